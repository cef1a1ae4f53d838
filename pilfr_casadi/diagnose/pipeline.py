"""The steps of a diagnosis in their order.

How an answer comes about:

1. `prepare` corrects faults of the recordings, refits the simulator, and measures the noise. The refitted simulator is
   the hypothesis that nothing is missing. What it leaves above the noise is the mismatch.
2. `Search.run` fits further hypotheses: the simulator with laws in its ports, with all parameters estimated together.
   Each gets a log evidence: how well it follows the recordings, less the cost of its parameters, plus its prior
   (`evidence`, which lists the numbers on which an answer rests).
3. `posterior` turns the evidences into probabilities. The confidence of an effect is the probability of all hypotheses
   that have it, times the probability that its law is the physics (`share_named`), times the probability that its
   strength is not zero. Four things lower it: a remainder that a flexible force explains, what the law leaves on data
   that it was not fitted to, parameters at a bound, and values at which the law degenerates into another. Among forms
   of a law that fit equally well, the one with the fewest parameters is stated.
4. `judge` chooses the verdict. It is a recording fault if its correction removed the mismatch; missing physics if the
   law of the likeliest hypothesis is more likely than not the physics; complete if the refit's residual can be noise;
   else unexplained. Steps 5 to 7 judge again if they change the probabilities.
5. If there is time, explanations without a law are tried: a parameter pinned to a wrong value, and a clipped input.
   They count if they explain as much as the law.
6. `find_named_correction` compares named laws with a learned force on held-out parts of the recordings. If the named
   law predicts worse than the force, the name is withdrawn. A learned force that stays beside the laws lowers their
   confidence (`Posterior.within`).
7. If the named laws may imitate a law where no port is declared, they are weighed against that
   (`find_undeclared_port`). If nothing has a name, such laws, those that were not tried, and parameters that vary are
   looked for, and `find_unnamed_correction` chooses the corrected simulator.
8. `_final_fits` sets offsets to zero that no longer improve the fit beside the effects, refits the simulator as given
   without offsets, and fits to convergence.
   `build_diagnosis` adds the proof (`proof`): errors on test recordings, placebos and standard errors. It changes no
   verdict.

**Long recordings.** Steps 1 to 7 see only their most informative stretches (`stretches`). The likeliest hypotheses are
fitted to everything before step 3, and the answer's simulator in step 8.

**Repetitions.** Steps 1 and 2 are repeated where something that they took for granted proves wrong (`repetitions`). If
nothing has a name after step 7 and the simulator drifts, the search is repeated in predictions, and the laws that are
found there are refitted in free run (`_name_in_predictions`).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from .._base import InputError, deferred_interrupt, in_words, one_blas_thread, percent
from ..laws import display_name
from .answer import Conclusion, FinalFits, build_diagnosis
from .arguments import Request
from .correction import Correction, find_named_correction, find_unnamed_correction, uncompared_correction
from .faults.gates import EQUAL_RATIO, Gate
from .faults.offsets import fix_idle_offsets, list_offsets, refit_without_offsets
from .faults.samples import clean_recordings, find_clipped_input
from .faults.tones import find_tones
from .fits.evidence import SURE
from .fits.workbench import Fitted, converge
from .other_explanations import (
    find_pinned_parameters,
    find_undeclared_port,
    find_untried_laws,
    find_varying_values,
    may_act_elsewhere,
)
from .posterior import Posterior, posterior
from .prediction import drift_note, drifts, unfinished_note
from .preparation import LEAST_REFIT, Prepared
from .proof import errors_of
from .repetitions import search_in_predictions, search_with_one_hold, search_with_repetitions
from .result import Diagnosis
from .search.moves import Search
from .search.stretches import Everything, Stretches, back_on_stretches, choose_stretches
from .verdict import Verdict, judge


@one_blas_thread
def diagnose_in_steps(request: Request) -> Diagnosis:
    """Carry out the steps of the module docstring."""
    request, first = search_with_repetitions(_on_stretches(request))
    ready, search = first.ready, first.search
    request, everything = _fit_to_everything(request, ready, search)
    found = _draw_conclusion(search, (*request.notes, *ready.gates))
    if found.verdict.kind == "unexplained" and request.focus is None:
        with search.until_interrupted():
            again = _advise_predictions if search.cut_short else _name_in_predictions
            found = again(request, search, found)
    final = _final_fits(request, ready, search, found, everything)
    with deferred_interrupt(again=False) as pressed:
        built = build_diagnosis(request, ready, search, found, final)
    search.bench = replace(search.bench, deadline=np.inf)  # fits that a user asks for later, as by `refine`, have time
    return replace(built, interrupted=built.interrupted or bool(pressed))


# long recordings


def _on_stretches(request: Request) -> Request:
    """Restrict a request to the most informative stretches if there are more samples than a search uses."""
    if sum(map(len, request.recordings)) <= request.search_samples:
        return request
    request.say("choice of stretches", 0, 1)
    recordings, notes = clean_recordings(request.recordings)
    hold = request.stated_hold or "zero"
    most = request.search_samples
    chosen = choose_stretches(request.simulator, recordings, hold, request.engine, most, request.workers)
    stretches = Stretches(recordings, chosen)
    request.say("choice of stretches", 1, 1)
    return replace(request, recordings=stretches.cut(), stretches=stretches, notes=(*request.notes, *notes))


def _fit_to_everything(request: Request, ready: Prepared, search: Search) -> tuple[Request, Everything | None]:
    """Fit the likeliest hypotheses to all recordings, and drop from the search those that these refute."""
    if request.stretches is None:
        return request, None
    with search.stage("fits to all recordings"):
        everything = Everything.of(search, request.stretches, ready.gates)
    note = request.stretches.note(everything is not None)
    return replace(request, notes=(note, *request.notes)), everything


def _final_fits(
    request: Request, ready: Prepared, search: Search, found: Conclusion, everything: Everything | None
) -> FinalFits:
    """Return the fits that the answer states: those of the search, or fits to everything if it ran on stretches."""
    bench, without, after = search.bench, _refit_as_given(request, search), found.fitted
    # after a held-out comparison, the offsets stay as they were compared
    if found.effects and not np.isfinite(found.correction.after):
        with search.until_interrupted():
            after = fix_idle_offsets(bench, after)
    if everything is None:
        if not search.interrupted:
            with search.until_interrupted(), search.stage("convergence"):
                after = converge(bench, after, request.deadline - time.perf_counter())
        return FinalFits(bench, without, after, ready.nominal, (without, after))
    with search.stage("fits to all recordings"):
        whole, pair = everything.bench, (without, after)
        to_all = [everything.fit(search, one) for one in pair]
        drawn = [back_on_stretches(bench, f, one.initial) for f, one in zip(to_all, pair, strict=True)]
        nominal = errors_of(whole, whole.model(request.simulator))
    return FinalFits(whole, to_all[0], to_all[1], nominal, (drawn[0], drawn[1]), partial(everything.fit, search))


def _refit_as_given(request: Request, search: Search) -> Fitted:
    """Refit the simulator without the offsets that the checks have added; after an interrupt it keeps them."""
    fitted = search.root.fitted
    if not search.interrupted:
        with search.until_interrupted():
            bench = replace(search.bench, deadline=max(search.bench.deadline, time.perf_counter() + LEAST_REFIT))
            fitted = refit_without_offsets(bench, fitted, len(request.simulator.elements))
    return fitted


# the conclusion


def _draw_conclusion(search: Search, gates: Sequence[Gate]) -> Conclusion:
    """Draw the conclusion; after an interrupt, draw it without further fits."""
    found = None
    with search.until_interrupted():
        found = _conclude_as_stage(search, gates)
    return found or conclude(search, gates)


def _conclude_as_stage(search: Search, gates: Sequence[Gate]) -> Conclusion:
    """Draw the conclusion, and note if the time ended meanwhile; an interrupted fit raises at the end of the stage."""
    with search.stage("conclusion"):
        found = conclude(search, gates)
        search.out_of_time = search.out_of_time or time.perf_counter() > search.bench.deadline
        return found


def conclude(search: Search, gates: Sequence[Gate]) -> Conclusion:
    """Draw the conclusion from a search: steps 3 to 7 of the module docstring.

    After Ctrl-C nothing more is fitted: a name that was found stays; otherwise the refitted simulator is returned.
    """
    answer, elsewhere = posterior(search), tuple[Gate, ...]()
    interrupted, finished = search.interrupted, not search.cut_short
    judged = _Judgement.of(search, answer, gates)
    if judged.kind in ("missing-physics", "unexplained") and not search.past_deadline:
        found = _conclude_without_a_law(search, judged)
        if found is not None:
            return found
    if judged.kind == "missing-physics":
        correction, fitted = find_named_correction(search, answer)
        judged, elsewhere = _weigh_names(search, answer.as_fitted(fitted), correction, gates, finished)
        if judged.kind == "missing-physics":
            return _conclude_named(search, judged, elsewhere, correction, fitted)
    if judged.kind == "unexplained" and finished:
        elsewhere = elsewhere or find_undeclared_port(search)[0]
        notes = (*judged.gates, *elsewhere, *find_untried_laws(search), *find_varying_values(search))
        judged = replace(judged, gates=notes)
    if search.interrupted and judged.kind != "recording-fault":
        return _conclude_interrupted(search, judged, came_to_an_answer=not interrupted)
    if judged.kind == "unexplained":
        return _conclude_unexplained(search, judged, elsewhere)
    refitted = search.root.fitted
    return Conclusion(judged.verdict, judged.gates, refitted, uncompared_correction(search, refitted))


@dataclass(frozen=True, eq=False)
class _Judgement:
    """A posterior, the notes beside it, and the verdict on both."""

    answer: Posterior
    gates: tuple[Gate, ...]
    verdict: Verdict

    @classmethod
    def of(cls, search: Search, answer: Posterior, gates: Sequence[Gate]) -> _Judgement:
        """Judge a posterior, with the steady tones that its laws leave among the notes."""
        noted = add_tones(search, answer, gates)
        return cls(answer, noted, judge(search, answer, noted))

    @property
    def kind(self) -> str:
        """Kind of the verdict."""
        return self.verdict.kind


def add_tones(search: Search, answer: Posterior, gates: Sequence[Gate]) -> tuple[Gate, ...]:
    """Add the steady tones in the residual of the named laws, or of the refit if nothing is named."""
    fitted = answer.best.fitted if answer.effects else search.root.fitted
    return (*gates, *find_tones(search.bench, fitted))


def _conclude_without_a_law(search: Search, judged: _Judgement) -> Conclusion | None:
    """Conclude that a parameter has a wrong pinned value, or an input was clipped, if that explains as much as laws."""
    answer, gates = judged.answer, judged.gates
    held = find_pinned_parameters(search, answer)
    if held is not None:
        corrected = uncompared_correction(search, held.fitted)
        freed = in_words(held.names)
        return Conclusion(Verdict("complete", held.sentence), gates, held.fitted, corrected, freed=freed)
    named = judged.kind == "missing-physics"
    if named and answer.sure >= SURE:
        return None
    refitted = search.root.fitted
    left = (answer.best if named else search.best).mean_square / search.root.mean_square
    clipping = find_clipped_input(search.bench, refitted, left)
    if clipping is None:
        return None
    fault = Verdict("recording-fault", clipping.sentence)
    return Conclusion(fault, (*gates, clipping), refitted, uncompared_correction(search, refitted))


def _weigh_names(
    search: Search, answer: Posterior, correction: Correction, gates: Sequence[Gate], finished: bool
) -> tuple[_Judgement, tuple[Gate, ...]]:
    """Weigh names against a learned force and, after a finished search, against laws where no port is declared.

    Also returns the note about such a law.
    """
    answer = answer.within({(port, law) for port, law, _ in correction.elements}, correction.shares["learned"])
    judged = _Judgement.of(search, answer, gates)
    if judged.kind != "missing-physics" or not finished or not may_act_elsewhere(search, answer.best):
        return judged, ()
    elsewhere, odds = find_undeclared_port(search, answer.best)
    return _Judgement.of(search, answer.against(odds), gates), elsewhere


def _conclude_named(
    search: Search, judged: _Judgement, elsewhere: Sequence[Gate], correction: Correction, fitted: Fitted
) -> Conclusion:
    """State the named effects, and the offsets beside them."""
    added, named = search.added_laws(fitted), {e.name for e in judged.answer.effects}
    more = correction.learned or any(e.law.listed and e.name not in named for e in added)
    sentence = f"{judged.verdict.sentence} {correction.sentence}" if more else judged.verdict.sentence
    notes = (*judged.gates, *elsewhere, *list_offsets(added, fitted.values))
    return Conclusion(Verdict(judged.kind, sentence), notes, fitted, correction, judged.answer.effects)


def _conclude_interrupted(search: Search, judged: _Judgement, came_to_an_answer: bool) -> Conclusion:
    """State what an interrupted search leaves: a correction without a name, or the refitted simulator."""
    correction, fitted = find_unnamed_correction(search)
    error = percent(search.bench.nrmse(search.root.fitted))
    off = f"Refitted, the simulator is off by {error} of the outputs' deviation."
    none = "The search was interrupted before it came to an answer."
    answer = judged.verdict.sentence if came_to_an_answer else none
    sentence = f"{answer} {correction.sentence if correction.elements else off}"
    return Conclusion(Verdict(judged.kind, sentence), judged.gates, fitted, correction)


def _conclude_unexplained(search: Search, judged: _Judgement, elsewhere: Sequence[Gate]) -> Conclusion:
    """State the law that is closest to an unexplained mismatch, or the law that explains it at an undeclared port."""
    correction, fitted = find_unnamed_correction(search)
    verdict = judge(search, judged.answer, judged.gates, correction.closest)
    where = [f"{g.value} in the equation of {g.channel} explains it" for g in elsewhere]
    answer = f"Physics is missing, but hardly at a declared port: {where[0]}." if where else verdict.sentence
    return Conclusion(Verdict(verdict.kind, f"{answer} {correction.sentence}"), judged.gates, fitted, correction)


# naming in predictions


def _advise_predictions(request: Request, search: Search, found: Conclusion, begun: bool = False) -> Conclusion:
    """Note that predictions were not tried, or not to the end, for lack of time, although the simulator drifts."""
    if search.interrupted or request.simulator.observer is not None or not drifts(search.bench, search.root.fitted):
        return found
    return replace(found, gates=(*found.gates, unfinished_note(request.simulator, begun)))


def _name_in_predictions(request: Request, search: Search, found: Conclusion) -> Conclusion:
    """Search with one-step predictions if the simulator drifts: errors of its free runs hardly distinguish laws.

    The laws that are named there are refitted in free run. They are kept if their strengths are significant there and
    they predict held-out data better than the refit, and as well as the correction that was found without a name.
    """
    if request.simulator.observer is not None or not drifts(search.bench, search.root.fitted):
        return found
    say, hold = request.say.under("predictions: "), search.bench.hold
    try:
        predicted = replace(request, hold=hold, focus="prediction", say=say)
        observed, found_there, memory = search_in_predictions(predicted, hold, search_with_one_hold)
        predicting = found_there.search
    except InputError:
        return found
    search.cut_short_with(predicting)
    if predicting.interrupted:
        return found
    named, answer = _draw_conclusion(predicting, ()), posterior(predicting)
    best = answer.best
    if named.verdict.kind != "missing-physics" or {e.name for e in named.effects} != best.names:
        return _advise_predictions(request, search, found, begun=True) if predicting.cut_short else found
    with search.stage("fit in free run"):
        search.keep(search.run_laws(best.laws, best))
        trial = search.thorough(search.memo[best.key])
        before, after = search.held_out(search.root), search.held_out(trial)
    answer = replace(answer, effects=named.effects).acting(search, trial)
    verdict = judge(predicting, answer, ())
    known = np.isfinite(before.mean_square) or not search.past_deadline
    better = known and after.mean_square < before.mean_square
    if verdict.kind != "missing-physics" or not better or after.rms > EQUAL_RATIO * found.correction.after:
        return found
    correction = replace(uncompared_correction(search, trial.fitted), before=before.rms, after=after.rms, closest=trial)
    note = drift_note(request.simulator, memory, in_words([display_name(law) for _, law in sorted(trial.names)]))
    return replace(
        found,
        verdict=verdict,
        gates=(*found.gates, *(g for g in observed.notes if g.finding == "disturbance"), note),
        fitted=trial.fitted,
        correction=correction,
        effects=answer.effects,
        decided=predicting,
    )
