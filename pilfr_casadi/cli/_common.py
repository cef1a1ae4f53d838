"""Shared parts of the commands: exit statuses, types of options, and reading the files that the options name."""

from __future__ import annotations

import contextlib
import inspect
import itertools
import math
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints

import typer

from .._base import InputError, listed
from ..data import Hold

if TYPE_CHECKING:
    from ..data import Recording
    from ..identify import Fit

DONE, NO_RESULT, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
UsageError: type[Exception] = typer.BadParameter.__mro__[1]  # Typer has moved its name between releases
MOST_SAMPLES = 10**9  # of a period, or skipped: 8 GB per channel
FILE_TYPES = ".csv, .mat, .npz, .parquet, .mf4"  # of recordings, for help texts


def say(sentence: str, status: int) -> int:
    """Print a sentence as one line on stderr; return the status."""
    print("pilfr: " + " ".join(sentence.split()), file=sys.stderr)
    return status


def takes_options(function: Callable[[Any], int]) -> Callable[..., int]:
    """Turn a function of a dataclass into a command: every field of the dataclass is an option or an argument."""
    (kind,) = (hint for name, hint in get_type_hints(function).items() if name != "return")
    hints = get_type_hints(kind)

    def command(**given: Any) -> int:
        return function(kind(**given))

    parameters = [
        inspect.Parameter(f.name, inspect.Parameter.KEYWORD_ONLY, default=f.default, annotation=hints[f.name])
        for f in fields(kind)
    ]
    vars(command)["__signature__"] = inspect.Signature(parameters)
    command.__annotations__, command.__doc__, command.__name__ = hints, function.__doc__, function.__name__
    return command


def integer(text: str, least: int, most: int, default: int | None = None, metavar: str = "N") -> Any:
    """Make an option that takes a whole number."""
    wanted = f"a whole number from {least} to {most}"
    return _parsing_option(int, lambda value: least <= value <= most, wanted, default, metavar, text)


def duration(text: str, default: float | None = None) -> Any:
    """Make an option that takes a time above zero."""
    wanted = "a number of seconds above zero"
    return _parsing_option(float, lambda value: 0 < value < math.inf, wanted, default, "SECONDS", text)


def _parsing_option(
    kind: Any, accepts: Callable[[Any], bool], wanted: str, default: Any, metavar: str, text: str
) -> Any:
    """Make an option that converts its text by `kind`, and refuses values that `accepts` does not accept."""

    def parse(given: str) -> Any:
        try:
            value = kind(given)
        except ValueError:
            value = math.nan
        if not accepts(value):
            raise typer.BadParameter(f"{given} was given; give {wanted}.")
        return value

    return typer.Option(default, parser=parse, metavar=metavar, help=text, show_default=False)


def initial_state(text: str) -> Any:
    """Make an option that takes the name of an initial state, or numbers separated by commas."""
    names = ("estimate", "zero", "periodic")
    wanted = "estimate, zero, periodic, or a number for each state, as in 20,0.5"

    def read(given: str) -> Any:
        return given if given in names else tuple(map(float, given.split(",")))

    def accepts(value: Any) -> bool:
        return value in names or (isinstance(value, tuple) and all(map(math.isfinite, value)))

    return _parsing_option(read, accepts, wanted, None, "STATE", text)


def option(text: str, metavar: str | None = None, default: Any = None, name: str | None = None) -> Any:
    """Make an option of any other type; `name` overrides the name of the field."""
    return typer.Option(default, *([name] if name else []), metavar=metavar, help=text, show_default=False)


def flag(text: str, name: str) -> Any:
    """Make an option that takes no value."""
    return option(text, default=False, name=name)


