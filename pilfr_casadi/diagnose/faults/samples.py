"""Faults visible in the recorded samples themselves: glitches, and stale, held, clipped and unsettled samples.

- Glitches, for example from a lost bit or a loose contact: a sample far off the cubic through its four neighbours,
  relative to the distances nearby. Once the cubic replaces it, its neighbours are inconspicuous; at a step or a shock
  they are not. A sample that follows such a pulse of an input is the answer to it.
- Stale samples: a channel that otherwise never repeats a value sometimes repeats its last one. Interpolation replaces
  them. Other repeats are not stale: a coarse converter, or an encoder that moves by no more than its step, has few
  values; a machine at rest repeats one value for long; a clipped channel repeats its limit.
- Frozen channels: a channel that otherwise hardly repeats a value holds one for long while an input moves, and then
  goes farther in one step than ever elsewhere. This is only noted: what happened is not known.
- Held outputs: an output that changes at every k-th sample alone was measured at that rate and held in between, which
  looks like a delay of (k - 1) / 2 samples. The values between cannot be told, so that this is only noted.
- Clipped channels: exactly repeated extremes. A clipped output can be compared with an equally clipped simulation; the
  part of a clipped input beyond its limit is lost.
- Unsettled periods: the rms differences of neighbouring periods are all equal if only noise differs, and larger at
  first if a transient decays. Then the first sample is not on the steady cycle, and the differences do not measure the
  noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import numpy as np

from ..._base import percent
from ...data import Recording
from ...laws import AsymmetricSaturation
from ...simulators import ACTUATOR, SENSOR, port_name
from ..fits.floor import DISTINCT_SHARE, sensor_step
from ..fits.screen import folds, held_out
from ..fits.workbench import Fitted, Workbench
from .gates import (
    CURED_SHARE,
    EXCEPTION_SHARE,
    Checked,
    FirstOrder,
    Gate,
    accept,
    correct,
    open_start,
    robust_deviation,
)

NEIGHBOURHOOD = 6  # widths on either side of a glitch with which it is compared

CUBIC, STENCIL = np.array([-1, 4, 0, 4, -1]) / 6, 2  # through the neighbours at -2, -1, 1, 2
GLITCH_SIZE = 0.1  # least distance of a glitch over the output's deviation
FEWEST_STEPS = 2.0  # least distance of a glitch over the resolution of a quantised signal, whose rounding leaves 1.4
ISOLATED_SHARE = 0.12  # distance of neighbours, and deviation nearby, over a glitch's distance; a kink leaves 1/6

ROUNDING = 1e-6  # bound on the relative rounding of distances

FEWEST_CHANGES = 20  # of an output, from which chance hardly puts all of them on one raster
ON_RASTER = 0.98  # least share of an output's changes that lie on the raster of a held output

LONGEST_REST = 5  # longest rest of an encoder or a machine, in samples
LARGEST_MOTION = 5  # largest motion of an encoder in a sample, in steps
MOST_LEFT = 0.5  # largest share of the mismatch that the guessed course of an input beyond its limit may leave
ON_STEP = 1e-3  # distance from a step of a coarse sensor, over the step, that rounding makes at most
CHANCE_FACTOR = 3.0  # factor on the number of repeats that noise causes


# glitches


def clean_recordings(recordings: Sequence[Recording]) -> tuple[tuple[Recording, ...], tuple[Gate, ...]]:
    """Remove glitches, and estimate the initial states of recordings that have not settled; note both."""
    recordings, glitches = remove_glitches(recordings)
    recordings, transients = open_unsettled(recordings)
    return recordings, (*glitches, *transients)


def remove_glitches(recordings: Sequence[Recording]) -> tuple[tuple[Recording, ...], list[Gate]]:
    """Replace glitches by interpolation between their neighbours; return the recordings and the findings."""
    gates = list[Gate]()
    mended = tuple(map(mend, recordings))
    for i, name in enumerate(recordings[0].outputs):
        pairs = [(r.y[:, i], clean.y[:, i]) for r, clean in zip(recordings, mended, strict=True)]
        places = [np.flatnonzero(y != clean) for y, clean in pairs]
        count = sum(map(len, places))
        if not count:
            continue
        first = next(r.dt * k[0] for r, k in zip(recordings, places, strict=True) if len(k))
        sentence = (
            f"Single samples of {name} are far off their neighbours, as from glitches: {count}, the first at "
            f"t = {first:.6g} s. Values interpolated between their neighbours replace them."
        )
        before, after = (sum(float(np.sum(distances(y) ** 2)) for y in ys) for ys in zip(*pairs, strict=True))
        gates.append(Gate(name, "glitch", count, sentence, fault=after < CURED_SHARE * before, change=mend))
    return (mended if gates else tuple(recordings)), gates


def mend(r: Recording) -> Recording:
    """Replace each glitch of a recording's outputs by the cubic through its neighbours."""
    return r.with_(y=np.column_stack([find_glitches(column, r.u)[1] for column in r.y.T]))


