"""Recordings as a diagnosis takes them: initial states left open."""

from __future__ import annotations

from ..data import Recording


def opened_at_the_start(recording: Recording) -> Recording:
    """A recording that is not on its steady cycle: the initial state is to be estimated."""
    return recording.with_(initial="estimate", period=None) if recording.begins == "periodic" else recording
