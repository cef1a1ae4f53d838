"""Laws in line with a force that the equations have already: a gap, a compliance, a rotor on a spring, a limit.

Let F(z, dz/dt) be that force at a port, the port's `term`. An element in line with it changes the coordinate of F to q:

    w = F(q, dq/dt) - F(z, dz/dt),

so that F(q, dq/dt) takes the place of F(z, dz/dt) in the equations. A limit changes the value of F instead.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from ..models import Named
from .base import Law, Local, beyond_gap
from .dynamic import SprungMass

REACHED = 0.99  # share of the samples below the size of a term, without its rare peaks
SAME = 1e-9  # relative difference that rounding may cause


class _InLine(Law):
    """The common part of laws in line with a term."""

    in_line = True
    position: ClassVar[bool | None] = None  # whether the term has to vary with z; None for either

    def why_not(self, local: Local) -> str:
        """Say why the law cannot stand in line with the port's term; empty if it can."""
        if local.term is None:
            return "the port names no term of the equations"
        if not np.all(np.isfinite(local.given)):  # the simulator divides by a parameter that is zero
            return "the term is not finite"
        moved = not _alike(local.term(local.z + local.half, local.dz), local.given)
        if self.position is not None and moved is not self.position:
            return f"the term {'varies' if moved else 'does not vary'} with the coordinate"
        return super().why_not(local)

    def change(self, local: Local, shape: Mapping[str, Any]) -> np.ndarray:
        """Change w (M,) of the term's force along a port's signals; roughly, because it only ranks laws."""
        raise NotImplementedError

    def forces_along(self, local: Local, shapes: Sequence[Mapping[str, Any]]) -> np.ndarray:
        """Compute the changes for several shapes, (M, len(shapes), 1)."""
        return np.column_stack([self.change(local, shape) for shape in shapes])[:, :, None]


class LineGap(_InLine):
    """A gap in line with a spring or a coupling of the simulator, whatever its curve."""

    id = "clearance"
    form = "in line with a term"
    equation = "w = F(z - clip(z, -g, g), dz/dt (|z| > g)) - F(z, dz/dt)"
    source = "Nordin & Gutman (2002), Automatica 38(10)"
    sentence = "a clearance in line with a modelled force F: it acts only beyond a gap"
    units = {"g": "z"}
    position = True
    substeps = 4  # a damper sets in at once at the edge of the gap
    starts = {"g": ("reach", 0.05, 0.15, 0.3, 0.5, 0.75)}
    ranges = {"g": ("reach", 0.002, 0.95)}

    def force(self, z: Any, dz: Any, p: Any, term: Any) -> Any:
        return term(*beyond_gap(z, dz, p.g)) - term(z, dz)

    def change(self, local: Local, shape: Mapping[str, Any]) -> np.ndarray:
        """Change by the travel beyond the gap."""
        assert local.term is not None
        travel, rate = beyond_gap(ca.DM(local.z), ca.DM(local.dz), shape["g"])
        return local.term(travel.full().ravel(), rate.full().ravel()) - local.given


class Compliance(_InLine):
    """A spring in line with a damper or a damped spring of the simulator (a mount, a hose, a rod that gives way)."""

    id = "compliance"
    equation = "w = k (z - q) - F(z, dz/dt),  F(q, dq/dt) = k (z - q)"
    source = "Findley, Lai & Onaran (1976), Creep and Relaxation, ch. 5"
    sentence = "a compliance in line with a modelled force F: both carry the same load, and share the travel"
    units = {"k": "w/z"}
    strength: ClassVar[tuple[str, ...]] = ()  # the force is not linear in k
    starts = {"k": lambda at: _stiffness(at) * np.geomspace(0.5, 50, 5)}
    ranges = {"k": lambda at: (0.01 * _stiffness(at), 1e4 * _stiffness(at))}
    order = follows = 1

    def why_not(self, local: Local) -> str:
        if found := super().why_not(local):
            return found
        assert local.term is not None
        rest, once, twice = (local.term(local.z, times * local.dz) for times in (0, 1, 2))
        if np.median((once - rest) * local.dz) <= 0:
            return "the term has no damper, and a spring in line with a spring is one spring"
        return "" if _alike(twice - rest, 2 * (once - rest)) else "the term is not linear in the rate"

    def force(self, z: Any, dz: Any, q: Any, p: Any, term: Any) -> Any:
        return p.k * (z - q) - term(z, dz)

    def flow(self, z: Any, q: Any, p: Any, term: Any) -> Any:
        """Rate at which F carries the load of the spring; F is linear in it."""
        rest = term(q, 0)
        return (p.k * (z - q) - rest) / (term(q, 1) - rest)

    def change(self, local: Local, shape: Mapping[str, Any]) -> np.ndarray:
        """Change by the deflection of the spring under the present load."""
        assert local.term is not None
        inner = local.z - local.given / shape["k"]
        return local.term(inner, np.gradient(inner, local.dt)) - local.given