@dataclass(frozen=True, kw_only=True)
class DataOptions:
    """Options to read recordings."""

    inputs: str | None = option("Names of the inputs (default: the model's or simulator's).", "NAME[,NAME]")
    outputs: str | None = option("Names of the outputs (default: the model's or simulator's).", "NAME[,NAME]")
    column: list[str] = option(
        "Column of a name, or of the time t, if it differs (repeatable; of several columns for a name, each file uses "
        "its own).",
        "NAME=COLUMN",
        [],
    )
    initial: Any = initial_state(
        "State at the first sample: estimate, zero (every state is zero), periodic, or the states' values, such as "
        "20,0.5 (default: estimate; zero where no outputs were measured)."
    )
    period: int | None = integer("Samples per period; needs --initial.", 0, MOST_SAMPLES, metavar="SAMPLES")
    hold: Hold | None = option("Course of the inputs between samples.")
    skip: int = integer("Leading samples that are simulated but not scored.", 0, MOST_SAMPLES, 0, "SAMPLES")
    dt: float | None = option("Step, if the file has no time column.", "SECONDS")
    time_tolerance: float | None = option(
        "Largest deviation of samples from a uniform grid (default: 1e-4 steps, beyond rounding).", "STEPS"
    )
    resample: float | None = option("New step, for uneven times or channels of different rates.", "SECONDS")

    def __post_init__(self) -> None:
        if self.period is not None and self.initial is None:
            raise InputError(
                f"--period {self.period} was given without --initial; give --initial periodic for a record in steady "
                "state from its first sample, or --initial estimate for one that settles first."
            )

    def names(self, inputs: Sequence[str] = (), outputs: Sequence[str] = ()) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the names of inputs and outputs from the options, by default the given ones."""
        return (
            tuple(inputs) if self.inputs is None else name_list(self.inputs, "--inputs"),
            tuple(outputs) if self.outputs is None else name_list(self.outputs, "--outputs"),
        )

    def columns(self, path: str) -> dict[str, str]:
        """Return the column of each name in a file; of several columns for a name, choose the one that the file has."""
        given: dict[str, list[str]] = {}
        for text in self.column:
            for name, column in pairs([text], "--column", "COLUMN").items():
                given.setdefault(name, []).append(column)
        if all(len(columns) == 1 for columns in given.values()):
            return {name: columns[0] for name, columns in given.items()}
        from ..data import column_names  # here, so that `pilfr --help` is quick

        there = column_names(path, [column for columns in given.values() for column in columns])
        out = {}
        for name, columns in given.items():
            found = [column for column in dict.fromkeys(columns) if column in there]
            if len(found) > 1:
                raise InputError(f"{path} has {listed(found)}, which --column gives for {name}; leave one of them out.")
            out[name] = found[0] if found else columns[0]
        return out

    def read(self, path: str, inputs: tuple[str, ...], outputs: tuple[str, ...], only_these: bool = False) -> Recording:
        """Read a recording; `only_these` allows `--column` to name other channels too."""
        from ..data import TIME_NAMES, read  # here, so that `pilfr --help` is quick

        columns = self.columns(path)
        if only_these:
            columns = {name: column for name, column in columns.items() if name in (*inputs, *outputs, *TIME_NAMES)}
        more = {key: getattr(self, key) for key in ("period", "hold", "skip", "dt", "time_tolerance", "resample")}
        return read(path, inputs, outputs, columns=columns, initial=self.initial or "estimate", **more)

    def read_all(self, paths: Sequence[str], inputs: tuple[str, ...], outputs: tuple[str, ...]) -> dict[str, Recording]:
        """Read recordings; return them by their paths."""
        return {path: self.read(path, inputs, outputs) for path in paths}


def simulator_files(metavar: str) -> Any:
    """Make the argument that takes a simulator file and recordings."""
    text = (
        "A Python file that sets `simulator` (or a model.json, or an FMU, which is a program that runs), then training "
        f"recordings ({FILE_TYPES})."
    )
    return typer.Argument(..., metavar=metavar, help=text)


@dataclass(frozen=True)
class SimulatorFile:
    """A file with a simulator, and how to load it.

    Attributes
    ----------
    loader : {"load_simulator", "load", "from_fmu", "from_mujoco"}
        Name of the function that loads it.
    options : mapping
        Options of that function.
    bounds : mapping
        Other bounds of parameters of a Python file's simulator.
    """

    path: str
    loader: str
    options: Mapping[str, Any] = field(default_factory=dict)
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def load(self) -> Any:
        """Load the file; a Python file's `simulator` and a saved model are returned as they are but for the bounds."""
        from ..identify import load
        from ..simulators import Simulator, from_fmu, from_mujoco, simulator_variable

        loaders: dict[str, Callable[..., Any]] = {
            "load": load,
            "load_simulator": simulator_variable,
            "from_fmu": from_fmu,
            "from_mujoco": from_mujoco,
        }
        found = loaders[self.loader](self.path, **self.options)
        if self.bounds and not isinstance(found, Simulator):
            fitted = (
                "a fitted model" if self.loader == "load" else f"a {type(found).__name__}, whose numbers have no names"
            )
            raise InputError(f"--bound was given, but {self.path} holds {fitted}; leave it out, or give a Simulator.")
        return found.with_bounds(self.bounds) if self.bounds else found


