"""Ports: the places where physics may be missing, and laws placed there.

A port that the user declares has a name of its own. Built-in ports need no declaration; their names give their kind
and their owner: `actuator:<input>`, `sensor:<output>`, `equation:<state>`, `parameter:<name>`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .._base import InputError
from ..data import revolution_in
from ..laws import display_name, short_name
from .domains import DOMAINS, MECHANICAL, UNKNOWN, infer_domain, is_motion, may_convert

Expression = Callable[..., Any]
ACTUATOR, SENSOR, EQUATION, PARAMETER = BUILT_IN = ("actuator", "sensor", "equation", "parameter")


def port_name(kind: str, of: str) -> str:
    """Name a built-in port by its kind and the input, output, state or parameter that it belongs to."""
    return f"{kind}:{of}"


def split_port(port: str) -> tuple[str, str]:
    """Split a port's name into its kind and its owner; the kind of a declared port is empty.

    Examples
    --------
    >>> split_port("sensor:x"), split_port("guide")
    (('sensor', 'x'), ('', 'guide'))
    """
    kind, colon, of = port.partition(":")
    return (kind, of) if colon and kind in BUILT_IN else ("", port)


def kind_of(port: str) -> str:
    """Return the kind of a port by its name: ACTUATOR, SENSOR, EQUATION, PARAMETER, or "" for a declared port."""
    return split_port(port)[0]


def in_series(port: str) -> bool:
    """Tell by its name whether a port belongs to a signal: an actuator or a sensor."""
    return kind_of(port) in (ACTUATOR, SENSOR)


def name_at(port: str, law: str, form: str = "", brief: bool = False) -> str:
    """Name a law in a port by its id and form: "backlash at gear", or "variation of R with temperature".

    A `brief` name omits the form unless it identifies the law.
    """
    kind, of = split_port(port)
    if kind == PARAMETER:
        _, _, by = form.rpartition("scheduled by ")
        return f"variation of {of}" + (f" with {'time' if by == 't' else by}" if by else "")
    return f"{(short_name if brief else display_name)(law, form)} at {port}"


def name_at_any(port: str, law: str, form: str, alike: Iterable[tuple[str, str]]) -> str:
    """Name a law in a port briefly, with the other ports where it would look the same; `alike` are (port, law).

    Examples
    --------
    >>> name_at_any("guide", "coulomb_friction", "smooth", [("screw", "coulomb_friction"), ("guide", "hysteresis")])
    'Coulomb friction at guide (or screw)'
    """
    others = [place for place, other in alike if other == law and place != port]
    return name_at(port, law, form, brief=True) + (f" (or {' or '.join(others)})" if others else "")


@dataclass(frozen=True, eq=False)
class Port:
    """A place where physics may be missing.

    Parameters
    ----------
    name : str
        Name in results.
    into : callable or mapping
        Where an internal force w enters: `{state: factor}` (added to the state's derivative) or `{output: factor}`; a
        callable takes any of x, u, p by name. An output that is a state's derivative, such as an acceleration, or that
        reads `dx`, changes with the force as well, without an entry of its own.
    across : callable
        Local coordinate z, from any of x, u, p.
    rate : callable, optional
        dz/dt, from any of x, u, p; by default `across` is differentiated along the dynamics. Where there is no position
        (a drive without an angle), both are the speed, which friction opposes. That is also the default where a force
        changes z at once, unless units say that z is no speed.
    unit, across_unit : str
        Units of w and of z.
    signals : mapping of str to callable, optional
        Further quantities, besides the inputs and z, with which the strength of a law here may vary, such as the load
        of a contact or a temperature: `{"load": lambda x, u: ca.fabs(u.torque)}`; from any of x, u, p.
    term : callable, optional
        Force that the equations have here already, with the sign of w, so that `into * term` is part of them: the force
        of a spring, `lambda z, p: p.k * z`, or minus the torque of a motor, `lambda u: -u.torque`. It takes any of z,
        dz, x, u, p by name, where z and dz are the local coordinate and its rate. Laws in line with it (a gap, a
        compliance, a rotor on a spring) are then tried: they change its z and dz.
        If no term is given, the force of a drive is found in the equations; where a force changes z at once, as in a
        drive of first order, all that changes z is the term.
    found : {"", "drive", "balance"}
        Kind of the term that the simulator has found in its equations, if none is given.
    series : bool
        A law acts on a signal, as at an actuator or a sensor; of built-in ports.
    domain : {"mechanical", "thermal", "electrical", "fluid", "unknown"}, optional
        Physical domain, which decides the laws that are tried; by default inferred from the units.

    Raises
    ------
    InputError
        If an argument has the wrong type, or the domain is not one of these. A simulator refuses a term that has the
        other sign in its equations.

    Examples
    --------
    >>> Port("mount", into={"vel": -1.0}, across=lambda x: x.pos, unit="N").kinds
    {'parallel'}
    """

    name: str
    into: Any
    across: Expression
    rate: Expression | None = None
    unit: str = ""
    across_unit: str = ""
    series: bool = False
    domain: str = ""
    signals: Mapping[str, Expression] = field(default_factory=dict)
    term: Expression | None = None
    found: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise InputError(f"A port's name is {self.name!r}; give a text, such as 'mount'.")
        what = f"of port {self.name!r}"
        if not callable(self.into) and not isinstance(self.into, Mapping):
            raise InputError(f"`into` {what} is {self.into!r}; give {{state or output: factor}} or a function.")
        for option, wanted in (("across", "lambda x: x.pos"), ("rate", "lambda x: x.vel")):
            given = getattr(self, option)
            if not callable(given) and not (option == "rate" and given is None):
                raise InputError(f"`{option}` {what} is {given!r}; give a function, such as {wanted}.")
        if self.term is not None and not callable(self.term):
            raise InputError(f"`term` {what} is {self.term!r}; give a function, such as lambda z, p: p.k * z.")
        for option in ("unit", "across_unit"):
            if not isinstance(getattr(self, option), str):
                raise InputError(f"`{option}` {what} is {getattr(self, option)!r}; give plain text, such as 'N'.")
        if not isinstance(self.signals, Mapping) or not all(map(callable, self.signals.values())):
            raise InputError(
                f"`signals` {what} are {self.signals!r}; give functions by name, {{'load': lambda x: ...}}."
            )
        for name in self.signals:
            if not isinstance(name, str) or not name.isidentifier() or name in ("z", "t"):
                raise InputError(f"A signal {what} is named {name!r}; give a name like 'load' (z and t are taken).")
        if self.domain not in ("", *DOMAINS, UNKNOWN):
            raise InputError(f"The domain {what} is {self.domain!r}; give {', '.join(DOMAINS)} or {UNKNOWN}.")
        object.__setattr__(self, "domain", self.domain or infer_domain(self.unit, self.across_unit))

    @property
    def kinds(self) -> set[str]:
        """Places that it offers to laws: "parallel", "parameter", or "series", at a sensor also "sensor"."""
        kind = kind_of(self.name)
        if kind == PARAMETER:
            return {"parameter"}
        if not self.series:
            return {"parallel"}
        return {"series", "sensor"} if kind == SENSOR else {"series"}

    @property
    def is_speed(self) -> bool:
        """Whether z is a speed; the port then has no position."""
        return self.rate is not None and self.rate is self.across

    @property
    def position_unit(self) -> str:
        """Unit of the position at the port, in which laws are written: the unit of z; for a speed, times s."""
        if not self.is_speed:
            return self.across_unit
        if not self.across_unit:
            return "[z] s"
        before, per_second, after = self.across_unit.rpartition("/s")
        return before if per_second and not after else f"{self.across_unit} s"

    @property
    def revolution(self) -> float:
        """One revolution in the unit of z; nan if z is no angle. A position without a unit may be an angle in rad."""
        torque = not self.unit or may_convert(self.unit, "N m")
        position = not (self.across_unit or self.is_speed or self.series) and torque
        return revolution_in("rad" if position else self.across_unit)

    def has_term_for(self, law: Any) -> bool:
        """Tell whether it has the force that a law in line needs: its own term, or one found in the equations."""
        return self.term is not None and self.found in ("", law.implied)

    def admits(self, law: Any) -> bool:
        """Tell whether a law (or its class) may be missing here: by its places, physical domains and coordinate.

        A port of unknown domain admits the laws of all domains, except special ones. If z is a speed, laws of the
        position are excluded; in an unknown domain z may be another quantity, so laws of z alone are admitted unless
        its unit is one of speed.
        """
        mechanical = self.domain == MECHANICAL or (self.domain == UNKNOWN and is_motion(self.across_unit))
        if self.is_speed and "z" in law.reads() and (mechanical or "dz" in law.reads()):
            return False
        if law.in_line and not self.has_term_for(law):
            return False
        if kind_of(self.name) == ACTUATOR and self.name.partition(":")[2] in (law.scaled_by, law.carried_by):
            return False  # a signal that it scales itself is a square, one that is added to itself a gain
        if self.domain in law.absent or (law.angular and np.isnan(self.revolution)):
            return False
        if not self.kinds & set(law.places) or (law.across and not may_convert(self.across_unit, law.across)):
            return False
        return self.domain in law.domains or not (law.special or (law.domains and self.domain != UNKNOWN))


@dataclass(frozen=True, eq=False)
class Placed:
    """A law in a port, with the prefix of its parameters' names."""

    port: str
    law: Any
    prefix: str

    @property
    def pair(self) -> tuple[str, type[Any]]:
        """Port and class of the law."""
        return self.port, type(self.law)

    @property
    def name(self) -> tuple[str, str]:
        """Port and id of the law, which are alike for all its forms."""
        return self.port, self.law.id

    @property
    def words(self) -> str:
        """Law, form and port in words; see `name_at`."""
        return name_at(*self.name, self.law.form)

    def own(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Select the law's values, by its own names, from values by full name."""
        return {name: values[f"{self.prefix}{name}"] for name in self.law.parameters()}

    def of(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Select the law's values, by full name, from values by full name."""
        return self.named(self.own(values))

    def named(self, own: Mapping[str, Any]) -> dict[str, Any]:
        """Rename values of the law to full names."""
        return {f"{self.prefix}{name}": value for name, value in own.items()}
