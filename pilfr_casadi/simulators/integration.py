"""A simulator as a discrete-time `Model`: classical Runge-Kutta of fourth order with a fixed sub-step.

Within a sub-step of length h the inputs are constant or linear in time, and

    k₁ = f(x, u₀), k₂ = f(x + h k₁/2, u_½), k₃ = f(x + h k₂/2, u_½), k₄ = f(x + h k₃, u₁),
    x⁺ = x + h (k₁ + 2 k₂ + 2 k₃ + k₄) / 6.

Laws are evaluated inside every stage. A law with memory (`step(z, s, p)`, such as a play) updates its memory once, by
the signal at the beginning of the sub-step, and starts from it in every stage (a second update by the same signal must
change nothing). A law with differential equations of its own (`flow`) adds states. The model's state is
[x; laws' states; laws' memory].
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import casadi as ca
import numpy as np

from .._base import InputError, one_at_a_time
from ..data import COURSES, SAME_STEP
from ..models import Model, inject_outputs, model_functions
from .equations import Equations, Named, stack
from .ports import ACTUATOR, PARAMETER, SENSOR, Expression, Placed, Port, split_port
from .user_arguments import call

BAND_LIMITED_STEPS = 8  # per sample at least; lines between them miss a third of the sampling rate by half a per cent

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
    """The equations of a simulator closed with its laws, on symbols; `vector` holds the parameters."""

    def __init__(self, simulator: Equations, vector: Any) -> None:
        self.simulator = simulator
        self.values = simulator.parameter_set.symbols(vector)
        laws = [e.law for e in simulator.elements]
        self.n_q = [int(getattr(law, "order", 0)) for law in laws]
        self.n_s = [int(law.memory) if hasattr(law, "step") else 0 for law in laws]
        self.vector = vector
        self.local = signals(simulator)
        self.rows = {port.name: i for i, port in enumerate(simulator.all_ports())}

    def evaluate(self, v: Instant) -> tuple[Any, Any, Any, dict[int, tuple[Any, Any, Any]]]:
        """Evaluate the derivatives of [x; q], outputs, next memory, and each element's (z, dz, w)."""
        simulator, t = self.simulator, v.t
        laws = _LawsAtInstant(self, v)
        x, u = laws.x, laws.u
        placed = [(i, e, *split_port(e.port)) for i, e in enumerate(simulator.elements)]
        for i, _, kind, name in placed:
            if kind == ACTUATOR:
                u[name] = u[name] + laws.apply(i, u[name], v.slope[simulator.inputs.index(name)])
        inputs, vector = Named("input", u), self._vary_parameters(laws)
        p = Named("parameter", simulator.parameter_set.symbols(vector))
        f = without_laws = simulator.derivatives(x, inputs, p, t)
        # states as most outputs read them, and as single outputs do
        read, output_forces = {"": dict(x._values)}, list[tuple[str, Any]]()
        rates = self.local(stack(x), stack(inputs), v.slope, t, vector)[1]
        for i, e, kind, _ in placed:
            if kind in (ACTUATOR, SENSOR, PARAMETER):
                continue
            port = simulator.port(e.port)
            z = simulator.across(port, x, inputs, p, t)
            term = functools.partial(simulator.term, port, x=x, u=inputs, p=p) if port.term else None
            w = laws.apply(i, z, rates[self.rows[e.port]], simulator.port_signals(port, x, inputs, p, t), term)
            factors = simulator.into(port, x, inputs, p, t)
            f = f + simulator.state_factors(factors) * w
            output_forces += [(name, factor * w) for name, factor in factors.items() if name not in simulator.states]
            if getattr(e.law, "sensed", False):
                motion = e.law.far_side(laws.q[i], self.law_values(e))
                far_side = dict(zip(simulator.shown_states(port) or (), motion, strict=False))
                for name in (e.law.seen_by,) if e.law.seen_by else (*read,):
                    read[name] = read.get(name, read[""]) | far_side
        y = simulator.measured(Named("state", read.pop("")), inputs, p, t, without_laws)
        for name, states in read.items():
            y[name] = simulator.measured(Named("state", states), inputs, p, t, without_laws)[name]
        for name, force in output_forces:
            y[name] = y[name] + force
        for i, e, kind, name in placed:
            if kind == SENSOR:
                y[name] = y[name] + laws.apply(i, y[name], rates[self.rows[e.port]])
        none = ca.SX(0, 1)
        return ca.vertcat(f, *laws.flow), ca.vertcat(*y.values()), ca.vertcat(none, *laws.memory), laws.signals

    def _vary_parameters(self, laws: _LawsAtInstant) -> Any:
        """Evaluate the vector of parameters with the laws that vary them, clipped to the bounds."""
        own, vector = self.simulator.parameter_set, self.vector
        for i, e in enumerate(self.simulator.elements):
            kind, name = split_port(e.port)
            if kind == PARAMETER:
                at, varied = own.position(name), ca.SX(vector)
                signal = getattr(e.law, "signal", "")
                z = {**laws.u, **laws.x._values}[signal] if signal else vector[at]
                lower, upper = own.lower[at].item(), own.upper[at].item()
                value = e.law.varied(vector[at], laws.apply(i, z, 0.0, laws.x._values), lower)
                varied[at] = ca.fmin(ca.fmax(value, lower), upper)
                vector = varied
        return vector

    def law_values(self, element: Placed) -> Named:
        """Parameters of a law by its own names."""
        n = len(element.prefix)
        return Named("parameter", {k[n:]: v for k, v in self.values.items() if k.startswith(element.prefix)})

    def memory(self, z: Any, s: Any) -> Any:
        """Evaluate the next memory of all laws from the local signal of each of its entries."""
        at, out = 0, [ca.SX(0, 1)]
        for element, part, n in zip(self.simulator.elements, _split(s, self.n_s), self.n_s, strict=True):
            out += [element.law.step(z[at], part, self.law_values(element))[1]] if n else []
            at += n
        return ca.vertcat(*out)


