"""Faults of single channels that the recordings themselves show: glitches, stale, clipped and unsettled samples.

- Glitches, as from a lost bit or a loose contact: a sample far off the cubic through its four neighbours, compared with
  the distances nearby. With it replaced by that cubic nothing around it stands out; around a step or a shock it does.
- Stale samples: a channel repeats its last value now and then, where it otherwise never does. A coarse converter
  repeats values too, but has few of them, and so does an encoder that moves by no more than its step; a machine at rest
  repeats one value for long, and a clipped channel its limit.
- Clipped channels: extremes that are repeated exactly. A clipped output can be compared with a simulation that is
  clipped alike; what a clipped input was beyond its limit is lost.
- Periods that have not settled: the rms differences of neighbouring periods are the same where only noise differs, and
  larger at first where a transient dies away. Then the first sample is not on the steady cycle, and the periods'
  differences are not the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..data import Recording
from ..laws import AsymmetricSaturation
from .gates import Gate, opened_at_the_start, refit
from .linearise import linearised
from .remainder import folds, followed, held_out, moved
from .workbench import Fitted, Workbench

CUBIC = np.array([-1, 4, 0, 4, -1]) / 6  # through the neighbours at -2, -1, 1, 2
GLITCH_REACH = 12  # samples on either side that a distance is compared with
USUAL_QUANTILE = 0.75  # of the distances nearby, that a glitch is compared with
GLITCH_FAR, GLITCH_SIZE = 12.0, 0.1  # times that quantile, and times the output's deviation
CLEAN_AROUND = 0.12  # of a glitch, that distances around it reach at most once it is replaced
MOST_GLITCHES = 0.02  # of the samples that may be glitches
MOSTLY_GLITCHES = 0.5  # share of all squared distances beyond which they are a fault

STALE_SHARE, DISTINCT_LEVELS = 0.01, 0.5  # of the samples: those that repeat, and values that differ
LONGEST_REPEAT = 5  # samples
ENCODER_STEPS = 4.5  # steps of an encoder in a sample, after which it may still have stood
CHANCE_REPEATS = 3.0  # times as many repeats as changes by one step up: noise makes about as many of both

MOST_LEFT = 0.5  # share of the mismatch that what lies beyond an input's limit leaves at most

DYING_RATIO = 1.5  # times the least difference of neighbouring periods that the first one is, where it dies away


def without_glitches(recordings: Sequence[Recording]) -> tuple[tuple[Recording, ...], list[Gate]]:
    """Replace glitches by what lies between their neighbours; return the recordings and the findings."""
    gates = []
    for i, name in enumerate(recordings[0].outputs):
        places = [glitches(r.y[:, i])[0] for r in recordings]
        count = sum(map(len, places))
        if not count:
            continue
        off = [distances(r.y[:, i]) ** 2 for r in recordings]
        weight = sum(float(np.sum(d[k])) for d, k in zip(off, places, strict=True)) / float(np.sum(np.concatenate(off)))
        first = next(r.dt * k[0] for r, k in zip(recordings, places, strict=True) if len(k))
        sentence = (
            f"Single samples of {name} are far off their neighbours, as from glitches: {count}, the first at "
            f"t = {first:.6g} s. What lies between their neighbours is taken instead."
        )
        gates.append(Gate(name, "glitch", count, sentence, True, weight > MOSTLY_GLITCHES, mended))
    return (tuple(map(mended, recordings)) if gates else tuple(recordings)), gates


def mended(r: Recording) -> Recording:
    """Replace each glitch of a recording's outputs by the cubic through its neighbours."""
    return r.with_(y=np.column_stack([glitches(column)[1] for column in r.y.T]))


