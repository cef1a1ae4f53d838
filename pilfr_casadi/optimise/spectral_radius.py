r"""Bounds on spectral radii: which matrices `stable` bounds, and the solve at a tight bound.

With a real Schur form `M / c = Q T Q'` at some point and `S = I + X`, X strictly block lower triangular,

    F = S⁻¹ Q' (M / c) Q S,    F below its 2 x 2 diagonal blocks = 0,

gives F the eigenvalues of its diagonal blocks. Both eigenvalues of a block lie in the unit disc if and only if (Jury)

    1 - det >= 0,   1 - tr + det >= 0,   1 + tr + det >= 0,

and so `ρ(M) <= c`: polynomial rows in M and in the extra unknowns X (zero at the point itself), smooth also where
eigenvalues meet. At a tight bound several eigenvalues lie on the circle at once, some of them equal, and a solver that
starts outside ends in poor points. `within_bounds` therefore

1. solves without the bound (or with a bound of 1 and a small slack, `loosened`) and is done where the result is inside;
2. else leads `-log ρ` from there to the bound, at most doubling it each time. Before each step `A` and `B_w` are scaled
   by one factor, which scales every bounded matrix of a PI-LFR (Krikelis et al. 2024, Eq. 15): the start is inside;
3. at the bound takes the Schur form anew until the cost stops falling.

Radii stop a share of `MARGINS` inside, so that the eigenvalues of the result, computed in floating point, never exceed
the bound: three digits of it are used. The result is a local minimum.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError
from ..models import PILFR, GeneralizedPlay, ParameterSet, PrandtlIshlinskii, element_slopes, unknown_slope
from .constraints import BeyondRadius, Constraint, linear_part, loosened, stable
from .exact_constraints import beyond, missed
from .gauss_newton import GaussNewton
from .problem import Problem
from .solution import FELT, Progress, Solution, Status

Array = np.ndarray
Solve = Callable[[Problem, "Array | None"], Solution]
NEAR = 1e-3  # distance of log ρ from its bound within which a start counts as lying at the bound
MARGINS = (2e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2)  # shares by which radii stay inside; the next where eigenvalues exceed
CLOSEST = 1e-3  # distance of log ρ from the unit circle at which tightening begins, at least
ROUNDS = 6  # Schur forms taken at the bound, at most
GAIN = 1e-4  # relative fall of the cost for which another round is worth it
STEP = GaussNewton(max_iterations=100, tolerance=1e-4)
ROW_UNIT = 1e-2  # unit of Jury's rows, next to which their violation is judged
CURVATURE = (
    1e-2  # curvature of the objective along X: damps X next to a cost of order 1 (calibrated on three tight fits)
)


@dataclass(frozen=True)
class WithElement:
    """`A + B_w S C_z` with one of an element's slopes S; a class, so that it can be sent to other processes."""

    element: Any
    slope: str

    def __call__(self, p: Mapping[str, Any]) -> Any:
        """Return the expression for named parameters p."""
        return p["A"] + p["B_w"] @ element_slopes(self.element, p)[self.slope] @ p["C_z"]


def stability(structure: PILFR, radius: float = 1.0, exact: bool = False) -> tuple[Constraint, ...]:
    """Bound the spectral radius of A, and of `A + B_w S C_z` for each slope S that the element can have.

    For plays the two cases are that no operator slips, or all do (for stops: all stick).
    """
    if structure.nx == 0:
        return ()
    limits: tuple[Constraint, ...] = (stable(radius, exact=exact),)
    element = structure.element
    if element is not None:
        symbols = {name: ca.MX.sym(name, *p.shape) for name, p in element.parameters().items()}
        for slope in element_slopes(element, symbols):
            name = f"spectral radius with the element's {slope}"
            limits += (stable(radius, WithElement(element, slope), name, exact=exact),)
    return limits


