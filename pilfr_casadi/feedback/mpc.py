"""Predictive control: the inputs that let the predicted outputs follow a reference within limits.

    minimise   Σ |(y_k - r_k) / y_scale|² + move |(u_k - u_{k-1}) / u_scale|² + penalty of s
    subject to low_u <= u_k <= high_u,   |u_k - u_{k-1}| <= rate,   low_y - s <= y_k <= high_y + s,   s >= 0,

over N samples from a state x with memory. Two ways lead to the same optimum: `"sqp"`, states eliminated, Gauss-Newton
steps from a dense QP (`ca.conic`), warm-started by the shifted plan, fast enough for sample times below a millisecond;
and `"ipopt"`, multiple shooting with a variable for each state, by `ca.nlpsol`. Between kinks the model is linear in
x and u, so the Gauss-Newton Hessian is the exact one for plays and stops.
"""

from __future__ import annotations

from time import perf_counter
from typing import Any

import casadi as ca
import numpy as np

from ..checks import numbers
from ..quadratic_program import unconstrained
from ..recording import InputError
from .asked import ENORMOUS, SOLVERS, asked, count, path
from .plan import Plan

Array = np.ndarray
PENALTY = 30.0  # of a violated output limit, per y_scale
CLOSE = 1e-5  # of u_scale: a smaller step ends the search


