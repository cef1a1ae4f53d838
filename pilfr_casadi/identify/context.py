"""`FitContext`: the recordings, solver and options of one fit, its solves, and its result with a note.

**A search begins at rest.** With a free initial state a search would improve the fit by initial memories that the
machine never had. A prior does not prevent this, because the units of states and memories are free too. So a search
begins at rest unless the recordings contradict it: unless freeing the state lowers the cost by more than the Bayesian
information criterion charges for the new variables (`FitContext.agrees_with_rest`).

The note of a result names what the recordings do not determine (`undetermined`).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from .._base import Progress, deferred_interrupt
from ..data import Recording, as_recordings, check_for_identification, fingerprint
from ..models import LAYER, PILFR, Lagged, Model
from ..optimise import (
    BOUND_STEP_SOLVER,
    Constraint,
    GaussNewton,
    Ipopt,
    IterationCallback,
    Problem,
    Solution,
    Status,
    describe_unbounded,
    limits_of,
    move_inside_exact,
    solve_within_radii,
)
from .result import DENSITY_PRIOR, Fit, FitOptions, with_solution
from .uncertainty import standard_errors
from .undetermined import describe_open_memory, describe_reached_gain

Stage = tuple[Model, Problem, Solution, str]  # model, problem, solution, note
Array = np.ndarray
BOUND_SOLVER = GaussNewton()  # solves at a bound on a spectral radius for solvers other than Gauss-Newton
FAR_WORSE = 1e3  # multiple of the error of zero outputs from which a fit has the status DIVERGES
NOISE_ROUNDS, NOISE_AGREES = 5, 0.05  # limit of noise estimates, and the relative change below which they stop


@dataclass(frozen=True, eq=False)
class FitContext:
    """The recordings, solver and options that every kind of fit shares.

    `constraints` include the bounds on spectral radii; `threads` is the number of recordings run at a time; `began` is
    the `time.perf_counter` at which the work began.
    """

    recordings: tuple[Recording, ...]
    solver: Any
    constraints: tuple[Constraint, ...] = ()
    l1: dict[str, float] = field(default_factory=dict)
    engine: str = "auto"
    progress: Progress | None = None
    threads: int = 1
    options: FitOptions = FitOptions()  # noqa: RUF009  (frozen)
    began: float = field(default_factory=time.perf_counter)

    @cached_property
    def weights(self) -> np.ndarray | None:
        """The weight of each recording, or None."""
        return self.options.weights_of(self.recordings)

    def problem(self, model: Model, noise: float = 1.0, **others: Any) -> Problem:
        """Make the simulation-error problem of a model; `others` replace options of `Problem`."""
        given: dict[str, Any] = {"constraints": self.constraints, "noise": self.options.noise or noise}
        given |= {"engine": self.engine, "weights": self.weights, **others}
        problem = Problem(model, self.recordings, **given)
        problem.threads = self.threads
        return problem

    def solve(self, problem: Problem, stage: str, start: np.ndarray | None = None) -> Solution:
        """Solve a problem inside its bounds on spectral radii; see `solve_within_bounds`."""
        if not isinstance(self.solver, GaussNewton | Ipopt):
            solution: Solution = self.solver.solve(problem, start)
            return solution
        bound_solver = self.solver if isinstance(self.solver, GaussNewton) else BOUND_SOLVER
        return solve_within_bounds(problem, start, self.solver, stage, self.progress, bound_solver)

    def iterate_noise(self, problem: Problem, solution: Solution) -> tuple[Problem, Solution]:
        """If there are priors, solve again with the noise set to the error reached, until the two agree."""
        priors = any(p.prior is not None and not np.all(p.fixed) for p in problem.model.parameters.values())
        for _ in range(NOISE_ROUNDS if priors and self.options.noise is None else 0):
            error = rms_error(problem, solution.theta)
            if abs(error / problem.noise - 1) < NOISE_AGREES or error == 0 or solution.status is Status.INTERRUPTED:
                break
            problem = self.problem(problem.model, error, l1=problem.l1, engine=problem.engine)
            solution = self.solve(problem, "solve", solution.theta)
        return problem, solution

    def at_rest(self) -> FitContext:
        """Return the context in which recordings with an estimated initial state begin at rest."""
        if not any(r.begins == "estimate" for r in self.recordings):
            return self
        recordings = [r.with_(initial="zero") if r.begins == "estimate" else r for r in self.recordings]
        return replace(self, recordings=tuple(recordings))

    def agrees_with_rest(self, problem: Problem, theta: np.ndarray, correlated: float = 1.0) -> bool:
        """Tell whether the recordings agree with a beginning at rest, given the solution θ of the problem from rest.

        A linearised step in the initial states alone predicts the largest decrease of the cost. `correlated` residuals
        count as one, because a model's errors change slowly. True also if θ already contains initial states.
        """
        if problem.size > problem.n_free or not any(r.begins == "estimate" for r in self.recordings):
            return True
        freed = self.problem(problem.model, engine=problem.engine, constraints=())
        n_free = freed.n_free
        _, gradient, hessian = freed.normal(np.concatenate([theta, freed.start[n_free:]]))
        cost = 0.5 * float(np.mean(problem.residual(theta) ** 2))
        if not np.isfinite(cost) or cost == 0:
            return True
        slope, curvature = gradient[n_free:], hessian[n_free:, n_free:]
        if not len(slope):
            return True
        decrease = 0.5 * float(slope @ np.linalg.lstsq(curvature, slope, rcond=None)[0])
        remaining = max(1 - decrease / cost, np.finfo(float).tiny)
        independent = max(freed.residuals / correlated, 2.0)
        return bool(-independent * np.log(remaining) < len(slope) * np.log(independent))

    def result(
        self, model: Model, structure: PILFR | None, problem: Problem, solution: Solution, note: str = "", **fields: Any
    ) -> Fit:
        """Build the `Fit` of a solution; Ctrl-C waits until it is complete and shows in its status.

        `fields` are further fields of the `Fit`; `errors={}` skips the standard errors.
        """
        built: list[Fit] = []
        try:
            with deferred_interrupt():
                built.append(
                    self._result(model, structure, problem, move_inside_exact(problem, solution), note, fields)
                )
            if self.progress:
                self.progress("standard errors", 1, 1, float(np.mean(built[0].train_nrmse)))
        except KeyboardInterrupt:
            if not built:
                raise
            return replace(built[0], solution=replace(built[0].solution, status=Status.INTERRUPTED))
        return built[0]

    def _result(
        self, model: Model, structure: PILFR | None, problem: Problem, solution: Solution, note: str, fields: Any
    ) -> Fit:
        """Build the `Fit`, with a note on quantities that the recordings do not determine.

        Priors that the search added to weights and thresholds (`DENSITY_PRIOR`) are removed from the model and its
        standard errors here.
        """
        fitted, judged, theta = with_solution(model, problem, solution), problem, solution.theta
        if note == DENSITY_PRIOR:
            fitted = without_density_prior(fitted, structure)
            names = ("engine", "constraints", "noise", "scale", "weights")
            options: dict[str, Any] = {name: getattr(problem, name) for name in names}
            judged = Problem(fitted, problem.recordings, **options)
        nrmse = tuple(problem.nrmse(theta))
        of_zero = [float(np.max(np.sqrt(np.mean(r.y**2, axis=0)) / problem.scale)) for r in problem.recordings]
        if solution.status.converged and not max(nrmse) < FAR_WORSE * max(1.0, *of_zero):
            solution = replace(solution, status=Status.DIVERGES)
        notes = (
            note,
            describe_open_memory(judged, theta),
            describe_reached_gain(problem, theta),
            describe_unbounded(structure, problem.constraints, problem.values(theta)),
        )
        bounds = zip(problem.labels, theta, problem.lower, problem.upper, strict=True)
        limits = limits_of(problem, solution)
        active = [f"{label} = {value:g}" for label, value, low, high in bounds if value in (low, high)]
        active += [limit.name for limit in limits if limit.active and limit.kind == "constraint"]
        states = zip(self.recordings, problem.first_states(theta), strict=True)
        if "errors" not in fields:
            fields = {**fields, "errors": standard_errors(judged, theta, structure)}
        return Fit(
            model=fitted,
            structure=structure,
            dt=self.recordings[0].dt,
            solution=solution,
            train_nrmse=nrmse,
            initial={fingerprint(r): state for r, state in states},
            labels=problem.labels,
            active=tuple(active),
            seconds=time.perf_counter() - self.began,
            units=dict(self.recordings[0].units),
            note="; ".join(part for part in notes if part),
            engine=self.engine,
            limits=limits,
            options=self.options,
            **fields,
        )


def without_density_prior(model: Model, structure: PILFR | None) -> Model:
    """Replace the priors that a search put on weights and thresholds by the structure's own, if it has any."""
    priors = structure.priors if structure else {}
    return model.with_parameters(model.parameters.change(**{name: {"prior": priors.get(name)} for name in LAYER}))


