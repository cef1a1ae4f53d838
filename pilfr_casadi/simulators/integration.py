"""A simulator as a discrete-time `Model`: classical Runge-Kutta of fourth order with a fixed sub-step.

Within a sub-step of length h the inputs are held or follow their chord, and

    k₁ = f(x, u₀), k₂ = f(x + h k₁/2, u_½), k₃ = f(x + h k₂/2, u_½), k₄ = f(x + h k₃, u₁),
    x⁺ = x + h (k₁ + 2 k₂ + 2 k₃ + k₄) / 6.

Laws are evaluated inside every stage; one with memory (`step(z, s, p)`, such as a play) from its memory at the
sub-step's begin, moved on once by the signal there (moving it again by the same signal must change nothing). A law with
differential equations of its own (`flow`) adds states. The model's state is [x; laws' states; laws' memory].
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from ..models import Model, ParameterSet, StepExpressions, accumulate_steps, from_expressions
from .expressions import Named, call
from .simulator import Placed, Simulator, in_series


@dataclass(frozen=True, eq=False)
class Instant:
    """What is known at one instant inside a sub-step."""

    x: Any  # simulator's states and laws' states
    s: Any  # laws' memory
    u: Any
    slope: Any  # du/dt
    t: Any


class Equations:
    """The closed equations of a simulator with its laws, on symbols."""

    def __init__(self, simulator: Simulator, vector: Any) -> None:
        self.simulator = simulator
        parameters = ParameterSet(dict(simulator.parameters))
        self.values = parameters.symbols(vector)
        self.p = Named("parameter", self.values)
        laws = [e.law for e in simulator.elements]
        self.n_q = [int(getattr(law, "order", 0)) for law in laws]
        self.n_s = [int(law.memory) if hasattr(law, "step") else 0 for law in laws]
        self.vector = vector
        self.local = signals(simulator)
        self.rows = {port.name: i for i, port in enumerate(simulator.all_ports())}

    def _own(self, element: Placed) -> Named:
        n = len(element.prefix)
        return Named("parameter", {k[n:]: v for k, v in self.values.items() if k.startswith(element.prefix)})

    def _parts(self, x: Any, s: Any) -> tuple[list[Any], list[Any], Any]:
        n_x = len(self.simulator.states)
        at_q, at_s = np.cumsum([n_x, *self.n_q]), np.cumsum([0, *self.n_s])
        q = [x[int(a) : int(b)] for a, b in pairwise(at_q)]
        memory = [s[int(a) : int(b)] for a, b in pairwise(at_s)]
        return q, memory, x[:n_x]

    def evaluate(self, v: Instant) -> tuple[Any, Any, Any, dict[int, tuple[Any, Any, Any]]]:
        """Derivatives of [x; q], outputs, next memory, and each element's (z, dz, w)."""
        simulator, p, t = self.simulator, self.p, v.t
        q, s, x_only = self._parts(v.x, v.s)
        x = Named("state", dict(zip(simulator.states, ca.vertsplit(x_only) if simulator.states else [], strict=True)))
        u = {name: v.u[i] for i, name in enumerate(simulator.inputs)}
        signals: dict[int, tuple[Any, Any, Any]] = {}
        flow: list[Any] = [ca.SX(n, 1) for n in self.n_q]
        memory: list[Any] = [ca.SX(n, 1) for n in self.n_s]

        def apply(i: int, z: Any, dz: Any) -> Any:
            e, now = simulator.elements[i], Named("input", u)
            have = {"z": z, "dz": dz, "q": q[i], "p": self._own(e), "t": t, "x": x, "u": now}
            if hasattr(e.law, "step"):
                rate = {"dz": dz} if "dz" in inspect.signature(e.law.step).parameters else {}
                w, memory[i] = e.law.step(z, s[i], self._own(e), **rate)
            else:
                w = call(e.law.force, f"law {e.law.id!r}", **have)
                if self.n_q[i]:
                    flow[i] = call(e.law.flow, f"law {e.law.id!r}", **have)
            if by := getattr(e.law, "scaled_by", ""):
                w = w * now[by]
            signals[i] = (z, dz, w)
            return w

        placed = list(enumerate(simulator.elements))
        for i, e in placed:
            if e.port.startswith("actuator:"):
                name = e.port.removeprefix("actuator:")
                at = simulator.inputs.index(name)
                u[name] = u[name] + apply(i, u[name], v.slope[at])
        inputs = Named("input", u)
        f = simulator.derivatives(x, inputs, p, t)
        y = simulator.measured(x, inputs, p, t)
        rates = self.local(x_only, ca.vertcat(*u.values()), v.slope, t, self.vector)[1]
        for i, e in placed:
            if in_series(e.port):
                continue
            port = simulator.port(e.port)
            z = simulator.across(port, x, inputs, p, t)
            w = apply(i, z, rates[self.rows[e.port]])
            for name, factor in simulator.into(port, x, inputs, p, t).items():
                if name in simulator.states:
                    unit = ca.SX.zeros(f.shape)
                    unit[simulator.states.index(name)] = factor
                    f = f + unit * w
                else:
                    y[name] = y[name] + factor * w
        for i, e in placed:
            if e.port.startswith("sensor:"):
                name = e.port.removeprefix("sensor:")
                y[name] = y[name] + apply(i, y[name], rates[self.rows[e.port]])
        return ca.vertcat(f, *flow), ca.vertcat(*y.values()), ca.vertcat(ca.SX(0, 1), *memory), signals

    def memory(self, z: Any, s: Any) -> Any:
        """Next memory of all laws from the local signal of each of its entries."""
        _, parts, _ = self._parts(ca.SX(len(self.simulator.states) + sum(self.n_q), 1), s)
        at, out = 0, [ca.SX(0, 1)]
        for element, part, n in zip(self.simulator.elements, parts, self.n_s, strict=True):
            out += [element.law.step(z[at], part, self._own(element))[1]] if n else []
            at += n
        return ca.vertcat(*out)


