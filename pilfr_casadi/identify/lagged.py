"""Fit NARX and NOE models, which are trained by one-step prediction and used in simulation.

A NARX is trained to predict one step from the measured outputs. A NOE starts like this and then reads a share of the
measured outputs that falls to zero: the simulation error over a long record has many minima, and a model guided by the
data avoids most of them. The simulation error over the training data selects the best start of both.

With early stopping a part of the training data is held back for validation, and the fit returns the point with the
smallest error on it. A single recording is cut in time: its end is held back, and simulated from the beginning of the
recording. Of several recordings the last ones are held back, with all that have the same inputs. The end of a periodic
recording has the same input as its beginning, so its mean period is cut in time.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._base import InputError, one_blas_thread
from ..data import Recording, group_by_input, mean_period, repeats_itself
from ..engine import Engine, make_engine
from ..models import NARX, PILFR, Lagged, Model, lagged_start, read_measured_output
from ..optimise import (
    Candidate,
    GaussNewton,
    Ipopt,
    IterationCallback,
    Problem,
    Solution,
    Status,
    estimate_initial_state,
)
from .context import FitContext, check_recordings, report_iterations
from .multistart import EXPLORE, judge, run_tasks
from .result import Fit, with_solution

OUTPUT_SHARES = (1.0, 0.3, 0.1, 0.0)  # shares of the measured output that a NOE reads in the stages of its training
PATIENCE = 20  # consecutive points without improvement after which training stops
CUT_NOTE = (
    "the input repeats, so the last {:.0f} % of the mean period decided when training stopped and the rest was trained "
    "on; validation=0 trains on everything, a second realization would be better"
)
SAME_INPUT_NOTE = (
    "the input repeats, so the data that decided when training stopped have the same input as the training data, which "
    "proves little; give another realization"
)


@dataclass(frozen=True, eq=False)
class LaggedSearch:
    """The model, options and data that all starts of one fit share."""

    lagged: Lagged
    structure: PILFR
    context: FitContext
    training: tuple[Recording, ...]
    validation: tuple[Recording, ...]

    def problem(self, model: Model, engine: Engine | None) -> Problem:
        """Make the problem of a model over the recordings that it is trained on."""
        return replace(self.context, recordings=self.training).problem(model, engine=engine or self.context.engine)


def fit_lagged(
    lagged: Lagged,
    train: tuple[Recording, ...],
    context: FitContext,
    starts: int,
    seed: int,
    executor: Executor | None,
) -> Fit:
    """Fit a NARX or NOE: solve from every start and return the smallest simulation error over the training data."""
    if context.l1:
        raise InputError("An L1 penalty is for the weights of an element; leave l1 out, or give a PILFR.")
    if not isinstance(context.solver, GaussNewton) and lagged.validation:
        raise InputError("Early stopping needs the solver GaussNewton(); give that, or validation=0.")
    context = replace(context, recordings=check_recordings(lagged, train))
    structure = lagged.structure(train[0].n_u, train[0].n_y)
    validation: tuple[Recording, ...] = ()
    training, note = context.recordings, ""
    if lagged.validation:
        training, validation, note = split_validation(context.recordings, lagged.validation)
    shared = context if executor is None else replace(context, progress=None)  # a callable stays in its process
    search = LaggedSearch(lagged, structure, shared, training, validation)

    def report(candidates: list[Candidate], total: int) -> None:
        if context.progress:
            context.progress("starts", len(candidates), total, min((c.nrmse for c in candidates), default=np.nan))

    sequences = np.random.SeedSequence(seed).spawn(starts)
    candidates, stopped = run_tasks(explore_lagged, [(search, i, s) for i, s in enumerate(sequences)], executor, report)
    usable = [c for c in candidates if np.isfinite(c.error)]
    if not usable and stopped:
        raise KeyboardInterrupt
    if not usable:
        raise InputError(
            "No start gave a finite simulation in free run; try more starts, fewer neurons or lags, or a NOE."
        )
    best = min(usable, key=lambda c: c.error)
    solution = replace(best.solution, status=Status.INTERRUPTED) if stopped else best.solution
    fields: dict[str, Any] = {"candidates": tuple(candidates), "errors": {}, "note": note}
    return context.result(best.model, search.structure, context.problem(best.model), solution, **fields)


@one_blas_thread
def explore_lagged(search: LaggedSearch, seed: int, sequence: np.random.SeedSequence) -> Candidate:
    """Run one start to its end."""
    values = lagged_start(search.lagged, search.structure, search.training, np.random.default_rng(sequence))
    model = search.structure.model_for(search.training[0], values)
    solution, engine = None, None
    shares = OUTPUT_SHARES[:1] if isinstance(search.lagged, NARX) else OUTPUT_SHARES
    for share in shares:
        trained = read_measured_output(model, share) if share else model
        problem = search.problem(trained, engine if share else None)
        engine = problem.engine
        begin = problem.start if solution is None else solution.theta
        if solution is not None and not np.isfinite(problem.cost(begin)):
            break
        solver = EXPLORE if share != shares[-1] else search.context.solver
        options: dict[str, Any] = {}
        if isinstance(solver, GaussNewton | Ipopt):
            options["progress"] = report_iterations(search.context.progress, "steps", solver.max_iterations)
        if search.validation and solver is search.context.solver:
            validation = Problem(trained, search.validation, engine=problem.engine, scale=problem.scale)
            solution = solve_with_early_stopping(solver, problem, validation, begin, **options)
        else:
            solution = solver.solve(problem, begin, **options)
        if solution.status is Status.INTERRUPTED:
            break
    assert solution is not None
    return _candidate(search, seed, model, solution)


def _candidate(search: LaggedSearch, seed: int, model: Model, solution: Solution) -> Candidate:
    """Judge the solution of a start in free run over all the training data."""
    engine = make_engine(model, search.context.engine)
    problem = Problem(model, search.context.recordings, engine=engine)
    theta = solution.theta
    pairs = zip(search.training, search.context.recordings, strict=False)
    # the original recordings that begin with the training data
    known = [r for k, r in pairs if k.begins == r.begins and np.array_equal(k.y, r.y[: len(k)])]
    known = known if len(known) == len(search.training) else []
    if problem.size > len(theta) or not known:  # add the initial states of recordings held back or cut
        fitted, n = with_solution(model, problem, solution), problem.n_free
        others = [r for r in search.context.recordings[len(known) :] if r.begins == "estimate"]
        after = theta if known else theta[:n]
        theta = np.concatenate([after, *(estimate_initial_state(fitted, engine, r) for r in others)])
        bounds, rest = np.split(solution.multipliers, [len(solution.theta)])
        bounds = np.concatenate([bounds[: len(after)], np.zeros(len(theta) - len(after))])
        solution = replace(solution, multipliers=np.concatenate([bounds, rest]))
    return judge(seed, model, problem, replace(solution, theta=theta))


def one_step(fit: Any, recording: Recording) -> np.ndarray:
    """Predict one step ahead with a fitted NARX or NOE, from the measured outputs up to the previous sample.

    Parameters
    ----------
    fit : Fit
        A fit of a `NARX` or `NOE`.
    recording : Recording
        Inputs and outputs.

    Returns
    -------
    array, shape (M, n_y)

    Raises
    ------
    InputError
        If the fit is of another model, or the recording does not fit it.
    """
    model, recording = read_measured_output(fit.model), fit.matched(recording)
    state = fit.initial_state(recording)
    return make_engine(model, fit.engine).simulate(model.drive(recording), model.parameters.start, state)[0]


def split_validation(
    recordings: Sequence[Recording], share: float
) -> tuple[tuple[Recording, ...], tuple[Recording, ...], str]:
    """Split training data; return the part to train on, the part for validation with its scored samples, and a note."""
    groups = group_by_input(recordings)
    if len(groups) > 1:
        wanted, last = max(1, round(share * len(recordings))), set(groups[-1])
        for group in reversed(groups[1:-1]):
            last |= set(group) if len(last) + len(group) <= wanted else set()
        training = tuple(r for i, r in enumerate(recordings) if i not in last)
        return training, tuple(_begin_at_rest(recordings[i]) for i in sorted(last)), ""
    pairs = [_cut_in_time(r, share) for r in recordings]
    note = ""
    if any(repeats_itself(r) or (r.begins == "periodic" and r.period) for r in recordings):
        note = CUT_NOTE.format(100 * share) if all(r.begins == "periodic" for r in recordings) else SAME_INPUT_NOTE
    return tuple(training for training, _ in pairs), tuple(validation for _, validation in pairs), note


def _cut_in_time(r: Recording, share: float) -> tuple[Recording, Recording]:
    """Cut one recording in time: return its beginning, and the whole recording scored after the cut."""
    if r.begins == "periodic" and r.period:
        whole = (len(r) - r.skip) // r.period * r.period
        mean = mean_period(r.slice(r.skip, r.skip + whole))
        cut = min(max(round((1 - share) * len(mean)), 2), len(mean) - 1)
        twice = mean.with_(u=np.tile(mean.u, (2, 1)), y=np.tile(mean.y, (2, 1)), initial="zero")
        # a period from rest precedes the scored part
        return mean.slice(0, cut), _score_from(twice, len(mean) + cut)
    cut = min(max(r.skip + round((1 - share) * (len(r) - r.skip)), r.skip + 2), len(r) - 1)
    return r.slice(0, cut), _score_from(r, cut)


def _begin_at_rest(recording: Recording) -> Recording:
    """Begin at zero instead of an estimated initial state, and do not score the first fifth."""
    if recording.begins != "estimate":
        return recording
    return _score_from(recording.with_(initial="zero"), max(recording.skip, len(recording) // 5))


def _score_from(recording: Recording, skip: int) -> Recording:
    """Score from sample `skip` on; drop the period if no whole one remains."""
    training = recording.period if recording.period and len(recording) - skip >= recording.period else None
    return recording.with_(skip=skip, period=training)


class EarlyStopping:
    """Remember the point of a solve with the smallest error on the validation data."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.best, self.theta, self.failed = np.inf, np.zeros(0), 0

    def __call__(self, theta: np.ndarray) -> bool:
        """Record a point θ of the solve; tell whether to stop there."""
        cost = self.problem.cost(theta[: self.problem.size])
        if cost < self.best or not self.theta.size:
            self.best, self.theta, self.failed = cost, theta.copy(), 0
        else:
            self.failed += 1
        return self.failed >= PATIENCE


def solve_with_early_stopping(
    solver: GaussNewton,
    problem: Problem,
    validation: Problem,
    start: np.ndarray,
    progress: IterationCallback | None = None,
) -> Solution:
    """Solve, and return the point with the smallest error on `validation`."""
    stopping = EarlyStopping(validation)
    solution = solver.solve(problem, start, progress, stopping)
    if not stopping.theta.size or solution.status is Status.INTERRUPTED:
        return solution
    if stopping(solution.theta) or stopping.failed:
        cost = problem.cost(stopping.theta)
        return replace(solution, theta=stopping.theta, cost=cost, status=Status.STOPPED_EARLY)
    return solution
