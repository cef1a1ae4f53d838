"""From the user's simulator and recordings to a refitted simulator on recordings without dull faults."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._base import InputError, Stages
from ..data import Recording
from ..simulators import Simulator
from .floor import Floor, white_part
from .gates import ASTRAY, AT_NOISE, CURED, SAME, Checked, Gate, another_zero, offsets, opened, refit, slips
from .linearise import along, linearised, observer_gain
from .proof import errors_of
from .recording_faults import stale_samples, unclip, without_glitches, without_transients
from .step_refinement import on_steps_as_fine
from .timing import AVERAGED, as_given, gaps, in_steps, timing
from .workbench import THOROUGH, Fitted, Workbench

SMALL = 4e-4  # mean square error up to which signs and units are not looked at
CHECKS, CHECKED = "checks and refit", 6  # the stage's name, and the parts of it that are reported
LED = (1.0, 0.3, 0.1, 0.03, 0.01)  # gains of the observer in turn


@dataclass(frozen=True, eq=False)
class Prepared:
    """The start of the search.

    Attributes
    ----------
    nominal : float
        NRMSE at the user's values.
    without : Fitted
        The simulator refitted.
    floor : Floor
        Measured, or estimated from the refit.
    """

    bench: Workbench
    without: Fitted
    nominal: float
    gates: tuple[Gate, ...]
    floor: Floor


def prepare(
    simulator: Simulator,
    recordings: Sequence[Recording],
    hold: str | None,
    engine: str,
    workers: int = 1,
    starts: Sequence[Mapping[str, Any]] = (),
    early: bool = True,
    say: Stages | None = None,
) -> Prepared:
    """Open the bench, look at the dull causes, refit from the user's values and from `starts`, measure the floor.

    Without `early` a channel that seems early is so only where it is all that is wrong.
    """
    say = say or Stages(lambda *_: None)
    say(CHECKS, 0, CHECKED)
    recordings, spikes = without_glitches(recordings)
    recordings, transients = without_transients(recordings)
    said = said_hold(simulator, recordings, hold)
    bench, times = opened(simulator, recordings, said or "zero", engine)
    bench, held = (bench, ()) if said else choose_hold(bench)
    nominal = errors_of(bench, bench.model(simulator))
    say(CHECKS, 1, CHECKED)
    now = Checked(bench, refitted(bench, starts), (*spikes, *transients, *stale_samples(recordings), *times, *held))
    say(CHECKS, 2, CHECKED, now.cost**0.5)
    if now.cost > max(AT_NOISE**2 * now.noise2, SMALL):
        now = _without_slips(now, not said, workers, starts, early)
    say(CHECKS, 3, CHECKED, now.cost**0.5)
    whole = unclip(now)
    now = gaps(whole)
    if now is not whole and not said:  # what looked better across a gap says nothing
        now = _held_again(now)
    say(CHECKS, 4, CHECKED, now.cost**0.5)
    now = now.then(*on_steps_as_fine(now.bench, now.fitted))
    now = _in_step(now, not said, early)
    say(CHECKS, 5, CHECKED, now.cost**0.5)
    now = offsets(now)
    bench, without = now.bench, now.fitted
    if now.gates:  # values and states that wrong data led to may be a dead end
        led = bench.fit(bench.simulator, [without.values], states=without.initial, solver=THOROUGH)
        without = min(led, bench.fit(bench.simulator, [{}, led.values], solver=THOROUGH), key=lambda f: f.cost)
    floor = now.then(bench, without).floor
    bench.check_followed(without)
    bench = replace(bench, typical=along(bench, without))
    say(CHECKS, CHECKED, CHECKED, without.cost**0.5)
    return Prepared(bench, without, nominal, now.gates, floor)


def _without_slips(
    now: Checked, unsaid: bool, workers: int, starts: Sequence[Mapping[str, Any]], early: bool
) -> Checked:
    """Put signs, units and exchanged channels right; on wrong data the better hold says nothing, so choose it again."""
    found = _slips(now, unsaid, workers, early)
    if len(found.gates) == len(now.gates):
        return found
    raw, held = now.bench, tuple[Gate, ...]()
    bench = Workbench.of(raw.simulator, found.bench.recordings, raw.hold, raw.engine)
    if unsaid:
        bench, held = choose_hold(bench)
        if bench.hold != raw.hold:  # of two units that are near, the wrong hold may have fitted the wrong one
            other = raw.otherwise_held()
            try:
                again = _slips(Checked(other, refitted(other), now.gates), unsaid, workers, early)
                if len(again.gates) > len(now.gates):
                    found = again
                    bench = Workbench.of(raw.simulator, found.bench.recordings, other.hold, raw.engine)
            except InputError:
                pass
        found = _noted(found, held)
    return found.then(bench, bench.fit(bench.simulator, [found.fitted.values, {}, *starts], solver=THOROUGH))


def _slips(now: Checked, unsaid: bool, workers: int, early: bool) -> Checked:
    """Find signs, units and exchanged channels; or a shift in time, since late by half a swing looks like a sign."""
    found = another_zero(now, slips(now, workers), workers)
    if len(found.gates) == len(now.gates) or found.cost <= ASTRAY:
        return found
    late = timing(now, 0.5 if unsaid else 1.0, early)
    return late if late.cost < CURED * found.cost else found


def _in_step(now: Checked, unsaid: bool, early: bool) -> Checked:
    """Put shifts and clocks right; where nobody said what inputs do between samples, with the better hold.

    Where inputs are taken as held but are interpolated, a late channel is late by half a sample more or less.
    """
    found = timing(now, 0.5 if unsaid else 1.0, early)
    if len(found.gates) == len(now.gates) or not unsaid:
        return found
    other = now.bench.otherwise_held()
    again = other.fit(other.simulator, [now.fitted.values], states=now.fitted.initial)
    both = found, timing(Checked(other, again, now.gates), 0.5, early)
    costs = [_honest(c, len(now.gates)) for c in both]
    best = both[int(costs[1] < costs[0])]
    shifts = [g.value for g in best.gates[len(now.gates) :] if g.finding == "alignment"]
    if any(v > 0 and not in_steps(v, now.bench.dt) for v in shifts):  # a delay is physics
        return now
    ratio = (max(costs) / max(min(costs), 1e-300)) ** 0.5
    return _noted(best, (hold_note(best.bench, ratio),) if ratio > SAME else ())


def _honest(found: Checked, before: int) -> float:
    """Compute the mean square error as if no channel read between its samples had its noise averaged away."""
    shifts = [g.value for g in found.gates[before:] if g.finding == "alignment"]
    return found.cost / (AVERAGED if any(not in_steps(v, found.bench.dt) for v in shifts) else 1)


def refitted(bench: Workbench, starts: Sequence[Mapping[str, Any]] = ()) -> Fitted:
    """Fit the simulator from the user's values and from others; far off, lead it there by an observer as well."""
    plain = bench.fit(bench.simulator, [{}, *starts], solver=THOROUGH)
    if plain.cost < ASTRAY:
        return plain
    probe, runs = linearised(bench, as_given(bench, plain))
    gain = observer_gain(probe, runs, white_part(plain.residual))
    if not gain.any():
        return plain
    try:
        led = bench.fit(bench.simulator, anneal=LED, model=bench.model(bench.simulator, gain))
        found = bench.fit(bench.simulator, [led.values], states=led.begin, solver=THOROUGH)
    except (InputError, np.linalg.LinAlgError):
        return plain
    return found if found.cost < plain.cost else plain


