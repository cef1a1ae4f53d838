"""What was accepted, looked at again: a closer law at its port, a finer form, and rivals beside a second effect.

With the second effect in place, the first law is put up again against its rivals; either is dropped where the other
does as well alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from .._base import InputError, side_by_side
from ..engine import make_engine
from ..laws import FINER
from ..simulators import Simulator
from .candidate import Candidate, attempt, judged
from .choice import LIKE, choose, dry_instead
from .explain import by_cost
from .kinship import imitates
from .rivals import FITTED, may_stand, rivals_beside
from .verdict import HINT

if TYPE_CHECKING:
    from .search import Pass, Search

FINER_BY = 0.94  # share of the mean square that a finer form of the named law leaves at most
Task = tuple[Simulator, Mapping[str, Any], Sequence[np.ndarray]]  # what is fitted, from which values and states
NEARLY = 1.1  # times a second effect's error that it may come to without the first, which then goes
LED = 2.0  # times the error of the nearest rival, of those that are fitted again from where it is


def prefer_what_leaves_nothing(search: Search) -> None:
    """Where the winner leaves what a flexible force explains, and a closer law at its port does not: take that."""
    found = search.passes[-1]
    assert found.choice is not None
    winner = found.choice.winner
    nearer = [c for c in found.candidates if c.port == winner.port and c.error < 0.95 * winner.error]
    own = [c for c in nearer if not imitates(c, winner, search.floor2)]
    closer = [c for c in own if dry_instead(c, found.candidates, search.floor2) is None]
    still = search.flexible(search.base).get(winner.port, 0.0) if closer else 0.0
    if still < HINT:
        return
    rival = search.polished(min(closer, key=lambda c: c.error))
    if rival is not None and search.flexible(rival.fitted).get(winner.port, 0.0) < 0.5 * still:
        search.base = rival.fitted
        margin = winner.error / rival.error
        choice = replace(found.choice, winner=rival, margin=min(margin, found.choice.margin), alike=())
        search.passes[-1] = replace(found, choice=choice)


def put_more_finely(search: Search) -> None:
    """The named law in a finer form, where there is one that fits better."""
    found = search.passes[-1]
    assert found.choice is not None
    winner = found.choice.winner
    element = search.base.simulator.elements[-1]
    bare = search.base.simulator.without_last_element()
    local = next((s.local for s in found.scored if s.port == winner.port), None)
    for kind in FINER.get(type(winner.law), ()):
        if local is None:
            return
        began = search.begin("finer form")
        given = element.own(search.base.values)
        shapes = list(kind.finer_starts(given, local))
        law = kind().at(shapes[0], kind().bounds(local))
        starts = [{**search.base.values, **element.named(shape)} for shape in shapes]
        placed = bare.with_element(element.port, law)
        model = search.bench.model(placed)
        engine = make_engine(model, search.bench.engine)
        nearest = by_cost(search.bench, placed, model, engine, starts, search.base)[:1]
        try:
            finer = search.bench.fit(placed, nearest, states=search.base.begin, model=model, engine=engine)
        except InputError:
            continue
        if finer.cost < FINER_BY * search.base.cost:
            search.base = finer
            size = law.size(finer.simulator.elements[-1].own(finer.values))
            head, tail = judged(search.bench, finer)
            better = replace(winner, law=law, fitted=finer, head=head, tail=tail, full=finer.cost, size=size)
            search.passes[-1] = replace(found, choice=replace(found.choice, winner=better))
        search.timed("finer form", began)


def look_back(search: Search) -> None:
    """With the second effect in place: its rivals in the first's place, and the second alone."""
    began = search.begin("look back")
    first, second = search.passes[-2], search.passes[-1]
    assert first.choice is not None
    assert second.choice is not None
    if _does_alone(search, second, NEARLY * second.choice.winner.error):
        search.timed("look back", began)
        return
    winner, kept = first.choice.winner, search.base.simulator.elements[-1]
    bare = search.base.simulator.without_last_element().without_last_element()
    others = rivals_beside(search, bare, kept)
    now = search.base.simulator, search.base.values, search.base.initial
    own_now, *found = _tried(
        search, [now, *((o.placed(kept), {**search.base.values, **o.values}, search.base.begin) for o in others)]
    )
    if own_now is not None and any(found):
        every = _led(search, [own_now, *(c for c in found if c is not None)])
        elements = [e for e, c in zip((o.element for o in others), found, strict=True) if c is not None]
        stay = replace(every[0], port=winner.port, law=winner.law, size=winner.size)
        pairs = zip(elements, every[1:], strict=True)
        rivals = [replace(c, port=e.port, law=e.law, size=e.law.size(e.own(c.fitted.values))) for e, c in pairs]
        if _gives_way(search, -2, stay, rivals) and not one_does_alone(search):
            _second_again(search)
    search.timed("look back", began)


