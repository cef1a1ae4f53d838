r"""A problem whose bounds on spectral radii are written as smooth rows, in further unknowns (`schur`).

The simulation error (Krikelis et al. 2024, Eq. 20) knows nothing of the unknowns X. A matrix that is block triangular
because its entries below the diagonal blocks are fixed at zero needs none: the coordinates of the states are free, and
rotated to its Schur form (`rotated`) the matrix `A` can have any eigenvalues, any number of them equal, without error.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from .constraints import BeyondRadius, Constraint, linear_part
from .problem import Problem
from .schur import below_blocks, bounded_rows, paired_schur

Array = np.ndarray
STATES = {"A": (1, 1), "B_u": (1, 0), "B_w": (1, 0), "C_y": (0, 1), "C_z": (0, 1)}  # blocks: turned left, right
UNIT = 1e-2  # of a row: violations are judged next to it
LOOSE = 1e-6  # curvature of the objective that an unknown is given, so that damping knows it
SAME = 1e-8  # relative change of cost and constraints under a rotation that is rounding


def radius_limits(problem: Problem) -> list[Constraint]:
    """The constraints that are exact bounds on a spectral radius."""
    return [c for c in problem.constraints if c.exact and isinstance(c.check, BeyondRadius)]


@dataclass(frozen=True, eq=False)
class _Rows:
    """One bound: its matrix over its radius as a Function of p, its Jacobian, the Schur basis and the rows' places."""

    limit: Constraint
    matrix: ca.Function
    slope: ca.Function
    basis: Array
    rows: ca.Function
    rows_slope: ca.Function
    unknowns: int


class Lifted:
    """What a solver minimises: `problem` with its exact bounds on spectral radii as rows of `schur`.

    Parameters
    ----------
    problem : Problem
        With such bounds.
    theta : array, shape (n,)
        Where the Schur forms are taken.
    inside : float
        Share by which the radii are held below their bounds, and other exact constraints, in their units, inside.
    triangular : bool
        Whether `A` is block triangular by its fixed entries.
    """

    def __init__(self, problem: Problem, theta: Array, inside: float, triangular: bool = False) -> None:
        self.problem = problem
        limits = radius_limits(problem)
        where = np.repeat([c not in limits for c in problem.constraints], problem.g_sizes).astype(bool)
        self.kept = np.flatnonzero(where)
        self.parts = [_rows(problem, c, theta, inside, triangular) for c in limits]
        extra = [p.unknowns for p in self.parts]
        self.first = np.concatenate([[problem.size], problem.size + np.cumsum(extra)]).astype(int)
        self.labels = (*problem.labels, *(f"X{k}[{i},0]" for k, m in enumerate(extra) for i in range(m)))
        free = np.full(sum(extra), np.inf)
        self.lower, self.upper = np.concatenate([problem.lower, -free]), np.concatenate([problem.upper, free])
        self.start = np.concatenate([theta, np.zeros(sum(extra))])
        held = [p.rows.size1_out(0) for p in self.parts]
        low = [p.rows.size1_out(1) for p in self.parts]
        top = [np.concatenate([np.full(a, np.inf), np.zeros(b)]) for a, b in zip(held, low, strict=True)]
        exact = np.repeat([c.exact for c in problem.constraints], problem.g_sizes).astype(bool)
        room = np.where(exact, inside * problem.constraint_units(theta), 0.0)
        room = np.minimum(room, 0.25 * (problem.g_upper - problem.g_lower))[self.kept]
        self.g_lower = np.concatenate([problem.g_lower[self.kept] + room, np.zeros(sum(held) + sum(low))])
        self.g_upper = np.concatenate([problem.g_upper[self.kept] - room, *top])

    @property
    def size(self) -> int:
        """Number of variables, X among them."""
        return len(self.start)

    def theta(self, x: Array) -> Array:
        """The variables of the problem itself."""
        return x[: self.problem.size]

    def cost(self, x: Array) -> float:
        """The objective."""
        return self.problem.cost(self.theta(x))

    def normal(self, x: Array) -> tuple[float, Array, Array]:
        """Objective, gradient and Gauss-Newton Hessian."""
        n = self.problem.size
        gradient, hessian = np.zeros(self.size), LOOSE * np.eye(self.size)
        value, gradient[:n], hessian[:n, :n] = self.problem.normal(self.theta(x))
        return value, gradient, hessian

    def constraint(self, x: Array) -> Array:
        """Values of the constraints: those that are no radius, then the rows of each bound."""
        out = [self.problem.constraint(self.theta(x))[self.kept]]
        p = self.problem.parameters(self.theta(x))
        for k, part in enumerate(self.parts):
            held, low = part.rows(self._turned(part, p), x[self.first[k] : self.first[k + 1]])
            out += [np.asarray(held).ravel(), np.asarray(low).ravel()]
        return np.concatenate(out)

    def _turned(self, part: _Rows, p: Array) -> Array:
        return np.asarray(part.basis.T @ np.asarray(part.matrix(p)) @ part.basis)

    def constraint_jacobian(self, x: Array) -> Array:
        """Jacobian of `constraint`."""
        problem = self.problem
        n_free, p = int(problem.free.sum()), problem.parameters(self.theta(x))
        kept = np.zeros((len(self.kept), self.size))
        kept[:, : problem.size] = problem.constraint_jacobian(self.theta(x))[self.kept]
        out = [kept]
        for k, part in enumerate(self.parts):
            at = slice(self.first[k], self.first[k + 1])
            slopes = part.rows_slope(self._turned(part, p), x[at], 0, 0)
            # vec(Q' M Q) = (Q' x Q') vec(M)
            turn = np.kron(part.basis.T, part.basis.T) @ np.asarray(part.slope(p))[:, problem.free]
            for by_m, by_x in zip(slopes[::2], slopes[1::2], strict=True):
                rows = np.zeros((by_m.shape[0], self.size))
                rows[:, :n_free] = np.asarray(by_m) @ turn
                rows[:, at] = np.asarray(by_x)
                out.append(rows)
        return np.concatenate(out)

    def constraint_units(self, x: Array, squares: Array | None = None) -> Array:
        """Units of the constraints."""
        n = self.problem.size
        units = self.problem.constraint_units(self.theta(x), None if squares is None else squares[:n])
        return np.concatenate([units[self.kept], np.full(len(self.g_lower) - len(self.kept), UNIT)])

    def multipliers(self, x: Array, found: Array) -> Array:
        """Multipliers of the problem's own bounds and constraints; of a radius next to its logarithm."""
        problem, n = self.problem, self.problem.size
        out = np.zeros(n + len(problem.g_lower))
        if len(found) != self.size + len(self.g_lower):
            return out
        out[:n], rows = found[:n], found[self.size :]
        out[n + self.kept] = rows[: len(self.kept)]
        p, at, first = problem.parameters(self.theta(x)), len(self.kept), np.cumsum([0, *problem.g_sizes])
        for k, part in enumerate(self.parts):
            unknown, matrix = x[self.first[k] : self.first[k + 1]], self._turned(part, p)
            by_m = np.concatenate([np.asarray(s) for s in part.rows_slope(matrix, unknown, 0, 0)[::2]])
            size = len(by_m)
            force = float(rows[at : at + size] @ by_m @ matrix.ravel(order="F"))
            out[n + first[problem.constraints.index(part.limit)]] = max(force, 0.0)
            at += size
        return out


