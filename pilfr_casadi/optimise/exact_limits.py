r"""Solve inside exact limits: bounds on spectral radii, and the last move of a result inside its limits.

With a real Schur form `M / c = Q T Q'` at some point and `S = I + X`, X strictly block lower triangular,

    F = S⁻¹ Q' (M / c) Q S,    F below its 2 x 2 diagonal blocks = 0,

gives F the eigenvalues of its diagonal blocks. Both eigenvalues of a block lie in the unit disc if and only if (Jury)

    1 - det >= 0,   1 - tr + det >= 0,   1 + tr + det >= 0,

and so `ρ(M) <= c`: polynomial rows in M and in the extra unknowns X (zero at the point itself), smooth also where
eigenvalues meet. At a tight bound several eigenvalues lie on the circle at once, some of them equal, and a solver that
starts outside ends in poor points. `solve_within_radii` therefore

1. solves without the bound (or with a bound of 1 and a small slack, `loosen_radii`) and stops if the result is inside;
2. otherwise tightens the bound in steps (`tighten_radii`) that at most double `-log ρ`. Before each step it scales `A`
   and `B_w` by one factor, and with them every bounded matrix of a PI-LFR (Krikelis et al. 2024, Eq. 15), so that the
   start is inside;
3. solves at the bound, with a new Schur form each time, until the cost stops falling.

Radii stay inside by one of the shares `MARGINS`, so that the eigenvalues of the result, computed in floating point,
never exceed the bound. The result is a local minimum.

A solver meets other constraints up to a tolerance. If an exact one fails on the numbers of the result,
`move_inside_exact` makes the smallest step, in the metric of the outputs, that meets it and keeps all others to first
order:

    minimise  1/2 d'(H + λ D)d   subject to  lower <= θ + d <= upper,  lower_g + m <= g(θ) + ∇g d <= upper_g - m

with `H` the Gauss-Newton Hessian of the simulation error (Eq. 20 there) and a margin m on the exact ones that doubles
until every check holds in floating point. Fixed parameters stay fixed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import casadi as ca
import numpy as np

from ..models import Neighbours, or_one
from .constraints import FEASIBILITY_TOLERANCE, Constraint, RadiusExcess, loosen_radii
from .gauss_newton import GaussNewton, replace_rounding
from .problem import Problem
from .quadratic_program import QuadraticProgram
from .solution import ACTIVE_MULTIPLIER, IterationCallback, Solution, Status

Array = np.ndarray
Solve = Callable[[Problem, "Array | None"], Solution]
NEAR_BOUND = 1e-3  # distance of log ρ from its bound within which a start counts as lying at the bound
MARGINS = (2e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2)  # shares by which radii stay inside, tried in turn
CLOSEST = 1e-3  # distance of log ρ from the unit circle at which tightening begins, at least
SCHUR_ROUNDS = 6  # Schur forms taken at the bound, at most
WORTHWHILE_FALL = 1e-4  # relative fall of the cost that justifies another round
BOUND_STEP_SOLVER = GaussNewton(max_iterations=100, tolerance=1e-4)  # for each tightening step
ROW_UNIT = 1e-2  # unit of Jury's rows, next to which their violation is judged
CURVATURE = 1e-2  # of the objective along X: damps X next to a cost of order 1 (calibrated on three tight fits)
MOST_MOVES = 40  # steps onto exact limits, with margins doubled from `FIRST_MARGIN` to more than any constraint needs
FIRST_MARGIN = 1e-9  # margin of the first of these steps, in units of a constraint
MOVE_DAMPING = 1e-6  # λ of these steps, only large enough that their Hessian is positive definite


def radius_limits(problem: Problem) -> dict[Constraint, RadiusExcess]:
    """Return the exact bounds on spectral radii of a problem with their checks."""
    return {c: c.check for c in problem.constraints if c.exact and isinstance(c.check, RadiusExcess)}


def radius_rows(problem: Problem) -> Array:
    """Return the mask (n_g,) of the constraints that are exact bounds on spectral radii."""
    limits = radius_limits(problem)
    return np.repeat([c in limits for c in problem.constraints], problem.g_sizes).astype(bool)


def below_blocks(n: int) -> Array:
    """Return the mask (n, n) of the entries below the 2 x 2 diagonal blocks (a last single one where n is odd)."""
    block = np.arange(n) // 2
    return np.asarray(block[:, None] > block[None, :])


@lru_cache(maxsize=32)
def jury_rows(n: int) -> ca.Function:
    """Build `(M, X) -> (jury, low)`: Jury's rows of the diagonal blocks of F, and F below them.

    M (n, n) is divided by its bound; X holds the entries of `below_blocks` column by column.
    """
    low = [(int(i), int(j)) for j, i in zip(*np.nonzero(below_blocks(n).T), strict=True)]
    m, x = ca.SX.sym("M", n, n), ca.SX.sym("X", len(low))
    step = ca.SX.zeros(n, n)
    for k, (i, j) in enumerate(low):
        step[i, j] = x[k]
    inverse, power = ca.SX.eye(n), ca.SX.eye(n)
    for _ in range((n + 1) // 2 - 1):  # X is nilpotent
        power = -ca.mtimes(power, step)
        inverse = inverse + power
    f = ca.mtimes([inverse, m, ca.SX.eye(n) + step])
    jury = []
    for i in range(0, n, 2):
        if i + 1 < n:
            trace, det = f[i, i] + f[i + 1, i + 1], f[i, i] * f[i + 1, i + 1] - f[i, i + 1] * f[i + 1, i]
            jury += [1 - det, 1 - trace + det, 1 + trace + det]
        else:
            jury += [1 - f[i, i], 1 + f[i, i]]
    out = [ca.vertcat(*jury), ca.vertcat(ca.SX(0, 1), *(f[i, j] for i, j in low))]
    return ca.Function("jury_rows", [m, x], [ca.densify(o) for o in out], ["M", "X"], ["jury", "low"])


def schur_basis(matrix: Array) -> Array:
    """Return an orthogonal Q (n, n) with `Q' M Q` block upper triangular.

    A block holds a complex pair, or two real eigenvalues near each other, because only such two can become a pair.
    """
    from scipy.linalg import lapack, schur

    t, q = schur(np.asarray(matrix, dtype=float))
    n = len(t)
    for i in range(0, n - 2, 2):
        part = np.ascontiguousarray(t[i:, i:])
        first = np.zeros(n - i, dtype=np.int32)
        first[list(_first_pair(part))] = 1
        moved, turn = lapack.dtrsen(first, part, np.eye(n - i), job="N")[:2]
        t[i:, i:], t[:i, i:], q[:, i:] = moved, t[:i, i:] @ turn, q[:, i:] @ turn
    return np.asarray(q)


def _first_pair(t: Array) -> tuple[int, int]:
    """Choose the two diagonal entries of a real Schur form that make up the first block."""
    double = np.flatnonzero(np.diag(t, -1))
    if len(double):
        return int(double[0]), int(double[0]) + 1
    order = np.argsort(np.diag(t))
    value = np.diag(t)[order]
    if len(order) % 2 == 0:
        return int(order[0]), int(order[1])
    # an odd number leaves one over: choose the one whose removal leaves the smallest gaps
    gaps = [np.sum(np.diff(np.delete(value, k))[::2]) for k in range(0, len(order), 2)]
    paired = np.delete(order, 2 * int(np.argmin(gaps)))
    return int(paired[0]), int(paired[1])


class _Bound:
    """One bounded matrix: M over its radius as a Function of p, the Schur basis Q, and Jury's rows with slopes."""

    def __init__(self, problem: Problem, limit: Constraint, check: RadiusExcess, theta: Array, margin: float) -> None:
        parameters = problem.model.parameters
        p = ca.MX.sym("p", parameters.size)
        scaled = ca.densify(check.matrix(parameters.symbols(p))) / (check.radius * (1.0 - margin))
        self.limit = limit
        self.matrix = ca.Function("matrix", [p], [scaled], ["p"], ["M"])
        self.slope = ca.Function("matrix_slope", [p], [ca.densify(ca.jacobian(ca.vec(scaled), p))], ["p"], ["jac"])
        self.basis = schur_basis(np.asarray(self.matrix(problem.parameters(theta))))
        self.rows = jury_rows(len(self.basis))
        self.rows_slope = self.rows.jacobian()
        self.unknowns = self.rows.size1_in(1)
        self.upper = np.concatenate([np.full(self.rows.size1_out(0), np.inf), np.zeros(self.rows.size1_out(1))])

    def rotated(self, p: Array) -> Array:
        """Return `Q' M Q`."""
        return np.asarray(self.basis.T @ np.asarray(self.matrix(p)) @ self.basis)

    def values(self, p: Array, x: Array) -> Array:
        """Return Jury's rows, then the entries below the blocks."""
        return np.concatenate([np.asarray(v).ravel() for v in self.rows(self.rotated(p), x)])

    def slopes(self, p: Array, x: Array) -> tuple[Array, Array]:
        """Return the rows' Jacobians with respect to `vec(Q' M Q)` and to X."""
        jury_m, jury_x, low_m, low_x = map(np.asarray, self.rows_slope(self.rotated(p), x, 0, 0))
        return np.vstack([jury_m, low_m]), np.vstack([jury_x, low_x])


