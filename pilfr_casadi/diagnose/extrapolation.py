"""Tell where test recordings go beyond the training recordings: in the range of a channel, or in frequency.

There, errors on the test recordings show how the corrected simulator extrapolates.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from .._base import in_words, percent
from ..data import Recording
from .faults.gates import Gate, value_with_unit
from .fits.evidence import BEYOND_RANGE, NEW_DENSITY, NEW_SHARE
from .fits.workbench import Workbench

ROUNDED = 1e-6  # change of a channel, over its size, that counts as none
LONGEST_SEGMENT = 512  # samples from which a spectral density is computed


def range_note(bench: Workbench, tests: Sequence[Recording]) -> Iterator[Gate]:
    """Note the channels of the test recordings with values or frequencies that the training recordings do not have."""
    simulator, trained, words = bench.simulator, bench.recordings, list[str]()
    names = (*simulator.inputs, *simulator.output_names)
    both = (np.concatenate([np.hstack([r.u, r.y])[r.skip :] for r in each]) for each in (trained, tests))
    for i, value, limit in ranges_left(*both):
        reached, known = (value_with_unit(v, bench.unit_of(names[i])) for v in (value, limit))
        words.append(f"{names[i]} reaches {reached} ({known} in training)")
    for i, name in enumerate(simulator.inputs):
        before, now = ([r.u[r.skip :, i] for r in each] for each in (trained, tests))
        share = share_at_new_frequencies(before, now, bench.dt)
        if share > NEW_SHARE:
            words.append(f"{percent(share)} of {name} is at frequencies that it hardly has in training")
    if words:
        advice = "There the corrected simulator extrapolates; train it on recordings like these, too."
        sentence = f"The test recordings go beyond the training recordings: {in_words(words)}. {advice}"
        yield Gate("recordings", "test range", None, sentence, False)


def ranges_left(trained: np.ndarray, tested: np.ndarray) -> list[tuple[int, float, float]]:
    """Find channels that leave their trained range by more than a tenth: number, farthest value, limit of the range.

    Both signals have one column for each channel.
    """
    found = []
    for i, (known, signal) in enumerate(zip(trained.T, tested.T, strict=True)):
        low, high, least, most = (float(f(x)) for x in (known, signal) for f in (np.min, np.max))
        value, limit = (most, high) if most - high > low - least else (least, low)
        beyond = max(most - high, low - least)
        if beyond > max(BEYOND_RANGE * (high - low), ROUNDED * max(abs(low), abs(high))):
            found.append((i, value, limit))
    return found


def share_at_new_frequencies(trained: Sequence[np.ndarray], tested: Sequence[np.ndarray], dt: float) -> float:
    """Compute the share of a signal's variance at frequencies that have 100 times less of the trained one's variance.

    Each signal has one array (M,) for each recording.
    """
    from scipy.signal import welch

    if all(np.ptp(u) <= ROUNDED * np.max(np.abs(u)) for u in tested):
        return 0.0
    length = min(LONGEST_SEGMENT, *map(len, trained), *map(len, tested))
    known, now = (
        np.average([welch(u, 1 / dt, nperseg=length)[1] for u in signals], axis=0, weights=[len(u) for u in signals])
        for signals in (trained, tested)
    )
    known, now = (density / max(np.sum(density), 1e-300) for density in (known, now))
    return float(np.sum(now[known < NEW_DENSITY * now]))