class _LawsAtInstant:
    """The laws of closed equations at one instant; applied in turn, each adds to inputs, flow, memory and signals."""

    def __init__(self, equations: ClosedEquations, v: Instant) -> None:
        simulator = equations.simulator
        self.equations, self.t = equations, v.t
        x, *self.q = _split(v.x, [len(simulator.states), *equations.n_q])
        self.s = _split(v.s, equations.n_s)
        self.x = Named("state", simulator.by_state(x))
        self.u = {name: v.u[i] for i, name in enumerate(simulator.inputs)}
        self.flow: list[Any] = [ca.SX(n, 1) for n in equations.n_q]
        self.memory: list[Any] = [ca.SX(n, 1) for n in equations.n_s]
        self.signals: dict[int, tuple[Any, Any, Any]] = {}

    def apply(
        self, i: int, z: Any, dz: Any, port_signals: Mapping[str, Any] | None = None, term: Expression | None = None
    ) -> Any:
        """Evaluate the force or the signal w of a law at the local coordinate z and its rate dz."""
        e = self.equations.simulator.elements[i]
        p, u = self.equations.law_values(e), Named("input", {**self.u, **(port_signals or {}), "t": self.t})
        have = {"z": z, "dz": dz, "q": self.q[i], "p": p, "t": self.t, "x": self.x, "u": u, "term": term}
        have["given"] = None if term is None else term(z, dz)
        if hasattr(e.law, "step"):
            read = {k: have[k] for k in ("dz", "u") if k in inspect.signature(e.law.step).parameters}
            w, self.memory[i] = e.law.step(z, self.s[i], p, **read)
        else:
            w = call(e.law.force, f"law {e.law.id!r}", **have)
            if self.equations.n_q[i]:
                self.flow[i] = call(e.law.flow, f"law {e.law.id!r}", **have)
        if by := getattr(e.law, "scaled_by", ""):
            w = w * u[by]
        self.signals[i] = (z, dz, w)
        return w


def _split(vector: Any, sizes: Sequence[int]) -> list[Any]:
    return list(ca.vertsplit(vector, np.cumsum([0, *sizes]).tolist()))


def on_grid(simulator: E, h: float) -> E:
    """Copy with the laws adapted to steps of length h, s."""
    placed = (replace(e, law=e.law.on_grid(h)) if hasattr(e.law, "on_grid") else e for e in simulator.elements)
    return simulator.with_elements(tuple(placed))


