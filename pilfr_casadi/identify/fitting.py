"""`fit`: identify a model from recordings.

The verb checks its arguments and chooses one of four ways: from values (an earlier fit, a closed model, or a structure
with values by name), a linear model alone, many starts (`multistart`), or the training of NARX and NOE models
(`lagged`). Where an L1 penalty is asked for, a last solve follows (`penalty`).
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np

from .._base import InputError, Progress, filled, one_blas_thread
from ..data import Recording, as_recordings, check_for_identification
from ..models import PILFR, Lagged, Model, PrandtlIshlinskii, StaticNetwork
from ..optimise import Constraint, Problem, Solution, Status, beyond, check_gain, check_room, loosened, stability_limits
from .context import Job, Stage, interrupted, rms_error
from .lagged import check_lagged_options, fit_lagged
from .linear_start import in_known_coordinates, known_entries, linear_model
from .multistart import KEEP, POLISH, STARTS, Search, search_starts
from .options import Asked
from .penalty import check_penalty, penalised
from .result import Candidate, Fit, with_solution

__all__ = ["Fit", "Progress", "fit"]
DEAD_WORKER = (
    "A worker process ended before it returned a result (it may have run out of memory); use fewer workers, or "
    "workers=1."
)
NO_GUARD = (
    "The worker processes could not begin: where processes are spawned, each runs the script again from its top, so "
    'put the call of fit below `if __name__ == "__main__":`, or use workers=1.'
)


def fit(
    model: PILFR | Lagged | Model | Fit,
    train: Recording | Sequence[Recording],
    *,
    solver: Any = None,
    starts: int = 8,
    seed: int = 0,
    start: str | Mapping[str, Any] = "grid",
    linear: Any = None,
    stable: bool | float | None = None,
    constraints: Sequence[Constraint] | None = None,
    l1: dict[str, float] | None = None,
    noise: float | str | None = None,
    weights: Sequence[float] | np.ndarray | None = None,
    engine: str = "auto",
    executor: Executor | None = None,
    workers: int = 1,
    progress: Progress | bool | None = None,
) -> Fit:
    """Identify a model from recordings by minimising the simulation error (Krikelis et al. 2024, Eq. 20).

    Parameters
    ----------
    model : PILFR, NARX, NOE, Model or Fit
        A structure (start values are found), a closed model of your own, or an earlier fit (started at its values).
    train : Recording or sequence of Recording
        Training data; nothing else is used.
    solver : GaussNewton or Ipopt
        Solver of the final problem; by default `GaussNewton(tolerance=1e-4)`. Where an exact bound on a spectral radius
        holds the solution, a Gauss-Newton SQP has the last word (see `spectral_radius`).
    starts, seed : int
        Number of starts and the seed of all of them. With `start="grid"` the first two have the element at the output
        and at the input, whatever the seed (of Hammerstein and Wiener models it is one); more are drawn. More starts
        with the same seed hold those of fewer.
    start : {"grid", "paper", "plain"} or mapping
        Thresholds on a grid, every start explored and the best polished; or the paper's start (Eq. 22-24), every start
        solved and re-gridded, which the paper does not do, or, "plain", solved and no more; with `linear` the best
        linear approximation "plain" is the paper's protocol.
        A mapping of values by parameter name is the one start of a PI-LFR with any element.
    linear : control.StateSpace or "bla", optional
        Linear model that the search for a PI-LFR begins with, such as `frequency_subspace` of a BLA, which is the
        paper's, or "bla": just that, of training recordings that are periodic; by default subspace identification
        refined by output error.
    stable : bool or float
        Bound on the spectral radius of a PI-LFR's linear part, and of it with the element's full slope, which holds
        exactly, by the eigenvalues of the result. True, the default, is 1: an integrator is let be one. A number below
        1 is a least rate of decay; False is no bound. Left out, an earlier fit keeps its own. The slope is `Σ w` of
        plays and stops, and that times the slope far out of each envelope of generalized plays, also where they are
        parts of a `Combined`; where an envelope is so steep in between that small motions there grow, the fit says so.
        Of elements with bounded forces the linear part decides; of envelopes of your own no slope is known, which the
        fit says.
    constraints : sequence of Constraint, optional
        See `Problem`. Left out, an earlier fit keeps its own; `()` is none.
    noise : float or "estimate", optional
        Standard deviation of the noise relative to the output's, which priors are weighed against. By default the noise
        is estimated wherever there are priors: the problem is solved, the noise set to the error that was reached, and
        the problem solved again, until the two agree. Left out, an earlier fit keeps its own.
    l1 : dict
        Weight of an L1 penalty by name, `{"w": 1e-4}`: unneeded operators get exactly zero. For a PI-LFR the problem
        is first solved without; then the weights of each channel are scaled to a sum of one and the penalty acts on the
        element alone, all linear blocks held, so that no change of scale evades it (see `penalty`). For a closed model
        of your own see `Problem`.
    weights : sequence of float, optional
        How much each recording counts, see `Problem` and `noise_weights`; for a fit from values (a `Model`, a `Fit`, or
        `start` a mapping). Left out, an earlier fit keeps those of its recordings.
    engine : {"auto", "c", "vm"}
        Generated C, or CasADi's virtual machine.
    executor, workers
        Where starts run: any `concurrent.futures.Executor`, or a pool of `workers` processes; the numbers are the same.
        A fit from values runs as many recordings side by side.
        Where processes are spawned, the call belongs below `if __name__ == "__main__":`.
    progress : bool or callable
        True for a bar on the terminal; a callable gets (stage, done, total, smallest training error so far). The stage
        "steps" is the solve of a start at work, its error where it is; of starts in other processes it is not heard.

    Returns
    -------
    Fit

    Raises
    ------
    InputError
        If recordings and model do not fit each other, hold too little, the start is not usable, or an option is unfit.
    """
    solver = solver or POLISH
    _check_options(model, solver, starts, seed, workers, progress)
    if not isinstance(start, Mapping) and start not in STARTS:
        raise InputError(f"The start {start!r} is unknown; use 'grid', 'paper' or 'plain', or values by name.")
    search = not isinstance(model, Model | Fit) and not isinstance(start, Mapping)
    if weights is not None and search:
        raise InputError("Weights are for a fit from values; give a Model, a Fit, or start={name: value}.")
    own = executor is None and workers > 1
    if own and getattr(multiprocessing.current_process(), "_inheriting", False):
        raise SystemExit(1)  # a spawned worker that runs the script again; the first process says what to do
    if l1 is not None and not isinstance(l1, dict):
        raise InputError(f'l1 = {l1!r} was given; give weights by name, like {{"w": 1e-4}}.')
    asked = (model.asked if isinstance(model, Fit) else Asked()).but(stable, constraints, noise, weights, train)
    if progress is True:
        from .._base import progress_bar

        shown: Any = progress_bar()
    else:
        shown = nullcontext(progress or None)
    pool = ProcessPoolExecutor(workers, initializer=_leave_interrupts) if own and search else None
    with shown as report:
        threads = 1 if search else workers
        job = Job((), solver, (), dict(l1 or {}), engine, report, threads, asked)
        try:
            return _fit(model, train, job, starts, seed, start, executor or pool, linear)
        except BrokenProcessPool:
            spawned = pool is not None and multiprocessing.get_start_method() != "fork"
            raise InputError(NO_GUARD if spawned else DEAD_WORKER) from None
        finally:
            if pool is not None:
                pool.shutdown(cancel_futures=True)


@one_blas_thread
def _fit(
    model: PILFR | Lagged | Model | Fit,
    train: Recording | Sequence[Recording],
    job: Job,
    starts: int,
    seed: int,
    start: str | Mapping[str, Any],
    executor: Executor | None,
    given: Any,
) -> Fit:
    if given is not None and not isinstance(model, PILFR):
        raise InputError("A linear model to begin with goes with a PILFR; any other model has its own values.")
    if isinstance(start, Mapping) and not isinstance(model, PILFR):
        raise InputError("Values to start from go with a PILFR; a Model and a Fit have their own.")
    asked = job.asked
    check_gain(asked.constraints, (model.model if isinstance(model, Fit) else model).element)
    if isinstance(model, Lagged):
        check_lagged_options(model, asked.stable, start)
        return fit_lagged(model, train, replace(job, limits=asked.constraints), starts, seed, executor)
    structure = model if isinstance(model, PILFR) else model.structure if isinstance(model, Fit) else None
    job = replace(job, limits=asked.limits(structure))
    if isinstance(model, PILFR) and isinstance(start, Mapping):
        model = at_values(model, as_recordings(train)[0], start)
    if not isinstance(model, PILFR):
        given = model.model if isinstance(model, Fit) else model
        check_room(given.parameters, job.limits)
        job = replace(job, recordings=check_for_identification(train, int(given.parameters.free.sum()) + 2))
        return from_values(given, structure, job, model if isinstance(model, Fit) else None)
    if not isinstance(model.element, PrandtlIshlinskii | StaticNetwork | None):
        raise InputError(
            "A start is found for PrandtlIshlinskii and StaticNetwork; for others give start={name: value} or a Model."
        )
    first = as_recordings(train)[0]
    fewest = max(model.count(first.n_u, first.n_y), 10 * model.nx) + 2
    job = replace(job, recordings=check_for_identification(train, fewest))
    shape = model.model(first.n_u, first.n_y).parameters
    check_room(shape, job.limits)
    if job.l1:
        check_penalty(job.l1, shape, model.element is None)
    assert isinstance(start, str)
    radius = loosened(stability_limits(model, asked.stable)[:1])
    linear, problem, solution = linear_model(
        job.recordings, model, engine=job.engine, constraints=radius, progress=job.progress, given=given
    )
    if solution.status is Status.INTERRUPTED:
        return job.result(linear, model.linear(), problem, solution)
    fitted = in_known_coordinates(model, with_solution(linear, problem, solution), job)
    if model.element is None:
        bounded = Problem(linear, job.recordings, engine=problem.engine, constraints=job.limits)
        more = model.fixed or model.bounds or model.priors or asked.constraints or solution.status is Status.INFEASIBLE
        if not (more or beyond(bounded, solution.theta)) and job.solver == POLISH:
            return job.result(linear, model, bounded, solution)  # nothing that the linear model has not seen
        return linear_only(model, fitted, job)
    return from_starts(model, fitted, problem, solution, job, starts, seed, start, executor)


def _check_options(model: Any, solver: Any, starts: Any, seed: Any, workers: Any, progress: Any) -> None:
    """Refuse what cannot be used before any long work."""
    if not isinstance(model, PILFR | Lagged | Model | Fit):
        raise InputError(
            f"The model is a {type(model).__name__}; give a PILFR, a NARX, a NOE, a closed Model or a Fit."
        )
    if isinstance(solver, type) or not hasattr(solver, "solve"):
        raise InputError(f"The solver is {solver!r}; give an object such as GaussNewton() or Ipopt().")
    for name, value, least in (("starts", starts, 1), ("seed", seed, 0), ("workers", workers, 1)):
        if not isinstance(value, int | np.integer) or value < least:
            raise InputError(f"{name} = {value!r} was given; give a whole number, {least} or more.")
    if progress is not None and not isinstance(progress, bool) and not callable(progress):
        raise InputError(f"progress = {progress!r} was given; give True, or a function of (stage, done, total, error).")


def _leave_interrupts() -> None:
    """In a worker: Ctrl-C is for the process that waits for the results."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def at_values(structure: PILFR, first: Recording, values: Mapping[str, Any]) -> Model:
    """The model of a structure at values given by name, with a recording's names of inputs and outputs."""
    model = structure.model(first.n_u, first.n_y, inputs=first.inputs, outputs=first.outputs)
    unknown = sorted(set(values) - set(model.parameters))
    if unknown:
        raise InputError(
            f"The start has a value for {unknown[0]!r}, which the model lacks; it has {', '.join(model.parameters)}."
        )
    changes = {}
    for name, value in values.items():
        p = model.parameters[name]
        given = filled(value, f"The start of {name!r}", p.value.shape)
        changes[name] = {"value": np.where(p.fixed & (name in structure.fixed), p.value, np.clip(given, *p.bounds))}
    return model.with_parameters(model.parameters.change(**changes))


