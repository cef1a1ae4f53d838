"""Turn a conclusion into a Diagnosis: compute the values, errors and tables that it states."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._base import InputError, in_words, percent
from ..data import Recording
from ..identify import surrogate_warning
from ..laws import Law, display_name, readable_unit, short_name
from ..simulators import Placed, in_series, name_at, split_port
from .arguments import Request
from .blind_spots import BlindSpot, assess_recordings
from .correction import Correction
from .detectability import port_units
from .effect import Effect, sign_doubt
from .experiment import next_experiment
from .faults.channels import IN_RECORDINGS, find_gross_channel_errors
from .faults.gates import EQUAL_RATIO, TEST_FAULT, TEST_OFFSET, Gate, edited
from .faults.offsets import Offset, describe_offsets, find_placed_offsets, remove_offsets, update_offsets
from .fits.evidence import BETTER_RATIO, FAR_RATIO, INDISTINGUISHABLE_NATS, NEAR_RATIO, all_sure, standard_errors
from .fits.floor import Floor
from .fits.force_recovery import is_curve_along
from .fits.workbench import Fitted, Workbench
from .mismatch_map import mismatch
from .posterior import LikelyEffect, hypotheses_named
from .preparation import Prepared
from .proof import Comparison, free_run_errors, parameter_table, placebo, range_note, test_errors
from .result import Diagnosis
from .result_text import Basis
from .search.moves import Search
from .search.trials import Trial
from .verdict import Verdict


@dataclass(frozen=True, eq=False)
class Conclusion:
    """Answer of a search."""

    verdict: Verdict
    gates: tuple[Gate, ...]
    fitted: Fitted  # the corrected simulator, or the refitted one if there is nothing to correct
    correction: Correction  # the elements that `fitted` has beside the refitted simulator
    effects: tuple[LikelyEffect, ...] = ()
    freed: str = ""  # the pinned parameters whose other values explain as much as the named laws, joined by "and"
    decided: Search | None = None  # the search that has named the effects, if it is another one


@dataclass(frozen=True, eq=False)
class FinalFits:
    """The fits whose values and errors an answer states."""

    bench: Workbench  # all training recordings as corrected
    without: Fitted  # the refitted simulator, fitted to them
    after: Fitted  # the corrected simulator, fitted to them
    nominal: float  # NRMSE at the user's values
    drawn: tuple[Fitted, Fitted]  # both along the recordings of the search's bench
    # fits a simulator of the search to the recordings of `bench`
    to_all: Callable[[Fitted], Fitted] = lambda fitted: fitted


def build_diagnosis(
    request: Request,
    ready: Prepared,
    search: Search,
    found: Conclusion,
    final: FinalFits,
) -> Diagnosis:
    """Put the search's conclusion and its proof into a Diagnosis."""
    proving = time.perf_counter()
    request.say("proof", 0, 1)
    bench, without, after = final.bench, final.without, final.after
    std = standard_errors(bench, after)
    errors, fewer, compared, test_notes = _compute_errors(request, search, found, final)
    decided = found.decided or search
    forms = {e: _other_forms(decided, found.effects, e) for e in found.effects}
    effects = tuple(_make_effect(search, e, final, std, forms[e], fewer.get(e, np.nan)) for e in found.effects)
    floor = search.least_floor if found.verdict.kind == "unexplained" else search.floor
    simulated = [e + r.y for e, r in zip(without.residual, bench.recordings, strict=True)]
    experiment = _design_experiment(decided, found.effects, request.limits)
    blind_spots = _blind_spots(request, ready, search)
    request.say("proof", 1, 1)
    now = time.perf_counter()
    return Diagnosis(
        verdict=found.verdict.kind,
        sentence=found.verdict.sentence,
        effects=effects,
        candidates=tuple(_candidate_row(decided, t, m.parent) for m in decided.moves_by_parent for t in m.trials),
        gates=(
            *_surrogate_note(request.surrogate_nrmse),
            *_failure_notes(request.simulator.program_failures),
            *_convergence_note(after),
            *test_notes,
            *_combination_note(after, std, blind_spots),
            *update_offsets(found.gates, after, std, bool(effects), _is_sure(found)),
        ),
        mismatch=mismatch(bench.recordings, without.residual, simulated, floor.deviation, bench.scale),
        parameters=parameter_table(request.simulator, without, after, std),
        errors=errors,
        floor=_describe_noise(floor, search.least_floor, bench, compared),
        corrected=replace(
            remove_offsets(after.corrected(), len(request.simulator.elements), idle=True),
            substeps=after.model.substeps,
        ),
        refitted=replace(without.corrected(), substeps=without.model.substeps),
        hold=bench.hold,
        train=bench.recordings,
        test=request.tests,
        next_experiment=experiment,
        seconds=now - request.began,
        times={**search.times, "proof": now - proving},
        interrupted=search.interrupted,
        out_of_time=search.out_of_time,
        evidence=Basis(search, floor.deviation, without=final.drawn[0], after=final.drawn[1]),
        substeps=after.model.substeps,
        freed=found.freed,
        correction=found.correction,
        blind_spots=blind_spots,
        calls={n: count - request.calls[n] for n, count in request.simulator.program_calls.items()},
    )


