"""A simulator as a discrete-time `Model`: classical Runge-Kutta of fourth order with a fixed sub-step.

Within a sub-step of length h the inputs are held or follow their chord, and

    k₁ = f(x, u₀), k₂ = f(x + h k₁/2, u_½), k₃ = f(x + h k₂/2, u_½), k₄ = f(x + h k₃, u₁),
    x⁺ = x + h (k₁ + 2 k₂ + 2 k₃ + k₄) / 6.

Laws are evaluated inside every stage. A law with memory (`step(z, s, p)`, such as a play) starts from its memory at the
beginning of the sub-step, moved on once by the signal there (moving it again by the same signal must change nothing). A
law with differential equations of its own (`flow`) adds states. The model's state is [x; laws' states; laws' memory].

The number of sub-steps keeps |λ| h below `LARGEST_STEP` for every eigenvalue λ of ∂f/∂x where a recording begins; where
these are very fast, along a run from there.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, TypeVar

import casadi as ca
import numpy as np

from .._base import InputError, one_at_a_time
from ..data import SAME_STEP, Recording
from ..models import Model, accumulate_steps, inject_outputs, map_points, model_functions
from .equations import Equations, Named, call
from .ports import ACTUATOR, PARAMETER, SENSOR, Placed, Port, split_port

LARGEST_STEP = 0.25  # largest |λ| h: a phase error of (λh)⁴/120 = 3e-5 of the angle of a cycle
MOST_SUBSTEPS = 200  # per sample
VERY_FAST = 8 * LARGEST_STEP  # |λ| times the sampling interval above which a run is looked at
INFINITE = 1e12  # rate that stands for an infinite one, rad/s
ENDLESS = 1e100  # size of a state above which it has diverged
FINE = 20  # sub-steps per sample of the run that looks for the rates
# its samples at most, those left out first, and the spacing of those looked at
BEGINNING, SETTLING, EVERY = 400, 40, 20
HIGH, FEWEST = 0.9, 5  # quantile of the rates along it that counts, and the rates that are too few to tell
SHOWN = 8  # values named in a message

E = TypeVar("E", bound=Equations)


@dataclass(frozen=True, eq=False)
class Instant:
    """The signals at one instant inside a sub-step."""

    x: Any  # simulator's states and laws' states
    s: Any  # laws' memory
    u: Any
    slope: Any  # du/dt
    t: Any


class ClosedEquations:
    """The equations of a simulator closed with its laws, on symbols."""

    def __init__(self, simulator: Equations, vector: Any) -> None:
        self.simulator = simulator
        self.values = simulator.parameter_set.symbols(vector)
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
        """Evaluate the derivatives of [x; q], outputs, next memory, and each element's (z, dz, w)."""
        simulator, p, t = self.simulator, self.p, v.t
        q, s, x_only = self._parts(v.x, v.s)
        x = Named("state", dict(zip(simulator.states, ca.vertsplit(x_only) if simulator.states else [], strict=True)))
        u = {name: v.u[i] for i, name in enumerate(simulator.inputs)}
        signals: dict[int, tuple[Any, Any, Any]] = {}
        flow: list[Any] = [ca.SX(n, 1) for n in self.n_q]
        memory: list[Any] = [ca.SX(n, 1) for n in self.n_s]

        def apply(
            i: int, z: Any, dz: Any, beside: Mapping[str, Any] | None = None, term: Callable[..., Any] | None = None
        ) -> Any:
            e, now = simulator.elements[i], Named("input", {"t": t, **u, **(beside or {})})
            have = {"z": z, "dz": dz, "q": q[i], "p": self._own(e), "t": t, "x": x, "u": now, "term": term}
            if hasattr(e.law, "step"):
                read = {k: have[k] for k in ("dz", "u") if k in inspect.signature(e.law.step).parameters}
                w, memory[i] = e.law.step(z, s[i], self._own(e), **read)
            else:
                w = call(e.law.force, f"law {e.law.id!r}", **have)
                if self.n_q[i]:
                    flow[i] = call(e.law.flow, f"law {e.law.id!r}", **have)
            if by := getattr(e.law, "scaled_by", ""):
                w = w * now[by]
            signals[i] = (z, dz, w)
            return w

        placed = [(i, e, *split_port(e.port)) for i, e in enumerate(simulator.elements)]
        for i, _, kind, name in placed:
            if kind == ACTUATOR:
                u[name] = u[name] + apply(i, u[name], v.slope[simulator.inputs.index(name)])
        inputs = Named("input", u)
        vector = self.vector
        for i, e, kind, name in placed:
            if kind == PARAMETER:
                own = simulator.parameter_set.position(name)
                low, high = (
                    ends[own].item() for ends in (simulator.parameter_set.lower, simulator.parameter_set.upper)
                )
                varied = ca.SX(vector)
                z = {**u, **x._values}[e.law.signal] if getattr(e.law, "signal", "") else vector[own]
                varied[own] = ca.fmin(ca.fmax(vector[own] + apply(i, z, 0.0, x._values), low), high)
                vector = varied
        if vector is not self.vector:
            p = Named("parameter", simulator.parameter_set.symbols(vector))
        f = bare = simulator.derivatives(x, inputs, p, t)
        seen, more = dict(x._values), list[tuple[str, Any]]()
        rates = self.local(x_only, ca.vertcat(*u.values()), v.slope, t, vector)[1]
        for i, e, kind, _ in placed:
            if kind in (ACTUATOR, SENSOR, PARAMETER):
                continue
            port = simulator.port(e.port)
            z = simulator.across(port, x, inputs, p, t)
            term = functools.partial(simulator.term, port, x=x, u=inputs, p=p) if port.term else None
            w = apply(i, z, rates[self.rows[e.port]], simulator.port_signals(port, x, inputs, p, t), term)
            for name, factor in simulator.into(port, x, inputs, p, t).items():
                if name in simulator.states:
                    unit = ca.SX.zeros(f.shape)
                    unit[simulator.states.index(name)] = factor
                    f = f + unit * w
                else:
                    more.append((name, factor * w))
            if getattr(e.law, "sensed", False):
                shown = simulator.shown_states(port) or ()
                seen |= zip(shown, e.law.far_side(q[i], self._own(e)), strict=False)
        y = simulator.measured(Named("state", seen), inputs, p, t, bare)
        for name, part in more:
            y[name] = y[name] + part
        for i, e, kind, name in placed:
            if kind == SENSOR:
                y[name] = y[name] + apply(i, y[name], rates[self.rows[e.port]])
        return ca.vertcat(f, *flow), ca.vertcat(*y.values()), ca.vertcat(ca.SX(0, 1), *memory), signals

    def memory(self, z: Any, s: Any) -> Any:
        """Evaluate the next memory of all laws from the local signal of each of its entries."""
        _, parts, _ = self._parts(ca.SX(len(self.simulator.states) + sum(self.n_q), 1), s)
        at, out = 0, [ca.SX(0, 1)]
        for element, part, n in zip(self.simulator.elements, parts, self.n_s, strict=True):
            out += [element.law.step(z[at], part, self._own(element))[1]] if n else []
            at += n
        return ca.vertcat(*out)


