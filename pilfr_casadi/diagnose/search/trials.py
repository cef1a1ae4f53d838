"""Fits of hypotheses: a simulator with laws put into its ports, all parameters estimated together.

A pair of port and law is fitted briefly from its best initial values. The best pairs are fitted again from several
initial values. Candidates that may win are fitted to convergence and to all samples. A sharp knee, as of dry friction,
is fitted on steps that are fine enough for it.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..._base import InputError
from ...data import Recording
from ...laws import Law
from ...simulators import Placed, Simulator
from ..faults.gates import EQUAL_RATIO, open_start
from ..faults.offsets import Offset, find_placed_offsets
from ..fits.evidence import FAR_RATIO, FORMULA_ERROR, WRONG_MODEL_SAMPLES
from ..fits.screen import Pair, Scored
from ..fits.step_refinement import knee_starts, refit_on_finer_steps
from ..fits.workbench import BRIEF, COMPARED_SAMPLES, DIVERGED, FEW, QUICK, THOROUGH, Fitted, Workbench

# Effort: pairs of each list of the screen that are fitted, besides the best of each port; the same with `few`
BEST, BEST_OF_FEW = 10, 4
MOST_REFINED = 8  # pairs fitted from several starts; only FEW with `few`
QUIET_SHARE = 0.1  # of the residual power in the loudest stretch, below which the head of a recording says too little
LEAST_SHARE = 0.01  # share over the largest of the same run below which start values are not used
Key = frozenset[Pair]
Name = tuple[str, str]  # port and law id of an effect


@dataclass(frozen=True, eq=False, repr=False)
class Trial:
    """A fitted hypothesis: laws in ports of the simulator."""

    laws: tuple[Placed, ...]  # the added laws, in their order
    fitted: Fitted
    # mean square error on the part of the recordings used by the fit, in units of the outputs' variance
    part_mean_square: float
    mean_square: float  # the same on all recordings
    thorough: bool = False  # whether it was fitted to convergence and to all samples
    information: np.ndarray | None = None  # see `evidence.information`
    added: Pair | None = None  # the law that its move has added or changed; by default the last one

    @classmethod
    def of(cls, fitted: Fitted, count: int, thorough: bool = False, added: Pair | None = None) -> Trial:
        """Make the trial of a fit to all recordings, whose last `count` elements are the hypothesis' laws."""
        return cls(fitted.last_elements(count), fitted, fitted.cost, fitted.cost, thorough, added=added)

    def with_added(self, pair: Pair) -> Trial:
        """Return the hypothesis with another one of its laws as the one that was added."""
        return self if self.pair == pair else replace(self, added=pair)

    @property
    def key(self) -> Key:
        """Ports and classes of the laws; equal keys mean the same hypothesis."""
        return frozenset(e.pair for e in self.laws)

    @property
    def effects(self) -> tuple[Placed, ...]:
        """The laws that are effects; an offset is a finding about the recording."""
        return tuple(e for e in self.laws if not isinstance(e.law, Offset))

    @property
    def names(self) -> frozenset[Name]:
        """Ports and law ids of the effects, which are alike for all forms of a law."""
        return frozenset(e.name for e in self.effects)

    def supersedes(self, other: Trial) -> bool:
        """Tell whether this fit of a hypothesis replaces another; a thorough one has priority."""
        if self.thorough != other.thorough:
            return self.thorough or self.mean_square < other.mean_square / EQUAL_RATIO
        return self.mean_square < other.mean_square

    @property
    def element(self) -> Placed:
        """The law that was added."""
        return next((e for e in self.laws if e.pair == self.added), self.laws[-1])

    @property
    def port(self) -> str:
        """Port of the law that was added."""
        return self.element.port

    @property
    def law(self) -> Law:
        """The law that was added."""
        return self.element.law

    @property
    def pair(self) -> Pair:
        """Port and class of the law that was added."""
        return self.element.pair

    @property
    def own(self) -> dict[str, Any]:
        """Fitted values of the law that was added, by its own names."""
        return self.element.own(self.fitted.values)

    @property
    def error(self) -> float:
        """Root of the mean square error."""
        return float(self.mean_square**0.5)

    @property
    def knee(self) -> str:
        """Full name of the knee, the speed within which the added law's force reverses, if it has one."""
        knee = getattr(self.law, "knee", "")
        return f"{self.element.prefix}{knee}" if knee else ""

    @functools.cached_property
    def size(self) -> int:
        """Count the free numbers of the effects."""
        return sum(e.law.size(e.own(self.fitted.values)) for e in self.effects)

    @functools.cached_property
    def doubtful(self) -> bool:
        """Whether a law degenerates at its fitted values."""
        return any(e.law.doubtful(e.own(self.fitted.values)) for e in self.laws)


