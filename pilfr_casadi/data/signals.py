"""Excitation signals: Tukey-shaped realizations of a multisine, sine sweep, pseudo-random binary sequence.

The multisines themselves are in :mod:`pilfr_casadi.multisines` and can be had from here too.
"""

from typing import Literal

import numpy as np

from .._base import InputError
from .multisines import Amplitude, Grid, count, excited_bins, multisine, orthogonal_multisine

__all__ = [
    "excited_bins",
    "multisine",
    "orthogonal_multisine",
    "prbs",
    "sine_sweep",
    "steady_periods",
    "tukey_realizations",
]


def tukey_realizations(
    n_realizations: int,
    n_period: int,
    f_max: float,
    fs: float,
    rng: np.random.Generator,
    *,
    f_min: float = 0.0,
    amplitude: Amplitude = None,
    grid: Grid = "full",
    normalize: Literal["record", "steady"] = "record",
) -> np.ndarray:
    """Training signal of Krikelis et al. (2024), Sec. 6.2.1: realizations of a multisine that fade in and out.

    Each realization has 2 `n_period` samples: half a period ramped up, one full steady period, half a period ramped
    down by a Tukey (cosine-tapered) window. It starts at zero and the next one joins it there without a step.

    Parameters
    ----------
    n_realizations : int
        Number of realizations, each with its own phases (and random grid).
    n_period : int
        Samples per period; even.
    f_max, fs, rng, f_min, amplitude, grid
        As for :func:`multisine`.
    normalize : {"record", "steady"}
        What has unit standard deviation: the whole record, ramps included, or each steady period.

    Returns
    -------
    u : array, (2 * n_period * n_realizations,)

    Raises
    ------
    InputError
        As :func:`multisine`, and for an odd `n_period` or an unknown `normalize`.

    See Also
    --------
    steady_periods : where the steady periods lie.
    """
    if n_period % 2:
        raise InputError(f"a period of {n_period} samples cannot be halved for the ramps; choose an even n_period.")
    if normalize not in ("record", "steady"):
        raise InputError(f"normalize is {normalize!r}; use 'record' or 'steady'.")
    half = n_period // 2
    ramp = np.sin(0.5 * np.pi * np.arange(half) / half) ** 2
    window = np.concatenate([ramp, np.ones(n_period), 1.0 - ramp])
    pieces = []
    for _ in range(count(n_realizations, "n_realizations")):
        period = multisine(n_period, f_max, fs, rng, f_min=f_min, amplitude=amplitude, grid=grid)
        pieces.append(window * np.concatenate([period[half:], period, period[:half]]))
    u = np.concatenate(pieces)
    return u / u.std() if normalize == "record" else u


def steady_periods(n_realizations: int, n_period: int) -> tuple[slice, ...]:
    """Samples of the steady periods in the signal of :func:`tukey_realizations`, one slice for each realization."""
    starts = [2 * n_period * i + n_period // 2 for i in range(n_realizations)]
    return tuple(slice(start, start + n_period) for start in starts)


def sine_sweep(
    f0: float, f1: float, fs: float, *, rate: float | None = None, duration: float | None = None, amplitude: float = 1.0
) -> np.ndarray:
    """Sine whose frequency moves linearly, ``amplitude · sin(2π (f0 t + (f1 − f0) t² / 2T))``.

    Parameters
    ----------
    f0, f1 : float
        Frequencies at start and end, Hz; `f1` may be the lower.
    fs : float
        Sampling frequency, Hz.
    rate, duration : float
        Sweep rate in Hz/s (its magnitude) or the duration ``T`` in s; give one of them.
    amplitude : float
        Peak of the sine.

    Returns
    -------
    u : array, (round(T * fs),)

    Raises
    ------
    InputError
        When not exactly one of `rate` and `duration` is given, or a value cannot be used.
    """
    if (rate is None) == (duration is None):
        raise InputError("a sine sweep needs its rate in Hz/s or its duration in s; give exactly one of them.")
    if not fs > 0 or not (0 <= f0 <= fs / 2 and 0 <= f1 <= fs / 2) or (rate is not None and f0 == f1):
        raise InputError(
            f"a sweep from {f0:g} to {f1:g} Hz cannot be sampled at {fs:g} Hz; choose two frequencies from 0 to fs/2."
        )
    length = abs(f1 - f0) / rate if rate else duration
    if length is None or not np.isfinite(length) or round(length * fs) < 2:
        raise InputError(
            f"rate {rate} or duration {duration} gives no sweep; choose one above zero, of two samples or more."
        )
    t = np.arange(round(length * fs)) / fs
    return amplitude * np.sin(2 * np.pi * (f0 * t + 0.5 * (f1 - f0) / length * t**2))


def prbs(
    n_samples: int, rng: np.random.Generator, *, order: int | None = None, hold: int = 1, amplitude: float = 1.0
) -> np.ndarray:
    """Pseudo-random binary sequence of maximum length, starting at a random place.

    Parameters
    ----------
    n_samples : int
        Samples to make; the sequence repeats after ``hold * (2**order - 1)``.
    rng : numpy.random.Generator
        Draws the start.
    order : int, optional
        Length of the shift register, 2 to 32; by default the shortest that does not repeat within `n_samples`.
    hold : int
        Samples for which each value is held.
    amplitude : float
        The values are ``±amplitude``.

    Returns
    -------
    u : array, (n_samples,)

    Raises
    ------
    InputError
        When a value cannot be used.
    """
    from scipy.signal import max_len_seq

    n_values = -(-count(n_samples, "n_samples") // count(hold, "hold"))
    if order is None:
        order = max(2, int(n_values).bit_length())
    if not 2 <= order <= 32:
        raise InputError(f"the order {order} of the binary sequence lies outside 2 to 32; choose one inside.")
    seed = int(rng.integers(1, 2**order))
    state = np.array([seed >> i & 1 for i in range(order)], dtype=np.int8)
    values, _ = max_len_seq(order, state=state, length=n_values)
    return amplitude * np.repeat(2.0 * values - 1.0, hold)[:n_samples]
