"""Predictive control: the inputs that let the predicted outputs follow a reference within limits.

    minimise   Σ |(y_k - r_k) / y_scale|² + move |(u_k - u_{k-1}) / u_scale|² + price · s_k / y_scale
    subject to low_u <= u_k <= high_u,   |u_k - u_{k-1}| <= rate,   low_y - s_k <= y_k <= high_y + s_k,   s_k >= 0,

over N samples from a state x with memory, s_k a slack for each output (`mpc_cost`). Two ways to solve it: `"sqp"`,
states eliminated, Gauss-Newton steps from a dense QP (`mpc_sqp`), warm-started by the shifted plan, fast enough for
sample times of a millisecond; and `"ipopt"`, multiple shooting with a variable for each state (`mpc_ipopt`), some 10 to
30 times slower. Kinks make the problem one of many pieces with local optima; SQP goes from piece to piece until none
that adjoins promises a lower cost (`mpc_pieces`): that is what converged means, an optimum nearby, not of all plans.
From 150 random states and inputs of a model with eight plays, far from one another, all first plans by either solver
converged, none by one was more than one percent worse than that by the other, and no random step lowered one by SQP by
more than 0.1 %. With several inputs and outputs behind plays there are more optima: of 60 plans for each of three
models with two of both those by SQP cost 0.60 to 0.97 of IPOPT's in the median, and 97 to 100 % of them were no more
than one percent worse. A plan that has NOT converged was cut short by `iterations`, by equations that are not finite or
curved too strongly, or is of a model of which SQP knows no pieces. Like any other it keeps the limits of inputs and
rates.
"""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np

from .._base import InputError, numbers
from .asked import SOLVERS, asked, count, path, within
from .mpc_cost import Cost
from .mpc_ipopt import Shooting
from .mpc_sqp import GaussNewton
from .plan import Plan

Array = np.ndarray
FIRST = 10  # times as many steps for the first plan


class PredictiveController:
    """Model predictive control of any `F(x, u) -> (x_next, y)`; `controller(x, reference, u_previous)` gives a `Plan`.

    Parameters
    ----------
    function : casadi.Function, Fit, KalmanFilter or Exported
        The model: `(x, u) -> (x_next, y)`, for example `fit.to_casadi()` or an observer's `function`.
    horizon : int
        Samples N.
    inputs : (low, high)
        Limits of the inputs, numbers or arrays (n_u,); infinite where there is none.
    outputs : (low, high), optional
        Limits of the outputs, each kept where that is possible; where it is not, the output comes as close as it can.
    rate : float or array, optional
        Largest change of an input from sample to sample. Where the previous input is so far outside the limits that
        both cannot be kept, the first change is as large as it takes.
    move : float
        Weight of changes of the inputs.
    y_scale, u_scale : float or array, optional
        What counts as one. By default half of the width between the limits of an input and of an output, and no more
        than the output can range over within the horizon; a tenth of that range where no output limits are given
        (`mpc_scales`). What was taken is in `controller.y_scale` and `u_scale`, and the same in each call.
    solver : {"sqp", "ipopt"}
        See above.
    iterations : int
        Most Gauss-Newton steps a call; where kinks are in the way, eight pieces for each may be entered as well. The
        first call, which starts from a held input, may take ten times as many. IPOPT has its own limits.

    Raises
    ------
    InputError
        If limits are unfit, or the solver is unknown; in a call, if state, reference or previous input have another
        shape, or are not finite.
    """

    def __init__(
        self,
        function: Any,
        horizon: int,
        *,
        inputs: tuple[Any, Any],
        outputs: tuple[Any, Any] | None = None,
        rate: Any = None,
        move: float = 1e-3,
        y_scale: Any = None,
        u_scale: Any = None,
        solver: str = "sqp",
        iterations: int = 5,
    ) -> None:
        task = asked(function, horizon, inputs, outputs, rate, move, y_scale, u_scale)
        if solver not in SOLVERS or not count(iterations):
            raise InputError(
                f"The solver {solver!r} and {iterations!r} iterations were given; give 'sqp' or 'ipopt', and 1 or more."
            )
        self.function, self.horizon, self.solver, self.iterations = task.function, task.horizon, solver, iterations
        self.low, self.high, self.low_y, self.high_y = task.low, task.high, task.low_y, task.high_y
        self.limited, self.rate, self.y_scale, self.u_scale = task.limited, task.rate, task.y_scale, task.u_scale
        self._task, self._cost = task, Cost(task)
        self._plan: Array | None = None
        self._solver = (GaussNewton if solver == "sqp" else Shooting)(task, self._cost)

    def __str__(self) -> str:
        n, n_u, n_y = (self.function.size1_in(0), self.function.size1_in(1), self.function.size1_out(1))
        limits = "inputs and outputs" if self.limited else "inputs"
        return (
            f"predictive controller over {self.horizon} samples by {self.solver}: {n} states, {n_u} inputs, {n_y} "
            f"outputs, limits of the {limits}" + (", rates limited" if np.isfinite(self.rate).any() else "")
        )

    __repr__ = __str__

    def __call__(self, x: Array, reference: Array, u_previous: Array) -> Plan:
        """Plan from the state x of sample k, towards the reference (N, n_y) of the samples k to k + N - 1.

        The plan's first input acts in sample k, its first output belongs to sample k, and so does the first row of the
        reference: the output that goes with x, which in a model without feedthrough no input can change any more.
        `u_previous` is the input of sample k - 1. The last plan, shifted by a sample, is where the search begins.
        """
        begin = perf_counter()
        n_u, n_y = self.function.size1_in(1), self.function.size1_out(1)
        wanted = path(reference, self.horizon, n_y)
        before = numbers(u_previous, "The previous input").reshape(-1)
        state = numbers(x, "The state").ravel()
        if len(before) != n_u or len(state) != self.function.size1_in(0):
            raise InputError(
                f"A state of {len(state)} numbers and {len(before)} previous inputs were given; give "
                f"{self.function.size1_in(0)} and {n_u}."
            )
        start = np.tile(before, self.horizon) if self._plan is None else np.append(self._plan[n_u:], self._plan[-n_u:])
        rate = self.rate.copy()
        rate[:n_u] = np.maximum(rate[:n_u], np.maximum(self.low[:n_u] - before, before - self.high[:n_u]))
        most = self.iterations * (FIRST if self._plan is None else 1)
        first = within(self._task, start, before, rate)
        u, y, converged = self._solver.solve(state, wanted, before, first, rate, most)
        self._plan = u
        shaped = u.reshape(-1, n_u), y.reshape(-1, n_y)
        cost = self._cost(u, y, wanted, before)
        spent, converged = perf_counter() - begin, converged and bool(np.isfinite(cost))
        return Plan(*shaped, cost, self._cost.over(y), spent, converged, self.limited)
