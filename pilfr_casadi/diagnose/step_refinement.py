"""Finer integration steps if the answer depends on them, and the knee width of a friction law.

Steps are chosen at the start of a recording. A force with a sharp reversal, such as a friction already in the
simulator, needs finer steps later; the error of coarse steps would look like missing physics.

The data decide how sharp the knee of a friction law is, not the steps of the simulation. On steps too long for its
knee, a stuck simulation chatters, and in fast motion each passage falls between two steps. The cost then has spurious
minima, and no other term of a law should make up for them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from .._base import InputError
from ..simulators import MOST_SUBSTEPS
from .floor import white_part
from .workbench import FINER, THOROUGH, Fitted, Workbench

if TYPE_CHECKING:
    from .trials import Trial

DEPENDS = 0.3  # least change by finer steps, over the noise, for which they are used
QUIET = 3e-4  # least noise, over the outputs' deviation, that the steps are compared with
NARROW = 0.05  # share of the widest knee that is tried, below which a knee is sharp
KNEES = (0.25, 4.0)  # factors on the knee width from which a law is fitted again
FINEST, SAME = 16, 0.1  # largest factor on the sub-steps; share by which finer steps may change the mean square


def refine_steps(bench: Workbench, fitted: Fitted) -> tuple[Workbench, Fitted]:
    """Refine the steps until their error is less than the noise; return the bench and the fit there."""
    noise2 = max(float(np.mean((white_part(fitted.residual) / bench.scale) ** 2)), QUIET**2)
    most, steps = min(FINEST * bench.chosen, MOST_SUBSTEPS), fitted.model.substeps
    while FINER * steps <= most and not fitted.simulator.discrete:
        steps = FINER * steps
        tried = replace(bench, substeps=steps)
        try:
            there = tried.rerun(fitted)
            if _difference2(bench, there, fitted) < DEPENDS**2 * noise2:
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


def _difference2(bench: Workbench, one: Fitted, other: Fitted) -> float:
    """Compute the mean square of the difference of two runs."""
    both = zip(one.residual, other.residual, bench.recordings, strict=True)
    return float(np.mean(np.concatenate([((a - b) / bench.scale)[r.skip :] for a, b, r in both]) ** 2))


def knee_starts(candidate: Trial) -> list[dict[str, Any]]:
    """Return the fitted values, and if the knee is sharp also those with a sharper and a wider one."""
    values, knee = candidate.fitted.values, candidate.knee
    if not knee or values[knee] > NARROW * candidate.fitted.model.parameters[knee].bounds[1]:
        return [values]
    return [values, *({**values, knee: times * values[knee]} for times in KNEES)]


def refit_on_finer_steps(bench: Workbench, fitted: Fitted, knee: str) -> Fitted:
    """Refit on finer steps if the simulation depends on them, or if the present steps limit the knee.

    The knee may be sharper there, as far as these steps can follow it at rest.
    """
    given = fitted.simulator.parameters[knee]
    low, high = given.bounds
    if fitted.model.substeps * FINER > FINEST * bench.chosen:
        return fitted
    finer, placed = replace(bench, at_least=FINER * fitted.model.substeps), fitted.corrected()
    sharper = replace(given, value=fitted.values[knee], bounds=(low / FINER, high))
    placed = placed.with_parameters({**placed.parameters, knee: sharper})
    there = finer.rerun(fitted, placed)
    held = fitted.values[knee] <= low
    if not held and abs(there.cost / fitted.cost - 1) < SAME:
        return fitted
    starts = [fitted.values, *([{**fitted.values, knee: low / 2}] if held else [])]
    states, model, engine = fitted.begin, there.model, there.engine
    try:
        found = finer.fit(placed, starts, states=states, solver=THOROUGH, model=model, engine=engine)
    except InputError:
        return fitted
    return found if found.cost < max(fitted.cost, there.cost) else fitted
