"""Laws of the local rate: friction and damping."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from ..models import play
from .base import Law, Local, signed_power

FALL = 0.05  # smallest excess of the peak of a falling friction over the friction that is left at high speed
SPRINGY = 0.08  # threshold of presliding over half the travel; above it the element is a stop of a hysteresis
MAX_THRESHOLD = 0.6  # largest threshold tried, over half the travel
SHARP = 2e-3  # narrowest reversal that is tried at any steps, over the speed
SHARPEST_REVERSAL = 1e-4  # narrowest reversal that is tried where the steps resolve it, over the speed
STABLE_STEP = 2.5  # |λ| h up to which a Runge-Kutta step is stable
BROAD = 0.1  # width of the reversal over the largest speed from which an answer says that it is broad
NO_FRICTION = 1e-3  # share of a constant load below which dry friction beside it is none
WIDE = 0.4  # width of the reversal over the widest that is tried; above it the force is damping that saturates


class CoulombFriction(Law):
    """Dry friction with a smooth reversal (Armstrong-Hélouvry et al. 1994)."""

    id = "coulomb_friction"
    form = "smooth"
    equation = "w = F_c tanh(dz/dt / v_0)"
    source = "Armstrong-Hélouvry, Dupont & Canudas de Wit (1994), Automatica 30(7)"
    sentence = "dry friction: a force that opposes motion and hardly depends on speed"
    units = {"F_c": "w", "v_0": "z/s"}
    domains: ClassVar[tuple[str, ...]] = ("mechanical",)
    dissipative = True
    knee = "v_0"
    starts = {"v_0": ("speed", 0.005, 0.02, 0.06, 0.15)}
    widest: ClassVar[float] = 0.5  # reversal that a fit may reach, over the largest speed

    def force(self, dz: Any, p: Any) -> Any:
        return p.F_c * ca.tanh(dz / p.v_0)

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {"v_0": (_narrowest_reversal(self, local), self.widest * local.speed)}

    def remark(self, values: Mapping[str, Any]) -> str:
        """Say that the reversal is broad, as of a damper whose force saturates (a digressive damper)."""
        share = self.widest * values["v_0"] / self.parameters()["v_0"].bounds[1]
        words = f"here it sets in over {share:.0%} of the largest speed, as in a damper whose force saturates"
        return words if BROAD < share < np.inf else ""

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Tell whether the reversal is so wide that the force depends on speed nearly everywhere."""
        return bool(values["v_0"] > WIDE * self.parameters()["v_0"].bounds[1])


class AsymmetricFriction(CoulombFriction):
    """Dry friction that differs between the two directions."""

    form = "asymmetric"
    equation = "w = F_c tanh(dz/dt / v_0) + F_0"
    sentence = "dry friction that differs between the two directions, or that has a constant load beside it"
    units = {"F_c": "w", "F_0": "w", "v_0": "z/s"}
    signed: ClassVar[tuple[str, ...]] = ("F_0",)

    def force(self, dz: Any, p: Any) -> Any:
        return super().force(dz, p) + p.F_0

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Tell whether nothing of it opposes the motion: then it is a constant load."""
        return super().doubtful(values) or bool(values["F_c"] < NO_FRICTION * np.abs(values["F_0"]))


class DirectionalFriction(AsymmetricFriction):
    """Dry and viscous friction that both differ between the two directions."""

    form = "directional"
    equation = "w = F_c tanh(dz/dt / v_0) + F_0 + c_0 |dz/dt|"
    sentence = (
        "dry friction, and friction that grows with speed, both different in the two directions (or a constant load)"
    )
    units = {"F_c": "w", "F_0": "w", "c_0": "w*s/z", "v_0": "z/s"}
    signed = ("F_0", "c_0")

    def force(self, dz: Any, p: Any) -> Any:
        return super().force(dz, p) + p.c_0 * ca.fabs(dz)


class PreslidingFriction(Law):
    """Dry friction whose contact springs back before it slides: an elasto-plastic element (Jenkins 1962; Dahl 1968)."""

    id = "coulomb_friction"
    form = "presliding"
    equation = "w = k_t stop_r[z],  F_c = k_t r"
    source = "Jenkins (1962); Al-Bender & Swevers (2008), IEEE Control Syst. 28(6)"
    sentence = "dry friction whose contact springs back a little before it slides"
    units = {"k_t": "w/z", "r": "z"}
    domains: ClassVar[tuple[str, ...]] = ("mechanical",)
    dissipative = True
    memory = 1
    starts = {"r": ("half", 0.003, 0.01, 0.03, 0.1, 0.25)}
    ranges = {"r": ("half", 0.0005, MAX_THRESHOLD)}

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        following = play(z, s, p["r"])
        return p["k_t"] * (z - following), following

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Tell whether the contact springs back over much of the travel: then it is one stop of a hysteresis."""
        return bool(values["r"] > SPRINGY / MAX_THRESHOLD * self.parameters()["r"].bounds[1])


