"""Periodic recordings: their mean period, their noise from what differs between periods, and weights by noise.

In steady state the response to a periodic input repeats, hysteresis included; what does not repeat is noise. With P
periods the variance of one sample is `Σ (y_p - mean)² / (P - 1)`, and of the mean period a P-th of that (Pintelon &
Schoukens 2012, chapter 2). Nothing about the system has to be known.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from .._base import InputError
from .recording import Recording, as_recordings

Array = np.ndarray


def mean_period(recording: Recording) -> Recording:
    """The mean of a recording's steady periods, as a recording of one period in steady state.

    Raises
    ------
    InputError
        If the period is not known, or the steady samples are not whole periods.
    """
    u, y = (_stacked(recording, x).mean(axis=0) for x in (recording.u, recording.y))
    return recording.with_(u=u, y=y, skip=0, initial="periodic")


def period_noise(recording: Recording) -> Array:
    """Standard deviation of one sample's noise from what differs between periods, shape (n_y,), in units of y.

    Raises
    ------
    InputError
        If there are fewer than two periods, or as `mean_period`.
    """
    y = _stacked(recording, recording.y)
    if len(y) < 2:
        raise InputError(f"{recording.label} has one period; noise shows only in what differs between two or more.")
    return np.asarray(np.sqrt(np.mean(np.var(y, axis=0, ddof=1), axis=0)))


def noise_weights(recordings: Recording | Iterable[Recording], error: float = 0.03) -> Array:
    """Weights for fitting the mean periods of recordings of several levels and of different noise, one each.

    The error of a recording counts relative to its own deviation, and less where noise hides it: with the expected
    relative `error` of the model and the relative noise n of the mean period,

        weight = (deviation in all recordings / own deviation) / sqrt(1 + (n / error)²).

    No recording is dropped. For `fit(..., weights=...)`.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        Two or more steady periods each.
    error : float
        Relative error of the model that is hoped for.

    Raises
    ------
    InputError
        As `period_noise`, or if `error` is not above zero.
    """
    if not error > 0:
        raise InputError(f"error={error!r} was given; give the relative error that is hoped for, above zero.")
    given = as_recordings(recordings)
    deviation = np.array([np.std(_stacked(r, r.y), axis=(0, 1)) for r in given])
    every = np.sqrt(np.mean(deviation**2, axis=0))
    counts = np.array([np.sqrt(len(_stacked(r, r.y))) for r in given])
    noise = np.mean([period_noise(r) for r in given] / deviation, axis=1) / counts
    return np.asarray(np.mean(every / deviation, axis=1) / np.sqrt(1.0 + (noise / error) ** 2))


def _stacked(recording: Recording, x: Array) -> Array:
    """Steady samples as (P, N, channels)."""
    if recording.period is None:
        raise InputError(f"The period of {recording.label} is not known; give it in samples, as in period=8192.")
    steady = len(recording) - recording.skip
    if steady % recording.period:
        raise InputError(
            f"{recording.label} has {steady} steady samples, which are not whole periods of {recording.period}; "
            "cut it, or correct `period` or `skip`."
        )
    return x[recording.skip :].reshape(-1, recording.period, x.shape[1])
