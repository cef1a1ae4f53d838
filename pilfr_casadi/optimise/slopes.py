"""Residuals and their derivatives over one recording, stretch by stretch, and what they sum up to.

A recording in periodic steady state begins at the fixed point `x = Φ(x, θ)` of one period. Its slope follows from the
implicit function theorem,

    dx/dθ = (I - Φ_x)^-1 Φ_θ,

so no periods have to be run before it: the sensitivity recursion carries `Φ_x` along with the parameters' columns.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from ..engine import Engine
from .layout import Part

Array = np.ndarray
SETTLED = 1e-10  # change over a period, next to the largest entry of the state, that is none
NEARLY = 1e-6  # the same where it has to do
MOST, WAIT = 200, 10  # periods, and periods before each leap
CHUNK = 512  # samples of a period whose slopes are held at a time


def settled(engine: Engine, period: Array, p: Array, state: Array, tolerance: float = SETTLED) -> Array:
    """State at the beginning of a steady period, not finite where none is reached.

    Memory of operators that never slip in a period is not decided by it: it stays as the periods leave it that are run
    from the state given, which is zero for a recording (`open_memory` finds it). Periods are run from there; where that
    takes long, for slow poles, Newton's rule on `x = Φ(x)` leaps ahead.
    """
    change, size = np.inf, 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(1, MOST + 1):
            before, state = state, engine.simulate(period, p, state)[1]
            change, size = np.max(np.abs(state - before), initial=0.0), np.max(np.abs(state), initial=1e-300)
            if not np.isfinite(change) or change <= tolerance * size:
                return state
            if k % WAIT == 0:
                state = _leap(engine, period, p, state)
    return state if change <= NEARLY * size else np.full_like(state, np.nan)


def _leap(engine: Engine, period: Array, p: Array, state: Array) -> Array:
    """One step of Newton's rule towards the fixed point of a period, where it brings it nearer; else one period."""
    after, slope = state, np.eye(len(state))
    rows = CHUNK * engine.linear.substeps
    for a in range(0, len(period), rows):
        _, _, after, slope = engine.sensitivity(period[a : a + rows], p, after, slope, np.full(len(p), -1))
    if not np.all(np.isfinite(slope)):
        return after
    try:
        there = state + steady_slope(np.hstack([(after - state)[:, None], slope]), 1)[:, 0]
    except np.linalg.LinAlgError:
        return after
    behind = engine.simulate(period, p, there)[1]
    return there if np.max(np.abs(behind - there)) < np.max(np.abs(after - state)) else after


def steady_slope(after: Array, n: int) -> Array:
    """`(I - Φ_x)^-1 Φ_θ` from the slope behind one period, columns of θ (n) first: shape (n_state, n).

    Memory that nothing moves in a whole period stays where it is: it has no slope.
    """
    size = len(after)
    matrix, right = np.eye(size) - after[:, n:], after[:, :n].copy()
    still = np.max(np.abs(matrix), axis=1, initial=0.0) <= 1e-12
    matrix[still, still], right[still] = 1.0, 0.0
    return np.linalg.solve(matrix, right) if size else right


@dataclass
class Pass:
    """One run of a recording with derivatives.

    Parameters
    ----------
    seed : array, (n_state, n_c)
        Slope of the first state.
    """

    engine: Engine
    part: Part
    p: Array
    columns: Array
    state: Array
    seed: Array
    length: int
    after_period: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def stretches(self, substeps: int) -> Iterator[tuple[Array, Array]]:
        """Residuals (R_b,) and their Jacobian (R_b, n_c), behind the periods that are run before the recording."""
        part, r, n = self.part, self.part.recording, substeps
        state, seed = self.state, self.seed
        if not part.steady:
            for a in range(0, len(part.warm_up), self.length * n):
                rows = part.warm_up[a : a + self.length * n]
                _, _, state, seed = self.engine.sensitivity(rows, self.p, state, seed, self.columns)
        a, period = 0, r.period or len(r)
        while a < len(r):
            b = min(a + self.length, len(r), period if a < period else len(r))
            y, jac, state, seed = self.engine.sensitivity(part.drive[a * n : b * n], self.p, state, seed, self.columns)
            if b == period:
                self.after_period = seed.copy()
            cut = min(max(r.skip - a, 0), b - a)
            e = ((y - r.y[a:b]) / part.scale)[cut:].ravel()
            jac /= part.scale[:, None]
            yield e, jac[cut:].reshape(e.size, jac.shape[2])
            a = b


def sums(run: Pass, substeps: int) -> tuple[float, Array, Array]:
    """`e'e`, `J'e` and `J'J` over a recording, for the columns of the seed."""
    n_c = run.seed.shape[1]
    value, gradient, hessian = 0.0, np.zeros(n_c), np.zeros((n_c, n_c))
    for e, jac in run.stretches(substeps):
        value += float(e @ e)
        gradient += e @ jac
        hessian += jac.T @ jac
    return value, gradient, hessian


def steady_sums(run: Pass, substeps: int, n: int) -> tuple[float, Array, Array]:
    """`sums` over a recording in periodic steady state for the n columns of θ; the seed is `[0 I]`."""
    value, gradient, hessian = sums(run, substeps)
    if not np.all(np.isfinite(run.after_period)):
        return np.inf, np.full(n, np.nan), np.full((n, n), np.nan)
    total = np.vstack([np.eye(n), steady_slope(run.after_period, n)])
    return value, total.T @ gradient, total.T @ hessian @ total
