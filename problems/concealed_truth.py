"""Truth of the concealed cases, simulated apart from the package: plain equations with a hidden effect in a port.

Only the user's callables (`dynamics`, `outputs`, a port's `into`, `across`, `rate`) are shared with what is handed out;
integrator, memory laws and refit stand here. Classical Runge-Kutta on a grid several times finer than the package
would choose; a law with memory is moved from the memory at the step's begin and updated at its end.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

Array = np.ndarray
BLOCK = 500  # fine steps in one unrolled call


@dataclass(frozen=True, eq=False)
class Effect:
    """A hidden effect: `fn(s) -> (w, dq, m_next)` of the signals s.z, s.dz, s.q, s.m, s.t, s.x, s.noise at a port."""

    port: str
    law: str
    variant: str
    fn: Callable[[Any], tuple[Any, Any, Any]] | None = None
    n_q: int = 0
    n_m: int = 0
    delay: float = 0.0  # s, at an actuator or a sensor
    numbers: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Motion:
    """A simulation on its samples: outputs (M, n_y), and z, dz, forces by port name on the samples."""

    y: Array
    z: dict[str, Array]
    dz: dict[str, Array]
    derivative: Array
    end: Array


def named(names: Sequence[str], vector: Any) -> SimpleNamespace:
    """Entries of a symbolic vector by name."""
    return SimpleNamespace(**{n: vector[i] for i, n in enumerate(names)})


def pick(function: Any, **have: Any) -> Any:
    """Call with the arguments it names."""
    if not callable(function):
        return function
    code = function.__code__
    return function(**{n: have[n] for n in code.co_varnames[: code.co_argcount]})


class Plant:
    """Equations of a rig with effects closed in, as one fine step `(state, u0, u1, d, t, p) -> (state', monitor)`."""

    def __init__(self, module: Mapping[str, Any], names: Mapping[str, tuple[str, ...]], effects: Sequence[Effect]):
        self.module, self.names, self.effects = module, names, tuple(e for e in effects if e.fn)
        self.delays = {e.port: e.delay for e in effects if e.delay}
        self.ports = {p.name: p for p in module["PORTS"]}
        self.n_x, self.n_u = len(names["states"]), len(names["inputs"])
        self.n_q, self.n_m = sum(e.n_q for e in self.effects), sum(e.n_m for e in self.effects)
        self.size = self.n_x + self.n_q + self.n_m

    def _evaluate(self, v: Any, m: Any, u: Any, slope: Any, d: Any, t: Any, p: Any) -> tuple[Any, Any, Any]:
        """Derivatives of [x; q], next memory, monitor [y; z and dz of each port; dx]."""
        xs, q = v[: self.n_x], v[self.n_x :]
        x, pp = named(self.names["states"], xs), named(self.names["parameters"], p)
        cut = {}
        a = b = 0
        for e in self.effects:
            cut[e] = q[a : a + e.n_q], m[b : b + e.n_m]
            a, b = a + e.n_q, b + e.n_m
        flow: dict[Effect, Any] = {}
        memory: dict[Effect, Any] = {}

        def apply(e: Effect, z: Any, dz: Any) -> Any:
            s = SimpleNamespace(z=z, dz=dz, q=cut[e][0], m=cut[e][1], t=t, x=x, noise=d)
            w, flow[e], memory[e] = e.fn(s)  # type: ignore[misc]
            return w

        raw, u = u, ca.vertcat(*[u[i] for i in range(self.n_u)])
        for e in self.effects:
            if e.port.startswith("actuator:"):
                i = self.names["inputs"].index(e.port.split(":")[1])
                u[i] = u[i] + apply(e, u[i], slope[i])
        uu = named(self.names["inputs"], u)
        found = pick(self.module["dynamics"], x=x, u=uu, p=pp, t=t) if self.n_x else {}
        f = ca.vertcat(ca.SX(0, 1), *[ca.SX(found[n]) for n in self.names["states"]])
        found = pick(self.module["outputs"], x=x, u=uu, p=pp, t=t)
        y = ca.vertcat(*[ca.SX(found[n]) for n in self.names["outputs"]])
        bare, seen = f, []
        for name, port in self.ports.items():
            z = ca.SX(pick(port.across, x=x, u=uu, p=pp))
            chain = ca.jtimes(z, ca.vertcat(v, raw), ca.vertcat(bare, ca.SX(self.n_q, 1), slope))
            dz = pick(port.rate, x=x, u=uu, p=pp) if port.rate else chain
            seen += [z, ca.SX(dz)]
            for e in self.effects:
                if e.port == name:
                    w = apply(e, z, dz)
                    for target, factor in pick(port.into, x=x, u=uu, p=pp).items():
                        if target in self.names["states"]:
                            f[self.names["states"].index(target)] += factor * w
                        else:
                            y[self.names["outputs"].index(target)] += factor * w
        for e in self.effects:
            if e.port.startswith("sensor:"):
                i = self.names["outputs"].index(e.port.split(":")[1])
                rate = ca.jtimes(y[i], ca.vertcat(v, raw), ca.vertcat(f, ca.SX(self.n_q, 1), slope))
                y[i] = y[i] + apply(e, y[i], rate)
        dq = ca.vertcat(ca.SX(0, 1), *[flow[e] for e in self.effects if e.n_q])
        nm = ca.vertcat(ca.SX(0, 1), *[memory[e] for e in self.effects if e.n_m])
        return ca.vertcat(f, dq), nm, ca.vertcat(y, *seen, f)

    def step(self, h: float) -> ca.Function:
        """One fine step."""
        n_v = self.n_x + self.n_q
        state, p = ca.SX.sym("state", self.size), ca.SX.sym("p", len(self.names["parameters"]))
        u0, u1 = ca.SX.sym("u0", self.n_u), ca.SX.sym("u1", self.n_u)
        d, t = ca.SX.sym("d"), ca.SX.sym("t")
        v, m, mid, slope = state[:n_v], state[n_v:], (u0 + u1) / 2, (u1 - u0) / h

        here = [ca.SX.sym(n, k) for n, k in (("v", n_v), ("m", self.n_m), ("u", self.n_u), ("slope", self.n_u))]
        here += [ca.SX.sym("d"), ca.SX.sym("t"), p]
        equations = ca.Function("equations", here, list(self._evaluate(*here)))

        def at(v: Any, u: Any, time: Any) -> Any:
            return equations(v, m, u, slope, d, time, p)

        k1, _, seen = at(v, u0, t)
        if n_v:
            k2 = at(v + h / 2 * k1, mid, t + h / 2)[0]
            k3 = at(v + h / 2 * k2, mid, t + h / 2)[0]
            k4 = at(v + h * k3, u1, t + h)[0]
            v = v + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        nm = at(v, u1, t + h)[1] if self.n_m else m
        following, seen = ca.cse([ca.vertcat(v, nm), seen])
        names = ["x", "u0", "u1", "d", "t", "p"]
        return ca.Function("fine", [state, u0, u1, d, t, p], [following, seen], names, ["x_next", "seen"])


def fine_inputs(u: Array, fine: int, hold: str) -> tuple[Array, Array]:
    """Inputs at begin and end of every fine step, each (M·fine, n_u)."""
    if hold == "zero":
        held = np.repeat(u, fine, axis=0)
        return held, held
    following = np.vstack([u[1:], u[-1:]])
    at = (np.arange(fine + 1) / fine)[None, :, None]
    grid = u[:, None, :] * (1 - at) + following[:, None, :] * at
    return grid[:, :-1].reshape(-1, u.shape[1]), grid[:, 1:].reshape(-1, u.shape[1])


def late(a: Array, n: int) -> Array:
    """A series moved n fine steps later; before it there was rest."""
    return a if n <= 0 else np.concatenate([np.zeros_like(a[:n]), a[:-n]])


def simulate(
    plant: Plant,
    p: Array,
    u: Array,
    dt: float,
    hold: str,
    fine: int,
    x0: Array | None = None,
    noise: Array | None = None,
) -> Motion:
    """Run over the samples of u (M, n_u) from x0 (default at rest); `noise` (M,) is an outside disturbance's shape."""
    m, h = len(u), dt / fine
    u0, u1 = fine_inputs(u, fine, hold)
    for i, name in enumerate(plant.names["inputs"]):
        n = round(plant.delays.get(f"actuator:{name}", 0.0) / h)
        if n:
            u0, u1 = np.array(u0), np.array(u1)
            u0[:, i], u1[:, i] = late(u0[:, i], n), late(u1[:, i], n)
    total = m * fine
    d = np.zeros(total) if noise is None else np.interp(np.arange(total) / fine, np.arange(m), noise)
    run = plant.step(h).mapaccum("run", BLOCK, {"base": 10})
    state = np.zeros(plant.size)
    if x0 is not None:
        state[: len(x0)] = x0
    columns, pad = [], -total % BLOCK
    u0, u1 = (np.vstack([a, np.repeat(a[-1:], pad, axis=0)]) for a in (u0, u1))
    d, t = np.pad(d, (0, pad)), np.arange(total + pad) * h
    for k in range(0, total, BLOCK):
        s = slice(k, k + BLOCK)
        xs, seen = run(state, u0[s].T, u1[s].T, d[None, s], t[None, s], ca.repmat(ca.DM(p), 1, BLOCK))
        state = np.asarray(xs)[:, -1]
        columns.append(np.asarray(seen))
        if not np.all(np.isfinite(columns[-1])):
            raise FloatingPointError("the truth diverges")
    seen = np.concatenate(columns, axis=1)[:, :total].T
    n_y = len(plant.names["outputs"])
    y = np.array(seen[:, :n_y])
    for i, name in enumerate(plant.names["outputs"]):
        y[:, i] = late(y[:, i], round(plant.delays.get(f"sensor:{name}", 0.0) / h))
    samples = seen[::fine]
    at = {name: n_y + 2 * i for i, name in enumerate(plant.ports)}
    return Motion(
        y[::fine],
        {name: samples[:, k] for name, k in at.items()},
        {name: samples[:, k + 1] for name, k in at.items()},
        samples[:, n_y + 2 * len(at) :],
        state,
    )