def discretise(simulator: Equations, dt: float, hold: str = "zero", substeps: int = 1) -> Model:
    """Discretise a simulator with its laws to a closed model for samples dt apart, s.

    `hold` says whether inputs are constant between samples ("zero"), interpolated ("linear"), band-limited, or at the
    value of the later sample ("next"), which acts on the derivatives and not yet on the outputs of the earlier one. A
    simulator in discrete time reads its inputs at the samples, so that "next" is "zero" there.

    `substeps` is the number of Runge-Kutta steps per sample (`choose_substeps`), at least eight for band-limited
    inputs, which are linear within a step.
    """
    own = getattr(simulator.dynamics, "dt", None)  # of a program that steps by itself
    if own is not None and abs(own / dt - 1) > SAME_STEP:
        raise InputError(f"The simulator has steps of {own:g} s, the recordings of {dt:g} s; give both the same step.")
    hold = "zero" if hold == "next" and simulator.discrete else hold
    if hold == "band-limited" and not simulator.discrete:
        substeps = max(substeps, BAND_LIMITED_STEPS)
    simulator = on_grid(simulator, dt / substeps)
    step = _SubStep(simulator, dt / substeps, hold)
    x, s, u0, u1, t, updated = step.x, step.s, step.u0, step.u1, step.t, step.updated
    x_next, y, stages = step.advance()
    update, z = step.update, step.z
    reads, columns = ["u"], [u0]
    if COURSES[hold].end:
        reads, columns = [*reads, "next"], [*columns, u1]
    if ca.depends_on(ca.vertcat(x_next, y, update), t):
        reads, columns = [*reads, "t"], [*columns, t]
    x_next, y = ca.cse([x_next, y])
    if s.numel() and not step.shifts.any() and not ca.depends_on(ca.vertcat(z, y), s):
        # a port of its own for the memory makes the derivatives sparse
        channels = ca.SX.sym("z", s.numel())
        w = s_next = step.equations.memory(channels, s)
    else:
        x_next, y, *staged = ca.substitute([x_next, y, *(stages or ())[1:]], [updated], [update])
        x, x_next = ca.vertcat(x, s), ca.vertcat(x_next, update)
        s = s_next = z = channels = updated = w = ca.SX(0, 1)
        if stages is not None:
            stages = stages[0], staged[0], staged[1], ca.vertcat(staged[2], update)
    u, p = ca.vertcat(*columns), step.vector
    model = Model(
        **model_functions(x, u, updated, p, [x_next, y], z, [channels, s, w, s_next]),
        parameters=simulator.parameter_set,
        element=None,
        states=simulator.states,
        inputs=simulator.inputs,
        outputs=simulator.output_names,
        reads=tuple(reads),
        substeps=substeps,
        stages=ca.Function("stages", [x, u, updated, p, stages[0]], stages[1:]) if stages else None,
        resting=step.resting(),
        begin_alike=step.alike_at_first(substeps),
        hold=hold,
    )
    return (
        model if simulator.observer is None else inject_outputs(model, simulator.observer, scales=step.sensor_scales())
    )


