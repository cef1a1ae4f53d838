"""The cheapest feasible point of a run, and whether the run has strayed from it.

An exact penalty `μ Σ violation` is exact only nearby: a run may stray to where violating the constraints pays, and
where no linear step leads back. No such point is better than the best feasible one for a penalty of

    μ > max (cost of the best - cost) / violation.
"""

from __future__ import annotations

import numpy as np

from .constraints import TOLERATED


class Feasible:
    """Remembers the feasible point of the smallest cost, and how much straying would pay.

    Parameters
    ----------
    tolerance : float
        Share of its cost by which another feasible point has to be dearer to be worse.
    """

    def __init__(self, tolerance: float) -> None:
        self.tolerance, self.cost, self.tempting = tolerance, np.inf, 0.0
        self.theta = self.multipliers = np.zeros(0)

    def see(self, cost: float, violation: float, theta: np.ndarray, multipliers: np.ndarray) -> None:
        """Remember a point, its summed violation in units of the constraints."""
        if violation > TOLERATED:
            self.tempting = max(self.tempting, (self.cost - cost) / violation if np.isfinite(self.cost) else 0.0)
        elif cost < self.cost:
            self.cost, self.theta, self.multipliers = cost, theta, multipliers

    def better(self, cost: float, violation: float) -> bool:
        """Whether the best feasible point beats one of this cost and violation."""
        return bool(np.isfinite(self.cost)) and (violation > TOLERATED or cost > self.cost * (1.0 + self.tolerance))
