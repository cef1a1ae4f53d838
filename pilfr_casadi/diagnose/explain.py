"""Full fits of the surviving pairs of port and law, the simulator's own parameters re-estimated with each.

Each pair is compiled and fitted briefly from its best start; the best pairs again from several: the screen's best
shapes on the refitted and on the user's parameters, and led there by an observer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..engine import make_engine
from ..laws import Law
from ..optimise import GaussNewton
from ..simulators import Simulator
from .candidate import Candidate, attempt, heads
from .screen import Scored
from .workbench import Fitted, Workbench, started

BRIEF = GaussNewton(max_iterations=12, tolerance=1e-3, patience=4)
BEST = 10  # pairs of each list that are fitted, besides the best of each port
EQUAL = 1e-3  # difference of shares that is none
REFINED, FIRST = 8, 3  # pairs fitted from several starts, and how many of them at first
AGAIN = 3  # starts that a pair is fitted from again
SAME = 1.02  # times the mean square error of fits that came to the same place
BEHIND = 3.0  # times the best error of a pair that is not worth more starts
FAINT = 0.01  # of the share that the other way of looking sees, below which one has seen nothing to start at


def survivors(scored: Sequence[Scored]) -> list[tuple[str, type[Law], list[Scored]]]:
    """Pairs worth a full fit: the best of both lists and the best of each port."""
    chosen: dict[tuple[str, type[Law]], list[Scored]] = {}
    for source in ("simulation", "observer"):
        ranked = [s for s in scored if s.source == source]
        ports, passed = set[str](), list[Scored]()
        for s in ranked:
            if len(passed) < BEST or s.port not in ports:
                chosen.setdefault((s.port, type(s.law)), [])
            if not any(_adds_nothing(s, other) for other in passed):  # two forms of one law are one hypothesis
                passed.append(s)
            ports.add(s.port)
    for s in scored:
        if (s.port, type(s.law)) in chosen:
            chosen[s.port, type(s.law)].append(s)
    chosen = {key: [s for s in found if s.share > FAINT * found[0].share] or found for key, found in chosen.items()}
    return [(port, law, entries) for (port, law), entries in chosen.items()]


def _adds_nothing(one: Scored, other: Scored) -> bool:
    """Whether of two laws at a port the one refines the other and scores the same."""
    a, b = type(one.law), type(other.law)
    return one.port == other.port and (issubclass(a, b) or issubclass(b, a)) and other.share - one.share < EQUAL


def closed(simulator: Simulator, entry: Scored, start: Mapping[str, Any]) -> tuple[Simulator, dict[str, Any]]:
    """The simulator with the law in its port, and its start values by full name."""
    law = entry.law
    limits: dict[str, tuple[Any, Any]] = dict(law.at(start).bounds(entry.local))
    if entry.sense:
        side = (0.0, np.inf) if entry.sense > 0 else (-np.inf, 0.0)
        limits |= {name: side for name in law.strength if name not in law.signed}
    inside = {k: np.clip(v, *limits[k]) if k in limits else v for k, v in start.items()}
    placed = simulator.with_element(entry.port, law.at(inside, limits))
    return placed, placed.elements[-1].named(inside)


@dataclass(frozen=True, eq=False)
class _Pair:
    """A pair with its compiled model and its starts, best first."""

    placed: Simulator
    model: Any
    engine: Any
    starts: list[Mapping[str, Any]]
    states: list[np.ndarray]
    candidate: Candidate | None


def prepare(bench: Workbench, entries: Sequence[Scored], without: Fitted, gain: np.ndarray | None) -> _Pair:
    """Compile a pair and fit it briefly from its best start."""
    first = entries[0]
    placed, _ = closed(without.simulator, first, first.starts[0])
    model = bench.model(placed, gain)
    engine = make_engine(model, bench.engine)
    nominal = {k: p.value for k, p in without.simulator.parameters.items()}
    starts: list[Mapping[str, Any]] = []
    led: list[Mapping[str, Any]] = []  # the observer's best: its run may be near the truth where the simulation is not
    for entry in entries:
        for i, own in enumerate(entry.starts):
            _, named = closed(without.simulator, entry, own)
            starts.append({**without.values, **named})
            if i == 0:
                led += [starts[-1]] if entry.source == "observer" else []
                starts.append({**nominal, **named})
    if set(first.law.parameters()) == set(first.law.strength):  # with nothing of it the simulator is as it was
        _, named = closed(without.simulator, first, {k: 0.0 * np.asarray(v) for k, v in first.starts[0].items()})
        starts.append({**without.values, **named})
    best, *rest = by_cost(bench, placed, model, engine, starts, without)
    ranked = [best, *(s for s in led if s is not best), *(s for s in rest if not any(s is o for o in led))]
    brief = attempt(bench, placed, ranked[:1], states=without.begin, solver=BRIEF, model=model, engine=engine)
    return _Pair(placed, model, engine, ranked, without.begin, brief)


def ways(pair: _Pair, led: bool) -> list[tuple[Mapping[str, Any], tuple[float, ...]]]:
    """Starts that a pair is fitted from again, each with the observer's gains on its way: led first, where it is."""
    starts = pair.starts[:AGAIN]
    if pair.candidate is not None:
        starts = [pair.candidate.fitted.values, *starts[1:]]
    return [(start, (1.0, 0.1)) for start in pair.starts[: int(led)]] + [(start, ()) for start in starts]