@dataclass(frozen=True, eq=False)
class Effort:
    """How thoroughly a move fits its pairs of port and law."""

    observer_gain: np.ndarray | None  # some fits begin along an observer with this gain
    enough: float  # error of one of the first pairs below which pairs far behind it are not refined
    few: bool  # select and refine fewer pairs, because a law is looked for in place of a known one


@dataclass(frozen=True, eq=False)
class Trials:
    """Fits of hypotheses to the recordings of a bench, in parallel.

    No fit begins after `until` (a time of `time.perf_counter`), and all end at the deadline of the bench. `residual` is
    that of the refit, by recording; without it, brief fits use the head of each recording in any case.
    """

    bench: Workbench
    workers: int
    until: float = np.inf
    residual: Sequence[np.ndarray] | None = None

    @property
    def over(self) -> bool:
        """Whether the time limit has passed."""
        return time.perf_counter() > self.until

    @functools.cached_property
    def part(self) -> Workbench:
        """The bench with the part of the recordings that brief fits use."""
        share = COMPARED_SAMPLES / sum(map(len, self.bench.recordings))
        if share >= 1:
            return self.bench
        residual = self.residual or [np.zeros_like(r.y) for r in self.bench.recordings]
        powers = [np.sum((e / self.bench.scale) ** 2, axis=1) for e in residual]
        return self.bench.on([_cut_head(r, share, p) for r, p in zip(self.bench.recordings, powers, strict=True)])

    def fit(
        self, simulator: Simulator, starts: Sequence[Mapping[str, Any]], count: int, **options: Any
    ) -> Trial | None:
        """Fit a simulator whose last `count` elements are the hypothesis' laws; None if every start diverges.

        For `options` see `Workbench.fit`.
        """
        try:
            found = self.part.fit(simulator, starts, **options)
        except InputError:
            return None
        return self.make_trial(found, count)

    def make_trial(self, found: Fitted, count: int) -> Trial:
        """Make a trial of a fit to a part of the recordings."""
        whole = found
        if self.part is not self.bench:
            whole = replace(self.bench.rerun(found), status=found.status)
        return Trial(found.last_elements(count), whole, found.cost, whole.cost if np.isfinite(whole.cost) else np.inf)

    def polish(self, trial: Trial) -> Trial:
        """Fit a trial to convergence and to all samples, on steps that are fine enough for its knee."""
        return self.refine_knee(self.converge(trial))

    def converge(self, trial: Trial) -> Trial:
        """Fit a trial to convergence and to all samples, on steps for its present values."""
        bench = replace(self.bench, at_least=max(self.bench.at_least, trial.fitted.model.substeps))
        placed = trial.fitted.corrected()  # choose sub-steps for the fitted laws
        compiled = bench.compile(placed)
        starts, states = knee_starts(trial.fitted, trial.knee), trial.fitted.initial
        try:
            if len(starts) > 1:
                quick = bench.fit(placed, starts, states=states, solver=QUICK, like=compiled)
                starts, states = [quick.values], quick.initial
            fitted = bench.fit(placed, starts, states=states, solver=THOROUGH, like=compiled)
        except InputError:
            return replace(trial, mean_square=np.inf, thorough=True)
        return Trial.of(fitted, len(trial.laws), True, trial.added)

    def refine_knee(self, trial: Trial) -> Trial:
        """Refit a converged trial on steps that are fine enough for its knee, if it has one."""
        if not trial.knee or not trial.mean_square < DIVERGED or time.perf_counter() > self.bench.deadline:
            return trial
        fitted = refit_on_finer_steps(self.bench, trial.fitted, trial.knee)
        return Trial.of(fitted, len(trial.laws), True, trial.added)

    def fit_pairs(
        self,
        parent: Trial,
        pairs: Sequence[Sequence[Scored]],
        effort: Effort,
        report: Callable[[int, int, float], None],
    ) -> tuple[list[Trial], int]:
        """Fit every selected pair of port and law beside a parent's laws; return the fits, smallest error first.

        Also returns how many pairs were tried before the time was over, with those whose every fit diverges.
        An interrupt ends the fits; it is marked, and what was found is returned.
        """
        most = FEW if effort.few else MOST_REFINED
        done, total = 0, len(pairs) + min(len(pairs), most)

        def least(found: Sequence[Trial | None]) -> float:
            return min((t.error for t in found if t), default=np.inf)

        def step(found: Sequence[Trial | None]) -> None:
            nonlocal done
            done += 1
            report(done, total, least(found))

        prepared, found = list[_BriefFit](), list[Trial | None]()
        pool = ThreadPoolExecutor(self.workers)
        try:
            tasks = [pool.submit(self._fit_briefly, parent, entries, effort.observer_gain) for entries in pairs]
            for task in tasks:
                if self.over and prepared:
                    break
                prepared.append(task.result())
                step([p.trial for p in prepared])
            prepared.sort(key=lambda p: p.trial.error if p.trial else np.inf)
            for group in (prepared[:FEW], prepared[FEW:most]):
                best = least(found)
                near = [p for p in group if best > effort.enough or (p.trial and p.trial.error < FAR_RATIO * best)]
                near = [] if self.over else near
                found += [p.trial for p in group if p not in near]
                for refined in self._refine(near, effort.observer_gain is not None, pool):
                    found.append(refined)
                    step(found)
            found += [p.trial for p in prepared[most:]]
            report(done if self.over else total, total, least(found))
        except (KeyboardInterrupt, SystemError, RuntimeError) as error:
            if not self.bench.interrupt.mark(error):
                raise
            found += [p.trial for p in prepared]
        finally:
            pool.shutdown(cancel_futures=True)
        return sorted((t for t in found if t is not None), key=lambda t: t.error), len(prepared)

    def _fit_briefly(self, parent: Trial, entries: Sequence[Scored], observer_gain: np.ndarray | None) -> _BriefFit:
        """Compile a pair and fit it briefly from its best start."""
        first, base = entries[0], parent.fitted
        placed, _ = place_law(base.simulator, first, first.starts[0])
        compiled = self.bench.compile(placed, observer_gain)
        users = self.bench.simulator.parameters
        # the refit may have compensated for the law by an offset there, or by the term that the law is in line with
        offsets = find_placed_offsets(self.bench.simulator.elements)
        reset = tuple(name for name, e in offsets.items() if e.port == first.port)
        if first.law.in_line:
            reset = (*reset, *self.bench.simulator.term_parameters(first.port))
        afresh = bool(reset) or first.law.special  # strongly curved forces may leave the refit far off
        reset = tuple(users) if first.law.special or not reset else reset
        nominal = {**base.values, **{name: users[name].value for name in reset}}
        starts: list[Mapping[str, Any]] = []
        # the best of each entry, by its score: the observer's run may be near the truth where the simulation is not,
        # and the cost alone would prefer starts with hardly any force
        firsts: list[Mapping[str, Any]] = []
        given: list[Mapping[str, Any]] = []  # with the user's own values of the parameters
        for entry in sorted(entries, key=lambda s: s.source != "observer"):
            others = {name: entry.beside.get(name, value) for name, value in base.values.items()}
            for i, own in enumerate(entry.starts):
                _, named = place_law(base.simulator, entry, own)
                starts.append({**others, **named})
                if i == 0:
                    firsts.append(starts[-1])
                    given.append({**nominal, **named})
                starts.append(given[-1])
        if first.law.free == set(first.law.strength):  # at zero strength the simulator is unchanged
            zero = {k: 0.0 * np.asarray(v) if k in first.law.free else v for k, v in first.starts[0].items()}
            starts.append({**base.values, **place_law(base.simulator, first, zero)[1]})
        best, *rest = self.part.by_cost(compiled, starts, base.begin)
        last = (s for s in rest if not any(s is first for first in firsts))
        ranked = [best, *(s for s in firsts if s is not best), *last]
        count = len(parent.laws) + 1
        options = {"states": base.begin, "like": compiled}
        brief = self.fit(placed, ranked[:1], count, solver=BRIEF, **options)
        if afresh:
            nearest = [s for s in ranked if any(s is n for n in given)][:1]
            again = self.fit(placed, nearest, count, solver=BRIEF, **{**options, "states": ()})
            brief = min((t for t in (brief, again) if t is not None), key=lambda t: t.part_mean_square, default=None)
        return _BriefFit(placed, options, ranked, count, brief)

    def _refine(self, pairs: Sequence[_BriefFit], observer: bool, pool: ThreadPoolExecutor) -> Iterator[Trial | None]:
        """Fit pairs from several starts, and with `observer` also along the observer; stop if three fits agree."""

        def submit(pair: _BriefFit, some: slice) -> list[Future[Trial | None]]:
            return [
                pool.submit(self.fit, pair.placed, [start], pair.count, anneal=anneal, **pair.options)
                for start, anneal in pair.starts_again(observer)[some]
            ]

        first = [submit(pair, slice(0, 3)) for pair in pairs]
        running = []
        for pair, tasks in zip(pairs, first, strict=True):
            found = [task.result() for task in tasks]
            running.append((pair, found, [] if _agree(found) else submit(pair, slice(3, None))))
        for pair, found, tasks in running:
            every = [pair.trial, *found, *(task.result() for task in tasks)]
            yield min((t for t in every if t is not None), key=lambda t: t.part_mean_square, default=None)


