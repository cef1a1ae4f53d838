"""The hidden force in a port: recovered from recordings without the help of a law, and drawn.

The corrected simulator without the law, linearised along the corrected run, is driven by an unknown force and smoothed
(see `smoother.py`). A nonlinear simulator is linearised again along the result.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from .. import plots
from .._base import InputError
from ..data import Recording
from ..diagnose import Constant, Fitted, Workbench
from ..models import Model, ParameterSet, map_points
from ..plots import Signal
from ..simulators import ClosedEquations, Instant, Simulator, discretise, on_grid, signals, states_along
from .page import Block, Picture, Text
from .smoother import UnknownForce

MOST_SAMPLES = 4000  # samples of a recording that are smoothed: the stretch with the most to see
PASSES = 3  # linearisations at most


@dataclass(frozen=True, eq=False)
class HiddenForce:
    """The force in a port along one recording.

    Attributes
    ----------
    t, z, dz, force, std : array, shape (K,)
        Time in s, local coordinate, its rate, the recovered force, and its standard deviation due to noise.
    law_z, law_dz, law : array, shape (K + 1,)
        Local coordinate, rate and force of the law along the corrected run, at the samples; empty without a law.
    instant : bool
        True: the force holds at a sample. False: it is the mean from one sample to the next.
    """

    port: str
    recording: str
    t: np.ndarray
    z: np.ndarray
    dz: np.ndarray
    force: np.ndarray
    std: np.ndarray
    law_z: np.ndarray
    law_dz: np.ndarray
    law: np.ndarray
    instant: bool

    @property
    def law_held(self) -> np.ndarray:
        """The law's force over each sample, comparable with `force`."""
        return self.law[:-1] if self.instant else (self.law[1:] + self.law[:-1]) / 2


def hidden_force(
    bench: Workbench, fitted: Fitted, port: str, number: int | None, noise: np.ndarray, i: int = 0
) -> HiddenForce | None:
    """Recover the force in a port along one recording; None where the outputs do not show it.

    Parameters
    ----------
    fitted : Fitted
        The corrected simulator, run on the bench's recordings.
    number : int, optional
        Index of the element whose force is recovered; None recovers a force at `port` beside all elements.
    noise : array, shape (n_y,)
        Standard deviation of the outputs' noise.
    i : int
        Index of the recording.
    """
    r, n = bench.recordings[i], fitted.model.substeps
    drive, start = fitted.model.drive(r), np.asarray(fitted.initial[i], dtype=float)
    with np.errstate(all="ignore"):
        states = states_along(fitted.model, drive, fitted.vector, start)
        law = _law_signals(fitted, number, states[::n], r, bench) if number is not None else None
        base, x0 = _without(fitted, number, start, bench.dt / n)
        instant = port.startswith("sensor:") or (port.startswith("actuator:") and bench.hold == "zero")
        held = np.zeros(len(r)) if law is None else law[2]
        held = held if instant else (held + np.append(held[1:], held[-1])) / 2
        window = _window(held if law is not None else np.abs(fitted.residual[i] / bench.scale).sum(axis=1), r.skip)
        found = _recover(bench, fitted, _Target(base, port, x0, r, held, noise, window))
    if found is None:
        return None
    z, dz, force, std = found
    z, dz = (v[:-1] if instant else (v[1:] + v[:-1]) / 2 for v in (z, dz))
    empty = np.zeros(0)
    law_z, law_dz, law_force = (empty, empty, empty) if law is None else (v[window] for v in law)
    return HiddenForce(port, r.name, r.t[window][:-1], z, dz, force, std, law_z, law_dz, law_force, instant)


