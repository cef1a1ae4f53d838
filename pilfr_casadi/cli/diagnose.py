"""Compare a simulator with recordings: `pilfr diagnose` and `pilfr check`.

`diagnose` finds the missing physics, prints the diagnosis and writes it. `check` prints what the recordings can reveal,
and writes check.json if a folder is given.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from .._base import InputError, deferred_interrupt, json_text, listed, progress_bar, write_atomically
from ..data import SAME_STEP, Recording, column_names, is_time
from ..simulators import Simulator, as_simulator
from ..studies import LARGEST_SIZE
from ._common import (
    DONE,
    INTERRUPTED,
    NO_RESULT,
    SimulatorFile,
    SimulatorOptions,
    check_new,
    check_out_folder,
    duration,
    flag,
    integer,
    name_list,
    numbers_of,
    option,
    print_line,
    print_note,
    print_recordings,
    reserved_file,
    say,
    simulator_files,
    takes_options,
)
from .app import name_options

if TYPE_CHECKING:
    from ..diagnose import Diagnosis


LAWS = option("Laws to try, by id (all forms of a law) or by class name (default: the whole catalogue).", "NAME[,NAME]")


@dataclass(frozen=True, kw_only=True)
class DiagnoseOptions(SimulatorOptions):
    """The options of `pilfr diagnose`."""

    files: list[str] = simulator_files("[SIMULATOR] TRAIN")
    simulated: str | None = option("Recorded simulation (inputs and outputs), instead of the simulator file.", "SIM")
    test: list[str] = option("Test recording, never fitted (repeatable).", "FILE", [])
    laws: str | None = LAWS
    effects: int | None = integer("Largest number of effects to look for (default: as many as the data tell).", 1, 100)
    limit: list[str] = option(
        "Largest amplitude of an input in the proposed next experiment (repeatable; default: as recorded).",
        "INPUT=AMPLITUDE",
        [],
    )
    workers: int | None = integer(
        "Number of parallel fits (default: one per processor, at most four).", 1, LARGEST_SIZE["workers"]
    )
    time_limit: float = duration(
        "End the search after about this time, with the best answer so far; loading the simulator and writing the "
        "report come on top (default: 600).",
        600.0,
    )
    focus: Literal["simulation", "prediction"] | None = option(
        "Errors of a free run, or of predictions one sample ahead (default: a free run, if the simulator can)."
    )
    search_samples: int | None = integer(
        "Training samples up to which the search uses all; of more it uses stretches (default: 60000).",
        20,
        LARGEST_SIZE["samples"],
    )
    out: str = option("Folder for diagnosis.json and report.html (default: diagnosis).", "DIR", "diagnosis")
    overwrite: bool = flag("Replace an existing diagnosis in that folder.", "--overwrite")

    @property
    def source(self) -> str | None:
        """The simulator file; None with `--simulated`."""
        return None if self.simulated else self.files[0]

    @property
    def train(self) -> list[str]:
        """The training recordings."""
        return self.files if self.simulated else self.files[1:]

    @property
    def recordings(self) -> list[str]:
        """All recordings: of the simulation, for training, for the test."""
        return [*([self.simulated] if self.simulated else []), *self.train, *self.test]

    def columns(self, path: str) -> dict[str, str]:
        """Return the column of each name in a file; a file may have the name itself as a column instead."""
        columns = super().columns(path)
        if not columns or not self.simulated:
            return columns
        names = {f: column_names(f, list(columns.values())) for f in self.recordings}
        there, anywhere = names[path], {name for found in names.values() for name in found}
        return {n: c for n, c in columns.items() if c in there or n not in there or c not in anywhere}


@takes_options
def diagnose_command(options: DiagnoseOptions) -> int:
    """Writes the answer to DIR/diagnosis.json and the report to DIR/report.html."""
    options.check_files("--simulated SIM.csv")
    laws = _law_names(options.laws)
    check_new(Path(options.out) / "diagnosis.json", options.overwrite)
    given = source = None
    if options.source is None:
        inputs, outputs = _simulated_names(options)
    else:
        source = options.simulator_file()
        given = source.load()
        simulator = as_simulator(given)
        inputs, outputs = simulator.inputs, simulator.output_names
    train = options.read_all(options.train, inputs, outputs)
    tests = options.read_all(options.test, inputs, outputs)
    _check_recordings(train, tests)
    check_out_folder(options.out)
    error, poor = 0.0, ""
    if given is not None:
        simulator = as_simulator(given, list(train.values()))
        name = f"simulator: {options.source}"
    else:
        simulator, error, poor = _surrogate(options, inputs, outputs)
        name = f"surrogate of {options.simulated} (NRMSE {error:.4f})"
    _announce(simulator, name, train, tests)
    if poor:
        print_line(f"note: {poor}")
    with deferred_interrupt():
        from ..diagnose import diagnose
    try:
        with progress_bar() as progress:
            diagnosis = diagnose(
                simulator,
                list(train.values()),
                test=list(tests.values()) or None,
                hold=options.hold,
                laws=laws,
                effects=options.effects,
                limits=numbers_of(options.limit, "--limit"),
                workers=options.workers,
                stand_in_error=error,
                time_limit=options.time_limit,
                focus=options.focus,
                search_samples=options.search_samples,
                progress=progress,
            )
    except KeyboardInterrupt:
        return say("Interrupted before there was a diagnosis; nothing was written.", INTERRUPTED)
    with reserved_file(Path(options.out) / "diagnosis.json", options.overwrite) as target:
        return write_diagnosis(diagnosis, target, source)


def _law_names(text: str | None) -> tuple[str, ...] | None:
    """Return the names given by `--laws`, checked before any file is read; None without the option."""
    if text is None:
        return None
    from ..diagnose import check_laws

    names = name_list(text, "--laws")
    check_laws(names)
    return names


def write_diagnosis(diagnosis: Diagnosis, target: Path, source: SimulatorFile | None = None) -> int:
    """Write diagnosis.json, corrected.py, then the report; print the diagnosis and the paths; return the exit status.

    `target` is the path of diagnosis.json; corrected.py loads and corrects the simulator file `source`, if there is
    one.
    """
    folder = target.parent
    corrected = folder / "corrected.py"
    try:
        with deferred_interrupt():
            diagnosis.save(target)
            print(diagnosis, flush=True)
            from ..report import corrected_file, diagnosis_report

            if source is not None:
                there = Path(os.path.relpath(os.path.realpath(source.path), os.path.realpath(folder))).as_posix()
                text = corrected_file(diagnosis, there, source.loader, source.options, source.bounds)
                write_atomically(corrected, text)
        with progress_bar() as progress:
            progress("writing the report: simulations and pictures", 0, 0, np.nan)
            began = time.perf_counter()
            page = diagnosis_report(diagnosis, folder)
            took = time.perf_counter() - began
    except KeyboardInterrupt:
        return say(f"Interrupted; the diagnosis is in {target}, a report was not written.", INTERRUPTED)
    except (InputError, OSError):
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        return say(f"The diagnosis is in {target}, but a report could not be written ({reason}).", NO_RESULT)
    print(f"writing the report took {took:.0f} s more, which the computing time and --time-limit do not count")
    print(f"diagnosis: {target}\nreport: {page}")
    if source is not None:
        print(f"corrected simulator: {corrected}")
    return INTERRUPTED if diagnosis.interrupted else DONE


def _check_recordings(train: dict[str, Recording], tests: dict[str, Recording]) -> None:
    """Refuse a test on training data, and recordings with different steps."""
    for there, t in tests.items():
        for path, r in train.items():
            if len(r) == len(t) and np.array_equal(r.u, t.u) and np.array_equal(r.y, t.y):
                raise InputError(f"{there} holds the same samples as {path}; a test needs other data.")
    path, first = next(iter(train.items()))
    for other, r in (train | tests).items():
        if abs(r.dt / first.dt - 1) > SAME_STEP:
            raise InputError(
                f"{other} has a step of {r.dt:g} s, {path} a step of {first.dt:g} s; resample one of them."
            )


def _announce(simulator: Simulator, name: str, train: dict[str, Recording], tests: dict[str, Recording]) -> None:
    ports = listed([port.name for port in simulator.all_ports()])
    free = sum(not bool(np.all(p.fixed)) for p in simulator.parameters.values())
    counts = f"{len(simulator.states)} states, {len(simulator.parameters)} parameters ({free} free)"
    print_line(f"{name}, {counts}; ports {ports}")
    print_note(simulator)
    print_recordings("training", train)
    print_recordings("test", tests)


def _surrogate(
    options: DiagnoseOptions, inputs: tuple[str, ...], outputs: tuple[str, ...]
) -> tuple[Simulator, float, str]:
    """Fit a linear model to the simulation; return it, its NRMSE, and a note if the fit is poor."""
    with deferred_interrupt():
        from ..identify import surrogate, surrogate_warning
    assert options.simulated is not None
    with progress_bar() as progress:
        progress("linear model of the simulation", 0, 0, np.nan)
        simulator, error = surrogate(options.read(options.simulated, inputs, outputs))
    return simulator, error, surrogate_warning(error)


def _simulated_names(options: DiagnoseOptions) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the given inputs and outputs, or find them among the columns that the files share."""
    if options.inputs and options.outputs:
        return options.names()
    if options.inputs or options.outputs:
        raise InputError("Only one of --inputs and --outputs was given; give both.")
    files = options.recordings
    first, *others = (_column_names(options, f) for f in files)
    shared = [n for n in first if not is_time(n) and all(n in other for other in others)]
    inputs = tuple(n for n in shared if _same_samples(options, n)) or tuple(n for n in shared if n[:1] in "uU")
    if not inputs and len(shared) == 2:
        inputs = _find_cause(options, shared)
    outputs = tuple(n for n in shared if n not in inputs)
    if not inputs or not outputs:
        raise InputError(
            f"The columns {listed(shared) or '(none)'} that {files[0]} and the recordings share do not tell inputs "
            "from outputs; give --inputs NAMES and --outputs NAMES."
        )
    for note in _report_unshared(files, (first, *others), shared):
        print_line(note)
    print_line(f"inputs {listed(inputs)}, outputs {listed(outputs)}, as found in the files")
    return inputs, outputs


