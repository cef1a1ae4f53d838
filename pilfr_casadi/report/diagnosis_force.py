"""The hidden force in a port, recovered from recordings without the help of a law.

The corrected simulator without the law, linearised along the corrected run, is driven by an unknown force and smoothed
(see `smoother.py`); where it is nonlinear it is linearised again along the result.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from ..data import Recording
from ..diagnose import Constant, Fitted, Workbench
from ..models import ParameterSet, map_points
from ..simulators import ClosedEquations, Instant, Simulator, discretise, on_grid, signals, states_along
from .smoother import UnknownForce

MOST = 4000  # samples smoothed


@dataclass(frozen=True, eq=False)
class Hidden:
    """The force in a port of one recording, (K,) each.

    Attributes
    ----------
    t, z, dz, force, std : array
        Time in s, local coordinate, its rate, the recovered force and its standard deviation from noise.
    law_z, law_dz, law : array
        The same of the law along the corrected run, at the samples; empty without a law.
    instant : bool
        Whether the force is that at a sample; otherwise it is the mean from one sample to the next.
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
        """The law's force over each sample, as the recovered one."""
        return self.law[:-1] if self.instant else (self.law[1:] + self.law[:-1]) / 2


def hidden_force(
    bench: Workbench, fitted: Fitted, port: str, number: int | None, noise: np.ndarray, i: int = 0
) -> Hidden | None:
    """Recover the force in a port along one recording; None where it cannot be seen from the outputs.

    Parameters
    ----------
    fitted : Fitted
        The corrected simulator, run on the bench's recordings.
    number : int, optional
        Which of its elements is to be recovered; without one, a force at `port` beside all elements.
    noise : array, (n_y,)
        Standard deviation of the outputs' noise.
    i : int
        Which recording.
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
        found = _recover(bench, fitted, base, port, x0, r, held, noise, window)
    if found is None:
        return None
    z, dz, force, std = found
    z, dz = (v[:-1] if instant else (v[1:] + v[:-1]) / 2 for v in (z, dz))
    empty = np.zeros(0)
    law_z, law_dz, law_force = (empty, empty, empty) if law is None else (v[window] for v in law)
    return Hidden(port, r.name, r.t[window][:-1], z, dz, force, std, law_z, law_dz, law_force, instant)


def _law_signals(
    fitted: Fitted, number: int, states: np.ndarray, r: Recording, bench: Workbench
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Local coordinate, rate and force (M,) of an element along a run."""
    simulator = on_grid(fitted.simulator, bench.dt / fitted.model.substeps)
    own = ParameterSet(dict(simulator.parameters))
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
    """The simulator without one of its elements, and an initial state without that element's."""
    simulator = fitted.simulator
    if number is None:
        return simulator, start
    own = ParameterSet(dict(simulator.parameters))
    equations = ClosedEquations(on_grid(simulator, h), ca.SX.sym("p", own.size))
    at_q = np.cumsum([len(simulator.states), *equations.n_q])
    at_s = np.cumsum([at_q[-1], *equations.n_s])
    dropped = [*range(at_q[number], at_q[number + 1]), *range(at_s[number], at_s[number + 1])]
    prefix = simulator.elements[number].prefix
    kept = {k: p for k, p in own.items() if not k.startswith(prefix)}
    elements = tuple(e for k, e in enumerate(simulator.elements) if k != number)
    return replace(simulator, elements=elements, parameters=ParameterSet(kept)), np.delete(start, dropped)


def _window(weight: np.ndarray, skip: int) -> slice:
    """The stretch that is smoothed: where there is most to see."""
    m = len(weight)
    if m - skip <= MOST:
        return slice(skip, m)
    energy = np.cumsum(np.append(0.0, np.abs(weight) ** 2))
    starts = np.arange(skip, m - MOST + 1, MOST // 8)
    at = int(starts[np.argmax(energy[starts + MOST] - energy[starts])])
    return slice(at, at + MOST)


def _recover(
    bench: Workbench,
    fitted: Fitted,
    base: Simulator,
    port: str,
    x0: np.ndarray,
    r: Recording,
    held: np.ndarray,
    noise: np.ndarray,
    window: slice,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    n = fitted.model.substeps
    probed = base.with_element(port, Constant())
    model = discretise(probed, bench.dt, bench.hold, n)
    drive = model.drive(r)
    values = {k: v for k, v in fitted.values.items() if k in base.parameters}
    p = np.tile(model.parameters.pack(values), (len(drive), 1))
    row = model.parameters.position(f"{probed.elements[-1].prefix}w").start
    x, u, q = ca.SX.sym("x", model.n_state), ca.SX.sym("u", model.n_u), ca.SX.sym("p", model.parameters.size)
    following, y = model.closed(x, u, q)
    blocks = [ca.densify(ca.jacobian(e, v)) for e, v in ((following, x), (following, q[row]), (y, x), (y, q[row]))]
    step = ca.Function("step", [x, u, q], [y, *blocks])
    best: tuple[float, Any] | None = None
    size: tuple[float, float] | None = None
    for _ in range(3):
        p[:, row] = np.repeat(held, n)
        states = states_along(model, drive, p, x0)
        cut = slice(window.start * n, window.stop * n)
        simulated, *blocks = map_points(step, states[cut], drive[cut], p[cut])
        error = r.y[window] - simulated[::n, :, 0]
        if not np.all(np.isfinite(error)):
            break
        system = UnknownForce.of(blocks, error, noise, held[window], states[cut][::n], n)
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
    z, dz = _local(bench, base, values, port, path[:, : len(base.states)], r.slice(window.start, window.stop))
    return z, dz, force[:-1], std[:-1]


def _local(
    bench: Workbench, base: Simulator, values: dict[str, Any], port: str, states: np.ndarray, r: Recording
) -> tuple[np.ndarray, np.ndarray]:
    """Local coordinate and rate (M,) of a port along states (M, n_x)."""
    own = ParameterSet(dict(base.parameters))
    vector = own.pack({k: v for k, v in values.items() if k in own})
    rows = signals(base)(states.T, r.u.T, _slope(bench, r).T, r.t[None], np.tile(vector[:, None], (1, len(r))))
    index = [known.name for known in base.all_ports()].index(port)
    return np.asarray(rows[0])[index], np.asarray(rows[1])[index]
