"""The step of written times: a uniform grid up to the rounding of their digits."""

from collections.abc import Callable

import numpy as np

from .._base import InputError
from .preprocessing import LONGEST_GAP

TOLERANCE = 1e-4  # allowed deviation of a sample from the grid, in steps; recorders' clocks drift less in a record
AGREEMENT = 1e-3  # allowed relative difference of a stated step from the times; a wrong unit differs by far more


def step_of(
    t: np.ndarray,
    column: str,
    place: Callable[[int], str],
    *,
    dt: float | None = None,
    tolerance: float | None = None,
) -> float:
    """Return the step of a uniform time grid, in seconds.

    A grid is uniform if every sample is within `tolerance` steps of ``t(0) + k dt``, plus the rounding of the written
    digits: a grid of 1/120 s written with six decimals is uniform. A stated step `dt` must agree with the times, and is
    returned as it is. For messages, `column` names the file and the column, and `place` returns the place of a sample,
    such as ``"line 17"``.
    """
    if len(t) < 2:
        raise InputError(f"{column} has only one sample; at least 2 are needed.")
    gaps = np.diff(t)
    if np.any(gaps <= 0):
        k = int(np.argmax(gaps <= 0)) + 1
        raise InputError(
            f"{column}: {place(k)} is {t[k]:.10g} s, after {t[k - 1]:.10g} s; time must increase from sample to sample."
        )
    step = (t[-1] - t[0]) / (len(t) - 1)
    deviation = np.abs(t - t[0] - np.arange(len(t)) * step)
    allowed = (TOLERANCE if tolerance is None else tolerance) * step
    if (deviation > allowed).any() and (deviation > allowed + _bound_rounding(t, step)).any():
        median = float(np.median(gaps))
        error = np.abs(gaps - median)
        k = int(np.argmax(error > 0.5 * error.max())) + 1
        raise InputError(
            f"{column} is not uniform: {place(k)} comes {gaps[k - 1]:.6g} s after the sample before it where "
            f"{median:.6g} s is usual, and samples lie up to {deviation.max() / step:.2g} steps off a uniform grid; "
            + (
                "cut the record at such gaps."
                if gaps.max() > LONGEST_GAP * median
                else "resample with resample=STEP, or allow more with time_tolerance=STEPS."
            )
        )
    step = float(f"{step:.12g}")
    if dt is None:
        return step
    if abs(step - dt) > AGREEMENT * dt:
        raise InputError(
            f"{column} has a step of {step:.6g} s, but dt={dt:.6g} was stated, a ratio of {step / dt:.4g}; "
            "time must be in seconds, so check its unit."
        )
    return float(dt)


def _bound_rounding(t: np.ndarray, step: float) -> np.ndarray:
    """Bound the deviation of samples from the grid by the rounding of written times, (M,), in seconds.

    Times are rounded to D decimals or to S significant digits, whichever is coarser at a sample. The errors of the
    first and last time shift and stretch the grid. The bound is at most a tenth of a step, so it never hides a missing
    sample.
    """
    size = np.abs(t)
    exponent = np.floor(np.log10(size, where=size > 0, out=np.full(len(t), -np.inf)))
    exponent[~np.isfinite(exponent)] = exponent[np.isfinite(exponent)].min()
    digits = _count_digits(lambda n: size * 10.0 ** (n - 1 - exponent))
    decimals = _count_digits(lambda n: size * 10.0**n)
    own = 0.5 * np.maximum(10.0 ** (exponent + 1 - digits), 10.0**-decimals)
    return np.minimum(own + own[0] + own[-1], 0.1 * step)


def _count_digits(scaled: Callable[[float], np.ndarray]) -> float:
    """Return the smallest n for which all scaled times are whole numbers; infinite if there is none below 15."""
    for n in range(15):
        times = scaled(float(n))
        near = np.abs(times - np.rint(times)) <= 4 * np.finfo(float).eps * np.abs(times)
        if near.all():
            return float(n)
    return np.inf
