"""From a linear model to a PI-LFR: many starts, and a careful polish of the best.

1. Exploration (`explore`): a short Gauss-Newton run from each start; about forty steps show how good a start is. The
   first two starts have the element at the output and at the input, the others anywhere (`grid_start`). If the
   structure fixes the place, the first start has its thresholds on a grid, and the others draw them.
2. Polish (`polish`): some thresholds of the best few have clustered or never slip. So they are spread again along the
   smoothed density of the fitted weights (`regrid`), and the solver runs again, twice. The second time thresholds reach
   beyond the visited range, and a weak prior keeps the weights near the smoothed density where the data do not
   determine them. A last run without the prior shows the prior's cost: the fit with the prior wins if its error is at
   most 10 % larger.

With `start="paper"` every start is solved to the end in 1 and polished in 2, so that each result stands for one start.
With "plain" it is only solved in 1. This is the paper's protocol if the linear model is the best linear approximation.
The refined linear model is at the minimum of the output error, where more starts get stuck. Elements without memory
have their own start values (`network_start`) and no thresholds to spread; their starts, too, are solved to the end
unless the start is "grid".

Every task depends on its own seed alone, so the numbers are the same for any executor and any number of workers.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from .._base import InputError, one_blas_thread, unwrapped_interrupt
from ..engine import Engine, make_engine
from ..models import (
    PILFR,
    Model,
    PrandtlIshlinskii,
    StaticNetwork,
    direction_fixed,
    fixed_blocks,
    places,
    weight_density,
)
from ..optimise import Candidate, GaussNewton, Problem, Solution, Status, at_active_radius, loosen_radii
from .context import FitContext, solve_within_bounds
from .linear_start import Blocks
from .result import DENSITY_PRIOR
from .start import envelope_start, grid_start, has_networks, network_start, paper_start, unit_states

EXPLORE = GaussNewton(max_iterations=60, tolerance=1e-3)
DEFAULT_SOLVER: GaussNewton = GaussNewton(max_iterations=200, tolerance=1e-4)  # of `fit`, and of every polish
START_KINDS: tuple[str, ...] = ("grid", "paper", "plain")
MOST_POLISHED = 4  # candidates that are polished
KERNEL_WIDTH = 1 / 12  # of the smoothed density of weights, over the visited range
PRIOR_MARGIN = 1.1  # multiple of the smallest error up to which the fit with the density prior wins


@dataclass(frozen=True, eq=False)
class StartSearch:
    """The options that all starts of one fit share; `level` is the error of the linear model."""

    context: FitContext
    structure: PILFR
    linear: Blocks
    start: str = "grid"
    level: float = 1.0
    coordinates: bool = True  # whether the states' coordinates are free to choose

    def problem(self, model: Model, engine: Engine | None = None, noise: float | None = None) -> Problem:
        """Make the simulation-error problem of a model, with looser bounds on spectral radii.

        Priors are weighed against the user's noise, else the error `noise` reached so far, else `level`.
        """
        constraints = loosen_radii(self.context.constraints, least=1.0)
        engines = {} if engine is None else {"engine": engine}
        return self.context.problem(model, noise or self.level, constraints=constraints, **engines)

    def solve(self, problem: Problem, start: np.ndarray | None, solver: Any, at_bound: bool = False) -> Solution:
        """Solve inside exact bounds on spectral radii; set `at_bound` if one of them is active at the start."""
        return solve_within_bounds(problem, start, solver, "steps", self.context.progress, at_bound=at_bound)

    def model(self, values: dict[str, Any]) -> Model:
        """Make the closed model that starts at `values`."""
        return self.structure.model_for(self.context.recordings[0], values)


@one_blas_thread
def explore(search: StartSearch, seed: int, sequence: np.random.SeedSequence) -> Candidate:
    """Run one start: briefly for "grid", else to the end, and for "paper" polish it too.

    The paper's start draws thresholds far smaller than z, which end in clusters and beyond the visited range. A solver
    alone does not bring them back.
    """
    model, solver = search.model(start_values(search, seed, sequence)), search.context.solver
    problem = search.problem(model)
    solution = search.solve(problem, None, EXPLORE if search.start == "grid" else solver)
    candidate = replace(judge(seed, model, problem, solution), drawn=is_drawn(search.structure, search.start, seed))
    if search.start != "paper" or solution.status is Status.INTERRUPTED or not np.isfinite(candidate.error):
        return candidate
    polished = polish(search, candidate)
    if solver == DEFAULT_SOLVER or polished is candidate:
        return polished
    # the user's solver makes the last solve
    problem = search.problem(polished.model, problem.engine, noise=polished.error)
    solution = search.solve(problem, polished.theta, solver)
    return judge(seed, polished.model, problem, solution, polished.note)


def start_values(search: StartSearch, seed: int, sequence: np.random.SeedSequence) -> Blocks:
    """Choose the values of one start."""
    structure, recordings = search.structure, search.context.recordings
    rng, inputs = np.random.default_rng(sequence), [r.u for r in recordings]
    linear, states = unit_states(search.linear, inputs, search.coordinates)
    if isinstance(structure.element, StaticNetwork):
        return network_start(structure, linear, inputs, states, rng)
    if search.start != "grid":
        return paper_start(structure, linear, inputs, states, rng)
    place = dict(enumerate(places(structure))).get(seed, "random")
    values = grid_start(structure, linear, inputs, states, rng, place)
    return envelope_start(structure, linear, values, recordings, states, place) if has_networks(structure) else values


def is_drawn(structure: Any, start: str, seed: int) -> bool:
    """Tell whether a start depends on the seed, as a grid start that draws a direction of z or thresholds does."""
    element = structure.element
    if start != "grid" or isinstance(element, StaticNetwork):
        return True
    several = "r" not in fixed_blocks(structure) and getattr(element, "n", 1) > 1
    return seed >= len(places(structure)) and (several or not direction_fixed(structure))


def judge(seed: int, model: Model, problem: Problem, solution: Solution, note: str = "") -> Candidate:
    """Make the candidate of a solution, with its error over the problem's recordings; infinite if it diverges."""
    e = problem.residual(solution.theta)
    with np.errstate(over="ignore", invalid="ignore"):
        error = float(np.sqrt(e @ e / e.size))
    error = error if np.isfinite(error) else np.inf
    nrmse = float(np.mean(problem.nrmse(solution.theta))) if np.isfinite(error) else np.inf
    return Candidate(seed, model, solution.theta, error, solution, note, nrmse=nrmse)


