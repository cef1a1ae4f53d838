"""Where the declared ports do not reach: what a law in the equation of a state would explain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from .._base import InputError
from ..laws import display_name
from .gates import Gate
from .search import Search
from .verdict import UNSURE


def beyond_the_ports(search: Search) -> Sequence[Gate]:
    """A note where a mismatch that no declared port explains has a sure name in the equation of a state."""
    ports = search.bench.simulator.ports
    if not ports or search.interrupted:
        return ()
    open_ = replace(search.bench.simulator, ports=())
    bench = replace(search.bench, simulator=open_)
    try:
        without = bench.fit(open_, [search.without.values], states=search.without.begin)
        other = Search(bench, without, search.floor, search.laws, search.workers, search.say).run(1)
    except InputError:
        return ()
    except KeyboardInterrupt:
        search.interrupted = True
        return ()
    search.interrupted, named = other.interrupted, other.accepted
    if other.certainty() <= UNSURE or not named or not named[0].winner.port.startswith("equation:"):
        return ()
    state, law = named[0].winner.port.removeprefix("equation:"), named[0].winner.law.id
    sentence = (
        f"No declared port reaches it: in the equation of {state}, {display_name(law)} explains it (refitted with it, "
        f"the error is {other.base.cost**0.5:.3g} of the outputs' deviation). Declare the port that it acts through."
    )
    return (Gate(state, "undeclared", law.replace("_", " "), sentence, False),)