class SchurProblem:
    """Problem whose exact bounds on spectral radii are Jury's rows in extra unknowns X; see `Minimisation`.

    The Schur forms are taken at θ. Radii stay a share `margin` below their bounds, and other exact constraints stay
    inside by `margin` of their units.
    """

    def __init__(self, problem: Problem, theta: Array, margin: float) -> None:
        self.problem = problem
        self.kept = np.flatnonzero(~radius_rows(problem))
        self.bounds = [_Bound(problem, c, check, theta, margin) for c, check in radius_limits(problem).items()]
        extra = [b.unknowns for b in self.bounds]
        self.places = [slice(a, b) for a, b in pairwise(problem.size + np.cumsum([0, *extra]))]
        self.labels = (*problem.labels, *(f"X{k}[{i},0]" for k, m in enumerate(extra) for i in range(m)))
        free = np.full(sum(extra), np.inf)
        self.lower, self.upper = np.concatenate([problem.lower, -free]), np.concatenate([problem.upper, free])
        self.start = np.concatenate([theta, np.zeros(sum(extra))])
        room = np.where(problem.g_exact, margin * problem.constraint_units(theta), 0.0)
        room = np.minimum(room, 0.25 * (problem.g_upper - problem.g_lower))[self.kept]
        top = [b.upper for b in self.bounds]
        self.g_lower = np.concatenate([problem.g_lower[self.kept] + room, np.zeros(sum(map(len, top)))])
        self.g_upper = np.concatenate([problem.g_upper[self.kept] - room, *top])

    @property
    def size(self) -> int:
        """Number of variables, X included."""
        return len(self.start)

    def theta(self, x: Array) -> Array:
        """Return the variables of the problem itself."""
        return x[: self.problem.size]

    def cost(self, x: Array) -> float:
        """Return the objective."""
        return self.problem.cost(self.theta(x))

    def normal(self, x: Array) -> tuple[float, Array, Array]:
        """Return the objective, its gradient and Gauss-Newton Hessian."""
        n = self.problem.size
        gradient, hessian = np.zeros(self.size), CURVATURE * np.eye(self.size)
        value, gradient[:n], hessian[:n, :n] = self.problem.normal(self.theta(x))
        return value, gradient, hessian

    def constraint(self, x: Array) -> Array:
        """Return the other constraints, then the rows of each bound."""
        p = self.problem.parameters(self.theta(x))
        kept = self.problem.constraint(self.theta(x))[self.kept]
        return np.concatenate([kept, *(b.values(p, x[at]) for b, at in zip(self.bounds, self.places, strict=True))])

    def constraint_jacobian(self, x: Array) -> Array:
        """Return the Jacobian of `constraint`."""
        problem, theta = self.problem, self.theta(x)
        n_free, p = problem.n_free, problem.parameters(theta)
        out = np.zeros((len(self.g_lower), self.size))
        out[: len(self.kept), : problem.size] = problem.constraint_jacobian(theta)[self.kept]
        row = len(self.kept)
        for bound, at in zip(self.bounds, self.places, strict=True):
            by_m, by_x = bound.slopes(p, x[at])
            turn = np.kron(bound.basis.T, bound.basis.T)  # vec(Q' M Q) = (Q' x Q') vec(M)
            rows = slice(row, row + len(by_m))
            out[rows, :n_free] = by_m @ (turn @ np.asarray(bound.slope(p))[:, problem.free])
            out[rows, at] = by_x
            row += len(by_m)
        return out

    def constraint_units(self, x: Array, squares: Array | None = None) -> Array:
        """Return the units of the constraints."""
        units = self.problem.constraint_units(self.theta(x), None if squares is None else self.theta(squares))
        return np.concatenate([units[self.kept], np.full(len(self.g_lower) - len(self.kept), ROW_UNIT)])

    def multipliers(self, x: Array, found: Array) -> Array:
        """Return the multipliers of the problem's own limits; a multiplier of a radius belongs to its logarithm."""
        problem, n = self.problem, self.problem.size
        out, rows = np.zeros(n + len(problem.g_lower)), found[self.size :]
        out[:n], out[n + self.kept] = found[:n], rows[: len(self.kept)]
        p, row = problem.parameters(self.theta(x)), len(self.kept)
        for bound, at in zip(self.bounds, self.places, strict=True):
            by_m = bound.slopes(p, x[at])[0]
            force = float(rows[row : row + len(by_m)] @ by_m @ bound.rotated(p).ravel(order="F"))
            out[n + problem.g_slices[problem.constraints.index(bound.limit)].start] = max(force, 0.0)
            row += len(by_m)
        return out


