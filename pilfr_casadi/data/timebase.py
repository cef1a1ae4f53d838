"""The step of a time column: seconds, increasing, uniform; or one sentence that says where it is not.

A grid is uniform if no sample is further than ``tolerance`` steps from ``t(0) + k dt``, beyond the rounding to the
digits written: a grid of 1/120 s written with six decimals is uniform.
"""

import re
from collections.abc import Callable, Sequence

import numpy as np

from .._base import InputError, listed

TIME_NAMES = ("t", "t_s", "time")
TOLERANCE = 1e-4  # steps that a sample may lie off the grid; the clocks of recorders do not drift by more in a record
AGREEMENT = 1e-3  # relative difference between a stated step and the written times; another unit differs by far more
_UNITS = r"ns|us|µs|μs|ms|min|h|d|nanoseconds?|microseconds?|milliseconds?|minutes?|hours?|days?"
_OTHER_UNIT = re.compile(rf"(?:t|time)[\s_\-\[(]+({_UNITS})[\])]?", re.IGNORECASE)


def time_column(names: Sequence[str], chosen: str | None, source: str) -> str | None:
    """Find the time column among the names; None where there is none.

    Parameters
    ----------
    names : sequence of str
        The columns of the file.
    chosen : str, optional
        The column that the user named for the time.
    source : str
        File name, for messages.

    Raises
    ------
    InputError
        If the choice is missing or states another unit, or there are several time columns.
    """
    found = [chosen] if chosen is not None else [name for name in TIME_NAMES if name in names]
    if not found:
        return None
    if len(found) > 1:
        raise InputError(
            f"{source} has several time columns ({', '.join(found)}); say which one, as in "
            f"columns={{'t': '{found[0]}'}}."
        )
    if found[0] not in names:
        raise InputError(f"{source} has no column {found[0]!r} for the time; its columns are {listed(names)}.")
    refuse_other_unit(found, source)
    return found[0]


def refuse_other_unit(names: Sequence[str], source: str) -> None:
    """Raise :class:`InputError` if a name such as ``t_ms`` or ``Time [min]`` states a unit other than seconds."""
    for name in names:
        unit = _OTHER_UNIT.fullmatch(name.strip())
        if unit:
            raise InputError(
                f"{source}: column {name!r} is time in {unit.group(1)} by its name, but time must be in seconds; "
                "convert it and name it t_s, or leave it out and state the step in seconds with dt=STEP."
            )


def step_of(
    t: np.ndarray,
    column: str,
    place: Callable[[int], str],
    *,
    dt: float | None = None,
    tolerance: float | None = None,
) -> float:
    """Return the step of a uniform time grid, in seconds.

    Parameters
    ----------
    t : array, (M,)
        Times in seconds, finite.
    column : str
        Name of the column, with its file, for messages.
    place : callable
        Returns the place of sample ``k`` in the file, e.g. ``"line 17"``.
    dt : float, optional
        Stated step; it must agree with the times and is returned in their place.
    tolerance : float, optional
        Allowed deviation from the grid in steps, beyond rounding; `TOLERANCE` by default.

    Raises
    ------
    InputError
        If time does not increase, is not uniform, or its step is not the stated one.
    """
    if len(t) < 2:
        raise InputError(f"{column} has only one sample; at least 2 are needed.")
    gaps = np.diff(t)
    back = np.flatnonzero(gaps <= 0)
    if back.size:
        k = int(back[0]) + 1
        raise InputError(
            f"{column}: {place(k)} is {t[k]:.10g} s, after {t[k - 1]:.10g} s; time must increase from sample to sample."
        )
    step = (t[-1] - t[0]) / (len(t) - 1)
    deviation = np.abs(t - t[0] - np.arange(len(t)) * step)
    allowed = (TOLERANCE if tolerance is None else tolerance) * step
    if (deviation > allowed).any() and (deviation > allowed + _rounding(t, step)).any():
        usual = float(np.median(gaps))
        odd = np.abs(gaps - usual)
        k = int(np.argmax(odd > 0.5 * odd.max())) + 1
        raise InputError(
            f"{column} is not uniform: {place(k)} comes {gaps[k - 1]:.6g} s after the sample before it where "
            f"{usual:.6g} s is usual, and samples lie up to {deviation.max() / step:.2g} steps off a uniform grid; "
            "resample, or allow more with time_tolerance=STEPS."
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


def _rounding(t: np.ndarray, step: float) -> np.ndarray:
    """Bound how far samples may lie off the grid because written times are rounded, (M,), in seconds.

    Times are rounded to D decimals or to S significant digits, whichever is coarser at a sample; the error of the last
    time turns the grid. The bound is at most a tenth of a step, so that it never hides a missing sample.
    """
    size = np.abs(t)
    exponent = np.floor(np.log10(size, where=size > 0, out=np.full(len(t), -np.inf)))
    exponent[~np.isfinite(exponent)] = exponent[np.isfinite(exponent)].min()
    digits = _fewest(lambda n: size * 10.0 ** (n - 1 - exponent))
    decimals = _fewest(lambda n: size * 10.0**n)
    own = 0.5 * np.maximum(10.0 ** (exponent + 1 - digits), 10.0**-decimals)
    return np.minimum(own + own[0] + own[-1], 0.1 * step)


def _fewest(scaled: Callable[[float], np.ndarray]) -> float:
    """Return the smallest n for which all scaled times are whole numbers; infinite where they are not rounded."""
    for n in range(15):
        times = scaled(float(n))
        near = np.abs(times - np.rint(times)) <= 4 * np.finfo(float).eps * np.abs(times)
        if near.all():
            return float(n)
    return np.inf
