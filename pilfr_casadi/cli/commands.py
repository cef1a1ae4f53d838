"""What each command of `cli` does: read, check, call the Python API, write, say what was done."""

from __future__ import annotations

import argparse
import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from .._base import Clock, InputError, deferred_interrupt, listed, progress_bar, time_limit, worker_pool
from ..data import (
    NOTHING_SENTENCE,
    TIME_NAMES,
    Recording,
    check_for_identification,
    column_names,
    explains_nothing,
    read,
)
from ..engine import VirtualMachine, compiler, make_engine
from ..identify import Fit, fit as identify, load
from ..linear import select_order
from ..models import ANY, PILFR, TAKES, Lagged, named_structure
from ..optimise import GaussNewton, Ipopt, Status
from .app import DONE, INTERRUPTED, NO_RESULT, say
from .option_values import bounds, name_list, number, pairs

LEAST = {"starts": 1, "seed": 0, "workers": 1, "operators": 0, "channels": 1, "hidden": 1, "lags": 1}
# options of a search with their defaults; a saved model to start from has them already
SEARCH = {
    "nx": None,
    "operators": None,
    "operator": None,
    "channels": None,
    "structure": "lfr",
    "hidden": None,
    "lags": None,
    "bound": (),
    "fix": (),
    "starts": 8,
    "seed": 0,
}


NAMES = {"bound": "bounds"}  # options that the structures call otherwise


def fit(options: argparse.Namespace) -> int:
    """Identify a model, write it with a report."""
    inputs, outputs, target = _checked(options)
    saved = load(options.start_from) if options.start_from else None
    if saved is not None:
        check_names(saved, inputs, outputs)
    train = [read_file(options, path, inputs, outputs) for path in options.train]
    tests = [read_file(options, path, inputs, outputs) for path in options.test]
    folder = make_folder(options.out)
    for kind, paths, recordings in (("training", options.train, train), ("test", options.test, tests)):
        for path, r in zip(paths, recordings, strict=True):
            names = f"inputs {listed(r.inputs)}, outputs {listed(r.outputs)}"
            print(f"{kind} data: {path}, {len(r)} samples, step {r.dt:.6g} s, {names}", flush=True)
    clock = Clock()
    try:
        task, result = _identified(options, saved, train, clock)
    except KeyboardInterrupt:
        if clock.expired:
            return say(f"No model was ready within --time-limit {options.time_limit:g}; give more time.", NO_RESULT)
        raise
    try:
        with deferred_interrupt():
            result.save(target)
            from ..report import fit_report
        print(result)
        if isinstance(task, PILFR) and task.element is not None and result.structure != task:
            print("No start was finished: this is the linear model that the starts begin with.")
        for recording in tests:
            print(_tested(result, recording))
        page = fit_report(result, train, tests, folder)
        print(f"model: {target}\nreport: {page}")
    except KeyboardInterrupt:
        return say(f"Interrupted; the model is in {target}, a report was not written.", INTERRUPTED)
    if result.status is Status.INTERRUPTED:
        return INTERRUPTED
    if result.status is Status.INFEASIBLE:
        missed = "; ".join(str(limit) for limit in result.limits if not limit.met)
        return say(f"The model does not meet its constraints: {missed}.", NO_RESULT)
    return say(NOTHING_SENTENCE, NO_RESULT) if explains_nothing(result.train_nrmse) else DONE


def _checked(options: argparse.Namespace) -> tuple[tuple[str, ...], tuple[str, ...], Path]:
    """Names of inputs and outputs, and the file that is to be written; defaults filled in, what is unfit refused."""
    given = [f"--{name}" for name in SEARCH if getattr(options, name) is not None]
    if options.start_from and given:
        raise InputError(
            f"{listed(given)} was given together with --from, whose model has its structure and start already; "
            "leave one of them out."
        )
    for name, default in SEARCH.items():
        if getattr(options, name) is None:
            setattr(options, name, default)
    inputs, outputs = name_list(options.inputs, "--inputs"), name_list(options.outputs, "--outputs")
    seen = [os.path.realpath(path) for path in (*options.train, *options.test)]
    if len(set(seen)) < len(seen):
        raise InputError("A file is given twice, as training or test recording; a test on training data says nothing.")
    for name, least in LEAST.items():
        if getattr(options, name) is not None and getattr(options, name) < least:
            raise InputError(f"--{name} {getattr(options, name)} was given; give {least} or more.")
    check_structure(options.structure, [name for name in SEARCH if f"--{name}" in given])
    if options.time_limit is not None and not 0 < options.time_limit < math.inf:
        raise InputError(f"--time-limit {options.time_limit:g} was given; give seconds, above zero.")
    target = Path(options.out) / "model.json"
    if target.exists() and not options.overwrite:
        raise InputError(f"{target} exists already; give another --out, or --overwrite to replace it.")
    return inputs, outputs, target


