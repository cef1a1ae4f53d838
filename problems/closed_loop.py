"""Controllers on a true simulator: what `mpc_piezo` and `mpc_masing` share.

A plant is anything with `y` (the output before the next input acts) and `advance(u)`. At each sample the sensor is read
with noise, and the input that was computed in the sample before is applied: a controller that plans has one sample of
time for it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from pilfr_casadi.feedback import Feedforward, KalmanFilter, PredictiveController

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


@dataclass
class Predictive:
    """Predictive control on the state of an observer."""

    planner: PredictiveController
    observer: KalmanFilter
    reference: Array
    seconds: list[float] = field(default_factory=list)
    before: float = 0.0

    def __post_init__(self) -> None:
        self.x, self.p = self.observer.x0, self.observer.Q

    def decide(self, k: int) -> float:
        """First input of the plan."""
        ahead = np.minimum(k + np.arange(self.planner.horizon), len(self.reference) - 1)
        plan = self.planner(self.x, self.reference[ahead], np.array([self.before]))
        self.seconds.append(plan.seconds)
        return float(plan.u[0])

    def hear(self, u: float, y: float) -> None:
        """Filter."""
        x, self.p, _ = self.observer.step(self.x, self.p, u, y)
        self.x, self.before = np.asarray(x).ravel(), u


@dataclass
class Compensated:
    """The inverse of the model on the state of an observer."""

    inverse: Feedforward
    observer: KalmanFilter
    reference: Array

    def __post_init__(self) -> None:
        self.x, self.p, self.before = self.observer.x0, self.observer.Q, 0.0

    def decide(self, k: int) -> float:
        """The input for what is wanted `ahead` samples later."""
        wanted = self.reference[min(k + self.inverse.ahead, len(self.reference) - 1)]
        return float(self.inverse.step(self.x, self.before, wanted)[1])

    def hear(self, u: float, y: float) -> None:
        """Filter."""
        x, self.p, _ = self.observer.step(self.x, self.p, u, y)
        self.x, self.before = np.asarray(x).ravel(), u


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


@dataclass(frozen=True, eq=False)
class Outcome:
    """A closed loop: true output, inputs, and figures over the samples from `skip` on."""

    name: str
    y: Array
    u: Array
    error: float
    violation: float
    median: float
    slowest: float


def run(
    name: str,
    plant: Plant,
    controller: Any,
    reference: Array,
    noise: float,
    *,
    outputs: tuple[float, float],
    skip: int = 0,
    seed: int = 0,
) -> Outcome:
    """Close the loop; the error is the rms of the true output's deviation, the violation the worst beyond `outputs`."""
    rng, m = np.random.default_rng(seed), len(reference)
    y, u = np.zeros(m), np.zeros(m)
    for k in range(m):
        y[k] = plant.y
        u[k] = controller.decide(k)
        controller.hear(u[k], y[k] + noise * rng.standard_normal())
        plant.advance(u[k])
    error = float(np.sqrt(np.mean((y - reference)[skip:] ** 2)))
    over = float(max(0.0, np.max(y) - outputs[1], outputs[0] - np.min(y)))
    seconds = np.array(getattr(controller, "seconds", []) or [0.0])
    return Outcome(name, y, u, error, over, float(np.median(seconds)), float(np.max(seconds)))


def table(outcomes: list[Outcome], unit: str, against: str, sample_time: float) -> str:
    """Table of outcomes; errors also as shares of that of the one named `against`."""
    base = next(o.error for o in outcomes if o.name == against)
    lines = [
        f"{'controller':<34}{'rms error':>12}{'/ ' + against:>16}{'violation':>12}{'solve time median / max':>28}",
        f"{'':<34}{unit:>12}{'':>16}{unit:>12}{f'ms, of {1e3 * sample_time:.3g} ms':>28}",
    ]
    for o in outcomes:
        spent = f"{1e3 * o.median:.2f} / {1e3 * o.slowest:.2f}" if o.slowest else "-"
        lines.append(f"{o.name:<34}{o.error:>12.4g}{o.error / base:>16.3f}{o.violation:>12.2g}{spent:>28}")
    return "\n".join(lines)


def tuned(make: Callable[[float], Outcome], values: Array) -> Outcome:
    """The outcome with the smallest error among values of a tuning knob: the opponent gets its best."""
    return min((make(float(v)) for v in values), key=lambda o: o.error if np.isfinite(o.error) else np.inf)


def draw(outcomes: list[Outcome], reference: Array, dt: float, unit: str, path: Path, outputs: tuple[float, float]) -> None:
    """Reference and outputs above, errors in the middle, inputs below."""
    from pilfr_casadi import plots
    from pilfr_casadi.plots.canvas import BLUE, GREEN, GREY, INK, ORANGE, PURPLE, VERMILLION, finish

    t, colours = dt * np.arange(len(reference)), [VERMILLION, BLUE, GREEN, ORANGE, PURPLE]
    figure = plots.new_figure(8.0, 8.0)
    top, middle, low = figure.subplots(3, 1, sharex=True)
    for value in outputs:
        if np.isfinite(value) and abs(value) < 3 * np.max(np.abs(reference)):
            top.axhline(value, color=GREY, linewidth=1, linestyle=":")
    top.plot(t, reference, color=INK, linewidth=1, linestyle="--", label="reference")
    for o, colour in zip(outcomes, colours, strict=False):
        top.plot(t, o.y, color=colour, linewidth=1.2, label=o.name)
        middle.plot(t, o.y - reference, color=colour, linewidth=1.0)
        low.step(t, o.u, color=colour, linewidth=0.9, where="post")
    finish(top, "", f"output [{unit}]", columns=3)
    finish(middle, "", f"error [{unit}]")
    finish(low, "time [s]", "input")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
