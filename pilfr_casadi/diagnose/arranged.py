"""Recordings as a diagnosis takes them: columns in the simulator's order, initial states left open."""

from __future__ import annotations

from typing import Any

from .._base import InputError
from ..data import Recording
from ..simulators import Simulator


def arranged(simulator: Simulator, recording: Recording) -> Recording:
    """A recording with its columns in the simulator's order.

    Raises
    ------
    InputError
        If a column is missing.
    """
    changes: dict[str, Any] = {}
    for names, own, letter in (
        (simulator.inputs, recording.inputs, "u"),
        (simulator.output_names, recording.outputs, "y"),
    ):
        kind = {"u": "input", "y": "output"}[letter]
        for name in names:
            if name not in own:
                raise InputError(
                    f"The recording {recording.label} has no {kind} {name!r}, which the simulator has; "
                    f"it has {', '.join(own) or 'none'}. Map a column to it by name."
                )
        if tuple(own) != tuple(names):
            order = [own.index(name) for name in names]
            values = getattr(recording, letter)[:, order]
            changes |= {letter: values, f"{kind}s": tuple(names)}
    if changes:
        kept = {*changes.get("inputs", recording.inputs), *changes.get("outputs", recording.outputs)}
        changes["units"] = {k: v for k, v in recording.units.items() if k in kept}
    return recording.with_(**changes) if changes else recording


def opened_at_the_start(recording: Recording) -> Recording:
    """A recording that is not on its steady cycle: the initial state is to be estimated."""
    return recording.with_(initial="estimate", period=None) if recording.begins == "periodic" else recording
