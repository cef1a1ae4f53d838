"""Lost samples, in all channels (then every state jumps) or in some outputs (these are too early from then on).

If all channels have lost samples and the time was renumbered, all states jump together. Along the refitted run, a jump
δ of the state at sample k changes the later outputs by `Φ_k δ`. With e the error that parameters and initial states
leave, and base the directions that these can follow, the best jump removes

    s' (S - G G')⁻¹ s,    S = Φ_k'Φ_k,  G = Φ_k' base,  s = Φ_k' e

of e'e. S, G and s follow by recursion from the next sample's, so that every sample is tried. A shock or a stop
moves no state that is the integral of another, and a step of a force or of a sensor moves none. No gap is reported if
one of these explains about as much, or if no state is such an integral. A refit to the two pieces confirms a jump.

If only some outputs have lost samples, as in one of two loggers, their later samples are early relative to the others.
Every sample is tried with every number of lost samples: before it the outputs count as recorded, after it moved.
Cumulative sums of the error that parameters and initial states leave make this fast. It is no gap if to leave out as
many samples, with nothing moved, explains as much: a shock may have fallen into them. It is none either if a constant
or a gain of the whole recording does (`find_rivals`), as where the outputs only rise or fall.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ...data import Recording
from ..fits.floor import ABOVE_NOISE, third_differences
from ..fits.linearise import Run, simulate_states
from ..fits.workbench import THOROUGH, Fitted, Workbench
from .gates import (
    CLEARLY_BETTER,
    CURED_SHARE,
    EQUAL_RATIO,
    NEAR_NOISE_RATIO,
    Checked,
    FirstOrder,
    Gate,
    accept,
    correct,
    robust_deviation,
    settle,
)
from .offsets import find_rivals
from .timing import LARGEST_SHIFT

MOST_GAPS = 3  # gaps that are sought at most
SHORTEST_PIECE = 40  # samples of a piece at least
RIVAL_DISTANCE = 5  # samples around a jump at which rivals are tried, and at which a drift would explain as much
SHOCK_DELAYS = (-0.5, 0.0, 0.5)  # delays of a shock that are tried, in samples
BLOCK = 500  # samples whose matrices are held at a time
RIDGE = 1e-6  # on the normal equations, against jumps that initial states can follow


@dataclass(frozen=True, eq=False)
class _Gap(Gate):
    """A gap at which a recording is cut in two.

    Until it is reported, its value is the recording's number and the arguments of `cut`.
    """

    states: Sequence[np.ndarray] = ()  # initial states of the recordings when this one is cut

    def begin(self, previous: Fitted) -> Sequence[np.ndarray]:
        """Return the initial states of the recordings in pieces."""
        return self.states

    def cut(self, r: Recording, *place: int) -> tuple[Recording, Recording]:
        """Cut a recording in two; the state at the later piece is estimated.

        The earlier piece ends at the first place, the later one begins at the last.
        """
        return r.slice(0, place[0]), r.slice(place[-1]).with_(initial="estimate", period=None)

    def apply(self, bench: Workbench) -> Workbench:
        """Return the bench with the two pieces in place of the recording."""
        i, *place = self.value
        pieces = self.cut(bench.recordings[i], *place)
        return replace(bench, recordings=(*bench.recordings[:i], *pieces, *bench.recordings[i + 1 :]))

    def run_whole(self, bench: Workbench, fitted: Fitted) -> Fitted:
        """Run the whole recording at the values of a fit to its two pieces."""
        initial = [x for i, x in enumerate(fitted.initial) if i != self.value[0] + 1]
        return bench.rerun(fitted, initial=initial)


@dataclass(frozen=True, eq=False)
class Jump(_Gap):
    """A jump of the state, as where samples were lost; until it is reported, its value is (recording, sample)."""

    share: float = 0.0  # share of the mean square that the jump removes
    rival: float = 0.0  # share that a shock nearby, or a step of one force or sensor there, removes
    neighbour: float = 0.0  # share that a jump some samples away removes
    # once reported: each recording that is cut, and the sample at which its later piece begins
    places: tuple[tuple[int, int], ...] = ()
    remedy: ClassVar[str] = "with the recording cut there"

    def beats(self, other: float, share: float) -> bool:
        """Tell whether this jump leaves at most a share of the error that a rival leaves, which removes `other`."""
        return 1 - self.share < share * (1 - other)

    def relocate(self, now: Checked, after: Checked) -> Jump | None:
        """Find the jump along the run of the whole recording."""
        return find_jump(now.bench, self.run_whole(now.bench, after.fitted))

    def apply_to_whole(self, whole: list[Recording], places: Sequence[tuple[int, int]]) -> list[Recording]:
        """Cut the recordings where samples are missing in a stretch."""
        out = list(whole)
        for i, k in sorted(((places[i][0], places[i][1] + k) for i, k in self.places), reverse=True):
            earlier, later = self.cut(out[i], k)
            out[i : i + 1] = [earlier, later.with_(name=_name_from(out[i], k))]
        return out


def settle_jump(now: Checked) -> tuple[Jump, Checked] | None:
    """Find a jump, and fit the two pieces; the jump is repeated until it stays."""
    jump = find_jump(now.bench, now.fitted)
    return None if jump is None else settle(now, jump, THOROUGH)


def find_gaps(now: Checked) -> Checked:
    """Find lost samples of all channels; cut the recordings there if the rule accepts it.

    Recordings in periodic steady state are not checked.
    """
    noise2 = min(now.noise2, _quiet_noise2(now) or np.inf)
    origins = [(r, 0) for r in now.bench.recordings]  # recording as given, and the sample at which a piece begins
    last, found = now, now
    while len(origins) - len(now.bench.recordings) < MOST_GAPS and last.cost > ABOVE_NOISE**2 * noise2:
        settled = settle_jump(last)
        if settled is None or not settled[0].beats(settled[0].rival, 1 / EQUAL_RATIO**2):
            break
        jump, last = settled
        i, k = jump.value
        r, begin = origins[i]
        origins.insert(i + 1, (r, begin + k))
        # jumps around a drift also imitate it
        sharp = jump.beats(jump.neighbour, CLEARLY_BETTER) or last.cost < NEAR_NOISE_RATIO**2 * noise2
        if sharp and jump.beats(jump.rival, CURED_SHARE):
            accepted = accept(now, _name_pieces(last, origins), _describe_gaps(jump, origins))
            found = accepted if accepted.adds_to(now) else found
    return found


def _name_from(r: Recording, k: int) -> str:
    """Name the piece of a recording that begins at sample k, by its time."""
    return f"{r.name} from {k * r.dt:.6g} s".strip()


def _name_pieces(now: Checked, origins: Sequence[tuple[Recording, int]]) -> Checked:
    named = [
        piece.with_(name=_name_from(r, k)) if k else piece
        for piece, (r, k) in zip(now.bench.recordings, origins, strict=True)
    ]
    return now.then(replace(now.bench, recordings=tuple(named)), now.fitted)


def _describe_gaps(jump: Jump, origins: Sequence[tuple[Recording, int]]) -> Gate:
    gaps = sorted([(r.label, k, k * r.dt) for r, k in origins if k])
    several = len({id(r) for r, _ in origins}) > 1
    at = " and ".join(f"t = {t:.6g} s (sample {k}{f' of {label}' if several else ''})" for label, k, t in gaps)
    words = (
        f"Samples are missing just before {at}: the state jumps there as no force and no shock could make it, as where "
        "a logger lost some and counted on"
    )
    given = list(dict.fromkeys(id(r) for r, _ in origins))  # the recordings in their order
    places = tuple((given.index(id(r)), k) for r, k in origins if k)
    return replace(jump, value=[t for _, _, t in gaps], sentence=words, places=places)


def _quiet_noise2(now: Checked) -> float:
    """Estimate the mean square of white noise from third differences, not disturbed by a few jumps."""
    thirds = np.concatenate([third_differences(e) for e in now.fitted.residual])
    return now.bench.pool((robust_deviation(thirds) / now.bench.scale) ** 2)


@np.errstate(over="ignore", invalid="ignore")
def find_jump(bench: Workbench, fitted: Fitted) -> Jump | None:
    """Find the jump of the states that removes most error, to first order; None if gaps cannot be detected."""
    simulator = bench.simulator
    if not simulator.kinematic:
        return None
    first = FirstOrder.of(bench, fitted)
    error = first.project_off(first.error)
    total = max(float(error @ error), 1e-300)
    moved = [i for i, name in enumerate(simulator.states) if name not in simulator.kinematic]
    best, best_size = Jump(", ".join([*simulator.inputs, *simulator.output_names]), "gap", None), np.zeros(0)
    for i, r, rows in _long_recordings(bench, 2 * SHORTEST_PIECE):
        read = np.column_stack([first.base, error])[rows].reshape(-1, r.n_y, first.base.shape[1] + 1)
        run, scale = first.runs[i], first.bench.scale
        shares, rivals, sizes = _jump_shares(run, scale, read, r.skip, len(simulator.states), moved)
        shares, rivals = shares / total, rivals / total
        shares[: r.skip + SHORTEST_PIECE] = shares[len(r) - SHORTEST_PIECE :] = 0.0
        k = int(np.argmax(shares))
        if shares[k] > best.share:
            around = slice(max(k - RIVAL_DISTANCE, 0), k + RIVAL_DISTANCE + 1)
            rival = float(np.max(rivals[around]))
            neighbour = float(max(shares[around.start], shares[k + RIVAL_DISTANCE]))
            best = replace(best, value=(i, k), share=float(shares[k]), rival=rival, neighbour=neighbour)
            best_size = sizes[k]
    if best.share < 1 - CLEARLY_BETTER:
        return None
    i, k = best.value
    state = simulate_states(fitted, bench.recordings[i], fitted.initial[i])[k, : len(best_size)] - best_size
    return replace(best, states=[*fitted.begin[: i + 1], np.asarray(state), *fitted.begin[i + 1 :]])


def _long_recordings(bench: Workbench, shortest: int) -> Iterator[tuple[int, Recording, slice]]:
    """Generate the recordings of `shortest` scored samples or more, not in steady state, and their rows of an error."""
    end = 0
    for i, r in enumerate(bench.recordings):
        begin, end = end, end + (len(r) - r.skip) * r.n_y
        if r.begins != "periodic" and len(r) - r.skip >= shortest:
            yield i, r, slice(begin, end)


def _jump_shares(
    run: Run, scale: np.ndarray, read: np.ndarray, skip: int, n_x: int, moved: Sequence[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute, at each sample, the share that the best jump of the state removes, the best rival's share, and the jump.

    `read` are the base and the error from `skip` on, `moved` the states that a shock moves. Shapes of the results are
    (M,), (M,) and (M, n_x). Forces that stay constant from a sample on are further states.
    """
    m, _, n = run.c.shape
    full, n_b = n + run.b.shape[2] - run.n_free, read.shape[2] - 1
    unit, s, g = np.eye(full), np.zeros((full, full)), np.zeros((full, n_b + 1))
    shock = unit[:, list(moved)]
    removed, rivals, sizes = np.zeros(m), np.zeros(m), np.zeros((m, n_x))
    for stop in range(m, skip, -BLOCK):  # from the last block on, because the matrices of all samples would be large
        now = slice(max(stop - BLOCK, skip), stop)
        forces, feedthrough = run.b[now, :, run.n_free :], run.d[now, :, run.n_free :]
        a = np.tile(unit, (len(forces), 1, 1))
        a[:, :n, :n], a[:, :n, n:] = run.a[now], forces
        c = np.concatenate([run.c[now], feedthrough], axis=2) / scale[:, None]
        size2, left, along = np.empty_like(a), np.empty_like(a), np.empty(a.shape[:2])
        for k in reversed(range(len(a))):
            s = c[k].T @ c[k] + a[k].T @ s @ a[k]
            g = c[k].T @ read[now.start - skip + k] + a[k].T @ g
            size2[k], left[k], along[k] = s, s - g[:, :n_b] @ g[:, :n_b].T, g[:, n_b]
        removed[now], sizes[now] = _solve_jumps(left, size2, along, unit[:, :n_x])
        later = a - unit
        later[:, :, n:] = 0.0
        tried = [shock + part * later @ shock for part in SHOCK_DELAYS] + [unit[:, [j]] for j in range(n, full)]
        rivals[now] = np.max([_solve_jumps(left, size2, along, rival)[0] for rival in tried], axis=0)
    return removed, rivals, sizes