class StribeckFriction(CoulombFriction):
    """Dry friction that falls as motion sets in (Stribeck 1902; Armstrong-Hélouvry et al. 1994)."""

    id = "stribeck_friction"
    flexible = True
    form = ""
    equation = "w = (F_c + F_e exp(-(dz/dt / v_s)^2)) tanh(dz/dt / v_0)"
    sentence = "dry friction that is larger at rest than in motion"
    units = {"F_c": "w", "F_e": "w", "v_s": "z/s", "v_0": "z/s"}
    widest = 0.3

    def force(self, dz: Any, p: Any) -> Any:
        return (p.F_c + p.F_e * ca.exp(-((dz / p.v_s) ** 2))) * ca.tanh(dz / p.v_0)

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        for v_s in (0.04, 0.1, 0.2, 0.4):
            for v_0 in (0.1, 0.3):
                yield {"v_s": v_s * local.speed, "v_0": v_0 * v_s * local.speed}

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {
            "v_s": (4e-3 * local.speed, 0.8 * local.speed),
            "v_0": (_narrowest_reversal(self, local), self.widest * local.speed),
        }

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Tell whether the friction hardly falls with speed from its peak beyond the reversal."""
        speed = np.linspace(0.0, 3.0 * float(values["v_s"]), 300)[1:]
        falling = abs(float(values["F_c"])) + abs(float(values["F_e"])) * np.exp(-((speed / float(values["v_s"])) ** 2))
        return _hardly_falls(self, values, float(np.max(falling * np.tanh(speed / float(values["v_0"])))))


class PreslidingStribeckFriction(PreslidingFriction):
    """Falling dry friction whose contact springs back first: an elasto-plastic element of falling strength."""

    id = "stribeck_friction"
    flexible = True
    equation = "w = (k_t + k_e exp(-(dz/dt / v_s)^2)) stop_r[z],  F_c = k_t r"
    source = "Armstrong-Hélouvry, Dupont & Canudas de Wit (1994), Automatica 30(7); Jenkins (1962)"
    sentence = "dry friction that is larger at rest than in motion, and whose contact springs back before it slides"
    units = {"k_t": "w/z", "k_e": "w/z", "r": "z", "v_s": "z/s"}
    starts = {"r": ("half", 0.003, 0.01, 0.03, 0.1), "v_s": ("speed", 0.05, 0.15, 0.4)}
    ranges = {**PreslidingFriction.ranges, "v_s": ("speed", 4e-3, 0.8)}

    def step(self, z: Any, s: Any, p: Any, dz: Any = 0.0) -> tuple[Any, Any]:
        following = play(z, s, p["r"])
        return (p["k_t"] + p["k_e"] * ca.exp(-((dz / p["v_s"]) ** 2))) * (z - following), following

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Tell whether the contact springs back over much of the travel, or the fall is negligible."""
        most = abs(float(values["k_t"])) + abs(float(values["k_e"]))
        return super().doubtful(values) or _hardly_falls(self, values, most)


def _narrowest_reversal(law: Law, local: Local) -> float:
    """Compute the narrowest reversal, z/s; in a narrower one a simulation chatters at rest."""
    force = sum(
        abs(float(law.values.get(name, 0.0))) for name in law.strength if name.startswith("F") and name != "F_0"
    )
    followed = 0.0 if law.scaled_by else force / (STABLE_STEP * local.max_damping)
    if not followed:
        return SHARP * local.speed
    return float(np.clip(followed, SHARPEST_REVERSAL * local.speed, SHARP * local.speed))


def _hardly_falls(law: Law, values: Mapping[str, Any], peak: float) -> bool:
    """Tell whether the fall from a peak is slight, spans all speeds, or ends at once: then it is dry friction."""
    (low, high), dry = law.parameters()["v_s"].bounds, abs(float(values[law.strength[0]]))
    return bool(not low < values["v_s"] < high or peak < (1 + FALL) * dry)