def _identified(
    options: argparse.Namespace, saved: Fit | None, train: list[Recording], clock: Clock
) -> tuple[Fit | PILFR | Lagged, Fit]:
    """What was to be fitted, and the fit; its status says where the time was up."""
    solver = GaussNewton() if options.solver == "gauss-newton" else Ipopt()
    with (
        time_limit(options.time_limit, clock),
        worker_pool(options.workers) as pool,
        progress_bar() as progress,
    ):
        task = saved if saved is not None else _structure(options, train)
        if isinstance(task, Lagged):  # too many lags are refused before they are built
            check_for_identification(train, task.unknowns(train[0].n_u, train[0].n_y) + 2)
        engine = announced_engine(task, train[0], options.engine)
        search = {} if saved is not None else {"starts": options.starts, "seed": options.seed, "executor": pool}
        result = identify(task, train, solver=solver, engine=engine, progress=progress, **search)
    if result.status is Status.INTERRUPTED and clock.expired:
        result = replace(result, solution=replace(result.solution, status=Status.TIME_LIMIT))
    return task, replace(result, engine=engine)


def simulate(options: argparse.Namespace) -> int:
    """Simulate a saved model on a file's inputs; judge it where the file has outputs."""
    from .simulate_command import run_simulation

    return run_simulation(options)


def export(options: argparse.Namespace) -> int:
    """Write a model's step as a serialized CasADi function with its names, or as C."""
    from .export_command import run_export

    return run_export(options)


def diagnose(options: argparse.Namespace) -> int:
    """Find what a simulator leaves out."""
    from .diagnose_command import run_diagnosis

    return run_diagnosis(options)


def run(options: argparse.Namespace) -> int:
    """Execute a run file."""
    from .run_command import run_command

    return run_command(options)


def campaign(options: argparse.Namespace) -> int:
    """Execute the jobs of a run file side by side."""
    from .run_command import campaign_command

    return campaign_command(options)


def demo(options: argparse.Namespace) -> int:
    """Identify the rig whose recordings come with the package."""
    from .demo import run_demo

    if options.workers < 1:
        raise InputError(f"--workers {options.workers} was given; give 1 or more.")
    return run_demo(make_folder(options.out), options.workers)


def read_file(
    options: argparse.Namespace, path: str, inputs: tuple[str, ...], outputs: tuple[str, ...], glance: bool = False
) -> Recording:
    """A recording, as the options say; at a glance columns may be given of names that are not asked for."""
    check_period(options)
    more = {key: getattr(options, key) for key in ("period", "hold", "skip", "dt", "time_tolerance")}
    columns = columns_of(options, path)
    if glance:
        columns = {name: column for name, column in columns.items() if name in (*inputs, *outputs, *TIME_NAMES)}
    return read(path, inputs, outputs, columns=columns, initial=options.initial or "estimate", **more)


def check_period(options: argparse.Namespace) -> None:
    """Refuse a period without a word on the initial state, which would be estimated as if there were no period."""
    if options.period is not None and options.initial is None:
        raise InputError(
            f"--period {options.period} was given without --initial; give --initial periodic for a record in steady "
            "state from its first sample, or --initial estimate for one that settles first."
        )


