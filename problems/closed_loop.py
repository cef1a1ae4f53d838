"""Controllers on a true simulator: what `mpc_piezo` and `mpc_masing` share.

At each sample the input that was computed in the sample before is applied, and the sensor is read with noise: a
controller that plans has one sample of time for it. The reference touches the limits that the controllers are told,
which stay a margin inside those of the machine.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pilfr_casadi.control import PredictiveController, do_mpc_controller, feedforward, kalman_filter
from pilfr_casadi.data import Recording
from pilfr_casadi.identify import Fit

from .controllers import ByDoMpc, Compensated, Controller, Given, Plant, Predictive, ProportionalIntegral

Array = np.ndarray
LINEAR, HYSTERESIS, PI = "MPC, linear model", "MPC, hysteresis model", "PI control"
MOVE = 1e-4  # weight of moves
ITERATIONS = 1  # of SQP per sample: the real-time iteration, which leaves most of a millisecond free


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
    controller: Controller,
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


def table(outcomes: list[Outcome], unit: str, sample_time: float, tolerance: float) -> str:
    """Table of outcomes; errors also as shares of that of linear predictive control."""
    base = next(o.error for o in outcomes if o.name == LINEAR)
    lines = [
        f"{'controller':<36}{'rms error':>11}{'/ linear MPC':>14}{'violation':>12}{'solve time, median / max':>26}",
        f"{'':<36}{unit:>11}{'':>14}{f'/ {tolerance:.2g} {unit}':>12}{f'ms, of {1e3 * sample_time:.3g} ms':>26}",
    ]
    for o in outcomes:
        spent = f"{1e3 * o.median:.2f} / {1e3 * o.slowest:.2f}" if o.slowest else "-"
        lines.append(f"{o.name:<36}{o.error:>11.3g}{o.error / base:>14.3f}{o.violation / tolerance:>12.2f}{spent:>26}")
    return "\n".join(lines)


def apart(outcomes: list[Outcome], unit: str, skip: int) -> list[str]:
    """How far the loops of one model by other solvers are from that by SQP, a line each."""
    ours = next(o for o in outcomes if o.name == HYSTERESIS)
    others = [o for o in outcomes if o.name.startswith(f"{HYSTERESIS}, ")]
    return [f"{o.name}: {np.sqrt(np.mean((o.y - ours.y)[skip:] ** 2)):.2g} {unit} rms from that by SQP" for o in others]


@dataclass(frozen=True)
class Task:
    """What has to be tracked, and on what.

    Attributes
    ----------
    plant : callable
        Gives a fresh plant at rest.
    reference : array, (M,)
        Wanted output.
    inputs, outputs : (low, high)
        Limits; the controllers are told those of the output less `margin`.
    noise : float
        Standard deviation of the sensor.
    y_scale, u_scale : float
        See `PredictiveController`.
    skip : int
        Samples at the beginning that are not scored.
    """

    plant: Callable[[], Plant]
    reference: Array
    inputs: tuple[float, float]
    outputs: tuple[float, float]
    margin: float
    noise: float
    y_scale: float
    u_scale: float
    skip: int = 50
    horizon: int = 20

    def close(self, name: str, controller: Controller) -> Outcome:
        """The loop with a controller."""
        return run(name, self.plant(), controller, self.reference, self.noise, outputs=self.outputs, skip=self.skip)

    def planner(self, function: Any, move: float, solver: str = "sqp") -> Any:
        """Predictive control with a model, by a solver of `PredictiveController` or by "do-mpc"."""
        limits = self.outputs[0] + self.margin, self.outputs[1] - self.margin
        scales: dict[str, Any] = {"y_scale": self.y_scale, "u_scale": self.u_scale}
        if solver == "do-mpc":
            common: dict[str, Any] = {"inputs": self.inputs, "outputs": limits, "move": move}
            return do_mpc_controller(function, self.horizon, self.reference, **common, **scales)
        options: dict[str, Any] = {"inputs": self.inputs, "outputs": limits, "move": move, "solver": solver, **scales}
        return PredictiveController(function, self.horizon, iterations=ITERATIONS, **options)


def compare(
    task: Task, linear: Fit, hysteresis: Fit, train: Recording, *, quick: bool, solvers: Sequence[str]
) -> list[Outcome]:
    """All controllers on one task.

    PI and linear predictive control are tuned on the task itself, over their gains and over the observer's noise,
    disturbance model and weight of moves; those with the hysteresis model take their defaults.
    """
    p = {k: v.value for k, v in linear.model.parameters.items()}
    gain = (p["C_y"] @ np.linalg.solve(np.eye(len(p["A"])) - p["A"], p["B_u"]) + p["D_yu"]).item()
    proportional = (0.0,) if quick else (0.0, 0.1, 0.3, 1.0)
    integral = (0.05,) if quick else (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2)
    loops = [
        task.close(PI, ProportionalIntegral(task.reference, gain, a / gain, b / gain, task.inputs))
        for a in proportional
        for b in integral
    ]
    out = [min(loops, key=lambda o: o.error if np.isfinite(o.error) else np.inf)]
    loops = []
    for share in (0.3,) if quick else (0.03, 0.1, 0.3, 1.0):
        for disturbance in (True,) if quick else (False, True):
            observer = kalman_filter(linear, train, disturbance=disturbance, share=share)
            for move in (MOVE,) if quick else (0.1 * MOVE, MOVE, 10 * MOVE):
                planner = task.planner(observer.function, move)
                loops.append(task.close(LINEAR, Predictive(planner, observer, task.reference)))
    out.append(min(loops, key=lambda o: o.error))
    observer = kalman_filter(hysteresis, train)
    for solver in ("sqp", *solvers):
        planner, name = task.planner(observer.function, MOVE, solver), HYSTERESIS
        if solver == "do-mpc":
            out.append(task.close(f"{name}, do-mpc", ByDoMpc(planner, observer)))
        else:
            name += f", {solver}" if solver != "sqp" else ""
            out.append(task.close(name, Predictive(planner, observer, task.reference)))
    inverse = feedforward(hysteresis, train, limits=task.inputs)
    out.append(task.close("inverse on the observer's state", Compensated(inverse, observer, task.reference)))
    out.append(task.close("inverse, no sensor", Given(inverse.inputs(task.reference)[:, 0])))
    return out


def draw(outcomes: list[Outcome], task: Task, dt: float, units: tuple[str, str], path: Path) -> None:
    """Outputs, errors of the linear model and better, errors of the hysteresis model alone, inputs; units as printed.

    PI control, whose errors are several times larger, is shown by its output only.
    """
    from pilfr_casadi import plots
    from pilfr_casadi.plots.canvas import BLUE, GREEN, GREY, INK, ORANGE, VERMILLION, choose_scale, finish

    t = dt * np.arange(len(task.reference))
    drawn = [o for o in outcomes if o.name.count(",") < 2 and "no sensor" not in o.name]
    looks = dict(zip([o.name for o in drawn], [ORANGE, VERMILLION, BLUE, GREEN], strict=True))
    errors = {o.name: o.y - task.reference for o in drawn if o.name != PI}
    close = {name: error for name, error in errors.items() if name != LINEAR}
    figure = plots.new_figure(8.0, 10.0)
    top, middle, near, low = figure.subplots(4, 1, sharex=True)
    scale, unit = _prefixed(*choose_scale(task.reference, units[0]))
    for value in task.outputs:
        top.axhline(value / scale, color=GREY, linewidth=1, linestyle=":")
    for o in drawn:
        top.plot(t, o.y / scale, color=looks[o.name], linewidth=1.4, label=o.name)
    top.plot(t, task.reference / scale, color=INK, linewidth=0.9, linestyle=(0, (1, 3)), label="reference")
    finish(top, "", f"output [{unit}]", columns=3)
    for axes, shown in ((middle, errors), (near, close)):
        worst = max(float(np.max(np.abs(e[task.skip :]))) for e in shown.values())
        scale, unit = _prefixed(*choose_scale(np.array([worst]), units[0]))
        for name, error in shown.items():
            axes.plot(t, error / scale, color=looks[name], linewidth=1.0)
        axes.set_ylim(-1.1 * worst / scale, 1.1 * worst / scale)
        finish(axes, "", f"error [{unit}]", legend=False)
    for o in drawn:
        low.step(t, o.u, color=looks[o.name], linewidth=0.7, where="post")
    finish(low, "time [s]", f"input [{units[1]}]", legend=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def _prefixed(scale: float, unit: str) -> tuple[float, str]:
    """Millimetres for 10⁻³ m, and the like."""
    power, _, plain = unit.rpartition(" ")
    prefixes = {("10⁻³", "m"): "mm", ("10⁻⁶", "m"): "µm", ("10⁻³", "µm"): "nm"}
    return scale, prefixes.get((power, plain), unit)


def program(
    about: str | None,
    name: str,
    outcomes: Callable[..., tuple[list[Outcome], Task]],
    units: tuple[str, str],
    dt: float,
    tolerance: float,
    arguments: Sequence[str] | None,
) -> None:
    """The command of a benchmark: print the table, draw the loops; units are those of output and input."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs", name), help="folder for the picture")
    parser.add_argument("--ipopt", action="store_true", help="plan by IPOPT and multiple shooting as well")
    parser.add_argument("--do-mpc", action="store_true", help="plan by do-mpc as well, which has to be installed")
    options = parser.parse_args(arguments)
    results, task = outcomes(solvers=("ipopt",) * options.ipopt + ("do-mpc",) * options.do_mpc)
    print(table(results, units[0], dt, tolerance))
    print("\n".join(apart(results, units[0], task.skip)))
    picture = options.out / f"{name}.png"
    draw(results, task, dt, units, picture)
    print(f"picture: {picture}")
