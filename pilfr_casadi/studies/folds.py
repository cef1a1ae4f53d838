"""Cross-validation: the training recordings in parts, each held out once.

With at least as many different inputs as folds, whole recordings are dealt out in turn, those of one input together.
With fewer, every recording is cut into as many blocks as there are folds; the state at the beginning of what follows a
cut is estimated, and in a block held out the samples it is estimated from are not scored (`Fit.scored_from`). Where an
input repeats, as in steady periods, blocks would hold out what the rest shows: that is refused.
"""

from __future__ import annotations

from collections.abc import Sequence

from .._base import InputError
from ..data import Recording, group_by_input, repeats_itself

LEAST = 20  # samples of a piece of training


def fold(recordings: Sequence[Recording], k: int, folds: int) -> tuple[tuple[Recording, ...], tuple[Recording, ...]]:
    """What is fitted and what is held out in fold k of `folds`.

    Raises
    ------
    InputError
        If the recordings are too short to be cut, or a block of one has the same input as its other blocks.
    """
    groups = group_by_input(recordings)
    if len(groups) >= folds:
        out = {i for number, group in enumerate(groups) if number % folds == k for i in group}
        dealt = list(enumerate(recordings))
        return tuple(r for i, r in dealt if i not in out), tuple(r for i, r in dealt if i in out)
    train: list[Recording] = []
    held: list[Recording] = []
    for r in recordings:
        first, last = (r.skip + round(share * (len(r) - r.skip) / folds) for share in (k, k + 1))
        if last - first < LEAST:
            raise InputError(f"{r.label} has {len(r)} samples, too few for {folds} folds; give fewer folds.")
        if repeats_itself(r):
            fewer = f"folds = {len(groups)}, " if len(groups) > 1 else ""
            raise InputError(
                f"folds = {folds} was given and the input of {r.label} repeats, so whatever block is held out has the "
                f"input of what is fitted and proves nothing; give {fewer}other realizations, or validation data."
            )
        held.append(r.slice(first, last))
        if k > 0:
            train.append(r.slice(0, first))
        if k < folds - 1:
            train.append(r.slice(last))
    return tuple(train), tuple(held)