@one_blas_thread
def polish(search: StartSearch, candidate: Candidate) -> Candidate:
    """Spread the thresholds of a candidate again and solve, with and without a prior that smooths the weights.

    The candidate with the prior (see its `note`) is returned if its training error is at most `PRIOR_MARGIN` times the
    smallest.
    """
    parameters, recordings = candidate.model.parameters, search.context.recordings
    regular = isinstance(search.structure.element, PrandtlIshlinskii)
    if not regular or not np.all(np.concatenate([parameters.free[parameters.position(name)] for name in ("r", "w")])):
        return candidate
    engine = make_engine(candidate.model, search.context.engine)
    n_free = int(parameters.free.sum())
    at_bound = at_active_radius(search.problem(candidate.model), candidate.theta, candidate.solution)
    candidates = [candidate]
    for extent, spread in ((1.0, 0.0), (1.3, 0.02)):
        best = min(candidates, key=_merit)
        problem = search.problem(best.model, engine)
        values, states = problem.parameters(best.theta), problem.first_states(best.theta)
        runs = [engine.simulate(r.u, values, s, True) for r, s in zip(recordings, states, strict=True)]
        z = np.concatenate([run[2] for run in runs])
        moved = regrid_channels(search.structure, parameters.unpack(values), z, extent=extent)
        model = candidate.model.with_parameters(parameters.at(parameters.pack(moved)))
        if spread:
            model = hold_near_density(model, moved, spread)
        problem = search.problem(model, engine, noise=best.error)
        begin = np.concatenate([problem.start[:n_free], best.theta[n_free:]])
        solution = search.solve(problem, begin, DEFAULT_SOLVER, at_bound)
        candidates.append(judge(candidate.seed, model, problem, solution, DENSITY_PRIOR if spread else ""))
        if solution.status is Status.INTERRUPTED:
            return _best_so_far(candidates)
    smooth = candidates[-1]
    problem = search.problem(candidate.model, engine, noise=smooth.error)
    solution = search.solve(problem, smooth.theta, DEFAULT_SOLVER, at_bound)
    candidates.append(judge(candidate.seed, candidate.model, problem, solution))
    if solution.status is Status.INTERRUPTED:
        return _best_so_far(candidates)
    best = min(candidates, key=_merit)
    usable = _merit(smooth)[0] == _merit(best)[0]
    return smooth if usable and smooth.error <= PRIOR_MARGIN * best.error else best