def find_glitches(y: np.ndarray, u: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Find single samples far off their neighbours, shape (k,); return them and the output without them.

    Samples at a pulse of one of the inputs u (M, n_u), or one sample later, may be the answer to it, and stay.
    """
    clean, found = np.array(y), np.zeros(0, dtype=int)
    inputs = [(v, distances(v)) for v in ([] if u is None else u.T)]
    least = max(GLITCH_SIZE * float(np.std(y)), FEWEST_STEPS * sensor_step(y))
    while len(y) > 4 * NEIGHBOURHOOD * STENCIL and len(found) < EXCEPTION_SHARE * len(y):
        d = distances(clean)
        large = np.flatnonzero(np.abs(d) > least)
        alone = [k for k in large[_may_stand_alone(d, large)] if _stands_alone(clean, d, int(k))]
        more = [k for k in alone if not any(_is_pulse(*v, int(k)) for v in inputs)]
        if not more:
            return np.sort(found), clean
        clean[more] -= d[more]
        found = np.append(found, more)
    return np.zeros(0, dtype=int), np.array(y)


def distances(y: np.ndarray) -> np.ndarray:
    """Compute the distance of each sample from the cubic through its four neighbours; none at the ends."""
    d = np.zeros(len(y))
    d[STENCIL:-STENCIL] = y[STENCIL:-STENCIL] - np.convolve(y, CUBIC, mode="valid")
    return d


def _may_stand_alone(d: np.ndarray, large: np.ndarray) -> np.ndarray:
    """Mark the samples whose replacement may make both neighbours inconspicuous; a fast test by distances."""
    possible = np.ones(len(large), dtype=bool)
    for step in (-1, 1):
        beside = large + step
        inside = (beside >= STENCIL) & (beside < len(d) - STENCIL)  # the ends have no distance
        after = d[beside] + CUBIC[STENCIL + step] * d[large]
        possible &= ~inside | (np.abs(after) < (1 + ROUNDING) * ISOLATED_SHARE * np.abs(d[large]))
    return possible


def _stands_alone(y: np.ndarray, d: np.ndarray, k: int) -> bool:
    """Tell whether a sample stands out, and its neighbours do not once it is replaced."""
    around = np.arange(
        max(k - NEIGHBOURHOOD * STENCIL, STENCIL), min(k + NEIGHBOURHOOD * STENCIL + 1, len(y) - STENCIL)
    )
    if robust_deviation(d[around[np.abs(around - k) > STENCIL]]) >= ISOLATED_SHARE * abs(d[k]):
        return False
    whole = slice(max(k - 2 * STENCIL, 0), min(k + 2 * STENCIL + 1, len(y)))
    other = np.array(y[whole])
    other[k - whole.start] -= d[k]
    return bool(np.max(np.abs(distances(other))) < ISOLATED_SHARE * abs(d[k]))


def _is_pulse(v: np.ndarray, d: np.ndarray, k: int) -> bool:
    """Tell whether an input has a pulse of one sample at sample k, or just before it."""
    inner = range(max(k - 1, STENCIL), min(k + 1, len(v) - STENCIL))
    return any(d[i] and _stands_alone(v, d, i) for i in inner)


# stale samples


@dataclass(frozen=True)
class Stale(Gate):
    """A channel that repeats samples: interpolation between the others replaces them."""

    remedy: ClassVar[str] = "with these samples interpolated"


def mend_stale_samples(now: Checked) -> Checked:
    """Interpolate stale samples if the rule accepts it; else note stale outputs. Held outputs repeat for a reason."""
    first, held = now.bench.recordings[0], {g.channel for g in now.gates if g.finding == "held"}
    for side, names in (("u", first.inputs), ("y", first.outputs)):
        for i, name in enumerate(names):
            repeated = share_of_repeats([getattr(r, side)[r.skip :, i] for r in now.bench.recordings])
            if not repeated or name in held:
                continue
            words = f"{percent(repeated)} of the samples of {name} repeat the one before, as from lost or stale samples"
            fault = Stale(name, "stale", repeated, words, change=partial(_interpolate_repeats, side=side, column=i))
            found = accept(now, correct(now, fault, [{}, now.fitted.values], now.fitted.begin), fault)
            if not found.adds_to(now) and side == "y":
                words = (
                    f"{words}, or from a coarse sensor while the machine is slow; the error that this causes counts as "
                    "noise. If samples were lost, leave them out (empty cells), or record again."
                )
                found = found.then(found.bench, found.fitted, Gate(name, "stale", repeated, words, False))
            now = found
    return now


def _interpolate_repeats(r: Recording, side: str, column: int) -> Recording:
    """Replace repeated samples of a channel by a cubic spline through the others."""
    from scipy.interpolate import CubicSpline

    v, k = np.array(getattr(r, side)), np.arange(len(r))
    fresh = ~_find_repeats(v[:, column], _smallest_step(v[:, column]))
    v[~fresh, column] = CubicSpline(k[fresh], v[fresh, column])(k[~fresh])
    return r.with_(**{side: v})


def share_of_repeats(columns: Sequence[np.ndarray]) -> float:
    """Compute the share of the samples of a channel that repeat the one before; zero if chance or rest explains it.

    In a resampled record of a coarse sensor, repeats lie on its steps, and most other samples between them.
    """
    together = np.concatenate(columns)
    step = _smallest_step(together)
    same = np.concatenate([_find_repeats(v, step) for v in columns])
    repeated = float(np.mean(same))
    coarse = _smallest_step(together[same])
    if np.isfinite(coarse):
        steps = (together - together[same][0]) / coarse
        on_steps = np.abs(steps - np.round(steps)) < ON_STEP
        if np.all(on_steps[same]) and np.mean(on_steps[~same]) < DISTINCT_SHARE:
            return 0.0
    by_chance = float(np.mean(np.abs(np.concatenate(list(map(np.diff, columns))) - step) < 0.5 * step))
    return repeated if _is_fine(together) and repeated > max(EXCEPTION_SHARE, CHANCE_FACTOR * by_chance) else 0.0


def _smallest_step(v: np.ndarray) -> float:
    """Return the smallest distance between two values of a signal."""
    return float(np.min(np.diff(np.unique(v)), initial=np.inf))


def find_stretches(mask: np.ndarray) -> np.ndarray:
    """Find begin and end of each stretch in which a mask (M,) is true, shape (n, 2)."""
    return np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]]))).reshape(-1, 2)


def _find_repeats(y: np.ndarray, step: float) -> np.ndarray:
    """Mark samples that repeat the one before, away from the limits, in short runs followed by a jump."""
    same = np.append(False, y[1:] == y[:-1]) & (y > np.min(y)) & (y < np.max(y))
    for begin, end in find_stretches(same):
        if end - begin > LONGEST_REST or abs(y[min(end, len(y) - 1)] - y[begin]) < LARGEST_MOTION * step:
            same[begin:end] = False
    return same


# frozen channels


def find_frozen_channels(recordings: Sequence[Recording]) -> list[Gate]:
    """Note each channel that holds a value for long, as of a logger or a sensor that stood still."""
    found, first = list[Gate](), recordings[0]
    for side, names in (("u", first.inputs), ("y", first.outputs)):
        for i, name in enumerate(names):
            columns = [getattr(r, side)[:, i] for r in recordings]
            others = [np.delete(r.u, i, axis=1) if side == "u" else r.u for r in recordings]
            stretches = [_find_frozen(v, u) for v, u in zip(columns, others, strict=True)]
            if not any(map(len, stretches)) or not _is_fine(np.concatenate(columns)):
                continue
            k = next(k for k, there in enumerate(stretches) if len(there))
            begin, end = stretches[k][0]
            jump = columns[k][end] - columns[k][begin]
            where = f" of recording {k + 1}" if len(recordings) > 1 else ""
            unless = "it was held there" if side == "u" else "the machine stuck there"
            remedy = "cut the recording" + ", or empty the repeated cells" * (side == "u")
            sentence = (
                f"{name} repeats one value from t = {first.dt * begin:.6g} s to {first.dt * (end - 1):.6g} s{where}, "
                f"and then jumps by {jump:.3g}, farther than in any other step, as if sensor or logger stood still. "
                f"Unless {unless}, {remedy}."
            )
            found.append(Gate(name, "frozen", int(sum(np.sum(np.diff(s)) for s in stretches)), sentence, False))
    return found


def _is_fine(values: np.ndarray) -> bool:
    """Tell whether most samples of a channel have a value of their own."""
    return len(np.unique(values)) > DISTINCT_SHARE * len(values)


def _find_frozen(v: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Find begin and end (behind it) of the long stretches of one value of a channel that end by its largest step.

    A stretch counts if one of the inputs u (M, n_u) moves in it, and if it is not at the beginning or at a limit.
    """
    steps, moving = np.abs(np.diff(v)), np.any(np.diff(u, axis=0) != 0, axis=1)
    stretches = [(b, e) for b, e in find_stretches(steps == 0) if e - b > LONGEST_REST and b > 0 and e < len(steps)]
    largest = np.max(np.delete(steps, [e for _, e in stretches]), initial=0.0)  # except those that lead out of them
    inside = (v > np.min(v, initial=np.inf)) & (v < np.max(v, initial=-np.inf))
    frozen = [(b, e + 1) for b, e in stretches if steps[e] > largest and np.any(moving[b:e]) and inside[b]]
    return np.array(frozen, dtype=int).reshape(-1, 2)


# held outputs


def find_held_outputs(recordings: Sequence[Recording]) -> list[Gate]:
    """Note each output that was measured at a slower rate than it was recorded."""
    found, dt = list[Gate](), recordings[0].dt
    for i, name in enumerate(recordings[0].outputs):
        k = min(_samples_between_changes(r.y[:, i], r.u) for r in recordings)
        if k > 1:
            sentence = (
                f"{name} changes only once in {k} samples, as if it were measured every {k * dt:.3g} s and held in "
                f"between, which looks like a delay of about {(k - 1) / 2 * dt:.3g} s. Leave its repeated values out "
                f"(empty cells), and read the file with resample={dt:.6g}."
            )
            found.append(Gate(name, "held", k, sentence, corrected=False))
    return found


def _samples_between_changes(y: np.ndarray, u: np.ndarray) -> int:
    """Return the largest number of samples on whose raster an output changes; 1 if there is none.

    So does an encoder at constant speed, but by a few of its steps; and a static machine without noise, but with
    inputs that are held on the same raster.
    """
    motions, driven = np.abs(np.diff(y)), np.flatnonzero(np.any(np.diff(u, axis=0) != 0, axis=1))
    changes = np.flatnonzero(motions)
    if len(changes) < FEWEST_CHANGES or np.median(motions[changes]) < LARGEST_MOTION * _smallest_step(y):
        return 1
    usual = int(np.argmax(np.bincount(np.diff(changes))))
    k = next((k for k in range(usual, 1, -1) if usual % k == 0 and _on_raster(changes, k)), 1)
    with_inputs = max(np.mean(np.isin(changes - late, driven)) for late in (0, 1)) >= ON_RASTER
    return 1 if with_inputs and _on_raster(driven, k) else k


def _on_raster(places: np.ndarray, k: int) -> bool:
    return bool(np.max(np.bincount(places % k), initial=0) >= ON_RASTER * len(places))


# clipped channels


@dataclass(frozen=True)
class Clipping(Gate):
    """A channel that repeats its extremes exactly: its column, and the limits (infinite where there is none)."""

    column: int = 0
    low: float = -np.inf
    high: float = np.inf
    most_left: ClassVar[float] = 1.0  # the repeated extremes show the fault, whatever else is wrong
    remedy: ClassVar[str] = "with the simulator's output clipped alike"

    def apply(self, bench: Workbench) -> Workbench:
        """Return the bench with the simulator's output clipped like the recorded one, so that the rest still counts."""
        law = AsymmetricSaturation().at({"low": max(self.low, -1e300), "high": min(self.high, 1e300)})
        placed = bench.simulator.with_element(port_name(SENSOR, self.channel), law)
        prefix = placed.elements[-1].prefix
        fixed = {k: replace(p, fixed=True) if k.startswith(prefix) else p for k, p in placed.parameters.items()}
        return replace(bench, simulator=placed.with_parameters(fixed))


def unclip(now: Checked) -> Checked:
    """Clip the simulator's outputs like the recorded ones."""
    for fault in find_clipping(now.bench.recordings, "y"):
        now = accept(now, correct(now, fault, [{}, now.fitted.values], now.fitted.begin), fault)
    return now


def find_clipped_input(bench: Workbench, without: Fitted, remains: float) -> Gate | None:
    """Find a clipped input that explains most of the mismatch, unless a law leaves a smaller share (`remains`).

    The true input beyond the limit is not recorded; a smooth continuation replaces it (`_beyond_limit`).
    """
    for fault in find_clipping(bench.recordings, "u"):
        explained = _explained_beyond(bench, without, fault)
        if 1 - explained < min(MOST_LEFT, remains):
            sentence = (
                f"{fault.sentence}, and its likely course beyond the limit explains {percent(explained)} of the "
                "mismatch: the recording does not contain the true input there. Record it with a larger range."
            )
            return replace(fault, sentence=sentence, corrected=False, fault=True)
    return None


def _explained_beyond(bench: Workbench, without: Fitted, fault: Clipping) -> float:
    """Compute the held-out share of the error that an input's continuation beyond its limits explains."""
    first = FirstOrder.of(bench, without)
    signs = [(v, 1.0 if v == fault.high else -1.0) for v in fault.value]
    inputs = [r.u[:, fault.column] for r in bench.recordings]
    beyond = [np.column_stack([sign * _beyond_limit(u, v) for v, sign in signs]) for u in inputs]
    left = first.project_off(first.error)
    columns = first.project_off(first.response([port_name(ACTUATOR, fault.channel)], beyond))
    # a positive coefficient would put the input inside its limit
    if np.any(np.linalg.lstsq(columns, left, rcond=1e-8)[0] > 0):
        return 0.0
    whole = [slice(r.skip, len(r)) for r in bench.recordings]
    return held_out(columns, left, folds(bench.recordings, whole))


def _beyond_limit(u: np.ndarray, limit: float) -> np.ndarray:
    """Estimate the part of a signal beyond a limit: the cubic with the slopes of the signal before and after."""
    out, rise = np.zeros(len(u)), np.abs(np.diff(u, prepend=u[0], append=u[-1]))
    for begin, end in find_stretches(u == limit):  # the step to the limit is cut short, and perhaps the step before it
        leaves, back = np.max(rise[max(begin - 1, 0) : begin + 1]), np.max(rise[end : end + 2])
        t = (np.arange(end - begin) + 0.5) / (end - begin)
        out[begin:end] = (end - begin) * t * (1 - t) * (leaves * (1 - t) + back * t)
    return out


def find_clipping(recordings: Sequence[Recording], kind: str) -> list[Clipping]:
    """Find inputs (`kind` "u") or outputs ("y") that repeat their extremes exactly over several samples."""
    out = []
    for i, name in enumerate(recordings[0].inputs if kind == "u" else recordings[0].outputs):
        y = np.concatenate([getattr(r, kind)[:, i] for r in recordings])
        if np.mean(np.diff(y) == 0) >= DISTINCT_SHARE:
            continue
        limits, count = [-np.inf, np.inf], 0
        for j, extreme in enumerate((y.min(), y.max())):
            at = y == extreme
            runs = np.diff(find_stretches(at)).ravel()
            if runs.max() >= 3 and np.sum(runs > 1) > 1 and at.mean() > CHANCE_FACTOR * _share_at_level(y):
                limits[j], count = float(extreme), count + int(at.sum())
        if count:
            finite = [v for v in limits if np.isfinite(v)]
            at_limits = " and ".join(f"{v:.6g}" for v in finite)
            words = f"{name} is clipped at {at_limits} ({count} samples at the limit)"
            out.append(Clipping(name, "clipping", finite, words, column=i, low=limits[0], high=limits[1]))
    return out


def _share_at_level(y: np.ndarray) -> float:
    """Compute the share of samples at a level of a quantised signal near its extremes; 0 for a continuous one."""
    if _is_fine(y):
        return 0.0
    counts = np.unique(y, return_counts=True)[1]
    return float(np.median(np.concatenate([counts[1:6], counts[-6:-1]])) / len(y))


# unsettled periods


def open_unsettled(recordings: Sequence[Recording]) -> tuple[tuple[Recording, ...], list[Gate]]:
    """Estimate the initial states of recordings that settle only within the record, and note this."""
    pairs = ((r, zip(r.outputs, _settled_shares(r), strict=True)) for r in recordings)
    share, name, r = min(((float(s), name, r) for r, shares in pairs for name, s in shares), key=lambda f: f[0])
    if share > CURED_SHARE:
        return tuple(recordings), []
    ratio = share**-0.5
    sentence = (
        f"{name} has not settled{f' in {r.name}' if r.name else ''}: its first two periods differ {ratio:.2g} times as "
        "much as later ones; initial states are estimated, and the periods do not tell the noise."
    )
    return tuple(map(open_start, recordings)), [Gate(name, "transient", ratio, sentence, change=open_start)]


def _settled_shares(r: Recording) -> np.ndarray:
    """Divide the least mean square difference of neighbouring periods by the first two's, by output; 1 if unknown."""
    count = (len(r) - r.skip) // r.period if r.period and r.begins == "periodic" else 0
    if count < 3 or not r.period:
        return np.ones(r.n_y)
    periods = r.y[r.skip :][: count * r.period].reshape(count, r.period, r.n_y)
    steps = np.mean(np.diff(periods, axis=0) ** 2, axis=1)
    rounding = (1e-9 * np.std(r.y, axis=0)) ** 2 + 1e-300
    return np.asarray(np.maximum(steps.min(axis=0), rounding) / np.maximum(steps[0], rounding))
