"""Two effects looked for at once, where one after the other explains too little or is not sure: each hides the other.

Every pair of laws at two ports is scored together along the refitted simulation. With orthonormal columns Q_a and Q_b
of what small doses of the two change (`remainder`) and e' what is left of the error, the share that they explain is

    |Q_aᵀ e'|² + rᵀ (I - W Wᵀ)⁻¹ r,    r = Q_bᵀ e' - W Q_aᵀ e',    W = Q_bᵀ Q_a

The best pairs are fitted together; then each law of the best is put up against every other, the other one in place.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from .._base import side_by_side
from ..engine import make_engine
from .candidate import Candidate, attempt
from .explain import BRIEF, closed
from .kinship import handicap
from .linearise import linearised
from .remainder import Dose, Remainder, held_out, orthonormal
from .review import one_does_alone
from .screen import Scored, start_values
from .workbench import Fitted, started

if TYPE_CHECKING:
    from .search import Pass, Search

SHAPES = 5  # of each law at each port, the best alone
PLACES, LAWS = 4, 2  # pairs of ports that are tried, and pairs of laws at each
LOOKED_AT = 60  # pairs of laws whose share is cross-validated
RIDGE = 1e-4
AS_FAR = 1.25  # times the error so far of a pair that is worth putting its laws up against all others
WORTH = 0.8  # times the error so far that a pair has to come to
PROMISING = 0.9  # of the mean square so far that a pair leaves at most after the first round
ROUNDS = 3  # times that one law is put up against all others


@dataclass(frozen=True, eq=False)
class _Block:
    """A law of one shape at a port, and what it changes."""

    scored: Scored
    dose: Dose


def _blocks(rest: Remainder) -> Iterator[_Block]:
    for task in rest.tasks:
        for law, doses in rest.doses(task):
            felt, sense = [d for d in doses if np.any(d.phi)], rest.runs[0].sense(law, task.index)
            shares = [float(np.sum((orthonormal(d.phi).T @ rest.left) ** 2)) for d in felt]
            for k in np.argsort(shares)[::-1][:SHAPES]:
                scored = Scored(task.port.name, law, shares[k], (), task.local, sense)
                yield _Block(scored, replace(felt[k], phi=felt[k].phi.copy()))


def together(parts: Sequence[np.ndarray], left: np.ndarray) -> np.ndarray:
    """Share of `left` that each two parts explain together, shape (n, n); parts are orthonormal columns."""
    q, width = np.hstack(parts), [p.shape[1] for p in parts]
    begin = np.cumsum([0, *width])
    gram, right = q.T @ q, q.T @ left
    out = np.zeros((len(parts), len(parts)))
    of_width = {w: np.flatnonzero(np.equal(width, w)) for w in set(width)}
    for i in range(len(parts)):
        own = slice(begin[i], begin[i + 1])
        rest = right - gram[:, own] @ right[own]
        for w, which in of_width.items():
            at = begin[which][:, None] + np.arange(w)
            r, across = rest[at], gram[:, own][at]
            inner = (1 + RIDGE) * np.eye(w) - across @ np.swapaxes(across, 1, 2)
            gained = np.einsum("jk,jk->j", r, np.linalg.solve(inner, r[:, :, None])[:, :, 0])
            out[i, which] = right[own] @ right[own] + gained
    return np.asarray(out / max(float(left @ left), 1e-300))


def promising(rest: Remainder) -> list[tuple[_Block, _Block]]:
    """Pairs worth a fit, best first: a few of each of the best pairs of ports."""
    blocks = list(_blocks(rest))
    if len(blocks) < 2:
        return []
    left = 1 - together([orthonormal(b.dose.phi) for b in blocks], rest.left)
    ports, factor = np.array([b.scored.port for b in blocks]), np.array([handicap(b.scored.law) for b in blocks])
    worth = np.maximum(left, 0.0) * np.outer(factor, factor) ** 2
    worth[ports[:, None] == ports] = np.inf
    seen: dict[tuple[Any, ...], tuple[float, tuple[_Block, _Block]]] = {}
    for flat in np.argsort(worth, axis=None):
        i, j = np.unravel_index(flat, worth.shape)
        if len(seen) >= LOOKED_AT or not np.isfinite(worth[i, j]):
            break
        pair = blocks[min(i, j)], blocks[max(i, j)]
        key = tuple((b.scored.port, type(b.scored.law)) for b in pair)
        if key not in seen and _opposes(pair, rest.left):
            kept = 1 - held_out(np.hstack([b.dose.phi for b in pair]), rest.left, rest.odd)
            seen[key] = (kept * (factor[i] * factor[j]) ** 2, pair)
    chosen: dict[tuple[str, str], list[tuple[_Block, _Block]]] = {}
    for _, pair in sorted(seen.values(), key=lambda s: s[0]):
        place = pair[0].scored.port, pair[1].scored.port
        if (place in chosen or len(chosen) < PLACES) and len(chosen.setdefault(place, [])) < LAWS:
            chosen[place].append(pair)
    return [pair for pairs in chosen.values() for pair in pairs]


def _strengths(pair: tuple[_Block, _Block], left: np.ndarray) -> list[np.ndarray]:
    """Strengths of both laws that explain most together."""
    phi = np.hstack([b.dose.phi for b in pair])
    found = -np.linalg.lstsq(phi, left, rcond=1e-8)[0] / np.concatenate([b.dose.size for b in pair])
    return np.split(found, [len(pair[0].dose.size)])


def _opposes(pair: tuple[_Block, _Block], left: np.ndarray) -> bool:
    """Whether the laws that must oppose motion, or push back, do."""
    for block, found in zip(pair, _strengths(pair, left), strict=True):
        if len(found) == 1 and block.scored.sense * found[0] < 0:
            return False
    return True


def _fitted_together(search: Search, rest: Remainder, pair: tuple[_Block, _Block]) -> Candidate | None:
    """A pair fitted from what the screen says of it, and the simulator's parameters as refitted and as given."""
    simulator, named = search.without.simulator, dict[str, Any]()
    for block, strength in zip(pair, _strengths(pair, rest.left), strict=True):
        start = start_values(block.scored.law, block.dose.shape, strength)
        simulator, own = closed(simulator, block.scored, start)
        named |= own
    nominal = {k: p.value for k, p in search.without.simulator.parameters.items()}
    starts = [{**search.without.values, **named}, {**nominal, **named}]
    return attempt(search.bench, simulator, starts, states=search.without.begin, solver=BRIEF)


