"""Laws that may stand in the first effect's place, now that the second is known."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Any

from ..laws import Attached
from ..simulators import Placed, Simulator, in_series
from .explain import closed
from .kinship import CONTAINS, complements

if TYPE_CHECKING:
    from .search import Search

FITTED = 6  # laws of the first's port that were fitted in its place
WIDER = 2  # that have it as a special case and were not
CARRIED = 2  # ports of a part that is carried along


@dataclass(frozen=True)
class Rival:
    """A law alone in its port, with its values by full name."""

    simulator: Simulator
    values: dict[str, Any]

    @property
    def element(self) -> Placed:
        """Where it stands."""
        return self.simulator.elements[-1]

    def placed(self, kept: Placed) -> Simulator:
        """With the second effect."""
        return self.simulator.with_element(kept.port, kept.law)


def rivals_beside(search: Search, bare: Simulator, kept: Placed) -> list[Rival]:
    """Rivals of the first of the last two effects, the second `kept`; `bare` is the simulator without both."""
    out = list[Rival]()
    for found, most in (
        (_fitted_before(search, bare), FITTED),
        (_never_fitted(search, bare), WIDER),
        (_carried_along(search, bare), CARRIED),
    ):
        out += islice((r for r in found if may_stand(r.element, kept)), most)
    return out


def may_stand(one: Placed, kept: Placed) -> bool:
    """Whether a law may stand where it does beside another effect."""
    return one.port != kept.port or complements(one.law, kept.law)


def _fitted_before(search: Search, bare: Simulator) -> Iterator[Rival]:
    """What was fitted at the first effect's port in its place, best first."""
    first = search.passes[-2]
    assert first.choice is not None
    winner = first.choice.winner
    for c in first.candidates:
        if c.port == winner.port and type(c.law) is not type(winner.law):
            own = c.fitted.simulator.elements[-1]
            yield Rival(bare.with_element(own.port, own.law), own.of(c.fitted.values))


def _never_fitted(search: Search, bare: Simulator) -> Iterator[Rival]:
    """What has the first law as a special case, where the screen did not let it through: the second effect hid it."""
    first = search.passes[-2]
    assert first.choice is not None
    winner, seen = first.choice.winner, {(c.port, type(c.law)) for c in first.candidates}
    for s in first.scored:
        wider = winner.law.id in CONTAINS.get(s.law.id, ()) and s.law.scaled_by == winner.law.scaled_by
        if s.port == winner.port and wider and (s.port, type(s.law)) not in seen:
            seen.add((s.port, type(s.law)))
            yield Rival(*closed(bare, s, s.starts[0]))


def _carried_along(search: Search, bare: Simulator) -> Iterator[Rival]:
    """A part that is carried along, at other ports, where the first effect is a mode beside a signal's path.

    A pole and a zero more are all of these; beside the second effect the first is now seen by itself.
    """
    element = search.base.simulator.elements[-2]
    if element.law.form != "mode" or not in_series(element.port):
        return
    own = element.own(search.base.values)
    found = {k: own[k] for k in ("W", "D")}
    seen = set[str]()
    for s in search.passes[-2].scored:
        if isinstance(s.law, Attached) and s.port not in seen:
            seen.add(s.port)
            yield Rival(*closed(bare, s, {**s.starts[0], **found}))