class ElasticDrive(SprungMass, _InLine):
    """A motor's rotor on a spring and a damper, between the torque that drives a joint and the joint."""

    id = "extra_mode"
    flexible = True
    form = "elastic drive"
    equation = "w = T - F,  T = k (z - q + 2 D / W (dz/dt - dq/dt)),  k / W^2 d2q/dt2 = T - F; outputs read q"
    source = "Spong (1987), Journal of Dynamic Systems, Measurement, and Control 109(4)"
    sentence = "an elastic drive: a spring stands between the motor, where the sensor is, and the joint"
    units = {"k": "w/z", "W": "rad/s", "D": ""}
    domains = ("mechanical",)
    strength: ClassVar[tuple[str, ...]] = ()  # the force is not linear in k
    position = False
    implied = "drive"
    sensed = True
    starts = {
        "k": lambda at: _stiffness(at) * np.array([2.0, 10.0, 50.0]),
        "W": lambda at: np.geomspace(0.04, 0.6, 5) / at.dt,
        "D": ("", 0.05),
    }
    ranges = {
        "k": lambda at: (0.01 * _stiffness(at), 1e4 * _stiffness(at)),
        "W": lambda at: (8 / at.duration, 1.6 / at.dt),
        "D": ("", 1e-3, 1.0),
    }
    order, follows = 2, 1

    def force(self, z: Any, dz: Any, q: Any, p: Any, term: Any) -> Any:
        return p.k * self.pull(z, dz, q, p) - term(z, dz)

    def flow(self, z: Any, dz: Any, q: Any, p: Any, term: Any) -> Any:
        """Rates of the rotor's angle and of its speed over W."""
        return ca.vertcat(p.W * q[1], p.W * (self.pull(z, dz, q, p) - term(q[0], p.W * q[1]) / p.k))

    def change(self, local: Local, shape: Mapping[str, Any]) -> np.ndarray:
        """Force of inertia of the rotor, which lies ahead of the joint by the spring's deflection."""
        rate = local.dz + np.gradient(-local.given / shape["k"], local.dt)
        return np.asarray(shape["k"] / shape["W"] ** 2 * np.gradient(rate, local.dt))


class ElasticDriveSeenAtLoad(ElasticDrive):
    """A motor's rotor on a spring and a damper, before a joint that carries the sensor."""

    form = "elastic drive, sensor at the load"
    equation = ElasticDrive.equation.removesuffix("; outputs read q")
    sentence = "an elastic drive: a spring stands between the motor and the joint, where the sensor is"
    sensed = False


class TermLimit(_InLine):
    """The common part of limits of a term: a force that the equations have, and that the machine cannot exceed."""

    id = "saturation"
    implied = "balance"
    absent: ClassVar[tuple[str, ...]] = ("thermal",)  # a flow of heat has no limit of its own
    source = "Khalil (2002), Nonlinear Systems, sec. 1.2"

    def why_not(self, local: Local) -> str:
        if found := super().why_not(local):
            return found
        hardly_acts = not np.ptp(local.given) > 0 or not _size(local) > 0
        return "the term is constant, or zero nearly always" if hardly_acts else ""

    def force(self, given: Any, p: Any) -> Any:
        return self.limited(given, p) - given

    def limited(self, given: Any, p: Any) -> Any:
        """Limit the term's force."""
        raise NotImplementedError

    def change(self, local: Local, shape: Mapping[str, Any]) -> np.ndarray:
        """Change by the limits."""
        return np.asarray(self.limited(ca.DM(local.given), Named("parameter", shape))).ravel() - local.given


class LimitedTerm(TermLimit):
    """A force of the equations with a hard limit on either side, such as the torque of a drive with limited current."""

    form = "of a modelled force"
    equation = "w = clip(F, low, high) - F"
    sentence = "saturation of a modelled force F: the machine does not exceed a limit on either side"
    units = {"low": "w", "high": "w"}
    strength: ClassVar[tuple[str, ...]] = ()  # the force is not linear in the limits
    starts = {
        "low": lambda at: np.quantile(at.given, (0.0, 0.02, 0.1, 0.3)),
        "high": lambda at: np.quantile(at.given, (1.0, 0.98, 0.9, 0.7)),
    }
    ranges = {
        "low": lambda at: (_reach(at, 0.0, -0.1), _reach(at, 0.5)),
        "high": lambda at: (_reach(at, 0.5), _reach(at, 1.0, 0.1)),
    }

    def limited(self, given: Any, p: Any) -> Any:
        return ca.fmax(ca.fmin(given, p.high), p.low)

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        """Generate the pairs of limits, except the one that is never reached."""
        _, *reached = super().shapes(local)
        yield from reached


class SoftlyLimitedTerm(TermLimit):
    """A force of the equations that approaches a limit gradually, such as the grip of a tyre."""

    form = "of a modelled force, soft"
    equation = "w = L tanh(F / L) - F"
    sentence = "saturation of a modelled force F: it approaches a limit gradually"
    units = {"L": "w"}
    strength: ClassVar[tuple[str, ...]] = ()  # the force is not linear in the limits
    starts = {"L": lambda at: _size(at) * np.array([0.3, 0.6, 1.0, 2.0])}
    ranges = {"L": lambda at: _size(at) * np.array([0.1, 10.0])}

    def limited(self, given: Any, p: Any) -> Any:
        return p.L * ca.tanh(given / p.L)


def _reach(local: Local, share: float, beyond: float = 0.0) -> float:
    """A quantile of the term's force, moved by a share of its span."""
    return float(np.quantile(local.given, share) + beyond * np.ptp(local.given))


def _size(local: Local) -> float:
    """Size of the term, without its rare peaks."""
    return float(np.quantile(np.abs(local.given), REACHED))


def _stiffness(local: Local) -> float:
    """Size of the term over the size of the coordinate."""
    return _size(local) / local.half or 1.0


def _alike(one: np.ndarray, other: np.ndarray) -> bool:
    return bool(np.max(np.abs(one - other)) <= SAME * max(np.max(np.abs(one)), np.max(np.abs(other)), 1e-300))
