"""Execute a run file and print its results: `pilfr run` and `pilfr campaign`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import typer

from .._base import progress_bar, worker_pool
from ..data import NOTHING_SENTENCE, explains_nothing
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
    INTERRUPTED,
    NO_RESULT,
    check_cluster,
    flag,
    make_folder,
    open_cluster,
    option,
    print_line,
    say,
    seconds,
    takes_options,
    whole,
)

LINE_WIDTH = 10_000  # characters: too wide to wrap or truncate a number of a table
EVERY_KEY = Path(__file__).parent / "demo_data" / "every_key.toml"


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """The options of `pilfr run`."""

    run_file: str = typer.Argument(..., metavar="RUN.toml", help="The run file (.toml, or .py that sets `run`).")
    out: str | None = option("Folder of the results (default: as in the file, else RUN-run).", "DIR")
    workers: int | None = whole(
        "Number of processes; it does not change the results (default: as in the file).", 1, LARGEST_SIZE["workers"]
    )
    overwrite: bool = flag("Compute everything again, even finished jobs.", "--overwrite")

    def read(self, kind: str) -> Run:
        """Read the run file; the folder and the workers of the command line override its own."""
        given = read_run(self.run_file, kind)
        if self.out is not None:
            check_own(Path(self.out), given.file, self.overwrite)
            given = replace(given, out=make_folder(self.out))
        return given if self.workers is None else replace(given, workers=self.workers)


@dataclass(frozen=True, kw_only=True)
class CampaignOptions(RunOptions):
    """The options of `pilfr campaign`."""

    dask: str | None = option("Run the jobs on the Dask cluster of this scheduler.", "ADDRESS")
    time_limit: float | None = seconds("Stop a job after this time (default: as in the file, else no limit).")


@takes_options
def run_command(options: RunOptions) -> int:
    """Jobs run one after the other, the starts of each side by side."""
    given = options.read("run")
    count = len(given.seeds) * len(given.cells)
    print_line(f"run: {given.file}, {count} job{'s' * (count > 1)}, results in {given.out}")

    def execute() -> RunResult:
        with worker_pool(given.workers) as pool, progress_bar() as progress:
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
