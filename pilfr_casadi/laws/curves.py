"""Memoryless curves of an actuator or a sensor."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from .base import Law, Local, grid

STRAIGHT = 0.03  # difference of a power from one that is no curve
NARROW = 0.05  # half the range over the middle of it, below which any curve is a gain and an offset
SIDED = 0.05  # share of the reach that a signal goes to either side at least, to tell the one from the other


class Polynomial(Law):
    """A memoryless curve: quadratic and cubic terms."""

    id = "static_curve"
    form = "polynomial"
    equation = "w = a_2 z^2 + a_3 z^3"
    source = "Billings & Fakhouri (1982), Automatica 18(1)"
    sentence = "a memoryless curve: the signal is bent by its own square and cube"
    units: ClassVar[Mapping[str, str]] = {"a_2": "w/z^2", "a_3": "w/z^3"}
    strength: ClassVar[tuple[str, ...]] = ("a_2", "a_3")
    places: ClassVar[tuple[str, ...]] = ("series",)

    def force(self, z: Any, p: Any) -> Any:
        return p.a_2 * z**2 + p.a_3 * z**3

    def applies(self, local: Local) -> str:
        narrow = local.half < NARROW * abs(local.low + local.high) / 2
        return "the signal stays where any curve is straight" if narrow else ""


class Quadratic(Polynomial):
    """A memoryless curve: the square alone."""

    form = "quadratic"
    equation = "w = a_2 z^2"
    units: ClassVar[Mapping[str, str]] = {"a_2": "w/z^2"}
    strength: ClassVar[tuple[str, ...]] = ("a_2",)

    def force(self, z: Any, p: Any) -> Any:
        return p.a_2 * z**2


class Cubic(Polynomial):
    """A memoryless curve: the cube alone."""

    form = "cubic"
    equation = "w = a_3 z^3"
    units: ClassVar[Mapping[str, str]] = {"a_3": "w/z^3"}
    strength: ClassVar[tuple[str, ...]] = ("a_3",)

    def force(self, z: Any, p: Any) -> Any:
        return p.a_3 * z**3


class Magnitude(Polynomial):
    """A gain that differs between the two signs."""

    form = "magnitude"
    equation = "w = a |z|"
    units: ClassVar[Mapping[str, str]] = {"a": "w/z"}
    strength: ClassVar[tuple[str, ...]] = ("a",)
    sentence = "a memoryless curve: the gain differs between the two signs"

    def force(self, z: Any, p: Any) -> Any:
        return p.a * ca.fabs(z)

    def applies(self, local: Local) -> str:
        """On one side alone it is a gain."""
        return "" if min(-local.low, local.high) > SIDED * local.reach else "one side is hardly visited"


class Power(Polynomial):
    """A signed power, such as the square root of a flow under its own head (Torricelli)."""

    form = "power"
    equation = "w = a sign(z) |z|^n"
    source = "White (2011), Fluid Mechanics, sec. 3.5"
    sentence = "a memoryless curve: a power of the local signal, as in flow through an orifice"
    units: ClassVar[Mapping[str, str]] = {"a": "w/z^n", "n": ""}
    strength: ClassVar[tuple[str, ...]] = ("a",)

    def force(self, z: Any, p: Any) -> Any:
        return p.a * ca.sign(z) * (ca.fabs(z) + 1e-12) ** p.n

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield from grid(n=[0.4, 0.5, 0.65, 1.5, 2.5])

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {"n": (0.3, 5.0)}

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """A power of one is no curve: a gain, as from a wrong unit."""
        return bool(abs(values["n"] - 1) < STRAIGHT)


class PowerWithGain(Power):
    """A signed power beside an error of the gain, which the simulator has no parameter for."""

    form = "power with gain"
    equation = "w = a sign(z) |z|^n + b z"
    units: ClassVar[Mapping[str, str]] = {**Power.units, "b": "w/z"}
    strength: ClassVar[tuple[str, ...]] = ("a", "b")

    def force(self, z: Any, p: Any) -> Any:
        return super().force(z, p) + p.b * z


class Root(Power):
    """A power below one inside the dynamics, such as flow through an orifice under its own head."""

    form = "root"
    places: ClassVar[tuple[str, ...]] = ("parallel",)

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield from grid(n=[0.4, 0.5, 0.65])

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {"n": (0.3, 0.9)}


class Orifice(Root):
    """Flow through an orifice under its own head: laminar at first, a square root at last."""

    form = "orifice"
    restoring = True
    equation = "w = a z / (z^2 + z_t^2)^(1/4)"
    source = "Borutzky, Barnard & Thoma (2002), Simulation Modelling Practice and Theory 10"
    sentence = "a memoryless curve: flow through an orifice, laminar below z_t and turbulent beyond"
    units: ClassVar[Mapping[str, str]] = {"a": "w/z^0.5", "z_t": "z"}

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Its power is given."""
        return False

    def force(self, z: Any, p: Any) -> Any:
        return p.a * z / (z**2 + p.z_t**2) ** 0.25

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield from grid(z_t=local.reach * np.array([0.02, 0.1, 0.3]))

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {"z_t": (1e-3 * local.reach, local.reach)}