def stability_limits(structure: PILFR, bound: bool | float) -> tuple[Constraint, ...]:
    """Return the constraints that `stable=bound` of a fit stands for."""
    if bound is False:
        return ()
    if not isinstance(bound, bool | int | float | np.number) or not np.isfinite(bound):
        raise InputError(f"stable = {bound!r} was given; give True, False or the largest spectral radius, above zero.")
    return stability(structure, float(bound), exact=True)


def unbounded_sentence(structure: PILFR | None, constraints: Iterable[Constraint], p: Mapping[str, Any]) -> str:
    """Say what the bounds leave open about an element in feedback, given named numbers p; empty if nothing."""
    radii = [c.check.radius for c in constraints if isinstance(c.check, BeyondRadius)]
    element = structure.element if structure else None
    if element is None or not radii or not np.any(np.sum(np.abs(p["C_z"]), axis=1) * np.sum(np.abs(p["B_w"]), axis=0)):
        return ""
    if unknown_slope(element, p):
        return (
            "the spectral radius is bounded for the linear part alone: how steep the element is that is fed back is "
            "not known, as with envelopes of your own, so judge stability by simulations beyond the recorded amplitudes"
        )
    if not isinstance(element, PrandtlIshlinskii) or not isinstance(element.operator, GeneralizedPlay):
        return ""
    worst = 0.0
    for side in "lr":
        slope = np.diag(np.sum(p["w"], axis=1) * element.operator.steepest(side, p))
        worst = max(worst, float(np.max(np.abs(np.linalg.eigvals(p["A"] + p["B_w"] @ slope @ p["C_z"])))))
    if worst <= min(radii):
        return ""
    return (
        f"where an envelope is steepest the spectral radius is {worst:.4g}, above its bound of {min(radii):g}, which "
        "holds far out: small motions there may grow until the envelope is flatter"
    )


def check_room(parameters: ParameterSet, limits: Iterable[Constraint]) -> None:
    """Refuse bounds on the entries of A under which no A has the required spectral radius.

    Raises
    ------
    InputError
        With the bounds, the least radius that they allow and the required one.
    """
    radii = [c.check.radius for c in limits if isinstance(c.check, BeyondRadius) and c.check.matrix is linear_part]
    if not radii or "A" not in parameters or np.all(parameters["A"].fixed):
        return
    a = parameters["A"]
    low, high = (np.where(a.fixed, a.value, bound) for bound in a.bounds)
    least = least_radius(low, high)
    if least > min(radii):
        entries = low[~a.fixed], high[~a.fixed]
        raise InputError(
            f"The bounds of A, {np.min(entries[0]):g} to {np.max(entries[1]):g}, allow no spectral radius below "
            f"{least:g}, and it is to be at most {min(radii):g} so that the model is stable; widen the bounds of A, or "
            "in Python give stable=False for a model that may grow without end."
        )


def least_radius(low: Array, high: Array) -> float:
    """Bound from below the spectral radius of every matrix between `low` and `high` (n, n), entry by entry.

    Uses `ρ(A) >= |trace A| / n` and, where `low >= 0`, `ρ(A) >= ρ(low)` (Perron and Frobenius).
    """
    low_trace, high_trace = float(np.trace(low)), float(np.trace(high))
    least = max(low_trace, -high_trace, 0.0) / max(len(low), 1)
    for bound, sign in ((low, 1.0), (high, -1.0)):
        if np.all(np.isfinite(bound)) and np.all(sign * bound >= 0):
            least = max(least, float(np.max(np.abs(np.linalg.eigvals(bound)), initial=0.0)))
    return least


def radius_limits(problem: Problem) -> list[Constraint]:
    """Return the constraints of a problem that are exact bounds on a spectral radius."""
    return [c for c in problem.constraints if c.exact and isinstance(c.check, BeyondRadius)]


def below_blocks(n: int) -> Array:
    """Return the mask (n, n) of the entries below the 2 x 2 diagonal blocks (a last single one where n is odd)."""
    block = np.arange(n) // 2
    return np.asarray(block[:, None] > block[None, :])