def _solve_jumps(
    left: np.ndarray, s: np.ndarray, e: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the squares that jumps in given directions, (n, k) or (M, n, k), remove, and the jumps' lengths."""
    across = np.swapaxes(directions, -1, -2)
    size = np.sqrt(np.maximum(np.einsum("...ii->...i", across @ s @ directions), 0.0))
    size = np.where(size > 0, size, 1.0)
    matrix = across @ left @ directions / (size[:, :, None] * size[:, None, :]) + RIDGE * np.eye(directions.shape[-1])
    wanted = (across @ e[:, :, None])[:, :, 0] / size
    lost = ~(np.isfinite(matrix).all(axis=(1, 2)) & np.isfinite(wanted).all(axis=1))  # the run diverges
    matrix[lost], wanted[lost] = np.eye(directions.shape[-1]), 0.0
    found = np.linalg.solve(matrix, wanted[:, :, None])[:, :, 0]
    return np.sum(found * wanted, axis=1), found / size


@dataclass(frozen=True, eq=False)
class _Pause(_Gap):
    """Samples that are left out, the rival of lost samples: a shock in them; its value is (recording, begin, end)."""


@dataclass(frozen=True, eq=False)
class OutputGap(_Gap):
    """Lost samples of some outputs; until it is reported, its value is (recording, sample, number of lost samples).

    A negative number says that all other channels have lost samples, so that these outputs come too late.
    """

    columns: tuple[int, ...] = (0,)
    share: float = 1.0  # share of the mean square that is left
    parameters: ClassVar[int] = 2
    remedy: ClassVar[str] = "with the recording cut there and the later outputs moved back"

    def cut(self, r: Recording, *place: int) -> tuple[Recording, Recording]:
        """Cut a recording at a sample, and move the later outputs by the number of lost samples."""
        k, lost = place
        y, begin, end = np.array(r.y), k + max(lost, 0), len(r) + min(lost, 0)
        y[begin:end, self.columns] = r.y[begin - lost : end - lost, self.columns]
        later = r.with_(y=y).slice(begin, end)
        return r.slice(0, k), later.with_(initial="estimate", period=None, name=_name_from(r, begin))

    def apply_to_whole(self, whole: list[Recording], places: Sequence[tuple[int, int]]) -> list[Recording]:
        """Cut and correct the recording that a checked stretch comes from."""
        i, k, lost = self.value
        j, begin = places[i]
        return [*whole[:j], *self.cut(whole[j], begin + k, lost), *whole[j + 1 :]]

    def to_dict(self) -> dict[str, object]:
        """Return the finding as in diagnosis.json."""
        i, k, lost = self.value
        return {**super().to_dict(), "value": {"recording": i, "sample": k, "lost": lost}}

    def relocate(self, now: Checked, after: Checked) -> OutputGap | None:
        """Find the gap along the run of the whole recording."""
        return find_output_gap(now.bench, self.run_whole(now.bench, after.fitted))


def find_output_gaps(now: Checked) -> Checked:
    """Find samples that some outputs have lost; cut the recording there if the rule accepts it and only noise is left.

    If more is wrong, a slow clock or a delay that varies may look like a gap.
    """
    if any(g.finding == "gap" for g in now.gates) or now.cost < ABOVE_NOISE**2 * now.noise2:
        return now
    found = find_output_gap(now.bench, now.fitted)
    settled = None if found is None else settle(now, found, THOROUGH)
    if settled is None:
        return now
    gap, after = _refine_place(now, *settled)
    if after.cost > NEAR_NOISE_RATIO**2 * now.noise2:
        return now
    i, k, lost = gap.value
    pause = _Pause(gap.channel, "pause", (i, k, k + abs(lost)))
    without = correct(now, pause, [after.fitted.values], after.fitted.begin)
    if without is not None and CLEARLY_BETTER * without.cost < after.cost:  # nothing has to be moved
        return now
    if find_rivals(now, after, after.cost):
        return now
    r = now.bench.recordings[i]
    verb = "are" if len(gap.columns) > 1 else "is"
    off = f"{abs(lost)} samples ({abs(lost) * r.dt:.3g} s) too {'early' if lost > 0 else 'late'}"
    whose = "a logger of its own" if lost > 0 else "the logger of the other channels"
    words = (
        f"From t = {k * r.dt:.6g} s (sample {k} of {r.label}) on, {gap.channel} {verb} recorded {off}, as where "
        f"{whose} lost samples and counted on"
    )
    return accept(now, after, replace(gap, sentence=words))


def _refine_place(now: Checked, gap: OutputGap, after: Checked) -> tuple[OutputGap, Checked]:
    """Move a gap in ever smaller steps to the best refit, because lost inputs also leave a wrong state before it."""
    step = LARGEST_SHIFT if after.cost > NEAR_NOISE_RATIO**2 * now.noise2 else 0
    while step:
        i, k, lost = gap.value
        last = len(now.bench.recordings[i]) - LARGEST_SHIFT - SHORTEST_PIECE
        for other in (k - step, k + step):
            moved = replace(gap, value=(i, other, lost))
            if SHORTEST_PIECE <= other <= last:
                found = correct(now, moved, [after.fitted.values], after.fitted.begin)
                if found is not None and found.cost < after.cost:
                    gap, after = moved, found
        step //= 2
    return gap, after


@np.errstate(over="ignore", invalid="ignore")
def find_output_gap(bench: Workbench, fitted: Fitted) -> OutputGap | None:
    """Find the gap of some outputs with the least error, to first order; None if a shift is about as good."""
    first, names = FirstOrder.of(bench, fitted), bench.simulator.output_names
    groups = [(i,) for i in range(len(names))] + ([tuple(range(len(names)))] if len(names) > 1 else [])
    whole = float(np.mean(first.project_off(first.error) ** 2))
    best: OutputGap | None = None
    for i, r, rows in _long_recordings(bench, 2 * SHORTEST_PIECE + LARGEST_SHIFT):
        sums = _Sums.of(first, rows, r.y[r.skip :] / first.bench.scale)
        for columns in groups:
            for lost, left in sums.left(columns):
                k = SHORTEST_PIECE + int(np.argmin(left[SHORTEST_PIECE:]))
                rival = min(whole, left[0])  # none, or the whole recording shifted
                if left[k] < CLEARLY_BETTER * rival and (best is None or left[k] < best.share * whole):
                    channel = ", ".join(names[c] for c in columns)
                    value = (i, r.skip + k, lost)
                    best = OutputGap(channel, "gap", value, columns=columns, share=left[k] / whole)
    if best is None:
        return None
    i, k, lost = best.value
    state = simulate_states(fitted, bench.recordings[i], fitted.initial[i])[k + max(lost, 0)]
    return replace(best, states=[*fitted.initial[: i + 1], state, *fitted.initial[i + 1 :]])


@dataclass(frozen=True, eq=False)
class _Sums:
    """A recording's part of the error, and the contributions of the other recordings to its sums.

    error, y (M, n_y) in units of the outputs' deviation; base (M, n_y, n); square and along (n,) of the others.
    """

    error: np.ndarray
    y: np.ndarray
    base: np.ndarray
    square: float
    along: np.ndarray
    count: int

    @classmethod
    def of(cls, first: FirstOrder, rows: slice, y: np.ndarray) -> _Sums:
        """Take the rows of one recording apart from the others."""
        rest = np.delete(first.error, rows)
        along = np.delete(first.base, rows, axis=0).T @ rest
        base = first.base[rows].reshape(*y.shape, -1)
        return cls(first.error[rows].reshape(y.shape), y, base, float(rest @ rest), along, len(rest))

    def left(self, columns: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
        """Generate each number of lost samples with the mean square that is left for a gap at each sample."""
        m = len(self.y)
        before, along_before = self._sums(self.error)
        for lost in (n for n in range(-LARGEST_SHIFT, LARGEST_SHIFT + 1) if n):
            begin, end = max(lost, 0), m + min(lost, 0)
            moved = np.array(self.error[begin:end])
            moved[:, columns] += self.y[begin:end, columns] - self.y[begin - lost : end - lost, columns]
            after, along_after = self._sums(moved, begin)
            n = len(moved) - SHORTEST_PIECE  # gaps at the first n samples
            square = self.square + before[:n] + after[-1] - after[:n]
            along = self.along + along_before[:n] + along_after[-1] - along_after[:n]
            used = self.count + self.y.shape[1] * (m - abs(lost))
            yield lost, (square - np.sum(along**2, axis=1)) / used

    def _sums(self, error: np.ndarray, begin: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Sum squares, and products with the base, up to each sample."""
        base = self.base[begin : begin + len(error)]
        square = np.append(0.0, np.cumsum(np.sum(error**2, axis=1)))
        along = np.cumsum(np.einsum("tyn,ty->tn", base, error), axis=0)
        return square, np.vstack([np.zeros((1, along.shape[1])), along])
