"""The physical domain of a port: mechanical, thermal, electrical or fluid, inferred from its units.

The unit of the hidden force and that of the local coordinate each allow some domains; the port belongs to the one
domain that both allow. Dimensions decide, not spelling (Karnopp, Margolis & Rosenberg 2012, System Dynamics):
a temperature is thermal, a unit with amperes is electrical, a volume or mass flow is fluid, a force or a torque is
mechanical. A pressure or a length may be fluid or mechanical, and a number, a power or a unit that is not known may be
anything: N over m is mechanical, m^3/s over m is fluid, W over K is thermal, V over the state of charge is electrical.
Without units, or if they contradict each other, the domain is unknown.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

import numpy as np

MECHANICAL = "mechanical"
DOMAINS = (MECHANICAL, "thermal", "electrical", "fluid")
UNKNOWN = "unknown"

_UNITS: dict[str, tuple[int, int, int, int, int]] = {
    unit: exponents
    for units, exponents in {  # exponents of kg, m, s, A, K
        "g t": (1, 0, 0, 0, 0),
        "m": (0, 1, 0, 0, 0),
        "L l": (0, 3, 0, 0, 0),
        "s min h": (0, 0, 1, 0, 0),
        "Hz rpm": (0, 0, -1, 0, 0),
        "A": (0, 0, 0, 1, 0),
        "K °C degC": (0, 0, 0, 0, 1),
        "N": (1, 1, -2, 0, 0),
        "Nm J": (1, 2, -2, 0, 0),
        "W": (1, 2, -3, 0, 0),
        "Pa bar": (1, -1, -2, 0, 0),
        "V": (1, 2, -3, -1, 0),
        "C Ah": (0, 0, 1, 1, 0),
        "F": (-1, -2, 4, 2, 0),
        "Ohm ohm Ω": (1, 2, -3, -2, 0),
        "S": (-1, -2, 3, 2, 0),
        "H": (1, 2, -2, -2, 0),
        "Wb": (1, 2, -2, -1, 0),
        "T": (1, 0, -2, -1, 0),
        "rad deg 1 %": (0, 0, 0, 0, 0),
    }.items()
    for unit in units.split()
}
_REVOLUTIONS = {
    "rad radian radians": 2 * np.pi,
    "mrad": 2e3 * np.pi,
    "deg ° degree degrees": 360.0,
    "rev revs revolution revolutions turn turns": 1.0,
}
_ANGLES = {"rad", "deg", "rpm"}  # units that occur in mechanics alone
_PREFIXES = "pnuµμmcdhkMG"

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
    """Tell whether a unit may be converted to another: of the same dimension, or not known.

    >>> may_convert("mV", "V"), may_convert("A", "V"), may_convert("", "V")
    (True, False, True)
    """
    sizes = _dimension(unit), _dimension(other)
    return None in sizes or sizes[0] == sizes[1]


def may_be_speed(unit: str) -> bool:
    """Tell whether a unit may be that of a speed: of a length, an angle or a count per time, or not given.

    >>> may_be_speed("rad/s"), may_be_speed("counts/s"), may_be_speed(""), may_be_speed("mm"), may_be_speed("level")
    (True, True, True, False, False)
    """
    size = _dimension(unit)
    return not unit or (unit.endswith("/s") if size is None else size in ((0, 1, -1, 0, 0), (0, 0, -1, 0, 0)))


def revolution_in(unit: str) -> float:
    """Return one revolution in the unit of an angle; nan if it is none.

    >>> revolution_in("deg"), revolution_in("turns"), revolution_in("rad/s"), revolution_in("m"), revolution_in("")
    (360.0, 1.0, nan, nan, nan)
    """
    return next((size for names, size in _REVOLUTIONS.items() if unit.strip() in names.split()), np.nan)


def common_domain(domains: Iterable[str]) -> str:
    """Return the domain of all whose domain is known; unknown if there is none, or more than one."""
    found = set(domains) - {UNKNOWN}
    return found.pop() if len(found) == 1 else UNKNOWN


def _allowed_domains(unit: str) -> tuple[str, ...]:
    """Domains in which a quantity of a unit may occur."""
    size = _dimension(unit)
    if size is None:
        return DOMAINS
    symbols = re.findall(r"[^\s*/·^()\d-]+", unit)
    if any(s in _ANGLES or (s[0] in _PREFIXES and s[1:] in _ANGLES) for s in symbols):
        return ("mechanical",)
    if size[4]:
        return ("thermal",)
    if size[3]:
        return ("electrical",)
    return _DOMAINS_OF.get(size[:3], DOMAINS)


def _dimension(unit: str) -> tuple[int, ...] | None:
    """Exponents of kg, m, s, A and K of a unit such as "N s/m" or "m^3/s"; None if it is empty or not known."""
    total, below = [0, 0, 0, 0, 0], False
    tokens = re.findall(r"[^\s*/·^()]+(?:\^\(?-?\d+\)?)?|/", unit.replace("²", "^2").replace("³", "^3"))
    for token in tokens:
        if token == "/":
            below = True
            continue
        base, _, power = token.partition("^")
        size = _base_dimension(base)
        if size is None:
            return None
        times = int(power.strip("()") or 1) * (-1 if below else 1)
        total = [a + times * b for a, b in zip(total, size, strict=True)]
    return tuple(total) if tokens else None


def _base_dimension(symbol: str) -> tuple[int, ...] | None:
    """Exponents of a unit without its prefix; None if it is not known."""
    if symbol in _UNITS:
        return _UNITS[symbol]
    return _UNITS.get(symbol[1:]) if symbol[:1] and symbol[0] in _PREFIXES else None
