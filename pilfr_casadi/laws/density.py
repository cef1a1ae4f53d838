"""Hysteresis with a smooth density of thresholds: rounded loops from three numbers.

A Prandtl-Ishlinskii layer whose stops have thresholds `R q` of density `g(q) = a^a q^(a - 1) exp(-a q) / Gamma(a)`,

    w = k_h int_0^inf g(q) stop_{R q}[z] dq.

a = 1 is the (extended) Masing spring `k_h R (1 - exp(-z / R))` of Krikelis et al. (2024), Eq. 26 with n = 1; a large a
comes near to a single Jenkins element. The density follows Iwan (1966) and Segalman (2005).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from ..models import play
from .base import Law, Local, grid

NODES = 24
# cells that are equally far from the curve of a = 1, each one stop at its centre of gravity with its weight
_LOW = -2 * np.log(1 - np.arange(NODES) / NODES)
_MASS = np.append(-np.diff(np.exp(-_LOW)), np.exp(-_LOW[-1]))
_MOMENT = np.append(-np.diff((_LOW + 1) * np.exp(-_LOW)), (_LOW[-1] + 1) * np.exp(-_LOW[-1]))
Q = _MOMENT / _MASS
WIDTH = _MASS * np.exp(Q)  # for the density exp(-q) at the centres


class SmoothHysteresis(Law):
    """Rate-independent hysteresis with rounded loops (Masing 1926; Iwan 1966; Segalman 2005)."""

    id = "hysteresis"
    form = "prandtl_ishlinskii"
    equation = "w = k_h sum_i g_i stop_{R q_i}[z],  g_i ~ q_i^(a - 1) exp(-a q_i)"
    source = "Segalman (2005), J. Appl. Mech. 72(5); Krikelis et al. (2024), Eq. 26"
    sentence = "rate-independent hysteresis: a force that depends on where the motion last turned round"
    units: ClassVar[Mapping[str, str]] = {"k_h": "w/z", "R": "z", "a": ""}
    strength: ClassVar[tuple[str, ...]] = ("k_h",)
    dissipative = True
    memory = NODES

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """Stops side by side."""
        share = [ca.exp((p["a"] - 1) * np.log(q) - p["a"] * q) * width for q, width in zip(Q, WIDTH, strict=True)]
        total = sum(share)
        following = [play(z, s[i], p["R"] * q) for i, q in enumerate(Q)]
        force = sum(g * (z - q) for g, q in zip(share, following, strict=True))
        return p["k_h"] * force / total, ca.vertcat(*following)

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield from grid(R=local.half * np.array([0.02, 0.06, 0.15, 0.4]), a=[1.0])

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {"R": (2e-3 * local.half, 2 * local.half), "a": (0.3, 12.0)}

    @classmethod
    def finer_starts(cls, values: Mapping[str, Any], local: Local) -> Iterator[dict[str, Any]]:
        """As stiff at first as the stops of given weights, spread in several ways."""
        for shape in cls().shapes(local):
            yield {**shape, "k_h": float(np.sum(values["w"]))}
