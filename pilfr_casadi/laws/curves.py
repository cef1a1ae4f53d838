"""Memoryless curves of an actuator or a sensor: gain, powers, saturation and dead zone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from ..models import Parameter
from .base import Law, Local, continue_along_tangents, signed_power, size_to_power

LINEAR_POWER = 0.03  # difference of a power from one, below which it is a gain
NARROW_RANGE = 0.05  # half the range over its middle, below which any curve is a gain and an offset


class Gain(Law):
    """A wrong gain: a calibration, or a constant of the equations that scales the signal."""

    id = "gain"
    equation = "w = g z"
    source = "Ljung (1999), System Identification, sec. 4.2"
    sentence = (
        "a wrong gain: the signal passes times 1 + g, as after a wrong calibration, or with a wrong constant in the "
        "equations that scales it, such as a mass"
    )
    units = {"g": "w/z"}
    places = ("series",)

    def force(self, z: Any, p: Any) -> Any:
        return p.g * z


class Polynomial(Law):
    """A memoryless curve: quadratic and cubic terms."""

    id = "static_curve"
    flexible = True
    form = "polynomial"
    equation = "w = a_2 z^2 + a_3 z^3"
    source = "Billings & Fakhouri (1982), Automatica 18(1)"
    sentence = "a memoryless curve: the signal is bent by its own square and cube"
    units = {"a_2": "w/z^2", "a_3": "w/z^3"}
    places = ("series",)

    def force(self, z: Any, p: Any) -> Any:
        return p.a_2 * z**2 + p.a_3 * z**3

    def why_not(self, local: Local) -> str:
        narrow = local.half < NARROW_RANGE * abs(local.low + local.high) / 2
        return "the signal stays where any curve is straight" if narrow else super().why_not(local)


class Quadratic(Polynomial):
    """A memoryless curve: the square alone."""

    form = "quadratic"
    equation = "w = a_2 z^2"
    units = {"a_2": "w/z^2"}

    def force(self, z: Any, p: Any) -> Any:
        return p.a_2 * z**2


class Cubic(Polynomial):
    """A memoryless curve: the cube alone."""

    form = "cubic"
    equation = "w = a_3 z^3"
    units = {"a_3": "w/z^3"}

    def force(self, z: Any, p: Any) -> Any:
        return p.a_3 * z**3


class Magnitude(Polynomial):
    """A gain that differs between the two signs."""

    form = "magnitude"
    equation = "w = a |z|"
    units = {"a": "w/z"}
    sentence = "a memoryless curve: the gain differs between the two signs"
    two_sided = True  # on one side alone it is a gain

    def force(self, z: Any, p: Any) -> Any:
        return p.a * ca.fabs(z)


class Rectified(Polynomial):
    """A sensor that does not measure the sign of its signal, such as a pulse counter, with a power and an offset."""

    form = "rectified"
    equation = "w = |z|^n + b - z"
    source = "Wigren & Schoukens (2017), Uppsala University, Tech. Rep. 2017-024"
    sentence = "a memoryless curve: the sensor does not see the sign of its signal"
    units = {"n": "", "b": "z"}
    strength = ()
    starts = {"n": ("", 1.0, 1.5), "b": ("", 0.0)}
    ranges = {"n": ("", 0.3, 3.0), "b": ("reach", -0.5, 0.5)}
    places = ("sensor",)
    two_sided = True  # on one side alone it is a power

    def force(self, z: Any, p: Any) -> Any:
        return size_to_power(z, p.n) + p.b - z


class Power(Polynomial):
    """A signed power, such as the square root of a flow under its own head (Torricelli)."""

    form = "power"
    equation = "w = a sign(z) |z|^n"
    source = "White (2011), Fluid Mechanics, sec. 3.5"
    sentence = "a memoryless curve: a power of the local signal, as in flow through an orifice"
    units = {"a": "w/z^n", "n": ""}
    starts = {"n": ("", 0.4, 0.5, 0.65, 1.5, 2.5)}
    ranges = {"n": ("", 0.3, 5.0)}

    def force(self, z: Any, p: Any) -> Any:
        return p.a * signed_power(z, p.n)

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Tell whether the power is about one, so that it is a gain, as from a wrong unit."""
        return bool(abs(values["n"] - 1) < LINEAR_POWER)


