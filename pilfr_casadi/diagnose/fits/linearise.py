"""Linearise the simulator along its own run: outputs' responses to forces at ports, parameters and initial states.

With a force that is constant over each sample,

    X⁺ = A_k X + B_k [dθ, w_k],    Y = C_k X + D_k [dθ, w_k].

Along an observer with gain K, the innovations replace the residual, and `A - K C` and `B - K D` replace A and B.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from ..._base import InputError, one_at_a_time
from ...data import COURSES, Recording
from ...laws import Law, Local
from ...linear import steady_state_gain, with_output_injection
from ...models import Model
from ...simulators import (
    PARAMETER,
    Port,
    Simulator,
    discretise,
    map_points,
    signals,
    split_port,
    states_along,
    term_function,
)
from .workbench import FINER_STEPS, Fitted, Workbench, pack_known

WALL = 1.0  # largest |λ| h of a contact on the finest steps

BLOCK = 256  # samples propagated at a time
CHUNK, ENTRIES = 300, 2e7  # samples linearised at a time, and entries of their matrices, at most
POINTS, MOST_SAMPLED = 60, 3000  # samples at which the user's equations are evaluated, among the first of a run


class ProbeForce(Law):
    """A constant force, the probe that measures a port's response."""

    id = "probe"
    equation = "w = w"
    units: ClassVar[Mapping[str, str]] = {"w": "w"}
    strength: ClassVar[tuple[str, ...]] = ("w",)
    places: ClassVar[tuple[str, ...]] = ("parallel", "series")

    def force(self, p: Any) -> Any:
        """Return the parameter."""
        return p.w


def differentiate_step(model: Model, columns: Sequence[int] = ()) -> tuple[tuple[ca.SX, ...], list[ca.SX]]:
    """Return symbols x (with memory), u, p of a model's step, and y, A, B, C, D there.

    B and D have a column for each entry of p in `columns`.
    """
    x, (u, p) = ca.SX.sym("x", model.n_state), model.symbols()[2:]
    following, y = model.closed(x, u, p)
    picked = p[list(columns)]
    blocks = [ca.jacobian(e, v) for e, v in ((following, x), (following, picked), (y, x), (y, picked))]
    return (x, u, p), [y, *map(ca.densify, blocks)]


@dataclass(frozen=True, eq=False)
class Probe:
    """One step of the probed simulator at fitted values, its derivatives, and the local signals of its ports."""

    model: Model
    step: ca.Function  # `(x, u) -> (y, A, B, C, D)`; B and D have a column for each free parameter, then each port
    local: ca.Function  # `(x, u, slope, t, p) -> (z, dz)`, one row a port; p excludes the probes
    values: np.ndarray  # parameter vector of the probed model
    free: np.ndarray
    ports: tuple[str, ...]
    n_x: int

    @classmethod
    @one_at_a_time
    def of(cls, bench: Workbench, fitted: Fitted) -> Probe:
        """Differentiate the probed simulator."""
        simulator = probed = fitted.simulator
        for port in simulator.all_ports():
            probed = probed.with_element(port.name, ProbeForce())
        model = discretise(probed, bench.dt, bench.hold, fitted.model.substeps)
        values = pack_known(model.parameters, fitted.values)
        names = tuple(port.name for port in simulator.all_ports())
        free = np.flatnonzero(model.parameters.free)
        (x, u, p), blocks = differentiate_step(model, free.tolist())
        at = ca.substitute(blocks, [p], [ca.SX(values)])  # fold constants
        step = ca.Function("probe", [x, u], ca.cse(at))
        return cls(model, step, signals(simulator), values, free, names, len(simulator.states))


@dataclass(frozen=True, eq=False)
class Run:
    """A recording's run, with the matrices that propagate small changes along it."""

    a: np.ndarray  # (M, n_x, n_x), one for each sample
    b: np.ndarray  # (M, n_x, n_c)
    c: np.ndarray  # (M, n_y, n_x)
    d: np.ndarray  # (M, n_y, n_c)
    mean: tuple[np.ndarray, np.ndarray, np.ndarray]  # mean a, b, c of a sub-step
    error: np.ndarray  # (M, n_y), simulated (or predicted) minus measured output
    z: np.ndarray  # (M, n_ports), local coordinates
    dz: np.ndarray  # (M, n_ports), their rates
    x: np.ndarray  # (M, n_x), the simulator's own states
    u: np.ndarray  # (M, n_u), inputs
    p: np.ndarray  # parameter vector, the simulator's own first
    own: np.ndarray  # (M, n), the ports' own signals
    sign: np.ndarray  # (n_ports,), +1 if a positive force opposes the port's motion, -1 if it drives it, 0 if neither
    back: np.ndarray  # (n_ports,), the same for a positive force that pushes the port back
    lift: np.ndarray  # (n_ports,), largest effect of a unit force on the local coordinate's first derivative
    push: np.ndarray  # (n_ports,), the same on its second derivative
    from_zero: bool = False  # whether all states begin at zero

    @property
    def n_free(self) -> int:
        """Number of columns of b and d for free parameters; the columns of the ports follow."""
        return int(self.b.shape[2] - len(self.sign))

    def sense(self, law: Law, port: int) -> int:
        """Return the sign of the law's strengths at a port if the law opposes motion or pushes back; else 0.

        A coordinate without inertia, such as a temperature, has no motion to oppose. There a law with memory, such as
        a second heat capacity, pushes back.
        """
        if law.dissipative and (self.sign[port] or not (law.order or law.memory)):
            return int(self.sign[port])
        return int(self.back[port]) if law.dissipative or law.restoring else 0


