"""Memoryless forces of the local coordinate: springs, contacts, gaps, and forces that repeat with position.

The plain powers, contacts and gaps occur in all domains (a curve, an overflow, a threshold). The finer forms of springs
are mechanical, and the powers among them also describe flows. `FreeCurve` covers the other domains.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from .base import Law, Local, contact_onset, signed_power

LEAST_PERIODS = 2.0  # within the motion, from which a force counts as periodic


def _hertz_limits(local: Local) -> tuple[float, float]:
    """Limit Hertz's strength so that its stiffness, pressed in by a tenth of the travel, is resolved by the steps."""
    k = local.max_stiffness / (1.5 * float(np.sqrt(0.2 * local.half)))
    return -k, k


class LinearStiffness(Law):
    """A spring, or a leak, that the simulator leaves out; a negative one is a magnet or a load that tips over."""

    id = "linear_stiffness"
    equation = "w = k_1 z"
    source = "Meirovitch (2001), Fundamentals of Vibrations, sec. 1.4"
    sentence = "a spring (or a leak): a force in proportion to the deflection"
    sentences: ClassVar[Mapping[str, str]] = {
        "thermal": "a heat path: a heat flow in proportion to the temperature",
        "fluid": "a leak or a resistance: a term in proportion to the level, pressure or flow",
        "electrical": "a leak or a resistance: a term in proportion to the current or voltage",
    }
    units = {"k_1": "w/z"}
    ranges = {"k_1": ("max_stiffness", -1.0, 1.0)}

    def force(self, z: Any, p: Any) -> Any:
        return p.k_1 * z


class CubicStiffness(Law):
    """Hardening (k_3 > 0) or softening spring (Duffing 1918)."""

    id = "cubic_stiffness"
    equation = "w = k_3 z^3"
    source = "Kovacic & Brennan (2011), The Duffing Equation, ch. 1"
    sentence = "a stiffness that grows (or falls) with the square of the deflection, the same in both directions"
    sentences: ClassVar[Mapping[str, str]] = {
        "thermal": "a cubic loss: a heat flow that grows with the third power of the temperature",
        "fluid": "a cubic loss: a term that grows with the third power of the level, pressure or flow",
        "electrical": "a cubic characteristic: a term that grows with the third power of the current or voltage",
    }
    units = {"k_3": "w/z^3"}

    def force(self, z: Any, p: Any) -> Any:
        return p.k_3 * z**3


class PowerStiffness(CubicStiffness):
    """A hardening spring of another power, such as a taut string or a rubber block."""

    form = "power"
    equation = "w = k_n sign(z) |z|^n"
    sentence = "a force that grows with a power of the deflection, the same in both directions"
    sentences: ClassVar[Mapping[str, str]] = {
        "fluid": "a term that grows with a power of the level, pressure or flow, the same in both directions"
    }
    units = {"k_n": "w/z^n", "n": ""}
    domains = ("mechanical", "fluid")
    starts = {"n": ("", 2.0, 2.5, 4.0)}
    ranges = {"n": ("", 1.7, 6.0)}
    as_base = {"k_n": lambda own: own["k_3"], "n": 3.0}

    def force(self, z: Any, p: Any) -> Any:
        return p.k_n * signed_power(z, p.n)


class GeometricStiffness(CubicStiffness):
    """A spring across the motion, such as a taut string: cubic at small and linear at large deflections."""

    form = "geometric"
    equation = "w = k z (1 - L / sqrt(L^2 + z^2))"
    source = "Nayfeh & Mook (1979), Nonlinear Oscillations, sec. 2.1"
    units = {"k": "w/z", "L": "z"}
    domains = ("mechanical",)
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
    domains = ("mechanical", "fluid")
    two_sided = True  # on one side alone the powers follow any curve, such as contacts and weirs

    def force(self, z: Any, p: Any) -> Any:
        return super().force(z, p) + p.k_5 * z**5