class _SubStep:
    """The symbols of one sub-step of length h, and the closed equations as a function that every stage calls."""

    def __init__(self, simulator: Equations, h: float, hold: str) -> None:
        own = simulator.parameter_set
        self.simulator, self.h = simulator, h
        self.vector = ca.SX.sym("p", own.size)
        self.equations = equations = ClosedEquations(simulator, self.vector)
        n_x, n_u = len(simulator.states) + sum(equations.n_q), len(simulator.inputs)
        self.x, self.s = ca.SX.sym("x", n_x), ca.SX.sym("s", sum(equations.n_s))
        self.u0, self.u1, self.t = ca.SX.sym("u", n_u), ca.SX.sym("next", n_u), ca.SX.sym("t")
        course, samples = COURSES[hold], (self.u0, self.u1)
        self.begin, self.end = samples[course.begin], samples[course.end]
        slope = (self.end - self.begin) / h
        sizes = (("x", n_x), ("s", self.s.numel()), ("u", n_u), ("t", 1))
        now = {name: ca.SX.sym(name, n) for name, n in sizes}
        f, y, after, local = equations.evaluate(Instant(**now, slope=slope))
        z = ca.vertcat(ca.SX(0, 1), *(ca.repmat(local[i][0], n) for i, n in enumerate(equations.n_s) if n))
        signals = ca.vertcat(ca.SX(0, 1), *(local[i][0] for i in range(len(local))))
        self.function = ca.Function("closed", [*now.values(), self.u0, self.u1, self.vector], [f, y, after, z, signals])
        _, _, self.update, self.z, _ = self._evaluate(self.x, self.s, self.begin, self.t)
        # the stages read a shift register as it was at the beginning of the step, and all other memory after its update
        self.updated = ca.SX.sym("updated", self.s.numel())
        self.shifts = np.repeat([getattr(e.law, "shifts", False) for e in simulator.elements], equations.n_s)
        self.memory = self._read(self.updated)
        # a register's content moves on within the step if inputs are interpolated
        self.drift = (self.updated - self.memory) * (not course.constant)

    def _read(self, updated: Any) -> Any:
        """Return the memory that the equations read, from the updated one."""
        read = (self.s[i] if shift else updated[i] for i, shift in enumerate(self.shifts))
        return ca.vertcat(ca.SX(0, 1), *read)

    def _evaluate(self, x: Any, s: Any, u: Any, t: Any) -> Any:
        return self.function(x, s, u, t, self.u0, self.u1, self.vector)

    def _evaluate_stage(self, x: Any, u: Any, share: float) -> Any:
        """Evaluate the derivatives at a share of the step."""
        return self._evaluate(x, self.memory + share * self.drift, u, self.t + share * self.h)[0]

    def advance(self) -> tuple[Any, Any, tuple[Any, ...] | None]:
        """Make the next states, the outputs, and the stages of `Model`, from the updated memory."""
        x, h, own = self.x, self.h, len(self.simulator.states)
        k1, y, *_ = self._evaluate(x, self.memory, self.u0, self.t)
        if self.begin is not self.u0:
            if ca.depends_on(self.update, self.u1):  # outputs read the memory of laws before the next inputs
                own = self._evaluate(x, self.s, self.u0, self.t)[2]
                y = self._evaluate(x, self._read(own), self.u0, self.t)[1]
            k1 = self._evaluate_stage(x, self.begin, 0.0)
        if self.simulator.discrete:  # laws' own states see a constant z over the sample
            return ca.vertcat(k1[:own], x[own:, 0] + h * k1[own:, 0]), y, None
        middle, end = (self.begin + self.end) / 2, self.end
        c2 = x + h / 2 * k1
        k2 = self._evaluate_stage(c2, middle, 0.5)
        c3 = x + h / 2 * k2
        k3 = self._evaluate_stage(c3, middle, 0.5)
        c4 = x + h * k3
        x_next = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + self._evaluate_stage(c4, end, 1.0))
        if not x.numel():
            return x_next, y, None
        # the same step, written with the three states at which the stages are evaluated
        c = ca.SX.sym("c", 3 * x.numel())
        s2, s3, s4 = ca.vertsplit(c, x.numel())
        by_c = ca.vertcat(
            c2, x + h / 2 * self._evaluate_stage(s2, middle, 0.5), x + h * self._evaluate_stage(s3, middle, 0.5)
        )
        by_stages = (s2 + 2 * s3 + s4 - x) / 3 + h / 6 * self._evaluate_stage(s4, end, 1.0)
        return x_next, y, (c, ca.vertcat(c2, c3, c4), by_c, by_stages)

    def sensor_scales(self) -> ca.Function | None:
        """Make `p -> scales` (n_y,), by which laws multiply outputs that they only scale; None without such a law."""
        laws = _LawsAtInstant(self.equations, Instant(self.x, self.s, self.u0, ca.SX.zeros(self.u0.shape), self.t))
        names, scales = self.simulator.output_names, ca.SX.ones(len(self.simulator.output_names))
        z, dz = ca.SX.sym("z"), ca.SX.sym("dz")
        for i, e in enumerate(self.simulator.elements):
            kind, name = split_port(e.port)
            if kind != SENSOR or self.equations.n_q[i] or self.equations.n_s[i]:
                continue
            scale = 1 + ca.jacobian(laws.apply(i, z, dz), z)
            if not ca.depends_on(scale, ca.vertcat(z, dz, self.x, self.s, self.u0, self.t)):
                scales[names.index(name)] *= scale
        return None if scales.is_constant() else ca.Function("scales", [self.vector], [ca.densify(scales)])

    def alike_at_first(self, substeps: int) -> tuple[int, ...]:
        """Number the unknowns of `Model.begin_alike`: entries of a shift register within one sample begin alike.

        So does a held input; an interpolated one does about.
        """
        numbers = list(range(self.x.numel()))
        for element, n in zip(self.simulator.elements, self.equations.n_s, strict=True):
            first = max(numbers, default=-1) + 1
            every = substeps if getattr(element.law, "shifts", False) else 1
            numbers += [first + i // every for i in range(n)]
        return tuple(numbers)

    def resting(self) -> ca.Function | None:
        """Make `(x, u, p) -> [x; laws' states; memory]` with all laws at rest, as if their signals had been constant.

        From zero, a delay or a lag of a signal about a working point would start with a transient that no recording
        shows and that biases a fit of the law's parameters.
        """
        counts = [n_q or n_s for n_q, n_s in zip(self.equations.n_q, self.equations.n_s, strict=True)]
        laws = [e.law for e in self.simulator.elements]
        shares = [  # 1 for states or memory that settle at the value of the law's signal
            np.asarray(law.standing(1.0)) if n and hasattr(law, "standing") else np.zeros(n)
            for law, n in zip(laws, counts, strict=True)
        ]
        if not any(np.any(share) for share in shares):
            return None
        sizes = (("x", len(self.simulator.states)), ("u", self.u0.numel()), ("p", self.vector.numel()))
        x, u, p = (ca.MX.sym(name, n) for name, n in sizes)
        z = ca.MX.zeros(len(shares))
        for _ in (*shares, None):  # one law's signal may be the output of another
            own = [share * z[i] for i, share in enumerate(shares)]
            state = ca.vertcat(x, *(part for part, n in zip(own, self.equations.n_q, strict=True) if n))
            memory = ca.vertcat(ca.MX(0, 1), *(part for part, n in zip(own, self.equations.n_s, strict=True) if n))
            z = self.function(state, memory, u, 0, u, u, p)[4]
        return ca.Function("resting", [x, u, p], [ca.densify(ca.vertcat(state, memory))])


def signals(simulator: Equations) -> ca.Function:
    """Make `(x, u, slope, t, p) -> (z, dz, lift, push, own)` of every port of `all_ports`, in its order, without laws.

    x (n_x,), u (n_u,), slope = du/dt (n_u,), t and p as in `discretise`; each result but the last has one row for each
    port. A unit force in the port changes z at the rate `lift`, and dz at the rate `push`: if `lift` is zero and `push`
    is negative, a positive force opposes the port's motion. `own` stacks the ports' own signals.
    """
    x, u, p, t = simulator.symbols()
    states, inputs, slope = stack(x), stack(u), ca.SX.sym("slope", len(simulator.inputs))
    f = simulator.derivatives(x, u, p, t) if not simulator.discrete else ca.SX.zeros(states.shape)
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
            dz = ca.jtimes(z, ca.vertcat(states, inputs), ca.vertcat(f, slope))
        force = simulator.state_factors({} if port.series else simulator.into(port, x, u, p, t))
        rows.append([z, dz, ca.jtimes(z, states, force), ca.jtimes(dz, states, force)])
    names = ["x", "u", "slope", "t", "p"]
    columns = [*(ca.vertcat(*column) for column in zip(*rows, strict=True)), ca.vertcat(*own_signals)]
    return ca.Function(
        "signals", [states, inputs, slope, t, stack(p)], columns, names, ["z", "dz", "lift", "push", "own"]
    )


@one_at_a_time
@functools.lru_cache(maxsize=64)
def term_function(simulator: Equations, port: Port) -> ca.Function:
    """Make `(z, dz, x, u, p) -> F` of a port's term, without laws."""
    x, u, p, _ = simulator.symbols()
    z, dz = ca.SX.sym("z"), ca.SX.sym("dz")
    force = simulator.term(port, z, dz, x, u, p)
    return ca.Function("term", [z, dz, stack(x), stack(u), stack(p)], [ca.densify(force)])
