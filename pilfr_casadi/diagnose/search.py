"""The search over hypotheses: sets of laws in ports, each fitted once and kept, all compared by one log evidence.

Moves lead from one hypothesis to others: *add* a law to the present ones; *exchange* one of several laws for another,
the others fixed in place; *add two* at once, if neither helps alone; *name a learned force*: fit the laws nearest to a
force that was learned beside a hypothesis. A move starts from the most promising hypothesis. The search ends if a move
brings no better one, if the error is at the noise, or at the time limit. All fits are kept in a memo and count in the
posterior.
"""

from __future__ import annotations

import itertools
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from .._base import InputError, Stages, is_interrupt, side_by_side
from ..laws import FINER, SCALABLE, Law, Local, scheduled, unscheduled
from ..simulators import Placed, Simulator
from .evidence import (
    BETTER_RATIO,
    CONTENDING_NATS,
    EFFECT_PRIOR,
    FORMULA_ERROR,
    LARGE_MODEL_ERROR,
    LOUDEST_NOISE,
    NEAR_RATIO,
    WRONG_MODEL_SAMPLES,
    HeldOut,
    Sample,
    held_out_errors,
    information,
    log_evidence,
    log_prior,
    spread,
)
from .floor import FEWEST, Floor, effective_size, white_part
from .gates import CLEARLY_BETTER
from .learned import learn_forces, nearest_to_learned
from .linearise import linearised
from .relatives import choose_pairs, complements, fit_pair, relatives
from .screen import Remainder, Scored, flexible_shares, screen, usable
from .trials import Key, Trial, Trials
from .workbench import DIVERGED, FEW, THOROUGH, Fitted, Workbench

# Effort
MOST_CONVERGED = 5  # trials of a step that are fitted to convergence at most
NEARLY_EXPLAINED = 0.05  # share of the excess left by one law below which far worse laws are not refined
MOST_PREDICTED = 6  # hypotheses judged on held-out blocks; more only until the likeliest one is judged
MOST_LEARNED = 2  # learned forces that are kept: those with the smallest error


@dataclass(frozen=True, eq=False)
class Step:
    """One move of the search: its parent hypothesis, the screen's scores, and the trials, best first."""

    parent: Trial
    scored: tuple[Scored, ...]
    trials: tuple[Trial, ...]


@dataclass(eq=False)
class Findings:
    """Results about one hypothesis that are computed when they are first needed.

    Attributes
    ----------
    screened : tuple, optional
        The scores of all further laws, and the observer's gain; see `screen`.
    flexible : dict, optional
        The share of the residual that a flexible force at each port explains.
    learned : list of Fitted, optional
        The learned forces beside it, best first.
    held_out : HeldOut, optional
        Its errors on held-out data.
    """

    screened: tuple[list[Scored], np.ndarray | None] | None = None
    flexible: dict[str, float] | None = None
    learned: list[Fitted] | None = None
    held_out: HeldOut | None = None


