"""Rate-independent laws with memory: hysteresis in its forms, and backlash."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from ..models import Parameter, play
from .base import Law, Local, grid

PARTS = 4  # of a step of a held signal
THIN = 0.1  # widest loop over the bend beside it that leaves a curve without memory
DIRECT, ALIKE = 0.05, 0.15  # gain past the plays, and spread of their thresholds over the mean, of a mere backlash


class StopHysteresis(Law):
    """Rate-independent hysteresis: a Prandtl-Ishlinskii layer of stops (Krikelis et al. 2024, Eq. 16)."""

    id = "hysteresis"
    form = "prandtl_ishlinskii"
    equation = "w = sum_i w_i stop_{r_i}[z]"
    source = "Krikelis et al. (2024), Eq. 2 and 16"
    sentence = "rate-independent hysteresis: a force that depends on where the motion last turned round"
    units: ClassVar[Mapping[str, str]] = {"w": "w/z", "r": "z"}
    strength: ClassVar[tuple[str, ...]] = ("w",)
    dissipative = True
    n = 6
    memory = 6

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """Stops side by side."""
        following = [play(z, s[i], p["r"][i]) for i in range(self.n)]
        return sum(p["w"][i] * (z - q) for i, q in enumerate(following)), ca.vertcat(*following)

    def parameters(self) -> dict[str, Parameter]:
        """Vectors of weights and thresholds."""
        w = np.broadcast_to(np.asarray(self.values.get("w", 0.0), dtype=float), (self.n,))
        r = np.broadcast_to(np.asarray(self.values.get("r", np.linspace(0.1, 1, self.n)), dtype=float), (self.n,))
        low, high = self.limits.get("w", (-np.inf, np.inf))
        r_low, r_high = self.limits.get("r", (0.0, np.inf))
        return {
            "w": Parameter(np.clip(w, low, high), unit=self.units["w"], bounds=(low, high)),
            "r": Parameter(np.clip(r, r_low, r_high), unit=self.units["r"], bounds=(r_low, r_high)),
        }

    def size(self, values: Mapping[str, Any]) -> int:
        """Weights that count, and the place and spread of the thresholds; a weight at zero is no parameter."""
        weights = np.abs(values["w"])
        scalars = sum(1 for p in self.parameters().values() if p.size == 1)
        return int(np.sum(weights > 0.01 * np.max(weights))) + 2 + scalars

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield {"r": local.half * np.geomspace(0.03, 0.95, self.n)}
        yield {"r": local.half * np.geomspace(0.005, 0.5, self.n)}

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        # a stop that never slips is a spring, a play that never moves a constant: both belong elsewhere
        return {"r": (1e-4 * local.half, 0.97 * local.half)}


class PlayHysteresis(StopHysteresis):
    """Hysteresis of an actuator or a sensor: plays added to the signal (Krikelis et al. 2024, Eq. 1 and 16)."""

    equation = "w = sum_i w_i play_{r_i}[u]"
    source = "Krikelis et al. (2024), Eq. 1 and 16"
    sentence = "rate-independent hysteresis: the output depends on where the signal last turned round"
    places: ClassVar[tuple[str, ...]] = ("series",)
    dissipative = False

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """Plays side by side, r = 0 being a gain."""
        following = [play(z, s[i], p["r"][i]) for i in range(self.n)]
        return sum(p["w"][i] * q for i, q in enumerate(following)), ca.vertcat(*following)

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield {"r": local.half * np.linspace(0.0, 0.9, self.n)}

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        # plays lag behind the signal where their weights are positive (Kuhnen 2003); the first is the gain
        return {**super().bounds(local), "w": (np.append(-1.0, np.zeros(self.n - 1)), np.inf)}

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Whether plays of about one threshold stand in place of the whole signal: a backlash."""
        w, r = np.asarray(values["w"])[1:], np.asarray(values["r"])[1:]
        total = float(np.sum(w))
        if abs(1 + float(values["w"][0])) > DIRECT * total:
            return False
        mean = float(w @ r) / max(total, 1e-300)
        return bool(w @ np.abs(r - mean) < ALIKE * mean * total)

    @classmethod
    def finer_starts(cls, values: Mapping[str, Any], local: Local) -> Iterator[dict[str, Any]]:
        """Each play but the first in two, a little apart."""
        w, r = np.asarray(values["w"]), np.asarray(values["r"])
        apart = np.concatenate([r[:1], 0.8 * r[1:], 1.2 * r[1:]])
        yield {**values, "w": np.concatenate([w[:1], w[1:] / 2, w[1:] / 2]), "r": apart}


class FinePlays(PlayHysteresis):
    """The same with more plays."""

    n = 11
    memory = 11


