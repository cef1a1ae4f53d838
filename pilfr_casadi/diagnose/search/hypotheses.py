"""The hypotheses of a search: sets of laws in ports, each fitted once and kept, and compared by one log evidence."""

from __future__ import annotations

import itertools
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from ..._base import Stages, UntilInterrupted
from ...laws import Law
from ...simulators import Placed, Simulator
from ..faults.gates import EQUAL_RATIO
from ..faults.offsets import describe_offsets
from ..fits.coloured_noise import log_likelihood
from ..fits.evidence import (
    CONTENDING_NATS,
    EFFECT_PRIOR,
    EXPLAINED_QUIET_NOISE,
    FAR_RATIO,
    INDISTINGUISHABLE_NATS,
    LARGE_MODEL_ERROR,
    LOUDEST_NOISE,
    WRONG_MODEL_SAMPLES,
    EffectiveSamples,
    HeldOut,
    formula_tolerance,
    held_out_errors,
    information,
    log_evidence,
    log_occam,
    log_prior,
    log_prior_of_states,
    spread,
)
from ..fits.flexible_forces import flexible_shares, innovation_share
from ..fits.floor import FEWEST, Floor, count_samples, swells_with, white_part
from ..fits.force_recovery import is_curve_along
from ..fits.screen import Scored, screen
from ..fits.workbench import DIVERGED, Fitted, Workbench
from .trials import Key, Name, Trial, Trials

MOST_CROSS_VALIDATED = 6  # hypotheses that are cross-validated; more only until the likeliest one is


@dataclass(eq=False, repr=False)
class Findings:
    """Results about one hypothesis that are computed when they are first needed."""

    # the scores of all further laws, and the observer's gain; see `screen`
    screened: tuple[list[Scored], np.ndarray | None] | None = None
    flexible: dict[str, float] | None = None  # the share of the residual that a flexible force at each port explains
    innovations: float | None = None  # the share of the residual's innovations that a flexible force explains
    driven: bool | None = None  # whether the power of its residual follows the machine's signals
    # the log likelihood of a sample of its residual as coloured noise, and the log prior density of its first states
    likelihood: tuple[float, float] | None = None
    learned: list[Fitted] | None = None  # the learned forces beside it, best first
    held_out: HeldOut | None = None  # its errors on held-out data
    spread: float | None = None  # the mean square uncertainty of its predictions for other inputs
    # whether the force of a law with memory is a curve along the runs, by the prefix of its parameters
    curves: dict[str, bool] = field(default_factory=dict)
    varied: bool = False  # whether variations of parameters were tried beside it
    replaced: bool = False  # whether laws with constant parameters were tried in place of its added law, which varies


