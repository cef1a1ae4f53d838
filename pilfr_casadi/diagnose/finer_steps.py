"""Finer steps, where what the refitted simulator does depends on them.

Steps are chosen from where a recording begins. A force that turns round at once, as friction that is in the simulator
already, asks for finer ones later; what coarse steps make of it would look like missing physics.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..recording import InputError
from ..substeps import MOST
from .workbench import FINER, THOROUGH, Fitted, Workbench

FINEST = 16  # times the sub-steps at most
DEPENDS = 0.3  # of what is left: as much as finer steps change, to be tried
GAINED = 0.8  # share of the mean square that finer steps leave at most


def on_steps_as_fine(bench: Workbench, fitted: Fitted) -> tuple[Workbench, Fitted]:
    """The bench on finer steps, where the simulator follows the recordings better on them, and the fit there."""
    most = min(FINEST * bench.substeps, MOST)
    tried, best = bench, (bench, fitted)
    while FINER * tried.substeps <= most and not fitted.simulator.discrete:
        tried = replace(tried, substeps=FINER * tried.substeps)
        try:
            there = tried.rerun(fitted)
            if not _changed(tried, there, fitted):
                break
            fitted = tried.fit(
                fitted.simulator,
                [fitted.values],
                states=fitted.begin,
                solver=THOROUGH,
                model=there.model,
                engine=there.engine,
            )
        except InputError:
            break
        if fitted.cost < GAINED * best[1].cost:
            best = tried, fitted
    return best


def _changed(bench: Workbench, one: Fitted, other: Fitted) -> bool:
    """Whether two runs differ by a good part of what is left."""
    both = zip(one.residual, other.residual, bench.recordings, strict=True)
    apart = np.concatenate([((a - b) / bench.scale)[r.skip :] for a, b, r in both])
    return bool(np.mean(apart**2) > DEPENDS**2 * other.cost)
