"""Damped Gauss-Newton SQP for the simulation-error problem.

Each step solves the quadratic program

    minimise  1/2 d'(H + λ D)d + g'd   subject to  lower <= θ + d <= upper,  lower_g <= g(θ) + ∇g d <= upper_g,

with `H` the Gauss-Newton Hessian and `D` the largest diagonal of `H` seen so far (Marquardt 1963; Moré 1978), in which
`replace_rounding` replaces entries that are rounding. At the usual start (`B_w = 0`) whole columns of the Jacobian
vanish and a state space is over-parametrised, so damping is needed and has to know the scales. Trial points are judged
by simulation alone. `Damping` holds λ and the rule by which it follows the gain ratio (Nielsen 1999).

General constraints enter an exact penalty `μ Σ violation` (`ExactPenalty`), with a second-order correction when a step
along their tangent violates them. A run may stray into a region where violating the constraints lowers the merit and
linear steps do not lead back. A run that ends worse than its cheapest feasible point (`BestFeasible`) is continued from
that point, with more damping and a larger penalty.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import casadi as ca
import numpy as np

from .._base import InputError, abandoned, handled_interrupt, unwrapped_interrupt
from ..models import Neighbours
from .constraints import FEASIBILITY_TOLERANCE
from .quadratic_program import SMALLEST_DIVISOR, QuadraticProgram, Step
from .solution import Iteration, IterationCallback, Solution, Status, check_solver_options

FEASIBLE_VIOLATION = 1e-9  # violation, in units of the constraints, up to which a point is feasible
ROUNDING_VIOLATION = 1e-12  # violation that rounding alone can cause
MOST_RETURNS = 4  # how often a run that has strayed may return to its best feasible point
ENDED = (Status.CONVERGED, Status.SMALL_STEP, Status.SOLVER_FAILED)  # the run cannot improve its point
KINK_SHARE = 1e-3  # predicted but unreachable improvement, as a share of the cost, that reveals a kink
ZERO_COST = 1e-24  # cost that counts as zero: outputs are off by 1e-12 of their size
ZERO_COLUMN = 1e-20  # squared column norm, relative to the largest of its matrix, that counts as zero
ZERO_SIZE = 1e-100  # size of a variable that counts as zero
SHRUNKEN_UNIT = 1e-2  # share of its first unit below which the unit of a constraint is replaced
ACCEPTED_RATIO = 1e-4  # gain ratio from which a step is accepted: any real descent (Moré 1978)
NEGLIGIBLE = 1e-3  # share of the tolerance below which a predicted improvement does not justify more damping
LEAST_DAMPING, MOST_DAMPING = 1e-12, 1e12  # λ outside which H + λ D equals H, or λ D, to rounding
RESTART_FACTOR = 10.0  # factor on the first λ of each return to the best feasible point
PENALTY_FACTOR = 1.5  # on the largest multiplier: an exact penalty needs more than 1 (Powell 1978)
# shares of the violation that a step removes, tried in turn until the quadratic program is feasible
VIOLATION_SHARES = (1.0, 0.5, 0.1, 0.01, 0.0)
Watch = Callable[[np.ndarray], bool]


class Minimisation(Protocol):
    """Problem as the solver sees it: a `Problem`, or one with extra unknowns (`exact_limits.SchurProblem`)."""

    labels: tuple[str, ...]
    start: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    g_lower: np.ndarray
    g_upper: np.ndarray

    @property
    def size(self) -> int:
        """Number of variables n."""

    def cost(self, theta: np.ndarray, /) -> float:
        """Return the objective; infinite where the simulation diverges."""

    def normal(self, theta: np.ndarray, /) -> tuple[float, np.ndarray, np.ndarray]:
        """Return objective, gradient (n,) and Gauss-Newton Hessian (n, n)."""

    def constraint(self, theta: np.ndarray, /) -> np.ndarray:
        """Return the general constraints (n_g,)."""

    def constraint_jacobian(self, theta: np.ndarray, /) -> np.ndarray:
        """Return the Jacobian of the general constraints (n_g, n)."""

    def constraint_units(self, theta: np.ndarray, squares: np.ndarray | None = None, /) -> np.ndarray:
        """Return the unit of each general constraint (n_g,), see `Problem.constraint_units`."""


@dataclass(frozen=True)
class Damping:
    """Levenberg-Marquardt λ with the factor by which the next rejected step raises it (Nielsen 1999)."""

    value: float
    growth: float = 2.0

    def after_success(self, ratio: float) -> Damping:
        """Multiply λ by a factor from 1/3 (good step) to 2 (poor step), by the gain ratio (actual over predicted)."""
        return Damping(self.value * max(1 / 3, 1.0 - (2.0 * min(ratio, 1.0) - 1.0) ** 3))

    def after_failure(self) -> Damping:
        """Raise λ, faster with every rejected step."""
        return Damping(self.value * self.growth, 2.0 * self.growth)

    def within(self, low: float, high: float) -> Damping:
        """Clip λ."""
        return Damping(min(max(self.value, low), high), self.growth)


def replace_rounding(squares: np.ndarray, theta: np.ndarray, neighbours: Neighbours) -> np.ndarray:
    """Replace squared column norms (n,) that are zero or rounding.

    A column is rounding if it is negligible beside the others of its matrix and if a change of its variable by its own
    size does not change the outputs, as for a state that is not excited. It gets the norm with which that change would
    change the outputs by their own size, so that damping suppresses steps along it.
    """
    size = neighbours.sizes(theta)
    idle = (squares <= ZERO_COLUMN * neighbours.largest(squares)) & (squares * size**2 <= ZERO_COLUMN)
    return np.asarray(np.where(idle, 1.0 / np.where(size > ZERO_SIZE, size, 1.0) ** 2, squares))


class ExactPenalty:
    """General constraints in their units, and the exact penalty `μ Σ violation` by which steps are judged.

    The weight μ follows the multipliers by Powell's rule (1978): it is 1.5 times the largest multiplier, or half-way
    down to that from its last value, but not below `least`. A weight that only grew would stay as large as the
    multipliers far from the solution and make the solver crawl. The units (n_g,) are fixed at the first point where a
    constraint has a slope (`Problem.constraint_units`).
    """

    def __init__(self, problem: Minimisation) -> None:
        self.problem, n_g = problem, len(problem.g_lower)
        self.unit, self._known = np.ones(n_g), np.zeros(n_g, dtype=bool)
        self.weight, self.least = 0.0, 0.0

    def measure_units(self, theta: np.ndarray, squares: np.ndarray) -> None:
        """Fix the units of constraints that have a slope at θ and had none before."""
        if not np.all(self._known):
            unit = self.problem.constraint_units(theta, squares)
            first = ~self._known & (unit > 0)
            self.unit[first], self._known[first] = unit[first], True

    def shrink_units(self, theta: np.ndarray) -> bool:
        """Adopt the units at θ that are far smaller than before; tell whether only they reveal a violation.

        The first unit of a constraint near a pole, such as a gain beside an integrator, may be immense.
        """
        if not len(self.unit):
            return False
        unit, before = self.problem.constraint_units(theta), self.violations(theta)
        smaller = self._known & (unit > 0) & (unit < SHRUNKEN_UNIT * self.unit)
        self.unit = np.where(smaller, unit, self.unit)
        return bool(np.any((before <= FEASIBILITY_TOLERANCE) & (self.violations(theta) > FEASIBILITY_TOLERANCE)))

    def values(self, theta: np.ndarray) -> np.ndarray:
        """Return the constraints in their units, shape (n_g,)."""
        return self.problem.constraint(theta) / self.unit if len(self.unit) else np.zeros(0)

    def slope(self, theta: np.ndarray) -> np.ndarray:
        """Return the Jacobian of `values`, shape (n_g, n)."""
        return self.problem.constraint_jacobian(theta) / self.unit[:, None]

    def room(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances from values to the lower and to the upper limits, (n_g,) each."""
        return self.problem.g_lower / self.unit - values, self.problem.g_upper / self.unit - values

    def violations(self, theta: np.ndarray) -> np.ndarray:
        """Return the violation of each constraint in its unit, shape (n_g,); infinite where it cannot be evaluated."""
        if not len(self.unit):
            return np.zeros(0)
        low, high = self.room(self.values(theta))
        over = np.maximum(np.maximum(low, -high), 0.0)
        return np.where(np.isnan(over), np.inf, over)

    def violation(self, theta: np.ndarray) -> float:
        """Return the summed violation."""
        return float(self.violations(theta).sum())

    def follow(self, multipliers: np.ndarray) -> None:
        """Adapt the weight to the constraints' multipliers (n_g,)."""
        if len(multipliers):
            needed = PENALTY_FACTOR * float(np.max(np.abs(multipliers)))
            self.weight = max(needed, 0.5 * (self.weight + needed), self.least)

    def raise_to(self, weight: float) -> None:
        """Raise the weight and its lower bound to `weight`, at least to twice the present lower bound."""
        self.weight = self.least = max(weight, 2.0 * self.least)


