"""Predictive control with the states eliminated: Gauss-Newton steps from a dense QP.

Between kinks the model is linear in x and u, so a step that crosses none ends in the optimum of its piece. Where no
share of a step lowers the cost as promised, a kink is in between, and the slopes of this side say nothing of the other:
the search then goes from piece to piece (`mpc_pieces`). A plan is called converged where the QP has next to nothing to
gain there, or no adjacent piece has.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ..arrays import Buffered
from ..recording import InputError
from .asked import Asked, within
from .mpc_cost import Cost
from .mpc_pieces import ARMIJO, GAIN, SHARES, Pieces
from .mpc_steps import At, Steps

Array = np.ndarray
CLOSE = 1e-5  # of u_scale: a smaller step ends the search
ENTERED = 6  # most pieces for each Gauss-Newton step


class GaussNewton:
    """Solves a task by `solve(x, wanted, before, u, rate, iterations)`."""

    def __init__(self, task: Asked, cost: Cost) -> None:
        self._task, self._cost = task, cost
        n, n_u = task.function.size1_in(0), task.function.size1_in(1)
        x, u = ca.SX.sym("x", n), ca.SX.sym("u", n_u * task.horizon)
        state, outputs = x, []
        for k in range(task.horizon):
            state, y = task.function(state, u[k * n_u : (k + 1) * n_u])
            outputs.append(y)
        stacked = ca.densify(ca.vertcat(*outputs))
        self._predict = Buffered(ca.Function("predict", [x, u], [stacked]))
        self._slopes = Buffered(ca.Function("slopes", [x, u], [stacked, ca.densify(ca.jacobian(stacked, u))]))
        self._steps = Steps(task, cost)
        try:
            pieces = Pieces(task, cost, self._predict)
        except InputError:  # an operation of which no pieces are known
            pieces = None
        self._pieces = pieces if pieces is not None and pieces.count else None

    def solve(
        self, x: Array, wanted: Array, before: Array, u: Array, rate: Array, iterations: int
    ) -> tuple[Array, Array, bool]:
        """Inputs, outputs, whether converged."""
        at = At(wanted, before, rate, u, *self._slopes(x, u))
        value = self._cost(u, at.y, wanted, before)
        for _ in range(iterations):
            step = self._steps(at)
            if step is None:
                return at.u, at.y, False
            expected = self._cost(at.u + step[0], at.y + at.jac @ step[0], wanted, before)
            gain = value - expected
            if gain <= GAIN * min(value, len(at.y)) or np.max(np.abs(step[0]) / self._task.u_scale) < CLOSE:
                return at.u, at.y, True
            for share in SHARES:
                u = within(self._task, at.u + share * step[0], before, rate)
                y = self._predict(x, u)[0]
                found = self._cost(u, y, wanted, before)
                if found < value - ARMIJO * share * gain:
                    break
            else:  # a kink in between
                break
            if share == 1.0 and abs(found - expected) <= GAIN * found:  # no kink in between
                return u, y, True
            value, at = found, At(wanted, before, rate, u, *self._slopes(x, u))
        if self._pieces is None:
            return at.u, at.y, False
        return self._pieces.solve(x, at, ENTERED * iterations)