class AsymmetricCubicStiffness(CubicStiffness):
    """A hardening or softening spring that differs between the directions: a suspension, a preloaded membrane."""

    form = "asymmetric"
    equation = "w = k_3 (z^3 + b z^2)"
    source = "Nayfeh & Mook (1979), Nonlinear Oscillations, sec. 4.2; Klippel (2006), J. Audio Eng. Soc. 54(10)"
    sentence = "a stiffness that grows (or falls) with the square of the deflection, not the same in both directions"
    sentences: ClassVar[Mapping[str, str]] = {
        "fluid": "a term that grows with the cube of the level, pressure or flow, not the same in both directions"
    }
    units = {"k_3": "w/z^3", "b": "z"}
    domains = ("mechanical", "fluid")
    two_sided = True
    starts = {"b": ("reach", -0.3, 0.3)}
    ranges = {"b": ("reach", -1, 1)}  # beyond that it is a quadratic force
    as_base = {"b": 0.0}

    def force(self, z: Any, p: Any) -> Any:
        return super().force(z, p) + p.k_3 * p.b * z**2


class QuadraticStiffness(Law):
    """A spring that is stiffer in one direction (Nayfeh & Mook 1979)."""

    id = "quadratic_stiffness"
    equation = "w = k_2 z^2"
    source = "Nayfeh & Mook (1979), Nonlinear Oscillations, sec. 4.2"
    sentence = "a stiffness that changes in proportion to the deflection, so that it is stiffer in one direction"
    sentences: ClassVar[Mapping[str, str]] = {
        "thermal": "a quadratic loss: a heat flow that grows with the square of the temperature",
        "fluid": "a quadratic loss: a term that grows with the square of the level, pressure or flow",
        "electrical": "a quadratic characteristic: a term that grows with the square of the current or voltage",
    }
    units = {"k_2": "w/z^2"}

    def force(self, z: Any, p: Any) -> Any:
        return p.k_2 * z**2


class ProgressiveStiffness(QuadraticStiffness):
    """A spring or a conductance that is progressively stiffer in one direction: an air spring, a junction."""

    form = "progressive"
    equation = "w = k_2 (z^2 + b z^3)"
    units = {"k_2": "w/z^2", "b": "1/z"}
    domains = ("mechanical", "fluid", "thermal")
    two_sided = True
    starts = {"b": lambda at: (-0.5 / at.reach, 0.5 / at.reach)}
    ranges = {"b": lambda at: (-1 / at.reach, 1 / at.reach)}  # the cubic part stays below the quadratic one
    as_base = {"b": 0.0}

    def force(self, z: Any, p: Any) -> Any:
        return super().force(z, p) * (1 + p.b * z)


class PiecewiseStiffness(Law):
    """A contact: another spring acts beyond a point (Shaw & Holmes 1983)."""

    id = "piecewise_stiffness"
    form = "above"
    equation = "w = k_c max(z - g, 0)"
    source = "Shaw & Holmes (1983), J. Sound Vib. 90(1)"
    sentence = "another stiffness sets in beyond a point, as of a contact"
    sentences: ClassVar[Mapping[str, str]] = {
        "thermal": "another heat path sets in beyond a temperature",
        "fluid": "another path sets in beyond a level, pressure or flow, as of a weir or a relief or check valve",
        "electrical": "another path sets in beyond a current or voltage, as of a diode",
    }
    units = {"k_c": "w/z", "g": "z"}
    starts = {"g": lambda at: at.low + 2 * at.half * np.array([0.15, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9])}
    ranges = {
        "g": lambda at: (at.low + 0.04 * at.half, at.high - 0.04 * at.half),
        "k_c": ("max_stiffness", -1.0, 1.0),
    }

    side: ClassVar[float] = 1.0  # 1 above the point, -1 below it

    def force(self, z: Any, p: Any) -> Any:
        return self.side * p.k_c * ca.fmax(self.side * (z - p.g), 0)


class PiecewiseStiffnessBelow(PiecewiseStiffness):
    """A contact on the other side: another spring acts below a point."""

    form = "below"
    equation = "w = -k_c max(g - z, 0)"
    side = -1.0


