"""The simulation-error problem through IPOPT, by single shooting with the package's own derivatives.

IPOPT solves the problem in the units of `Scaled`, with unchanged bounds and constraints and the damped Gauss-Newton
Hessian of `DampedHessian`. This makes the interior-point iteration a Levenberg-Marquardt method with a barrier for
bounds and a filter for constraints (Wächter & Biegler 2006). With an undamped or the exact Hessian trials diverged.
Only while IPOPT restores feasibility, ignoring the cost, the Hessian is the curvature of the constraints.

An interior-point method pushes variables away from bounds, and thresholds start on theirs (r = 0). So push and barrier
are small compared with the first cost, which is 1. Bounds are never relaxed. At the end, variables whose multiplier
exceeds their distance to a bound are set to it if that does not raise the cost. A diverging simulation is an evaluation
error, from which the line search backs off.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, handled_interrupt
from ..models import or_one
from .gauss_newton import ACCEPTED_RATIO, LEAST_DAMPING, MOST_DAMPING, ZERO_COLUMN, Damping
from .problem import Problem
from .quadratic_program import SMALLEST_DIVISOR
from .solution import Iteration, IterationCallback, Solution, Status, check_solver_options

SETTINGS = {
    "print_level": 0,
    "sb": "yes",
    "tol": 1e-9,
    "nlp_scaling_method": "none",
    "bound_relax_factor": 0.0,
    "mu_strategy": "adaptive",
    "adaptive_mu_globalization": "never-monotone-mode",
    "mu_max": 1e-3,
    "mu_init": 1e-3,
    "watchdog_shortened_iter_trigger": 0,
    "bound_push": 1e-4,
    "bound_frac": 1e-4,
    "slack_bound_push": 1e-4,
    "slack_bound_frac": 1e-4,
}
ENDINGS = {
    "Solve_Succeeded": Status.CONVERGED,
    "Solved_To_Acceptable_Level": Status.CONVERGED,
    "Maximum_Iterations_Exceeded": Status.MAX_ITERATIONS,
    "Infeasible_Problem_Detected": Status.INFEASIBLE,
}
Sparsities = dict[str, ca.Sparsity]
FEASIBLE_VIOLATION = 1e-8  # up to which a point is feasible, in units of the change that one scaled variable causes
INFEASIBLE_FROM = 1e-6  # the same, above which the end of a run is infeasible
MOST_SOLVES = 4  # when IPOPT's line search fails, the next solve starts from the best point with more damping
MORE_DAMPING, LEAST_RAISED = 100.0, 1e-2  # factor on λ for the next solve, and the least λ that it multiplies
RAISED, MOST_RAISED = 4.0, 100.0  # factor on λ for each shortening by the line search, and the largest factor in all
MOST_FIRST_STEPS = 20  # most trials of the first step, from which column norms of the Jacobian are computed
MOST_CORRECTIONS = 3  # Newton steps back onto the constraints after variables were set to their bounds
QUASI_NEWTON_PATIENCE = 4  # factor on the patience with a quasi-Newton Hessian, whose steps gain less


class _Callback(ca.Callback):
    """CasADi Function around a Python function, with its inputs and outputs by name.

    The function takes one flat array per input and returns one value per output. CasADi would turn an exception into a
    failed evaluation and forget it. So the exception is passed to `failed`, and the solver receives NaN.
    """

    def __init__(
        self,
        name: str,
        inputs: Mapping[str, ca.Sparsity],
        outputs: Mapping[str, ca.Sparsity],
        function: Callable[..., Sequence[Any]],
        failed: Callable[[BaseException], None],
    ) -> None:
        ca.Callback.__init__(self)
        self._inputs, self._outputs = list(inputs.items()), list(outputs.items())
        self._function, self._failed = function, failed
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self._inputs)

    def get_n_out(self) -> int:
        return len(self._outputs)

    def get_name_in(self, i: int) -> str:
        return self._inputs[i][0]

    def get_name_out(self, i: int) -> str:
        return self._outputs[i][0]

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return self._inputs[i][1]

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return self._outputs[i][1]

    def eval(self, arguments: Sequence[Any]) -> Sequence[Any]:
        try:
            return self._function(*(np.asarray(a).ravel() for a in arguments))
        except BaseException as error:
            self._failed(error)
            return [ca.DM(sparsity, np.nan) for _, sparsity in self._outputs]


@dataclass(frozen=True, eq=False)
class Point:
    """A point x (n,): objective, its gradient (n,) and Gauss-Newton Hessian (n, n), constraints (n_g,) and Jacobian."""

    x: np.ndarray
    value: float
    gradient: np.ndarray
    hessian: np.ndarray
    constraints: np.ndarray
    slope: np.ndarray


class DampedHessian:
    """Hessian for IPOPT: `H + λ D`, with D the largest diagonal of H so far (Marquardt 1963; Moré 1978).

    With λ = 0 a state space, which is over-parametrised, takes useless steps, and columns that vanish make H singular.
    λ follows how well the last step was predicted (`Damping`). The Hessian predicts the Lagrangian, so the curvature of
    constraints, which H leaves out, counts as a miss and raises λ as well; without this, iterates cycle along curved
    constraints. Where the line search had to shorten a step, λ grows.
    """

    def __init__(self, first: float, size: int) -> None:
        self.damping, self.largest = Damping(first), np.zeros(size)
        self.before: Point | None = None
        self.damped = np.zeros((size, size))

    def at(self, point: Point, multipliers: np.ndarray, trials: int) -> np.ndarray:
        """Return `H + λ D` at a new iterate, reached after `trials` evaluations; multipliers (n_g,)."""
        if self.before is not None and np.any(point.x != self.before.x):
            if trials > 1:
                raised = self.damping.value * min(RAISED ** (trials - 1), MOST_RAISED)
                self.damping = Damping(raised, self.damping.growth)
            else:
                ratio = self._ratio(self.before, point, multipliers)
                poor = ratio < ACCEPTED_RATIO
                self.damping = self.damping.after_failure() if poor else self.damping.after_success(ratio)
            self.damping = self.damping.within(LEAST_DAMPING, MOST_DAMPING)
        self.largest = np.maximum(self.largest, np.diag(point.hessian))
        # the variables are scaled to order 1, so smaller entries are zero or rounding
        diagonal = np.where(self.largest > ZERO_COLUMN, self.largest, 1.0)
        self.damped = point.hessian + self.damping.value * np.diag(diagonal)
        self.before = point
        return self.damped

    def _ratio(self, before: Point, after: Point, multipliers: np.ndarray) -> float:
        """Return 1 + (gain - predicted gain) / scale: the gain ratio where no bound or constraint bends the step."""
        d = after.x - before.x
        curvature = 0.5 * float(d @ before.hessian @ d)
        predicted = float((before.gradient + multipliers @ before.slope) @ d) + curvature
        change = after.value - before.value + float(multipliers @ (after.constraints - before.constraints))
        return 1.0 + (predicted - change) / max(float(d @ self.damped @ d) - curvature, SMALLEST_DIVISOR)


class Scaled:
    """Problem in variables and units for a solver with absolute tolerances.

        x = s θ,    F(x) = cost(x / s) / cost(θ_0),    G(x) = g(x / s) / u

    s are the column norms of the Jacobian over the root of the first cost: a unit of any variable changes the residuals
    by about their own size. u are the largest entries of each row of ∇g. So results do not depend on physical units.
    At the usual start (`B_w = 0`, Krikelis et al. (2024), Eq. 24) whole columns vanish; norms are therefore the larger
    ones of the start, inside the bounds and with a finite cost, and of one damped Gauss-Newton step from it, whose λ is
    raised until it lowers the cost. Derivatives at the start that are not finite raise a FloatingPointError.
    """

    def __init__(self, problem: Problem, start: np.ndarray, damping: float) -> None:
        self.problem, self.damping = problem, damping
        cost, g, h = problem.normal(start)
        squares = np.diag(h).copy()
        if not (np.all(np.isfinite(h)) and np.all(np.isfinite(g))):
            raise FloatingPointError("the derivatives at the start are not finite")
        unit, trial = 1.0 / np.sqrt(or_one(squares)), start
        for _ in range(MOST_FIRST_STEPS):
            step = -unit * np.linalg.solve(h * unit * unit[:, None] + self.damping * np.eye(len(g)), g * unit)
            trial = np.clip(start + step, problem.lower, problem.upper)
            there = np.diag(problem.normal(trial)[2]) if problem.cost(trial) <= cost else np.full(len(g), np.nan)
            if np.all(np.isfinite(there)):
                squares = np.maximum(squares, there)
                break
            self.damping *= RAISED
        self.unit = cost if cost > 0 else 1.0
        self.s = np.sqrt(_fill_zero_columns(squares, problem.labels, start, self.unit) / self.unit)
        self.g_unit = or_one(np.max(np.abs(problem.constraint_jacobian(trial) / self.s), axis=1, initial=0.0))
        self.lower, self.upper = problem.lower * self.s, problem.upper * self.s
        self.g_lower, self.g_upper = problem.g_lower / self.g_unit, problem.g_upper / self.g_unit

    def theta(self, x: np.ndarray) -> np.ndarray:
        """Return θ at x, clipped to the bounds against rounding."""
        return np.asarray(np.clip(x / self.s, self.problem.lower, self.problem.upper))

    def constraints(self, theta: np.ndarray) -> np.ndarray:
        """Compute the scaled constraints G, shape (n_g,)."""
        return self.problem.constraint(theta) / self.g_unit

    def slope(self, x: np.ndarray) -> np.ndarray:
        """Compute the Jacobian of G, shape (n_g, n)."""
        return self.problem.constraint_jacobian(self.theta(x)) / self.s / self.g_unit[:, None]

    def excess(self, g: np.ndarray) -> np.ndarray:
        """Return how far G lies above (positive) or below (negative) its limits, shape (n_g,)."""
        return np.maximum(g - self.g_upper, 0.0) - np.maximum(self.g_lower - g, 0.0)

    def point(self, x: np.ndarray) -> Point:
        """Evaluate objective and constraints with derivatives at x."""
        with np.errstate(all="ignore"):
            f, g, h = self.problem.normal(self.theta(x))
            scale = self.s * self.unit
            gradient, hessian = g / scale, h / scale / self.s[:, None]
        return Point(x, f / self.unit, gradient, hessian, self.constraints(self.theta(x)), self.slope(x))

    @cached_property
    def _weighted_curvature(self) -> ca.Function | None:
        """`(p, λ) -> ∇²(λ'g)` over the model's full parameter vector; None where the constraints are linear."""
        p, lam = ca.MX.sym("p", len(self.problem.free)), ca.MX.sym("lam", len(self.g_unit))
        h = ca.hessian(ca.dot(lam, self.problem.rows.function(p)), p)[0]
        return ca.Function("curvature", [p, lam], [ca.densify(h)], ["p", "lam"], ["hessian"]) if h.nnz() else None

    def curvature(self, x: np.ndarray, multipliers: np.ndarray) -> np.ndarray:
        """Compute the Hessian of the constraints weighted by their multipliers (n_g,), shape (n, n)."""
        h, free = np.zeros((len(x), len(x))), np.flatnonzero(self.problem.free)
        if self._weighted_curvature is not None:
            dense = np.asarray(
                self._weighted_curvature(self.problem.parameters(self.theta(x)), multipliers / self.g_unit)
            )
            s = self.s[: len(free)]
            h[: len(free), : len(free)] = dense[np.ix_(free, free)] / s / s[:, None]
        return h

    def multipliers(self, lam_x: np.ndarray, lam_g: np.ndarray) -> np.ndarray:
        """Return the multipliers of the bounds and constraints of the problem itself, shape (n + n_g,)."""
        return self.unit * np.concatenate([lam_x * self.s, lam_g / self.g_unit])