def _best_so_far(candidates: list[Candidate]) -> Candidate:
    """Return the best candidate, marked as interrupted."""
    best = min(candidates, key=_merit)
    return replace(best, solution=replace(best.solution, status=Status.INTERRUPTED))


def _merit(candidate: Candidate) -> tuple[bool, float]:
    """Return the sort key of a candidate: infeasible ones last, then by error. The smallest wins."""
    return candidate.solution.status is Status.INFEASIBLE, candidate.error


def hold_near_density(model: Model, values: dict[str, Any], spread: float) -> Model:
    """Put priors of relative standard deviation `spread` on weights and thresholds that have none."""
    r, w = values["r"], values["w"]
    gap = np.gradient(r, axis=1) if r.shape[1] > 1 else r
    priors = {
        "w": {"prior": (w, spread * np.maximum(w, 0.1 * np.mean(w) + 1e-12))},
        "r": {"prior": (r, spread * np.maximum(gap, 1e-12 + 1e-3 * np.max(r)))},
    }
    changes = {k: v for k, v in priors.items() if model.parameters[k].prior is None}
    return model.with_parameters(model.parameters.change(**changes))


def regrid(
    r: np.ndarray,
    w: np.ndarray,
    reach: float,
    *,
    extent: float = 1.3,
    count: int | None = None,
    spacing: float = 0.4,
) -> tuple[np.ndarray, np.ndarray]:
    """Spread the thresholds and weights (N,) of one channel along their smoothed density.

    Each new threshold represents an equal share of `density^spacing`. With 0.4 the thresholds are the knots of a good
    piecewise-linear approximation of the loading curve. Beyond the visited range the density is extrapolated.

    Parameters
    ----------
    r, w : array, shape (N,)
        Fitted thresholds and weights; returned as they are if no weight or range is above zero.
    reach : float
        Largest |z| visited.
    extent : float
        Largest threshold, in units of `reach`; the log-linear extrapolation of the tail never rises.
    count : int, optional
        Number of new thresholds, N by default.
    spacing : float
        Power of the density by which thresholds are spaced; 0 gives an even grid.
    """
    from scipy.integrate import cumulative_trapezoid

    if not (np.sum(w) > 0 and reach > 0):
        return r[:count], w[:count]
    grid = np.linspace(0.0, extent * reach, 600)
    d = weight_density(r, w, grid, KERNEL_WIDTH * reach)
    if d.max() <= 1e-200 * np.sum(w):  # all thresholds lie far beyond the visited range: spread them evenly
        d = np.full_like(grid, np.sum(w) / grid[-1])
    tail = (grid >= 0.4 * reach) & (grid <= 0.85 * reach)
    log_d = np.log(d + 1e-6 * d.max())
    slope = min(float(np.polyfit(grid[tail], log_d[tail], 1)[0]), 0.0)
    outside = grid > 0.85 * reach
    d[outside] = np.exp(np.mean(log_d[tail]) + slope * (grid[outside] - np.mean(grid[tail])))
    cumulative = cumulative_trapezoid(d**spacing, grid, initial=0)
    edges = np.interp(np.linspace(0, 1, (count or len(r)) + 1), cumulative / cumulative[-1], grid)
    mass = np.diff(np.interp(edges, grid, cumulative_trapezoid(d, grid, initial=0)))
    moment = np.diff(np.interp(edges, grid, cumulative_trapezoid(d * grid, grid, initial=0)))
    return moment / np.maximum(mass, 1e-300), mass


