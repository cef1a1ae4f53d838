"""draft"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from .problem import Problem
from .solution import Iteration, Progress, Solution, Status

class _Callback(ca.Callback):
    def __init__(self, name, inputs, outputs, evaluate):
        ca.Callback.__init__(self)
        self._ins, self._outs, self._evaluate = list(inputs.items()), list(outputs.items()), evaluate
        self.construct(name, {})
    def get_n_in(self): return len(self._ins)
    def get_n_out(self): return len(self._outs)
    def get_name_in(self, i): return self._ins[i][0]
    def get_name_out(self, i): return self._outs[i][0]
    def get_sparsity_in(self, i): return self._ins[i][1]
    def get_sparsity_out(self, i): return self._outs[i][1]
    def eval(self, arg): return self._evaluate(*arg)


@dataclass(frozen=True)
class Ipopt:
    hessian: str = "gauss-newton"
    max_iterations: int = 300
    tolerance: float = 1e-5
    patience: int = 5
    damping: float = 1e-1
    time_limit: float = np.inf
    options: Any = None
    mu: float = 1e-3

    def solve(self, problem, start=None, progress=None):
        return _Run(self, problem, problem.start if start is None else start, progress).run()


class _Run:
    def __init__(self, options, problem, start, progress):
        self.options, self.problem, self.progress = options, problem, progress
        self.start = np.clip(np.asarray(start, float), problem.lower, problem.upper)
        self.n, self.n_g = problem.size, len(problem.g_lower)
        self.began = time.perf_counter()
        self.history = []
        self.damping, self.growth = options.damping, 2.0
        self.memo_x = None; self.normal_x = None
        self.last = None
        self.evals = 0
        self.best = None
        self.recent = []
        self.stop = None
        self.diag_max = None
        self.multipliers = np.zeros(self.n + self.n_g)

    # scaled
    def theta(self, x): return np.asarray(x).ravel() / self.s
    def value(self, x):
        x = np.asarray(x).ravel()
        key = x.tobytes()
        if self.memo_x != key:
            theta = x / self.s
            f = self.problem.cost(theta)
            g = self.problem.constraint(theta) if self.n_g else np.zeros(0)
            self.memo_x, self.memo = key, (f / self.f0, g / self.r)
            self.evals += 1
            if np.isfinite(f):
                viol = float(np.max(np.maximum(self.problem.g_lower - g, g - self.problem.g_upper), initial=0.0))
                rank = (max(viol, 1e-8), f)
                if self.best is None or rank < self.best[0]:
                    self.best = (rank, np.clip(theta, self.problem.lower, self.problem.upper))
        return self.memo
    def normal(self, x):
        x = np.asarray(x).ravel(); key = x.tobytes()
        if self.normal_x != key:
            f, g, h = self.problem.normal(x / self.s)
            self.normal_x = key
            self.norm = (f / self.f0, g / self.s / self.f0, h / self.s / self.s[:, None] / self.f0)
        return self.norm

    def hess(self, x, sigma):
        x = np.asarray(x).ravel(); sigma = float(sigma)
        if sigma == 0.0: return np.zeros((self.n, self.n))
        f, g, h = self.normal(x)
        self.diag_max = np.maximum(self.diag_max, np.diag(h))
        floor = np.where(self.diag_max > 0, self.diag_max, 1.0)
        if self.last is not None and self.last[0] is not None and not np.array_equal(self.last[0], x):
            x0, f0, g0, h0, lam0, fl0 = self.last
            d = x - x0
            pred = -(g0 @ d + 0.5 * d @ h0 @ d)
            curv = 0.5 * d @ h0 @ d + lam0 * d @ (fl0 * d)
            ratio = 1 + ((f0 - f) - pred) / max(curv, 1e-300)
            ratio = float(np.clip(ratio, -2, 2))
            if self.evals > 1 :
                self.damping *= min(4.0 ** (self.evals - 1), 100)
            elif ratio < 1e-4 :
                self.damping *= self.growth; self.growth *= 2
            else:
                self.damping = max(self.damping * max(1 / 3, 1 - (2 * min(ratio, 1) - 1) ** 3), 1e-12)
                self.growth = 2.0
            self.trace = (ratio, self.evals)
        self.evals = 0
        self.last = (x, f, g, h, self.damping, floor)
        return sigma * (h + self.damping * np.diag(floor))

    def scaling(self):
        p = self.problem
        f, g, h = p.normal(self.start)
        self.f0 = max(f, 1e-300)
        d = np.diag(h).copy()
        u = 1 / np.sqrt(np.where(d > 0, d, 1.0))
        lam, probe = self.options.damping, self.start
        for _ in range(20):
            step = -np.linalg.solve(h * u * u[:, None] + lam * np.eye(self.n), g * u) * u
            trial = np.clip(self.start + step, p.lower, p.upper)
            if p.cost(trial) <= f: probe = trial; break
            lam *= 4
        self.damping = lam
        h2 = p.normal(probe)[2]
        if np.all(np.isfinite(h2)): d = np.maximum(d, np.diag(h2))
        self.zero = int((d <= 0).sum())
        d = np.where(d > 0, d, np.median(d[d > 0]))
        self.s = np.sqrt(d / self.f0)
        self.r = np.ones(self.n_g)
        if self.n_g:
            J = p.constraint_jacobian(self.start) / self.s
            self.r = np.maximum(np.abs(J).max(axis=1), 1e-300)
        self.diag_max = np.zeros(self.n)

    def callback(self, x, f, g, lam_x, lam_g, lam_p):
        x = np.asarray(x).ravel()
        theta = x / self.s; f = float(f) * self.f0
        self.recent.append(f)
        lam_x = np.asarray(lam_x).ravel(); lam_g = np.asarray(lam_g).ravel()
        self.lam = (lam_x, lam_g)
        comp = 0.0
        lx, ux = self.problem.lower * self.s, self.problem.upper * self.s
        with np.errstate(invalid='ignore'):
            gap = np.where(lam_x < 0, x - lx, ux - x)
        comp = float(np.sum(np.where(lam_x != 0, np.abs(lam_x) * np.where(np.isfinite(gap), gap, 0), 0)))
        it = Iteration(len(self.recent) - 1, f, time.perf_counter() - self.began, comp, self.damping)
        self.history.append(it)
        if self.progress: self.progress(it)
        if it.seconds > self.options.time_limit: self.stop = Status.TIME_LIMIT
        k = self.options.patience
        if len(self.recent) > k and abs(self.recent[-1 - k] - self.recent[-1]) < self.options.tolerance * f and comp * self.f0 < 1e-3 * f + 0 and self.best[0][0] <= 1e-8:
            self.stop = Status.CONVERGED
        return 1 if self.stop else 0

    def run(self):
        p, n, m = self.problem, self.n, self.n_g
        self.scaling()
        D = ca.Sparsity.dense
        V, P, one, G = D(n, 1), ca.Sparsity(0, 0), D(1, 1), D(m, 1)
        oracle = _Callback("nlp", {"x": V, "p": P}, {"f": one, "g": G}, lambda x, p: list(self.value(x)))
        grad = _Callback("nlp_grad_f", {"x": V, "p": P}, {"f": one, "grad_f_x": V}, lambda x, p: list(self.normal(x)[:2]))
        jac = _Callback("nlp_jac_g", {"x": V, "p": P}, {"g": G, "jac_g_x": D(m, n)}, lambda x, p_: [self.value(x)[1], p.constraint_jacobian(self.theta(x)) / self.s / self.r[:, None]])
        hess = _Callback("nlp_hess_l", {"x": V, "p": P, "lam_f": one, "lam_g": G}, {"triu_hess_gamma_x_x": ca.Sparsity.upper(n)}, lambda x, p, a, b: [ca.triu(ca.DM(self.hess(x, a)))])
        ins = {"x": V, "f": one, "g": G, "lam_x": V, "lam_g": G, "lam_p": D(0, 1)}
        cb = _Callback("it", ins, {"ret": one}, lambda *a: [self.callback(*a)])
        ip = dict(print_level=0, sb="yes", bound_relax_factor=0.0, nlp_scaling_method="none", max_iter=self.options.max_iterations, tol=1e-9, mu_init=self.options.mu, watchdog_shortened_iter_trigger=0,
            mu_strategy="adaptive", mu_max=1e-3, bound_push=1e-4, bound_frac=1e-4, adaptive_mu_globalization="never-monotone-mode")
        ip.update(self.options.options or {})
        opts = dict(grad_f=grad, no_nlp_grad=True, iteration_callback=cb, print_time=False, calc_lam_p=False, show_eval_warnings=False, ipopt=ip)
        if self.options.hessian == "gauss-newton": opts["hess_lag"] = hess
        else: ip["hessian_approximation"] = "limited-memory"
        if m: opts["jac_g"] = jac
        solver = ca.nlpsol("ipopt", "ipopt", oracle, opts)
        r = solver(x0=self.start * self.s, lbx=p.lower * self.s, ubx=p.upper * self.s, lbg=p.g_lower / self.r, ubg=p.g_upper / self.r)
        self.status = solver.stats()["return_status"]
        theta = self.best[1]
        return Solution(theta, p.cost(theta), self.stop or Status.CONVERGED, len(self.recent), time.perf_counter() - self.began, message=self.status, history=tuple(self.history))