def refit(
    plant: Plant,
    p: Array,
    free: Array,
    u: Array,
    y: Array,
    dt: float,
    hold: str,
    coarse: int,
    lower: Array,
    upper: Array,
    steps: int = 4,
) -> float:
    """NRMSE left by a plant after a few damped Gauss-Newton steps on its free parameters and x0."""
    sigma = np.maximum(y.std(axis=0), 1e-300)
    m, n_x = len(u), plant.n_x
    u0, u1 = fine_inputs(u, coarse, hold)
    run = plant.step(dt / coarse).mapaccum("run", BLOCK, {"base": 10})
    total, pad = m * coarse, -(m * coarse) % BLOCK
    u0, u1 = (np.vstack([a, np.repeat(a[-1:], pad, axis=0)]).T for a in (u0, u1))
    zeros, t = np.zeros((1, BLOCK)), np.arange(total + pad)[None, :] * dt / coarse

    def output(p: Array, x0: Array) -> Array:
        state, columns = np.concatenate([x0, np.zeros(plant.size - n_x)]), []
        for k in range(0, total, BLOCK):
            s = slice(k, k + BLOCK)
            xs, seen = run(state, u0[:, s], u1[:, s], zeros, t[:, s], ca.repmat(ca.DM(p), 1, BLOCK))
            state = np.asarray(xs)[:, -1] if plant.size else state
            columns.append(np.asarray(seen)[: y.shape[1]])
        return np.concatenate(columns, axis=1)[:, :total:coarse].T

    x0, index = np.zeros(n_x), np.flatnonzero(free)
    now = output(p, x0)
    step0 = None
    for _ in range(steps):
        e = ((y - now) / sigma).ravel()
        with np.errstate(over="ignore"):
            cost = float(e @ e)
        if not np.isfinite(cost):
            return np.inf
        columns = []
        for i in index:
            q = p.copy()
            q[i] += 1e-4 * max(abs(p[i]), 1e-3 * (upper[i] - lower[i]))
            columns.append(((output(q, x0) - now) / sigma).ravel() / (q[i] - p[i]))
        if step0 is None:  # the initial state enters almost linearly: its columns are kept
            reach = 1e-3 * np.maximum(1e-9, np.ones(n_x))
            step0 = [((output(p, x0 + reach * r) - now) / sigma).ravel() / 1e-3 for r in np.eye(n_x)]
        jacobian = np.stack(columns + step0, axis=1) if columns + step0 else np.zeros((len(e), 1))
        norm = np.linalg.norm(jacobian, axis=0)
        norm[norm == 0] = 1.0
        jacobian = jacobian / norm
        for damping in (1e-6, 1e-2, 1.0):
            h = jacobian.T @ jacobian + damping * np.eye(len(norm))
            d = np.linalg.solve(h + 1e-10 * np.eye(len(h)), jacobian.T @ e) / norm
            q = p.copy()
            q[index] = np.clip(p[index] + d[: len(index)], lower[index], upper[index])
            trial_x0 = x0 + d[len(index) :] if n_x else x0
            trial = output(q, trial_x0)
            with np.errstate(over="ignore"):
                new = float(np.sum(((y - trial) / sigma) ** 2))
            if np.isfinite(new) and new < cost:
                break
        else:
            break
        p, x0, now = q, trial_x0, trial
        if new > 0.98 * cost:
            break
    e = (y - now) / sigma
    return float(np.mean(np.sqrt(np.mean(e**2, axis=0))))
