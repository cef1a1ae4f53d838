"""Faults visible in the recorded samples themselves: glitches, stale, clipped and unsettled samples, and steady tones.

- Glitches, for example from a lost bit or a loose contact: a sample far off the cubic through its four neighbours,
  relative to the distances nearby. Replacing it by that cubic makes its neighbours inconspicuous; this does not hold at
  a step or a shock.
- Stale samples: a channel sometimes repeats its last value, which it otherwise never does. Three other causes are told
  apart: a coarse converter, or an encoder that moves by no more than its step, has few values; a machine at rest
  repeats one value for long; a clipped channel repeats its limit.
- Clipped channels: exactly repeated extremes. A clipped output can be compared with an equally clipped simulation; the
  part of a clipped input beyond its limit is lost.
- Unsettled periods: the rms differences of neighbouring periods are equal if only noise differs, and larger at first if
  a transient decays. Then the first sample is not on the steady cycle, and the periods' differences are not the noise.
- Tones, for example from mains hum, a fan or an unbalanced motor: a line of the residual's spectrum far above its
  neighbours. Its amplitude and phase are constant over the record, and it is neither in an input nor a harmonic or a
  mixture of an input's few lines. A residual at one of the simulator's own frequencies is not noise either: an
  unrecorded force leaves such a residual, and no law at any port explains it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..data import Recording
from ..laws import AsymmetricSaturation
from .gates import CURED, LEAST_GAIN, USELESS_FIT, Checked, FirstOrder, Gate, describe_fall, gain, open_start, refit
from .linearise import linearised
from .screen import folds, held_out
from .workbench import Fitted, Workbench

CUBIC = np.array([-1, 4, 0, 4, -1]) / 6  # through the neighbours at -2, -1, 1, 2
GLITCH_REACH = 12  # samples on either side with which a distance is compared
USUAL_QUANTILE = 0.75  # quantile of the distances nearby with which a glitch is compared
GLITCH_FAR, GLITCH_SIZE = 12.0, 0.1  # least distance of a glitch over that quantile, and over the output's deviation
MOST_GLITCHES = 0.02  # largest share of the samples that may be glitches

STALE_SHARE = 0.01  # least share of the samples that repeat
CONTINUOUS = 0.5  # share of the samples with distinct values above which a signal is not quantised
STANDING = 5  # longest rest of an encoder or a machine, in samples; largest motion of an encoder in a sample, in steps
BY_CHANCE = 3.0  # factor on the number of repeats that noise causes

MOST_LEFT = 0.5  # largest share of the mismatch that remains after correcting an input beyond its limit

DYING_RATIO = 1.5  # least ratio of the first to the smallest difference of neighbouring periods, for a transient

FAR, OVER = 50.0, 10.0  # least ratio to the lines around: of a tone; of an input's line or a mode's
AROUND, OWN = 30, 3  # lines on either side that are compared, and that belong to the tone
FINE = 10  # least number of spectral lines up to a tone or a mode
POWER = 0.05  # least power of a tone over the residual's, and of an input's further lines over its strongest
STEADY = 0.5  # largest change of the amplitude in a quarter of the record, over the amplitude
# for mixtures of an input's lines: most lines; highest order of mixtures, and of harmonics
LINES, ORDER, HARMONICS = 3, 7, 60

LIGHT = 0.15  # damping ratio below which a mode rings
SEGMENTS = 4  # half-overlapping segments over which a mode's spectrum is averaged
BAND = 1.2, 1.8  # limits of the frequency ratio to a mode, above and below, in which the spectrum is compared


def remove_glitches(recordings: Sequence[Recording]) -> tuple[tuple[Recording, ...], list[Gate]]:
    """Replace glitches by interpolation between their neighbours; return the recordings and the findings."""
    gates = list[Gate]()
    for i, name in enumerate(recordings[0].outputs):
        places, clean = zip(*(find_glitches(r.y[:, i]) for r in recordings), strict=True)
        count = sum(map(len, places))
        if not count:
            continue
        before, after = (
            sum(float(np.sum(distances(y) ** 2)) for y in ys) for ys in ([r.y[:, i] for r in recordings], clean)
        )
        first = next(r.dt * k[0] for r, k in zip(recordings, places, strict=True) if len(k))
        sentence = (
            f"Single samples of {name} are far off their neighbours, as from glitches: {count}, the first at "
            f"t = {first:.6g} s. What lies between their neighbours is taken instead."
        )
        gates.append(Gate(name, "glitch", count, sentence, fault=after < CURED * before, change=mend))
    return (tuple(map(mend, recordings)) if gates else tuple(recordings)), gates


def mend(r: Recording) -> Recording:
    """Replace each glitch of a recording's outputs by the cubic through its neighbours."""
    return r.with_(y=np.column_stack([find_glitches(column)[1] for column in r.y.T]))