def from_values(model: Model, structure: PILFR | None, job: Job, earlier: Fit | None) -> Fit:
    """A closed model or an earlier fit, from its values, and from the initial states that the fit has or estimates."""
    if job.l1:
        check_penalty(job.l1, model.parameters, structure is not None and structure.element is None)
    options: dict[str, Any] = {"l1": {} if structure else job.l1}
    problem = job.problem(model, **options)
    if not np.isfinite(problem.cost(problem.start)):
        raise InputError("The simulation diverges at the start values; start from a stable model.")
    start = problem.start
    if earlier is not None:
        estimated = [r for r in job.recordings if r.begins == "estimate"]
        begin = np.concatenate([start[: int(problem.free.sum())], *(earlier.initial_state(r) for r in estimated)])
        start = begin if problem.cost(begin) < problem.cost(start) else start
    latest = model, problem, job.solve(problem, "solve", start), ""
    try:
        problem, solution = job.settled(problem, latest[2], "solve", **options)
        latest = model, problem, solution, ""
        if job.l1 and structure:
            latest = penalised(model, problem, solution, job, problem.noise)
    except KeyboardInterrupt:
        latest = interrupted(*latest)
    model, problem, solution, note = latest
    return job.result(model, structure, problem, solution, note=note)


def linear_only(structure: PILFR, fitted: Model, job: Job) -> Fit:
    """A linear model with the structure's bounds and fixed blocks, from the one without."""
    values = {k: p.value for k, p in fitted.parameters.items()}
    first = job.recordings[0]
    model = structure.model(first.n_u, first.n_y, values, inputs=fitted.inputs, outputs=fitted.outputs)
    problem = job.problem(model)
    latest = problem, job.solve(problem, "solve")
    try:
        latest = job.settled(*latest, "solve")
    except KeyboardInterrupt:
        latest = problem, replace(latest[1], status=Status.INTERRUPTED)
    return job.result(model, structure, *latest)


