"""`pilfr check`: read the files, print what the recordings can reveal, and write check.json where a folder is given."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import typer

from .._base import InputError, deferred_interrupt, write_atomically
from ..data import TABLE_SUFFIXES
from ..identify import load
from ..simulators import as_simulator, simulator_variable
from ._common import (
    DONE,
    DataOptions,
    check_given_once,
    describe,
    flag,
    make_folder,
    new_file,
    option,
    takes_options,
)
from .app import name_options


@dataclass(frozen=True, kw_only=True)
class CheckOptions(DataOptions):
    """The options of `pilfr check`."""

    files: list[str] = typer.Argument(
        ...,
        metavar="SIMULATOR TRAIN",
        help="A Python file that sets `simulator` (or a model.json), then training recordings (.csv, .mat, .npz).",
    )
    out: str | None = option("Folder for check.json (default: nothing is written).", "DIR")
    overwrite: bool = flag("Replace an existing check.json in that folder.", "--overwrite")


@takes_options
def check_command(options: CheckOptions) -> int:
    """Refits only the simulator itself; with --out, the answer is in DIR/check.json."""
    source, train = options.files[0], options.files[1:]
    if Path(source).suffix.lower() in TABLE_SUFFIXES:
        raise InputError(f"{source} is not a simulator file; give SIMULATOR.py first, then the recordings.")
    if not train:
        raise InputError("No recording was given; give the simulator file and at least one recording.")
    if scripts := [path for path in train if Path(path).suffix.lower() == ".py"]:
        raise InputError(f"{scripts[0]} was given as a recording; give one simulator file, first.")
    if options.inputs or options.outputs:
        raise InputError("--inputs and --outputs were given; a simulator file has its own names.")
    check_given_once(train)
    if options.out is not None:
        new_file(options.out, "check.json", options.overwrite)
    given = load(source) if Path(source).suffix.lower() == ".json" else simulator_variable(source)
    simulator = as_simulator(given)
    recordings = [options.read(path, simulator.inputs, simulator.output_names) for path in train]
    folder = make_folder(options.out) if options.out is not None else None
    for path, recording in zip(train, recordings, strict=True):
        print(describe("training", path, recording), flush=True)
    with deferred_interrupt():
        from ..diagnose import check
    found = check(as_simulator(given, recordings), recordings, hold=options.hold)
    print(name_options(str(found)))
    if folder is not None:
        target = folder / "check.json"
        content = json.dumps(found.to_dict(), indent=1, allow_nan=False, ensure_ascii=False) + "\n"
        write_atomically(target, content)
        print(f"check: {target}")
    return DONE
