"""A score test of every port and law: how much of the residual a small dose of a law would take away.

The outputs' sensitivity to a law at zero strength is projected off the simulator's own parameters and the initial
states (Rao 1948); shape parameters lie on a grid. It is done twice: along the refitted simulation, and along an
observer with process noise at every port, on its innovations.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..laws import Law
from ..laws.base import Local
from ..laws.trace import columns, trace
from ..simulator import Port
from .linearise import Probe, Run, linearised, locals_of, observer_gain, propagate, run
from .workbench import Fitted, Workbench

MOST = 6000  # samples looked at
HUGE = 1e60  # times an output's deviation
BLOCKS = 10  # a recording, odd and even ones in turn


@dataclass(frozen=True, eq=False)
class Scored:
    """A port and law with the share of the residual that a small dose takes away, and start values, best first.

    The share is judged on blocks it was not fitted to.
    """

    port: str
    law: Law
    share: float
    starts: tuple[dict[str, Any], ...]
    local: Local
    source: str = "simulation"


def screen(
    bench: Workbench, fitted: Fitted, laws: Sequence[type[Law]], noise: np.ndarray, keep: int = 3
) -> tuple[list[Scored], dict[str, int], np.ndarray | None]:
    """Every port and law with its score along the simulation and along the observer, best first.

    Also returns each port's sense (+1: a positive force opposes motion, see `linearise.Run`) and the observer's gain.

    Parameters
    ----------
    noise : array, shape (n_y,)
        Standard deviation of the outputs' noise.
    keep : int
        Start values kept of each pair.
    """
    probe, runs = linearised(bench, fitted)
    gain = observer_gain(probe, runs, noise)
    signs = {name: int(s) for name, s in zip(probe.ports, runs[0].sign, strict=True)}

    def along_observer() -> list[Scored]:
        led = [run(bench, probe, fitted, i, gain) for i in range(len(runs))] if gain.any() else []
        seen = all(np.all(np.isfinite(values)) for r in led for values in (r.a, r.b, r.z, r.dz, r.error))
        return _score(bench, probe, led, laws, "observer", keep) if led and seen else []

    with ThreadPoolExecutor(1) as other:
        observed = other.submit(along_observer)
        found = _score(bench, probe, runs, laws, "simulation", keep) + observed.result()
    led = any(s.source == "observer" for s in found)
    return sorted(found, key=lambda s: -s.share), signs, gain if led else None


def _windows(bench: Workbench, runs: Sequence[Run]) -> list[slice]:
    """The stretch of each recording that is looked at: where the error is largest."""
    share = max(MOST // len(runs) // len(bench.scale), 200)
    out = []
    for r, recording in zip(runs, bench.recordings, strict=True):
        m, skip = len(r.error), recording.skip
        if m - skip <= share:
            out.append(slice(skip, m))
            continue
        energy = np.cumsum(np.append(0.0, np.sum((r.error / bench.scale) ** 2, axis=1)))
        starts = np.arange(skip, m - share + 1, max(share // 8, 1))
        at = int(starts[np.argmax(energy[starts + share] - energy[starts])])
        out.append(slice(at, at + share))
    return out


def _score(
    bench: Workbench,
    probe: Probe,
    runs: list[Run],
    laws: Sequence[type[Law]],
    source: str,
    keep: int,
) -> list[Scored]:
    tasks, phi, left = columns_of(bench, probe, runs, laws)
    total, at, out = max(float(left @ left), 1e-300), 0, []
    odd = folds(len(left), len(runs))
    for task in tasks:
        own = at
        for law, shapes in task.pairs:
            width, scores = columns(law), []
            for k, shape in enumerate(shapes):
                cols = slice(at + k * width, at + (k + 1) * width)
                drop, strength = _gain(phi[:, cols], left, law, int(runs[0].sign[task.index]))
                found = -strength / task.size[cols.start - own : cols.stop - own]
                scores.append((drop / total, shape, found, cols))
            at += width * len(shapes)
            scores.sort(key=lambda s: -s[0])
            starts = tuple(_start(law, shape, c) for _, shape, c, _ in scores[:keep])
            share = held_out(phi[:, scores[0][3]], left, odd)
            out.append(Scored(task.port.name, law, share, starts, task.local, source))
    return out


def folds(length: int, recordings: int) -> np.ndarray:
    """Every second block of the stacked record, as a mask."""
    return (np.arange(length) * BLOCKS * recordings // max(length, 1)) % 2 == 1


def held_out(phi: np.ndarray, left: np.ndarray, odd: np.ndarray, ridges: Sequence[float] = (1e-6,)) -> float:
    """Share of `left` that the columns explain on blocks they were not fitted to."""
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


def columns_of(
    bench: Workbench, probe: Probe, runs: list[Run], laws: Sequence[type[Law]]
) -> tuple[list[_Task], np.ndarray, np.ndarray]:
    """Each port's laws, the outputs' changes by all their shapes, and the error.

    Changes and error are without what the simulator's own parameters and the initial states can follow.
    """
    n_free = len(probe.free) - len(probe.ports)
    short = [
        replace(r, **{k: getattr(r, k)[w] for k in ("a", "b", "c", "d", "error", "z", "dz")})
        for r, w in zip(runs, _windows(bench, runs), strict=True)
    ]
    error = np.concatenate([(r.error / bench.scale).ravel() for r in short])
    tasks = _tasks(bench, probe, laws, locals_of(bench, runs), locals_of(bench, short))
    edges = np.cumsum([0, *(len(r.z) for r in short)])
    blocks = []
    for i, r in enumerate(short):
        forces = [(t.index, t.forces[edges[i] : edges[i + 1]]) for t in tasks]
        with np.errstate(over="ignore", invalid="ignore"):
            y = propagate(r, forces, n_free)
            y /= bench.scale[:, None]
        y = y.reshape(-1, y.shape[2])
        y[:, ~((y.max(axis=0) < HUGE) & (y.min(axis=0) > -HUGE))] = 0.0  # what grows without end says nothing
        blocks.append(y)
    first = n_free + short[0].a.shape[1]
    base = orthonormal(block_diagonal([b[:, :first] for b in blocks], n_free))
    left = error - base @ (base.T @ error)
    phi = np.concatenate([b[:, first:] for b in blocks])
    size = lengths(phi)
    phi -= base @ (base.T @ phi)
    phi[:, lengths(phi) < 1e-6 * size] = 0.0  # what the simulator's own parameters follow entirely
    return tasks, phi, left


@dataclass(frozen=True, eq=False)
class _Task:
    """A port's laws and shapes with their forces, each column of unit size (`size` is what it was)."""

    index: int
    port: Port
    local: Local
    pairs: list[tuple[Law, list[dict[str, Any]]]]
    forces: np.ndarray
    size: np.ndarray


