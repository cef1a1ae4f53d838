"""Identify a model from recordings, save it, and use it: `pilfr fit`, `simulate` and `export`."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import numpy as np
import typer

from .._base import (
    Clock,
    InputError,
    Progress,
    csv_text,
    deferred_interrupt,
    in_words,
    listed,
    progress_bar,
    time_limit,
    worker_pool,
    write_atomically,
)
from ..data import (
    COURSES,
    NOTHING_SENTENCE,
    STACK_SUFFIXES,
    Recording,
    column_names,
    explains_nothing,
    name_with_unit,
    nrmse,
    read_stack,
    written_times,
)
from ..engine import VirtualMachine, compiler, make_engine
from ..export import NAMES, Exported, exported
from ..identify import Fit, check_recordings, fit, load, run_simulator
from ..linear import select_order
from ..models import ALL_OPTIONS, PILFR, STRUCTURE_OPTIONS, Lagged, named_structure
from ..optimise import GaussNewton, Ipopt, Status
from ..simulators import load_simulator, unit_notes
from ..studies import LARGEST_SIZE
from ._common import (
    DONE,
    FILE_TYPES,
    INTERRUPTED,
    NO_RESULT,
    DataOptions,
    Hold,
    bounds_of,
    check_given_once,
    check_names,
    check_new,
    check_out_folder,
    duration,
    flag,
    initial_state,
    integer,
    numbers_of,
    option,
    print_line,
    print_recordings,
    reserved_file,
    say,
    takes_options,
)

DEFAULT_STARTS = 8
# options of a search, which a saved model replaces
SEARCH = ("nx", "operators", "operator", "channels", "structure", "hidden", "lags", "bound", "fix", "starts", "seed")
STRUCTURE_NAMES = {"bound": "bounds"}  # option: its name in `STRUCTURE_OPTIONS`


@dataclass(frozen=True, kw_only=True)
class FitCommandOptions(DataOptions):
    """The options of `pilfr fit`; options of a search have no default, which shows whether they were given."""

    train: list[str] = typer.Argument(..., metavar="TRAIN", help=f"Training recordings ({FILE_TYPES}).")
    inputs: str = option("Names of the inputs.", "NAME[,NAME]", ...)
    outputs: str = option("Names of the outputs.", "NAME[,NAME]", ...)
    test: list[str] = option("Test recording, never fitted (repeatable).", "FILE", [])
    nx: int | None = integer("States of the linear part (default: chosen on the training data).", 0, LARGEST_SIZE["nx"])
    operators: int | None = integer(
        "Hysteresis operators per channel (default: 20); 0 for a linear model.", 0, LARGEST_SIZE["operators"]
    )
    operator: Literal["play", "stop", "generalized_play"] | None = option("Kind of operator (default: play).")
    channels: int | None = integer("Channels of the element (default: 1).", 1, LARGEST_SIZE["channels"])
    structure: Literal["lfr", "hammerstein", "wiener", "ssnn", "network_lfr", "narx", "noe"] | None = option(
        "Where the element sits (default: lfr), or a network to compare with."
    )
    hidden: int | None = integer("Neurons of a network (default: 15; 10 for narx and noe).", 1, LARGEST_SIZE["hidden"])
    lags: int | None = integer("Number of past outputs and inputs of narx and noe.", 1, LARGEST_SIZE["lags"])
    bound: list[str] = option("Bounds of a parameter (repeatable).", "NAME=LOW:HIGH", [])
    fix: list[str] = option("Hold a block of parameters at a value (repeatable).", "NAME=VALUE", [])
    starts: int | None = integer(f"Starts (default: {DEFAULT_STARTS}).", 1, LARGEST_SIZE["starts"])
    seed: int | None = integer("Seed of all starts (default: 0).", 0, LARGEST_SIZE["seed"])
    start_from: str | None = option("Start from a saved model instead of searching.", "MODEL.json", name="--from")
    solver: Literal["gauss-newton", "ipopt"] = option(
        "Solver of the final problem (default: gauss-newton).", default="gauss-newton"
    )
    workers: int = integer(
        "Number of processes; it does not change the results (default: 1).", 1, LARGEST_SIZE["workers"], 1
    )
    engine: Literal["auto", "c", "vm"] = option(
        "Generated C or CasADi's virtual machine (default: C where there is a compiler).", default="auto"
    )
    time_limit: float | None = duration("Stop after this time and keep the best so far (default: no limit).")
    out: str = option("Folder for model.json and report.html (default: fit).", "DIR", "fit")
    overwrite: bool = flag("Replace an existing model in that folder.", "--overwrite")

    @property
    def search(self) -> list[str]:
        """The options of a search that were given."""
        return [name for name in SEARCH if getattr(self, name) not in (None, [])]


@takes_options
def fit_command(options: FitCommandOptions) -> int:
    """Writes the model to DIR/model.json and the report to DIR/report.html."""
    _check_options(options)
    inputs, outputs = options.names()
    saved = load(options.start_from) if options.start_from else None
    if saved is not None:
        check_names(saved, inputs, outputs)
    train_by_path = options.read_all(options.train, inputs, outputs)
    tests_by_path = options.read_all(options.test, inputs, outputs)
    check_out_folder(options.out)
    print_recordings("training", train_by_path)
    print_recordings("test", tests_by_path)
    train, tests = list(train_by_path.values()), list(tests_by_path.values())
    clock = Clock()
    try:
        with time_limit(options.time_limit, clock), progress_bar() as progress:
            task, result = _identify(options, saved, train, progress)
    except KeyboardInterrupt:
        if clock.expired:
            return say(f"No model was ready within --time-limit {options.time_limit:g}; give more time.", NO_RESULT)
        raise
    if result.status is Status.INTERRUPTED and clock.expired:
        result = replace(result, solution=replace(result.solution, status=Status.TIME_LIMIT))
    with reserved_file(Path(options.out) / "model.json", options.overwrite) as target:
        try:
            _write(result, task, train, tests, target)
        except KeyboardInterrupt:
            return say(f"Interrupted; the model is in {target}, a report was not written.", INTERRUPTED)
    if result.status is Status.INTERRUPTED:
        return INTERRUPTED
    if result.status is Status.INFEASIBLE:
        missed = "; ".join(str(limit) for limit in result.limits if not limit.met)
        return say(f"The model does not meet its constraints: {missed}.", NO_RESULT)
    return say(NOTHING_SENTENCE, NO_RESULT) if explains_nothing(result.train_nrmse) else DONE


def _check_options(options: FitCommandOptions) -> None:
    """Refuse options that exclude each other, and an existing model file."""
    if options.start_from and options.search:
        raise InputError(
            f"--from was given together with {listed([f'--{name}' for name in options.search])}, but its model has its "
            "structure and start already; leave one of them out."
        )
    check_given_once([*options.train, *options.test])
    structure = options.structure or "lfr"
    for name in options.search:
        own = STRUCTURE_NAMES.get(name, name)
        if own in ALL_OPTIONS and own not in STRUCTURE_OPTIONS[structure]:
            raise InputError(f"--{name} is not for --structure {structure}; leave it out.")
    if "lags" in STRUCTURE_OPTIONS[structure] and options.lags is None:
        raise InputError(f"--structure {structure} needs --lags, the number of past outputs; give it.")
    check_new(Path(options.out) / "model.json", options.overwrite)


def _identify(
    options: FitCommandOptions, saved: Fit | None, train: list[Recording], progress: Progress
) -> tuple[Fit | PILFR | Lagged, Fit]:
    """Fit; return the structure or the saved model that was fitted, and the fit."""
    solver = GaussNewton() if options.solver == "gauss-newton" else Ipopt()
    starts = 1 if saved is not None else options.starts or DEFAULT_STARTS
    with worker_pool(min(options.workers, starts)) as pool:
        task = saved if saved is not None else _build_structure(options, train, progress)
        check_recordings(task, train)  # before the engine is compiled
        progress("building the engine", 0, 0, np.nan)
        engine = announce_engine(task, train[0], options.engine)
        search: dict[str, Any] = {}
        if saved is None:
            search = {"starts": starts, "seed": options.seed or 0, "executor": pool}
        result = fit(task, train, solver=solver, engine=engine, progress=progress, **search)
    return task, replace(result, engine=engine)


def _build_structure(options: FitCommandOptions, train: Sequence[Recording], progress: Progress) -> PILFR | Lagged:
    structure = options.structure or "lfr"
    given: dict[str, Any] = {k: getattr(options, k) for k in ("operators", "operator", "channels", "hidden", "lags")}
    if "nx" in STRUCTURE_OPTIONS[structure]:
        nx, how = options.nx, "as given"
        if nx is None:
            choice = select_order(train, range(1, 9), offset=True, progress=progress)
            nx, how = int(choice.recommended), "chosen on the training data"
        print_line(f"order: {nx}, {how}")
        given |= {"nx": nx, "bounds": bounds_of(options.bound), "fix": numbers_of(options.fix, "--fix")}
    return named_structure(structure, **{k: v for k, v in given.items() if v is not None})


def announce_engine(task: PILFR | Lagged | Fit, recording: Recording, choice: str, quiet: bool = False) -> str:
    """Build the engine and announce it; return the choice that builds it again without a warning."""
    if choice == "vm":
        if not quiet:
            print_line("engine: CasADi's virtual machine, as given")
        return choice
    model = task.model if isinstance(task, Fit) else task.model(recording.n_u, recording.n_y)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        engine = make_engine(model, choice)
    if not isinstance(engine, VirtualMachine):
        if not quiet:
            print_line("engine: generated C, compiled")
        return choice
    found = [str(w.message) for w in caught if issubclass(w.category, RuntimeWarning)]
    reason = "no C compiler was found" if compiler() is None else "it could not be built"
    if found:
        reason = found[-1].rpartition(";")[0] or found[-1]
    print_line(f"engine: CasADi's virtual machine, which is slower: {' '.join(reason.split())}")
    return "vm"


def _write(
    result: Fit, task: Fit | PILFR | Lagged, train: list[Recording], tests: list[Recording], target: Path
) -> None:
    """Write the model and the report, and print the errors."""
    with deferred_interrupt():
        result.save(target)
        from ..report import fit_report
    print(result)
    if result.status is Status.MAX_ITERATIONS:
        print(f"To go on from here: --from {target}")
    if isinstance(task, PILFR) and task.element is not None and result.structure != task:
        print("No start was finished: this is the initial linear model.")
    for recording in tests:
        print(describe_test_error(result, recording))
    with progress_bar() as progress:
        progress("writing the report", 0, 0, np.nan)
        page = fit_report(result, train, tests, target.parent)
    print(f"model: {target}\nreport: {page}")


def describe_test_error(result: Fit, recording: Recording) -> str:
    """Describe the error on a test recording, or explain why there is none."""
    try:
        recording = result.matched(recording)
        error, first = result.nrmse(recording), result.scored_from(recording)
    except InputError as reason:
        return f"no NRMSE on {recording.name}: {reason}"
    residual = (result.simulate(recording) - recording.y)[first:]
    share = 100 * np.sqrt(np.mean(residual**2, axis=0)) / np.ptp(recording.y[first:], axis=0)
    text = f"NRMSE on {recording.name}: {error:.4f} (rms error {', '.join(f'{s:.2f}' for s in share)} % of the range)"
    if first > recording.skip:
        text += f"; the first {first} samples estimate the initial state and are not scored"
    return text


@dataclass(frozen=True, kw_only=True)
class SimulateOptions(DataOptions):
    """The options of `pilfr simulate`."""

    model: str = typer.Argument(
        ..., metavar="MODEL", help="A model.json, or a Python file that sets `simulator`, such as corrected.py."
    )
    data: str = typer.Argument(
        ...,
        metavar="DATA",
        help=f"A recording ({FILE_TYPES}), or several in one array (.npz, .npy: samples, channels, ...).",
    )
    out: str = option("CSV file; for several records also .npz or .npy.", "FILE", ...)
    overwrite: bool = flag("Replace an existing file.", "--overwrite")


@dataclass(frozen=True)
class _Simulated:
    """Simulated outputs y (M, n_y) along a recording, with their names and the units of the model's channels."""

    recording: Recording
    y: np.ndarray
    outputs: Sequence[str]
    units: Mapping[str, str]
    columns: dict[str, str]  # of the file, by name
    scored_from: Callable[[Recording], int]


