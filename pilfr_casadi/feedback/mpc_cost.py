"""The cost of a plan: deviations from the reference, changes of the inputs, the worst violation of an output limit."""

from __future__ import annotations

import numpy as np

from .asked import Asked

Array = np.ndarray
PENALTY = 30.0  # of a violated output limit, per y_scale


class Cost:
    """`Σ |(y_k - r_k) / y_scale|² + move |(u_k - u_{k-1}) / u_scale|² + 30 s / y_scale` of a task.

    Attributes
    ----------
    differences, weighted : array, shape (N n_u, N n_u)
        Inputs to their changes, plain and as they count.
    penalty : float
        Of the slack, in units of y_scale.
    """

    def __init__(self, task: Asked) -> None:
        n_u = task.function.size1_in(1)
        self.task, self.penalty = task, PENALTY
        self.differences = np.eye(task.horizon * n_u) - np.eye(task.horizon * n_u, k=-n_u)
        self.weighted = np.sqrt(task.move) * self.differences / task.u_scale[:, None]
        self._root = np.abs(np.diag(self.weighted))

    def __call__(self, u: Array, y: Array, wanted: Array, before: Array) -> float:
        """Cost of inputs u and outputs y, sample by sample."""
        moves, scale = self.weighted @ u - self.moved(before), self.task.y_scale
        over = self._beyond(y) / scale
        return float(np.sum(((y - wanted) / scale) ** 2) + np.sum(moves**2) + self.penalty * np.max(over, initial=0.0))

    def offset(self, before: Array) -> Array:
        """What the previous input contributes to the changes."""
        return np.concatenate([before, np.zeros(len(self._root) - len(before))])

    def moved(self, before: Array) -> Array:
        """What the previous input contributes to the weighted changes."""
        return np.asarray(self.offset(before) * self._root)

    def over(self, y: Array) -> float:
        """How far the outputs are beyond their limits at most."""
        return float(np.max(self._beyond(y), initial=0.0))

    def _beyond(self, y: Array) -> Array:
        return np.maximum(0, np.maximum(self.task.low_y - y, y - self.task.high_y))
