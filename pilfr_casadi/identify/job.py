"""What the ways to a fit share: recordings, solver and options, and the stages that follow a first solution."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from .._base import Progress, deferred_interrupt
from ..data import Recording, as_recordings
from ..models import PILFR, Model
from ..optimise import Constraint, GaussNewton, Ipopt, Problem, Solution, Status, exactly
from .options import Asked
from .outcome import outcome, with_solution
from .penalty import element_alone, merged, restored, sentence, unit_weights, without_idle
from .result import Fit
from .search import Search
from .start import Blocks
from .told import solve_inside

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
    def _weights(self) -> np.ndarray | None:
        return self.asked.weights_of(self.recordings)

    def problem(self, model: Model, noise: float = 1.0, **options: Any) -> Problem:
        """The simulation-error problem of a model."""
        given: dict[str, Any] = {"constraints": self.limits, "noise": self.asked.noise or noise, "engine": self.engine}
        given |= {"weights": self._weights, "threads": self.threads, **options}
        return Problem(model, self.recordings, **given)

    def search(self, structure: PILFR, linear: Blocks, **options: Any) -> Search:
        """What the tasks of a search for a structure share."""
        given = {"engine": self.engine, "noise": self.asked.noise, "weights": self._weights, **options}
        return Search(structure, self.recordings, linear, self.solver, self.limits, **given)

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

        Where it leaves an exact bound on a spectral radius, the bound is tightened (`tightening`).
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


def penalised(model: Model, problem: Problem, solution: Solution, job: Job, noise: float) -> Stage:
    """The model, problem and solution with the L1 penalty, from the solution without, and a note; see `penalty`."""
    if solution.status is Status.INTERRUPTED:
        return model, problem, solution, "interrupted before the L1 penalty was applied"
    found = unit_weights(with_solution(model, problem, solution))
    states = solution.theta[int(problem.free.sum()) :]
    options: dict[str, Any] = {"engine": problem.engine, "l1": job.l1}
    whole, held = (job.problem(m, noise, **options) for m in (found, element_alone(found, job.l1)))
    begin = merged(held, np.concatenate([held.start[: int(held.free.sum())], states]))
    states = begin[int(held.free.sum()) :]
    last = without_idle(held.model.with_parameters(held.model.parameters.at(held.parameters(begin))))
    if np.any(last.parameters.free):
        held = job.problem(last, noise, **options)
    begin = np.concatenate([held.start[: int(held.free.sum())], states])
    result = restored(job.solve(held, "L1 penalty", begin), held, whole)
    return found, whole, result, sentence(with_solution(found, whole, result), job.l1)
