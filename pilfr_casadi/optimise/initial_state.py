"""The initial state of a recording at known parameters: given, at rest, in steady state, or estimated.

In a fit, initial states that are to be estimated are variables of the problem (`place_recordings` in `problem`), with
the same prior (`state_precision` in `penalties`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from .._base import InputError
from ..data import Recording
from ..engine import Engine
from ..models import Model
from .gauss_newton import GaussNewton
from .penalties import STATE_NOISE, Penalties, state_precision
from .problem import Problem
from .steady_state import steady_state

STATE_ROUNDS = 20  # most solves for a first state, each with a wider prior
SAMPLES_PER_STATE = 10  # an estimate from so many samples adds a tenth of the noise's mean square to the run
LEAST_INFORMATION = 1e-9  # singular value, over the largest, below which a direction of the state moves no output
LARGEST_STATE = 1.1  # mean square of a first state, in units of its prior, above which the prior is widened
PRIOR_WIDTH = 2.0  # prior deviation of a first state over its deviation along known runs
LEAST_VARIANCE = 1e-6  # least variance of a combination of states, over that of each
ROUNDING = 1e-9  # deviation of a state, over its size, below which it rests
MOST_CONFLICT = 3.0  # largest misfit to prior and samples together, over its expectation, the number of states
WIDER = 100.0  # factor on the prior covariance where the samples contradict it


@dataclass(frozen=True, eq=False)
class StatePrior:
    """Prior of the initial state of a recording, from runs of the same simulator along other recordings.

    Without it, a state that the first samples hardly show is fitted to their noise, such as the temperature of a wall.

    Attributes
    ----------
    mean : array, shape (n,)
        Mean of the state with memory along those runs.
    precision : array, shape (n, n)
        Inverse of its prior covariance; without information on states that did not move.
    noise : array, shape (n_y,)
        Rms error of each output along those runs, enlarged if neighbouring errors are correlated.
    """

    mean: np.ndarray
    precision: np.ndarray
    noise: np.ndarray

    @classmethod
    def of(cls, states: np.ndarray, errors: np.ndarray, correlation: float = 1.0) -> Self | None:
        """Take the states (M, n) and the errors (M, n_y) of runs; None if they diverge or an output has no error.

        `correlation` is the number of samples over which errors are correlated; only one of these counts.
        """
        noise = np.sqrt(correlation * np.mean(errors**2, axis=0))
        if not (np.all(np.isfinite(states)) and np.all(np.isfinite(noise)) and np.all(noise > 0)):
            return None
        mean, deviation = np.mean(states, axis=0), np.std(states, axis=0)
        moves = deviation > ROUNDING * np.max(np.abs(states), axis=0)
        scaled = (states - mean)[:, moves] / deviation[moves]
        square = np.zeros((len(mean), len(mean)))
        inverse = np.linalg.inv(scaled.T @ scaled / len(scaled) + LEAST_VARIANCE * np.eye(scaled.shape[1]))
        square[np.ix_(moves, moves)] = inverse / np.outer(deviation[moves], deviation[moves]) / PRIOR_WIDTH**2
        return cls(mean, square, noise)


def samples_for_state(model: Model) -> int:
    """Return the least number of samples that an unknown initial state is fitted to: ten per state, at least 50."""
    return max(SAMPLES_PER_STATE * model.initial_basis.shape[1], 50)


def samples_to_start(model: Model, engine: Engine, recording: Recording) -> int:
    """Choose how many leading samples an unknown initial state is fitted to, up to a third of the recording.

    Ten samples per state are enough if all are equally informative: the estimate's error then adds a tenth of the
    noise's mean square to the rest of the run. A few samples hardly show a slow or lightly damped mode, and its error
    rings on. With the information `H` of the head and `H'` of the rest (n' residuals) on the state, the error adds
    `tr(H^-1 H') / n'` of the noise; the head is doubled until that is at most a tenth.
    """
    least, most = samples_for_state(model), len(recording) // 3
    if least >= most or not model.n_state:
        return min(least, most)
    jacobian = _slope_by_state(model, engine, recording)
    if not np.all(np.isfinite(jacobian)):  # the run diverges
        return least
    used, rows = least, jacobian.shape[0] // len(recording)
    while used < most:
        head, rest = jacobian[: used * rows], jacobian[used * rows :]
        size = np.maximum(np.linalg.norm(head, axis=0), 1e-300)
        inverse = np.linalg.pinv(head / size, rcond=LEAST_INFORMATION)
        added = float(np.sum((rest / size @ inverse) ** 2)) / len(rest)
        if added <= 1 / SAMPLES_PER_STATE:
            break
        used = min(2 * used, most)
    return used


def _state_problem(model: Model, engine: Engine, recording: Recording, noise: np.ndarray | None = None) -> Problem:
    """Make the problem whose only variables are the initial state; outputs are scaled by noise or their deviations."""
    fixed = model.parameters.change(**{k: {"fixed": True, "prior": None} for k in model.parameters})
    spread = np.std(recording.y, axis=0)
    scale = np.where(spread > 0, spread, np.max(spread) or 1.0)  # a constant output gets the largest deviation
    return Problem(model.with_parameters(fixed), recording, engine=engine, scale=scale if noise is None else noise)


def _slope_by_state(model: Model, engine: Engine, recording: Recording) -> np.ndarray:
    """Compute the slope of the scaled outputs by the initial state in a run from rest, (M n_y, n)."""
    problem = _state_problem(model, engine, recording.with_(skip=0, initial="estimate", period=None))
    try:
        with np.errstate(all="ignore"):
            return np.asarray(problem.jacobian(problem.start))
    except (InputError, RuntimeError, FloatingPointError):
        return np.full((1, 1), np.nan)


def estimate_initial_state(
    model: Model,
    engine: Engine,
    recording: Recording,
    samples: int | None = None,
    *,
    state_prior: bool = False,
    starts: Sequence[np.ndarray] = (),
    known: StatePrior | None = None,
) -> np.ndarray:
    """Find the state with memory at a recording's first sample, as its `initial` says, at the model's parameters.

    An estimated state is fitted to the first `samples` outputs alone, from rest and from each of `starts`. With
    `state_prior` it has a prior around rest on the scale of the states in a run over all inputs (`state_precision`),
    and is fitted from rest alone. With `known` it has that prior instead, and is fitted from its mean as well.
    """
    values, state = model.parameters.start, model.first_state(recording)
    if recording.begins == "periodic":
        period = model.drive(recording)[: (recording.period or 1) * model.substeps]
        return steady_state(engine, period, values, state)
    if recording.begins != "estimate" or not model.n_state:
        return state
    basis, starts = model.initial_basis, list(map(model.initial_unknowns, starts))
    head = recording.slice(0, max(min(len(recording), samples or samples_for_state(model)), 2)).with_(skip=0)
    problem = _state_problem(model, engine, head, known.noise if known else None)
    solver = GaussNewton(max_iterations=50)
    if known is not None:
        square = basis.T @ known.precision @ basis
        mean = np.linalg.pinv(square, hermitian=True) @ basis.T @ known.precision @ known.mean
        known = replace(known, mean=mean, precision=square)
        return basis @ _fit_with_prior(problem, solver, (problem.start, *starts, mean), known)
    square = state_precision(engine, model.drive(recording), values, model.n_x, model.n_s) if state_prior else None
    if square is None:
        found = [solver.solve(problem, start) for start in (problem.start, *starts)]
        return basis @ min(found, key=lambda solution: solution.cost).theta
    square, state, wider = basis.T @ square @ basis, problem.start, 1.0
    for _ in range(STATE_ROUNDS):  # free decay from a large state exceeds the states of forced motion
        _set_prior(problem, square / wider, np.zeros(len(square)))
        state = solver.solve(problem, state).theta
        size = float(state @ square @ state) / STATE_NOISE**2 / len(square)
        if size <= LARGEST_STATE * wider:
            break
        wider = size
    return basis @ state


def _fit_with_prior(
    problem: Problem, solver: GaussNewton, starts: Sequence[np.ndarray], known: StatePrior
) -> np.ndarray:
    """Fit an initial state with a prior, which is widened as long as the samples contradict it.

    If prior and noise are right, the misfit to both beyond that of the best fit to the samples alone is a chi-square of
    as many degrees of freedom as there are states (Gelman et al. 2013, Bayesian Data Analysis, ch. 6).
    """
    free = min((solver.solve(problem, start) for start in starts), key=lambda solution: solution.cost)
    found, n = free, len(known.mean)
    for i in range(STATE_ROUNDS):
        _set_prior(problem, known.precision / WIDER**i, known.mean)
        found = min((solver.solve(problem, x) for x in (known.mean, free.theta)), key=lambda solution: solution.cost)
        if 2 * problem.residuals * (found.cost - free.cost) <= MOST_CONFLICT * n:
            break
    return found.theta


def _set_prior(problem: Problem, precision: np.ndarray, mean: np.ndarray) -> None:
    """Give the initial state of a problem a prior."""
    states = [(0, precision, mean)]
    problem.penalties = Penalties(problem.model.parameters, {}, 1.0, problem.residuals, problem.size, states)
