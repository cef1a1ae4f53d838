"""The cost of a plan: deviations from the reference, changes of the inputs, violated output limits.

Each violation is paid for where it is, at its sample and output: one that cannot be avoided gives no leave to another.
The price is exact, a limit being kept where that is possible: a reference beyond a limit by e y_scale pulls with no
more than 2 e a sample, so it is 30, or 30 e where e is larger than one.
"""

from __future__ import annotations

import numpy as np

from .asked import Asked

Array = np.ndarray
PENALTY = 30.0  # of a violated output limit, per y_scale
KEPT = 1e-5  # of y_scale: a smaller violation is none


class Cost:
    """`Σ |(y_k - r_k) / y_scale|² + move |(u_k - u_{k-1}) / u_scale|² + price s_k / y_scale` of a task.

    Attributes
    ----------
    differences, weighted : array, shape (N n_u, N n_u)
        Inputs to their changes, plain and as they count.
    """

    def __init__(self, task: Asked) -> None:
        n_u = task.function.size1_in(1)
        self.task = task
        self.differences = np.eye(task.horizon * n_u) - np.eye(task.horizon * n_u, k=-n_u)
        self.weighted = np.sqrt(task.move) * self.differences / task.u_scale[:, None]
        self._root = np.abs(np.diag(self.weighted))

    def __call__(self, u: Array, y: Array, wanted: Array, before: Array) -> float:
        """Cost of inputs u and outputs y, sample by sample."""
        with np.errstate(over="ignore", invalid="ignore"):
            moves, error = self.weighted @ u - self.moved(before), (y - wanted) / self.task.y_scale
            value = float(error @ error + moves @ moves)
            if self.task.limited:
                value += self.price(wanted) * float(np.sum(self._beyond(y) / self.task.y_scale))
        return value

    def price(self, wanted: Array) -> float:
        """Of a violated output limit, per y_scale."""
        return price_of(self._beyond(wanted) / self.task.y_scale)

    def offset(self, before: Array) -> Array:
        """What the previous input contributes to the changes."""
        return np.concatenate([before, np.zeros(len(self._root) - len(before))])

    def moved(self, before: Array) -> Array:
        """What the previous input contributes to the weighted changes."""
        return np.asarray(self.offset(before) * self._root)

    def over(self, y: Array) -> float:
        """How far the outputs are beyond their limits at most; what a solver's tolerance leaves is nothing."""
        beyond = self._beyond(y)
        return float(np.max(beyond[beyond > KEPT * self.task.y_scale], initial=0.0))

    def _beyond(self, y: Array) -> Array:
        return np.maximum(0, np.maximum(self.task.low_y - y, y - self.task.high_y))


def price_of(beyond: Array) -> float:
    """Price of a violated limit where a reference is beyond the limits by so many y_scale."""
    return PENALTY * max(1.0, float(np.max(beyond, initial=0.0)))
