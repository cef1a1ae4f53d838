"""Pairs of laws: which may stand at one port, and which explain most together.

Two effects may hide each other, so that neither law explains enough alone. Then every pair of laws at two ports is
scored along the refitted simulation. Let Q_a and Q_b be orthonormal columns of the output changes by small doses of the
two (`screen`), and e' the remaining error. The pair explains the share

    |Q_aᵀ e'|² + rᵀ (I - W Wᵀ)⁻¹ r,    r = Q_bᵀ e' - W Q_aᵀ e',    W = Q_bᵀ Q_a

of it. The best pairs are fitted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...laws import DRAGS, DRY, SMALL_AND_LARGE, Law, SprungMass, TermLimit
from ..fits.screen import Dose, Remainder, Scored, held_out, orthonormal, start_values
from ..fits.workbench import BRIEF, Fitted
from .trials import Trial, Trials, place_law

SHAPES_OF_A_LAW = 5  # shapes of each law at each port: the best alone
PLACES, LAWS = 4, 2  # pairs of ports that are tried, and pairs of laws at each pair of ports
MOST_PAIRS = 60  # pairs of laws whose share is cross-validated
RIDGE = 1e-4  # on the gram matrix of orthonormal columns, against nearly parallel laws


def complements(one: Law, other: Law) -> bool:
    """Tell whether two laws of a port are different physics: one opposes motion, the other is a curve of position.

    So are dry friction and a drag that grows with speed, a dead zone and a saturation, and two curves of position if a
    signal, such as a pressure, varies the strength of one alone. A constant offset may stand beside any other law, and
    so may a limit of a force that the equations have, because it acts on that force alone. A mass on a spring may
    stand beside any force without such a mass. The path of a signal may have a delay, a lag, and a curve
    or a memory of its size.
    """
    if any(law.id == "offset" or isinstance(law, TermLimit) for law in (one, other)):
        return one.id != other.id
    if "delay" in (one.id, other.id) or any(
        law.id == "extra_mode" and law.places == ("series",) for law in (one, other)
    ):
        return (one.shifts, one.order > 0) != (other.shifts, other.order > 0)
    sprung = [isinstance(law, SprungMass) for law in (one, other)]
    if any(sprung):
        plain = other if sprung[0] else one
        return not all(sprung) and plain.order == 0
    if any(a.id in DRY and b.id in DRAGS for a, b in ((one, other), (other, one))):
        return True
    if {one.id, other.id} == set(SMALL_AND_LARGE):
        return True
    rubs, springs = sorted((one, other), key=lambda law: not law.dissipative)
    if _is_curve(rubs):
        varied = [bool(law.scaled_by or law.scheduled_by not in ("", "z")) for law in (one, other)]
        return _is_curve(springs) and varied[0] != varied[1]
    return rubs.dissipative and _is_curve(springs) and rubs.id not in ("creep", "extra_mode")


def _is_curve(law: Law) -> bool:
    """Tell whether a law is a curve of position, without memory; a contact may depend on the speed as well."""
    return not law.dissipative and "z" in law.reads() and not hasattr(law, "step") and law.order == 0


@dataclass(frozen=True, eq=False)
class _Block:
    """A law of one shape at a port, and its dose."""

    scored: Scored
    dose: Dose


def _blocks(rest: Remainder) -> Iterator[_Block]:
    for task in rest.tasks:
        for law, doses in rest.doses(task):
            felt, sense = [d for d in doses if np.any(d.phi)], rest.runs[0].sense(law, task.index)
            shares = [float(np.sum((orthonormal(d.phi).T @ rest.left) ** 2)) for d in felt]
            for k in np.argsort(shares)[::-1][:SHAPES_OF_A_LAW]:
                scored = Scored(task.port.name, law, shares[k], (), task.local, sense)
                yield _Block(scored, replace(felt[k], phi=felt[k].phi.copy()))


def pair_shares(parts: Sequence[np.ndarray], left: np.ndarray) -> np.ndarray:
    """Compute the share of `left` that each two parts explain together, shape (n, n); parts are orthonormal columns."""
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


def choose_pairs(rest: Remainder) -> list[tuple[_Block, _Block]]:
    """Choose the pairs worth a fit, best first: a few of each of the best pairs of ports.

    Both laws may act at one port if they are different physics there.
    """
    blocks = list(_blocks(rest))
    if len(blocks) < 2:
        return []
    left = 1 - pair_shares([orthonormal(b.dose.phi) for b in blocks], rest.left)
    ports = np.array([b.scored.port for b in blocks])
    laws = list({type(b.scored.law): b.scored.law for b in blocks}.values())
    number = np.array([next(k for k, law in enumerate(laws) if type(law) is type(b.scored.law)) for b in blocks])
    together = np.array([[complements(one, other) for other in laws] for one in laws])
    worth = np.maximum(left, 0.0)
    worth[(ports[:, None] == ports) & ~together[np.ix_(number, number)]] = np.inf
    seen: dict[tuple[Any, ...], tuple[float, tuple[_Block, _Block]]] = {}
    for flat in np.argsort(worth, axis=None):
        i, j = np.unravel_index(flat, worth.shape)
        if len(seen) >= MOST_PAIRS or not np.isfinite(worth[i, j]):
            break
        pair = blocks[min(i, j)], blocks[max(i, j)]
        key = tuple(b.scored.pair for b in pair)
        if key not in seen and _opposes(pair, rest.left):
            kept = 1 - held_out(np.hstack([b.dose.phi for b in pair]), rest.left, rest.odd)
            seen[key] = (kept, pair)
    chosen: dict[tuple[str, str], list[tuple[_Block, _Block]]] = {}
    for _, pair in sorted(seen.values(), key=lambda s: s[0]):
        place = pair[0].scored.port, pair[1].scored.port
        if (place in chosen or len(chosen) < PLACES) and len(chosen.setdefault(place, [])) < LAWS:
            chosen[place].append(pair)
    return [pair for pairs in chosen.values() for pair in pairs]


def _strengths(pair: tuple[_Block, _Block], left: np.ndarray) -> list[np.ndarray]:
    """Compute the strengths of both laws that explain most together."""
    phi = np.hstack([b.dose.phi for b in pair])
    found = -np.linalg.lstsq(phi, left, rcond=1e-8)[0] / np.concatenate([b.dose.size for b in pair])
    return np.split(found, [len(pair[0].dose.size)])


def _opposes(pair: tuple[_Block, _Block], left: np.ndarray) -> bool:
    """Tell whether each law that must oppose motion, or push back, has the right sign."""
    for block, found in zip(pair, _strengths(pair, left), strict=True):
        if len(found) == 1 and block.scored.sense * found[0] < 0:
            return False
    return True


def fit_pair(trials: Trials, root: Fitted, rest: Remainder, pair: tuple[_Block, _Block]) -> Trial | None:
    """Fit a pair from its screened start values, with the simulator's parameters as refitted and as given."""
    simulator, named = root.simulator, dict[str, Any]()
    for block, strength in zip(pair, _strengths(pair, rest.left), strict=True):
        start = start_values(block.scored.law, block.dose.shape, strength)
        simulator, own = place_law(simulator, block.scored, start)
        named |= own
    nominal = {k: p.value for k, p in root.simulator.parameters.items()}
    starts = [{**root.values, **named}, {**nominal, **named}]
    return trials.fit(simulator, starts, 2, states=root.begin, solver=BRIEF)
