"""`pilfr run` and `pilfr campaign`: a run file on the command line, and a sentence for everything that can go wrong."""

from __future__ import annotations

import argparse
import contextlib
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path

from .._base import InputError, progress_bar, worker_pool
from ..data import NOTHING_SENTENCE, explains_nothing
from ..identify import drawn
from ..models import PILFR, places
from ..studies import (
    AHEAD,
    MODEL,
    PAGE,
    PICTURE,
    ROLES,
    SUMMARY,
    TABLE,
    Cell,
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
)
from .app import DONE, INTERRUPTED, NO_RESULT, say
from .commands import make_folder

WIDE = 10_000  # characters: a number that is cut off is a wrong number, so lines are as long as they have to be


def run_command(options: argparse.Namespace) -> int:
    """Execute a run file; returns the exit status: 1 where no job gives a model or explains anything."""
    given = _given(options, "run")
    count = len(given.seeds) * len(given.cells)
    print(f"run: {given.file}, {count} job{'s' * (count > 1)}, results in {given.out}", flush=True)
    try:
        with worker_pool(given.workers) as pool, progress_bar() as progress:
            result = run(given, overwrite=options.overwrite, executor=pool, progress=progress, tell=_tell)
    except RunInterrupted as stop:
        return say(f"Interrupted; {stop}, the same command goes on from there.", INTERRUPTED)
    except KeyboardInterrupt:
        return say("Interrupted; what is done stays, the same command goes on from there.", INTERRUPTED)
    except NoModel as missed:
        return say(str(missed), NO_RESULT)
    return _told(given, result, TABLE, MODEL)


def campaign_command(options: argparse.Namespace) -> int:
    """Execute the jobs of a run file side by side; returns the exit status."""
    given = _given(options, "campaign")
    if options.time_limit is not None:
        if not 0 < options.time_limit < float("inf"):
            raise InputError(f"--time-limit {options.time_limit:g} was given; give a number of seconds above zero.")
        given = replace(given, time_limit=options.time_limit)
    if options.dask and options.workers is not None:
        raise InputError("--workers and --dask were given; the cluster has its own workers, so leave one of them out.")
    folds = f" x {given.folds} folds" if given.folds else ""
    size = f"{len(given.cells)} cells x {len(given.seeds)} seeds{folds}"
    try:
        with contextlib.ExitStack() as stack:
            executor: Executor | None = None
            workers, ahead = given.workers, AHEAD
            if options.dask:
                from ..studies import dask_executor

                executor, workers, ahead = stack.enter_context(dask_executor(options.dask))
            print(f"campaign: {given.file}, {size}, {workers} workers, results in {given.out}", flush=True)
            progress = stack.enter_context(progress_bar())
            result = campaign(
                given,
                overwrite=options.overwrite,
                executor=executor,
                ahead=ahead,
                progress=progress,
                tell=_tell,
            )
    except RunInterrupted as stop:
        return say(f"Interrupted; {stop}, the same command goes on from there.", INTERRUPTED)
    except KeyboardInterrupt:
        return say("Interrupted; what is done stays, the same command goes on from there.", INTERRUPTED)
    except NoModel as missed:
        return say(str(missed), NO_RESULT)
    _print_summary(result)
    return _told(given, result, TABLE, SUMMARY, PICTURE, MODEL)


def _given(options: argparse.Namespace, kind: str) -> Run:
    given = read_run(options.run_file, kind)
    if options.out is not None:
        check_own(Path(options.out), given.file, options.overwrite)
        given = replace(given, out=make_folder(options.out))
    if options.workers is not None:
        if options.workers < 1:
            raise InputError(f"--workers {options.workers} was given; give 1 or more.")
        given = replace(given, workers=options.workers)
    return given


def _print_summary(result: RunResult) -> None:
    """Quartiles of every cell, and the structure that is recommended."""
    from rich.console import Console
    from rich.table import Table

    keys = grid_keys(s.cell for s in result.summary)
    table = Table(box=None, header_style="bold", pad_edge=False)
    for name in ("recording", *keys, "jobs", "failed", "25 %", "median", "75 %", "s a job"):
        table.add_column(name, justify="left" if name == "recording" else "right", no_wrap=True)
    for s in result.summary:
        quartiles = [f"{q:.4f}" for q in s.quartiles[1:4]]
        cell = [str(s.cell.get(k, "-")) for k in keys]
        counts = [str(s.jobs), f"{100 * s.failure_rate:.0f} %"]
        table.add_row(f"{s.recording} ({s.role})", *cell, *counts, *quartiles, f"{s.seconds:.1f}")
    Console(highlight=False, width=WIDE).print(table)
    if result.selection is not None:
        print(result.selection)


def _told(given: Run, result: RunResult, *files: str) -> int:
    """Errors of the model chosen, and where everything is; the exit status."""
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
    if len(given.seeds) > 1:
        for cell in given.cells:
            alike = _alike(cell)
            if alike:
                print(f"{cell.name or 'the model'}: {alike}")
    for name in (*files, *([PAGE] if given.report else []), "manifest.json"):
        print(result.folder / name)
    return say(NOTHING_SENTENCE, NO_RESULT) if explains_nothing(result.fit.train_nrmse) else DONE


def _alike(cell: Cell) -> str:
    """Why every seed gives the same model of a cell, and what to do; empty where starts are drawn."""
    model, start, starts = cell.model, cell.search["start"], cell.search["starts"]
    if not isinstance(model, PILFR):
        return ""
    if model.element is None:
        return "a linear model has no starts, so every seed gives the same one; use one seed"
    if any(drawn(model, start, i) for i in range(starts)):
        return ""
    first = len(places(model))
    more = f", or {first + 1} starts or more" if drawn(model, start, first) else ""
    return f"no start is drawn, so every seed gives the same model; use one seed{more}"


def _tell(line: str) -> None:
    print(line, flush=True)
