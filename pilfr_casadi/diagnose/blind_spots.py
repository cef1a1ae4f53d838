"""Find blind spots of recordings and sensors: facts that they cannot reveal, without fitting a law (`pilfr check`).

The simulator's own parameters are refitted once. `identifiability` then tells which parameters are identifiable,
`detectability` which laws are detectable at which ports, and `excitation` counts reversals and amplitudes of the
motion. A parameter or law that is not identifiable or detectable is a blind spot, and so is a motion without reversals.
The gravest blind spot that another recording can remove decides what to record next.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from .._base import capitalise, in_words, multiple, one_blas_thread, percent, to_json
from ..data import COURSES, HOLD_CHOICES, Recording, as_recordings, moves_freely
from ..laws import LINEAR, Law, display_name
from ..simulators import ACTUATOR, SENSOR, UNKNOWN, in_series, kind_of, port_name, split_port
from .arguments import check_laws, match_recordings
from .detectability import SMALL_SHARE, LawRow, assess_laws, group_alike
from .excitation import Excitation, excitations, single_frequency
from .faults.channels import correct_gross_channel_errors, refit_corrected
from .faults.gates import USELESS_FIT, Checked, Gate
from .faults.offsets import WrongStart, find_wrong_start
from .faults.samples import find_held_outputs
from .fits.floor import ABOVE_NOISE, SENSOR_RESOLUTION, Floor
from .fits.linearise import linearise_runs
from .fits.workbench import QUICK, Fitted, Workbench
from .identifiability import ParameterRow, Sensitivity, Tie, assess_parameters, helpful_sensors
from .preparation import choose_hold, conversions

IDENTIFIABLE = {  # by status: the word in the table, and the sentence of the blind spot
    "identifiable": ("yes", ""),
    "dead": ("no: dead, no output reacts", "No output reacts to {}."),
    "flat": ("no: flat within its bounds", "These recordings say less about {} than the bounds do."),
    "start": (
        "no: traded off with the unknown start",
        "{} cannot be distinguished from the unknown initial state; state it if you know it, such as initial='zero'.",
    ),
    "tied": ("no: traded off, see above", ""),
    "port": ("only with a law at its port", ""),
}
MOTION = {  # by kind of blind spot: the record that removes it
    "no-reversal": "A slow triangle of {} with reversals, at two amplitudes.",
    "one-amplitude": "A second amplitude of {}, such as half of it.",
}
GRAVEST = ("rough", "constant-input", "one-frequency")  # kinds of blind spots that stand before all others
# by kind of initial state: its name in the printed result
START_WORDS = {"zero": "at zero", "estimate": "estimated", "periodic": "periodic", "given": "as given"}
# by source of the noise floor: its name in the printed result
SOURCES = {
    "periods": "from the periods",
    "repeats": "from repeated recordings",
    "estimated": "from the refit's residual",
}


@dataclass(frozen=True)
class BlindSpot:
    """A fact that the recordings cannot reveal, or a fault of theirs: its kind, the names concerned, and a sentence."""

    kind: str
    names: tuple[str, ...]
    sentence: str


@dataclass(frozen=True, eq=False)
class Check:
    """Answer of `check`: which parameters and missing laws the recordings can reveal.

    Attributes
    ----------
    blind_spots : tuple of BlindSpot
        Facts that the recordings cannot reveal, the gravest first.
    parameters, ties : tuple of ParameterRow, tuple of Tie
        Refitted free parameters, and groups of parameters that trade off.
    laws : tuple of LawRow
        Every law at every port, with the strength from which it is detectable.
    classes : tuple of tuple of (port, law)
        Groups of laws that look the same.
    excitation : tuple of Excitation
        Motion at each port.
    noise : dict
        `source`; `deviation` and its `share` of the output's deviation, both by output.
    error : float
        NRMSE of the refitted simulator.
    rough : bool
        Whether the simulated motion is not the machine's, so that nothing that follows from it is exact. All recordings
        are judged together, because in a quiet one among loud ones the relative error says little.
    hold, starts : str, tuple of str
        Stated course of the inputs between samples ("" if not stated), and the start of each recording.
    hold_taken : str
        The course with which the simulator was refitted: the stated one, or the one that fits better. "" without
        inputs.
    switches : tuple of str
        Inputs that are only ever on or off: zero or one other value.
    idle_inputs : tuple of str
        Inputs that the simulator's equations do not read.
    unknown_domains : tuple of str
        Declared ports whose units do not tell the physical domain, so that laws of all domains are tried there.
    conversions : tuple of str
        Sentences on channels that are recorded in another unit than the simulator's.
    next_record : str
        The recording that would help most.
    seconds : float
    """

    blind_spots: tuple[BlindSpot, ...]
    parameters: tuple[ParameterRow, ...]
    ties: tuple[Tie, ...]
    laws: tuple[LawRow, ...]
    classes: tuple[tuple[tuple[str, str], ...], ...]
    excitation: tuple[Excitation, ...]
    noise: dict[str, Any]
    error: float
    rough: bool
    hold: str
    starts: tuple[str, ...]
    hold_taken: str = "zero"
    idle_inputs: tuple[str, ...] = ()
    unknown_domains: tuple[str, ...] = ()
    switches: tuple[str, ...] = ()
    conversions: tuple[str, ...] = ()
    next_record: str = ""
    seconds: float = 0.0

    @property
    def detectable(self) -> tuple[LawRow, ...]:
        """Laws that are detectable."""
        return tuple(r for r in self.laws if r.status == "detectable")

    def to_dict(self) -> dict[str, Any]:
        """Return the content of check.json; numbers that are not finite are None."""
        out: dict[str, Any] = {"schema": 1, **asdict(self), "hold": self.hold or None}
        del out["seconds"]
        for row, tie in zip(out["ties"], self.ties, strict=True):
            row["sentence"] = tie.sentence
        for row in out["laws"]:
            row["strength"] = dict(zip(("name", "value", "unit"), row["strength"] or (), strict=False)) or None
        out["classes"] = [[{"port": port, "law": law} for port, law in group] for group in self.classes]
        clean: dict[str, Any] = to_json(out)
        return clean

    def __str__(self) -> str:
        lines = [*self._error_lines(), ""]
        # near wrong values, finding none says little
        near = " near the refitted values, which what is missing may distort" * (self._times_of_noise > ABOVE_NOISE)
        lines += ["Blind spots of these recordings:" if self.blind_spots else f"No blind spot was found{near}."]
        lines += [f"- {b.sentence}" for b in self.blind_spots]
        lines += ["", *self._parameter_lines(), "", *self._law_lines()]
        if groups := [] if self.rough else list(self._group_lines()):
            lines += ["", "Laws that look the same, one group a line:", *groups]
        lines += ["", *self._excitation_lines(), "", *self._circumstances(), f"next record: {self.next_record}"]
        return "\n".join([*lines, f"computed in {self.seconds:.1f} s"])

    @property
    def _times_of_noise(self) -> float:
        return self.error / max(float(np.mean(list(self.noise["share"].values()))), 1e-300)

    def _error_lines(self) -> Iterator[str]:
        """State the error of the refitted simulator, and what follows if it is above the noise."""
        times = multiple(self._times_of_noise)
        yield f"refitted: error {percent(self.error)} of the outputs' deviation, {times} times the noise"
        if self._times_of_noise > ABOVE_NOISE:
            yield "  Something is missing, or the noise is slow. What is missing may distort the refitted values;"
            yield "  standard errors and detectable strengths count the noise alone."

    def _parameter_lines(self) -> Iterator[str]:
        if not self.parameters:
            yield "The simulator has no free parameter."
            return
        rows = []
        for p in self.parameters:
            std = "-" if p.std is None or p.at_bound else f"{p.std:.2g} {p.unit}"
            answer = IDENTIFIABLE[p.status][0] + ", at its bound" * p.at_bound
            rows.append((p.name, f"{p.value:.4g} {p.unit}", std, answer))
        yield from _table(("parameter", "refitted", "std. error (noise only)", "identifiable"), rows)

    def _label(self, port: str) -> str:
        """Join the names of all ports that look the same as this one."""
        groups = (b.names for b in self.blind_spots if b.kind == "alike-ports")
        return " = ".join(next((names for names in groups if port in names), (port,)))

    def _law_lines(self) -> Iterator[str]:
        if self.rough:
            yield "Which laws are detectable is not listed: the simulated motion is not the machine's."
            return
        rows = []
        shown: dict[str, str] = {}
        for r in self.laws:
            shown.setdefault(self._label(r.port), r.port)
        for label, port in shown.items():
            for r in sorted((r for r in self.detectable if r.port == port), key=lambda r: r.share or 0.0):
                share = "" if r.share is None else f"{100 * r.share:.2g} %"
                strength = "{} = {:.2g} {}".format(*r.strength).rstrip() if r.strength else ""
                rows.append((label, display_name(r.law, r.form), f"{r.force:.2g} {r.unit}".rstrip(), share, strength))
            hidden = [r for r in self.laws if r.port == port and r.status != "detectable"]
            rows += [(label, display_name(r.law, r.form), f"no: {_why(r)}", "", "") for r in sorted(hidden, key=_why)]
        columns = ("port", "law", "detectable from (rms)", "share", "strength")
        yield from _table(columns, rows) if rows else ["No law is detectable at any port."]

    def _group_lines(self) -> Iterator[str]:
        """List groups of laws that look the same, except at ports that all look the same."""
        for group in self.classes:
            names = dict.fromkeys(f"{display_name(law)} at {self._label(port)}" for port, law in group)
            if len(names) > 1:
                yield f"- {', '.join(names)}"

    def _excitation_lines(self) -> Iterator[str]:
        rows = [
            (e.port, f"{e.travel:.3g} {e.unit}", str(e.reversals), str(e.amplitudes), str(e.rests))
            for e in self.excitation
        ]
        yield from _table(("simulated coordinate", "travel", "reversals", "amplitudes", "rests"), rows)

    def _circumstances(self) -> Iterator[str]:
        units = {e.port: e.unit for e in self.excitation}
        each = ((f"{name} {value:.2g}", port_name(SENSOR, name)) for name, value in self.noise["deviation"].items())
        noise = ", ".join(f"{text} {units.get(port, '')}".rstrip() for text, port in each)
        yield f"noise ({self.noise['source']}): {noise}"
        if self.hold_taken:
            taken = COURSES[self.hold_taken].words
            unsaid = f"not stated, here taken as {taken}; state hold={HOLD_CHOICES} if you know"
            yield f"inputs between samples: {taken if self.hold else unsaid}"
        yield f"start of each recording: {', '.join(self.starts)}"
        if self.unknown_domains:
            where = in_words(self.unknown_domains)
            yield (
                f"physical domain unknown at {where}, so laws of all domains are tried: state the units, as in "
                "Port(unit='W', across_unit='K'); of an FMU, as in --port wall=loss[W]:temperature[K]"
            )
        if self.idle_inputs:
            idle = in_words(self.idle_inputs)
            yield f"inputs that the equations do not read: {idle}; a diagnosis tries their effects"
        yield from (f"units: {sentence}" for sentence in self.conversions)


def _why(r: LawRow) -> str:
    """Say why a law is not detectable."""
    return {"followed": f"{r.why} can imitate it", "weak": "below the noise", "no data": r.why}[r.status]


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Align rows of text in columns."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    for row in (head, *rows):
        yield "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()


@one_blas_thread
def check(
    simulator: Any,
    train: Recording | Sequence[Recording],
    hold: str | None = None,
    laws: Sequence[type[Law] | str] | None = None,
    engine: str = "auto",
) -> Check:
    """Find what recordings can reveal about a simulator and its missing physics, without fitting a law.

    Parameters
    ----------
    simulator : Simulator, control.StateSpace, or a fitted PI-LFR
        The simulator, with nominal parameters, bounds and ports.
    train : Recording or sequence of Recording
        The recordings that are to be diagnosed.
    hold : {"zero", "linear", "band-limited", "next"}, optional
        Course of the inputs between samples for recordings that do not state it; by default the simulator's, or else
        the one with which the refitted simulator follows better.
    laws : sequence of Law classes or names, optional
        Names are as in `diagnose`. By default the plainest form of each law of the catalogue.
    engine : {"auto", "c", "vm"}
        Generated C or CasADi's virtual machine; by default C where there is a compiler.

    Returns
    -------
    Check

    Raises
    ------
    InputError
        If simulator and recordings do not fit each other, or the simulation diverges or runs away from them.
    """
    given = as_recordings(train)
    simulator, recordings, stated = match_recordings(simulator, given, hold)
    wanted = None if laws is None else check_laws(laws)
    now = _refit(Workbench.of(simulator, recordings, stated or "zero", engine), hold_stated=stated is not None)
    found = assess_recordings(now.bench, now.fitted, now.floor, stated or "", wanted)
    found = replace(found, conversions=tuple(note.sentence for note in conversions(simulator, given)))
    slow = find_held_outputs(recordings)
    return _with_faults(found, now.gates, slow, recordings) if now.gates or slow else found


def _refit(bench: Workbench, hold_stated: bool) -> Checked:
    """Refit with channels and start corrected if they are wrong, and with the better hold unless it is stated."""
    now = correct_gross_channel_errors(bench)
    if now is not None and now.gates:
        now = refit_corrected(now)
    elif now is None or not np.isfinite(now.cost):
        now = Checked(bench, bench.fit(bench.simulator))
    if not hold_stated:
        now = choose_hold(now, QUICK)[0]
    now = find_wrong_start(now)
    now.bench.interrupt.raise_pending()  # half a fit would tell wrong things
    now.bench.check_followed(now.fitted)
    return now


def _with_faults(found: Check, faults: Sequence[Gate], slow: Sequence[Gate], recordings: Sequence[Recording]) -> Check:
    """Put faults and held outputs of the recordings before the blind spots, and the advice to correct them first."""
    spots = [
        BlindSpot("recording-fault", (f.channel,), f.sentence + " Below, it is corrected." * f.corrected)
        for f in (*faults, *slow)
    ]
    wired = [f.channel for f in faults if not isinstance(f, WrongStart)]
    advice = [f"Correct the recordings first: check wiring, sign and unit of {in_words(wired)}."] if wired else []
    if len(wired) < len(faults):
        advice.append("State how the recordings begin: give each state's value, or leave the start unknown.")
    if slow:
        advice.append(f"Leave the repeated values of {in_words([f.channel for f in slow])} out first.")
    estimated = any(isinstance(f, WrongStart) and f.corrected for f in faults)
    starts = tuple(START_WORDS[r.begins] + ", here estimated" * estimated for r in recordings)
    return replace(found, blind_spots=(*spots, *found.blind_spots), next_record=" ".join(advice), starts=starts)


def assess_recordings(
    bench: Workbench, fitted: Fitted, floor: Floor, stated: str, laws: Sequence[type[Law]] | None = None
) -> Check:
    """Assess the recordings of a bench along a refitted run; `stated` is the stated hold, "" if none was stated."""
    began, inputs, outputs = time.perf_counter(), bench.simulator.inputs, bench.simulator.output_names
    noise = np.maximum(floor.deviation, SENSOR_RESOLUTION * bench.scale)
    probe, runs = linearise_runs(bench, fitted)
    quiet = replace(bench, scale=noise, noise2=None)  # from here on, the noise is the unit of all outputs
    response = Sensitivity.of(quiet, fitted, runs)
    parameters, ties = assess_parameters(response)
    rows, classes = assess_laws(quiet, fitted, probe, runs, laws, response.names)
    found = Check(
        blind_spots=(),
        parameters=parameters,
        ties=ties,
        laws=rows,
        classes=classes,
        excitation=tuple(excitations(quiet, probe, runs)),
        noise={
            "source": SOURCES[floor.source],
            "deviation": dict(zip(outputs, noise.tolist(), strict=True)),
            "share": dict(zip(outputs, (noise / bench.scale).tolist(), strict=True)),
        },
        error=bench.nrmse(fitted),
        rough=bool(np.mean(fitted.squares) > USELESS_FIT),
        hold=stated if inputs else "",
        hold_taken=bench.hold if inputs else "",
        idle_inputs=bench.simulator.idle_inputs,
        unknown_domains=tuple(p.name for p in bench.simulator.ports if not p.series and p.domain == UNKNOWN),
        starts=tuple(START_WORDS[r.begins] for r in bench.recordings),
        switches=tuple(name for i, name in enumerate(inputs) if _is_switch([r.u[:, i] for r in bench.recordings])),
    )
    swings = np.ptp(bench.stacked_inputs, axis=0)
    still = [name for name, swing in zip(inputs, swings, strict=True) if not swing > 0]
    spots = [
        *_find_blind_spots(found, still, _alive_as_given(quiet, fitted, parameters)),
        *_single_frequencies(inputs, bench.recordings),
        *_free_motions(bench.recordings),
    ]
    spots.sort(key=lambda spot: GRAVEST.index(spot.kind) if spot.kind in GRAVEST else len(GRAVEST))
    found = replace(found, blind_spots=tuple(spots))
    sensors = helpful_sensors(response, runs) if ties else ()
    return replace(found, next_record=_next_record(found, inputs, sensors), seconds=time.perf_counter() - began)


def _is_switch(runs: Sequence[np.ndarray]) -> bool:
    """Tell whether an input is switched on and off; a single step, or two values besides zero, may be of any size."""
    values = np.unique(np.concatenate(runs))
    return len(values) == 2 and 0.0 in values and any(np.count_nonzero(np.diff(u)) > 1 for u in runs)


def _alive_as_given(bench: Workbench, fitted: Fitted, parameters: Sequence[ParameterRow]) -> tuple[str, ...]:
    """Find parameters that are dead or flat after the refit but move the outputs at the given values."""
    doubtful = [p.name for p in parameters if p.status in ("dead", "flat")]
    if not doubtful:
        return ()
    values = {k: p.value for k, p in fitted.model.parameters.items()}
    given = bench.rerun(fitted, values)
    if not np.isfinite(given.cost):
        return ()
    response = Sensitivity.of(bench, given, linearise_runs(bench, given)[1])
    reach = dict(zip(response.names, response.reach, strict=True))
    return tuple(name for name in doubtful if reach[name] >= 1)


def _find_blind_spots(found: Check, still: Sequence[str], alive: Sequence[str]) -> Iterator[BlindSpot]:
    """Describe everything that the recordings cannot reveal, the gravest first.

    To add a blind spot, yield it here at its rank; its remedy goes into `MOTION` or `_next_record`.
    `still` are inputs that never change; `alive` are dead or flat parameters that move the outputs at the given values.
    """

    def spot(kind: str, names: Sequence[str], sentence: str) -> Iterator[BlindSpot]:
        if names:
            yield BlindSpot(kind, tuple(names), sentence.format(in_words(names)))

    if found.rough:
        left = f"{percent(found.error)} of the outputs' deviation"
        yield BlindSpot("rough", (), f"The refitted simulator leaves {left}: blind spots are known roughly.")
    yield from spot("constant-input", still, "Constant in all recordings: {}.")
    if not found.parameters:
        text = "The simulator has no free parameter, so a wrong value and a missing law look alike."
        yield BlindSpot("no-free-parameter", (), text)
    for status, (_, sentence) in IDENTIFIABLE.items():
        names = [p.name for p in found.parameters if sentence and p.status == status]
        own = in_words([name for name in names if name in alive])
        more = f" At the given values, before the refit, the outputs do react to {own}." if own else ""
        yield from spot(status, names, sentence + more)
    for tie in found.ties:
        yield BlindSpot("tied", tie.names, tie.sentence)
    known = [e for e in found.excitation if not found.rough or kind_of(e.port) == ACTUATOR]
    moving = [e for e in known if split_port(e.port)[1] not in still]
    yield from spot("no-motion", [e.port for e in moving if e.travel == 0], "Nothing moves at {}.")
    text = "No reversal at {}: hysteresis and friction look like stiffness and damping there."
    yield from spot("no-reversal", [e.port for e in moving if e.travel > 0 and e.reversals == 0], text)
    text = "A single amplitude at {}: hysteresis looks like damping and stiffness there."
    switched = {port_name(ACTUATOR, name) for name in found.switches}
    single = [e.port for e in moving if e.reversals and e.amplitudes == 1 and e.port not in switched]
    yield from spot("one-amplitude", single, text)
    ports, seen = (dict.fromkeys(r.port for r in rows) for rows in (found.laws, found.detectable))
    dark = [port for port in ports if port not in seen]
    yield from spot("hidden-port", dark, "No law of the catalogue is detectable at {}.")
    for port in ports:
        yield from _followed_laws(found, port)
    for group in () if found.rough else _alike_ports(found):
        yield from spot("alike-ports", group, "A law looks the same at {}.")


def _single_frequencies(inputs: Sequence[str], recordings: Sequence[Recording]) -> Iterator[BlindSpot]:
    """Find inputs that are one sine in all recordings."""
    for i, name in enumerate(inputs):
        if f := single_frequency([r.u[:, i] for r in recordings], recordings[0].dt):
            text = f"{name} has a single frequency, {f:.3g} Hz: a delay, a lag and a resonance look alike there."
            yield BlindSpot("one-frequency", (name,), text)


def _free_motions(recordings: Sequence[Recording]) -> Iterator[BlindSpot]:
    """Find out whether the start alone moves the recordings, and all of them have the same travel."""
    if not moves_freely(recordings):
        return
    travels = np.array([np.ptp(r.y[r.skip :], axis=0) for r in recordings])
    if np.all(np.ptp(travels, axis=0) <= SMALL_SHARE * np.max(travels, axis=0)):
        text = "No input changes and there is one start: an effect of the amplitude may look like an effect of time."
        yield BlindSpot("one-path", (), text)


def _followed_laws(found: Check, port: str) -> Iterator[BlindSpot]:
    """Find the laws of a port that the simulator's own parameters imitate, grouped by parameter."""
    followed = [r for r in found.laws if r.port == port and r.status == "followed" and r.law not in LINEAR]
    for why in dict.fromkeys(r.why for r in followed):
        rows = [r for r in followed if r.why == why]
        what = _describe_change(why) if any(why == p.name for p in found.parameters) else why
        names = in_words([display_name(r.law, r.form) for r in rows])
        text = f"{capitalise(names)} at {port} cannot be distinguished from {what}."
        yield BlindSpot("followed", (port, *dict.fromkeys(r.law for r in rows)), text)