def regrid_channels(
    structure: PILFR, values: Mapping[str, np.ndarray], z: np.ndarray, **options: Any
) -> dict[str, Any]:
    """Spread every channel's thresholds and weights by `regrid`; z (M, n_w) is the fitted model's signal."""
    reaches = [threshold_range(structure, values, z_i, i) for i, z_i in enumerate(z.T)]
    channels = [regrid(r, w, reach, **options) for r, w, reach in zip(values["r"], values["w"], reaches, strict=True)]
    return {**values, "r": np.array([r for r, _ in channels]), "w": np.array([w for _, w in channels])}


def threshold_range(structure: PILFR, values: Mapping[str, np.ndarray], z: np.ndarray, channel: int) -> float:
    """Return the smallest threshold for which an operator of a channel never moves over z (M,).

    For plays and stops it is max |z|. A generalized play rests if its lower curve `γ_l - r` at any z lies below its
    upper curve `γ_r + r` at any other z, so the threshold is half of `max γ_l - min γ_r`.
    """
    if not has_networks(structure):
        return float(np.max(np.abs(z)))
    assert isinstance(structure.element, PrandtlIshlinskii)
    operator, ends = structure.element.operator, np.array([np.max(z), np.min(z)])
    low, high = (operator.envelope(side, end, values, channel) for side, end in zip("lr", ends, strict=True))
    return max(float(low - high) / 2, 0.0)


def search_starts(
    search: StartSearch,
    starts: int,
    seed: int,
    executor: Executor | None,
    report: Callable[[str, list[Candidate], int], None],
) -> tuple[list[Candidate], Candidate | None, bool]:
    """Explore and polish; return all explored candidates, the winner, and whether the search was interrupted.

    The winner is None if the search was interrupted before there was one. `report` receives the stage, its candidates
    so far and their final number; its first call has no candidates.
    """
    sequences = np.random.SeedSequence(seed).spawn(starts)
    tasks = [(search, i, s) for i, s in enumerate(sequences)]
    found, stopped = run_tasks(explore, tasks, executor, partial(report, "starts"))
    usable = sorted((c for c in found if np.isfinite(c.error)), key=_merit)
    if not usable and stopped:
        return found, None, True
    if not usable:
        raise InputError(
            "No start gave a finite simulation; check units, initial state and bounds on A, or choose another order."
        )
    if search.start != "grid" or stopped:
        return found, usable[0], stopped
    chosen = usable[:MOST_POLISHED]
    if any(at_active_radius(search.problem(c.model), c.theta, c.solution) for c in usable):
        # At a bound the errors after exploration rank candidates poorly. So polish each candidate that was among the
        # best when it was explored; then more starts are never worse than fewer.
        chosen = [
            c for i, c in enumerate(found) if c in sorted(found[: i + 1], key=_merit)[:MOST_POLISHED] and c in usable
        ]
    polished, stopped = run_tasks(polish, [(search, c) for c in chosen], executor, partial(report, "polish"))
    return found, min(polished or usable[:1], key=_merit), stopped


def run_tasks(
    function: Callable[..., Candidate],
    tasks: Iterable[tuple[Any, ...]],
    executor: Executor | None,
    report: Callable[[list[Candidate], int], None],
) -> tuple[list[Candidate], bool]:
    """Run tasks in the executor or one by one; return the results in their order, and whether it was interrupted.

    `report` receives the results so far and their final number; its first call has no results.
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
        with unwrapped_interrupt():
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
