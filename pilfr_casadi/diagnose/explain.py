"""Full fits of the surviving pairs of port and law, the simulator's own parameters re-estimated with each.

Each pair is fitted to the first part of every recording, from several starts: the screen's best shapes on the refitted
and on the user's parameters, and led there by an observer. It is judged on the rest, and the best are fitted to
everything.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..compiled import make_engine
from ..gauss_newton import GaussNewton
from ..laws import Law
from ..recording import InputError, Recording
from ..simulator import Simulator
from .proof import deviations, shown
from .screen import Scored
from .workbench import QUICK, THOROUGH, Fitted, Workbench

HEAD = 0.7  # share of each recording that candidates are fitted to
BRIEF = GaussNewton(max_iterations=12, tolerance=1e-3, patience=4)
WEAK, NO_WORSE = 2.0, 1.03  # standard errors within which a part of a law is idle, and error without it
SHOWN = 3.0  # standard errors that a law's strength is from zero at least
REFINED, FIRST = 8, 3  # pairs fitted from several starts, and how many of them at first
SAME = 1.02  # times the mean square error of fits that came to the same place
BEHIND = 3.0  # times the best error of a pair that is not worth more starts
LONG = 12000  # samples that candidates are fitted to


@dataclass(frozen=True, eq=False)
class Candidate:
    """A port and law, fitted.

    Attributes
    ----------
    fitted : Fitted
        On the first part; on everything once `polished`.
    head, tail : float
        Mean square errors of the first part (fitted) and of the rest (not seen), in units of the outputs' variance.
    size : int
        Parameters of the law.
    """

    port: str
    law: Law
    fitted: Fitted
    head: float
    tail: float
    size: int
    full: float = np.nan

    @property
    def name(self) -> tuple[str, str]:
        """Port and law id."""
        return self.port, self.law.id

    @property
    def error(self) -> float:
        """Root of the geometric mean of both mean squares."""
        return float((self.head * self.tail) ** 0.25)

    @property
    def at_bound(self) -> bool:
        """Whether a parameter of the law is held back by one of its bounds."""
        prefix = self.fitted.simulator.elements[-1].prefix
        bounds = {k: p.bounds for k, p in self.fitted.model.parameters.items() if k.startswith(prefix)}
        return any(np.any((self.fitted.values[k] <= a) | (self.fitted.values[k] >= b)) for k, (a, b) in bounds.items())


def heads(recordings: Sequence[Recording], share: float = HEAD) -> tuple[Recording, ...]:
    """First part of each recording."""
    total, out = sum(map(len, recordings)), []
    for r in recordings:
        most = int(len(r) * min(1.0, LONG / (share * total)))
        cut = max(int(share * most), min(len(r), r.skip + 20))
        part = r.slice(0, cut)
        out.append(
            part.with_(initial="estimate", period=None)
            if isinstance(part.initial, str) and part.initial == "periodic"
            else part
        )
    return tuple(out)


def judged(bench: Workbench, fitted: Fitted) -> tuple[float, float]:
    """Mean square error on the first part and on the rest of each recording."""
    head, tail = [], []
    vector = fitted.vector
    firsts = heads(bench.recordings)
    for r, first, state in zip(bench.recordings, firsts, fitted.initial, strict=True):
        with np.errstate(over="ignore", invalid="ignore"):
            y = fitted.engine.simulate(fitted.model.drive(r), vector, state)[0]
            e = ((y - r.y) / bench.scale) ** 2
        cut = len(first)
        head.append(e[r.skip : cut])
        tail.append(e[cut:] if len(r) - cut > 5 else e[r.skip :])
    with np.errstate(over="ignore", invalid="ignore"):
        means = [float(np.mean(np.concatenate(part))) for part in (head, tail)]
    return means[0], means[1] if np.isfinite(means[1]) else np.inf


def survivors(scored: Sequence[Scored], keep: int = 10) -> list[tuple[str, type[Law], list[Scored]]]:
    """Pairs worth a full fit: the best of both lists and the best of each port."""
    chosen: dict[tuple[str, type[Law]], list[Scored]] = {}
    for source in ("simulation", "observer"):
        ranked = [s for s in scored if s.source == source]
        ports: set[str] = set()
        for i, s in enumerate(ranked):
            if i < keep or s.port not in ports:
                chosen.setdefault((s.port, type(s.law)), [])
            ports.add(s.port)
    for s in scored:
        if (s.port, type(s.law)) in chosen:
            chosen[s.port, type(s.law)].append(s)
    return [(port, law, entries) for (port, law), entries in chosen.items()]


def closed(
    simulator: Simulator, entry: Scored, start: Mapping[str, Any], sign: int
) -> tuple[Simulator, dict[str, Any]]:
    """The simulator with the law in its port, and its start values by full name."""
    law = entry.law
    limits: dict[str, tuple[Any, Any]] = dict(law.at(start).bounds(entry.local))
    if law.dissipative and sign:
        side = (0.0, np.inf) if sign > 0 else (-np.inf, 0.0)
        limits |= {name: side for name in law.strength if name not in law.signed}
    inside = {k: np.clip(v, *limits[k]) if k in limits else v for k, v in start.items()}
    placed = simulator.with_element(entry.port, law.at(inside, limits))
    prefix = placed.elements[-1].prefix
    return placed, {f"{prefix}{k}": v for k, v in inside.items()}


@dataclass(frozen=True, eq=False)
class _Pair:
    """A pair with its compiled model and its starts, best first."""

    placed: Simulator
    model: Any
    engine: Any
    starts: list[Mapping[str, Any]]
    states: list[np.ndarray]
    candidate: Candidate | None


def prepare(bench: Workbench, entries: Sequence[Scored], without: Fitted, sign: int, gain: np.ndarray | None) -> _Pair:
    """Compile a pair and fit it briefly from its best start."""
    first = entries[0]
    placed, _ = closed(without.simulator, first, first.starts[0], sign)
    model = bench.model(placed, gain)
    engine = make_engine(model, bench.engine)
    nominal = {k: p.value for k, p in without.simulator.parameters.items()}
    starts: list[Mapping[str, Any]] = []
    led: list[Mapping[str, Any]] = []  # the observer's best: its run may be near the truth where the simulation is not
    for entry in entries:
        for i, own in enumerate(entry.starts):
            _, named = closed(without.simulator, entry, own, sign)
            starts.append({**without.values, **named})
            if i == 0:
                led += [starts[-1]] if entry.source == "observer" else []
                starts.append({**nominal, **named})
    best, *rest = by_cost(bench, model, engine, starts, without)
    ranked = [best, *(s for s in led if s is not best), *(s for s in rest if not any(s is o for o in led))]
    brief = attempt(bench, placed, ranked[:1], states=without.begin, solver=BRIEF, model=model, engine=engine)
    return _Pair(placed, model, engine, ranked, without.begin, brief)


def refine(bench: Workbench, pair: _Pair, led: bool, runs: int = 3) -> Candidate | None:
    """Fit a pair from several starts, and `led` by the observer as well."""
    compiled = {"states": pair.states, "model": pair.model, "engine": pair.engine}
    starts = pair.starts[:runs]
    if pair.candidate is not None:
        starts = [pair.candidate.fitted.values, *starts[1:]]
    found = [pair.candidate]
    if led:
        found.append(attempt(bench, pair.placed, pair.starts[:1], anneal=(1.0, 0.1), **compiled))
    for start in starts:
        found.append(attempt(bench, pair.placed, [start], **compiled))
        heads = sorted(c.head for c in found[1:] if c)
        if len(heads) > 2 and heads[2] < SAME * heads[0]:  # three ways to the same place
            break
    return min((c for c in found if c is not None), key=lambda c: c.head, default=None)


def attempt(
    bench: Workbench, simulator: Simulator, starts: Sequence[Mapping[str, Any]], **options: Any
) -> Candidate | None:
    """Fit a simulator to the first parts and judge it on the rest; its last element is the candidate's law.

    `options` are those of `Workbench.fit`; None where every start diverges.
    """
    alone = len(simulator.elements) == len(bench.simulator.elements) + 1
    # a trend in time cannot be judged on a time that it has not seen; beside another effect it has to stand that all
    # the same, for what an integrator makes of that effect's error looks like a trend
    trend = alone and getattr(simulator.elements[-1].law, "id", "") == "drift"
    part = bench if trend else bench.on(heads(bench.recordings))
    try:
        fitted = part.fit(simulator, starts, **{"solver": QUICK, **options})
    except InputError:
        return None
    head, tail = judged(bench, fitted)
    element = simulator.elements[-1]
    values = {k: fitted.values[f"{element.prefix}{k}"] for k in element.law.parameters()}
    return Candidate(
        element.port, element.law, fitted, head, tail if np.isfinite(tail) else 1e12, element.law.size(values)
    )


def by_cost(
    bench: Workbench, model: Any, engine: Any, starts: Sequence[Mapping[str, Any]], without: Fitted
) -> list[Mapping[str, Any]]:
    """Starts in the order of their error as they stand on the first parts, from the initial states of a fit."""
    part, parameters = bench.on(heads(bench.recordings)), model.parameters

    def cost(start: Mapping[str, Any]) -> float:
        known = {k: v for k, v in start.items() if k in parameters}
        vector, total = np.clip(parameters.pack(known), parameters.lower, parameters.upper), 0.0
        for r, state in zip(part.recordings, without.begin, strict=True):
            full = np.zeros(model.n_state)
            full[: len(state)] = state
            with np.errstate(over="ignore", invalid="ignore"):
                y = engine.simulate(model.drive(r), vector, full)[0]
                total += float(np.sum(((y - r.y) / part.scale)[r.skip :] ** 2))
        return total if np.isfinite(total) else np.inf

    return sorted(starts, key=cost)


def polish(bench: Workbench, candidate: Candidate) -> Candidate:
    """Fit a candidate to everything; one whose strength may as well be zero lives off its initial state and is out."""
    candidate = simpler(bench, candidate)
    placed = candidate.fitted.corrected()  # sub-steps for the law as it was fitted
    out = replace(candidate, head=np.inf, tail=np.inf, full=np.inf)
    try:
        fitted = bench.fit(placed, [candidate.fitted.values], states=candidate.fitted.initial, solver=THOROUGH)
    except InputError:
        return out
    if shown(bench, fitted) < SHOWN:
        return out
    done = replace(candidate, fitted=fitted, full=fitted.cost)
    plain = simpler(bench, done, deviations(bench, fitted))
    return done if plain is done else polish(bench, plain)


def simpler(bench: Workbench, candidate: Candidate, std: Mapping[str, np.ndarray] | None = None) -> Candidate:
    """A law one of whose strengths is zero is the law that it refines, started where it stands.

    With standard errors, what may as well be zero counts as zero.
    """
    element = candidate.fitted.simulator.elements[-1]
    if element.port != candidate.port or type(element.law) is not type(candidate.law):  # another was put in after it
        return candidate
    plain: Any = type(candidate.law).__base__
    own = {
        k.removeprefix(element.prefix): v for k, v in candidate.fitted.values.items() if k.startswith(element.prefix)
    }
    doubt = {name: WEAK * std[f"{element.prefix}{name}"] if std else 0.0 for name in candidate.law.strength}
    idle = [name for name, most in doubt.items() if np.all(np.abs(own[name]) <= most)]
    if not idle or not getattr(plain, "units", {}) or not set(plain.units) <= set(own) - set(idle):
        return candidate
    if not set(candidate.law.places) <= set(plain.places):
        return candidate
    law = plain().at(
        {k: own[k] for k in plain.units}, {k: v for k, v in candidate.law.limits.items() if k in plain.units}
    )
    placed = candidate.fitted.simulator.without_last_element().with_element(element.port, law)
    found = attempt(bench, placed, [candidate.fitted.values], states=candidate.fitted.begin)
    return found if found is not None and found.error < (NO_WORSE if std else 1.01) * candidate.error else candidate


def explain(
    bench: Workbench,
    scored: Sequence[Scored],
    without: Fitted,
    signs: Mapping[str, int],
    gain: np.ndarray | None,
    workers: int,
    enough: float,
    report: Callable[[int, int, float], None],
) -> list[Candidate]:
    """Every survivor fitted, smallest error first.

    Where one of the first comes below the error `enough`, those that are far behind it are not refined.
    """
    pairs = survivors(scored)
    done, total = 0, len(pairs) + min(len(pairs), REFINED)

    def step(found: Sequence[Candidate | None]) -> None:
        nonlocal done
        done += 1
        report(done, total, min((c.error for c in found if c), default=np.inf))

    pool = ThreadPoolExecutor(workers)
    try:
        tasks = [pool.submit(prepare, bench, entries, without, signs[port], gain) for port, _, entries in pairs]
        prepared = []
        for task in tasks:
            prepared.append(task.result())
            step([p.candidate for p in prepared])
        prepared.sort(key=lambda p: p.candidate.error if p.candidate else np.inf)
        found: list[Candidate | None] = []
        for group in (prepared[:FIRST], prepared[FIRST:REFINED]):
            best = min((c.error for c in found if c), default=np.inf)
            near = [p for p in group if best > enough or (p.candidate and p.candidate.error < BEHIND * best)]
            again = [pool.submit(refine, bench, pair, gain is not None) for pair in near]
            found += [p.candidate for p in group if p not in near]
            for refined in again:
                found.append(refined.result())
                step(found)
        found += [p.candidate for p in prepared[REFINED:]]
        report(total, total, min((c.error for c in found if c), default=np.inf))
    finally:
        pool.shutdown(cancel_futures=True)
    return sorted((c for c in found if c is not None), key=lambda c: c.error)
