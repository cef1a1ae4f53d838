"""Further hypotheses that the screen did not select: relatives of the best ones, and pairs of laws at once.

A relative is a pair of port and law with its own start values; each function selects one kind of them.

Two effects may hide each other, so that neither law explains enough alone. Then every pair of laws at two ports is
scored along the refitted simulation. Let Q_a and Q_b be orthonormal columns of the output changes by small doses of the
two (`screen`), and e' the remaining error. The pair explains the share

    |Q_aᵀ e'|² + rᵀ (I - W Wᵀ)⁻¹ r,    r = Q_bᵀ e' - W Q_aᵀ e',    W = Q_bᵀ Q_a

of it. The best pairs are fitted.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...laws import (
    DRAGS,
    DRY,
    SMALL_AND_LARGE,
    Attached,
    Delay,
    Lag,
    Law,
    Local,
    Resonance,
    SprungMass,
    TermLimit,
    unit_forces,
)
from ...simulators import PARAMETER, in_series, kind_of
from ..fits.evidence import FAR_RATIO, NEAR_RATIO
from ..fits.force_recovery import forces_of_change
from ..fits.linearise import port_signals
from ..fits.screen import HUGE, Dose, Pair, Remainder, Scored, fit_shapes, held_out, orthonormal, start_values
from ..fits.workbench import BRIEF, FEW, Fitted, Workbench
from .trials import Trial, Trials, place_law

RESONANCE_DAMPINGS = (0.25, 0.6)  # damping ratios of the resonances tried in place of a delay or a lag
SHAPES_OF_A_LAW = 5  # shapes of each law at each port: the best alone
PLACES, LAWS = 4, 2  # pairs of ports that are tried, and pairs of laws at each pair of ports
MOST_PAIRS = 60  # pairs of laws whose share is cross-validated
RIDGE = 1e-4  # on the gram matrix of orthonormal columns, against nearly parallel laws
MATCHED_SAMPLES = 4000  # approximate number of samples on which a law is matched to a force


def complements(one: Law, other: Law) -> bool:
    """Tell whether two laws of a port are different physics: one opposes motion, the other is a curve of position.

    So are dry friction and a drag that grows with speed, a dead zone and a saturation, and two curves of position if a
    signal, such as a pressure, varies the strength of one alone. A constant offset may stand beside any other law, and
    so may a limit of a force that the equations have, because it acts on that force alone. A mass on a spring may
    stand beside any force without such a mass. The path of a signal may have a delay, a lag, and a curve
    or a memory of its size.
    """
    if "offset" in (one.id, other.id):
        return one.id != other.id
    if any(isinstance(law, TermLimit) for law in (one, other)):
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


def relatives(bench: Workbench, trials: Sequence[Trial], scored: Sequence[Scored]) -> list[Scored]:
    """Select further pairs of port and law for a fit; trials and scored entries are best first."""
    if not trials:
        return []
    found = [
        entry
        for some in (
            _extended_laws,  # first those that begin at values of a fitted law, because a step fits only so many
            _simpler_laws,
            _forms_of_the_best,
            _special_cases,
            _other_forms,
            _attached_masses,
            _damped_resonances,
            _other_end,
        )
        for entry in some(trials, scored)
    ]
    return [*found, *_matching_forces(bench, trials, scored)]


def _near(trials: Sequence[Trial]) -> set[Pair]:
    """Return the pairs of port and law that came near the best error."""
    return {t.pair for t in trials if t.error < NEAR_RATIO * trials[0].error}


def _special_cases(trials: Sequence[Trial], scored: Sequence[Scored]) -> list[Scored]:
    """Select special cases of the best law at its port that did not come near, as from a wrong minimum."""
    best, near = trials[0], _near(trials)
    cases = best.law.contains
    return [s for s in scored if s.port == best.port and s.law.id in cases and s.pair not in near]


def _other_forms(trials: Sequence[Trial], scored: Sequence[Scored]) -> list[Scored]:
    """Select untried forms of the laws that came near."""
    tried, near = {t.pair for t in trials}, {(port, law.id) for port, law in _near(trials)}
    return _first_of_pairs(s for s in scored if (s.port, s.law.id) in near and s.pair not in tried)


def _forms_of_the_best(trials: Sequence[Trial], scored: Sequence[Scored]) -> list[Scored]:
    """Select forms of the best law that did not come near: those that share most of its shape, from its values."""
    best, near = trials[0], _near(trials)
    shape = {name: value for name, value in best.own.items() if name in best.law.free - set(best.law.strength)}
    out = list[tuple[int, Scored]]()
    for s in _first_of_pairs(s for s in scored if (s.port, s.law.id) == best.name and s.pair not in near):
        shared = {k: v for k, v in shape.items() if k in s.law.free and s.law.units[k] == best.law.units[k]}
        if shared:
            out.append((len(shared), replace(s, starts=({**s.starts[0], **shared},))))
    return [entry for _, entry in sorted(out, key=lambda found: -found[0])[:FEW]]


def _first_of_pairs(entries: Iterable[Scored]) -> list[Scored]:
    out: dict[Pair, Scored] = {}
    for s in entries:
        out.setdefault(s.pair, s)
    return list(out.values())


def _attached_masses(trials: Sequence[Trial], scored: Sequence[Scored]) -> list[Scored]:
    """Select attached masses at every port where none came near, from frequency and damping of the best resonance."""
    best, near = trials[0], _near(trials)
    if not {"W", "D"} <= set(best.law.units) or isinstance(best.law, Attached):
        return []
    found = {k: float(np.ravel(best.own[k])[0]) for k in ("W", "D")}
    return _with_starts((s for s in scored if isinstance(s.law, Attached) and s.pair not in near), [found])


def _damped_resonances(trials: Sequence[Trial], scored: Sequence[Scored]) -> list[Scored]:
    """Select damped resonances in place of a delay or a lag T that came near: at low frequencies T = 2 D / W."""
    late: dict[str, float] = {}
    for t in trials:
        if isinstance(t.law, Delay | Lag) and t.error < FAR_RATIO * trials[0].error and t.port not in late:
            late[t.port] = float(np.ravel(t.own["T"])[0])
    out = []
    for port, time in late.items():
        starts = [{"W": 2 * damping / time, "D": damping} for damping in RESONANCE_DAMPINGS]
        out += _with_starts((s for s in scored if isinstance(s.law, Resonance) and s.port == port), starts)
    return out


def _other_end(trials: Sequence[Trial], scored: Sequence[Scored]) -> list[Scored]:
    """Select the best law at every actuator and sensor where it did not come near.

    Only a law with its own time scale, or one of the time alone, acts alike at both ends.
    """
    best, near = trials[0], _near(trials)
    if not in_series(best.port) or not (best.law.order or best.law.shifts or best.law.reads() == {"t"}):
        return []
    times = {k: best.own[k] for k, unit in best.law.units.items() if unit in ("s", "rad/s", "")}
    same = (s for s in scored if type(s.law) is type(best.law) and in_series(s.port) and s.pair not in near)
    return _with_starts(same, [times]) if times else _first_of_pairs(same)


def _with_starts(entries: Iterable[Scored], starts: Sequence[dict[str, Any]]) -> list[Scored]:
    """Return the first entry of each pair, with starts at some given values added."""
    return [
        replace(s, starts=(*({**own, **start} for own in s.starts for start in starts), *s.starts))
        for s in _first_of_pairs(entries)
    ]


def _extended_laws(trials: Sequence[Trial], scored: Sequence[Scored]) -> list[Scored]:
    """Select laws with one more term than one that came near, if worse or untried: from its values.

    A law that follows a part of the recordings best and diverges on the rest may lack the term that bounds it.
    """
    near, least = _near(trials), {t.pair: t.error for t in reversed(trials)}
    unbounded = [t for t in trials if t.mean_square == np.inf and t.part_mean_square < trials[0].part_mean_square]
    out: dict[Pair, Scored] = {}
    for t in [*(t for t in trials if t.pair in near), *unbounded]:
        for s in scored:
            wider = s.port == t.port and isinstance(s.law, type(t.law)) and type(s.law) is not type(t.law)
            worse = s.pair not in least or least[s.pair] > t.error
            if wider and worse and s.pair not in out:
                starts = tuple(filter(None, (s.law.starts_as(t.law, t.own, shape) for shape in s.starts)))
                out |= {s.pair: replace(s, starts=starts, beside=t.fitted.values)} if starts else {}
    return list(out.values())


def _simpler_laws(trials: Sequence[Trial], scored: Sequence[Scored]) -> list[Scored]:
    """Select the law that one which came near refines, if untried or far worse: from its values."""
    near, out = _near(trials), dict[Pair, Scored]()
    for t in (t for t in trials if t.pair in near):
        plain: Any = type(t.law).__base__
        pair, units = (t.port, plain), set(getattr(plain, "units", {}))
        if not units or not units <= set(t.law.units) or pair in near or pair in out:
            continue
        entry = next((s for s in scored if s.pair == pair), None)
        if entry is not None:
            out[pair] = replace(entry, starts=({k: t.own[k] for k in plain.units},))
    return list(out.values())


def _matching_forces(bench: Workbench, trials: Sequence[Trial], scored: Sequence[Scored]) -> list[Scored]:
    """Select laws with fewer parameters than the best law, at its port, with the most similar force.

    They start with everything else where the best hypothesis has it. None if the best law is not flexible.
    """
    best, near = trials[0], _near(trials)
    if not best.law.flexible:
        return []
    there = (s for s in scored if s.port == best.port and s.pair not in near)
    entries = _first_of_pairs(s for s in there if s.law.size(s.starts[0]) < best.law.size(best.own))
    return _most_alike(bench, best, entries, {best.port: _added_force(bench, best)}) if entries else []


def in_place_of_variation(bench: Workbench, best: Trial, scored: Sequence[Scored]) -> list[Scored]:
    """Select laws with constant parameters, no more of them, whose force is most like that of a law that varies.

    The added law of the best hypothesis varies with a signal. If it is a parameter, its change acts at some ports as a
    force: a stiffness that varies with its own deflection is a stiffening spring.
    """
    force, most = _added_force(bench, best), best.law.size(best.own)
    forces = (
        forces_of_change(bench, best.fitted, best.port, force)
        if kind_of(best.port) == PARAMETER
        else {best.port: force}
    )
    plain = (s for s in scored if s.port in forces and not (s.law.flexible or s.law.scheduled_by or s.law.scaled_by))
    return _most_alike(bench, best, _first_of_pairs(s for s in plain if s.law.size(s.starts[0]) <= most), forces)


def _added_force(bench: Workbench, trial: Trial) -> np.ndarray:
    """Compute the force, or the change of a parameter, by the added law of a hypothesis along its runs, (M,)."""
    values, law = trial.own, trial.law
    shape = {k: v for k, v in values.items() if k not in law.strength}
    strengths = np.concatenate([np.ravel(values[k]) for k in law.strength]) if law.strength else np.ones(1)
    local = port_signals(bench, trial.fitted, trial.port)
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(unit_forces(law.at(values), local, [shape])[:, 0] @ strengths)


def _most_alike(
    bench: Workbench, best: Trial, entries: Iterable[Scored], forces: Mapping[str, np.ndarray]
) -> list[Scored]:
    """Select the entries whose laws are most like the force at their port, starting there; `best` gives the rest."""
    local = {port: port_signals(bench, best.fitted, port) for port in forces}
    # also excludes nan, for example from the root of a negative number
    bounded = {k for k, v in local.items() if np.all(np.abs([v.z, v.dz, forces[k]]) < HUGE)}
    with np.errstate(over="ignore", invalid="ignore"):
        found = [(*_match_force(s.law, local[s.port], forces[s.port]), s) for s in entries if s.port in bounded]
    ranked = sorted((f for f in found if f[0] < 1), key=lambda f: f[0])[:FEW]
    return [replace(s, starts=(start, *s.starts), beside=best.fitted.values) for _, start, s in ranked]


def _match_force(law: Law, local: Local, force: np.ndarray) -> tuple[float, dict[str, Any]]:
    """Compute the share of a force that a law leaves, beside gains of the signal and its rate, and its start values."""
    shapes = list(law.shapes(local))
    every = max(len(force) // MATCHED_SAMPLES, 1)
    base = np.column_stack([np.ones_like(local.z), local.z, local.dz])[::every]
    q = np.linalg.svd(base / np.maximum(np.linalg.norm(base, axis=0), 1e-300), full_matrices=False)[0]
    target = force[::every] - q @ (q.T @ force[::every])
    total, best, start = float(target @ target), np.inf, dict[str, Any]()
    made = unit_forces(law, local, shapes)[::every]
    for k, found, fit in fit_shapes((a - q @ (q.T @ a) for a in np.moveaxis(made, 1, 0)), target):
        if not law.strength and found[0] <= 0:  # the simulator's gain may scale the force, but not change its sign
            continue
        left = float(np.sum((target - fit) ** 2)) / max(total, 1e-300)
        if left < best:
            best, start = left, start_values(law, shapes[k], found)
    return best, start


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