def find_glitches(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
    """Tell whether a sample stands out, and its neighbours do not once it is replaced."""
    around = np.arange(max(k - GLITCH_REACH, 2), min(k + GLITCH_REACH + 1, len(y) - 2))
    near = np.abs(around - k) <= 2
    usual = float(np.quantile(d[around[~near]], USUAL_QUANTILE))
    if d[k] <= GLITCH_FAR * usual:
        return False
    whole = slice(max(k - 4, 0), min(k + 5, len(y)))
    other = np.array(y[whole])
    other[k - whole.start] -= distances(y)[k]
    return bool(np.max(np.abs(distances(other))) < CURED * d[k])


def find_stale_samples(recordings: Sequence[Recording]) -> list[Gate]:
    """Note each output that repeats samples."""
    found = []
    for i, name in enumerate(recordings[0].outputs):
        values = np.concatenate([r.y[r.skip :, i] for r in recordings])
        levels = np.unique(values)
        step = np.min(np.diff(levels), initial=np.inf)
        repeated = float(np.mean(np.concatenate([_find_repeats(r.y[r.skip :, i], step) for r in recordings])))
        changes = np.concatenate([np.diff(r.y[r.skip :, i]) for r in recordings])
        up = float(np.mean(np.abs(changes - step) < 0.5 * step))
        if repeated > max(STALE_SHARE, BY_CHANCE * up) and len(levels) > CONTINUOUS * len(values):
            sentence = (
                f"{repeated:.0%} of the samples of {name} repeat the one before, as from lost or stale samples; the "
                "error that this makes is taken for noise: record again, or leave them out."
            )
            found.append(Gate(name, "stale", repeated, sentence, False))
    return found


def find_stretches(mask: np.ndarray) -> np.ndarray:
    """Find begin and end of each stretch in which a mask (M,) is true, shape (n, 2)."""
    return np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]]))).reshape(-1, 2)


def _find_repeats(y: np.ndarray, step: float) -> np.ndarray:
    """Mark samples that repeat the one before, away from the limits, in short runs followed by a jump."""
    same = np.append(False, y[1:] == y[:-1]) & (y > np.min(y)) & (y < np.max(y))
    for begin, end in find_stretches(same):
        if end - begin > STANDING or abs(y[min(end, len(y) - 1)] - y[begin]) < STANDING * step:
            same[begin:end] = False
    return same


@dataclass(frozen=True)
class Clipping:
    """A channel that repeats its extremes exactly: its column, the limits (infinite where none), samples at them."""

    column: int
    low: float
    high: float
    count: int

    @property
    def limits(self) -> list[float]:
        """Finite limits."""
        return [v for v in (self.low, self.high) if np.isfinite(v)]

    def __str__(self) -> str:
        at = " and ".join(f"{v:.6g}" for v in self.limits)
        return f"clipped at {at} ({self.count} samples at the limit)"


