"""The context of one fit: recordings, solver and options, and the solves that every way to a fit makes.

An initial state that is free in a search lets it pay for a better fit with memories that no machine had. A prior does
not prevent this, because the units of states and memories are free too. So a search begins with the state at rest where
the recordings do not contradict it: where freeing the state would lower the cost by less than the Bayesian information
criterion charges for the new variables (`FitContext.agrees_with_rest`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from .._base import Progress, deferred_interrupt
from ..data import Recording, as_recordings, fingerprint
from ..models import LAYER, PILFR, Model
from ..optimise import (
    STEP,
    Constraint,
    GaussNewton,
    Ipopt,
    Iteration,
    Problem,
    Solution,
    Status,
    exactly,
    limits_of,
    unbounded_sentence,
    within_bounds,
)
from .options import FitOptions
from .result import PRIOR, Fit, describe_open_memory, describe_reached_gain, with_solution
from .uncertainty import standard_errors

Stage = tuple[Model, Problem, Solution, str]  # model, problem, solution, note
AT_BOUND = GaussNewton()  # solves at a bound on a spectral radius for solvers other than Gauss-Newton
DIVERGES = 1e3  # times the error of a model without outputs, from which a model diverges
NOISE_ROUNDS, NOISE_AGREES = 5, 0.05  # most estimates of the noise, and the relative change that ends them


@dataclass(frozen=True, eq=False)
class FitContext:
    """What all ways to a fit share.

    Attributes
    ----------
    recordings : tuple of Recording
        Training data.
    solver : object
        `GaussNewton`, `Ipopt`, or any object with `solve(problem, start)`.
    constraints : tuple of Constraint
        All constraints, bounds on spectral radii included.
    l1 : dict
        Weight of an L1 penalty by parameter name.
    engine : str
    progress : callable or None
    threads : int
        Recordings that are run at a time.
    options : FitOptions
    began : float
        When the work began (`time.perf_counter`), s.
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
        """Weight of each recording, or None."""
        return self.options.weights_of(self.recordings)

    def problem(self, model: Model, noise: float = 1.0, **others: Any) -> Problem:
        """Simulation-error problem of a model; `others` replace options of `Problem`."""
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
        last = self.solver if isinstance(self.solver, GaussNewton) else AT_BOUND
        return solve_within_bounds(problem, start, self.solver, stage, self.progress, last)

    def settle_noise(self, problem: Problem, solution: Solution, stage: str, **others: Any) -> tuple[Problem, Solution]:
        """Solve again with the noise at the error that was reached, until both agree, where there are priors."""
        priors = any(p.prior is not None and not np.all(p.fixed) for p in problem.model.parameters.values())
        for _ in range(NOISE_ROUNDS if priors and self.options.noise is None else 0):
            error = rms_error(problem, solution)
            if abs(error / problem.noise - 1) < NOISE_AGREES or error == 0 or solution.status is Status.INTERRUPTED:
                break
            problem = self.problem(problem.model, error, **{**others, "engine": problem.engine})
            solution = self.solve(problem, stage, solution.theta)
        return problem, solution

    def at_rest(self) -> FitContext:
        """Return the context with recordings at rest where their initial state is to be estimated, if there are any."""
        if not any(r.begins == "estimate" for r in self.recordings):
            return self
        recordings = [r.with_(initial="zero") if r.begins == "estimate" else r for r in self.recordings]
        return replace(self, recordings=tuple(recordings))

    def agrees_with_rest(self, problem: Problem, theta: np.ndarray, correlated: float = 1.0) -> bool:
        """Whether the recordings agree with a beginning at rest, given the solution θ of the problem from rest.

        `correlated` is the number of residuals that count as one, because a model's errors change slowly.
        True also for problems that have initial states of their own. Only the states are freed, in a linearised step,
        which foretells the largest decrease of the cost.
        """
        if problem.size > int(problem.free.sum()) or not any(r.begins == "estimate" for r in self.recordings):
            return True
        freed = self.problem(problem.model, engine=problem.engine, constraints=())
        n_free = int(freed.free.sum())
        _, gradient, hessian = freed.normal(np.concatenate([theta, freed.start[n_free:]]))
        cost = 0.5 * float(np.mean(problem.residual(theta) ** 2))
        if not np.isfinite(cost) or cost == 0:
            return True
        slope, curvature = gradient[n_free:], hessian[n_free:, n_free:]
        if not len(slope):
            return True
        decrease = 0.5 * float(slope @ np.linalg.lstsq(curvature, slope, rcond=None)[0])
        left = max(1 - decrease / cost, np.finfo(float).tiny)
        independent = max(freed.residuals / correlated, 2.0)
        return bool(-independent * np.log(left) < len(slope) * np.log(independent))

    def result(
        self, model: Model, structure: PILFR | None, problem: Problem, solution: Solution, note: str = "", **fields: Any
    ) -> Fit:
        """Build the `Fit` of a solution; Ctrl-C waits until it is complete and shows in its status.

        `fields` are further fields of the `Fit`; `errors={}` spares the standard errors of what is no minimum.
        """
        found: list[Fit] = []
        try:
            with deferred_interrupt():
                found.append(self._result(model, structure, problem, exactly(problem, solution), note, fields))
            if self.progress:
                self.progress("standard errors", 1, 1, np.nan)
        except KeyboardInterrupt:
            if not found:
                raise
            return replace(found[0], solution=replace(found[0].solution, status=Status.INTERRUPTED))
        return found[0]

    def _result(
        self, model: Model, structure: PILFR | None, problem: Problem, solution: Solution, note: str, fields: Any
    ) -> Fit:
        """Build the `Fit`; its note also says what the recordings leave open.

        Where the search has put priors of its own (`PRIOR`) on weights and thresholds, neither the model nor the
        standard errors know of them.
        """
        fitted, judged, theta = with_solution(model, problem, solution), problem, solution.theta
        if note == PRIOR:
            priors = structure.priors if structure else {}
            own = {name: {"prior": priors.get(name)} for name in LAYER}
            fitted = fitted.with_parameters(fitted.parameters.change(**own))
            names = ("engine", "constraints", "noise", "scale", "weights")
            options: dict[str, Any] = {name: getattr(problem, name) for name in names}
            judged = Problem(fitted, problem.recordings, **options)
        nrmse = tuple(problem.nrmse(theta))
        if solution.status.converged and not max(nrmse) < DIVERGES * _nrmse_of_zero(problem):
            solution = replace(solution, status=Status.DIVERGES)
        notes = (
            note,
            describe_open_memory(judged, theta),
            describe_reached_gain(problem, theta),
            unbounded_sentence(
                structure, problem.constraints, problem.model.parameters.unpack(problem.parameters(theta))
            ),
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


def _nrmse_of_zero(problem: Problem) -> float:
    """Largest NRMSE of any output that a model without outputs has, at least 1."""
    return max(1.0, *(float(np.max(np.sqrt(np.mean(r.y**2, axis=0)) / problem.scale)) for r in problem.recordings))


def solve_within_bounds(
    problem: Problem,
    start: np.ndarray | None,
    solver: Any,
    stage: str = "solve",
    progress: Progress | None = None,
    last: GaussNewton = STEP,
    held: bool = False,
) -> Solution:
    """Solve a problem inside exact bounds on spectral radii, reporting the solver's steps (`within_bounds`).

    Parameters
    ----------
    problem, start, last, held
        See `within_bounds`; `last` gets the solver's limit on time.
    solver : object
        Has `solve(problem, start)`. Solvers of the package take a limit on time and report their steps.
    stage : str
        Name under which the steps are reported.
    progress : callable
        Gets (stage, step, largest number of steps, error).
    """
    start = problem.start if start is None else start
    if not isinstance(solver, GaussNewton | Ipopt):
        return within_bounds(problem, start, solver.solve, last, held)
    report, last = (
        report_iterations(progress, stage, solver.max_iterations),
        replace(last, time_limit=solver.time_limit),
    )
    return within_bounds(problem, start, lambda p, s: solver.solve(p, s, report), last, held, report)


def report_iterations(progress: Progress | None, stage: str, most: int) -> Callable[[Iteration], None] | None:
    """Turn a progress function into one of a solver's iterations, which reports the error that a cost stands for."""
    if progress is None:
        return None
    return lambda i: progress(stage, min(i.number, most), most, float(np.sqrt(2 * max(i.cost, 0.0))))


def context_of_fit(
    fit: Fit,
    train: Recording | Sequence[Recording],
    *,
    solver: Any,
    stable: bool | float | None = None,
    constraints: Any = None,
    noise: float | str | None = None,
    weights: Any = None,
    engine: str = "auto",
) -> FitContext:
    """Context of a fit made from an earlier one, whose options hold where no others are given."""
    recordings = as_recordings(train)
    options = fit.options.updated(stable, constraints, noise, weights, recordings)
    return FitContext(recordings, solver, options.all_constraints(fit.structure), engine=engine, options=options)


def mark_interrupted(model: Model, problem: Problem, solution: Solution, note: str) -> Stage:
    """Return the stage with its solution marked as interrupted."""
    return model, problem, replace(solution, status=Status.INTERRUPTED), note


def rms_error(problem: Problem, solution: Solution) -> float:
    """Root mean square of the normalised residuals."""
    e = problem.residual(solution.theta)
    return float(np.sqrt(np.mean(e**2)))
