"""`fit`: identify a model from recordings.

`fit` checks its arguments and chooses one of four methods: from values (an earlier fit, a closed model, a simulator, or
a structure with values by name), a linear model alone, many starts (`multistart`), or the training of NARX and NOE
models (`lagged`). With an L1 penalty a last solve follows (`penalty`).
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._base import InputError, Progress, check_executor, filled, one_blas_thread, shown_progress, whole, worker_pool
from ..data import Recording, as_recordings
from ..models import PILFR, Lagged, Model, PrandtlIshlinskii, StaticNetwork
from ..optimise import (
    Candidate,
    Constraint,
    Problem,
    Solution,
    Status,
    check_gain,
    check_radius_bounds,
    loosen_radii,
    stability_limits,
    violated_exact,
)
from ..simulators import Simulator, discretise_for
from .context import FitContext, Stage, check_recordings, mark_interrupted, rms_error, without_density_prior
from .lagged import fit_lagged
from .linear_start import known_entries, linear_model, transform_to_known_basis
from .multistart import DEFAULT_SOLVER, MOST_POLISHED, START_KINDS, StartSearch, search_starts
from .penalty import check_penalty, solve_with_penalty
from .result import Fit, FitOptions, with_solution

DEAD_WORKER = (
    "A worker process ended before it returned a result (it may have run out of memory); use fewer workers, or "
    "workers=1."
)
NO_GUARD = (
    "The worker processes could not begin: where processes are spawned, each runs the script again from its top; "
    'put the call of fit below `if __name__ == "__main__":`, or use workers=1.'
)
# residuals that count as one independent residual, because errors of a fit change slowly; calibrated on the paper's rig
CORRELATED_SAMPLES = 10


@dataclass(frozen=True, eq=False)
class StartOptions:
    """Options of the starts that `fit` tries: `kind` is its option `start`, `count` its option `starts`."""

    count: int
    seed: int
    kind: str | Mapping[str, Any]
    linear: Any
    executor: Executor | None


def fit(
    model: PILFR | Lagged | Model | Simulator | Fit,
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
    model : PILFR, NARX, NOE, Model, Simulator or Fit
        A structure, for which start values are computed, or a closed model, a simulator or an earlier fit, which
        starts at its own values. A simulator is integrated on the recordings' grid, with the `hold` of the recordings
        or else its own.
    train : Recording or sequence of Recording
        Training data.
    solver : GaussNewton or Ipopt
        Solver of the final problem, by default `GaussNewton(tolerance=1e-4)`. At an exact bound on a spectral radius
        the last solve is always by Gauss-Newton.
    starts, seed : int
        Number of starts (see `start`), and the seed of all of them. With `start="grid"` the first two have the element
        at the output and at the input (Hammerstein and Wiener models have one such start); further starts are drawn.
        With the same seed, more starts include all of fewer starts.
    start : {"grid", "paper", "plain"} or mapping
        How start values are chosen (`starts` is their number). "grid" (default) places thresholds on a grid, explores
        every start and polishes the best. "paper" solves from every start of the paper (Eq. 22-24) and then moves its
        thresholds, an addition to the paper. "plain" only solves; with `linear="bla"` this is the paper's
        protocol. A mapping of values by parameter name is the only start, for a PI-LFR with any element.
    linear : control.StateSpace or "bla", optional
        Linear model from which the search for a PI-LFR begins; "bla" estimates the best linear approximation from
        periodic training recordings, as in the paper. By default subspace identification refined by output error.
    stable : bool or float, default True
        Upper bound on the spectral radius of a fitted PI-LFR, checked on the eigenvalues of the result. `True` allows
        integrators (bound 1), a float below 1 enforces a minimum decay per sample, `False` removes the bound. The bound
        covers `A` and `A` with all operators moving (slope `Σ w`; for generalized plays also the slope of their
        envelopes far out, and `fit` reports envelopes that are so steep in between that small motions grow). Elements
        with bounded forces need a bound on `A` alone. For user-defined envelopes no slope is known; `fit` reports this.
        Refitting a `Fit` keeps its bound unless you pass a new one.
    constraints : sequence of Constraint, optional
        See `Problem`. Refitting a `Fit` keeps its constraints unless you pass others; `()` removes them.
    noise : float or "estimate", optional
        Standard deviation of the noise relative to the output's, against which priors are weighed. By default the noise
        is estimated wherever there are priors: the problem is solved, the noise set to the error that was reached, and
        the problem solved again, until the two agree. Refitting a `Fit` keeps its noise unless you pass another.
    l1 : dict
        Weight of an L1 penalty by name, `{"w": 1e-4}`: unneeded operators get exactly zero. For a PI-LFR the problem
        is first solved without; then the weights of each channel are scaled to a sum of one and the penalty acts on the
        element alone, with all linear blocks fixed, so that no change of scale evades it (see `penalty`). For your own
        closed model see `Problem`.
    weights : sequence of float, optional
        Weight of each recording, see `Problem` and `noise_weights`; for fits from values (a `Model`, a `Simulator`, a
        `Fit`, or `start` a mapping). Refitting a `Fit` keeps its weights unless you pass others.
    engine : {"auto", "c", "vm"}
        Generated C, or CasADi's virtual machine.
    executor, workers
        Where starts run: any `concurrent.futures.Executor`, or a pool of `workers` processes; the numbers are the same.
        A fit from values runs as many recordings side by side. On systems that spawn processes, put the call below
        `if __name__ == "__main__":`.
    progress : bool or callable
        True shows a bar on the terminal; a callable gets (stage, done, total, error). The error is the smallest
        `train_nrmse` reached so far, averaged over the recordings, and nan while a solver runs. The stage "steps"
        reports the iterations of a start; starts in other processes do not report it.

    Notes
    -----
    A recording with `initial="estimate"` is taken to begin at rest unless the data contradict this; then its state and
    memory are estimated. For a test recording they are estimated with a prior around rest (`Fit.initial_state`).

    Raises
    ------
    InputError
        If recordings and model do not match, the recordings are too short, the start is not usable, or an option is
        invalid.
    """
    solver = solver or DEFAULT_SOLVER
    _check_arguments(model, solver, starts, seed, workers)
    showing = shown_progress(progress)
    check_executor(executor)
    if not isinstance(start, Mapping) and start not in START_KINDS:
        raise InputError(f"The start {start!r} is unknown; use 'grid', 'paper' or 'plain', or values by name.")
    searches = isinstance(model, PILFR | Lagged) and not isinstance(start, Mapping)
    if weights is not None and searches:
        raise InputError("Weights are for a fit from values; give a Model, a Fit, or start={name: value}.")
    own_pool = executor is None and workers > 1
    if own_pool and getattr(multiprocessing.current_process(), "_inheriting", False):
        raise SystemExit(1)  # a spawned worker runs the script again; the first process reports the error
    if l1 is not None and not isinstance(l1, dict):
        raise InputError(f'l1 = {l1!r} was given; give weights by name, like {{"w": 1e-4}}.')
    options = model.options if isinstance(model, Fit) else FitOptions()
    train = _match_units(model, train)
    options = options.updated(stable, constraints, noise, weights, train)
    with ExitStack() as stack:
        report = stack.enter_context(showing)
        context = FitContext((), solver, (), dict(l1 or {}), engine, report, 1 if searches else workers, options)
        try:
            pool = stack.enter_context(worker_pool(workers)) if own_pool and searches else executor
            return _fit(model, train, context, StartOptions(starts, seed, start, linear, pool))
        except BrokenProcessPool:
            spawned = own_pool and multiprocessing.get_start_method() != "fork"
            raise InputError(NO_GUARD if spawned else DEAD_WORKER) from None