@dataclass(frozen=True, eq=False)
class _BriefFit:
    """A pair of port and law: options of its fits (with the compiled model), starts (best first), and brief fit."""

    placed: Simulator
    options: dict[str, Any]
    starts: list[Mapping[str, Any]]
    count: int
    trial: Trial | None

    def starts_again(self, observer: bool) -> list[tuple[Mapping[str, Any], tuple[float, ...]]]:
        """Return the starts for further fits, each with its observer gains; starts along the observer come first."""
        starts = self.starts[:FEW]
        if self.trial is not None:
            starts = [self.trial.fitted.values, *starts[1:]]
        return [(start, (1.0, 0.1)) for start in self.starts[: int(observer)]] + [(start, ()) for start in starts]


def _agree(found: Sequence[Trial | None]) -> bool:
    """Tell whether three fits came to the same minimum."""
    costs = sorted(t.part_mean_square for t in found if t)
    return len(costs) > 2 and costs[2] < EQUAL_RATIO * costs[0]


def _cut_head(r: Recording, share: float, power: np.ndarray) -> Recording:
    """Return the first part of a recording, longer if its residual is far quieter than later.

    A recording may begin at rest, where most laws do not act. Then the part ends with the first loud stretch. It begins
    with the recording, so that laws with memory start as they do there.
    """
    cut = max(int(share * len(r)), min(len(r), r.skip + 20))
    if cut < len(r):
        energy = np.cumsum(np.append(0.0, np.where(np.arange(len(power)) < r.skip, 0.0, power)))
        held = energy[cut:] - energy[:-cut]
        if held[0] < QUIET_SHARE * np.max(held):
            cut += int(np.argmax(held >= 0.5 * np.max(held)))
    return r if cut >= len(r) else open_start(r.slice(0, cut))


