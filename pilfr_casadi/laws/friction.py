"""Laws of the local rate: friction and damping."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from ..models import play
from .base import Law, Local, grid

KNEE = 0.15  # of the speed at which friction has fallen, that its reversal may take
FALL = 0.05  # of dry friction, the least by which it is larger at rest
SPRINGY = 0.08  # of half the travel, beyond which a contact that springs back is an elasto-plastic part
MOST = 0.6  # of half the travel, the widest that is tried
SHARP, SHARPEST = 2e-3, 1e-4  # of the speed, the narrowest reversal that is tried anyhow, and where steps can follow
STABLE = 2.5  # |λ| h with which a Runge-Kutta step is stable
WIDE = 0.4  # of the widest reversal that is tried, beyond which it is damping that gives way rather than dry friction


class CoulombFriction(Law):
    """Dry friction with a smooth reversal (Armstrong-Hélouvry et al. 1994)."""

    id = "coulomb_friction"
    form = "smooth"
    equation = "w = F_c tanh(dz/dt / v_0)"
    source = "Armstrong-Hélouvry, Dupont & Canudas de Wit (1994), Automatica 30(7)"
    sentence = "dry friction: a force that opposes motion and hardly depends on speed"
    units: ClassVar[Mapping[str, str]] = {"F_c": "w", "v_0": "z/s"}
    strength: ClassVar[tuple[str, ...]] = ("F_c",)
    dissipative = True
    knee = "v_0"

    def force(self, dz: Any, p: Any) -> Any:
        return p.F_c * ca.tanh(dz / p.v_0)

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield from grid(v_0=local.speed * np.array([0.005, 0.02, 0.06, 0.15]))

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {"v_0": (_sharpest(self, local), 0.5 * local.speed)}

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """A reversal over much of the speeds there are: the force depends on speed nearly everywhere."""
        return bool(values["v_0"] > WIDE * self.parameters()["v_0"].bounds[1])


class AsymmetricFriction(CoulombFriction):
    """Dry friction that differs between the two directions."""

    form = "asymmetric"
    equation = "w = F_c tanh(dz/dt / v_0) + F_0"
    sentence = "dry friction that differs between the two directions, or that has a constant load beside it"
    units: ClassVar[Mapping[str, str]] = {"F_c": "w", "F_0": "w", "v_0": "z/s"}
    strength: ClassVar[tuple[str, ...]] = ("F_c", "F_0")
    signed: ClassVar[tuple[str, ...]] = ("F_0",)

    def force(self, dz: Any, p: Any) -> Any:
        return p.F_c * ca.tanh(dz / p.v_0) + p.F_0


class DirectionalFriction(AsymmetricFriction):
    """Dry and viscous friction that both differ between the two directions."""

    form = "directional"
    equation = "w = F_c tanh(dz/dt / v_0) + F_0 + c_0 |dz/dt|"
    sentence = (
        "dry friction, and friction that grows with speed, both different in the two directions (or a constant load)"
    )
    units: ClassVar[Mapping[str, str]] = {"F_c": "w", "F_0": "w", "c_0": "w*s/z", "v_0": "z/s"}
    strength: ClassVar[tuple[str, ...]] = ("F_c", "F_0", "c_0")
    signed: ClassVar[tuple[str, ...]] = ("F_0", "c_0")

    def force(self, dz: Any, p: Any) -> Any:
        return p.F_c * ca.tanh(dz / p.v_0) + p.F_0 + p.c_0 * ca.fabs(dz)


class PreslidingFriction(Law):
    """Dry friction whose contact springs back before it slides: an elasto-plastic element (Jenkins 1962; Dahl 1968)."""

    id = "coulomb_friction"
    form = "presliding"
    equation = "w = k_t stop_r[z],  F_c = k_t r"
    source = "Jenkins (1962); Al-Bender & Swevers (2008), IEEE Control Syst. 28(6)"
    sentence = "dry friction whose contact springs back a little before it slides"
    units: ClassVar[Mapping[str, str]] = {"k_t": "w/z", "r": "z"}
    strength: ClassVar[tuple[str, ...]] = ("k_t",)
    dissipative = True
    memory = 1

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """One stop."""
        following = play(z, s, p["r"])
        return p["k_t"] * (z - following), following

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield from grid(r=local.half * np.array([0.003, 0.01, 0.03, 0.1, 0.25]))

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {"r": (5e-4 * local.half, MOST * local.half)}

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """A contact that springs back over much of the travel: hysteresis, of which this is one stop."""
        return bool(values["r"] > SPRINGY / MOST * self.parameters()["r"].bounds[1])


class StribeckFriction(CoulombFriction):
    """Dry friction that falls as motion sets in (Stribeck 1902; Armstrong-Hélouvry et al. 1994)."""

    id = "stribeck_friction"
    form = ""
    equation = "w = (F_c + F_e exp(-(dz/dt / v_s)^2)) tanh(dz/dt / v_0)"
    sentence = "dry friction that is larger at rest than in motion"
    units: ClassVar[Mapping[str, str]] = {"F_c": "w", "F_e": "w", "v_s": "z/s", "v_0": "z/s"}
    strength: ClassVar[tuple[str, ...]] = ("F_c", "F_e")

    def force(self, dz: Any, p: Any) -> Any:
        return (p.F_c + p.F_e * ca.exp(-((dz / p.v_s) ** 2))) * ca.tanh(dz / p.v_0)

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        for v_s in (0.04, 0.1, 0.2, 0.4):
            for v_0 in (0.1, 0.3):
                yield {"v_s": v_s * local.speed, "v_0": v_0 * v_s * local.speed}

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {"v_s": (4e-3 * local.speed, 0.8 * local.speed), "v_0": (_sharpest(self, local), 0.3 * local.speed)}

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """A knee as wide as the range over which friction falls, or no fall to speak of."""
        return bool(values["v_0"] > KNEE * values["v_s"]) or _hardly_falls(self, values)


class PreslidingStribeckFriction(PreslidingFriction):
    """The same where the contact springs back before it slides: an elasto-plastic element of falling strength."""

    id = "stribeck_friction"
    equation = "w = (k_t + k_e exp(-(dz/dt / v_s)^2)) stop_r[z],  F_c = k_t r"
    source = "Armstrong-Hélouvry, Dupont & Canudas de Wit (1994), Automatica 30(7); Jenkins (1962)"
    sentence = "dry friction that is larger at rest than in motion, and whose contact springs back before it slides"
    units: ClassVar[Mapping[str, str]] = {"k_t": "w/z", "k_e": "w/z", "r": "z", "v_s": "z/s"}
    strength: ClassVar[tuple[str, ...]] = ("k_t", "k_e")

    def step(self, z: Any, s: Any, p: Any, dz: Any = 0.0) -> tuple[Any, Any]:
        """One stop."""
        following = play(z, s, p["r"])
        return (p["k_t"] + p["k_e"] * ca.exp(-((dz / p["v_s"]) ** 2))) * (z - following), following

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield from grid(
            r=local.half * np.array([0.003, 0.01, 0.03, 0.1]), v_s=local.speed * np.array([0.05, 0.15, 0.4])
        )

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {**super().bounds(local), "v_s": (4e-3 * local.speed, 0.8 * local.speed)}

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """As without the fall, or no fall to speak of."""
        return super().doubtful(values) or _hardly_falls(self, values)


def _sharpest(law: Law, local: Local) -> float:
    """Narrowest reversal, z/s: stuck in a narrower one, a simulation would chatter on its steps."""
    force = sum(
        abs(float(law.values.get(name, 0.0))) for name in law.strength if name.startswith("F") and name != "F_0"
    )
    followed = 0.0 if law.scaled_by else force / (STABLE * local.firmest)
    if not followed:
        return SHARP * local.speed
    return float(np.clip(followed, SHARPEST * local.speed, SHARP * local.speed))


def _hardly_falls(law: Law, values: Mapping[str, Any]) -> bool:
    """Whether a fall is slight, or goes on over all speeds, or is over at once: no friction is larger at rest then."""
    (low, high), (dry, more) = law.parameters()["v_s"].bounds, (abs(float(values[k])) for k in law.strength[:2])
    return bool(not low < values["v_s"] < high or more < FALL * dry)


class ViscousDamping(Law):
    """A damper where the simulator has none."""

    id = "viscous_damping"
    equation = "w = c_1 dz/dt"
    source = "Meirovitch (2001), Fundamentals of Vibrations, sec. 1.4"
    sentence = "a viscous damper: a force in proportion to speed"
    units: ClassVar[Mapping[str, str]] = {"c_1": "w*s/z"}
    strength: ClassVar[tuple[str, ...]] = ("c_1",)
    dissipative = True

    def force(self, dz: Any, p: Any) -> Any:
        return p.c_1 * dz


class DirectionalDamping(ViscousDamping):
    """A damper that differs between the two directions, such as a shock absorber (Dixon 2007)."""

    form = "directional"
    equation = "w = c_1 dz/dt + c_0 |dz/dt|"
    source = "Dixon (2007), The Shock Absorber Handbook, ch. 6"
    sentence = "viscous damping that differs between the two directions"
    units: ClassVar[Mapping[str, str]] = {"c_1": "w*s/z", "c_0": "w*s/z"}
    strength: ClassVar[tuple[str, ...]] = ("c_1", "c_0")
    signed: ClassVar[tuple[str, ...]] = ("c_0",)

    def force(self, dz: Any, p: Any) -> Any:
        return p.c_1 * dz + p.c_0 * ca.fabs(dz)


class QuadraticDrag(Law):
    """Drag of turbulent flow (White 2011)."""

    id = "quadratic_drag"
    equation = "w = c_2 dz/dt |dz/dt|"
    source = "White (2011), Fluid Mechanics, sec. 7.6"
    sentence = "a drag that grows with the square of speed"
    units: ClassVar[Mapping[str, str]] = {"c_2": "w*s^2/z^2"}
    strength: ClassVar[tuple[str, ...]] = ("c_2",)
    dissipative = True

    def force(self, dz: Any, p: Any) -> Any:
        return p.c_2 * dz * ca.fabs(dz)


class DirectionalDrag(QuadraticDrag):
    """Drag that differs between the two directions, such as of an orifice with a sharp and a round edge."""

    form = "directional"
    equation = "w = c_2 dz/dt |dz/dt| + c_0 (dz/dt)^2"
    sentence = "a drag that grows with the square of speed and differs between the two directions"
    units: ClassVar[Mapping[str, str]] = {"c_2": "w*s^2/z^2", "c_0": "w*s^2/z^2"}
    strength: ClassVar[tuple[str, ...]] = ("c_2", "c_0")
    signed: ClassVar[tuple[str, ...]] = ("c_0",)

    def force(self, dz: Any, p: Any) -> Any:
        return p.c_2 * dz * ca.fabs(dz) + p.c_0 * dz**2


class CubicDamping(Law):
    """Damping that grows with the cube of speed (Nayfeh & Mook 1979)."""

    id = "cubic_damping"
    equation = "w = c_3 (dz/dt)^3"
    source = "Nayfeh & Mook (1979), Nonlinear Oscillations, sec. 3.3"
    sentence = "a damping force that grows with the cube of speed"
    units: ClassVar[Mapping[str, str]] = {"c_3": "w*s^3/z^3"}
    strength: ClassVar[tuple[str, ...]] = ("c_3",)

    def force(self, dz: Any, p: Any) -> Any:
        return p.c_3 * dz**3
