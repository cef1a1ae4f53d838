"""Laws that repeat with position: forces inside the dynamics, errors of a sensor or an actuator."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from .base import Law, Local, grid

FEWEST = 1.5  # smallest number of periods within the motion that is tried
SEEN = 2.0  # number of periods within the motion from which a force counts as periodic


class PeriodicForce(Law):
    """A force that repeats with position: cogging, ripple of a screw or gear (Hanselman 2006)."""

    id = "periodic_force"
    equation = "w = a sin(2 pi z / L) + b cos(2 pi z / L)"
    source = "Hanselman (2006), Brushless Permanent Magnet Motor Design, sec. 8.3"
    sentence = "a force that repeats with position, as from cogging or the pitch of a screw or gear"
    units = {"a": "w", "b": "w", "L": "z"}
    strength: ClassVar[tuple[str, ...]] = ("a", "b")

    def force(self, z: Any, p: Any) -> Any:
        angle = 2 * np.pi * z / p.L
        return p.a * ca.sin(angle) + p.b * ca.cos(angle)

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield from grid(L=2 * local.half / np.concatenate([np.arange(FEWEST, 8, 0.5), np.arange(8, 60.1, 1.0)]))

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {"L": (2 * local.half / 60, 2 * local.half / FEWEST)}

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Tell whether the motion holds fewer than two periods, which could be any other curve."""
        return bool(values["L"] > FEWEST / SEEN * self.parameters()["L"].bounds[1])


class HarmonicForce(PeriodicForce):
    """A force that repeats with position, its second harmonic included."""

    form = "harmonics"
    equation = "w = a sin(q) + b cos(q) + a_2 sin(2 q) + b_2 cos(2 q),  q = 2 pi z / L"
    units = {"a": "w", "b": "w", "a_2": "w", "b_2": "w", "L": "z"}
    strength = ("a", "b", "a_2", "b_2")

    def force(self, z: Any, p: Any) -> Any:
        twice = 4 * np.pi * z / p.L
        return super().force(z, p) + p.a_2 * ca.sin(twice) + p.b_2 * ca.cos(twice)


class Ripple(PeriodicForce):
    """An error that repeats with the signal itself: an encoder off centre, or its interpolation.

    At least three periods are tried, because fewer could be any other curve.
    """

    form = "ripple"
    source = "Heydemann (1981), Applied Optics 20(19)"
    sentence = "an error that repeats with the signal itself, as from an encoder off centre or its interpolation"
    places = ("sensor",)

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Never: at least three periods are tried."""
        return False

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield from grid(L=2 * local.half / np.arange(3.0, 60.1, 1.0))

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {"L": (2 * local.half / 60, 2 * local.half / 3)}
