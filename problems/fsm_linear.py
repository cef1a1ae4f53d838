r"""The fine steering mirror near each level: linear models in modal form, and how they move with the level.

    x⁺ = A x + B (u + κ_l z),   y = C x + D (u + κ_l z),   z = C_z x + D_z u,     κ = -1, 0, κ_3 at the three levels

A is block diagonal, one 2 x 2 block a mode. The forces κ z act where the actuators do, so `C_z` and `D_z` say how the
stiffness and the gain of the three actuators change with the level. Fitted to the spectra by damped least squares; the
level is told here, and only here: what is found is where the hysteretic models of `fsm` begin. Signals are in tenths of
a volt and in micrometres.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pilfr_casadi.linear import BLA, frequency_subspace

Array = np.ndarray
U_UNIT, Y_UNIT = 0.1, 1e-6  # V, m
LINES = np.arange(1, 3841)  # that are excited


@dataclass(frozen=True, eq=False)
class Spectra:
    """Fourier coefficients of a level's mean periods: U, Y (lines, channels, realizations), deviation of y, weights."""

    U: Array
    Y: Array
    deviation: Array
    weight: Array

    @classmethod
    def of(cls, u: Array, y: Array, weight: Array) -> Spectra:
        """From mean periods (samples, channels, realizations), in V and m."""
        n = len(u)
        U, Y = (np.fft.rfft(x, axis=0)[LINES] / n for x in (u / U_UNIT, y / Y_UNIT))
        return cls(U, Y, np.std(y / Y_UNIT, axis=(0, 2)), weight)


class Levels:
    """The family of models: variables in one vector, a linear model for each level."""

    def __init__(self, mask: Array, scheduled: int, levels: Sequence[int], period: int) -> None:
        n = len(mask)
        self.mask, self.n_z, self.levels, self.z = mask, scheduled, tuple(levels), np.exp(2j * np.pi * LINES / period)
        self.shapes: dict[str, tuple[int, ...]] = {"A": (int(mask.sum()),), "B": (n, 3), "C": (3, n), "D": (3, 3)}
        if scheduled:
            self.shapes |= {"C_z": (scheduled, n), "D_z": (scheduled, 3), "kappa": (scheduled,)}

    def pack(self, values: dict[str, Array]) -> Array:
        """One vector."""
        return np.concatenate([np.ravel(values[name]) for name in self.shapes])

    def unpack(self, theta: Array) -> dict[str, Array]:
        """Blocks by name; A whole."""
        out, at = {}, 0
        for name, shape in self.shapes.items():
            size = int(np.prod(shape))
            out[name], at = theta[at : at + size].reshape(shape), at + size
        A = np.zeros(self.mask.shape)
        A[self.mask] = out["A"]
        return {**out, "A": A}

    def at(self, v: dict[str, Array], level: int) -> tuple[Array, Array, Array, Array, Array]:
        """A, B, C, D and κ at a level."""
        if not self.n_z:
            return v["A"], v["B"], v["C"], v["D"], np.zeros(0)
        kappa = np.array([-np.ones(self.n_z), np.zeros(self.n_z), v["kappa"]][level])
        B, D = v["B"][:, : self.n_z] * kappa, v["D"][:, : self.n_z] * kappa
        return v["A"] + B @ v["C_z"], v["B"] + B @ v["D_z"], v["C"] + D @ v["C_z"], v["D"] + D @ v["D_z"], kappa

    def kept(self, theta: Array) -> Array:
        """Real poles held inside (-0.7, 0.99): beyond, they are not what the lines tell of."""
        rows = np.nonzero(self.mask)[0]
        single = self.mask.sum(axis=1)[rows] == 1
        theta = theta.copy()
        head = theta[: len(rows)]
        head[single] = np.clip(head[single], -0.7, 0.99)
        return theta