def solve_within_radii(
    problem: Problem,
    start: Array | None,
    solve: Solve,
    bound_solver: GaussNewton = BOUND_STEP_SOLVER,
    at_bound: bool = False,
    progress: IterationCallback | None = None,
) -> Solution:
    """Solve a problem that may have exact bounds on spectral radii.

    `solve` is any solver's function of a problem and a start. `bound_solver` solves at the bounds, and `progress`
    receives its iterations. With `at_bound`, for a solution known to lie at a bound, the solve without the bounds is
    skipped.
    """
    if not radius_limits(problem):
        return solve(problem, start)
    ends = time.perf_counter() + bound_solver.time_limit
    given = begin = problem.start if start is None else start
    if not at_bound:
        found = solve(problem.with_constraints(loosen_radii(problem.constraints)), start)
        if found.status in (Status.INTERRUPTED, Status.DIVERGED_START) or _log_room(problem, found.theta) >= 0:
            return found
        begin = begin if near_radius(problem, begin) else found.theta
    tightened = tighten_radii(problem, begin, _with_time_left(ends, bound_solver), progress)
    if begin is not given and _is_better(problem, given, tightened):
        tightened = tighten_radii(problem, given, _with_time_left(ends, bound_solver), progress)
    return tightened


def near_radius(problem: Problem, theta: Array) -> bool:
    """Tell whether a point is inside every exact bound on a radius and close to one; False if there are no bounds."""
    return bool(radius_limits(problem)) and 0 <= _log_room(problem, theta) <= NEAR_BOUND


