"""The command `pilfr diagnose`: read, check, find what is missing, write, say what was found."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._base import InputError, deferred_interrupt, listed, progress_bar
from ..data import SAME_STEP, TIME_NAMES, Recording, column_names
from ..export import write_atomically
from ..identify import load
from ..simulators import Simulator, as_simulator, simulator_variable
from .app import DONE, INTERRUPTED, NO_RESULT, say
from .commands import columns_of, make_folder, read_file
from .option_values import name_list, pairs

TABLES = (".csv", ".tsv", ".txt", ".dat", ".mat", ".npz")


def run_diagnosis(options: argparse.Namespace) -> int:
    """Diagnose a simulator, or what a simulation recorded; see `cli` for the options and the exit status."""
    train = list(options.files)
    source = None if options.simulated else train.pop(0)
    _check_files(options, source, train)
    target = Path(options.out) / "diagnosis.json"
    if target.exists() and not options.overwrite:
        raise InputError(f"{target} exists already; give another --out, or --overwrite to replace it.")
    if source is not None:
        given = load(source) if Path(source).suffix.lower() == ".json" else simulator_variable(source)
        simulator = as_simulator(given)
        inputs, outputs = simulator.inputs, simulator.output_names
    else:
        inputs, outputs = _simulated_names(options, train)
    recordings = [read_file(options, path, inputs, outputs) for path in train]
    tests = [read_file(options, path, inputs, outputs) for path in options.test]
    _check_apart([*zip(train, recordings, strict=True)], [*zip(options.test, tests, strict=True)])
    _check_steps([*zip([*train, *options.test], [*recordings, *tests], strict=True)])
    folder = make_folder(options.out)
    error, poor = 0.0, ""
    if source is not None:
        simulator = as_simulator(given, recordings)
    else:
        simulator, error, poor = _surrogate(options, inputs, outputs)
    name = f"simulator: {source}" if source else f"surrogate of {options.simulated} (NRMSE {error:.4f})"
    _announce(simulator, name, [("training", train, recordings), ("test", options.test, tests)])
    if poor:
        print(f"note: {poor}", flush=True)
    with deferred_interrupt():
        from ..diagnose import diagnose
    try:
        with progress_bar() as progress:
            diagnosis = diagnose(
                simulator,
                recordings,
                test=tests or None,
                hold=options.hold,
                limits=amplitudes(options.limit),
                workers=options.workers,
                stand_in_error=error,
                progress=progress,
            )
    except KeyboardInterrupt:
        return say("Interrupted before there was a diagnosis; nothing was written.", INTERRUPTED)
    return write(diagnosis, folder)


def amplitudes(given: Sequence[str]) -> dict[str, float]:
    """Amplitudes by name from "name=number"."""
    out = {}
    for name, value in pairs(given, "--limit").items():
        try:
            out[name] = float(value)
        except ValueError:
            raise InputError(f"--limit {name}={value} is not a number; give, for example, --limit {name}=10.") from None
    return out


def write(diagnosis: Any, folder: Path) -> int:
    """Write diagnosis.json, then the page; print the diagnosis and where it is; returns the exit status."""
    target = folder / "diagnosis.json"
    content = json.dumps(diagnosis.to_dict(), indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    try:
        with deferred_interrupt():
            write_atomically(target, content)
            print(diagnosis, flush=True)
            from ..report import diagnosis_report
        page = diagnosis_report(diagnosis, folder)
    except KeyboardInterrupt:
        return say(f"Interrupted; the diagnosis is in {target}, a report was not written.", INTERRUPTED)
    except (InputError, OSError):
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        return say(f"The diagnosis is in {target}, but a report could not be written ({reason}).", NO_RESULT)
    print(f"diagnosis: {target}\nreport: {page}")
    return INTERRUPTED if getattr(diagnosis, "interrupted", False) else DONE


def _check_files(options: argparse.Namespace, source: str | None, train: Sequence[str]) -> None:
    if source is not None and Path(source).suffix.lower() in TABLES:
        raise InputError(
            f"{source} is no simulator file; give SIMULATOR.py first, or the simulation's own inputs and outputs with "
            "--simulated SIM.csv."
        )
    scripts = [path for path in (*train, *options.test) if Path(path).suffix.lower() == ".py"]
    if scripts:
        raise InputError(
            f"{scripts[0]} was given as a recording; give one simulator file, first, and none with --simulated."
        )
    if not train:
        raise InputError("No training recording was given; give the simulator file and at least one recording.")
    if source is not None and (options.inputs or options.outputs):
        raise InputError("--inputs and --outputs go with --simulated; a simulator file has names of its own.")
    every = [*train, *options.test, *([options.simulated] if options.simulated else [])]
    seen = [os.path.realpath(path) for path in every]
    if len(set(seen)) < len(seen):
        raise InputError("A file is given twice, as training or test recording; a test on training data says nothing.")
    if options.workers is not None and options.workers < 1:
        raise InputError(f"--workers {options.workers} was given; give 1 or more.")


def _check_apart(train: Sequence[tuple[str, Recording]], tests: Sequence[tuple[str, Recording]]) -> None:
    for there, t in tests:
        for path, r in train:
            if len(r) == len(t) and np.array_equal(r.u, t.u) and np.array_equal(r.y, t.y):
                raise InputError(f"{there} holds the same samples as {path}; a test on training data says nothing.")


def _check_steps(given: Sequence[tuple[str, Recording]]) -> None:
    path, first = given[0]
    for other, r in given:
        if abs(r.dt / first.dt - 1) > SAME_STEP:
            raise InputError(f"{other} has a step of {r.dt:g} s, {path} one of {first.dt:g} s; resample one of them.")


def _announce(simulator: Simulator, name: str, kinds: Sequence[tuple[str, Sequence[str], Sequence[Recording]]]) -> None:
    ports = listed([port.name for port in simulator.all_ports()])
    free = sum(not bool(np.all(p.fixed)) for p in simulator.parameters.values())
    counts = f"{len(simulator.states)} states, {len(simulator.parameters)} parameters ({free} free)"
    print(f"{name}, {counts}; ports {ports}", flush=True)
    for kind, paths, recordings in kinds:
        for path, r in zip(paths, recordings, strict=True):
            names = f"inputs {listed(r.inputs)}, outputs {listed(r.outputs)}"
            print(f"{kind} data: {path}, {len(r)} samples, step {r.dt:.6g} s, {names}", flush=True)


def _surrogate(
    options: argparse.Namespace, inputs: tuple[str, ...], outputs: tuple[str, ...]
) -> tuple[Simulator, float, str]:
    with deferred_interrupt():
        from ..diagnose import POOR, TOO_POOR, surrogate
    simulator, error = surrogate(read_file(options, options.simulated, inputs, outputs))
    return simulator, error, TOO_POOR if error > POOR else ""


def _simulated_names(options: argparse.Namespace, train: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Inputs and outputs by option, else the columns that the files share, told apart by their values."""
    if options.inputs and options.outputs:
        return name_list(options.inputs, "--inputs"), name_list(options.outputs, "--outputs")
    if options.inputs or options.outputs:
        raise InputError("Only one of --inputs and --outputs was given; give both.")
    files = [options.simulated, *train, *options.test]
    first, *others = (_named(options, f) for f in files)
    shared = [n for n in first if n not in TIME_NAMES and all(n in other for other in others)]
    inputs = tuple(n for n in shared if _alike(options, n, files)) or tuple(n for n in shared if n[:1] in "uU")
    if not inputs and len(shared) == 2:
        inputs = _cause(options, shared)
    outputs = tuple(n for n in shared if n not in inputs)
    if not inputs or not outputs:
        raise InputError(
            f"Which of the columns {listed(shared) or '(none is shared)'} of {files[0]} and the recordings are inputs "
            "is not to be seen; give --inputs NAMES and --outputs NAMES."
        )
    _check_names(files, (first, *others), shared)
    print(f"inputs {listed(inputs)}, outputs {listed(outputs)}, as found in the files", flush=True)
    return inputs, outputs


