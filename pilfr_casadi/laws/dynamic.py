"""Laws in time: delay, relaxation, lags and modes, and trends."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from ..models import Parameter
from .base import Law, Local

LONGEST_SCREENED = 24  # memory of a delay in the screen, in steps; longer delays are not tried
LONGEST_TIME = 2.0  # largest time constant of a relaxation, in durations of the recordings
# largest ratio of a slow part of a signal to what follows at once: in the longest time constant, as much again follows
# within the recordings; beyond that it is a lag
MOST_CREEP = 1 / (1 - np.exp(-1 / LONGEST_TIME))
MOST_DAMPED_MODE = 0.2  # damping ratio from which a mode is doubtful: a judgement, not from a source


@dataclass(frozen=True)
class Delay(Law):
    """A pure delay of the signal, whole samples and a fraction."""

    id = "delay"
    equation = "w = u(t - T) - u(t)"
    source = "Ljung (1999), System Identification, sec. 4.2"
    sentence = "a pure delay: the signal arrives later than the simulator has it"
    units = {"T": "s"}
    places = ("series",)
    shifts = True
    substeps = 4  # a delayed held input changes inside a sample
    h: float = 0.0  # length of a step, s
    starts = {"T": ("dt", 0.5, 1, 1.5, 2, 3, 4, 6, 8, 11, 15, 20)}

    def on_grid(self, h: float) -> Delay:
        return replace(self, h=h)

    @property
    def memory(self) -> int:
        """Largest delay, in steps."""
        most = self.limits.get("T", self._default_limits)[1]
        return int(np.ceil(most / self.h)) if self.h and np.isfinite(most) else LONGEST_SCREENED

    @property
    def lacks(self) -> str:
        """Ask for a start value or a limit, if without it the length of the memory is unknown; else empty."""
        known = np.isfinite(self.limits.get("T", self._default_limits)[1])
        return "" if known else "give the time that it starts at, as in Delay().at({'T': 0.01}); it may come to double"

    @property
    def _default_limits(self) -> tuple[float, float]:
        """Default limits: from zero to twice the start value."""
        return 0.0, 2 * float(np.asarray(self.values.get("T", np.inf)))

    def first_unknowns(self, values: Mapping[str, Any], dt: float) -> int:
        """Samples before the recording that arrive in it."""
        return int(np.ceil(float(np.asarray(values["T"])) / dt))

    def parameters(self) -> dict[str, Parameter]:
        """The delay, within the length of its memory."""
        out = super().parameters()
        return out if "T" in self.limits else {"T": replace(out["T"], bounds=self._default_limits)}

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """Shift the register, and read it between two of its entries."""
        line = ca.vertcat(z, s)
        at = p["T"] / self.h
        weight = [ca.fmax(1 - ca.fabs(at - i), 0) for i in range(self.memory + 1)]
        return sum(weight[i] * line[i] for i in range(self.memory + 1)) - z, line[: self.memory]

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        most = 1.6 * float(np.asarray(self.values["T"])) + 2 * local.dt if "T" in self.values else 24 * local.dt
        return {"T": (0.02 * local.dt, min(most, 30 * local.dt))}


class Relaxation(Law):
    """Creep of a support or material: a spring and a damper in series, in parallel to the rest (Maxwell 1867)."""

    id = "creep"
    equation = "w = k_v (z - q),  dq/dt = (z - q) / T"
    source = "Findley, Lai & Onaran (1976), Creep and Relaxation, ch. 5"
    sentence = "creep: under a constant load the deflection goes on slowly"
    sentences: ClassVar[Mapping[str, str]] = {
        "thermal": "a slow heat capacity behind a thermal resistance",
        "fluid": "a slow store behind a resistance: a second volume or branch",
        "electrical": "a slow store behind a resistance, as of diffusion in a cell or of eddy currents",
    }
    units = {"k_v": "w/z", "T": "s"}
    dissipative = True
    order = follows = 1
    starts = {"T": lambda at: np.geomspace(20 * at.dt, at.duration / 2, 7)}
    ranges = {"T": lambda at: (5 * at.dt, LONGEST_TIME * at.duration)}

    def force(self, z: Any, q: Any, p: Any) -> Any:
        return p.k_v * (z - q)

    def flow(self, z: Any, q: Any, p: Any) -> Any:
        return (z - q) / p.T

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Tell whether a time constant is at its upper bound: then it hardly creeps, like a spring or a gain."""
        return any(values[name] >= p.bounds[1] for name, p in self.parameters().items() if p.unit == "s")


class _TwoStages(Law):
    """The common part of creep with a fast and a slow part."""

    form = "two-stage"
    order = follows = 2
    ranges = dict.fromkeys(("T_1", "T_2"), Relaxation.ranges["T"])

    def flow(self, z: Any, q: Any, p: Any) -> Any:
        return ca.vertcat((z - q[0]) / p.T_1, (z - q[1]) / p.T_2)

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        times = np.geomspace(20 * local.dt, local.duration / 2, 5)
        for fast, slow in itertools.combinations(times, 2):
            yield {"T_1": float(fast), "T_2": float(slow)}


