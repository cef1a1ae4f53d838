"""Integration steps fine enough for the data, and for the sharp knee of a friction law.

Integration steps are chosen at the start of a recording. A force with a sharp reversal, such as a friction already in
the simulator, needs finer steps later; the error of coarse steps would look like missing physics. `refine_steps` makes
them finer if the answer depends on them. `refit_on_finer_steps` lets the data decide how sharp the knee of a friction
law is. On steps too long for its knee, a stuck simulation chatters, and in fast motion each passage falls between two
steps. The cost then has spurious minima, and no other term of a law should make up for them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..._base import InputError
from ...simulators import MOST_SUBSTEPS
from .floor import white_part
from .workbench import FINER_STEPS, THOROUGH, Fitted, Workbench, refit

STEP_ERROR = 0.3  # least change by finer steps, over the noise, for which they are used
LEAST_NOISE = 3e-4  # least noise, over the outputs' deviation, that the steps are compared with
COST_CHANGE = 0.1  # share by which finer steps may change the mean square
SHARP_KNEE = 0.05  # share of the widest knee that is tried, below which a knee is sharp


def refine_steps(bench: Workbench, fitted: Fitted) -> tuple[Workbench, Fitted]:
    """Refine the steps until their error is less than the noise; return the bench and the fit there."""
    noise = np.maximum(white_part(bench.scored(fitted.residual)), LEAST_NOISE * bench.scale)
    most, steps = min(FINER_STEPS**2 * bench.chosen, MOST_SUBSTEPS), fitted.model.substeps
    while FINER_STEPS * steps <= most and not fitted.simulator.discrete:
        steps = FINER_STEPS * steps
        tried, starts, states = replace(bench, substeps=steps), [fitted.values, {}], fitted.begin
        try:
            there = tried.run(fitted.simulator, fitted.values, states)
        except InputError:
            break
        moved = [(a - b) / noise for a, b in zip(there.residual, fitted.residual, strict=True)]
        if np.mean(np.concatenate(bench.scored(moved)) ** 2) < STEP_ERROR**2:
            break
        found = refit(tried, starts, fitted.simulator, states=states, solver=THOROUGH, like=there)
        if found is None:
            break
        bench, fitted = tried, found
    return bench, fitted


def knee_starts(fitted: Fitted, knee: str) -> list[dict[str, Any]]:
    """Return the fitted values, and if there is a sharp knee also those with a sharper and a wider one."""
    values = fitted.values
    if not knee or values[knee] > SHARP_KNEE * fitted.model.parameters[knee].bounds[1]:
        return [values]
    return [values, *({**values, knee: times * values[knee]} for times in (1 / FINER_STEPS, FINER_STEPS))]


def refit_on_finer_steps(bench: Workbench, fitted: Fitted, knee: str) -> Fitted:
    """Refit on finer steps if the simulation depends on them, or if the present steps limit the knee.

    The knee may be sharper there, as far as these steps can follow it at rest.
    """
    given = fitted.simulator.parameters[knee]
    low, high = given.bounds
    if fitted.model.substeps * FINER_STEPS > FINER_STEPS**2 * bench.chosen:
        return fitted
    finer, placed = replace(bench, at_least=FINER_STEPS * fitted.model.substeps), fitted.corrected()
    sharper = replace(given, value=fitted.values[knee], bounds=(low / FINER_STEPS, high))
    placed = placed.with_parameters({**placed.parameters, knee: sharper})
    there = finer.run(placed, fitted.values, fitted.begin)
    held = fitted.values[knee] <= low
    if not held and abs(there.cost / fitted.cost - 1) < COST_CHANGE:
        return fitted
    starts = [fitted.values, *([{**fitted.values, knee: low / 2}] if held else [])]
    found = refit(finer, starts, placed, states=fitted.begin, solver=THOROUGH, like=there)
    return found if found is not None and found.cost < max(fitted.cost, there.cost) else fitted
