"""Memoryless laws of the local coordinate: springs, contacts and gaps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from .base import Law, Local, beyond, grid


def one_sided(local: Local) -> str:
    """Give the reason why a law of both signs of z cannot be identified; empty if it can."""
    return "" if local.low < -0.05 * local.reach and local.high > 0.05 * local.reach else "one side is never visited"


def hardest(local: Local) -> tuple[float, float]:
    """Limit Hertz's strength so that its stiffness, pressed in by a tenth of the travel, is resolved by the steps."""
    k = local.stiffest / (1.5 * float(np.sqrt(0.2 * local.half)))
    return -k, k


class LinearStiffness(Law):
    """A spring, or a leak, that the simulator leaves out; a negative one is a magnet or a load that tips over."""

    id = "linear_stiffness"
    equation = "w = k_1 z"
    source = "Meirovitch (2001), Fundamentals of Vibrations, sec. 1.4"
    sentence = "a spring (or a leak): a force in proportion to the deflection"
    units = {"k_1": "w/z"}
    strength = ("k_1",)
    ranges = {"k_1": ("stiffest", -1.0, 1.0)}

    def force(self, z: Any, p: Any) -> Any:
        return p.k_1 * z


class CubicStiffness(Law):
    """Hardening (k_3 > 0) or softening spring (Duffing 1918)."""

    id = "cubic_stiffness"
    equation = "w = k_3 z^3"
    source = "Kovacic & Brennan (2011), The Duffing Equation, ch. 1"
    sentence = "a stiffness that grows (or falls) with the square of the deflection, the same in both directions"
    units = {"k_3": "w/z^3"}
    strength: ClassVar[tuple[str, ...]] = ("k_3",)

    def force(self, z: Any, p: Any) -> Any:
        return p.k_3 * z**3


class PowerStiffness(CubicStiffness):
    """A hardening spring of another power, such as a taut string or a rubber block."""

    form = "power"
    equation = "w = k_n sign(z) |z|^n"
    units = {"k_n": "w/z^n", "n": ""}
    strength = ("k_n",)
    starts = {"n": ("", 2.0, 2.5, 4.0)}
    ranges = {"n": ("", 1.7, 6.0)}

    def force(self, z: Any, p: Any) -> Any:
        return p.k_n * ca.sign(z) * (ca.fabs(z) + 1e-12) ** p.n


class GeometricStiffness(CubicStiffness):
    """A spring across the motion, such as a taut string: cubic at small and linear at large deflections."""

    form = "geometric"
    equation = "w = k z (1 - L / sqrt(L^2 + z^2))"
    source = "Nayfeh & Mook (1979), Nonlinear Oscillations, sec. 2.1"
    units = {"k": "w/z", "L": "z"}
    strength = ("k",)
    restoring = True  # with either sign it could follow any curve together with a plain spring
    starts = {"L": ("reach", 0.15, 0.4, 1.0)}
    ranges = {"L": ("reach", 0.03, 3)}

    def force(self, z: Any, p: Any) -> Any:
        return p.k * z * (1 - p.L / ca.sqrt(p.L**2 + z**2))


class QuinticStiffness(CubicStiffness):
    """A hardening spring that leaves its cubic law at large deflections."""

    form = "quintic"
    equation = "w = k_3 z^3 + k_5 z^5"
    units = {"k_3": "w/z^3", "k_5": "w/z^5"}
    strength = ("k_3", "k_5")

    def force(self, z: Any, p: Any) -> Any:
        return p.k_3 * z**3 + p.k_5 * z**5

    def applies(self, local: Local) -> str:
        # on one side alone the powers follow any curve, such as contacts and weirs
        return one_sided(local)


class QuadraticStiffness(Law):
    """A spring that is stiffer in one direction (Nayfeh & Mook 1979)."""

    id = "quadratic_stiffness"
    equation = "w = k_2 z^2"
    source = "Nayfeh & Mook (1979), Nonlinear Oscillations, sec. 4.2"
    sentence = "a stiffness that changes in proportion to the deflection, so that it is stiffer in one direction"
    units = {"k_2": "w/z^2"}
    strength = ("k_2",)

    def force(self, z: Any, p: Any) -> Any:
        return p.k_2 * z**2


class ProgressiveStiffness(QuadraticStiffness):
    """A spring that is progressively stiffer in one direction: an air spring, a bellows."""

    form = "progressive"
    equation = "w = k_2 (z^2 + b z^3)"
    source = "Nayfeh & Mook (1979), Nonlinear Oscillations, sec. 4.2"
    units = {"k_2": "w/z^2", "b": "1/z"}

    def force(self, z: Any, p: Any) -> Any:
        return p.k_2 * z**2 * (1 + p.b * z)

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield from grid(b=np.array([-0.5, 0.5]) / local.reach)

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        # the cubic part stays below the quadratic one
        return {"b": (-1 / local.reach, 1 / local.reach)}

    def applies(self, local: Local) -> str:
        return one_sided(local)


