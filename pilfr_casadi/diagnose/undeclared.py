"""Where the declared ports do not reach: what a law in the equation of a state would explain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from .._base import InputError
from ..laws import display_name
from .gates import Gate
from .posterior import posterior
from .search import Search
from .verdict import SURE


def beyond_the_ports(search: Search) -> Sequence[Gate]:
    """A note where a mismatch that no declared port explains has a sure name in the equation of a state."""
    ports = search.bench.simulator.ports
    if not ports or search.interrupted:
        return ()
    open_ = replace(search.bench.simulator, ports=())
    bench = replace(search.bench, simulator=open_)
    try:
        without = bench.fit(open_, [search.root.fitted.values], states=search.root.fitted.begin)
        other = Search(bench, without, search.floor, search.laws, search.workers, search.say).run(1)
    except InputError:
        return ()
    except KeyboardInterrupt:
        search.interrupted = True
        return ()
    search.interrupted, found = other.interrupted, posterior(other)
    if found.sure <= SURE or not found.effects[0].name[0].startswith("equation:"):
        return ()
    state, law = found.effects[0].name[0].removeprefix("equation:"), found.effects[0].name[1]
    sentence = (
        f"No declared port reaches it: in the equation of {state}, {display_name(law)} explains it (refitted with it, "
        f"the error is {found.best.error:.3g} of the outputs' deviation). Declare the port that it acts through."
    )
    return (Gate(state, "undeclared", law.replace("_", " "), sentence, False),)
