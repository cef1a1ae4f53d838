"""Gate of periodic recordings that have not settled: their periods still differ by what dies away.

The rms differences of neighbouring periods are the same where only noise differs, and larger at first where a transient
dies away. Then the first sample is not on the steady cycle, and the periods' differences are not the noise.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..data import Recording
from .gates import Gate
from .standing import opened_at_the_start

MORE = 1.5  # times the least difference of neighbouring periods that the first one is, where it dies away


def without_transients(recordings: Sequence[Recording]) -> tuple[tuple[Recording, ...], list[Gate]]:
    """Recordings that settle within the record, with initial states to be estimated; and what is to be told."""
    found = [(float(ratio), name, r) for r in recordings for name, ratio in zip(r.outputs, _dying(r), strict=True)]
    ratio, name, r = max(found, key=lambda f: f[0])
    if ratio < MORE:
        return tuple(recordings), []
    sentence = (
        f"{name} has not settled{f' in {r.name}' if r.name else ''}: its first two periods differ {ratio:.2g} times as "
        "much as later ones; initial states are estimated, and the periods do not tell the noise."
    )
    return tuple(map(opened_at_the_start, recordings)), [
        Gate(name, "transient", ratio, sentence, True, change=opened_at_the_start)
    ]


def _dying(r: Recording) -> np.ndarray:
    """Difference of the first two periods over the least of neighbours, by output; ones where there is none."""
    count = (len(r) - r.skip) // r.period if r.period and r.begins == "periodic" else 0
    if count < 3 or not r.period:
        return np.ones(r.n_y)
    periods = r.y[r.skip :][: count * r.period].reshape(count, r.period, r.n_y)
    steps = np.sqrt(np.mean(np.diff(periods, axis=0) ** 2, axis=1))
    return np.asarray(steps[0] / np.maximum(steps.min(axis=0), 1e-9 * np.std(r.y, axis=0) + 1e-300))