class PiecewiseStiffness(Law):
    """A contact: another spring acts beyond a point (Shaw & Holmes 1983)."""

    id = "piecewise_stiffness"
    form = "above"
    equation = "w = k_c max(z - g, 0)"
    source = "Shaw & Holmes (1983), J. Sound Vib. 90(1)"
    sentence = "a contact: beyond a point of the travel another stiffness sets in"
    units = {"k_c": "w/z", "g": "z"}
    strength = ("k_c",)

    def force(self, z: Any, p: Any) -> Any:
        return p.k_c * ca.fmax(z - p.g, 0)

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield from grid(g=local.low + 2 * local.half * np.array([0.15, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9]))

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        k = local.stiffest
        return {"g": (local.low + 0.04 * local.half, local.high - 0.04 * local.half), "k_c": (-k, k)}


class PiecewiseStiffnessBelow(PiecewiseStiffness):
    """A contact on the other side: another spring acts below a point."""

    form = "below"
    equation = "w = -k_c max(g - z, 0)"

    def force(self, z: Any, p: Any) -> Any:
        return -p.k_c * ca.fmax(p.g - z, 0)


class HertzContact(PiecewiseStiffness):
    """A contact between curved bodies (Hertz 1881)."""

    form = "hertz"
    equation = "w = k_c max(z - g, 0)^1.5"
    source = "Johnson (1985), Contact Mechanics, ch. 4"
    units = {"k_c": "w/z^1.5", "g": "z"}

    def force(self, z: Any, p: Any) -> Any:
        depth = ca.fmax(z - p.g, 0)
        return p.k_c * depth * ca.sqrt(depth + 1e-300)

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {**super().bounds(local), "k_c": hardest(local)}


class Clearance(Law):
    """A gap spring: force only beyond the clearance on either side (Shaw & Holmes 1983)."""

    id = "clearance"
    form = "symmetric"
    equation = "w = k_g (z - clip(z, -g, g))"
    source = "Shaw & Holmes (1983), J. Sound Vib. 90(1)"
    sentence = "a clearance: the spring carries load only beyond a gap on either side"
    units = {"k_g": "w/z", "g": "z"}
    strength: ClassVar[tuple[str, ...]] = ("k_g",)
    starts = {"g": ("reach", 0.03, 0.08, 0.15, 0.25, 0.35, 0.5, 0.65, 0.8)}
    ranges = {"g": ("reach", 0.001, 0.97), "k_g": ("stiffest", -1.0, 1.0)}

    def force(self, z: Any, p: Any) -> Any:
        return p.k_g * (ca.fmax(z - p.g, 0) - ca.fmax(-z - p.g, 0))

    def applies(self, local: Local) -> str:
        return one_sided(local)


class SlackSpring(Clearance):
    """A gap in line with a spring that the simulator has: within it, that spring carries nothing."""

    form = "in its own spring"
    equation = "w = -k_g clip(z, -g, g)"
    sentence = "a clearance in line with a spring of stiffness k_g that is modelled: it carries load only beyond a gap"
    restoring = True  # it reduces a modelled spring

    def force(self, z: Any, p: Any) -> Any:
        return -p.k_g * ca.fmax(ca.fmin(z, p.g), -p.g)


class SlackCoupling(SlackSpring):
    """A gap in line with a modelled spring and its damper, as between the teeth of gears."""

    form = "in its own coupling"
    equation = "w = -k_g clip(z, -g, g) - c_g dz/dt (|z| < g)"
    sentence = (
        "a clearance in line with a coupling that is modelled: its spring k_g and damper c_g act only beyond a gap"
    )
    units = {"k_g": "w/z", "c_g": "w*s/z", "g": "z"}
    strength = ("k_g", "c_g")

    def force(self, z: Any, dz: Any, p: Any) -> Any:  # type: ignore[override]
        return super().force(z, p) - p.c_g * dz * (1 - beyond(z, p.g))

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Tell whether there is no spring at all, only damping that depends on the position."""
        return not np.any(values["k_g"])


class SoftClearance(Clearance):
    """A gap between curved bodies: Hertz's contact on either side."""

    form = "hertz"
    equation = "w = k_g sign(z) max(|z| - g, 0)^1.5"
    source = "Johnson (1985), Contact Mechanics, ch. 4"
    units = {"k_g": "w/z^1.5", "g": "z"}

    def force(self, z: Any, p: Any) -> Any:
        above, below = ca.fmax(z - p.g, 0), ca.fmax(-z - p.g, 0)
        return p.k_g * (above * ca.sqrt(above + 1e-300) - below * ca.sqrt(below + 1e-300))

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {**super().bounds(local), "k_g": hardest(local)}


class OffCentreClearance(Clearance):
    """A gap that does not lie around zero."""

    form = "off-centre"
    equation = "w = k_g (z - clip(z, m - g, m + g))"
    units = {"k_g": "w/z", "g": "z", "m": "z"}

    def force(self, z: Any, p: Any) -> Any:
        return p.k_g * (ca.fmax(z - p.m - p.g, 0) - ca.fmax(p.m - z - p.g, 0))

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        middle = (local.low + local.high) / 2
        yield from grid(g=local.half * np.array([0.1, 0.3, 0.6]), m=middle + local.half * np.array([-0.3, 0.0, 0.3]))

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        k = local.stiffest
        return {"g": (1e-3 * local.half, local.half), "m": (local.low, local.high), "k_g": (-k, k)}
