"""From recordings to a refitted simulator: the checks of recordings in their order.

If nobody stated what the inputs do between samples, the hold with the smaller error is used. Faulty data say nothing
about the hold: if a fault was found, the other hold goes through all checks as well.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from .._base import InputError, Stages, UntilInterrupted, in_words
from ..data import COURSES, Recording
from ..engine import make_engine
from ..optimise import GaussNewton, Status
from ..simulators import Simulator, discretise_for, stated_hold, unit_notes
from .faults.channels import accept_best, find_channel_errors, find_gross_channel_errors, open_bench, refit_corrected
from .faults.gates import CURED_SHARE, EQUAL_RATIO, NEAR_NOISE_RATIO, POOR_FIT, Checked, Gate, error_ratio
from .faults.lost_samples import find_gaps, find_output_gaps
from .faults.offsets import find_offsets, find_wrong_start
from .faults.rates import find_wrong_rates
from .faults.samples import clean_recordings, find_frozen_channels, find_held_outputs, mend_stale_samples, unclip
from .faults.timing import AVERAGED_NOISE, TimeShift, find_time_shift, in_steps
from .fits.evidence import BETTER_RATIO
from .fits.floor import Floor, pool, white_part
from .fits.linearise import linearise_runs, observer_gain, sample_run
from .fits.step_refinement import refine_steps
from .fits.workbench import THOROUGH, Fitted, Workbench, refit, refit_with_other_holds
from .proof import errors_of

CHECKED_ABOVE = 4e-4  # mean square error up to which signs and units are not checked
CHECKS, CHECKED = "checks and refit", 6  # the stage's name, and the number of its parts that are reported
LEAST_REFIT = 10.0  # seconds for the first refit in any case
UNCHECKED = (
    "Some checks of the recordings were left out, because time ran out or the run was interrupted: a shift, a gap or "
    "an offset of a channel may have been missed."
)
OTHER_HOLD_UNCHECKED = (
    "Time ran out before the fault of a channel was also looked for with another hold of the inputs: another channel "
    "may be at fault."
)
# holds compared before a search: a further one costs all checks again, and shows hardly while physics is missing
PREPARED_HOLDS = ("zero", "linear")
TIMED_SAMPLES = 50  # samples whose simulation is timed
LONG_SIMULATION = 1.0  # seconds that a simulation takes without a note
OBSERVER_GAINS = (1.0, 0.3, 0.1, 0.03, 0.01)  # gains of the observer, in turn


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
    correct_early: bool = True,
    say: Stages | None = None,
    until: float = np.inf,
) -> Prepared:
    """Correct faults of the recordings, refit from the user's values, and measure the noise.

    Without `correct_early`, an early channel is corrected only if no other error is left. No check begins after `until`
    (a time of `time.perf_counter`), and the fits of checks end then; a note tells if checks were left out.
    """
    say = say or Stages(lambda *_: None)
    say(CHECKS, 0, CHECKED)
    recordings, cleaned = clean_recordings(recordings)
    slow = [*find_held_outputs(recordings), *find_frozen_channels(recordings)]
    stated = stated_hold(simulator, recordings, hold)
    bench, times = open_bench(simulator, recordings, stated or "zero", engine)
    checks, noted = _Checks(workers, correct_early, say, until), (*cleaned, *slow, *times)
    held: Sequence[Gate] = ()
    if stated:
        first = checks.begin(bench, noted)
    else:
        first, held = choose_hold(checks.begin_with_either_hold(bench, noted).with_deadline(checks.refit_deadline()))
    nominal = errors_of(replace(bench, hold=first.bench.hold), first.fitted.model)
    say(CHECKS, 1, CHECKED)
    now = checks.run(first, 1.0 if stated else 0.5)
    faulty = any(g.fault for g in now.gates[len(first.gates) :])
    if not stated and faulty and not bench.interrupt.pressed:  # on faulty data the better hold says nothing
        now, held = _with_better_hold(checks, now, first, held)
    bench, without = now.bench, now.fitted
    unchecked = dict.fromkeys([*checks.left_out, *([UNCHECKED] if bench.interrupt.pressed else [])])
    corrected = bool(now.gates or held)  # values and states from faulty data may be in a wrong minimum
    if corrected and not bench.interrupt.pressed:
        again = bench.fit(bench.simulator, [without.values], states=without.initial, solver=THOROUGH)
        without = min(again, bench.fit(bench.simulator, [{}, again.values], solver=THOROUGH), key=lambda f: f.cost)
    bench.check_followed(without)
    bench = replace(bench, typical=sample_run(bench, without))
    say(CHECKS, CHECKED, CHECKED, without.cost**0.5)
    notes = [Gate("recordings", "unchecked", None, sentence, corrected=False) for sentence in unchecked]
    notes += find_wrong_rates(bench)
    return Prepared(bench, without, nominal, (*now.gates, *held, *notes), Checked(bench, without).floor)


@dataclass(frozen=True)
class _Checks:
    """The checks of recordings in their order; `left_out` receives what to say about those that were not begun."""

    workers: int
    correct_early: bool
    say: Stages
    until: float
    left_out: list[str] = field(default_factory=list)

    def refit_deadline(self) -> float:
        """Return when a refit that begins now ends: with the checks, but in LEAST_REFIT seconds at the earliest."""
        return max(self.until, time.perf_counter() + LEAST_REFIT)

    def begin(self, bench: Workbench, gates: tuple[Gate, ...]) -> Checked:
        """Refit from the user's values; correct a fault of a channel that shows at these values."""
        found: Checked | None = None
        with UntilInterrupted(bench.interrupt, self.say.interrupted):
            faults = find_gross_channel_errors(replace(bench, deadline=self.refit_deadline()), self.workers)
            if faults:
                found = self._try_gross_errors(replace(bench, deadline=self.refit_deadline()), faults, gates)
        return found or first_refit(replace(bench, deadline=self.refit_deadline()), gates)

    def begin_with_either_hold(self, bench: Workbench, gates: tuple[Gate, ...]) -> Checked:
        """Begin; if a channel is at fault, begin with the other hold too, since a wrong hold may blame a wrong one."""
        (other,) = bench.with_other_holds(PREPARED_HOLDS)
        try:
            first = self.begin(bench, gates)
        except InputError:
            return self.begin(other, gates)
        if len(first.gates) == len(gates) or bench.interrupt.pressed:
            return first
        if time.perf_counter() > self.until:
            self.left_out.append(OTHER_HOLD_UNCHECKED)
            return first
        with suppress(InputError):
            first = min(first, self.begin(other, gates), key=lambda checked: checked.cost)
        return first

    def _try_gross_errors(self, bench: Workbench, faults: Sequence[Gate], gates: tuple[Gate, ...]) -> Checked | None:
        """Correct the likeliest fault if the rule accepts it; None if there is no fault and every run diverges.

        The refit to the recordings as given gets half of the time: a slow simulator is not fitted at length to what it
        cannot follow. It goes on if there is no fault.
        """
        brief = replace(bench, deadline=(time.perf_counter() + bench.deadline) / 2)
        plain = refit(brief, solver=THOROUGH) or brief.run_given()
        now = replace(with_observer(Checked(brief, plain, gates)), bench=bench)
        found = accept_best(now, () if bench.interrupt.pressed else faults, self.workers)
        if bench.interrupt.pressed:  # half a fit accepts wrong faults
            return now if np.isfinite(now.cost) else None
        found = found.with_deadline(self.refit_deadline())
        if found.adds_to(now):
            return refit_corrected(found)
        if not np.isfinite(found.cost):
            return None
        bench, values, states = found.bench, found.fitted.values, found.fitted.initial
        return replace(found, fitted=bench.fit(bench.simulator, [values], states=states, solver=THOROUGH))

    def run(self, first: Checked, shift_step: float) -> Checked:
        """Correct one fault after the other from the first refit on; for `shift_step` see `timing`."""
        now = with_observer(first.with_deadline(self.refit_deadline())).weighted()
        now = self._in_turn(now, find_wrong_start, in_any_case=True)
        now = now.with_deadline(self.until)
        channels = partial(self._correct_channel_errors, shift_step=shift_step)
        shift = partial(find_time_shift, shift_step=shift_step, correct_early=self.correct_early)
        now = self._in_turn(now, self._report(2), channels, in_any_case=True)
        now = self._in_turn(now, self._report(3), unclip, mend_stale_samples, find_gaps)
        now = self._in_turn(now, self._report(4), _refine_steps, in_any_case=True)
        return self._in_turn(now, shift, find_output_gaps, self._report(5), find_offsets)

    def _in_turn(self, now: Checked, *checks: Callable[[Checked], Checked], in_any_case: bool = False) -> Checked:
        """Carry out checks one after the other, until an interrupt comes, or the time is over, unless `in_any_case`."""
        for check in checks:
            if now.bench.interrupt.pressed or not (in_any_case or time.perf_counter() < self.until):
                self.left_out.append(UNCHECKED)
                break
            with UntilInterrupted(now.bench.interrupt, self.say.interrupted):
                before, now = now, check(now)
                now = now if now.fitted is before.fitted else now.weighted()
        return now

    def _report(self, done: int) -> Callable[[Checked], Checked]:
        """Make a step that only reports how many checks are done."""

        def report(now: Checked) -> Checked:
            self.say(CHECKS, done, CHECKED, now.cost**0.5)
            return now

        return report

    def _correct_channel_errors(self, now: Checked, shift_step: float) -> Checked:
        """Correct wrong signs, units and exchanged channels if the refit is not at the noise, and refit."""
        if now.cost <= NEAR_NOISE_RATIO**2 * now.noise2 or np.mean(now.fitted.squares) <= CHECKED_ABOVE:
            return now
        found = self._find_channel_errors(now, shift_step)
        return refit_corrected(found) if found.adds_to(now) else found

    def _find_channel_errors(self, now: Checked, shift_step: float) -> Checked:
        """Find wrong signs, units and exchanged channels; or a shift, because half a period late looks like a sign."""
        found = find_channel_errors(now, self.workers)
        if not found.adds_to(now) or found.cost <= POOR_FIT:
            return found
        late = find_time_shift(now, shift_step, self.correct_early)
        return late if late.cost < CURED_SHARE * found.cost else found


