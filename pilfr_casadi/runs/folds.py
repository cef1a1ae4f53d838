"""Cross-validation: the training recordings in parts, each held out once.

With at least as many recordings as folds, whole recordings are dealt out in turn. With fewer, every recording is cut
into as many blocks as there are folds; the state at the beginning of what follows a cut is estimated, and in a block
held out the samples it is estimated from are not scored (`Fit.scored_from`).
"""

from __future__ import annotations

from collections.abc import Sequence

from ..recording import InputError, Recording

LEAST = 20  # samples of a piece of training


def fold(recordings: Sequence[Recording], k: int, folds: int) -> tuple[tuple[Recording, ...], tuple[Recording, ...]]:
    """What is fitted and what is held out in fold k of `folds`.

    Raises
    ------
    InputError
        If the recordings are too short to be cut.
    """
    if len(recordings) >= folds:
        dealt = list(enumerate(recordings))
        return tuple(r for i, r in dealt if i % folds != k), tuple(r for i, r in dealt if i % folds == k)
    train: list[Recording] = []
    held: list[Recording] = []
    for r in recordings:
        first, last = (r.skip + round(share * (len(r) - r.skip) / folds) for share in (k, k + 1))
        if last - first < LEAST:
            raise InputError(f"{r.label} has {len(r)} samples, too few for {folds} folds; give fewer folds.")
        held.append(r.slice(first, last))
        if k > 0:
            train.append(r.slice(0, first))
        if k < folds - 1:
            train.append(r.slice(last))
    return tuple(train), tuple(held)
