"""How many sub-steps a sample a simulator needs: |λ| h is to stay below `REACH` for every eigenvalue λ of ∂f/∂x.

What is looked at is where a recording begins; where that is very fast, a run from there.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from .._base import InputError
from ..data import Recording
from ..models import ParameterSet
from .integration import Equations, Instant, discretise, states_along
from .simulator import Simulator

REACH = 0.25  # largest |λ| h: phase error (λh)⁴/120 = 3e-5 of a cycle's angle
MOST = 200  # sub-steps a sample
ENDLESS = 1e100  # a state beyond this has grown without end
SHOWN = 8  # values named in a sentence


def _flow(simulator: Simulator, n_p: int) -> ca.Function:
    """`(x, u, p) -> (f, ∂f/∂x)` of [x; laws' states], memory at rest."""
    vector = ca.SX.sym("p", n_p)
    equations = Equations(simulator, vector)
    n_x = len(simulator.states) + sum(equations.n_q)
    x, u = ca.SX.sym("x", n_x), ca.SX.sym("u", len(simulator.inputs))
    s = ca.SX.zeros(sum(equations.n_s))
    f = equations.evaluate(Instant(x, s, u, ca.SX.zeros(u.shape), ca.SX(0.0)))[0]
    return ca.Function("flow", [x, u, vector], [f, ca.densify(ca.jacobian(f, x))])


def fastest(simulator: Simulator, x: np.ndarray, u: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Largest |eigenvalue| of ∂f/∂x, rad/s, at states x (K, n_x) and inputs u (K, n_u), shape (K,); nan if infinite."""
    if not simulator.states or simulator.discrete:
        return np.zeros(len(x))
    flow = _flow(simulator, len(p))
    n_x, out = flow.size1_in(0), np.full(len(x), np.nan)
    for k, (row, inputs) in enumerate(zip(x, u, strict=True)):
        full = np.concatenate([row, np.zeros(n_x - len(row))]) if len(row) < n_x else row[:n_x]
        a = np.asarray(flow(full, inputs, p)[1])
        if np.all(np.isfinite(a)):
            out[k] = float(np.max(np.abs(np.linalg.eigvals(a))))
    return out


def growth(simulator: Simulator, recording: Recording) -> float:
    """Largest real part of the eigenvalues of ∂f/∂x where a recording begins, 1/s; none where there is no state."""
    if not simulator.states or simulator.discrete:
        return 0.0
    p = ParameterSet(dict(simulator.parameters)).start
    flow, start = _flow(simulator, len(p)), _start(simulator, recording)
    a = np.asarray(flow(np.append(start, np.zeros(flow.size1_in(0) - len(start))), recording.u[0], p)[1])
    return float(np.max(np.linalg.eigvals(a).real)) if np.all(np.isfinite(a)) else 0.0


def wanted_substeps(simulator: Simulator, recordings: Sequence[Recording]) -> tuple[int, float]:
    """Sub-steps a sample that keep |λ| h below `REACH`, and the largest |λ|, rad/s; see `choose_substeps`."""
    rate, first = at_begin(simulator, recordings[0]), recordings[0]
    if rate * first.dt > 8 * REACH:
        p = ParameterSet(dict(simulator.parameters)).start
        rate = _along_a_run(simulator, first, p, _start(simulator, first), rate)
    return max(1, int(np.ceil(rate * first.dt / REACH))), rate


def at_begin(simulator: Simulator, recording: Recording) -> float:
    """Largest |λ|, rad/s, where a recording begins; 1e12 where that is infinite."""
    p, start = ParameterSet(dict(simulator.parameters)).start, _start(simulator, recording)
    rate = fastest(simulator, start[None], np.mean(recording.u, axis=0)[None], p)[0]
    return float(np.nan_to_num(rate, nan=1e12))


def choose_substeps(simulator: Simulator, recordings: Sequence[Recording]) -> int:
    """Sub-steps a sample that keep |λ| h below `REACH`, from the Jacobian where the first recording begins.

    Where that is very fast, a run is looked at instead (a square root is infinitely steep at zero).

    Raises
    ------
    InputError
        If more than `MOST` would be needed, or a derivative is not finite.
    """
    needed, rate = wanted_substeps(simulator, recordings)
    if needed <= MOST:
        return needed
    raise InputError(
        _not_finite(simulator, recordings[0])
        or f"The simulator has an eigenvalue of {rate:.3g} rad/s, too fast for samples {recordings[0].dt:g} s apart; "
        "check its units, or replace the fast state by its steady state."
    )


def _start(simulator: Simulator, recording: Recording) -> np.ndarray:
    """The simulator's states where a recording begins: as given, else at rest."""
    given = np.asarray(recording.initial, dtype=float) if not isinstance(recording.initial, str) else np.zeros(0)
    n_x = len(simulator.states)
    return given[:n_x] if len(given) >= n_x else np.zeros(n_x)


def _run(simulator: Simulator, recording: Recording, p: np.ndarray, start: np.ndarray) -> np.ndarray:
    """States at every sub-step, 20 a sample, of the begin of a recording."""
    model = discretise(simulator, recording.dt, "zero", substeps=20)
    first = np.append(start, np.zeros(model.n_state - len(start)))
    return states_along(model, model.drive(recording), p, first)


def _along_a_run(simulator: Simulator, recording: Recording, p: np.ndarray, start: np.ndarray, rate: float) -> float:
    """A high quantile of the rates along a run, if that runs."""
    short = recording.slice(0, min(len(recording), 400))
    states = _run(simulator, short, p, start)[::20]
    found = fastest(simulator, states[40::20], short.u[40::20], p)
    found = found[np.isfinite(found)]
    return min(rate, float(np.quantile(found, 0.9))) if len(found) > 5 else rate


def _not_finite(simulator: Simulator, recording: Recording) -> str:
    """Which state's derivative, or slope of it, is not finite, and where, in a sentence; empty where all are."""
    p, start = ParameterSet(dict(simulator.parameters)).start, _start(simulator, recording)
    flow = _flow(simulator, len(p))
    n_x, names = flow.size1_in(0), simulator.states

    def derivative(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.asarray(flow(x, u, p)[0]).ravel()

    begun = np.append(start, np.zeros(n_x - len(start)))
    points = [(begun, recording.u[0]), (begun, np.mean(recording.u, axis=0))]
    if all(np.all(np.isfinite(derivative(*point))) for point in points):  # what a run meets on its way
        short = recording.slice(0, min(len(recording), 400))
        states = _run(simulator, short, p, start)[:, :n_x]
        last = int(np.argmin(np.append(np.all(np.abs(states) < ENDLESS, axis=1), False))) - 1
        x, u = states[last], short.u[last // 20]
        points += [(x + share * recording.dt / 20 * derivative(x, u), u) for share in (0.0, 0.5, 1.0)]
    for x, u in points:
        off = ~np.isfinite(derivative(x, u)[: len(names)])
        if np.all(np.abs(x) < ENDLESS) and np.any(off):
            return _sentence(simulator, f"The derivative of the state {names[int(np.argmax(off))]!r}", x, u)
    slope = ~np.isfinite(np.asarray(flow(*points[0], p)[1])[: len(names), : len(names)])
    if not np.any(slope):
        return ""
    i, j = np.argwhere(slope)[0]
    return _sentence(simulator, f"The slope of the derivative of {names[i]!r} by the state {names[j]!r}", *points[0])


def _sentence(simulator: Simulator, what: str, x: np.ndarray, u: np.ndarray) -> str:
    values = [*zip(simulator.states, x, strict=False), *zip(simulator.inputs, u, strict=True)]
    values += [(k, 0.0) for k, v in simulator.parameters.items() if v.value.ndim == 0 and float(v.value) == 0]
    shown = ", ".join(f"{name} = {float(value):.4g}" for name, value in values[:SHOWN])
    more = f" and {len(values) - SHOWN} more" if len(values) > SHOWN else ""
    at_rest = (
        "; where the machine is never at zero, write the equations about its working point, or in Python say where a "
        "recording begins, by the argument `initial` of Recording"
    )
    return (
        f"{what} is not finite at {shown}{more}; check what the equations divide by, or take a root or a logarithm of, "
        f"and the parameters' values{'' if np.any(x) else at_rest}."
    )
