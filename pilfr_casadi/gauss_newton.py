"""Damped Gauss-Newton SQP for the simulation-error problem.

Each step solves the quadratic program

    minimise  1/2 d'(H + λ D)d + g'd   subject to  lower <= θ + d <= upper,  lower_g <= g(θ) + ∇g d <= upper_g,

with `H` the Gauss-Newton Hessian and `D` the largest diagonal of `H` seen so far (Marquardt 1963; Moré 1978): at the
usual start (`B_w = 0`) whole columns of the Jacobian vanish and a state space is over-parametrised, so damping is
needed and has to know the scales. Trial points are judged by simulation alone; λ follows the gain ratio (Nielsen
1999). General constraints enter an exact penalty `μ Σ violation`, with a second-order correction when a step along
their tangent violates them.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import casadi as ca
import numpy as np

from .callback import handled_interrupt
from .problem import Problem
from .solution import Iteration, Progress, Solution, Status


class _QuadraticProgram:
    """Dense QP through `ca.conic`, built once; solves for a step inside limits."""

    def __init__(self, n: int, n_g: int, plugin: str) -> None:
        structure = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(n_g, n)}
        quiet = {"daqp": {}, "qrqp": {"print_iter": False, "print_header": False, "print_info": False}}.get(plugin, {})
        self._solve = ca.conic("qp", plugin, structure, {**quiet, "error_on_fail": False})

    def __call__(
        self,
        h: np.ndarray,
        g: np.ndarray,
        lbx: np.ndarray,
        ubx: np.ndarray,
        a: np.ndarray,
        lba: np.ndarray,
        uba: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, bool]:
        out = self._solve(h=h, g=g, lbx=lbx, ubx=ubx, a=a, lba=lba, uba=uba)
        d = np.asarray(out["x"]).ravel()
        multipliers = np.concatenate([np.asarray(out["lam_x"]).ravel(), np.asarray(out["lam_a"]).ravel()])
        return d, multipliers, bool(self._solve.stats()["success"]) and bool(np.all(np.isfinite(d)))


@dataclass(frozen=True)
class GaussNewton:
    """Options of the damped Gauss-Newton SQP.

    Parameters
    ----------
    max_iterations : int
        Accepted and rejected steps together.
    tolerance : float
        Stop when the cost improved by less than this share over `patience` iterations, or the model predicts less.
    damping : float
        First λ.
    time_limit : float
        Seconds.
    qp : str
        CasADi conic plugin.
    """

    max_iterations: int = 200
    tolerance: float = 1e-5
    patience: int = 5
    damping: float = 1e-2
    time_limit: float = np.inf
    qp: str = "daqp"

    def solve(self, problem: Problem, start: np.ndarray | None = None, progress: Progress | None = None) -> Solution:
        """Minimise from `start` (n,), by default the problem's own."""
        return _Run(self, problem, problem.start if start is None else start, progress).run()


