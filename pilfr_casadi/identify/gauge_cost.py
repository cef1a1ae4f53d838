r"""A start moved to where it meets the constraints, along what changes no output.

The numbers of a PI-LFR may change in many ways that change nothing else (`orbit`): `w` may be halved where `B_w` is
doubled. Constraints on such numbers, `Σ w <= 0.1`, cost nothing, but a solver that starts where they are violated
leaves by linear steps, of which no two scales agree, and loses the minimum that it came from. So the start is led along
the orbit first,

    θ' = Σ_k c_k t_k(θ),    minimise |c|²  subject to  lower_g <= g + ∇g T c <= upper_g,

with the tangents `t_k` of the orbit at θ that move nothing fixed, in small steps (Runge-Kutta of the fourth order). It
stays where it was if that does not meet the constraints, or changes the objective: priors and bounds have their say.
"""

from __future__ import annotations

import numpy as np

from ..models import BLOCKS, PILFR
from ..optimise import Problem, QuadraticProgram, missed
from .gauge import null_space, orbit_tangents

Array = np.ndarray
STEP = 0.1  # of a step along the orbit: a scale changes by about this share
STEPS = 200
SAME = 1e-3  # share of the objective that rounding and bounds may cost
NO_SLOPE = 1e-9  # share of a constraint's slope along the orbit that is rounding


def costless(problem: Problem, theta: Array) -> Array:
    """The start, or where the same model meets the constraints."""
    parameters = problem.model.parameters
    if not len(problem.g_lower) or problem.model.element is None or not set(BLOCKS) <= set(parameters):
        return theta
    structure = PILFR(problem.model.n_x, problem.model.element)
    moved, over = theta, _over(problem, theta)
    if not over:
        return theta
    for _ in range(STEPS):
        c = _direction(problem, moved, structure) if np.any(missed(problem, moved)) else None
        if c is None:
            break
        there = _flow(problem, moved, structure, c)
        left = _over(problem, there)
        if not left < over:
            break
        moved, over = there, left
    if moved is theta or np.any(missed(problem, moved)):
        return theta
    return moved if problem.cost(moved) <= (1 + SAME) * problem.cost(theta) else theta


def _over(problem: Problem, theta: Array) -> float:
    """By how much the constraints are violated in all."""
    g = problem.constraint(theta)
    return float(np.sum(np.maximum(np.maximum(problem.g_lower - g, g - problem.g_upper), 0.0)))


def _direction(problem: Problem, theta: Array, structure: PILFR) -> Array | None:
    """The least coefficients (k,) of the tangents that meet the constraints to first order, cut to a step; or None."""
    inside, outside = orbit_tangents(problem, theta, structure)
    free = null_space(outside)
    jac, tangents = problem.constraint_jacobian(theta), inside @ free
    slope, size = jac @ tangents, np.linalg.norm(jac, axis=1) * np.linalg.norm(tangents)
    moves = np.max(np.abs(slope), axis=1, initial=0.0) > NO_SLOPE * size
    if not np.any(moves) or not np.all(np.isfinite(slope)):
        return None
    g, slope = problem.constraint(theta)[moves], slope[moves]
    n = slope.shape[1]
    none = np.full(n, np.inf)
    program = QuadraticProgram(n, len(slope), "daqp")
    low, high = problem.g_lower[moves] - g, problem.g_upper[moves] - g
    a, _, found = program(np.eye(n), np.zeros(n), -none, none, slope, low, high)
    c = free @ a
    return c * min(1.0, STEP / np.max(np.abs(c))) if found and np.any(c) else None


def _flow(problem: Problem, theta: Array, structure: PILFR, c: Array) -> Array:
    """Where the flow along the tangents leads, coefficients held."""

    def rate(at: Array) -> Array:
        return np.asarray(orbit_tangents(problem, at, structure)[0] @ c)

    k1 = rate(theta)
    k2 = rate(theta + 0.5 * k1)
    k3 = rate(theta + 0.5 * k2)
    k4 = rate(theta + k3)
    return np.clip(theta + (k1 + 2 * k2 + 2 * k3 + k4) / 6, problem.lower, problem.upper)