class PredictiveController:
    """Model predictive control of any `F(x, u) -> (x_next, y)`; `controller(x, reference, u_previous)` gives a `Plan`.

    Parameters
    ----------
    function : casadi.Function, Fit, KalmanFilter or Exported
        The model: `(x, u) -> (x_next, y)`, for example `fit.to_casadi()` or an observer's `function`.
    horizon : int
        Samples N.
    inputs : (low, high)
        Limits of the inputs, numbers or arrays (n_u,); infinite where there is none.
    outputs : (low, high), optional
        Limits of the outputs, kept where that is possible (a common slack is penalised).
    rate : float or array, optional
        Largest change of an input from sample to sample. Where the previous input is so far outside the limits that
        both cannot be kept, the first change is as large as it takes.
    move : float
        Weight of changes of the inputs.
    y_scale, u_scale : float or array
        What counts as one.
    solver : {"sqp", "ipopt"}
        See above.
    iterations : int
        Most Gauss-Newton steps a call; the first call, which starts from a held input, may take ten times as many.

    Raises
    ------
    InputError
        If limits are unfit, or the solver is unknown; in a call, if state, reference or previous input have another
        shape, or are not finite.
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
        y_scale: Any = 1.0,
        u_scale: Any = 1.0,
        solver: str = "sqp",
        iterations: int = 5,
    ) -> None:
        task = asked(function, horizon, inputs, outputs, rate, move, y_scale, u_scale)
        if solver not in SOLVERS or not count(iterations):
            raise InputError(
                f"The solver {solver!r} and {iterations!r} iterations were given; give 'sqp' or 'ipopt', and 1 or more."
            )
        self.function, self.horizon, self.solver, self.iterations = task.function, task.horizon, solver, iterations
        self.low, self.high, self.low_y, self.high_y = task.low, task.high, task.low_y, task.high_y
        self.limited, self.rate, self.y_scale, self.u_scale = task.limited, task.rate, task.y_scale, task.u_scale
        horizon, move, n_u = task.horizon, task.move, task.function.size1_in(1)
        self._differences = np.eye(horizon * n_u) - np.eye(horizon * n_u, k=-n_u)
        self._weighted = np.sqrt(move) * self._differences / self.u_scale[:, None]
        self._plan: Array | None = None
        {"sqp": self._build_sqp, "ipopt": self._build_ipopt}[solver]()

    def __str__(self) -> str:
        n, n_u, n_y = (self.function.size1_in(0), self.function.size1_in(1), self.function.size1_out(1))
        limits = "inputs and outputs" if self.limited else "inputs"
        return (
            f"predictive controller over {self.horizon} samples by {self.solver}: {n} states, {n_u} inputs, {n_y} "
            f"outputs, limits of the {limits}" + (", rates limited" if np.isfinite(self.rate).any() else "")
        )

    __repr__ = __str__

    def __call__(self, x: Array, reference: Array, u_previous: Array) -> Plan:
        """Plan from the state x, towards the reference (N, n_y) from the present sample on.

        `u_previous` is the input of the sample before; the last plan, shifted, is where the search begins.
        """
        begin = perf_counter()
        n_u, n_y = self.function.size1_in(1), self.function.size1_out(1)
        wanted = path(reference, self.horizon, n_y)
        before = numbers(u_previous, "The previous input").reshape(-1)
        state = numbers(x, "The state").ravel()
        if len(before) != n_u or len(state) != self.function.size1_in(0):
            raise InputError(
                f"A state of {len(state)} numbers and {len(before)} previous inputs were given; give "
                f"{self.function.size1_in(0)} and {n_u}."
            )
        start = np.tile(before, self.horizon) if self._plan is None else np.append(self._plan[n_u:], self._plan[-n_u:])
        solve = self._solve_sqp if self.solver == "sqp" else self._solve_ipopt
        rate = self.rate.copy()
        rate[:n_u] = np.maximum(rate[:n_u], np.maximum(self.low[:n_u] - before, before - self.high[:n_u]))
        u, y, slack, converged = solve(state, wanted, before, self._within(start, before, rate), rate)
        self._plan = u
        shaped = u.reshape(-1, n_u), y.reshape(-1, n_y)
        cost = self._cost(u, y, wanted, before)
        return Plan(*shaped, cost, slack, perf_counter() - begin, converged and bool(np.isfinite(cost)))

    def _within(self, u: Array, before: Array, rate: Array) -> Array:
        """Inputs moved into the limits and the rates, sample by sample."""
        n, u = len(before), np.clip(u, self.low, self.high)
        if np.any(np.abs(u - np.concatenate([before, u[:-n]])) > rate):
            for k in range(0, len(u), n):
                here = slice(k, k + n)
                slow = np.clip(u[here], before - rate[here], before + rate[here])
                u[here] = before = np.clip(slow, self.low[here], self.high[here])
        return u

    def _offset(self, before: Array) -> Array:
        return np.concatenate([before, np.zeros(len(self.low) - len(before))])

    def _cost(self, u: Array, y: Array, wanted: Array, before: Array) -> float:
        moves = self._weighted @ u - self._moved(before)
        over = np.maximum(0, np.maximum(self.low_y - y, y - self.high_y)) / self.y_scale
        return float(
            np.sum(((y - wanted) / self.y_scale) ** 2) + np.sum(moves**2) + PENALTY * np.max(over, initial=0.0)
        )

    def _moved(self, before: Array) -> Array:
        """What the previous input contributes to the weighted changes."""
        root = np.abs(np.diag(self._weighted))
        return self._offset(before) * root

    # --- states eliminated, Gauss-Newton
    def _build_sqp(self) -> None:
        n, n_u = self.function.size1_in(0), self.function.size1_in(1)
        x, u = ca.SX.sym("x", n), ca.SX.sym("u", n_u * self.horizon)
        state, outputs = x, []
        for k in range(self.horizon):
            state, y = self.function(state, u[k * n_u : (k + 1) * n_u])
            outputs.append(y)
        stacked = ca.vertcat(*outputs)
        self._predict = ca.Function("predict", [x, u], [stacked])
        self._slopes = ca.Function("slopes", [x, u], [stacked, ca.densify(ca.jacobian(stacked, u))])
        size, rows = len(self.low), 2 * len(self.low_y) * self.limited + len(self.low) * np.isfinite(self.rate).any()
        m = size + self.limited
        structure = {"h": ca.Sparsity.dense(m, m), "a": ca.Sparsity.dense(rows, m)}
        unconstrained(np.eye(1), np.zeros(1))  # what it imports is not paid for by the first plan
        self._qp = ca.conic("qp", "daqp", structure, {"error_on_fail": False})

    def _solve_sqp(
        self, x: Array, wanted: Array, before: Array, u: Array, rate: Array
    ) -> tuple[Array, Array, float, bool]:
        moved, converged, best, y = self._moved(before), False, np.inf, np.zeros(0)
        for _ in range(self.iterations if self._plan is not None else 10 * self.iterations):
            out, jac = self._slopes(x, u)
            y, jac = out.full().ravel(), jac.full()
            best = self._cost(u, y, wanted, before)
            step = self._qp_step(u, y, jac, wanted, before, moved, rate)
            if step is None:
                break
            if np.max(np.abs(step) / self.u_scale) < CLOSE:
                converged = True
                break
            expected = self._cost(u + step, y + jac @ step, wanted, before)
            for share in (1.0, 0.5, 0.25, 0.1):
                trial = np.clip(u + share * step, self.low, self.high)
                output = self._predict(x, trial).full().ravel()
                value = self._cost(trial, output, wanted, before)
                if value < best:
                    break
            else:
                converged = True  # at a kink: no shorter step is better
                break
            converged = (share == 1.0 and value - expected < 1e-4 * value) or best - value < 1e-6 * value
            u, y = trial, output
            if converged:  # no kink in between, or next to nothing gained
                break
        return u, y, self._over(y), bool(converged)

    def _over(self, y: Array) -> float:
        """How far the outputs are beyond their limits at most."""
        return float(np.max(np.maximum(0, np.maximum(self.low_y - y, y - self.high_y)), initial=0.0))

    def _qp_step(
        self, u: Array, y: Array, jac: Array, wanted: Array, before: Array, moved: Array, rate: Array
    ) -> Array | None:
        """Gauss-Newton step inside the limits, the QP in units of u_scale; None where the solver finds none."""
        if not (np.all(np.isfinite(y)) and np.all(np.isfinite(jac))):
            return None
        scaled, weighted = jac * (self.u_scale / self.y_scale[:, None]), self._weighted * self.u_scale
        h = 2 * (scaled.T @ scaled + weighted.T @ weighted)
        g = 2 * (scaled.T @ ((y - wanted) / self.y_scale) + weighted.T @ (self._weighted @ u - moved))
        lbx, ubx = (self.low - u) / self.u_scale, (self.high - u) / self.u_scale
        below, above = (self.low_y - y) / self.y_scale, (self.high_y - y) / self.y_scale
        changes, gap = self._differences * self.u_scale, self._offset(before) - self._differences @ u
        free = unconstrained(h, g)
        if free is not None and np.all((lbx <= free) & (free <= ubx)):
            outputs, moves = scaled @ free, changes @ free - gap
            if np.all((below <= outputs) & (outputs <= above)) and np.all(np.abs(moves) <= rate):
                return np.asarray(free * self.u_scale)
        a, lba, uba = [], [], []
        if np.any(np.isfinite(rate)):
            rate = np.minimum(rate, ENORMOUS)
            a, lba, uba = (
                [np.hstack([changes, np.zeros((len(u), int(self.limited)))])],
                [gap - rate],
                [gap + rate],
            )
        if self.limited:
            h, g = np.pad(h, (0, 1)), np.append(g, PENALTY)
            h[-1, -1] = 1e-6 * PENALTY
            lbx, ubx = np.append(lbx, 0.0), np.append(ubx, ENORMOUS)
            one, none = np.ones((len(y), 1)), np.full(len(y), ENORMOUS)
            a += [np.hstack([scaled, one]), np.hstack([scaled, -one])]
            lba, uba = [*lba, below, -none], [*uba, none, above]
        rows = {"a": np.vstack(a), "lba": np.concatenate(lba), "uba": np.concatenate(uba)} if a else {}
        out = self._qp(h=h, g=g, lbx=lbx, ubx=ubx, **rows)
        return out["x"].full().ravel()[: len(u)] * self.u_scale if self._qp.stats()["success"] else None

    # --- multiple shooting
    def _build_ipopt(self) -> None:
        n, n_u, n_y, m = (*(self.function.size1_in(i) for i in (0, 1)), self.function.size1_out(1), self.horizon)
        states, u, s = ca.MX.sym("X", n, m), ca.MX.sym("U", n_u, m), ca.MX.sym("s")
        x, wanted, before = ca.MX.sym("x", n), ca.MX.sym("r", n_y, m), ca.MX.sym("before", n_u)
        following, y = self.function.map(m)(ca.horzcat(x, states[:, :-1]), u)
        error = (ca.vec(y) - ca.vec(wanted)) / self.y_scale
        moves = ca.DM(self._weighted) @ ca.vec(u)
        first = ca.vertcat(before, ca.DM.zeros(n_u * (m - 1))) * np.abs(np.diag(self._weighted))
        cost = ca.sumsqr(error) + ca.sumsqr(moves - first) + PENALTY * s
        changes = ca.DM(self._differences) @ ca.vec(u) - ca.vertcat(before, ca.DM.zeros(n_u * (m - 1)))
        y = ca.vec(y) / self.y_scale
        nlp = {
            "x": ca.vertcat(ca.vec(states), ca.vec(u), s),
            "p": ca.vertcat(x, ca.vec(wanted), before),
            "f": cost,
            "g": ca.vertcat(ca.vec(following - states), changes, y + s, y - s),
        }
        quiet = {"print_level": 0, "sb": "yes", "tol": 1e-9, "max_iter": 100, "warm_start_init_point": "yes"}
        self._nlp = ca.nlpsol("mpc", "ipopt", nlp, {"ipopt": {**quiet, "mu_init": 1e-4}, "print_time": False})
        free, zero = np.full(n_y * m, np.inf), np.zeros(n * m)
        low_y, high_y = (np.where(np.abs(v) < ENORMOUS, v, np.sign(v) * np.inf) for v in (self.low_y, self.high_y))
        self._bounds = {
            "lbx": np.concatenate([np.full(n * m, -np.inf), self.low, [0.0]]),
            "ubx": np.concatenate([np.full(n * m, np.inf), self.high, [np.inf]]),
        }
        self._sides = (zero, low_y / self.y_scale, -free), (zero, free, high_y / self.y_scale)
        self._simulate = self.function.mapaccum("simulate", m)

    def _solve_ipopt(
        self, x: Array, wanted: Array, before: Array, u: Array, rate: Array
    ) -> tuple[Array, Array, float, bool]:
        n_u, m = self.function.size1_in(1), self.horizon
        states = np.asarray(self._simulate(x, u.reshape(m, n_u).T)[0]).ravel(order="F")
        p = np.concatenate([x, wanted, before])
        (zero, low, free), (_, none, high) = self._sides
        limits = {"lbg": np.concatenate([zero, -rate, low, free]), "ubg": np.concatenate([zero, rate, none, high])}
        out = self._nlp(x0=np.concatenate([states, u, [0.0]]), p=p, **self._bounds, **limits)
        found = np.asarray(out["x"]).ravel()
        u = np.clip(found[len(states) : -1], self.low, self.high)
        y = np.asarray(self._simulate(x, u.reshape(m, n_u).T)[1]).ravel(order="F")
        return u, y, self._over(y), bool(self._nlp.stats()["success"])
