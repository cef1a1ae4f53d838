"""The hidden force in a port, recovered from recordings without assuming a law.

The corrected simulator without the law, linearised along the corrected run, is driven by an unknown force that changes
by a random step each sample,

    Δx⁺ = A Δx + B Δw,   w⁺ = w + ε,   y_measured - y = C Δx + D Δw + noise.

States and force are estimated from all outputs, past and future (Rauch, Tung & Striebel 1965, AIAA J. 3(8)). The
variances of ε and of the noise (at least the given one) are chosen from a grid by maximum likelihood. A nonlinear
simulator is linearised again along the result.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ..._base import one_at_a_time
from ...data import COURSES, Recording
from ...linear import measurement_update
from ...simulators import (
    ACTUATOR,
    PARAMETER,
    SENSOR,
    ClosedEquations,
    Instant,
    Named,
    Simulator,
    discretise,
    kind_of,
    map_points,
    on_grid,
    signals,
    split_port,
    stack,
    states_along,
)
from .evidence import FORMULA_ERROR
from .linearise import (
    ProbeForce,
    compose_substeps,
    differentiate_step,
    input_slope,
    local_signals,
    loudest_stretch,
    simulate_states,
)
from .workbench import Fitted, Workbench, pack_known

NOISE_FACTORS = (1.0, 3.0, 9.0)  # factors on the given noise that are tried
SMOOTHED_SAMPLES = 4000  # longest stretch of a recording that is smoothed: the one with the most energy
PASSES = 3  # linearisations at most
# random steps of the force that are tried, in units of the force that explains the residual
RANDOM_STEPS = np.logspace(-4.0, 0.5, 10)
REPEATS = 0.01  # share of the ranges of coordinate and force within which a sample repeats another
LEVEL_DIGITS = 9  # decimals of a coordinate over its range, up to which two samples are at one level
SAME_CHANGE = 1e-6  # share of the change of the derivatives up to which a force acts as a parameter does


@dataclass(frozen=True, eq=False)
class _Smoother:
    """The linear system of the smoother, with state [Δx; Δw] scaled to unit size.

    f (M, n, n), h (M, n_y, n), outputs e (M, n_y) in units of the noise; known change `steps` (M,) of w; `unit` (n,).
    """

    f: np.ndarray
    h: np.ndarray
    e: np.ndarray
    steps: np.ndarray
    unit: np.ndarray
    constant: bool

    @classmethod
    def of(
        cls,
        blocks: list[np.ndarray],
        error: np.ndarray,
        noise: np.ndarray,
        expected: np.ndarray,
        states: np.ndarray,
        n: int,
    ) -> _Smoother:
        """Compose the sub-steps of each sample, with the force held over it."""
        m, n_x, n_y = len(error), states.shape[1], error.shape[1]
        a, b, c, d = blocks
        constant = np.allclose(a, a[0], rtol=1e-9, atol=1e-12)
        f, g = compose_substeps(a, b, n)
        g, c, d = g[:, :, 0], c[::n], d[::n, :, 0]
        noise = np.maximum(noise, 1e-6 * np.std(error, axis=0) + 1e-300)
        x, total = np.zeros(n_x), 0.0  # response of the outputs to a lasting unit force
        for _ in range(min(m, 500)):
            total += float(np.sum(((c[0] @ x + d[0]) / noise) ** 2))
            x = f[0] @ x + g[0]
        response = np.sqrt(total / min(m, 500)) if np.isfinite(total) else 0.0
        spread = float(np.sqrt(np.mean((error / noise) ** 2)))
        size = max(spread / response if response > 0 else 0.0, float(np.std(expected)), 1e-300)
        size = size if response > 0 else 0.0
        unit = np.append(np.maximum(np.std(states, axis=0), 1e-12), size)
        whole, seen = np.zeros((m, n_x + 1, n_x + 1)), np.zeros((m, n_y, n_x + 1))
        whole[:, :n_x, :n_x], whole[:, :n_x, n_x], whole[:, n_x, n_x] = f, g, 1.0
        seen[:, :, :n_x], seen[:, :, n_x] = c, d
        divided = np.where(unit > 0, unit, 1.0)
        return cls(
            whole / divided[:, None] * unit,
            seen * unit / noise[:, None],
            error / noise,
            np.append(-np.diff(expected), 0.0) / divided[-1],
            unit,
            bool(constant),
        )

    def likeliest(self) -> tuple[float, float] | None:
        """Find the likeliest random step of the force and factor on the noise; None if the force is not observable."""
        if not self.unit[-1] > 0:
            return None
        q, r = (v.ravel() for v in np.meshgrid(RANDOM_STEPS, NOISE_FACTORS, indexing="ij"))
        costs, _ = self._filter(q, r, min(len(self.e), 1200))
        if not np.any(np.isfinite(costs)):
            return None
        best = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
        return float(q[best]), float(r[best])

    def _filter(
        self, q: np.ndarray, r: np.ndarray, length: int, keep: bool = False
    ) -> tuple[np.ndarray, list[tuple[np.ndarray, ...]]]:
        """Run K filters side by side, because a step of many costs hardly more than a step of one.

        q and r are (K,). Returns minus twice the log likelihoods, (K,), and, if they are to be kept, the predicted and
        filtered means (K, n) and covariances (K, n, n) of each sample.
        """
        n, n_y = len(self.unit), self.e.shape[1]
        s, p = np.zeros((len(q), n)), np.tile(np.diag(np.append(np.full(n - 1, 0.01), 25.0)), (len(q), 1, 1))
        noise = r[:, None, None] ** 2 * np.eye(n_y)
        costs = np.zeros(len(q))
        kept: list[tuple[np.ndarray, ...]] = []
        for h, f, e, step in zip(self.h[:length], self.f, self.e, self.steps, strict=False):
            v, gain, p_at = measurement_update(p, h, noise)
            innovation = (e - s @ h.T)[:, :, None]
            costs += (innovation.mT @ np.linalg.solve(v, innovation))[:, 0, 0] + np.linalg.slogdet(v)[1]
            s_at = s + (gain @ innovation)[:, :, 0]
            p_at = (p_at + p_at.mT) / 2
            if keep:
                kept.append((s, p, s_at, p_at))
            s, p = s_at @ f.T, f @ p_at @ f.T
            s[:, -1] += step
            p[:, -1, -1] += q**2
        return costs, kept

    def smooth(self, q: float, r: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute the changes of states (M, n_x) and force (M,), and the force's standard deviation (M,)."""
        kept = [tuple(v[0] for v in each) for each in self._filter(np.array([q]), np.array([r]), len(self.e), True)[1]]
        m, n = len(kept), len(self.unit)
        mean, variance = np.empty((m, n)), np.empty(m)
        s, p = kept[-1][2], kept[-1][3]
        mean[-1], variance[-1] = s, p[-1, -1]
        for k in range(m - 2, -1, -1):
            ahead, p_ahead, at, p_at = kept[k + 1][0], kept[k + 1][1], kept[k][2], kept[k][3]
            gain = np.linalg.lstsq(p_ahead, self.f[k] @ p_at, rcond=1e-13)[0].T
            s, p = at + gain @ (s - ahead), p_at + gain @ (p - p_ahead) @ gain.T
            mean[k], variance[k] = s, p[-1, -1]
        mean *= self.unit
        return mean[:, :-1], mean[:, -1], np.sqrt(np.maximum(variance, 0.0)) * self.unit[-1]


