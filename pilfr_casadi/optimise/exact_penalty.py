"""General constraints in units of their own, and the exact penalty `μ Σ violation` by which steps are judged.

The weight μ follows the multipliers by Powell's rule (1978): 1.5 times the largest, or half-way down to that from what
it was. A weight that only grows keeps what far-off multipliers asked for, and crawls.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .constraints import TOLERATED

if TYPE_CHECKING:
    from .lifted import Lifted
    from .problem import Problem

SHRUNK = 1e-2  # share of its first unit below which a constraint's unit is taken anew


class ExactPenalty:
    """The constraints of a problem, measured where each first has a slope, and where a run ends (`shrink`).

    Attributes
    ----------
    unit : numpy.ndarray
        Shape (n_g,), see `Problem.constraint_units`.
    weight, least : float
        μ, and what it never falls below.
    """

    def __init__(self, problem: Problem | Lifted) -> None:
        self.problem, n_g = problem, len(problem.g_lower)
        self.unit, self._known = np.ones(n_g), np.zeros(n_g, dtype=bool)
        self.weight, self.least = 0.0, 0.0

    def measure(self, theta: np.ndarray, squares: np.ndarray) -> None:
        """Take the units of what has a slope at θ and had none before."""
        if not np.all(self._known):
            unit = self.problem.constraint_units(theta, squares)
            first = ~self._known & (unit > 0)
            self.unit[first], self._known[first] = unit[first], True

    def shrink(self, theta: np.ndarray) -> bool:
        """Take units at θ that are far smaller than they were; whether these alone tell of a violation.

        Where a constraint has a pole nearby, such as a gain beside an integrator, its first unit may be immense.
        """
        if not len(self.unit):
            return False
        unit, before = self.problem.constraint_units(theta), self.violations(theta)
        smaller = self._known & (unit > 0) & (unit < SHRUNK * self.unit)
        self.unit = np.where(smaller, unit, self.unit)
        return bool(np.any((before <= TOLERATED) & (self.violations(theta) > TOLERATED)))

    def values(self, theta: np.ndarray) -> np.ndarray:
        """The constraints in their units, shape (n_g,)."""
        return self.problem.constraint(theta) / self.unit if len(self.unit) else np.zeros(0)

    def slope(self, theta: np.ndarray) -> np.ndarray:
        """Their Jacobian, shape (n_g, n)."""
        return self.problem.constraint_jacobian(theta) / self.unit[:, None]

    def room(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far it is from values to the lower limits and to the upper ones, (n_g,) each."""
        return self.problem.g_lower / self.unit - values, self.problem.g_upper / self.unit - values

    def violations(self, theta: np.ndarray) -> np.ndarray:
        """Violation of each constraint in its unit, shape (n_g,); infinite where it has no value."""
        if not len(self.unit):
            return np.zeros(0)
        low, high = self.room(self.values(theta))
        over = np.maximum(np.maximum(low, -high), 0.0)
        return np.where(np.isnan(over), np.inf, over)

    def violation(self, theta: np.ndarray) -> float:
        """Their sum."""
        return float(self.violations(theta).sum())

    def follow(self, multipliers: np.ndarray) -> None:
        """Let the weight follow the constraints' multipliers (n_g,)."""
        if len(multipliers):
            needed = 1.5 * float(np.max(np.abs(multipliers)))
            self.weight = max(needed, 0.5 * (self.weight + needed), self.least)

    def raise_to(self, weight: float) -> None:
        """Set the weight, and let it never fall below; at least twice what that was."""
        self.weight = self.least = max(weight, 2.0 * self.least)
