"""Records of one experiment by two loggers on one clock.

Records of two experiments are not joined end to end, because the state would jump between them: `fit` and `diagnose`
take them as a list.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .._base import InputError, is_number, listed, positive
from .preprocessing import sample_at
from .recording import SAME_STEP, Recording

Names = Sequence[str] | str | None


def merge(
    first: Recording,
    second: Recording,
    *,
    dt: float | None = None,
    start: float = 0.0,
    inputs: Names = None,
    outputs: Names = None,
) -> Recording:
    """Put the channels of two records of one experiment on one clock, over the time that both cover.

    Name, initial state and skipped samples are those of the first record; an initial state stays only if the common
    time begins with the first record. Where an input was resampled, it is no longer held between samples, and `hold`
    becomes `"linear"` if it was said.

    Parameters
    ----------
    first, second : Recording
    dt : float, optional
        Common step in seconds; the longer of both by default. An anti-alias filter precedes a longer step.
    start : float
        Time of the second record's first sample on the clock of the first, in seconds; it may be negative.
    inputs, outputs : names, optional
        Channels of both that are inputs and outputs; by default each keeps its role.

    Raises
    ------
    InputError
        If both have a channel of the same name, a name is unknown, or fewer than two samples are common.
    """
    for r in (first, second):
        if not isinstance(r, Recording):
            raise InputError(f"a {type(r).__name__} was given to merge; give two Recordings.")
    twice = sorted({*first.inputs, *first.outputs} & {*second.inputs, *second.outputs})
    if twice:
        raise InputError(f"both recordings have a channel {twice[0]!r}; rename one of them before you merge.")
    if not is_number(start) or not np.isfinite(start):
        raise InputError(f"start={start!r} was given; give the time of the second record's first sample in seconds.")
    step = max(first.dt, second.dt) if dt is None else positive(dt, "dt", "the common step in seconds")
    begin, end = max(0.0, start), min(first.t[-1], start + second.t[-1])
    times = begin + np.arange(int(np.floor(max(end - begin, 0.0) / step + SAME_STEP)) + 1) * step
    if end < begin or len(times) < 2:
        raise InputError(f"the recordings have fewer than 2 samples of {step:g} s in common; check start and dt.")
    signals: dict[str, np.ndarray] = {}
    for r, offset in ((first, 0.0), (second, start)):
        values = sample_at(np.hstack([r.u, r.y]), r.dt, times - offset, step)
        signals |= dict(zip((*r.inputs, *r.outputs), values.T, strict=True))
    u, y = (_chosen(inputs, first.inputs + second.inputs), _chosen(outputs, first.outputs + second.outputs))
    for name in (*u, *y):
        if name not in signals:
            raise InputError(f"the two recordings have no channel {name!r}; they have {listed(list(signals))}.")
    as_sampled = begin == 0 and step == first.dt and (step == second.dt or not second.n_u)
    keeps = begin == 0 and first.begins != "periodic"
    return replace(
        first,
        u=_columns(signals, u, len(times)),
        y=_columns(signals, y, len(times)),
        dt=step,
        inputs=u,
        outputs=y,
        units={name: unit for name, unit in {**second.units, **first.units}.items() if name in {*u, *y}},
        period=None,
        initial=first.initial if keeps else "estimate",
        hold=first.hold if as_sampled or not first.hold else "linear",
        skip=min(max(int(np.ceil((first.skip * first.dt - begin) / step - SAME_STEP)), 0), len(times) - 1),
    )


def _chosen(given: Names, default: tuple[str, ...]) -> tuple[str, ...]:
    return default if given is None else (given,) if isinstance(given, str) else tuple(given)


def _columns(signals: dict[str, np.ndarray], names: tuple[str, ...], count: int) -> np.ndarray:
    return np.column_stack([np.empty((count, 0)), *(signals[name] for name in names)])