def _refine_steps(now: Checked) -> Checked:
    return now.then(*refine_steps(now.bench, now.fitted))


def _with_better_hold(
    checks: _Checks, now: Checked, first: Checked, held: Sequence[Gate]
) -> tuple[Checked, Sequence[Gate]]:
    """Repeat the checks with the other hold, and keep the one with the smaller error; return the note about it.

    If inputs are taken as held but were interpolated, a late channel is late by half a sample more or less.
    """
    try:
        again = _with_other_hold(first.with_deadline(checks.refit_deadline()))
        if again is None:
            return now, held
        both = now, checks.run(again, 0.5)
    except InputError:
        return now, held
    noise2 = np.min([found.floor.squares(found.bench.scale) for found in both], axis=0)
    costs = [_comparable_cost(found, noise2) for found in both]
    ratio = error_ratio(*costs)
    if ratio > EQUAL_RATIO:
        now = both[int(costs[1] < costs[0])]
        held = [hold_note(now.bench.simulator, now.bench.hold, ratio)]
    if any(s.delay > 0 and not in_steps(s.value, now.bench.dt) for s in _shifts(now)):  # a delay is physics
        now = checks.run(first if now.bench.hold == first.bench.hold else again, 1.0)
    return now, held


def _shifts(found: Checked) -> list[TimeShift]:
    return [g for g in found.gates if isinstance(g, TimeShift) and g.finding == "alignment"]


