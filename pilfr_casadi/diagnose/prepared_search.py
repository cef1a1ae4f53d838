"""Preparation and search; both anew where what they come to asks for it.

A law may have shown that the refit had stayed in a local minimum. And a channel that seems early, while more is wrong,
may be a sign of that: an axis that friction holds starts late and stops early.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

from ..interrupts import Progress
from ..laws import Law
from ..recording import Recording
from ..simulator import Simulator
from .prepare import Prepared, prepare
from .search import Search
from .verdict import UNSURE

FURTHER = 0.5  # share of the mean square that is left at most where a channel that seemed early is not


def prepared_search(
    simulator: Simulator,
    recordings: Sequence[Recording],
    hold: str | None,
    engine: str,
    laws: Sequence[type[Law]],
    workers: int,
    say: Progress,
    hold_said: bool,
    effects: int,
    ready: Prepared | None = None,
) -> tuple[Prepared, Search]:
    """What a search starts from, made here unless given, and the search; its times hold those of the preparation."""
    times: dict[str, float] = {}

    def searched(
        ready: Prepared | None = None, starts: Sequence[Mapping[str, Any]] = (), early: bool = True
    ) -> tuple[Prepared, Search]:
        began = time.perf_counter()
        ready = ready or prepare(simulator, recordings, hold, engine, workers, starts, early)
        times["gates and refit"] = times.get("gates and refit", 0.0) + time.perf_counter() - began
        search = Search(ready.bench, ready.without, ready.floor, laws, workers, say, hold_said)
        search.times, search.may_be_led = times, not starts
        return ready, search.run(effects)

    ready, search = searched(ready)
    try:
        if search.led_to:
            ready, search = searched(starts=[search.led_to])
        if _early(ready) and not search.interrupted and (search.certainty() <= UNSURE or search.much()):
            other = searched(early=False)
            if other[1].base.cost < FURTHER * search.base.cost:
                ready, search = other
    except KeyboardInterrupt:
        search.interrupted = True
        if search.led_to:  # what was named is no physics
            search.passes, search.base = [], search.without
    return ready, search


def _early(ready: Prepared) -> bool:
    return any(g.finding == "alignment" and g.value < 0 for g in ready.gates)