def _check_arguments(model: Any, solver: Any, starts: Any, seed: Any, workers: Any) -> None:
    """Refuse invalid arguments before any long work."""
    if not isinstance(model, PILFR | Lagged | Model | Simulator | Fit):
        raise InputError(
            f"The model is a {type(model).__name__}; give a PILFR, a NARX, a NOE, a closed Model, a Simulator or a Fit."
        )
    if isinstance(solver, type) or not hasattr(solver, "solve"):
        raise InputError(f"The solver is {solver!r}; give an object such as GaussNewton() or Ipopt().")
    for name, value, least in (("starts", starts, 1), ("seed", seed, 0), ("workers", workers, 1)):
        whole(value, name, least)


def _match_units(model: Any, train: Recording | Sequence[Recording]) -> tuple[Recording, ...]:
    """Return recordings in the units of the model, with the channels of a simulator; of a structure, in equal units.

    Values without a unit count as in these units.
    """
    recordings = as_recordings(train)
    # the first unit of each channel
    units: Mapping[str, str] = {name: unit for r in reversed(recordings) for name, unit in r.units.items()}
    if isinstance(model, Fit | Simulator):
        units, recordings = model.units, tuple(map(model.matched, recordings))
    elif isinstance(model, Model):
        recordings = tuple(map(model.in_order, recordings))
    matched = []
    for r in (r.in_units(units) for r in recordings):
        own = {name: unit for name, unit in units.items() if name in (*r.inputs, *r.outputs)}
        matched.append(r.with_(units={**own, **r.units}) if own.keys() - r.units.keys() else r)
    return tuple(matched)


