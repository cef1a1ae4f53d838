"""From recordings to a PI-LFR: linear model, many starts, and a careful polish of the best.

1. `linear_model`: subspace identification refined by output error, states scaled to unit variance (Krikelis et al.,
   Sec. 5.3).
2. Exploration: from each seed a short Gauss-Newton run. Most of what a start will ever reach shows within some forty
   steps.
3. The best few are re-gridded (`start.regrid`) and run again: thresholds that have clustered or fallen asleep are
   spread along the density the fit has found. This is done twice, the second time with thresholds beyond the visited
   range and a weak prior that holds the weights to the smoothed density, which decides what the data leaves open.
   A last run without the prior shows what the prior costs.
4. The smallest training error wins; with the prior wins over without when it is within `margin` of it.

Every task depends on its own seed alone, so the numbers are the same for any executor and any number of workers.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from .compiled import make_engine
from .constraints import Constraint, stable
from .elements import PrandtlIshlinskii
from .gauss_newton import GaussNewton
from .lfr import PILFR
from .model import Model
from .problem import Problem
from .recording import InputError, Recording
from .sensitivities import Engine
from .solution import Solution, Status
from .start import Blocks, grid_start, paper_start, regridded, unit_states
from .subspace import subspace_matrices
from .threads import one_blas_thread

EXPLORE = GaussNewton(max_iterations=60, tolerance=1e-3)
POLISH = GaussNewton(max_iterations=200, tolerance=1e-4)
KEEP = 4  # candidates that are polished
PRIOR = "weights held near a smooth density by a weak prior"


@dataclass(frozen=True, eq=False)
class Search:
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

    def problem(self, model: Model, engine: Engine | None = None, noise: float = 1.0) -> Problem:
        """The simulation-error problem of a model of this structure."""
        return Problem(
            model,
            self.recordings,
            engine=engine or self.engine,
            constraints=self.constraints,
            l1=self.l1,
            noise=self.noise or noise,
        )

    def model(self, values: dict[str, Any]) -> Model:
        """The closed model starting at `values`."""
        first = self.recordings[0]
        return self.structure.model(first.n_u, first.n_y, values, inputs=first.inputs, outputs=first.outputs)


@dataclass(frozen=True, eq=False)
class Candidate:
    """What one start led to."""

    seed: int
    model: Model
    theta: np.ndarray
    error: float
    solution: Solution
    note: str = ""


def stability(structure: PILFR, radius: float = 1.0) -> tuple[Constraint, ...]:
    """Bounds on the spectral radius of A, and of A + B_w diag(Σw) C_z: no operator slips, or all (stops: sticks)."""
    if structure.nx == 0:
        return ()
    limits: tuple[Constraint, ...] = (stable(radius),)
    element = structure.element
    if isinstance(element, PrandtlIshlinskii):
        limits += (stable(radius, _with_element, "spectral radius with the element's full slope"),)
    return limits


def _with_element(p: Any) -> Any:
    return p["A"] + p["B_w"] @ ca.diag(ca.sum2(p["w"])) @ p["C_z"]


def linear_model(
    recordings: Sequence[Recording],
    structure: PILFR,
    *,
    engine: str = "auto",
    constraints: tuple[Constraint, ...] = (),
    solver: GaussNewton | None = None,
) -> tuple[Model, Problem, Solution]:
    """A linear state-space model: subspace identification refined by output error.

    Raises
    ------
    InputError
        If the recordings are too short for the order.
    """
    linear = structure.linear()
    first = recordings[0]
    offset = np.mean(np.concatenate([r.y for r in recordings]), axis=0) if structure.offset else np.zeros(first.n_y)
    a, b, c, d = subspace_matrices(recordings, structure.nx, offset=structure.offset)
    model = linear.model(
        first.n_u,
        first.n_y,
        {"A": a, "B_u": b, "C_y": c, "D_yu": d, "y_0": offset},
        inputs=first.inputs,
        outputs=first.outputs,
    )
    problem = Problem(model, recordings, engine=engine, constraints=constraints)
    solution = (solver or GaussNewton(tolerance=1e-4)).solve(problem)
    return model, problem, solution


@one_blas_thread
def explore(search: Search, seed: int, sequence: np.random.SeedSequence) -> Candidate:
    """One start, run until it has shown what it is worth (to the end with the paper's start)."""
    rng = np.random.default_rng(sequence)
    inputs = [r.u for r in search.recordings]
    scaled, states = unit_states(search.linear, inputs)
    if search.start == "paper":
        values, solver = paper_start(search.structure, scaled, rng), search.solver
    else:
        values, solver = grid_start(search.structure, scaled, inputs, states, rng), EXPLORE
    model = search.model(values)
    problem = search.problem(model)
    return _candidate(seed, model, problem, solver.solve(problem))


def _candidate(seed: int, model: Model, problem: Problem, solution: Solution, note: str = "") -> Candidate:
    e = problem.residual(solution.theta)
    error = float(np.sqrt(e @ e / e.size)) if np.all(np.isfinite(e)) else np.inf
    return Candidate(seed, model, solution.theta, error, solution, note)


@one_blas_thread
def polish(search: Search, candidate: Candidate, margin: float = 1.1) -> Candidate:
    """Re-grid a candidate and run it further, with and without a prior that holds the weights to a smooth density.

    The one with the prior (its `note` says so) is returned where its training error is within `margin` of the smallest.
    """
    parameters = candidate.model.parameters
    if not np.all(np.concatenate([parameters.free[parameters.position(name)] for name in ("r", "w")])):
        return candidate
    engine = make_engine(candidate.model, search.engine)
    n_free = int(parameters.free.sum())
    found = [candidate]
    for beyond, spread in ((1.0, 0.0), (1.3, 0.02)):
        best = min(found, key=lambda c: c.error)
        problem = search.problem(best.model, engine)
        values, states = problem.parameters(best.theta), problem.first_states(best.theta)
        runs = [engine.simulate(r.u, values, s, True) for r, s in zip(search.recordings, states, strict=True)]
        moved = regridded(search.structure, parameters.unpack(values), np.concatenate([run[2] for run in runs]), beyond)
        model = candidate.model.with_parameters(parameters.at(parameters.pack(moved)))
        if spread:
            model = _with_prior(model, moved, spread)
        problem = search.problem(model, engine, noise=best.error)
        solution = POLISH.solve(problem, np.concatenate([problem.start[:n_free], best.theta[n_free:]]))
        found.append(_candidate(candidate.seed, model, problem, solution, PRIOR if spread else ""))
    smooth = found[-1]
    problem = search.problem(candidate.model, engine)
    found.append(_candidate(candidate.seed, candidate.model, problem, POLISH.solve(problem, smooth.theta)))
    best = min(found, key=lambda c: c.error)
    return smooth if smooth.error <= margin * best.error else best


def _with_prior(model: Model, values: dict[str, Any], spread: float) -> Model:
    """Hold weights and thresholds near the smoothed density, with a relative standard deviation `spread`."""
    r, w = values["r"], values["w"]
    gap = np.gradient(r, axis=1) if r.shape[1] > 1 else r
    priors = {
        "w": {"prior": (w, spread * np.maximum(w, 0.1 * np.mean(w) + 1e-12))},
        "r": {"prior": (r, spread * np.maximum(gap, 1e-12 + 1e-3 * np.max(r)))},
    }
    own = {k: v for k, v in priors.items() if model.parameters[k].prior is None}
    return model.with_parameters(model.parameters.change(**own))


def run_tasks(
    function: Callable[..., Candidate],
    tasks: Iterable[tuple[Any, ...]],
    executor: Executor | None,
    report: Callable[[Candidate], None],
) -> tuple[list[Candidate], bool]:
    """Results in the order of the tasks, from an executor or one after the other; whether the run was interrupted."""
    tasks, results = list(tasks), []
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
        for i, task in enumerate(tasks):
            candidate = futures[i].result() if futures else function(*task)
            results.append(candidate)
            report(candidate)
            if candidate.solution.status is Status.INTERRUPTED:
                return results, True
    except KeyboardInterrupt:
        for future in futures or ():
            future.cancel()
        return results, True
    return results, False


def search_starts(
    search: Search,
    starts: int,
    seed: int,
    executor: Executor | None,
    report: Callable[[Candidate], None],
    keep: int = KEEP,
) -> tuple[list[Candidate], Candidate | None, bool]:
    """All candidates of the exploration, the winner (None if interrupted before there was one), whether interrupted.

    Raises
    ------
    InputError
        If no start gives a finite simulation.
    """
    sequences = np.random.SeedSequence(seed).spawn(starts)
    found, stopped = run_tasks(explore, [(search, i, s) for i, s in enumerate(sequences)], executor, report)
    usable = sorted((c for c in found if np.isfinite(c.error)), key=lambda c: c.error)
    if not usable and stopped:
        return found, None, True
    if not usable:
        raise InputError(
            "No start gave a finite simulation; check units and the initial state, or choose another order."
        )
    if search.start == "paper" or stopped:
        return found, usable[0], stopped
    polished, stopped = run_tasks(polish, [(search, c) for c in usable[:keep]], executor, report)
    return found, min(polished or usable[:1], key=lambda c: c.error), stopped