@dataclass(frozen=True, eq=False)
class HiddenForce:
    """The force in a port along one recording; arrays have the shape (K,), the law's arrays (K + 1,)."""

    port: str
    recording: str
    t: np.ndarray  # s, on the recording's clock
    z: np.ndarray  # local coordinate
    dz: np.ndarray  # its rate
    force: np.ndarray
    std: np.ndarray  # standard deviation of the force due to noise
    law_z: np.ndarray  # local coordinate of the law along the corrected run, at the samples; empty without a law
    law_dz: np.ndarray
    law: np.ndarray
    # whether the force holds at a sample, or at the next one if inputs have their next value; else it is the mean
    instant: bool

    @property
    def law_held(self) -> np.ndarray:
        """The law's force over each sample, comparable with `force`."""
        return self.law[:-1] if self.instant else (self.law[1:] + self.law[:-1]) / 2


def hidden_force(
    bench: Workbench, fitted: Fitted, port: str, number: int | None, noise: np.ndarray, i: int = 0
) -> HiddenForce | None:
    """Recover the force in a port along one recording; None if the outputs do not reveal it.

    Element `number` of the corrected simulator is removed, and its force recovered; with None, the force is recovered
    that acts at `port` beside all elements. `noise` (n_y,) is the standard deviation of the outputs' noise.
    """
    if kind_of(port) == PARAMETER:  # no force acts there
        return None
    r = bench.recordings[i]
    course = COURSES[bench.hold]
    instant = kind_of(port) == SENSOR or (kind_of(port) == ACTUATOR and course.constant)
    ahead = kind_of(port) == ACTUATOR and course.begin == 1  # what acts after a sample is that of the next one
    with np.errstate(all="ignore"):
        law = law_signals(bench, fitted, number, i, ahead) if number is not None else None
        base, x0 = _remove_element(fitted, number, fitted.initial[i], bench.dt / fitted.model.substeps)
        expected = np.zeros(len(r)) if law is None else law[2]
        expected = expected if instant else (expected + np.append(expected[1:], expected[-1])) / 2
        size = expected if law is not None else np.abs(fitted.residual[i] / bench.scale).sum(axis=1)
        window = loudest_stretch(size**2, SMOOTHED_SAMPLES, r.skip)
        found = _recover(bench, fitted, _Target(base, port, x0, r, expected, noise, window))
    if found is None:
        return None
    z, dz, force, std = found
    z, dz = (v[1:] if ahead else v[:-1] if instant else (v[1:] + v[:-1]) / 2 for v in (z, dz))
    empty = np.zeros(0)
    law_z, law_dz, law_force = (empty, empty, empty) if law is None else (v[window] for v in law)
    return HiddenForce(port, r.name, r.clock[window][:-1], z, dz, force, std, law_z, law_dz, law_force, instant)