@lru_cache(maxsize=32)
def jury_rows(n: int) -> ca.Function:
    """Build `(M, X) -> (held, low)`: Jury's rows of the diagonal blocks of F, and F below them.

    M (n, n) is over its bound; X holds the entries of `below_blocks` column by column.
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
    held = []
    for i in range(0, n, 2):
        if i + 1 < n:
            trace, det = f[i, i] + f[i + 1, i + 1], f[i, i] * f[i + 1, i + 1] - f[i, i + 1] * f[i + 1, i]
            held += [1 - det, 1 - trace + det, 1 + trace + det]
        else:
            held += [1 - f[i, i], 1 + f[i, i]]
    out = [ca.vertcat(*held), ca.vertcat(ca.SX(0, 1), *(f[i, j] for i, j in low))]
    return ca.Function("jury_rows", [m, x], [ca.densify(o) for o in out], ["M", "X"], ["held", "low"])


def schur_basis(matrix: Array) -> Array:
    """Return an orthogonal Q (n, n) with `Q' M Q` block upper triangular.

    Blocks hold complex pairs, and those real eigenvalues that are nearest to each other: only these may become a pair.
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
    """Choose the diagonal entries of a real Schur form that form the first block."""
    double = np.flatnonzero(np.diag(t, -1))
    if len(double):
        return int(double[0]), int(double[0]) + 1
    order = np.argsort(np.diag(t))
    value = np.diag(t)[order]
    if len(order) % 2 == 0:
        return int(order[0]), int(order[1])
    # an odd number leaves one alone: the one whose removal leaves the smallest gaps
    gaps = [np.sum(np.diff(np.delete(value, k))[::2]) for k in range(0, len(order), 2)]
    left = np.delete(order, 2 * int(np.argmin(gaps)))
    return int(left[0]), int(left[1])


class _Bound:
    """One bounded matrix: M over its radius as a Function of p, the Schur basis Q, and Jury's rows with slopes."""

    def __init__(self, problem: Problem, limit: Constraint, theta: Array, margin: float) -> None:
        check, parameters = limit.check, problem.model.parameters
        assert isinstance(check, BeyondRadius)
        p = ca.MX.sym("p", parameters.size)
        scaled = ca.densify(check.matrix(parameters.symbols(p))) / (check.radius * (1.0 - margin))
        self.limit = limit
        self.matrix = ca.Function("matrix", [p], [scaled], ["p"], ["M"])
        self.slope = ca.Function("matrix_slope", [p], [ca.densify(ca.jacobian(ca.vec(scaled), p))], ["p"], ["jac"])
        self.basis = schur_basis(np.asarray(self.matrix(problem.parameters(theta))))
        self.rows = jury_rows(len(self.basis))
        self.rows_slope = self.rows.jacobian()
        self.unknowns = self.rows.size1_in(1)
        self.held, self.low = self.rows.size1_out(0), self.rows.size1_out(1)

    def turned(self, p: Array) -> Array:
        """Return `Q' M Q`."""
        return np.asarray(self.basis.T @ np.asarray(self.matrix(p)) @ self.basis)

    def values(self, p: Array, x: Array) -> Array:
        """Return Jury's rows, then the entries below the blocks."""
        return np.concatenate([np.asarray(v).ravel() for v in self.rows(self.turned(p), x)])

    def slopes(self, p: Array, x: Array) -> tuple[Array, Array]:
        """Return the rows' Jacobians with respect to `vec(Q' M Q)` and to X."""
        held_m, held_x, low_m, low_x = self.rows_slope(self.turned(p), x, 0, 0)
        return np.vstack([np.asarray(held_m), np.asarray(low_m)]), np.vstack([np.asarray(held_x), np.asarray(low_x)])


