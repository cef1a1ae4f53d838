"""Continuous-time equations with ports that missing physics can be put into, as CasADi expressions.

    ẋ = f(x, u, p) + Σ into_j(p) w_j,   y = h(x, u, p) + Σ into_j(p) w_j,
    w_j = law_j(z_j, ż_j),   z_j = across_j(x, u)

The user's functions are called with the symbols that they name: `x.<state>`, `u.<input>`, `p.<parameter>`. At an
actuator or a sensor a law acts in series: it adds `w = law(u) - u` to the signal.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Self, cast

import casadi as ca
import numpy as np

from .._base import InputError, check_known, whole
from ..data import known_hold
from ..models import Named, Parameter, ParameterSet
from .domains import MECHANICAL, UNKNOWN, common_domain, is_motion, may_be_speed
from .external import calls_external
from .ports import (
    ACTUATOR,
    EQUATION,
    PARAMETER,
    SENSOR,
    Expression,
    Placed,
    Port,
    kind_of,
    port_name,
    split_port,
)
from .user_arguments import as_scalar, as_scalars, call, check_expressions, check_names, check_parameters, check_ports

EQUAL_DEPTH = 5  # levels of two expressions that are compared
COMPARED_POINTS = 3  # random points at which expressions are compared


@dataclass(frozen=True, eq=False)
class Equations:
    """Equations with ports and the laws in them; the fields are those of `Simulator`."""

    dynamics: Expression
    outputs: Expression
    states: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    ports: tuple[Port, ...] = ()
    hold: str | None = None
    discrete: bool = False
    elements: tuple[Placed, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    observer: np.ndarray | None = None
    substeps: int = 1

    def __post_init__(self) -> None:
        for kind in ("dynamics", "outputs"):
            if not callable(getattr(self, kind)):
                raise InputError(f"The simulator's {kind} are {getattr(self, kind)!r}; give a function of x, u and p.")
        for kind in ("states", "inputs"):
            object.__setattr__(self, kind, check_names(getattr(self, kind), kind))
        known_hold(self.hold)
        object.__setattr__(self, "substeps", whole(self.substeps, "substeps", 1))
        if not isinstance(self.units, Mapping) or not all(isinstance(unit, str) for unit in self.units.values()):
            raise InputError(f"The simulator's units are {self.units!r}; give {{name: unit}}.")
        object.__setattr__(self, "parameters", check_parameters(self.parameters))
        object.__setattr__(self, "ports", check_ports(self.ports))
        x, u, p, t = self.symbols()
        known = ca.vertcat(stack(x, u, p), t)
        check_expressions(self.by_state(self.derivatives(x, u, p, t)) | self.measured(x, u, p, t), known)
        for port in self.ports:
            own = {f"{port.name}: into {target}": factor for target, factor in self.into(port, x, u, p, t).items()}
            check_expressions(own | {f"{port.name}: across": self.across(port, x, u, p, t)}, known)
            self._check_term(port, x, u, p, t)
        signals = [name for port in self.ports for name in port.signals]
        check_known(
            list(self.units), [*self.inputs, *self.output_names, *signals], "inputs and outputs", "The simulator"
        )
        if self.observer is not None:
            object.__setattr__(self, "observer", self._check_gain(self.observer))

    def _check_gain(self, given: Any) -> np.ndarray:
        wanted = len(self.states), len(self.output_names)
        try:
            gain = np.asarray(given, dtype=float)
        except (TypeError, ValueError):
            gain = np.zeros(0)
        if gain.shape != wanted or not np.all(np.isfinite(gain)):
            raise InputError(
                f"The simulator's observer is {given!r}; give finite numbers, a row for each of {wanted[0]} states and "
                f"a column for each of {wanted[1]} outputs."
            )
        return gain

    def _copy_with(self, **changes: Any) -> Self:
        """Copy without new checks, for changes of elements or values that keep the equations."""
        copy = object.__new__(type(self))
        copy.__dict__.update(self.__dict__, **changes)
        return copy

    def with_elements(self, elements: tuple[Placed, ...]) -> Self:
        """Copy with other laws of the same parameters in place of its own."""
        return self._copy_with(elements=elements)

    def with_ports(self, ports: tuple[Port, ...]) -> Self:
        """Copy with other inner ports, such as `undeclared`; its cached properties are evaluated again."""
        copy = object.__new__(type(self))
        copy.__dict__.update({f.name: getattr(self, f.name) for f in fields(self)}, ports=ports)
        return copy

    @property
    def parameter_set(self) -> ParameterSet:
        """The parameters with the layout of their vector."""
        return cast(ParameterSet, self.parameters)

    def symbols(self) -> tuple[Named, Named, Named, Any]:
        """Make new symbols x, u, p and t for the equations."""
        x = Named("state", {n: ca.SX.sym(n) for n in self.states})
        u = Named("input", {n: ca.SX.sym(n) for n in self.inputs})
        own = self.parameter_set
        return x, u, Named("parameter", own.symbols(ca.SX.sym("p", own.size))), ca.SX.sym("t")

    def derivatives(self, x: Named, u: Named, p: Named, t: Any) -> Any:
        """Evaluate the dynamics without laws, a vector (n_x, 1)."""
        if not self.states:
            return ca.SX(0, 1)
        found = call(self.dynamics, "simulator's dynamics", x=x, u=u, p=p, t=t)
        if not isinstance(found, Mapping):
            raise InputError(f"The simulator's dynamics returned {type(found).__name__}; return {{state: derivative}}.")
        for name in self.states:
            if name not in found:
                raise InputError(f"The simulator's dynamics give no derivative for the state {name!r}; add it.")
        for name in found:
            if name not in self.states:
                raise InputError(
                    f"The simulator's dynamics give {name!r}, which is not a state; there are {', '.join(self.states)}."
                )
        checked = as_scalars(found, "dynamics", "derivative")
        return ca.vertcat(*(checked[name] for name in self.states))

    def by_state(self, vector: Any) -> dict[str, Any]:
        """Split a vector (n_x, 1) by state."""
        return dict(zip(self.states, ca.vertsplit(vector), strict=True))

    def measured(self, x: Named, u: Named, p: Named, t: Any, dx: Any = None) -> dict[str, Any]:
        """Evaluate the outputs by name, without laws; `dx` (n_x, 1) replaces the derivatives without laws."""
        more = {}
        if self._reads_rates:
            dx = self.derivatives(x, u, p, t) if dx is None else dx
            more["dx"] = Named("derivative", self.by_state(dx))
        found = call(self.outputs, "simulator's outputs", x=x, u=u, p=p, t=t, **more)
        if not isinstance(found, Mapping) or not found:
            raise InputError("The simulator's outputs must be a dict {output: expression} with at least one entry.")
        return as_scalars(found, "outputs", "expression")

    @cached_property
    def output_names(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return tuple(self.measured(*self.symbols()))

    @cached_property
    def _reads_rates(self) -> bool:
        """Whether the outputs ask for the states' derivatives."""
        if self.discrete or not self.states:
            return False
        try:
            return "dx" in inspect.signature(self.outputs).parameters
        except (TypeError, ValueError):
            return False

    def _derivative_feedthrough(self, x: Named, u: Named, p: Named, t: Any) -> Any:
        """Evaluate the factor of each state's derivative in each output, (n_y, n_x)."""
        if not self._reads_rates:
            return ca.sparsify(ca.SX(self._accelerometer_gains))
        dx = ca.SX.sym("dx", len(self.states))
        outputs = ca.vertcat(*self.measured(x, u, p, t, dx).values())
        factors = ca.jacobian(outputs, dx)
        if ca.depends_on(factors, dx):
            raise InputError("An output is not linear in dx; a force at a port would not add to it.")
        return factors

    @cached_property
    def _accelerometer_gains(self) -> np.ndarray:
        """Positive factors by which outputs are multiples of states' derivatives, (n_y, n_x); zero for no multiple.

        Random points decide. A derivative that depends on a single state or input is left out, because its multiple
        may be that state itself.
        """
        n_x, n_y = len(self.states), len(self.output_names)
        out = np.zeros((n_y, n_x))
        if self.discrete or not n_x:
            return out
        x, u, p, t = self.symbols()
        moving = stack(x, u)
        f, y = self.derivatives(x, u, p, t), ca.vertcat(*self.measured(x, u, p, t).values())
        both = ca.Function("both", [ca.vertcat(moving, stack(p), t)], [f, y])
        rates, outputs = evaluate_at_random_points(both)
        with np.errstate(all="ignore"):
            ratios = outputs[:, :, None] / rates[:, None, :]
        same = np.all(np.isclose(ratios, ratios[0], rtol=1e-9, atol=0.0), axis=0) & (ratios[0] > 0)
        rich = np.array([ca.jacobian(f[i], moving).nnz() > 1 for i in range(n_x)])
        for i, j in zip(*np.nonzero(same & rich), strict=True):
            out[i, j] = ratios[0, i, j] if not out[i].any() else 0.0
        return out

    def port_signals(self, port: Port, x: Named, u: Named, p: Named, t: Any) -> dict[str, Any]:
        """Evaluate a port's own signals by name."""
        found = {}
        for name, signal in port.signals.items():
            what = f"signal {name!r} of port {port.name!r}"
            if name in self.inputs:
                raise InputError(f"The {what} has the name of an input; give it another one.")
            found[name] = as_scalar(call(signal, what, x=x, u=u, p=p, t=t), what)
        return found

    def into(self, port: Port, x: Named, u: Named, p: Named, t: Any) -> dict[str, Any]:
        """Evaluate the factors of w by state or output."""
        name = f"`into` of port {port.name!r}"
        found = call(port.into, name, x=x, u=u, p=p, t=t) if callable(port.into) else port.into
        if not isinstance(found, Mapping) or not found:
            raise InputError(f"The {name} must be a dict {{state or output: factor}}; got {found!r}.")
        known = tuple(dict.fromkeys((*self.states, *self.output_names)))
        for target in found:
            if target not in known:
                raise InputError(f"Port {port.name!r} goes into {target!r}; there are {', '.join(known)}.")
        given = as_scalars(found, f"port {port.name!r}", "factor")
        through = ca.mtimes(self._derivative_feedthrough(x, u, p, t), self.state_factors(given))
        rates = dict(zip(self.output_names, ca.vertsplit(through), strict=True))
        return given | {k: v for k, v in rates.items() if k not in given and not v.is_zero()}

    def state_factors(self, factors: Mapping[str, Any]) -> Any:
        """Select the factors of w in the derivatives, a vector (n_x, 1); zero for states that w does not enter."""
        return ca.vertcat(ca.SX(0, 1), *(factors.get(state, 0.0) for state in self.states))

    def across(self, port: Port, x: Named, u: Named, p: Named, t: Any) -> Any:
        """Evaluate the local coordinate z."""
        name = f"`across` of port {port.name!r}"
        return as_scalar(call(port.across, name, x=x, u=u, p=p, t=t), name)

    def term(self, port: Port, z: Any, dz: Any, x: Named, u: Named, p: Named) -> Any:
        """Evaluate a port's term at another coordinate and rate."""
        assert port.term is not None
        name = f"`term` of port {port.name!r}"
        return as_scalar(call(port.term, name, z=ca.SX(z), dz=ca.SX(dz), x=x, u=u, p=p), name)

    def term_parameters(self, name: str) -> tuple[str, ...]:
        """List the parameters that a port's term depends on."""
        x, u, p, _ = self.symbols()
        term = self.term(self.port(name), ca.SX.sym("z"), ca.SX.sym("dz"), x, u, p)
        return tuple(name for name in self.parameters if ca.depends_on(term, ca.vec(ca.SX(p[name]))))

    def rate(self, port: Port, x: Named, u: Named, p: Named, t: Any) -> Any:
        """Evaluate the rate dz/dt of a port inside the equations, with constant inputs."""
        if port.rate is not None:
            return as_scalar(call(port.rate, f"`rate` of port {port.name!r}", x=x, u=u, p=p, t=t), "rate")
        return ca.jtimes(self.across(port, x, u, p, t), stack(x), self.derivatives(x, u, p, t))

    def _check_term(self, port: Port, x: Named, u: Named, p: Named, t: Any) -> None:
        """Refuse a term with the opposite sign in the equations: its slopes by all symbols are then opposite too."""
        if port.term is None:
            return
        known = ca.vertcat(stack(x, u, p), t)
        term = self.term(port, self.across(port, x, u, p, t), self.rate(port, x, u, p, t), x, u, p)
        name, factor = next(iter(self.into(port, x, u, p, t).items()))
        entire = (self.measured(x, u, p, t) | self.by_state(self.derivatives(x, u, p, t)))[name]
        slopes = ca.Function("slopes", [known], [ca.jacobian(v, known) for v in (entire, factor * term, factor)])
        total, own, scale = evaluate_at_random_points(slopes)
        moving = np.any(own != 0, axis=0) & ~np.any(scale != 0, axis=0)
        same, opposite = (np.any(np.all(np.isclose(total, sign * own, atol=0.0), axis=0) & moving) for sign in (1, -1))
        if opposite and not same:
            raise InputError(
                f"The equations hold the term of port {port.name!r} with the other sign; give it so that `into` times "
                "the term is part of them."
            )

    def shown_states(self, port: Port) -> tuple[str, str] | None:
        """Find the two states that are a port's coordinate and its rate, if an output reads one of them."""
        if port.series or self.discrete:
            return None
        x, u, p, t = self.symbols()
        z = self.across(port, x, u, p, t)
        name = z.name() if z.is_symbolic() else ""
        rate = self._integrals.get(name, "")
        if rate not in self.states or rate == name:
            return None
        read = ca.vertcat(*self.measured(x, u, p, t).values())
        return (name, rate) if ca.depends_on(read, ca.vertcat(x[name], x[rate])) else None

    def readers(self, port: Port) -> tuple[str, ...]:
        """List the outputs that read a port's coordinate or its rate, if these are states."""
        x, u, p, t = self.symbols()
        states = self.shown_states(port)
        if states is None:
            return ()
        motion = ca.vertcat(*(x[name] for name in states))
        return tuple(name for name, y in self.measured(x, u, p, t).items() if ca.depends_on(y, motion))

    def port(self, name: str) -> Port:
        """Find a port by name: declared, `actuator:<input>`, `sensor:<output>`, `equation:<state>`, `parameter:<name>`.

        Parameters are not among `all_ports`: a law there changes a parameter's value, not a signal.
        """
        for port in self.all_ports():
            if port.name == name:
                return port
        kind, own = split_port(name)
        if kind == EQUATION and own in self.kinematic and not self.ports:  # a user may still put a law there
            return self._equation_port(own)
        of_law = any(own.startswith(e.prefix) for e in self.elements)
        if kind == PARAMETER and own in self.parameters and not (of_law or self.parameters[own].value.ndim):
            return Port(name, {}, lambda p: p[own], None, self.parameters[own].unit, series=True)
        known = ", ".join(port.name for port in self.all_ports())
        raise InputError(f"There is no port {name!r}; there are {known}.")

    def all_ports(self) -> tuple[Port, ...]:
        """List the declared ports, then actuators and sensors.

        Without declared ports there is one for each state's equation that is no definition of a speed.
        """
        return self._all_ports

    @cached_property
    def _all_ports(self) -> tuple[Port, ...]:
        equations = () if self.discrete else (name for name in self.states if name not in self.kinematic)
        inner = self.ports or tuple(map(self._equation_port, equations))
        domain = common_domain(port.domain for port in inner)  # also of actuators: a voltage is a signal in all domains
        if not self.ports:
            inner = tuple(replace(port, domain=domain) if port.domain == UNKNOWN else port for port in inner)
        inner = self._add_drives(tuple(map(self._mark_speed, inner)))
        actuators = (_series_port(ACTUATOR, n, lambda u, n=n: u[n], self.units, domain) for n in self.inputs)
        sensors = (_series_port(SENSOR, n, lambda: 0, self.units, domain) for n in self.output_names)
        return (*inner, *actuators, *sensors)

    def _equation_port(self, state: str) -> Port:
        """Make the port of a state's equation, where w is subtracted from its derivative.

        If the state is the derivative of another state (a velocity), that other state is the local coordinate. The
        port has units if an output is the coordinate itself.
        """
        integral = next((n for n, rate in self._integrals.items() if rate == state), state)
        unit = self.state_units.get(integral, "")
        own = f"{unit}/s" if integral == state else f"{unit}/s^2"
        rate = None if integral == state else lambda x: x[state]
        return Port(port_name(EQUATION, state), {state: -1.0}, lambda x: x[integral], rate, own if unit else "", unit)

    def _mark_speed(self, port: Port) -> Port:
        """Set `rate` to `across` if z is a speed: a force changes its derivative, and its unit may be a speed's."""
        if self.discrete or not self.states:
            return port
        x, u, p, t = self.symbols()
        z = self.across(port, x, u, p, t)
        if port.rate is not None:
            speed = ca.is_equal(ca.SX(self.rate(port, x, u, p, t)), ca.SX(z), EQUAL_DEPTH)
        else:
            lift = ca.jtimes(z, stack(x), self.state_factors(self.into(port, x, u, p, t)))
            speed = not lift.is_zero() and port.domain in (MECHANICAL, UNKNOWN) and may_be_speed(port.across_unit)
            speed = speed and not (z.is_symbolic() and z.name() in self.kinematic)  # which are positions
        return replace(port, rate=port.across) if speed else port

    def _add_drives(self, ports: tuple[Port, ...]) -> tuple[Port, ...]:
        """Find what drives a motion in the equations, as `term` of the first port at each driven motion without one.

        A drive may be elastic wherever a force acts on a position, and limited wherever it moves a state of first
        order, whether its user has thought of that or not.
        """
        if self.discrete or not self.states:
            return ports
        at = self.symbols()
        targets = [tuple(self.into(port, *at)) for port in ports]
        taken = {target for port, target in zip(ports, targets, strict=True) if port.term is not None}
        out = []
        for port, target in zip(ports, targets, strict=True):
            for kind, find in (("drive", self._find_drive), ("balance", self._find_balance)):
                if target not in taken and (term := find(port, *at)) is not None:
                    taken.add(target)
                    port = replace(port, term=self._make_expression(term, *at[:3]), found=kind)
            out.append(port)
        return tuple(out)

    def _make_expression(self, value: Any, x: Named, u: Named, p: Named) -> Expression:
        """Make a function of states, inputs and parameters from an expression in their symbols."""
        of = ca.Function("term", [stack(x), stack(u), stack(p)], [value])
        names = self.states, self.inputs, tuple(self.parameters)

        def evaluate(x: Named, u: Named, p: Named) -> Any:
            sides = zip((x, u, p), names, strict=True)
            return of(*(ca.vertcat(*(ca.vec(ca.SX(one[n])) for n in some)) for one, some in sides))

        return evaluate

    def _find_drive(self, port: Port, x: Named, u: Named, p: Named, t: Any) -> Any:
        """Return the force of a drive at a port, with the sign of w; None if none acts on a position there.

        A drive acts by inputs, and by states that only inputs move, such as the lagged torque of an actuator.
        """
        into, z = self.into(port, x, u, p, t), self.across(port, x, u, p, t)
        speed = next(iter(into))
        moves = len(into) == 1 and z.is_symbolic() and self._integrals.get(z.name()) == speed
        if not moves or port.domain not in (MECHANICAL, UNKNOWN):
            return None
        rates = self.by_state(self.derivatives(x, u, p, t))
        actuators = set(self.states) - {z.name(), speed}
        mechanism = [x[n] for n in self.states if n not in actuators]
        while coupled := {n for n in actuators if ca.depends_on(rates[n], ca.vertcat(*mechanism))}:
            actuators -= coupled
            mechanism += [x[n] for n in coupled]
        forces = [n for n in self.inputs if not is_motion(self.units.get(n, ""))]
        lagged = [x[n] for n in sorted(actuators)]
        driving = ca.vertcat(*(u[n] for n in forces), *lagged)
        slope = ca.jacobian(rates[speed], driving) / into[speed]
        if not slope.nnz() or ca.depends_on(slope, ca.vertcat(stack(u), *lagged, t)):
            return None
        return ca.mtimes(slope, driving)

    def _find_balance(self, port: Port, x: Named, u: Named, p: Named, t: Any) -> Any:
        """Return all that changes a state which a port's force changes at once, with the sign of w.

        None if the port's coordinate is no such state, if no input drives it, or if the force acts with a factor that
        varies along a recording, which may pass through zero.
        """
        into, z = self.into(port, x, u, p, t), self.across(port, x, u, p, t)
        (name, factor), *more = into.items()
        if more or not z.is_symbolic() or z.name() != name or ca.depends_on(factor, ca.vertcat(stack(x), stack(u))):
            return None
        rate = self.by_state(self.derivatives(x, u, p, t))[name]
        if not ca.depends_on(rate, stack(u)) or ca.depends_on(rate / factor, ca.vertcat(t)):
            return None
        return rate / factor

    @cached_property
    def state_units(self) -> dict[str, str]:
        """Units of states: of the outputs that equal them, or else of the declared ports' coordinates."""
        at = self.symbols()
        known = [(self.across(port, *at), port.across_unit) for port in self.ports]
        known += [(y, self.units.get(name, "")) for name, y in self.measured(*at).items()]
        return {z.name(): unit for z, unit in known if unit and z.is_symbolic() and z.name() in self.states}

    def signal_units(self, port: str, recorded: Mapping[str, str] | None = None) -> dict[str, str]:
        """Return the units, by name, of the signals that may scale a law at a port; a recording's units come first.

        A parameter varies with states as well. An output may have the name of a state and another unit.
        """
        own = {name: self.state_units.get(name, "") for name in self.states if kind_of(port) == PARAMETER}
        return {**self.units, **(recorded or {}), **own}

    @cached_property
    def _integrals(self) -> dict[str, str]:
        """States whose derivative is a single symbol, with its name."""
        derivatives = self.by_state(self.derivatives(*self.symbols()))
        return {name: rate.name() for name, rate in derivatives.items() if rate.is_symbolic()}

    @cached_property
    def kinematic(self) -> frozenset[str]:
        """States that are the integral of another state: their equations are definitions and cannot miss physics."""
        own = {} if self.discrete else self._integrals
        return frozenset(n for n, rate in own.items() if rate in self.states and rate != n)

    @cached_property
    def unreached(self) -> frozenset[str]:
        """States whose equations are no definitions and have no declared port."""
        at = self.symbols()
        reached = {target for port in self.ports for target in self.into(port, *at)}
        return frozenset(self.states) - self.kinematic - reached

    @cached_property
    def undeclared(self) -> tuple[Port, ...]:
        """Ports of states' equations that differ from all declared ports; empty if none is declared.

        A declared port is the port of an equation if it enters that equation alone and has the same coordinate.
        """
        at = self.symbols()
        declared = [
            ([target for target in self.into(port, *at) if target in self.states], self.across(port, *at))
            for port in self.ports
        ]
        found = []
        for state in self.states if self.ports and not self.discrete else ():
            port = self._equation_port(state)
            z = self.across(port, *at)
            same = any(reached == [state] and ca.is_equal(z, other, EQUAL_DEPTH) for reached, other in declared)
            if state not in self.kinematic and not same:
                found.append(self._mark_speed(port))
        return tuple(found)

    @cached_property
    def coefficients(self) -> tuple[str, ...]:
        """Scalar parameters whose effect on the equations depends on states or inputs.

        A variation of any other parameter, such as an offset, is a force or a curve at a port.
        """
        x, u, p, t = self.symbols()
        equations = ca.vertcat(self.derivatives(x, u, p, t), *self.measured(x, u, p, t).values())
        scalars = [name for name, own in self.parameters.items() if not own.value.ndim]
        return tuple(name for name in scalars if ca.depends_on(ca.jacobian(equations, p[name]), stack(x, u)))

    @cached_property
    def idle_inputs(self) -> tuple[str, ...]:
        """Inputs that no equation depends on; they may scale the missing physics."""
        x, u, p, t = self.symbols()
        read = ca.vertcat(self.derivatives(x, u, p, t), *self.measured(x, u, p, t).values())
        return tuple(name for name in self.inputs if not ca.depends_on(read, u[name]))


def _series_port(kind: str, name: str, across: Expression, units: Mapping[str, str], domain: str) -> Port:
    unit = units.get(name, "")
    return Port(port_name(kind, name), {}, across, None, unit, unit, series=True, domain=domain)


def stack(*named: Named) -> Any:
    """Stack the values of several sets of symbols in one column."""
    return ca.vertcat(ca.SX(0, 1), *(ca.vec(value) for names in named for value in names._values.values()))


def evaluate_at_random_points(function: ca.Function) -> list[np.ndarray]:
    """Evaluate a function of one vector at random points; return an array (points, entries) per result.

    They are nan if it calls another program, which may fail there.
    """
    if calls_external(function):
        return [np.full((COMPARED_POINTS, function.numel_out(i)), np.nan) for i in range(function.n_out())]
    points = np.random.default_rng(0).uniform(0.5, 1.5, (COMPARED_POINTS, function.numel_in(0)))
    with np.errstate(all="ignore"):
        results = zip(*(function.call([point]) for point in points), strict=True)
        return [np.array([value.full().ravel() for value in column]) for column in results]
