"""Heat flows that are not in proportion to a temperature difference: radiation and free convection."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .base import Law, Local, signed_power

ROOM = 293.0  # temperature of the surroundings that is tried first, K
COLDEST = 150.0  # K, below which a temperature counts as a difference and not as absolute
LINEAR_RANGE = 0.05  # range over the absolute temperature within which radiation is linear


class Radiation(Law):
    """Heat that a body radiates, over its temperature above the surroundings."""

    id = "radiation"
    form = "difference"
    equation = "w = G ((z + T_a)^4 - T_a^4) / (4 T_a^3)"
    source = "Incropera et al. (2007), Fundamentals of Heat and Mass Transfer, sec. 1.2.3"
    sentence = "radiation: a heat flow that grows with the fourth power of the absolute temperature"
    units = {"G": "w/z", "T_a": "z"}
    domains = ("thermal",)
    special = True
    restoring = True  # heat flows from the warm to the cold
    starts = {"T_a": ("", ROOM)}
    ranges = {"T_a": ("", 250.0, 350.0)}  # surroundings in K

    def force(self, z: Any, p: Any) -> Any:
        return p.G * ((z + p.T_a) ** 4 - p.T_a**4) / (4 * p.T_a**3)

    def why_not(self, local: Local) -> str:
        straight = local.high - local.low < LINEAR_RANGE * ROOM
        return "the temperature stays where radiation is linear" if straight else ""


class AbsoluteRadiation(Radiation):
    """Heat that a body radiates, over its absolute temperature in K."""

    form = "absolute"
    equation = "w = G (z^4 - T_a^4) / (4 T_a^3)"

    def force(self, z: Any, p: Any) -> Any:
        return p.G * (z**4 - p.T_a**4) / (4 * p.T_a**3)

    def why_not(self, local: Local) -> str:
        return "the temperature is not absolute" if local.low < COLDEST else super().why_not(local)


class Convection(Law):
    """Heat that warm air carries upwards: the flow grows faster than the temperature difference."""

    id = "convection"
    form = "free"
    equation = "w = h sign(z) |z|^n,  n = 5/4 (laminar) to 4/3 (turbulent)"
    source = "Incropera et al. (2007), Fundamentals of Heat and Mass Transfer, sec. 9.6"
    sentence = "free convection: a heat flow that grows with a power above one of the temperature difference"
    units = {"h": "w/z^n", "n": ""}
    domains = ("thermal",)
    special = True
    restoring = True
    starts = {"n": ("", 1.25, 4 / 3)}
    ranges = {"n": ("", 1.1, 1.5)}

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Tell whether the power is at a bound, which no free convection has."""
        low, high = self.parameters()["n"].bounds
        return not low < float(values["n"]) < high

    def force(self, z: Any, p: Any) -> Any:
        return p.h * signed_power(z, p.n)