class SchurProblem:
    """A problem whose exact bounds on spectral radii are Jury's rows in extra unknowns X.

    Parameters
    ----------
    problem : Problem
        Problem with such bounds; its simulation error does not depend on X.
    theta : array, shape (n,)
        Point at which the Schur forms are taken.
    margin : float
        Share by which the radii are held below their bounds and other exact constraints, in their units, inside.
    """

    def __init__(self, problem: Problem, theta: Array, margin: float) -> None:
        self.problem = problem
        limits = radius_limits(problem)
        self.kept = np.flatnonzero(np.repeat([c not in limits for c in problem.constraints], problem.g_sizes))
        self.bounds = [_Bound(problem, c, theta, margin) for c in limits]
        extra = [b.unknowns for b in self.bounds]
        self.places = [slice(a, b) for a, b in pairwise(problem.size + np.cumsum([0, *extra]))]
        self.labels = (*problem.labels, *(f"X{k}[{i},0]" for k, m in enumerate(extra) for i in range(m)))
        free = np.full(sum(extra), np.inf)
        self.lower, self.upper = np.concatenate([problem.lower, -free]), np.concatenate([problem.upper, free])
        self.start = np.concatenate([theta, np.zeros(sum(extra))])
        exact = np.repeat([c.exact for c in problem.constraints], problem.g_sizes).astype(bool)
        room = np.where(exact, margin * problem.constraint_units(theta), 0.0)
        room = np.minimum(room, 0.25 * (problem.g_upper - problem.g_lower))[self.kept]
        top = [np.concatenate([np.full(b.held, np.inf), np.zeros(b.low)]) for b in self.bounds]
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
        n_free, p = int(problem.free.sum()), problem.parameters(theta)
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
        n = self.problem.size
        units = self.problem.constraint_units(self.theta(x), None if squares is None else squares[:n])
        return np.concatenate([units[self.kept], np.full(len(self.g_lower) - len(self.kept), ROW_UNIT)])

    def multipliers(self, x: Array, found: Array) -> Array:
        """Return multipliers of the problem's own limits; of a radius with respect to its logarithm."""
        problem, n = self.problem, self.problem.size
        out = np.zeros(n + len(problem.g_lower))
        if len(found) != self.size + len(self.g_lower):
            return out
        out[:n], rows = found[:n], found[self.size :]
        out[n + self.kept] = rows[: len(self.kept)]
        p, row, first = problem.parameters(self.theta(x)), len(self.kept), np.cumsum([0, *problem.g_sizes])
        for bound, at in zip(self.bounds, self.places, strict=True):
            by_m = bound.slopes(p, x[at])[0]
            force = float(rows[row : row + len(by_m)] @ by_m @ bound.turned(p).ravel(order="F"))
            out[n + first[problem.constraints.index(bound.limit)]] = max(force, 0.0)
            row += len(by_m)
        return out


def within_bounds(
    problem: Problem,
    start: Array | None,
    solve: Solve,
    last: GaussNewton = STEP,
    held: bool = False,
    progress: Progress | None = None,
) -> Solution:
    """Solve a problem that may have exact bounds on spectral radii.

    Parameters
    ----------
    problem : Problem
    start : array, shape (n,), optional
        By default the problem's own.
    solve : callable
        Solves a problem from a start; any solver.
    last : GaussNewton
        Options of the solves at the bounds themselves.
    held : bool
        Whether the bounds are known to hold the solution; the solve without them is then left out.
    progress : callable
        Receives the iterations of `last`.
    """
    if not radius_limits(problem):
        return solve(problem, start)
    ends = time.perf_counter() + last.time_limit
    given = begin = problem.start if start is None else start
    if not held:
        found = solve(with_constraints(problem, loosened(problem.constraints)), start)
        if found.status in (Status.INTERRUPTED, Status.DIVERGED_START) or _room(problem, found.theta) >= 0:
            return found
        begin = begin if at_bounds(problem, begin) else found.theta
    tightened = tighten(problem, begin, _until(ends, last), progress)
    if begin is not given and _beats(problem, given, tightened):
        tightened = tighten(problem, given, _until(ends, last), progress)
    return tightened


