"""Preprocess signals given as arrays, by SciPy: detrend, filter, resample, interpolate onto even times.

The verbs of `Recording` (`cut`, `detrend`, `filter`, `resample`, `merge`) call these functions and keep the rest of the
recording consistent.

Oppenheim & Schafer (2010), Discrete-Time Signal Processing, sec. 4.6 (change of step), 5.7 (zero phase).
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from .._base import InputError, is_number, listed, positive, whole
from .holds import SAME_TIME

Array = np.ndarray

TRENDS = ("constant", "linear")
FILTERS = ("lowpass", "highpass", "bandpass", "bandstop")
LARGEST_FACTOR = 1000  # largest numerator and denominator of a rational change of step
RATIO_ERROR = 1e-9  # relative error of that ratio, far below a sample over the longest recordings
MOST_SAMPLES = 1e8  # of a resampled recording: 0.8 GB a channel
PASSBAND = 0.8  # share of the new Nyquist frequency that the anti-alias filter passes; the rest is its transition band
ANTI_ALIAS_ORDER = 8  # order of the Butterworth filter before an irrational change of step
MOST_UNEVEN = 0.5  # largest deviation of a gap from the median one for a spline, which wiggles between uneven samples
LONGEST_GAP = 10  # in median steps; samples interpolated over a longer gap would be invented


def remove_trend(values: Array, kind: Any) -> Array:
    """Subtract the mean, or the least-squares line, from every column of (M, n)."""
    if kind not in TRENDS:
        raise InputError(f"kind={kind!r} was given to detrend; give {listed(TRENDS)}.")
    from scipy.signal import detrend

    return np.asarray(detrend(values, axis=0, type=kind))


def butterworth(values: Array, dt: float, cutoff: float | tuple[float, float], kind: str, order: int) -> Array:
    """Run a Butterworth filter forwards and backwards over every column of (M, n); see `Recording.filter`.

    The two passes cancel the phase, double the order, and make the gain at a cutoff frequency one half.
    """
    if kind not in FILTERS:
        raise InputError(f"kind={kind!r} was given to filter; give {listed(FILTERS)}.")
    edges = (cutoff,) if is_number(cutoff) else tuple(cutoff) if isinstance(cutoff, tuple | list | Array) else ()
    needed = 2 if kind.startswith("band") else 1
    if len(edges) != needed or not all(is_number(edge) for edge in edges) or list(edges) != sorted(set(edges)):
        wanted = "two frequencies in Hz, the lower one first" if needed == 2 else "one frequency in Hz"
        raise InputError(f"cutoff={cutoff!r} was given for a {kind} filter; give {wanted}.")
    for edge in edges:
        positive(edge, "cutoff", "a frequency in Hz")
        if edge >= 0.5 / dt:
            raise InputError(
                f"cutoff={edge:g} Hz is not below the Nyquist frequency {0.5 / dt:g} Hz, half the sampling rate; give "
                "a lower one."
            )
    return _zero_phase(values, dt, edges if needed == 2 else edges[0], kind, whole(order, "order", 1))


def _zero_phase(values: Array, dt: float, edges: Any, kind: Any, order: int) -> Array:
    """Filter forwards and backwards; the signal is extended beyond its ends by odd reflection."""
    from scipy.signal import butter, sosfiltfilt

    sections = butter(order, edges, kind, fs=1 / dt, output="sos")
    edge = 6 * len(sections) + 3
    if len(values) <= edge:
        raise InputError(f"{len(values)} samples are too few for this filter, which needs more than {edge}.")
    return np.asarray(sosfiltfilt(sections, values, axis=0, padlen=edge))


def change_step(values: Array, dt: float, step: float) -> Array:
    """Resample every column of (M, n) from step `dt` to `step`, s; an anti-alias filter precedes a longer step.

    A rational change of step uses a polyphase filter, any other a zero-phase low-pass and a cubic spline. The first
    sample stays the first.
    """
    _check_count((len(values) - 1) * dt, step)
    ratio = Fraction(dt / step).limit_denominator(LARGEST_FACTOR)
    count = int(np.floor((len(values) - 1) * dt / step * (1 + RATIO_ERROR))) + 1
    if count < 2:
        raise InputError(
            f"a step of {step:g} s leaves {count} sample of {(len(values) - 1) * dt:g} s; give a shorter one."
        )
    if ratio.numerator in range(1, LARGEST_FACTOR + 1) and abs(float(ratio) * step / dt - 1) < RATIO_ERROR:
        if ratio == 1:
            return values
        from scipy.signal import resample_poly

        polyphase = resample_poly(values, ratio.numerator, ratio.denominator, axis=0, padtype="line")
        return np.asarray(polyphase[:count])
    return sample_at(values, dt, np.arange(count) * step, step)


def _check_count(seconds: float, step: float) -> None:
    """Refuse a step that makes more samples than memory holds."""
    if seconds > MOST_SAMPLES * step:
        raise InputError(
            f"a step of {step:g} s makes more than {MOST_SAMPLES:g} samples of {seconds:.6g} s; give a longer one."
        )


def sample_at(values: Array, dt: float, times: Array, step: float) -> Array:
    """Interpolate every column of (M, n) at times in s after its first sample; low-pass it if `step` exceeds `dt`."""
    from scipy.interpolate import CubicSpline

    if step > dt * (1 + RATIO_ERROR):
        values = _zero_phase(values, dt, PASSBAND * 0.5 / step, "lowpass", ANTI_ALIAS_ORDER)
    known = np.arange(len(values)) * dt
    return np.asarray(CubicSpline(known, values, axis=0)(np.clip(times, 0.0, known[-1])))


def common_times(spans: Sequence[tuple[float, float]], step: float) -> Array:
    """Return the times that all spans (first and last time, s) cover, from the last beginning on, (M,), in seconds."""
    begin, end = (pick(times) for pick, times in zip((max, min), zip(*spans, strict=True), strict=True))
    _check_count(end - begin, step)
    times = begin + np.arange(int(np.floor(max(end - begin, 0.0) / step + SAME_TIME)) + 1) * step
    if end < begin or len(times) < 2:
        raise InputError(
            f"the channels begin by {begin:.6g} s and end from {end:.6g} s on, so they have fewer than 2 samples of "
            f"{step:g} s in common; check their times, or give a shorter step."
        )
    return times


def check_times(t: Array, step: float, label: str, held: bool) -> None:
    """Refuse times (M,), s, that do not increase, or have gaps longer than `LONGEST_GAP` median gaps and steps.

    `label` begins the message. A signal that is `held` may have gaps of any length.
    """
    gaps = np.diff(t)
    if not len(gaps) or np.any(gaps <= 0):
        raise InputError(f"{label} needs at least two times that increase from sample to sample; sort the samples.")
    usual = float(np.median(gaps))
    worst = int(np.argmax(gaps))
    if gaps[worst] > LONGEST_GAP * max(usual, step) and not held:
        raise InputError(
            f"{label} has a gap of {gaps[worst]:.3g} s after {t[worst]:.6g} s, where {usual:.3g} s is usual; cut the "
            "record there into two."
        )


def interpolate_at(t: Array, values: Array, times: Array, step: float, smooth: bool) -> Array:
    """Bring samples (M,) from their own times t, s, to even `times` within these; a filter precedes a longer step.

    The samples are interpolated on a grid at least as fine as their median gap, then resampled to `step`: by a cubic
    spline if the signal is `smooth`, as of a machine, and the gaps differ little; else linearly.
    """
    gaps = np.diff(t)
    usual = float(np.median(gaps))
    parts = max(int(np.ceil(step / usual - RATIO_ERROR)), 1)
    before = int((times[0] - t[0]) / step)  # whole steps before the first time, for the filter
    begin = times[0] - before * step
    count = max(int((t[-1] - begin) * parts / step * (1 + RATIO_ERROR)), (before + len(times) - 1) * parts) + 1
    grid = np.clip(begin + np.arange(count) * step / parts, t[0], t[-1])
    if smooth and np.max(np.abs(gaps - usual)) < MOST_UNEVEN * usual:
        from scipy.interpolate import CubicSpline

        even = CubicSpline(t, values)(grid)
    else:
        even = np.interp(grid, t, values)
    return change_step(even[:, None], step / parts, step)[before : before + len(times), 0]
