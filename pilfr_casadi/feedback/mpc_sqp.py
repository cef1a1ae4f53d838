"""Predictive control with the states eliminated: Gauss-Newton steps from a dense QP.

Between kinks the model is linear in x and u, so a step that crosses none ends in the optimum of its piece. Where no
share of a step lowers the cost as promised, a kink is in between, and the slopes of this side say nothing of the other:
the search then goes on from the end of the full step and keeps the best plan it has seen. A plan is called converged
where the QP has next to nothing to gain there; at an optimum that lies in a kink the slopes of one side always promise
more, so such a plan is not. Nor can the slopes of all sides tell: what they promise together (a bundle, Kiwiel 1985) is
a bound for convex kinks alone, and where a play takes the input back kinks are concave. Of 14 plans that such a bundle
called optima, 5 were not: random steps lowered their cost by 0.1 to 0.7 %.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ..quadratic_program import unconstrained
from .asked import ENORMOUS, Asked
from .mpc_cost import Cost

Array = np.ndarray
CLOSE = 1e-5  # of u_scale: a smaller step ends the search
GAIN = 1e-4  # of the cost: a smaller promise is none
ARMIJO = 0.1  # of what was promised, to be kept
LOWER = 1e-3  # of the cost, by which a plan has to be better than the best for the search to go on
PATIENCE = 5  # steps in a row that find no better plan


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
        stacked = ca.vertcat(*outputs)
        self._predict = ca.Function("predict", [x, u], [stacked])
        self._slopes = ca.Function("slopes", [x, u], [stacked, ca.densify(ca.jacobian(stacked, u))])
        size = len(task.low)
        rows = 2 * len(task.low_y) * task.limited + size * np.isfinite(task.rate).any()
        m = size + task.limited
        structure = {"h": ca.Sparsity.dense(m, m), "a": ca.Sparsity.dense(rows, m)}
        unconstrained(np.eye(1), np.zeros(1))  # what it imports is not paid for by the first plan
        self._qp = ca.conic("qp", "daqp", structure, {"error_on_fail": False})

    def solve(
        self, x: Array, wanted: Array, before: Array, u: Array, rate: Array, iterations: int
    ) -> tuple[Array, Array, bool]:
        """Inputs, outputs, whether converged."""
        low, high, least, missed, converged = self._task.low, self._task.high, np.inf, 0, False
        best, at_best, y = u, np.zeros(0), np.zeros(0)
        for _ in range(iterations):
            out, jac = self._slopes(x, u)
            y, jac = out.full().ravel(), jac.full()
            value = self._cost(u, y, wanted, before)
            missed = 0 if value < (1 - LOWER) * least else missed + 1
            if not len(at_best) or value < least:
                best, at_best, least = u, y, value
            step = self._step(u, y, jac, wanted, before, rate)
            if step is None or missed > PATIENCE:
                break
            expected = self._cost(u + step, y + jac @ step, wanted, before)
            if value - expected <= GAIN * value or np.max(np.abs(step) / self._task.u_scale) < CLOSE:
                converged = value <= least
                break
            for share in (1.0, 0.5, 0.25, 0.1):
                trial = np.clip(u + share * step, low, high)
                output = self._predict(x, trial).full().ravel()
                found = self._cost(trial, output, wanted, before)
                if found < value - ARMIJO * share * (value - expected):
                    break
            else:  # a kink in between: on to its other side
                u = np.clip(u + step, low, high)
                continue
            u = trial
            if found < least:
                best, at_best = trial, output
                if share == 1.0 and abs(found - expected) <= GAIN * found:  # no kink in between
                    converged = True
                    break
        return best, at_best, converged

    def _step(self, u: Array, y: Array, jac: Array, wanted: Array, before: Array, rate: Array) -> Array | None:
        """Gauss-Newton step inside the limits, the QP in units of u_scale; None where the solver finds none."""
        task, cost = self._task, self._cost
        if not (np.all(np.isfinite(y)) and np.all(np.isfinite(jac))):
            return None
        scaled, weighted = jac * (task.u_scale / task.y_scale[:, None]), cost.weighted * task.u_scale
        h = 2 * (scaled.T @ scaled + weighted.T @ weighted)
        g = 2 * (scaled.T @ ((y - wanted) / task.y_scale) + weighted.T @ (cost.weighted @ u - cost.moved(before)))
        lbx, ubx = (task.low - u) / task.u_scale, (task.high - u) / task.u_scale
        below, above = (task.low_y - y) / task.y_scale, (task.high_y - y) / task.y_scale
        changes, gap = cost.differences * task.u_scale, cost.offset(before) - cost.differences @ u
        free = unconstrained(h, g)
        if free is not None and np.all((lbx <= free) & (free <= ubx)):
            outputs, moves = scaled @ free, changes @ free - gap
            if np.all((below <= outputs) & (outputs <= above)) and np.all(np.abs(moves) <= rate):
                return np.asarray(free * task.u_scale)
        a, lba, uba = [], [], []
        if np.any(np.isfinite(rate)):
            rate = np.minimum(rate, ENORMOUS)
            a, lba, uba = (
                [np.hstack([changes, np.zeros((len(u), int(task.limited)))])],
                [gap - rate],
                [gap + rate],
            )
        if task.limited:
            h, g = np.pad(h, (0, 1)), np.append(g, cost.penalty)
            h[-1, -1] = 1e-6 * cost.penalty
            lbx, ubx = np.append(lbx, 0.0), np.append(ubx, ENORMOUS)
            one, none = np.ones((len(y), 1)), np.full(len(y), ENORMOUS)
            a += [np.hstack([scaled, one]), np.hstack([scaled, -one])]
            lba, uba = [*lba, below, -none], [*uba, none, above]
        rows = {"a": np.vstack(a), "lba": np.concatenate(lba), "uba": np.concatenate(uba)} if a else {}
        out = self._qp(h=h, g=g, lbx=lbx, ubx=ubx, **rows)
        return out["x"].full().ravel()[: len(u)] * task.u_scale if self._qp.stats()["success"] else None
