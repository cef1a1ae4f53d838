"""A filter named at an actuator, put up against one in every sensor, as anti-alias filters or a late logger are.

With the response G of a linear simulator of one input and the filter's F, `G (F u) = F (G u)` for every output: what is
linear and time-invariant commutes (Oppenheim & Willsky 1997, Signals and Systems, sec. 2.3), and no recording tells the
two apart. Where the simulator is not linear, or has several inputs, the fits do.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from ..simulators import Simulator
from .candidate import Candidate, attempt
from .choice import LIKE

if TYPE_CHECKING:
    from .search import Search

FILTERS = ("extra_mode", "delay")
BETTER = 1.15  # times nearer that one in each sensor has to come, of more parameters than one at the actuator


def every_sensor(search: Search) -> None:
    """Take filters in every sensor for those named, where that comes nearer; told where it comes as near."""
    names, own = search.bench.simulator.output_names, search.base.simulator.elements
    found = [p for p in search.passes if p.accepted]
    steps = [p for p in found if p.choice is not None and p.choice.winner.law.id in FILTERS]
    behind = [p for p in steps if p.choice is not None and p.choice.winner.port.startswith("actuator:")]
    if not behind or len(names) < 2 or len(own) - len(search.bench.simulator.elements) != len(found):
        return
    began, first = search.begin("every sensor"), behind[0]
    assert first.choice is not None
    ports, law = [f"sensor:{name}" for name in names], first.choice.winner.law
    rival = _rival(search, ports, first.choice.winner)
    stay = attempt(search.bench, search.base.simulator, [search.base.values], states=search.base.initial)
    search.timed("every sensor", began)
    if rival is None or stay is None or rival.error > (1 + LIKE) * stay.error:
        return
    done = search.polished(rival) if rival.error < stay.error / BETTER else None
    if done is None:
        common = " + ".join(ports), law.id
        told = replace(first, choice=replace(first.choice, common=common))
        search.passes = [told if p is first else p for p in search.passes]
        return
    placed = {e.port: e.law for e in done.fitted.simulator.elements}
    size = first.choice.winner.size
    winners = [replace(done, port=port, law=placed[port], size=size) for port in ports]
    choices = [replace(first.choice, winner=w, alike=(), margin=stay.error / done.error) for w in winners]
    new = [replace(first, choice=c, candidates=(c.winner,)) for c in choices]
    new[0] = replace(new[0], candidates=(winners[0], *first.candidates))
    at = search.passes.index(first)
    search.passes = [p for p in (*search.passes[:at], *new, *search.passes[at + 1 :]) if p not in steps]
    search.base = done.fitted
    search.open_after = search.flexible(search.base)


def _rival(search: Search, ports: list[str], winner: Candidate) -> Candidate | None:
    """The simulator with what is named besides filters, and the winner's filter in each sensor."""
    bench, base = search.bench, search.base
    found = base.simulator.elements[len(bench.simulator.elements) :]
    source = next(e for e in found if e.port == winner.port and e.law.id == winner.law.id)
    own = source.own(base.values)
    simulator: Simulator = bench.simulator
    for e in found:
        if e.law.id not in FILTERS:
            simulator = simulator.with_element(e.port, e.law)
    named = dict[str, object]()
    for port in ports:
        simulator = simulator.with_element(port, source.law)
        named |= simulator.elements[-1].named(own)
    nominal = {k: p.value for k, p in search.without.simulator.parameters.items()}
    starts = [{**base.values, **named}, {**base.values, **nominal, **named}]
    return attempt(bench, simulator, starts, states=base.begin)