def glitches(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find single samples far off their neighbours, shape (k,); return them and the output without them."""
    clean, found, deviation = np.array(y), np.zeros(0, dtype=int), float(np.std(y))
    while len(y) > 4 * GLITCH_REACH and len(found) < MOST_GLITCHES * len(y):
        d = distances(clean)
        large = np.flatnonzero(np.abs(d) > GLITCH_SIZE * deviation)
        more = [k for k in large if _stands_alone(clean, np.abs(d), int(k))]
        if not more:
            return np.sort(found), clean
        clean[more] -= d[more]
        found = np.append(found, more)
    return np.zeros(0, dtype=int), np.array(y)


def distances(y: np.ndarray) -> np.ndarray:
    """Compute the distance of each sample from the cubic through its four neighbours; none at the ends."""
    d = np.zeros(len(y))
    d[2:-2] = y[2:-2] - np.convolve(y, CUBIC, mode="valid")
    return d


def _stands_alone(y: np.ndarray, d: np.ndarray, k: int) -> bool:
    """Tell whether a sample stands out, and nothing around it does once it is replaced."""
    around = np.arange(max(k - GLITCH_REACH, 2), min(k + GLITCH_REACH + 1, len(y) - 2))
    near = np.abs(around - k) <= 2
    usual = float(np.quantile(d[around[~near]], USUAL_QUANTILE))
    if d[k] <= GLITCH_FAR * usual:
        return False
    whole = slice(max(k - 4, 0), min(k + 5, len(y)))
    other = np.array(y[whole])
    other[k - whole.start] -= distances(y)[k]
    return bool(np.max(np.abs(distances(other))) < CLEAN_AROUND * d[k])


def stale_samples(recordings: Sequence[Recording]) -> list[Gate]:
    """Note each output that repeats samples."""
    found = []
    for i, name in enumerate(recordings[0].outputs):
        values = np.concatenate([r.y[r.skip :, i] for r in recordings])
        levels = np.unique(values)
        step = np.min(np.diff(levels), initial=np.inf)
        repeated = float(np.mean(np.concatenate([_repeated(r.y[r.skip :, i], step) for r in recordings])))
        changes = np.concatenate([np.diff(r.y[r.skip :, i]) for r in recordings])
        up = float(np.mean(np.abs(changes - step) < 0.5 * step))
        if repeated > max(STALE_SHARE, CHANCE_REPEATS * up) and len(levels) > DISTINCT_LEVELS * len(values):
            sentence = (
                f"{repeated:.0%} of the samples of {name} repeat the one before, as from lost or stale samples; the "
                "error that this makes is taken for noise: record again, or leave them out."
            )
            found.append(Gate(name, "stale", repeated, sentence, False))
    return found


def stretches(mask: np.ndarray) -> np.ndarray:
    """Find begin and end of each stretch of a mask (M,) that is true, shape (n, 2)."""
    return np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]]))).reshape(-1, 2)


def _repeated(y: np.ndarray, step: float) -> np.ndarray:
    """Tell which samples repeat the one before, away from the limits, in short runs that a jump follows."""
    same = np.append(False, y[1:] == y[:-1]) & (y > np.min(y)) & (y < np.max(y))
    for begin, end in stretches(same):
        if end - begin > LONGEST_REPEAT or abs(y[min(end, len(y) - 1)] - y[begin]) <= ENCODER_STEPS * step:
            same[begin:end] = False
    return same


def unclip(bench: Workbench, plain: Fitted) -> tuple[Workbench, Fitted, list[Gate]]:
    """Clip the simulator's outputs where the recorder clipped the machine's; the rest of these outputs still counts."""
    gates = []
    for i, low, high, count in clipped(bench.recordings, "y"):
        name = bench.simulator.output_names[i]
        law = AsymmetricSaturation().at({"low": max(low, -1e300), "high": min(high, 1e300)})
        placed = bench.simulator.with_element(f"sensor:{name}", law)
        prefix = placed.elements[-1].prefix
        held = {k: replace(p, fixed=True) if k.startswith(prefix) else p for k, p in placed.parameters.items()}
        other = replace(bench, simulator=placed.with_parameters(held))
        found = refit(other, plain)
        if found is None or found.cost > min(0.97 * plain.cost, 0.3):
            continue
        at = " and ".join(f"{v:.6g}" for v in _finite_limits(low, high))
        sentence = (
            f"{name} is clipped at {at} ({count} samples at the limit); with the simulator's output clipped alike the "
            f"refitted error falls from {plain.cost**0.5:.3g} to {found.cost**0.5:.3g} of the outputs' deviation."
        )
        left = found.cost / plain.cost
        gates.append(Gate(name, "clipping", _finite_limits(low, high), sentence, True, fault=True, left=left))
        bench, plain = other, found
    return bench, plain, gates


def clipped_input(bench: Workbench, without: Fitted, remains: float) -> Gate | None:
    """Find the clipped input beyond whose limits most of the mismatch lies, if no law leaves less (`remains`) of it.

    What went into the machine there is not in the recording; what goes on as smoothly stands for it (`_beyond_limit`).
    """
    for i, low, high, count in clipped(bench.recordings, "u"):
        name = bench.simulator.inputs[i]
        left = 1 - _explained(bench, without, i, low, high)
        if left < min(MOST_LEFT, remains):
            at = " and ".join(f"{v:.6g}" for v in _finite_limits(low, high))
            sentence = (
                f"{name} is clipped at {at} ({count} samples at the limit), and what it may have been beyond explains "
                f"{1 - left:.0%} of the mismatch: what went into the machine there is not in the recording. Record it "
                "with a larger range."
            )
            return Gate(name, "clipping", _finite_limits(low, high), sentence, False, fault=True)
    return None


def _explained(bench: Workbench, without: Fitted, i: int, low: float, high: float) -> float:
    """Compute the share of the error that input i beyond its limits explains, on blocks that it was not fitted to."""
    probe, runs = linearised(bench, without)
    port = probe.ports.index(f"actuator:{bench.simulator.inputs[i]}")
    skips = [r.skip for r in bench.recordings]
    limits = [(v, sign) for v, sign in ((low, -1.0), (high, 1.0)) if np.isfinite(v)]
    phi, error = [], []
    for run, r in zip(runs, bench.recordings, strict=True):
        beyond = np.column_stack([sign * _beyond_limit(r.u[:, i], v) for v, sign in limits])
        phi.append(moved(bench, run, [(port, beyond)], r.skip)[:, -len(limits) :])
        error.append((run.error / bench.scale)[r.skip :].ravel())
    base = followed(bench, runs, skips)
    left, columns = np.concatenate(error), np.concatenate(phi)
    left = left - base @ (base.T @ left)
    columns = columns - base @ (base.T @ columns)
    if np.any(np.linalg.lstsq(columns, left, rcond=1e-8)[0] > 0):  # it would have been within the limit
        return 0.0
    return held_out(columns, left, folds(len(left), len(runs)))


def _beyond_limit(u: np.ndarray, limit: float) -> np.ndarray:
    """Estimate how far a signal was beyond a limit: the cubic that leaves and comes back with its slopes around it."""
    out, rise = np.zeros(len(u)), np.abs(np.diff(u, prepend=u[0], append=u[-1]))
    for begin, end in stretches(u == limit):  # the step to the limit is cut short, the one before it may be
        leaves, back = np.max(rise[max(begin - 1, 0) : begin + 1]), np.max(rise[end : end + 2])
        t = (np.arange(end - begin) + 0.5) / (end - begin)
        out[begin:end] = (end - begin) * t * (1 - t) * (leaves * (1 - t) + back * t)
    return out


def _finite_limits(low: float, high: float) -> list[float]:
    """Return the limits that there are."""
    return [v for v in (low, high) if np.isfinite(v)]


def clipped(recordings: Sequence[Recording], kind: str) -> list[tuple[int, float, float, int]]:
    """Find channels that repeat their extremes exactly over several samples: (column, low, high, samples at limits).

    `kind` is "u" for the inputs, "y" for the outputs.
    """
    out = []
    for i in range(getattr(recordings[0], kind).shape[1]):
        y = np.concatenate([getattr(r, kind)[:, i] for r in recordings])
        limits, count = [-np.inf, np.inf], 0
        for j, extreme in enumerate((y.min(), y.max())):
            at = y == extreme
            runs = np.diff(stretches(at)).ravel()
            neighbours = np.mean(np.abs(np.diff(y)) == 0)
            if (
                at.sum() >= 6
                and runs.max(initial=0) >= 3
                and np.sum(runs > 1) > 1
                and at.mean() > 3 * _quantised(y)
                and neighbours < 0.5
            ):
                limits[j], count = float(extreme), count + int(at.sum())
        if count:
            out.append((i, limits[0], limits[1], count))
    return out


def _quantised(y: np.ndarray) -> float:
    """Compute the share of samples at a level of a quantised signal near its extremes; 0 for a continuous one."""
    values, counts = np.unique(y, return_counts=True)
    if len(values) > 0.5 * len(y):
        return 0.0
    return float(np.median(np.concatenate([counts[1:6], counts[-6:-1]])) / len(y))


def without_transients(recordings: Sequence[Recording]) -> tuple[tuple[Recording, ...], list[Gate]]:
    """Leave the initial states of recordings that settle only within the record to be estimated, and note this."""
    pairs = ((r, zip(r.outputs, _transient_ratios(r), strict=True)) for r in recordings)
    found = [(float(ratio), name, r) for r, ratios in pairs for name, ratio in ratios]
    ratio, name, r = max(found, key=lambda f: f[0])
    if ratio < DYING_RATIO:
        return tuple(recordings), []
    sentence = (
        f"{name} has not settled{f' in {r.name}' if r.name else ''}: its first two periods differ {ratio:.2g} times as "
        "much as later ones; initial states are estimated, and the periods do not tell the noise."
    )
    return tuple(map(opened_at_the_start, recordings)), [
        Gate(name, "transient", ratio, sentence, True, change=opened_at_the_start)
    ]


def _transient_ratios(r: Recording) -> np.ndarray:
    """Divide the first two periods' difference by the least of neighbours, by output; ones where there are none."""
    count = (len(r) - r.skip) // r.period if r.period and r.begins == "periodic" else 0
    if count < 3 or not r.period:
        return np.ones(r.n_y)
    periods = r.y[r.skip :][: count * r.period].reshape(count, r.period, r.n_y)
    steps = np.sqrt(np.mean(np.diff(periods, axis=0) ** 2, axis=1))
    return np.asarray(steps[0] / np.maximum(steps.min(axis=0), 1e-9 * np.std(r.y, axis=0) + 1e-300))