@one_blas_thread
def _fit(
    model: PILFR | Lagged | Model | Simulator | Fit,
    train: tuple[Recording, ...],
    context: FitContext,
    starts: StartOptions,
) -> Fit:
    """Choose the method for the kind of model and start."""
    options = context.options
    structure = model if isinstance(model, PILFR) else model.structure if isinstance(model, Fit) else None
    _refuse_ignored_options(model, structure, starts, options.stable)
    if isinstance(model, Lagged):
        check_gain(options.constraints, model.element)
        context = replace(context, constraints=options.constraints)
        return fit_lagged(model, train, context, starts.count, starts.seed, starts.executor)
    if isinstance(model, PILFR) and not isinstance(starts.kind, Mapping):
        return _fit_structure(model, train, replace(context, constraints=options.all_constraints(model)), starts)
    simulator = model if isinstance(model, Simulator) else model.simulator if isinstance(model, Fit) else None
    closed = _closed_model(model, train, starts.kind)
    check_gain(options.constraints, closed.element)
    context = replace(context, constraints=options.all_constraints(structure))
    check_radius_bounds(closed.parameters, context.constraints)
    context = replace(context, recordings=check_recordings(closed, train))
    found = fit_from_values(closed, structure, context, model if isinstance(model, Fit) else None)
    return found if simulator is None else found.with_simulator(simulator)


def _refuse_ignored_options(model: Any, structure: PILFR | None, starts: StartOptions, stable: bool | float) -> None:
    """Refuse options of the search for a PI-LFR, and of its spectral radius, for any other model."""
    searches, kind = isinstance(model, PILFR), type(model).__name__
    if starts.linear is not None and not searches:
        raise InputError(f"linear= was given for a {kind}; it is for a PILFR, leave it out.")
    if starts.kind != "grid" and not searches:
        raise InputError(f"start = {starts.kind!r} was given for a {kind}, which has its own start; leave it out.")
    if not isinstance(stable, bool) and structure is None:
        raise InputError(f"stable = {stable!r} was given for a {kind}; it bounds a PILFR alone, leave it out.")


def _closed_model(model: PILFR | Model | Simulator | Fit, recordings: Sequence[Recording], values: Any) -> Model:
    """Make the closed model that a fit from values starts with."""
    if isinstance(model, PILFR):
        return model_at_values(model, recordings[0], values)
    if not isinstance(model, Simulator):
        return model.model if isinstance(model, Fit) else model
    return discretise_for(model, recordings)


