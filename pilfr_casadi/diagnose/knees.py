"""The width over which a friction turns round: as sharp as the data say, not as the steps of the simulation would.

Where a simulation is stuck it chatters on steps too long for its knee, and where it passes quickly each passage falls
between two steps: its error has minima of its own there, which no other term of a law is to make up for.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..compiled import make_engine
from ..recording import InputError
from .workbench import FINER, THOROUGH, Fitted, Workbench

if TYPE_CHECKING:
    from .candidate import Candidate

NARROW = 0.05  # of the widest that is tried, of a knee that is sharp
KNEES = (0.25, 4.0)  # times the width of a knee that a law is started from again
MOVED = 1.2  # times the width, of a knee that is another
# times the lower limit of a knee, the next limit and where to start; share of the mean square that is left at most
SHARPER, BETTER = (0.1, 0.4), 0.9
FINEST, SAME = 16, 0.1  # times the sub-steps at most, and the share by which finer ones may change the mean square


def knees(candidate: Candidate) -> list[dict[str, Any]]:
    """Fitted values, also with a sharper and a wider knee where it is sharp."""
    values, knee = candidate.fitted.values, candidate.knee
    if not knee or values[knee] > NARROW * candidate.fitted.model.parameters[knee].bounds[1]:
        return [values]
    return [values, *({**values, knee: times * values[knee]} for times in KNEES)]


def on_finer_steps(bench: Workbench, fitted: Fitted) -> Fitted:
    """Fitted again on finer steps, where what the simulation does depends on them."""
    if fitted.model.substeps * FINER > FINEST * bench.substeps:
        return fitted
    finer, placed = replace(bench, at_least=FINER * fitted.model.substeps), fitted.corrected()
    model = finer.model(placed)
    engine = make_engine(model, bench.engine)
    states = bench.begun(placed, model, model.parameters.pack(fitted.values), fitted.begin)  # a delay's are others here
    there = bench.result(placed, fitted.values, states, engine, model)
    if abs(there.cost / fitted.cost - 1) < SAME:
        return fitted
    try:
        return finer.fit(placed, [fitted.values], states=fitted.begin, solver=THOROUGH, model=model, engine=engine)
    except InputError:
        return fitted


def sharper(bench: Workbench, knee: str, fitted: Fitted) -> Fitted:
    """With a sharper knee than steps can follow at rest, where a limit holds it back and that is far better."""
    given = fitted.simulator.parameters[knee]
    low, high = given.bounds
    if fitted.values[knee] > low:
        return fitted
    freed = replace(given, value=SHARPER[1] * low, bounds=(SHARPER[0] * low, high))
    placed = fitted.simulator.with_parameters({**fitted.simulator.parameters, knee: freed})
    finer = replace(bench, at_least=fitted.model.substeps)
    try:
        found = finer.fit(placed, [{**fitted.values, knee: freed.value}], states=fitted.initial, solver=THOROUGH)
    except InputError:
        return fitted
    return found if found.cost < BETTER * fitted.cost else fitted


def moved(before: Candidate, after: Candidate) -> bool:
    """Whether the knee is another than the one that the first part was fitted with."""
    if not after.knee:
        return False
    ratio = float(after.fitted.values[after.knee] / before.fitted.values[after.knee])
    return abs(np.log(ratio)) > np.log(MOVED)
