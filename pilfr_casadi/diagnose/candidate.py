"""A port and law, fitted: to the first part of every recording, judged on the rest, and at last fitted to everything.

A law one of whose strengths may as well be zero is the law that it refines; one whose strengths may all be zero is out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._base import InputError
from ..data import Recording
from ..engine import make_engine
from ..laws import Law
from ..simulators import Placed, Simulator, in_series
from .knees import knees, moved, on_finer_steps
from .proof import deviations, shown
from .standing import opened_at_the_start
from .workbench import QUICK, THOROUGH, Fitted, Workbench

HEAD = 0.7  # share of each recording that candidates are fitted to
WEAK, NO_WORSE = 2.0, 1.03  # standard errors within which a part of a law is idle, and error without it
MUCH_AS_WELL = 1.1  # the same of a part that is nothing beside another
TINY = 1e-3  # of another strength, of one that is nothing beside it
SHOWN = 3.0  # standard errors that a law's strength is from zero at least
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
        return any(np.any(self.fitted.at_bound(k)) for k in self.element.of(self.fitted.values))

    @property
    def held_back(self) -> bool:
        """Whether an upper bound holds one back: at a lower one it is as sharp or as small as the data can tell."""
        p, values = self.fitted.model.parameters, self.fitted.values
        return any(np.any(values[k] >= p[k].bounds[1]) for k in self.element.of(values))

    @property
    def knee(self) -> str:
        """Full name of the width over which the law's force turns round, where it has one."""
        knee = getattr(self.law, "knee", "")
        return f"{self.element.prefix}{knee}" if knee else ""

    @property
    def doubtful(self) -> bool:
        """Whether the law at its fitted values is hardly what its name says."""
        return self.law.doubtful(self.own)

    def within(self, dt: float) -> bool:
        """Whether it is a delay, a lag or a mode of a signal that acts within a step dt."""
        timed = in_series(self.port) and (self.law.order > 0 or self.law.shifts)
        return timed and bool(np.max(self.own.get("T", np.inf)) < dt or np.max(self.own.get("W", 0.0)) * dt > 1)

    @property
    def element(self) -> Placed:
        """Where the law stands; another effect may stand behind it."""
        elements = self.fitted.simulator.elements[::-1]
        return next((e for e in elements if e.port == self.port and type(e.law) is type(self.law)), elements[0])

    @property
    def own(self) -> dict[str, Any]:
        """The law's fitted values by its own names."""
        return self.element.own(self.fitted.values)


def heads(recordings: Sequence[Recording]) -> tuple[Recording, ...]:
    """First part of each recording."""
    total, out = sum(map(len, recordings)), []
    for r in recordings:
        most = int(len(r) * min(1.0, LONG / (HEAD * total)))
        cut = max(int(HEAD * most), min(len(r), r.skip + 20))
        part = r.slice(0, cut)
        out.append(opened_at_the_start(part))
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
    size = element.law.size(element.own(fitted.values))
    return Candidate(element.port, element.law, fitted, head, tail if np.isfinite(tail) else 1e12, size)


def polish(bench: Workbench, candidate: Candidate) -> Candidate:
    """Fit a candidate to everything; one whose strength may as well be zero lives off its initial state and is out."""
    candidate = simpler(bench, candidate)
    bench = _as_fine(bench, candidate)
    placed = candidate.fitted.corrected()  # sub-steps for the law as it was fitted
    out = replace(candidate, head=np.inf, tail=np.inf, full=np.inf)
    model = bench.model(placed)
    engine = make_engine(model, bench.engine)
    starts, states = knees(candidate), candidate.fitted.initial
    try:
        if len(starts) > 1:
            quick = bench.fit(placed, starts, states=states, model=model, engine=engine)
            starts, states = [quick.values], quick.initial
        fitted = bench.fit(placed, starts, states=states, solver=THOROUGH, model=model, engine=engine)
    except InputError:
        return out
    fitted = on_finer_steps(bench, fitted, candidate.knee) if candidate.knee else fitted
    if shown(bench, fitted) < SHOWN:
        return out
    done = replace(candidate, fitted=fitted, full=fitted.cost)
    # what coarse steps, or a knee that stayed where it was, cost is no fault of the law
    if fitted.model.substeps > candidate.fitted.model.substeps or moved(candidate, done):
        own = {"states": fitted.begin, "model": fitted.model, "engine": fitted.engine}
        again = attempt(bench, fitted.simulator, [fitted.values], **own)
        done = replace(done, head=again.head, tail=again.tail) if again is not None else done
    plain = simpler(bench, done, deviations(bench, fitted))
    return done if plain is done else polish(bench, plain)


def _as_fine(bench: Workbench, candidate: Candidate) -> Workbench:
    """The bench with steps at least as fine as a candidate's: on coarser ones its knee would look wider."""
    return replace(bench, at_least=max(bench.at_least, candidate.fitted.model.substeps))


def _next_to_nothing(candidate: Candidate, name: str) -> float:
    """Strength that is nothing beside another of the same unit: standard errors do not know what steps do to a run."""
    own, units = candidate.own, candidate.law.units
    return TINY * max(float(np.max(np.abs(own[k]))) for k in candidate.law.strength if units[k] == units[name])


def simpler(bench: Workbench, candidate: Candidate, std: Mapping[str, np.ndarray] | None = None) -> Candidate:
    """A law one of whose strengths is zero is the law that it refines, started where it stands.

    With standard errors, what may as well be zero counts as zero.
    """
    element = candidate.fitted.simulator.elements[-1]
    if element.port != candidate.port or type(element.law) is not type(candidate.law):  # another was put in after it
        return candidate
    plain: Any = type(candidate.law).__base__
    own = element.own(candidate.fitted.values)
    nothing = {name: _next_to_nothing(candidate, name) if std else 0.0 for name in candidate.law.strength}
    # at a bound there is no standard error: there only nothing is nothing
    doubt = {name: np.nan_to_num(WEAK * std[f"{element.prefix}{name}"]) if std else 0.0 for name in nothing}
    idle = {name for name in nothing if np.all(np.abs(own[name]) <= np.maximum(doubt[name], nothing[name]))}
    units = set(getattr(plain, "units", {}))
    less = set(candidate.law.strength) - units  # of several that are idle, one after the other
    if not units or not less or not less <= idle or not units <= set(own):
        return candidate
    if not set(candidate.law.places) <= set(plain.places):
        return candidate
    given = candidate.fitted.model.parameters
    limits = {k: given[f"{element.prefix}{k}"].bounds for k in plain.units if k in candidate.law.limits}
    law = plain().at({k: own[k] for k in plain.units}, limits)
    placed = candidate.fitted.simulator.without_last_element().with_element(element.port, law)
    found = attempt(_as_fine(bench, candidate), placed, [candidate.fitted.values], states=candidate.fitted.begin)
    tiny = all(np.all(np.abs(own[name]) <= nothing[name]) for name in less)
    worse = 1.01 if not std else MUCH_AS_WELL if tiny else NO_WORSE
    return found if found is not None and found.error < worse * candidate.error else candidate