def _beside(search: Search, joint: Fitted, kept: Any) -> Fitted:
    """The simulator with one law of a pair, at the values that it has beside the other."""
    simulator = search.bench.simulator.with_element(kept.port, kept.law)
    model = search.bench.model(simulator)
    known = {k: v for k, v in joint.values.items() if k in model.parameters}
    initial = search.bench.begun(simulator, model, started(model, known), joint.begin)
    return search.bench.result(simulator, known, initial, make_engine(model, search.bench.engine), model)


def two_at_once(search: Search) -> None:
    """Look for two effects together; the search goes over to them where they explain what it has not."""
    before, better = (search.base, list(search.passes), search.open_after, search.floor), False
    certainty = search.certainty()
    try:
        found = _two(search)
        better = found is not None and _better(search, found, before[0].cost)
        if better and one_does_alone(search):
            search.open_after = search.flexible(search.base)
        better = better and search.certainty() > certainty
    finally:  # an interrupt leaves what there was
        if not better:
            search.base, search.passes, search.open_after, search.floor = before


def _better(search: Search, found: tuple[Fitted, list[Pass]], cost: float) -> bool:
    search.base, search.passes = found
    search.open_after = search.flexible(search.base)
    return len(search.passes) == 2 and search.base.cost < WORTH**2 * cost


def _two(search: Search) -> tuple[Fitted, list[Pass]] | None:
    """Both laws fitted, and the pass that put each up against all others."""
    began, bench = search.begin("two at once"), search.bench
    rest = Remainder.of(bench, *linearised(bench, search.without), search.laws)
    pairs = promising(rest)
    fits = side_by_side(lambda pair: _fitted_together(search, rest, pair), pairs, search.workers)
    best = min((c for c in fits if c is not None), key=lambda c: c.error, default=None)
    best = search.polished(best) if best is not None else None
    search.timed("two at once", began)
    if best is None or best.full > AS_FAR**2 * search.base.cost:
        return None
    joint, passes, before = best.fitted, dict[str, Any](), search.base.cost
    elements = list(joint.simulator.elements[-2:])
    for k in range(ROUNDS):
        kept, other = elements
        search.base = _beside(search, joint, kept)
        step = search.pass_(1, search.screened())
        if step.choice is None:
            return None
        joint = step.choice.winner.fitted
        if joint.cost > PROMISING * before:
            return None
        new = joint.simulator.elements[-1]
        same = (new.port, type(new.law)) == (other.port, type(other.law))
        passes = {kept.port: passes.get(kept.port), new.port: replace(step, accepted=True)}
        elements = [new, joint.simulator.elements[-2]]
        if k and same:
            break
    steps = [p for p in passes.values() if p is not None]
    # strongest first: the one without which the other is further off
    return joint, sorted(steps, key=lambda p: -p.before[0])
