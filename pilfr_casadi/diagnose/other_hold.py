"""The same search with inputs that do the other thing between samples, where nobody has said what they do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .._base import InputError
from .first_effect import MISHELD
from .gates import hold_note
from .preparation import Prepared
from .search import Search
from .search_start import Asked, prepared_search


def doubted(search: Search) -> bool:
    """Whether inputs may do the other thing between samples.

    A late sensor looks like the other hold: what is named explains too little then, or is a lag or a mode within a
    sample.
    """
    if search.interrupted or search.misheld > MISHELD:
        return not search.interrupted
    named = [c.winner for c in search.accepted]
    return (search.much() or any(c.within(search.bench.dt) for c in named)) if named else search.unsure()


def otherwise_held(asked: Asked, ready: Prepared, search: Search) -> tuple[Prepared, Search]:
    """A search with the other hold where inputs seem to be held so or names are surer then; else the one there is."""
    wrong = search.misheld > MISHELD
    try:
        hold = search.bench.otherwise_held().hold
        held = replace(asked, hold=hold, say=asked.say.under("other hold: "))
        # one effect shows whether it is worth the search for two
        other, again = prepared_search(held if wrong else replace(held, effects=1))
        nearer = again.base.cost <= search.base.cost
        if not wrong and nearer and asked.effects > 1 and again.much() and not again.interrupted:
            other, again = prepared_search(held, other)
            nearer = again.base.cost <= search.base.cost
    except InputError:  # it cannot be run so
        return ready, search
    except KeyboardInterrupt:
        search.interrupted = True
        return ready, search
    nothing = not again.accepted and not again.unsure()  # is missing, where inputs do the other
    surer = nearer and (nothing or again.certainty() > search.certainty())
    if (not wrong and not surer) or (again.interrupted and not again.accepted):
        search.interrupted = again.interrupted
        return ready, search
    ratio = search.misheld if wrong else float(np.sqrt(search.base.cost / max(again.base.cost, 1e-300)))
    return replace(other, gates=(*other.gates, hold_note(asked.simulator, hold, ratio))), again
