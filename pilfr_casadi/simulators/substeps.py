"""The number of integration steps per sample of a recording.

It keeps |λ| h below `LARGEST_STEP` for every eigenvalue λ of ∂f/∂x where a recording begins. If these are very fast,
the eigenvalues along a run from there decide.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import casadi as ca
import numpy as np

from .._base import InputError, usable
from ..data import Recording, moves_freely
from ..models import Model
from .equations import Equations
from .fmu_function import accumulate_steps, map_points
from .integration import ClosedEquations, Instant, discretise

LARGEST_STEP = 0.25  # largest |λ| h: a phase error of (λh)⁴/120 = 3e-5 of the angle of a cycle
MOST_SUBSTEPS = 200  # per sample
VERY_FAST = 8 * LARGEST_STEP  # |λ| times the sampling interval above which the rates along a trial run decide
INFINITE_RATE = 1e12  # replaces an infinite rate, rad/s
TRIAL_SUBSTEPS = 20  # sub-steps per sample of the trial run
# samples of the trial run, samples skipped at its beginning, and spacing of those that count
TRIAL_SAMPLES, SETTLING_SAMPLES, SPACING = 400, 40, 20
RATE_QUANTILE, FEWEST_RATES = 0.9, 5  # quantile of the rates along the run that decides, if there are more than these
SHOWN_VALUES = 8  # values named in a message


def states_along(model: Model, drive: np.ndarray, p: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Simulate from x (n_x,) with p (n_p,) or (K, n_p); return the states at the start of each step, (K, n_x)."""
    rows = p if p.ndim == 2 else np.broadcast_to(p, (len(drive), len(p)))
    with np.errstate(all="ignore"):
        found = accumulate_steps(model.closed, x, drive, rows)[0]
    return np.vstack([x[None], found[:-1]])


@functools.lru_cache(maxsize=8)  # callers ask for several rates of one simulator in turn
def _flow_function(simulator: Equations) -> ca.Function:
    """Make `(x, u, p) -> (f, ∂f/∂x)` of [x; laws' states], with zero memory."""
    vector = ca.SX.sym("p", simulator.parameter_set.size)
    equations = ClosedEquations(simulator, vector)
    n_x = len(simulator.states) + sum(equations.n_q)
    x, u = ca.SX.sym("x", n_x), ca.SX.sym("u", len(simulator.inputs))
    s = ca.SX.zeros(sum(equations.n_s))
    f = equations.evaluate(Instant(x, s, u, ca.SX.zeros(u.shape), ca.SX(0.0)))[0]
    return ca.Function("flow", [x, u, vector], [ca.densify(f), ca.densify(ca.jacobian(f, x))])