def columns_of(options: argparse.Namespace, path: str) -> dict[str, str]:
    """Name -> column of a file; beside a simulation, a file may have the name itself and another file the column."""
    columns = pairs(options.column, "--column")
    if not columns or not getattr(options, "simulated", None):
        return columns
    names = {f: column_names(f, list(columns.values())) for f in (options.simulated, *options.files, *options.test)}
    there, elsewhere = names[path], {name for found in names.values() for name in found}
    return {n: c for n, c in columns.items() if c in there or n not in there or c not in elsewhere}


def check_names(fitted: Fit, inputs: Sequence[str], outputs: Sequence[str]) -> None:
    """Refuse names that are not the model's, in its order: swapped ones would be simulated without a word."""
    for role, names, own in (("inputs", inputs, fitted.model.inputs), ("outputs", outputs, fitted.model.outputs)):
        if tuple(names) != tuple(own):
            raise InputError(
                f"--{role} {','.join(names)} was given but the model's {role} are {','.join(own)}, in this order; "
                f"use its names and say which column each is, as in --column {own[0]}=COLUMN."
            )


def check_structure(structure: str, given: Sequence[str]) -> None:
    """Refuse options that are not for the structure, and a NARX or NOE of no lags."""
    takes = TAKES[structure]
    for name in given:
        if NAMES.get(name, name) in ANY and NAMES.get(name, name) not in takes:
            raise InputError(f"--{name} is not for --structure {structure}; leave it out.")
    if "lags" in takes and "lags" not in given:
        raise InputError(f"--structure {structure} needs --lags, the number of past outputs; give it.")


def _structure(options: argparse.Namespace, train: Sequence[Recording]) -> PILFR | Lagged:
    given = {k: getattr(options, k) for k in ("operators", "operator", "channels", "hidden", "lags")}
    if "nx" in TAKES[options.structure]:
        given |= {"nx": _order(options, train), "bounds": bounds(options.bound)}
        given["fix"] = {name: number(value, "--fix") for name, value in pairs(options.fix, "--fix").items()}
    return named_structure(options.structure, **{k: v for k, v in given.items() if v is not None})


def _order(options: argparse.Namespace, train: Sequence[Recording]) -> int:
    if options.nx is not None:
        print(f"order: {options.nx}, as given", flush=True)
        return int(options.nx)
    nx = int(select_order(train, range(1, 9), offset=True).recommended)
    print(f"order: {nx}, chosen on the training data", flush=True)
    return nx


def announced_engine(task: PILFR | Lagged | Fit, recording: Recording, choice: str, quiet: bool = False) -> str:
    """Build the engine once, say which one it is and why; returns the choice that gives it without a warning."""
    if choice != "vm":
        model = task.model if isinstance(task, Fit) else task.model(recording.n_u, recording.n_y)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            engine = make_engine(model, choice)
        if not isinstance(engine, VirtualMachine):
            if not quiet:
                print("engine: generated C, compiled", flush=True)
            return choice
        found = [str(w.message) for w in caught if issubclass(w.category, RuntimeWarning)]
        reason = (
            (found[-1].rpartition(";")[0] or found[-1])
            if found
            else "no C compiler was found"
            if compiler() is None
            else "it could not be built"
        )
        print(f"engine: CasADi's virtual machine, which is slower: {' '.join(reason.split())}", flush=True)
    elif not quiet:
        print("engine: CasADi's virtual machine, as given", flush=True)
    return "vm"


def make_folder(path: str) -> Path:
    """Make the output folder before any long work, so that a bad one is said at once."""
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".writable-{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f"The folder {path} cannot be written ({error.strerror}); give another --out.") from None
    return folder


def _tested(result: Fit, recording: Recording) -> str:
    try:
        error, first = result.nrmse(recording), result.scored_from(recording)
    except InputError as reason:
        return f"no NRMSE on {recording.name}: {reason}"
    left = (result.simulate(recording) - recording.y)[first:]
    share = 100 * np.sqrt(np.mean(left**2, axis=0)) / np.ptp(recording.y[first:], axis=0)
    text = f"NRMSE on {recording.name}: {error:.4f} (rms error {', '.join(f'{s:.2f}' for s in share)} % of the range)"
    fitted = first > recording.skip
    return text + (f"; its initial state is fitted to the first {first} samples, not scored" if fitted else "")