class LossyContact(PiecewiseStiffness):
    """A contact that loses energy: it presses harder while it is compressed, and never pulls (Hunt & Crossley 1975)."""

    form = "above, with loss"
    equation = "w = k_c max(z - g, 0) max(1 + b dz/dt, 0)"
    source = "Hunt & Crossley (1975), J. Appl. Mech. 42(2)"
    sentence = "a contact that loses energy: beyond a point, it presses harder while it is compressed, and never pulls"
    sentences: ClassVar[Mapping[str, str]] = {}
    units = {"k_c": "w/z", "g": "z", "b": "s/z"}
    domains = ("mechanical",)
    restoring = True  # it never pulls
    starts = {**PiecewiseStiffness.starts, "b": lambda at: (1 / at.speed,)}
    ranges = {**PiecewiseStiffness.ranges, "b": lambda at: (0.0, 10 / at.speed)}
    as_base = {"b": 0.0}

    def force(self, z: Any, dz: Any, p: Any) -> Any:  # type: ignore[override]
        return super().force(z, p) * ca.fmax(1 + self.side * p.b * dz, 0)


class LossyContactBelow(PiecewiseStiffnessBelow, LossyContact):
    """A contact that loses energy, on the other side."""

    form = "below, with loss"
    equation = "w = -k_c max(g - z, 0) max(1 - b dz/dt, 0)"
    as_base = LossyContact.as_base


class DampedContact(PiecewiseStiffness):
    """A contact with spring and damper that never pulls, as of a rubber pad; its force has no jump where it begins.

    It acts from z = g - T dz/dt on, which is a little before the point if the motion towards it is fast.
    """

    form = "above, with damper"
    equation = "w = k_c max(z - g + T dz/dt, 0)"
    source = "Brogliato (2016), Nonsmooth Mechanics, ch. 2"
    sentence = "a contact with a spring and a damper at a point, which never pulls"
    sentences: ClassVar[Mapping[str, str]] = {}
    units = {"k_c": "w/z", "g": "z", "T": "s"}
    domains = ("mechanical",)
    restoring = True  # it never pulls
    starts = {**PiecewiseStiffness.starts, "T": lambda at: (0.1 * at.half / at.speed,)}
    ranges = {**PiecewiseStiffness.ranges, "T": lambda at: (0.0, at.half / at.speed)}
    as_base = {"T": 0.0}

    def force(self, z: Any, dz: Any, p: Any) -> Any:  # type: ignore[override]
        return super().force(z + p.T * dz, p)


class DampedContactBelow(PiecewiseStiffnessBelow, DampedContact):
    """A contact with spring and damper, on the other side."""

    form = "below, with damper"
    equation = "w = -k_c max(g - z - T dz/dt, 0)"
    as_base = DampedContact.as_base


class HertzContact(PiecewiseStiffness):
    """A contact between curved bodies (Hertz 1881)."""

    form = "hertz"
    equation = "w = k_c max(z - g, 0)^1.5"
    source = "Johnson (1985), Contact Mechanics, ch. 4"
    units = {"k_c": "w/z^1.5", "g": "z"}
    domains = ("mechanical", "fluid")  # the flow over a weir grows with the same power of the head
    ranges = {**PiecewiseStiffness.ranges, "k_c": _hertz_limits}

    def force(self, z: Any, p: Any) -> Any:
        depth = ca.fmax(z - p.g, 0)
        return p.k_c * depth * ca.sqrt(depth + 1e-300)


class Clearance(Law):
    """A gap spring: force only beyond the clearance on either side (Shaw & Holmes 1983)."""

    id = "clearance"
    form = "symmetric"
    equation = "w = k_g (z - clip(z, -g, g))"
    source = "Shaw & Holmes (1983), J. Sound Vib. 90(1)"
    sentence = "a clearance: the spring carries load only beyond a gap on either side"
    sentences: ClassVar[Mapping[str, str]] = {
        "fluid": "a dead zone: the path opens only beyond a level, pressure or flow on either side",
        "electrical": "a dead zone: the path opens only beyond a current or voltage on either side",
    }
    units = {"k_g": "w/z", "g": "z"}
    absent = ("thermal",)  # heat flows at any difference
    two_sided = True
    starts = {"g": ("reach", 0.03, 0.08, 0.15, 0.25, 0.35, 0.5, 0.65, 0.8)}
    ranges = {"g": ("reach", 0.001, 0.97), "k_g": ("max_stiffness", -1.0, 1.0)}

    def force(self, z: Any, p: Any) -> Any:
        return p.k_g * (ca.fmax(z - p.g, 0) - ca.fmax(-z - p.g, 0))


