r"""Subspace identification of a linear model from a frequency response function.

.. math:: G(z) = C (z I - A)^{-1} B + D

McKelvey, Akçay & Ljung (1996), Subspace-based multivariable system identification from frequency response data, IEEE
Trans. Automatic Control 41(7), 960-979, algorithm 2 (any frequency grid, noise weighting), with two changes. Where they
stack powers ``1, z, ..., z^(r-1)``, which are nearly dependent unless the frequencies fill the unit circle, polynomials
in ``z`` are used that are orthonormal on the grid (Brubeck, Nakatsukasa & Trefethen (2021), Vandermonde with Arnoldi,
SIAM Review 63(2), 405-415); the shift structure then is the recurrence of the polynomials. And with several outputs
`C`, `D` and `B`, `D` are solved for in turn a few times, as `C` from the singular vectors alone is the least certain
part.
"""

from __future__ import annotations

import numpy as np

from .._base import InputError
from ..models import or_one
from .bla import BLA, moving_mean
from .statespace import resolvent
from .subspace_problem import BUDGET, ROUNDING, Matrices, RangeSpace, SubspaceProblem, least_squares, triangle

Array = np.ndarray

SWEEPS = 2  # turns of solving for C, D and for B, D


class FrequencyProblem(SubspaceProblem):
    """Subspace identification from the response at some of the frequencies of a BLA."""

    def __init__(self, bla: BLA, weight: bool, part: slice = slice(None)) -> None:
        G, self.dt = np.asarray(bla.G, dtype=complex)[part], bla.dt
        frequency = np.asarray(bla.frequency, dtype=float)[part]
        if G.ndim != 3 or len(G) != len(frequency) or not np.all(np.isfinite(G)):
            raise InputError("G of the BLA must be finite, of shape (frequencies, outputs, inputs); check the BLA.")
        if np.any(frequency < 0) or np.any(frequency > 0.5000001 / bla.dt):
            raise InputError(
                f"the BLA has frequencies outside 0 to {0.5 / bla.dt:g} Hz, half the sampling rate; check the unit of "
                "frequency and dt."
            )
        self.z = np.exp(2j * np.pi * frequency * bla.dt)
        self.y_scale, self.u_scale = _balanced_units(np.sqrt(np.mean(np.abs(G) ** 2, axis=0)))
        units = self.y_scale[:, None] / self.u_scale
        self.G = G / units
        self.var = np.ones(G.shape)
        self.weighted = weight and bla.var_total is not None
        if self.weighted:
            var = moving_mean(np.asarray(bla.var_total)[part], 5) / units**2
            self.var = var + ROUNDING**2 * np.mean(np.abs(self.G) ** 2)
        self.size = max(float(np.sum(np.abs(self.G) ** 2 / self.var)), 1e-300)
        F, n_y, n_u = G.shape
        self.affordable_rows = np.sqrt(BUDGET / (F * n_u)) / n_y
        self.most_rows = (2 * F * n_u - 1) // (n_y + n_u) if 2 * F > 2 else 0
        self.too_few = f"{F} frequencies are too few"

    def range_space(self, r: int) -> RangeSpace:
        """See :meth:`SubspaceProblem.range_space`."""
        F, n_y, n_u = self.G.shape
        P, H = _orthonormal_polynomials(self.z, r)
        Q = P * np.sqrt(np.mean(1 / self.var, axis=(1, 2)))
        T = _real((Q[:, None, None, :] * self.G.transpose(1, 2, 0)).reshape(-1, F))
        inputs = np.linalg.qr(_real(Q).T)[0].T
        T -= (T @ inputs.T) @ inputs  # project off the rows of the input, the same for every input
        T = T.reshape(r * n_y, n_u * 2 * F)
        K = np.eye(r * n_y)
        if self.weighted:  # covariance of the noise in T is K K'
            for i in range(n_y):
                covariance = ((Q * self.var[:, i].sum(axis=1)) @ Q.conj().T).real
                K[i::n_y, i::n_y] = np.linalg.cholesky(covariance)
            T = np.linalg.solve(K, T)
        left, values, _ = np.linalg.svd(triangle(T.T).T)
        basis = (K @ left).reshape(r, n_y, -1)
        shifted = np.einsum("ij,iok->jok", H, basis).reshape((r - 1) * n_y, -1)
        m = len(shifted)
        return RangeSpace(left[:m], np.linalg.solve(K[:m, :m], shifted), basis[0] / P[0, 0].real, values)

    def reduced(self, A: Array, C: Array) -> list[Array]:
        """See :meth:`SubspaceProblem.reduced`."""
        return _response_problems(A, C, self.z, self.G, self.var)

    def complete(self, A: Array, C: Array) -> tuple[Matrices, float]:
        """As :meth:`SubspaceProblem.complete`; with several outputs `C` is solved for as well."""
        model, error = super().complete(A, C)
        if len(self.y_scale) > 1:
            G, var = self.G.swapaxes(1, 2), self.var.swapaxes(1, 2)
            for _ in range(SWEEPS):  # C and D are to the transposed response what B and D are to the response
                blocks = _response_problems(A.T, (model.B * self.u_scale).T, self.z, G, var)
                C = np.array([least_squares(R[:, :-1], R[:, -1])[: len(A)] for R in blocks])
                model, error = super().complete(A, C)
        return model, error


def _balanced_units(size: Array) -> tuple[Array, Array]:
    """Scales of outputs (rows) and inputs (columns) that make every row and column of `size` one in mean square."""
    rows, columns = np.ones(size.shape[0]), np.ones(size.shape[1])
    for _ in range(100):
        rows = or_one(np.sqrt(np.mean((size * columns) ** 2, axis=1)))
        columns = 1 / or_one(np.sqrt(np.mean((size / rows[:, None]) ** 2, axis=0)))
    return rows, columns


def _orthonormal_polynomials(z: Array, r: int) -> tuple[Array, Array]:
    """Polynomials of degree 0 to r - 1 at `z`, orthonormal over `z` and its conjugates.

    Returns the values, (r, F), and the real recurrence `H`, (r, r - 1): ``z p_j = sum_i H[i, j] p_i``.
    """
    P, H = np.empty((r, len(z)), dtype=complex), np.zeros((r, r - 1))
    P[0] = 1 / np.sqrt(len(z))
    for j in range(r - 1):
        v = z * P[j]
        for _ in range(2):
            h = (P[: j + 1].conj() @ v).real
            H[: j + 1, j] += h
            v -= h @ P[: j + 1]
        H[j + 1, j] = np.linalg.norm(v)
        P[j + 1] = v / H[j + 1, j]
    return P, H


def _real(X: Array) -> Array:
    return np.concatenate([X.real, X.imag], axis=1)


def _response_problems(A: Array, C: Array, z: Array, G: Array, var: Array) -> list[Array]:
    """Triangular factors ``[K y]`` of ``(C (z I - A)⁻¹ b + d) / std = G[:, :, j] / std``, one for each input j."""
    F, n_y, n_u = G.shape
    K = np.empty((F, n_y, len(A) + n_y + 1), dtype=complex)
    K[..., : len(A)] = resolvent(A, C, z)
    K[..., len(A) : -1] = np.eye(n_y)
    blocks = []
    for j in range(n_u):
        K[..., -1] = G[..., j]
        rows = (K / np.sqrt(var[..., j, None])).reshape(F * n_y, -1)
        blocks.append(triangle(np.concatenate([rows.real, rows.imag])))
    return blocks
