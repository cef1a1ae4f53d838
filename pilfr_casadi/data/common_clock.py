"""Merge the records that two loggers made of one experiment.

Records of two experiments are not joined end to end, because the state would jump between them: `fit` and `diagnose`
take them as a list.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .._base import InputError, is_number, listed, positive
from .holds import COURSES, becomes_mean, hold_at
from .preprocessing import common_times, sample_at
from .recording import SAME_STEP, Recording, as_tuple

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

    Name, initial state and skipped samples come from the first record. The initial state is kept only if the common
    time begins with the first record. The hold comes from the records whose channels are inputs; if theirs differ, it
    is `"linear"`. If all inputs are held (`hold="zero"`) and their levels usually last at least a new step, an input
    becomes its mean over each new step, and is held; else it becomes `"linear"`, unless no input was resampled. If all
    inputs have their next value (`hold="next"`), each becomes its mean over the new step that ends at each sample.

    Parameters
    ----------
    first, second : Recording
    dt : float, optional
        Common step in seconds; by default the longer step. An anti-alias filter precedes a longer step.
    start : float
        Time of the second record's first sample on the clock of the first, in seconds; it may be negative.
    inputs, outputs : names, optional
        Channels of the result that are inputs and outputs; by default each channel keeps its role.

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
    try:
        times = common_times([(0.0, first.t[-1]), (start, start + second.t[-1])], step)
    except InputError:
        raise InputError(
            f"the recordings have fewer than 2 samples of {step:g} s in common; check start and dt."
        ) from None
    u = first.inputs + second.inputs if inputs is None else as_tuple(inputs)
    y = first.outputs + second.outputs if outputs is None else as_tuple(outputs)
    known = [*first.inputs, *first.outputs, *second.inputs, *second.outputs]
    for name in (*u, *y):
        if name not in known:
            raise InputError(f"the two recordings have no channel {name!r}; they have {listed(known)}.")
    begin = times[0]
    sources = [(r, at) for r, at in ((first, begin), (second, begin - start)) if {*u} & {*r.inputs, *r.outputs}]
    holds = {r.hold for r, _ in sources if r.hold}
    hold = "linear" if len(holds) > 1 else next(iter(holds), None)
    means = len(holds) == 1 and all(_is_held(first, name, step) or _is_held(second, name, step) for name in u)
    held = u if means else ()
    signals = {**_signals_at(first, times, step, held), **_signals_at(second, times - start, step, held)}
    as_sampled = bool(held) or all(_is_at_samples(r, at, step) for r, at in sources)
    keeps_initial = begin == 0 and first.begins != "periodic"
    return replace(
        first,
        u=_stack_columns(signals, u, len(times)),
        y=_stack_columns(signals, y, len(times)),
        dt=step,
        inputs=u,
        outputs=y,
        units={name: unit for name, unit in {**second.units, **first.units}.items() if name in {*u, *y}},
        period=None,
        start=first.start + begin,
        initial=first.initial if keeps_initial else "estimate",
        hold="linear" if hold and COURSES[hold].constant and not as_sampled else hold,
        skip=min(max(int(np.ceil((first.skip * first.dt - begin) / step - SAME_STEP)), 0), len(times) - 1),
    )


def _is_at_samples(r: Recording, begin: float, step: float) -> bool:
    """Tell whether times of a step from `begin` on, in s after a recording's first sample, are among its samples."""
    return step == r.dt and abs(begin / step - round(begin / step)) < SAME_STEP


def _is_held(r: Recording, name: str, step: float) -> bool:
    """Tell whether a channel is an input that becomes its mean: at its next value, or held for at least a step."""
    return name in r.inputs and becomes_mean(r.hold, r.t, r.u[:, r.inputs.index(name)], step)


def _signals_at(r: Recording, times: np.ndarray, step: float, held: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the channels of a recording at times in s after its first sample, by name."""
    names = (*r.inputs, *r.outputs)
    values = np.hstack([r.u, r.y])
    signals = dict(zip(names, sample_at(values, r.dt, times, step).T, strict=True))
    return signals | {n: hold_at(r.t, values[:, i], times, step, r.hold) for i, n in enumerate(names) if n in held}


def _stack_columns(signals: dict[str, np.ndarray], names: tuple[str, ...], count: int) -> np.ndarray:
    """Stack named signals as columns, (count, n); n may be 0."""
    return np.column_stack([np.empty((count, 0)), *(signals[name] for name in names)])
