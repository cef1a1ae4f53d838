"""A score test of every port and law: the share of the residual that a small dose of a law would remove.

Errors and responses are taken beyond the base: the orthonormal directions in which the simulator's own parameters and
the initial states can change the stacked outputs (Rao 1948). The remainders are

    e' = e - base baseᵀ e,    φ' = φ - base baseᵀ φ,

where φ holds the outputs' changes by a small dose of each law at a port, a column for each of its shapes and strengths;
shape parameters lie on a grid. Each port is processed separately: its columns are the largest arrays of a diagnosis.
The test is done twice: along the refitted simulation, and along an observer with process noise at every port, on its
innovations.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..._base import side_by_side
from ...data import Recording
from ...laws import Law, Local, count_columns, unit_forces
from ...simulators import EQUATION, PARAMETER, SENSOR, Port, kind_of, port_name
from .linearise import (
    Probe,
    Run,
    linearise_runs,
    locals_of,
    loudest_stretch,
    observer_gain,
    parameter_signals,
    propagate,
    run,
)
from .workbench import FEW, Fitted, Workbench

Pair = tuple[str, type[Law]]  # a port and the class of a law
SCREENED_SAMPLES = 6000  # samples used at most
HUGE = 1e60  # ratio to an output's deviation above which a response diverges
BLOCKS = 10  # blocks a recording; every second block is held out in turn
RIDGES = (1e-6, 1e-3)  # strengths of the ridge regression of flexible forces, relative to a column of unit length


@dataclass(frozen=True, eq=False)
class Task:
    """A port, its local signals over the whole recordings, and each law allowed there with its shapes.

    `index` is its place among all ports; that of a parameter counts back from the first port.
    """

    index: int
    port: Port
    local: Local
    part: Local
    pairs: list[tuple[Law, list[dict[str, Any]]]]


@dataclass(frozen=True, eq=False)
class Dose:
    """Response to a law of one shape: a column for each strength (R, n), and the forces' sizes (n,)."""

    shape: dict[str, Any]
    phi: np.ndarray
    size: np.ndarray


