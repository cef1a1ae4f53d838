"""Predictive control by multiple shooting, a variable for each state, and IPOPT.

IPOPT needs slopes that are continuous and does not end at an optimum that lies in a kink, as most do where plays are
about to slip. Where it does not end, the same problem is solved with every max and min rounded (`export.smoothing`), by
as much as moves the outputs of a run by less than `ROUNDED` of y_scale, and the better plan of the two is taken; both
are judged by the model as it is.
"""

from __future__ import annotations

from functools import cached_property

import casadi as ca
import numpy as np

from .asked import ENORMOUS, Asked, within
from .mpc_cost import Cost
from .mpc_rounding import rounded

Array = np.ndarray
OPTIONS = {"print_level": 0, "sb": "yes", "tol": 1e-9, "warm_start_init_point": "yes", "mu_init": 1e-4}
EXACT, ROUND = 40, 100  # most iterations with the model as it is, and rounded
ROUNDED = 0.02  # of y_scale, by which rounding may change the outputs
ALIKE = 1e-3  # of the cost


class Shooting:
    """Solves a task by `solve(x, wanted, before, u, rate, iterations)`."""

    def __init__(self, task: Asked, cost: Cost) -> None:
        self._task, self._cost = task, cost
        self._simulate = task.function.mapaccum("simulate", task.horizon)
        self._slacks = len(task.low_y) * task.limited
        self._exact = self._solver(task.function, EXACT)
        free, zero = np.full(len(task.low_y), np.inf), np.zeros(task.function.size1_in(0) * task.horizon)
        low_y, high_y = (np.where(np.abs(v) < ENORMOUS, v, np.sign(v) * np.inf) for v in (task.low_y, task.high_y))
        self._bounds = {
            "lbx": np.concatenate([np.full(len(zero), -np.inf), task.low, np.zeros(self._slacks)]),
            "ubx": np.concatenate([np.full(len(zero), np.inf), task.high, np.full(self._slacks, np.inf)]),
        }
        sides = (low_y / task.y_scale, -free), (free, high_y / task.y_scale)
        self._sides = [(zero, *(side if task.limited else ())) for side in sides]

    def _solver(self, function: ca.Function, most: int) -> ca.Function:
        task, cost = self._task, self._cost
        n, n_u, n_y, m = (*(function.size1_in(i) for i in (0, 1)), function.size1_out(1), task.horizon)
        states, u, s = ca.MX.sym("X", n, m), ca.MX.sym("U", n_u, m), ca.MX.sym("s", self._slacks)
        x, wanted, before = ca.MX.sym("x", n), ca.MX.sym("r", n_y, m), ca.MX.sym("before", n_u)
        price = ca.MX.sym("price")
        following, y = function.map(m)(ca.horzcat(x, states[:, :-1]), u)
        error = (ca.vec(y) - ca.vec(wanted)) / task.y_scale
        moves = ca.DM(cost.weighted) @ ca.vec(u)
        offset = ca.vertcat(before, ca.DM.zeros(n_u * (m - 1)))
        first = offset * np.abs(np.diag(cost.weighted))
        changes = ca.DM(cost.differences) @ ca.vec(u) - offset
        y = ca.vec(y) / task.y_scale
        nlp = {
            "x": ca.vertcat(ca.vec(states), ca.vec(u), s),
            "p": ca.vertcat(x, ca.vec(wanted), before, price),
            "f": ca.sumsqr(error) + ca.sumsqr(moves - first) + price * ca.sum1(s),
            "g": ca.vertcat(ca.vec(following - states), changes, *((y + s, y - s) if task.limited else ())),
        }
        return ca.nlpsol("mpc", "ipopt", nlp, {"ipopt": {**OPTIONS, "max_iter": most}, "print_time": False})

    @cached_property
    def _rounded(self) -> ca.Function | None:
        """The solver of the rounded problem; None where the model has nothing that can be rounded."""
        function = rounded(self._task, ROUNDED)
        return None if function is None else self._solver(function, ROUND)

    def solve(
        self, x: Array, wanted: Array, before: Array, u: Array, rate: Array, iterations: int
    ) -> tuple[Array, Array, bool]:
        """Inputs, outputs, whether converged; IPOPT has its own limits of iterations."""
        exact = self._solved(self._exact, x, wanted, before, u, rate)
        if exact[2] or self._rounded is None:
            return exact
        rounded = self._solved(self._rounded, x, wanted, before, u, rate)
        costs = [self._cost(*plan[:2], wanted, before) for plan in (exact, rounded)]
        if not costs[1] <= costs[0]:
            near = costs[1] <= (1 + ALIKE) * costs[0] + ROUNDED**2 * len(wanted)  # apart by no more than rounding does
            return *exact[:2], rounded[2] and bool(near)
        return rounded

    def _solved(
        self, solver: ca.Function, x: Array, wanted: Array, before: Array, u: Array, rate: Array
    ) -> tuple[Array, Array, bool]:
        n_u, m = self._task.function.size1_in(1), self._task.horizon
        states = np.asarray(self._simulate(x, u.reshape(m, n_u).T)[0]).ravel(order="F")
        p = np.concatenate([x, wanted, before, [self._cost.price(wanted)]])
        (zero, *low), (_, *high) = self._sides
        limits = {"lbg": np.concatenate([zero, -rate, *low]), "ubg": np.concatenate([zero, rate, *high])}
        out = solver(x0=np.concatenate([states, u, np.zeros(self._slacks)]), p=p, **self._bounds, **limits)
        u = np.asarray(out["x"]).ravel()[len(states) : len(states) + len(u)]
        u = within(self._task, u, before, rate)
        y = np.asarray(self._simulate(x, u.reshape(m, n_u).T)[1]).ravel(order="F")
        return u, y, bool(solver.stats()["success"])
