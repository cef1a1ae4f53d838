"""Gate of gaps: samples that were lost within a recording, time renumbered, so that every channel jumps at once.

Along the refitted run, a jump δ of the state at sample k changes what comes after by `Φ_k δ`. With e what parameters
and initial states leave of the error, and base what they can follow, the best jump takes away

    s' (S - G G')⁻¹ s,    S = Φ_k'Φ_k,  G = Φ_k' base,  s = Φ_k' e

of e'e; S, G and s follow from those of the next sample, so that every sample is tried at once. A shock or a stop moves
no state that is the integral of another, and a step of a force or of a sensor moves none: where one of these does about
as well, or where no state is such an integral, nothing is said. A jump is confirmed by a refit to the two pieces.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._base import InputError
from ..data import Recording
from ..simulators import states_along
from .gates import Gate
from .linearise import Run, linearised
from .timing import ALONE, DROP, nominal_directions
from .workbench import THOROUGH, Fitted, Workbench

MOST = 3  # gaps
ABOVE = 4.0  # times the noise, in mean square, beyond which gaps are looked for
SHARE = 0.2  # of the mean square that a jump takes away at least
RIVAL, WORSE = 0.97, 2.0  # of that, a shock or a step takes away at most, and times what a jump leaves it leaves
TURNS = 5  # of a fit and a jump
SHORTEST = 40  # samples of a piece
NEAR = 3  # samples around a jump at which a shock is tried
BETWEEN = (-0.5, 0.0, 0.5)  # samples, by which it may come later
BESIDE, SHARP = 5, 1.1  # samples beside a gap, where a jump leaves so many times the mean square
CHUNK = 256  # samples solved for at a time
RIDGE = 1e-6  # of a jump that initial states can follow nothing is known

Origin = tuple[str, int]  # label of the recording as given, and its sample that a piece begins with
Stage = tuple[Workbench, Fitted, list[Origin]]


@dataclass(frozen=True)
class Jump:
    """A jump of the state at a sample of a recording; the shares are of the mean square that it takes away.

    Attributes
    ----------
    rival : float
        Share that a shock nearby, or a step of one force or sensor there, takes away.
    beside : float
        Share that a jump some samples away takes away.
    size : array, shape (n_x,)
        The jump.
    """

    recording: int
    sample: int
    share: float
    rival: float
    beside: float
    size: np.ndarray

    @property
    def distinct(self) -> bool:
        """Tell whether it takes much away, and no rival as much."""
        return self.share > SHARE and self.rival < RIVAL * self.share

    @property
    def told(self) -> bool:
        """Tell whether every rival also leaves far more."""
        return self.distinct and 1 - self.rival > WORSE * max(1 - self.share, 0.0)

    @property
    def sharp(self) -> bool:
        """Tell whether it does so at this very sample only; a drift does so around it too."""
        return 1 - self.beside > SHARP * (1 - self.share)


def gaps(bench: Workbench, plain: Fitted, noise2: float) -> tuple[Workbench, Fitted, list[Gate]]:
    """Look for lost samples; cut the recordings there if that cures most of the mismatch.

    The state at the first sample of a later piece is estimated. Recordings in periodic steady state are left alone.
    """
    noise2 = min(noise2, _quiet(bench, plain) or noise2)
    least = ALONE**2 * noise2
    stages: list[Stage] = [(bench, plain, [(r.label, 0) for r in bench.recordings])]
    while len(stages) <= MOST and stages[-1][1].cost > ABOVE * noise2:
        now, found, origins = stages[-1]
        settled = _settled(now, found)
        if settled is None or not settled[0].distinct or settled[2].cost > (1 - SHARE / 2) * found.cost:
            break
        jump, now, found = settled
        label, begin = origins[jump.recording]
        at = jump.recording + 1
        stages.append((now, found, [*origins[:at], (label, begin + jump.sample), *origins[at:]]))
    for now, found, origins in reversed(stages[1:]):  # what looked like one more may be another cause's
        confirmed = _confirmed(now, found, origins, least) if found.cost < DROP * plain.cost else None
        if confirmed is not None:
            now, found, origins = confirmed
            pieces = [_named(r, begin) for r, (_, begin) in zip(now.recordings, origins, strict=True)]
            gate = _gate(bench, [o for o in origins if o[1]], plain.cost, found.cost)
            return replace(now, recordings=tuple(pieces)), found, [gate]
    return bench, plain, []


def _confirmed(now: Workbench, found: Fitted, origins: list[Origin], least: float) -> Stage | None:
    """Test each gap again, now that the others are cut; return None if one of them is no gap."""
    sharp, origins = True, list(origins)
    for i, (label, begin) in enumerate(origins):
        if not begin:
            continue
        settled = _settled(*_joined(now, found, i))
        if settled is None or settled[0].recording != i - 1 or not settled[0].told:
            return None
        jump, now, found = settled
        origins[i] = label, origins[i - 1][1] + jump.sample
        sharp = sharp and jump.sharp
    return (now, found, origins) if sharp or found.cost < least else None


def _named(r: Recording, begin: int) -> Recording:
    """Name a piece by the time at which it begins."""
    return r.with_(name=f"{r.name} from {begin * r.dt:.6g} s".strip()) if begin else r


def _joined(bench: Workbench, fitted: Fitted, i: int) -> tuple[Workbench, Fitted]:
    """Put a piece back behind the one before; return the bench and the run there at the same values."""
    one, other = bench.recordings[i - 1 : i + 1]
    whole = one.with_(u=np.concatenate([one.u, other.u]), y=np.concatenate([one.y, other.y]))
    before = replace(bench, recordings=(*bench.recordings[: i - 1], whole, *bench.recordings[i + 1 :]))
    return before, _same(before, fitted, [*fitted.initial[:i], *fitted.initial[i + 1 :]])


def _same(bench: Workbench, fitted: Fitted, initial: list[np.ndarray]) -> Fitted:
    """Run another bench's fit on this one's recordings at its values."""
    return bench.result(bench.simulator, fitted.values, initial, fitted.engine, fitted.model)


def _settled(bench: Workbench, fitted: Fitted) -> tuple[Jump, Workbench, Fitted] | None:
    """Repeat jump and fit to the pieces until the jump stays: a fit across a gap may have gone astray."""
    best: tuple[Jump, Workbench, Fitted] | None = None
    along = fitted
    for _ in range(TURNS):
        jump = find_jump(bench, along)
        if jump is None or jump.share < SHARE:
            break
        i = jump.recording
        if best is not None and (i, jump.sample) == (best[0].recording, best[0].sample):
            return jump, *best[1:]
        pieces = _cut(bench.recordings[i], jump.sample)
        other = replace(bench, recordings=(*bench.recordings[:i], *pieces, *bench.recordings[i + 1 :]))
        states = [*along.begin[: i + 1], _begin(along, bench.recordings[i], jump), *along.begin[i + 1 :]]
        starts: list[dict[str, Any]] = [along.values, {}]
        try:
            found = other.fit(
                other.simulator, starts, states=states, solver=THOROUGH, model=fitted.model, engine=fitted.engine
            )
        except InputError:
            break
        best = jump, other, found
        along = _same(bench, found, [*found.initial[: i + 1], *found.initial[i + 2 :]])
    return best


def _cut(r: Recording, sample: int) -> tuple[Recording, Recording]:
    """Cut a recording in two; the second begins in a state that is to be estimated."""
    return r.slice(0, sample), r.slice(sample).with_(initial="estimate", period=None)


def _quiet(bench: Workbench, fitted: Fitted) -> float:
    """Estimate the mean square of white noise from the median of third differences, which a few jumps do not move."""
    thirds = np.abs(np.concatenate([np.diff(e, 3, axis=0) for e in fitted.residual]))
    return float(np.mean((1.4826 * np.median(thirds, axis=0) / bench.scale) ** 2) / 20)


@np.errstate(over="ignore", invalid="ignore")
def find_jump(bench: Workbench, fitted: Fitted) -> Jump | None:
    """Find the jump of the simulator's states that takes most away, to first order; None if gaps cannot be told."""
    simulator = bench.simulator
    if not simulator.kinematic:
        return None
    runs = linearised(bench, fitted)[1]
    base = nominal_directions(bench, fitted)
    error = np.concatenate(
        [(one.error / bench.scale)[r.skip :].ravel() for one, r in zip(runs, bench.recordings, strict=True)]
    )
    error = error - base @ (base.T @ error)
    n_x = len(simulator.states)
    moved = [i for i, name in enumerate(simulator.states) if name not in simulator.kinematic]
    best: Jump | None = None
    at = 0
    for i, (r, one) in enumerate(zip(bench.recordings, runs, strict=True)):
        rows = slice(at, at + (len(r) - r.skip) * r.n_y)
        at = rows.stop
        if r.begins == "periodic" or len(r) - r.skip < 2 * SHORTEST:
            continue
        shares, rivals, sizes = _taken(one, bench.scale, base[rows], error[rows], r.skip, n_x, moved)
        shares[: r.skip + SHORTEST] = shares[len(r) - SHORTEST :] = 0.0
        k = int(np.argmax(shares))
        if best is None or shares[k] > best.share:
            rival = float(np.max(rivals[max(k - NEAR, 0) : k + NEAR + 1]))
            beside = float(max(shares[k - BESIDE], shares[k + BESIDE]))
            best = Jump(i, k, float(shares[k]), rival, beside, sizes[k])
    total = max(float(error @ error), 1e-300)
    if best is None:
        return None
    return replace(best, share=best.share / total, rival=best.rival / total, beside=best.beside / total)