class ViscousDamping(Law):
    """A damper that the simulator leaves out."""

    id = "viscous_damping"
    equation = "w = c_1 dz/dt"
    source = "Meirovitch (2001), Fundamentals of Vibrations, sec. 1.4"
    sentence = "a viscous damper: a force in proportion to speed"
    sentences: ClassVar[Mapping[str, str]] = {
        "thermal": "a heat capacity: a heat flow in proportion to the rate of the temperature",
        "fluid": "a capacity or an inertance: a term in proportion to the rate of the level, pressure or flow",
        "electrical": "a capacitance or an inductance: a term in proportion to the rate of the voltage or current",
    }
    units = {"c_1": "w*s/z"}
    dissipative = True

    def force(self, dz: Any, p: Any) -> Any:
        return p.c_1 * dz


class DirectionalDamping(ViscousDamping):
    """A damper that differs between the two directions, such as a shock absorber (Dixon 2007)."""

    form = "directional"
    equation = "w = c_1 dz/dt + c_0 |dz/dt|"
    source = "Dixon (2007), The Shock Absorber Handbook, ch. 6"
    sentence = "viscous damping that differs between the two directions"
    sentences: ClassVar[Mapping[str, str]] = {
        "fluid": "a capacity or an inertance that differs between rise and fall",
        "electrical": "a capacitance or an inductance that differs between rise and fall",
    }
    absent = ("thermal",)
    units = {"c_1": "w*s/z", "c_0": "w*s/z"}
    signed = ("c_0",)

    def force(self, dz: Any, p: Any) -> Any:
        return super().force(dz, p) + p.c_0 * ca.fabs(dz)


class QuadraticDrag(Law):
    """Drag of turbulent flow (White 2011)."""

    id = "quadratic_drag"
    equation = "w = c_2 dz/dt |dz/dt|"
    source = "White (2011), Fluid Mechanics, sec. 7.6"
    sentence = "a drag that grows with the square of speed"
    sentences: ClassVar[Mapping[str, str]] = {
        "fluid": "a term that grows with the square of the rate of the level, pressure or flow",
        "electrical": "a term that grows with the square of the rate of the voltage or current",
    }
    absent: ClassVar[tuple[str, ...]] = ("thermal",)
    units = {"c_2": "w*s^2/z^2"}
    dissipative = True

    def force(self, dz: Any, p: Any) -> Any:
        return p.c_2 * dz * ca.fabs(dz)


class DirectionalDrag(QuadraticDrag):
    """Drag that differs between the two directions, such as of an orifice with a sharp and a round edge."""

    form = "directional"
    equation = "w = c_2 dz/dt |dz/dt| + c_0 (dz/dt)^2"
    sentence = "a drag that grows with the square of speed and differs between the two directions"
    sentences: ClassVar[Mapping[str, str]] = {
        "fluid": "a term in the squared rate of the level, pressure or flow, not the same for rise and fall",
        "electrical": "a term in the squared rate of the voltage or current, not the same for rise and fall",
    }
    units = {"c_2": "w*s^2/z^2", "c_0": "w*s^2/z^2"}
    signed = ("c_0",)

    def force(self, dz: Any, p: Any) -> Any:
        return super().force(dz, p) + p.c_0 * dz**2


class PowerDrag(QuadraticDrag):
    """Drag of another power of the speed: between laminar and turbulent flow, or of a bearing's churning oil."""

    form = "power"
    equation = "w = c_n sign(dz/dt) |dz/dt|^n"
    sentence = "a drag that grows with a power of the speed"
    sentences: ClassVar[Mapping[str, str]] = {
        "fluid": "a term that grows with a power of the rate of the level, pressure or flow",
        "electrical": "a term that grows with a power of the rate of the voltage or current",
    }
    units = {"c_n": "w*s^n/z^n", "n": ""}
    starts = {"n": ("", 1.3, 1.6, 2.5)}
    ranges = {"n": ("", 1.15, 4.0)}
    as_base = {"c_n": lambda own: own["c_2"], "n": 2.0}

    def force(self, dz: Any, p: Any) -> Any:
        return p.c_n * signed_power(dz, p.n)


class CubicDamping(Law):
    """Damping that grows with the cube of speed (Nayfeh & Mook 1979)."""

    id = "cubic_damping"
    equation = "w = c_3 (dz/dt)^3"
    source = "Nayfeh & Mook (1979), Nonlinear Oscillations, sec. 3.3"
    sentence = "a damping force in proportion to the cube of speed"
    sentences: ClassVar[Mapping[str, str]] = {
        "fluid": "a term in proportion to the cube of the rate of the level, pressure or flow",
        "electrical": "a term in proportion to the cube of the rate of the voltage or current",
    }
    absent = ("thermal",)
    units = {"c_3": "w*s^3/z^3"}

    def force(self, dz: Any, p: Any) -> Any:
        return p.c_3 * dz**3
