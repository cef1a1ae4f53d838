"""Inputs between samples: the holds that a recording may state, and what each of them does.

A `Course` says for each hold which samples act between two samples; code that integrates, resamples or exports asks it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from .._base import InputError

Array = np.ndarray

Hold = Literal["zero", "linear", "band-limited", "next"]
HOLDS: tuple[Hold, ...] = get_args(Hold)
HOLD_CHOICES = f"{', '.join(map(repr, HOLDS[:-1]))} or {HOLDS[-1]!r}"  # in messages
INTERPOLATION_REACH = 10  # samples on each side that an interpolated value depends on
INTERPOLATION_WINDOW = ("kaiser", 8.0)  # of the sine cardinal: 80 dB of attenuation
SAME_TIME = 1e-4  # difference of two times in steps up to which they count as the same; written times have few digits


@dataclass(frozen=True)
class Course:
    """Course of inputs from one sample to the next.

    Attributes
    ----------
    words : str
        Completes the sentence "between samples the inputs are ...".
    begin, end : int
        The sample, 0 or 1, whose value acts just after sample 0, and just before sample 1.
    """

    words: str
    begin: int
    end: int

    @property
    def constant(self) -> bool:
        """Whether inputs do not change between samples."""
        return self.begin == self.end

    def between(self, now: Array, after: Array, share: Array) -> Array:
        """Return the inputs (M, n) at a share of the step (M, 1), from those of the earlier and of the later sample.

        At its own sample an input always has its own value. Band-limited inputs depend on further samples:
        `interpolate_band_limited`.
        """
        if not self.constant:
            return now + (after - now) * share
        return np.where(share > 0, after, now) if self.begin else now


COURSES: dict[str, Course] = {
    "zero": Course("held", 0, 0),
    "linear": Course("interpolated", 0, 1),
    "band-limited": Course("band-limited", 0, 1),
    "next": Course("at their next value", 1, 1),
}


def known_hold(hold: Any, role: str = "hold") -> str | None:
    """Return a hold, None if it is not known; refuse anything else. `role` names it in the message."""
    if hold is not None and not (isinstance(hold, str) and hold in HOLDS):
        raise InputError(f"{role} is {hold!r}; give {HOLD_CHOICES}, or None.")
    return hold


def step_hold(hold: str) -> str:
    """Return the hold of a step that knows the samples at its two ends alone: band-limited inputs are linear there."""
    return "linear" if hold == "band-limited" else hold


def becomes_mean(hold: str | None, t: Array, values: Array, step: float) -> bool:
    """Tell whether an input (M,) at times t becomes its mean over a new step: at its next value, or held for a step."""
    course = COURSES[hold or "linear"]
    return course.constant and bool(course.begin or levels_last(t, values, step))


def levels_last(t: Array, values: Array, step: float) -> bool:
    """Tell whether the levels of a held signal (M,) usually last at least a step, so that its means keep its course.

    A few shorter ones, as where the clock of a logger jitters, do not count: the means keep their integrals.
    """
    changes = t[1:][np.diff(values) != 0]
    return len(changes) < 2 or bool(np.median(np.diff(changes)) > step * (1 - SAME_TIME))


def hold_at(t: Array, values: Array, times: Array, step: float, hold: str | None = "zero") -> Array:
    """Return the mean of a signal (M,), held from each of its times t to the next, over the step after each of `times`.

    With `hold="next"` each value has been held since the time before, and the means are those over the step before each
    of `times`. The means keep the signal's integral; a value that is held throughout a step is kept.
    """
    if hold == "next":  # the same, backwards in time
        return hold_at(-t[::-1], values[::-1], -times[::-1], step)[::-1]
    changes = np.append(True, np.diff(values) != 0)
    t, values = t[changes], values[changes]
    known = np.append(t, max(t[-1], times[-1]) + 2 * step)
    integral = np.append(0.0, np.cumsum(values * np.diff(known)))
    means = np.diff(np.interp(np.append(times, times[-1] + step), known, integral)) / step
    first, last = (np.searchsorted(t, times + share * step, "right") - 1 for share in (SAME_TIME, 1 - SAME_TIME))
    return np.where(first == last, values[first], means)  # without rounding where the signal keeps its value


def interpolate_band_limited(values: Array, n: int, period: int | None = None) -> Array:
    """Interpolate band-limited signals (M, k) at n points a sample; return (n M + 1, k), the samples unchanged.

    The signals have no content above half the sampling rate, as behind an anti-alias filter. With `period`, in samples,
    they repeat, so that the whole curve is known; else they are reflected in their first and last points, near which
    the curve is uncertain.
    """
    from scipy.signal import firwin, upfirdn

    reach, count = INTERPOLATION_REACH, len(values)
    if period:
        more = values[np.arange(-reach, count + reach + 1) % period]
        more[reach : reach + count] = values
    else:
        more = np.pad(values, ((reach, reach + 1), (0, 0)), "reflect", reflect_type="odd")
    if n == 1:
        return np.asarray(more[reach : reach + count + 1])
    taps = firwin(2 * reach * n + 1, 1 / n, window=INTERPOLATION_WINDOW)
    for k in range(n):  # a constant stays one, however large
        taps[k::n] /= np.sum(taps[k::n])
    fine = upfirdn(taps, more, n, axis=0)[reach * n :]
    fine[: n * len(more) : n] = more
    return np.asarray(fine[n * reach : n * (reach + count) + 1])
