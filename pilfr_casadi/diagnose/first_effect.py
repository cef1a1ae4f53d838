"""What is seen once the first effect is in place: of the refit, of what inputs do between samples, of offsets."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from .._base import InputError
from .candidate import polish
from .offset import offsets, without_idle_offsets
from .workbench import THOROUGH, Fitted

if TYPE_CHECKING:
    from .search import Search

LED_OUT = 0.8  # share of the mean square that is left at most by a simulator that a law has led out of a dead end
MISHELD = 1.05  # times the error that inputs held wrongly between samples leave


def led_out(search: Search) -> bool:
    """Whether the simulator alone, fitted from where the first law has led its parameters, is far better.

    Then it had stayed in a local minimum, and that is what the law has made up for.
    """
    if not search.may_be_led:
        return False
    base, began = search.base, search.begin("look back")
    try:
        alone = search.bench.fit(search.bench.simulator, [base.values], states=base.begin, solver=THOROUGH)
    except InputError:
        return False
    finally:
        search.timed("look back", began)
    if alone.cost > LED_OUT * search.without.cost:
        return False
    search.led_to = alone.values
    return True


def wrongly_held(search: Search) -> bool:
    """Whether, with the effects in place, inputs seem to do the other thing between samples."""
    if search.hold_said:
        return False
    base, began = search.base, search.begin("look back")
    try:
        other = search.bench.otherwise_held().fit(base.simulator, [base.values], states=base.initial, solver=THOROUGH)
    except InputError:
        return False
    finally:
        search.timed("look back", began)
    search.misheld = float(np.sqrt(base.cost / max(other.cost, 1e-300)))
    return search.misheld > MISHELD


def offset_beside(search: Search) -> None:
    """A constant that the first effect had hidden is a parameter of the simulator, with and without the effect."""
    began = search.begin("look back")
    bench, base, gates = offsets(search.bench, search.base)
    try:
        if gates:
            before = search.without
            search.without = bench.fit(bench.simulator, [before.values], states=before.begin, solver=THOROUGH)
            search.bench, search.gates = bench, (*search.gates, *gates)
            _take(search, base)
    except InputError:
        return
    finally:
        search.timed("look back", began)


def let_idle_offsets_go(search: Search) -> None:
    """Offsets that an effect had looked like are none."""
    found = without_idle_offsets(search.bench, search.base)
    if found is not search.base:
        _take(search, found)


def _take(search: Search, found: Fitted) -> None:
    """A fit with other offsets; what of the last law stood for them, or against them, goes."""
    search.base = found
    last = max(i for i, p in enumerate(search.passes) if p.accepted)
    choice = search.passes[last].choice
    assert choice is not None
    done = polish(search.bench, replace(choice.winner, fitted=found)) if choice.winner.law.signed else None
    if done is not None and np.isfinite(done.full):
        search.base = done.fitted
        search.passes[last] = replace(search.passes[last], choice=replace(choice, winner=done))