@dataclass(frozen=True, eq=False)
class Remainder:
    """The error along runs, and its part that the simulator's own parameters cannot imitate."""

    bench: Workbench
    runs: list[Run]  # the stretches that are used
    base: np.ndarray  # (R, n), orthonormal directions that parameters and initial states can follow
    left: np.ndarray  # (R,), the rest of the error, each output in units of its deviation
    tasks: tuple[Task, ...]  # ports whose laws can be tried, sensors last
    odd: np.ndarray  # (R,), every second block

    @classmethod
    def of(cls, bench: Workbench, probe: Probe, runs: list[Run], laws: Sequence[type[Law]], at: str = "") -> Remainder:
        """Project the error along some runs, for the laws that the data can determine; with `at`, for one port only."""
        signals = ("a", "b", "c", "d", "error", "z", "dz", "x", "u", "own")
        windows = _windows(bench, runs)
        short = [
            replace(r, **{k: getattr(r, k)[w] for k in signals}, from_zero=r.from_zero and w.start == 0)
            for r, w in zip(runs, windows, strict=True)
        ]
        error = np.concatenate([(r.error / bench.scale).ravel() for r in short])
        base = orthonormal(np.hstack(own_changes(bench, short)))
        left = project_off(error, base)
        every = (*_tasks(bench, probe, laws, runs, short), *_parameter_tasks(bench, probe, laws, runs, short))
        tasks = [t for t in every if at in ("", t.port.name)]
        return cls(bench, short, base, left, tuple(tasks), folds(bench.recordings, windows))

    def columns(self, task: Task, shifted: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Compute the responses beyond the base to a port's laws, each with a force of unit size, and their sizes.

        Shapes (R, n) and (n,); shapes and strengths of one law follow those of the other. The forces may be `shifted`
        by half a run, so that they have no relation to it.
        """
        forces = np.hstack([unit_forces(law, task.part, s).reshape(len(task.part.z), -1) for law, s in task.pairs])
        if shifted:
            parts = np.split(forces, np.cumsum([len(r.z) for r in self.runs])[:-1])
            forces = np.concatenate([np.roll(part, len(part) // 2, axis=0) for part in parts])
        return self.response(task.index, forces)

    def response(self, port: int, forces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the responses beyond the base to forces (M, n) at a port, scaled to unit size, and their sizes."""
        forces[~(np.abs(forces) < 1e100)] = 0.0
        size = lengths(forces) / np.sqrt(len(forces))
        size = np.where(size > 0, size, 1.0)
        forces /= size
        blocks, at = [], 0
        for r in self.runs:
            now = slice(at, at + len(r.z))
            blocks.append(moved(self.bench, r, [(port, forces[now])])[:, -len(size) :])
            at = now.stop
        phi = np.concatenate(blocks) if len(blocks) > 1 else blocks[0]
        size_before = lengths(phi)
        phi -= self.base @ (self.base.T @ phi)
        phi[:, lengths(phi) < 1e-6 * size_before] = 0.0  # the simulator's own parameters imitate these entirely
        return phi, size

    def doses(self, task: Task) -> Iterator[tuple[Law, list[Dose]]]:
        """Generate each law of a port with a dose of each of its shapes; see `columns`."""
        phi, size = self.columns(task)
        at = 0
        for law, shapes in task.pairs:
            width = count_columns(law)
            spans = [slice(at + k * width, at + (k + 1) * width) for k in range(len(shapes))]
            yield law, [Dose(shape, phi[:, own], size[own]) for shape, own in zip(shapes, spans, strict=True)]
            at += width * len(shapes)


def moved(bench: Workbench, r: Run, forces: Sequence[tuple[int, np.ndarray]] = (), skip: int = 0) -> np.ndarray:
    """Compute the stacked outputs' changes, over their deviation, by free parameters, initial state, and forces.

    The first `skip` samples are left out; see `propagate` for the forces.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        return in_deviations(bench, propagate(r, forces)[skip:])


def in_deviations(bench: Workbench, changes: np.ndarray) -> np.ndarray:
    """Stack changes of the outputs (M, n_y, n) in units of their deviation, (R, n); diverging ones become zero."""
    with np.errstate(over="ignore", invalid="ignore"):
        y = (changes / bench.scale[:, None]).reshape(-1, changes.shape[2])
    y[:, ~((y.max(axis=0) < HUGE) & (y.min(axis=0) > -HUGE))] = 0.0  # a diverging response carries no information
    return y


def own_changes(
    bench: Workbench, runs: Sequence[Run], skips: Sequence[int] = (), known: Sequence[bool] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the stacked outputs' changes by free parameters (R, n_free) and by unknown initial states (R, n).

    `known` marks the runs whose initial state is known; see `moved` for the units and `skips`.
    """
    blocks = [moved(bench, r, skip=skip) for r, skip in zip(runs, skips or [0] * len(runs), strict=True)]
    changes, n = block_diagonal(blocks, runs[0].n_free), runs[0].n_free
    unknown = np.repeat(np.logical_not(known or [False] * len(runs)), (changes.shape[1] - n) // len(runs))
    return changes[:, :n], changes[:, n:][:, unknown]


def _windows(bench: Workbench, runs: Sequence[Run]) -> list[slice]:
    """Choose the stretch of each recording that is used: the one with the largest error."""
    share = max(SCREENED_SAMPLES // len(runs) // len(bench.scale), 200)
    return [
        loudest_stretch(np.sum((r.error / bench.scale) ** 2, axis=1), share, recording.skip)
        for r, recording in zip(runs, bench.recordings, strict=True)
    ]


def _tasks(bench: Workbench, probe: Probe, laws: Sequence[type[Law]], runs: list[Run], short: list[Run]) -> list[Task]:
    """Make a task for each port that moves, except equations that only define a rate; sensors come last."""
    by_name = {port.name: port for port in bench.simulator.all_ports()}
    definitions = {port_name(EQUATION, state) for state in bench.simulator.kinematic}
    out = []
    for j, (name, local, part) in enumerate(
        zip(probe.ports, locals_of(bench, runs), locals_of(bench, short), strict=True)
    ):
        port = by_name[name]
        if not np.ptp(local.z) > 0 or name in definitions:
            continue
        chosen = [law() for law in laws if port.admits(law)]
        pairs = [(law, list(law.shapes(local))) for law in chosen if usable(law, local)]
        if pairs:
            out.append(Task(j, port, local, part, pairs))
    return sorted(out, key=lambda t: kind_of(t.port.name) == SENSOR)


def _parameter_tasks(
    bench: Workbench, probe: Probe, laws: Sequence[type[Law]], runs: list[Run], short: list[Run]
) -> Iterator[Task]:
    """Generate a task for each free coefficient of the equations; a change of it has a column of its own."""
    own = [law() for law in laws if "parameter" in law.places and (law.scheduled_by or law.signal)]
    for name in bench.simulator.coefficients if own else ():
        if np.all(bench.simulator.parameters[name].fixed):
            continue
        at = probe.model.parameters.position(name).start
        index = int(np.searchsorted(probe.free, at)) - runs[0].n_free
        value = float(probe.values[at])
        port = bench.simulator.port(port_name(PARAMETER, name))
        both = [parameter_signals(bench, value, [r.x for r in rs], [r.u for r in rs]) for rs in (runs, short)]
        for signal in dict.fromkeys(law.signal for law in own):
            local, part = (replace(v, z=v.inputs[signal]) if signal else v for v in both)
            laws_of = [law for law in own if law.signal == signal and usable(law, local)]
            if laws_of:
                yield Task(index, port, local, part, [(law, list(law.shapes(local))) for law in laws_of])


def usable(law: Law, local: Local) -> bool:
    """Tell whether the data can determine a law at a port."""
    if "dz" in law.reads() and not np.any(local.dz):
        return False
    return not law.why_not(local)


def folds(recordings: Sequence[Recording], windows: Sequence[slice]) -> np.ndarray:
    """Mark every second block of the stacked outputs of some windows.

    All periods are held out at the same phases: a force that repeats with the input could otherwise learn the noise of
    one period, and repeat half of it in the next.
    """
    out = []
    for r, window in zip(recordings, windows, strict=True):
        length, count = window.stop - window.start, BLOCKS
        at = np.arange(length)
        if r.period and r.begins == "periodic" and length > r.period:
            count = 2 * max(round(BLOCKS * r.period / length / 2), 1)  # even, so that blocks alternate across periods
            at, length = at % r.period, r.period
        out.append(np.repeat(at * count // max(length, 1) % 2 == 1, r.n_y))
    return np.concatenate(out)


def held_out(phi: np.ndarray, left: np.ndarray, odd: np.ndarray, ridges: Sequence[float] = RIDGES[:1]) -> float:
    """Compute the share of `left` that the columns explain on blocks that they were not fitted to."""
    rest = least_rest(phi, left, odd, ridges)
    return max(0.0, 1 - float(rest @ rest) / max(float(left @ left), 1e-300))


def least_rest(phi: np.ndarray, left: np.ndarray, odd: np.ndarray, ridges: Sequence[float]) -> np.ndarray:
    """Compute what the columns leave of `left` on blocks that they were not fitted to, with the best penalty."""
    size = lengths(phi)
    if not np.any(size > 0):
        return left
    phi = phi[:, size > 0] / size[size > 0]
    return min((held_out_rest(phi, left, odd, ridge) for ridge in ridges), key=lambda rest: float(rest @ rest))


def held_out_rest(phi: np.ndarray, left: np.ndarray, odd: np.ndarray, ridge: float) -> np.ndarray:
    """Compute the rest (R,) on every second block with coefficients fitted to the others, and vice versa."""
    rest = np.empty_like(left)
    for a, b in ((odd, ~odd), (~odd, odd)):
        rest[b] = left[b] - phi[b] @ ridge_solution(phi[a], left[a], ridge)
    return rest


def ridge_solution(a: np.ndarray, b: np.ndarray, ridge: float) -> np.ndarray:
    """Solve a x = b in the least squares sense, with the penalty ridge |x|²."""
    return np.asarray(np.linalg.solve(a.T @ a + ridge * np.eye(a.shape[1]), a.T @ b))


def block_diagonal(blocks: list[np.ndarray], n_free: int) -> np.ndarray:
    """Arrange columns by parameters shared by all recordings, and by an initial state for each."""
    n_x = blocks[0].shape[1] - n_free
    out = np.zeros((sum(map(len, blocks)), n_free + n_x * len(blocks)))
    at = 0
    for i, b in enumerate(blocks):
        rows = slice(at, at + len(b))
        out[rows, :n_free] = b[:, :n_free]
        out[rows, n_free + i * n_x : n_free + (i + 1) * n_x] = b[:, n_free:]
        at += len(b)
    return out


def lengths(columns: np.ndarray) -> np.ndarray:
    """Compute the length of each column."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->j", columns, columns)))


def project_off(columns: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Subtract the projection on orthonormal directions from one column (R,) or several (R, n)."""
    return np.asarray(columns - base @ (base.T @ columns))


def orthonormal(columns: np.ndarray) -> np.ndarray:
    """Compute an orthonormal basis of the columns' span."""
    size = lengths(columns)
    kept = columns[:, size > 0] / size[size > 0]
    u, s, _ = np.linalg.svd(kept, full_matrices=False)
    return u[:, s > 1e-9 * s.max(initial=1e-300)]


@dataclass(frozen=True, eq=False)
class Scored:
    """A port and law with its score and start values, best first.

    The score is the share of the residual that a small dose removes on blocks that it was not fitted to; `sense` is
    `linearise.Run.sense`. Everything else starts at the values `beside`, by full name, or where they say nothing, at
    those of the hypothesis that the law is added to.
    """

    port: str
    law: Law
    share: float
    starts: tuple[dict[str, Any], ...]
    local: Local
    sense: int = 0
    source: str = "simulation"
    beside: Mapping[str, Any] = field(default_factory=dict)

    @property
    def pair(self) -> Pair:
        """Port and class of the law."""
        return self.port, type(self.law)


def screen(
    bench: Workbench, fitted: Fitted, laws: Sequence[type[Law]], noise: np.ndarray, workers: int
) -> tuple[list[Scored], np.ndarray | None]:
    """Score every port and law along the simulation and along the observer, best first.

    `noise` (n_y,) is the standard deviation of the outputs' noise. Also returns the observer's gain.
    """
    bench = bench.balanced(fitted)
    probe, runs = linearise_runs(bench, fitted)
    gain = observer_gain(probe, runs, noise)
    observed = [run(bench, probe, fitted, i, gain) for i in range(len(runs))] if gain.any() else []
    if not all(_stays_bounded(r, bench.scale) for r in observed):
        observed = []
    remainders = [("simulation", Remainder.of(bench, probe, runs, laws))]
    if observed:
        remainders.append(("observer", Remainder.of(bench, probe, observed, laws)))
    tasks = [(rest, task, source) for source, rest in remainders for task in rest.tasks]
    found = [scored for one in side_by_side(lambda task: _score(*task), tasks, workers) for scored in one]
    seen = any(s.source == "observer" for s in found)
    return sorted(found, key=lambda s: -s.share), gain if seen else None


def _stays_bounded(r: Run, scale: np.ndarray) -> bool:
    """Tell whether an observer has kept the simulator in its range and bounded."""
    finite = all(np.all(np.isfinite(values)) for values in (r.a, r.b, r.z, r.dz))
    return finite and bool(np.all(np.abs(r.error) < HUGE * scale))


def _score(rest: Remainder, task: Task, source: str) -> list[Scored]:
    """Score each law of a port by its best shape, with its start values."""
    total, out = max(float(rest.left @ rest.left), 1e-300), []
    for law, doses in rest.doses(task):
        sense, scores = rest.runs[0].sense(law, task.index), []
        for dose in doses:
            drop, strength = _gain(dose.phi, rest.left, law, sense)
            scores.append((drop / total, dose, -strength / dose.size))
        scores.sort(key=lambda s: -s[0])
        kept = scores if law.in_line else scores[:FEW]  # a small dose hardly ranks the shapes of a law in line
        starts = tuple(start_values(law, dose.shape, c) for _, dose, c in kept)
        # a law with the sign of a drive explains nothing
        share = min(held_out(scores[0][1].phi, rest.left, rest.odd), scores[0][0])
        out.append(Scored(task.port.name, law, share, starts, task.local, sense, source))
    return out


def start_values(law: Law, shape: dict[str, Any], strength: np.ndarray) -> dict[str, Any]:
    """Compute a law's start values: its shape, and its strengths from one entry a column."""
    values, at, p = dict(shape), 0, law.at(shape).parameters()
    for name in law.strength:
        size = p[name].size
        values[name] = strength[at : at + size] if p[name].value.ndim else float(strength[at])
        at += size
    return values


def fit_shapes(columns: Iterable[np.ndarray], force: np.ndarray) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Fit the unit forces (M, n) of each shape of a law to a force; generate shape, strengths and fitted force."""
    for k, a in enumerate(columns):
        if np.all(np.isfinite(a)):
            strengths = np.linalg.lstsq(a, force, rcond=1e-9)[0]
            yield k, strengths, a @ strengths


def _signed(law: Law) -> np.ndarray:
    """Mark the strengths (one entry a column) that may have either sign."""
    p = law.parameters()
    return np.concatenate([np.full(p[name].size, name in law.signed) for name in law.strength])


def _gain(phi: np.ndarray, left: np.ndarray, law: Law, sense: int) -> tuple[float, np.ndarray]:
    """Compute the decrease of the sum of squares by the columns of one shape, and their coefficients."""
    gram, right = phi.T @ phi, phi.T @ left
    size = np.sqrt(np.diag(gram))
    if not np.any(size > 0):
        return 0.0, np.zeros(phi.shape[1])
    size = np.where(size > 0, size, 1.0)
    n = len(size)
    ridge = gram / np.outer(size, size) + 1e-10 * np.eye(n)
    if sense and n > 1:
        from scipy.optimize import nnls

        root = np.linalg.cholesky(ridge).T
        target = np.linalg.solve(root.T, -sense * right / size)
        both = _signed(law)  # strengths of either sign: their negatives are columns as well
        found = nnls(np.hstack([root, -root[:, both]]), target)[0]
        coefficients = found[:n]
        coefficients[both] -= found[n:]
        coefficients = -sense * coefficients
    else:
        coefficients = np.linalg.solve(ridge, right / size)
        if sense and n == 1 and -sense * coefficients[0] < 0:
            coefficients = np.zeros(1)
    share = float(2 * coefficients @ (right / size) - coefficients @ ridge @ coefficients)
    return share, coefficients / size