def _is_sure(found: Conclusion) -> bool:
    """Tell whether every named effect is sure, or there is none because nothing is missing."""
    return all_sure(e.confidence for e in found.effects) or found.verdict.kind in ("complete", "recording-fault")


def _describe_noise(floor: Floor, white: Floor, bench: Workbench, compared: Comparison | None) -> dict[str, Any]:
    """Describe the noise relative to the training recordings, and to the test recordings if there are any."""
    floors = {"nrmse": floor, "white": white}
    return {
        **{name: f.nrmse(bench.scale) for name, f in floors.items()},
        "source": floor.source,
        "test": compared and {name: compared.noise(f.deviation, bench.scale) for name, f in floors.items()},
    }


def _compute_errors(
    request: Request, search: Search, found: Conclusion, final: FinalFits
) -> tuple[dict[str, dict[str, float] | None], dict[LikelyEffect, float], Comparison | None, tuple[Gate, ...]]:
    """Compute the table of errors (see `Diagnosis`), the test errors without each of several effects, and notes.

    Also returns the comparison on the test recordings, if there are any.
    """
    bench, without, after, fewer = final.bench, final.without, final.after, dict[LikelyEffect, float]()
    tests = request.tests
    notes, compared = tuple[Gate, ...](), None
    errors: dict[str, dict[str, float] | None] = {
        "train": {"nominal": final.nominal, "before": bench.nrmse(without), "after": bench.nrmse(after)},
        "test": None,
    }
    if tests:
        each = {e: final.to_all(f) for e, f in _without_each_effect(search, found).items()}
        fits = {"before": without, "after": after, **{f"without {i}": f for i, f in enumerate(each.values())}}
        offsets, at_zero = _at_zero_offsets(bench, after, len(request.simulator.elements))
        fits |= {"at zero offsets": at_zero} if offsets else {}
        compared = test_errors(bench, tests, found.gates, fits, bench.on(tests).model(request.simulator))
        on_tests = compared.errors
        notes = (*_edit_notes(compared), *_resting_notes(compared.find_resting()), *_scored_note(compared))
        if not list(_edit_notes(compared)) and on_tests["after"] > FAR_RATIO * bench.nrmse(after):
            notes = (*_test_faults(bench, after, tests, found.gates), *notes)
        if on_tests["after"] > NEAR_RATIO * bench.nrmse(after) and all(g.finding != TEST_FAULT for g in notes):
            notes = (*notes, *range_note(bench, edited(tests, found.gates)))
        notes = (*notes, *_offset_note(offsets, on_tests)) if offsets else notes
        fewer = {e: on_tests[f"without {i}"] for i, e in enumerate(each)}
        errors["test"] = {name: on_tests[name] for name in ("nominal", "before", "after")}
    if bench.simulator.observer is not None:
        free = edited(tests, found.gates) or bench.recordings
        errors["free_run"] = free_run_errors(bench, free, request.simulator, without, after)
    return errors, fewer, compared, notes