def select_pairs(scored: Sequence[Scored], few: bool) -> list[list[Scored]]:
    """Select the pairs worth a full fit: the best of both lists and of each port, and some whatever their score.

    The latter are the best law of each port with a single free parameter, which richer ones hide in the list, and the
    laws made for a port: special laws of its domain, and laws in line with its term. Their forces are so curved that a
    small dose says little about them. The most promising come first, because a time limit may leave the others out.
    """
    chosen, best = dict[Pair, list[Scored]](), BEST_OF_FEW if few else BEST
    for source in ("simulation", "observer"):
        ports, plain, passed = set[str](), set[str](), list[Scored]()
        for s in (s for s in scored if s.source == source):
            first = s.port not in ports or (s.port not in plain and _is_plain(s))
            if len(passed) < best or first or s.law.special or s.law.in_line:
                chosen.setdefault(s.pair, [])
            if not any(_is_redundant(s, other) for other in passed):  # two forms of one law are one hypothesis
                passed.append(s)
            ports.add(s.port)
            plain |= {s.port} if _is_plain(s) else set()
    largest = dict[str, float]()  # by run, because shares of different residuals are not comparable
    for s in scored:
        largest[s.source] = max(largest.get(s.source, 0.0), s.share)
        if s.pair in chosen:
            chosen[s.pair].append(s)
    kept = ([s for s in found if s.share > LEAST_SHARE * largest[s.source]] or found for found in chosen.values())
    return sorted(kept, key=lambda found: max(map(_estimate_evidence, found)), reverse=True)


def _estimate_evidence(one: Scored) -> float:
    """Estimate the log evidence of a law from its screen: the samples of a wrong model count, and a nat per number."""
    return float(-0.5 * WRONG_MODEL_SAMPLES * np.log(max(1 - one.share, 1e-300)) - one.law.size(one.starts[0]))


def _is_plain(one: Scored) -> bool:
    """Tell whether a law has a single free parameter, besides the width of a knee that only makes it smooth."""
    return one.law.size(one.starts[0]) - bool(one.law.knee) == 1


def _is_redundant(one: Scored, other: Scored) -> bool:
    """Tell whether one of two laws at a port refines the other, and they score the same."""
    a, b = type(one.law), type(other.law)
    return one.port == other.port and (issubclass(a, b) or issubclass(b, a)) and other.share - one.share < FORMULA_ERROR


def place_law(
    simulator: Simulator, entry: Scored, start: Mapping[str, Any], index: int | None = None
) -> tuple[Simulator, dict[str, Any]]:
    """Put a law into its port, by default behind all others; return the simulator and start values by full name."""
    law = entry.law
    limits: dict[str, tuple[Any, Any]] = dict(law.at(start).bounds(entry.local))
    if entry.sense:
        side = (0.0, np.inf) if entry.sense > 0 else (-np.inf, 0.0)
        limits |= {name: side for name in law.strength if name not in law.signed}
    inside = {k: np.clip(v, *limits[k]) if k in limits else v for k, v in start.items()}
    placed = simulator.with_element(entry.port, law.at(inside, limits), index)
    return placed, placed.elements[-1 if index is None else index].named(inside)