class GeneralizedHysteresis(PlayHysteresis):
    """Asymmetric hysteresis: plays of a bent signal (Al Janaideh, Rakheja & Su 2011)."""

    form = "generalized_play"
    equation = "w = sum_i w_i play_{r_i}[u + a_2 u^2 + a_3 u^3] + b_2 u^2"
    source = "Al Janaideh, Rakheja & Su (2011), IEEE/ASME Trans. Mechatronics 16(4); Krikelis et al. (2024), Eq. 14"
    units: ClassVar[Mapping[str, str]] = {"w": "w/z", "b_2": "w/z^2", "r": "z", "a_2": "1/z", "a_3": "1/z^2"}
    strength: ClassVar[tuple[str, ...]] = ("w", "b_2")

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """Plays of the bent signal."""
        bent = z + p["a_2"] * z**2 + p["a_3"] * z**3
        w, following = super().step(bent, s, p)
        return w + p["b_2"] * z**2, following

    def parameters(self) -> dict[str, Parameter]:
        """Weights and thresholds, the bend, and a memoryless part."""
        out = super().parameters()
        scalars = {}
        for name in ("b_2", "a_2", "a_3"):
            low, high = self.limits.get(name, (-np.inf, np.inf))
            scalars[name] = Parameter(float(self.values.get(name, 0.0)), unit=self.units[name], bounds=(low, high))
        return {"w": out["w"], "b_2": scalars["b_2"], "r": out["r"], "a_2": scalars["a_2"], "a_3": scalars["a_3"]}

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        for bend in (-0.2, 0.0, 0.2):
            yield {"r": local.half * np.linspace(0.0, 0.9, self.n), "a_2": bend / local.reach, "a_3": 0.0}

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        bend = {"a_2": (-0.4 / local.reach, 0.4 / local.reach), "a_3": (-0.2 / local.reach**2, 0.5 / local.reach**2)}
        return {**super().bounds(local), **bend}

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Whether it is a backlash, or the loops are thin beside the memoryless part: hardly a hysteresis then."""
        reach = self.parameters()["r"].bounds[1]
        wide = np.abs(values["w"]) * np.clip(np.minimum(values["r"], reach - values["r"]), 0.0, None)
        return super().doubtful(values) or bool(np.sum(wide) < THIN * np.max(reach) ** 2 * abs(values["b_2"]))


class FineGeneralized(GeneralizedHysteresis):
    """The same with more plays."""

    n = 11
    memory = 11


class BoucWen(Law):
    """Hysteresis by the Bouc-Wen equation (Bouc 1967; Wen 1976)."""

    id = "hysteresis"
    form = "bouc_wen"
    equation = "w = k_h q,  dq/dt = dz/dt (1 - (1 - s + s sign(q dz/dt)) |q/q_0|^n)"
    source = "Wen (1976), J. Eng. Mech. 102(2); Ismail, Ikhouane & Rodellar (2009)"
    sentence = "rate-independent hysteresis: a force that depends on where the motion last turned round"
    units: ClassVar[Mapping[str, str]] = {"k_h": "w/z", "q_0": "z", "s": "", "n": ""}
    strength: ClassVar[tuple[str, ...]] = ("k_h",)
    dissipative = True
    order = 1

    def force(self, q: Any, p: Any) -> Any:
        return p.k_h * q

    def flow(self, dz: Any, q: Any, p: Any) -> Any:
        """Equation of the hysteretic displacement q, which stays within q_0 but for what a step is too long."""
        size = (ca.fmin(ca.fabs(q / p["q_0"]), 1) + 1e-9) ** p["n"]
        return dz * (1 - (1 - p["s"]) * size) - p["s"] * ca.fabs(dz) * ca.sign(q) * size

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield from grid(q_0=local.half * np.array([0.03, 0.1, 0.3, 0.8]), s=[0.5, 0.8], n=[1.0])

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {"q_0": (2e-3 * local.half, 5 * local.half), "s": (0.3, 1.5), "n": (0.5, 4.0)}


class BoucWenActuator(BoucWen):
    """The same of a signal that moves in steps: an actuator's held input, or a sensor."""

    equation = "w = b z + k_h q,  q+ = q + dz (1 - (1 - s + s sign(q dz)) |q/q_0|^n) at each step dz of z"
    units: ClassVar[Mapping[str, str]] = {"b": "w/z", "k_h": "w/z", "q_0": "z", "s": "", "n": ""}
    strength: ClassVar[tuple[str, ...]] = ("b", "k_h")
    places: ClassVar[tuple[str, ...]] = ("series",)
    dissipative = False
    order = 0
    memory = 2  # q and the z it belongs to

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """Along the chord from the last z, in parts so small that the equation is followed."""
        q, part = s[0], (z - s[1]) / PARTS
        for _ in range(PARTS):
            middle = q + self.flow(part, q, p) / 2
            q = q + self.flow(part, middle, p)
        return p["b"] * z + p["k_h"] * q, ca.vertcat(q, z)


class Backlash(Law):
    """Play between two parts (Nordin & Gutman 2002)."""

    id = "backlash"
    equation = "w = play_r[u] - u"
    source = "Nordin & Gutman (2002), Automatica 38(10)"
    sentence = "backlash: on every reversal the signal is lost until the play is taken up"
    units: ClassVar[Mapping[str, str]] = {"r": "z"}
    places: ClassVar[tuple[str, ...]] = ("series",)
    memory = 1

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """One play."""
        following = play(z, s, p["r"])
        return following - z, following

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield from grid(r=local.half * np.array([0.01, 0.03, 0.08, 0.18, 0.35, 0.6]))

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {"r": (1e-3 * local.half, 0.9 * local.half)}
