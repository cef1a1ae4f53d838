"""Finer steps, where what the refitted simulator does depends on them.

Steps are chosen from where a recording begins. A force that turns round at once, as friction that is in the simulator
already, asks for finer ones later; what coarse steps make of it would look like missing physics.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .._base import InputError
from ..simulators import MOST_SUBSTEPS
from .floor import white_part
from .knees import FINEST
from .workbench import FINER, THOROUGH, Fitted, Workbench

DEPENDS = 0.3  # of the noise: as much as finer steps may change at least, to be taken
QUIET = 3e-4  # of the outputs' deviation: noise below which nothing is to be seen for steps either


def on_steps_as_fine(bench: Workbench, fitted: Fitted) -> tuple[Workbench, Fitted]:
    """The bench on steps whose error is less than the noise, whatever else is missing, and the fit there."""
    noise2 = max(float(np.mean((white_part(fitted.residual) / bench.scale) ** 2)), QUIET**2)
    most, steps = min(FINEST * bench.chosen, MOST_SUBSTEPS), fitted.model.substeps
    while FINER * steps <= most and not fitted.simulator.discrete:
        steps = FINER * steps
        tried = replace(bench, substeps=steps)
        try:
            there = tried.rerun(fitted)
            if _apart2(bench, there, fitted) < DEPENDS**2 * noise2:
                break
            fitted = tried.fit(
                fitted.simulator,
                [fitted.values, {}],
                states=fitted.begin,
                solver=THOROUGH,
                model=there.model,
                engine=there.engine,
            )
        except InputError:
            break
        bench = tried
    return bench, fitted


def _apart2(bench: Workbench, one: Fitted, other: Fitted) -> float:
    """Mean square of the difference of two runs."""
    both = zip(one.residual, other.residual, bench.recordings, strict=True)
    return float(np.mean(np.concatenate([((a - b) / bench.scale)[r.skip :] for a, b, r in both]) ** 2))