def on_grid(simulator: E, h: float) -> E:
    """Copy with the laws made for steps of length h, s."""
    placed = (replace(e, law=e.law.on_grid(h)) if hasattr(e.law, "on_grid") else e for e in simulator.elements)
    return simulator.with_elements(tuple(placed))


def discretise(simulator: Equations, dt: float, hold: str = "zero", substeps: int = 1) -> Model:
    """Make the simulator with its laws a closed discrete-time model for samples dt apart, s.

    `hold` says whether inputs are held between samples ("zero") or interpolated ("linear"); `substeps` counts the
    Runge-Kutta steps per sample (`choose_substeps`).
    """
    own = getattr(simulator.dynamics, "dt", None)  # of a program that steps by itself
    if own is not None and abs(own / dt - 1) > SAME_STEP:
        raise InputError(f"The simulator goes in steps of {own:g} s, the recordings in {dt:g} s; give both one step.")
    simulator = on_grid(simulator, dt / substeps)
    step = _SubStep(simulator, dt / substeps, hold)
    x, s, u0, u1, t, moved = step.x, step.s, step.u0, step.u1, step.t, step.moved
    x_next, y, stages = step.advance()
    begun, z = step.begun, step.z
    reads, columns = ["u"], [u0]
    if hold == "linear":
        reads, columns = [*reads, "next"], [*columns, u1]
    if ca.depends_on(ca.vertcat(x_next, y, begun), t):
        reads, columns = [*reads, "t"], [*columns, t]
    x_next, y = ca.cse([x_next, y])
    if s.numel() and not step.shifts.any() and not ca.depends_on(z, s):
        # memory that is moved by a port of its own makes the derivatives sparse
        channels = ca.SX.sym("z", s.numel())
        w = s_next = step.equations.memory(channels, s)
    else:
        x_next, y, *staged = ca.substitute([x_next, y, *(stages or ())[1:]], [moved], [begun])
        x, x_next = ca.vertcat(x, s), ca.vertcat(x_next, begun)
        s = s_next = z = channels = moved = w = ca.SX(0, 1)
        if stages is not None:
            stages = stages[0], staged[0], staged[1], ca.vertcat(staged[2], begun)
    u, p = ca.vertcat(*columns), step.vector
    model = Model(
        **model_functions(x, u, moved, p, [x_next, y], z, [channels, s, w, s_next]),
        parameters=simulator.parameter_set,
        element=None,
        states=simulator.states,
        inputs=simulator.inputs,
        outputs=simulator.output_names,
        reads=tuple(reads),
        substeps=substeps,
        stages=ca.Function("stages", [x, u, moved, p, stages[0]], stages[1:]) if stages else None,
        resting=step.resting(),
    )
    return model if simulator.observer is None else inject_outputs(model, simulator.observer)