def response(A: Array, B: Array, C: Array, U: Array, z: Array) -> tuple[Array, Array]:
    """`C (zI - A)^-1` (lines, 3, n), and the states (lines, n) under U (lines, 3)."""
    values, V = np.linalg.eig(A)
    inverse, gain = np.linalg.inv(V), 1 / (z[:, None] - values)
    return ((C @ V)[None] * gain[:, None, :]) @ inverse, ((U @ (inverse @ B).T) * gain) @ V.T


def normal(
    family: Levels, theta: Array, data: Sequence[Spectra], step: int, jacobian: bool = True
) -> tuple[float, Array, Array]:
    """Mean squared relative error of the outputs, with gradient and Gauss-Newton Hessian; every `step`-th line."""
    v, m = family.unpack(theta), len(theta)
    value, gradient, hessian, count = 0.0, np.zeros(m), np.zeros((m, m)), 0
    z, (rows, columns) = family.z[::step], np.nonzero(family.mask)
    for level in family.levels:
        A, B, C, D, kappa = family.at(v, level)
        if np.max(np.abs(np.linalg.eigvals(A))) >= 1.05:
            return np.inf, gradient, hessian
        spectra = data[level]
        for r in range(spectra.U.shape[2]):
            U = spectra.U[::step, :, r]
            H, X = response(A, B, C, U, z)
            scale = spectra.weight[r] / spectra.deviation * np.sqrt(2 * step)
            e = (X @ C.T + U @ D.T - spectra.Y[::step, :, r]) * scale
            value, count = value + float(np.sum(np.abs(e) ** 2)), count + 3
            if not jacobian:
                continue
            driven, direct = H * scale[:, None], np.eye(3) * scale
            signal, own = U, np.zeros((len(z), 0))
            if family.n_z:
                own = X @ v["C_z"].T + U @ v["D_z"].T
                signal = U.copy()
                signal[:, : family.n_z] += own * kappa
            parts = [
                driven[:, :, rows] * X[:, None, columns],
                driven[:, :, :, None] * signal[:, None, None, :],
                direct[None, :, :, None] * X[:, None, None, :],
                direct[None, :, :, None] * signal[:, None, None, :],
            ]
            if family.n_z:
                through = (H @ v["B"] + v["D"])[:, :, : family.n_z] * scale[:, None]
                parts += [(through * kappa)[..., None] * X[:, None, None, :]]
                parts += [(through * kappa)[..., None] * U[:, None, None, :]]
                parts += [through * own[:, None, :] * (level == 2)]
            J = np.concatenate([p.reshape(len(z), 3, -1) for p in parts], axis=2).reshape(-1, m)
            real, residual = np.concatenate([J.real, J.imag]), np.concatenate([e.ravel().real, e.ravel().imag])
            hessian += real.T @ real
            gradient += real.T @ residual
    return value / count, gradient / count, hessian / count


def refined(
    family: Levels, theta: Array, data: Sequence[Spectra], step: int = 3, iterations: int = 20, seconds: float = 90.0
) -> Array:
    """Damped Gauss-Newton from θ until the error falls by less than 0.02 % a step."""
    began, damping = time.process_time(), 1e-3
    value, gradient, hessian = normal(family, theta, data, step)
    largest = np.diag(hessian)
    for _ in range(iterations):
        largest = np.maximum(largest, np.diag(hessian))
        unit = np.maximum(largest, 1e-12 * largest.max())
        for _ in range(9):
            trial = family.kept(theta - np.linalg.solve(hessian + damping * np.diag(unit), gradient))
            reached = normal(family, trial, data, step, jacobian=False)[0]
            if reached < value:
                break
            damping *= 5
        else:
            break
        gain, theta, damping = 1 - reached / value, trial, max(damping / 4, 1e-9)
        if gain < 4e-4 or time.process_time() - began > seconds:
            break
        value, gradient, hessian = normal(family, theta, data, step)
    return theta


