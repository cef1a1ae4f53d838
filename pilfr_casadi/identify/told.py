"""A solve as the ways to a fit make it: inside exact bounds on spectral radii, and with its steps told."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from .._base import Progress
from ..optimise import STEP, GaussNewton, Ipopt, Iteration, Problem, Solution, within_bounds
from .gauge_cost import costless


def solve_inside(
    problem: Problem,
    start: np.ndarray | None,
    solver: Any,
    stage: str,
    progress: Progress | None,
    last: GaussNewton = STEP,
    held: bool = False,
) -> Solution:
    """The solution of a solver, of the package or a user's, inside exact bounds on spectral radii (`tightening`).

    It begins where the start meets constraints that cost nothing (`costless`).

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
    start = costless(problem, problem.start if start is None else start)
    if not isinstance(solver, GaussNewton | Ipopt):
        return within_bounds(problem, start, solver.solve, last, held)
    report, last = iterations(progress, stage, solver.max_iterations), replace(last, time_limit=solver.time_limit)
    return within_bounds(problem, start, lambda p, s: solver.solve(p, s, report), last, held, report)


def iterations(progress: Progress | None, stage: str, most: int) -> Callable[[Iteration], None] | None:
    """A solver's progress function that reports iterations as a stage, with the error that their cost stands for."""
    if progress is None:
        return None
    return lambda i: progress(stage, min(i.number, most), most, float(np.sqrt(2 * max(i.cost, 0.0))))
