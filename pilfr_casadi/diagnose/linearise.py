"""The simulator linearised along its own run: how a small force at a port, a parameter or the start moves the outputs.

With a force held over each step,

    X⁺ = A_k X + B_k [dθ, w_k],    Y = C_k X + D_k [dθ, w_k],

and along an observer with gain K, whose innovations are then looked at instead of the residual, `A - K C` and
`B - K D` take the place of A and B.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from ..integration import discretise, signals, states_along
from ..laws.base import Law, Local
from ..model import Model
from ..observer import kalman_gain, led
from ..simulator import Simulator
from .workbench import Fitted, Workbench


class Constant(Law):
    """A constant force: the probe that a port's response is measured with."""

    id = "probe"
    equation = "w = w"
    units: ClassVar[Mapping[str, str]] = {"w": "w"}
    strength: ClassVar[tuple[str, ...]] = ("w",)
    places: ClassVar[tuple[str, ...]] = ("parallel", "series")

    def force(self, p: Any) -> Any:
        """The parameter itself."""
        return p.w


def probed(simulator: Simulator) -> Simulator:
    """The simulator with a constant force at every port, in the order of `all_ports`."""
    for port in simulator.all_ports():
        simulator = simulator.with_element(port.name, Constant())
    return simulator


@dataclass(frozen=True, eq=False)
class Probe:
    """One step of the probed simulator with its derivatives, and the local signals of its ports.

    Attributes
    ----------
    step : casadi.Function
        `(x, u, p) -> (x_next, y, A, B, C, D)`; B and D have a column for each free parameter, then each port.
    local : casadi.Function
        `(x, u, slope, t, p) -> (z, dz)`, a row a port; p without the probes.
    """

    model: Model
    step: ca.Function
    local: ca.Function
    free: np.ndarray
    ports: tuple[str, ...]
    n_x: int

    @classmethod
    def of(cls, bench: Workbench, fitted: Fitted) -> Probe:
        """Differentiate the probed simulator."""
        simulator = fitted.simulator
        model = discretise(probed(simulator), bench.dt, bench.hold, fitted.model.substeps)
        x, _, u, p = model.symbols()
        following, y = model.closed(x, u, p)
        parameters = model.parameters
        names = tuple(port.name for port in simulator.all_ports())
        free = np.flatnonzero(parameters.free)
        picked = p[free.tolist()]
        blocks = [ca.jacobian(e, v) for e, v in ((following, x), (following, picked), (y, x), (y, picked))]
        step = ca.Function("probe", [x, u, p], [following, y, *map(ca.densify, blocks)])
        return cls(model, step, signals(simulator), free, names, len(simulator.states))


@dataclass(frozen=True, eq=False)
class Run:
    """A recording's run: what is needed to propagate small changes along it.

    Attributes
    ----------
    a, b, c, d : array, shapes (K, n_x, n_x), (K, n_x, n_c), (K, n_y, n_x), (K, n_y, n_c)
        One a step, `substeps` of them a sample.
    error : array, shape (M, n_y)
        Simulated (or predicted) minus measured output.
    z, dz : array, shape (M, n_ports)
        Local signals.
    sign : array, shape (n_ports,)
        +1 where a positive force opposes the port's motion, -1 where it drives it, 0 where there is no such sense.
    """

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray
    error: np.ndarray
    z: np.ndarray
    dz: np.ndarray
    states: np.ndarray
    sign: np.ndarray


def run(bench: Workbench, probe: Probe, fitted: Fitted, i: int, gain: np.ndarray | None = None) -> Run:
    """Run recording i at fitted values from its fitted state, led by an observer where a gain is given."""
    r, model = bench.recordings[i], probe.model
    n = model.substeps
    p = model.parameters.pack({k: v for k, v in fitted.values.items() if k in model.parameters})
    drive, x = model.drive(r), np.asarray(fitted.initial[i], dtype=float)[: model.n_x]
    if gain is None:
        states = states_along(model, drive, p, x)
    else:
        seen = led(model, gain)
        states = states_along(seen, seen.drive(r), np.append(p, 1.0), x)
    m = len(drive)
    _, y, a, b, c, d = (np.asarray(v) for v in probe.step(states.T, drive.T, np.tile(p[:, None], (1, m))))
    n_x, n_y, n_c = model.n_x, model.n_y, len(probe.free)
    blocks = (
        a.reshape(n_x, m, n_x).transpose(1, 0, 2),
        b.reshape(n_x, m, n_c).transpose(1, 0, 2),
        c.reshape(n_y, m, n_x).transpose(1, 0, 2),
        d.reshape(n_y, m, n_c).transpose(1, 0, 2),
    )
    u = r.u
    slope = np.gradient(u, r.dt, axis=0) if bench.hold == "linear" and len(u) > 2 else np.zeros_like(u)
    own = p[: len(p) - len(probe.ports)]
    inputs = (
        states[::n, : probe.n_x].T,
        u.T,
        slope.T,
        (np.arange(len(u)) * r.dt)[None],
        np.tile(own[:, None], (1, len(u))),
    )
    z, dz, lift, push = (np.asarray(v).T for v in probe.local(*inputs))
    sign = np.where(np.abs(lift).max(axis=0) > 0, 0.0, -np.sign(np.median(push, axis=0)))
    return Run(*blocks, error=y.T[::n] - r.y, z=z, dz=dz, states=states, sign=sign)


