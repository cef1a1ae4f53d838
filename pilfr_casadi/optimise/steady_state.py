"""Periodic steady states: the fixed point `x = Φ(x)` of one period of the input.

A period does not determine the memory of operators that never slip in it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np

from ..engine import Engine

Array = np.ndarray
STEADY = 1e-10  # relative change of the state over a period that counts as none
NEARLY_STEADY = 1e-6  # the same, accepted after the last period
MOST_PERIODS, PERIODS_PER_NEWTON_STEP = 200, 10  # limit of periods; periods run between two Newton steps
STILL_MEMORY = 1e-12  # deviation of a memory's slope over a period from 1 up to which the memory does not move
CHUNK_SAMPLES = 512  # samples of a period whose slopes are kept in memory at a time


def steady_state(engine: Engine, period: Array, p: Array, state: Array) -> Array:
    """Find the state at the beginning of a steady period; nan where no steady state is reached.

    Periods are run from the given state, with a Newton step on `x = Φ(x)` now and then to speed up slow poles. A period
    does not determine the memory of operators that never slip in it, so that memory keeps its given value.
    """
    change, size = np.inf, 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(1, MOST_PERIODS + 1):
            before, state = state, engine.simulate(period, p, state)[1]
            change, size = np.max(np.abs(state - before), initial=0.0), np.max(np.abs(state), initial=1e-300)
            if not np.isfinite(change) or change <= STEADY * size:
                return state
            if k % PERIODS_PER_NEWTON_STEP == 0:
                state = _newton_step(engine, period, p, state)
    return state if change <= NEARLY_STEADY * size else np.full_like(state, np.nan)


def _newton_step(engine: Engine, period: Array, p: Array, state: Array) -> Array:
    """Take one Newton step towards the fixed point of a period if that brings it nearer, else run one period."""
    after, slope = deque(_state_slopes(engine, period, p, state), maxlen=1)[0][1:]
    if not np.all(np.isfinite(slope)):
        return after
    try:
        trial = state + steady_slope(np.hstack([(after - state)[:, None], slope]), 1)[:, 0]
    except np.linalg.LinAlgError:
        return after
    trial_after = engine.simulate(period, p, trial)[1]
    return trial if np.max(np.abs(trial_after - trial)) < np.max(np.abs(after - state)) else after


def steady_slope(after: Array, n: int) -> Array:
    """Compute `(I - Φ_x)^-1 Φ_θ`, (n_state, n), from the slope after one period, whose first n columns belong to θ.

    A memory that does not move in the whole period has zero slope.
    """
    size = len(after)
    matrix, right = np.eye(size) - after[:, n:], after[:, :n].copy()
    still = np.max(np.abs(matrix), axis=1, initial=0.0) <= STILL_MEMORY
    matrix[still, still], right[still] = 1.0, 0.0
    return np.linalg.solve(matrix, right) if size else right


def undetermined_memory(engine: Engine, period: Array, p: Array, state: Array, n_x: int, scale: Array) -> Array:
    """Find the memories (indices, (k,)) that affect the outputs but that a steady period does not determine."""
    parts = [
        (np.max(np.abs(outputs / scale[:, None]), axis=(0, 1), initial=0.0), slope)
        for outputs, _, slope in _state_slopes(engine, period, p, state)
    ]
    seen, slope = np.max([effect for effect, _ in parts], axis=0), parts[-1][1]
    still = np.max(np.abs(slope - np.eye(len(state))), axis=1, initial=0.0) <= STILL_MEMORY
    return np.flatnonzero(still[n_x:] & (seen[n_x:] > STILL_MEMORY * np.max(seen, initial=0.0)))


def _state_slopes(engine: Engine, period: Array, p: Array, state: Array) -> Iterator[tuple[Array, Array, Array]]:
    """Yield slopes of the outputs by the first state, the state and its slope, after each part of a period."""
    after, slope = state, np.eye(len(state))
    rows = CHUNK_SAMPLES * engine.linear.substeps
    for a in range(0, len(period), rows):
        _, outputs, after, slope = engine.sensitivity(period[a : a + rows], p, after, slope, np.full(len(p), -1))
        yield outputs, after, slope