def at_active_radius(problem: Problem, theta: Array, solution: Solution) -> bool:
    """Tell whether a bound on a radius is active at a point, by the solution's multipliers if it has any."""
    rows, force = radius_rows(problem), np.abs(solution.multipliers[problem.size :])
    if len(force) == len(rows) and np.max(force[rows], initial=0.0) <= ACTIVE_MULTIPLIER * solution.cost:
        return False  # a multiplier of nan is unknown and does not count
    return near_radius(problem, theta)


def tighten_radii(
    problem: Problem, theta: Array, bound_solver: GaussNewton, progress: IterationCallback | None = None
) -> Solution:
    """Tighten the bounds step by step from the radii at θ to the wanted ones; return the best solution inside."""
    if not np.isfinite(problem.cost(theta)):
        theta = _scale_inside(problem, theta)
    if not np.isfinite(problem.cost(theta)):
        return point_as_solution(problem, theta, Status.DIVERGED_START)
    ends = time.perf_counter() + bound_solver.time_limit
    for constraints in _tightening_path(problem, theta):
        step = problem.with_constraints(constraints)
        found = _solve_jury_rows(
            step, _scale_inside(step, theta), _with_time_left(ends, BOUND_STEP_SOLVER), MARGINS[0], progress
        )
        if found.status is Status.INTERRUPTED:
            return found
        theta = found.theta if found.status is not Status.INFEASIBLE else theta
    theta, iterations = _scale_inside(problem, theta), 0
    best = point_as_solution(problem, theta, Status.RESTORED if _meets_all(problem, theta) else Status.INFEASIBLE)
    for _ in range(SCHUR_ROUNDS):
        found = _solve_inside(problem, theta, bound_solver, ends, progress)
        iterations += found.iterations
        if found.status is Status.INTERRUPTED:
            return found if best.status is Status.INFEASIBLE else replace(best, status=Status.INTERRUPTED)
        first = best.status is Status.INFEASIBLE
        # of two results that are equally good, prefer the one that has converged
        allowance = WORTHWHILE_FALL if found.status.converged and not best.status.converged else 0.0
        better = found.status is not Status.INFEASIBLE and (first or found.cost < (1.0 + allowance) * best.cost)
        gain = 1.0 if first else 1.0 - found.cost / max(best.cost, 1e-300)
        best, theta = (found, found.theta) if better else (best, theta)
        if found.status is Status.TIME_LIMIT:
            best = replace(best, status=found.status) if best.status is Status.RESTORED else best
            break
        if not better or gain < WORTHWHILE_FALL:
            break
    return replace(best, iterations=iterations)