def _law_signals(
    fitted: Fitted, number: int, states: np.ndarray, r: Recording, bench: Workbench
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute local coordinate, rate and force, (M,) each, of an element along a run."""
    simulator = on_grid(fitted.simulator, bench.dt / fitted.model.substeps)
    own = simulator.parameter_set
    vector = ca.SX.sym("p", own.size)
    equations = ClosedEquations(simulator, vector)
    n_s, n_u = sum(equations.n_s), len(simulator.inputs)
    n_x = states.shape[1] - n_s
    x, s, u, v, t = (ca.SX.sym(k, m) for k, m in (("x", n_x), ("s", n_s), ("u", n_u), ("v", n_u), ("t", 1)))
    found = equations.evaluate(Instant(x, s, u, v, t))[3][number]
    function = ca.Function("law", [ca.vertcat(x, s), u, v, t, vector], [ca.vertcat(*map(ca.SX, found))])
    (rows,) = map_points(function, states, r.u, _slope(bench, r), r.t[:, None], fitted.vector)
    return rows[:, 0, 0], rows[:, 1, 0], rows[:, 2, 0]


def _slope(bench: Workbench, r: Recording) -> np.ndarray:
    return np.gradient(r.u, r.dt, axis=0) if bench.hold == "linear" else np.zeros_like(r.u)


def _without(fitted: Fitted, number: int | None, start: np.ndarray, h: float) -> tuple[Simulator, np.ndarray]:
    """Return the simulator without one of its elements, and its initial state without that element's part."""
    simulator = fitted.simulator
    if number is None:
        return simulator, start
    own = simulator.parameter_set
    equations = ClosedEquations(on_grid(simulator, h), ca.SX.sym("p", own.size))
    at_q = np.cumsum([len(simulator.states), *equations.n_q])
    at_s = np.cumsum([at_q[-1], *equations.n_s])
    dropped = [*range(at_q[number], at_q[number + 1]), *range(at_s[number], at_s[number + 1])]
    prefix = simulator.elements[number].prefix
    kept = {k: p for k, p in own.items() if not k.startswith(prefix)}
    elements = tuple(e for k, e in enumerate(simulator.elements) if k != number)
    return replace(simulator, elements=elements, parameters=ParameterSet(kept)), np.delete(start, dropped)


def _window(weight: np.ndarray, skip: int) -> slice:
    """Choose the stretch that is smoothed: the one with the most energy."""
    m = len(weight)
    if m - skip <= MOST_SAMPLES:
        return slice(skip, m)
    energy = np.cumsum(np.append(0.0, np.abs(weight) ** 2))
    starts = np.arange(skip, m - MOST_SAMPLES + 1, MOST_SAMPLES // 8)
    at = int(starts[np.argmax(energy[starts + MOST_SAMPLES] - energy[starts])])
    return slice(at, at + MOST_SAMPLES)


@dataclass(frozen=True, eq=False)
class _Target:
    """The simulator without the law, and the port and the stretch of a recording where the force is sought."""

    simulator: Simulator
    port: str
    x0: np.ndarray
    recording: Recording
    held: np.ndarray  # the force expected over each sample
    noise: np.ndarray
    window: slice


def _recover(
    bench: Workbench, fitted: Fitted, target: _Target
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """Smooth the force in passes; return local coordinate and rate (M,), force and deviation (M - 1,)."""
    n, window, r = fitted.model.substeps, target.window, target.recording
    probed = target.simulator.with_element(target.port, Constant())
    model = discretise(probed, bench.dt, bench.hold, n)
    drive = model.drive(r)
    values = {k: v for k, v in fitted.values.items() if k in target.simulator.parameters}
    p = np.tile(model.parameters.pack(values), (len(drive), 1))
    row = model.parameters.position(f"{probed.elements[-1].prefix}w").start
    step = _linearised_step(model, row)
    x0, held = target.x0, target.held
    best: tuple[float, Any] | None = None
    size: tuple[float, float] | None = None
    for _ in range(PASSES):
        p[:, row] = np.repeat(held, n)
        states = states_along(model, drive, p, x0)
        cut = slice(window.start * n, window.stop * n)
        simulated, *blocks = map_points(step, states[cut], drive[cut], p[cut])
        error = r.y[window] - simulated[::n, :, 0]
        if not np.all(np.isfinite(error)):
            break
        system = UnknownForce.of(blocks, error, target.noise, held[window], states[cut][::n], n)
        size = size or system.likeliest()
        if size is None:
            return None
        dx, dw, std = system.smooth(*size)
        score = float(np.mean((error / bench.scale) ** 2))
        if best is not None and score > best[0]:
            break
        best = (score, (states[cut][::n] + dx, held[window] + dw, std))
        if system.constant:
            break
        x0 = x0 + dx[0] if window.start == 0 else x0
        held = held.copy()
        held[window] += dw
    if best is None:
        return None
    path, force, std = best[1]
    states = path[:, : len(target.simulator.states)]
    z, dz = _local(bench, target.simulator, values, target.port, states, r.slice(window.start, window.stop))
    return z, dz, force[:-1], std[:-1]


def _linearised_step(model: Model, row: int) -> ca.Function:
    """Make a step that also returns the derivatives of next state and output by state and by parameter `row`."""
    x, u, q = ca.SX.sym("x", model.n_state), ca.SX.sym("u", model.n_u), ca.SX.sym("p", model.parameters.size)
    following, y = model.closed(x, u, q)
    blocks = [ca.densify(ca.jacobian(e, v)) for e, v in ((following, x), (following, q[row]), (y, x), (y, q[row]))]
    return ca.Function("step", [x, u, q], [y, *blocks])


def _local(
    bench: Workbench, base: Simulator, values: dict[str, Any], port: str, states: np.ndarray, r: Recording
) -> tuple[np.ndarray, np.ndarray]:
    """Compute local coordinate and rate, (M,) each, of a port along states (M, n_x)."""
    own = base.parameter_set
    vector = own.pack({k: v for k, v in values.items() if k in own})
    rows = signals(base)(states.T, r.u.T, _slope(bench, r).T, r.t[None], np.tile(vector[:, None], (1, len(r))))
    index = [known.name for known in base.all_ports()].index(port)
    return np.asarray(rows[0])[index], np.asarray(rows[1])[index]


def force_blocks(
    bench: Workbench, noise: np.ndarray, fitted: Fitted, port: str, number: int | None, name: str
) -> list[Block]:
    """Recover the force in a port along the loudest recording, and draw it.

    Parameters
    ----------
    bench, noise, fitted, port, number
        See `hidden_force`.
    name : str
        Name of the law in the pictures; empty without a law.
    """
    records = bench.recordings
    loud = int(np.argmax([np.std(r.y[r.skip :] / bench.scale) * np.sqrt(len(r)) for r in records]))
    try:
        hidden = hidden_force(bench, fitted, port, number, noise, loud)
    except (InputError, np.linalg.LinAlgError, RuntimeError):
        hidden = None
    if hidden is None:
        return [Text(f"The outputs do not show the force at {port}, so it cannot be recovered.")]
    recording = hidden.recording or (f"training recording {loud + 1}" if len(records) > 1 else "the recording")
    how = (
        f"The blue points are the force at {port} that makes the simulator follow {recording}. A smoother found it: it "
        "keeps the fitted parameters and assumes only that the force wanders in random steps; it knows no law."
    )
    how += f" The orange line is the fitted {name} along the simulation." if name else ""
    return [Text(how), *_Drawing.of(hidden, bench, name).pictures()]


@dataclass(frozen=True, eq=False)
class _Drawing:
    """A hidden force with the names and units of its axes."""

    hidden: HiddenForce
    name: str
    label: str  # of the force
    across: str  # of the local coordinate
    unit: str
    across_unit: str
    series: bool

    @classmethod
    def of(cls, hidden: HiddenForce, bench: Workbench, name: str) -> _Drawing:
        port = bench.simulator.port(hidden.port)
        kind, _, channel = hidden.port.partition(":")
        label = {"actuator": "added to the input", "sensor": "added to the output"}.get(kind, "force w")
        across = channel if port.series and channel else "local coordinate z"
        return cls(hidden, name, label, across, port.unit, port.across_unit, port.series)

    def pictures(self) -> list[Block]:
        """Draw the force over its local coordinate, rate and time, and the part that the law leaves."""
        h, alt = self.hidden, f"Recovered force at {self.hidden.port}"
        x, force = Signal(self.across, h.z, self.across_unit), Signal(self.label, h.force, self.unit)
        drawn = [(x, force, h.law_z, h.law, f"{h.port}, over {self.across}.", f"{alt} over its local coordinate.")]
        if np.ptp(h.dz) > 0:
            rate = Signal(f"rate of {self.across}", h.dz, f"{self.across_unit}/s" if self.across_unit else "")
            drawn.append((rate, force, h.law_dz, h.law, "The same force over the rate.", f"{alt} over its rate."))
        elif self.series and len(h.law):  # a law in series: its output over its input
            acting = Signal(f"{self.across} as it acts", h.z + h.force, self.across_unit)
            caption = "The signal behind the law over the signal before it."
            drawn.append((x, acting, h.law_z, h.law_z + h.law, caption, f"{alt}: output over input."))
        out: list[Block] = [
            Picture(
                plots.force_cloud(x, y, law_x, law, title=h.port, name=self.name).figure,
                caption,
                text,
            )
            for x, y, law_x, law, caption, text in drawn
        ]
        over = plots.force_time(h.t, force, h.std, h.law, self.name)
        caption = "The same force over time, around its largest value. The band is the uncertainty due to noise."
        out.append(Picture(over.figure, caption, f"{alt} over time."))
        if len(h.law):
            rest = Signal("recovered − law", h.force - h.law_held, self.unit)
            left = plots.force_left(x, rest, h.std)
            caption = "The recovered force minus the law. Where the mean bends away from zero, the law's form is wrong."
            out.append(Picture(left.figure, caption, f"{alt} without the law."))
        return out
