"""A model run along a recording: what observers and inverses are made from, whatever the model is.

A fit has a step of its own; a simulator is taken with the recording's step and hold; a diagnosis is its corrected
simulator, in steps and sub-steps as fitted; an export is what it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import casadi as ca
import numpy as np

from .._base import LARGEST, InputError
from ..data import Recording
from ..export import Exported, exported
from ..identify import Fit
from ..simulators import Simulator

Array = np.ndarray


class Corrected(Protocol):
    """A diagnosis, as far as it is needed here."""

    @property
    def corrected(self) -> Simulator:
        """The corrected simulator."""

    def export(self, **options: Any) -> Any:
        """Its step."""


Observable = Fit | Corrected | Simulator | Exported


@dataclass(frozen=True, eq=False)
class Along:
    """A model and its free run.

    Attributes
    ----------
    function : casadi.Function
        `(x, u) -> (x_next, y)`.
    names : tuple of str
        Of the entries of u: where inputs are interpolated, those of the next sample follow.
    u, y : array, shape (M, n_u), (M, n_y)
        What the steps read, and the outputs.
    states : array, shape (n, M + 1)
        States before each sample and after the last.
    linear : array of int
        Entries of x that are neither operators' memory nor the time.
    clock : array of int
        The entry that is the time, where there is one.
    scored : int
        First sample of the recording that counts.
    """

    function: ca.Function
    names: tuple[str, ...]
    u: Array
    y: Array
    states: Array
    linear: Array
    clock: Array
    scored: int


def exported_for(given: Any, recording: Recording, verb: str) -> Exported:
    """The step of a fit, a diagnosis, a simulator or an export, beginning where the recording begins.

    Raises
    ------
    InputError
        If it is none of these, or does not fit the recording; `verb` says what it was given to.
    """
    diagnosed = not isinstance(given, type) and isinstance(getattr(given, "corrected", None), Simulator)
    if not (isinstance(given, Fit | Simulator | Exported) or diagnosed):
        raise InputError(
            f"A {type(given).__name__} was given to {verb}; give a Fit, a Diagnosis, a Simulator or an export."
        )
    if not isinstance(recording, Recording) or not len(recording):
        raise InputError(f"A {type(recording).__name__} was given to {verb}; give a Recording of the machine.")
    if isinstance(given, Exported):
        own, n = given, recording.n_u
        if (own.inputs[:n], own.outputs) != (recording.inputs, recording.outputs) or (
            abs(own.dt / recording.dt - 1) > 1e-4
        ):
            raise InputError(
                f"The export steps by {own.dt:g} s from {', '.join(own.inputs)} to {', '.join(own.outputs)}, the "
                f"recording by {recording.dt:g} s from {', '.join(recording.inputs)} to "
                f"{', '.join(recording.outputs)}; they must be the same."
            )
        return own
    if isinstance(given, Simulator):
        return exported(given, dt=recording.dt, hold=recording.hold, start=recording)
    return exported(given, start=recording)


def along(given: Any, recording: Recording, verb: str) -> Along:
    """Run what `exported_for` gives along a recording.

    Raises
    ------
    InputError
        As `exported_for`, or if the run diverges.
    """
    model = exported_for(given, recording, verb)
    u = recording.u
    if len(model.inputs) > recording.n_u:
        u = np.hstack([u, np.vstack([u[1:], u[-1:]])])
    start = model.x0()
    following, y = (np.asarray(v) for v in model.step.mapaccum("along", len(u))(start, u.T))
    counted = given.scored_from(recording) if isinstance(given, Fit) else recording.skip
    if not (np.all(np.abs(following) < LARGEST) and np.all(np.abs(y[:, counted:]) < LARGEST)):
        raise InputError(
            f"The model diverges along the recording, so {verb} can make nothing of it; give one that is stable."
        )
    held = {model.states[name] for name in model.sampled.held}
    clock = len(model.states) - 1 if model.sampled.timed else -1
    linear = [i for i in range(len(model.states)) if i not in held and i != clock]
    return Along(
        function=model.step,
        names=model.inputs,
        u=u,
        y=y.T,
        states=np.column_stack([start, following]),
        linear=np.array(linear, dtype=int),
        clock=np.array([clock] if clock >= 0 else [], dtype=int),
        scored=counted,
    )