@dataclass(frozen=True, kw_only=True)
class SimulatorOptions(DataOptions):
    """Options of commands that compare a simulator with recordings."""

    files: list[str] = simulator_files("SIMULATOR TRAIN")
    port: list[str] = option(
        "Port of an FMU by its variables: an input that is a force, a coordinate, its speed (repeatable); with "
        "units, as in wall=loss[W]:temperature[K], where the FMU states none.",
        "NAME=INTO:ACROSS[:RATE]",
        [],
    )
    bound: list[str] = option(
        "Bounds of a parameter, which the refit may then change (repeatable).",
        "NAME=LOW:HIGH",
        [],
    )

    @property
    def source(self) -> str | None:
        """The simulator file; None if a recorded simulation replaces it."""
        return self.files[0]

    @property
    def train(self) -> list[str]:
        """The training recordings."""
        return self.files[1:]

    @property
    def recordings(self) -> list[str]:
        """All recordings."""
        return self.train

    def check_files(self, instead: str = "") -> None:
        """Refuse files in the wrong order, and names of channels, which the simulator file defines.

        `instead` is the option that takes a recorded simulation instead of a simulator file, if there is one.
        """
        from ..data import TABLE_SUFFIXES

        if self.source is not None and Path(self.source).suffix.lower() in TABLE_SUFFIXES:
            then = f"or inputs and outputs of the simulation with {instead}" if instead else "then the recordings"
            raise InputError(f"{self.source} is not a simulator file; give SIMULATOR.py first, {then}.")
        if scripts := [path for path in self.recordings if Path(path).suffix.lower() == ".py"]:
            none = f", and none with {instead}" if instead else ""
            raise InputError(f"{scripts[0]} was given as a recording; give one simulator file, first{none}.")
        if self.source is None and (self.bound or self.port):
            name = "bound" if self.bound else "port"
            raise InputError(f"--{name} was given, which is for a simulator file, not for {instead}; leave it out.")
        if not self.train:
            raise InputError("No training recording was given; give the simulator file and at least one recording.")
        if self.source is not None and (self.inputs or self.outputs):
            where = f"; they go with {instead}" if instead else ""
            raise InputError(
                "--inputs and --outputs were given, but a simulator file has its own names; map columns to them with "
                f"--column NAME=COLUMN{where}."
            )
        check_given_once(self.recordings)

    def simulator_file(self) -> SimulatorFile:
        """Choose how to load the simulator of a Python file, a model.json, an FMU, or a MuJoCo model."""
        path = self.files[0]
        kind = Path(path).suffix.lower()
        if kind == ".fmu":
            return SimulatorFile(path, "from_fmu", self._fmu_options(path))
        if self.port:
            raise InputError(f"--port was given, which is for an FMU; {path} has its own, so leave it out.")
        bounds = bounds_of(self.bound)
        if kind in (".xml", ".urdf"):
            return SimulatorFile(path, "from_mujoco", {"bounds": bounds})
        return SimulatorFile(path, "load" if kind == ".json" else "load_simulator", bounds=bounds)

    def _fmu_options(self, path: str) -> dict[str, Any]:
        """Return the options of `from_fmu`, with the inputs and outputs that the first recording has."""
        from ..data import column_names
        from ..simulators import CoSimulation, fmu_signals, needs_step_size, parse_port

        ports = pairs(self.port, "--port", "INTO:ACROSS")
        bounds = bounds_of(self.bound)
        columns, signals = self.columns(self.train[0]), fmu_signals(path)
        forces = {parse_port(name, text, [*signals[0], *signals[1]])["into"] for name, text in ports.items()}
        wanted = [columns.get(name, name) for names in signals for name in names]
        recorded, kept = set(column_names(self.train[0], wanted)), []
        for role, names in zip(("input", "output"), signals, strict=True):
            kept.append(tuple(name for name in names if columns.get(name, name) in recorded))
            missing = [name for name in names if name not in kept[-1] and name not in forces]
            if missing and kept[-1]:
                print(f"note: {self.train[0]} has no column for the {role}s {listed(missing)} of {path}", flush=True)
            if not kept[-1] and (role == "output" or missing):
                raise InputError(
                    f"{self.train[0]} has no column for any {role} of {path} ({listed(names)}); rename its columns, or "
                    f"say which they are, as in --column {names[0]}=COLUMN."
                )
        inputs, outputs = kept
        options: dict[str, Any] = {"ports": ports, "bounds": bounds, "inputs": inputs, "outputs": outputs}
        if needs_step_size(path):
            options["cosimulation"] = CoSimulation(self.read(self.train[0], inputs, outputs, only_these=True).dt)
        return options