def unclip(now: Checked) -> Checked:
    """Clip the simulator's outputs like the recorded ones, so that the rest of these outputs still counts."""
    for found in find_clipping(now.bench.recordings, "y"):
        bench, plain = now.bench, now.fitted
        name = bench.simulator.output_names[found.column]
        law = AsymmetricSaturation().at({"low": max(found.low, -1e300), "high": min(found.high, 1e300)})
        placed = bench.simulator.with_element(f"sensor:{name}", law)
        prefix = placed.elements[-1].prefix
        held = {k: replace(p, fixed=True) if k.startswith(prefix) else p for k, p in placed.parameters.items()}
        other = replace(bench, simulator=placed.with_parameters(held))
        after = refit(other, [{}, plain.values], states=plain.begin)
        if after is None or after.cost > USELESS_FIT or gain(plain.cost, after.cost, after.residual, 0) < LEAST_GAIN:
            continue
        sentence = (
            f"{name} is {found}; with the simulator's output clipped alike {describe_fall(plain.cost, after.cost)}."
        )
        gate = Gate(name, "clipping", found.limits, sentence, fault=True, left=after.cost / plain.cost)
        now = now.then(other, after, gate)
    return now


def clipped_input(bench: Workbench, without: Fitted, remains: float) -> Gate | None:
    """Find a clipped input that explains most of the mismatch, if no law leaves less (`remains`) of it.

    The true input beyond the limit is not recorded; a smooth continuation replaces it (`_beyond_limit`).
    """
    for found in find_clipping(bench.recordings, "u"):
        name = bench.simulator.inputs[found.column]
        explained = _explained_beyond(bench, without, found)
        if 1 - explained < min(MOST_LEFT, remains):
            sentence = (
                f"{name} is {found}, and what it may have been beyond explains {explained:.0%} of the mismatch: what "
                "went into the machine there is not in the recording. Record it with a larger range."
            )
            return Gate(name, "clipping", found.limits, sentence, corrected=False, fault=True)
    return None


def _explained_beyond(bench: Workbench, without: Fitted, found: Clipping) -> float:
    """Compute the held-out share of the error that an input's continuation beyond its limits explains."""
    first = FirstOrder.of(bench, without)
    signs = [(v, 1.0 if v == found.high else -1.0) for v in found.limits]
    beyond = [
        np.column_stack([sign * _beyond_limit(r.u[:, found.column], v) for v, sign in signs]) for r in bench.recordings
    ]
    left = first.left(first.error)
    columns = first.left(first.response([f"actuator:{bench.simulator.inputs[found.column]}"], beyond))
    # a positive coefficient would put the input inside its limit
    if np.any(np.linalg.lstsq(columns, left, rcond=1e-8)[0] > 0):
        return 0.0
    return held_out(columns, left, folds(len(left), len(first.runs)))


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
    for i in range(getattr(recordings[0], kind).shape[1]):
        y = np.concatenate([getattr(r, kind)[:, i] for r in recordings])
        limits, count = [-np.inf, np.inf], 0
        still = float(np.mean(np.diff(y) == 0))
        for j, extreme in enumerate((y.min(), y.max())):
            at = y == extreme
            runs = np.diff(find_stretches(at)).ravel()
            several = runs.max(initial=0) >= 3 and np.sum(runs > 1) > 1
            if several and at.mean() > BY_CHANCE * _share_at_level(y) and still < CONTINUOUS:
                limits[j], count = float(extreme), count + int(at.sum())
        if count:
            out.append(Clipping(i, limits[0], limits[1], count))
    return out


def _share_at_level(y: np.ndarray) -> float:
    """Compute the share of samples at a level of a quantised signal near its extremes; 0 for a continuous one."""
    values, counts = np.unique(y, return_counts=True)
    if len(values) > CONTINUOUS * len(y):
        return 0.0
    return float(np.median(np.concatenate([counts[1:6], counts[-6:-1]])) / len(y))