def _test_faults(bench: Workbench, after: Fitted, tests: Sequence[Recording], gates: Sequence[Gate]) -> Iterator[Gate]:
    """Note a wrong sign, a wrong unit or an exchange in a test recording, which the corrected simulator shows.

    With the channel corrected it has to follow about as well as it does the training recordings. Otherwise physics that
    only the test shows may as well be the reason.
    """
    for i, (r, now) in enumerate(zip(tests, edited(tests, gates), strict=True), 1):
        if not np.ptp(now.y, axis=0).all():
            continue
        faults = find_gross_channel_errors(replace(bench.renewed([now]), simulator=after.corrected()))
        if not faults or faults[0].left ** 0.5 > FAR_RATIO * bench.nrmse(after):
            continue
        name = f"recording {r.name or i}" if len(tests) > 1 else "recording"
        place = f"In the test {name}, unlike the training recordings, "
        equal = [g for g in faults if g.left <= EQUAL_RATIO * faults[0].left]
        words = ", or ".join(g.sentence.removeprefix(IN_RECORDINGS) for g in equal)
        advice = "It does not tell which: check both." if len(equal) > 1 else "Correct that."
        yield Gate(faults[0].channel, TEST_FAULT, faults[0].value, f"{place}{words}. {advice}", False)


def _at_zero_offsets(bench: Workbench, after: Fitted, own: int) -> tuple[str, Fitted]:
    """Run a fit with its offsets after the first `own` elements at zero; also name the offsets, "" if there is none."""
    added = find_placed_offsets(after.simulator.elements[own:])
    found = {name: e for name, e in added.items() if np.any(after.values[name])}
    zero = {name: np.zeros_like(after.values[name]) for name in found}
    return describe_offsets(found.values()), bench.rerun(after, {**after.values, **zero}) if found else after


def _offset_note(offsets: str, errors: Mapping[str, float]) -> Iterator[Gate]:
    """Note that the test recordings hardly have the offsets of the training recordings; `errors` are those on them."""
    zero, after = errors["at zero offsets"], errors["after"]
    if BETTER_RATIO * zero < after:
        words = (
            f"The test recordings hardly have {offsets}: at zero offset, the error of the corrected simulator there is "
            f"{percent(zero)} in place of {percent(after)}. Something may differ between the recordings."
        )
        yield Gate("recordings", TEST_OFFSET, None, words, False)


def _surrogate_note(error: float) -> Iterator[Gate]:
    """Note that a surrogate replaces the simulation, with an NRMSE of `error`; no note if the error is zero."""
    if error:
        words = (
            f"A linear model stands for the simulation, which it follows to NRMSE {error:.4f}; that counts as noise."
        )
        yield Gate("simulation", "surrogate", error, f"{words} {surrogate_warning(error)}".rstrip(), False)


def _failure_notes(failures: Mapping[str, str]) -> Iterator[Gate]:
    """Note the functions of the simulator that failed: a fit avoids what they cannot compute."""
    for name, error in failures.items():
        words = (
            f"{name} failed at some points, first with {error}. A simulation that comes there counts as diverging, so "
            "the fit keeps away from there; let it return a number for all values."
        )
        yield Gate("simulation", "failure", name, words, False)


def _convergence_note(after: Fitted) -> Iterator[Gate]:
    """Note that the fit whose values are stated has not converged; no note if it has."""
    if not after.status.converged:
        words = (
            f"The fit of the corrected simulator ended early. {after.status.value} Its parameters may still change by "
            "more than their standard errors; bound known ones, or add a recording that distinguishes them."
        )
        yield Gate("simulation", "convergence", after.status.name.lower(), words, False)


def _resting_notes(resting: Sequence[tuple[str, int]]) -> Iterator[Gate]:
    """Note test recordings whose scored part hardly moves, so that their relative errors are large."""
    for name, first in resting:
        words = (
            f"In {name or 'the test recording'} an output moves less than half as much after {first} samples. These "
            "serve to estimate its initial state and are not scored, so that relative errors on the rest are "
            "large. Give its initial state, or a longer test recording."
        )
        yield Gate("simulation", "resting test", first, words, False)


def _scored_note(compared: Comparison) -> Iterator[Gate]:
    """Note which test samples are not scored: all models are compared on the same samples, also the one as given."""
    count = max(first - r.skip for r, first in compared.scored)
    if count > 0:
        words = (
            f"Up to {count} samples of a test recording are not scored, because the initial state is estimated from "
            "them. The slowest of the compared simulators sets this number, so another correction changes the test "
            "errors as given and refitted a little, too."
        )
        yield Gate("simulation", "scored samples", count, words, False)