def _fit_structure(structure: PILFR, train: tuple[Recording, ...], context: FitContext, starts: StartOptions) -> Fit:
    """Fit a PI-LFR without start values; begin at rest unless the recordings contradict it."""
    check_gain(context.options.constraints, structure.element)
    if not isinstance(structure.element, PrandtlIshlinskii | StaticNetwork | None):
        raise InputError(
            "Start values are known for PrandtlIshlinskii and StaticNetwork; else give start={name: value} or a Model."
        )
    shape = structure.model(train[0].n_u, train[0].n_y).parameters
    context = replace(context, recordings=check_recordings(structure, train))
    check_radius_bounds(shape, context.constraints)
    if context.l1:
        check_penalty(context.l1, shape, structure.element is None)
    rest = context.at_rest() if structure.element is not None else context
    found = _search(structure, rest, context, starts)
    return found or _search(structure, context, context, starts)  # type: ignore[return-value]


def _search(structure: PILFR, context: FitContext, original: FitContext, starts: StartOptions) -> Fit | None:
    """Find the linear model, then search from it.

    `context` may assume a beginning at rest that `original` does not; None if the recordings contradict it.
    """
    radius = loosen_radii(stability_limits(structure, context.options.stable)[:1])
    options: dict[str, Any] = {"engine": context.engine, "constraints": radius, "progress": context.progress}
    linear, problem, solution = linear_model(context.recordings, structure, given=starts.linear, **options)
    if solution.status is Status.INTERRUPTED:
        return original.result(linear, structure.linear(), problem, solution)
    if context is not original and not original.agrees_with_rest(problem, solution.theta):
        return None
    fitted = transform_to_known_basis(structure, with_solution(linear, problem, solution), context)
    if structure.element is not None:
        return _fit_from_starts(structure, fitted, (problem, solution), context, original, starts)
    bounded = Problem(linear, context.recordings, engine=problem.engine, constraints=context.constraints)
    own = structure.fixed or structure.bounds or structure.priors or context.options.constraints
    changed = own or solution.status is Status.INFEASIBLE or violated_exact(bounded, solution.theta)
    if not changed and context.solver == DEFAULT_SOLVER:
        return context.result(linear, structure, bounded, solution)  # the linear start is the answer
    return _fit_linear(structure, fitted, context)


def model_at_values(structure: PILFR, first: Recording, values: Mapping[str, Any]) -> Model:
    """Make the model of a structure at values by name, with a recording's names of inputs and outputs."""
    model = structure.model_for(first)
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


def fit_from_values(model: Model, structure: PILFR | None, context: FitContext, earlier: Fit | None) -> Fit:
    """Fit a closed model, or an earlier fit again, from its values and initial states."""
    if context.l1:
        check_penalty(context.l1, model.parameters, structure is not None and structure.element is None)
    problem = context.problem(model, l1={} if structure else context.l1)
    if not np.isfinite(problem.cost(problem.start)):
        raise InputError("The simulation diverges at the start values; start from a stable model.")
    start = problem.start
    if earlier is not None:
        begin = problem.variables(start[: problem.n_free], [earlier.initial_state(r) for r in context.recordings])
        start = begin if problem.cost(begin) < problem.cost(start) else start
    return _solve_and_refine(model, structure, problem, start, context)


def _solve_and_refine(
    model: Model, structure: PILFR | None, problem: Problem, start: np.ndarray, context: FitContext
) -> Fit:
    """Solve the problem of a closed model, with the noise estimated and the L1 penalty of a structure."""
    latest = model, problem, context.solve(problem, "solve", start), ""
    try:
        problem, solution = context.iterate_noise(problem, latest[2])
        latest = model, problem, solution, ""
        if context.l1 and structure:
            latest = solve_with_penalty(model, problem, solution, context)
    except KeyboardInterrupt:
        latest = mark_interrupted(*latest)
    model, problem, solution, note = latest
    return context.result(model, structure, problem, solution, note)