class TwoStageRelaxation(_TwoStages, Relaxation):
    """Creep of a support or material with a fast and a slow part."""

    equation = "w = k_1 (z - q_1) + k_2 (z - q_2),  dq_i/dt = (z - q_i) / T_i"
    units = {"k_1": "w/z", "k_2": "w/z", "T_1": "s", "T_2": "s"}

    def force(self, z: Any, q: Any, p: Any) -> Any:
        return p.k_1 * (z - q[0]) + p.k_2 * (z - q[1])

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Tell also whether its parts pull against each other: nearly equal ones make a rate of z, not creep."""
        return super().doubtful(values) or float(np.asarray(values["k_1"])) * float(np.asarray(values["k_2"])) < 0


class Creep(Relaxation):
    """Creep of an actuator or a sensor: a slow part follows the signal (Kelvin-Voigt element)."""

    equation = "w = c q,  dq/dt = (u - q) / T"
    source = "Kuhnen & Janocha (2002), Control and Intelligent Systems 30(1)"
    sentence = "creep: after a step the signal goes on slowly in the same direction"
    sentences: ClassVar[Mapping[str, str]] = {}
    units = {"c": "", "T": "s"}
    strength: ClassVar[tuple[str, ...]] = ("c",)
    places = ("series",)
    dissipative = False
    # with a negative strength the signal would come back; if most of it came slowly, it would be a lag
    ranges = {**Relaxation.ranges, "c": ("", 0.0, MOST_CREEP)}

    def force(self, q: Any, p: Any) -> Any:  # type: ignore[override]
        return p.c * q

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Tell whether most of the signal comes slowly, as behind a lag, or it hardly creeps."""
        return super().doubtful(values) or any(values[name] >= MOST_CREEP for name in self.strength)


class TwoStageCreep(_TwoStages, Creep):
    """Creep of an actuator or a sensor with a fast and a slow part."""

    equation = "w = c_1 q_1 + c_2 q_2,  dq_i/dt = (u - q_i) / T_i"
    units = {"c_1": "", "c_2": "", "T_1": "s", "T_2": "s"}
    strength = ("c_1", "c_2")
    ranges = {**_TwoStages.ranges, "c_1": ("", 0.0, MOST_CREEP), "c_2": ("", 0.0, MOST_CREEP)}

    def force(self, q: Any, p: Any) -> Any:  # type: ignore[override]
        return p.c_1 * q[0] + p.c_2 * q[1]


class Lag(Law):
    """An actuator or a sensor that follows with a lag."""

    id = "extra_mode"
    flexible = True
    form = "lag"
    equation = "w = q - u,  dq/dt = (u - q) / T"
    source = "Franklin, Powell & Emami-Naeini (2015), sec. 3.3"
    sentence = "an unmodelled lag: the signal follows with a time constant"
    units = {"T": "s"}
    places = ("series",)
    order = follows = 1
    starts = {"T": ("dt", *np.geomspace(0.25, 40, 8))}
    ranges = {"T": lambda at: (0.15 * at.dt, at.duration / 4)}
    substeps = 4  # a lag may be shorter than a sample

    def force(self, z: Any, q: Any, p: Any) -> Any:
        return q - z

    def flow(self, z: Any, q: Any, p: Any) -> Any:
        return (z - q) / p.T


class Resonance(Law):
    """An actuator or a sensor with dynamics of second order."""

    id = "extra_mode"
    flexible = True
    form = "resonance"
    equation = "w = q_1 - u,  d2q_1/dt2 = W^2 (u - q_1) - 2 D W dq_1/dt"
    source = "Franklin, Powell & Emami-Naeini (2015), sec. 3.3"
    sentence = "an unmodelled resonance in the path of the signal"
    units = {"W": "rad/s", "D": ""}
    places: ClassVar[tuple[str, ...]] = ("series",)
    absent: ClassVar[tuple[str, ...]] = ("thermal",)  # heat has no inertia
    order, follows = 2, 1
    starts = {"W": lambda at: np.geomspace(0.015, 1.2, 16) / at.dt, "D": ("", 0.05, 0.5)}
    ranges = {"W": lambda at: (8 / at.duration, 1.6 / at.dt), "D": ("", 1e-3, 1.0)}

    def force(self, z: Any, q: Any, p: Any) -> Any:
        return q[0] - z

    def flow(self, z: Any, q: Any, p: Any) -> Any:
        return ca.vertcat(p.W * q[1], p.W * (z - q[0]) - 2 * p.D * p.W * q[1])