def open_unsettled(recordings: Sequence[Recording]) -> tuple[tuple[Recording, ...], list[Gate]]:
    """Estimate the initial states of recordings that settle only within the record, and note this."""
    pairs = ((r, zip(r.outputs, _transient_ratios(r), strict=True)) for r in recordings)
    found = [(float(ratio), name, r) for r, ratios in pairs for name, ratio in ratios]
    ratio, name, r = max(found, key=lambda f: f[0])
    if ratio < DYING_RATIO:
        return tuple(recordings), []
    sentence = (
        f"{name} has not settled{f' in {r.name}' if r.name else ''}: its first two periods differ {ratio:.2g} times as "
        "much as later ones; initial states are estimated, and the periods do not tell the noise."
    )
    return tuple(map(open_start, recordings)), [Gate(name, "transient", ratio, sentence, change=open_start)]


def _transient_ratios(r: Recording) -> np.ndarray:
    """Divide the first two periods' difference by the smallest of neighbours, by output; ones if it is unknown."""
    count = (len(r) - r.skip) // r.period if r.period and r.begins == "periodic" else 0
    if count < 3 or not r.period:
        return np.ones(r.n_y)
    periods = r.y[r.skip :][: count * r.period].reshape(count, r.period, r.n_y)
    steps = np.sqrt(np.mean(np.diff(periods, axis=0) ** 2, axis=1))
    return np.asarray(steps[0] / np.maximum(steps.min(axis=0), 1e-9 * np.std(r.y, axis=0) + 1e-300))


def tones(bench: Workbench, fitted: Fitted) -> list[Gate]:
    """Note each output whose residual holds the same tone in every recording."""
    found = []
    for i, name in enumerate(bench.simulator.output_names):
        pairs = zip(fitted.residual, bench.recordings, strict=True)
        each = [find_tone(e[r.skip :, i], r) for e, r in pairs if len(r) - r.skip >= 8 * AROUND]
        told = [t for t in each if t is not None]
        longest = max((len(r) for r in bench.recordings), default=0) * bench.dt
        if not told or len(told) < len(each) or np.ptp([f for f, _ in told]) > 2 / longest:
            continue
        f, amplitude = float(np.mean([f for f, _ in told])), float(np.mean([a for _, a in told]))
        unit = bench.recordings[0].units.get(name, "")
        sentence = (
            f"{name} holds a steady tone of {f:.4g} Hz, amplitude {amplitude:.3g}{f' {unit}' if unit else ''}, that is "
            "in no input, as from mains hum or a fan: shield or filter it, or record what causes it."
        )
        share = amplitude**2 / 2 / bench.scale[i] ** 2 / len(bench.scale) / fitted.cost
        found.append(Gate(name, "tone", f, sentence, corrected=False, left=1 - min(share, 1.0)))
    return found


