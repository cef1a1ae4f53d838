"""Limits of the range of an actuator or a sensor: saturation and dead zone."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import casadi as ca
import numpy as np

from .base import Law, Local, grid


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

    def force(self, z: Any, p: Any) -> Any:
        return ca.fmax(ca.fmin(z, p.high), p.low) - z

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        at = np.array([0.5, 0.75, 0.97])
        middle = (local.low + local.high) / 2
        yield from grid(low=middle - local.half * at, high=middle + local.half * at)

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        middle = (local.low + local.high) / 2
        return {"low": (local.low * 1.0 - 0.1 * local.half, middle), "high": (middle, local.high + 0.1 * local.half)}


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
        return z / (1 + (ca.fabs(z / p.L) + 1e-9) ** p.n) ** (1 / p.n) - z


class SkewSaturation(AsymmetricSaturation):
    """A limit on either side that is approached gradually."""

    form = "soft asymmetric"
    equation = "w = L tanh(u / L) - u,  L = L_1 below zero and L_2 above"
    units = {"L_1": "z", "L_2": "z"}

    def force(self, z: Any, p: Any) -> Any:
        up, down = ca.fmax(z, 0), ca.fmin(z, 0)
        return p.L_2 * ca.tanh(up / p.L_2) + p.L_1 * ca.tanh(down / p.L_1) - z

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        at = local.reach * np.array([0.4, 0.9, 2.0])
        yield from grid(L_1=at, L_2=at)

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {name: (0.1 * local.reach, 20 * local.reach) for name in ("L_1", "L_2")}


class DeadZone(Law):
    """Small signals have no effect."""

    id = "dead_zone"
    form = "symmetric"
    equation = "w = -clip(u, -g, g)"
    source = "Khalil (2002), Nonlinear Systems, sec. 1.2"
    sentence = "a dead zone: small signals have no effect"
    units = {"g": "z"}
    places = ("series",)
    starts = {"g": ("reach", 0.02, 0.06, 0.12, 0.25, 0.4)}
    ranges = {"g": ("reach", 0.001, 0.8)}

    def force(self, z: Any, p: Any) -> Any:
        return -ca.fmax(ca.fmin(z, p.g), -p.g)

    def applies(self, local: Local) -> str:
        return "" if np.min(np.abs(local.z)) < 0.1 * local.reach else "the signal is never small"


class AsymmetricDeadZone(DeadZone):
    """A dead zone that reaches further on one side."""

    form = "asymmetric"
    equation = "w = -clip(u, -g_1, g_2)"
    units = {"g_1": "z", "g_2": "z"}
    ranges = {"g_1": ("reach", 0.0, 0.8), "g_2": ("reach", 0.0, 0.8)}

    def force(self, z: Any, p: Any) -> Any:
        return -ca.fmax(ca.fmin(z, p.g_2), -p.g_1)

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        at = local.reach * np.array([0.02, 0.15, 0.35])
        yield from grid(g_1=at, g_2=at)

    def applies(self, local: Local) -> str:
        return "" if local.low < 0 < local.high else "one side is never visited"
