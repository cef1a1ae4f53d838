"""The arguments of `diagnose`: their checks, and the request that they make."""

from __future__ import annotations

import difflib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from .._base import InputError, Progress, Stages, is_number, listed, positive, processors, whole
from ..data import SAME_STEP, Recording, as_recordings, check_for_identification, known_hold
from ..laws import (
    CATALOGUE,
    SCALABLE,
    Feedthrough,
    Law,
    LinearStiffness,
    UnreadInput,
    VaryingParameter,
    ViscousDamping,
    carried,
    scaled,
    scheduled,
    seen_by,
)
from ..simulators import Simulator, as_simulator, check_hold, may_be_flow, stated_hold
from .faults.gates import Gate, edited
from .preparation import conversions, slow_note
from .search.stretches import SEARCHED_SAMPLES, Stretches

FEWEST_SHARED = 20  # equal samples in a row that cannot be chance, where the outputs move
FEWEST_SAMPLES = 20  # samples in all training recordings together; fewer cannot determine a model


@dataclass(frozen=True, eq=False)
class Request:
    """Arguments of `diagnose`, checked; see there."""

    simulator: Simulator
    recordings: Sequence[Recording]
    laws: Sequence[type[Law]]
    hold: str | None
    engine: str
    workers: int
    most_effects: float
    surrogate_nrmse: float
    deadline: float
    say: Stages
    focus: str | None = None
    notes: tuple[Gate, ...] = ()
    stretches: Stretches | None = None  # where `recordings` are stretches of long ones
    aligned: bool = False  # whether the times of the channels are settled
    edits: tuple[Gate, ...] = ()  # corrections that `recordings` have already
    nominal: float = np.nan  # error at the user's values before these
    calls: Mapping[str, int] = field(default_factory=dict)  # of the simulator's programs before
    tests: tuple[Recording, ...] = ()
    limits: Mapping[str, float] | None = None
    search_samples: int = SEARCHED_SAMPLES
    began: float = 0.0  # time (of `time.perf_counter`) at which the diagnosis began

    def corrected(self, edits: Sequence[Gate], nominal: float, stage: str) -> Request:
        """Return the request with recordings corrected by further edits; its stages are shown under another name."""
        recordings, say = edited(self.recordings, edits), self.say.under(stage)
        return replace(self, recordings=recordings, edits=(*self.edits, *edits), nominal=nominal, say=say)

    @property
    def stated_hold(self) -> str | None:
        """Course of the inputs between samples; None if nobody stated it."""
        return stated_hold(self.simulator, self.recordings, self.hold)


def read_arguments(
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
) -> Request:
    """Check the arguments of `diagnose`; return the request that they make.

    Raises
    ------
    InputError
        If an argument is wrong, or simulator and recordings do not fit each other.
    """
    began = time.perf_counter()
    workers = min(processors(), 4) if workers is None else whole(workers, "workers", 1)
    most_effects = np.inf if effects is None else whole(effects, "effects", 0)
    check_time_and_focus(time_limit, focus)
    positive(stand_in_error, "stand_in_error", "the NRMSE of a model that replaces the simulator", zero=True)
    given = as_recordings(train)
    simulator, recordings, stated = match_recordings(simulator, given, hold)
    tests = match_tests(simulator, test, recordings, stated)
    check_limits(simulator, limits)
    tried = (*add_scaled_laws(check_laws(laws), simulator), *((VaryingParameter,) if laws is None else ()))
    say = Stages(progress or (lambda stage, done, total, best: None))
    calls, slow = simulator.program_calls, slow_note(simulator, recordings)
    return Request(
        simulator=simulator,
        recordings=recordings,
        laws=tried,
        hold=hold,
        engine=engine,
        workers=workers,
        most_effects=most_effects,
        surrogate_nrmse=stand_in_error,
        deadline=np.inf if time_limit is None else began + float(time_limit),
        say=say.under(f"{slow[0].value:.2g} s a simulation: ") if slow else say,
        focus=focus,
        notes=(*conversions(simulator, given), *slow),
        calls=calls,
        tests=tests,
        limits=limits,
        search_samples=SEARCHED_SAMPLES
        if search_samples is None
        else whole(search_samples, "search_samples", FEWEST_SAMPLES),
        began=began,
    )