@dataclass(eq=False)
class Search:
    """The state of a search, filled by `run`.

    Attributes
    ----------
    bench : Workbench
        Recordings, and the settings for runs and fits.
    without : Fitted
        The refitted simulator, with no law.
    floor : Floor
        The noise; if it is only estimated, the search improves the estimate.
    laws : sequence of type of Law
        The laws that are tried.
    memo : dict
        The best trial of every fitted hypothesis, by key.
    steps : list of Step
        The moves, in their order.
    findings : dict
        Further results about each fitted hypothesis, by key.
    hold_said : bool
        Whether somebody stated the hold of the inputs between samples.
    stand_in_error : float
        NRMSE between a surrogate and its simulation; the floor contains it.
    count : float
        Samples of the best residual over its correlation time.
    until : float
        Time (of `time.perf_counter`) at which the search ends.
    deadline : float
        Time at which the diagnosis has to end.
    out_of_time : bool
        Whether the time limit ended the search.
    """

    bench: Workbench
    without: Fitted
    floor: Floor
    laws: Sequence[type[Law]]
    workers: int
    say: Stages
    hold_said: bool = True
    stand_in_error: float = 0.0
    until: float = np.inf
    deadline: float = np.inf
    memo: dict[Key, Trial] = field(default_factory=dict)
    steps: list[Step] = field(default_factory=list)
    alternatives: dict[str, tuple[Law, ...]] = field(default_factory=dict)
    findings: defaultdict[Key, Findings] = field(default_factory=lambda: defaultdict(Findings))
    times: dict[str, float] = field(default_factory=dict)
    interrupted: bool = False
    out_of_time: bool = False
    count: float = FEWEST

    @cached_property
    def fits(self) -> Trials:
        """Fits of hypotheses, with the bench, workers and time limit of the search."""
        return Trials(self.bench, self.workers, self.until, self.deadline)

    @property
    def samples(self) -> float:
        """Effective samples, shared by all hypotheses."""
        return self.sample.effective(min(t.mean_square for t in self.memo.values()) + self.tolerance)

    @property
    def floor2(self) -> float:
        """Mean square of the noise in units of the outputs' variance."""
        return float(np.mean((self.floor.deviation / self.bench.scale) ** 2))

    @property
    def tolerance(self) -> float:
        """Mean square error that the formulas of laws leave of any mismatch, because no machine follows one exactly."""
        return FORMULA_ERROR * max(self.root.mean_square - self.floor2, 0.0)

    @property
    def sample(self) -> Sample:
        """Noise and number of samples of the recordings."""
        return Sample(self.floor2 + self.tolerance, self.count)

    @property
    def root(self) -> Trial:
        """The hypothesis without laws."""
        return self.memo[frozenset()]

    @property
    def best(self) -> Trial:
        """The most promising hypothesis, from which the search goes on."""
        return max(self.memo.values(), key=self.optimistic_evidence)

    def optimistic_evidence(self, trial: Trial) -> float:
        """Compute the log evidence of a hypothesis as if the missing rest were found: samples count as at the noise."""
        return self._log_evidence(trial, trial.mean_square, self.sample.effective(0.0))

    def evidence(self, trial: Trial) -> float:
        """Compute the log evidence of a hypothesis, from its error on held-out blocks if that is known.

        Where all models are wrong, the spread of predictions for other inputs counts as an error.
        """
        known = self.findings[trial.key].held_out
        v = known.error**2 if known else trial.mean_square * self._held_out_ratio()
        v += known.spread if known and self._all_wrong else 0.0
        return self._log_evidence(trial, v, self.samples)

    def _held_out_ratio(self) -> float:
        """Compute the usual ratio of held-out to fit error (mean squares), for hypotheses that were not predicted."""
        known = [(self.findings[key].held_out, trial.mean_square) for key, trial in self.memo.items()]
        ratios = [h.error**2 / fit for h, fit in known if h and np.isfinite(h.error) and fit > 0]
        return float(np.median(ratios)) if ratios else 1.0

    def _log_evidence(self, trial: Trial, v: float, n: float) -> float:
        known = trial.information if trial.information is not None else np.zeros(0)
        return log_evidence(v + self.tolerance, known, self.log_prior(trial), n)

    def log_prior(self, trial: Trial) -> float:
        """Compute the log prior probability of a hypothesis."""
        return log_prior(trial.laws, self.alternatives, trial.doubtful, self.domains)

    @cached_property
    def domains(self) -> dict[str, str]:
        """The physical domain of each port, by name."""
        return {port.name: port.domain for port in self.bench.simulator.all_ports()}

    def held_out(self, trial: Trial) -> HeldOut:
        """Compute the held-out errors of a hypothesis, once."""
        known = self.findings[trial.key]
        if known.held_out is None:
            known.held_out = self.held_out_errors(trial.fitted, self.spread(trial.fitted, trial.laws))
        return known.held_out

    def held_out_errors(self, fitted: Fitted, spread: float) -> HeldOut:
        """Compute the held-out errors of a fitted simulator with a known spread for other inputs."""
        return replace(held_out_errors(self.bench, fitted, self.workers), spread=spread)

    def spread(self, fitted: Fitted, laws: Sequence[Placed]) -> float:
        """Compute the mean square uncertainty of a fitted simulator's predictions for other inputs."""
        own = Sample(self.floor2, _count_samples(fitted, self.bench))
        return spread(self.bench, fitted, laws, fitted.cost + self.tolerance, own.effective(0.0))

    @property
    def _all_wrong(self) -> bool:
        """Whether even the best model's error is mostly model error."""
        return self.samples < WRONG_MODEL_SAMPLES / LARGE_MODEL_ERROR

    def _judge_on_held_out_data(self) -> None:
        """Compute the held-out errors of the likeliest hypotheses.

        If only one is likely and its error is noise, the fit error is enough. A wrong model may overfit; and of several
        that follow the recordings equally well, the right one predicts best.
        """
        if not self._all_wrong and len({frozenset((e.port, e.law.id) for e in t.laws) for t in self._likeliest()}) < 2:
            return
        with self.stage("held-out blocks"):
            if self._all_wrong:
                self.held_out(self.root)
            for done in itertools.count():
                likely = self._likeliest()
                left = [t for t in likely if self.findings[t.key].held_out is None]
                if not left or (done >= MOST_PREDICTED and left[0] is not likely[0]):
                    break
                if not self._in_time():  # a comparison that was not finished favours what was not judged
                    self._forget_held_out()
                    break
                self.held_out(left[0])

    def _forget_held_out(self) -> None:
        """Forget the held-out errors, so that all hypotheses are compared by their fit errors."""
        for known in self.findings.values():
            known.held_out = None

    def _likeliest(self) -> list[Trial]:
        """List the hypotheses that may be the likeliest."""
        return likeliest(list(self.memo.values()), self.evidence)

    def flexible(self, trial: Trial) -> dict[str, float]:
        """Compute the share of a trial's residual that a flexible force explains, by port."""
        known = self.findings[trial.key]
        if known.flexible is None:
            with self.stage("flexible"):
                known.flexible = flexible_shares(self.bench, trial.fitted)
        return known.flexible

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Report that a stage begins and ends, add its seconds, and end the search if one of its fits was interrupted.

        Raises
        ------
        KeyboardInterrupt
            If a fit was interrupted. Such a fit has returned its best result so far.
        """
        self.say(name, 0, 1, self.without.cost**0.5)
        began = time.perf_counter()
        yield
        self.times[name] = self.times.get(name, 0.0) + time.perf_counter() - began
        self.say(name, 1, 1, self.best.error)
        if self.bench.interrupted_fits and not self.interrupted:
            raise KeyboardInterrupt

    def run(self, effects: float) -> Search:
        """Search for up to `effects` effects; an interrupt ends the search with the present results."""
        self.keep(Trial((), self.without, self.without.cost, self.without.cost, True))
        with self.until_interrupted():
            self._estimate_noise()
            if self._grow(effects) and self._name_rest(effects):
                self._every_sensor()
                self._judge_on_held_out_data()
        if self.interrupted:
            self._forget_held_out()
        return self

    def until_interrupted(self) -> UntilInterrupted:
        """Make a context that an interrupt ends, so that the answer rests on what was found before it."""
        return UntilInterrupted(self)

    def resume(self, effects: float) -> Search:
        """Continue with the present hold because the other is no better, unless the search was interrupted."""
        self.hold_said = True
        return self if self.interrupted else self.run(effects)

    def _grow(self, effects: float) -> bool:
        """Add effects while that pays; return False as soon as the other hold proves better."""
        while (
            self.can_improve(parent := self.best)
            and len(parent.effects) < effects
            and self._pays(parent)
            and self._in_time()
        ):
            self.add(parent)
            if not parent.laws and self._in_time() and self._escape_local_minimum():
                self.add(self.root)
            if self.other_hold_fits_better():
                return False
            if len(self.best.effects) > len(parent.effects) >= 1:
                self.exchange()
            if len(self.best.laws) <= len(parent.laws):  # no added law is worth its prior
                break
        if effects > 1 and len(self.best.effects) < 2 and self.can_improve(self.best) and self._in_time():
            self.add_two()
        return True

    def _name_rest(self, effects: float) -> bool:
        """Name the forces learned beside the simulator, the best hypothesis, and that without its weakest effect.

        The weakest of several effects may imitate a law that only a learned force shows, such as a gain that varies
        with the position. Go on if one of the laws leads.
        """
        best = self.best
        fewer = [t for t in self.memo.values() if t.effects and t.key < best.key]
        without_weakest = sorted(fewer, key=lambda t: (-len(t.effects), t.mean_square))[:1]
        for base in {t.key: t for t in (self.root, best, *without_weakest)}.values():
            if len(base.effects) < effects and self.can_improve(best) and self._in_time():
                self.name_learned(base)
        return self.best is best or self._grow(effects)

    def _pays(self, trial: Trial) -> bool:
        """Tell whether the last of several laws was worth it; a wrong model can always use one more."""
        fewer = [t for t in self.memo.values() if t.laws and len(t.effects) < len(trial.effects)]
        return len(trial.effects) < 2 or self.evidence(trial) > max(map(self.evidence, fewer), default=-np.inf)

    def other_hold_fits_better(self) -> bool:
        """Tell whether the best hypothesis follows the recordings better with the other hold of the inputs."""
        best = self.best.fitted
        if self.hold_said or not self._in_time():
            return False
        try:
            other = self.bench.with_other_hold().fit(
                best.simulator, [best.values], states=best.initial, solver=THOROUGH
            )
        except InputError:
            return False
        return other.cost * BETTER_RATIO**2 < best.cost

    def can_improve(self, trial: Trial) -> bool:
        """Tell whether a law that removes all but the noise would be worth its prior beside a hypothesis."""
        left, noise = (v + self.tolerance for v in (trial.mean_square, self.floor2))
        most = 0.5 * self.sample.effective(0.0) * np.log(max(left / noise, 1.0))
        return bool(most > np.log(max(len(self.alternatives), 1)) - EFFECT_PRIOR)

    @property
    def past_deadline(self) -> bool:
        """Whether the time for the whole diagnosis is over."""
        return time.perf_counter() > self.deadline

    def _in_time(self) -> bool:
        """Tell whether there is time for more; if not, note that in the result."""
        self.out_of_time = self.out_of_time or time.perf_counter() > self.until
        return not self.out_of_time

    def keep(self, trial: Trial) -> None:
        """Put a trial into the memo, unless the same hypothesis fits better there."""
        if trial.information is None:
            trial = replace(trial, information=information(self.bench, trial.fitted, trial.laws))
        known = self.memo.get(trial.key)
        if known is None or trial.supersedes(known):
            self.memo[trial.key] = trial
            self.findings.pop(trial.key, None)

    def add(self, parent: Trial, again: bool = False) -> None:
        """Fit the laws that the screen selects beside a hypothesis, fewer if `again`; polish those that may win."""
        scored, gain = self.screened(parent)
        scored = [s for s in scored if _may_stand_beside(parent.laws, s.port, s.law)]
        enough = float(np.sqrt(self.floor2 + NEARLY_EXPLAINED * max(parent.mean_square - self.floor2, 0.0)))
        trials = self._fitted(parent, scored, gain, enough, again)
        more = relatives(self.bench, trials, scored) if self._in_time() else []
        if more:
            trials = sorted([*trials, *self._fitted(parent, more, gain, enough, again)], key=lambda t: t.error)
        with self.stage("choice"):
            self._record(parent, scored, trials)
            self._estimate_noise()
            best = self.best
            self._finer(parent)
            if self.best is not best:
                self._estimate_noise()

    def _record(self, parent: Trial, scored: Sequence[Scored], trials: Sequence[Trial]) -> None:
        """Keep the trials of a move, and note the move."""
        self._keep_all(trials)
        self.steps.append(Step(parent, tuple(scored), tuple(trials)))

    def screened(self, parent: Trial) -> tuple[list[Scored], np.ndarray | None]:
        """Score every port and law beside a hypothesis; see `screen`."""
        known = self.findings[parent.key]
        if known.screened is None:
            with self.stage("screen"):
                known.screened = screen(self.bench, parent.fitted, self.laws, self.floor.deviation, self.workers)
                for s in known.screened[0]:
                    there = self.alternatives.setdefault(s.port, ())
                    if not any(type(law) is type(s.law) for law in there):
                        self.alternatives[s.port] = (*there, s.law)
        return known.screened

    def _fitted(
        self, parent: Trial, scored: Sequence[Scored], gain: np.ndarray | None, enough: float, again: bool
    ) -> list[Trial]:
        began = time.perf_counter()
        stage = f"fits, effect {len(parent.laws) + 1}" if parent.laws else "fits"
        trials = self.fits.beside(parent, scored, gain, enough, partial(self.say, stage), again)
        self.times["fits"] = self.times.get("fits", 0.0) + time.perf_counter() - began
        if self.bench.interrupted_fits:
            raise KeyboardInterrupt
        return trials

    def _keep_all(self, trials: Sequence[Trial]) -> None:
        """Keep trials, and fit those that may win to convergence."""
        for trial in trials:
            self.keep(trial)
        kept = {t.key: self.memo[t.key] for t in trials}.values()
        ranked = sorted(kept, key=self.optimistic_evidence, reverse=True)
        near = [t for t in ranked[:MOST_CONVERGED] if not t.thorough and t.error < NEAR_RATIO * ranked[0].error]
        for trial in side_by_side(self.fits.polish, near, self.workers):
            self.keep(trial)

    def thorough(self, trial: Trial) -> Trial:
        """Return the same hypothesis fitted to convergence and to all samples, or as it is after the deadline."""
        if not self.memo[trial.key].thorough and not self.past_deadline:
            self.keep(self.fits.polish(trial))
        return self.memo[trial.key]

    def _estimate_noise(self) -> None:
        """Estimate the noise: the part of the best hypothesis' residual that no force and no law at any port explains.

        A measured noise is kept. Third differences give a lower limit: the white noise inside the residual. The
        effective samples follow from the residual's correlation.
        """
        self.count = _count_samples(self.best.fitted, self.bench)
        if self.floor.source != "estimated":
            return
        best = self.best
        pairs = zip(best.fitted.residual, self.bench.recordings, strict=True)
        error = np.concatenate([e[r.skip :] for e, r in pairs])
        followed = [s.share for s in self.screened(best)[0] if s.source == "simulation"]
        share = float(np.clip(1 - max([*self.flexible(best).values(), *followed], default=0.0), 0.0, 1.0))
        rest = np.minimum(np.sqrt(share * np.mean(error**2, axis=0)), LOUDEST_NOISE * self.bench.scale)
        known, white = self.stand_in_error * self.bench.scale, white_part(best.fitted.residual)
        self.floor = Floor(np.hypot(np.maximum(white, rest), known), "estimated")

    def _finer(self, parent: Trial) -> None:
        """Fit the best law of a step in its finer forms; then let the strength of the best that may vary do so."""
        best = self.best
        if len(best.laws) == len(parent.laws) + 1:
            self._refine(best, FINER.get(type(best.element.law), ()))
        step = [self.memo[t.key] for t in self.steps[-1].trials if unscheduled(type(t.law)) in SCALABLE]
        if step and self.can_improve(self.best) and self._in_time():
            varied = max(step, key=self.optimistic_evidence)
            kind = unscheduled(type(varied.law))
            signals = ("z", *self._local(varied.port).inputs)
            self._refine(varied, [scheduled(kind, by) for by in signals if by != varied.law.scheduled_by])

    def _local(self, port: str) -> Local:
        """Return the signals at a port as it was first screened."""
        return next(s.local for step in self.steps for s in step.scored if s.port == port)

    def _refine(self, trial: Trial, kinds: Sequence[Any]) -> None:
        """Fit a hypothesis with its last law in other forms, which start from its values."""
        element, base, local = trial.element, trial.fitted, self._local(trial.port)
        bare = base.simulator.without_element()

        def fit(kind: Any) -> Trial | None:
            shapes = list(kind.finer_starts(trial.own, local))
            placed = bare.with_element(element.port, kind().at(shapes[0], kind().bounds(local)))
            starts = [{**base.values, **element.named(shape)} for shape in shapes]
            return self.fits.fitted(placed, starts, len(trial.laws), states=base.begin)

        found = side_by_side(fit, [kind for kind in kinds if usable(kind(), local)], self.workers)
        self._keep_all([t for t in found if t is not None])

    def learned(self, base: Trial) -> list[Fitted]:
        """Fit learned forces beside a hypothesis, at the most promising ports, to a part of the recordings."""
        known = self.findings[base.key]
        if known.learned is None:
            with self.stage("learned force"):
                shares = self.flexible(base)
                ports = sorted(shares, key=lambda name: -shares[name])[:FEW]
                try:
                    known.learned = learn_forces(self.fits.part, base.fitted, ports, self.workers)[:MOST_LEARNED]
                except (InputError, np.linalg.LinAlgError):
                    known.learned = []
        return known.learned

    def name_learned(self, base: Trial) -> None:
        """Fit the laws whose forces are nearest to those learned beside a hypothesis."""
        entries = list[Scored]()
        for fitted in self.learned(base):
            port = fitted.simulator.elements[-1].port
            screened = [s for s in self.screened(base)[0] if s.port == port]
            for near in nearest_to_learned(self.fits.part, fitted, self.laws):
                alike = [s for s in screened if s.law.dissipative == near.kind.dissipative]
                if alike and _may_stand_beside(base.laws, port, near.kind):
                    entries.append(replace(alike[0], law=near.kind, starts=(near.start,)))
        if not entries:
            return
        self._record(base, entries, self._fitted(base, entries, None, float(np.sqrt(self.floor2)), True))

    def exchange(self) -> None:
        """Try all other laws, and none, in place of each of several laws, the rest in place, until none changes."""
        for _ in range(FEW):
            best = self.best
            for element in best.effects if len(best.effects) > 1 else ():
                rest = self.beside([e for e in best.laws if e is not element], best)
                if not rest.mean_square < DIVERGED:
                    continue
                if self._in_time() and not any(step.parent.key == rest.key for step in self.steps):
                    self.keep(rest)
                    self.add(rest, again=True)
                known = self.memo.get(rest.key)  # a law that was found only beside another one may do without it
                converged = known is not None and known.thorough and known.mean_square <= rest.mean_square
                if not converged and not self.past_deadline:
                    self.keep(self.fits.polish(rest))
            if self.best.key == best.key:
                return

    def add_two(self) -> None:
        """Fit two laws at once beside the simulator alone, because one after the other may hide each other."""
        with self.stage("two at once"):
            rest = Remainder.of(self.bench, *linearised(self.bench, self.root.fitted), self.laws)
            fits, before = self.fits, self.best
            found = side_by_side(
                lambda pair: fit_pair(fits, self.root.fitted, rest, pair), choose_pairs(rest), self.workers
            )
            self._keep_all([t for t in found if t is not None])
        if self.best is not before:
            self.exchange()

    def _every_sensor(self) -> None:
        """Move a filter of the best hypothesis from an actuator to every sensor, as data loggers have them.

        Linear time-invariant systems commute (Oppenheim & Willsky 1997, Signals and Systems, sec. 2.3).
        """
        best, names = self.best, self.bench.simulator.output_names
        filters = [e for e in best.laws if e.port.startswith("actuator:") and (e.law.order or e.law.shifts)]
        if len(names) < 2 or len(filters) != 1 or not self._in_time():
            return
        with self.stage("every sensor"):
            source = filters[0]
            joint = self.beside([e for e in best.laws if e is not source], best)
            simulator, named = joint.fitted.simulator, dict[str, object](joint.fitted.values)
            for name in names:
                simulator = simulator.with_element(f"sensor:{name}", source.law)
                named |= simulator.elements[-1].named(source.own(best.fitted.values))
            found = self.fits.fitted(simulator, [named], len(joint.laws) + len(names), states=joint.fitted.begin)
            if found is not None:
                self.keep(self.fits.polish(found))

    def _escape_local_minimum(self) -> bool:
        """Refit the simulator alone from the best law's parameters; if far better, restart the search and return True.

        The first refit was in a local minimum, and the law has compensated for that.
        """
        best, bench = self.best.fitted, self.bench
        with self.stage("look back"):
            try:
                alone = bench.fit(bench.simulator, [best.values], states=best.begin, solver=THOROUGH)
            except InputError:
                return False
        if alone.cost > CLEARLY_BETTER * self.root.mean_square:
            return False
        self.without, self.memo, self.steps = alone, {}, []
        self.findings.clear()
        self.keep(Trial((), alone, alone.cost, alone.cost, True))
        return True

    def beside(self, laws: Sequence[Placed], joint: Trial) -> Trial:
        """Make a trial of some laws of a hypothesis, perhaps of another search, at the values that they have there."""
        simulator: Simulator = self.bench.simulator
        named: dict[str, object] = {k: joint.fitted.values.get(k, v) for k, v in self.root.fitted.values.items()}
        for e in laws:
            simulator = simulator.with_element(e.port, e.law)
            named |= simulator.elements[-1].named(e.own(joint.fitted.values))
        fitted = self.bench.run(simulator, named, joint.fitted.begin)
        return Trial(fitted.last_elements(len(laws)), fitted, fitted.cost, fitted.cost)


@dataclass(frozen=True)
class UntilInterrupted:
    """A context that an interrupt ends; the search is marked as interrupted then."""

    search: Search

    def __enter__(self) -> None:
        """Do nothing."""

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> bool:
        """Catch an interrupt, and nothing else."""
        caught = is_interrupt(error)
        if caught:
            self.search.interrupted = True
            self.search.say.interrupted()
        return caught


def likeliest(trials: Sequence[Trial], evidence: Callable[[Trial], float]) -> list[Trial]:
    """List the hypotheses that may be the likeliest by an evidence, the likeliest first."""
    ranked = sorted(trials, key=evidence, reverse=True)
    return [t for t in ranked if evidence(t) > evidence(ranked[0]) - CONTENDING_NATS]


def _may_stand_beside(laws: Sequence[Placed], port: str, law: Law) -> bool:
    """Tell whether a law at a port may be a further effect beside some laws."""
    return all(e.port != port or complements(e.law, law) for e in laws)


def _count_samples(fitted: Fitted, bench: Workbench) -> float:
    """Compute the number of samples over the correlation time of a fit's residual."""
    residual = [e[r.skip :] for e, r in zip(fitted.residual, bench.recordings, strict=True)]
    return max(effective_size(residual), FEWEST)