@dataclass(eq=False, repr=False)
class Hypotheses:
    """The hypotheses that were fitted to some recordings, and the results about each."""

    bench: Workbench  # recordings, and the settings for runs and fits
    without: Fitted  # the refitted simulator, with no law
    floor: Floor  # the noise; if it is only estimated, the search improves the estimate
    laws: Sequence[type[Law]]
    workers: int
    say: Stages
    hold_settled: bool = True  # whether the hold of the inputs is stated, or was compared with the others
    surrogate_nrmse: float = 0.0  # NRMSE between a surrogate and its simulation; the floor contains it
    until: float = np.inf  # time (of `time.perf_counter`) at which the search ends
    memo: dict[Key, Trial] = field(default_factory=dict)  # the best trial of every fitted hypothesis, by key
    alternatives: dict[str, tuple[Law, ...]] = field(default_factory=dict)
    # further results about each fitted hypothesis, by key
    findings: defaultdict[Key, Findings] = field(default_factory=lambda: defaultdict(Findings))
    times: dict[str, float] = field(default_factory=dict)
    most_effects: float = np.inf  # effects that may be named
    out_of_time: bool = False  # whether the time limit ended the search
    # pairs of port and law that were selected for a fit beside the simulator alone, and those that were tried
    selected: int = 0
    tried: int = 0
    count: float = FEWEST  # samples of the best residual over its correlation time
    # mean squares of the mismatch (n_y,) for `tolerance`; None: those of the refit
    mismatch2: np.ndarray | None = None
    # the objects that `_least_tolerant` was computed from, and its value
    _least: tuple[tuple[object, ...], float] | None = None

    @cached_property
    def fits(self) -> Trials:
        """Fits of hypotheses, with the bench, workers and time limit of the search."""
        return Trials(self.bench, self.workers, self.until, self.without.residual)

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C was pressed: nothing more is fitted, and the answer says so."""
        return self.bench.interrupt.pressed

    @property
    def cut_short(self) -> bool:
        """Whether an interrupt or the time limit ended the search."""
        return self.interrupted or self.out_of_time

    @property
    def samples(self) -> float:
        """Effective samples, shared by all hypotheses."""
        return self.effective_samples.at(self._least_tolerant())

    def _least_tolerant(self) -> float:
        """Compute the smallest `_tolerant` of all hypotheses; kept while these stay, because each evidence needs it."""
        basis = (self.tolerance, self.bench, *self.memo.values())  # objects, each equal to itself alone
        if self._least is None or self._least[0] != basis:
            self._least = basis, min(map(self._tolerant, self.memo.values()))
        return self._least[1]

    @property
    def floor2(self) -> float:
        """Mean square of the noise in units of the outputs' variance."""
        return self.bench.pool(self.floor.squares(self.bench.scale))

    @property
    def tolerance(self) -> float:
        """Mean square error that any law may leave in any output; see `evidence.formula_tolerance`."""
        mismatch2 = self.root.fitted.squares if self.mismatch2 is None else self.mismatch2
        return formula_tolerance(mismatch2, self.floor.squares(self.bench.scale))

    def _tolerant(self, trial: Trial) -> float:
        """Compute the mean square error of a hypothesis and what its formulas may leave."""
        if not np.isfinite(trial.mean_square):
            return np.inf
        return self.bench.pool(self._less_freedom(trial) * trial.fitted.squares + self.tolerance)

    def _less_freedom(self, trial: Trial) -> float:
        """Compute the ratio of all samples to those that are left to judge the laws by.

        The states in which laws begin in a recording follow as many samples, whatever the physics. In a short recording
        the register of a long delay holds most of it.
        """
        dt, count = self.bench.dt, sum(r.begins == "estimate" for r in self.bench.recordings)
        unknown = count * sum(e.law.first_unknowns(e.own(trial.fitted.values), dt) for e in trial.laws)
        total = sum(e.size for e in self.bench.scored(trial.fitted.residual))
        return total / max(total - unknown, 1)

    def may_leave(self, floor: Floor | None = None) -> float:
        """Compute the mean square of a noise, by default the floor, and what the right formulas may leave."""
        return self.bench.pool((floor or self.floor).squares(self.bench.scale) + self.tolerance)

    @property
    def effective_samples(self) -> EffectiveSamples:
        """The effective samples at any error, from the noise and the number of samples of the recordings."""
        return EffectiveSamples(self.may_leave(), self.count)

    @property
    def root(self) -> Trial:
        """The hypothesis without laws."""
        return self.memo[frozenset()]

    @property
    def offsets(self) -> str:
        """Words for the offsets that all hypotheses have, such as "the offset of u"; empty if there is none."""
        return describe_offsets(self.bench.simulator.elements)

    @property
    def best(self) -> Trial:
        """The most promising hypothesis, from which the search continues."""
        return max(self.memo.values(), key=self.optimistic_evidence)

    def optimistic_evidence(self, trial: Trial) -> float:
        """Compute the log evidence of a hypothesis with as many effective samples as at the noise level."""
        return self._log_evidence(trial, self._tolerant(trial), self.effective_samples.at(0.0))

    def evidence(self, trial: Trial) -> float:
        """Compute the log evidence of a hypothesis, from its error on held-out blocks if that is known.

        Where all models are wrong, the spread of predictions for other inputs counts as an error, where it is known.
        """
        return self._judged_evidence(trial, 0.5)

    def _judged_evidence(self, trial: Trial, quantile: float) -> float:
        """Compute the log evidence, with a quantile of the known ratios for one that was not cross-validated."""
        known, v = self.findings[trial.key].held_out, np.inf
        if known or np.isfinite(trial.mean_square):
            ratio = self._held_out_ratio(quantile) * self._less_freedom(trial)
            squares = known.squares if known else ratio * trial.fitted.squares
            v = self.bench.pool(squares + self.tolerance) + self._known_spread(trial)
        return self._log_evidence(trial, v, self.samples)

    def squares_elsewhere(self, trial: Trial) -> np.ndarray:
        """Return a hypothesis' mean square errors, (n_y,), as large as on held-out blocks if those are known.

        Not the predicted second halves: a motion that nearly is unstable amplifies the errors of the right laws.
        """
        known = self.findings[trial.key].held_out
        ratio = max(known.blocks / max(trial.mean_square, 1e-300), 1.0) if known else 1.0
        return np.asarray(ratio * trial.fitted.squares)

    def _known_spread(self, trial: Trial) -> float:
        """Return the spread of a hypothesis where all models are wrong, as far as it is known; zero elsewhere.

        Further laws determine nothing better, so that it is at least the largest that is known with fewer laws.
        """
        if not self._all_wrong:
            return 0.0
        own = self.findings[trial.key].spread
        fewer = (self.findings[key].spread or 0.0 for key in self.memo if key < trial.key) if own is None else (own,)
        return max(fewer, default=0.0)

    def _held_out_ratio(self, quantile: float) -> float:
        """Compute a quantile of the known ratios of held-out to fit error (mean squares).

        The median of two ratios is the smaller: one hypothesis that predicts badly says nothing about the others.
        """
        known = [(self.findings[key].held_out, trial.mean_square) for key, trial in self.memo.items()]
        ratios = [h.mean_square / fit for h, fit in known if h and np.isfinite(h.mean_square) and fit > 0]
        return float(np.quantile(ratios, quantile, method="lower")) if ratios else 1.0

    def _log_evidence(self, trial: Trial, v: float, n: float) -> float:
        return log_evidence(v, trial.information, self.log_prior(trial), n)

    def log_prior(self, trial: Trial) -> float:
        """Compute the log prior probability of a hypothesis."""
        doubtful = trial.doubtful or any(self.hides_memory(trial, e) for e in trial.laws)
        return log_prior(trial.laws, self.alternatives, doubtful, self.domains)

    def doubtful(self, trial: Trial, element: Placed) -> bool:
        """Tell whether a law of a hypothesis degenerates, at its fitted values or along its motion."""
        return element.law.doubtful(element.own(trial.fitted.values)) or self.hides_memory(trial, element)

    def hides_memory(self, trial: Trial, element: Placed) -> bool:
        """Tell whether a law remembers where its motion turned, but its force is a curve along the fitted runs."""
        if not element.law.turns:
            return False
        curves, number = self.findings[trial.key].curves, trial.fitted.simulator.elements.index(element)
        if element.prefix not in curves:
            curves[element.prefix] = is_curve_along(self.bench, trial.fitted, number)
        return curves[element.prefix]

    @cached_property
    def domains(self) -> dict[str, str]:
        """The physical domain of each port, by name."""
        return {port.name: port.domain for port in self.bench.simulator.all_ports()}

    def held_out(self, trial: Trial) -> HeldOut:
        """Compute the held-out errors and the spread of a hypothesis, once, and return the errors.

        If it follows no better than with fewer laws, it has those of the hypothesis with fewer laws.
        """
        known = self.findings[trial.key].held_out
        if known is None:
            alike = [t for t in self.memo.values() if t.key < trial.key and t.thorough and self._alike(t, trial)]
            shown = min([*alike, trial], key=lambda t: len(t.key))
            known = self.findings[shown.key].held_out or held_out_errors(self.bench, shown.fitted, self.workers)
            if np.isfinite(known.rms) or not self.past_deadline:  # otherwise the time was over before they were known
                spread = self.spread_of(shown)
                for key in (shown.key, trial.key):
                    self.findings[key].held_out, self.findings[key].spread = known, spread
        return known

    def _alike(self, one: Trial, other: Trial) -> bool:
        """Tell whether two hypotheses follow the recordings so alike that these do not distinguish them."""
        ratio = one.mean_square / max(other.mean_square, 1e-300)
        nats = 0.5 * self.effective_samples.at(0.0) * np.log(ratio)
        return bool(ratio < EQUAL_RATIO and nats < INDISTINGUISHABLE_NATS)

    def spread_of(self, trial: Trial) -> float:
        """Compute the spread of a hypothesis, once."""
        known = self.findings[trial.key]
        if known.spread is None:
            known.spread = self.spread(trial.fitted)
        return known.spread

    def spread(self, fitted: Fitted) -> float:
        """Compute the mean square uncertainty of a fitted simulator's predictions for other inputs."""
        own = EffectiveSamples(self.floor2, self.count_samples(fitted))
        v = self.bench.pool(fitted.squares + self.tolerance)
        return spread(self.bench, fitted, self.added_laws(fitted), v, own.at(0.0))

    def added_laws(self, fitted: Fitted) -> tuple[Placed, ...]:
        """Return the laws that a fitted simulator has beside the one that is diagnosed."""
        return fitted.simulator.elements[len(self.bench.simulator.elements) :]

    @property
    def _all_wrong(self) -> bool:
        """Whether over a fifth of even the best model's error may be model error, or samples are too few to tell."""
        return self.samples < WRONG_MODEL_SAMPLES / LARGE_MODEL_ERROR

    def cross_validate_likeliest(self) -> None:
        """Compute the held-out errors of the likeliest hypotheses.

        If only one is likely and its error is noise, the fit error is enough. Otherwise held-out data decide, because a
        wrong model may overfit, and among models that follow the recordings equally well the right one predicts best.
        If the search took all its time, the comparison has half of what is left for the conclusion.
        """
        if not self._all_wrong and len({frozenset(e.name for e in t.laws) for t in self._likeliest()}) < 2:
            return
        now = time.perf_counter()
        until = max(self.until, now + (self.bench.deadline - now) / 2)
        with self.stage("held-out blocks"):
            if self._all_wrong:
                self.held_out(self.root)
            for done in itertools.count():
                best = max(self.memo.values(), key=self.evidence)
                unknown = [t for t in (best, *self._likeliest()) if self.findings[t.key].held_out is None]
                if not unknown or (done >= MOST_CROSS_VALIDATED and unknown[0] is not best):
                    break
                if time.perf_counter() > until:  # an unfinished comparison favours the hypotheses that were not judged
                    self.out_of_time = True
                    self.forget_held_out()
                    self._judge_by_spread()
                    break
                self.say("held-out blocks", done, min(done + len(unknown), max(MOST_CROSS_VALIDATED, done + 1)))
                self.held_out(unknown[0])

    def forget_held_out(self) -> None:
        """Forget the held-out errors, so that all hypotheses are compared by their fit errors."""
        for known in self.findings.values():
            known.held_out = known.spread = None

    def _judge_by_spread(self) -> None:
        """Compute the spread of the likeliest hypotheses, which takes less time than to hold data out."""
        while self._all_wrong and not self.past_deadline:
            unknown = [t for t in likeliest(self.memo.values(), self.evidence) if t.laws]
            unknown = [t for t in unknown if self.findings[t.key].spread is None]
            if not unknown:
                break
            self.spread_of(unknown[0])

    def _likeliest(self) -> list[Trial]:
        """List the hypotheses that may be the likeliest if they predict as well as any that did."""
        return likeliest(self.memo.values(), partial(self._judged_evidence, quantile=0.0))

    def flexible(self, trial: Trial) -> dict[str, float]:
        """Compute the share of a trial's residual that a flexible force explains, by port."""
        known = self.findings[trial.key]
        if known.flexible is None:
            with self.stage("flexible"):
                known.flexible = flexible_shares(self.bench, trial.fitted)
        return known.flexible

    def innovation_share(self, trial: Trial) -> float:
        """Compute the share of the innovations of a trial's residual that a flexible force explains."""
        known = self.findings[trial.key]
        if known.innovations is None:
            known.innovations = innovation_share(self.bench, trial.fitted)
        return known.innovations

    def evidence_in_noise(self, trial: Trial) -> float:
        """Compute the log evidence of a hypothesis whose residual is coloured noise.

        Its innovations are weighted as white noise. The prior of the laws' initial states is included; otherwise a law
        could fit slow noise by an implausible initial state.
        """
        if not np.isfinite(trial.mean_square):
            return -np.inf
        known, residuals = self.findings[trial.key], self.bench.scored(trial.fitted.residual)
        size = sum(e.size for e in residuals)
        n = replace(self.effective_samples, count=size).at(0.0)
        if known.likelihood is None:
            known.likelihood = log_likelihood(residuals) / size, log_prior_of_states(self.bench, trial.fitted)
        likelihood, states = known.likelihood
        occam = log_occam(trial.mean_square, trial.information, n)
        return n * likelihood + states - occam + self.log_prior(trial)

    def screened(self, parent: Trial) -> tuple[list[Scored], np.ndarray | None]:
        """Score every port and law beside a hypothesis; see `screen`."""
        known = self.findings[parent.key]
        if known.screened is None:
            with self.stage("screen"):
                known.screened = screen(self.bench, parent.fitted, self.laws, self.floor.deviation, self.workers)
                self.note_alternatives(known.screened[0])
        return known.screened

    def note_alternatives(self, scored: Sequence[Scored]) -> None:
        """Note the laws that are possible at each port."""
        for s in scored:
            there = self.alternatives.setdefault(s.port, ())
            if not any(type(law) is type(s.law) for law in there):
                self.alternatives[s.port] = (*there, s.law)

    @property
    def least_floor(self) -> Floor:
        """Lower limit of the noise: the measured noise, or the white part of the best residual."""
        if self.floor.source != "estimated":
            return self.floor
        white = white_part(self.bench.scored(self.best.fitted.residual))
        white = np.hypot(white, self.surrogate_nrmse * self.bench.scale)
        return Floor(white, self.floor.source)

    @property
    def least_noise2(self) -> float:
        """Mean square of the least floor, in units of the outputs' variance."""
        return self.bench.pool(self.least_floor.squares(self.bench.scale))

    def can_improve(self, trial: Trial, noise: Floor | None = None) -> bool:
        """Tell whether a further law would be worth its prior if it left only the noise, by default the floor.

        An error no larger than what the formulas of the present laws may leave asks for no further law.
        """
        limit = self.may_leave(noise)
        most = 0.5 * self.effective_samples.at(0.0) * np.log(max(self._tolerant(trial) / limit, 1.0))
        return trial.mean_square > limit and bool(most > np.log(max(len(self.alternatives), 1)) - EFFECT_PRIOR)

    @property
    def past_deadline(self) -> bool:
        """Whether nothing more is fitted: Ctrl-C was pressed, or the time for the whole diagnosis is over."""
        return self.interrupted or time.perf_counter() > self.bench.deadline

    def may_go_on(self) -> bool:
        """Tell whether there is time for more; if not, set `out_of_time`, with which the result tells that."""
        self.out_of_time = self.out_of_time or time.perf_counter() > self.until
        return not self.out_of_time

    def cut_short_with(self, other: Hypotheses) -> None:
        """Note that another search of the same diagnosis was interrupted or ran out of time."""
        if other.interrupted:
            self.bench.interrupt.handle()
        self.out_of_time = self.out_of_time or other.out_of_time

    def keep(self, trial: Trial) -> None:
        """Put a trial into the memo, unless the same hypothesis fits better there."""
        if trial.information is None:
            trial = replace(trial, information=information(self.bench, trial.fitted, trial.laws))
        known = self.memo.get(trial.key)
        if known is None or trial.supersedes(known):
            self.memo[trial.key] = trial
            self.findings.pop(trial.key, None)
        if self.floor.source == "estimated" and trial.mean_square < self.floor2:  # noise is no larger than the residual
            self.floor = Floor(np.minimum(self.floor.deviation, self.rms(trial)), "estimated")

    def thorough(self, trial: Trial) -> Trial:
        """Return the same hypothesis fitted to convergence and to all samples, or as it is after the deadline."""
        if not self.memo[trial.key].thorough and not self.past_deadline:
            self.keep(self.fits.polish(trial))
        return self.memo[trial.key]

    def estimate_noise(self) -> None:
        """Estimate the noise as the part of the best hypothesis' residual that no force or law at any port explains.

        A measured noise is kept. Third differences give a lower limit: the white noise in the residual. The
        smallest error of any hypothesis is an upper limit. The effective samples follow from the residual's
        correlation, and are no more than those in which the mismatch acts. The slow residual of a wrong model would
        make them so few that no evidence could refute it; so a hypothesis that leaves a far smaller error takes its
        place.
        """
        best, nearest = self.best, min(self.memo.values(), key=lambda t: t.mean_square)
        best = nearest if FAR_RATIO * nearest.error < best.error else best
        self.count = self.count_samples(best.fitted)
        if self.floor.source != "estimated" or self.past_deadline:
            return
        followed = [s.share for s in self.screened(best)[0] if s.source == "simulation"]
        share = float(np.clip(1 - max([*self.flexible(best).values(), *followed], default=0.0), 0.0, 1.0))
        if best is self.root and share > 1 - EXPLAINED_QUIET_NOISE and self.is_driven:
            share = 0.0  # what no force explains is noise, but not if the machine drives it
        rest = np.minimum(np.sqrt(share) * self.rms(best), LOUDEST_NOISE * self.bench.scale)
        known, white = self.surrogate_nrmse * self.bench.scale, white_part(self.bench.scored(best.fitted.residual))
        noise = np.minimum(np.hypot(np.maximum(white, rest), known), self.rms(nearest))
        self.floor = Floor(noise, "estimated")

    @property
    def is_driven(self) -> bool:
        """Whether the power of the refit's residual follows the inputs, the simulated outputs or their rates.

        The power of noise does not. The measured outputs hold the noise itself, and their rates hardly anything else
        where the machine is slow.
        """
        known, fitted = self.findings[self.root.key], self.root.fitted
        if known.driven is None:
            signals = []
            for r, e in zip(self.bench.recordings, fitted.residual, strict=True):
                simulated = r.y + e
                signals.append(np.column_stack([r.u, simulated, np.gradient(simulated, axis=0)])[r.skip :])
            # the noise may be of another level in each recording, such as with another range of a sensor
            rest = [e / np.maximum(white_part([e]), 1e-300) for e in self.bench.scored(fitted.residual)]
            known.driven = swells_with(rest, signals)
        return known.driven

    def count_samples(self, fitted: Fitted) -> float:
        """Count the samples over the correlation time of a fit's residual, at most those in which the mismatch acts."""
        residuals, mismatch = (self.bench.scored(f.residual) for f in (fitted, self.root.fitted))
        return count_samples(residuals, mismatch, self.bench.scale)

    def rms(self, trial: Trial) -> np.ndarray:
        """Compute the rms error of each output, (n_y,)."""
        return np.asarray(self.bench.scale * np.sqrt(trial.fitted.squares))

    def run_laws(self, laws: Sequence[Placed], joint: Trial) -> Trial:
        """Run some laws of a hypothesis, perhaps of another search, at its values, and return them as a trial.

        The steps are as fine as those of the hypothesis, because a law that only needs finer steps explains nothing.
        """
        simulator: Simulator = self.bench.simulator
        named: dict[str, object] = {k: joint.fitted.values.get(k, v) for k, v in self.root.fitted.values.items()}
        for e in laws:
            simulator = simulator.with_element(e.port, e.law)
            named |= simulator.elements[-1].named(e.own(joint.fitted.values))
        bench = replace(self.bench, at_least=max(self.bench.at_least, joint.fitted.model.substeps))
        fitted = bench.run(simulator, named, joint.fitted.begin)
        return Trial.of(fitted, len(laws))

    def leave_out(self, joint: Trial, elements: Sequence[Placed]) -> Trial | None:
        """Fit a hypothesis without some of its laws to convergence; None if it diverges.

        A law that was found beside another one may not need it. After the deadline the trial is not fitted.
        """
        rest = self.run_laws([e for e in joint.laws if not any(e is left for left in elements)], joint)
        if not rest.mean_square < DIVERGED:
            return None
        known = self.memo.get(rest.key)
        as_fine = known is not None and known.fitted.model.substeps >= rest.fitted.model.substeps
        converged = known is not None and known.thorough and as_fine and known.mean_square <= rest.mean_square
        if not converged and not self.past_deadline:
            found = self.fits.converge(rest)
            self.keep(self.fits.refine_knee(found) if found.error < FAR_RATIO * joint.error else found)
        kept = self.memo.get(rest.key)
        return kept if kept is not None and np.isfinite(kept.mean_square) else None

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Report that a stage begins and ends, add its seconds, and end the search if one of its fits was interrupted.

        Raises
        ------
        KeyboardInterrupt
            If a fit was interrupted. Such a fit has returned its best result so far.
        """
        self.bench.interrupt.raise_pending()
        self.say(name, 0, 1, self.without.cost**0.5)
        began = time.perf_counter()
        yield
        self.times[name] = self.times.get(name, 0.0) + time.perf_counter() - began
        self.say(name, 1, 1, self.best.error)
        self.bench.interrupt.raise_pending()

    def until_interrupted(self) -> UntilInterrupted:
        """Make a context that an interrupt ends, so that the answer rests on what was found before it."""
        return UntilInterrupted(self.bench.interrupt, self.say.interrupted)


def likeliest(trials: Iterable[Trial], evidence: Callable[[Trial], float]) -> list[Trial]:
    """List the hypotheses whose evidence is near the largest, the likeliest first."""
    ranked = sorted(trials, key=evidence, reverse=True)
    return [t for t in ranked if evidence(t) > evidence(ranked[0]) - CONTENDING_NATS]


def likeliest_forms(trials: Iterable[Trial], evidence: Callable[[Trial], float]) -> list[Trial]:
    """Return of each set of laws the likeliest form, the likeliest set first."""
    first = dict[frozenset[Name], Trial]()
    for trial in sorted(trials, key=evidence, reverse=True):
        first.setdefault(trial.names, trial)
    return [*first.values()]