def _fill_zero_columns(squares: np.ndarray, labels: tuple[str, ...], start: np.ndarray, unit: float) -> np.ndarray:
    """Give columns that vanish at both points the median norm of their parameter, else a norm from the start value."""
    names, out = np.array([label.split("[")[0] for label in labels]), squares.copy()
    for name in set(names[~(squares > 0)]):
        alike = names == name
        known, size = squares[alike & (squares > 0)], float(np.max(np.abs(start[alike])))
        out[alike & ~(squares > 0)] = np.median(known) if len(known) else unit / (size or 1.0) ** 2
    return out


@dataclass(frozen=True)
class Ipopt:
    """Options of the solver through `casadi.nlpsol("ipopt")`.

    Parameters
    ----------
    hessian : {"gauss-newton", "limited-memory"}
        Damped Gauss-Newton Hessian, or IPOPT's own quasi-Newton approximation (many more iterations).
    max_iterations : int
        Limit of iterations over all solves.
    tolerance : float
        Stop when the cost changed by less than this share over `patience` iterations.
    damping : float
        First λ.
    time_limit : float
        Seconds of a solve; see `GaussNewton`.
    options : mapping
        Further options of IPOPT by name, for example `{"print_level": 5}`.

    Raises
    ------
    InputError
        If the Hessian is unknown, or IPOPT does not take an option.
    """

    hessian: str = "gauss-newton"
    max_iterations: int = 500
    tolerance: float = 1e-5
    patience: int = 5
    damping: float = 0.1
    time_limit: float = np.inf
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_solver_options(self)
        if self.hessian not in ("gauss-newton", "limited-memory"):
            raise InputError(f"The Hessian {self.hessian!r} is unknown; use 'gauss-newton' or 'limited-memory'.")
        if not isinstance(self.options, Mapping):
            raise InputError(
                f'IPOPT\'s options were given as {self.options!r}; give them by name, like {{"print_level": 5}}.'
            )
        x = ca.MX.sym("x")
        for name, value in self.options.items():  # IPOPT itself judges them, on a problem of one variable
            settings = {"ipopt": {name: value, "sb": "yes"}, "print_time": False}
            try:
                ca.nlpsol("check", "ipopt", {"x": x, "f": x**2}, settings)
            except (RuntimeError, TypeError):
                raise InputError(
                    f"IPOPT rejects the option {name!r} with the value {value!r}; see its list of options."
                ) from None

    def solve(
        self, problem: Problem, start: np.ndarray | None = None, progress: IterationCallback | None = None
    ) -> Solution:
        """Minimise from `start` (n,), by default the problem's own."""
        return _Run(self, problem, problem.start if start is None else start, progress).run()


