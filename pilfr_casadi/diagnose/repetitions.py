"""Prepare and search, and repeat that where something that was taken for granted proves wrong.

There are five cases: with an observer if the simulator is unstable and runs away from the recordings (`prediction`);
with the other hold if nobody stated it and the best hypothesis follows better with it; without a shift if a channel
seemed to be early, because missing physics can look like a lead; with a shift that shows only beside the first law; and
from unknown initial states if a wrong zero was preferred to a wrong start. Each search fits different data. Its
evidence is therefore not comparable; the smaller error decides.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from .._base import InputError
from .arguments import Request, stated_hold
from .faults.gates import LEAST_GAIN, USELESS_FIT, Checked, Gate, gain
from .faults.offsets import Offset, WrongStart
from .faults.timing import TimeShift
from .fits.evidence import AS_GIVEN_RATIO
from .fits.floor import Floor, measured_floor
from .fits.workbench import RunsAway
from .prediction import can_be_led, prediction_note, predictor
from .preparation import CHECKS, Prepared, hold_note, prepare
from .search.moves import Search

# shares of the remaining time for the preparation, and for preparation and search; the rest is for the correction
PREPARATION_SHARE, SEARCH_SHARE = 0.35, 0.7


def search_with_focus(request: Request) -> tuple[Request, Prepared, Search]:
    """Search; if nobody stated the focus and the simulator runs away, let the recordings lead it."""
    if request.focus != "prediction":
        try:
            return request, *_search_both_holds(request)
        except RunsAway:  # by `Workbench`, in the first refit or as the check of it in `_search_once`
            if request.focus == "simulation" or not can_be_led(request.simulator, request.recordings):
                raise
    # the gain depends little on the hold, which the search may still change
    hold = stated_hold(request.simulator, request.recordings, request.hold) or "zero"
    led, memory = predictor(request.simulator, request.recordings, hold, request.engine)
    note = prediction_note(request.simulator, request.recordings, memory)
    request = replace(request, simulator=led, notes=(*request.notes, note))
    return request, *_search_both_holds(request)


def _search_both_holds(request: Request) -> tuple[Prepared, Search]:
    """Search; if nobody stated the hold of the inputs and it matters, use the hold with the smaller error."""
    ready, search = run_search(request)
    if search.hold_said or not _prefers_other_hold(search):
        return ready, search
    hold = search.bench.with_other_hold().hold
    held = replace(request, hold=hold, say=request.say.under("other hold: "))
    found = _again(search, partial(run_search, held))
    if found is None:
        return ready, search.resume(request.most_effects)
    other, again = found
    only_refitted, before2, after2 = again.interrupted and len(again.memo) < 2, *_comparable(search, again)
    if after2 > before2 or only_refitted:
        return ready, search.resume(request.most_effects)
    # the laws that were found since may have been what the hold had made up for
    if _prefers_other_hold(again):
        search.adopt(again.best)
        resumed = search.resume(request.most_effects)
        before2, after2 = _comparable(resumed, again)
        if before2 < after2:
            return ready, resumed
    ratio = float(np.sqrt(before2 / max(after2, 1e-300)))
    return replace(other, gates=(*other.gates, hold_note(request.simulator, hold, ratio))), again


def _prefers_other_hold(search: Search) -> bool:
    """Tell whether a search that nobody has interrupted would be better with the other hold."""
    prefers = False
    with search.until_interrupted():
        prefers = search.prefers_other_hold()
    return prefers


def _comparable(one: Search, other: Search) -> tuple[float, float]:
    """Compute the mean square errors of the best hypotheses of two searches, with the noise of the first."""
    return one.best.mean_square, one.bench.pool(other.best.fitted.squares)


def run_search(request: Request) -> tuple[Prepared, Search]:
    """Prepare and search; if a lead was corrected, repeat without, and keep that if it is clearly better.

    If a channel proves shifted beside a law, repeat with it at its right times. If a wrong zero was preferred to a
    wrong start, repeat with the start unknown.
    """
    ready, search = _search_once(request, shift_early=True)
    if search.shift is not None:
        return _search_realigned(request, ready, search, search.shift)
    start = next((g.otherwise for g in ready.gates if isinstance(g, WrongStart) and g.otherwise), None)
    if start is not None and not search.cut_short:
        request, ready, search = _search_from_unknown_start(request, ready, search, start)
    leads = any(isinstance(g, TimeShift) and g.leads for g in ready.gates)
    if not leads or search.cut_short or not search.can_improve(search.best):
        return ready, search
    found = _again(search, partial(_search_once, request, shift_early=False))
    if found is None:
        return ready, search
    before2, after2 = _comparable(search, found[1])
    return found if after2 < AS_GIVEN_RATIO * before2 else (ready, search)


def _search_realigned(request: Request, ready: Prepared, search: Search, shift: Gate) -> tuple[Prepared, Search]:
    """Search with a shifted channel at its right times, which ended a search; go on with that if it is clearly better.

    Missing physics can look like a lead.
    """
    edits = [g for g in ready.gates if g.corrected and g.change is not None]  # the shift is one of corrected channels
    moved = replace(request.corrected((*edits, shift), ready.nominal, "shifted: "), aligned=True)
    search.shift, search.aligned = None, True
    found = _again(search, partial(_search_once, moved, shift_early=True))
    if found is None:
        return ready, search if search.interrupted else search.run(request.most_effects)
    other, again = found
    if again.can_improve(again.best) and not again.cut_short:
        search.run(request.most_effects)
    before2, after2 = _comparable(search, again)
    return (ready, search) if before2 < AS_GIVEN_RATIO * after2 else (other, again)


def _search_from_unknown_start(
    request: Request, ready: Prepared, search: Search, start: WrongStart
) -> tuple[Request, Prepared, Search]:
    """Search with the initial states estimated; keep that if it follows to the noise, and clearly better.

    Before the missing physics is known, it may be what makes a wrong zero more likely than a wrong start. While it is
    unknown, free initial states and an offset together make up for a part of it.
    """
    opened = request.corrected((start,), ready.nominal, "unknown start: ")
    found = _again(search, partial(_search_once, opened, shift_early=True))
    if found is None:
        return request, ready, search
    other, again = found
    changed = sum(a is not b for a, b in zip(opened.recordings, request.recordings, strict=True))
    unknown = changed * len(opened.simulator.states)
    residuals = again.bench.scored(again.best.fitted.residual)
    explained = not again.can_improve(again.best)
    if explained and gain(*_comparable(search, again), residuals, unknown) > LEAST_GAIN:
        return opened, other, again
    return request, ready, search


def _again(search: Search, prepare_and_search: Callable[[], tuple[Prepared, Search]]) -> tuple[Prepared, Search] | None:
    """Prepare and search once more; None if an interrupt came before that search began, or the simulator diverges.

    If that search is cut short, so is the present one.
    """
    found = None
    with search.until_interrupted(), suppress(InputError):
        found = prepare_and_search()
        search.cut_short_with(found[1])
    return found


def _search_once(request: Request, shift_early: bool) -> tuple[Prepared, Search]:
    """Check and correct the recordings, refit the simulator, measure the noise, and search from there."""
    began = time.perf_counter()
    left = request.deadline - began
    ready = prepare(
        request.simulator,
        request.recordings,
        request.hold,
        request.engine,
        request.workers,
        early=shift_early,
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
        ready.bench,
        ready.without,
        ready.floor,
        (*request.laws, Offset),
        request.workers,
        request.say,
        hold_said=request.hold_said,
        aligned=request.aligned,
        stand_in_error=request.stand_in_error,
        until=began + SEARCH_SHARE * left,
        times={CHECKS: time.perf_counter() - began},
    )
    return ready, search.run(request.most_effects)


def _noise(request: Request, ready: Prepared) -> Floor:
    """Return the noise floor of the prepared recordings; the error of a surrogate counts as noise."""
    floor = ready.floor
    if request.stretches is not None and floor.source == "estimated":  # what repeats may be outside the stretches
        floor = measured_floor(request.stretches.everything(ready.bench, ready.gates).recordings) or floor
    if not request.stand_in_error:
        return floor
    return floor.beside(request.stand_in_error * ready.bench.scale)