def law_signals(
    bench: Workbench, fitted: Fitted, number: int, i: int, ahead: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute local coordinate, rate and force, (M,) each, of an element along the fitted run of recording i.

    They are those of each sample, or `ahead` of the next one.
    """
    r, function = bench.recordings[i], _law_function(fitted, number, bench.dt)
    states = simulate_states(fitted, r, fitted.initial[i])
    (rows,) = map_points(function, states, r.u, input_slope(bench, r), r.clock[:, None], fitted.vector)
    rows = np.concatenate([rows[1:], rows[-1:]]) if ahead else rows
    return rows[:, 0, 0], rows[:, 1, 0], rows[:, 2, 0]


@one_at_a_time
@functools.lru_cache(maxsize=4)  # for all recordings
def _law_function(fitted: Fitted, number: int, dt: float) -> ca.Function:
    """Build `(states, u, slope of u, t, parameters) -> (z, dz, w)` of an element."""
    simulator = on_grid(fitted.simulator, dt / fitted.model.substeps)
    vector = ca.SX.sym("p", simulator.parameter_set.size)
    equations = ClosedEquations(simulator, vector)
    n_s, n_u = sum(equations.n_s), len(simulator.inputs)
    n_x = fitted.model.n_state - n_s
    x, s, u, v, t = (ca.SX.sym(k, m) for k, m in (("x", n_x), ("s", n_s), ("u", n_u), ("v", n_u), ("t", 1)))
    found = equations.evaluate(Instant(x, s, u, v, t))[3][number]
    return ca.Function("law", [ca.vertcat(x, s), u, v, t, vector], [ca.vertcat(*map(ca.SX, found))])


def signals_along(bench: Workbench, fitted: Fitted, number: int = -1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute local coordinate, rate and force of an element along the runs of all recordings, (M,) each."""
    number %= len(fitted.simulator.elements)
    found = [law_signals(bench, fitted, number, i) for i in range(len(bench.recordings))]
    z, dz, w = (np.concatenate(part) for part in zip(*found, strict=True))
    return z, dz, w


def is_curve(z: np.ndarray, w: np.ndarray) -> bool:
    """Tell whether a force w (M,) is a function of the coordinate z (M,) alone, so that no memory shows.

    Then it has one value at each level of z. In the order of z, each force lies between those of its neighbours, or
    near them. Elsewhere the neighbours come from another branch. Of samples that nearly repeat each other, as over many
    periods, one counts: they would be each other's neighbours.
    """
    finite = np.isfinite(z) & np.isfinite(w)
    if np.sum(finite) < 3 or np.ptp(z[finite]) == 0 or np.ptp(w[finite]) == 0:
        return True
    z, w = ((v[finite] - np.min(v[finite])) / np.ptp(v[finite]) for v in (z, w))
    least = FORMULA_ERROR * np.var(w)
    _, level, samples = np.unique(np.round(z, LEVEL_DIGITS), return_inverse=True, return_counts=True)
    if np.mean((w - (np.bincount(level, w) / samples)[level]) ** 2) > least:
        return False
    _, first = np.unique(np.round(np.column_stack([z, w]) / REPEATS).astype(np.int64), axis=0, return_index=True)
    any_order = np.random.default_rng(0).permutation(first)  # of samples at the same z
    order = any_order[np.argsort(z[any_order], kind="stable")]
    beside = np.sort([w[order][:-2], w[order][2:]], axis=0)
    off = w[order][1:-1] - np.clip(w[order][1:-1], *beside)
    return len(off) == 0 or bool(np.mean(off**2) < FORMULA_ERROR * np.var(w[order]))


def is_curve_along(bench: Workbench, fitted: Fitted, number: int) -> bool:
    """Tell whether the force of an element is a curve along the runs of all recordings; not if they diverge."""
    if not np.isfinite(fitted.cost):
        return False
    z, _, w = signals_along(bench, fitted, number)
    return is_curve(z, w)


def forces_of_change(bench: Workbench, fitted: Fitted, port: str, change: np.ndarray) -> dict[str, np.ndarray]:
    """Return the forces (M,) by port that change the derivatives as a change (M,) of a parameter does along the runs.

    `port` is that of the parameter (`parameter:<name>`). Ports at which no force acts alike are left out: all of them
    if an output reads the parameter.
    """
    simulator, (_, name) = bench.simulator, split_port(port)
    x, u, p, t = simulator.symbols()
    rates = ca.SX.sym("dx", len(simulator.states))  # an output that reads these alone changes by a force alike
    if ca.depends_on(ca.vertcat(*simulator.measured(x, u, p, t, rates).values()), p[name]):
        return {}
    step = ca.SX.sym("step")
    moved = Named("parameter", {k: p[k] + step if k == name else p[k] for k in p})
    change_of = simulator.derivatives(x, u, moved, t) - simulator.derivatives(x, u, p, t)
    ports = [one for one in simulator.all_ports() if not one.series]
    factors = [ca.densify(simulator.state_factors(simulator.into(one, x, u, p, t))) for one in ports]
    arguments = [stack(x), stack(u), stack(p), t, step]
    function = ca.Function("change", arguments, [ca.densify(change_of), *factors])
    runs = zip(bench.recordings, fitted.initial, strict=True)
    states = np.concatenate([simulate_states(fitted, r, state)[:, : len(simulator.states)] for r, state in runs])
    inputs, clock = (np.concatenate(part) for part in zip(*((r.u, r.clock) for r in bench.recordings), strict=True))
    values = pack_known(simulator.parameter_set, fitted.values)
    total, *by_port = map_points(function, states, inputs, values, clock[:, None], change[:, None])
    found = {}
    for one, factor in zip(ports, by_port, strict=True):
        size = np.sum(factor**2, axis=(1, 2))
        force = np.sum(total * factor, axis=(1, 2)) / np.where(size > 0, size, 1.0)
        if np.sum((total - force[:, None, None] * factor) ** 2) < SAME_CHANGE**2 * np.sum(total**2):
            found[one.name] = force
    return found


def _remove_element(fitted: Fitted, number: int | None, start: np.ndarray, h: float) -> tuple[Simulator, np.ndarray]:
    """Return the simulator without one of its elements, and its initial state without that element's part."""
    simulator = fitted.simulator
    if number is None:
        return simulator, start
    equations = ClosedEquations(on_grid(simulator, h), ca.SX.sym("p", simulator.parameter_set.size))
    at_q = np.cumsum([len(simulator.states), *equations.n_q])
    at_s = np.cumsum([at_q[-1], *equations.n_s])
    dropped = [*range(at_q[number], at_q[number + 1]), *range(at_s[number], at_s[number + 1])]
    return simulator.without_element(number), np.delete(start, dropped)


@dataclass(frozen=True, eq=False)
class _Target:
    """The simulator without the law, with the port and the stretch of a recording where the force is sought."""

    simulator: Simulator
    port: str
    x0: np.ndarray
    recording: Recording
    expected: np.ndarray  # the force expected over each sample
    noise: np.ndarray
    window: slice


def _recover(
    bench: Workbench, fitted: Fitted, target: _Target
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """Smooth the force in passes; return local coordinate and rate (M,), force and standard deviation (M - 1,)."""
    n, window, r = fitted.model.substeps, target.window, target.recording
    open_ = target.simulator.with_element(target.port, ProbeForce())
    model = discretise(open_, bench.dt, bench.hold, n)
    drive = model.drive(r)
    values = {k: v for k, v in fitted.values.items() if k in target.simulator.parameters}
    p = np.tile(model.parameters.pack(values), (len(drive), 1))
    row = model.parameters.position(f"{open_.elements[-1].prefix}w").start
    step = ca.Function("step", *differentiate_step(model, [row]))
    x0, force = target.x0, target.expected
    best: tuple[float, tuple[np.ndarray, np.ndarray, np.ndarray]] | None = None
    size: tuple[float, float] | None = None
    for _ in range(PASSES):
        p[:, row] = np.repeat(force, n)
        states = states_along(model, drive, p, x0)
        cut = slice(window.start * n, window.stop * n)
        simulated, *blocks = map_points(step, states[cut], drive[cut], p[cut])
        error = r.y[window] - simulated[::n, :, 0]
        if not np.all(np.isfinite(error)):
            break
        system = _Smoother.of(blocks, error, target.noise, force[window], states[cut][::n], n)
        size = size or system.likeliest()
        if size is None:
            return None
        dx, dw, std = system.smooth(*size)
        score = float(np.mean((error / bench.scale) ** 2))
        if best is not None and score > best[0]:
            break
        best = (score, (states[cut][::n] + dx, force[window] + dw, std))
        if system.constant:
            break
        x0 = x0 + dx[0] if window.start == 0 else x0
        force = force.copy()
        force[window] += dw
    if best is None:
        return None
    states, force, std = best[1]
    states = states[:, : len(target.simulator.states)]
    z, dz = _local_motion(bench, target.simulator, values, target.port, states, r.slice(window.start, window.stop))
    return z, dz, force[:-1], std[:-1]


def _local_motion(
    bench: Workbench, base: Simulator, values: dict[str, Any], port: str, states: np.ndarray, r: Recording
) -> tuple[np.ndarray, np.ndarray]:
    """Compute local coordinate and rate, (M,) each, of a port along states (M, n_x)."""
    z, dz, *_ = local_signals(bench, signals(base), states, r, pack_known(base.parameter_set, values))
    index = [known.name for known in base.all_ports()].index(port)
    return z[:, index], dz[:, index]
