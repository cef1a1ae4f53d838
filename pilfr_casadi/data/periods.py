"""Periodic recordings: mean period, noise from the scatter of periods, weights by noise, and repeated inputs.

In steady state the response to a periodic input repeats, hysteresis included; the part that does not repeat is noise.
With P periods the variance of one sample is `Σ (y_p - mean)² / (P - 1)`; averaging over the periods divides it by P
(Pintelon & Schoukens 2012, chapter 2). This needs no knowledge of the system.

Held-out data prove nothing if their input also occurs in the training data: a model that has memorised one period
predicts the next. Two stretches of input count as the same if the root mean square of their difference is at most
`SAME_INPUT` times their standard deviation.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from .._base import InputError, positive
from .recording import Recording, as_recordings

Array = np.ndarray

SAME_INPUT = 0.02  # rms difference over standard deviation up to which inputs are the same; a measured one has noise
WRONG_PERIOD = 0.5  # the same ratio above which the stated period is wrong; two unrelated stretches give 1.4
LARGEST_LAG = 2 / 3  # largest lag at which a recording is compared with itself, as a share of its length
CONSTANT_CHANNEL = 1e-9  # standard deviation over largest value up to which a channel counts as constant


def mean_period(recording: Recording) -> Recording:
    """Return the mean of a recording's steady periods, as a recording of one period in steady state.

    Raises
    ------
    InputError
        If the period is not known, or the steady samples are not whole periods.
    """
    u, y = (_by_period(recording, x).mean(axis=0) for x in (recording.u, recording.y))
    return recording.with_(u=u, y=y, skip=0, initial="periodic")


def period_noise(recording: Recording) -> Array:
    """Estimate the standard deviation of one sample's noise from the scatter of the periods, (n_y,), in units of y.

    Raises
    ------
    InputError
        If there are fewer than two periods, or as `mean_period`.
    """
    y = _by_period(recording, recording.y)
    if len(y) < 2:
        raise InputError(f"{recording.label} has one period; noise shows only in the scatter of two or more.")
    return np.asarray(np.sqrt(np.mean(np.var(y, axis=0, ddof=1), axis=0)))


def noise_weights(recordings: Recording | Iterable[Recording], error: float = 0.03) -> Array:
    """Return weights for fitting the mean periods of recordings with different levels and noise, one each.

    The error of a recording counts relative to its own standard deviation, and counts less if noise exceeds it. With
    the expected relative `error` of the model and the relative noise n of the mean period,

        weight = (deviation in all recordings / own deviation) / sqrt(1 + (n / error)²).

    Pass the result to `fit(..., weights=...)`. No recording gets the weight zero.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Two or more steady periods each.
    error : float
        Relative error that the model is expected to reach.

    Raises
    ------
    InputError
        As `period_noise`, or if `error` is not above zero.
    """
    positive(error, "error", "the relative error that the model is expected to reach")
    given = as_recordings(recordings)
    deviation = np.array([np.std(_by_period(r, r.y), axis=(0, 1)) for r in given])
    overall = np.sqrt(np.mean(deviation**2, axis=0))
    counts = np.array([np.sqrt(len(_by_period(r, r.y))) for r in given])
    noise = np.mean([period_noise(r) for r in given] / deviation, axis=1) / counts
    return np.asarray(np.mean(overall / deviation, axis=1) / np.sqrt(1.0 + (noise / error) ** 2))


def repeats_itself(recording: Recording) -> bool:
    """Tell whether a recording's input repeats within it, as in steady periods or a sine."""
    m = len(recording) - recording.skip
    if recording.begins == "periodic" and recording.period and recording.period <= LARGEST_LAG * m:
        return True
    u = _standardise(recording.u[recording.skip :])
    if u is None:
        return False
    n = np.arange(m, 0, -1)
    power = np.concatenate([[0.0], np.cumsum(np.sum(u**2, axis=1))])
    # (1/n) Σ |u(t+p) - u(t)|² for each lag p
    difference = (power[-1] - power[:m] + power[m - np.arange(m)] - 2 * _correlate(u, u)[:m]) / n
    variance = float(u.shape[1])
    first = np.argmax(difference > variance)  # a slow input resembles itself at small lags, which are left out
    last = int(LARGEST_LAG * m)
    return bool(first and first < last and np.min(difference[first : last + 1]) <= SAME_INPUT**2 * variance)