def along(bench: Workbench, fitted: Fitted, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Some states of the user's equations (count, n_x) and inputs (count, n_u) along the longest fitted run."""
    i = int(np.argmax([len(r) for r in bench.recordings]))
    r, model, n_x = bench.recordings[i], fitted.model, len(bench.simulator.states)
    short = r.slice(0, min(len(r), 3000))
    states = states_along(model, model.drive(short), fitted.vector, fitted.initial[i])[:: model.substeps, :n_x]
    step = max(len(states) // count, 1)
    return states[::step], short.u[::step]


def observer_gain(probe: Probe, runs: list[Run], noise: np.ndarray) -> np.ndarray:
    """Gain of an observer with process noise at every port, each strong enough to explain the residual alone."""
    first = runs[0]
    a, c = first.a.mean(axis=0), first.c.mean(axis=0)
    ports = first.b.mean(axis=0)[:, len(probe.free) - len(probe.ports) :]
    error = np.sqrt(np.mean(np.concatenate([r.error for r in runs]) ** 2, axis=0))
    q = np.zeros_like(a)
    for column in ports.T:
        x, total = column.copy(), 0.0
        for _ in range(200):
            total += float(np.sum((c @ x / error) ** 2))
            x = a @ x
        if total > 0 and np.isfinite(total):
            q += np.outer(column, column) / total
    return kalman_gain(a, c, q, np.diag(np.maximum(noise, 0.05 * error) ** 2))


def propagate(
    r: Run,
    forces: list[tuple[int, np.ndarray]],
    n_free: int,
    substeps: int,
    gain: np.ndarray | None = None,
) -> np.ndarray:
    """Output changes of free parameters, the initial state, and forces at ports.

    Parameters
    ----------
    forces : list of (port, array of shape (M, n))
        Forces at the samples of the run; a port's number counts from 0.

    Returns
    -------
    array, shape (M, n_y, n_free + n_x + total n)
    """
    steps, n_x, _ = r.a.shape
    n_y, first = r.c.shape[1], n_free + n_x
    widths = [f.shape[1] for _, f in forces]
    a, b = r.a, r.b
    if gain is not None:
        a, b = a - gain @ r.c, b - gain @ r.d
    edges = first + np.cumsum([0, *widths])
    spans = [slice(i, j) for i, j in pairwise(edges)]
    moving = [
        (n_free + port, span, (f + np.vstack([f[1:], f[-1:]])) / 2)
        for (port, f), span in zip(forces, spans, strict=True)
        if b[:, :, n_free + port].any()
    ]
    # columns that reach no state are not carried along
    end = max((span.stop for _, span, _ in moving), default=first)
    x = np.zeros((n_x, end))
    x[:, n_free:first] = np.eye(n_x)
    carried = np.empty((steps // substeps, n_x, end))
    for k in range(steps):
        sample = k // substeps
        if k % substeps == 0:
            carried[sample] = x
        x = a[k] @ x
        x[:, :n_free] += b[k][:, :n_free]
        for column, span, mean in moving:
            x[:, span] += b[k][:, column, None] * mean[sample]
    c, d = r.c[::substeps], r.d[::substeps]
    out = np.zeros((len(c), n_y, int(edges[-1])))
    np.matmul(c, carried, out=out[:, :, :end])
    out[:, :, :n_free] += d[:, :, :n_free]
    for (port, f), span in zip(forces, spans, strict=True):
        out[:, :, span] += d[:, :, n_free + port, None] * f[:, None, :]
    return out


def locals_of(bench: Workbench, runs: list[Run]) -> list[Local]:
    """Local signals of every port over all recordings."""
    lengths = tuple(len(r.z) for r in runs)
    z, dz = np.concatenate([r.z for r in runs]), np.concatenate([r.dz for r in runs])
    return [Local(z[:, j], dz[:, j], bench.dt, lengths) for j in range(z.shape[1])]