class Mode(Resonance):
    """A mode beside the path of the signal."""

    form = "mode"
    equation = "w = c_1 q_1 + c_2 q_2,  dq_1/dt = W q_2,  dq_2/dt = W (u - q_1) - 2 D W q_2"
    source = "Preumont (2011), Vibration Control of Active Structures, sec. 2.6"
    sentence = "an unmodelled mode that the signal excites"
    units = {"c_1": "w/z", "c_2": "w/z", "W": "rad/s", "D": ""}
    places = ("parallel", "series")
    starts = {**Resonance.starts, "D": ("", 0.05)}  # a mode that damps more is doubtful

    def force(self, q: Any, p: Any) -> Any:  # type: ignore[override]
        return p.c_1 * q[0] + p.c_2 * q[1]

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Tell whether it is damped more than modes of machines are, or too fast or too slow to be visible.

        With strengths of either sign it then imitates nearly anything linear, or a drift.
        """
        slowest, fastest = self.parameters()["W"].bounds
        return bool(values["D"] > MOST_DAMPED_MODE or not slowest < values["W"] < fastest)


class SprungMass:
    """The common part of laws with a mass behind a spring and a damper; q are its travel, and its speed over W."""

    def pull(self, z: Any, dz: Any, q: Any, p: Any) -> Any:
        """Force of spring and damper over the spring's stiffness."""
        return z - q[0] + 2 * p.D * (dz / p.W - q[1])

    def far_side(self, q: Any, p: Any) -> tuple[Any, Any]:
        """Travel and speed of the mass."""
        return q[0], p.W * q[1]


class Attached(SprungMass, Resonance):
    """A small mass on a spring and a damper, carried along (a tuned absorber, a loose part)."""

    form = "attached mass"
    equation = "w = k_a (z - q) + 2 D k_a / W (dz/dt - dq/dt),  d2q/dt2 = W^2 w / k_a"
    source = "Den Hartog (1956), Mechanical Vibrations, sec. 3.2"
    sentence = "an unmodelled mode: a part on a spring of its own that is carried along"
    units = {"k_a": "w/z", "W": "rad/s", "D": ""}
    domains = ("mechanical",)
    places = ("parallel",)
    dissipative = True
    starts = {"W": lambda at: np.geomspace(0.015, 1.2, 32) / at.dt, "D": ("", 0.05)}

    def force(self, z: Any, dz: Any, q: Any, p: Any) -> Any:  # type: ignore[override]
        return p.k_a * self.pull(z, dz, q, p)

    def flow(self, z: Any, dz: Any, q: Any, p: Any) -> Any:  # type: ignore[override]
        """Rates of its travel and of its speed over W."""
        return ca.vertcat(p.W * q[1], p.W * self.pull(z, dz, q, p))


class ElasticJoint(Attached):
    """A mass behind a spring and a damper, whose motion the sensors measure (a gear with a sensor at its output)."""

    form = "elastic joint"
    equation = f"{Attached.equation},  outputs read q in place of z"
    source = "Spong (1987), Journal of Dynamic Systems, Measurement, and Control 109(4)"
    sentence = "an elastic joint: the sensor sees the far side of a spring that the simulator takes for rigid"
    sensed = True
    starts = {"W": lambda at: np.geomspace(0.03, 1.0, 8) / at.dt, "D": ("", 0.05)}


class Drift(Law):
    """A slow trend in time."""

    id = "drift"
    flexible = True
    equation = "w = a t + b t^2"
    source = "Ljung (1999), System Identification, sec. 14.1"
    sentence = "a slow trend in time that no input explains"
    units = {"a": "w/s", "b": "w/s^2"}
    places = ("parallel", "series")

    def force(self, t: Any, p: Any) -> Any:
        return p.a * t + p.b * t**2


class Settling(Drift):
    """A warm-up or a decay towards a level."""

    form = "settling"
    equation = "w = a exp(-t / T) + b"
    source = "Ljung (1999), System Identification, sec. 14.1; Incropera et al. (2007), sec. 5.1"
    units = {"a": "w", "b": "w", "T": "s"}
    starts = {"T": ("duration", 0.05, 0.15, 0.4, 1.0)}
    ranges = {"T": ("duration", 0.02, 3)}

    def force(self, t: Any, p: Any) -> Any:
        return p.a * ca.exp(-t / p.T) + p.b


class Swing(Drift):
    """A slow oscillation, such as a room's temperature over a day."""

    form = "swing"
    equation = "w = a cos(2 pi t / T) + b sin(2 pi t / T) + c"
    units = {"a": "w", "b": "w", "c": "w", "T": "s"}
    starts = {"T": ("duration", 0.4, 0.7, 1.0, 1.5, 2.5)}
    ranges = {"T": ("duration", 0.25, 4)}

    def force(self, t: Any, p: Any) -> Any:
        angle = 2 * np.pi * t / p.T
        return p.a * ca.cos(angle) + p.b * ca.sin(angle) + p.c