def _compute_eigenvalues(simulator: Equations, x: np.ndarray, u: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Compute the eigenvalues of ∂f/∂x at x (K, n_x) and u (K, n_u), (K, n); nan where ∂f/∂x is not finite."""
    flow = _flow_function(simulator)
    states = np.stack([_pad(row, flow.size1_in(0)) for row in x])
    slopes = map_points(flow, states, u, p)[1]
    out, finite = np.full(states.shape, np.nan, dtype=complex), np.all(np.isfinite(slopes), axis=(1, 2))
    out[finite] = np.linalg.eigvals(slopes[finite])
    return out


def fastest_rates(simulator: Equations, x: np.ndarray, u: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Compute the largest |eigenvalue| of ∂f/∂x, rad/s, at x (K, n_x) and u (K, n_u), shape (K,); nan if infinite."""
    if not simulator.states or simulator.discrete:
        return np.zeros(len(x))
    return np.asarray(np.max(np.abs(_compute_eigenvalues(simulator, x, u, p)), axis=1))


def growth_rate(simulator: Equations, recording: Recording) -> float:
    """Compute the largest real part of the eigenvalues of ∂f/∂x where a recording begins, 1/s; 0 without a state."""
    if not simulator.states or simulator.discrete:
        return 0.0
    begin, p = _initial_states(simulator, recording), simulator.parameter_set.start
    return float(np.max(np.nan_to_num(_compute_eigenvalues(simulator, begin[None], recording.u[:1], p).real)))


def needed_substeps(simulator: Equations, recordings: Sequence[Recording]) -> tuple[int, float]:
    """Count the sub-steps per sample that keep |λ| h below `LARGEST_STEP`, and give the largest |λ|, rad/s."""
    rate, first = rate_at_start(simulator, recordings[0]), recordings[0]
    if rate * first.dt > VERY_FAST:
        rate = _find_rate_along_run(simulator, first, rate)
    return max(1, int(np.ceil(rate * first.dt / LARGEST_STEP))), rate


def rate_at_start(simulator: Equations, recording: Recording) -> float:
    """Compute the largest |λ|, rad/s, where a recording begins; `INFINITE_RATE` where it is infinite."""
    p, start = simulator.parameter_set.start, _initial_states(simulator, recording)
    rate = fastest_rates(simulator, start[None], np.mean(recording.u, axis=0)[None], p)[0]
    return float(np.nan_to_num(rate, nan=INFINITE_RATE))


def choose_substeps(simulator: Equations, recordings: Sequence[Recording]) -> int:
    """Choose the sub-steps per sample that keep |λ| h below `LARGEST_STEP` where the first recording begins.

    If an eigenvalue is very fast, the eigenvalues along a run decide (a square root is infinitely steep at zero). Laws
    in ports may ask for more sub-steps (`least_substeps`). More than `MOST_SUBSTEPS`, or a derivative that is not
    finite, raises InputError.
    """
    needed, rate = needed_substeps(simulator, recordings)
    if needed <= MOST_SUBSTEPS:
        return max(needed, least_substeps(simulator))
    raise InputError(
        _describe_non_finite(simulator, recordings[0])
        or f"The simulator has an eigenvalue of {rate:.3g} rad/s, too fast for samples {recordings[0].dt:g} s apart; "
        "check its units, or replace the fast state by its steady state."
    )


def discretise_for(simulator: Equations, recordings: Sequence[Recording]) -> Model:
    """Discretise on the recordings' grid, with the stated hold of the inputs, else zero, and enough sub-steps."""
    hold = stated_hold(simulator, recordings) or "zero"
    return discretise(simulator, recordings[0].dt, hold, choose_substeps(simulator, recordings))


def stated_hold(simulator: Equations, recordings: Sequence[Recording], hold: str | None = None) -> str | None:
    """Return the hold that the recordings, the caller or the simulator state, in this order; None if none of them does.

    A simulator in discrete time reads its inputs at the samples, whatever the recordings state between them. Without an
    input that changes, any hold is the same.
    """
    stated = hold or simulator.hold
    if simulator.discrete:
        return stated or "zero"
    return one_hold(recordings) or stated or ("zero" if moves_freely(recordings) else None)


def one_hold(recordings: Sequence[Recording]) -> str | None:
    """Return the hold that the recordings state, None if none does; refuse several."""
    first, *others = dict.fromkeys(r.hold for r in recordings if r.hold) or [None]
    if others:
        raise InputError(
            f"The recordings differ in `hold` ({first!r} and {others[0]!r}), and a simulator is integrated with one of "
            "them; give all the same, as by recording.with_(hold=...), or use them one by one."
        )
    return first


def check_hold(simulator: Equations, recording: Recording, hold: str) -> None:
    """Refuse a recording that states another hold of its inputs than the one that a simulator was fitted with."""
    if recording.n_u and not simulator.discrete and recording.hold not in (None, hold):
        raise InputError(
            f"{recording.label} states hold={recording.hold!r}, and the simulator was fitted with {hold!r}; give that "
            f"by with_(hold={hold!r}), or simulate with the fitted `Simulator` itself, which takes each recording's."
        )


def least_substeps(simulator: Equations) -> int:
    """Return the fewest sub-steps per sample that the simulator and its laws allow; 1 in discrete time."""
    if simulator.discrete:
        return 1
    return max([simulator.substeps, *(int(getattr(e.law, "substeps", 1)) for e in simulator.elements)])


def _initial_states(simulator: Equations, recording: Recording) -> np.ndarray:
    """Return the simulator's states where a recording begins, zero unless the recording gives them."""
    given = np.asarray(recording.initial, dtype=float) if not isinstance(recording.initial, str) else np.zeros(0)
    n_x = len(simulator.states)
    return given[:n_x] if len(given) >= n_x else np.zeros(n_x)


def _pad(x: np.ndarray, n: int) -> np.ndarray:
    """Cut x to n entries, or append zeros up to n."""
    return np.append(x[:n], np.zeros(max(n - len(x), 0)))


def _run_trial(simulator: Equations, recording: Recording) -> tuple[Recording, np.ndarray]:
    """Simulate the beginning of a recording; return it and the states at every sub-step."""
    short = recording.slice(0, min(len(recording), TRIAL_SAMPLES))
    model = discretise(simulator, recording.dt, "zero", substeps=TRIAL_SUBSTEPS)
    first = _pad(_initial_states(simulator, recording), model.n_state)
    return short, states_along(model, model.drive(short), simulator.parameter_set.start, first)


def _find_rate_along_run(simulator: Equations, recording: Recording, rate: float) -> float:
    """Compute a high quantile of the rates along a run; return the given rate if the run diverges."""
    short, states = _run_trial(simulator, recording)
    x, u = states[::TRIAL_SUBSTEPS][SETTLING_SAMPLES::SPACING], short.u[SETTLING_SAMPLES::SPACING]
    if not len(x):
        return rate
    found = fastest_rates(simulator, x, u, simulator.parameter_set.start)
    found = found[np.isfinite(found)]
    return min(rate, float(np.quantile(found, RATE_QUANTILE))) if len(found) > FEWEST_RATES else rate


def _describe_non_finite(simulator: Equations, recording: Recording) -> str:
    """Say which state's derivative, or its slope, is not finite, and at which values; empty if all are finite."""
    p, flow, names = simulator.parameter_set.start, _flow_function(simulator), simulator.states
    n_x = flow.size1_in(0)

    def derivative(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.asarray(flow(x, u, p)[0]).ravel()

    start = _pad(_initial_states(simulator, recording), n_x)
    points = [(start, recording.u[0]), (start, np.mean(recording.u, axis=0))]
    if all(np.all(np.isfinite(derivative(*point))) for point in points):  # a later point of the run
        short, states = _run_trial(simulator, recording)
        states = states[:, :n_x]
        last = int(np.argmin(np.append(np.all(usable(states), axis=1), False))) - 1
        x, u = states[last], short.u[last // TRIAL_SUBSTEPS]
        points += [(x + share * recording.dt / TRIAL_SUBSTEPS * derivative(x, u), u) for share in (0.0, 0.5, 1.0)]
    for x, u in points:
        off = ~np.isfinite(derivative(x, u)[: len(names)])
        if np.all(usable(x)) and np.any(off):
            return _describe_point(simulator, f"The derivative of the state {names[int(np.argmax(off))]!r}", x, u)
    slope = ~np.isfinite(np.asarray(flow(*points[0], p)[1])[: len(names), : len(names)])
    if not np.any(slope):
        return ""
    i, j = np.argwhere(slope)[0]
    return _describe_point(
        simulator, f"The slope of the derivative of {names[i]!r} by the state {names[j]!r}", *points[0]
    )


def _describe_point(simulator: Equations, what: str, x: np.ndarray, u: np.ndarray) -> str:
    values = [*zip(simulator.states, x, strict=False), *zip(simulator.inputs, u, strict=True)]
    values += [(k, 0.0) for k, v in simulator.parameters.items() if v.value.ndim == 0 and float(v.value) == 0]
    shown = ", ".join(f"{name} = {float(value):.4g}" for name, value in values[:SHOWN_VALUES])
    more = f" and {len(values) - SHOWN_VALUES} more" if len(values) > SHOWN_VALUES else ""
    at_rest = (
        "; if the machine is never at zero, write the equations about its working point, or in Python give the states "
        "at a recording's first sample by the argument `initial` of Recording"
    )
    return (
        f"{what} is not finite at {shown}{more}; check what the equations divide by, or take a root or a logarithm of, "
        f"and the parameters' values{'' if np.any(x) else at_rest}."
    )