def bounds_of(texts: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Parse each `NAME=LOW:HIGH`; a missing end is infinite."""
    out = {}
    for name, value in pairs(texts, "--bound", "LOW:HIGH").items():
        low, sign, high = value.partition(":")
        given = f"--bound {name}={value}"
        if not sign or value == sign:
            raise InputError(f"{given} was given; write --bound NAME=LOW:HIGH, of which one may be left out.")
        ends = number(low, given) if low else -math.inf, number(high, given) if high else math.inf
        if not ends[0] <= ends[1]:
            raise InputError(
                f"The bounds {value} of {name} are infeasible: the lower one exceeds the upper one; swap them."
            )
        out[name] = ends
    return out


def name_list(text: str, option: str) -> tuple[str, ...]:
    """Split names at commas."""
    names = tuple(part.strip() for part in text.split(",") if part.strip())
    if not names:
        raise InputError(f"{option} {text!r} holds no name; write {option} NAME, or several separated by commas.")
    return names


def pairs(texts: Sequence[str], option: str, value_name: str = "VALUE") -> dict[str, str]:
    """Parse each `NAME=VALUE`."""
    out: dict[str, str] = {}
    for text in texts:
        name, sign, value = text.partition("=")
        if not (name and sign and value):
            raise InputError(f"{option} {text!r} was given; write {option} NAME={value_name}.")
        if name in out:
            raise InputError(f"{option} is given twice for {name}; leave one out.")
        out[name] = value
    return out


def numbers_of(texts: Sequence[str], option: str) -> dict[str, float]:
    """Parse each `NAME=NUMBER`; refuse infinite numbers."""
    found = {name: number(value, f"{option} {name}={value}") for name, value in pairs(texts, option).items()}
    for name, value in found.items():
        if math.isinf(value):
            raise InputError(f"{option} {name}={value} was given; give a finite number.")
    return found


def number(text: str, given: str) -> float:
    """Parse a number, which may be infinite; `given` begins the message if it is not a number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if math.isnan(value):
        raise InputError(f"{given} was given, and {text!r} is not a number; write one like 0.5.")
    return value


def check_given_once(paths: Sequence[str]) -> None:
    """Refuse a file that is given twice."""
    if len({os.path.realpath(path) for path in paths}) < len(paths):
        raise InputError("A file is given twice, as training or test recording; a test needs other data.")


def check_names(fitted: Fit, inputs: Sequence[str], outputs: Sequence[str]) -> None:
    """Refuse names other than the model's, in its order: swapped channels would give a wrong simulation silently."""
    for role, names, own in (("inputs", inputs, fitted.model.inputs), ("outputs", outputs, fitted.model.outputs)):
        if tuple(names) != tuple(own):
            raise InputError(
                f"--{role} {','.join(names)} was given but the model's {role} are {','.join(own)}, in this order; "
                f"use its names and say which column each is, as in --column {own[0]}=COLUMN."
            )


def print_line(line: str) -> None:
    """Print a line at once, also into a pipe."""
    print(line, flush=True)


def print_note(simulator: Any) -> None:
    """Print the note of an imported simulator, if it has one."""
    if note := getattr(simulator.dynamics, "note", ""):
        print_line(f"  {note}")


def print_recordings(kind: str, recordings: Mapping[str, Recording]) -> None:
    """Print a line about each recording, given by the path of its file."""
    for path, r in recordings.items():
        names = f"inputs {', '.join(r.inputs) or 'none'}, outputs {', '.join(r.outputs)}"
        print_line(f"{kind} data: {path}, {len(r)} samples, step {r.dt:.6g} s, {names}")


def check_cluster(dask: str | None, workers: int | None) -> None:
    """Refuse a number of workers for a cluster."""
    if dask and workers is not None:
        raise InputError("--workers and --dask were given; the cluster has its own workers, so leave one of them out.")


@contextlib.contextmanager
def open_cluster(dask: str | None, workers: int) -> Iterator[tuple[Any, int, int]]:
    """Yield an executor or None, its number of workers, and the number of jobs to submit at a time."""
    from ..studies import AHEAD, dask_executor  # here, so that `pilfr --help` is quick

    if not dask:
        yield None, workers, AHEAD
        return
    with dask_executor(dask) as cluster:
        yield cluster


def check_new(target: Path, overwrite: bool) -> None:
    """Refuse an existing file as a result, unless `overwrite` is given."""
    if target.exists() and not overwrite:
        raise InputError(f"{target} exists already; give another --out, or --overwrite to replace it.")


@contextlib.contextmanager
def reserved_file(path: Path, overwrite: bool) -> Iterator[Path]:
    """Make the folder of a result and reserve the file there, so that no other run writes it; yield its path.

    The work is not lost if another run has written the file since it was checked: another folder inside then takes the
    result. Without a result, neither the file nor a new folder is left.
    """
    missing = _missing_folders(path.parent)
    target = make_out_folder(str(path.parent)) / path.name
    for count in itertools.count(2):
        try:
            if not overwrite:
                target.touch(exist_ok=False)
            break
        except FileExistsError:
            inside = path.parent / f"run-{count}"
            missing = [*_missing_folders(inside), *missing]
            target = make_out_folder(str(inside)) / path.name
    if target.parent != path.parent:
        print_line(f"note: another run has written {path} meanwhile; this result is in {target.parent}")
    try:
        yield target
    finally:
        if target.is_file() and not target.stat().st_size:
            target.unlink()
        for folder in missing:
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()


def _missing_folders(folder: Path) -> list[Path]:
    """List the folders on the way to a folder that do not exist, the innermost first."""
    return [part for part in (folder, *folder.parents) if not part.exists()]


def check_out_folder(path: str) -> Path:
    """Check that the folder of the results can be made and written, and leave nothing new behind."""
    folder = Path(path)
    missing = _missing_folders(folder)
    make_out_folder(path)
    for part in missing:
        part.rmdir()
    return folder


def make_out_folder(path: str) -> Path:
    """Make the folder of the results, and check that it is writable, before any long work."""
    if not path:
        raise InputError("--out '' was given; give the name of a folder.")
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"The folder {path} cannot be written ({reason}); give another --out.") from None
    return folder
