"""Laws with memory: hysteresis in its forms, backlash, delay, and linear relaxations and modes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from ..operators import play
from ..parameters import Parameter
from .base import Law, Local, grid


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
        """Equation of the hysteretic displacement q."""
        size = (ca.fabs(q / p.q_0) + 1e-9) ** p.n
        return dz * (1 - (1 - p.s) * size) - p.s * ca.fabs(dz) * ca.sign(q) * size

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield from grid(q_0=local.half * np.array([0.03, 0.1, 0.3, 0.8]), s=[0.5, 0.8], n=[1.0])

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {"q_0": (2e-3 * local.half, 5 * local.half), "s": (0.3, 1.5), "n": (0.5, 4.0)}


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


@dataclass(frozen=True)
class Delay(Law):
    """A pure delay of the signal, whole samples and a fraction."""

    id = "delay"
    equation = "w = u(t - T) - u(t)"
    source = "Ljung (1999), System Identification, sec. 4.2"
    sentence = "a pure delay: the signal arrives later than the simulator has it"
    units: ClassVar[Mapping[str, str]] = {"T": "s"}
    places: ClassVar[tuple[str, ...]] = ("series",)
    shifts: ClassVar[bool] = True
    h: float = 0.0  # length of a step, s

    def on_grid(self, h: float) -> Delay:
        """The law for steps of length h."""
        return replace(self, h=h)

    @property
    def memory(self) -> int:
        """Steps that the delay may reach back."""
        return int(np.ceil(self.limits["T"][1] / self.h)) if self.h and "T" in self.limits else 24

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """A shift register, read between two of its places."""
        line = ca.vertcat(z, s)
        at = p["T"] / self.h
        weight = [ca.fmax(1 - ca.fabs(at - i), 0) for i in range(self.memory + 1)]
        return sum(weight[i] * line[i] for i in range(self.memory + 1)) - z, line[: self.memory]

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield from grid(T=local.dt * np.array([0.5, 1, 1.5, 2, 3, 4, 6, 8, 11, 15, 20]))

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        most = 1.6 * float(np.asarray(self.values["T"])) + 2 * local.dt if "T" in self.values else 24 * local.dt
        return {"T": (0.02 * local.dt, min(most, 30 * local.dt))}


class Relaxation(Law):
    """Creep of a support or material: a spring and a damper in series, beside what is there (Maxwell 1867)."""

    id = "creep"
    equation = "w = k_v (z - q),  dq/dt = (z - q) / T"
    source = "Findley, Lai & Onaran (1976), Creep and Relaxation, ch. 5"
    sentence = "creep: under a constant load the deflection goes on slowly"
    units: ClassVar[Mapping[str, str]] = {"k_v": "w/z", "T": "s"}
    strength: ClassVar[tuple[str, ...]] = ("k_v",)
    dissipative = True
    order = 1

    def force(self, z: Any, q: Any, p: Any) -> Any:
        return p.k_v * (z - q)

    def flow(self, z: Any, q: Any, p: Any) -> Any:
        """The damper's travel."""
        return (z - q) / p.T

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield from grid(T=np.geomspace(20 * local.dt, local.duration / 2, 7))

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {"T": (5 * local.dt, 2 * local.duration)}


class Creep(Relaxation):
    """Creep of an actuator or a sensor: a slow part follows the signal (Kelvin-Voigt element)."""

    equation = "w = c q,  dq/dt = (u - q) / T"
    source = "Kuhnen & Janocha (2002), Control and Intelligent Systems 30(1)"
    sentence = "creep: after a step the signal goes on slowly in the same direction"
    units: ClassVar[Mapping[str, str]] = {"c": "", "T": "s"}
    strength: ClassVar[tuple[str, ...]] = ("c",)
    places: ClassVar[tuple[str, ...]] = ("series",)
    dissipative = False

    def force(self, q: Any, p: Any) -> Any:  # type: ignore[override]
        return p.c * q


class TwoStageCreep(Creep):
    """Creep with a fast and a slow part."""

    form = "two-stage"
    equation = "w = c_1 q_1 + c_2 q_2,  dq_i/dt = (u - q_i) / T_i"
    units: ClassVar[Mapping[str, str]] = {"c_1": "", "c_2": "", "T_1": "s", "T_2": "s"}
    strength: ClassVar[tuple[str, ...]] = ("c_1", "c_2")
    order = 2

    def force(self, q: Any, p: Any) -> Any:  # type: ignore[override]
        return p.c_1 * q[0] + p.c_2 * q[1]

    def flow(self, z: Any, q: Any, p: Any) -> Any:
        """Both parts."""
        return ca.vertcat((z - q[0]) / p.T_1, (z - q[1]) / p.T_2)

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        times = np.geomspace(20 * local.dt, local.duration / 2, 5)
        for i, fast in enumerate(times):
            for slow in times[i + 1 :]:
                yield {"T_1": float(fast), "T_2": float(slow)}

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {name: (5 * local.dt, 2 * local.duration) for name in ("T_1", "T_2")}