def _taken(
    run: Run, scale: np.ndarray, base: np.ndarray, error: np.ndarray, skip: int, n_x: int, moved: Sequence[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the share that the best jump of the state takes away at each sample, its best rival's, and that jump.

    Shapes (M,), (M,) and (M, n_x); `moved` are the states that a shock moves.
    """
    m, n, _ = run.a.shape
    full = n + run.b.shape[2] - run.n_free
    taken, rival, size = np.zeros(m), np.zeros(m), np.zeros((m, n_x))
    unit, shock = np.eye(full), np.eye(full)[:, list(moved)]
    steps = [unit[:, [j]] for j in range(n, full)]
    for now, s, g, e in _backwards(run, scale, base, error, skip):
        left = s - g @ np.swapaxes(g, 1, 2)
        turn = np.zeros_like(s)
        turn[:, :n, :n] = run.a[now] - np.eye(n)
        shocks = [shock + part * turn @ shock for part in BETWEEN]
        taken[now], size[now] = _solved(left, s, e, unit[:, :n_x])
        rival[now] = np.max([_solved(left, s, e, way)[0] for way in (*shocks, *steps)], axis=0)
    return taken, rival, size


def _solved(left: np.ndarray, s: np.ndarray, e: np.ndarray, ways: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the shares that jumps along some ways, (n, k) or (K, n, k), take away, and their lengths."""
    across = np.swapaxes(ways, -1, -2)
    size = np.sqrt(np.maximum(np.einsum("...ii->...i", across @ s @ ways), 0.0))
    size = np.where(size > 0, size, 1.0)
    matrix = across @ left @ ways / (size[:, :, None] * size[:, None, :]) + RIDGE * np.eye(ways.shape[-1])
    wanted = (across @ e[:, :, None])[:, :, 0] / size
    lost = ~(np.isfinite(matrix).all(axis=(1, 2)) & np.isfinite(wanted).all(axis=1))  # where a run grows without end
    matrix[lost], wanted[lost] = np.eye(ways.shape[-1]), 0.0
    found = np.linalg.solve(matrix, wanted[:, :, None])[:, :, 0]
    return np.sum(found * wanted, axis=1), found / size


def _backwards(
    run: Run, scale: np.ndarray, base: np.ndarray, error: np.ndarray, skip: int
) -> Iterator[tuple[slice, np.ndarray, np.ndarray, np.ndarray]]:
    """Yield S, G and s of states and of forces that stay from a sample on, some samples at a time, the last first."""
    m, n_y, n = run.c.shape
    forces = run.b.shape[2] - run.n_free
    full, n_b = n + forces, base.shape[1]
    read = np.zeros((m - skip, n_y, n_b + 1))
    read[:, :, :n_b] = base.reshape(m - skip, n_y, n_b)
    read[:, :, n_b] = error.reshape(m - skip, n_y)
    c = np.concatenate([run.c, run.d[:, :, run.n_free :]], axis=2) / scale[:, None]
    s, g = np.zeros((full, full)), np.zeros((full, n_b + 1))
    a = np.eye(full)
    for stop in range(m, skip, -CHUNK):
        now = slice(max(stop - CHUNK, skip), stop)
        every_s, every_g = np.zeros((stop - now.start, full, full)), np.zeros((stop - now.start, full, n_b + 1))
        for k in range(stop - 1, now.start - 1, -1):
            a[:n, :n], a[:n, n:] = run.a[k], run.b[k, :, run.n_free :]
            s = c[k].T @ c[k] + a.T @ s @ a
            g = c[k].T @ read[k - skip] + a.T @ g
            every_s[k - now.start], every_g[k - now.start] = s, g
        yield now, every_s, every_g[:, :, :n_b], every_g[:, :, n_b]


def _begin(fitted: Fitted, r: Recording, jump: Jump) -> np.ndarray:
    """Compute the simulator's own states after a jump, to first order."""
    model = fitted.model
    states = states_along(model, model.drive(r), fitted.vector, fitted.initial[jump.recording])
    return np.asarray(states[jump.sample * model.substeps, : len(jump.size)] - jump.size)


def _gate(bench: Workbench, places: Sequence[Origin], before: float, after: float) -> Gate:
    """Describe the gaps before some samples."""
    ordered = sorted(places)
    dt, several = bench.dt, len({label for label, _ in ordered}) > 1 or len(bench.recordings) > 1
    at = " and ".join(f"t = {k * dt:.6g} s (sample {k}{f' of {label}' if several else ''})" for label, k in ordered)
    names = ", ".join([*bench.simulator.inputs, *bench.simulator.output_names])
    sentence = (
        f"Samples are missing just before {at}: the state jumps there as no force and no shock could make it, as where "
        "a logger lost some and counted on. With the recording cut there the refitted error falls from "
        f"{before**0.5:.3g} to {after**0.5:.3g} of the outputs' deviation."
    )
    return Gate(names, "gap", [k * dt for _, k in ordered], sentence, True, True, left=after / before)
