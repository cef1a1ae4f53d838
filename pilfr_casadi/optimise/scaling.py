"""A problem in variables and units that a solver with absolute tolerances can work in.

    x = s θ,    F(x) = cost(x / s) / cost(θ_0),    G(x) = g(x / s) / u

s are the column norms of the Jacobian, divided by the root of the first cost: a unit of any variable changes the
residuals by about their own size. u are the largest entries of each row of ∇g. So results do not depend on the units
of anything. At the usual start (`B_w = 0`, Krikelis et al. (2024), Eq. 24) whole columns vanish; norms are therefore
taken at the start and after one damped Gauss-Newton step from it, whichever is larger.
"""

from __future__ import annotations

from functools import cached_property

import casadi as ca
import numpy as np

from .damping import Point
from .problem import Problem


class Scaled:
    """The scaled problem.

    Parameters
    ----------
    problem : Problem
        What is scaled.
    start : array, shape (n,)
        Where, inside the bounds and with a finite cost.
    damping : float
        λ of the step; raised until the step lowers the cost.

    Raises
    ------
    FloatingPointError
        If the derivatives at the start are not finite.
    """

    def __init__(self, problem: Problem, start: np.ndarray, damping: float) -> None:
        self.problem, self.damping = problem, damping
        cost, g, h = problem.normal(start)
        squares = np.diag(h).copy()
        if not (np.all(np.isfinite(h)) and np.all(np.isfinite(g))):
            raise FloatingPointError("the derivatives at the start are not finite")
        unit, trial = 1.0 / np.sqrt(np.where(squares > 0, squares, 1.0)), start
        for _ in range(20):
            step = -unit * np.linalg.solve(h * unit * unit[:, None] + self.damping * np.eye(len(g)), g * unit)
            trial = np.clip(start + step, problem.lower, problem.upper)
            there = np.diag(problem.normal(trial)[2]) if problem.cost(trial) <= cost else np.full(len(g), np.nan)
            if np.all(np.isfinite(there)):
                squares = np.maximum(squares, there)
                break
            self.damping *= 4.0
        self.unit = cost if cost > 0 else 1.0
        self.s = np.sqrt(_filled(squares, problem.labels, start, self.unit) / self.unit)
        rows = np.max(np.abs(problem.constraint_jacobian(trial) / self.s), axis=1, initial=0.0)
        self.g_unit = np.where(rows > 0, rows, 1.0)
        self.lower, self.upper = problem.lower * self.s, problem.upper * self.s
        self.g_lower, self.g_upper = problem.g_lower / self.g_unit, problem.g_upper / self.g_unit

    def theta(self, x: np.ndarray) -> np.ndarray:
        """θ at x, rounding taken back into the bounds."""
        return np.asarray(np.clip(x / self.s, self.problem.lower, self.problem.upper))

    def constraints(self, theta: np.ndarray) -> np.ndarray:
        """Scaled constraints G, shape (n_g,)."""
        return self.problem.constraint(theta) / self.g_unit if len(self.g_unit) else np.zeros(0)

    def slope(self, x: np.ndarray) -> np.ndarray:
        """Jacobian of G, shape (n_g, n)."""
        return self.problem.constraint_jacobian(self.theta(x)) / self.s / self.g_unit[:, None]

    def excess(self, g: np.ndarray) -> np.ndarray:
        """By how much G lies above (positive) or below (negative) its limits, shape (n_g,)."""
        return np.maximum(g - self.g_upper, 0.0) - np.maximum(self.g_lower - g, 0.0)

    def point(self, x: np.ndarray) -> Point:
        """Everything at x, with derivatives."""
        with np.errstate(all="ignore"):
            f, g, h = self.problem.normal(self.theta(x))
            scale = self.s * self.unit
            gradient, hessian = g / scale, h / scale / self.s[:, None]
        return Point(x, f / self.unit, gradient, hessian, self.constraints(self.theta(x)), self.slope(x))

    @cached_property
    def _weighted_curvature(self) -> ca.Function | None:
        """`(p, λ) -> ∇²(λ'g)` over the model's full parameter vector; None where the constraints are linear."""
        p, lam = ca.MX.sym("p", len(self.problem.free)), ca.MX.sym("lam", len(self.g_unit))
        h = ca.hessian(ca.dot(lam, self.problem.rows.function(p)), p)[0]
        return ca.Function("curvature", [p, lam], [ca.densify(h)], ["p", "lam"], ["hessian"]) if h.nnz() else None

    def curvature(self, x: np.ndarray, multipliers: np.ndarray) -> np.ndarray:
        """Hessian of the constraints weighted by their multipliers (n_g,), shape (n, n)."""
        h, free = np.zeros((len(x), len(x))), np.flatnonzero(self.problem.free)
        if self._weighted_curvature is not None:
            dense = np.asarray(
                self._weighted_curvature(self.problem.parameters(self.theta(x)), multipliers / self.g_unit)
            )
            s = self.s[: len(free)]
            h[: len(free), : len(free)] = dense[np.ix_(free, free)] / s / s[:, None]
        return h

    def multipliers(self, lam_x: np.ndarray, lam_g: np.ndarray) -> np.ndarray:
        """Multipliers of the bounds and constraints of the problem itself, shape (n + n_g,)."""
        return self.unit * np.concatenate([lam_x * self.s, lam_g / self.g_unit])


def _filled(squares: np.ndarray, labels: tuple[str, ...], start: np.ndarray, unit: float) -> np.ndarray:
    """Columns that vanish at both points get the norm of their like (idle thresholds), else one to fit their value."""
    names, out = np.array([label.split("[")[0] for label in labels]), squares.copy()
    for name in set(names[~(squares > 0)]):
        alike = names == name
        known, size = squares[alike & (squares > 0)], float(np.max(np.abs(start[alike])))
        out[alike & ~(squares > 0)] = np.median(known) if len(known) else unit / (size or 1.0) ** 2
    return out
