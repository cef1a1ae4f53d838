"""`pilfr simulate` and `pilfr export`: what can be done with a saved model."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import numpy as np
import typer

from .._base import InputError, listed, write_atomically
from ..data import Recording, column_names, nrmse, read_stack, written_times
from ..export import NAMES, exported
from ..identify import Fit, load
from ..simulators import load_simulator
from ._common import DONE, NO_RESULT, DataOptions, check_names, flag, option, pairs, say, takes_options
from .fit import announced_engine

ARRAYS = (".npz", ".npy")


@dataclass(frozen=True, kw_only=True)
class SimulateOptions(DataOptions):
    """The options of `pilfr simulate`."""

    model: str = typer.Argument(..., help="A saved model, model.json.")
    data: str = typer.Argument(
        ..., help="A recording (.csv, .mat, .npz), or several in one array (.npz, .npy: samples, channels, ...)."
    )
    out: str = option("CSV file; of several records also .npz or .npy.", "FILE", ...)


@takes_options
def simulate_command(options: SimulateOptions) -> int:
    """Where the file has the outputs too, the error of the simulation is printed."""
    _check_out(options)
    fitted = load(options.model)
    inputs, outputs = options.names(fitted.model.inputs, fitted.model.outputs)
    kind = Path(options.data).suffix.lower()
    if kind in ARRAYS:
        stack = read_stack(Path(options.data), inputs, outputs)
        if stack is not None:
            return _simulate_stack(options, fitted, *stack)
    if Path(options.out).suffix.lower() in ARRAYS:
        raise InputError(f"--out {options.out} is for several records in one array; give a name that ends in .csv.")
    if kind not in (".mat", ".npz"):  # there, a matrix stands for several names
        check_names(fitted, inputs, outputs)
    columns, measured = _measured(options, inputs, outputs)
    options = replace(
        options,
        initial=options.initial or ("estimate" if measured else "zero"),
        column=[f"{name}={column}" for name, column in columns.items()],
    )
    recording = options.read(options.data, inputs, outputs if measured else ())
    check_names(fitted, recording.inputs, recording.outputs if measured else fitted.model.outputs)
    y = replace(fitted, engine=announced_engine(fitted, recording, "auto", quiet=True)).simulate(recording)
    if not np.all(np.isfinite(y)):
        return say(f"The simulation of {options.model} diverges on {options.data}; nothing was written.", NO_RESULT)
    write_atomically(Path(options.out), _table(options, fitted, recording, y, columns))
    if measured:
        print(_error_line(fitted, recording, y))
    else:
        state = "zero" if options.initial == "zero" else "that of the periodic steady state"
        print(f"{options.data} has no outputs ({listed(outputs)}) to compare with; initial state: {state}")
    print(f"simulated outputs: {options.out}")
    return DONE


def _check_out(options: SimulateOptions) -> None:
    out = Path(options.out)
    for path, what in ((options.data, "recording"), (options.model, "model")):
        if os.path.realpath(out) == os.path.realpath(path):
            raise InputError(f"--out {options.out} would overwrite the {what}; give another file.")
    if out.suffix.lower() in (".mat", *ARRAYS) and Path(options.data).suffix.lower() not in ARRAYS:
        raise InputError(f"--out {options.out} is written as CSV; give a name that ends in .csv.")


def _measured(options: SimulateOptions, inputs: Sequence[str], outputs: Sequence[str]) -> tuple[dict[str, str], bool]:
    """Return the columns to read by name, and whether the file has the outputs."""
    columns = pairs(options.column, "--column")
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


def _table(options: SimulateOptions, fitted: Fit, recording: Recording, y: np.ndarray, columns: dict[str, str]) -> str:
    """Write times (as they were read), inputs and simulated outputs as CSV."""
    times = written_times(options.data, columns) or [repr(float(f"{t:.12g}")) for t in recording.t]
    rows = np.column_stack([recording.u, y]).tolist()
    lines = [",".join([t.strip(), *map(repr, row)]) for t, row in zip(times, rows, strict=True)]
    header = ",".join(["t", *fitted.model.inputs, *fitted.model.outputs])
    return "\n".join([header, *lines]) + "\n"


def _simulate_stack(options: SimulateOptions, fitted: Fit, u: np.ndarray, y: np.ndarray | None) -> int:
    """Simulate records (samples, channels, further axes), one after the other, each from its own initial state."""
    axes, initial = u.shape[2:], options.initial or ("zero" if y is None else "estimate")
    if y is None:
        _check_initial(options, "none")
    if options.dt is None:
        raise InputError(f"{options.data} has no time column; state the step with --dt SECONDS.")
    more: dict[str, Any] = {key: getattr(options, key) for key in ("period", "hold", "skip")}
    found, errors = np.empty((len(u), fitted.model.n_y, *axes)), []
    for number, index in enumerate(np.ndindex(*axes)):
        at = (slice(None), slice(None), *index)
        measured = np.empty((len(u), 0)) if y is None else y[at]
        name = f"{Path(options.data).stem} {list(index)}"
        outputs = () if y is None else fitted.model.outputs
        inputs = fitted.model.inputs
        record = Recording(u[at], measured, options.dt, inputs, outputs, initial=initial, name=name, **more)
        if number == 0:
            fitted = replace(fitted, engine=announced_engine(fitted, record, "auto", quiet=True))
        found[at] = fitted.simulate(record)
        if not np.all(np.isfinite(found[at])):
            return say(f"The simulation of {options.model} diverges on {name}; nothing was written.", NO_RESULT)
        if y is not None:
            print(_error_line(fitted, record, found[at]))
            errors.append(nrmse(record.y, found[at], skip=fitted.scored_from(record)))
    write_atomically(Path(options.out), _stack_content(Path(options.out), u, found, options.dt, fitted))
    if errors:
        print(f"NRMSE, mean over {len(errors)} records: {np.mean(errors):.4f}")
    print(f"simulated outputs: {options.out}")
    return DONE


def _stack_content(out: Path, u: np.ndarray, y: np.ndarray, dt: float, fitted: Fit) -> bytes:
    """Write `y` as an array laid out like the inputs (.npz, .npy), or as CSV whose first column numbers the records."""
    if out.suffix.lower() in ARRAYS:
        buffer = BytesIO()
        if out.suffix.lower() == ".npz":
            np.savez(buffer, y=y, dt=dt)
        else:
            np.save(buffer, y)
        return buffer.getvalue()
    lines = [",".join(["record", "t", *fitted.model.inputs, *fitted.model.outputs])]
    for number, index in enumerate(np.ndindex(*u.shape[2:])):
        at = (slice(None), slice(None), *index)
        for k, row in enumerate(np.hstack([u[at], y[at]]).tolist()):
            lines.append(",".join([str(number + 1), repr(float(f"{k * dt:.12g}")), *map(repr, row)]))
    return ("\n".join(lines) + "\n").encode()


def _error_line(fitted: Fit, recording: Recording, y: np.ndarray) -> str:
    try:
        return f"NRMSE on {recording.name}: {nrmse(recording.y, y, skip=fitted.scored_from(recording)):.4f}"
    except InputError as error:
        return f"no NRMSE on {recording.name}: {error}"


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """The options of `pilfr export`."""

    model: str = typer.Argument(..., help="A model.json, or a Python file that sets `simulator`.")
    out: str = option("The file; with --c the folder for both files.", "FILE", ...)
    casadi: bool = flag("A file for casadi.Function.load, and its names (default).", "--casadi")
    c: bool = flag("C source and header that need no library.", "--c")
    name: str = option("Name of the function (default: model).", default="model")
    smooth: float = option("Round min and max by this much (default: exact).", "EPS", 0.0)
    dt: float | None = option("Step of a simulator, which has none.", "SECONDS")
    hold: Literal["zero", "linear"] | None = option("Course of a simulator's inputs between samples.")


@takes_options
def export_command(options: ExportOptions) -> int:
    """The function maps (x, u) to (x_next, y), with the memory of the operators inside x."""
    if options.casadi and options.c:
        raise InputError("--casadi and --c were given; give one of them.")
    simulated = Path(options.model).suffix.lower() == ".py"
    source: Any = load_simulator(options.model) if simulated else load(options.model)
    for key in ("dt", "hold"):
        if getattr(options, key) is not None and not simulated:
            raise InputError(f"--{key} was given, but a saved model has its own step; leave it out.")
    if simulated and options.dt is None:
        raise InputError("A simulator has no step of its own; give --dt SECONDS.")
    step = exported(source, dt=options.dt, hold=options.hold, smooth=options.smooth, name=options.name)
    out = Path(options.out)
    if options.c:
        code, header = step.to_c(options.out)
        print(f"C source: {code}\nheader: {header}")
        return DONE
    if out.is_dir() or not out.parent.is_dir() or not os.access(out.parent, os.W_OK):
        raise InputError(f"--out {options.out} cannot be written; give a file in a folder that exists.")
    names = out.with_name(out.name + NAMES)
    if os.path.realpath(options.model) in map(os.path.realpath, (out, names)):
        raise InputError(f"--out {options.out} would overwrite the model; give another file.")
    step.serialize(out)
    print(f"casadi function: {options.out}\nnames of its signals: {names}")
    return DONE