def on_grid(simulator: Simulator, h: float) -> Simulator:
    """The simulator with its laws made for steps of length h, s."""
    placed = (replace(e, law=e.law.on_grid(h)) if hasattr(e.law, "on_grid") else e for e in simulator.elements)
    return replace(simulator, elements=tuple(placed))


def discretise(simulator: Simulator, dt: float, hold: str = "zero", substeps: int = 1) -> Model:
    """The simulator with its laws as a closed discrete-time model.

    Parameters
    ----------
    simulator : Simulator
    dt : float
        Sampling interval, s.
    hold : {"zero", "linear"}
        Inputs between samples.
    substeps : int
        Runge-Kutta steps a sample; see `substeps.choose_substeps`.
    """
    simulator = on_grid(simulator, dt / substeps)
    own = ParameterSet(dict(simulator.parameters))
    vector = ca.SX.sym("p", own.size)
    equations = Equations(simulator, vector)
    n_x, n_u = len(simulator.states) + sum(equations.n_q), len(simulator.inputs)
    x, s = ca.SX.sym("x", n_x), ca.SX.sym("s", sum(equations.n_s))
    u0, u1, t = ca.SX.sym("u", n_u), ca.SX.sym("next", n_u), ca.SX.sym("t")
    h = dt / substeps
    end, slope = (u1, (u1 - u0) / h) if hold == "linear" else (u0, ca.SX.zeros(n_u))
    middle = (u0 + end) / 2

    sizes = (("x", n_x), ("s", s.numel()), ("u", n_u), ("t", 1))
    now = {name: ca.SX.sym(name, n) for name, n in sizes}
    f, y, after, local = equations.evaluate(Instant(**now, slope=slope))
    z = ca.vertcat(ca.SX(0, 1), *(ca.repmat(local[i][0], n) for i, n in enumerate(equations.n_s) if n))
    at = ca.Function("at", [*now.values(), u0, u1, vector], [f, y, after, z])  # written out once, called at every stage

    def k(state: Any, u: Any, c: float) -> Any:
        return at(state, seen + c * later, u, t + c * h, u0, u1, vector)[0]

    _, _, begun, z = at(x, s, u0, t, u0, u1, vector)
    # a shift register takes in the signal at the step's begin, where it is measured; others have moved on with it when
    # the step begins
    moved = ca.SX.sym("moved", s.numel())
    shifts = np.repeat([getattr(e.law, "shifts", False) for e in simulator.elements], equations.n_s)
    seen = ca.vertcat(ca.SX(0, 1), *(s[i] if shift else moved[i] for i, shift in enumerate(shifts)))
    # within the step what a register holds stays where inputs are held, and moves on with inputs that do
    later = (moved - seen) * (hold == "linear")
    k1, y, _, _ = at(x, seen, u0, t, u0, u1, vector)
    n_own = len(simulator.states)
    stages: tuple[Any, ...] | None = None
    if simulator.discrete:  # laws' own states move with z held over the sample
        x_next = ca.vertcat(k1[:n_own], x[n_own:] + h * k1[n_own:])
    else:
        c2 = x + h / 2 * k1
        k2 = k(c2, middle, 0.5)
        c3 = x + h / 2 * k2
        k3 = k(c3, middle, 0.5)
        c4 = x + h * k3
        x_next = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k(c4, end, 1.0))
        if n_x:  # the same by way of the three states at which the stages are evaluated
            c = ca.SX.sym("c", 3 * n_x)
            s2, s3, s4 = ca.vertsplit(c, n_x)
            by_c = ca.vertcat(c2, x + h / 2 * k(s2, middle, 0.5), x + h * k(s3, middle, 0.5))
            stages = c, ca.vertcat(c2, c3, c4), by_c, (s2 + 2 * s3 + s4 - x) / 3 + h / 6 * k(s4, end, 1.0)
    reads, columns = ["u"], [u0]
    if hold == "linear":
        reads, columns = [*reads, "next"], [*columns, u1]
    if ca.depends_on(ca.vertcat(x_next, y, begun), t):
        reads, columns = [*reads, "t"], [*columns, t]
    x_next, y = ca.cse([x_next, y])
    state, following, port = (x, s), (x_next, begun), None
    if s.numel() and not any(shifts) and not ca.depends_on(z, s):
        # memory that is moved by a port of its own makes the derivatives sparse
        channels = ca.SX.sym("z", s.numel())
        port = z, channels, moved
        following = x_next, equations.memory(channels, s)
    else:
        x_next, y, *staged = ca.substitute([x_next, y, *(stages or ())[1:]], [moved], [begun])
        empty = ca.SX(0, 1)
        state, following = (ca.vertcat(x, s), empty), (ca.vertcat(x_next, begun), empty)
        if stages is not None:
            stages = stages[0], staged[0], staged[1], ca.vertcat(staged[2], begun)
    (x, s), (x_next, s_next) = state, following
    return from_expressions(
        StepExpressions(x, s, ca.vertcat(*columns), vector, x_next, s_next, y, port, stages),
        own,
        states=simulator.states,
        inputs=simulator.inputs,
        outputs=simulator.output_names,
        reads=tuple(reads),
        substeps=substeps,
    )