def match_recordings(
    simulator: Any, train: Recording | Sequence[Recording], hold: str | None
) -> tuple[Simulator, tuple[Recording, ...], str | None]:
    """Return the simulator, the recordings with its channels in its order, and their hold if somebody stated it.

    Inputs may be constant or absent: the motion from a start, such as a decay, excites as well.

    Raises
    ------
    InputError
        If the hold is unknown, or simulator and recordings do not fit each other.
    """
    known_hold(hold)
    given = as_recordings(train)
    simulator = as_simulator(simulator, given)
    recordings = [simulator.matched(r) for r in given]
    stated = stated_hold(simulator, recordings, hold)
    return simulator, check_for_identification(recordings, FEWEST_SAMPLES, excited=False), stated


def match_tests(
    simulator: Simulator, test: Recording | Sequence[Recording] | None, train: Sequence[Recording], hold: str | None
) -> tuple[Recording, ...]:
    """Return the test recordings with the simulator's channels; `hold` is what is stated for the training.

    Training data, other steps, another hold of the inputs, and recordings without outputs are refused.
    """
    tests = tuple(simulator.matched(r) for r in as_recordings(test)) if test is not None else ()
    for t in tests:
        if not t.n_y:
            label = t.label.removeprefix("the ")
            raise InputError(f"The test {label} has no outputs to compare with; name the measured columns.")
        if hold is None and t.hold is not None and not simulator.discrete:
            raise InputError(
                f"The test {t.label.removeprefix('the ')} states hold={t.hold!r}, and no training recording states "
                "any; state it for both, or for none."
            )
        check_hold(simulator, t, hold or "zero")
        for r in train:
            if (shared := _shared_samples(r, t)) == len(t):
                raise InputError(
                    "A test recording equals a training recording or a part of one; give data the fit has not seen."
                )
            if shared:
                raise InputError(
                    f"{shared} of the {len(t)} samples of a test recording are training data; cut them off."
                )
        if abs(t.dt / train[0].dt - 1) > SAME_STEP:
            raise InputError(f"The test recording's step is {t.dt:g} s, the training's {train[0].dt:g} s; resample it.")
    return tests


def _shared_samples(train: Recording, test: Recording) -> int:
    """Count the samples with which a test recording repeats a part of a training recording, or its begin or end.

    Parts in which the outputs hardly move tell nothing, and samples that are not scored may be shared.
    """
    one, other = (np.column_stack([r.y, r.u]) for r in (train, test))
    moves = (np.diff(test.y, axis=0) != 0).any(axis=1)
    if not moves.any():
        return 0
    (i, part), (j, again) = (_first_motion(rows, train.y.shape[1]) for rows in (one, other))
    for shift in (*(_places(one, again) - j), *(i - _places(other, part))):  # of the test in the training recording
        begin, rest = max(-shift, 0), one[max(shift, 0) :]
        shared = min(len(rest), len(other) - begin)
        seen = int(np.sum(moves[begin : begin + shared - 1]))
        if (
            seen >= min(FEWEST_SHARED, int(np.sum(moves)))
            and begin + shared > test.skip
            and np.array_equal(rest[:shared], other[begin : begin + shared])
        ):
            return shared
    return 0


def _first_motion(rows: np.ndarray, n_y: int) -> tuple[int, np.ndarray]:
    """Return where the outputs, the first columns, begin to move, and the rows there that tell the place."""
    first = int(np.argmax((np.diff(rows[:, :n_y], axis=0) != 0).any(axis=1)))
    return first, rows[first : first + FEWEST_SHARED]


