"""A filter behind the one input of a linear simulator, or the same one in every sensor: which, no recording tells.

With the simulator's response G and the filter's F, `G (F u) = F (G u)` for every output, from rest: what is linear and
time-invariant commutes (Oppenheim & Willsky 1997, Signals and Systems, sec. 2.3). With one output the sensor is a port
like others, and fitted.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .search import Search
    from .verdict import Choice

FILTERS = ("extra_mode", "delay")  # what a set of sensors may have in common: anti-alias filters, a late logger


def every_sensor(choice: Choice, search: Search) -> tuple[str, str] | None:
    """All sensors joined by " + ", and the law, where the same law in each of them is as good an answer; else None."""
    winner, simulator = choice.winner, search.bench.simulator
    several = len(simulator.output_names) > 1
    if winner.law.id not in FILTERS or not winner.port.startswith("actuator:") or not several:
        return None
    driven = len(simulator.inputs) - len(simulator.idle_inputs)
    if driven != 1 or len(search.base.simulator.elements) != 1 or not simulator.linear:
        return None
    return " + ".join(f"sensor:{name}" for name in simulator.output_names), winner.law.id
