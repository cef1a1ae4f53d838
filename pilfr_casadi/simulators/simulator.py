"""The user's simulator: continuous-time equations with ports that missing physics can be put into.

    ẋ = f(x, u, p) + Σ into_j(p) w_j,   y = h(x, u, p) + Σ into_j(p) w_j,
    w_j = law_j(z_j, ż_j),   z_j = across_j(x, u)

`close_loop(simulator, law, port)` puts a law into a port and gives a simulator again; `discretise` (in
`integration.py`) makes it a `Model`, the same as any other. At an actuator or a sensor a law stands in series: what it
adds to the signal is `w = law(u) - u`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import casadi as ca

from .._base import InputError
from ..models import Parameter, ParameterSet
from .expressions import Expression, Named, call

BUILT_IN = ("actuator:", "sensor:", "equation:")


@dataclass(frozen=True, eq=False)
class Port:
    """A place where physics may be missing.

    Parameters
    ----------
    name : str
        Name in results.
    into : callable or mapping
        How an internal force w enters: `{state: factor}` (added to the state's derivative) or `{output: factor}`; a
        callable takes any of x, u, p by name.
    across : callable
        Local coordinate z, of any of x, u, p.
    rate : callable, optional
        dz/dt, of any of x, u, p; left out, `across` is differentiated along the dynamics. Of a drive without an angle
        both are the speed, which friction opposes.
    unit, across_unit : str
        Units of w and of z.
    """

    name: str
    into: Any
    across: Expression
    rate: Expression | None = None
    unit: str = ""
    across_unit: str = ""
    series: bool = False

    @property
    def kinds(self) -> set[str]:
        """Places of laws that it is: "parallel", or "series" and at a sensor "sensor"."""
        if not self.series:
            return {"parallel"}
        return {"series", "sensor"} if self.name.startswith("sensor:") else {"series"}


@dataclass(frozen=True, eq=False)
class Placed:
    """A law in a port, and the prefix of its parameters' names."""

    port: str
    law: Any
    prefix: str

    def own(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """The law's values by its own names, of values by full name."""
        return {name: values[f"{self.prefix}{name}"] for name in self.law.parameters()}

    def of(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """The law's values by full name, of all values."""
        return self.named(self.own(values))

    def named(self, own: Mapping[str, Any]) -> dict[str, Any]:
        """Values of the law by full name."""
        return {f"{self.prefix}{name}": value for name, value in own.items()}


@dataclass(frozen=True, eq=False)
class Simulator:
    """A simulator with ports.

    Parameters
    ----------
    dynamics : callable
        Of any of x, u, p (and t, time in s) by name, to `{state: derivative}`; x.<state>, u.<input>, p.<parameter> are
        CasADi symbols.
    outputs : callable
        Of the same, to `{output: expression}`.
    states, inputs : tuple of str
        Names; `states=()` is a static device.
    parameters : mapping
        `Parameter` by name.
    ports : tuple of Port
        Declared ports; where there are none, each state's equation is one.
    hold : {"zero", "linear"}, optional
        What inputs do between samples, where recordings do not say.
    discrete : bool
        `dynamics` gives the next sample's states instead of derivatives.

    Raises
    ------
    InputError
        If names are not unique, a derivative is missing, or a port names what is not there.
    """

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

    def __post_init__(self) -> None:
        for kind in ("states", "inputs"):
            names = getattr(self, kind)
            names = (names,) if isinstance(names, str) else tuple(names)
            if len(set(names)) != len(names):
                raise InputError(f"The simulator's {kind} {', '.join(names)} are not unique; name each once.")
            object.__setattr__(self, kind, names)
        if self.hold not in (None, "zero", "linear"):
            raise InputError(f"hold = {self.hold!r} was given; use 'zero', 'linear' or None.")
        for name, p in self.parameters.items():
            if not isinstance(p, Parameter):
                raise InputError(f"The simulator's parameter {name!r} is {p!r}; give Parameter(value, ...).")
        object.__setattr__(self, "parameters", ParameterSet(dict(self.parameters)))
        object.__setattr__(self, "ports", tuple(self.ports))
        x, u, named, t = self._symbols()
        found = (
            dict(zip(self.states, ca.vertsplit(self.derivatives(x, u, named, t)), strict=True)) if self.states else {}
        )
        known = [*x._values.values(), *u._values.values(), *named._values.values(), t]
        _check_expressions({**found, **self.measured(x, u, named, t)}, known)
        names = [port.name for port in self.ports]
        if len(set(names)) != len(names):
            raise InputError(f"The port names {', '.join(names)} are not unique; name each port once.")
        for port in self.ports:
            if port.name.startswith(BUILT_IN):
                raise InputError(
                    f"The port {port.name!r} is declared with a name that begins as those of built-in ones do "
                    f"({', '.join(BUILT_IN)}), which need no declaration; call it something else."
                )
            self.into(port, x, u, named, t)
            self.across(port, x, u, named, t)

    def _symbols(self) -> tuple[Named, Named, Named, Any]:
        x = Named("state", {n: ca.SX.sym(n) for n in self.states})
        u = Named("input", {n: ca.SX.sym(n) for n in self.inputs})
        own = ParameterSet(dict(self.parameters))
        return x, u, Named("parameter", own.symbols(ca.SX.sym("p", own.size))), ca.SX.sym("t")

    def derivatives(self, x: Named, u: Named, p: Named, t: Any) -> Any:
        """The dynamics as a vector (n_x, 1), elements left out."""
        if not self.states:
            return ca.SX(0, 1)
        found = call(self.dynamics, "simulator's dynamics", x=x, u=u, p=p, t=t)
        if not isinstance(found, Mapping):
            raise InputError(f"The simulator's dynamics returned {type(found).__name__}; return {{state: derivative}}.")
        return ca.vertcat(*_row(found, self.states, "dynamics", "derivative"))

    def measured(self, x: Named, u: Named, p: Named, t: Any) -> dict[str, Any]:
        """The outputs by name, elements left out."""
        found = call(self.outputs, "simulator's outputs", x=x, u=u, p=p, t=t)
        if not isinstance(found, Mapping) or not found:
            raise InputError("The simulator's outputs must be a dict {output: expression} with at least one entry.")
        return dict(zip(found, _row(found, tuple(found), "outputs", "expression"), strict=True))

    @cached_property
    def output_names(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return tuple(self.measured(*self._symbols()))

    def into(self, port: Port, x: Named, u: Named, p: Named, t: Any) -> dict[str, Any]:
        """Factors of w by state or output."""
        what = f"`into` of port {port.name!r}"
        found = call(port.into, what, x=x, u=u, p=p, t=t) if callable(port.into) else port.into
        if not isinstance(found, Mapping) or not found:
            raise InputError(f"The {what} must be a dict {{state or output: factor}}; got {found!r}.")
        known = (*self.states, *self.output_names)
        for name in found:
            if name not in known:
                raise InputError(f"Port {port.name!r} goes into {name!r}; there are {', '.join(known)}.")
        return dict(zip(found, _row(found, tuple(found), f"port {port.name!r}", "factor"), strict=True))

    def across(self, port: Port, x: Named, u: Named, p: Named, t: Any) -> Any:
        """Local coordinate z."""
        what = f"`across` of port {port.name!r}"
        return _scalar(call(port.across, what, x=x, u=u, p=p, t=t), what)

    def port(self, name: str) -> Port:
        """A port by name: declared, `actuator:<input>`, `sensor:<output>` or `equation:<state>`."""
        for port in self.all_ports():
            if port.name == name:
                return port
        known = ", ".join(port.name for port in self.all_ports())
        raise InputError(f"There is no port {name!r}; there are {known}.")

    def all_ports(self) -> tuple[Port, ...]:
        """Declared ports (else one for each state's equation), then actuators and sensors."""
        return self._every_port

    @cached_property
    def _every_port(self) -> tuple[Port, ...]:
        inner = self.ports or (() if self.discrete else tuple(map(self._equation, self.states)))
        actuators = (_series("actuator", n, lambda u, n=n: u[n], self.units) for n in self.inputs)
        sensors = (_series("sensor", n, lambda: 0, self.units) for n in self.output_names)
        return (*inner, *actuators, *sensors)

    def _equation(self, state: str) -> Port:
        """The port of a state's equation: w is taken from its derivative.

        Where the state is itself the derivative of another (a velocity), the local coordinate is that other one.
        """
        x, u, p, t = self._symbols()
        derivatives = ca.vertsplit(self.derivatives(x, u, p, t))
        held = next(
            (n for n, d in zip(self.states, derivatives, strict=True) if d.is_symbolic() and d.name() == state), None
        )
        if held is None or held == state:
            return Port(f"equation:{state}", {state: -1.0}, lambda x: x[state])
        return Port(f"equation:{state}", {state: -1.0}, lambda x: x[held], lambda x: x[state])

    @cached_property
    def kinematic(self) -> frozenset[str]:
        """States that are the integral of another state: their equations are definitions, in which nothing can miss."""
        if self.discrete:
            return frozenset()
        x, u, p, t = self._symbols()
        derivatives = zip(self.states, ca.vertsplit(self.derivatives(x, u, p, t)), strict=True)
        return frozenset(n for n, d in derivatives if d.is_symbolic() and d.name() in self.states and d.name() != n)

    @cached_property
    def idle_inputs(self) -> tuple[str, ...]:
        """Inputs that no equation reads: they may scale what is missing."""
        x, u, p, t = self._symbols()
        read = ca.vertcat(self.derivatives(x, u, p, t), *self.measured(x, u, p, t).values())
        return tuple(name for name in self.inputs if not ca.depends_on(read, u[name]))

    def with_parameters(self, parameters: Mapping[str, Parameter]) -> Simulator:
        """The same equations with other parameters of the same names."""
        return replace(self, parameters=ParameterSet(dict(parameters)))

    def with_element(self, port: str, law: Any) -> Simulator:
        """A simulator with a law put into a port; see `model.close_loop`."""
        place = self.port(port)
        allowed = getattr(law, "places", ("series", "parallel"))
        if not place.kinds & set(allowed):
            kind = "series" if place.series else "parallel"
            raise InputError(f"The law {law.id!r} cannot stand in {kind} at {port!r}; choose another port or law.")
        if getattr(law, "channels", 1) != 1:
            raise InputError(f"The element has {law.channels} channels, the port {port!r} has one; give as many.")
        if lacks := getattr(law, "lacks", ""):
            raise InputError(f"The law {law.id!r} cannot be closed in at {port!r} yet: {lacks}.")
        count = sum(e.port == port for e in self.elements)
        prefix = f"{port}." if not count else f"{port}#{count + 1}."
        placed = Placed(port, law, prefix)
        return replace(
            self,
            parameters=ParameterSet(dict(self.parameters)) | placed.named(law.parameters()),
            elements=(*self.elements, placed),
        )

    def without_last_element(self) -> Simulator:
        """The simulator before the last `with_element`."""
        *kept, last = self.elements
        own = {k: p for k, p in self.parameters.items() if not k.startswith(last.prefix)}
        return replace(self, parameters=ParameterSet(own), elements=tuple(kept))


def in_series(port: str) -> bool:
    """Whether a port, by its name, is a signal's own: an actuator or a sensor."""
    return port.startswith(("actuator:", "sensor:"))


def _series(kind: str, name: str, across: Expression, units: Mapping[str, str]) -> Port:
    unit = units.get(name, "")
    return Port(f"{kind}:{name}", {}, across, None, unit, unit, series=True)


def _check_expressions(found: Mapping[str, Any], known: list[Any]) -> None:
    """Refuse symbols of the user's own, and the NaN that `math.sin(symbol)` gives without a word."""
    names, expressions = list(found), list(found.values())
    f = ca.Function("equations", known, expressions, {"allow_free": True})
    if f.has_free():
        raise InputError(f"The simulator's equations hold a symbol {f.get_free()[0]!r}; use x, u, p and t alone.")
    k = range(f.n_instructions())
    if any(f.instruction_id(i) == ca.OP_CONST and f.instruction_constant(i) != f.instruction_constant(i) for i in k):
        for name in names:
            _check_expressions({name: found[name]}, known) if len(names) > 1 else None
        raise InputError(
            f"The equation of {names[0]!r} holds a number that is none (NaN); use CasADi's functions on symbols, "
            "as in ca.sin(x.pos) rather than math.sin(x.pos), and check constants."
        )


def _scalar(value: Any, what: str) -> Any:
    try:
        value = ca.SX(value)
    except Exception:
        raise InputError(f"The {what} gave {value!r}; give a number or a CasADi expression.") from None
    if value.shape != (1, 1):
        raise InputError(f"The {what} has the shape {value.shape}; give one number or expression.")
    return value


def _row(found: Mapping[str, Any], names: tuple[str, ...], where: str, what: str) -> list[Any]:
    for name in names:
        if name not in found:
            raise InputError(f"The simulator's {where} give no {what} for the state {name!r}; add it.")
    for name in found:
        if name not in names:
            raise InputError(
                f"The simulator's {where} give {name!r}, which is not a state; there are {', '.join(names)}."
            )
    return [_scalar(found[name], f"{what} of {name!r} in the {where}") for name in names]
