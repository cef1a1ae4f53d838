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
    stand_in_error: float = 0.0,
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
        floor = ready.floor.beside(stand_in_error * ready.bench.scale) if stand_in_error else ready.floor
        search = Search(ready.bench, ready.without, floor, laws, workers, say, hold_said)
        search.times, search.may_be_led, search.stand_in_error = times, not starts, stand_in_error
        return ready, search.run(effects)

    def settled(ready: Prepared | None = None, early: bool = True) -> tuple[Prepared, Search]:
        ready, search = searched(ready, early=early)
        if not search.led_to or search.interrupted:
            return ready, search
        try:
            return searched(starts=[search.led_to], early=early)
        except KeyboardInterrupt:  # what was named is no physics
            search.interrupted, search.passes, search.base = True, [], search.without
            return ready, search

    ready, search = settled(ready)
    if _early(ready) and not search.interrupted and (search.certainty() <= UNSURE or search.much()):
        try:
            other = settled(early=False)
        except KeyboardInterrupt:
            search.interrupted = True
            return ready, search
        if other[1].base.cost < FURTHER * search.base.cost:
            return other
    return ready, search


def _early(ready: Prepared) -> bool:
    return any(g.finding == "alignment" and g.value < 0 for g in ready.gates)