def keeps_its_period(recording: Recording) -> bool:
    """Tell whether the input repeats after the stated period; True for recordings not in periodic steady state."""
    u, n = recording.u[recording.skip :], recording.period or 0
    if recording.begins != "periodic" or not 0 < n < len(u):
        return True
    difference = np.sqrt(np.mean((u[n:] - u[:-n]) ** 2, axis=0))
    return bool(np.all(difference <= WRONG_PERIOD * np.std(u, axis=0)))


def same_input(one: Recording, other: Recording) -> bool:
    """Tell whether the shorter of two inputs is contained in the other, half by half and in any phase."""
    short, long = sorted((one, other), key=lambda r: len(r) - r.skip)
    wanted, u = short.u[short.skip :], long.u[long.skip :]
    if long.begins == "periodic":
        u = np.concatenate([u, u[: long.period]])
    half = len(wanted) // 2
    return half > 0 and _contains(u, wanted[:half]) and _contains(u, wanted[half : 2 * half])


def group_by_input(recordings: Sequence[Recording]) -> list[list[int]]:
    """Group the recordings by their inputs; return the indices of each group, in the order of the recordings."""
    groups: list[list[int]] = []
    for k, r in enumerate(recordings):
        own = next((g for g in groups if any(same_input(r, recordings[i]) for i in g)), None)
        if own is None:
            groups.append([k])
        else:
            own.append(k)
    return groups


def _contains(u: Array, wanted: Array) -> bool:
    """Tell whether an input (M, n_u) contains a stretch (L, n_u); False for a constant stretch."""
    middle, size = wanted.mean(axis=0), wanted.std(axis=0)
    moving = size > CONSTANT_CHANNEL * np.max(np.abs(u), initial=1e-300)
    if len(u) < len(wanted) or not np.any(moving):
        return False
    a, b = ((x - middle)[:, moving] / size[moving] for x in (wanted, u))
    power = np.concatenate([[0.0], np.cumsum(np.sum(b**2, axis=1))])
    lags = len(u) - len(a) + 1
    difference = np.sum(a**2) + power[len(a) :] - power[:lags] - 2 * _correlate(b, a)[:lags]
    return bool(np.min(difference) <= SAME_INPUT**2 * a.size)


def _standardise(u: Array) -> Array | None:
    """Return the channels that vary, (M, n), with mean 0 and standard deviation 1; None where none does."""
    size = u.std(axis=0)
    moving = size > CONSTANT_CHANNEL * np.max(np.abs(u), axis=0, initial=1e-300)
    return (u - u.mean(axis=0))[:, moving] / size[moving] if np.any(moving) else None


def _correlate(u: Array, v: Array) -> Array:
    """Return Σ u(t + p) v(t) over t and channels, for the lags p from 0 to M - 1, (M,)."""
    from scipy.signal import fftconvolve

    return np.sum(fftconvolve(u, v[::-1], axes=0), axis=1)[len(v) - 1 :]


def _by_period(recording: Recording, x: Array) -> Array:
    """Return the steady samples as (P, N, channels)."""
    if recording.period is None:
        raise InputError(f"The period of {recording.label} is not known; give it in samples, as in period=8192.")
    steady = len(recording) - recording.skip
    if steady % recording.period:
        raise InputError(
            f"{recording.label} has {steady} steady samples, which are not whole periods of {recording.period}; "
            "cut it, or correct `period` or `skip`."
        )
    return x[recording.skip :].reshape(steady // recording.period, recording.period, x.shape[1])
