"""How the recordings of a problem are run: from which state, and behind which periods.

The state with memory at the first sample is zero, given, a variable of the problem, or that of the periodic steady
state: the fixed point of one period (`slopes`), or what a given number of periods before the recording leads to.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from .._base import InputError, numbers
from ..data import Recording
from ..engine import Engine
from ..models import Model


@dataclass(frozen=True)
class Part:
    """One recording inside the problem.

    Attributes
    ----------
    recording : Recording
        Its data.
    first : int or None
        The first of its variables, where its initial state is estimated.
    state : array, (n_state,)
        State at its first sample, before any periods that are run before.
    drive, warm_up : array
        What drives it, and the periods before it.
    scale : array, (n_y,)
        What residuals are divided by.
    steady : bool
        Whether it begins at the fixed point of its period, where periods from rest lead.
    """

    recording: Recording
    first: int | None
    state: np.ndarray
    drive: np.ndarray
    warm_up: np.ndarray
    scale: np.ndarray
    steady: bool = False


def lay_out(
    model: Model,
    recordings: Sequence[Recording],
    engine: Engine,
    at: int,
    periods: int | None,
    scales: Sequence[np.ndarray],
) -> Iterator[Part]:
    """Each recording with its first state, which is a variable from index `at` on where it is to be estimated."""
    n_state = model.n_x + model.n_s
    for r, scale in zip(recordings, scales, strict=True):
        zero, drive = np.zeros(n_state), model.drive(r)
        nothing = drive[:0]
        if isinstance(r.initial, str):
            if r.begins == "zero":
                yield Part(r, None, zero, drive, nothing, scale)
            elif r.begins == "estimate":
                yield Part(r, at, zero, drive, nothing, scale)
                at += n_state
            else:
                if r.period is None:
                    raise InputError(
                        "A recording in periodic steady state needs its period in samples; give `period=`."
                    )
                one = drive[: r.period * model.substeps]
                warm_up = _periods_before(model, engine, one, periods)
                yield Part(r, None, zero, drive, warm_up, scale, periods is None)
        else:
            given = np.asarray(r.initial, dtype=float).ravel()
            if given.size not in (len(model.states), n_state):
                raise InputError(
                    f"An initial state of {given.size} numbers was given; expected {len(model.states)} or {n_state}."
                )
            yield Part(r, None, np.concatenate([given, zero[given.size :]]), drive, nothing, scale)


def _periods_before(model: Model, engine: Engine, one: np.ndarray, periods: int | None) -> np.ndarray:
    """What drives the periods before a periodic recording: as many as the start model takes to settle, 2 to 50."""
    state = np.zeros(model.n_x + model.n_s)
    for count in range(1, 51 if periods is None else 1):
        before, state = state, engine.simulate(one, model.parameters.start, state)[1]
        if not np.all(np.isfinite(state)):
            break
        periods = max(count, 2)
        if np.max(np.abs(state - before), initial=0.0) <= 1e-6 * np.max(np.abs(state), initial=0.0):
            break
    return np.tile(one, (periods or 2, 1))


def checked_weights(given: Sequence[float] | np.ndarray | None, count: int) -> np.ndarray:
    """One weight above zero for each recording, ones where none are given."""
    weights = numbers(np.ones(count) if given is None else given, "A weight of a recording").ravel()
    if len(weights) != count or not np.all(weights > 0):
        raise InputError(
            f"{len(weights)} weights from {weights.min(initial=np.inf):g} were given for {count} recordings; give one "
            "above zero for each."
        )
    return weights


def output_scale(recordings: Sequence[Recording]) -> np.ndarray:
    """Standard deviation of each output over all recordings, (n_y,)."""
    return np.std(np.concatenate([r.y[r.skip :] for r in recordings]), axis=0)
