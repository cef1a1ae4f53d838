"""Whether a value that is held does what a linear law was named for.

A spring or a damper in a port where the simulator has one is the same as another value of that one. It comes out as
missing only where the value is fixed, or its bounds do not let it go there; then that is what has to be said.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..recording import InputError
from .choice import LIKE
from .workbench import THOROUGH, Fitted

if TYPE_CHECKING:
    from .search import Search

LINEAR = ("linear_stiffness", "viscous_damping")


@dataclass(frozen=True, eq=False)
class Held:
    """A parameter, the value it would take, the simulator fitted with it, and what is said of it."""

    name: str
    value: float
    fitted: Fitted
    sentence: str


def held_value(search: Search) -> Held | None:
    """The held parameter that does as well, let go, as the one linear law that was named; None where there is none."""
    named = [c.winner for c in search.accepted]
    if len(named) != 1 or named[0].law.id not in LINEAR:
        return None
    bench, without = search.bench, search.without
    best: tuple[str, Fitted] | None = None
    for name, p in bench.simulator.parameters.items():
        stays = bool(np.all(p.fixed) or np.all(without.at_bound(name)))
        if p.size != 1 or not stays or float(p.value) == 0:  # what is nothing is not there
            continue
        free = replace(p, fixed=False, bounds=(0.0 if float(p.value) > 0 else -np.inf, np.inf))
        simulator = bench.simulator.with_parameters({**bench.simulator.parameters, name: free})
        try:
            found = bench.fit(simulator, [without.values], states=without.initial, solver=THOROUGH)
        except InputError:
            continue
        if best is None or found.cost < best[1].cost:
            best = name, found
    if best is None or best[1].cost > (1 + LIKE) ** 2 * search.base.cost:
        return None
    name, found = best
    p, value = bench.simulator.parameters[name], float(found.values[name])
    unit = f" {p.unit}" if p.unit else ""
    kept = "held at" if np.all(p.fixed) else "kept by its bounds at"
    sentence = (
        f"Nothing is missing but a value: with {name} = {value:.4g}{unit}, which is {kept} "
        f"{float(without.values[name]):.4g}{unit}, the refitted simulator's error falls from {without.cost**0.5:.3g} "
        f"to {found.cost**0.5:.3g} of the outputs' deviation, as with the {named[0].law.id.replace('_', ' ')} at "
        f"{named[0].port}; let it go there, or say what takes its place."
    )
    return Held(name, value, found, sentence)
