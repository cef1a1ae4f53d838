"""Memoryless curves of an actuator or a sensor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import casadi as ca

from .base import Law, Local

STRAIGHT = 0.03  # difference of a power from one, below which it is a gain
NARROW = 0.05  # half the range over its middle, below which any curve is a gain and an offset
SIDED = 0.05  # share of the reach that a signal must visit on either side, to tell the sides apart


class Polynomial(Law):
    """A memoryless curve: quadratic and cubic terms."""

    id = "static_curve"
    form = "polynomial"
    equation = "w = a_2 z^2 + a_3 z^3"
    source = "Billings & Fakhouri (1982), Automatica 18(1)"
    sentence = "a memoryless curve: the signal is bent by its own square and cube"
    units = {"a_2": "w/z^2", "a_3": "w/z^3"}
    strength: ClassVar[tuple[str, ...]] = ("a_2", "a_3")
    places = ("series",)

    def force(self, z: Any, p: Any) -> Any:
        return p.a_2 * z**2 + p.a_3 * z**3

    def applies(self, local: Local) -> str:
        narrow = local.half < NARROW * abs(local.low + local.high) / 2
        return "the signal stays where any curve is straight" if narrow else ""


class Quadratic(Polynomial):
    """A memoryless curve: the square alone."""

    form = "quadratic"
    equation = "w = a_2 z^2"
    units = {"a_2": "w/z^2"}
    strength = ("a_2",)

    def force(self, z: Any, p: Any) -> Any:
        return p.a_2 * z**2


class Cubic(Polynomial):
    """A memoryless curve: the cube alone."""

    form = "cubic"
    equation = "w = a_3 z^3"
    units = {"a_3": "w/z^3"}
    strength = ("a_3",)

    def force(self, z: Any, p: Any) -> Any:
        return p.a_3 * z**3


class Magnitude(Polynomial):
    """A gain that differs between the two signs."""

    form = "magnitude"
    equation = "w = a |z|"
    units = {"a": "w/z"}
    strength = ("a",)
    sentence = "a memoryless curve: the gain differs between the two signs"

    def force(self, z: Any, p: Any) -> Any:
        return p.a * ca.fabs(z)

    def applies(self, local: Local) -> str:
        """Reason why the data carries no information: on one side alone it is a gain."""
        return "" if min(-local.low, local.high) > SIDED * local.reach else "one side is hardly visited"


class Power(Polynomial):
    """A signed power, such as the square root of a flow under its own head (Torricelli)."""

    form = "power"
    equation = "w = a sign(z) |z|^n"
    source = "White (2011), Fluid Mechanics, sec. 3.5"
    sentence = "a memoryless curve: a power of the local signal, as in flow through an orifice"
    units = {"a": "w/z^n", "n": ""}
    strength: ClassVar[tuple[str, ...]] = ("a",)
    starts = {"n": ("", 0.4, 0.5, 0.65, 1.5, 2.5)}
    ranges = {"n": ("", 0.3, 5.0)}

    def force(self, z: Any, p: Any) -> Any:
        return p.a * ca.sign(z) * (ca.fabs(z) + 1e-12) ** p.n

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Tell whether the power is one, which makes it a gain, as from a wrong unit."""
        return bool(abs(values["n"] - 1) < STRAIGHT)


class PowerWithGain(Power):
    """A signed power and an error of the gain, for a simulator without a gain parameter."""

    form = "power with gain"
    equation = "w = a sign(z) |z|^n + b z"
    units = {**Power.units, "b": "w/z"}
    strength = ("a", "b")

    def force(self, z: Any, p: Any) -> Any:
        return super().force(z, p) + p.b * z


class Root(Power):
    """A power below one inside the dynamics, such as flow through an orifice under its own head."""

    form = "root"
    places = ("parallel",)
    starts = {"n": ("", 0.4, 0.5, 0.65)}
    ranges = {"n": ("", 0.3, 0.9)}


class Orifice(Root):
    """Flow through an orifice under its own head: laminar at small and a square root at large signals."""

    form = "orifice"
    restoring = True
    equation = "w = a z / (z^2 + z_t^2)^(1/4)"
    source = "Borutzky, Barnard & Thoma (2002), Simulation Modelling Practice and Theory 10"
    sentence = "a memoryless curve: flow through an orifice, laminar below z_t and turbulent beyond"
    units = {"a": "w/z^0.5", "z_t": "z"}
    starts = {"z_t": ("reach", 0.02, 0.1, 0.3)}
    ranges = {"z_t": ("reach", 0.001, 1.0)}

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Never: its power is known."""
        return False

    def force(self, z: Any, p: Any) -> Any:
        return p.a * z / (z**2 + p.z_t**2) ** 0.25