def find_tone(e: np.ndarray, r: Recording) -> tuple[float, float] | None:
    """Find frequency, Hz, and amplitude of the tone in the residual of one output; None if there is none."""
    n, e = len(e), e - np.mean(e)
    power = _power_lines(e)
    k = FINE + int(np.argmax(power[FINE:-OWN]))
    if power[k] < FAR * _lines_around(power, k):
        return None
    f = _refine_frequency(e, k)
    whole = _fit_wave(e, f, slice(None))
    quarters = [_fit_wave(e, f, slice(q * n // 4, (q + 1) * n // 4)) for q in range(4)]
    unsteady = max(abs(q - whole) for q in quarters) > STEADY * abs(whole)
    if unsteady or abs(whole) ** 2 / 2 < POWER * float(np.mean(e**2)):
        return None
    return None if any(_comes_from_input(u, f, r) for u in r.u[r.skip :].T) else (f / r.dt, abs(whole))


def _power_lines(v: np.ndarray) -> np.ndarray:
    return np.asarray(np.abs(np.fft.rfft((v - np.mean(v)) * np.hanning(len(v)))) ** 2)


def _lines_around(power: np.ndarray, k: int) -> float:
    """Return the median of the lines around line k."""
    near = np.arange(max(k - AROUND, 1), min(k + AROUND + 1, len(power)))
    return float(np.median(power[near[np.abs(near - k) > OWN]]))


def _fit_wave(e: np.ndarray, f: float, part: slice) -> complex:
    """Fit amplitude and phase of the frequency f, a share of the sampling rate, in a part of e."""
    angle = 2 * np.pi * f * np.arange(len(e))[part]
    a, b, _ = np.linalg.lstsq(np.column_stack([np.cos(angle), np.sin(angle), np.ones(len(angle))]), e[part])[0]
    return complex(a, -b)


def _refine_frequency(e: np.ndarray, k: int) -> float:
    """Find the frequency of the strongest wave near line k, as a share of the sampling rate."""
    from scipy.optimize import minimize_scalar

    ends = (k - 1) / len(e), (k + 1) / len(e)
    found = minimize_scalar(lambda f: -abs(_fit_wave(e, f, slice(None))), bounds=ends, options={"xatol": 1e-3 / len(e)})
    return float(found.x)


def _comes_from_input(u: np.ndarray, f: float, r: Recording) -> bool:
    """Tell whether an input holds the frequency, or can make it by harmonics or mixtures of its few lines."""
    from scipy.signal import find_peaks

    n, power = len(u), _power_lines(u)
    k = round(f * n)
    if np.max(power[max(k - 1, 0) : k + 2]) > OVER * _lines_around(power, k):
        return True
    if r.period and abs(f * r.period - round(f * r.period)) * n < r.period:
        return True
    strong = find_peaks(power, POWER * np.max(power), distance=2 * OWN)[0]
    lines = [_refine_frequency(u, j) for j in strong[: LINES + 1]]
    order = ORDER
    if lines and all(abs(v / lines[0] - round(v / lines[0])) < 0.05 for v in lines):
        lines, order = lines[:1], HARMONICS if lines[0] * n > AROUND else ORDER
    if not 0 < len(lines) <= LINES:
        return False
    orders = itertools.product(range(-order, order + 1), repeat=len(lines))
    made = np.array([np.dot(c, lines) for c in orders if sum(map(abs, c)) <= order])
    # orders above half the sampling rate fold back
    return bool(np.any(np.abs(np.abs(made - np.round(made)) - f) * n < 2))


def ringing(bench: Workbench, fitted: Fitted) -> float | None:
    """Find the frequency, Hz, of a lightly damped mode that is visible in a fit's residual, or None."""
    a = linearised(bench, fitted)[1][0].mean[0]
    with np.errstate(divide="ignore"):
        poles = np.log(np.linalg.eigvals(a).astype(complex)) * fitted.model.substeps / bench.dt
    modes = [abs(s) / (2 * np.pi) for s in poles if s.imag > 0 and -s.real < LIGHT * abs(s)]
    rest = [e[r.skip :, i] for e, r in zip(fitted.residual, bench.recordings, strict=True) for i in range(r.n_y)]
    return next((f for f in sorted(modes) if any(_stands_out(e, f * bench.dt) for e in rest)), None)


def _stands_out(e: np.ndarray, f: float) -> bool:
    """Tell whether the spectrum of e at frequency f, a share of the sampling rate, is far above its surroundings."""
    from scipy.signal import welch

    length = int(np.ceil(FINE / f))
    if BAND[1] * f > 0.5 or 2 * len(e) // length - 1 < SEGMENTS:
        return False
    lines, power = welch(e, nperseg=length)
    far = np.maximum(lines / f, f / np.maximum(lines, 1e-12))
    around = power[(far > BAND[0]) & (far < BAND[1])]
    return bool(np.max(power[far < 1 + 1.5 / FINE]) > OVER * np.median(around))
