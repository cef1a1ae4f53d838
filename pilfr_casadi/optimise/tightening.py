r"""A solve under exact bounds on spectral radii: without them first, then with bounds that are tightened step by step.

At a tight bound several eigenvalues lie on the circle at once, some of them equal, and a solver that starts there or
outside ends in poor points. So

1. the problem is solved with every such bound at 1 or above (`constraints.loosened`); where the result is inside, it is
   the solution, also of a start next to a bound, which may hold nothing;
2. else `-log ρ` is led from where it is to the bound, at most doubled at a time; before each step `A` and `B_w`
   are scaled by one factor, which scales every matrix of a PI-LFR whose radius is bounded (Krikelis et al. 2024,
   Eq. 15, and the same with the element's slope): the start is inside. Each step is a Gauss-Newton solve with the
   bound as smooth rows in further unknowns (`lifted`), in the coordinates in which `A` is block triangular where they
   are free, in any where they are not;
3. at the bound the Schur forms are taken anew until nothing improves, and the radii are held inside by a margin that
   grows until the eigenvalues of the numbers themselves are inside.

What results is a minimum in the feasible set, not merely a point of it; which one is a matter of the start. Where the
start itself is inside and better, 2 begins there.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from .constraints import BeyondRadius, Constraint, loosened
from .exactness import beyond, missed
from .gauss_newton import GaussNewton
from .lifted import Lifted, back, radius_limits, rotated
from .problem import Problem
from .solution import FELT, Progress, Solution, Status

Array = np.ndarray
Solve = Callable[[Problem, "Array | None"], Solution]
NEAR = 1e-3  # how near to its bound a start is taken for held by it, in the logarithm
INSIDE = (2e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2)  # margins, next to the bound
FIRST = 1e-3  # least distance from the unit circle, in the logarithm, from which tightening begins
ROUNDS = 6  # Schur forms taken at the bound
GAIN = 1e-4  # relative gain of a round that another one follows
STEP = GaussNewton(max_iterations=100, tolerance=1e-4)


def within_bounds(
    problem: Problem,
    start: Array | None,
    solve: Solve,
    last: GaussNewton = STEP,
    held: bool = False,
    progress: Progress | None = None,
) -> Solution:
    """The solution of a problem that may have exact bounds on spectral radii.

    Parameters
    ----------
    problem : Problem
    start : array, shape (n,), optional
        By default the problem's own.
    solve : callable
        Solves a problem from a start, however it likes.
    last : GaussNewton
        Options of the solves at the bounds themselves.
    held : bool
        Whether the bounds are known to hold the solution, so that there is no use in solving without them.
    progress : callable
        Gets the iterations of `last`.
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
    if tightened.status is not Status.INFEASIBLE or time.perf_counter() > ends:
        return tightened
    other = solve(problem, start)  # the bound as one row, for what no scaling brings inside
    return other if other.status is not Status.INFEASIBLE else tightened


def at_bounds(problem: Problem, theta: Array) -> bool:
    """Whether a point is inside every exact bound on a radius and next to one; False where there is none."""
    return bool(radius_limits(problem)) and 0 <= _room(problem, theta) <= NEAR


def held_at_bounds(problem: Problem, theta: Array, solution: Solution) -> bool:
    """Whether a point is next to a bound that holds it, by the solution's multipliers where it has any."""
    limits, force = radius_limits(problem), np.abs(solution.multipliers[problem.size :])
    rows = np.repeat([c in limits for c in problem.constraints], problem.g_sizes).astype(bool)
    idle = len(force) == len(rows) and bool(np.max(force[rows], initial=0.0) <= FELT * solution.cost)  # nan is unknown
    return not idle and at_bounds(problem, theta)


def _beats(problem: Problem, theta: Array, found: Solution) -> bool:
    """Whether θ is inside every constraint, and better than what was found."""
    if found.status is Status.INTERRUPTED or not _met(problem, theta):
        return False
    return found.status is Status.INFEASIBLE or problem.cost(theta) < found.cost


def _met(problem: Problem, theta: Array) -> bool:
    """Whether θ is inside every constraint."""
    own = np.repeat([c.exact for c in problem.constraints], problem.g_sizes)  # these have a check of their own
    return not beyond(problem, theta) and not np.any(missed(problem, theta) & ~own)


def _until(ends: float, solver: GaussNewton) -> GaussNewton:
    """The solver with what is left of the time."""
    return replace(solver, time_limit=ends - time.perf_counter())


