"""Diagnose the recordings of many machines: `pilfr fleet`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from .._base import InputError, deferred_interrupt, progress_bar
from ..simulators import as_simulator
from ..studies import LARGEST_SIZE, NoModel, RunInterrupted
from ._common import (
    DONE,
    FILE_TYPES,
    INTERRUPTED,
    NO_RESULT,
    SimulatorOptions,
    check_cluster,
    flag,
    open_cluster,
    option,
    print_line,
    say,
    seconds,
    takes_options,
    whole,
)

if TYPE_CHECKING:
    from ..data import Recording


@dataclass(frozen=True, kw_only=True)
class FleetOptions(SimulatorOptions):
    """The options of `pilfr fleet`."""

    files: list[str] = typer.Argument(
        ...,
        metavar="SIMULATOR FOLDER",
        help=f"The simulator, as for `pilfr diagnose`, then a folder with a recording ({FILE_TYPES}), or a folder of "
        "recordings in the order of their names, for each machine.",
    )
    sample: int = whole("Number of machines that are diagnosed to find the common physics (default: 4).", 1, 1000, 4)
    workers: int | None = whole(
        "Number of processes; it does not change the results (default: one per processor).", 1, LARGEST_SIZE["workers"]
    )
    dask: str | None = option("Run the jobs on the Dask cluster of this scheduler.", "ADDRESS")
    time_limit: float | None = seconds("Stop the work at a machine after this time (default: no limit).")
    out: str | None = option("Folder of the results (default: fleet).", "DIR")
    overwrite: bool = flag("Compute everything again, even finished jobs.", "--overwrite")
    against: str | None = option("Judge the machines against the fleet in this folder, and write nothing.", "DIR")

    @property
    def target(self) -> str:
        """The folder of the results."""
        return "fleet" if self.out is None else self.out

    @cached_property
    def machines(self) -> dict[str, list[str]]:
        """The files of each machine."""
        from ..data import TABLE_SUFFIXES

        if len(self.files) != 2:
            raise InputError(f"{len(self.files)} paths were given; give the simulator file, then a folder of machines.")
        folder = Path(self.files[1])
        if not folder.is_dir():
            raise InputError(f"{folder} is no folder; give a folder with a recording, or a folder, for each machine.")

        def tables(where: Path) -> list[Path]:
            return sorted(p for p in where.iterdir() if p.is_file() and p.suffix.lower() in TABLE_SUFFIXES)

        files = tables(folder)
        from_files = {p.stem: [str(p)] for p in files}
        subfolders = {p.name: [str(q) for q in tables(p)] for p in sorted(folder.iterdir()) if p.is_dir()}
        from_folders = {name: paths for name, paths in subfolders.items() if paths}
        if both := sorted(set(from_files) & set(from_folders)):
            raise InputError(f"{folder} has both a file and a folder for the machine {both[0]!r}; leave one out.")
        if len(from_files) < len(files):
            raise InputError(f"{folder} has two files for one machine; put a machine's recordings into its own folder.")
        found = from_files | from_folders
        if not found:
            raise InputError(f"{folder} holds no recording ({FILE_TYPES}), nor a folder with one.")
        return dict(sorted(found.items()))

    @property
    def train(self) -> list[str]:
        """All recordings."""
        return [path for paths in self.machines.values() for path in paths]

    def check_folder(self) -> None:
        """Refuse to write results among the recordings: the next call would take them for a machine."""
        if Path(self.files[1]).resolve() in (Path(self.target).resolve(), *Path(self.target).resolve().parents):
            raise InputError(f"The folder {self.target} is inside {self.files[1]}; give the results another --out.")


@takes_options
def fleet_command(options: FleetOptions) -> int:
    """Writes report.html, fleet.json and fleet.csv to DIR. The same command continues after an interrupt."""
    check_cluster(options.dask, options.workers)
    if options.against is not None and options.out is not None:
        raise InputError("--against and --out were given; --against writes nothing, so leave one of them out.")
    options.check_files()
    if options.against is None:
        options.check_folder()
    given = options.load_simulator()
    simulator = as_simulator(given)
    inputs, outputs = simulator.inputs, simulator.output_names
    machines = {
        name: list(options.read_all(paths, inputs, outputs).values()) for name, paths in options.machines.items()
    }
    with deferred_interrupt():
        from ..studies import fleet
    if options.against is not None:
        return _judge(options, given, machines)
    count = sum(map(len, machines.values()))
    print_line(f"fleet: {len(machines)} machines, {count} recordings, results in {options.target}")
    try:
        with open_cluster(options.dask, 0) as (executor, _, ahead), progress_bar() as progress:
            result = fleet(
                given,
                machines,
                sample=options.sample,
                hold=options.hold,
                workers=options.workers,
                executor=executor,
                ahead=ahead,
                time_limit=options.time_limit,
                out=options.target,
                overwrite=options.overwrite,
                progress=progress,
                tell=print_line,
            )
    except RunInterrupted as stop:
        return say(f"Interrupted; {stop}, the same command continues from there.", INTERRUPTED)
    except NoModel as missed:
        return say(str(missed), NO_RESULT)
    print(result)
    for name in ("report.html", "fleet.json", "fleet.csv"):
        print(Path(options.target) / name)
    return DONE


def _judge(options: FleetOptions, simulator: object, machines: dict[str, list[Recording]]) -> int:
    """Print how each machine compares with an earlier fleet."""
    from ..studies import read_fleet

    fleet = read_fleet(options.against, simulator)
    for name, recordings in machines.items():
        found = fleet.judge(name, recordings)
        findings = "; ".join(f"{text} ({p:.2f})" for text, p in found.reasons) or "as the others"
        print_line(f"{name}: {findings}")
    return DONE
