"""Electrical laws: diodes and electrodes, and coils that saturate."""

from __future__ import annotations

from typing import Any

import casadi as ca

from .base import Law, Local

SHARPEST_KNEE = 0.005  # smallest width of a knee that is tried, over the largest |z|


class _Electrical(Law):
    """A law that is tried at electrical ports only; its local coordinate is a current."""

    domains = ("electrical",)
    special = True
    across = "A"


class _ElectricalCurve(_Electrical):
    """A static curve, current over voltage or voltage over current, of a part that takes power."""

    id = "static_curve"
    restoring = True


class Diode(_ElectricalCurve):
    """A junction that conducts in one direction, with its series resistance 1 / G (Shockley 1949)."""

    form = "diode"
    equation = "w = G V_T (s(z) - s(0)),  s(z) = ln(1 + exp((z - V_0) / V_T))"
    source = "Sze & Ng (2007), Physics of Semiconductor Devices, sec. 2.3; Enz et al. (1995)"
    sentence = "a diode: a current that grows exponentially with the voltage, from about V_0 on in proportion to it"
    units = {"G": "w/z", "V_0": "z", "V_T": "z"}
    across = "V"
    starts = {"V_0": ("reach", 0.1, 0.2, 0.35, 0.6, 0.9), "V_T": ("reach", 0.02, 0.08)}
    ranges = {"G": ("max_stiffness", -1.0, 1.0), "V_0": ("reach", 0.01, 1.5), "V_T": ("reach", SHARPEST_KNEE, 0.5)}

    def force(self, z: Any, p: Any) -> Any:
        return p.G * p.V_T * (_rise((z - p.V_0) / p.V_T) - _rise(-p.V_0 / p.V_T))

    def why_not(self, local: Local) -> str:
        return "" if local.high > 0 else "the voltage is never positive"


class ReversedDiode(Diode):
    """A junction that conducts in the other direction."""

    form = "reversed diode"
    equation = "w = -G V_T (s(-z) - s(0)),  s(z) = ln(1 + exp((z - V_0) / V_T))"

    def force(self, z: Any, p: Any) -> Any:
        return -super().force(-z, p)

    def why_not(self, local: Local) -> str:
        return "" if local.low < 0 else "the voltage is never negative"


class Clamp(Diode):
    """Two junctions back to back, such as a clamp of a voltage or a varistor."""

    form = "clamp"
    equation = "w = G V_T (s(z) - s(-z)),  s(z) = ln(1 + exp((z - V_0) / V_T))"
    sentence = "a clamp: a current that grows exponentially with the voltage in both directions, beyond about V_0"
    two_sided = True

    def force(self, z: Any, p: Any) -> Any:
        return super().force(z, p) - super().force(-z, p)

    def why_not(self, local: Local) -> str:
        return Law.why_not(self, local)


def _rise(x: Any) -> Any:
    """Compute ln(1 + exp(x)) without overflow."""
    return ca.fmax(x, 0) + ca.log1p(ca.exp(-ca.fabs(x)))


class Overpotential(_ElectricalCurve):
    """Voltage across a reaction at an electrode, or a junction: the inverse of the exponential (Butler-Volmer)."""

    form = "overpotential"
    equation = "w = V_a asinh(z / I_0)"
    source = "Newman & Thomas-Alyea (2004), Electrochemical Systems, ch. 8"
    sentence = "an overpotential: a voltage that grows with the logarithm of a large current"
    units = {"V_a": "w", "I_0": "z"}
    starts = {"I_0": ("reach", 0.003, 0.02, 0.1, 0.4)}
    ranges = {"I_0": ("reach", 1e-4, 2.0)}

    def force(self, z: Any, p: Any) -> Any:
        return p.V_a * ca.asinh(z / p.I_0)


class VoltageDrop(_ElectricalCurve):
    """Voltage across a contact or a switch at any current, as of brushes or by the dead time of a bridge."""

    form = "voltage drop"
    equation = "w = V_d tanh(z / I_0)"
    source = "Choi & Sul (1996), IEEE Trans. Power Electron. 11(2)"
    sentence = "a voltage drop that opposes the current and hardly grows with it, as of brushes or a bridge's dead time"
    units = {"V_d": "w", "I_0": "z"}
    two_sided = True
    starts = {"I_0": ("reach", 0.01, 0.05, 0.2)}
    ranges = {"I_0": ("reach", 1e-4, 0.5)}

    def force(self, z: Any, p: Any) -> Any:
        return p.V_d * ca.tanh(z / p.I_0)


class SaturatingInductance(_Electrical):
    """A coil whose core saturates: its inductance falls with the current."""

    id = "saturating_inductance"
    equation = "w = -L_s dz/dt q / (1 + q),  q = (z / I_s)^2"
    source = "Chua & Stromsmoe (1970), IEEE Trans. Circuit Theory 17(4); Boldea & Nasar (2010)"
    sentence = "a saturating inductance: the current changes faster as it grows, because the core carries no more flux"
    units = {"L_s": "w*s/z", "I_s": "z"}
    starts = {"I_s": ("reach", 0.2, 0.5, 1.0, 2.0)}
    ranges = {"I_s": ("reach", 0.05, 5.0), "L_s": ("", 0.0, float("inf"))}

    def force(self, z: Any, dz: Any, p: Any) -> Any:
        q = (z / p.I_s) ** 2
        return -p.L_s * dz * q / (1 + q)