class Lag(Law):
    """An actuator or a sensor that follows with a lag."""

    id = "extra_mode"
    form = "lag"
    equation = "w = q - u,  dq/dt = (u - q) / T"
    source = "Franklin, Powell & Emami-Naeini (2015), sec. 3.3"
    sentence = "an unmodelled lag: the signal follows with a time constant"
    units: ClassVar[Mapping[str, str]] = {"T": "s"}
    places: ClassVar[tuple[str, ...]] = ("series",)
    order = 1

    def force(self, z: Any, q: Any, p: Any) -> Any:
        return q - z

    def flow(self, z: Any, q: Any, p: Any) -> Any:
        """First order."""
        return (z - q) / p.T

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield from grid(T=local.dt * np.geomspace(0.7, 40, 7))

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {"T": (0.4 * local.dt, local.duration / 4)}


class Resonance(Law):
    """An actuator or a sensor with dynamics of second order."""

    id = "extra_mode"
    form = "resonance"
    equation = "w = q_1 - u,  d2q_1/dt2 = W^2 (u - q_1) - 2 D W dq_1/dt"
    source = "Franklin, Powell & Emami-Naeini (2015), sec. 3.3"
    sentence = "an unmodelled resonance in the path of the signal"
    units: ClassVar[Mapping[str, str]] = {"W": "rad/s", "D": ""}
    places: ClassVar[tuple[str, ...]] = ("series",)
    order = 2

    def force(self, z: Any, q: Any, p: Any) -> Any:
        return q[0] - z

    def flow(self, z: Any, q: Any, p: Any) -> Any:
        """Second order."""
        return ca.vertcat(p.W * q[1], p.W * (z - q[0]) - 2 * p.D * p.W * q[1])

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield from grid(W=np.geomspace(0.015, 1.2, 16) / local.dt, D=[0.05])

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {"W": (8 / local.duration, 1.6 / local.dt), "D": (1e-3, 2.0)}


class Mode(Resonance):
    """A mode beside the path of the signal."""

    form = "mode"
    equation = "w = c_1 q_1 + c_2 q_2,  dq_1/dt = W q_2,  dq_2/dt = W (u - q_1) - 2 D W q_2"
    source = "Preumont (2011), Vibration Control of Active Structures, sec. 2.6"
    sentence = "an unmodelled mode that the signal excites"
    units: ClassVar[Mapping[str, str]] = {"c_1": "w/z", "c_2": "w/z", "W": "rad/s", "D": ""}
    strength: ClassVar[tuple[str, ...]] = ("c_1", "c_2")
    places: ClassVar[tuple[str, ...]] = ("parallel", "series")

    def force(self, q: Any, p: Any) -> Any:  # type: ignore[override]
        return p.c_1 * q[0] + p.c_2 * q[1]


class Attached(Resonance):
    """A small mass on a spring, carried along (a tuned absorber, a loose part)."""

    form = "attached mass"
    equation = "w = k_a (z - q_1),  d2q_1/dt2 = W^2 (z - q_1) - 2 D W dq_1/dt"
    source = "Den Hartog (1956), Mechanical Vibrations, sec. 3.2"
    sentence = "an unmodelled mode: a part on a spring of its own that is carried along"
    units: ClassVar[Mapping[str, str]] = {"k_a": "w/z", "W": "rad/s", "D": ""}
    strength: ClassVar[tuple[str, ...]] = ("k_a",)
    places: ClassVar[tuple[str, ...]] = ("parallel",)

    def force(self, z: Any, q: Any, p: Any) -> Any:
        return p.k_a * (z - q[0])


class Drift(Law):
    """A slow trend in time."""

    id = "drift"
    equation = "w = a t + b t^2"
    source = "Ljung (1999), System Identification, sec. 14.1"
    sentence = "a slow trend in time that no input explains"
    units: ClassVar[Mapping[str, str]] = {"a": "w/s", "b": "w/s^2"}
    strength: ClassVar[tuple[str, ...]] = ("a", "b")
    places: ClassVar[tuple[str, ...]] = ("parallel", "series")

    def force(self, t: Any, p: Any) -> Any:
        return p.a * t + p.b * t**2


class Settling(Drift):
    """A warm-up that comes to an end."""

    form = "settling"
    equation = "w = a (1 - exp(-t / T))"
    source = "Ljung (1999), System Identification, sec. 14.1; Incropera et al. (2007), sec. 5.1"
    units: ClassVar[Mapping[str, str]] = {"a": "w", "T": "s"}
    strength: ClassVar[tuple[str, ...]] = ("a",)

    def force(self, t: Any, p: Any) -> Any:
        return p.a * (1 - ca.exp(-t / p.T))

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        yield from grid(T=local.duration * np.array([0.05, 0.15, 0.4, 1.0]))

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        return {"T": (0.02 * local.duration, 3 * local.duration)}
