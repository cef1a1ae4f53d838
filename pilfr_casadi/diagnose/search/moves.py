"""The moves of the search from hypothesis to hypothesis, each a set of laws in ports.

Moves lead from one hypothesis to others: *add* a law to the present ones; *exchange* one of several laws for another,
the others fixed in place; *add two* at once, if neither helps alone; *refine* a law: fit it in a finer form, or with a
strength that varies with a signal; *vary a parameter* of the simulator with a signal; *name a learned force*: fit the
laws nearest to a force that was learned beside a hypothesis. A move starts from the most promising hypothesis. The
search ends if a move brings no better one, if the error is at the noise, or at the time limit. All fits are kept and
count in the posterior (`hypotheses`).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ..._base import InputError
from ...laws import constant
from ...simulators import ACTUATOR, PARAMETER, SENSOR, kind_of, port_name
from ..faults.gates import CLEARLY_BETTER, Checked, Gate
from ..faults.timing import TimeShift, find_time_shift
from ..fits.evidence import BETTER_RATIO, FAR_RATIO, LEAST_FORMULA_ERROR, cap_mismatch
from ..fits.floor import ABOVE_NOISE
from ..fits.linearise import linearise_runs
from ..fits.screen import Remainder, Scored
from ..fits.workbench import DIVERGED, FEW, THOROUGH, Fitted, refit, refit_with_other_holds
from .forms import Forms, is_filter, may_stand_beside
from .hypotheses import likeliest_forms
from .learned import learn_forces, nearest_to_learned
from .pairs import choose_pairs, fit_pair
from .trials import Effort, Trial

# Effort
NEARLY_EXPLAINED = 0.05  # share of the excess left by one law below which far worse laws are not refined
TWO = "two at once"  # a stage, entered once
MOST_LEARNED = 2  # learned forces that are kept: those with the smallest error


@dataclass(eq=False, repr=False)
class Search(Forms):
    """A search, filled by `run`."""

    aligned: bool = False  # whether the times of the channels are settled, so that no shift is looked for
    shift: Gate | None = None  # the shift of a channel that ended the search, because it shows only beside a law
    better_hold: str = ""  # the hold of the inputs that ended the search, because it proved better

    def run(self, effects: float) -> Search:
        """Search for up to `effects` effects; an interrupt ends the search with the present results."""
        self.better_hold, self.most_effects = "", effects
        self.keep(Trial.of(self.without, 0, thorough=True))
        with self.until_interrupted():
            self.estimate_noise()
            if not self.interrupted:
                self._grow()
                self._name_rest()
                self._finish()
        if self.interrupted:
            self.forget_held_out()
        return self

    @property
    def must_repeat(self) -> bool:
        """Whether the search goes no further: it has to be repeated with another hold or with a channel shifted."""
        return bool(self.better_hold) or self.shift is not None

    def resume(self, effects: float | None = None) -> None:
        """Continue with the present hold, for up to `effects` effects or as many as before; not after an interrupt."""
        self.hold_settled = True
        if not self.interrupted:
            self.run(self.most_effects if effects is None else effects)

    def adopt(self, other: Trial) -> None:
        """Fit the laws of another search's hypothesis to these recordings, from its values, and keep the fit."""
        with self.until_interrupted(), suppress(InputError):
            there = self.run_laws(other.laws, other)
            if there.mean_square < DIVERGED:
                self.keep(self.fits.polish(there))

    def _grow(self, varied: bool = False) -> None:
        """Add effects while that pays; end as soon as the other hold, or a channel's shift, proves better.

        A parameter that varies can imitate many laws. So hypotheses with one are a basis for more only if `varied`.
        The first law is fitted even if the preparation took all the time.
        """
        while (
            self.can_improve(self.best)
            and len((parent := self._parent(varied)).effects) < self.most_effects
            and self._is_worth_its_prior(parent)
            and (self.may_go_on() or not self.moves)
        ):
            self.add(parent)
            if not parent.laws and self.may_go_on() and self._escape_local_minimum():
                self.add(self.root)
            self.better_hold = "" if self.hold_settled else self.find_better_hold()
            if not parent.laws and not self.must_repeat:
                self._find_shift()
            if self.must_repeat:
                return
            if not parent.laws and self.can_improve(self.best) and self.may_go_on():
                self.vary_parameters(self.root)
            if len(self._parent(varied).effects) > len(parent.effects) >= 1:
                self.exchange()
            if len(self._parent(varied).laws) <= len(parent.laws):  # no added law is worth its prior
                break
        if self.most_effects > 1 and TWO not in self.times and self.can_improve(self.best) and self.may_go_on():
            best = self.best
            self.add_two()
            if self.best is not best:
                self._grow(varied)

    def _parent(self, varied: bool) -> Trial:
        """Return the best hypothesis, or the best one in which no parameter varies."""
        if varied:
            return self.best
        fixed = [t for t in self.memo.values() if all(kind_of(e.port) != PARAMETER for e in t.laws)]
        return max(fixed, key=self.optimistic_evidence)

    def _grow_to_noise(self) -> None:
        """Try one more law on a residual below the formula error of the laws before it.

        An inexact formula can look like one more effect. The law is therefore kept only if the remaining residual can
        be white noise. Residuals below LEAST_FORMULA_ERROR are skipped.
        """
        base, least = self.best, LEAST_FORMULA_ERROR * self.bench.pool(cap_mismatch(self.root.fitted.squares))
        is_noise = base.mean_square < ABOVE_NOISE**2 * self.least_noise2 + least
        if not base.laws or is_noise or base.mean_square > self.may_leave() or not self.may_go_on():
            return
        noise = self.floor, self.count
        self.mismatch2, found = base.fitted.squares, False
        try:
            if self.can_improve(base):
                self.add(base, few=True)
            at_noise = self.best.mean_square < ABOVE_NOISE**2 * self.least_noise2
            found = at_noise and len(self.best.effects) > len(base.effects)
        finally:
            if not found:
                self.mismatch2, (self.floor, self.count) = None, noise
        if found:  # other laws may stand beside the new one in place of those before
            self.exchange()

    def _name_rest(self) -> None:
        """Try varying parameters and laws near learned forces beside three hypotheses.

        These are the simulator, the best one, and the best one without its weakest effect, which may imitate a law that
        only a learned force shows, such as a gain that varies with the position. Search on if one of them becomes the
        best.
        """
        if self.must_repeat:
            return
        best = self._parent(varied=False)
        fewer = [t for t in self.memo.values() if t.effects and t.key < best.key]
        without_weakest = sorted(fewer, key=lambda t: (-len(t.effects), t.mean_square))[:1]
        for name_rest in (self.vary_parameters, self.name_learned):
            for base in {t.key: t for t in (self.root, best, *without_weakest)}.values():
                if len(base.effects) < self.most_effects and self.can_improve(self.best) and self.may_go_on():
                    name_rest(base)
        if self.best is not best:  # laws that were found before may have made up for its last one
            self.exchange()
            self._grow(varied=True)

    def _finish(self) -> None:
        """Look for what the moves before cannot find, and compare the likeliest hypotheses."""
        if self.must_repeat:
            return
        if len(self.best.effects) < self.most_effects:
            self._grow_to_noise()
        self._every_sensor()
        self.compare_effects()
        self.cross_validate_likeliest()

    def _is_worth_its_prior(self, trial: Trial) -> bool:
        """Tell whether the last of several laws was worth it; a wrong model gains from any further law."""
        fewer = [t for t in self.memo.values() if t.laws and len(t.effects) < len(trial.effects)]
        return len(trial.effects) < 2 or self.evidence(trial) > max(map(self.evidence, fewer), default=-np.inf)

    def find_better_hold(self) -> str:
        """Return the hold of the inputs with which the best hypothesis follows best, if clearly better; else empty."""
        best = self.best.fitted
        found = refit_with_other_holds(
            self.bench,
            [best.values],
            best.simulator,
            states=best.initial,
            may_go_on=lambda: not self.interrupted and self.may_go_on(),
        )
        if self.interrupted or not found:
            return ""
        held, fitted = found[0]
        return held.hold if fitted.cost < best.cost / BETTER_RATIO**2 else ""

    def _find_shift(self) -> None:
        """Look beside each of the first laws for an output that comes before its cause; missing physics may hide it.

        Filters and laws with memory are left out: they imitate a shift. A delay is a law itself.
        """
        if self.aligned or not self.can_improve(self.best):
            return
        first_move = {t.key for m in self.moves if not m.parent.laws for t in m.trials}
        kept = [self.memo[key] for key in first_move]
        plain = [t for t in kept if not (t.law.order or t.law.memory)]
        best, shift_step = CLEARLY_BETTER * self.best.mean_square, 1.0 if self.hold_settled else 0.5
        with self.stage("shifts beside a law"):
            for trial in likeliest_forms(plain, self.optimistic_evidence)[:FEW] if self.may_go_on() else ():
                bench = replace(self.bench, simulator=trial.fitted.simulator)
                found = find_time_shift(Checked(bench, trial.fitted), shift_step, given=False)
                shift = found.gates[0] if found.gates else None
                if isinstance(shift, TimeShift) and shift.leads and found.cost < best:
                    sentence = f"{shift.sentence.rstrip('.')} (beside {trial.element.words})."
                    best, self.shift = found.cost, replace(shift, sentence=sentence)
        self.aligned = True

    def add(self, parent: Trial, few: bool = False) -> None:
        """Fit the laws, or only a few, that the screen selects beside a hypothesis; polish those that may win."""
        scored, observer_gain = self.addable(parent)
        if self.moves and not self.may_go_on():
            return
        enough = float(np.sqrt(self.floor2 + NEARLY_EXPLAINED * max(parent.mean_square - self.floor2, 0.0)))
        trials = self.fit_selected(parent, scored, Effort(observer_gain, enough, few))
        with self.stage("choice"):
            self.record(parent, scored, trials)
            self.estimate_noise()
            best = self.best
            self.refine_added(parent)
            if self.best is not best:
                self.estimate_noise()

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
        entries, scored = list[Scored](), self.addable(base)[0]
        for fitted in self.learned(base):
            port = fitted.simulator.elements[-1].port
            for near in nearest_to_learned(self.fits.part, fitted, self.laws):
                alike = [s for s in scored if s.port == port and s.law.dissipative == near.kind.dissipative]
                if alike and may_stand_beside(base.laws, port, near.kind):
                    entries.append(replace(alike[0], law=near.kind, starts=(near.start,)))
        if entries:
            self.try_beside(base, entries)

    def exchange(self) -> None:
        """Try all other laws, and none, in place of each of several laws, the rest in place, until none changes."""
        for _ in range(FEW):
            best = self.best
            for element in best.effects if len(best.effects) > 1 else ():
                rest = self.run_laws([e for e in best.laws if e is not element], best)
                if not rest.mean_square < DIVERGED:
                    continue
                if self.may_go_on() and not self.expanded(rest):  # from the values of all laws, which may be right
                    self.keep(rest)
                    self.add(rest, few=True)
                found = self.leave_out(best, [element])
                wrong = found is not None and not self.expanded(found, FAR_RATIO)  # it had been in a wrong minimum
                if found is not None and wrong and self.can_improve(self.best) and self.may_go_on():
                    self.add(found, few=True)
            if self.best.key == best.key:
                return

    def compare_effects(self) -> None:
        """Fit the best hypothesis in other forms of each effect, without each of several, and without their variations.

        A later effect can make an earlier one, or its variation, idle. It can also show the right form of one; a wrong
        form leaves an error that may pass for slow noise.
        """
        with self.stage("forms of each effect"):
            while (best := self.best).effects and not self.past_deadline:
                for element in best.effects:
                    if self.may_go_on():
                        self.fit_related_forms(best.with_added(element.pair))
                    if len(best.effects) == 1:
                        continue
                    self.leave_out(best, [element])
                    plain = constant(type(element.law))
                    if plain is not type(element.law) and kind_of(element.port) != PARAMETER:
                        self.fit_forms(self.run_laws(best.laws, best).with_added(element.pair), [plain])
                if self.best.key == best.key:
                    return

    def expanded(self, trial: Trial, ratio: float = np.inf) -> bool:
        """Tell whether laws were added to a hypothesis, at an error of at most `ratio` times the present one."""
        return any(m.parent.key == trial.key and m.parent.error <= ratio * trial.error for m in self.moves)

    def add_two(self) -> None:
        """Fit two laws at once beside the simulator alone, because one after the other may hide each other."""
        with self.stage(TWO):
            rest = Remainder.of(self.bench, *linearise_runs(self.bench, self.root.fitted), self.laws)
            fits, before = self.fits, self.best
            found = self.on_workers(lambda pair: fit_pair(fits, self.root.fitted, rest, pair), choose_pairs(rest))
            self.keep_all([t for t in found if t is not None])
        if self.best is not before:
            self.exchange()

    def _every_sensor(self) -> None:
        """Move a filter of the best hypothesis from an actuator to every sensor, as data loggers have them.

        Linear time-invariant systems commute (Oppenheim & Willsky 1997, Signals and Systems, sec. 2.3).
        """
        best, names = self.best, self.bench.simulator.output_names
        filters = [e for e in best.laws if kind_of(e.port) == ACTUATOR and is_filter(e.law)]
        if len(names) < 2 or len(filters) != 1 or not self.may_go_on():
            return
        source = filters[0]
        others = [e for e in best.laws if e is not source]
        if not all(may_stand_beside(others, port_name(SENSOR, name), source.law) for name in names):
            return
        with self.stage("every sensor"):
            joint = self.run_laws(others, best)
            simulator, named = joint.fitted.simulator, dict[str, object](joint.fitted.values)
            for name in names:
                simulator = simulator.with_element(port_name(SENSOR, name), source.law)
                named |= simulator.elements[-1].named(source.own(best.fitted.values))
            found = self.fits.fit(simulator, [named], len(joint.laws) + len(names), states=joint.fitted.begin)
            if found is not None:
                self.keep(self.fits.polish(found))

    def _escape_local_minimum(self) -> bool:
        """Refit the simulator alone from the best law's parameters; if far better, restart the search and return True.

        The first refit was in a local minimum, and the law has compensated for that.
        """
        best, bench = self.best.fitted, self.bench
        with self.stage("look back"):
            alone = refit(bench, [best.values], states=best.begin, solver=THOROUGH)
        if alone is None or alone.cost > CLEARLY_BETTER * self.root.mean_square:
            return False
        self.without, self.memo, self.moves = alone, {}, []
        self.findings.clear()
        self.keep(Trial.of(alone, 0, thorough=True))
        return True