def _comparable_cost(found: Checked, noise2: np.ndarray) -> float:
    """Compute the mean square error without the noise reduction by interpolating a channel between its samples."""
    cost = pool(found.fitted.squares, noise2)[0]
    between = any(not in_steps(s.value, found.bench.dt) for s in _shifts(found))
    return cost / (AVERAGED_NOISE if between else 1)


def first_refit(bench: Workbench, gates: tuple[Gate, ...] = ()) -> Checked:
    """Refit the simulator from the user's values."""
    return Checked(bench, bench.fit(bench.simulator, solver=THOROUGH), gates)


def with_observer(now: Checked) -> Checked:
    """If the error of a refit is large, refit with an observer as well, from the user's values."""
    if now.cost < POOR_FIT:
        return now
    bench = now.bench
    given = bench.run_given(now.fitted)
    if not np.isfinite(given.cost):
        return now
    probe, runs = linearise_runs(bench, given)
    gain = observer_gain(probe, runs, white_part(now.fitted.residual))
    if not gain.any():
        return now
    try:
        observed = bench.fit(bench.simulator, anneal=OBSERVER_GAINS, like=bench.compile(bench.simulator, gain))
        found = bench.fit(bench.simulator, [observed.values], states=observed.begin, solver=THOROUGH)
    except (InputError, np.linalg.LinAlgError):
        return now
    return replace(now, fitted=found) if found.cost < now.cost else now


