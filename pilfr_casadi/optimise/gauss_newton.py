"""Damped Gauss-Newton SQP for the simulation-error problem.

Each step solves the quadratic program

    minimise  1/2 d'(H + λ D)d + g'd   subject to  lower <= θ + d <= upper,  lower_g <= g(θ) + ∇g d <= upper_g,

with `H` the Gauss-Newton Hessian and `D` the largest diagonal of `H` seen so far (Marquardt 1963; Moré 1978), rounding
left out (`damping.without_rounding`): at the usual start (`B_w = 0`) whole columns of the Jacobian vanish and a state
space is over-parametrised, so damping is needed and has to know the scales. Trial points are judged by simulation
alone; λ follows the gain ratio (Nielsen 1999). General constraints, in units of their own
(`Problem.constraint_units`), enter an exact penalty `μ Σ violation`, with a second-order correction when a step along
their tangent violates them.

A run may stray to where violating the constraints pays and linear steps do not lead back: one that ends worse than the
cheapest feasible point goes on from there, with more damping and under a larger penalty (`feasible`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

from .._base import InputError
from ..models import Neighbours
from .callback import handled_interrupt
from .constraints import TOLERATED
from .damping import without_rounding
from .exact_penalty import ExactPenalty
from .feasible import Feasible
from .lifted import Lifted
from .problem import Problem
from .quadratic_program import QuadraticProgram
from .solution import Iteration, Progress, Solution, Status

FEASIBLE = 1e-9  # violation, in units of the constraints, that is none
RETURNS = 4  # times that a run which has strayed goes on from the best feasible point
ENDED = (Status.CONVERGED, Status.SMALL_STEP, Status.SOLVER_FAILED)  # as far as a run gets
Watch = Callable[[np.ndarray], bool]
KINK = 1e-3  # share of the cost that a step promises in vain, from which multipliers mean nothing
NOTHING = 1e-24  # a cost that is rounding: outputs are off by 1e-12 of their size


@dataclass(frozen=True)
class GaussNewton:
    """Options of the damped Gauss-Newton SQP.

    Parameters
    ----------
    max_iterations : int
        Steps, the rejected ones too.
    tolerance : float
        Stop when the cost improved by less than this share over `patience` iterations, or the model predicts less.
    damping : float
        First λ.
    time_limit : float
        Seconds of a solve, at a bound on a spectral radius with all its repetitions (`tightening`). A fit makes several
        solves.
    qp : str
        CasADi conic plugin.

    Raises
    ------
    InputError
        If there is no such plugin.
    """

    max_iterations: int = 200
    tolerance: float = 1e-5
    patience: int = 5
    damping: float = 1e-2
    time_limit: float = np.inf
    qp: str = "daqp"

    def __post_init__(self) -> None:
        if not ca.has_conic(str(self.qp)):
            raise InputError(f"The QP solver {self.qp!r} is not there; use 'daqp', or another conic plugin of CasADi.")

    def solve(
        self,
        problem: Problem | Lifted,
        start: np.ndarray | None = None,
        progress: Progress | None = None,
        watch: Watch | None = None,
        unfinished: bool = False,
    ) -> Solution:
        """Minimise from `start` (n,), by default the problem's own.

        `watch` is given every point and may end it. What a limit ends is the best feasible point, or, `unfinished`,
        where the run is, feasible or not, from which another one can go on.
        """
        return _Run(self, problem, problem.start if start is None else start, progress, watch).run(unfinished)


@dataclass(frozen=True, eq=False)
class _Step:
    """A quadratic program's step (n,), its multipliers (n + n_g,), and whether it was found."""

    d: np.ndarray
    multipliers: np.ndarray
    good: bool