def one_does_alone(search: Search) -> bool:
    """Whether one of the last two effects does as well without the other, which then goes."""
    steps = search.passes[-2:]
    together = min(p.choice.winner.error for p in steps if p.choice is not None)
    return any(_does_alone(search, step, (1 + LIKE) * together) for step in steps)


def _does_alone(search: Search, step: Pass, enough: float) -> bool:
    """Whether an error below `enough` is left without the other of the last two effects, which then goes."""
    assert step.choice is not None
    elements = search.base.simulator.elements[-2:]
    kept = next((e for e in elements if (e.port, e.law.id) == step.choice.winner.name), None)
    if kept is None:
        return False
    placed = search.base.simulator.without_last_element().without_last_element().with_element(kept.port, kept.law)
    own = placed.elements[-1].named(kept.own(search.base.values))
    alone = attempt(search.bench, placed, [{**search.base.values, **own}], states=search.base.begin)
    alone = search.polished(alone) if alone is not None and alone.error < enough else None
    if alone is None:
        return False
    search.base = alone.fitted
    search.passes[-2:] = [replace(step, choice=replace(step.choice, winner=alone))]
    return True


def _second_again(search: Search) -> None:
    """The second effect chosen again, beside the law that has come into the first's place."""
    second = search.passes[-1]
    assert second.choice is not None
    winner, kept = second.choice.winner, search.base.simulator.elements[-2]
    bare = search.base.simulator.without_last_element()
    others = [c for c in second.candidates if c.error < LED * winner.error and c is not winner]
    tasks: list[Task] = [(search.base.simulator, search.base.values, search.base.initial)]
    for c in [c for c in others if may_stand(c.element, kept)][:FITTED]:
        placed = bare.with_element(c.port, c.law)
        tasks.append((placed, {**search.base.values, **placed.elements[-1].named(c.own)}, search.base.begin))
    stay, *found = _tried(search, tasks)
    if stay is not None:
        _gives_way(search, -1, stay, [c for c in found if c is not None])


def _tried(search: Search, tasks: Sequence[Task]) -> list[Candidate | None]:
    return side_by_side(lambda t: attempt(search.bench, t[0], [t[1]], states=t[2]), tasks, search.workers)


def _gives_way(search: Search, index: int, stay: Candidate, rivals: Sequence[Candidate]) -> bool:
    """Choose again between an effect and its rivals; whether another takes its place."""
    step, tried = search.passes[index], [stay, *rivals]
    assert step.choice is not None
    again = choose(tried, step.before, search.floor2, search.effective_samples(tried))
    if again is None:
        return False
    gives_way = again.winner is not stay
    winner = search.polished(again.winner) if gives_way else stay
    if winner is None:
        return False
    search.base = winner.fitted if gives_way else search.base
    better = replace(step.choice, winner=winner, alike=again.alike, margin=again.margin)
    search.passes[index] = replace(step, choice=better)
    return gives_way


def _led(search: Search, tried: Sequence[Candidate]) -> list[Candidate]:
    """Laws in the first's place, the near ones fitted again beside what the second is with the nearest of them.

    The second was fitted beside another's error, and may have stayed at values that only this asked for.
    """
    best = min(tried, key=lambda c: c.error)

    def led(c: Candidate) -> Candidate:
        first, second = c.fitted.simulator.elements[-2:]
        if c is best or c.error > LED * best.error or first.port == second.port:
            return c
        own = first.of(c.fitted.values)
        shared = {k: v for k, v in best.fitted.values.items() if k in c.fitted.values}
        again = attempt(search.bench, c.fitted.simulator, [{**shared, **own}], states=c.fitted.begin)
        return again if again is not None and again.error < c.error else c

    return side_by_side(led, tried, search.workers)
