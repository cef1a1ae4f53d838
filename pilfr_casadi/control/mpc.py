"""Predictive control: inputs that make the predicted outputs follow a reference within limits.

    minimise   Σ |(y_k - r_k) / y_scale|² + move |(u_k - u_{k-1}) / u_scale|² + penalty · s_k / y_scale
    subject to low_u <= u_k <= high_u,   |u_k - u_{k-1}| <= rate,   low_y - s_k <= y_k <= high_y + s_k,   s_k >= 0

over N samples from a state x with memory. Each output and sample has its own slack s, so an unavoidable
violation does not permit another one. States are eliminated (single shooting), and the Hessian is Gauss-Newton's,
`2 JᵀJ` of the weighted deviations. CasADi solves the problem by `sqpmethod` with the QP solver DAQP (`solver="sqp"`) or
by IPOPT (`solver="ipopt"`), starting from the last plan shifted by a sample.

Operators with memory make the model piecewise linear. Within a piece the Gauss-Newton step ends in the optimum; between
pieces the line search decides, and a plan may stop at a kink that is not an optimum. It is then marked as not
converged, which is rare with one input and common with several inputs behind plays. A plan is never worse than the last
one shifted, and it always keeps the limits of inputs and rates. Nocedal & Wright (2006), Numerical Optimization, ch.
18.

`control_task` holds the limits, the scales and the penalty.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, is_whole, numbers
from ..models import Buffered
from .control_task import ControlTask, check_task

Array = np.ndarray
FIRST_PLAN_FACTOR = 10  # times as many iterations for the first plan, which starts from a constant input
LIMIT_TOLERANCE = 1e-5  # of y_scale: smaller violations of an output limit lie within the solver's tolerance
SLACK_HESSIAN = 0.1  # Hessian of the slacks: makes the QP strictly convex, small against the penalty of 30
QUIET = {"print_time": False, "error_on_fail": False}
SQP = {
    "qpsol": "daqp",
    "qpsol_options": {"error_on_fail": False},
    "tol_pr": 1e-5,  # of the scaled constraints: DAQP's own tolerance with the curvature of the slacks
    "tol_du": 1e-4,
    "beta": 0.5,  # the line search halves a step until the cost falls: kinks stand in the way of full steps
    "max_iter_ls": 12,  # steps below 2^-12 gain nothing; with 8, plans of several inputs cost 3 % more
    "merit_memory": 1,
    "min_step_size": 1e-6,  # of u_scale: a smaller step gains nothing
    **dict.fromkeys(("print_header", "print_iteration", "print_status"), False),
}
IPOPT = {"ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-9, "max_iter": 200}}
SUCCESS = ("Solve_Succeeded", "Search_Direction_Becomes_Too_Small", "Solved_To_Acceptable_Level")


@dataclass(frozen=True, eq=False)
class Plan:
    """The result of a call of a predictive controller.

    Attributes
    ----------
    inputs, outputs : array, shape (N, n_u), (N, n_y)
        Planned inputs and predicted outputs.
    cost, slack : float
        Cost, and the largest violation of an output limit, in units of the outputs.
    seconds : float
        Computing time, s.
    converged : bool
        Whether the solver reached an optimum.
    limited : bool
        Whether output limits were given; without them the slack is zero.
    """

    inputs: Array
    outputs: Array
    cost: float
    slack: float
    seconds: float
    converged: bool
    limited: bool = True

    @property
    def u(self) -> Array:
        """The input to apply now, (n_u,)."""
        return self.inputs[0]

    def __str__(self) -> str:
        how = "converged" if self.converged else "NOT converged"
        applied = ", ".join(f"{v:.5g}" for v in self.u)
        limits = (
            f"; outputs beyond their limits by {self.slack:.3g}" if self.slack > 0 else "; outputs within their limits"
        )
        return (
            f"plan over {len(self.inputs)} samples, {how} in {1e3 * self.seconds:.2f} ms, cost {self.cost:.5g}\n"
            f"input to apply now: {applied}{limits if self.limited else ''}"
        )

    __repr__ = __str__


class PredictiveController:
    """Model predictive control of any `F(x, u) -> (x_next, y)`; `controller(x, reference, u_previous)` gives a `Plan`.

    Parameters
    ----------
    function : casadi.Function, Fit, KalmanFilter or Exported
        The model: `(x, u) -> (x_next, y)`, for example `fit.to_casadi()` or an observer's `function`.
    horizon : int
        Samples N.
    inputs : (low, high)
        Limits of the inputs, numbers or arrays (n_u,); infinite for no limit.
    outputs : (low, high), optional
        Limits of the outputs, kept wherever possible; otherwise the violation is as small as possible.
    rate : float or array, optional
        Largest change of an input from sample to sample. If the previous input lies too far outside the limits, the
        first change exceeds the rate as much as it must to reach them.
    move : float
        Weight of changes of the inputs.
    y_scale, u_scale : float or array, optional
        Deviation that costs one. By default half of the width between the limits of an input or output, and for an
        output at most half of the range that it can cover within the horizon (a tenth of the range without limits).
        The attributes `y_scale` and `u_scale` hold the values in use.
    solver : {"sqp", "ipopt"}
        `"sqp"` takes about a millisecond, `"ipopt"` some ten times as long.
    iterations : int
        Largest number of SQP iterations in a call; the first call may take ten times as many. With 1 each sample costs
        one QP, the real-time iteration of Diehl, Bock & Schlöder (2005), SIAM J. Control Optim. 43. The loops of
        `problems.mpc_piezo` then track as well, although few plans converge. IPOPT has its own limit.

    Raises
    ------
    InputError
        If limits cannot be used or the solver is unknown; in a call, if the state, the reference or the previous input
        has another shape or is not finite.
    """

    def __init__(
        self,
        function: Any,
        horizon: int,
        *,
        inputs: tuple[Any, Any],
        outputs: tuple[Any, Any] | None = None,
        rate: Any = None,
        move: float = 1e-3,
        y_scale: Any = None,
        u_scale: Any = None,
        solver: str = "sqp",
        iterations: int = 5,
    ) -> None:
        task = check_task(function, horizon, inputs, outputs, rate, move, y_scale, u_scale)
        if solver not in ("sqp", "ipopt") or not is_whole(iterations, 1):
            raise InputError(
                f"The solver {solver!r} and {iterations!r} iterations were given; give 'sqp' or 'ipopt', and 1 or more."
            )
        self.function, self.horizon, self.solver, self.iterations = task.function, task.horizon, solver, iterations
        self.y_scale, self.u_scale = task.y_scale, task.u_scale
        self._task, self._problem = task, Transcription(task)
        self._first = self._problem.solver(solver, FIRST_PLAN_FACTOR * iterations)
        self._next = self._problem.solver(solver, iterations) if solver == "sqp" else self._first
        self._plan: Array | None = None

    def __str__(self) -> str:
        (n, n_u, n_y), task = self._task.sizes, self._task
        limits = "inputs and outputs" if task.limited else "inputs"
        return (
            f"predictive controller over {self.horizon} samples by {self.solver}: {n} states, {n_u} inputs, {n_y} "
            f"outputs, limits of the {limits}" + (", rates limited" if np.isfinite(task.rate).any() else "")
        )

    __repr__ = __str__

    def __call__(self, x: Array, reference: Array, u_previous: Array) -> Plan:
        """Plan from the state x of sample k, towards the reference (N, n_y) of the samples k to k + N - 1.

        The first planned input acts in sample k. The first output and the first row of the reference belong to sample
        k too; in a model without feedthrough no input can change that output any more. `u_previous` is the input of
        sample k - 1. The search starts from the last plan, shifted by a sample.
        """
        begin = perf_counter()
        task, problem = self._task, self._problem
        n, n_u, n_y = task.sizes
        r = _flatten_reference(reference, self.horizon, n_y)
        u_before, state = numbers(u_previous, "The previous input").reshape(-1), numbers(x, "The state").ravel()
        if len(u_before) != n_u or len(state) != n:
            raise InputError(
                f"A state of {len(state)} numbers and {len(u_before)} previous inputs were given; give {n} and {n_u}."
            )
        rate, last = task.first_rate(u_before), self._plan
        start = np.tile(u_before, self.horizon) if last is None else np.append(last[n_u:], last[-n_u:])
        start = task.clip(start, u_before, rate)
        given = state, r, u_before
        found, converged = problem.solve(self._first if last is None else self._next, start, rate, *given)
        u = task.clip(found, u_before, rate)
        cost, y = problem.cost(u, *given)
        if not converged:
            start_cost, start_y = problem.cost(start, *given)
            if not cost <= start_cost:
                u, cost, y = start, start_cost, start_y
        self._plan = u
        violation = task.violation(y)
        slack = float(np.max(violation[violation > LIMIT_TOLERANCE * task.y_scale], initial=0.0))
        converged = converged and bool(np.isfinite(cost))
        seconds = perf_counter() - begin
        return Plan(u.reshape(-1, n_u), y.reshape(-1, n_y), cost, slack, seconds, converged, task.limited)


class Transcription:
    """The nonlinear program of a task, in units of u_scale and y_scale.

    Variables are the inputs (N n_u,) and, with output limits, a slack for each output and sample; parameters are the
    state, the reference, the previous input and the penalty of a violated limit.
    """

    def __init__(self, task: ControlTask) -> None:
        self._task = task
        n, n_u, n_y = task.sizes
        samples, slacks = task.horizon, task.horizon * n_y * task.limited
        v, s, x = ca.SX.sym("v", samples * n_u), ca.SX.sym("s", slacks), ca.SX.sym("x", n)
        r, u_before, penalty = ca.SX.sym("r", samples * n_y), ca.SX.sym("u_before", n_u), ca.SX.sym("penalty")
        u, state, outputs = v * task.u_scale, x, []
        for k in range(samples):
            state, y = task.function(state, u[k * n_u : (k + 1) * n_u])
            outputs.append(y)
        y = ca.vertcat(*outputs) / task.y_scale
        changes = (u - ca.vertcat(u_before, u[:-n_u])) / task.u_scale
        residual = ca.vertcat(y - r / task.y_scale, np.sqrt(task.move) * changes)
        self._variables, self._parameters = ca.vertcat(v, s), ca.vertcat(x, r, u_before, penalty)
        self._cost = ca.sumsqr(residual) + penalty * ca.sum1(s)
        jacobian = ca.jacobian(residual, self._variables)
        curvature = ca.diag(ca.vertcat(ca.SX.zeros(samples * n_u), SLACK_HESSIAN * ca.SX.ones(slacks)))
        self._hessian = 2 * jacobian.T @ jacobian + curvature
        rate_limited = np.flatnonzero(np.isfinite(task.rate))
        self._rate_limited, rows = rate_limited, [changes[rate_limited.tolist()]]
        low, high, free = task.low_y / task.y_scale, task.high_y / task.y_scale, np.full(slacks, np.inf)
        self._constraint_bounds = np.zeros(0), np.zeros(0)
        if task.limited:
            rows += [y + s, y - s]
            self._constraint_bounds = np.concatenate([low, -free]), np.concatenate([free, high])
        self._constraints = ca.vertcat(*rows)
        self._zero_slacks = np.zeros(slacks)
        lbx, ubx = np.append(task.low / task.u_scale, self._zero_slacks), np.append(task.high / task.u_scale, free)
        self._variable_bounds = lbx, ubx
        names = ["u", "x", "reference", "u_before"], ["cost", "y"]
        predict = ca.Function("predict", [v, x, r, u_before], [ca.sumsqr(residual), ca.densify(y)], *names)
        self._predict = Buffered(predict)

    def solver(self, name: str, iterations: int) -> Buffered:
        """Build CasADi's solver of the program."""
        x, p, g = self._variables, self._parameters, self._constraints
        factor, multipliers = ca.SX.sym("lam_f"), ca.SX.sym("lam_g", g.shape[0])
        hessian = ca.triu(factor * self._hessian)
        names, out = ["x", "p", "lam_f", "lam_g"], "triu_hess_gamma_x_x"
        plugin, options = "ipopt", dict[str, Any](IPOPT)
        if name == "sqp":
            plugin, options = "sqpmethod", {**SQP, "max_iter": iterations}
            hessian, out = ca.triu2symm(hessian), "hess_gamma_x_x"
        gauss_newton = ca.Function("gauss_newton", [x, p, factor, multipliers], [hessian], names, [out])
        program = {"x": x, "p": p, "f": self._cost, "g": g}
        return Buffered(ca.nlpsol("mpc", plugin, program, {**QUIET, **options, "hess_lag": gauss_newton}))

    def solve(
        self, solver: Buffered, start: Array, rate: Array, x: Array, r: Array, u_before: Array
    ) -> tuple[Array, bool]:
        """Find inputs (N n_u,) from a start; also tell whether the solver converged."""
        task, (low, high) = self._task, self._constraint_bounds
        largest = (rate / task.u_scale)[self._rate_limited]
        lbg, ubg = np.append(-largest, low), np.append(largest, high)
        v = np.append(start / task.u_scale, self._zero_slacks)
        p = np.concatenate([x, r, u_before, [task.penalty(r)]])
        found = solver(v, p, *self._variable_bounds, lbg, ubg)[0][: len(start)]
        return found * task.u_scale, solver.status in SUCCESS and bool(np.all(np.isfinite(found)))

    def cost(self, u: Array, x: Array, r: Array, u_before: Array) -> tuple[float, Array]:
        """Compute the cost of inputs (N n_u,), violated limits included, and their outputs (N n_y,)."""
        task = self._task
        cost, y = self._predict(u / task.u_scale, x, r, u_before)
        y = y * task.y_scale
        violation = float(np.sum(task.violation(y) / task.y_scale)) if task.limited else 0.0
        return float(cost[0]) + task.penalty(r) * violation, y


def _flatten_reference(reference: Any, samples: int, n_y: int) -> Array:
    """Flatten a reference (samples, n_y); for a single output (samples,) is accepted."""
    found = numbers(reference, "The reference")
    if found.shape == (samples, n_y) or (n_y == 1 and found.size == samples == max(found.shape, default=0)):
        return found.reshape(-1)
    raise InputError(f"The reference has the shape {found.shape}; give {(samples, n_y)}, one row per sample.")