def _column_names(options: DiagnoseOptions, path: str) -> list[str]:
    """Return the columns of a file, by the names that the options give them."""
    names = {column: name for name, column in options.columns(path).items()}
    return [names.get(column, column) for column in column_names(path)]


def _report_unshared(files: Sequence[str], columns: Sequence[Sequence[str]], shared: Sequence[str]) -> Iterator[str]:
    """Note each column that only one file has; refuse if both have some: it may be one column with two names."""
    first, *others = ([n for n in names if not is_time(n) and n not in shared] for names in columns)
    for path, names, own in zip(files[1:], columns[1:], others, strict=True):
        lost = [n for n in first if n not in names]
        if lost and own:
            raise InputError(
                f"{files[0]} has {listed(lost)}, which {path} has not, and {path} has {listed(own)} of its own; say "
                f"which are the same, as in --column {lost[0]}={own[0]}, or which to use, with --inputs and --outputs."
            )
        for extra, there, lacks in ((lost, files[0], path), (own, path, files[0])):
            if extra:
                yield f"note: {listed(extra)} of {there} is left out, because {lacks} has no such column"


def _find_cause(options: DiagnoseOptions, shared: Sequence[str]) -> tuple[str, ...]:
    """Return the column that is the input: a linear model fits only from cause to effect."""
    from ..identify import surrogate

    assert options.simulated is not None
    errors = {}
    for name, other in (shared, shared[::-1]):
        try:
            recording = options.read(options.simulated, (name,), (other,), only_these=True)
            errors[name] = surrogate(recording, nx=4)[1]
        except InputError:
            errors[name] = np.inf
    best = min(shared, key=lambda n: errors[n])
    return (best,) if errors[best] < 0.3 * max(errors.values()) else ()