def tighten(problem: Problem, theta: Array, last: GaussNewton, progress: Progress | None = None) -> Solution:
    """The best solution inside that is found when the bounds are tightened from where θ is."""
    if not np.isfinite(problem.cost(theta)):
        theta = _scaled(problem, theta)
    if not np.isfinite(problem.cost(theta)):
        return _unsolved(problem, theta, Status.DIVERGED_START)
    ends = time.perf_counter() + last.time_limit
    for constraints in list(_steps(problem, theta))[:-1]:
        step = with_constraints(problem, constraints)
        found = _at_bound(step, _scaled(step, theta), _until(ends, STEP), INSIDE[0], True, progress)
        if found.status is Status.INTERRUPTED:
            return found
        theta = found.theta if found.status is not Status.INFEASIBLE else theta
    theta = _scaled(problem, theta)
    best, coordinates, iterations = _unsolved(problem, theta, Status.RESTORED), True, 0
    if not _met(problem, theta):
        best = replace(best, status=Status.INFEASIBLE)
    for _ in range(ROUNDS):
        found = _inside(problem, theta, last, ends, coordinates, progress)
        iterations += found.iterations
        if found.status is Status.INTERRUPTED:
            return found if best.status is Status.INFEASIBLE else replace(best, status=Status.INTERRUPTED)
        first = best.status is Status.INFEASIBLE
        # of two that are as good the one that has converged
        margin = GAIN if found.status.converged and not best.status.converged else 0.0
        better = found.status is not Status.INFEASIBLE and (first or found.cost < (1.0 + margin) * best.cost)
        gain = 1.0 if best.status is Status.INFEASIBLE else 1.0 - found.cost / max(best.cost, 1e-300)
        best, theta = (found, found.theta) if better else (best, theta)
        if found.status is Status.TIME_LIMIT:
            best = replace(best, status=found.status) if best.status is Status.RESTORED else best
            break
        if not better or gain < GAIN:
            if not coordinates:
                break
            coordinates = False  # the last word has a solve in any coordinates
    return replace(best, iterations=iterations)


def with_constraints(problem: Problem, constraints: tuple[Constraint, ...]) -> Problem:
    """The same problem under other constraints."""
    names = ("engine", "l1", "noise", "scale", "weights", "threads")
    given: dict[str, Any] = {name: getattr(problem, name) for name in names}
    return Problem(problem.model, problem.recordings, constraints=constraints, **given)


def _steps(problem: Problem, theta: Array) -> list[tuple[Constraint, ...]]:
    """The constraints with the bounds on their way to where they are asked for, which come last."""
    values, ways = problem.model.parameters.unpack(problem.parameters(theta)), {}
    for c in radius_limits(problem):
        assert isinstance(c.check, BeyondRadius)
        first = max(-np.log(max(c.check(values) + c.check.radius, 1e-300)), FIRST)
        ways[c] = first, max(-np.log(c.check.radius), first)
    count = max(1, int(np.ceil(np.log2(max(b / a for a, b in ways.values())))))
    steps = []
    for k in range(1, count):
        at = {c: float(np.exp(-(a ** (1 - k / count)) * b ** (k / count))) for c, (a, b) in ways.items()}
        steps.append(tuple(_moved(c, at[c]) if c in at else c for c in problem.constraints))
    return [*steps, problem.constraints]


def _moved(c: Constraint, radius: float) -> Constraint:
    """The same bound at another radius, where that is larger."""
    assert isinstance(c.check, BeyondRadius)
    return replace(c, check=replace(c.check, radius=max(radius, c.check.radius)))


def _scaled(problem: Problem, theta: Array) -> Array:
    """θ with A and B_w scaled so that every radius is inside; as it is where they may not be scaled."""
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
    """How far inside their bounds the radii are, in the logarithm: the least; negative outside."""
    values, out = problem.model.parameters.unpack(problem.parameters(theta)), np.inf
    for c in radius_limits(problem):
        assert isinstance(c.check, BeyondRadius)
        excess = c.check(values)
        out = min(out, -float(np.log1p(max(excess / c.check.radius, -1.0 + 1e-300))) if excess else 0.0)
    return out


def _inside(
    problem: Problem, theta: Array, solver: GaussNewton, ends: float, coordinates: bool, progress: Progress | None
) -> Solution:
    """A solve at the bounds, held so far inside that the eigenvalues of the result are; infeasible where none is."""
    found = _unsolved(problem, theta, Status.INFEASIBLE)
    for inside in INSIDE:
        found = _at_bound(problem, theta, _until(ends, solver), inside, coordinates, progress)
        if found.status is Status.INTERRUPTED or not np.isfinite(found.cost):
            break
        if found.status is not Status.INFEASIBLE:
            if not beyond(problem, found.theta):
                return found
            theta = found.theta
    return replace(found, status=Status.INTERRUPTED if found.status is Status.INTERRUPTED else Status.INFEASIBLE)


def _at_bound(
    problem: Problem, theta: Array, solver: GaussNewton, inside: float, coordinates: bool, progress: Progress | None
) -> Solution:
    """One solve with the radii as smooth rows, in free coordinates of the states where there are any."""
    turned = rotated(problem, theta) if coordinates else None
    held, begin = turned or (problem, theta)
    lifted = Lifted(held, begin, inside, triangular=turned is not None)
    found = solver.solve(lifted, lifted.start, progress, unfinished=True)
    there = lifted.theta(found.theta)
    force = lifted.multipliers(found.theta, found.multipliers)
    multipliers = np.zeros(problem.size + len(problem.g_lower))
    loose = np.flatnonzero(held.free[problem.free])
    multipliers[loose] = force[: len(loose)]
    multipliers[int(problem.free.sum()) :] = force[len(loose) :]
    return replace(found, theta=back(problem, held, there), multipliers=multipliers)


def _unsolved(problem: Problem, theta: Array, status: Status) -> Solution:
    return Solution(theta, problem.cost(theta), status, 0, 0.0)  # multipliers are not known
