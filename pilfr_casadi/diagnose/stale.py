"""Gate of stale samples: a channel that repeats its last value now and then, where it otherwise never does.

A coarse converter repeats values too, but has few of them; a machine at rest repeats one for long.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..recording import Recording
from .gates import Gate

SHARE, DISTINCT, LONGEST = 0.01, 0.5, 5  # of the samples that repeat, values that differ, and samples of one repeat


def stale_samples(recordings: Sequence[Recording]) -> list[Gate]:
    """A note for each output that repeats samples."""
    found = []
    for i, name in enumerate(recordings[0].outputs):
        repeated = float(np.mean(np.concatenate([_repeated(r.y[r.skip :, i]) for r in recordings])))
        values = np.concatenate([r.y[r.skip :, i] for r in recordings])
        if repeated > SHARE and len(np.unique(values)) > DISTINCT * len(values):
            sentence = (
                f"{repeated:.0%} of the samples of {name} repeat the one before, as from lost or stale samples; the "
                "error that this makes is taken for noise: record again, or leave them out."
            )
            found.append(Gate(name, "stale", repeated, sentence, False))
    return found


def _repeated(y: np.ndarray) -> np.ndarray:
    """Which samples repeat the one before, in runs that are not long."""
    same = np.append(False, y[1:] == y[:-1])
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same.astype(int), [0]])))
    for begin, end in edges.reshape(-1, 2):
        if end - begin > LONGEST:
            same[begin:end] = False
    return same