def modal(A: Array) -> tuple[Array, Array]:
    """Coordinates T (columns) in which A is block diagonal, pairs first by frequency, and the mask of its blocks."""
    values, V = np.linalg.eig(A)
    pairs = sorted((i for i in range(len(A)) if values[i].imag > 0), key=lambda i: np.angle(values[i]))
    single = sorted((i for i in range(len(A)) if values[i].imag == 0), key=lambda i: -values[i].real)
    columns = [part for i in pairs for part in (V[:, i].real, V[:, i].imag)] + [V[:, i].real for i in single]
    mask = np.eye(len(A), dtype=bool)
    for k in range(0, 2 * len(pairs), 2):
        mask[k : k + 2, k : k + 2] = True
    return np.array(columns).T, mask


def in_modes(A: Array, B: Array, C: Array, *rows: Array) -> tuple[Array, ...]:
    """mask, A, B, C and further rows in modal coordinates, states of a mode scaled alike and balanced."""
    T, mask = modal(A)
    inverse = np.linalg.inv(T)
    A, B, C = inverse @ A @ T * mask, inverse @ B, C @ T
    size = np.linalg.norm(B, axis=1) / np.linalg.norm(C, axis=0)
    scale = np.sqrt(mask @ size / mask.sum(axis=1))
    return mask, A * scale / scale[:, None], B / scale[:, None], C * scale, *(row @ T * scale for row in rows)


def first_modes(spectra: Spectra, period: int, order: int = 48, least_damping: float = 2.5e-3) -> dict[str, Array]:
    """Subspace identification at one level, without the modes that are hardly damped or beyond the excited lines."""
    G = np.empty((len(LINES), 3, 3), dtype=complex)
    for k in range(len(LINES)):
        G[k] = (spectra.Y[k] * spectra.weight) @ np.linalg.pinv(spectra.U[k] * spectra.weight)
    system = frequency_subspace(BLA(LINES / period, G, None, None, 1.0), order, weight=False)
    mask, A, B, C = in_modes(*(np.asarray(M) for M in (system.A, system.B, system.C)))
    values = np.array([np.linalg.eigvals(A[np.ix_(row, row)])[0] for row in mask])
    logarithm = np.log(values.astype(complex))
    damping = -logarithm.real / np.abs(logarithm)
    keep = np.where(mask.sum(axis=1) == 2, damping > least_damping, values.real > -0.7)
    square = np.ix_(keep, keep)
    return {"mask": mask[square], "A": A[square], "B": B[keep], "C": C[:, keep], "D": np.asarray(system.D)}


def fitted_levels(
    start: dict[str, Array], data: Sequence[Spectra], levels: Sequence[int], scheduled: int, period: int, step: int = 3
) -> tuple[Levels, Array]:
    """The family fitted to some levels from the blocks of `start`."""
    family = Levels(start["mask"], scheduled, levels, period)
    n = len(start["mask"])
    begin = {**start, "A": start["A"][start["mask"]]}
    begin |= {"C_z": np.zeros((scheduled, n)), "D_z": np.zeros((scheduled, 3)), "kappa": np.ones(scheduled)}
    return family, refined(family, family.pack(begin), data, step)


def simulated(family: Levels, theta: Array, spectra: Spectra, level: int, period: int) -> tuple[Array, Array]:
    """Outputs in m (samples, 3, realizations), and the signals z (samples, n_z, realizations), in steady state."""
    v = family.unpack(theta)
    A, B, C, D, _ = family.at(v, level)
    y, own = [], []
    for r in range(spectra.U.shape[2]):
        U = spectra.U[:, :, r]
        X = response(A, B, C, U, family.z)[1]
        y.append(_wave(X @ C.T + U @ D.T, period) * Y_UNIT)
        own.append(_wave(X @ v["C_z"].T + U @ v["D_z"].T, period) if family.n_z else np.zeros((period, 0)))
    return np.stack(y, axis=2), np.stack(own, axis=2)


def _wave(lines: Array, period: int) -> Array:
    full = np.zeros((period // 2 + 1, lines.shape[1]), dtype=complex)
    full[LINES] = lines * period
    return np.fft.irfft(full, n=period, axis=0)
