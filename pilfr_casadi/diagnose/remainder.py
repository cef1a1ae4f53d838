"""The error that remains after the simulator's own parameters and initial states are projected off.

With base the orthonormal directions in which these can change the stacked outputs, the remainders are

    e' = e - base baseᵀ e,    φ' = φ - base baseᵀ φ,

where φ holds the outputs' changes by a small dose of each law at a port, a column for each of its shapes and strengths.
Each port is processed separately: its columns are the largest arrays of a diagnosis.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..laws import Law, Local, count_columns, unit_forces
from ..simulators import Port
from .linearise import Probe, Run, locals_of, loudest_stretch, propagate
from .workbench import Workbench

MOST = 6000  # samples used at most
HUGE = 1e60  # ratio to an output's deviation above which a response diverges
BLOCKS = 10  # blocks a recording; every second block is held out in turn


@dataclass(frozen=True, eq=False)
class Task:
    """A port, its local signals over the whole recordings, and each law allowed there with its shapes."""

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
    """The error along runs, and its part that the simulator's own parameters cannot imitate.

    Attributes
    ----------
    runs : list of Run
        The stretches that are used.
    base : array, shape (R, n)
        Orthonormal directions that parameters and initial states can follow.
    left : array, shape (R,)
        The rest of the error, each output in units of its deviation.
    tasks : tuple of Task
        Ports whose laws can be tried, sensors last.
    odd : array, shape (R,), bool
        Every second block.
    """

    bench: Workbench
    runs: list[Run]
    base: np.ndarray
    left: np.ndarray
    tasks: tuple[Task, ...]
    odd: np.ndarray

    @classmethod
    def of(cls, bench: Workbench, probe: Probe, runs: list[Run], laws: Sequence[type[Law]], at: str = "") -> Remainder:
        """Project the error along some runs, for the laws that the data can determine; with `at`, for one port only."""
        signals = ("a", "b", "c", "d", "error", "z", "dz", "u")
        short = [
            replace(r, **{k: getattr(r, k)[w] for k in signals}, from_zero=r.from_zero and w.start == 0)
            for r, w in zip(runs, _windows(bench, runs), strict=True)
        ]
        error = np.concatenate([(r.error / bench.scale).ravel() for r in short])
        base = followed(bench, short)
        left = project_off(error, base)
        tasks = [t for t in _tasks(bench, probe, laws, runs, short) if at in ("", t.port.name)]
        return cls(bench, short, base, left, tuple(tasks), folds(len(left), len(runs)))

    def columns(self, task: Task) -> tuple[np.ndarray, np.ndarray]:
        """Compute the responses beyond the base to a port's laws, each with a force of unit size, and their sizes.

        Shapes (R, n) and (n,); shapes and strengths of one law follow those of the other.
        """
        forces = [unit_forces(law, task.part, s).reshape(len(task.part.z), -1) for law, s in task.pairs]
        return self.response(task.index, np.hstack(forces))

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
        y = propagate(r, forces)[skip:]
        y /= bench.scale[:, None]
    y = y.reshape(-1, y.shape[2])
    y[:, ~((y.max(axis=0) < HUGE) & (y.min(axis=0) > -HUGE))] = 0.0  # a diverging response carries no information
    return y


def followed(bench: Workbench, runs: Sequence[Run], skips: Sequence[int] = ()) -> np.ndarray:
    """Compute orthonormal directions of the stacked outputs that parameters and initial states can follow, (R, n)."""
    return orthonormal(np.hstack(own_changes(bench, runs, skips)))


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
    share = max(MOST // len(runs) // len(bench.scale), 200)
    return [
        loudest_stretch(np.sum((r.error / bench.scale) ** 2, axis=1), share, recording.skip)
        for r, recording in zip(runs, bench.recordings, strict=True)
    ]


def _tasks(bench: Workbench, probe: Probe, laws: Sequence[type[Law]], runs: list[Run], short: list[Run]) -> list[Task]:
    by_name = {port.name: port for port in bench.simulator.all_ports()}
    out = []
    for j, (name, local, part) in enumerate(
        zip(probe.ports, locals_of(bench, runs), locals_of(bench, short), strict=True)
    ):
        port = by_name[name]
        if not np.ptp(local.z) > 0 or name.removeprefix("equation:") in bench.simulator.kinematic:
            continue
        chosen = [law() for law in laws if port.kinds & set(law.places)]
        pairs = [(law, list(law.shapes(local))) for law in chosen if usable(law, local)]
        if pairs:
            out.append(Task(j, port, local, part, pairs))
    return sorted(out, key=lambda t: t.port.name.startswith("sensor:"))


def usable(law: Law, local: Local) -> bool:
    """Tell whether the data can determine a law at a port."""
    if "dz" in law.reads() and not np.any(local.dz):
        return False
    return not law.why_not(local)


def folds(length: int, recordings: int) -> np.ndarray:
    """Mark every second block of the stacked record."""
    return (np.arange(length) * BLOCKS * recordings // max(length, 1)) % 2 == 1


def held_out(phi: np.ndarray, left: np.ndarray, odd: np.ndarray, ridges: Sequence[float] = (1e-6,)) -> float:
    """Compute the share of `left` that the columns explain on blocks that they were not fitted to."""
    size = lengths(phi)
    if not np.any(size > 0):
        return 0.0
    phi = phi[:, size > 0] / size[size > 0]
    best = 0.0
    for ridge in ridges:
        wrong = 0.0
        for fold in (odd, ~odd):
            a, b = phi[fold], left[fold]
            c = np.linalg.solve(a.T @ a + ridge * np.eye(a.shape[1]), a.T @ b)
            wrong += float(np.sum((left[~fold] - phi[~fold] @ c) ** 2))
        best = max(best, 1 - wrong / max(float(left @ left), 1e-300))
    return best


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