@np.errstate(over="ignore", invalid="ignore")
def run(bench: Workbench, probe: Probe, fitted: Fitted, i: int, gain: np.ndarray | None = None) -> Run:
    """Run recording i at fitted values from its fitted state, corrected by an observer if a gain is given.

    An observer may push a simulator out of its range; then the run is not finite.
    """
    r, model, p = bench.recordings[i], probe.model, probe.values
    n = model.substeps
    drive, x = model.drive(r), np.asarray(fitted.initial[i], dtype=float)[: model.n_state]
    if gain is None:
        states = states_along(model, drive, p, x)
    else:
        seen = with_output_injection(model, gain)
        states = states_along(seen, seen.drive(r), np.append(p, 1.0), x)
    kept: list[np.ndarray] = []
    means = []
    size = n * model.n_state * (model.n_state + probe.step.size2_out(2))
    chunk = int(np.clip(ENTRIES / max(size, 1), 1, CHUNK)) * n
    for begin in range(0, len(states), chunk):  # the matrices of all sub-steps together would be large
        now = slice(begin, begin + chunk)
        y, a, b, c, d = map_points(probe.step, states[now], drive[now])
        means.append([len(y) * v.mean(axis=0) for v in (a, b, c)])
        if gain is not None:
            a, b = a - gain @ c, b - gain @ d
        part = (*compose_substeps(a, b, n), c[::n], d[::n], y[::n, :, 0])
        kept = kept or [np.empty((len(r), *v.shape[1:])) for v in part]  # too large to hold twice if states are many
        for whole, v in zip(kept, part, strict=True):
            whole[begin // n : begin // n + len(v)] = v
    a, b, c, d, y = kept
    mean = tuple(sum(v) / len(states) for v in zip(*means, strict=True))
    x_run = states[::n, : probe.n_x]
    z, dz, lift, push, own = local_signals(bench, probe.local, x_run, r, p[: len(p) - len(probe.ports)])
    moved, sign = np.abs(lift).max(axis=0) > 0, -np.sign(np.median(push, axis=0))
    speed = np.array([port.is_speed for port in bench.simulator.all_ports()])
    sense = {
        "sign": np.where(moved & ~speed, 0.0, sign),
        "back": np.where(moved, -np.sign(np.median(lift, axis=0)), sign),
    }
    felt = {"lift": np.abs(lift).max(axis=0), "push": np.abs(push).max(axis=0)}
    along_run = {"z": z, "dz": dz, "x": x_run, "u": r.u, "p": p, "own": own}
    return Run(a, b, c, d, mean, error=y - r.y, **along_run, **sense, **felt, from_zero=r.begins == "zero")


def local_signals(
    bench: Workbench, local: ca.Function, states: np.ndarray, r: Recording, p: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Compute z, dz, lift, push (M, n_ports) and own signals of every port along states (M, n_x) and inputs.

    `local` is the function of `simulators.signals`.
    """
    found = map_points(local, states, r.u, input_slope(bench, r), r.clock[:, None], p)
    return tuple(v[:, :, 0] for v in found)


def input_slope(bench: Workbench, r: Recording) -> np.ndarray:
    """Compute the inputs' rates at the samples, (M, n_u); zero if the inputs are held."""
    constant = COURSES[bench.hold].constant or len(r) < 3
    return np.zeros_like(r.u) if constant else np.gradient(r.u, r.dt, axis=0)


def loudest_stretch(power: np.ndarray, length: int, skip: int) -> slice:
    """Choose the stretch of at most `length` samples with the largest sum of `power` (M,), after the first `skip`."""
    m = len(power)
    if m - skip <= length:
        return slice(skip, m)
    energy = np.cumsum(np.append(0.0, power))
    starts = np.arange(skip, m - length + 1, max(length // 8, 1))
    at = int(starts[np.argmax(energy[starts + length] - energy[starts])])
    return slice(at, at + length)


def compose_substeps(a: np.ndarray, b: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Compose the matrices (K, n_x, n_x) and (K, n_x, n_c) of sub-steps into matrices of samples, n sub-steps each."""
    total, moved = a[::n], b[::n]
    for j in range(1, n):
        moved = a[j::n] @ moved + b[j::n]
        total = a[j::n] @ total
    return total, moved


def simulate_states(fitted: Fitted, r: Recording, state: np.ndarray) -> np.ndarray:
    """Run a simulator at its fitted values from an initial state; return the states at samples, (M, n_state)."""
    model = fitted.model
    return states_along(model, model.drive(r), fitted.vector, state)[:: model.substeps]


@functools.lru_cache(maxsize=2)  # the screen and the flexible force use the same fit
def linearise_runs(bench: Workbench, fitted: Fitted) -> tuple[Probe, list[Run]]:
    """Return the probe of a fitted simulator, and its run of every recording."""
    probe = Probe.of(bench, fitted)
    runs = [run(bench, probe, fitted, i) for i in range(len(bench.recordings))]
    for i, r in enumerate(runs):
        if not all(np.isfinite(found).all() for found in (r.z, r.lift, r.push)):
            _refuse_infinite_port(bench, probe, fitted, i)
    return probe, runs


def _refuse_infinite_port(bench: Workbench, probe: Probe, fitted: Fitted, i: int) -> None:
    """Refuse a port that is not finite along the simulator's own run, if that run is."""
    r = bench.recordings[i]
    states = simulate_states(fitted, r, fitted.initial[i])[:, : probe.n_x]
    z, _, lift, push, _ = local_signals(bench, probe.local, states, r, probe.values[: -len(probe.ports)])
    finite = np.isfinite([z, lift, push]).all(axis=(0, 1))
    if np.isfinite(states).all() and not finite.all():
        raise InputError(
            f"The port {probe.ports[int(np.argmin(finite))]!r} is not finite along the recordings; correct a division "
            "by zero, or a logarithm or root of a negative number, in its `into`, `across` or `rate`."
        )


def sample_run(bench: Workbench, fitted: Fitted) -> tuple[np.ndarray, np.ndarray]:
    """Return some states of the user's equations (n, n_x) and inputs (n, n_u) along the longest fitted run."""
    i = int(np.argmax([len(r) for r in bench.recordings]))
    r = bench.recordings[i]
    short = r.slice(0, min(len(r), MOST_SAMPLED))
    states = simulate_states(fitted, short, fitted.initial[i])[:, : len(bench.simulator.states)]
    step = max(len(states) // POINTS, 1)
    return states[::step], short.u[::step]


def observer_gain(probe: Probe, runs: list[Run], noise: np.ndarray) -> np.ndarray:
    """Compute the gain of an observer with process noise at every port, each able to explain the residual alone."""
    a, b, c = runs[0].mean
    ports = b[:, runs[0].n_free :]
    error = np.sqrt(np.mean(np.concatenate([r.error for r in runs]) ** 2, axis=0))
    q = np.zeros_like(a)
    for column in ports.T:
        x, total = column.copy(), 0.0
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            for _ in range(200):
                total += float(np.sum((c @ x / error) ** 2))
                x = a @ x
        if total > 0 and np.isfinite(total):
            q += np.outer(column, column) / total
    gain = steady_state_gain(a, c, q, np.diag(np.maximum(noise, 0.05 * error) ** 2))
    gain[probe.n_x :] = 0.0  # the laws' own states get no correction
    return gain


def propagate(r: Run, forces: Sequence[tuple[int, np.ndarray]] = ()) -> np.ndarray:
    """Compute the changes of the outputs by free parameters, the initial state, and forces at ports.

    Each entry of `forces` is the number of a port, counted from 0, and forces (M, n) at the samples of the run. The
    changes have the shape (M, n_y, n_free + n_x + total n).
    """
    (m, n_x, _), n_free = r.a.shape, r.n_free
    n_y, first = r.c.shape[1], n_free + n_x
    edges = first + np.cumsum([0, *(f.shape[1] for _, f in forces)])
    spans = [slice(i, j) for i, j in pairwise(edges)]
    moving = [
        (n_free + port, span, (f + np.vstack([f[1:], f[-1:]])) / 2)
        for (port, f), span in zip(forces, spans, strict=True)
        if r.b[:, :, n_free + port].any()
    ]
    # skip columns that reach no state
    end = max((span.stop for _, span, _ in moving), default=first)
    x = np.zeros((n_x, end))
    x[:, n_free:first] = np.eye(n_x)
    out = np.zeros((m, n_y, int(edges[-1])))
    for at in range(0, m, BLOCK):
        now = slice(at, min(at + BLOCK, m))
        carried = np.empty((now.stop - at + 1, n_x, end))
        carried[1:] = 0.0
        carried[0] = x
        carried[1:, :, :n_free] = r.b[now, :, :n_free]
        for column, span, mean in moving:
            np.multiply(r.b[now, :, column, None], mean[now, None, :], out=carried[1:, :, span])
        for before, after, a in zip(carried, carried[1:], r.a[now], strict=False):
            after += a @ before
        x = carried[-1]
        np.matmul(r.c[now], carried[:-1], out=out[now, :, :end])
    out[:, :, :n_free] += r.d[:, :, :n_free]
    for (port, f), span in zip(forces, spans, strict=True):
        out[:, :, span] += r.d[:, :, n_free + port, None] * f[:, None, :]
    return out


def locals_of(bench: Workbench, runs: list[Run]) -> list[Local]:
    """Return the local signals of every port over all recordings."""
    lengths = tuple(len(r.z) for r in runs)
    z, dz = np.concatenate([r.z for r in runs]), np.concatenate([r.dz for r in runs])
    rate = WALL * FINER_STEPS * bench.substeps / bench.dt
    lift, push = (np.max([getattr(r, name) for r in runs], axis=0) for name in ("lift", "push"))
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # a force that does not move it has no limit
        max_stiffness, max_damping = np.where(lift > 0, rate / lift, rate**2 / push), rate / push
    inputs = bench.signals_of([r.u for r in runs])
    own = own_signals(bench.simulator, np.concatenate([r.own for r in runs]))
    rest = tuple(r.from_zero for r in runs)
    pairs = enumerate(zip(max_stiffness.tolist(), max_damping.tolist(), strict=True))
    x, u = (np.concatenate([getattr(r, name) for r in runs]) for name in ("x", "u"))
    found = [Local(z[:, j], dz[:, j], bench.dt, lengths, k, d, {**inputs, **own[j]}, rest) for j, (k, d) in pairs]
    ports = bench.simulator.all_ports()
    return [_with_equations(bench.simulator, q, v, x, u, runs[0].p) for q, v in zip(ports, found, strict=True)]


def _with_equations(
    simulator: Simulator, port: Port, local: Local, x: np.ndarray, u: np.ndarray, p: np.ndarray
) -> Local:
    """Add whether outputs read the port's coordinate, the port's term, and one revolution if z is an angle."""
    term = term_function(simulator, port) if port.term else None
    own = p[: simulator.parameter_set.size]

    def term_along(z: np.ndarray, dz: np.ndarray) -> np.ndarray:
        assert term is not None
        return np.asarray(map_points(term, z[:, None], dz[:, None], x, u, own)[0][:, 0, 0])

    return replace(
        local,
        readers=simulator.readers(port),
        term=term_along if term is not None else None,
        revolution=port.revolution,
    )


def own_signals(simulator: Simulator, values: np.ndarray) -> list[dict[str, np.ndarray]]:
    """Return the own signals of each port by name, from the own signals (M, n) of all ports."""
    columns = iter(values.T)
    return [{name: next(columns) for name in port.signals} for port in simulator.all_ports()]


def parameter_signals(bench: Workbench, value: float, x: Sequence[np.ndarray], u: Sequence[np.ndarray]) -> Local:
    """Return the signals that a parameter may vary with: states (M, n_x) and inputs (M, n_u) of each run, and time."""
    states = zip(bench.simulator.states, np.concatenate(x).T, strict=True)
    signals = bench.signals_of(u)
    signals = {**signals, **dict(states), "t": signals["t"]}
    z = np.full(len(signals["t"]), value)
    return Local(z, np.zeros_like(z), bench.dt, tuple(map(len, u)), inputs=signals)


def port_signals(bench: Workbench, fitted: Fitted, port: str) -> Local:
    """Compute the local signals of a port, or of a parameter, along the fitted runs of all recordings."""
    simulator = fitted.simulator
    kind, of = split_port(port)
    index = 0 if kind == PARAMETER else [p.name for p in simulator.all_ports()].index(port)
    function, parts = signals(simulator), []
    for r, state in zip(bench.recordings, fitted.initial, strict=True):
        with np.errstate(over="ignore", invalid="ignore"):
            x = simulate_states(fitted, r, state)[:, : len(simulator.states)]
            z, dz, *_, own = local_signals(bench, function, x, r, fitted.vector)
        parts.append((z[:, index], dz[:, index], own, x, r.u))
    if kind == PARAMETER:
        value = float(fitted.values[of])
        return parameter_signals(bench, value, *zip(*(part[3:] for part in parts), strict=True))
    z, dz, own, x, u = (np.concatenate([part[k] for part in parts]) for k in range(5))
    local = bench.local(z, dz)
    local = replace(local, inputs={**local.inputs, **own_signals(simulator, own)[index]})
    return _with_equations(simulator, simulator.port(port), local, x, u, fitted.vector)