class SaturatingSpring(Law):
    """A modelled spring whose force approaches a limit, such as the lateral force of a tyre over its slip angle."""

    id = "saturation"
    form = "of a force"
    equation = "w = -k_s (z - L tanh(z / L))"
    source = "Pacejka (2012), Tire and Vehicle Dynamics, ch. 1"
    sentence = "a force that saturates: of the modelled spring, k_s z does not grow beyond k_s L"
    units = {"k_s": "w/z", "L": "z"}
    domains = ("mechanical",)
    restoring = True  # it reduces a modelled spring
    starts = {"L": ("reach", 0.3, 0.6, 1.0)}
    ranges = {"L": ("reach", 0.05, 3.0), "k_s": ("max_stiffness", -1.0, 1.0)}

    def force(self, z: Any, p: Any) -> Any:
        return -p.k_s * (z - p.L * ca.tanh(z / p.L))


class SlackSpring(Clearance):
    """A gap in line with a spring that the simulator has: within it, that spring carries nothing."""

    form = "in its own spring"
    equation = "w = -k_g clip(z, -g, g)"
    sentence = "a clearance in line with a spring of stiffness k_g that is modelled: it carries load only beyond a gap"
    sentences: ClassVar[Mapping[str, str]] = {
        "fluid": "a dead zone: a modelled path k_g opens only beyond a level, pressure or flow on either side",
        "electrical": "a dead zone: a modelled path k_g opens only beyond a current or voltage on either side",
    }
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

    def force(self, z: Any, dz: Any, p: Any) -> Any:  # type: ignore[override]
        return super().force(z, p) - p.c_g * dz * (1 - contact_onset(z, p.g))

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Tell whether there is no spring at all, only damping that depends on the position."""
        return not np.any(values["k_g"])


class SoftClearance(Clearance):
    """A gap between curved bodies: Hertz's contact on either side."""

    form = "hertz"
    equation = "w = k_g sign(z) max(|z| - g, 0)^1.5"
    source = "Johnson (1985), Contact Mechanics, ch. 4"
    units = {"k_g": "w/z^1.5", "g": "z"}
    domains = ("mechanical",)
    ranges = {**Clearance.ranges, "k_g": _hertz_limits}

    def force(self, z: Any, p: Any) -> Any:
        above, below = ca.fmax(z - p.g, 0), ca.fmax(-z - p.g, 0)
        return p.k_g * (above * ca.sqrt(above + 1e-300) - below * ca.sqrt(below + 1e-300))


class OffCentreClearance(Clearance):
    """A gap that does not lie around zero."""

    form = "off-centre"
    equation = "w = k_g (z - clip(z, m - g, m + g))"
    units = {"k_g": "w/z", "g": "z", "m": "z"}
    starts = {"g": ("half", 0.1, 0.3, 0.6), "m": lambda at: at.middle + at.half * np.array([-0.3, 0.0, 0.3])}
    ranges = {"g": ("half", 1e-3, 1.0), "m": lambda at: (at.low, at.high), "k_g": ("max_stiffness", -1.0, 1.0)}
    as_base = {"m": 0.0}

    def force(self, z: Any, p: Any) -> Any:
        return p.k_g * (ca.fmax(z - p.m - p.g, 0) - ca.fmax(p.m - z - p.g, 0))


def _periods(local: Local) -> np.ndarray:
    """Periods to try: parts of the travel, and one revolution where a shaft turns more often than that."""
    parts = 2 * local.half / np.concatenate([np.arange(1.5, 8, 0.5), np.arange(8, 60.1, 1.0)])
    return np.append(parts, local.revolution) if local.revolution < parts[-1] else parts


def _wave(z: Any, p: Any) -> Any:
    """Compute a wave of the period L from its two amplitudes."""
    angle = 2 * np.pi * z / p.L
    return p.a * ca.sin(angle) + p.b * ca.cos(angle)


