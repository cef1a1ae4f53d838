r"""Move a result inside its exact constraints where rounding has left it outside.

A solver meets constraints up to a tolerance. Where an exact one fails on the numbers of the result, the point is moved
by the smallest step, in the metric of the outputs, that meets it and keeps all others to first order:

    minimise  1/2 d'(H + λ D)d   subject to  lower <= θ + d <= upper,  lower_g + m <= g(θ) + ∇g d <= upper_g - m

with `H` the Gauss-Newton Hessian of the simulation error (Krikelis et al. 2024, Eq. 20) and a margin m on the exact
ones that doubles until every check holds in floating point. What is fixed stays fixed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..models import Neighbours
from .constraints import TOLERATED
from .gauss_newton import QuadraticProgram, without_rounding
from .problem import Problem
from .solution import Solution, Status

ROUNDS = 40  # steps with doubled margins, from `FIRST` to more than any constraint needs
FIRST = 1e-9  # margin of the first step, in units of a constraint


def beyond(problem: Problem, theta: np.ndarray) -> list[str]:
    """Return the names of the exact constraints that do not hold at the numbers θ."""
    if not any(c.exact for c in problem.constraints):
        return []
    g, names, at = problem.constraint(theta), [], 0
    values = problem.model.parameters.unpack(problem.parameters(theta))
    for c, size in zip(problem.constraints, problem.g_sizes, strict=True):
        part = slice(at, at + size)
        at += size
        if not c.exact:
            continue
        if c.check is not None:
            held = c.check(values) <= 0
        else:
            held = bool(np.all((g[part] >= problem.g_lower[part]) & (g[part] <= problem.g_upper[part])))
        if not held:
            names.append(c.name)
    return names


def missed(problem: Problem, theta: np.ndarray) -> np.ndarray:
    """Tell which constraints are violated beyond tolerance in their units at θ: (n_g,), bool."""
    g, unit = problem.constraint(theta), problem.constraint_units(theta)
    over = np.maximum(problem.g_lower - g, g - problem.g_upper)
    return ~np.asarray(over <= TOLERATED * np.where(unit > 0, unit, 1.0))


def _far(problem: Problem, theta: np.ndarray, unit: np.ndarray) -> bool:
    """Whether a constraint is violated by more than its unit, so that the step has led astray."""
    g = problem.constraint(theta)
    return bool(np.any(np.maximum(problem.g_lower - g, g - problem.g_upper) > unit))


def exactly(problem: Problem, solution: Solution) -> Solution:
    """Move a solution inside its exact constraints; its status is infeasible where no small step does it."""
    theta = solution.theta
    if solution.status is Status.INFEASIBLE or not np.isfinite(solution.cost) or not beyond(problem, theta):
        return solution
    exact = np.repeat([c.exact for c in problem.constraints], problem.g_sizes)
    hessian = problem.normal(theta)[2]
    floor = without_rounding(np.diag(hessian), theta, Neighbours(problem.labels))
    unit = problem.constraint_units(theta, floor)
    unit = np.where(unit > 0, unit, 1.0)
    damped = hessian + 1e-6 * np.diag(floor)
    damped += np.diag(np.where(np.diag(damped) > 0, 0.0, 1.0))
    qp, margin = QuadraticProgram(problem.size, len(unit), "daqp"), FIRST
    for _ in range(ROUNDS):
        g = problem.constraint(theta)
        room = np.where(exact, np.minimum(margin * unit, 0.25 * (problem.g_upper - problem.g_lower)), 0.0)
        d, _, good = qp(
            damped,
            np.zeros(problem.size),
            problem.lower - theta,
            problem.upper - theta,
            problem.constraint_jacobian(theta),
            problem.g_lower + room - g,
            problem.g_upper - room - g,
        )
        trial = np.clip(theta + d, problem.lower, problem.upper)
        if not good or not np.all(np.isfinite(problem.constraint(trial))) or _far(problem, trial, unit):
            break
        theta = trial
        if not beyond(problem, theta):
            break
        margin *= 2.0
    cost, g = problem.cost(theta), problem.constraint(theta)
    over = np.maximum(np.maximum(problem.g_lower - g, g - problem.g_upper), 0.0)
    if beyond(problem, theta) or not np.isfinite(cost) or np.any(over > TOLERATED * unit):
        failed = Status.INFEASIBLE if solution.status.converged else solution.status
        return replace(solution, status=failed)
    return replace(solution, theta=theta, cost=cost, violation=float(np.max(over, initial=0.0)))
