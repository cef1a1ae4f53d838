"""The state with memory at the first sample of a recording, of a model whose parameters are known."""

from __future__ import annotations

import numpy as np

from .._base import InputError
from ..data import Recording
from ..engine import Engine
from ..models import Model
from .gauss_newton import GaussNewton
from .problem import STATE_NOISE, Penalties, Problem, settled, state_precision

ROUNDS = 20  # at most, of wider priors
WIDE = 1.1  # mean square of a state in units of its prior up to which the prior stays


def samples_for_state(model: Model) -> int:
    """Samples that an unknown initial state is fitted to: ten a state, at least 50."""
    return max(10 * (model.n_x + model.n_s), 50)


def first_state(
    model: Model, engine: Engine, recording: Recording, samples: int | None = None, *, state_prior: bool = False
) -> np.ndarray:
    """State with memory at a recording's first sample, as its `initial` says; the model's parameters are held.

    Where it is to be estimated, it is fitted to the first `samples` outputs, and later outputs are not looked at. With
    `state_prior` it has a prior around rest, whose scale is that of a run over all inputs (`state_precision`).

    Raises
    ------
    InputError
        If a given state has another number of entries.
    """
    n, initial, values = model.n_x + model.n_s, recording.initial, model.parameters.start
    if not isinstance(initial, str):
        given = np.asarray(initial, dtype=float).ravel()
        states = len(model.states)
        if given.size not in (states, n):
            raise InputError(f"An initial state of {given.size} numbers was given; expected {states} or {n}.")
        return np.concatenate([given, np.zeros(n - given.size)])
    state = np.zeros(n)
    if initial == "periodic":
        period = model.drive(recording)[: (recording.period or 1) * model.substeps]
        state = settled(engine, period, values, state)
    elif initial == "estimate" and n:
        samples = min(len(recording), samples or samples_for_state(model))
        held = model.with_parameters(
            model.parameters.change(**{k: {"fixed": True, "prior": None} for k in model.parameters})
        )
        head = recording.slice(0, max(samples, 2)).with_(skip=0)
        spread = np.std(head.y, axis=0)
        spread = np.where(spread > 0, spread, np.max(spread) or 1.0)
        problem = Problem(held, head, engine=engine, scale=spread)
        if not state_prior:
            return GaussNewton(max_iterations=50).solve(problem).theta
        square = state_precision(engine, model.drive(recording), values, model.n_x, model.n_s)
        wider, start = 1.0, problem.start
        for _ in range(ROUNDS):  # a machine that is let go from afar is no machine in forced motion
            priors = [] if square is None else [(0, square / wider)]
            problem.penalties = Penalties(held.parameters, {}, 1.0, problem.residuals, problem.size, priors)
            state = start = GaussNewton(max_iterations=50).solve(problem, start).theta
            size = 0.0 if square is None else float(state @ square @ state) / STATE_NOISE**2 / n
            if size <= WIDE * wider:
                break
            wider = size
    return state