def _tasks(
    bench: Workbench, probe: Probe, laws: Sequence[type[Law]], places: list[Local], parts: list[Local]
) -> list[_Task]:
    """Forces along `parts` of the signals of `places`."""
    by_name = {port.name: port for port in bench.simulator.all_ports()}
    out = []
    for j, (name, local, part) in enumerate(zip(probe.ports, places, parts, strict=True)):
        port = by_name[name]
        if not np.ptp(local.z) > 0 or name.removeprefix("equation:") in bench.simulator.kinematic:
            continue
        chosen = [law() for law in laws if ("series" if port.series else "parallel") in law.places]
        pairs = [(law, list(law.shapes(local))) for law in chosen if usable(law, local)]
        if not pairs:
            continue
        forces = np.hstack([trace(law, part, shapes).reshape(len(part.z), -1) for law, shapes in pairs])
        forces = np.where(np.abs(forces) < 1e100, forces, 0.0)
        size = np.sqrt(np.mean(forces**2, axis=0))
        size = np.where(size > 0, size, 1.0)
        out.append(_Task(j, port, local, pairs, forces / size, size))
    return sorted(out, key=lambda t: t.port.name.startswith("sensor:"))


def usable(law: Law, local: Local) -> bool:
    """Whether the data can speak to a law at a port."""
    if "dz" in law.reads() and not np.any(local.dz):
        return False
    return not law.applies(local)


def _start(law: Law, shape: dict[str, Any], strength: np.ndarray) -> dict[str, Any]:
    values, at, p = dict(shape), 0, law.at(shape).parameters()
    for name in law.strength:
        size = p[name].size
        values[name] = strength[at : at + size] if p[name].value.ndim else float(strength[at])
        at += size
    return values


def block_diagonal(blocks: list[np.ndarray], n_free: int) -> np.ndarray:
    """Parameters shared by all recordings, an initial state for each."""
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
    """Length of each column."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->j", columns, columns)))


def orthonormal(columns: np.ndarray) -> np.ndarray:
    """Orthonormal basis of the columns' span."""
    size = lengths(columns)
    kept = columns[:, size > 0] / size[size > 0]
    u, s, _ = np.linalg.svd(kept, full_matrices=False)
    return u[:, s > 1e-9 * s.max(initial=1e-300)]


def _signed(law: Law) -> np.ndarray:
    """Which strengths (one entry a column) need not oppose motion."""
    p = law.parameters()
    return np.concatenate([np.full(p[name].size, name in law.signed) for name in law.strength])


def _gain(phi: np.ndarray, left: np.ndarray, law: Law, sign: int) -> tuple[float, np.ndarray]:
    """Drop of the sum of squares by the columns of one shape, and their coefficients."""
    gram, right = phi.T @ phi, phi.T @ left
    size = np.sqrt(np.diag(gram))
    if not np.any(size > 0):
        return 0.0, np.zeros(phi.shape[1])
    size = np.where(size > 0, size, 1.0)
    n = len(size)
    ridge = gram / np.outer(size, size) + 1e-10 * np.eye(n)
    if law.dissipative and sign and n > 1:
        from scipy.optimize import nnls

        root = np.linalg.cholesky(ridge).T
        target = np.linalg.solve(root.T, -sign * right / size)
        both = _signed(law)  # these may have either sign: their negatives are columns as well
        found = nnls(np.hstack([root, -root[:, both]]), target)[0]
        coefficients = found[:n]
        coefficients[both] -= found[n:]
        coefficients = -sign * coefficients
    else:
        coefficients = np.linalg.solve(ridge, right / size)
        if law.dissipative and sign and n == 1 and -sign * coefficients[0] < 0:
            coefficients = np.zeros(1)
    share = float(2 * coefficients @ (right / size) - coefficients @ ridge @ coefficients)
    return share, coefficients / size
