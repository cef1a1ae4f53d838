"""Predictive control with the states eliminated: Gauss-Newton steps from a dense QP.

Between kinks the model is linear in x and u, so a step that crosses none ends in the optimum of its piece. Where no
share of a step lowers the cost as promised, a kink is in between, and the slopes of this side say nothing of the other:
the search then goes from piece to piece (`mpc_pieces`). Among kinks there are many optima, so it is made from where the
steps led, from where they lead with the kinks rounded, and from the previous input held, and the best is taken. A plan
is called converged where the QP has next to nothing to gain there, or no adjacent piece has.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from .._base import InputError
from ..models import Buffered
from .asked import Asked, within
from .mpc_cost import Cost
from .mpc_pieces import ARMIJO, GAIN, SHARES, Pieces
from .mpc_rounding import rounded
from .mpc_steps import At, Steps

Array = np.ndarray
CLOSE = 1e-5  # of u_scale: a smaller step ends the search
ENTERED = 8  # most pieces for each Gauss-Newton step
ROUNDED = 0.1  # of y_scale, by which rounding may change the outputs


class GaussNewton:
    """Solves a task by `solve(x, wanted, before, u, rate, iterations)`."""

    def __init__(self, task: Asked, cost: Cost) -> None:
        self._task, self._cost, self._steps = task, cost, Steps(task, cost)
        self._exact = Prediction(task.function, task.horizon)
        try:
            pieces = Pieces(task, cost, self._exact.outputs)
        except InputError:  # an operation of which no pieces are known
            pieces = None
        self._pieces = pieces if pieces is not None and pieces.count else None
        function = rounded(task, ROUNDED) if self._pieces else None
        self._rounded = Prediction(function, task.horizon) if function is not None else None

    def solve(
        self, x: Array, wanted: Array, before: Array, u: Array, rate: Array, iterations: int
    ) -> tuple[Array, Array, bool]:
        """Inputs, outputs, whether converged."""
        begin = self._exact.at(x, At(wanted, before, rate, u, u, u))
        at, done = self._descend(self._exact, x, begin, iterations)
        if done or self._pieces is None:
            return at.u, at.y, done
        most = ENTERED * iterations
        best, most = self._pieces.solve(x, at, most)
        least = self._cost(*best[:2], wanted, before)
        for start in (self._smooth, self._held):
            u = start(x, begin, iterations)
            there = replace(begin, u=u, y=self._exact.outputs(x, u)[0])
            found, most = self._pieces.solve(x, there, most, least)
            cost = self._cost(*found[:2], wanted, before)
            best, least = (found, cost) if cost < least else (best, least)
            if not most:
                break
        return best

    def _smooth(self, x: Array, at: At, iterations: int) -> Array:
        """Where the steps lead with the kinks rounded."""
        if self._rounded is None:
            return at.u
        return self._descend(self._rounded, x, self._rounded.at(x, at), iterations)[0].u

    def _held(self, x: Array, at: At, iterations: int) -> Array:
        """The previous input."""
        return within(self._task, np.tile(at.before, self._task.horizon), at.before, at.rate)

    def _descend(self, prediction: Prediction, x: Array, at: At, iterations: int) -> tuple[At, bool]:
        """Steps until a kink is in the way, and whether there was none."""
        task, value = self._task, self._cost(at.u, at.y, at.wanted, at.before)
        for _ in range(iterations):
            step = self._steps(at)
            if step is None:
                return at, False
            expected = self._cost(at.u + step[0], at.y + at.jac @ step[0], at.wanted, at.before)
            gain = value - expected
            if gain <= GAIN * min(value, len(at.y)) or np.max(np.abs(step[0]) / task.u_scale) < CLOSE:
                return at, True
            for share in SHARES:
                u = within(task, at.u + share * step[0], at.before, at.rate)
                y = prediction.outputs(x, u)[0]
                found = self._cost(u, y, at.wanted, at.before)
                if found < value - ARMIJO * share * gain:
                    break
            else:
                return at, False
            if share == 1.0 and abs(found - expected) <= GAIN * found:  # no kink in between
                return replace(at, u=u, y=y), True
            value, at = found, prediction.at(x, replace(at, u=u))
        return at, False


class Prediction:
    """Outputs (N n_y,) over the horizon, and their slopes."""

    def __init__(self, function: ca.Function, horizon: int) -> None:
        n, n_u = function.size1_in(0), function.size1_in(1)
        x, u = ca.SX.sym("x", n), ca.SX.sym("u", n_u * horizon)
        state, outputs = x, []
        for k in range(horizon):
            state, y = function(state, u[k * n_u : (k + 1) * n_u])
            outputs.append(y)
        stacked = ca.densify(ca.vertcat(*outputs))
        self.outputs = Buffered(ca.Function("predict", [x, u], [stacked]))
        self._slopes = Buffered(ca.Function("slopes", [x, u], [stacked, ca.densify(ca.jacobian(stacked, u))]))

    def at(self, x: Array, at: At) -> At:
        """The same with outputs and slopes for its inputs."""
        y, jac = self._slopes(x, at.u)
        return replace(at, y=y, jac=jac)