def _fit_linear(structure: PILFR, fitted: Model, context: FitContext) -> Fit:
    """Fit a linear model with the structure's bounds and fixed blocks, starting from the model without them."""
    values = {k: p.value for k, p in fitted.parameters.items()}
    model = structure.model_for(fitted, values)
    problem = context.problem(model)
    return _solve_and_refine(model, structure, problem, problem.start, context)


def _fit_from_starts(
    structure: PILFR,
    linear: Model,
    solved: tuple[Problem, Solution],
    context: FitContext,
    original: FitContext,
    starts: StartOptions,
) -> Fit | None:
    """Fit a PI-LFR from many starts, given the solved linear model; None if the recordings contradict rest."""
    problem, solution = solved
    progress, least = context.progress, np.inf

    def report(stage: str, found: list[Candidate], total: int) -> None:
        nonlocal least
        least = min([least, *(c.nrmse for c in found)])
        if progress:
            progress(stage, len(found), total, least if np.isfinite(least) else np.nan)

    search = StartSearch(
        context if starts.executor is None else replace(context, progress=None),  # a callable stays in its process
        structure,
        {k: p.value for k, p in linear.parameters.items()},
        start=str(starts.kind),
        level=rms_error(problem, solution.theta),
        coordinates=not known_entries(structure),
    )
    candidates, best, stopped = search_starts(search, starts.count, starts.seed, starts.executor, report)
    if best is None:
        return original.result(linear, structure.linear(), problem, replace(solution, status=Status.INTERRUPTED))
    compared: dict[str, Any] = {"linear": linear, "linear_nrmse": tuple(problem.nrmse(solution.theta))}
    model, problem, result, note = _finish(structure, candidates, best, stopped, context, starts.kind == "grid")
    stopped = result.status is Status.INTERRUPTED
    if (
        context is not original
        and not stopped
        and not original.agrees_with_rest(problem, result.theta, CORRELATED_SAMPLES)
    ):
        return None
    return original.result(model, structure, problem, result, note, candidates=tuple(candidates), **compared)


def _finish(
    structure: PILFR,
    candidates: Sequence[Candidate],
    best: Candidate,
    stopped: bool,
    context: FitContext,
    polished: bool,
) -> Stage:
    """Solve from the best candidate to the end: with the user's solver, the noise estimated, and the L1 penalty."""
    model, note, l1 = best.model, best.note, context.l1 and not stopped
    if l1:  # the penalty and a prior towards a smooth density contradict each other
        model, note = without_density_prior(model, structure), ""
    problem = context.problem(model, best.error)
    latest: Stage = model, problem, best.solution, note
    try:
        if stopped:
            latest = mark_interrupted(*latest)
        elif polished or violated_exact(problem, best.theta):
            latest = model, problem, context.solve(problem, "solve", best.theta), note
        model, problem, result, note = latest = _meet_constraints(latest, candidates, context)
        if structure.priors and not stopped:
            problem, result = context.iterate_noise(problem, result)
            latest = model, problem, result, note
        if l1:
            latest = solve_with_penalty(model, problem, latest[2], context)
    except KeyboardInterrupt:
        latest = mark_interrupted(*latest)
    return latest


def _meet_constraints(latest: Stage, candidates: Sequence[Candidate], context: FitContext) -> Stage:
    """Return the stage or, if its last solve misses the constraints, a solve from the best start that met them."""
    usable = [c for c in candidates if c.solution.status is not Status.INFEASIBLE and np.isfinite(c.error)]
    for other in sorted(usable, key=lambda c: c.error)[:MOST_POLISHED]:
        if latest[2].status is not Status.INFEASIBLE:
            break
        problem = context.problem(other.model, other.error)
        found = context.solve(problem, "solve", other.theta)
        if found.status is not Status.INFEASIBLE:
            return other.model, problem, found, other.note
    return latest