class _SubStep:
    """The symbols of one sub-step of length h, and the closed equations as a function that every stage calls."""

    def __init__(self, simulator: Equations, h: float, hold: str) -> None:
        own = simulator.parameter_set
        self.simulator, self.h, self.hold = simulator, h, hold
        self.vector = ca.SX.sym("p", own.size)
        self.equations = equations = ClosedEquations(simulator, self.vector)
        n_x, n_u = len(simulator.states) + sum(equations.n_q), len(simulator.inputs)
        self.x, self.s = ca.SX.sym("x", n_x), ca.SX.sym("s", sum(equations.n_s))
        self.u0, self.u1, self.t = ca.SX.sym("u", n_u), ca.SX.sym("next", n_u), ca.SX.sym("t")
        self.end, slope = (self.u1, (self.u1 - self.u0) / h) if hold == "linear" else (self.u0, ca.SX.zeros(n_u))
        sizes = (("x", n_x), ("s", self.s.numel()), ("u", n_u), ("t", 1))
        now = {name: ca.SX.sym(name, n) for name, n in sizes}
        f, y, after, local = equations.evaluate(Instant(**now, slope=slope))
        z = ca.vertcat(ca.SX(0, 1), *(ca.repmat(local[i][0], n) for i, n in enumerate(equations.n_s) if n))
        signals = ca.vertcat(ca.SX(0, 1), *(local[i][0] for i in range(len(local))))
        self.at = ca.Function("at", [*now.values(), self.u0, self.u1, self.vector], [f, y, after, z, signals])
        _, _, self.begun, self.z, _ = self._at(self.x, self.s, self.u0, self.t)
        # a shift register takes in the signal at the beginning of the step, where it is measured; other memory has
        # already moved on with it
        self.moved = ca.SX.sym("moved", self.s.numel())
        self.shifts = np.repeat([getattr(e.law, "shifts", False) for e in simulator.elements], equations.n_s)
        read = (self.s[i] if shift else self.moved[i] for i, shift in enumerate(self.shifts))
        self.memory = ca.vertcat(ca.SX(0, 1), *read)
        # within the step the content of a register stays where inputs are held, and moves on with interpolated inputs
        self.drift = (self.moved - self.memory) * (hold == "linear")

    def _at(self, x: Any, s: Any, u: Any, t: Any) -> Any:
        return self.at(x, s, u, t, self.u0, self.u1, self.vector)

    def _slope(self, x: Any, u: Any, share: float) -> Any:
        """Evaluate the derivatives at a share of the step."""
        return self._at(x, self.memory + share * self.drift, u, self.t + share * self.h)[0]

    def advance(self) -> tuple[Any, Any, tuple[Any, ...] | None]:
        """Make the next states, the outputs, and the stages of `Model`, from the moved memory."""
        x, h, own = self.x, self.h, len(self.simulator.states)
        k1, y, *_ = self._at(x, self.memory, self.u0, self.t)
        if self.simulator.discrete:  # the laws' own states move with z held over the sample
            return ca.vertcat(k1[:own], x[own:, 0] + h * k1[own:, 0]), y, None
        middle, end = (self.u0 + self.end) / 2, self.end
        c2 = x + h / 2 * k1
        k2 = self._slope(c2, middle, 0.5)
        c3 = x + h / 2 * k2
        k3 = self._slope(c3, middle, 0.5)
        c4 = x + h * k3
        x_next = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + self._slope(c4, end, 1.0))
        if not x.numel():
            return x_next, y, None
        # the same by way of the three states at which the stages are evaluated
        c = ca.SX.sym("c", 3 * x.numel())
        s2, s3, s4 = ca.vertsplit(c, x.numel())
        by_c = ca.vertcat(c2, x + h / 2 * self._slope(s2, middle, 0.5), x + h * self._slope(s3, middle, 0.5))
        by_stages = (s2 + 2 * s3 + s4 - x) / 3 + h / 6 * self._slope(s4, end, 1.0)
        return x_next, y, (c, ca.vertcat(c2, c3, c4), by_c, by_stages)

    def resting(self) -> ca.Function | None:
        """Make `(x, u, p) -> [x; laws' states; memory]`: all laws at rest, as if their signals had stood still.

        From zero, a delay or a lag of a signal about a working point would first have to come there: a transient that
        no recording shows, and that bends a fit of the law's parameters.
        """
        counts = [n_q or n_s for n_q, n_s in zip(self.equations.n_q, self.equations.n_s, strict=True)]
        laws = [e.law for e in self.simulator.elements]
        shares = [  # one for those states or memories that come to rest at the value at which the law's signal stands
            np.asarray(law.standing(1.0)) if n and hasattr(law, "standing") else np.zeros(n)
            for law, n in zip(laws, counts, strict=True)
        ]
        if not any(np.any(share) for share in shares):
            return None
        sizes = (("x", len(self.simulator.states)), ("u", self.u0.numel()), ("p", self.vector.numel()))
        x, u, p = (ca.MX.sym(name, n) for name, n in sizes)
        z = ca.MX.zeros(len(shares))
        for _ in (*shares, None):  # one law's signal may be what another gives out
            own = [share * z[i] for i, share in enumerate(shares)]
            state = ca.vertcat(x, *(part for part, n in zip(own, self.equations.n_q, strict=True) if n))
            memory = ca.vertcat(ca.MX(0, 1), *(part for part, n in zip(own, self.equations.n_s, strict=True) if n))
            z = self.at(state, memory, u, 0, u, u, p)[4]
        return ca.Function("resting", [x, u, p], [ca.densify(ca.vertcat(state, memory))])


