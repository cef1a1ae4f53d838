"""How the recordings of a problem are run: from which state, and behind which periods.

The state with memory at the first sample is zero, given, a variable of the problem, or that of the periodic steady
state, which is reached by running periods before the recording.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from .model import Model
from .recording import InputError, Recording
from .sensitivities import Engine


@dataclass(frozen=True)
class Part:
    """One recording inside the problem: its first variable (or None), what drives it, and what is run before it."""

    recording: Recording
    first: int | None
    state: np.ndarray
    drive: np.ndarray
    warm_up: np.ndarray


def lay_out(
    model: Model, recordings: Sequence[Recording], engine: Engine, at: int, periods: int | None
) -> Iterator[Part]:
    """Each recording with its first state, which is a variable from index `at` on where it is to be estimated."""
    n_state = model.n_x + model.n_s
    for r in recordings:
        zero, drive = np.zeros(n_state), model.drive(r)
        nothing = drive[:0]
        if isinstance(r.initial, str):
            if r.initial == "zero":
                yield Part(r, None, zero, drive, nothing)
            elif r.initial == "estimate":
                yield Part(r, at, zero, drive, nothing)
                at += n_state
            else:
                if r.period is None:
                    raise InputError(
                        "A recording in periodic steady state needs its period in samples; give `period=`."
                    )
                one = drive[: r.period * model.substeps]
                yield Part(r, None, zero, drive, _periods_before(model, engine, one, periods))
        else:
            given = np.asarray(r.initial, dtype=float).ravel()
            if given.size not in (len(model.states), n_state):
                raise InputError(
                    f"An initial state of {given.size} numbers was given; expected {len(model.states)} or {n_state}."
                )
            yield Part(r, None, np.concatenate([given, zero[given.size :]]), drive, nothing)


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