def point_as_solution(problem: Problem, theta: Array, status: Status) -> Solution:
    """Make a solution without multipliers from a point that no solver has reached."""
    return Solution(theta, problem.cost(theta), status, 0, 0.0)


def _tightening_path(problem: Problem, theta: Array) -> list[tuple[Constraint, ...]]:
    """List the constraints of each tightening step from the radii at θ, without the last (the wanted bounds)."""
    values, limits, distances = problem.values(theta), radius_limits(problem), {}
    for c, check in limits.items():
        first = max(-np.log(max(check(values) + check.radius, 1e-300)), CLOSEST)
        distances[c] = first, max(-np.log(check.radius), first)
    count = max(1, int(np.ceil(np.log2(max(b / a for a, b in distances.values())))))
    steps = []
    for k in range(1, count):
        radii = {c: float(np.exp(-(a ** (1 - k / count)) * b ** (k / count))) for c, (a, b) in distances.items()}
        looser = {c: replace(check, radius=max(radii[c], check.radius)) for c, check in limits.items()}
        steps.append(tuple(replace(c, check=looser[c]) if c in looser else c for c in problem.constraints))
    return steps


def _scale_inside(problem: Problem, theta: Array) -> Array:
    """Scale A and B_w so that every radius is inside; return θ unchanged if fixed entries forbid it."""
    parameters = problem.model.parameters
    names = [name for name in ("A", "B_w") if name in parameters and parameters[name].size]
    values = problem.values(theta)
    room = _log_room(problem, theta)
    if room > 0 or any(np.any(parameters[k].fixed & (parameters[k].value != 0)) for k in names):
        return theta
    share = 0.999 * float(np.exp(room))
    scaled = {**values, **{k: share * values[k] for k in names}}
    start = np.concatenate([parameters.pack(scaled)[problem.free], theta[problem.n_free :]])
    return np.asarray(np.clip(start, problem.lower, problem.upper))


def _log_room(problem: Problem, theta: Array) -> float:
    """Return the least distance of the log radii from their bounds; negative outside."""
    values = problem.values(theta)
    with np.errstate(divide="ignore"):
        return min(-float(np.log1p(check(values) / check.radius)) for check in radius_limits(problem).values())


def _meets_all(problem: Problem, theta: Array) -> bool:
    """Tell whether θ meets every constraint."""
    unit = problem.constraint_units(theta)
    over = problem.excess(theta) - FEASIBILITY_TOLERANCE * or_one(unit)
    return not violated_exact(problem, theta) and bool(np.all((over <= 0) | problem.g_exact))


