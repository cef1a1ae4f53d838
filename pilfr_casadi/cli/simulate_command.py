"""`pilfr simulate`: a saved model on one recording, or on a stack of them in one array."""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np

from .._base import InputError, listed
from ..data import Recording, column_names, nrmse, read_stack, written_times
from ..export import write_atomically
from ..identify import Fit, load
from .app import DONE, NO_RESULT, say
from .commands import announced_engine, check_names, check_period, read_file
from .option_values import name_list, pairs


def run_simulation(options: argparse.Namespace) -> int:
    """Simulate a saved model on a file's inputs; judge it where the file has outputs."""
    check_period(options)
    out = Path(options.out)
    for path, what in ((options.data, "recording"), (options.model, "model")):
        if os.path.realpath(out) == os.path.realpath(path):
            raise InputError(f"--out {options.out} would overwrite the {what}; give another file.")
    kind = Path(options.data).suffix.lower()
    if out.suffix.lower() in (".mat", ".npz", ".npy") and kind not in (".npz", ".npy"):
        raise InputError(f"--out {options.out} is written as CSV; give a name that ends in .csv.")
    fitted = load(options.model)
    inputs = name_list(options.inputs, "--inputs") if options.inputs else fitted.model.inputs
    outputs = name_list(options.outputs, "--outputs") if options.outputs else fitted.model.outputs
    if kind in (".npz", ".npy"):
        stack = read_stack(Path(options.data), inputs, outputs)
        if stack is not None:
            return _simulate_stack(options, fitted, *stack)
    if out.suffix.lower() in (".npz", ".npy"):
        raise InputError(f"--out {options.out} is for several records in one array; give a name that ends in .csv.")
    if kind not in (".mat", ".npz"):  # there, a matrix stands for several names
        check_names(fitted, inputs, outputs)
    columns = pairs(options.column, "--column")
    there = column_names(options.data, [columns.get(name, name) for name in (*inputs, *outputs)])
    measured = bool(options.outputs) or any(name in columns or name in there for name in outputs)
    if not measured and options.initial == "estimate":
        raise InputError(
            f"--initial estimate needs measured outputs, but {options.data} has no column {listed(outputs)}; "
            "give --initial zero, or --initial periodic with --period SAMPLES."
        )
    options.initial = options.initial or ("estimate" if measured else "zero")
    columns = columns if measured else {k: v for k, v in columns.items() if k not in outputs}
    recording = read_file(options, options.data, inputs, outputs if measured else ())
    check_names(fitted, recording.inputs, recording.outputs if measured else fitted.model.outputs)
    engine = announced_engine(fitted, recording, "auto", quiet=True)
    y = replace(fitted, engine=engine).simulate(recording)
    if not np.all(np.isfinite(y)):
        return say(f"The simulation of {options.model} diverges on {options.data}; nothing was written.", NO_RESULT)
    times = written_times(options.data, columns) or [repr(float(f"{t:.12g}")) for t in recording.t]
    rows = np.column_stack([recording.u, y]).tolist()
    lines = [",".join([t.strip(), *map(repr, row)]) for t, row in zip(times, rows, strict=True)]
    header = ",".join(["t", *fitted.model.inputs, *fitted.model.outputs])
    write_atomically(out, "\n".join([header, *lines]) + "\n")
    if measured:
        print(_judged(fitted, recording, y))
    else:
        state = "zero" if options.initial == "zero" else "that of the periodic steady state"
        print(f"{options.data} has no outputs ({listed(outputs)}) to compare with; initial state: {state}")
    print(f"simulated outputs: {options.out}")
    return DONE


def _simulate_stack(options: argparse.Namespace, fitted: Fit, u: np.ndarray, y: np.ndarray | None) -> int:
    """Simulate records (samples, channels, further axes), one after the other, each from its own initial state."""
    axes, initial = u.shape[2:], options.initial or ("zero" if y is None else "estimate")
    if y is None and initial == "estimate":
        raise InputError(
            f"--initial estimate needs measured outputs, but {options.data} has none; give --initial zero, or "
            "--initial periodic with --period SAMPLES."
        )
    if options.dt is None:
        raise InputError(f"{options.data} has no time column; state the step with --dt SECONDS.")
    more = {key: getattr(options, key) for key in ("period", "hold", "skip")}
    found, errors, engine = np.empty((len(u), fitted.model.n_y, *axes)), [], ""
    for number, index in enumerate(np.ndindex(*axes)):
        at = (slice(None), slice(None), *index)
        measured = np.empty((len(u), 0)) if y is None else y[at]
        name = f"{Path(options.data).stem} {list(index)}"
        outputs = () if y is None else fitted.model.outputs
        inputs = fitted.model.inputs
        record = Recording(u[at], measured, options.dt, inputs, outputs, initial=initial, name=name, **more)
        if number == 0:
            engine = announced_engine(fitted, record, "auto", quiet=True)
            fitted = replace(fitted, engine=engine)
        found[at] = fitted.simulate(record)
        if not np.all(np.isfinite(found[at])):
            return say(f"The simulation of {options.model} diverges on {name}; nothing was written.", NO_RESULT)
        if y is not None:
            print(_judged(fitted, record, found[at]))
            errors.append(nrmse(record.y, found[at], skip=fitted.scored_from(record)))
    write_atomically(Path(options.out), _stack_text(Path(options.out), u, found, options.dt, fitted))
    if errors:
        print(f"NRMSE, mean over {len(errors)} records: {np.mean(errors):.4f}")
    print(f"simulated outputs: {options.out}")
    return DONE


def _stack_text(out: Path, u: np.ndarray, y: np.ndarray, dt: float, fitted: Fit) -> bytes:
    """`y` as an array laid out like the inputs (.npz, .npy), or CSV with the record's number in the first column."""
    if out.suffix.lower() in (".npz", ".npy"):
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


def _judged(fitted: Fit, recording: Recording, y: np.ndarray) -> str:
    try:
        return f"NRMSE on {recording.name}: {nrmse(recording.y, y, skip=fitted.scored_from(recording)):.4f}"
    except InputError as error:
        return f"no NRMSE on {recording.name}: {error}"
