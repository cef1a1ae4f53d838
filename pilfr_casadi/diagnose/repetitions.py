"""Prepare and search, and repeat that where something that was taken for granted proves wrong.

There are six cases:

- If the simulator is unstable and runs away from the recordings, search with an observer (`prediction`).
- If nobody stated the hold of the inputs and the best hypothesis follows better with another one, search with that.
- If a channel seemed to be early, search without that correction, because missing physics can look like a lead.
- If a channel proves shifted only beside the first law, search with it at its right times.
- If a wrong zero was preferred to a wrong start, search from unknown initial states.
- If disturbances move the machine, predict with an observer that forgets sooner.

A seventh, in predictions, is `pipeline._name_in_predictions`. The functions are nested: `search_with_repetitions` calls
`_search_with_each_hold`, that calls `search_with_one_hold`, and that `_search_once`.

Each search fits different data. Its evidence is therefore not comparable; the smaller error decides.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from .._base import InputError
from ..simulators import Simulator
from .arguments import Request
from .faults.gates import LEAST_GAIN, USELESS_FIT, Checked, Gate, error_ratio, evidence_gain
from .faults.offsets import Offset, WrongStart
from .faults.timing import TimeShift
from .fits.evidence import AS_GIVEN_RATIO, SURE
from .fits.floor import Floor, measured_floor
from .fits.workbench import RunsAway
from .posterior import posterior
from .prediction import agreement_note, disturbance_note, forget_sooner, observer_keeps_up, prediction_note, predictor
from .preparation import CHECKS, Prepared, hold_note, prepare
from .search.moves import Search

# shares of the remaining time for the preparation, and for preparation and search; the rest is for the correction
PREPARATION_SHARE, SEARCH_SHARE = 0.35, 0.7


@dataclass(frozen=True, eq=False)
class Attempt:
    """A search, and the preparation from which it began."""

    ready: Prepared
    search: Search

    def compared_with(self, other: Attempt) -> tuple[float, float]:
        """Compute the mean square errors of the best hypotheses of two searches, with the noise of the first."""
        return self.search.best.mean_square, self.search.bench.pool(other.search.best.fitted.squares)


def search_with_repetitions(request: Request) -> tuple[Request, Attempt]:
    """Search; if nobody stated the focus and the simulator runs away, correct its states by an observer."""
    if request.focus != "prediction":
        try:
            return request, _search_with_each_hold(request)
        except RunsAway:  # by `Workbench`, in the first refit or as the check of it in `_search_once`
            if request.focus == "simulation" or not observer_keeps_up(request.simulator, request.recordings):
                raise
    # the gain depends little on the hold, which the search may still change
    observed_request, found, _ = search_in_predictions(request, request.stated_hold or "zero", _search_with_each_hold)
    return observed_request, found


def search_in_predictions(
    request: Request, hold: str, search: Callable[[Request], Attempt]
) -> tuple[Request, Attempt, float]:
    """Search with an observer, or with one that forgets sooner where disturbances move the machine.

    Also returns the memory of the observer, s.

    Raises
    ------
    InputError
        If the simulator diverges with every observer.
    """
    observed, memory = predictor(request.simulator, request.recordings, hold, request.engine)
    observed_request = _with_observer(request, observed, memory)
    first = search(replace(observed_request, most_effects=min(1, observed_request.most_effects)))
    found = observed_request, first, memory
    answer, compared = _search_forgetting_sooner(request, found, search), first.search.best.names
    if answer[1] is first and request.most_effects > 1 and not first.search.cut_short:
        first.search.resume(request.most_effects)
        if first.search.best.names != compared:
            answer = _search_forgetting_sooner(request, found, search)
    return answer


def _search_forgetting_sooner(
    request: Request, found: tuple[Request, Attempt, float], search: Callable[[Request], Attempt]
) -> tuple[Request, Attempt, float]:
    """Search with a shorter memory if the likeliest hypothesis predicts better with one; return what was found if not.

    So too if that search was cut short before it found as much. Effects that only the longer memory shows well enough
    to be sure stay if the likeliest hypothesis with the shorter one has them, too: then they do not only imitate it.
    """
    observed_request, first, memory = found
    sooner = forget_sooner(first.search, request.simulator, memory)
    if sooner is None:
        return found
    observed, shorter = sooner
    note = disturbance_note(request.simulator, shorter, memory)
    sooner_request = _with_observer(
        replace(request, say=request.say.under("shorter memory: ")), observed, shorter, note
    )
    other = _repeat(first, partial(search, sooner_request))
    if other is None:
        return found
    before2, after2 = first.compared_with(other)
    if other.search.cut_short and before2 <= after2:
        return found
    longer, sure = posterior(first.search), posterior(other.search).sure > SURE
    if longer.sure > SURE and not sure and longer.best.names <= other.search.best.names:
        note = agreement_note(request.simulator, shorter, memory)
        return replace(observed_request, notes=(*observed_request.notes, note)), first, memory
    return sooner_request, other, shorter


def _with_observer(request: Request, observed: Simulator, memory: float, *more: Gate) -> Request:
    """Return the request with an observed simulator, and with notes about it."""
    note = prediction_note(request.simulator, request.recordings, memory)
    return replace(request, simulator=observed, notes=(*request.notes, note, *more))


def _search_with_each_hold(request: Request) -> Attempt:
    """Search; if nobody stated the hold of the inputs and it matters, use the hold with the smallest error."""
    found = search_with_one_hold(request)
    search = found.search
    hold = "" if search.hold_settled else search.better_hold or _find_better_hold(search)
    return _search_with_better_hold(request, found, hold) if hold else found


def _search_with_better_hold(request: Request, first: Attempt, hold: str) -> Attempt:
    """Search with a hold that the best hypothesis prefers; keep the search with the smaller error, and note it."""
    search = first.search
    held = replace(request, hold=hold, say=request.say.under("other hold: "))
    other = _repeat(first, partial(search_with_one_hold, held))
    if other is None:
        if not search.hold_settled:
            search.resume()
        return first
    again = other.search
    only_refitted, before2, after2 = again.interrupted and len(again.memo) < 2, *first.compared_with(other)
    if after2 > before2 or only_refitted:
        if not search.hold_settled:  # else this search is finished
            search.resume()
        return first
    better = _find_better_hold(again)
    # the laws that were found since may have been what the hold had made up for
    if better == search.bench.hold:
        search.adopt(again.best)
        search.resume()
        before2, after2 = first.compared_with(other)
        if before2 < after2:
            return first
    note = hold_note(request.simulator, hold, error_ratio(before2, after2))
    other = replace(other, ready=replace(other.ready, gates=(*other.ready.gates, note)))
    further = better and better != search.bench.hold
    return _search_with_better_hold(request, other, better) if further else other


def _find_better_hold(search: Search) -> str:
    """Return a hold with which a search that nobody has interrupted would be better; empty without one."""
    found = ""
    with search.until_interrupted():
        found = search.find_better_hold()
    return found


def search_with_one_hold(request: Request) -> Attempt:
    """Prepare and search; if an early channel was corrected, repeat without, and keep that if it is clearly better.

    If a channel proves shifted beside a law, repeat with it at its right times. If a wrong zero was preferred to a
    wrong start, repeat with the start unknown.
    """
    first = _search_once(request, correct_early=True)
    if first.search.shift is not None:
        return _search_realigned(request, first, first.search.shift)
    start = next((g.otherwise for g in first.ready.gates if isinstance(g, WrongStart) and g.otherwise), None)
    if start is not None and not first.search.cut_short:
        request, first = _search_from_unknown_start(request, first, start)
    search = first.search
    leads = any(isinstance(g, TimeShift) and g.leads for g in first.ready.gates)
    if not leads or search.cut_short or not search.can_improve(search.best):
        return first
    other = _repeat(first, partial(_search_once, request, correct_early=False))
    if other is None:
        return first
    before2, after2 = first.compared_with(other)
    return other if after2 < AS_GIVEN_RATIO * before2 else first


def _search_realigned(request: Request, first: Attempt, shift: Gate) -> Attempt:
    """Search with a shifted channel at its right times, which ended a search; go on with that if it is clearly better.

    Missing physics can look like a lead.
    """
    # the shift is one of corrected channels
    edits = [g for g in first.ready.gates if g.corrected and g.change is not None]
    moved = replace(request.corrected((*edits, shift), first.ready.nominal, "shifted: "), aligned=True)
    search = first.search
    search.shift, search.aligned = None, True
    other = _repeat(first, partial(_search_once, moved, correct_early=True))
    if other is None:
        if not search.interrupted:
            search.run(request.most_effects)
        return first
    again = other.search
    if again.can_improve(again.best) and not again.cut_short:
        search.run(request.most_effects)
    before2, after2 = first.compared_with(other)
    return first if before2 < AS_GIVEN_RATIO * after2 else other


def _search_from_unknown_start(request: Request, first: Attempt, start: WrongStart) -> tuple[Request, Attempt]:
    """Search with the initial states estimated; keep that if it follows to the noise, and clearly better.

    Before the missing physics is known, it may be what makes a wrong zero more likely than a wrong start. While it is
    unknown, free initial states and an offset together make up for a part of it.
    """
    opened = request.corrected((start,), first.ready.nominal, "unknown start: ")
    other = _repeat(first, partial(_search_once, opened, correct_early=True))
    if other is None:
        return request, first
    again = other.search
    changed = sum(a is not b for a, b in zip(opened.recordings, request.recordings, strict=True))
    unknown = changed * len(opened.simulator.states)
    residuals = again.bench.scored(again.best.fitted.residual)
    explained = not again.can_improve(again.best)
    if explained and evidence_gain(*first.compared_with(other), residuals, unknown) > LEAST_GAIN:
        return opened, other
    return request, first


def _repeat(first: Attempt, prepare_and_search: Callable[[], Attempt]) -> Attempt | None:
    """Prepare and search once more; None if an interrupt came before that search began, or the simulator diverges.

    If that search is cut short, so is the present one.
    """
    found = None
    with first.search.until_interrupted(), suppress(InputError):
        found = prepare_and_search()
        first.search.cut_short_with(found.search)
    return found


def _search_once(request: Request, correct_early: bool) -> Attempt:
    """Check and correct the recordings, refit the simulator, measure the noise, and search from there."""
    began = time.perf_counter()
    left = request.deadline - began
    ready = prepare(
        request.simulator,
        request.recordings,
        hold=request.hold,
        engine=request.engine,
        workers=request.workers,
        correct_early=correct_early,
        say=request.say,
        until=began + PREPARATION_SHARE * left,
    )
    if request.focus is None:  # an unstable simulator may stay within bounds and still not follow
        ready.bench.check_followed(ready.without, USELESS_FIT)
    nominal = ready.nominal if np.isnan(request.nominal) else request.nominal
    ready = replace(ready, gates=(*request.edits, *ready.gates), nominal=nominal)
    ready = replace(ready, bench=replace(ready.bench, deadline=request.deadline), floor=_noise(request, ready))
    now = Checked(ready.bench, ready.without).weighted(ready.floor)
    ready = replace(ready, bench=now.bench, without=now.fitted)
    search = Search(
        bench=ready.bench,
        without=ready.without,
        floor=ready.floor,
        laws=(*request.laws, Offset),
        workers=request.workers,
        say=request.say,
        hold_settled=request.stated_hold is not None,
        aligned=request.aligned,
        surrogate_nrmse=request.surrogate_nrmse,
        until=began + SEARCH_SHARE * left,
        times={CHECKS: time.perf_counter() - began},
    )
    return Attempt(ready, search.run(request.most_effects))


def _noise(request: Request, ready: Prepared) -> Floor:
    """Return the noise floor of the prepared recordings; the error of a surrogate counts as noise."""
    floor = ready.floor
    if request.stretches is not None and floor.source == "estimated":  # what repeats may be outside the stretches
        floor = measured_floor(request.stretches.everything(ready.bench, ready.gates).recordings) or floor
    if not request.surrogate_nrmse:
        return floor
    return floor.beside(request.surrogate_nrmse * ready.bench.scale)