def states_along(model: Model, drive: np.ndarray, p: np.ndarray, x: np.ndarray) -> np.ndarray:
    """States at the start of each step of a run from x, shape (K, n_x); p (n_p,), or (K, n_p) where it changes."""
    rows = p if p.ndim == 2 else np.broadcast_to(p, (len(drive), len(p)))
    with np.errstate(all="ignore"):
        found = accumulate_steps(model.closed, x, drive, rows)[0]
    return np.vstack([x[None], found[:-1]])


def signals(simulator: Simulator) -> ca.Function:
    """`(x, u, slope, t, p) -> (z, dz, lift, push)` of every port of `all_ports`, in its order, laws left out.

    x (n_x,), u (n_u,), slope = du/dt (n_u,), t and p as in `discretise`; each result has one row a port. A unit force
    in the port moves z at once at the rate `lift`, and dz at the rate `push`: where `lift` is zero and `push` negative,
    a positive force opposes the port's motion.
    """
    own = ParameterSet(dict(simulator.parameters))
    vector = ca.SX.sym("p", own.size)
    p = Named("parameter", own.symbols(vector))
    n_x, n_u = len(simulator.states), len(simulator.inputs)
    xs, us, slope, t = ca.SX.sym("x", n_x), ca.SX.sym("u", n_u), ca.SX.sym("slope", n_u), ca.SX.sym("t")
    x = Named("state", {name: xs[i] for i, name in enumerate(simulator.states)})
    u = Named("input", {name: us[i] for i, name in enumerate(simulator.inputs)})
    f = simulator.derivatives(x, u, p, t) if not simulator.discrete else ca.SX.zeros(n_x)
    y = simulator.measured(x, u, p, t)
    rows: list[list[Any]] = []
    for port in simulator.all_ports():
        here = y[port.name.removeprefix("sensor:")] if port.name.startswith("sensor:") else None
        z = simulator.across(port, x, u, p, t) if here is None else here
        if port.rate is not None:
            dz = ca.SX(call(port.rate, f"rate of port {port.name!r}", x=x, u=u, p=p, t=t))
        else:
            dz = ca.jtimes(z, ca.vertcat(xs, us), ca.vertcat(f, slope))
        force = ca.SX.zeros(n_x)
        if not port.series:
            for name, factor in simulator.into(port, x, u, p, t).items():
                if name in simulator.states:
                    force[simulator.states.index(name)] = factor
        rows.append([z, dz, ca.jtimes(z, xs, force), ca.jtimes(dz, xs, force)])
    names = ["x", "u", "slope", "t", "p"]
    columns = [ca.vertcat(*column) for column in zip(*rows, strict=True)]
    return ca.Function("signals", [xs, us, slope, t, vector], columns, names, ["z", "dz", "lift", "push"])
