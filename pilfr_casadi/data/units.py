"""Parse units such as "N s/m", "mm" or "l/min": their dimensions, and their sizes in SI."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

# unit: size in SI, exponents of kg, m, s, A, K and of the angle in rad
_UNITS: dict[str, tuple[float, tuple[int, int, int, int, int, int]]] = {
    unit: (size, exponents)
    for units, size, exponents in (
        ("g", 1e-3, (1, 0, 0, 0, 0, 0)),
        ("t", 1e3, (1, 0, 0, 0, 0, 0)),
        ("m", 1.0, (0, 1, 0, 0, 0, 0)),
        ("in inch", 0.0254, (0, 1, 0, 0, 0, 0)),
        ("L l", 1e-3, (0, 3, 0, 0, 0, 0)),
        ("s", 1.0, (0, 0, 1, 0, 0, 0)),
        ("min", 60.0, (0, 0, 1, 0, 0, 0)),
        ("h", 3600.0, (0, 0, 1, 0, 0, 0)),
        ("Hz", 1.0, (0, 0, -1, 0, 0, 0)),
        ("rpm", 2 * np.pi / 60, (0, 0, -1, 0, 0, 1)),
        ("A", 1.0, (0, 0, 0, 1, 0, 0)),
        ("K °C degC", 1.0, (0, 0, 0, 0, 1, 0)),
        ("°F degF", 5 / 9, (0, 0, 0, 0, 1, 0)),
        ("N", 1.0, (1, 1, -2, 0, 0, 0)),
        ("Nm J", 1.0, (1, 2, -2, 0, 0, 0)),
        ("Ncm", 1e-2, (1, 2, -2, 0, 0, 0)),
        ("Nmm", 1e-3, (1, 2, -2, 0, 0, 0)),
        ("W", 1.0, (1, 2, -3, 0, 0, 0)),
        ("Pa", 1.0, (1, -1, -2, 0, 0, 0)),
        ("bar", 1e5, (1, -1, -2, 0, 0, 0)),
        ("V", 1.0, (1, 2, -3, -1, 0, 0)),
        ("C", 1.0, (0, 0, 1, 1, 0, 0)),
        ("Ah", 3600.0, (0, 0, 1, 1, 0, 0)),
        ("F", 1.0, (-1, -2, 4, 2, 0, 0)),
        ("Ohm ohm Ω", 1.0, (1, 2, -3, -2, 0, 0)),
        ("S", 1.0, (-1, -2, 3, 2, 0, 0)),
        ("H", 1.0, (1, 2, -2, -2, 0, 0)),
        ("Wb", 1.0, (1, 2, -2, -1, 0, 0)),
        ("T", 1.0, (1, 0, -2, -1, 0, 0)),
        ("rad radian radians", 1.0, (0, 0, 0, 0, 0, 1)),
        ("deg ° degree degrees", np.pi / 180, (0, 0, 0, 0, 0, 1)),
        ("rev revs revolution revolutions turn turns", 2 * np.pi, (0, 0, 0, 0, 0, 1)),
        ("1", 1.0, (0, 0, 0, 0, 0, 0)),
        ("%", 1e-2, (0, 0, 0, 0, 0, 0)),
    )
    for unit in units.split()
}
_POWERS = {"p": -12, "n": -9, "uµμ": -6, "m": -3, "c": -2, "d": -1, "h": 2, "k": 3, "M": 6, "G": 9}
_SUPERSCRIPTS = str.maketrans({"²": "^2", "³": "^3", "⋅": "·", "⁻": "^-", "¹": "1"})  # "s⁻¹" as "s^-1"
_PREFIXES = {letter: 10.0**power for letters, power in _POWERS.items() for letter in letters}
_NO_PREFIX = "t in inch min h rpm °C degC °F degF Ncm Nmm 1 % deg ° degree degrees radian radians"
_NO_PREFIX += " rev revs revolution revolutions turn turns"
_PREFIXED = set(_UNITS) - set(_NO_PREFIX.split())
_ZEROS = {"°C": 273.15, "degC": 273.15, "°F": 255.372, "degF": 255.372}  # in K; no factor converts another zero
_AMBIGUOUS = {"g", "C", "T", "F", "h", "t"}  # may also name an acceleration, a temperature, a torque, a time
_ANGLES = {unit for unit, (_, exponents) in _UNITS.items() if exponents == (0, 0, 0, 0, 0, 1)}


def dimension(unit: str) -> tuple[int, ...] | None:
    """Return the exponents of kg, m, s, A and K of a unit; None if it is empty or not known.

    >>> dimension("N s/m"), dimension("m^3/s"), dimension("counts")
    ((1, 0, -1, 0, 0), (0, 3, -1, 0, 0), None)
    """
    found = _parse(unit)
    return None if found is None else found[1][:5]


def conversion(unit: str, wanted: str) -> float | None:
    """Return the factor that converts a unit to another: nan if there is none, None if it is not known.

    Units that differ only by an angle, such as rpm and Hz, are ambiguous: their factor counts as not known.

    >>> conversion("mm", "m"), conversion("N m", "Nm"), conversion("counts", "m"), conversion("rpm", "Hz")
    (0.001, 1.0, None, None)
    >>> conversion("V", "m"), conversion("°C", "K"), conversion("degF", "°C")
    (nan, nan, nan)
    """
    if unit.strip() == wanted.strip():
        return 1.0
    one, other = _parse(unit), _parse(wanted)
    if one is None or other is None:
        return None
    if one[1] == other[1]:
        same_zero = _ZEROS.get(unit.strip()) == _ZEROS.get(wanted.strip())
        return float(f"{one[0] / other[0]:.12g}") if same_zero else np.nan
    ambiguous = one[1][:5] == other[1][:5] or _AMBIGUOUS & {unit.strip(), wanted.strip()}
    return None if ambiguous else np.nan


def revolution_in(unit: str) -> float:
    """Return one revolution in a unit of angle; nan for any other unit.

    >>> revolution_in("deg"), revolution_in("turns"), revolution_in("rad/s"), revolution_in("m"), revolution_in("")
    (360.0, 1.0, nan, nan, nan)
    """
    found = _split_prefix(unit.strip())
    return float(f"{2 * np.pi / found[1]:.15g}") if found is not None and found[0] in _ANGLES else np.nan


def symbols(unit: str) -> list[str]:
    """Return the symbols of a unit without their prefixes.

    >>> symbols("mrad/s^2")
    ['rad', 's']
    """
    found = (_split_prefix(symbol) for symbol in re.findall(r"[^\s*/·^()\d-]+", unit))
    return [known[0] for known in found if known is not None]


def insert_units(unit: str, values: Mapping[str, str]) -> str:
    """Replace symbols of a unit by units, and collect the powers of equal symbols.

    >>> insert_units("w*s/z", {"w": "N", "z": "m"}), insert_units("w*s^3/z^3", {"w": "N m", "z": "rpm s"})
    ('N s/m', 'N m/rpm^3')
    """
    if unit in values:
        return values[unit]
    powers = dict[str, float]()
    for symbol, exponent in _factors(unit) or [(unit, 1.0)]:
        base, _, kept = symbol.partition("^")
        inserted = values.get(base, base)
        factors = None if kept else _factors(inserted)
        if factors is None:  # a symbolic power, or a quotient in brackets
            compound = {" ", "/", "*", "·"} & set(inserted)
            factors = [((f"({inserted})" if compound else inserted) + (f"^{kept}" if kept else ""), 1.0)]
        for own, power in factors:
            powers[own] = powers.get(own, 0.0) + exponent * power
    above, below = (
        [name if abs(n) == 1 else f"{name}^{abs(n):g}" for name, n in powers.items() if sign * n > 0]
        for sign in (1, -1)
    )
    if not below:
        return " ".join(above)
    return f"{' '.join(above) or 1}/{below[0] if len(below) == 1 else '(' + ' '.join(below) + ')'}"


def _factors(unit: str) -> list[tuple[str, float]] | None:
    """Split a unit into symbols and exponents; None if it is no product. A symbolic exponent stays with its symbol."""
    plain = unit.translate(_SUPERSCRIPTS)
    if re.search(r"\([^)]*/", plain):  # a quotient in brackets
        return None
    found, sign = list[tuple[str, float]](), 1.0
    for token in re.findall(r"(?:\[[^\]]*\]|[^\s*/·^()]+)(?:\^\(?[\w.-]+\)?)?|/", plain):
        symbol, _, power = token.partition("^")
        number = re.fullmatch(r"-?[\d.]+", power.strip("()"))
        if token == "/":
            sign = -1.0
        elif symbol != "1":
            found.append((symbol, sign * float(number[0])) if number else (token, sign))
    return found


def _parse(unit: str) -> tuple[float, tuple[int, ...]] | None:
    """Return a unit's size in SI and its exponents; None if it is empty or not known."""
    factors = _factors(unit)
    if factors is None or not (factors or "1" in unit):
        return None
    size, total = 1.0, np.zeros(6, int)
    for symbol, power in factors:
        found = _split_prefix(symbol)
        if found is None or not power.is_integer():
            return None
        size *= found[1] ** int(power)
        total = total + int(power) * np.array(_UNITS[found[0]][1])
    return size, tuple(total.tolist())


def _split_prefix(symbol: str) -> tuple[str, float] | None:
    """Return a symbol without its prefix, and its size in SI; None if it is not known."""
    if symbol in _UNITS:
        return symbol, _UNITS[symbol][0]
    if symbol[:1] in _PREFIXES and symbol[1:] in _PREFIXED:
        return symbol[1:], _PREFIXES[symbol[0]] * _UNITS[symbol[1:]][0]
    return None