def _places(rows: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Return the places at which rows (M, n) contain a part of other rows."""
    count = max(len(rows) - len(part) + 1, 0)
    same = [(rows[k : k + count] == row).all(axis=1) for k, row in enumerate(part)]
    return np.flatnonzero(np.all(same, axis=0))


def check_laws(laws: Sequence[type[Law] | str] | None) -> tuple[type[Law], ...]:
    """Return the classes of laws, by default the catalogue; a name stands for a class, or for all forms of an id."""
    if isinstance(laws, str):
        laws = [name.strip() for name in laws.split(",")]
    found: list[type[Law]] = []
    for law in laws or ():
        if isinstance(law, str):
            found += _laws_named(law)
        elif isinstance(law, type) and issubclass(law, Law):
            found.append(law)
        else:
            raise InputError(f"laws holds {law!r}; give classes of laws, such as pilfr.laws.CoulombFriction.")
    return CATALOGUE if laws is None else tuple(dict.fromkeys(found))


def _laws_named(name: str) -> list[type[Law]]:
    """Return the laws of the catalogue with an id, or the one with a class name; letter case is ignored."""
    found = [law for law in CATALOGUE if name.lower() in (law.id, law.__name__.lower())]
    if not found:
        labels = dict.fromkeys(label for law in CATALOGUE for label in (law.id, law.__name__))
        known = {label.lower(): label for label in labels}
        wanted = name.lower().replace(" ", "_")
        near = [label for label in known if wanted in label][:3] or difflib.get_close_matches(wanted, known, 3)
        meant = listed([known[label] for label in near])
        hint = f"did you mean {meant}?" if near else "give ids or class names from the catalogue of laws."
        raise InputError(f"The catalogue has no law {name!r}; {hint}")
    return found


def add_scaled_laws(laws: Sequence[type[Law]], simulator: Simulator) -> tuple[type[Law], ...]:
    """Return the laws, and versions of some of them whose strength varies with a signal.

    An input that the equations do not read may act itself, or scale a law; any other may reach a sensor, or the channel
    of another input, directly. An input whose unit allows it may be a flow that carries signals along. A spring or
    damper of the simulator's own may vary with the time, an input, or a port's own signal, and a damper with the
    position. Other laws are found first, and then let vary (`Search`). Of several sensors at an elastic joint or drive,
    one alone may be on the far side.
    """
    given = {law.__name__ for law in laws}  # in a worker, classes made at run time are others of the same name
    all_laws = given >= {law.__name__ for law in CATALOGUE}
    alone = [UnreadInput] if all_laws else []
    may_scale = [*(law for law in SCALABLE if law in laws), *alone]
    by_input = [scaled(law, by) for law in may_scale for by in simulator.idle_inputs]
    by_input += [scheduled(law, by) for law in alone for by in simulator.idle_inputs]  # with a constant beside it
    by_input += [scaled(Feedthrough, by) for by in simulator.inputs if all_laws and by not in simulator.idle_inputs]
    flows = [name for name in simulator.inputs if may_be_flow(simulator.units.get(name, ""))]
    carrying = [carried(by) for by in flows if all_laws]
    signals = ["t", *simulator.inputs, *sorted({name for port in simulator.ports for name in port.signals})]
    pairs = [(law, by) for law in (LinearStiffness, ViscousDamping) for by in signals] + [(ViscousDamping, "z")]
    varying = [scheduled(law, by, "quadratic") for law, by in pairs if law in laws]
    read = [names for port in simulator.all_ports() if len(names := simulator.readers(port)) > 1]
    sensors = sorted({name for names in read for name in names})
    return (
        *laws,
        *by_input,
        *carrying,
        *varying,
        *(seen_by(law, name) for law in laws if law.sensed for name in sensors),
    )


def check_time_and_focus(time_limit: float | None, focus: str | None) -> None:
    """Refuse a time limit that is not positive, and an unknown focus."""
    if time_limit is not None and not (is_number(time_limit) and time_limit > 0):
        raise InputError(f"time_limit={time_limit!r} was given; give seconds, a positive number.")
    if focus not in (None, "simulation", "prediction"):
        raise InputError(f"focus={focus!r} was given; use 'simulation', 'prediction' or None.")


def check_limits(simulator: Simulator, limits: Mapping[str, float] | None) -> None:
    """Refuse a limit on a name that is not an input, and a limit that is not positive."""
    if limits is not None and not isinstance(limits, Mapping):
        raise InputError(f'limits={limits!r} was given; give amplitudes by input, like {{"force": 2.0}}.')
    for name, most in (limits or {}).items():
        if name not in simulator.inputs:
            own = listed(simulator.inputs) or "none"
            raise InputError(f"A limit was given for {name!r}, which is no input; the simulator has {own}.")
        if not (is_number(most) and most > 0):
            raise InputError(f"The limit of {name} is {most!r}; give the largest amplitude allowed, a positive number.")
