"""Preparation and search; both anew where what they come to asks for it.

A law may have shown that the refit had stayed in a local minimum. And a channel that seems early, while more is wrong,
may be a sign of that: an axis that friction holds starts late and stops early.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ..data import Recording
from ..laws import Law
from ..simulators import Simulator
from .gates import said_hold
from .preparation import CHECKS, Prepared, prepare
from .search import Search
from .stages import Stages
from .verdict import UNSURE

FURTHER = 0.5  # share of the mean square that is left at most where a channel that seemed early is not


@dataclass(frozen=True, eq=False)
class Asked:
    """What is diagnosed, and how; see `diagnose`."""

    simulator: Simulator
    recordings: Sequence[Recording]
    laws: Sequence[type[Law]]
    hold: str | None
    engine: str
    workers: int
    effects: int
    stand_in_error: float
    say: Stages

    @property
    def hold_said(self) -> bool:
        """Whether somebody said what inputs do between samples."""
        return said_hold(self.simulator, self.recordings, self.hold) is not None

    def prepared(self, starts: Sequence[Mapping[str, Any]] = (), early: bool = True) -> Prepared:
        """What a search starts from; see `prepare`."""
        return prepare(
            self.simulator, self.recordings, self.hold, self.engine, self.workers, starts, early, say=self.say
        )

    def search(self, ready: Prepared, times: dict[str, float], may_be_led: bool) -> Search:
        """A search that has not begun; its stages are added to `times`."""
        floor = ready.floor.beside(self.stand_in_error * ready.bench.scale) if self.stand_in_error else ready.floor
        return Search(
            ready.bench,
            ready.without,
            floor,
            self.laws,
            self.workers,
            self.say,
            hold_said=self.hold_said,
            stand_in_error=self.stand_in_error,
            may_be_led=may_be_led,
            times=times,
        )


def prepared_search(asked: Asked, ready: Prepared | None = None) -> tuple[Prepared, Search]:
    """What a search starts from, made here unless given, and the search; its times hold those of the preparation."""
    times: dict[str, float] = {}

    def searched(
        ready: Prepared | None = None, starts: Sequence[Mapping[str, Any]] = (), early: bool = True
    ) -> tuple[Prepared, Search]:
        began = time.perf_counter()
        ready = ready or asked.prepared(starts, early)
        times[CHECKS] = times.get(CHECKS, 0.0) + time.perf_counter() - began
        return ready, asked.search(ready, times, not starts).run(asked.effects)

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
        search.interrupted = other[1].interrupted
        if other[1].base.cost < FURTHER * search.base.cost:
            return other
    return ready, search


def _early(ready: Prepared) -> bool:
    return any(g.finding == "alignment" and g.value < 0 for g in ready.gates)
