"""The quadratic program of one step of a plan, inside all limits, in units of u_scale and y_scale.

First with the output limits as they are; where they cannot all be kept, or one would cost more than its price, once
more with a slack for each output and sample. A piece between kinks gives its edges as further rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from ..models import Buffered
from ..optimise import unconstrained
from .asked import ENORMOUS, Asked
from .mpc_cost import Cost

Array = np.ndarray


@dataclass(frozen=True)
class At:
    """Where a step begins: state, reference, previous input, largest changes; inputs, outputs and their slopes."""

    wanted: Array
    before: Array
    rate: Array
    u: Array
    y: Array
    jac: Array


class Steps:
    """Solves for Gauss-Newton steps; `edges` is how many rows the edges of a piece give."""

    def __init__(self, task: Asked, cost: Cost, edges: int = 0) -> None:
        self._task, self._cost, self._edges = task, cost, edges
        self._rated = bool(np.any(np.isfinite(task.rate)))
        unconstrained(np.eye(1), np.zeros(1))  # what it imports is not paid for by the first plan
        m, n_y = len(task.low), len(task.low_y)
        fixed = m * self._rated + edges
        self._hard = _program(m, fixed + n_y * task.limited)
        self._soft = _program(m + n_y, fixed + 2 * n_y) if task.limited else self._hard
        self._changes = cost.differences * task.u_scale
        self._weighted = cost.weighted * task.u_scale
        self._curved = 2 * self._weighted.T @ self._weighted

    def __call__(self, at: At, edges: tuple[Array, Array] | None = None) -> tuple[Array, Array] | None:
        """Step (N n_u,) and the multipliers of the edges `rows @ step / u_scale >= least`; None where there is none."""
        task, cost = self._task, self._cost
        if not (np.all(np.isfinite(at.y)) and np.all(np.isfinite(at.jac))):
            return None
        scaled = at.jac * (task.u_scale / task.y_scale[:, None])
        moves = cost.weighted @ at.u - cost.moved(at.before)
        h = 2 * (scaled.T @ scaled) + self._curved
        g = 2 * (scaled.T @ ((at.y - at.wanted) / task.y_scale) + self._weighted.T @ moves)
        lbx, ubx = (task.low - at.u) / task.u_scale, (task.high - at.u) / task.u_scale
        below, above = (task.low_y - at.y) / task.y_scale, (task.high_y - at.y) / task.y_scale
        a, low, high = [], [], []
        if self._rated:
            gap, most = cost.offset(at.before) - cost.differences @ at.u, np.minimum(at.rate, ENORMOUS)
            a, low, high = [self._changes], [gap - most], [gap + most]
        if edges is not None:
            a, low, high = [*a, edges[0]], [*low, edges[1]], [*high, np.full(self._edges, ENORMOUS)]
        if task.limited:
            a, low, high = [*a, scaled], [*low, below], [*high, above]
        if not a:
            a, low, high = [np.zeros((0, len(h)))], [np.zeros(0)], [np.zeros(0)]
        rows, least, most = np.concatenate(a), np.concatenate(low), np.concatenate(high)
        free = unconstrained(h, g)
        if free is not None and np.all((lbx <= free) & (free <= ubx)):
            there = rows @ free
            if np.all((least <= there) & (there <= most)):
                return free * task.u_scale, np.zeros(self._edges)
        step, _, multipliers, _ = self._hard(h, g, rows, least, most, lbx, ubx)
        found, n_y = self._hard.success, len(at.y)
        if task.limited:
            price = cost.price(at.wanted)
            if not found or np.max(np.abs(multipliers[-n_y:])) > price:
                step, found, multipliers = self._softened(h, g, rows, (least, most), (lbx, ubx), price)
        if not found or not np.all(np.isfinite(step)):
            return None
        begin = len(lbx) * self._rated
        return step * task.u_scale, -multipliers[begin : begin + self._edges]

    def _softened(
        self, h: Array, g: Array, rows: Array, sides: tuple[Array, Array], box: tuple[Array, Array], price: float
    ) -> tuple[Array, bool, Array]:
        """The same with slacks; the rows of the outputs are the last."""
        m, n_y = len(h), len(self._task.low_y)
        fixed, outputs, one = rows[:-n_y], rows[-n_y:], np.eye(n_y)
        whole = np.zeros((m + n_y, m + n_y))
        whole[:m, :m] = h
        whole[m:, m:] = 1e-6 * price * one
        a = np.block([[fixed, np.zeros((len(fixed), n_y))], [outputs, one], [outputs, -one]])
        (least, most), none = sides, np.full(n_y, ENORMOUS)
        step, _, multipliers, _ = self._soft(
            whole,
            np.append(g, np.full(n_y, price)),
            a,
            np.concatenate([least, -none]),
            np.concatenate([most[:-n_y], none, most[-n_y:]]),
            np.append(box[0], np.zeros(n_y)),
            np.append(box[1], none),
        )
        return step[:m], self._soft.success, multipliers


def _program(n: int, rows: int) -> Buffered:
    structure = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(rows, n)}
    return Buffered(ca.conic("step", "daqp", structure, {"error_on_fail": False}))
