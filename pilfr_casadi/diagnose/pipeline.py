"""The steps of a diagnosis in their order.

How an answer comes about:

1. `prepare` corrects faults of the recordings, refits the simulator, and measures the noise. The refitted simulator is
   the hypothesis that nothing is missing. What it leaves above the noise is the mismatch.
2. `Search.run` fits further hypotheses: the simulator with laws in its ports, with all parameters estimated together.
   Each gets a log evidence: how well it follows the recordings, less the cost of its parameters, plus its prior
   (`evidence`, which lists the numbers on which an answer rests).
3. `posterior` turns the evidences into probabilities. An effect's confidence is the probability of all hypotheses that
   have it, times the probability that its law is the physics (`share_named`): a rest that a flexible force could
   explain lowers it, as do values at a bound or at which the law degenerates. Of forms of a law that follow alike, the
   plainest is stated.
4. `judge` chooses the verdict. It is a recording fault if its correction removed the mismatch; missing physics if the
   law of the likeliest hypothesis is more likely than not the physics; complete if the refit's residual can be noise;
   else unexplained.
5. If there is time, explanations without a law are tried: a parameter pinned to a wrong value, and a clipped input.
   They count if they explain as much as the law.
6. `find_correction` compares named laws with a learned force on held-out parts of the recordings. If the named law
   predicts worse than the force, the name is withdrawn and the verdict is chosen again. A learned force that stays
   beside the laws lowers their confidence (`Posterior.within`).
7. The proof (`proof`) adds errors on test recordings, placebos and standard errors. It changes no verdict. Offsets that
   no longer improve the fit beside the effects are set to zero.

**Long recordings.** Steps 1 to 6 see only their most informative stretches (`stretches`). The leading hypotheses are
then fitted to everything before step 3, and the answer's simulator before step 7.

**Repetitions.** Steps 1 and 2 are repeated where something that they took for granted proves wrong (`repetitions`). If
nothing has a name after step 6 and the simulator drifts, the search is repeated in predictions, and the laws that are
found there are refitted in free run (`_name_in_predictions`).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from .._base import (
    InputError,
    Progress,
    Stages,
    deferred_interrupt,
    one_blas_thread,
    percent,
    positive,
    processors,
    whole,
)
from ..data import Recording, as_recordings
from ..laws import Law, VaryingParameter, display_name
from .answer import Conclusion, FinalFits, build_diagnosis
from .arguments import (
    FEWEST_SAMPLES,
    Request,
    add_scaled_laws,
    check_laws,
    check_limits,
    check_time_and_focus,
    match_recordings,
    match_tests,
    stated_hold,
)
from .correction import find_correction, named_correction
from .faults.gates import EQUAL_RATIO, Gate
from .faults.offsets import fix_idle_offsets, list_offsets
from .faults.samples import find_clipped_input, open_unsettled, remove_glitches
from .faults.tones import find_tones
from .fits.evidence import SURE
from .fits.workbench import converge
from .other_explanations import (
    find_pinned_parameters,
    find_undeclared_port,
    find_untried_laws,
    find_varying_values,
    may_act_elsewhere,
)
from .posterior import Posterior, names, posterior
from .prediction import drift_note, drifts, predictor
from .preparation import Prepared, conversions, slow_note
from .proof import errors_of
from .repetitions import run_search, search_with_focus
from .result import Diagnosis
from .search.moves import Search
from .search.stretches import SEARCHED_SAMPLES, Everything, Stretches, back_on_stretches, choose_stretches
from .verdict import Verdict, judge


@one_blas_thread
def diagnose_in_steps(
    simulator: Any,
    train: Recording | Sequence[Recording],
    *,
    test: Recording | Sequence[Recording] | None,
    hold: str | None,
    laws: Sequence[type[Law] | str] | None,
    effects: int | None,
    limits: Mapping[str, float] | None,
    workers: int | None,
    engine: str,
    stand_in_error: float,
    time_limit: float | None,
    focus: str | None,
    search_samples: int | None,
    progress: Progress | None,
) -> Diagnosis:
    """Carry out `diagnose`, whose parameters these are, by the steps of the module docstring."""
    began = time.perf_counter()
    workers = min(processors(), 4) if workers is None else whole(workers, "workers", 1)
    most_effects = np.inf if effects is None else whole(effects, "effects", 0)
    check_time_and_focus(time_limit, focus)
    positive(stand_in_error, "stand_in_error", "the NRMSE of a model that replaces the simulator", zero=True)
    say = Stages(progress or (lambda stage, done, total, best: None))
    given = as_recordings(train)
    simulator, recordings = match_recordings(simulator, given, hold)
    tests = match_tests(simulator, test, recordings)
    check_limits(simulator, limits)
    tried = (*add_scaled_laws(check_laws(laws), simulator), *((VaryingParameter,) if laws is None else ()))
    deadline = np.inf if time_limit is None else began + float(time_limit)
    calls, slow = simulator.program_calls, slow_note(simulator, recordings)
    say = say.under(f"{slow[0].value:.2g} s a simulation: ") if slow else say
    request = Request(
        simulator,
        recordings,
        tried,
        hold,
        engine,
        workers,
        most_effects,
        stand_in_error,
        deadline,
        say,
        focus,
        notes=(*conversions(simulator, given), *slow),
        calls=calls,
    )
    most = SEARCHED_SAMPLES if search_samples is None else whole(search_samples, "search_samples", FEWEST_SAMPLES)
    request, ready, search = search_with_focus(_on_stretches(request, most))
    request, everything = _fit_to_everything(request, ready, search)
    found = _concluded(search, (*request.notes, *ready.gates))
    if found.verdict.kind == "unexplained" and request.focus is None and not search.cut_short:
        with search.until_interrupted():
            found = _name_in_predictions(request, search, found)
    final = _final_fits(request, ready, search, found, everything)
    with deferred_interrupt(again=False) as pressed:
        built = build_diagnosis(request, ready, search, found, final, tests, limits, began)
    search.bench = replace(search.bench, deadline=np.inf)  # fits that a user asks for later, as by `refine`, have time
    return replace(built, interrupted=built.interrupted or bool(pressed))


def _on_stretches(request: Request, most: int) -> Request:
    """Restrict a request to the most informative stretches if the recordings have more than `most` samples."""
    if sum(map(len, request.recordings)) <= most:
        return request
    request.say("choice of stretches", 0, 1)
    recordings, spikes = remove_glitches(request.recordings)
    recordings, transients = open_unsettled(recordings)
    hold = stated_hold(request.simulator, recordings, request.hold) or "zero"
    chosen = choose_stretches(request.simulator, recordings, hold, request.engine, most, request.workers)
    stretches = Stretches(recordings, chosen)
    request.say("choice of stretches", 1, 1)
    notes = (*request.notes, *spikes, *transients)
    return replace(request, recordings=stretches.cut(), stretches=stretches, notes=notes)


def _fit_to_everything(request: Request, ready: Prepared, search: Search) -> tuple[Request, Everything | None]:
    """Fit the leading hypotheses to all recordings if the search ran on stretches of them, and note that."""
    if request.stretches is None:
        return request, None
    with search.stage("fits to all recordings"):
        everything = Everything.of(search, request.stretches, ready.gates)
    note = request.stretches.note(everything is not None)
    return replace(request, notes=(note, *request.notes)), everything


def _concluded(search: Search, gates: Sequence[Gate]) -> Conclusion:
    """Draw the conclusion; after an interrupt, draw it without further fits."""
    with search.until_interrupted(), search.stage("conclusion"):
        found = conclude(search, gates)
        search.out_of_time = search.out_of_time or time.perf_counter() > search.bench.deadline
        return found
    return conclude(search, gates)


def conclude(search: Search, gates: Sequence[Gate]) -> Conclusion:
    """Draw the conclusion from a search: steps 3 to 6 of the module docstring.

    A name that may stand for a law where no port is declared is weighed against that. If there is no name, undeclared
    ports and varying values are checked, unless the time is over. After Ctrl-C nothing more is fitted: a name that was
    found stays; otherwise the refitted simulator is returned.
    """
    answer, interrupted = posterior(search), search.interrupted
    finished, elsewhere = not search.cut_short, tuple[Gate, ...]()
    given, gates = gates, with_tones(search, answer, gates)
    verdict = judge(search, answer, gates)
    if verdict.kind in ("missing-physics", "unexplained") and not search.past_deadline:
        found = _without_a_law(search, answer, verdict, gates)
        if found is not None:
            return found
    if verdict.kind == "missing-physics":
        correction, fitted = find_correction(search, answer, named=True)
        answer = answer.within({(port, law) for port, law, _ in correction.elements}, correction.shares["learned"])
        gates = with_tones(search, answer, given)
        verdict = judge(search, answer, gates)
        if verdict.kind == "missing-physics" and finished and may_act_elsewhere(search, answer.best):
            elsewhere, odds = find_undeclared_port(search, answer.best)
            answer = answer.against(odds)
            verdict = judge(search, answer, gates)
        if verdict.kind == "missing-physics":
            said = f"{verdict.sentence} {correction.sentence}" if correction.learned else verdict.sentence
            zeros = list_offsets(search.added_laws(fitted), fitted.values)
            notes = (*gates, *elsewhere, *zeros)
            return Conclusion(Verdict(verdict.kind, said), notes, fitted, correction, answer.effects)
    if verdict.kind == "unexplained" and finished:
        elsewhere = elsewhere or find_undeclared_port(search)[0]
        gates = (*gates, *elsewhere, *find_untried_laws(search), *find_varying_values(search))
    refitted = search.root.fitted
    if search.interrupted and verdict.kind != "recording-fault":
        correction, fitted = find_correction(search, answer)
        off = f"Refitted, the simulator is off by {percent(search.bench.nrmse(refitted))} of the outputs' deviation."
        said = correction.sentence if correction.elements else off
        before = "The search was interrupted before it came to an answer." if interrupted else verdict.sentence
        sentence = f"{before} {said}"
        return Conclusion(Verdict(verdict.kind, sentence), gates, fitted, correction)
    if verdict.kind == "unexplained":
        correction, fitted = find_correction(search, answer)
        verdict = judge(search, answer, gates, correction.closest)
        where = [f"{g.value} in the equation of {g.channel} explains it" for g in elsewhere]
        said = f"Physics is missing, but hardly at a declared port: {where[0]}." if where else verdict.sentence
        verdict = Verdict(verdict.kind, f"{said} {correction.sentence}")
        return Conclusion(verdict, gates, fitted, correction)
    return Conclusion(verdict, gates, refitted, named_correction(search, refitted))


def with_tones(search: Search, answer: Posterior, gates: Sequence[Gate]) -> tuple[Gate, ...]:
    """Add the steady tones that the named laws leave, or the refit if nothing has a name."""
    fitted = answer.best.fitted if answer.effects else search.root.fitted
    return (*gates, *find_tones(search.bench, fitted))


def _without_a_law(search: Search, answer: Posterior, verdict: Verdict, gates: Sequence[Gate]) -> Conclusion | None:
    """Conclude that a parameter has a wrong pinned value, or an input was clipped, if that explains as much as laws."""
    held = find_pinned_parameters(search, answer)
    if held is not None:
        corrected = named_correction(search, held.fitted)
        return Conclusion(
            Verdict("complete", held.sentence), tuple(gates), held.fitted, corrected, (), " and ".join(held.names)
        )
    named = verdict.kind == "missing-physics"
    if named and answer.sure >= SURE:
        return None
    refitted = search.root.fitted
    left = answer.best.mean_square / search.root.mean_square if named else 1.0
    clipping = find_clipped_input(search.bench, refitted, left)
    if clipping is None:
        return None
    fault = Verdict("recording-fault", clipping.sentence)
    return Conclusion(fault, (*gates, clipping), refitted, named_correction(search, refitted))


def _name_in_predictions(request: Request, search: Search, found: Conclusion) -> Conclusion:
    """Search once more in predictions if the simulator drifts, so that errors of free runs hardly tell laws apart.

    The laws that are named there are refitted in free run. There they have to act as surely, and to predict held-out
    data better than the refit, and as well as the correction that was found without a name.
    """
    if request.simulator.observer is not None or not drifts(search.bench, search.root.fitted):
        return found
    say, hold = request.say.under("predictions: "), search.bench.hold
    try:
        led, memory = predictor(request.simulator, request.recordings, hold, request.engine)
        leading = run_search(replace(request, simulator=led, hold=hold, focus="prediction", say=say))[1]
    except InputError:
        return found
    search.cut_short_with(leading)
    if leading.interrupted:
        return found
    named, answer = _concluded(leading, ()), posterior(leading)
    best = answer.best
    if named.verdict.kind != "missing-physics" or {e.name for e in named.effects} != names(best):
        return found
    with search.stage("fit in free run"):
        search.keep(search.run_laws(best.laws, best))
        trial = search.thorough(search.memo[best.key])
        before, after = search.held_out(search.root), search.held_out(trial)
    answer = replace(answer, effects=named.effects).acting(search, trial)
    verdict = judge(leading, answer, ())
    known = np.isfinite(before.error) or not search.past_deadline
    predicts = known and after.error < before.error and not after.rms > EQUAL_RATIO * found.correction.after
    if verdict.kind != "missing-physics" or not predicts:
        return found
    correction = replace(named_correction(search, trial.fitted), before=before.rms, after=after.rms, closest=trial)
    note = drift_note(request.simulator, memory, " and ".join(display_name(law) for _, law in sorted(names(trial))))
    return replace(
        found,
        verdict=verdict,
        gates=(*found.gates, note),
        fitted=trial.fitted,
        correction=correction,
        effects=answer.effects,
        decided=leading,
    )


def _final_fits(
    request: Request, ready: Prepared, search: Search, found: Conclusion, everything: Everything | None
) -> FinalFits:
    """Return the fits that the answer states: those of the search, or fits to everything if it ran on stretches."""
    bench, without, after = search.bench, search.root.fitted, found.fitted
    if found.effects and not np.isfinite(found.correction.after):  # a held-out comparison chose what it compared
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