def _same_samples(options: DiagnoseOptions, name: str) -> bool:
    """Tell whether the simulation has the same samples of a column as one of the recordings."""
    first, *others = (options.read(f, (name,), (), only_these=True).u for f in options.recordings)
    return any(len(o) == len(first) and bool(np.allclose(o, first, rtol=1e-6, atol=0.0)) for o in others)


@dataclass(frozen=True, kw_only=True)
class CheckOptions(SimulatorOptions):
    """The options of `pilfr check`."""

    laws: str | None = LAWS
    out: str | None = option("Folder for check.json (default: nothing is written).", "DIR")
    overwrite: bool = flag("Replace an existing check.json in that folder.", "--overwrite")


@takes_options
def check_command(options: CheckOptions) -> int:
    """Refits only the simulator itself; with --out, the answer is in DIR/check.json."""
    options.check_files()
    laws = _law_names(options.laws)
    if options.out is not None:
        check_new(Path(options.out) / "check.json", options.overwrite)
    given = options.simulator_file().load()
    simulator = as_simulator(given)
    recordings = options.read_all(options.train, simulator.inputs, simulator.output_names)
    if options.out is not None:
        check_out_folder(options.out)
    print_note(simulator)
    print_recordings("training", recordings)
    with deferred_interrupt():
        from ..diagnose import check
    train = list(recordings.values())
    found = check(as_simulator(given, train), train, hold=options.hold, laws=laws)
    print(name_options(str(found)))
    if options.out is not None:
        with reserved_file(Path(options.out) / "check.json", options.overwrite) as target:
            write_atomically(target, json_text(found.to_dict()))
        print(f"check: {target}")
    return DONE