def states_along(model: Model, drive: np.ndarray, p: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Run from x: states at the start of each step, shape (K, n_x); p (n_p,), or (K, n_p) where it changes."""
    rows = p if p.ndim == 2 else np.broadcast_to(p, (len(drive), len(p)))
    with np.errstate(all="ignore"):
        found = accumulate_steps(model.closed, x, drive, rows)[0]
    return np.vstack([x[None], found[:-1]])


def signals(simulator: Equations) -> ca.Function:
    """Make `(x, u, slope, t, p) -> (z, dz, lift, push, own)` of every port of `all_ports`, in its order, without laws.

    x (n_x,), u (n_u,), slope = du/dt (n_u,), t and p as in `discretise`; each result but the last has one row for each
    port. A unit force in the port moves z at once at the rate `lift`, and dz at the rate `push`: where `lift` is zero
    and `push` is negative, a positive force opposes the port's motion. `own` stacks the ports' own signals.
    """
    own = simulator.parameter_set
    vector = ca.SX.sym("p", own.size)
    p = Named("parameter", own.symbols(vector))
    n_x, n_u = len(simulator.states), len(simulator.inputs)
    xs, us, slope, t = ca.SX.sym("x", n_x), ca.SX.sym("u", n_u), ca.SX.sym("slope", n_u), ca.SX.sym("t")
    x = Named("state", {name: xs[i] for i, name in enumerate(simulator.states)})
    u = Named("input", {name: us[i] for i, name in enumerate(simulator.inputs)})
    f = simulator.derivatives(x, u, p, t) if not simulator.discrete else ca.SX.zeros(n_x)
    y = simulator.measured(x, u, p, t)
    rows: list[list[Any]] = []
    own_signals: list[Any] = [ca.SX(0, 1)]
    for port in simulator.all_ports():
        own_signals += simulator.port_signals(port, x, u, p, t).values()
        kind, of = split_port(port.name)
        z = y[of] if kind == SENSOR else simulator.across(port, x, u, p, t)
        if port.rate is not None:
            dz = simulator.rate(port, x, u, p, t)
        else:
            dz = ca.jtimes(z, ca.vertcat(xs, us), ca.vertcat(f, slope))
        force = ca.SX.zeros(n_x)
        if not port.series:
            for name, factor in simulator.into(port, x, u, p, t).items():
                if name in simulator.states:
                    force[simulator.states.index(name)] = factor
        rows.append([z, dz, ca.jtimes(z, xs, force), ca.jtimes(dz, xs, force)])
    names = ["x", "u", "slope", "t", "p"]
    columns = [*(ca.vertcat(*column) for column in zip(*rows, strict=True)), ca.vertcat(*own_signals)]
    return ca.Function("signals", [xs, us, slope, t, vector], columns, names, ["z", "dz", "lift", "push", "own"])


@one_at_a_time
@functools.lru_cache(maxsize=64)
def term_function(simulator: Equations, port: Port) -> ca.Function:
    """Make `(z, dz, x, u, p) -> F` of a port's term, without laws."""
    own = simulator.parameter_set
    x, u, _, _ = simulator.symbols()
    z, dz, vector = ca.SX.sym("z"), ca.SX.sym("dz"), ca.SX.sym("p", own.size)
    force = simulator.term(port, z, dz, x, u, Named("parameter", own.symbols(vector)))
    states, inputs = (ca.vertcat(*names._values.values()) for names in (x, u))
    return ca.Function("term", [z, dz, states, inputs, vector], [ca.densify(force)])


@functools.lru_cache(maxsize=8)  # several rates of one simulator are looked at in turn
def _flow(simulator: Equations) -> ca.Function:
    """Make `(x, u, p) -> (f, ∂f/∂x)` of [x; laws' states], memory at rest."""
    vector = ca.SX.sym("p", simulator.parameter_set.size)
    equations = ClosedEquations(simulator, vector)
    n_x = len(simulator.states) + sum(equations.n_q)
    x, u = ca.SX.sym("x", n_x), ca.SX.sym("u", len(simulator.inputs))
    s = ca.SX.zeros(sum(equations.n_s))
    f = equations.evaluate(Instant(x, s, u, ca.SX.zeros(u.shape), ca.SX(0.0)))[0]
    return ca.Function("flow", [x, u, vector], [ca.densify(f), ca.densify(ca.jacobian(f, x))])


def _eigenvalues(simulator: Equations, x: np.ndarray, u: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Eigenvalues of ∂f/∂x at x (K, n_x) and u (K, n_u), (K, n); nan where ∂f/∂x is not finite."""
    flow = _flow(simulator)
    states = np.stack([_padded(row, flow.size1_in(0)) for row in x])
    slopes = map_points(flow, states, u, p)[1]
    out, finite = np.full(states.shape, np.nan, dtype=complex), np.all(np.isfinite(slopes), axis=(1, 2))
    out[finite] = np.linalg.eigvals(slopes[finite])
    return out


def fastest_rates(simulator: Equations, x: np.ndarray, u: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Compute the largest |eigenvalue| of ∂f/∂x, rad/s, at x (K, n_x) and u (K, n_u), shape (K,); nan if infinite."""
    if not simulator.states or simulator.discrete:
        return np.zeros(len(x))
    return np.asarray(np.max(np.abs(_eigenvalues(simulator, x, u, p)), axis=1))


def growth_rate(simulator: Equations, recording: Recording) -> float:
    """Compute the largest real part of the eigenvalues of ∂f/∂x where a recording begins, 1/s; 0 without a state."""
    if not simulator.states or simulator.discrete:
        return 0.0
    begin, p = _start(simulator, recording), simulator.parameter_set.start
    return float(np.max(np.nan_to_num(_eigenvalues(simulator, begin[None], recording.u[:1], p).real)))


def needed_substeps(simulator: Equations, recordings: Sequence[Recording]) -> tuple[int, float]:
    """Count the sub-steps per sample that keep |λ| h below `LARGEST_STEP`, and give the largest |λ|, rad/s."""
    rate, first = rate_at_start(simulator, recordings[0]), recordings[0]
    if rate * first.dt > VERY_FAST:
        rate = _along_a_run(simulator, first, rate)
    return max(1, int(np.ceil(rate * first.dt / LARGEST_STEP))), rate


def rate_at_start(simulator: Equations, recording: Recording) -> float:
    """Compute the largest |λ|, rad/s, where a recording begins; `INFINITE` where it is infinite."""
    p, start = simulator.parameter_set.start, _start(simulator, recording)
    rate = fastest_rates(simulator, start[None], np.mean(recording.u, axis=0)[None], p)[0]
    return float(np.nan_to_num(rate, nan=INFINITE))


def choose_substeps(simulator: Equations, recordings: Sequence[Recording]) -> int:
    """Choose the sub-steps per sample that keep |λ| h below `LARGEST_STEP` where the first recording begins.

    Where a rate is very fast, the rates along a run decide (a square root is infinitely steep at zero). More than
    `MOST_SUBSTEPS`, or a derivative that is not finite, is refused. Laws in ports may ask for more (`least_substeps`).
    """
    needed, rate = needed_substeps(simulator, recordings)
    if needed <= MOST_SUBSTEPS:
        return max(needed, least_substeps(simulator))
    raise InputError(
        _not_finite(simulator, recordings[0])
        or f"The simulator has an eigenvalue of {rate:.3g} rad/s, too fast for samples {recordings[0].dt:g} s apart; "
        "check its units, or replace the fast state by its steady state."
    )


def discretise_for(simulator: Equations, recordings: Sequence[Recording]) -> Model:
    """Discretise on the recordings' grid, with their hold of the inputs (else the simulator's) and enough sub-steps."""
    holds = {r.hold or simulator.hold or "zero" for r in recordings}
    if len(holds) > 1:
        raise InputError(
            "The recordings differ in `hold`, and a simulator is integrated with one of them; fit them one by one."
        )
    return discretise(simulator, recordings[0].dt, holds.pop(), choose_substeps(simulator, recordings))


def least_substeps(simulator: Equations) -> int:
    """Give the fewest sub-steps per sample that simulator and laws ask for; 1 for an equation in discrete time."""
    if simulator.discrete:
        return 1
    return max([simulator.substeps, *(int(getattr(e.law, "substeps", 1)) for e in simulator.elements)])


def _start(simulator: Equations, recording: Recording) -> np.ndarray:
    """Give the simulator's states where a recording begins: as given, else zero."""
    given = np.asarray(recording.initial, dtype=float) if not isinstance(recording.initial, str) else np.zeros(0)
    n_x = len(simulator.states)
    return given[:n_x] if len(given) >= n_x else np.zeros(n_x)


def _padded(x: np.ndarray, n: int) -> np.ndarray:
    """Give n entries of x, zeros behind its own."""
    return np.append(x[:n], np.zeros(max(n - len(x), 0)))


def _short_run(simulator: Equations, recording: Recording) -> tuple[Recording, np.ndarray]:
    """Give the beginning of a recording, and the states at every sub-step of a run over it, `FINE` per sample."""
    short = recording.slice(0, min(len(recording), BEGINNING))
    model = discretise(simulator, recording.dt, "zero", substeps=FINE)
    first = _padded(_start(simulator, recording), model.n_state)
    return short, states_along(model, model.drive(short), simulator.parameter_set.start, first)


def _along_a_run(simulator: Equations, recording: Recording, rate: float) -> float:
    """Compute a high quantile of the rates along a run; the given rate where the run diverges."""
    short, states = _short_run(simulator, recording)
    x, u = states[::FINE][SETTLING::EVERY], short.u[SETTLING::EVERY]
    found = fastest_rates(simulator, x, u, simulator.parameter_set.start)
    found = found[np.isfinite(found)]
    return min(rate, float(np.quantile(found, HIGH))) if len(found) > FEWEST else rate


def _not_finite(simulator: Equations, recording: Recording) -> str:
    """Say which state's derivative, or its slope, is not finite, and where; empty if all are finite."""
    p, flow, names = simulator.parameter_set.start, _flow(simulator), simulator.states
    n_x = flow.size1_in(0)

    def derivative(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.asarray(flow(x, u, p)[0]).ravel()

    begun = _padded(_start(simulator, recording), n_x)
    points = [(begun, recording.u[0]), (begun, np.mean(recording.u, axis=0))]
    if all(np.all(np.isfinite(derivative(*point))) for point in points):  # the run meets it later
        short, states = _short_run(simulator, recording)
        states = states[:, :n_x]
        last = int(np.argmin(np.append(np.all(np.abs(states) < ENDLESS, axis=1), False))) - 1
        x, u = states[last], short.u[last // FINE]
        points += [(x + share * recording.dt / FINE * derivative(x, u), u) for share in (0.0, 0.5, 1.0)]
    for x, u in points:
        off = ~np.isfinite(derivative(x, u)[: len(names)])
        if np.all(np.abs(x) < ENDLESS) and np.any(off):
            return _where(simulator, f"The derivative of the state {names[int(np.argmax(off))]!r}", x, u)
    slope = ~np.isfinite(np.asarray(flow(*points[0], p)[1])[: len(names), : len(names)])
    if not np.any(slope):
        return ""
    i, j = np.argwhere(slope)[0]
    return _where(simulator, f"The slope of the derivative of {names[i]!r} by the state {names[j]!r}", *points[0])


def _where(simulator: Equations, what: str, x: np.ndarray, u: np.ndarray) -> str:
    values = [*zip(simulator.states, x, strict=False), *zip(simulator.inputs, u, strict=True)]
    values += [(k, 0.0) for k, v in simulator.parameters.items() if v.value.ndim == 0 and float(v.value) == 0]
    shown = ", ".join(f"{name} = {float(value):.4g}" for name, value in values[:SHOWN])
    more = f" and {len(values) - SHOWN} more" if len(values) > SHOWN else ""
    at_rest = (
        "; where the machine is never at zero, write the equations about its working point, or in Python say where a "
        "recording begins, by the argument `initial` of Recording"
    )
    return (
        f"{what} is not finite at {shown}{more}; check what the equations divide by, or take a root or a logarithm of, "
        f"and the parameters' values{'' if np.any(x) else at_rest}."
    )