def at_bounds(problem: Problem, theta: Array) -> bool:
    """Whether a point is inside every exact bound on a radius and close to one; False where there is none."""
    return bool(radius_limits(problem)) and 0 <= _room(problem, theta) <= NEAR


def held_at_bounds(problem: Problem, theta: Array, solution: Solution) -> bool:
    """Whether a bound on a radius holds a point in place, judged by the solution's multipliers where it has any."""
    limits, force = radius_limits(problem), np.abs(solution.multipliers[problem.size :])
    rows = np.repeat([c in limits for c in problem.constraints], problem.g_sizes).astype(bool)
    idle = len(force) == len(rows) and bool(np.max(force[rows], initial=0.0) <= FELT * solution.cost)  # nan is unknown
    return not idle and at_bounds(problem, theta)


def tighten(problem: Problem, theta: Array, last: GaussNewton, progress: Progress | None = None) -> Solution:
    """Lead the bounds from the radii at θ to where they are wanted, and return the best solution inside."""
    if not np.isfinite(problem.cost(theta)):
        theta = _scaled(problem, theta)
    if not np.isfinite(problem.cost(theta)):
        return unsolved(problem, theta, Status.DIVERGED_START)
    ends = time.perf_counter() + last.time_limit
    for constraints in _path(problem, theta):
        step = with_constraints(problem, constraints)
        found = _solve_rows(step, _scaled(step, theta), _until(ends, STEP), MARGINS[0], progress)
        if found.status is Status.INTERRUPTED:
            return found
        theta = found.theta if found.status is not Status.INFEASIBLE else theta
    theta, iterations = _scaled(problem, theta), 0
    best = unsolved(problem, theta, Status.RESTORED if _met(problem, theta) else Status.INFEASIBLE)
    for _ in range(ROUNDS):
        found = _solve_inside(problem, theta, last, ends, progress)
        iterations += found.iterations
        if found.status is Status.INTERRUPTED:
            return found if best.status is Status.INFEASIBLE else replace(best, status=Status.INTERRUPTED)
        first = best.status is Status.INFEASIBLE
        # of two results that are equally good, prefer the one that has converged
        allowance = GAIN if found.status.converged and not best.status.converged else 0.0
        better = found.status is not Status.INFEASIBLE and (first or found.cost < (1.0 + allowance) * best.cost)
        gain = 1.0 if first else 1.0 - found.cost / max(best.cost, 1e-300)
        best, theta = (found, found.theta) if better else (best, theta)
        if found.status is Status.TIME_LIMIT:
            best = replace(best, status=found.status) if best.status is Status.RESTORED else best
            break
        if not better or gain < GAIN:
            break
    return replace(best, iterations=iterations)


def with_constraints(problem: Problem, constraints: tuple[Constraint, ...]) -> Problem:
    """Return the same problem under other constraints."""
    names = ("engine", "l1", "noise", "scale", "weights", "threads")
    given: dict[str, Any] = {name: getattr(problem, name) for name in names}
    return Problem(problem.model, problem.recordings, constraints=constraints, **given)


def unsolved(problem: Problem, theta: Array, status: Status) -> Solution:
    """Return a point to which no step of a solver has led: its multipliers are not known."""
    return Solution(theta, problem.cost(theta), status, 0, 0.0)


def _path(problem: Problem, theta: Array) -> list[tuple[Constraint, ...]]:
    """Return the constraints with the bounds on their way from the radii at θ, the wanted bounds left out."""
    values, ways = problem.model.parameters.unpack(problem.parameters(theta)), {}
    for c in radius_limits(problem):
        assert isinstance(c.check, BeyondRadius)
        first = max(-np.log(max(c.check(values) + c.check.radius, 1e-300)), CLOSEST)
        ways[c] = first, max(-np.log(c.check.radius), first)
    count = max(1, int(np.ceil(np.log2(max(b / a for a, b in ways.values())))))
    steps = []
    for k in range(1, count):
        radii = {c: float(np.exp(-(a ** (1 - k / count)) * b ** (k / count))) for c, (a, b) in ways.items()}
        steps.append(tuple(_loosen(c, radii[c]) if c in radii else c for c in problem.constraints))
    return steps


