"""Electrical laws: diodes and electrodes, and coils that saturate."""

from __future__ import annotations

from typing import Any

import casadi as ca

from .base import Law

STEEPEST = 25.0  # largest |z| / V_T that is tried: a current over e^25 decides nothing at smaller voltages
LARGEST = 40.0  # exponent above which an exponential goes on as its tangent, so that a trial step stays finite


def _exponential(x: Any) -> Any:
    """Exponential minus one, with its tangent beyond `LARGEST`."""
    inside = ca.fmin(x, LARGEST)
    return ca.exp(inside) * (1 + x - inside) - 1


class Diode(Law):
    """A junction that conducts in one direction (Shockley 1949)."""

    id = "static_curve"
    form = "diode"
    equation = "w = I_s (exp(z / V_T) - 1)"
    source = "Sze & Ng (2007), Physics of Semiconductor Devices, sec. 2.3"
    sentence = "a diode: a current that grows exponentially with the voltage in one direction"
    units = {"I_s": "w", "V_T": "z"}
    domains = ("electrical",)
    special = True
    restoring = True  # power flows into it
    starts = {"V_T": lambda at: tuple(abs(at.high) / n for n in (2.0, 4.0, 7.0, 12.0, 20.0))}
    ranges = {"V_T": ("reach", 1 / STEEPEST, 2.0)}

    def force(self, z: Any, p: Any) -> Any:
        return p.I_s * _exponential(z / p.V_T)


class ReversedDiode(Diode):
    """A junction that conducts in the other direction."""

    form = "reversed diode"
    equation = "w = -I_s (exp(-z / V_T) - 1)"
    starts = {"V_T": lambda at: tuple(abs(at.low) / n for n in (2.0, 4.0, 7.0, 12.0, 20.0))}

    def force(self, z: Any, p: Any) -> Any:
        return -super().force(-z, p)


class Clamp(Diode):
    """Two junctions back to back, such as a clamp of a voltage or a varistor."""

    form = "clamp"
    equation = "w = I_s (exp(z / V_T) - exp(-z / V_T))"
    sentence = "a clamp: a current that grows exponentially with the voltage in both directions"
    two_sided = True
    starts = {"V_T": lambda at: tuple(at.reach / n for n in (2.0, 4.0, 7.0, 12.0, 20.0))}

    def force(self, z: Any, p: Any) -> Any:
        return super().force(z, p) - super().force(-z, p)


class Overpotential(Law):
    """Voltage that a reaction at an electrode takes, or a junction: its inverse is the exponential (Butler-Volmer)."""

    id = "static_curve"
    form = "overpotential"
    equation = "w = V_a asinh(z / I_0)"
    source = "Newman & Thomas-Alyea (2004), Electrochemical Systems, ch. 8"
    sentence = "an overpotential: a voltage that grows with the logarithm of a large current"
    units = {"V_a": "w", "I_0": "z"}
    domains = ("electrical",)
    special = True
    restoring = True
    starts = {"I_0": ("reach", 0.003, 0.02, 0.1, 0.4)}
    ranges = {"I_0": ("reach", 1e-4, 2.0)}

    def force(self, z: Any, p: Any) -> Any:
        return p.V_a * ca.asinh(z / p.I_0)


class SaturatingInductance(Law):
    """A coil whose core saturates: its inductance falls with the current."""

    id = "saturating_inductance"
    equation = "w = -L_s dz/dt q / (1 + q),  q = (z / I_s)^2"
    source = "Chua & Stromsmoe (1970), IEEE Trans. Circuit Theory 17(4); Boldea & Nasar (2010), ch. 5"
    sentence = "a saturating inductance: the current changes faster as it grows, because the core carries no more flux"
    units = {"L_s": "w*s/z", "I_s": "z"}
    domains = ("electrical",)
    special = True
    starts = {"I_s": ("reach", 0.2, 0.5, 1.0, 2.0)}
    ranges = {"I_s": ("reach", 0.05, 5.0), "L_s": ("", 0.0, float("inf"))}

    def force(self, z: Any, dz: Any, p: Any) -> Any:
        q = (z / p.I_s) ** 2
        return -p.L_s * dz * q / (1 + q)