def from_starts(
    structure: PILFR,
    linear: Model,
    problem: Problem,
    solution: Solution,
    job: Job,
    starts: int,
    seed: int,
    start: str,
    executor: Executor | None,
) -> Fit:
    """A PI-LFR from many starts; `problem` and `solution` are those of the linear model."""
    blocks = {k: p.value for k, p in linear.parameters.items()}
    level, coordinates = rms_error(problem, solution), not known_entries(structure)
    told = job.progress if executor is None else None
    search = Search.of(job, structure, blocks, start=start, level=level, coordinates=coordinates, progress=told)
    least: list[float] = [np.inf]

    def report(stage: str, found: list[Candidate], total: int) -> None:
        least.append(min([least[-1], *(c.error for c in found)]))
        if job.progress:
            job.progress(stage, len(found), total, least[-1] if np.isfinite(least[-1]) else np.nan)

    candidates, best, stopped = search_starts(search, starts, seed, executor, report)
    if best is None:
        ended = replace(solution, status=Status.INTERRUPTED)
        return job.result(linear, structure.linear(), problem, ended)
    compared: dict[str, Any] = {"linear": linear, "linear_nrmse": tuple(problem.nrmse(solution.theta))}
    model, note, l1 = best.model, best.note, job.l1 and not stopped
    if l1:  # the penalty and a prior towards a smooth density contradict each other
        asked = {name: {"prior": structure.priors.get(name)} for name in ("w", "r")}
        model, note = model.with_parameters(model.parameters.change(**asked)), ""
    problem = job.problem(model, best.error)
    latest = model, problem, best.solution, note
    try:
        if stopped:
            latest = interrupted(*latest)
        elif start == "grid" or beyond(problem, best.theta):
            latest = model, problem, job.solve(problem, "solve", best.theta), note
        model, problem, result, note = latest = _from_others(latest, candidates, job)
        if structure.priors and not stopped:
            problem, result = job.settled(problem, result, "solve")
            latest = model, problem, result, note
        if l1:
            latest = penalised(model, problem, latest[2], job, problem.noise)
    except KeyboardInterrupt:
        latest = interrupted(*latest)
    model, problem, result, note = latest
    return job.result(model, structure, problem, result, candidates=tuple(candidates), note=note, **compared)


def _from_others(latest: Stage, candidates: Sequence[Candidate], job: Job) -> Stage:
    """The same or, where its last solve misses the constraints, that from the best start which had met them."""
    usable = [c for c in candidates if c.solution.status is not Status.INFEASIBLE and np.isfinite(c.error)]
    for other in sorted(usable, key=lambda c: c.error)[:KEEP]:
        if latest[2].status is not Status.INFEASIBLE:
            break
        problem = job.problem(other.model, other.error)
        found = job.solve(problem, "solve", other.theta)
        if found.status is not Status.INFEASIBLE:
            return other.model, problem, found, other.note
    return latest