def settled(found: Sequence[Candidate | None]) -> bool:
    """Whether three ways came to the same place."""
    heads = sorted(c.head for c in found if c)
    return len(heads) > 2 and heads[2] < SAME * heads[0]


def refine(bench: Workbench, pairs: Sequence[_Pair], led: bool, pool: ThreadPoolExecutor) -> Iterator[Candidate | None]:
    """Fit pairs from several starts, and `led` by the observer as well; three ways to the same place are enough."""

    def submit(pair: _Pair, some: slice) -> list[Future[Candidate | None]]:
        compiled = {"states": pair.states, "model": pair.model, "engine": pair.engine}
        return [
            pool.submit(attempt, bench, pair.placed, [start], anneal=anneal, **compiled)
            for start, anneal in ways(pair, led)[some]
        ]

    first = [submit(pair, slice(0, 3)) for pair in pairs]
    begun = []
    for pair, tasks in zip(pairs, first, strict=True):
        found = [task.result() for task in tasks]
        begun.append((pair, found, [] if settled(found) else submit(pair, slice(3, None))))
    for pair, found, tasks in begun:
        every = [pair.candidate, *found, *(task.result() for task in tasks)]
        yield min((c for c in every if c is not None), key=lambda c: c.head, default=None)


def by_cost(
    bench: Workbench,
    placed: Simulator,
    model: Any,
    engine: Any,
    starts: Sequence[Mapping[str, Any]],
    without: Fitted,
) -> list[Mapping[str, Any]]:
    """Starts in the order of their error as they stand on the first parts, from the initial states of a fit."""
    part = bench.on(heads(bench.recordings))
    initial = part.begun(placed, model, started(model, starts[0]), without.begin)

    def cost(start: Mapping[str, Any]) -> float:
        values = model.parameters.unpack(started(model, start))
        found = part.result(placed, values, initial, engine, model).cost
        return found if np.isfinite(found) else np.inf

    return sorted(starts, key=cost)


def explain(
    bench: Workbench,
    scored: Sequence[Scored],
    without: Fitted,
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
        tasks = [pool.submit(prepare, bench, entries, without, gain) for *_, entries in pairs]
        prepared = []
        for task in tasks:
            prepared.append(task.result())
            step([p.candidate for p in prepared])
        prepared.sort(key=lambda p: p.candidate.error if p.candidate else np.inf)
        found: list[Candidate | None] = []
        for group in (prepared[:FIRST], prepared[FIRST:REFINED]):
            best = min((c.error for c in found if c), default=np.inf)
            near = [p for p in group if best > enough or (p.candidate and p.candidate.error < BEHIND * best)]
            found += [p.candidate for p in group if p not in near]
            for refined in refine(bench, near, gain is not None, pool):
                found.append(refined)
                step(found)
        found += [p.candidate for p in prepared[REFINED:]]
        report(total, total, min((c.error for c in found if c), default=np.inf))
    finally:
        pool.shutdown(cancel_futures=True)
    return sorted((c for c in found if c is not None), key=lambda c: c.error)
