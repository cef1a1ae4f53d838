"""Controllers of the closed loops: predictive control, inversion, PI.

Each gives the input of a sample before that sample is measured, as a machine that computes for one sample has to.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from time import perf_counter
from typing import Any, Protocol

import numpy as np

from pilfr_casadi.control import Feedforward, KalmanFilter, PredictiveController

Array = np.ndarray


class Plant(Protocol):
    """A true simulator."""

    @property
    def y(self) -> float:
        """Output before the next input acts."""

    def advance(self, u: float) -> None:
        """Hold an input for one sample."""


class Controller(Protocol):
    """Gives the input of sample k and then hears what was measured in it."""

    def decide(self, k: int) -> float:
        """Input of sample k."""

    def hear(self, u: float, y: float) -> None:
        """Take notice of sample k."""


class Tracked:
    """The state that an observer holds to be true."""

    def __init__(self, observer: KalmanFilter) -> None:
        self.observer, self.x, self.p = observer, observer.x0, observer.Q

    def hear(self, u: float, y: float) -> None:
        """Filter."""
        x, self.p, _ = self.observer.step(self.x, self.p, u, y)
        self.x = np.asarray(x).ravel()


@dataclass
class Predictive:
    """Predictive control on the state of an observer."""

    planner: PredictiveController
    observer: KalmanFilter
    reference: Array
    seconds: list[float] = field(default_factory=list)
    before: float = 0.0

    def __post_init__(self) -> None:
        self.state = Tracked(self.observer)

    def decide(self, k: int) -> float:
        """First input of the plan."""
        ahead = np.minimum(k + np.arange(self.planner.horizon), len(self.reference) - 1)
        plan = self.planner(self.state.x, self.reference[ahead], np.array([self.before]))
        self.seconds.append(plan.seconds)
        return float(plan.u[0])

    def hear(self, u: float, y: float) -> None:
        """Filter."""
        self.state.hear(u, y)
        self.before = u


@dataclass
class ByDoMpc:
    """The same predictive control by do-mpc, which is handed the whole reference when it is made."""

    planner: Any
    observer: KalmanFilter
    seconds: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.state = Tracked(self.observer)
        self.planner.x0, self.planner.u0 = self.state.x[:, None], np.zeros((1, 1))
        self.planner.set_initial_guess()

    def decide(self, k: int) -> float:
        """First input of the plan."""
        begin = perf_counter()
        u = float(np.asarray(self.planner.make_step(self.state.x[:, None])).item())
        self.seconds.append(perf_counter() - begin)
        return u

    def hear(self, u: float, y: float) -> None:
        """Filter."""
        self.state.hear(u, y)


@dataclass
class Compensated:
    """The inverse of the model on the state of an observer."""

    inverse: Feedforward
    observer: KalmanFilter
    reference: Array
    before: float = 0.0

    def __post_init__(self) -> None:
        self.state = Tracked(self.observer)

    def decide(self, k: int) -> float:
        """The input for what is wanted `ahead` samples later."""
        wanted = self.reference[min(k + self.inverse.ahead, len(self.reference) - 1)]
        return float(self.inverse.step(self.state.x, self.before, wanted)[1])

    def hear(self, u: float, y: float) -> None:
        """Filter."""
        self.state.hear(u, y)
        self.before = u


@dataclass
class Given:
    """A path of inputs computed beforehand, without feedback."""

    inputs: Array

    def decide(self, k: int) -> float:
        """Input of sample k."""
        return float(self.inputs[k])

    def hear(self, u: float, y: float) -> None:
        """Nothing is heard."""


@dataclass
class ProportionalIntegral:
    """PI control with the static feed-forward `u = r / gain`; the integral rests while the input is at a limit."""

    reference: Array
    gain: float
    proportional: float
    integral: float
    limits: tuple[float, float]
    total: float = 0.0
    error: float = 0.0

    def decide(self, k: int) -> float:
        """Input from the error that was heard last."""
        u = self.reference[k] / self.gain + self.proportional * self.error + self.integral * self.total
        self._k = k
        return float(np.clip(u, *self.limits))

    def hear(self, u: float, y: float) -> None:
        """Integrate."""
        self.error = float(self.reference[self._k]) - y
        if self.limits[0] < u < self.limits[1]:
            self.total += self.error
