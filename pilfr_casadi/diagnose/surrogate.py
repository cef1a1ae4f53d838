r"""A linear stand-in for a simulation of which only inputs and outputs are known, in modes with names.

A discrete model identified from the simulation's own record is taken to continuous time,

.. math:: A_c = \log(A) / \Delta t, \qquad B_c = \left(\int_0^{\Delta t} e^{A_c s} ds\right)^{-1} B
   \quad\text{(inputs held)},

with the first-order-hold counterpart where inputs are interpolated, and split into real modes. A pair of eigenvalues
`-ζ ω ± j ω √(1 - ζ²)` becomes a displacement `q` and its rate `v`,

.. math:: \dot q = v + b_q u, \qquad \dot v = -\omega^2 q - 2 ζ ω v + b_v u, \qquad y = c_q q + c_v v,

a real eigenvalue `-r` the equation `q' = -r (q - b u)`. Frequencies, dampings and gains are parameters. The
conversions are those of Franklin, Powell & Workman (1998), Digital Control of Dynamic Systems, Sec. 4.3 and 6.3.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from ..fit import fit
from ..lfr import PILFR
from ..metrics import nrmse
from ..parameters import Parameter
from ..recording import InputError, Recording, as_recordings, check_for_identification
from ..simulator import Named, Port, Simulator

POOR = 0.02  # NRMSE above which the simulation is not linear enough for a surrogate to stand for it
FREE = 0.3  # share by which parameters may move
FAST = 0.9  # eigenvalues closer to the Nyquist frequency than this share have no continuous counterpart to trust
EXACT = 1e-3  # NRMSE at which no higher order is looked for
HIGHEST = 8
SMALL = 1e-3  # share of an output below which a coefficient is held
Array = np.ndarray
Progress = Callable[[str, int, int, float], None]


@dataclass(frozen=True, eq=False)
class Mode:
    """A real mode: one eigenvalue, or a conjugate pair.

    Attributes
    ----------
    value : complex
        Eigenvalue in rad/s; of a pair the one with positive imaginary part, of two real ones the faster.
    into : array, shape (1 or 2, n_u)
        How inputs enter q (and v).
    out : array, shape (n_y, 1 or 2)
        How q (and v) are seen.
    spring : (float, float), optional
        For two real eigenvalues -a and -b taken together: a b and a + b.
    """

    value: complex
    into: Array
    out: Array
    spring: tuple[float, float] | None = None

    @property
    def second_order(self) -> bool:
        """Whether it has a displacement and a rate."""
        return bool(len(self.into) == 2)

    def label(self, slowest: float) -> str:
        """Readable name: the frequency in Hz, of a pair the undamped natural one; zero below `slowest` rad/s."""
        rate = np.sqrt(abs(self.spring[0])) if self.spring else abs(self.value)
        return f"{rate / (2 * np.pi):.3g} Hz" if rate > slowest else "0 Hz"


def surrogate(
    recordings: Recording | Sequence[Recording], *, nx: int | None = None, progress: Progress | None = None
) -> tuple[Simulator, float]:
    """Identify a linear simulator from what a simulation was given and what it answered.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Inputs and outputs of the simulation.
    nx : int, optional
        States; chosen on the recordings where left out.
    progress : callable, optional
        Called with (stage, done, total, smallest error so far).

    Returns
    -------
    Simulator
        In modes, with the ports `mode:<frequency> Hz`; its parameters may move by 30 %.
    float
        Its NRMSE on the recordings, in free-run simulation from the fitted initial state.

    Raises
    ------
    InputError
        If nothing can be identified from the recordings.
    """
    records = check_for_identification(as_recordings(recordings), 40)
    hold = next((r.hold for r in records if r.hold), None)
    # the states of the sampled model are not those of the simulation: with interpolated inputs rest is not zero there
    records = tuple(r if r.period else r.with_(initial="estimate") for r in records)
    found: list[tuple[float, Simulator]] = []
    for n in range(HIGHEST + 1) if nx is None else (nx,):  # a simulation has no noise: its order shows by itself
        one = _identified(records, n, hold, progress)
        found += [one] if one is not None else []
        if found and found[-1][0] < EXACT:
            break
    if not found:
        raise InputError(
            "No linear model in continuous time follows the simulation; give the simulator itself, or a simulation "
            "at a shorter step."
        )
    least = min(error for error, _ in found)
    error, simulator = next(f for f in found if f[0] <= max(1.1 * least, EXACT))
    return simulator, error


def _identified(
    records: Sequence[Recording], n: int, hold: str | None, progress: Progress | None
) -> tuple[float, Simulator] | None:
    try:
        found = fit(PILFR(n), records, progress=progress)
    except InputError:
        return None
    p = found.parameters
    a, b, c, d = (p[k] for k in ("A", "B_u", "C_y", "D_yu"))
    options = []
    for between in (hold,) if hold else ("zero", "linear"):
        try:
            continuous = to_continuous(a, b, c, d, records[0].dt, between)
        except InputError:
            continue
        direct = np.max(np.abs(continuous[3]) / np.maximum(np.abs(d).max(), 1e-300), initial=0.0)
        options.append((float(direct), between, continuous))
    if not options:
        return None
    # a simulation without direct feed-through tells by it how its inputs went between the samples
    _, between, matrices = min(options, key=lambda o: o[0]) if not hold else options[0]
    simulator = replace(modal_simulator(matrices, np.ravel(p["y_0"]), records[0]), hold=between)
    errors = [nrmse(r.y, found.simulate(r), skip=r.skip) for r in records]
    return float(np.mean(errors)), simulator


def to_continuous(a: Array, b: Array, c: Array, d: Array, dt: float, hold: str) -> tuple[Array, Array, Array, Array]:
    """A discrete state space in continuous time, for inputs that are held or interpolated between the samples.

    Parameters
    ----------
    a, b, c, d : array
        Shapes (n, n), (n, n_u), (n_y, n), (n_y, n_u).
    dt : float
        Sampling interval, s.
    hold : {"zero", "linear"}

    Raises
    ------
    InputError
        Where an eigenvalue lies on the negative real axis, or too near the Nyquist frequency or zero.
    """
    from scipy.linalg import expm, logm

    n = len(a)
    if not n:
        return a, b, c, d
    values = np.linalg.eigvals(a)
    angle = np.abs(np.angle(values))
    if np.any(angle > FAST * np.pi) or np.any(np.abs(values) < 1e-4):
        raise InputError("The model has a mode too fast for its step; simulate at a shorter step.")
    a_c = np.real(logm(a)) / dt
    # ∫ e^{A s} ds and ∫ e^{A (Δ - s)} s ds / Δ in one exponential (Van Loan, 1978)
    block = np.zeros((3 * n, 3 * n))
    block[:n, :n], block[:n, n : 2 * n], block[n : 2 * n, 2 * n :] = a_c * dt, np.eye(n) * dt, np.eye(n)
    whole = expm(block)
    gamma_1, gamma_2 = whole[:n, n : 2 * n], whole[:n, 2 * n :]
    if hold == "zero":
        return a_c, np.linalg.solve(gamma_1, b), c, d
    # x⁺ = A x + (Γ₁ - Γ₂) B u + Γ₂ B u⁺ is x⁺ = A x' + B_d u with x' = x - Γ₂ B u:  B_d = (Γ₁ - Γ₂ + A Γ₂) B
    b_c = np.linalg.solve(gamma_1 - gamma_2 + a @ gamma_2, b)
    return a_c, b_c, c, d - c @ gamma_2 @ b_c


def modes(a: Array, b: Array, c: Array) -> list[Mode]:
    """Real modes of a state space, slowest first."""
    values, right = np.linalg.eig(a)
    left = np.linalg.inv(right)
    out: list[Mode] = []
    for k, value in enumerate(values):
        if value.imag < -1e-9 * abs(value):
            continue
        into, seen = left[k] @ b, c @ right[:, k]
        if abs(value.imag) <= 1e-9 * abs(value):
            scale = _unit(np.real(into[None, :]))
            out.append(Mode(complex(value.real), np.real(into[None, :]) / scale, np.real(seen[:, None]) * scale))
            continue
        # contribution 2 Re(seen s), s' = value s + into u; q and v = q' span (Re s, Im s): q = 2 Re(m s) for any m
        turn = np.conj(into[np.argmax(np.abs(into))])
        m = turn / (1j * abs(turn)) if abs(turn) else 1.0 + 0j  # the strongest input enters v alone
        basis = np.array([[m, np.conj(m)], [m * value, np.conj(m * value)]])  # (q, v) = basis (s, s*)
        entering = np.real(basis @ np.array([into, np.conj(into)]))
        output = np.real(np.column_stack([seen, np.conj(seen)]) @ np.linalg.inv(basis))
        scale = _unit(entering[1:])
        out.append(Mode(complex(value), entering / scale, output * scale))
    return sorted(_together(out), key=lambda mode: abs(mode.value))


def _together(found: list[Mode]) -> list[Mode]:
    """Two real modes that inputs enter alike and whose jumps cancel are one mass: `q'' = -a b q - (a + b) q' + u`."""
    real = [mode for mode in found if not mode.second_order]
    if len(real) != 2 or not np.allclose(real[0].into, real[1].into, rtol=0.0, atol=0.02):
        return found
    (one, two), jump = real, real[0].out + real[1].out
    if np.max(np.abs(jump)) > 0.02 * np.max(np.abs(one.out)):
        return found
    a, b = -one.value.real, -two.value.real
    into, out = np.vstack([0 * one.into, one.into]), np.column_stack([one.out * b + two.out * a, jump])
    rest = [mode for mode in found if mode.second_order]
    return [*rest, Mode(complex(-max(a, b, key=abs)), into, out, (a * b, a + b))]


def _unit(into: Array) -> float:
    """A scale that leaves the largest gain of the inputs at one."""
    largest = into.ravel()[np.argmax(np.abs(into))]
    return float(largest) if largest else 1.0


def modal_simulator(matrices: tuple[Array, Array, Array, Array], offset: Array, like: Recording) -> Simulator:
    """A simulator in modes, with the names of a recording.

    Parameters
    ----------
    matrices : A, B, C, D
        In continuous time.
    offset : array, shape (n_y,)
        Constants of the outputs.
    """
    found = modes(*matrices[:3])
    names = _distinct([mode.label(0.05 / (len(like) * like.dt)) for mode in found])
    parameters: dict[str, Parameter] = {}
    states: list[str] = []
    inputs, outputs = like.inputs, like.outputs

    def free(name: str, value: float, unit: str = "", size: float = 0.0) -> None:
        reach = FREE * max(abs(value), 0.1 * size)
        held = abs(value) <= SMALL * size
        parameters[name] = Parameter(value, unit=unit, bounds=(value - reach, value + reach), fixed=held)

    for i, mode in enumerate(found, 1):
        speed = np.array([1.0, max(abs(mode.value), 1 / (len(like) * like.dt))])[
            : len(mode.into)
        ]  # v is this much larger than q
        entering = float(np.max(np.abs(mode.into) * (speed[::-1])[:, None]))
        leaving = float(np.max(np.abs(mode.out) * speed))
        if mode.spring:
            rate = max(abs(mode.value), 1 / (len(like) * like.dt))
            free(f"stiffness{i}", mode.spring[0], "1/s^2", rate**2)
            free(f"drag{i}", mode.spring[1], "1/s", rate)
            states += [f"q{i}", f"v{i}"]
        elif mode.second_order:
            w = abs(mode.value)
            free(f"frequency{i}", w / (2 * np.pi), "Hz")
            free(f"damping{i}", -mode.value.real / w)
            states += [f"q{i}", f"v{i}"]
        else:
            parameters[f"rate{i}"] = _rate(-mode.value.real)
            states.append(f"q{i}")
        kinds = ("rate_gain", "gain") if mode.second_order else ("gain",)
        for row, kind, faster in zip(mode.into, kinds, speed[::-1], strict=True):
            for name, value in zip(inputs, row, strict=True):
                if value == 1.0:  # the gain of the strongest input is one; what is seen of the mode has its size
                    parameters[f"{kind}{i}_{name}"] = Parameter(1.0, fixed=True)
                else:
                    free(f"{kind}{i}_{name}", float(value), size=entering / faster)
        for column, kind, faster in zip(mode.out.T, ("shape", "rate_shape")[: len(speed)], speed, strict=True):
            for name, value in zip(outputs, column, strict=True):
                free(f"{kind}{i}_{name}", float(value), like.units.get(name, ""), leaving / faster)
    spreads, moved = np.std(like.y[like.skip :], axis=0), np.std(like.u, axis=0)
    for name, row, spread in zip(outputs, matrices[3], spreads, strict=True):
        for other, value, push in zip(inputs, row, moved, strict=True):
            free(f"direct_{name}_{other}", float(value), size=float(spread / max(push, 1e-300)))
    for name, value, spread in zip(outputs, offset, spreads, strict=True):
        parameters[f"offset_{name}"] = Parameter(value, bounds=(value - spread, value + spread))

    def driven(u: Named, p: Named, kind: str, i: int) -> Any:
        return sum((p[f"{kind}{i}_{n}"] * u[n] for n in inputs), start=ca.SX(0))

    def dynamics(x: Named, u: Named, p: Named) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for i, mode in enumerate(found, 1):
            if mode.second_order:
                q, v = x[f"q{i}"], x[f"v{i}"]
                if mode.spring:
                    pull = p[f"stiffness{i}"] * q + p[f"drag{i}"] * v
                else:
                    w = 2 * np.pi * p[f"frequency{i}"]
                    pull = w**2 * q + 2 * p[f"damping{i}"] * w * v
                out[f"q{i}"] = v + driven(u, p, "rate_gain", i)
                out[f"v{i}"] = driven(u, p, "gain", i) - pull
            else:
                out[f"q{i}"] = -p[f"rate{i}"] * x[f"q{i}"] + driven(u, p, "gain", i)
        return out

    def seen(x: Named, u: Named, p: Named) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for name in outputs:
            y = p[f"offset_{name}"] + sum((p[f"direct_{name}_{n}"] * u[n] for n in inputs), start=ca.SX(0))
            for i, mode in enumerate(found, 1):
                y = y + p[f"shape{i}_{name}"] * x[f"q{i}"]
                if mode.second_order:
                    y = y + p[f"rate_shape{i}_{name}"] * x[f"v{i}"]
            out[name] = y
        return out

    ports = tuple(_port(f"mode:{name}", i, mode) for i, (name, mode) in enumerate(zip(names, found, strict=True), 1))
    return Simulator(dynamics, seen, tuple(states), inputs, parameters, ports, units=dict(like.units))


def _rate(value: float) -> Parameter:
    reach = FREE * abs(value)
    return Parameter(value, unit="1/s", bounds=(value - reach, value + reach))


def _port(name: str, i: int, mode: Mode) -> Port:
    if not mode.second_order:
        return Port(name, {f"q{i}": -1.0}, lambda x: x[f"q{i}"])
    return Port(name, {f"v{i}": -1.0}, lambda x: x[f"q{i}"], lambda x: x[f"v{i}"])


def _distinct(names: list[str]) -> list[str]:
    """Equal names with a number behind."""
    return [n if names.count(n) == 1 else f"{n} ({names[:k].count(n) + 1})" for k, n in enumerate(names)]
