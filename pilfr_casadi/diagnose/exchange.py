"""Two effects put up against the same two laws at other ports, exchanged ones first.

The first law is chosen while the second is missing; at the wrong port it leaves the second another rest than its own.
So it is tried at the second's port, and wherever it came near alone, with the second where it is and at the first's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from .._base import side_by_side
from ..simulators import Simulator
from .candidate import Candidate, attempt
from .choice import LIKE
from .explain import BRIEF, closed
from .kinship import complements
from .review import look_back

if TYPE_CHECKING:
    from .search import Pass, Search

NEAR = 2.0  # times the error as chosen, after a brief fit, of what is worth a whole one
ALONE = 1.5  # times the error of the first law alone that it comes to at a port where it is tried again
WAYS = 4  # that are tried

Place = tuple[str, Candidate]  # a port, and whose law goes there


def exchange(search: Search) -> None:
    """The last two effects with their laws placed otherwise, where that comes nearer; told where it comes as near."""
    steps = search.passes[-2:]
    if len(steps) < 2 or not all(p.accepted for p in steps):
        return
    assert steps[0].choice is not None
    assert steps[1].choice is not None
    one, other = steps[0].choice.winner, steps[1].choice.winner
    if type(one.law) is type(other.law):
        return
    began = search.begin("exchange")
    ways = _ways(steps[0], one, other)
    stay, *tried = side_by_side(lambda way: _placed(search, way), [[], *ways], search.workers)
    pairs = [(found, way) for found, way in zip(tried, ways, strict=True) if found is not None]
    best, way = min(pairs, key=lambda pair: pair[0].error, default=(None, []))
    search.timed("exchange", began)
    if best is None or stay is None:
        return
    ratio = best.error / stay.error
    done = search.polished(best) if ratio < 1 / (1 + LIKE) else None
    for k, ((port, c), step) in enumerate(zip(way, steps, strict=True)):
        choice = step.choice
        assert choice is not None
        if done is not None:
            law = next(e.law for e in done.fitted.simulator.elements[::-1] if e.port == port and e.law.id == c.law.id)
            moved = replace(done, port=port, law=law, size=c.size)
            choice = replace(choice, winner=moved, alike=(), margin=1 / ratio)
        elif ratio > 1 + LIKE:
            choice = replace(choice, margin=min(choice.margin, ratio))
        elif port != c.port:
            rival = replace(best, port=port, law=c.law, size=c.size)
            choice = replace(choice, alike=(*choice.alike, rival))
        search.passes[k - 2] = replace(step, choice=choice)
    if done is not None:
        search.base = done.fitted
        look_back(search)


def _ways(first: Pass, one: Candidate, other: Candidate) -> list[list[Place]]:
    """Other places for the laws of both effects, the likeliest first."""
    alone = {c.port: c.error for c in reversed(first.candidates) if type(c.law) is type(one.law)}
    near = sorted((p for p in alone if alone[p] < ALONE * alone.get(one.port, 0.0)), key=lambda p: alone[p])
    beside, ways = complements(one.law, other.law), list[list[Place]]()
    for port in dict.fromkeys([other.port, *near]):
        for second in dict.fromkeys([one.port, other.port]):
            if port != one.port and (port != second or beside):
                ways.append([(port, one), (second, other)])
    return ways[:WAYS]


def _placed(search: Search, way: Sequence[Place]) -> Candidate | None:
    """Laws at these ports, fitted from the values that they have and from the screen's; as chosen where none is given.

    None where one cannot stand there, or comes nowhere near.
    """
    bench, base = search.bench, search.base
    if not way:
        return attempt(bench, base.simulator, [base.values], states=base.initial)
    nominal: dict[str, Any] = {k: p.value for k, p in search.without.simulator.parameters.items()}
    starts, simulator = list[dict[str, Any]](), bench.simulator
    for screened in (False, True):
        found = _closed(search, way, screened)
        if found is None:
            return None
        simulator = simulator if screened else found[0]
        starts += [{**base.values, **found[1]}, {**nominal, **found[1]}]
    brief = attempt(bench, simulator, starts, states=base.begin, solver=BRIEF)
    if brief is None or brief.error > NEAR * search.base.cost**0.5:
        return brief
    return attempt(bench, simulator, [brief.fitted.values], states=brief.fitted.initial)


def _closed(search: Search, way: Sequence[Place], screened: bool) -> tuple[Simulator, dict[str, Any]] | None:
    """The simulator with laws at these ports, and their start values by full name."""
    simulator, named = search.bench.simulator, dict[str, Any]()
    for port, c in way:
        entries = (s for p in search.passes[-2:] for s in p.scored if s.port == port and type(s.law) is type(c.law))
        entry = next(entries, None)
        if entry is None:
            return None
        element = next(e for e in search.base.simulator.elements[::-1] if e.port == c.port and e.law.id == c.law.id)
        own = element.own(search.base.values)
        simulator, values = closed(simulator, entry, {**own, **entry.starts[0]} if screened else own)
        named |= values
    return simulator, named
