"""The initial state of a recording, at parameters that are known: given, at rest, in steady state, or estimated.

In a fit, initial states that are to be estimated are variables of the problem (`place_recordings` in `problem`), with
the same prior (`state_precision` there).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..data import Recording
from ..engine import Engine
from ..models import Model
from .gauss_newton import GaussNewton
from .problem import STATE_NOISE, Penalties, Problem, state_precision
from .steady_state import steady_state

STATE_ROUNDS = 20  # solves for a first state, at most, each with a wider prior
LARGEST_STATE = 1.1  # mean square of a first state, in units of its prior, above which the prior is widened


def samples_for_state(model: Model) -> int:
    """Return the number of samples that an unknown initial state is fitted to: ten per state, at least 50."""
    return max(10 * model.n_state, 50)


def estimate_initial_state(
    model: Model,
    engine: Engine,
    recording: Recording,
    samples: int | None = None,
    *,
    state_prior: bool = False,
    starts: Sequence[np.ndarray] = (),
) -> np.ndarray:
    """Find the state with memory at a recording's first sample, as its `initial` says, at the model's parameters.

    A state that is to be estimated is fitted to the first `samples` outputs alone, from rest and from each of `starts`.
    With `state_prior` it has a prior around rest, on the scale of the states in a run over all inputs
    (`state_precision`), and is fitted from rest alone.
    """
    n, values, state = model.n_state, model.parameters.start, model.first_state(recording)
    if recording.begins == "periodic":
        period = model.drive(recording)[: (recording.period or 1) * model.substeps]
        return steady_state(engine, period, values, state)
    if recording.begins != "estimate" or not n:
        return state
    head = recording.slice(0, max(min(len(recording), samples or samples_for_state(model)), 2)).with_(skip=0)
    spread = np.std(head.y, axis=0)
    spread = np.where(spread > 0, spread, np.max(spread) or 1.0)
    fixed = model.parameters.change(**{k: {"fixed": True, "prior": None} for k in model.parameters})
    problem, solver = (
        Problem(model.with_parameters(fixed), head, engine=engine, scale=spread),
        GaussNewton(max_iterations=50),
    )
    square = state_precision(engine, model.drive(recording), values, model.n_x, model.n_s) if state_prior else None
    if square is None:
        found = [solver.solve(problem, start) for start in (problem.start, *starts)]
        return min(found, key=lambda solution: solution.cost).theta
    state, wider = problem.start, 1.0
    for _ in range(STATE_ROUNDS):  # free decay from a large state exceeds the states of forced motion
        problem.penalties = Penalties(fixed, {}, 1.0, problem.residuals, problem.size, [(0, square / wider)])
        state = solver.solve(problem, state).theta
        size = float(state @ square @ state) / STATE_NOISE**2 / n
        if size <= LARGEST_STATE * wider:
            break
        wider = size
    return state