# what inputs do between samples


def said_hold(simulator: Any, recordings: Sequence[Recording], said: str | None) -> str | None:
    """Return the hold that the user, the simulator or a recording states; None if none does."""
    return next((h for h in (said, simulator.hold, *(r.hold for r in recordings)) if h is not None), None)


def choose_hold(bench: Workbench, previous: Fitted | None = None) -> tuple[Workbench, tuple[Gate, ...]]:
    """Choose the hold that fits better, and note it; the bench's own where the errors are the same."""
    both = bench, bench.otherwise_held()
    fits = [refit(b, previous) for b in both]
    costs = [np.inf if found is None else found.cost for found in fits]
    ratio = float(np.sqrt(max(costs) / max(min(costs), 1e-300)))
    if not ratio >= SAME:
        return bench, ()
    best = both[int(costs[1] < costs[0])]
    return best, (hold_note(best, ratio),)


def _held_again(now: Checked) -> Checked:
    """Choose the hold again, and refit where it is the other one."""
    bench, held = choose_hold(now.bench, now.fitted)
    fitted = now.fitted
    if bench is not now.bench:
        fitted = bench.fit(bench.simulator, [fitted.values], states=fitted.begin, solver=THOROUGH)
    return _noted(now.then(bench, fitted), held)


def _noted(now: Checked, held: Sequence[Gate]) -> Checked:
    """Put another note about the hold in place of the last one."""
    return replace(now, gates=(*(g for g in now.gates if g.finding != "hold"), *held))


def hold_note(bench: Workbench, ratio: float) -> Gate:
    """Note that the bench's hold was chosen from the data; the other's error is `ratio` times as large."""
    words = {"zero": "held over each sample", "linear": "interpolated between samples"}[bench.hold]
    sentence = (
        f"The recordings do not say what inputs do between samples; {words} fits better (error {ratio:.3g} times "
        "smaller) and is used."
    )
    return Gate(", ".join(bench.simulator.inputs), "hold", bench.hold, sentence)