def _rows(problem: Problem, limit: Constraint, theta: Array, inside: float, triangular: bool) -> _Rows:
    check = limit.check
    assert isinstance(check, BeyondRadius)
    parameters = problem.model.parameters
    p = ca.MX.sym("p", parameters.size)
    scaled = ca.densify(check.matrix(parameters.symbols(p))) / (check.radius * (1.0 - inside))
    n = int(scaled.shape[0])
    matrix = ca.Function("matrix", [p], [scaled], ["p"], ["M"])
    slope = ca.Function("matrix_slope", [p], [ca.densify(ca.jacobian(ca.vec(scaled), p))], ["p"], ["jac"])
    lifted = not (triangular and check.matrix is linear_part)
    basis = paired_schur(np.asarray(matrix(problem.parameters(theta))))[0] if lifted else np.eye(n)
    rows = bounded_rows(n, lifted)
    return _Rows(limit, matrix, slope, basis, rows, rows.jacobian(), rows.size1_in(1))


def rotated(problem: Problem, theta: Array) -> tuple[Problem, Array] | None:
    """The problem in coordinates of the states in which `A` is block triangular, and its variables there.

    None where the coordinates are not free: something is known, bounded or has a prior in them, or cost or constraints
    change with them.
    """
    parameters = problem.model.parameters
    blocks = [name for name in STATES if name in parameters]
    if "A" not in blocks or not all(_free(parameters[name]) for name in blocks):
        return None
    if np.any(parameters["A"].fixed):
        return None
    values = parameters.unpack(problem.parameters(theta))
    n, n_free = len(values["A"]), int(problem.free.sum())
    basis, t = paired_schur(values["A"])
    turned = turn(values, basis) | {"A": t}
    fixed = {"A": {"fixed": below_blocks(n)}}
    model = problem.model.with_parameters(parameters.at(parameters.pack(turned)).change(**fixed))
    held = Problem(
        model,
        problem.recordings,
        engine=problem.engine,
        constraints=problem.constraints,
        l1=problem.l1,
        noise=problem.noise,
        scale=problem.scale,
        weights=problem.weights,
        threads=problem.threads,
    )
    states, size = theta[n_free:].copy(), problem.model.n_x + problem.model.n_s
    for first in range(0, len(states), size):
        states[first : first + n] = basis.T @ states[first : first + n]
    there = np.concatenate([parameters.pack(turned)[held.free], states])
    cost, other = problem.cost(theta), held.cost(there)
    if not abs(other - cost) <= SAME * max(cost, 1e-12):
        return None
    kept = np.repeat([c.check is None for c in problem.constraints], problem.g_sizes).astype(bool)
    g, other_g = problem.constraint(theta)[kept], held.constraint(there)[kept]
    unit = problem.constraint_units(theta)[kept]
    return (held, there) if np.all(np.abs(other_g - g) <= 1e-6 * np.maximum(unit, 1e-300)) else None


def _free(p: Any) -> bool:
    """Whether a block may be rotated: without bounds or a prior, and all free or all zero."""
    bounded = np.any(np.isfinite(p.bounds[0])) or np.any(np.isfinite(p.bounds[1]))
    whole = not np.any(p.fixed) or bool(np.all(p.fixed) and not np.any(p.value))
    return whole and p.prior is None and not bounded


def turn(values: Mapping[str, Array], basis: Array) -> dict[str, Array]:
    """Blocks with `x = Q x'`."""
    out = dict(values)
    for name, (left, right) in STATES.items():
        if name in values:
            block = basis.T @ values[name] if left else values[name]
            out[name] = block @ basis if right else block
    return out


def back(problem: Problem, held: Problem, theta: Array) -> Array:
    """Variables of `problem` for those of a problem with more entries fixed."""
    states = theta[int(held.free.sum()) :]
    return np.concatenate([held.parameters(theta)[problem.free], states])