class BestFeasible:
    """Cheapest feasible point of a run, and the weight μ of the penalty above which no infeasible point beats it.

        μ > max (cost of the best - cost) / violation.

    Another feasible point is worse if its cost is higher by more than the share `tolerance`.
    """

    def __init__(self, tolerance: float) -> None:
        self.tolerance, self.cost, self.weight_needed = tolerance, np.inf, 0.0
        self.theta = self.multipliers = np.zeros(0)

    def update(self, cost: float, violation: float, theta: np.ndarray, multipliers: np.ndarray) -> None:
        """Update the best point, or the weight needed, with a point and its summed violation."""
        if violation > FEASIBILITY_TOLERANCE:
            self.weight_needed = max(
                self.weight_needed, (self.cost - cost) / violation if np.isfinite(self.cost) else 0.0
            )
        elif cost < self.cost:
            self.cost, self.theta, self.multipliers = cost, theta, multipliers

    def beats(self, cost: float, violation: float) -> bool:
        """Tell whether the best feasible point beats one of this cost and violation."""
        worse = violation > FEASIBILITY_TOLERANCE or cost > self.cost * (1.0 + self.tolerance)
        return bool(np.isfinite(self.cost)) and worse


@dataclass(frozen=True)
class GaussNewton:
    """Options of the damped Gauss-Newton SQP.

    Parameters
    ----------
    max_iterations : int
        Steps, rejected ones included.
    tolerance : float
        Stop when the cost improved by less than this share over `patience` iterations, or the model predicts less.
    patience : int
        Iterations over which the improvement is measured.
    damping : float
        First Levenberg-Marquardt λ (see `Damping`); larger values give shorter first steps.
    time_limit : float
        Seconds for one solve, including its repetitions at a bound on a spectral radius. A fit makes several solves.
    qp : str
        CasADi conic plugin.

    Raises
    ------
    InputError
        If CasADi has no such plugin.
    """

    max_iterations: int = 200
    tolerance: float = 1e-5
    patience: int = 5
    damping: float = 1e-2
    time_limit: float = np.inf
    qp: str = "daqp"

    def __post_init__(self) -> None:
        check_solver_options(self)
        if not ca.has_conic(str(self.qp)):
            raise InputError(
                f"The QP solver {self.qp!r} is not available; use 'daqp', or another conic plugin of CasADi."
            )

    def solve(
        self,
        problem: Minimisation,
        start: np.ndarray | None = None,
        progress: IterationCallback | None = None,
        watch: Watch | None = None,
        unfinished: bool = False,
    ) -> Solution:
        """Minimise from `start` (n,), by default the problem's own.

        `watch` receives every accepted point and ends the run by returning True. A run that reaches its limit of
        iterations or time returns its best feasible point; with `unfinished` it returns its last point, feasible or
        not, from which another run can continue.
        """
        return _Run(self, problem, problem.start if start is None else start, progress, watch).run(unfinished)