def _is_better(problem: Problem, theta: Array, found: Solution) -> bool:
    """Tell whether θ meets every constraint at a lower cost than the solution found."""
    if found.status is Status.INTERRUPTED or not _meets_all(problem, theta):
        return False
    return found.status is Status.INFEASIBLE or problem.cost(theta) < found.cost


def _with_time_left(ends: float, solver: GaussNewton) -> GaussNewton:
    """Return the solver with the remaining time as its limit."""
    return replace(solver, time_limit=ends - time.perf_counter())


def _solve_inside(
    problem: Problem, theta: Array, solver: GaussNewton, ends: float, progress: IterationCallback | None
) -> Solution:
    """Solve at the bounds with the smallest margin for which the eigenvalues of the result are inside."""
    found = point_as_solution(problem, theta, Status.INFEASIBLE)
    for margin in MARGINS:
        found = _solve_jury_rows(problem, theta, _with_time_left(ends, solver), margin, progress)
        if found.status is Status.INTERRUPTED or not np.isfinite(found.cost):
            break
        if found.status is not Status.INFEASIBLE:
            if not violated_exact(problem, found.theta):
                return found
            theta = found.theta
    return replace(found, status=Status.INTERRUPTED if found.status is Status.INTERRUPTED else Status.INFEASIBLE)


def _solve_jury_rows(
    problem: Problem, theta: Array, solver: GaussNewton, margin: float, progress: IterationCallback | None
) -> Solution:
    """Solve once, with the bounds on radii written as Jury's rows."""
    schur = SchurProblem(problem, theta, margin)
    found = solver.solve(schur, schur.start, progress, unfinished=True)
    multipliers = schur.multipliers(found.theta, found.multipliers)
    return replace(found, theta=schur.theta(found.theta), multipliers=multipliers)


def violated_exact(problem: Problem, theta: Array) -> list[str]:
    """List the names of the exact constraints that θ violates."""
    if not any(c.exact for c in problem.constraints):
        return []
    satisfied = problem.excess(theta) <= 0
    values = problem.values(theta)
    return [
        c.name
        for c, rows in zip(problem.constraints, problem.g_slices, strict=True)
        if c.exact and not (np.all(satisfied[rows]) if c.check is None else c.check(values) <= 0)
    ]


def move_inside_exact(problem: Problem, solution: Solution) -> Solution:
    """Move a solution inside its exact constraints; the status becomes infeasible if no small step suffices."""
    theta = solution.theta
    if solution.status is Status.INFEASIBLE or not np.isfinite(solution.cost) or not violated_exact(problem, theta):
        return solution
    hessian = problem.normal(theta)[2]
    floor = replace_rounding(np.diag(hessian), theta, Neighbours(problem.labels))
    unit = or_one(problem.constraint_units(theta, floor))
    damped = hessian + MOVE_DAMPING * np.diag(floor)
    damped += np.diag(np.where(np.diag(damped) > 0, 0.0, 1.0))
    qp, margin = QuadraticProgram(problem.size, len(unit), "daqp"), FIRST_MARGIN
    for _ in range(MOST_MOVES):
        g = problem.constraint(theta)
        room = np.where(problem.g_exact, np.minimum(margin * unit, 0.25 * (problem.g_upper - problem.g_lower)), 0.0)
        d, _, good = qp(
            damped,
            np.zeros(problem.size),
            problem.lower - theta,
            problem.upper - theta,
            problem.constraint_jacobian(theta),
            problem.g_lower + room - g,
            problem.g_upper - room - g,
        )
        trial = np.clip(theta + d, problem.lower, problem.upper)
        if not good or not np.all(problem.excess(trial) <= unit):  # the linearisation no longer holds
            break
        theta = trial
        if not violated_exact(problem, theta):
            break
        margin *= 2.0
    cost, over = problem.cost(theta), np.maximum(problem.excess(theta), 0.0)
    if violated_exact(problem, theta) or not np.isfinite(cost) or np.any(over > FEASIBILITY_TOLERANCE * unit):
        return replace(solution, status=Status.INFEASIBLE) if solution.status.converged else solution
    return replace(solution, theta=theta, cost=cost, violation=float(np.max(over, initial=0.0)))
