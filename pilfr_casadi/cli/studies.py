"""Execute the jobs of a run file, or diagnose many machines: `pilfr run`, `pilfr campaign` and `pilfr fleet`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import typer

from .._base import InputError, deferred_interrupt, progress_bar, worker_pool
from ..data import NOTHING_SENTENCE, TABLE_SUFFIXES, Recording, explains_nothing
from ..simulators import as_simulator
from ..studies import (
    LARGEST_SIZE,
    MODEL,
    PAGE,
    PICTURE,
    ROLES,
    SUMMARY,
    TABLE,
    NoModel,
    Run,
    RunInterrupted,
    RunResult,
    campaign,
    check_own,
    grid_keys,
    read_run,
    reasons,
    run,
    seeds_advice,
)
from ._common import (
    DONE,
    FILE_TYPES,
    INTERRUPTED,
    NO_RESULT,
    SimulatorOptions,
    check_cluster,
    duration,
    flag,
    integer,
    make_out_folder,
    open_cluster,
    option,
    print_line,
    say,
    takes_options,
)

LINE_WIDTH = 10_000  # characters: too wide to wrap or truncate a number of a table
EVERY_KEY = Path(__file__).parent / "demo_data" / "every_key.toml"


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """The options of `pilfr run`."""

    run_file: str = typer.Argument(..., metavar="RUN.toml", help="The run file (.toml, or .py that sets `run`).")
    out: str | None = option("Folder of the results (default: as in the file, else RUN-run).", "DIR")
    workers: int | None = integer(
        "Number of processes; it does not change the results (default: as in the file).", 1, LARGEST_SIZE["workers"]
    )
    overwrite: bool = flag("Compute everything again, even finished jobs.", "--overwrite")

    def read(self, kind: str) -> Run:
        """Read the run file; the folder and the workers of the command line override its own."""
        given = read_run(self.run_file, kind)
        if self.out is not None:
            check_own(Path(self.out), given.file, self.overwrite)
            given = replace(given, out=make_out_folder(self.out))
        return given if self.workers is None else replace(given, workers=self.workers)


@dataclass(frozen=True, kw_only=True)
class CampaignOptions(RunOptions):
    """The options of `pilfr campaign`."""

    dask: str | None = option("Run the jobs on the Dask cluster of this scheduler.", "ADDRESS")
    time_limit: float | None = duration("Stop a job after this time (default: as in the file, else no limit).")


@takes_options
def run_command(options: RunOptions) -> int:
    """Jobs run one after the other, the starts of each side by side."""
    given = options.read("run")
    count = len(given.seeds) * len(given.cells)
    print_line(f"run: {given.file}, {count} job{'s' * (count > 1)}, results in {given.out}")

    def execute() -> RunResult:
        starts = max(cell.search.get("starts", 1) for cell in given.cells)
        with worker_pool(min(given.workers, starts)) as pool, progress_bar() as progress:
            return run(given, overwrite=options.overwrite, executor=pool, progress=progress, tell=print_line)

    return _report(given, execute, TABLE, MODEL)


@takes_options
def campaign_command(options: CampaignOptions) -> int:
    """Jobs run side by side; a job that fails, hangs or dies does not stop the others."""
    check_cluster(options.dask, options.workers)
    given = options.read("campaign")
    if options.time_limit is not None:
        given = replace(given, time_limit=options.time_limit)

    def execute() -> RunResult:
        with open_cluster(options.dask, given.workers) as (executor, workers, ahead):
            folds = f" x {given.folds} folds" if given.folds else ""
            size = f"{len(given.cells)} cells x {len(given.seeds)} seeds{folds}"
            print_line(f"campaign: {given.file}, {size}, {workers} workers, results in {given.out}")
            with progress_bar() as progress:
                result = campaign(
                    given,
                    overwrite=options.overwrite,
                    executor=executor,
                    ahead=ahead,
                    progress=progress,
                    tell=print_line,
                )
        _print_summary(result)
        return result

    return _report(given, execute, TABLE, SUMMARY, PICTURE, MODEL)


def _report(given: Run, execute: Callable[[], RunResult], *files: str) -> int:
    """Execute a run; print the errors of the chosen model and the paths of the results; return the exit status."""
    try:
        result = execute()
    except RunInterrupted as stop:
        return say(f"Interrupted; {stop}, the same command continues from there.", INTERRUPTED)
    except KeyboardInterrupt:
        return say("Interrupted; finished jobs are kept, the same command continues from there.", INTERRUPTED)
    except NoModel as missed:
        return say(str(missed), NO_RESULT)
    for role in ROLES:
        for s in result.scores:
            if s.role == role and s.job == result.chosen:
                print(f"NRMSE on {s.recording} ({role}): {s.nrmse:.4f}")
    failed = f", {len(result.failed)} of them without a model" if result.failed else ""
    print(f"chosen: {result.chosen}; {len(result.done)} jobs done now, {len(result.skipped)} before{failed}")
    if result.note:
        print(result.note)
    for line in reasons(result.manifest["jobs"], result.failed):
        print(f"without a model: {line}")
    for cell in given.cells if len(given.seeds) > 1 else ():
        advice = seeds_advice(cell)
        if advice:
            print(f"{cell.name or 'the model'}: {advice}")
    for name in (*files, *([PAGE] if given.report else []), "manifest.json"):
        print(result.folder / name)
    return say(NOTHING_SENTENCE, NO_RESULT) if explains_nothing(result.fit.train_nrmse) else DONE


def _print_summary(result: RunResult) -> None:
    """Print the quartiles of every cell, and the recommended structure."""
    from rich.console import Console
    from rich.table import Table

    keys = grid_keys(s.cell for s in result.summary)
    table = Table(box=None, header_style="bold", pad_edge=False)
    for name in ("recording", *keys, "jobs", "failed", "25 %", "median", "75 %", "s per job"):
        table.add_column(name, justify="left" if name == "recording" else "right", no_wrap=True)
    for s in result.summary:
        quartiles = [f"{q:.4f}" for q in s.quartiles[1:4]]
        cell = [str(s.cell.get(k, "-")) for k in keys]
        counts = [str(s.jobs), f"{100 * s.failure_rate:.0f} %"]
        table.add_row(f"{s.recording} ({s.role})", *cell, *counts, *quartiles, f"{s.seconds:.1f}")
    Console(highlight=False, width=LINE_WIDTH).print(table)
    if result.selection is not None:
        print(result.selection)


# shown at the end of the help of both commands
for command in (run_command, campaign_command):
    command.__doc__ = f"{command.__doc__}\n\nAn example with every key of a run file: {EVERY_KEY}"


@dataclass(frozen=True, kw_only=True)
class FleetOptions(SimulatorOptions):
    """The options of `pilfr fleet`."""

    files: list[str] = typer.Argument(
        ...,
        metavar="SIMULATOR FOLDER",
        help=f"The simulator, as for `pilfr diagnose`, then a folder with a recording ({FILE_TYPES}), or a folder of "
        "recordings in the order of their names, for each machine.",
    )
    sample: int = integer("Number of machines that are diagnosed to find the common physics (default: 4).", 1, 1000, 4)
    workers: int | None = integer(
        "Number of processes; it does not change the results (default: one per processor).", 1, LARGEST_SIZE["workers"]
    )
    dask: str | None = option("Run the jobs on the Dask cluster of this scheduler.", "ADDRESS")
    time_limit: float | None = duration("Stop the work at a machine after this time (default: no limit).")
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
        if len(self.files) != 2:
            raise InputError(f"{len(self.files)} paths were given; give the simulator file, then a folder of machines.")
        folder = Path(self.files[1])
        if not folder.is_dir():
            raise InputError(f"{folder} is no folder; give a folder with a recording, or a folder, for each machine.")

        files = _recordings_in(folder)
        from_files = {p.stem: [str(p)] for p in files}
        subfolders = {p.name: [str(q) for q in _recordings_in(p)] for p in sorted(folder.iterdir()) if p.is_dir()}
        from_folders = {name: paths for name, paths in subfolders.items() if paths}
        for name in (name for name, paths in subfolders.items() if not paths):
            print_line(f"note: {folder / name} holds no recording and is left out")
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

    def check_target(self) -> None:
        """Refuse to write results among the recordings: the next call would take them for a machine."""
        if Path(self.files[1]).resolve() in (Path(self.target).resolve(), *Path(self.target).resolve().parents):
            raise InputError(f"The folder {self.target} is inside {self.files[1]}; give the results another --out.")


def _recordings_in(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.is_file() and p.suffix.lower() in TABLE_SUFFIXES)


@takes_options
def fleet_command(options: FleetOptions) -> int:
    """Writes pages, fleet.json and fleet.csv to DIR. The same command continues after an interrupt or adds machines."""
    check_cluster(options.dask, options.workers)
    if options.against is not None and options.out is not None:
        raise InputError("--against and --out were given; --against writes nothing, so leave one of them out.")
    options.check_files()
    if options.against is None:
        options.check_target()
    given = options.simulator_file().load()
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
        print_line(f"{name}: {found.findings or 'as the others'}")
    return DONE
