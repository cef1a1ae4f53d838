"""A plan among kinks: from piece to adjacent piece, until none promises a lower cost.

With every max, min and |·| held on its side (`export.sides`) the prediction has no kinks; the piece ends where a gap
changes its sign. A step inside a piece keeps to these edges, so where the model is piecewise linear it ends in the
optimum of the piece, and no kink takes back what it promised. There the edges that hold it back have multipliers; the
piece behind one of them, or behind all of them, is entered if its own step lowers the cost. A plan that no such piece
betters is an optimum: the active signature method of Griewank & Walther (2019), whose test of one edge after the other
is exact where the slopes of the edges are independent (2016). Edges with the same slope, such as those of all plays
that turn at once, are crossed together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from ..export import with_sides
from ..models import Buffered
from .asked import ENORMOUS, Asked, within
from .mpc_cost import Cost
from .mpc_steps import At, Steps

Array = np.ndarray
SHARES = (1.0, 0.5, 0.25, 0.1)
GAIN = 1e-4  # of the cost, and of what a deviation of y_scale everywhere costs: a smaller promise is none
ARMIJO = 0.1  # of what was promised, to be kept
TOUCHING = 1e-7  # of the row of an edge
HELD = 1e-9  # of the largest multiplier
ALIKE = 1e-9  # cosines less than one: the same slope
PATIENCE, FAR = 5, 100.0  # steps after which a search so many times above the bar is given up
FLAT = 1e-12  # of the units of a gap: one that no input changes


class Pieces:
    """Goes on from inputs by `solve(x, at, most)`; `predict` is `(x, u) -> y`.

    Raises
    ------
    InputError
        If the model holds an operation of which no pieces are known.
    """

    def __init__(self, task: Asked, cost: Cost, predict: Buffered) -> None:
        self._task, self._cost, self._predict = task, cost, predict
        function = task.function.expand()
        held, free = (_over(task, with_sides(function, held=held)) for held in (True, False))
        self.count = held.size1_in(2)
        if self.count:
            arguments = held.sx_in()
            found = ca.vertcat(*held(*arguments))
            slopes = ca.densify(ca.jacobian(found, arguments[1]))
            self._piece = Buffered(ca.Function("piece", arguments, [ca.densify(found), slopes]))
            self._gaps = Buffered(ca.Function("gaps", arguments, [ca.densify(free(*arguments)[1])]))
            self._steps = Steps(task, cost, self.count)

    def solve(self, x: Array, at: At, most: int, bar: float = np.inf) -> tuple[tuple[Array, Array, bool], int]:
        """Inputs that are no worse, outputs, whether no adjacent piece promises a lower cost; steps left of `most`.

        A search that is not to end above the cost `bar` gives up in a piece whose optimum is, or far above it.
        """
        y, sure = at.y, True
        value = self._cost(at.u, y, at.wanted, at.before)
        own = (self._gaps(x, at.u)[0] >= 0).astype(float)
        ahead = [own]
        hopeless = most - PATIENCE
        while ahead and most > 0 and (most > hopeless or value <= FAR * bar):
            sides, most = ahead.pop(0), most - 1
            found = self._step(x, at, sides)
            if found is None:
                sure = sure and sides is not own
                continue
            gain = value - found.expected
            if gain <= GAIN * min(value, len(y)):
                ahead = ahead if sides is not own else _behind(sides, found)
                if value > bar:
                    break
                continue
            for share in SHARES:
                u = within(self._task, at.u + share * found.step, at.before, at.rate)
                there = self._predict(x, u)[0]
                lower = self._cost(u, there, at.wanted, at.before)
                if lower < value - ARMIJO * share * gain:
                    exact = abs(lower - found.expected) <= GAIN * lower
                    at, y, value, own, sure = replace(at, u=u), there, lower, sides, True
                    ahead = _behind(sides, found) if exact else [own]
                    break
            else:
                sure = False
        return (at.u, y, sure and not ahead), most

    def _step(self, x: Array, at: At, sides: Array) -> Inside | None:
        """The step inside a piece."""
        n_y, scale = len(at.y), self._task.u_scale
        found, slopes = self._piece(x, at.u, sides)
        y, jac = found[:n_y], slopes[:n_y]
        sign = 2 * sides - 1
        rows, gaps = sign[:, None] * slopes[n_y:] * scale, sign * found[n_y:]
        size = np.abs(rows).max(axis=1)
        flat = size < FLAT
        size[flat] = 1.0
        rows, least = rows / size[:, None], -gaps / size
        least[flat] = -ENORMOUS
        result = self._steps(replace(at, y=y, jac=jac), (rows, least))
        if result is None:
            return None
        step, multipliers = result
        expected = self._cost(at.u + step, y + jac @ step, at.wanted, at.before)
        return Inside(step, expected, rows, multipliers, rows @ (step / scale) - least < TOUCHING)


@dataclass(frozen=True)
class Inside:
    """A step inside a piece, the cost it promises; of the edges the rows, multipliers, and which are touched."""

    step: Array
    expected: float
    rows: Array
    multipliers: Array
    touched: Array


def _behind(sides: Array, found: Inside) -> list[Array]:
    """The pieces behind all edges that hold a step back, and behind each of them, the strongest first."""
    touched = np.flatnonzero(found.touched)
    rows, multipliers = found.rows[touched], found.multipliers[touched]
    rows = rows / np.linalg.norm(rows, axis=1)[:, None]
    strong = multipliers > HELD * max(1.0, float(np.max(multipliers, initial=0.0)))
    alike = rows @ rows.T > 1 - ALIKE
    groups: list[Array] = []
    for i in np.argsort(-multipliers):
        if strong[i]:
            groups.append(touched[alike[i]])
            strong &= ~alike[i]
    if len(groups) > 1:
        groups.insert(0, np.concatenate(groups))
    pieces = []
    for group in groups:
        other = sides.copy()
        other[group] = 1 - other[group]
        pieces.append(other)
    return pieces


def _over(task: Asked, step: ca.Function) -> ca.Function:
    """`(x, u, s) -> (y, gaps)` over the horizon, of one step."""
    n, n_u, kinks = (step.size1_in(i) for i in range(3))
    x, u, s = (ca.SX.sym(name, m) for name, m in (("x", n), ("u", n_u * task.horizon), ("s", kinks * task.horizon)))
    state, outputs, gaps = x, [], []
    for k in range(task.horizon):
        state, y, gap = step(state, u[k * n_u : (k + 1) * n_u], s[k * kinks : (k + 1) * kinks])
        outputs.append(y)
        gaps.append(gap)
    return ca.Function("over", [x, u, s], [ca.vertcat(*outputs), ca.vertcat(*gaps)])