def _loosen(c: Constraint, radius: float) -> Constraint:
    """Move a bound to a larger radius."""
    assert isinstance(c.check, BeyondRadius)
    return replace(c, check=replace(c.check, radius=max(radius, c.check.radius)))


def _scaled(problem: Problem, theta: Array) -> Array:
    """Scale A and B_w so that every radius is inside; return θ as it is where they may not be scaled."""
    parameters = problem.model.parameters
    names = [name for name in ("A", "B_w") if name in parameters and parameters[name].size]
    values = parameters.unpack(problem.parameters(theta))
    room = _room(problem, theta)
    if room > 0 or any(np.any(parameters[k].fixed & (parameters[k].value != 0)) for k in names):
        return theta
    share = 0.999 * float(np.exp(room))
    scaled = {**values, **{k: share * values[k] for k in names}}
    start = np.concatenate([parameters.pack(scaled)[problem.free], theta[int(problem.free.sum()) :]])
    return np.asarray(np.clip(start, problem.lower, problem.upper))


def _room(problem: Problem, theta: Array) -> float:
    """Return the least distance of the log radii from their bounds; negative outside."""
    values, out = problem.model.parameters.unpack(problem.parameters(theta)), np.inf
    for c in radius_limits(problem):
        assert isinstance(c.check, BeyondRadius)
        excess = c.check(values)
        out = min(out, -float(np.log1p(max(excess / c.check.radius, -1.0 + 1e-300))) if excess else 0.0)
    return out


def _met(problem: Problem, theta: Array) -> bool:
    """Whether θ meets every constraint."""
    own = np.repeat([c.exact for c in problem.constraints], problem.g_sizes)  # these have a check of their own
    return not beyond(problem, theta) and not np.any(missed(problem, theta) & ~own)


def _beats(problem: Problem, theta: Array, found: Solution) -> bool:
    """Whether θ meets every constraint at a lower cost than the solution found."""
    if found.status is Status.INTERRUPTED or not _met(problem, theta):
        return False
    return found.status is Status.INFEASIBLE or problem.cost(theta) < found.cost


def _until(ends: float, solver: GaussNewton) -> GaussNewton:
    """Return the solver with the time that is left."""
    return replace(solver, time_limit=ends - time.perf_counter())


def _solve_inside(
    problem: Problem, theta: Array, solver: GaussNewton, ends: float, progress: Progress | None
) -> Solution:
    """Solve at the bounds, with a margin wide enough that the eigenvalues of the result are inside."""
    found = unsolved(problem, theta, Status.INFEASIBLE)
    for margin in MARGINS:
        found = _solve_rows(problem, theta, _until(ends, solver), margin, progress)
        if found.status is Status.INTERRUPTED or not np.isfinite(found.cost):
            break
        if found.status is not Status.INFEASIBLE:
            if not beyond(problem, found.theta):
                return found
            theta = found.theta
    return replace(found, status=Status.INTERRUPTED if found.status is Status.INTERRUPTED else Status.INFEASIBLE)


def _solve_rows(
    problem: Problem, theta: Array, solver: GaussNewton, margin: float, progress: Progress | None
) -> Solution:
    """Solve once with the radii as Jury's rows."""
    schur = SchurProblem(problem, theta, margin)
    found = solver.solve(schur, schur.start, progress, unfinished=True)
    multipliers = schur.multipliers(found.theta, found.multipliers)
    return replace(found, theta=schur.theta(found.theta), multipliers=multipliers)