# hold of the inputs between samples


def choose_hold(first: Checked, solver: GaussNewton = THOROUGH) -> tuple[Checked, Sequence[Gate]]:
    """Choose the hold whose refit has the smaller error, and note it; keep the first one if the errors are equal.

    It is kept without a note if a refit was cut short, which says nothing.
    """
    other = _with_other_hold(first, solver)
    if other is None:
        return first, [hold_note(first.bench.simulator, first.bench.hold, np.inf)]
    if Status.TIME_LIMIT in (first.fitted.status, other.fitted.status):
        return first, ()
    costs = first.cost, other.cost
    ratio = error_ratio(*costs)
    if not ratio >= EQUAL_RATIO:
        return first, ()
    best = other if other.cost < first.cost else first
    return best, [hold_note(best.bench.simulator, best.bench.hold, ratio)]


def _with_other_hold(first: Checked, solver: GaussNewton = THOROUGH) -> Checked | None:
    """Repeat the first refit with the other hold, from its values and from the user's; None if it diverges."""
    starts = [first.fitted.values, {}]
    found = refit_with_other_holds(first.bench, starts, solver=solver, among=PREPARED_HOLDS)
    return replace(first, bench=found[0][0], fitted=found[0][1]) if found else None


def conversions(simulator: Simulator, recordings: Sequence[Recording]) -> tuple[Gate, ...]:
    """Note which channels are recorded in another unit than the simulator's."""
    found = {
        sentence: Gate(name, "conversion", r.factor_to(simulator.units, name), sentence)
        for r in recordings
        for name, sentence in unit_notes(simulator.units, r).items()
    }
    return tuple(found.values())


def slow_note(simulator: Simulator, recordings: Sequence[Recording]) -> tuple[Gate, ...]:
    """Note how long a simulation of all recordings takes, if the simulator calls programs and it takes long.

    A short piece is simulated; the value of the note is the time in s.
    """
    if not simulator.program_calls:
        return ()
    piece = recordings[0].slice(0, TIMED_SAMPLES)
    try:
        model = discretise_for(simulator, [piece])
        engine, drive = make_engine(model, "vm"), model.drive(piece)
        began = time.perf_counter()
        engine.simulate(drive, model.parameters.start, np.zeros(model.n_state))
    except InputError:  # what is wrong is said where all of the recordings are simulated
        return ()
    seconds = (time.perf_counter() - began) * sum(map(len, recordings)) / len(piece)
    if seconds < LONG_SIMULATION:
        return ()
    words = (
        f"A simulation of the training recordings takes about {seconds:.2g} s, because it calls "
        f"{in_words(list(simulator.program_calls))} at every step, and each fit takes hundreds of simulations. Give "
        "shorter recordings, or equations, or more time (time_limit, --time-limit)."
    )
    return (Gate("simulation", "slow", seconds, words, corrected=False),)


def hold_note(simulator: Simulator, hold: str, ratio: float) -> Gate:
    """Note that the hold was chosen from the data; the other's error is `ratio` times as large."""
    known = "" if ratio > BETTER_RATIO else "; state the hold if you know it"
    how = f"fit better (error {ratio:.3g} times smaller{known})" if ratio > EQUAL_RATIO else "fit no worse"
    how = how if np.isfinite(ratio) else "let the simulation follow (otherwise it diverges)"
    words = f"inputs that are {COURSES[hold].words} there {how} and are used"
    sentence = f"The recordings do not say what inputs do between samples; {words}."
    return Gate(", ".join(simulator.inputs), "hold", hold, sentence)
