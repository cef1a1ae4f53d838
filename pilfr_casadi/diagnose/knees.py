"""The width over which a friction turns round: as sharp as the data say, not as the steps of the simulation would.

Where a simulation is stuck it chatters on steps too long for its knee, and where it passes quickly each passage falls
between two steps: its error has minima of its own there, which no other term of a law is to make up for.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from .._base import InputError
from .workbench import FINER, THOROUGH, Fitted, Workbench

if TYPE_CHECKING:
    from .trials import Trial

NARROW = 0.05  # of the widest that is tried, of a knee that is sharp
KNEES = (0.25, 4.0)  # times the width of a knee that a law is started from again
FINEST, SAME = 16, 0.1  # times the sub-steps at most, and the share by which finer ones may change the mean square


def knees(candidate: Trial) -> list[dict[str, Any]]:
    """Fitted values, also with a sharper and a wider knee where it is sharp."""
    values, knee = candidate.fitted.values, candidate.knee
    if not knee or values[knee] > NARROW * candidate.fitted.model.parameters[knee].bounds[1]:
        return [values]
    return [values, *({**values, knee: times * values[knee]} for times in KNEES)]


def on_finer_steps(bench: Workbench, fitted: Fitted, knee: str) -> Fitted:
    """Fitted again on finer steps, where what the simulation does depends on them or they hold a sharper knee back.

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