class _Run:
    """One solve: the point, its derivatives and the damping; constraints and their multipliers are in units."""

    def __init__(
        self,
        options: GaussNewton,
        problem: Minimisation,
        start: np.ndarray,
        progress: IterationCallback | None,
        watch: Watch | None,
    ) -> None:
        self.options, self.problem, self.progress, self.watch = options, problem, progress, watch
        self.theta = np.clip(np.asarray(start, dtype=float), problem.lower, problem.upper)
        self.penalty, self.best = ExactPenalty(problem), BestFeasible(options.tolerance)
        self.n_g = len(problem.g_lower)
        self.qp = QuadraticProgram(problem.size, self.n_g, options.qp)
        self.damping, self.tried = Damping(options.damping), 0
        self.multipliers = np.zeros(problem.size + self.n_g)
        self.history: list[Iteration] = []
        self.interrupted = False
        self.began = time.perf_counter()

    def run(self, unfinished: bool) -> Solution:
        """Iterate, return to the best feasible point where the run strays, and collect the solution."""
        status = Status.MAX_ITERATIONS
        self.cost = self.problem.cost(self.theta)
        if not np.isfinite(self.cost):
            return self._finish(Status.DIVERGED_START)
        try:
            with handled_interrupt(self._interrupt), unwrapped_interrupt():
                status = self._iterate()
                for k in range(MOST_RETURNS):
                    if status in ENDED and self.penalty.shrink_units(self.theta):
                        self.best = BestFeasible(self.options.tolerance)
                    elif self._has_strayed(status):
                        self._go_back()
                        self.penalty.raise_to(2.0 * self.best.weight_needed)
                    else:
                        break
                    self.damping = Damping(self.options.damping * RESTART_FACTOR**k)
                    status = self._iterate()
        except KeyboardInterrupt:
            status = Status.INTERRUPTED
        finally:
            abandoned.pending = False
        continues = unfinished and status in (Status.MAX_ITERATIONS, Status.TIME_LIMIT)
        if not continues and self.best.beats(self.cost, self.penalty.violation(self.theta)):
            status = Status.SOLVER_FAILED if self._has_strayed(status) else status
            self._go_back()
        self.penalty.shrink_units(self.theta)
        if status in ENDED and np.any(self.penalty.violations(self.theta) > FEASIBILITY_TOLERANCE):
            status = Status.INFEASIBLE
        return self._finish(status)

    def _has_strayed(self, status: Status) -> bool:
        """Tell whether the run ended by itself, and worse than a feasible point that it has visited."""
        return status in (*ENDED, Status.INFEASIBLE) and self.best.beats(self.cost, self.penalty.violation(self.theta))

    def _go_back(self) -> None:
        self.cost, self.theta, self.multipliers = self.best.cost, self.best.theta, self.best.multipliers
        self._record(0.0)

    def _record(self, length: float) -> None:
        seconds = time.perf_counter() - self.began
        self.history.append(Iteration(self.tried, self.cost, seconds, length, self.damping.value))

    def _interrupt(self) -> None:
        self.interrupted = True
        abandoned.mark()

    def _iterate(self) -> Status:
        problem, options = self.problem, self.options
        scale, neighbours = np.zeros(problem.size), Neighbours(problem.labels)
        recent: list[tuple[float, float]] = []  # cost and violation
        accepted = True
        while self.tried < options.max_iterations:
            self.tried += 1
            if self.interrupted:
                return Status.INTERRUPTED
            if time.perf_counter() - self.began > options.time_limit:
                return Status.TIME_LIMIT
            if accepted:
                self.cost, gradient, hessian = problem.normal(self.theta)
                scale = np.maximum(scale, np.diag(hessian))
                floor = replace_rounding(scale, self.theta, neighbours)
                self.penalty.measure_units(self.theta, floor)
                slope, violation = self.penalty.slope(self.theta), self.penalty.violation(self.theta)
                recent.append((self.cost, violation))
                self.best.update(self.cost, violation, self.theta, self.multipliers)
                if self.progress:
                    self.progress(self.history[-1] if self.history else Iteration(0, self.cost, 0.0))
                if self.watch and self.watch(self.theta):
                    return Status.STOPPED_EARLY
                if self._has_converged(recent):
                    return Status.CONVERGED if violation <= FEASIBLE_VIOLATION else Status.INFEASIBLE
            damped = hessian + self.damping.value * np.diag(floor)
            step = self._step(damped, gradient, slope)
            if step.good:
                self.multipliers = step.multipliers
                self.penalty.follow(step.multipliers[problem.size :])
            predicted = -float(gradient @ step.d + 0.5 * step.d @ hessian @ step.d)
            trial, cost, improvement = self._judge(step, damped, gradient, slope)
            expected = predicted + self.penalty.weight * violation
            accepted = bool(step.good and improvement > ACCEPTED_RATIO * expected and improvement > 0)
            length = float(np.max(np.abs(step.d) * np.sqrt(floor))) if step.good else 0.0
            if accepted:
                self.theta, self.cost = trial, cost
                self.damping = self.damping.after_success(improvement / max(expected, SMALLEST_DIVISOR)).within(
                    LEAST_DAMPING, np.inf
                )
                self._record(length)
                continue
            if (
                step.good
                and expected < NEGLIGIBLE * options.tolerance * abs(self.cost)
                and violation <= FEASIBLE_VIOLATION
            ):
                return self._judge_stalled(hessian, floor, gradient, slope)
            self.damping = self.damping.after_failure()
            if self.damping.value > MOST_DAMPING:
                stalled = self._judge_stalled(hessian, floor, gradient, slope)
                return Status.INFEASIBLE if violation > FEASIBILITY_TOLERANCE else stalled
        return Status.MAX_ITERATIONS

    def _has_converged(self, recent: list[tuple[float, float]]) -> bool:
        """Tell whether the last steps changed the cost by less than the tolerance, at an unchanged violation."""
        options = self.options
        if self.cost <= ZERO_COST and recent[-1][1] <= FEASIBLE_VIOLATION:
            return True
        if len(recent) <= options.patience:
            return False
        (cost, violation), (now, left) = recent[-1 - options.patience], recent[-1]
        if left > FEASIBILITY_TOLERANCE:
            mu = self.penalty.weight
            merits = cost + mu * violation, now + mu * left
            return violation - left < options.tolerance * left and merits[0] - merits[1] < options.tolerance * merits[1]
        return max(violation, left) <= FEASIBLE_VIOLATION and cost - now < options.tolerance * abs(now)

    def _judge_stalled(self, hessian: np.ndarray, floor: np.ndarray, gradient: np.ndarray, slope: np.ndarray) -> Status:
        """Tell a minimum from a point where only the damping makes the step so small.

        Multipliers are taken from a step with little damping. At a kink that step predicts an improvement that no step
        reaches, and the multipliers are NaN.
        """
        step = self._step(hessian + min(self.damping.value, self.options.damping) * np.diag(floor), gradient, slope)
        promised = -float(gradient @ step.d + 0.5 * step.d @ hessian @ step.d) if step.good else np.inf
        self.multipliers = step.multipliers * (1.0 if promised < KINK_SHARE * abs(self.cost) else np.nan)
        return Status.CONVERGED if promised < self.options.tolerance * abs(self.cost) else Status.SMALL_STEP

    def _step(
        self, damped: np.ndarray, gradient: np.ndarray, slope: np.ndarray, correction: np.ndarray | None = None
    ) -> Step:
        """Solve the quadratic program, removing less of the violation where it is infeasible."""
        problem = self.problem
        low, high = self.penalty.room(self.penalty.values(self.theta) if correction is None else correction)
        for share in VIOLATION_SHARES if self.n_g else VIOLATION_SHARES[:1]:
            step = self.qp(
                damped,
                gradient,
                problem.lower - self.theta,
                problem.upper - self.theta,
                slope,
                np.minimum(low, share * np.maximum(low, 0.0)),
                np.maximum(high, share * np.minimum(high, 0.0)),
            )
            if step.good:
                break
        return step

    def _judge(
        self, step: Step, damped: np.ndarray, gradient: np.ndarray, slope: np.ndarray
    ) -> tuple[np.ndarray, float, float]:
        """Return the trial point, its cost and its improvement of the penalised cost."""
        if not step.good:
            return self.theta, self.cost, -np.inf
        problem, here = self.problem, self.penalty.violation(self.theta)
        trial = self._end_of_step(step)
        there = self.penalty.violation(trial)
        if self.n_g and there > max(here, ROUNDING_VIOLATION):
            corrected = self._step(damped, gradient, slope, self.penalty.values(trial) - slope @ step.d)
            if corrected.good:
                candidate = self._end_of_step(corrected)
                if self.penalty.violation(candidate) < there:
                    trial, there = candidate, self.penalty.violation(candidate)
        cost = problem.cost(trial)
        return trial, cost, self.cost - cost + self.penalty.weight * (here - there)

    def _end_of_step(self, step: Step) -> np.ndarray:
        """Return the end of a step: exactly on its active bounds, and inside the others."""
        problem, force, theta = self.problem, step.multipliers[: self.problem.size], self.theta + step.d
        theta = np.where((force < 0) & np.isfinite(problem.lower), problem.lower, theta)
        theta = np.where((force > 0) & np.isfinite(problem.upper), problem.upper, theta)
        return np.asarray(np.clip(theta, problem.lower, problem.upper))

    def _finish(self, status: Status) -> Solution:
        return Solution(
            theta=self.theta,
            cost=self.problem.cost(self.theta),
            status=status,
            iterations=len(self.history),
            seconds=time.perf_counter() - self.began,
            violation=float((self.penalty.violations(self.theta) * self.penalty.unit).max(initial=0.0)),
            multipliers=self.multipliers / np.concatenate([np.ones(self.problem.size), self.penalty.unit]),
            history=tuple(self.history),
        )