class _Run:
    """One solve: the point, its derivatives and the damping; constraints, limits and multipliers of them are scaled."""

    def __init__(
        self,
        options: GaussNewton,
        problem: Problem | Lifted,
        start: np.ndarray,
        progress: Progress | None,
        watch: Watch | None = None,
    ) -> None:
        self.options, self.problem, self.progress, self.watch = options, problem, progress, watch
        self.theta = np.clip(np.asarray(start, dtype=float), problem.lower, problem.upper)
        self.penalty, self.best = ExactPenalty(problem), Feasible(options.tolerance)
        self.n_g = len(problem.g_lower)
        self.qp = QuadraticProgram(problem.size, self.n_g, options.qp)
        self.damping, self.growth, self.tried = options.damping, 2.0, 0
        self.multipliers = np.zeros(problem.size + self.n_g)
        self.history: list[Iteration] = []
        self.interrupted = False
        self.began = time.perf_counter()

    def run(self, unfinished: bool) -> Solution:
        status = Status.MAX_ITERATIONS
        self.cost = self.problem.cost(self.theta)
        if not np.isfinite(self.cost):
            return self._finish(Status.DIVERGED_START)
        try:
            with handled_interrupt(self._interrupt):  # casadi may swallow a KeyboardInterrupt
                status = self._iterate()
                for k in range(RETURNS):
                    if status in ENDED and self.penalty.shrink(self.theta):
                        self.best = Feasible(self.options.tolerance)
                    elif self._strayed(status):
                        self._back()
                        self.penalty.raise_to(2.0 * self.best.tempting)
                    else:
                        break
                    self.damping, self.growth = self.options.damping * 10.0**k, 2.0
                    status = self._iterate()
        except KeyboardInterrupt:
            status = Status.INTERRUPTED
        goes_on = unfinished and status in (Status.MAX_ITERATIONS, Status.TIME_LIMIT)
        if not goes_on and self.best.better(self.cost, self.penalty.violation(self.theta)):
            status = Status.SOLVER_FAILED if self._strayed(status) else status
            self._back()
        self.penalty.shrink(self.theta)
        if status in ENDED and np.any(self.penalty.violations(self.theta) > TOLERATED):
            status = Status.INFEASIBLE
        return self._finish(status)

    def _strayed(self, status: Status) -> bool:
        """Whether it ended of itself, and worse than a feasible point that it has seen."""
        return status in (*ENDED, Status.INFEASIBLE) and self.best.better(self.cost, self.penalty.violation(self.theta))

    def _back(self) -> None:
        self.cost, self.theta, self.multipliers = self.best.cost, self.best.theta, self.best.multipliers
        self._accepted(0.0)

    def _accepted(self, length: float) -> None:
        self.history.append(Iteration(self.tried, self.cost, time.perf_counter() - self.began, length, self.damping))

    def _interrupt(self) -> None:
        self.interrupted = True

    def _iterate(self) -> Status:
        problem, options = self.problem, self.options
        scale, neighbours = np.zeros(problem.size), Neighbours(problem.labels)
        recent: list[tuple[float, float]] = []  # cost and violation
        fresh = True
        while self.tried < options.max_iterations:
            self.tried += 1
            if self.interrupted:
                return Status.INTERRUPTED
            if time.perf_counter() - self.began > options.time_limit:
                return Status.TIME_LIMIT
            if fresh:
                self.cost, gradient, hessian = problem.normal(self.theta)
                scale = np.maximum(scale, np.diag(hessian))
                floor = without_rounding(scale, self.theta, neighbours)
                self.penalty.measure(self.theta, floor)
                slope, violation = self.penalty.slope(self.theta), self.penalty.violation(self.theta)
                recent.append((self.cost, violation))
                self.best.see(self.cost, violation, self.theta, self.multipliers)
                if self.progress:
                    self.progress(self.history[-1] if self.history else Iteration(0, self.cost, 0.0))
                if self.watch and self.watch(self.theta):
                    return Status.STOPPED_EARLY
                if self._calm(recent):
                    return Status.CONVERGED if violation <= FEASIBLE else Status.INFEASIBLE
            step = self._step(hessian + self.damping * np.diag(floor), gradient, slope)
            if step.good:
                self.multipliers = step.multipliers
                self.penalty.follow(step.multipliers[problem.size :])
            predicted = -float(gradient @ step.d + 0.5 * step.d @ hessian @ step.d)
            trial, cost, improvement = self._judge(step, hessian + self.damping * np.diag(floor), gradient, slope)
            expected = predicted + self.penalty.weight * violation
            fresh = bool(step.good and improvement > 1e-4 * expected and improvement > 0)
            length = float(np.max(np.abs(step.d) * np.sqrt(floor))) if step.good else 0.0
            if fresh:
                ratio = min(improvement / max(expected, 1e-300), 2.0)  # a cube of it follows
                self.theta, self.cost = trial, cost
                self.damping = max(self.damping * max(1 / 3, 1 - (2 * ratio - 1) ** 3), 1e-12)
                self.growth = 2.0
                self._accepted(length)
            else:
                if step.good and expected < 1e-3 * options.tolerance * abs(self.cost) and violation <= FEASIBLE:
                    return self._stalled(hessian, floor, gradient, slope)
                self.damping *= self.growth
                self.growth *= 2.0
                if self.damping > 1e12:
                    stalled = self._stalled(hessian, floor, gradient, slope)
                    return Status.INFEASIBLE if violation > TOLERATED else stalled
        return Status.MAX_ITERATIONS

    def _calm(self, recent: list[tuple[float, float]]) -> bool:
        """Whether the last few steps changed next to nothing, all feasible or all as infeasible as the last."""
        options = self.options
        if self.cost <= NOTHING and recent[-1][1] <= FEASIBLE:
            return True
        if len(recent) <= options.patience:
            return False
        (cost, violation), (now, left) = recent[-1 - options.patience], recent[-1]
        if left > TOLERATED:
            mu = self.penalty.weight
            merits = cost + mu * violation, now + mu * left
            return violation - left < options.tolerance * left and merits[0] - merits[1] < options.tolerance * merits[1]
        return max(violation, left) <= FEASIBLE and cost - now < options.tolerance * abs(now)

    def _stalled(self, hessian: np.ndarray, floor: np.ndarray, gradient: np.ndarray, slope: np.ndarray) -> Status:
        """What it means that a step promises nothing: a minimum, unless only its damping makes it so small.

        Multipliers are those of a step with little damping, and none at a kink, where it promises much in vain.
        """
        step = self._step(hessian + min(self.damping, self.options.damping) * np.diag(floor), gradient, slope)
        promised = -float(gradient @ step.d + 0.5 * step.d @ hessian @ step.d) if step.good else np.inf
        self.multipliers = step.multipliers * (1.0 if promised < KINK * abs(self.cost) else np.nan)
        return Status.CONVERGED if promised < self.options.tolerance * abs(self.cost) else Status.SMALL_STEP

    def _step(
        self, damped: np.ndarray, gradient: np.ndarray, slope: np.ndarray, correction: np.ndarray | None = None
    ) -> _Step:
        problem = self.problem
        low, high = self.penalty.room(self.penalty.values(self.theta) if correction is None else correction)
        for share in (1.0, 0.5, 0.1, 0.01, 0.0) if self.n_g else (1.0,):  # of the violation that the step has to remove
            d, multipliers, good = self.qp(
                damped,
                gradient,
                problem.lower - self.theta,
                problem.upper - self.theta,
                slope,
                np.minimum(low, share * np.maximum(low, 0.0)),
                np.maximum(high, share * np.minimum(high, 0.0)),
            )
            if good:
                break
        return _Step(d, multipliers, good)

    def _judge(
        self, step: _Step, damped: np.ndarray, gradient: np.ndarray, slope: np.ndarray
    ) -> tuple[np.ndarray, float, float]:
        """Trial point, its cost and the improvement of the penalised cost it brings."""
        if not step.good:
            return self.theta, self.cost, -np.inf
        problem, here = self.problem, self.penalty.violation(self.theta)
        trial = self._inside(step)
        there = self.penalty.violation(trial)
        if self.n_g and there > max(here, 1e-12):
            corrected = self._step(damped, gradient, slope, self.penalty.values(trial) - slope @ step.d)
            if corrected.good:
                candidate = self._inside(corrected)
                if self.penalty.violation(candidate) < there:
                    trial, there = candidate, self.penalty.violation(candidate)
        cost = problem.cost(trial)
        return trial, cost, self.cost - cost + self.penalty.weight * (here - there)

    def _inside(self, step: _Step) -> np.ndarray:
        """The end of a step: exactly on the bounds that its quadratic program holds active, and inside the others."""
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
