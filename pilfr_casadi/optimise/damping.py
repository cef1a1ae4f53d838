"""A damped Gauss-Newton Hessian for a solver that does its own line search.

    ∇²L ≈ H + λ D,    D = largest diag H so far (Marquardt 1963; Moré 1978).

With λ = 0 a state space, which is over-parametrised, takes steps of no use, and columns that vanish make H singular.
λ follows how well the last step was foretold (Nielsen 1999). What the Hessian foretells is the Lagrangian, so the
curvature of constraints, which H leaves out, counts as a miss and raises λ as well; without this, iterates cycle along
curved constraints. Where the line search had to shorten a step, λ grows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..models import Neighbours

ROUNDING = 1e-20  # squares of columns that are rounding
NONE = 1e-100  # size of a variable that is none: what is left of one that was driven to zero


def without_rounding(squares: np.ndarray, theta: np.ndarray, neighbours: Neighbours) -> np.ndarray:
    """Squared column norms (n,) in which those that are zero or rounding are replaced.

    A column is rounding where it is so next to the others of its matrix, and a change of its variable by the variable's
    size changes the outputs by nothing: a state that nothing excites. It gets the norm with which that change would
    change the outputs by their own size; what rounding says about the variable is then damped away.
    """
    size = neighbours.sizes(theta)
    idle = (squares <= ROUNDING * neighbours.largest(squares)) & (squares * size**2 <= ROUNDING)
    return np.asarray(np.where(idle, 1.0 / np.where(size > NONE, size, 1.0) ** 2, squares))


@dataclass(frozen=True, eq=False)
class Point:
    """A point x (n,): objective, its gradient (n,) and Gauss-Newton Hessian (n, n), constraints (n_g,) and Jacobian."""

    x: np.ndarray
    value: float
    gradient: np.ndarray
    hessian: np.ndarray
    constraints: np.ndarray
    slope: np.ndarray


class Damping:
    """λ, and what is needed to judge the next step.

    Parameters
    ----------
    first : float
        λ of the first Hessian.
    size : int
        Number of variables n.
    """

    def __init__(self, first: float, size: int) -> None:
        self.value, self.growth, self.largest = first, 2.0, np.zeros(size)
        self.before: Point | None = None
        self.damped = np.zeros((size, size))

    def hessian(self, point: Point, multipliers: np.ndarray, trials: int) -> np.ndarray:
        """`H + λ D` at a new iterate, reached after `trials` evaluations; multipliers (n_g,) of the constraints."""
        if self.before is not None and np.any(point.x != self.before.x):
            if trials > 1:
                self.value *= min(4.0 ** (trials - 1), 100.0)
            else:
                self._follow(self._ratio(self.before, point, multipliers))
            self.value = min(max(self.value, 1e-12), 1e12)
        self.largest = np.maximum(self.largest, np.diag(point.hessian))
        # the variables are scaled: next to 1, what is less has been zero or rounding so far
        self.damped = point.hessian + self.value * np.diag(np.where(self.largest > ROUNDING, self.largest, 1.0))
        self.before = point
        return self.damped

    def _ratio(self, before: Point, after: Point, multipliers: np.ndarray) -> float:
        """1 + (gain - foretold gain) / scale; the gain ratio, where bounds and constraints do not bend the step."""
        d = after.x - before.x
        curvature = 0.5 * float(d @ before.hessian @ d)
        foretold = float((before.gradient + multipliers @ before.slope) @ d) + curvature
        change = after.value - before.value + float(multipliers @ (after.constraints - before.constraints))
        return 1.0 + (foretold - change) / max(float(d @ self.damped @ d) - curvature, 1e-300)

    def _follow(self, ratio: float) -> None:
        if ratio < 1e-4:
            self.value, self.growth = self.value * self.growth, 2.0 * self.growth
        else:
            self.value, self.growth = self.value * max(1 / 3, 1.0 - (2.0 * min(ratio, 1.0) - 1.0) ** 3), 2.0
