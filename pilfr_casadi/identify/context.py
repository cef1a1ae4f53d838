"""The context of one fit: recordings, solver and options, and the solves that every way to a fit makes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from .._base import Progress, deferred_interrupt
from ..data import Recording, as_recordings
from ..models import PILFR, Model
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
    within_bounds,
)
from .options import Asked
from .result import Fit, outcome

Stage = tuple[Model, Problem, Solution, str]  # model, problem, solution, note
LAST = GaussNewton()  # at a bound on a radius, where another solver is asked for
ROUNDS, AGREE = 5, 0.05  # of noise estimates: how many at most, and the relative change that ends them


@dataclass(frozen=True, eq=False)
class Job:
    """What the ways to a fit share."""

    recordings: tuple[Recording, ...]
    solver: Any
    limits: tuple[Constraint, ...]
    l1: dict[str, float]
    engine: str
    progress: Progress | None
    threads: int = 1
    asked: Asked = Asked()  # noqa: RUF009  (frozen)
    began: float = field(default_factory=time.perf_counter)

    @cached_property
    def weights(self) -> np.ndarray | None:
        """Weight of each recording, or None."""
        return self.asked.weights_of(self.recordings)

    def problem(self, model: Model, noise: float = 1.0, **options: Any) -> Problem:
        """The simulation-error problem of a model."""
        given: dict[str, Any] = {"constraints": self.limits, "noise": self.asked.noise or noise, "engine": self.engine}
        given |= {"weights": self.weights, "threads": self.threads, **options}
        return Problem(model, self.recordings, **given)

    def settled(self, problem: Problem, solution: Solution, stage: str, **options: Any) -> tuple[Problem, Solution]:
        """Problem and solution with the noise at the error that is reached, where priors are weighed against it."""
        priors = any(p.prior is not None and not np.all(p.fixed) for p in problem.model.parameters.values())
        for _ in range(ROUNDS if priors and self.asked.noise is None else 0):
            error = rms_error(problem, solution)
            if abs(error / problem.noise - 1) < AGREE or error == 0 or solution.status is Status.INTERRUPTED:
                break
            problem = self.problem(problem.model, error, **{**options, "engine": problem.engine})
            solution = self.solve(problem, stage, solution.theta)
        return problem, solution

    def solve(self, problem: Problem, stage: str, start: np.ndarray | None = None) -> Solution:
        """The solver's solution; those of the package report their iterations.

        Where it leaves an exact bound on a spectral radius, the bound is tightened (`spectral_radius`).
        """
        if not isinstance(self.solver, GaussNewton | Ipopt):
            solution: Solution = self.solver.solve(problem, start)
            return solution
        last = self.solver if isinstance(self.solver, GaussNewton) else LAST
        return solve_inside(problem, start, self.solver, stage, self.progress, last)

    def result(self, model: Model, structure: PILFR | None, problem: Problem, solution: Solution, **more: Any) -> Fit:
        """What a solution of a problem amounts to; Ctrl-C waits until it is known, and is told by the status."""
        found: list[Fit] = []
        given = {"engine": self.engine, "asked": self.asked, **more}
        try:
            with deferred_interrupt():
                solution = exactly(problem, solution)
                found.append(outcome(model, structure, problem, solution, self.began, self.recordings, **given))
            if self.progress:
                self.progress("standard errors", 1, 1, np.nan)
        except KeyboardInterrupt:
            if not found:
                raise
            return replace(found[0], solution=replace(solution, status=Status.INTERRUPTED))
        return found[0]


def following(
    fit: Fit,
    train: Recording | Sequence[Recording],
    *,
    solver: Any,
    stable: bool | float | None = None,
    constraints: Any = None,
    noise: float | str | None = None,
    weights: Any = None,
    engine: str = "auto",
) -> Job:
    """The job of what is made from a fit: what that was asked with holds, where nothing else is given."""
    recordings = as_recordings(train)
    asked = fit.asked.but(stable, constraints, noise, weights, recordings)
    return Job(recordings, solver, asked.limits(fit.structure), {}, engine, None, asked=asked)


def interrupted(model: Model, problem: Problem, solution: Solution, note: str) -> Stage:
    """The same, its solution marked as interrupted."""
    return model, problem, replace(solution, status=Status.INTERRUPTED), note


def rms_error(problem: Problem, solution: Solution) -> float:
    """Root mean square of the normalised residuals."""
    e = problem.residual(solution.theta)
    return float(np.sqrt(np.mean(e**2)))


def solve_inside(
    problem: Problem,
    start: np.ndarray | None,
    solver: Any,
    stage: str,
    progress: Progress | None,
    last: GaussNewton = STEP,
    held: bool = False,
) -> Solution:
    """The solution of a solver, of the package or a user's, inside exact bounds on spectral radii (`spectral_radius`).

    Parameters
    ----------
    problem, start, last, held
        See `within_bounds`; `last` gets the solver's limit on time.
    solver : object
        With `solve(problem, start)`. Those of the package take a limit on time, and tell their steps.
    stage : str
        What the steps are told as.
    progress : callable
        Gets (stage, step, largest number of steps, error).
    """
    start = problem.start if start is None else start
    if not isinstance(solver, GaussNewton | Ipopt):
        return within_bounds(problem, start, solver.solve, last, held)
    report, last = iterations(progress, stage, solver.max_iterations), replace(last, time_limit=solver.time_limit)
    return within_bounds(problem, start, lambda p, s: solver.solve(p, s, report), last, held, report)


def iterations(progress: Progress | None, stage: str, most: int) -> Callable[[Iteration], None] | None:
    """A solver's progress function that reports iterations as a stage, with the error that their cost stands for."""
    if progress is None:
        return None
    return lambda i: progress(stage, min(i.number, most), most, float(np.sqrt(2 * max(i.cost, 0.0))))