def _edit_notes(compared: Comparison) -> Iterator[Gate]:
    """Note that the test recordings hardly have the faults for which they were corrected as the training data were."""
    given, corrected = compared.unedited, compared.errors["after"]
    if given * NEAR_RATIO < corrected:
        words = (
            "The test recordings were corrected as the training recordings were, and that does not suit them: the "
            f"error there is {100 * corrected:.3g} %, and {100 * given:.3g} % if they are left as given. Check whether "
            "they have the same faults."
        )
        yield Gate("recordings", "test correction", None, words, False)


def _combination_note(after: Fitted, std: Mapping[str, np.ndarray], blind_spots: Sequence[BlindSpot]) -> Iterator[Gate]:
    """Note the numbers that the recordings determine only in combination, so that they have no standard error.

    Numbers without any effect on the outputs are blind spots and not in this note.
    """
    own = after.model.parameters
    dead = {name for spot in blind_spots if spot.kind == "dead" for name in spot.names}
    tied = [
        name
        for name, p in own.items()
        if name not in dead
        and not p.value.ndim
        and not np.all(p.fixed)
        and not np.isfinite(std[name])
        and not after.is_at_bound(name)
    ]
    if len(tied) < 2:
        return
    of_laws = {
        e.prefix + own: f"{own} of the {name_at(e.port, e.law.id, e.law.form, brief=True)}"
        for e in after.simulator.elements
        for own in e.law.parameters()
    }
    together = in_words([of_laws.get(name, name) for name in tied])
    words = f"These recordings determine {together} only in combination, so they have no standard errors."
    yield Gate("simulation", "combination", ", ".join(tied), words, False)


def _blind_spots(request: Request, ready: Prepared, search: Search) -> tuple[BlindSpot, ...]:
    """Find the blind spots of the recordings for the refitted simulator; empty if they cannot be computed."""
    stated = search.bench.hold if request.stated_hold else ""
    with suppress(InputError, np.linalg.LinAlgError):
        return assess_recordings(search.bench, search.root.fitted, ready.floor, stated).blind_spots
    return ()


def _without_each_effect(search: Search, found: Conclusion) -> dict[LikelyEffect, Fitted]:
    """Fit the corrected simulator without each of several named effects; empty beside a learned force."""
    if len(found.effects) < 2 or found.correction.learned or search.interrupted:
        return {}
    joint, out = Trial.of(found.fitted, len(found.correction.elements)), dict[LikelyEffect, Fitted]()
    for effect in found.effects:
        rest = search.leave_out(joint, [e for e in joint.laws if e.name == effect.name])
        if rest is not None:
            out[effect] = rest.fitted
    return out


def _make_effect(
    search: Search,
    named: LikelyEffect,
    final: FinalFits,
    std: dict[str, np.ndarray],
    other_forms: Sequence[Law],
    test_without: float,
) -> Effect:
    """Make the effect that an answer states, at the values of the final fit, with its placebo and its remarks."""
    bench, fitted = search.bench, final.after
    element = next(e for e in fitted.simulator.elements if e.name == named.name)  # its form may differ
    law = element.law
    own, unrelated = placebo(bench, search.root.fitted, element.port, law)
    port = bench.simulator.port(element.port)
    doubt = sign_doubt(fitted.simulator, element, fitted.values)
    remarks = [law.remark(element.own(fitted.values)), doubt, *_describe_order(fitted, element)]
    if law.turns and is_curve_along(bench, final.drawn[1], fitted.simulator.elements.index(element)):
        remarks.append("these recordings do not show its memory: a curve follows them as well")
    if other_forms:
        others = in_words([display_name(other.id, other.form) for other in other_forms])
        forms = "other forms of this law, are" if other_forms[1:] else "another form of this law, is"
        remarks.append(f"{others}, {forms} about as likely")
    return Effect(
        port=element.port,
        law=law.id,
        confidence=named.confidence,
        sentence="; ".join(filter(None, [law.sentences.get(port.domain, law.sentence), *remarks])),
        equation=law.equation.replace("dz/dt", "v") if port.is_speed else law.equation,
        parameters=_effect_parameters(bench, fitted, element, std),
        indistinguishable=tuple(named.alike),
        form=law.form,
        placebo={"own": own, "unrelated": unrelated},
        test_without=test_without,
        at_port=named.at_port,
    )


