"""The step of written times: a uniform grid up to the rounding of their digits."""

from collections.abc import Callable

import numpy as np

from .._base import InputError
from .preprocessing import LONGEST_GAP

TOLERANCE = 1e-4  # allowed deviation of a sample from the grid, in steps; recorders' clocks drift less in a record
MOST_ROUNDING = 0.1  # largest rounding of a time, in steps; more could hide a missing sample
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
            f"{column}: {place(k)} is {t[k]:.10g} s, after {t[k - 1]:.10g} s; "
            + (_say_too_coarse(t) or "time must increase from sample to sample.")
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
            + (_say_too_coarse(t) or _say_what_to_do(gaps.max() > LONGEST_GAP * median))
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


def _say_what_to_do(has_gap: bool) -> str:
    if has_gap:
        return "cut the record at such gaps."
    return "resample with resample=STEP, or allow more with time_tolerance=STEPS."


def _say_too_coarse(t: np.ndarray) -> str:
    """Say what to do if the precision in which times are stored is too coarse for their step; empty if it is not."""
    spacing, step = float(np.max(_spacing(t))), float(np.ptp(t)) / (len(t) - 1)
    if step == 0 or spacing <= MOST_ROUNDING * step:
        return ""
    return (
        f"times up to {np.max(np.abs(t)):.6g} s are stored to {spacing:.2g} s only, too coarse for their step; give "
        "them as float64, or count them from the start of the recording."
    )


def _spacing(t: np.ndarray) -> np.ndarray:
    """Return the distances between neighbouring numbers at stored times; in single precision if all times have it."""
    with np.errstate(over="ignore"):
        single = t.astype(np.float32)
    stored = single if np.array_equal(single, t) else t
    return np.asarray(np.spacing(np.abs(stored)), dtype=float)


def _bound_rounding(t: np.ndarray, step: float) -> np.ndarray:
    """Bound the deviation of samples from the grid by the rounding of written times, (M,), in seconds.

    Times are rounded to D decimals, to S significant digits, or to the precision in which they are stored, whichever is
    coarser at a sample. The errors of the first and last time shift and stretch the grid. The bound is at most a tenth
    of a step, so it never hides a missing sample.
    """
    size = np.abs(t)
    exponent = np.floor(np.log10(size, where=size > 0, out=np.full(len(t), -np.inf)))
    exponent[~np.isfinite(exponent)] = exponent[np.isfinite(exponent)].min()
    digits = _count_digits(lambda n: size * 10.0 ** (n - 1 - exponent))
    decimals = _count_digits(lambda n: size * 10.0**n)
    own = 0.5 * np.maximum(np.maximum(10.0 ** (exponent + 1 - digits), 10.0**-decimals), _spacing(t))
    return np.minimum(own + own[0] + own[-1], MOST_ROUNDING * step)


def _count_digits(scaled: Callable[[float], np.ndarray]) -> float:
    """Return the smallest n for which all scaled times are whole numbers; infinite if there is none below 15."""
    for n in range(15):
        times = scaled(float(n))
        near = np.abs(times - np.rint(times)) <= 4 * np.finfo(float).eps * np.abs(times)
        if near.all():
            return float(n)
    return np.inf
