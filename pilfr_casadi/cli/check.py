"""`pilfr check`: read the files, print what the recordings can reveal, and write check.json where a folder is given."""

from __future__ import annotations

import json
from dataclasses import dataclass

from .._base import deferred_interrupt, write_atomically
from ..simulators import as_simulator
from ._common import (
    DONE,
    SimulatorOptions,
    describe,
    flag,
    load_simulator,
    make_folder,
    new_file,
    option,
    takes_options,
)
from .app import name_options


@dataclass(frozen=True, kw_only=True)
class CheckOptions(SimulatorOptions):
    """The options of `pilfr check`."""

    out: str | None = option("Folder for check.json (default: nothing is written).", "DIR")
    overwrite: bool = flag("Replace an existing check.json in that folder.", "--overwrite")


@takes_options
def check_command(options: CheckOptions) -> int:
    """Refits only the simulator itself; with --out, the answer is in DIR/check.json."""
    options.check_files()
    if options.out is not None:
        new_file(options.out, "check.json", options.overwrite)
    given = load_simulator(options.files[0])
    simulator = as_simulator(given)
    recordings = [options.read(path, simulator.inputs, simulator.output_names) for path in options.train]
    folder = make_folder(options.out) if options.out is not None else None
    for path, recording in zip(options.train, recordings, strict=True):
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