class _Run:
    """One solve: the point, its derivatives and the damping."""

    def __init__(self, options: GaussNewton, problem: Problem, start: np.ndarray, progress: Progress | None) -> None:
        self.options, self.problem, self.progress = options, problem, progress
        self.theta = np.clip(np.asarray(start, dtype=float), problem.lower, problem.upper)
        self.n_g = len(problem.g_lower)
        self.qp = _QuadraticProgram(problem.size, self.n_g, options.qp)
        self.damping, self.growth, self.penalty = options.damping, 2.0, 0.0
        self.multipliers = np.zeros(problem.size + self.n_g)
        self.history: list[Iteration] = []
        self.interrupted = False
        self.began = time.perf_counter()

    def violation(self, theta: np.ndarray) -> np.ndarray:
        """Violation of each general constraint, shape (n_g,)."""
        if not self.n_g:
            return np.zeros(0)
        g = self.problem.constraint(theta)
        return np.maximum(np.maximum(self.problem.g_lower - g, g - self.problem.g_upper), 0.0)

    def run(self) -> Solution:
        status = Status.MAX_ITERATIONS
        self.cost = self.problem.cost(self.theta)
        if not np.isfinite(self.cost):
            return self._finish(Status.DIVERGED_START)
        try:
            with handled_interrupt(self._interrupt):  # casadi may swallow a KeyboardInterrupt
                status = self._iterate()
        except KeyboardInterrupt:
            status = Status.INTERRUPTED
        return self._finish(status)

    def _interrupt(self) -> None:
        self.interrupted = True

    def _iterate(self) -> Status:
        problem, options = self.problem, self.options
        scale = np.zeros(problem.size)
        recent: list[float] = []
        fresh = True
        for number in range(options.max_iterations):
            if self.interrupted:
                return Status.INTERRUPTED
            if time.perf_counter() - self.began > options.time_limit:
                return Status.TIME_LIMIT
            if fresh:
                self.cost, gradient, hessian = problem.normal(self.theta)
                slope = problem.constraint_jacobian(self.theta)
                scale = np.maximum(scale, np.diag(hessian))
                violation = self.violation(self.theta)
                recent.append(self.cost + self.penalty * float(violation.sum()))
                if self.progress:
                    self.progress(self.history[-1] if self.history else Iteration(0, self.cost, 0.0))
                calm = len(recent) > options.patience and recent[-1 - options.patience] - recent[
                    -1
                ] < options.tolerance * abs(recent[-1])
                if calm and violation.sum() <= 1e-9:
                    return Status.CONVERGED
            # a column that has been zero so far does not move, whatever its damping: the method is invariant to units
            floor = np.where(scale > 0, scale, 1.0)
            damped = hessian + self.damping * np.diag(floor)
            step, good = self._step(damped, gradient, slope)
            predicted = -float(gradient @ step + 0.5 * step @ hessian @ step)
            trial, improvement = (
                self._judge(step, damped, gradient, slope, violation) if good else (self.theta, -np.inf)
            )
            expected = predicted + self.penalty * float(violation.sum())
            fresh = bool(good and improvement > 1e-4 * expected and improvement > 0)
            length = float(np.max(np.abs(step) * np.sqrt(floor))) if good else 0.0
            if fresh:
                ratio = min(improvement / max(expected, 1e-300), 2.0)  # a cube of it follows
                self.theta = trial
                self.damping = max(self.damping * max(1 / 3, 1 - (2 * ratio - 1) ** 3), 1e-12)
                self.growth = 2.0
                self.history.append(
                    Iteration(
                        number + 1, self.cost - improvement, time.perf_counter() - self.began, length, self.damping
                    )
                )
            else:
                if good and expected < 1e-3 * options.tolerance * abs(self.cost) and violation.sum() <= 1e-9:
                    return Status.CONVERGED
                self.damping *= self.growth
                self.growth *= 2.0
                if self.damping > 1e12:
                    return Status.INFEASIBLE if violation.sum() > 1e-6 else Status.SMALL_STEP
        return Status.MAX_ITERATIONS

    def _step(
        self, damped: np.ndarray, gradient: np.ndarray, slope: np.ndarray, correction: np.ndarray | None = None
    ) -> tuple[np.ndarray, bool]:
        problem = self.problem
        g = (problem.constraint(self.theta) if self.n_g else np.zeros(0)) if correction is None else correction
        low, high = problem.g_lower - g, problem.g_upper - g
        # unit diagonal: daqp's tolerances are absolute
        unit = 1.0 / np.sqrt(np.diag(damped))
        lbx, ubx = (problem.lower - self.theta) / unit, (problem.upper - self.theta) / unit
        size = max(float(np.max(np.abs(gradient * unit))), 1e-300)
        h, steepest, a = damped * unit * unit[:, None], gradient * unit / size, slope * unit
        for share in (1.0, 0.5, 0.1, 0.01, 0.0) if self.n_g else (1.0,):  # of the violation that the step has to remove
            lba = np.minimum(low, share * np.maximum(low, 0.0))
            uba = np.maximum(high, share * np.minimum(high, 0.0))
            d, multipliers, good = self.qp(h, steepest, lbx / size, ubx / size, a, lba / size, uba / size)
            if good:
                break
        if good:
            n = problem.size
            self.multipliers = np.concatenate([multipliers[:n] * size / unit, multipliers[n:] * size])
            if self.n_g:
                # Powell's rule: a penalty that only grows keeps what far-off multipliers asked for, and crawls
                needed = 1.5 * float(np.max(np.abs(self.multipliers[n:])))
                self.penalty = max(needed, 0.5 * (self.penalty + needed))
        return d * size * unit, good

    def _judge(
        self, step: np.ndarray, damped: np.ndarray, gradient: np.ndarray, slope: np.ndarray, violation: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """Trial point and the improvement of the penalised cost it brings."""
        problem = self.problem
        merit = self.cost + self.penalty * float(violation.sum())
        trial = self._inside(self.theta + step)
        there = float(self.violation(trial).sum())
        if self.n_g and there > max(float(violation.sum()), 1e-12):
            linearised = problem.constraint(trial) - slope @ step
            corrected, good = self._step(damped, gradient, slope, linearised)
            if good:
                candidate = self._inside(self.theta + corrected)
                if float(self.violation(candidate).sum()) < there:
                    trial, there = candidate, float(self.violation(candidate).sum())
        return trial, merit - problem.cost(trial) - self.penalty * there

    def _inside(self, theta: np.ndarray) -> np.ndarray:
        """Exactly on the bounds that the last quadratic program holds active, and inside the others."""
        problem, force = self.problem, self.multipliers[: self.problem.size]
        theta = np.where((force < 0) & np.isfinite(problem.lower), problem.lower, theta)
        theta = np.where((force > 0) & np.isfinite(problem.upper), problem.upper, theta)
        return np.asarray(np.clip(theta, problem.lower, problem.upper))

    def _finish(self, status: Status) -> Solution:
        violation = float(self.violation(self.theta).max(initial=0.0))
        return Solution(
            theta=self.theta,
            cost=self.problem.cost(self.theta),
            status=status,
            iterations=len(self.history),
            seconds=time.perf_counter() - self.began,
            violation=violation,
            multipliers=self.multipliers,
            history=tuple(self.history),
        )
