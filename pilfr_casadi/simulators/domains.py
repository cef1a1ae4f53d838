"""The physical domain of a port: mechanical, thermal, electrical or fluid, inferred from its units.

The units of the hidden force and of the local coordinate each allow some domains; the port belongs to the one
domain that both allow. Dimensions decide, not spelling (Karnopp, Margolis & Rosenberg 2012, System Dynamics):
a temperature is thermal, a unit with amperes is electrical, a volume or mass flow is fluid, a force or a torque is
mechanical. A pressure or a length may be fluid or mechanical, and a number, a power or a unit that is not known may be
anything. So N over m is mechanical, m^3/s over m is fluid, W over K is thermal, V over the state of charge is
electrical. Without units, or if they contradict each other, the domain is unknown.
"""

from __future__ import annotations

from collections.abc import Iterable

from ..data import dimension, symbols

MECHANICAL = "mechanical"
DOMAINS = (MECHANICAL, "thermal", "electrical", "fluid")
UNKNOWN = "unknown"

FLOWS = ("m^3/s", "kg/s", "m/s", "rad/s", "1", "V", "A")  # of what carries a signal along, and of commands to its drive

_ROTATION_UNITS = {"rad", "deg", "rpm"}  # occur in mechanics alone

# domains of the dimensions that are neither thermal nor electrical; others may be anything
_DOMAINS_OF: dict[tuple[int, ...], tuple[str, ...]] = {
    (1, 1, -2): ("mechanical",),  # force
    (1, 2, -2): ("mechanical",),  # torque, energy
    (0, 1, -2): ("mechanical",),  # acceleration
    (0, 1, -1): ("mechanical", "fluid"),  # speed, or the rate of a level
    (0, 1, 0): ("mechanical", "fluid"),  # position, or a level
    (1, -1, -2): ("mechanical", "fluid"),  # stress, or a pressure
    (0, 3, 0): ("fluid",),  # volume
    (0, 3, -1): ("fluid",),  # volume flow
    (1, 0, -1): ("fluid",),  # mass flow
    (1, 0, 0): ("fluid",),  # mass
}


def infer_domain(*units: str) -> str:
    """Infer the domain of a port from the units of its force and of its local coordinate.

    >>> infer_domain("W", "K"), infer_domain("l/min", "kPa"), infer_domain("N m", "rad"), infer_domain("V", "")
    ('thermal', 'fluid', 'mechanical', 'electrical')
    >>> infer_domain("level/s", "level"), infer_domain("N", "A")
    ('unknown', 'unknown')
    """
    allowed = set(DOMAINS)
    for unit in units:
        allowed &= set(_allowed_domains(unit))
    return allowed.pop() if len(allowed) == 1 else UNKNOWN


def may_convert(unit: str, other: str) -> bool:
    """Tell whether a unit may be converted to another: both have the same dimension, or one is unknown.

    >>> may_convert("mV", "V"), may_convert("A", "V"), may_convert("", "V")
    (True, False, True)
    """
    sizes = dimension(unit), dimension(other)
    return None in sizes or sizes[0] == sizes[1]


def may_be_speed(unit: str) -> bool:
    """Tell whether a unit may belong to a speed: a length, an angle or a count per time, or not given.

    >>> may_be_speed("rad/s"), may_be_speed("counts/s"), may_be_speed(""), may_be_speed("mm"), may_be_speed("level")
    (True, True, True, False, False)
    """
    size = dimension(unit)
    return not unit or (unit.endswith("/s") if size is None else size in ((0, 1, -1, 0, 0), (0, 0, -1, 0, 0)))


def may_be_flow(unit: str) -> bool:
    """Tell whether a unit may belong to what moves a fluid or a belt: a flow, a speed, or a drive's command.

    >>> [may_be_flow(unit) for unit in ("L/min", "kg/h", "rpm", "%", "", "degC", "W", "N")]
    [True, True, True, True, True, False, False, False]
    """
    return any(may_convert(unit, of_flow) for of_flow in FLOWS)


def is_motion(unit: str) -> bool:
    """Tell whether a unit is that of a position, a speed or an acceleration, of a length or an angle.

    >>> is_motion("mm"), is_motion("rad/s"), is_motion("m/s^2"), is_motion("N m"), is_motion("V"), is_motion("")
    (True, True, True, False, False, False)
    """
    size = dimension(unit)
    if size is None:
        return False
    plain = size[0] == size[3] == size[4] == 0 and size[2] in (0, -1, -2)
    return plain and (size[1] == 1 or (size[1] == 0 and bool(_ROTATION_UNITS & set(symbols(unit)))))


def common_domain(domains: Iterable[str]) -> str:
    """Return the one known domain among several; unknown if there is none, or more than one."""
    found = set(domains) - {UNKNOWN}
    return found.pop() if len(found) == 1 else UNKNOWN


def _allowed_domains(unit: str) -> tuple[str, ...]:
    """List the domains in which a quantity with a unit may occur."""
    size = dimension(unit)
    if size is None:
        return DOMAINS
    if _ROTATION_UNITS & set(symbols(unit)):
        return ("mechanical",)
    if size[4]:
        return ("thermal",)
    if size[3]:
        return ("electrical",)
    return _DOMAINS_OF.get(size[:3], DOMAINS)
