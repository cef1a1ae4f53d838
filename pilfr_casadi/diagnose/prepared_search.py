"""Preparation and search; both anew where a law has shown that the refit had stayed in a local minimum."""

from __future__ import annotations

import time
from collections.abc import Sequence

from ..interrupts import Progress
from ..laws import Law
from ..recording import Recording
from ..simulator import Simulator
from .prepare import Prepared, prepare
from .search import Search


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
    began = time.perf_counter()
    ready = ready or prepare(simulator, recordings, hold, engine, workers)
    spent = time.perf_counter() - began
    search = Search(ready.bench, ready.without, ready.floor, laws, workers, say, hold_said).run(effects)
    if search.led_to:
        began = time.perf_counter()
        try:
            ready = prepare(simulator, recordings, hold, engine, workers, [search.led_to])
        except KeyboardInterrupt:  # what was named is no physics
            search.interrupted, search.passes, search.base = True, [], search.without
        else:
            spent, times = spent + time.perf_counter() - began, search.times
            search = Search(ready.bench, ready.without, ready.floor, laws, workers, say, hold_said, may_be_led=False)
            search.times = times
            search.run(effects)
    search.times = {"gates and refit": spent, **search.times}
    return ready, search