def _alike_ports(found: Check) -> list[list[str]]:
    """Find groups of ports at which all commonly detectable laws look the same."""
    laws: dict[str, set[str]] = {}
    for r in found.detectable:
        laws.setdefault(r.port, set()).add(r.law)
    same = {(one, other) for group in found.classes for one in group for other in group}

    def alike(one: str, other: str) -> bool:
        shared = laws[one] & laws[other]
        return bool(shared) and all(((one, law), (other, law)) in same for law in shared)

    return [group for group in group_alike(laws, alike) if len(group) > 1]


def _next_record(found: Check, inputs: Sequence[str], sensors: Sequence[str]) -> str:
    """Say what to record next, from the gravest blind spot that a recording can remove."""
    names = {b.kind: b.names for b in reversed(found.blind_spots)}
    if "rough" in names:
        return (
            "None yet: either values, units, the start or the hold are wrong, so check its values and units, or large "
            "physics is missing, which `pilfr diagnose` finds out from these recordings."
        )
    still = names.get("constant-input", ())
    varied = f"One in which {in_words(still)} {'varies' if len(still) == 1 else 'vary'}"
    if "one-path" in names:
        begin = f"{varied}, or one" if still else "One"
        return f"{begin} from another start, such as half of it: each amplitude then has another time."
    if still:
        return f"{varied}."
    if single := names.get("one-frequency"):
        return f"One with several frequencies and amplitudes of {in_words(single)}, such as a multisine."
    graded = [name for name in inputs if name not in found.switches]  # a switch has no other amplitude
    drive = next(iter([*graded, *inputs]), "the input")
    signals = [port for kind in MOTION for port in names.get(kind, ()) if kind_of(port) == ACTUATOR]
    own = split_port(signals[0])[1] if signals else drive
    for inside, signal in ((True, drive), (False, own)):  # forces inside first, then the signals
        for kind, sentence in MOTION.items():
            if graded and any(in_series(port) != inside for port in names.get(kind, ())):
                return sentence.format(signal)
    if sensors:
        tied = in_words([n for t in found.ties for n in t.names])
        return f"One with another sensor, such as one of {sensors[0]}, to separate {tied}."
    if hidden := (*names.get("hidden-port", ()), *names.get("dead", ())):
        return f"One with another sensor, which reacts to {in_words(hidden)}."
    if group := names.get("alike-ports"):
        forces = [port for port in group if not in_series(port)]
        sensor = f"One with another sensor between {in_words(group)}."
        return f"One that also measures the force at {forces[0]}." if forces else sensor
    if "flat" in names or "followed" in names:
        return f"A longer one, {f'with other amplitudes and rates of {drive}' if inputs else 'from another start'}."
    if "start" in names:
        return "One that begins at rest, with initial='zero'." if inputs else "One whose start you know and state."
    if found.ties:
        return f"No further record of these signals helps: measure {found.ties[0].names[0]} separately and fix it."
    if bounded := [p.name for p in found.parameters if p.at_bound]:
        where = "a bound" if len(bounded) == 1 else "bounds"
        return (
            f"None yet: {in_words(bounded)} came out at {where}, so that values or bounds are wrong, or physics is "
            "missing, which `pilfr diagnose` finds out from these recordings."
        )
    return "These recordings tell most things. For the test, take amplitudes that the training recordings do not have."


def _describe_change(parameter: str) -> str:
    """Describe a change of a parameter, or of the constant that a check has added at a channel."""
    port, _, name = parameter.rpartition(".")
    return f"an offset of {port.partition(':')[2]}" if name == "w_0" and ":" in port else f"a change of {parameter}"
