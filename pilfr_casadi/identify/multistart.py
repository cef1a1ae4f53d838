"""From recordings to a PI-LFR: linear model, many starts, and a careful polish of the best.

1. `linear_model`: subspace identification refined by output error, states scaled to unit variance (Krikelis et al.,
   Sec. 5.3).
2. Exploration: from each start a short Gauss-Newton run. Most of what a start will ever reach shows within some forty
   steps. The first two have the element at the output and at the input, the others anywhere (`start.grid_start`);
   where the structure says its place, the thresholds are a grid in the first and drawn in the others.
3. The best few are re-gridded (`start.regrid`) and run again: thresholds that have clustered or fallen asleep are
   spread along the density the fit has found. This is done twice, the second time with thresholds beyond the visited
   range and a weak prior that holds the weights to the smoothed density, which decides what the data leaves open; a
   last run without the prior shows what it costs. With the prior wins over without when it is within 10 %.

With the paper's start every start goes through 2 (to the end) and 3, so that each result stands for one start.
With "plain" it goes through 2 alone: the paper's protocol where the linear model that is given is the best linear
approximation (the paper's beginning), while 1 begins at the minimum of the output error, where more starts get stuck.
Elements without memory have their
own start values (`start.network_start`) and nothing to re-grid; with either of these each start is run to the end.

Every task depends on its own seed alone, so the numbers are the same for any executor and any number of workers.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from .._base import InputError, Progress, one_blas_thread
from ..data import Recording
from ..engine import Engine, make_engine
from ..models import PILFR, Model, PrandtlIshlinskii, StaticNetwork, direction_fixed, fixed_whole, places
from ..optimise import Constraint, GaussNewton, Problem, Solution, Status, held_at_bounds, loosened
from .context import FitContext, solve_within_bounds
from .result import PRIOR, Candidate
from .start import (
    Blocks,
    envelope_start,
    grid_start,
    has_networks,
    network_start,
    paper_start,
    regrid_channels,
    unit_states,
)

EXPLORE = GaussNewton(max_iterations=60, tolerance=1e-3)
POLISH = GaussNewton(max_iterations=200, tolerance=1e-4)
STARTS = ("grid", "paper", "plain")
KEEP = 4  # candidates that are polished
MARGIN = 1.1  # times the smallest error, for the weights of a smooth density


@one_blas_thread
def explore(search: StartSearch, seed: int, sequence: np.random.SeedSequence) -> Candidate:
    """One start, run until it has shown what it is worth; with the paper's start to the end, polish included or not.

    The paper's start draws thresholds far smaller than z, which end in clusters and beyond the visited range: a solver
    alone does not bring them back.
    """
    rng = np.random.default_rng(sequence)
    inputs = [r.u for r in search.recordings]
    scaled, states = unit_states(search.linear, inputs, search.coordinates)
    solver = EXPLORE if search.start == "grid" else search.solver
    if isinstance(search.structure.element, StaticNetwork):
        values = network_start(search.structure, scaled, inputs, states, rng)
    elif search.start == "grid":
        place = dict(enumerate(places(search.structure))).get(seed, "random")
        values = grid_start(search.structure, scaled, inputs, states, rng, place)
        if has_networks(search.structure):
            values = envelope_start(search.structure, scaled, values, search.recordings, states, place)
    else:
        values = paper_start(search.structure, scaled, inputs, states, rng)
    model = search.model(values)
    problem = search.problem(model)
    candidate = _candidate(seed, model, problem, search.solve(problem, None, solver))
    candidate = replace(candidate, drawn=is_drawn(search.structure, search.start, seed))
    done = candidate.solution.status is Status.INTERRUPTED or not np.isfinite(candidate.error)
    if search.start != "paper" or done:
        return candidate
    polished = polish(search, candidate)
    if search.solver == POLISH or polished is candidate:
        return polished
    # the user's solver has the last word
    problem = search.problem(polished.model, problem.engine, noise=polished.error)
    solution = search.solve(problem, polished.theta, search.solver)
    return _candidate(seed, polished.model, problem, solution, polished.note)


def is_drawn(structure: Any, start: str, seed: int) -> bool:
    """Whether a start has anything random in it: with the grid, the direction of z where it is free, or thresholds."""
    element = structure.element
    if start != "grid" or isinstance(element, StaticNetwork):
        return True
    several = "r" not in fixed_whole(structure) and getattr(element, "n", 1) > 1
    return seed >= len(places(structure)) and (several or not direction_fixed(structure))


def _candidate(seed: int, model: Model, problem: Problem, solution: Solution, note: str = "") -> Candidate:
    e = problem.residual(solution.theta)
    with np.errstate(over="ignore", invalid="ignore"):
        error = float(np.sqrt(e @ e / e.size))
    error = error if np.isfinite(error) else np.inf
    return Candidate(seed, model, solution.theta, error, solution, note)


@one_blas_thread
def polish(search: StartSearch, candidate: Candidate) -> Candidate:
    """Re-grid a candidate and run it further, with and without a prior that holds the weights to a smooth density.

    The one with the prior (its `note` says so) is returned where its training error is hardly above the smallest.
    """
    parameters = candidate.model.parameters
    regular = isinstance(search.structure.element, PrandtlIshlinskii)
    if not regular or not np.all(np.concatenate([parameters.free[parameters.position(name)] for name in ("r", "w")])):
        return candidate
    engine = make_engine(candidate.model, search.engine)
    n_free = int(parameters.free.sum())
    held = _held(search, candidate)

    def solve(problem: Problem, start: np.ndarray) -> Solution:
        return search.solve(problem, start, POLISH, held)

    found = [candidate]
    for beyond, spread in ((1.0, 0.0), (1.3, 0.02)):
        best = min(found, key=_merit)
        problem = search.problem(best.model, engine)
        values, states = problem.parameters(best.theta), problem.first_states(best.theta)
        runs = [engine.simulate(r.u, values, s, True) for r, s in zip(search.recordings, states, strict=True)]
        moved = regrid_channels(
            search.structure, parameters.unpack(values), np.concatenate([run[2] for run in runs]), beyond
        )
        model = candidate.model.with_parameters(parameters.at(parameters.pack(moved)))
        if spread:
            model = hold_near_density(model, moved, spread)
        problem = search.problem(model, engine, noise=best.error)
        solution = solve(problem, np.concatenate([problem.start[:n_free], best.theta[n_free:]]))
        found.append(_candidate(candidate.seed, model, problem, solution, PRIOR if spread else ""))
        if solution.status is Status.INTERRUPTED:
            return _best_so_far(found)
    smooth = found[-1]
    problem = search.problem(candidate.model, engine, noise=smooth.error)
    found.append(_candidate(candidate.seed, candidate.model, problem, solve(problem, smooth.theta)))
    if found[-1].solution.status is Status.INTERRUPTED:
        return _best_so_far(found)
    best = min(found, key=_merit)
    usable = _merit(smooth)[0] == _merit(best)[0]
    return smooth if usable and smooth.error <= MARGIN * best.error else best


def _held(search: StartSearch, candidate: Candidate) -> bool:
    """Whether a candidate is at an exact bound on a spectral radius, which its multiplier says to hold it."""
    return held_at_bounds(search.problem(candidate.model), candidate.theta, candidate.solution)


def _best_so_far(found: list[Candidate]) -> Candidate:
    """The candidate of the smallest error, as one that was interrupted."""
    best = min(found, key=_merit)
    return replace(best, solution=replace(best.solution, status=Status.INTERRUPTED))


def hold_near_density(model: Model, values: dict[str, Any], spread: float) -> Model:
    """Hold weights and thresholds near the smoothed density, with a relative standard deviation `spread`."""
    r, w = values["r"], values["w"]
    gap = np.gradient(r, axis=1) if r.shape[1] > 1 else r
    priors = {
        "w": {"prior": (w, spread * np.maximum(w, 0.1 * np.mean(w) + 1e-12))},
        "r": {"prior": (r, spread * np.maximum(gap, 1e-12 + 1e-3 * np.max(r)))},
    }
    own = {k: v for k, v in priors.items() if model.parameters[k].prior is None}
    return model.with_parameters(model.parameters.change(**own))


def _merit(candidate: Candidate) -> tuple[bool, float]:
    """What candidates are compared by: whether the constraints hold comes first."""
    return candidate.solution.status is Status.INFEASIBLE, candidate.error


def search_starts(
    search: StartSearch,
    starts: int,
    seed: int,
    executor: Executor | None,
    report: Callable[[str, list[Candidate], int], None],
    keep: int = KEEP,
) -> tuple[list[Candidate], Candidate | None, bool]:
    """All candidates of the exploration, the winner (None if interrupted before there was one), whether interrupted.

    `report` is told the stage, what it has found and how many it will, first when there is nothing yet.

    Raises
    ------
    InputError
        If no start gives a finite simulation.
    """
    sequences = np.random.SeedSequence(seed).spawn(starts)
    found, stopped = run_tasks(
        explore, [(search, i, s) for i, s in enumerate(sequences)], executor, partial(report, "starts")
    )
    usable = sorted((c for c in found if np.isfinite(c.error)), key=_merit)
    if not usable and stopped:
        return found, None, True
    if not usable:
        raise InputError(
            "No start gave a finite simulation; check units, initial state and bounds on A, or choose another order."
        )
    if search.start != "grid" or stopped:
        return found, usable[0], stopped
    chosen = usable[:keep]
    if any(_held(search, c) for c in usable):
        # what exploring reaches says less: every one that was among the best when it came, so that more starts are
        # never worse than fewer
        chosen = [c for i, c in enumerate(found) if c in sorted(found[: i + 1], key=_merit)[:keep] and c in usable]
    polished, stopped = run_tasks(polish, [(search, c) for c in chosen], executor, partial(report, "polish"))
    return found, min(polished or usable[:1], key=_merit), stopped


@dataclass(frozen=True, eq=False)
class StartSearch:
    """All that the tasks of one identification share."""

    structure: PILFR
    recordings: tuple[Recording, ...]
    linear: Blocks
    solver: Any = field(default_factory=GaussNewton)
    constraints: tuple[Constraint, ...] = ()
    engine: str = "auto"
    start: str = "grid"
    l1: dict[str, float] = field(default_factory=dict)
    noise: float | None = None
    weights: np.ndarray | None = None
    level: float = 1.0
    coordinates: bool = True  # whether the states' coordinates are free to choose
    progress: Progress | None = None  # gets the steps of every solve; of starts in other processes they are not heard

    @classmethod
    def of(cls, context: FitContext, structure: PILFR, linear: Blocks, **options: Any) -> StartSearch:
        """The search for a structure with the recordings, solver and options of a context."""
        given = {"engine": context.engine, "noise": context.options.noise, "weights": context.weights, **options}
        return cls(structure, context.recordings, linear, context.solver, context.constraints, **given)

    def problem(self, model: Model, engine: Engine | None = None, noise: float | None = None) -> Problem:
        """The simulation-error problem of a model of this structure.

        Priors are weighed against the noise that was asked for, else what has been reached, `noise`; else what a linear
        model reaches, `level`.
        """
        return Problem(
            model,
            self.recordings,
            engine=engine or self.engine,
            constraints=loosened(self.constraints, least=1.0),
            l1=self.l1,
            noise=self.noise or noise or self.level,
            weights=self.weights,
        )

    def solve(self, problem: Problem, start: np.ndarray | None, solver: Any, held: bool = False) -> Solution:
        """A solver's solution inside exact bounds on spectral radii; `held` says that they hold it."""
        return solve_within_bounds(problem, start, solver, "steps", self.progress, held=held)

    def model(self, values: dict[str, Any]) -> Model:
        """The closed model starting at `values`."""
        first = self.recordings[0]
        return self.structure.model(first.n_u, first.n_y, values, inputs=first.inputs, outputs=first.outputs)


def run_tasks(
    function: Callable[..., Candidate],
    tasks: Iterable[tuple[Any, ...]],
    executor: Executor | None,
    report: Callable[[list[Candidate], int], None],
) -> tuple[list[Candidate], bool]:
    """Results in the order of the tasks, from an executor or one after the other; whether the run was interrupted.

    `report` gets the results so far and their number in the end, first when there are none.
    """
    tasks, results = list(tasks), list[Candidate]()
    if executor is not None:
        try:
            pickle.dumps(tasks[:1])
        except Exception as error:
            raise InputError(
                f"The model or a constraint cannot be sent to other processes ({error}); "
                "define functions at the top of a module, or use workers=1."
            ) from None
    futures = [executor.submit(function, *task) for task in tasks] if executor is not None else None
    try:
        report(results, len(tasks))
        for i, task in enumerate(tasks):
            candidate = futures[i].result() if futures else function(*task)
            results.append(candidate)
            report(results, len(tasks))
            if candidate.solution.status is Status.INTERRUPTED:
                return results, True
    except KeyboardInterrupt:
        for future in futures or ():
            future.cancel()
        return results, True
    return results, False