def _effect_parameters(
    bench: Workbench, fitted: Fitted, element: Placed, std: Mapping[str, np.ndarray]
) -> dict[str, dict[str, Any]]:
    """Return the numbers of a law, each with its standard error and unit, and whether it is at a limit."""
    port, recorded = bench.simulator.port(element.port), bench.recordings[0]
    w_unit, z_unit = port_units(port, recorded)
    if port.series and not w_unit:  # in the unit of its signal, such as [force]
        w_unit = z_unit = f"[{split_port(port.name)[1]}]"
    signals = bench.simulator.signal_units(port.name, recorded.units)
    out: dict[str, dict[str, Any]] = {}
    for own, value in element.own(fitted.values).items():
        name, unit = f"{element.prefix}{own}", readable_unit(element.law.units[own], w_unit, z_unit, signals)
        limited = np.ravel(fitted.is_at_bound(name) & ~fitted.model.parameters[name].fixed)
        for i, (v, error) in enumerate(zip(np.ravel(value).tolist(), np.ravel(std[name]).tolist(), strict=True)):
            out[own + (f"[{i}]" if np.size(value) > 1 else "")] = {
                "value": v,
                "std": error if np.isfinite(error) else None,
                "unit": unit,
                "at_limit": bool(v and limited[i]),
            }
    return out


def _other_forms(search: Search, effects: Sequence[LikelyEffect], effect: LikelyEffect) -> list[Law]:
    """List the laws of no more parameters that make another form of an effect about as likely, the likeliest first."""
    stated, law = {e.name for e in effects}, effect.element.law
    alike = hypotheses_named(search, stated)
    own = [t for t in alike if any(type(e.law) is type(law) for e in t.effects)]
    least = max(map(search.evidence, own), default=np.inf) - INDISTINGUISHABLE_NATS
    found = dict[str, Law]()
    for t in sorted((t for t in alike if search.evidence(t) > least), key=search.evidence, reverse=True):
        for e in t.effects:
            if e.name == effect.name and len(e.law.units) <= len(law.units):
                found.setdefault(e.law.form, e.law)
    return [other for form, other in found.items() if form != law.form]


def _describe_order(fitted: Fitted, element: Placed) -> Iterator[str]:
    """Tell which laws of the same signal come before a law."""
    for e in fitted.simulator.elements:
        if e is element:
            return
        if e.port == element.port and in_series(e.port) and not isinstance(e.law, Offset):
            yield f"it acts on the signal after the {short_name(e.law.id, e.law.form)}"


def _design_experiment(
    search: Search, effects: Sequence[LikelyEffect], limits: Mapping[str, float] | None
) -> dict[str, Any] | None:
    """Design the experiment that would separate the first tie, if there is one."""
    if search.bench.simulator.observer is not None:  # a proposed input has no outputs to correct states by
        return None
    for effect in effects:
        if effect.alike:
            name, other = next(iter(effect.alike.items()))
            stated = hypotheses_named(search, {e.name for e in effects})
            having = stated or [t for t in search.memo.values() if effect.name in t.names]
            one = max(having, key=search.evidence)
            rivals = in_words([name_at(*pair, brief=True) for pair in (effect.name, name)])
            best = next_experiment(search.bench, (one.fitted, other.fitted), search.floor.deviation, limits, rivals)
            tied = [list(effect.name), list(name)]
            if best is not None:
                return {"between": tied, **best}
            sentence = (
                f"No sine or triangle within the allowed amplitude tells {rivals} apart beyond the noise and better "
                "than these recordings do."
            )
            return {"between": tied, "sentence": sentence}
    return None


def _candidate_row(search: Search, t: Trial, parent: Trial) -> dict[str, Any]:
    """Return a candidate's row for diagnosis.json, with the law that it adds to its parent."""
    added = next((e for e in t.laws if e.pair not in parent.key), t.element)
    held_out = search.findings[t.key].held_out
    gain = search.evidence(t) - search.evidence(parent)
    return {
        "port": added.port,
        "law": added.law.id,
        "form": added.law.form,
        "nrmse_train": search.bench.nrmse(t.fitted) if np.isfinite(t.mean_square) else np.inf,
        "nrmse_validation": held_out.rms if held_out and np.isfinite(held_out.rms) else None,
        "delta_bic": -2 * gain,
    }