class PeriodicForce(Law):
    """A force that repeats with position: cogging, ripple of a screw or gear (Hanselman 2006)."""

    id = "periodic_force"
    flexible = True
    equation = "w = a sin(2 pi z / L) + b cos(2 pi z / L)"
    source = "Hanselman (2006), Brushless Permanent Magnet Motor Design, sec. 8.3"
    sentence = "a force that repeats with position, as from cogging or the pitch of a screw or gear"
    units = {"a": "w", "b": "w", "L": "z"}
    domains = ("mechanical",)
    min_periods = 1.5  # smallest number of periods within the motion that is tried
    starts = {"L": _periods}

    def force(self, z: Any, p: Any) -> Any:
        return _wave(z, p)

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        least = np.nanmin([2 * local.half / 60, local.revolution])
        return {"L": (least, 2 * local.half / self.min_periods)}

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Tell whether the motion covers fewer than two periods; the force could then be any other curve."""
        return bool(values["L"] > self.min_periods / LEAST_PERIODS * self.parameters()["L"].bounds[1])


class HarmonicForce(PeriodicForce):
    """A force that repeats with position, its second harmonic included."""

    form = "harmonics"
    equation = "w = a sin(q) + b cos(q) + a_2 sin(2 q) + b_2 cos(2 q),  q = 2 pi z / L"
    units = {"a": "w", "b": "w", "a_2": "w", "b_2": "w", "L": "z"}

    def force(self, z: Any, p: Any) -> Any:
        twice = 4 * np.pi * z / p.L
        return super().force(z, p) + p.a_2 * ca.sin(twice) + p.b_2 * ca.cos(twice)


class Ripple(PeriodicForce):
    """An error that repeats with the signal itself: an encoder off centre, or its interpolation."""

    form = "ripple"
    source = "Heydemann (1981), Applied Optics 20(19)"
    sentence = "an error that repeats with the signal itself, as from an encoder off centre or its interpolation"
    places = ("sensor",)
    min_periods = 3.0
    starts = {"L": lambda at: 2 * at.half / np.arange(3.0, 60.1, 1.0)}


class _Gravity(Law):
    """Gravity over the angle of a swinging arm; the unit of the angle gives its revolution L."""

    id = "gravity"
    source = "Siciliano et al. (2009), Robotics: Modelling, Planning and Control, sec. 7.3"
    domains = ("mechanical",)
    angular = True
    starts = {"L": lambda at: [L for L in (at.revolution,) if np.isfinite(L)]}
    constants = ("L",)
    least_turn: ClassVar[float] = 0.0  # share of a revolution within the motion, below which it is another curve

    def why_not(self, local: Local) -> str:
        known = 2 * local.half > self.least_turn * local.revolution  # not if the revolution is not known
        return "" if known else "the motion is not a good part of one revolution"


class Gravity(_Gravity):
    """Gravity on a swinging arm beyond small angles, where the equations have the sine's slope at zero only."""

    form = "beyond small angles"
    equation = "w = a (sin(q) - q),  q = 2 pi z / L,  L one revolution"
    sentence = "gravity on a swinging arm: a torque in proportion to the sine of the angle, not to the angle"
    units = {"a": "w", "L": "z"}
    least_turn = 0.25  # a cubic curve below

    def force(self, z: Any, p: Any) -> Any:
        q = 2 * np.pi * z / p.L
        return p.a * (ca.sin(q) - q)


class WholeGravity(_Gravity):
    """Gravity on an arm whose equations have none; the arm may hang at any angle."""

    equation = "w = a sin(q) + b cos(q),  q = 2 pi z / L,  L one revolution"
    sentence = "gravity on a swinging arm: a torque in proportion to the sine of its angle to the vertical"
    units = {"a": "w", "b": "w", "L": "z"}
    least_turn = 0.1  # a straight line below

    def force(self, z: Any, p: Any) -> Any:
        return _wave(z, p)


class Unbalance(_Gravity):
    """The centrifugal force of an eccentric rotor, along a fixed direction."""

    id = "periodic_force"
    form = "unbalance"
    equation = "w = (dz/dt)^2 (a sin(q) + b cos(q)),  q = 2 pi z / L,  L one revolution"
    source = "Genta (2005), Dynamics of Rotating Systems, ch. 2"
    sentence = "the force of an unbalanced rotor: it turns with the rotor and grows with the square of its speed"
    units = {"a": "w*s^2/z^2", "b": "w*s^2/z^2", "L": "z"}
    least_turn = 1.0  # less is a curve of the angle

    def force(self, z: Any, dz: Any, p: Any) -> Any:
        return dz**2 * _wave(z, p)
