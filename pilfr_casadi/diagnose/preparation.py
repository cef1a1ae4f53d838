"""From the user's simulator and recordings to a refitted simulator on recordings without dull faults."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._base import InputError, Stages
from ..data import Recording
from ..simulators import Simulator
from .floor import Floor, noise_floor, white_part
from .gaps import gaps
from .gates import CURED, STRAINED, Gate, choose_hold, hold_note, opened, said_hold, slips
from .linearise import along, linearised, observer_gain
from .offset import another_zero, offsets
from .proof import errors_of
from .recording_faults import stale_samples, unclip, without_glitches, without_transients
from .step_refinement import on_steps_as_fine
from .timing import FAR, as_given, in_steps, timing
from .workbench import THOROUGH, Fitted, Workbench

SUSPECT, LEAST = 25.0, 4e-4  # times the noise, and mean square error, beyond which signs and units are looked at
CHECKS, CHECKED = "checks and refit", 6  # the stage's name, and the parts of it that are reported
LED = (1.0, 0.3, 0.1, 0.03, 0.01)  # gains of the observer in turn


@dataclass(frozen=True, eq=False)
class Prepared:
    """What the search starts from.

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
    bench, gates = opened(simulator, recordings, hold or "zero", engine)
    gates = [*spikes, *transients, *stale_samples(recordings), *gates]
    between, notes = choose_hold(simulator, bench.recordings, hold, engine)
    bench = Workbench.of(simulator, bench.recordings, between, engine)
    nominal = errors_of(bench, bench.model(simulator))
    say(CHECKS, 1, CHECKED)
    without = refitted(bench, starts)
    say(CHECKS, 2, CHECKED, without.cost**0.5)
    unsaid = said_hold(simulator, recordings, hold) is None
    first = noise_floor(bench.recordings, without.residual)
    noise2 = float(np.mean((first.deviation / bench.scale) ** 2))
    if without.cost > SUSPECT * noise2 and without.cost > LEAST:
        raw, found = bench, _slips(bench, without, noise2, unsaid, workers, early)
        without = found[1]
        if found[2]:  # what looked better on wrong data says nothing
            asked, (between, notes) = between, choose_hold(simulator, found[0].recordings, hold, engine)
            if between != asked:  # of two units that are near, the wrong hold may have fitted the wrong one
                found = _slips_again(raw, between, noise2, unsaid, workers, early) or found
            bench = Workbench.of(simulator, found[0].recordings, between, engine)
            without = bench.fit(simulator, [found[1].values, {}, *starts], solver=THOROUGH)
            gates = [*gates, *found[2]]
    gates = [*gates, *notes]
    say(CHECKS, 3, CHECKED, without.cost**0.5)
    bench, without, more = unclip(bench, without)
    gates += more
    floor = noise_floor(bench.recordings, without.residual)
    noise2 = float(np.mean((floor.deviation / bench.scale) ** 2))
    bench, without, more = gaps(bench, without, noise2)
    if more:  # what looked better across a gap, and the noise that it makes, say nothing
        gates += more
        if unsaid:
            bench, without, held = _better_held(bench, without)
            gates, notes = [g for g in gates if g not in notes] + held, held
        floor = noise_floor(bench.recordings, without.residual)
        noise2 = float(np.mean((floor.deviation / bench.scale) ** 2))
    say(CHECKS, 4, CHECKED, without.cost**0.5)
    bench, without = on_steps_as_fine(bench, without)
    given, before = bench, without
    # where inputs are taken as held but are interpolated, a late channel is late by half a sample more or less
    bench, without, more = timing(given, before, noise2, 0.5 if unsaid else 1.0, early)
    if more and unsaid:  # out of step, what looked better says nothing
        other = given.otherwise_held()
        found = timing(other, other.fit(other.simulator, [before.values], states=before.initial), noise2, 0.5, early)
        costs = _honest(without, more, bench.dt), _honest(found[1], found[2], bench.dt)
        if costs[1] < costs[0]:
            bench, without, more = found
        if any(_late_by_a_part(g, bench.dt) for g in more):  # a delay is physics
            bench, without, more = given, before, []
        else:
            ratio = (max(costs) / max(min(costs), 1e-300)) ** 0.5
            held = [hold_note(simulator, bench.hold, ratio)] if ratio > 1.02 else []
            gates = [g for g in gates if g not in notes] + held
    gates += more
    say(CHECKS, 5, CHECKED, without.cost**0.5)
    bench, without, more = offsets(bench, without)
    gates += more
    if gates:  # values and states that wrong data led to may be a dead end
        led = bench.fit(bench.simulator, [without.values], states=without.initial, solver=THOROUGH)
        without = min(led, bench.fit(bench.simulator, [{}, led.values], solver=THOROUGH), key=lambda f: f.cost)
    floor = noise_floor(bench.recordings, without.residual)
    bench.check_followed(without)
    bench = replace(bench, typical=along(bench, without))
    say(CHECKS, CHECKED, CHECKED, without.cost**0.5)
    return Prepared(bench, without, nominal, tuple(gates), floor)


def _slips(
    bench: Workbench, without: Fitted, noise2: float, unsaid: bool, workers: int, early: bool
) -> tuple[Workbench, Fitted, list[Gate]]:
    """Signs, units and exchanged channels; or a shift in time, since late by half a swing looks like another sign."""
    found = another_zero(bench, without, slips(bench, without, workers), workers)
    if not found[2] or found[1].cost <= STRAINED:
        return found
    late = timing(bench, without, noise2, 0.5 if unsaid else 1.0, early)
    return late if late[1].cost < CURED * found[1].cost else found


def _slips_again(
    raw: Workbench, hold: str, noise2: float, unsaid: bool, workers: int, early: bool
) -> tuple[Workbench, Fitted, list[Gate]] | None:
    """The same on the recordings as given, with the other hold; None where that shows no slip or cannot be run."""
    try:
        bench = Workbench.of(raw.simulator, raw.recordings, hold, raw.engine)
        found = _slips(bench, refitted(bench), noise2, unsaid, workers, early)
    except InputError:
        return None
    return found if found[2] else None


def refitted(bench: Workbench, starts: Sequence[Mapping[str, Any]] = ()) -> Fitted:
    """The simulator fitted from the user's values and from others; far off, led there by an observer as well."""
    plain = bench.fit(bench.simulator, [{}, *starts], solver=THOROUGH)
    if plain.cost < FAR:
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


def _better_held(bench: Workbench, fitted: Fitted) -> tuple[Workbench, Fitted, list[Gate]]:
    """The bench with what fits better of inputs held and interpolated between samples; and what is to be told."""
    other = bench.otherwise_held()
    try:
        found = other.fit(other.simulator, [fitted.values], states=fitted.begin, solver=THOROUGH)
    except InputError:
        return bench, fitted, []
    ratio = (max(found.cost, fitted.cost) / max(min(found.cost, fitted.cost), 1e-300)) ** 0.5
    if found.cost < fitted.cost and ratio > 1.02:
        bench, fitted = other, found
    return bench, fitted, [hold_note(bench.simulator, bench.hold, ratio)] if ratio > 1.02 else []


def _honest(fitted: Fitted, gates: Sequence[Gate], dt: float) -> float:
    """Mean square error; a channel read between its samples has up to half of its noise averaged away."""
    between = any(g.finding == "alignment" and not in_steps(g.value, dt) for g in gates)
    return fitted.cost * (2 if between else 1)


def _late_by_a_part(gate: Gate, dt: float) -> bool:
    """Whether a channel comes late, and not by whole samples."""
    return gate.finding == "alignment" and gate.value > 0 and not in_steps(gate.value, dt)
