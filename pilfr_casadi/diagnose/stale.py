"""Gate of stale samples: a channel that repeats its last value now and then, where it otherwise never does.

A coarse converter repeats values too, but has few of them, and an encoder where it moves by no more than its step; a
machine at rest repeats one for long, and a clipped channel its limit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..data import Recording
from .gates import Gate

SHARE, DISTINCT, LONGEST = 0.01, 0.5, 5  # of the samples that repeat, values that differ, and samples of one repeat
SLOW = 4.5  # steps of an encoder in a sample, after which it may still have stood
CHANCE = 3.0  # times as many repeats as changes by one step up: noise makes about as many of the one as of the other


def stale_samples(recordings: Sequence[Recording]) -> list[Gate]:
    """A note for each output that repeats samples."""
    found = []
    for i, name in enumerate(recordings[0].outputs):
        values = np.concatenate([r.y[r.skip :, i] for r in recordings])
        levels = np.unique(values)
        step = np.min(np.diff(levels), initial=np.inf)
        repeated = float(np.mean(np.concatenate([_repeated(r.y[r.skip :, i], step) for r in recordings])))
        changes = np.concatenate([np.diff(r.y[r.skip :, i]) for r in recordings])
        up = float(np.mean(np.abs(changes - step) < 0.5 * step))
        if repeated > max(SHARE, CHANCE * up) and len(levels) > DISTINCT * len(values):
            sentence = (
                f"{repeated:.0%} of the samples of {name} repeat the one before, as from lost or stale samples; the "
                "error that this makes is taken for noise: record again, or leave them out."
            )
            found.append(Gate(name, "stale", repeated, sentence, False))
    return found


def stretches(mask: np.ndarray) -> np.ndarray:
    """Begin and end of each stretch of a mask (M,) that is true, shape (n, 2)."""
    return np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]]))).reshape(-1, 2)


def _repeated(y: np.ndarray, step: float) -> np.ndarray:
    """Which samples repeat the one before away from the limits, in runs that are not long and followed by a jump."""
    same = np.append(False, y[1:] == y[:-1]) & (y > np.min(y)) & (y < np.max(y))
    for begin, end in stretches(same):
        if end - begin > LONGEST or abs(y[min(end, len(y) - 1)] - y[begin]) <= SLOW * step:
            same[begin:end] = False
    return same
