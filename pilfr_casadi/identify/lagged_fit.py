"""Fits of NARX and NOE models, which are trained another way than they are used, or with data held back.

A NARX is trained to predict one step, reading the measured outputs. A NOE begins so and then reads a smaller and
smaller share of them, down to none: simulation errors over a long record have many minima, and a model that is led by
the data passes most of them by. What both are judged and chosen by is the simulation error over the training data.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._base import InputError, one_blas_thread
from ..data import Recording, as_recordings, check_for_identification
from ..engine import Engine, make_engine
from ..models import NARX, PILFR, Lagged, Model, lagged_start, reading_output
from ..optimise import GaussNewton, Ipopt, Problem, Solution, Status
from .early_stopping import held_problem, hold_back, solve_watched
from .job import Job
from .multistart import EXPLORE
from .outcome import with_solution
from .result import Fit, first_state
from .search import Candidate, run_tasks
from .told import iterations

SHARES = (1.0, 0.3, 0.1, 0.0)  # of the measured output that a NOE reads while it is trained, stage by stage


@dataclass(frozen=True, eq=False)
class LaggedSearch:
    """All that the starts of one identification share."""

    wanted: Lagged
    structure: PILFR
    job: Job
    kept: tuple[Recording, ...]
    held: tuple[Recording, ...]

    def problem(self, model: Model, engine: Engine | None) -> Problem:
        """The error of a model over what is trained on."""
        return replace(self.job, recordings=self.kept).problem(model, engine=engine or self.job.engine)


def check_lagged_options(wanted: Lagged, stable: bool | float, start: Any) -> None:
    """Refuse what a NARX or NOE would leave unheard: a bound on a spectral radius, a start of another kind.

    Raises
    ------
    InputError
        That says which.
    """
    kind = type(wanted).__name__
    if not isinstance(stable, bool):
        raise InputError(
            f"stable = {stable!r} was given for a {kind}, whose state is the past of its signals and has no spectral "
            "radius to bound; leave it out."
        )
    if start != "grid":
        raise InputError(f"start = {start!r} was given for a {kind}, whose starts are of their own kind; leave it out.")


def fit_lagged(
    wanted: Lagged,
    train: Recording | Sequence[Recording],
    job: Job,
    starts: int,
    seed: int,
    executor: Executor | None,
) -> Fit:
    """The fit of a NARX or NOE: every start to its end, the smallest simulation error over the training data.

    Raises
    ------
    InputError
        If the recordings hold too little, no start gives a finite simulation, or an option is unfit.
    """
    if job.l1:
        raise InputError("An L1 penalty is for the weights of an element; leave l1 out, or give a PILFR.")
    if not isinstance(job.solver, GaussNewton) and wanted.validation:
        raise InputError("Early stopping needs the solver GaussNewton(); give that, or validation=0.")
    first = as_recordings(train)[0]
    job = replace(job, recordings=check_for_identification(train, wanted.unknowns(first.n_u, first.n_y) + 2))
    structure = wanted.structure(first.n_u, first.n_y)
    whole = job.recordings, (), ""
    kept, held, note = hold_back(job.recordings, wanted.validation) if wanted.validation else whole
    told = job.progress if executor is None else None  # a callable stays in its process
    search = LaggedSearch(wanted, structure, replace(job, progress=told), kept, held)

    def report(found: list[Candidate], total: int) -> None:
        if job.progress:
            job.progress("starts", len(found), total, min((c.error for c in found), default=np.nan))

    sequences = np.random.SeedSequence(seed).spawn(starts)
    found, stopped = run_tasks(explore_lagged, [(search, i, s) for i, s in enumerate(sequences)], executor, report)
    usable = [c for c in found if np.isfinite(c.error)]
    if not usable and stopped:
        raise KeyboardInterrupt
    if not usable:
        raise InputError(
            "No start gave a finite simulation in free run; try more starts, fewer neurons or lags, or a NOE."
        )
    best = min(usable, key=lambda c: c.error)
    solution = replace(best.solution, status=Status.INTERRUPTED) if stopped else best.solution
    more: dict[str, Any] = {"candidates": tuple(found), "minimum": False, "note": note}
    return job.result(best.model, search.structure, job.problem(best.model), solution, **more)


@one_blas_thread
def explore_lagged(search: LaggedSearch, seed: int, sequence: np.random.SeedSequence) -> Candidate:
    """One start, run to its end."""
    first = search.kept[0]
    values = lagged_start(search.wanted, search.structure, search.kept, np.random.default_rng(sequence))
    names = {"inputs": first.inputs, "outputs": first.outputs}
    model = search.structure.model(first.n_u, first.n_y, values, **names)
    solution, engine = None, None
    shares = SHARES[:1] if isinstance(search.wanted, NARX) else SHARES
    for share in shares:
        trained = reading_output(model, share) if share else model
        problem = search.problem(trained, engine if share else None)
        engine = problem.engine
        begin = problem.start if solution is None else solution.theta
        if solution is not None and not np.isfinite(problem.cost(begin)):
            break
        solver = EXPLORE if share != shares[-1] else search.job.solver
        told: dict[str, Any] = {}
        if isinstance(solver, GaussNewton | Ipopt):
            told["progress"] = iterations(search.job.progress, "steps", solver.max_iterations)
        if search.held and solver is search.job.solver:
            held = held_problem(trained, search.held, problem)
            solution = solve_watched(solver, problem, held, begin, **told)
        else:
            solution = solver.solve(problem, begin, **told)
        if solution.status is Status.INTERRUPTED:
            break
    assert solution is not None
    return _candidate(search, seed, model, solution)


def _candidate(search: LaggedSearch, seed: int, model: Model, solution: Solution) -> Candidate:
    """What a start has led to, judged in free run over all the training data."""
    engine = make_engine(model, search.job.engine)
    problem = Problem(model, search.job.recordings, engine=engine)
    theta = solution.theta
    known = [r for k, r in zip(search.kept, search.job.recordings, strict=False) if _begins_alike(k, r)]
    known = known if len(known) == len(search.kept) else []
    if problem.size > len(theta) or not known:  # the initial states of what was held back, or began elsewhere
        fitted, n = with_solution(model, problem, solution), int(problem.free.sum())
        others = [r for r in search.job.recordings[len(known) :] if r.begins == "estimate"]
        after = theta if known else theta[:n]
        theta = np.concatenate([after, *(first_state(fitted, engine, r) for r in others)])
        bounds, rest = np.split(solution.multipliers, [len(solution.theta)])
        bounds = np.concatenate([bounds[: len(after)], np.zeros(len(theta) - len(after))])
        solution = replace(solution, multipliers=np.concatenate([bounds, rest]))
    with np.errstate(over="ignore", invalid="ignore"):
        e = problem.residual(theta)
        error = float(np.sqrt(np.mean(e**2)))
    error = error if np.isfinite(error) else np.inf
    return Candidate(seed, model, theta, error, replace(solution, theta=theta))


def _begins_alike(kept: Recording, given: Recording) -> bool:
    """Whether what was trained on is a recording, or the beginning of one."""
    return kept.begins == given.begins and np.array_equal(kept.y, given.y[: len(kept)])


def one_step(fit: Any, recording: Recording) -> np.ndarray:
    """Predictions of a fitted NARX or NOE one step ahead, reading the measured outputs up to the sample before.

    Parameters
    ----------
    fit : Fit
        Of a `NARX` or `NOE`.
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
    model = reading_output(fit.model)
    state = fit.initial_state(recording)
    return make_engine(model, fit.engine).simulate(model.drive(recording), model.parameters.start, state)[0]