class _Run:
    """One solve: the last point evaluated and the best one."""

    def __init__(self, options: Ipopt, problem: Problem, start: np.ndarray, progress: IterationCallback | None) -> None:
        self.options, self.problem, self.progress = options, problem, progress
        self.theta = np.clip(np.asarray(start, dtype=float), problem.lower, problem.upper)
        self.cost, self.violation = np.inf, np.inf
        self.multipliers = np.zeros(problem.size + len(problem.g_lower))
        self.history: list[Iteration] = []
        self.stopped: Status | None = None
        self.error: BaseException | None = None
        self.x, self.at, self.slope_at = self.theta, b"", b""
        self.began = time.perf_counter()

    def run(self) -> Solution:
        """Solve, again with more damping where IPOPT gives up, and return the best point."""
        status: Status | None = None
        message = ""
        try:
            start, self.cost = self.theta, self.problem.cost(self.theta)
            if not np.isfinite(self.cost):
                return self._solution(Status.DIVERGED_START, message)
            try:
                with np.errstate(all="ignore"):
                    self.scaled = Scaled(self.problem, start, self.options.damping)
            except FloatingPointError:
                return self._solution(Status.DIVERGED_START, message)
            self._keep(start, self.cost)
            damping = self.scaled.damping
            for _ in range(MOST_SOLVES):
                before = (self.violation, self.cost)
                with handled_interrupt(lambda: self._failed(KeyboardInterrupt())):
                    message = self._nlpsol(damping)
                status = self._status_of(message, *before)
                if status is not None:
                    break
                damping = MORE_DAMPING * max(self.hessian.damping.value, LEAST_RAISED)
            if self.error is None:
                self._snap_to_bounds()
        except KeyboardInterrupt as interrupt:
            self.error = interrupt
        if isinstance(self.error, KeyboardInterrupt):
            status = Status.INTERRUPTED
        elif self.error is not None:
            raise self.error
        stopped = status in (Status.MAX_ITERATIONS, Status.TIME_LIMIT, Status.INTERRUPTED)
        if self.violation > INFEASIBLE_FROM and not stopped:
            status = Status.INFEASIBLE
        return self._solution(status or Status.SOLVER_FAILED, message)

    def _status_of(self, message: str, violation: float, cost: float) -> Status | None:
        """Translate IPOPT's return status, given violation and cost before; None to try again."""
        status = self.stopped or ENDINGS.get(message)
        if status is Status.INFEASIBLE and self.violation <= FEASIBLE_VIOLATION:
            return None
        if status is None and violation <= FEASIBLE_VIOLATION and cost - self.cost < self.options.tolerance * self.cost:
            return Status.SMALL_STEP
        return status

    def _nlpsol(self, damping: float) -> str:
        """Run IPOPT once from the best point and return its status."""
        scaled, n, n_g, dense = self.scaled, self.problem.size, len(self.problem.g_lower), ca.Sparsity.dense
        self.hessian, self.trials = DampedHessian(damping, n), 0
        x, g, one = dense(n, 1), dense(n_g, 1), dense(1, 1)
        first, last = {"x": x, "p": ca.Sparsity(0, 0)}, {"lam_f": one, "lam_g": g}
        iterate = {"x": x, "f": one, "g": g, "lam_x": x, "lam_g": g, "lam_p": dense(0, 1)}
        triangle = {"triu_hess_gamma_x_x": ca.Sparsity.upper(n)}
        parts: dict[str, tuple[str, Sparsities, Sparsities, Callable[..., Sequence[Any]]]] = {
            "oracle": ("nlp", first, {"f": one, "g": g}, self._value),
            "grad_f": ("nlp_grad_f", first, {"f": one, "grad_f_x": x}, self._gradient),
            "jac_g": ("nlp_jac_g", first, {"g": g, "jac_g_x": dense(n_g, n)}, self._slope),
            "hess_lag": ("nlp_hess_l", first | last, triangle, self._hessian),
            "iteration_callback": ("iteration", iterate, {"ret": one}, self._iteration),
        }
        settings = {**SETTINGS, "max_iter": max(self.options.max_iterations - len(self.history), 0)}
        if self.options.hessian == "limited-memory":
            settings |= {"hessian_approximation": "limited-memory", "limited_memory_max_history": 30}
            del parts["hess_lag"]
        if not n_g:
            del parts["jac_g"]
        made = {key: _Callback(*part, self._failed) for key, part in parts.items()}
        oracle, ipopt = made.pop("oracle"), {**settings, **self.options.options}
        quiet = {"print_time": False, "show_eval_warnings": False, "calc_lam_p": False, "no_nlp_grad": True}
        solver = ca.nlpsol("ipopt", "ipopt", oracle, {**made, **quiet, "ipopt": ipopt})
        limits = {"lbg": scaled.g_lower, "ubg": scaled.g_upper}
        out = solver(x0=self.theta * scaled.s, lbx=scaled.lower, ubx=scaled.upper, **limits)
        self.multipliers = scaled.multipliers(*(np.asarray(out[key]).ravel() for key in ("lam_x", "lam_g")))
        return str(solver.stats()["return_status"])

    def _failed(self, error: BaseException) -> None:
        self.error, self.stopped = self.error or error, Status.SOLVER_FAILED

    def _keep(self, theta: np.ndarray, cost: float, margin: float = 0.0) -> np.ndarray:
        """Keep θ if it is the best so far: feasible with the lowest cost, else least violated; returns G there."""
        g = self.scaled.constraints(theta)
        violation = max(float(np.max(np.abs(self.scaled.excess(g)), initial=0.0)), FEASIBLE_VIOLATION)
        if np.isfinite(cost) and (violation, cost) < (self.violation, self.cost * (1.0 + margin)):
            self.theta, self.cost, self.violation = theta, cost, violation
        return g

    def _value(self, x: np.ndarray, _: Any) -> Sequence[Any]:
        """Evaluate F and G; infinite where the simulation diverges, so that IPOPT backs off."""
        if self.stopped:
            return [np.nan, np.full(len(self.problem.g_lower), np.nan)]
        if x.tobytes() != self.at:
            if time.perf_counter() - self.began > self.options.time_limit:
                self.stopped = Status.TIME_LIMIT
            theta = self.scaled.theta(x)
            cost = self.problem.cost(theta)
            self.values = [cost / self.scaled.unit, self._keep(theta, cost)]
            self.at, self.trials = x.tobytes(), self.trials + 1
        return self.values

    def _point(self, x: np.ndarray) -> Point:
        if x.tobytes() != self.slope_at:
            self.point, self.slope_at = self.scaled.point(x), x.tobytes()
        return self.point

    def _gradient(self, x: np.ndarray, _: Any) -> Sequence[Any]:
        point = self._point(x)
        return [point.value, point.gradient]

    def _slope(self, x: np.ndarray, _: Any) -> Sequence[Any]:
        return [self.scaled.constraints(self.scaled.theta(x)), self.scaled.slope(x)]

    def _hessian(self, x: np.ndarray, _: Any, weight: np.ndarray, multipliers: np.ndarray) -> Sequence[Any]:
        if weight[0]:
            h = weight[0] * self.hessian.at(self._point(x), multipliers / weight[0], self.trials)
            self.trials = 0
        else:  # IPOPT restores feasibility
            h = self.scaled.curvature(x, multipliers)
        return [ca.triu(ca.DM(h))]

    def _iteration(self, *iterate: np.ndarray) -> Sequence[Any]:
        """Record an accepted iterate and test for convergence; 1 tells IPOPT to stop."""
        x, f, g, lam_x, lam_g, _ = iterate
        scaled, options, cost = self.scaled, self.options, float(f[0]) * self.scaled.unit
        step = float(np.max(np.abs(x - self.x)) * np.sqrt(scaled.unit)) if self.history else 0.0
        self.x = x
        seconds = time.perf_counter() - self.began
        self.history.append(Iteration(len(self.history), cost, seconds, step, self.hessian.damping.value))
        if self.progress:
            self.progress(self.history[-1])
        value, multipliers = np.concatenate([x, g]), np.concatenate([lam_x, lam_g])
        low, high = np.concatenate([scaled.lower, scaled.g_lower]), np.concatenate([scaled.upper, scaled.g_upper])
        gap = np.where(multipliers < 0, value - low, high - value)
        barrier = float(np.sum(np.abs(multipliers * np.where(np.isfinite(gap), gap, 0.0)))) * scaled.unit
        span = options.patience * (1 if options.hessian == "gauss-newton" else QUASI_NEWTON_PATIENCE)
        recent = [entry.cost for entry in self.history[-1 - span :]]
        settled = len(recent) > span and max(recent) - min(recent) < options.tolerance * cost
        feasible = np.max(np.abs(scaled.excess(g)), initial=0.0) <= FEASIBLE_VIOLATION
        if settled and feasible and barrier < 10 * options.tolerance * cost:
            self.stopped = self.stopped or Status.CONVERGED
        return [int(self.stopped is not None)]

    def _snap_to_bounds(self) -> None:
        """Set variables to their active bounds and restore the constraints, if that does not raise the cost."""
        problem, scaled = self.problem, self.scaled
        theta, force = self.theta.copy(), self.multipliers[: problem.size] / scaled.s / scaled.unit
        for bound, pull in ((problem.lower, -force), (problem.upper, force)):
            near = np.abs(theta - bound) * scaled.s <= np.maximum(pull, 0.0)
            theta[near] = bound[near]
        loose = (theta > problem.lower) & (theta < problem.upper)
        for _ in range(MOST_CORRECTIONS):
            excess = scaled.excess(scaled.constraints(theta))
            rows = np.abs(excess) > 0.1 * FEASIBLE_VIOLATION
            if not np.any(rows):
                break
            slope = scaled.slope(theta * scaled.s)[np.ix_(rows, loose)]
            theta[loose] -= np.linalg.lstsq(slope, excess[rows], rcond=None)[0] / scaled.s[loose]
            theta = np.clip(theta, problem.lower, problem.upper)
        self._keep(theta, problem.cost(theta), margin=self.options.tolerance)
        inside = (self.theta > problem.lower) & (self.theta < problem.upper)
        self.multipliers[: problem.size][inside] = 0.0  # the barrier leaves small values there

    def _solution(self, status: Status, message: str) -> Solution:
        return Solution(
            theta=self.theta,
            cost=self.cost,
            status=status,
            iterations=max(len(self.history) - 1, 0),
            seconds=time.perf_counter() - self.began,
            violation=float(np.max(self.problem.excess(self.theta), initial=0.0)),
            multipliers=self.multipliers,
            history=tuple(self.history),
            message=message,
        )