class PowerWithGain(Power):
    """A signed power and an error of the gain, for a simulator without a gain parameter."""

    form = "power with gain"
    equation = "w = a sign(z) |z|^n + b z"
    units = {**Power.units, "b": "w/z"}

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
    equation = "w = a z / (z^2 + z_t^2)^(1/4)"
    source = "Borutzky, Barnard & Thoma (2002), Simulation Modelling Practice and Theory 10"
    sentence = "a memoryless curve: flow through an orifice, laminar below z_t and turbulent beyond"
    units = {"a": "w/z^0.5", "z_t": "z"}
    restoring = True
    starts = {"z_t": ("reach", 0.02, 0.1, 0.3)}
    ranges = {"z_t": ("reach", 0.001, 1.0)}

    def force(self, z: Any, p: Any) -> Any:
        return p.a * z / (z**2 + p.z_t**2) ** 0.25

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Never: its power is known."""
        return False


class Exponential(Polynomial):
    """An exponential of the signal, such as an equal-percentage valve or a thermistor, from zero to its end R."""

    form = "exponential"
    equation = "w = R (exp(c u) - 1) / (exp(c R) - 1) - u"
    source = (
        "Liptak (2006), Instrument Engineers' Handbook, vol. 2, ch. 6; Steinhart & Hart (1968), Deep-Sea Res. 15(4)"
    )
    sentence = "a memoryless curve: the gain grows exponentially with the signal, as of an equal-percentage valve"
    units = {"c": "1/z", "R": "z"}
    strength = ()
    domains = ("thermal", "electrical", "fluid")
    special = True
    starts = {
        "c": lambda at: np.array([-3.0, -1.0, 1.0, 3.0]) / at.reach,
        "R": lambda at: (at.high if at.high > -at.low else at.low,),
    }
    ranges = {"c": lambda at: (-8.0 / at.reach, 8.0 / at.reach)}
    constants = ("R",)

    def force(self, z: Any, p: Any) -> Any:
        return p.R * (ca.exp(p.c * z) - 1) / (ca.exp(p.c * p.R) - 1) - z


class FreeCurve(Law):
    """A smooth curve through zero of a shape that no formula has, such as an open-circuit voltage over the charge."""

    id = "static_curve"
    flexible = True
    form = "free"
    equation = (
        "w = sum_i c_i (T_i(x) - T_i(x_0)),  i = 2..9,  x = (z - z_m) / z_h,  x_0 = -z_m / z_h; "
        "T_i along its tangents outside -1 <= x <= 1"
    )
    source = "Plett (2015), Battery Management Systems, vol. 1, sec. 2.2; Press et al. (2007), sec. 5.8"
    sentence = "a memoryless curve of a shape that no formula has"
    units = {"c": "w", "z_m": "z", "z_h": "z"}
    strength: ClassVar[tuple[str, ...]] = ("c",)
    constants: ClassVar[tuple[str, ...]] = ("z_m", "z_h")
    domains = ("electrical", "fluid")
    special = True
    degrees = tuple(range(2, 10))  # an offset and a slope are parameters of the simulator; nine follow a narrow knee

    def force(self, z: Any, p: Any) -> Any:
        def terms(x: Any) -> tuple[list[Any], list[Any]]:
            polynomials = chebyshev(x, max(self.degrees))
            slopes_at_ends = [i**2 * (x if i % 2 == 0 else 1.0) for i in self.degrees]
            return [polynomials[i] for i in self.degrees], slopes_at_ends

        at_z, at_zero = (continue_along_tangents((one - p.z_m) / p.z_h, -1.0, 1.0, terms) for one in (z, 0.0))
        return sum(p.c[k] * (at_z[k] - at_zero[k]) for k in range(len(self.degrees)))

    def parameters(self) -> dict[str, Parameter]:
        """Coefficients, one for each degree, and the middle and half of the range."""
        out = super().parameters()
        return {**out, "c": replace(out["c"], value=np.broadcast_to(out["c"].value, len(self.degrees)))}

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield {"z_m": (local.low + local.high) / 2, "z_h": max((local.high - local.low) / 2, 1e-300)}


class SteepCurve(FreeCurve):
    """A free curve with an exponential at one end, such as the open-circuit voltage of a cell that runs empty."""

    form = "free with a steep end"
    equation = (
        "w = sum_i c_i (T_i(x) - T_i(x_0)) + a (L(x) - L(x_0)),  L(x) = exp(-(1 + s x) / e),  i = 2..9, "
        "x = (z - z_m) / z_h,  x_0 = -z_m / z_h; T_i along its tangents outside -1 <= x <= 1, L where 1 + s x < 0"
    )
    source = "Chen & Rincon-Mora (2006), IEEE Trans. Energy Convers. 21(2)"
    sentence = "a memoryless curve of a shape that no formula has, steep at one end"
    units = {**FreeCurve.units, "a": "w", "e": "", "s": ""}
    strength = (*FreeCurve.strength, "a")
    constants = (*FreeCurve.constants, "s")  # -1 if the steep end is that of large z
    starts = {"e": ("", 0.02, 0.1), "s": ("", 1.0, -1.0)}
    ranges = {"e": ("", 0.001, 0.5)}

    def force(self, z: Any, p: Any) -> Any:
        def steep(x: Any) -> Any:
            beyond = 1 + p.s * x
            return ca.exp(-ca.fmax(beyond, 0.0) / p.e) - ca.fmin(beyond, 0.0) / p.e

        at_z, at_zero = (steep((one - p.z_m) / p.z_h) for one in (z, 0.0))
        return super().force(z, p) + p.a * (at_z - at_zero)

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        for range_of_z in super().shapes(local):
            yield from (shape | range_of_z for shape in Law.shapes(self, local))

    @classmethod
    def finer_starts(cls, found: Law, local: Local) -> Iterator[dict[str, Any]]:
        """Start at either end of a free curve that was found."""
        yield from ({**shape, **found.values, "a": 0.0} for shape in cls().shapes(local))


def chebyshev(x: Any, degree: int) -> list[Any]:
    """Compute the Chebyshev polynomials of the first kind, from degree 0 to `degree`."""
    out = [1.0, x]
    for _ in range(degree - 1):
        out.append(2 * x * out[-1] - out[-2])
    return out


class Saturation(Law):
    """A hard limit, the same on both sides."""

    id = "saturation"
    form = "symmetric"
    equation = "w = clip(u, -L, L) - u"
    source = "Khalil (2002), Nonlinear Systems, sec. 1.2"
    sentence = "saturation: beyond a limit the signal does not follow any more"
    units = {"L": "z"}
    places = ("series",)
    starts = {"L": ("reach", 0.3, 0.45, 0.6, 0.75, 0.9)}
    ranges = {"L": ("reach", 0.1, 0.995)}

    def force(self, z: Any, p: Any) -> Any:
        return ca.fmax(ca.fmin(z, p.L), -p.L) - z


class AsymmetricSaturation(Saturation):
    """A hard limit on either side."""

    form = "asymmetric"
    equation = "w = clip(u, low, high) - u"
    units = {"low": "z", "high": "z"}
    starts = {
        "low": lambda at: at.middle - at.half * np.array([0.5, 0.75, 0.97]),
        "high": lambda at: at.middle + at.half * np.array([0.5, 0.75, 0.97]),
    }
    ranges = {
        "low": lambda at: (at.low - 0.1 * at.half, at.middle),
        "high": lambda at: (at.middle, at.high + 0.1 * at.half),
    }
    as_base = {"low": lambda own: -own["L"], "high": lambda own: own["L"]}

    def force(self, z: Any, p: Any) -> Any:
        return ca.fmax(ca.fmin(z, p.high), p.low) - z


class SoftSaturation(Saturation):
    """A limit that is approached gradually."""

    form = "soft"
    equation = "w = L tanh(u / L) - u"
    starts = {"L": ("reach", 0.3, 0.6, 1.0, 2.0)}
    ranges = {"L": ("reach", 0.1, 10)}

    def force(self, z: Any, p: Any) -> Any:
        return p.L * ca.tanh(z / p.L) - z


class GradualSaturation(Saturation):
    """A limit whose knee may be sharp or wide."""

    form = "gradual"
    equation = "w = u / (1 + |u / L|^n)^(1/n) - u"
    units = {"L": "z", "n": ""}
    starts = {"L": ("reach", 0.5, 1.0, 2.0), "n": ("", 1.0, 2.0, 5.0)}
    ranges = {"L": ("reach", 0.1, 20), "n": ("", 0.7, 12.0)}

    def force(self, z: Any, p: Any) -> Any:
        return z * ca.exp(-ca.log(1 + size_to_power(z / p.L, p.n, 1e-9)) / p.n) - z


class SkewSaturation(AsymmetricSaturation):
    """A limit on either side that is approached gradually."""

    form = "soft asymmetric"
    equation = "w = L tanh(u / L) - u,  L = L_1 below zero and L_2 above"
    units = {"L_1": "z", "L_2": "z"}
    starts = dict.fromkeys(units, ("reach", 0.4, 0.9, 2.0))
    ranges = dict.fromkeys(units, ("reach", 0.1, 20))

    def force(self, z: Any, p: Any) -> Any:
        up, down = ca.fmax(z, 0), ca.fmin(z, 0)
        return p.L_2 * ca.tanh(up / p.L_2) + p.L_1 * ca.tanh(down / p.L_1) - z


class DeadZone(Law):
    """Small signals have no effect."""

    id = "dead_zone"
    form = "symmetric"
    equation = "w = -clip(u, -g, g)"
    source = "Khalil (2002), Nonlinear Systems, sec. 1.2"
    sentence = "a dead zone: small signals have no effect"
    units = {"g": "z"}
    places = ("series",)
    rare = ("sensor",)  # sensors show small signals; friction in front of one looks like this while it slips
    starts = {"g": ("reach", 0.02, 0.06, 0.12, 0.25, 0.4)}
    ranges = {"g": ("reach", 0.001, 0.8)}

    def force(self, z: Any, p: Any) -> Any:
        return -ca.fmax(ca.fmin(z, p.g), -p.g)

    def why_not(self, local: Local) -> str:
        return "" if np.min(np.abs(local.z)) < 0.1 * local.reach else "the signal is never small"


class AsymmetricDeadZone(DeadZone):
    """A dead zone that reaches further on one side."""

    form = "asymmetric"
    equation = "w = -clip(u, -g_1, g_2)"
    units = {"g_1": "z", "g_2": "z"}
    starts = dict.fromkeys(units, ("reach", 0.02, 0.15, 0.35))
    ranges = dict.fromkeys(units, ("reach", 0.0, 0.8))
    as_base = dict.fromkeys(units, lambda own: own["g"])

    def force(self, z: Any, p: Any) -> Any:
        return -ca.fmax(ca.fmin(z, p.g_2), -p.g_1)

    def why_not(self, local: Local) -> str:
        return "" if local.low < 0 < local.high else "one side is never visited"