def _named(options: argparse.Namespace, path: str) -> list[str]:
    """A file's columns by the names that options give them."""
    names = {column: name for name, column in columns_of(options, path).items()}
    return [names.get(column, column) for column in column_names(path)]


def _check_names(files: Sequence[str], columns: Sequence[Sequence[str]], shared: Sequence[str]) -> None:
    """Columns that the simulation has and a recording has not are told; perhaps they have another name there."""
    first, *others = ([n for n in names if n not in TIME_NAMES and n not in shared] for names in columns)
    for path, names, own in zip(files[1:], columns[1:], others, strict=True):
        lost = [n for n in first if n not in names]
        if lost and own:
            raise InputError(
                f"{files[0]} has {listed(lost)}, which {path} has not, and {path} has {listed(own)} of its own; say "
                f"which are the same, as in --column {lost[0]}={own[0]}, or which to use, with --inputs and --outputs."
            )
        for extra, there, lacks in ((lost, files[0], path), (own, path, files[0])):
            if extra:
                print(f"note: {listed(extra)} of {there} is left out, for {lacks} has no such column", flush=True)


def _cause(options: argparse.Namespace, shared: Sequence[str]) -> tuple[str, ...]:
    """Of two columns the one from which the other follows: a cause comes before its effect, and not the other way."""
    from ..diagnose import surrogate

    errors = {}
    for name, other in (shared, shared[::-1]):
        try:
            errors[name] = surrogate(read_file(options, options.simulated, (name,), (other,), glance=True), nx=4)[1]
        except InputError:
            errors[name] = np.inf
    best = min(shared, key=lambda n: errors[n])
    return (best,) if errors[best] < 0.3 * max(errors.values()) else ()


def _alike(options: argparse.Namespace, name: str, files: Sequence[str]) -> bool:
    """Whether the simulation has the very samples of one of the recordings."""
    first, *others = (read_file(options, f, (name,), (), glance=True).u for f in files)
    return any(len(o) == len(first) and bool(np.allclose(o, first, rtol=1e-6, atol=0.0)) for o in others)
