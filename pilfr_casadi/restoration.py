r"""A way back where a solver cannot meet an exact bound on the spectral radius.

Where eigenvalues meet, the radius has a kink, the powers that bound it (`constraints`) are steep, and a solver that
has left the feasible set may not find back. Scaling `A` and `B_w` by one factor scales every matrix of a PI-LFR whose
radius is bounded (Krikelis et al. 2024, Eq. 15, and the same with the element's slope), so a feasible point is known.
From there the problem is solved

1. with lower powers, `‖A^m‖^(1/m)` for m = 2^12 and 2^9, which bound the radius from further above, but smoothly;
2. with all that enters the radius held;

until one of them ends feasible; what is found is then improved under the tight bound, as far as that stays feasible.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from .constraints import BeyondRadius, LogRadius
from .exactness import beyond, exactly
from .problem import Problem
from .solution import Solution, Status

SQUARINGS = (12, 9)
ENTERING = ("A", "B_w", "C_z", "w")  # what enters the radius
Solve = Callable[[Problem, np.ndarray], Solution]


def restored_radius(problem: Problem, solution: Solution, solve: Solve) -> Solution:
    """A feasible solution in the place of one that misses an exact bound on the spectral radius, where there is one."""
    if solution.status is not Status.INFEASIBLE:
        return solution
    start = _scaled(problem, solution.theta)
    if start is None or not np.isfinite(problem.cost(start)):
        return solution
    for rough in _rougher(problem, start):
        found = exactly(problem, solve(rough, start))
        if found.status is Status.INTERRUPTED:
            return replace(solution, status=Status.INTERRUPTED)
        if found.status is Status.INFEASIBLE or beyond(problem, found.theta):
            continue
        better = exactly(problem, solve(problem, found.theta))
        if better.status.converged and not beyond(problem, better.theta) and better.cost <= found.cost:
            return better
        return replace(found, status=Status.RESTORED)
    return solution


def _scaled(problem: Problem, theta: np.ndarray) -> np.ndarray | None:
    """θ with A and B_w scaled to the bounds; None where none is exact, or A or B_w may not be scaled."""
    checks = [c.check for c in problem.constraints if isinstance(c.check, BeyondRadius)]
    parameters = problem.model.parameters
    names = [name for name in ("A", "B_w") if name in parameters and parameters[name].size]
    if not checks or any(np.any(parameters[k].fixed & (parameters[k].value != 0)) for k in names):
        return None
    values = parameters.unpack(problem.parameters(theta))
    share = min(0.999 * c.radius / max(c(values) + c.radius, 1e-300) for c in checks)
    scaled = {**values, **{k: min(share, 1.0) * values[k] for k in names}}
    n = int(problem.free.sum())
    start = np.concatenate([parameters.pack(scaled)[problem.free], theta[n:]])
    start = np.asarray(np.clip(start, problem.lower, problem.upper))
    inside = parameters.unpack(problem.parameters(start))
    return start if all(c(inside) <= 0 for c in checks) else None


def _rougher(problem: Problem, start: np.ndarray) -> Iterator[Problem]:
    """The problem with smoother bounds, then with what enters the radius held at the start."""

    def same(squarings: int | None) -> Problem:
        constraints = [
            replace(c, expression=LogRadius(c.expression.matrix, squarings))
            if isinstance(c.expression, LogRadius) and squarings
            else c
            for c in problem.constraints
        ]
        return Problem(
            problem.model,
            problem.recordings,
            engine=problem.engine,
            constraints=constraints,
            l1=problem.l1,
            noise=problem.noise,
            scale=problem.scale,
            weights=problem.weights,
            threads=problem.threads,
        )

    for squarings in SQUARINGS:
        yield same(squarings)
    held, labels = same(None), np.array([label.partition("[")[0] for label in problem.labels])
    where = np.isin(labels, ENTERING)
    held.lower, held.upper = np.where(where, start, held.lower), np.where(where, start, held.upper)
    yield held