def solve_within_bounds(
    problem: Problem,
    start: np.ndarray | None,
    solver: Any,
    stage: str = "solve",
    progress: Progress | None = None,
    bound_solver: GaussNewton = BOUND_STEP_SOLVER,
    at_bound: bool = False,
) -> Solution:
    """Solve a problem inside exact bounds on spectral radii with any solver (`solve_within_radii`).

    The package's solvers report their steps under the name `stage` and pass their time limit on to `bound_solver`.
    """
    start = problem.start if start is None else start
    if not isinstance(solver, GaussNewton | Ipopt):
        return solve_within_radii(problem, start, solver.solve, bound_solver, at_bound)
    report = report_iterations(progress, stage, solver.max_iterations)
    bound_solver = replace(bound_solver, time_limit=solver.time_limit)
    return solve_within_radii(problem, start, lambda p, s: solver.solve(p, s, report), bound_solver, at_bound, report)


def report_iterations(progress: Progress | None, stage: str, most: int) -> IterationCallback | None:
    """Turn a progress function into a callback for a solver's iterations.

    A cost includes priors and weights of recordings, so it is no NRMSE, and the error reported is nan.
    """
    if progress is None:
        return None
    return lambda i: progress(stage, min(i.number, most), most, np.nan)


def context_of_fit(
    fit: Fit, train: Recording | Sequence[Recording], *, solver: Any, engine: str = "auto", **others: Any
) -> FitContext:
    """Make the context of a fit that continues an earlier one; `others` replace its `FitOptions`."""
    recordings = tuple(fit.matched(r) for r in as_recordings(train))
    options = fit.options.updated(**others, train=recordings)
    return FitContext(recordings, solver, options.all_constraints(fit.structure), engine=engine, options=options)


def check_recordings(
    model: PILFR | Lagged | Model | Fit, train: Recording | Sequence[Recording]
) -> tuple[Recording, ...]:
    """Check that recordings fit each other and have enough samples for a model; return them as a tuple."""
    first = as_recordings(train)[0]
    if isinstance(model, Lagged):
        unknowns = model.unknowns(first.n_u, first.n_y)
    elif isinstance(model, PILFR):
        unknowns = max(int(model.model(first.n_u, first.n_y).parameters.free.sum()), 10 * model.nx)
    else:
        unknowns = int((model.model if isinstance(model, Fit) else model).parameters.free.sum())
    structure = model.structure if isinstance(model, Fit) else model
    black_box = isinstance(structure, PILFR | Lagged)  # a Model may be a simulator, which moves from its start
    return check_for_identification(train, unknowns + 2, excited=black_box)


def mark_interrupted(model: Model, problem: Problem, solution: Solution, note: str) -> Stage:
    """Return the stage with its solution marked as interrupted."""
    return model, problem, replace(solution, status=Status.INTERRUPTED), note


def rms_error(problem: Problem, theta: Array) -> float:
    """Compute the root mean square of the normalised residuals."""
    return float(np.sqrt(np.mean(problem.residual(theta) ** 2)))