@takes_options
def simulate_command(options: SimulateOptions) -> int:
    """Prints the error of the simulation if the file has the outputs too."""
    _check_out(options)
    if Path(options.model).suffix.lower() == ".py":
        return _simulate_equations(options)
    fitted = load(options.model)
    inputs, outputs = options.names(fitted.model.inputs, fitted.model.outputs)
    data = Path(options.data)
    stack = read_stack(data, inputs, outputs) if data.suffix.lower() in STACK_SUFFIXES else None
    if stack is not None:
        return _simulate_stack(options, fitted, *stack)
    return _simulate_record(options, fitted, inputs, outputs)


def _simulate_record(options: SimulateOptions, fitted: Fit, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> int:
    if Path(options.data).suffix.lower() not in (".mat", ".npz"):  # there, a matrix stands for several names
        check_names(fitted, inputs, outputs)
    recording, columns, measured = _read_to_simulate(options, inputs, outputs)
    check_names(fitted, recording.inputs, recording.outputs if measured else fitted.model.outputs)
    for note in unit_notes(fitted.units, recording, "model").values():
        print(f"note: {note}")
    recording = fitted.matched(recording)
    y = replace(fitted, engine=announce_engine(fitted, recording, "auto", quiet=True)).simulate(recording)
    run = _Simulated(recording, y, fitted.model.outputs, fitted.units, columns, fitted.scored_from)
    return _write_simulated(options, run)


def _simulate_equations(options: SimulateOptions) -> int:
    simulator = load_simulator(options.model)
    if Path(options.data).suffix.lower() == ".npy":
        raise InputError("Only a saved model simulates several records in one array; give one recording.")
    inputs, outputs = options.names(simulator.inputs, simulator.output_names)
    recording, columns, _ = _read_to_simulate(options, inputs, outputs)
    for note in unit_notes(simulator.units, recording).values():
        print(f"note: {note}")
    seen, y, first = run_simulator(simulator, recording)
    run = _Simulated(seen, y, simulator.output_names, simulator.units, columns, lambda _: first)
    return _write_simulated(options, run)


def _read_to_simulate(
    options: SimulateOptions, inputs: tuple[str, ...], outputs: tuple[str, ...]
) -> tuple[Recording, dict[str, str], bool]:
    """Read a recording; return it, its columns by name, and whether it has the outputs."""
    if Path(options.out).suffix.lower() in STACK_SUFFIXES:
        raise InputError(f"--out {options.out} is for several records in one array; give a name that ends in .csv.")
    columns, measured = _columns_to_read(options, inputs, outputs)
    options = replace(
        options,
        initial=options.initial or ("estimate" if measured else "zero"),
        column=[f"{name}={column}" for name, column in columns.items()],
    )
    return options.read(options.data, inputs, outputs if measured else ()), columns, measured


def _write_simulated(options: SimulateOptions, run: _Simulated) -> int:
    """Write the simulated outputs; print their error, or the initial state if none were measured."""
    recording = run.recording
    if not np.all(np.isfinite(run.y)):
        return say(f"The simulation of {options.model} diverges on {options.data}; nothing was written.", NO_RESULT)
    path = _write_out(options, _recording_table(options, run))
    if recording.n_y:
        _print_error(recording, run.y, run.scored_from)
    else:
        state = {"zero": "zero", "periodic": "periodic steady state"}.get(recording.begins, "as given")
        print(f"{options.data} has no outputs ({listed(run.outputs)}) to compare with; initial state: {state}")
        if options.initial is None:
            print("  If the machine begins elsewhere, give each state's value with --initial.")
    print(f"simulated outputs: {path}")
    return DONE


def _check_out(options: SimulateOptions) -> None:
    out = Path(options.out)
    for path, what in ((options.data, "recording"), (options.model, "model")):
        if os.path.realpath(out) == os.path.realpath(path):
            raise InputError(f"--out {options.out} would overwrite the {what}; give another file.")
    if out.suffix.lower() in (".mat", *STACK_SUFFIXES) and Path(options.data).suffix.lower() not in STACK_SUFFIXES:
        raise InputError(f"--out {options.out} is written as CSV; give a name that ends in .csv.")
    _check_writable(out)
    check_new(out, options.overwrite)


def _check_writable(out: Path) -> None:
    """Refuse a file that cannot be written, before any long work."""
    if out.is_dir() or not out.parent.is_dir() or not os.access(out.parent, os.W_OK):
        raise InputError(f"--out {out} cannot be written; give a file in a folder that exists.")


def _write_out(options: SimulateOptions, content: str | bytes) -> Path:
    """Write the simulated outputs; return the path of the file."""
    with reserved_file(Path(options.out), options.overwrite) as target:
        write_atomically(target, content)
    return target


def _columns_to_read(
    options: SimulateOptions, inputs: Sequence[str], outputs: Sequence[str]
) -> tuple[dict[str, str], bool]:
    """Return the columns to read by name, and whether the file has the outputs."""
    columns = options.columns(options.data)
    there = column_names(options.data, [columns.get(name, name) for name in (*inputs, *outputs)])
    if options.outputs or any(name in columns or name in there for name in outputs):
        return columns, True
    _check_initial(options, f"no column {listed(outputs)}")
    return {k: v for k, v in columns.items() if k not in outputs}, False


def _check_initial(options: SimulateOptions, lack: str) -> None:
    if options.initial == "estimate":
        raise InputError(
            f"--initial estimate needs measured outputs, but {options.data} has {lack}; give --initial zero, or "
            "--initial periodic with --period SAMPLES."
        )


def _recording_table(options: SimulateOptions, run: _Simulated) -> str:
    """Write the times as in the file, the inputs, and the simulated outputs as CSV."""
    recording, columns = run.recording, run.columns
    wanted = [columns.get(name, name) for name in (*recording.inputs, *recording.outputs)]
    written = None if options.resample else written_times(options.data, columns, wanted)
    times = written or map(_time_text, recording.t)
    rows = np.column_stack([recording.u, run.y]).tolist()
    lines = [[t.strip(), *row] for t, row in zip(times, rows, strict=True)]
    known = {**recording.units, **run.units}  # of a channel in both, the recording is in the model's unit
    names = [name_with_unit(name, known.get(name, "")) for name in (*recording.inputs, *run.outputs)]
    return csv_text([["t", *names], *lines])


def _time_text(t: float) -> str:
    """Write a time without the digits that come from multiplying the step."""
    return repr(float(f"{t:.12g}"))


def _simulate_stack(options: SimulateOptions, fitted: Fit, u: np.ndarray, y: np.ndarray | None) -> int:
    """Simulate records in arrays (samples, channels, further axes), each from its own initial state."""
    axes, initial = u.shape[2:], options.initial or ("zero" if y is None else "estimate")
    if y is None:
        _check_initial(options, "none")
    if options.dt is None:
        raise InputError(f"{options.data} has no time column; state the step with --dt SECONDS.")
    more: dict[str, Any] = {key: getattr(options, key) for key in ("period", "hold", "skip")}
    found, errors = np.empty((len(u), fitted.model.n_y, *axes)), list[float]()
    for k, index in enumerate(np.ndindex(*axes)):
        at = (slice(None), slice(None), *index)
        measured = np.empty((len(u), 0)) if y is None else y[at]
        name = f"{Path(options.data).stem} {list(index)}"
        outputs = () if y is None else fitted.model.outputs
        inputs = fitted.model.inputs
        record = Recording(u[at], measured, options.dt, inputs, outputs, initial=initial, name=name, **more)
        if k == 0:
            fitted = replace(fitted, engine=announce_engine(fitted, record, "auto", quiet=True))
        found[at] = fitted.simulate(record)
        if not np.all(np.isfinite(found[at])):
            return say(f"The simulation of {options.model} diverges on {name}; nothing was written.", NO_RESULT)
        if y is not None:
            errors += _print_error(record, found[at], fitted.scored_from)
    path = _write_out(options, _stack_content(Path(options.out), u, found, options.dt, fitted))
    if errors:
        print(f"NRMSE, mean over {len(errors)} records: {np.mean(errors):.4f}")
    print(f"simulated outputs: {path}")
    return DONE


def _stack_content(out: Path, u: np.ndarray, y: np.ndarray, dt: float, fitted: Fit) -> bytes:
    """Write `y` as an array like the inputs (.npz, .npy), or as CSV whose first column numbers the records."""
    if out.suffix.lower() in STACK_SUFFIXES:
        buffer = BytesIO()
        if out.suffix.lower() == ".npz":
            np.savez(buffer, y=y, dt=dt)
        else:
            np.save(buffer, y)
        return buffer.getvalue()
    names = [name_with_unit(name, fitted.units.get(name, "")) for name in (*fitted.model.inputs, *fitted.model.outputs)]
    lines: list[list[Any]] = [["record", "t", *names]]
    for record, index in enumerate(np.ndindex(*u.shape[2:])):
        at = (slice(None), slice(None), *index)
        for k, row in enumerate(np.hstack([u[at], y[at]]).tolist()):
            lines.append([record + 1, _time_text(k * dt), *row])
    return csv_text(lines).encode()


def _print_error(recording: Recording, y: np.ndarray, scored_from: Callable[[Recording], int]) -> list[float]:
    """Print the error of simulated outputs, and return it; an empty list if it does not exist."""
    try:
        error = nrmse(recording.y, y, skip=scored_from(recording))
    except InputError as reason:
        print(f"no NRMSE on {recording.name}: {reason}")
        return []
    print(f"NRMSE on {recording.name}: {error:.3g}")
    return [error]


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """The options of `pilfr export`."""

    model: str = typer.Argument(..., metavar="MODEL", help="A model.json, or a Python file that sets `simulator`.")
    out: str = option("Path of the file; with --c the folder of both files.", "FILE", ...)
    casadi: bool = flag("Write a file for casadi.Function.load, and one with its names (default).", "--casadi")
    c: bool = flag("Write C source and header that need no library.", "--c")
    fmu: bool = flag("Write a co-simulation FMU, FILE.fmu, for this platform.", "--fmu")
    fmi: Literal["2.0", "3.0"] | None = option("Version of the FMU (default: 2.0).")
    name: str = option("Name of the function (default: model).", "NAME", "model")
    smooth: float = option("Width of the rounding of min and max (default: 0, exact).", "EPS", 0.0)
    dt: float | None = option("Duration of a step, needed for a simulator.", "SECONDS")
    hold: Hold | None = option("Course of a simulator's inputs between samples.")
    initial: Any = initial_state("State in which it begins: zero (default), or the states' values, such as 20,0.5.")
    overwrite: bool = flag("Replace existing files.", "--overwrite")

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that are written."""
        out = Path(self.out)
        if self.c:
            return out / f"{self.name}.c", out / f"{self.name}.h"
        return (out,) if self.fmu else (out, out.with_name(out.name + NAMES))


@takes_options
def export_command(options: ExportOptions) -> int:
    """The function maps (x, u) to (x_next, y); x includes the memory of the operators."""
    kinds = [f"--{kind}" for kind in ("casadi", "c", "fmu") if getattr(options, kind)]
    if len(kinds) > 1:
        raise InputError(f"{in_words(kinds)} were given; give one of them.")
    if options.fmi and not options.fmu:
        raise InputError("--fmi was given, which is the version of an FMU; give --fmu too, or leave it out.")
    simulated = Path(options.model).suffix.lower() == ".py"
    source: Any = load_simulator(options.model) if simulated else load(options.model)
    for key in ("dt", "hold"):
        if getattr(options, key) is not None and not simulated:
            raise InputError(f"--{key} was given, but a saved model has its own step; leave it out.")
    if simulated and options.dt is None:
        raise InputError("A simulator has no fixed step; give --dt SECONDS.")
    if options.initial in ("estimate", "periodic"):
        raise InputError(
            f"--initial {options.initial} needs a recording; give zero or each state's value, as in --initial 20,0.5."
        )
    start = None if options.initial in (None, "zero") else np.array(options.initial)
    _check_files(options)
    more: dict[str, Any] = {"smooth": options.smooth, "name": options.name}
    step = exported(source, dt=options.dt, hold=options.hold, start=start, **more)
    if options.initial is None and step.states:
        print("note: the exported model begins with every state at zero; give other values with --initial.")
    if COURSES[step.hold].begin:
        print("note: the input of a step acts until the next one; of a log of means, that is the next row.")
    with reserved_file(options.files[0], options.overwrite) as target:
        _write_exported(step, options, target)
    return DONE


def _write_exported(step: Exported, options: ExportOptions, target: Path) -> None:
    """Write the files of an export, of which `target` is the first, and print where they are."""
    if options.c:
        code, header = step.to_c(target.parent)
        print(f"C source: {code}\nheader: {header}")
    elif options.fmu:
        print(f"FMU: {step.to_fmu(target, options.fmi or '2.0')}")
    else:
        step.serialize(target)
        print(f"casadi function: {target}\nnames of its signals: {target}{NAMES}")


def _check_files(options: ExportOptions) -> None:
    """Refuse files that cannot be written, the model itself and, without `--overwrite`, existing files."""
    if not options.c:
        _check_writable(Path(options.out))
    for path in options.files:
        if os.path.realpath(options.model) == os.path.realpath(path):
            raise InputError(f"--out {options.out} would overwrite the model; give another file.")
        check_new(path, options.overwrite)
