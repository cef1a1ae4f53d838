"""Whether a value that is held does what laws were named for, or what none does.

A spring or a damper in a port where the simulator has one is the same as another value of that one. It comes out as
missing only where the value is fixed, or its bounds do not let it go there; then that is what has to be said. With a
value whose bounds are in another unit no law says anything of the machine: it is looked for powers of ten away.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .._base import InputError
from ..laws import display_name
from .posterior import Posterior
from .search import Search
from .workbench import THOROUGH, Fitted

LIKE = 0.03  # share by which errors differ that say the same
AT_FLOOR, WELL_ABOVE = 1.15, 3.0  # times the noise that counts as being at it, and as being far from it
HELPLESS = 0.5  # error of a refit that says little of a machine: a value may be powers of ten away
FAR = (1e-3, 1e-2, 0.1, 10.0, 100.0, 1e3)
LINEAR = ("linear_stiffness", "viscous_damping")


@dataclass(frozen=True, eq=False)
class Held:
    """A parameter, the value it would take, the simulator fitted with it, and what is said of it."""

    name: str
    value: float
    fitted: Fitted
    sentence: str


def held_value(search: Search, answer: Posterior) -> Held | None:
    """The held parameter that, let go, does as well as what was named; None where there is none.

    One that is fixed is asked for only by a linear law, which is the same as another value of it.
    """
    named = [e.element for e in answer.effects]
    linear = len(named) == 1 and named[0].law.id in LINEAR
    bench, without = search.bench, search.root.fitted
    if not linear and without.cost < HELPLESS**2:
        return None
    as_well = (1 + LIKE) ** 2 * answer.best.whole if named else np.inf
    enough = min(as_well, (WELL_ABOVE if named else AT_FLOOR) ** 2 * search.floor2)  # else something is missing
    best: tuple[str, Fitted] | None = None
    for name, p in bench.simulator.parameters.items():
        stays = bool((linear and np.all(p.fixed)) or np.all(without.at_bound(name)))
        if p.size != 1 or not stays or float(p.value) == 0:  # what is nothing is not there
            continue
        free = replace(p, fixed=False, bounds=(0.0 if float(p.value) > 0 else -np.inf, np.inf))
        simulator = bench.simulator.with_parameters({**bench.simulator.parameters, name: free})
        far = () if linear else FAR
        starts = [without.values, *({**without.values, name: p.value * by} for by in far)]
        try:
            found = bench.fit(simulator, starts, states=without.initial, solver=THOROUGH)
        except InputError:
            continue
        except KeyboardInterrupt:
            search.interrupted = True
            return None
        if bench.struck:
            search.interrupted = True
            return None
        (low, high), value = p.bounds, float(found.values[name])
        beyond = bool(np.all(p.fixed)) or not np.all((low <= value) & (value <= high))
        if beyond and (best is None or found.cost < best[1].cost):
            best = name, found
    if best is None or best[1].cost > enough:
        return None
    name, found = best
    p, value = bench.simulator.parameters[name], float(found.values[name])
    unit = f" {p.unit}" if p.unit else ""
    kept = "held at" if np.all(p.fixed) else "kept by its bounds at"
    words = " and ".join(f"the {display_name(c.law.id)} at {c.port}" for c in named)
    like = f", no further off than with {words}" if named else ""
    sentence = (
        f"Nothing is missing but a value: with {name} = {value:.5g}{unit}, which is {kept} "
        f"{float(without.values[name]):.4g}{unit}, the refitted simulator's error falls from {without.cost**0.5:.3g} "
        f"to {found.cost**0.5:.3g} of the outputs' deviation{like}; let it go there, or say what takes its place."
    )
    return Held(name, value, found, sentence)
