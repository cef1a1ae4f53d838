"""`pilfr run`: a run file on the command line, with progress, and a sentence for everything that can go wrong."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from ..cli import DONE, INTERRUPTED, NO_RESULT, say
from ..commands import make_folder
from ..interrupts import insistent, worker_pool
from ..progress import progress_bar
from ..recording import InputError
from .described import ROLES, read_run
from .execute import ConstraintsNotMet, RunInterrupted, run
from .folder import check_own


def run_command(options: argparse.Namespace) -> int:
    """Execute a run file; returns the exit status: 1 where no job meets its constraints or explains anything."""
    given = read_run(options.run_file)
    if options.out is not None:
        check_own(Path(options.out), given.file, options.overwrite)
        given = replace(given, out=make_folder(options.out))
    if options.workers is not None:
        if options.workers < 1:
            raise InputError(f"--workers {options.workers} was given; give 1 or more.")
        given = replace(given, workers=options.workers)
    print(
        f"run: {given.file}, {len(given.seeds)} job{'s' * (len(given.seeds) > 1)}, results in {given.out}", flush=True
    )
    try:
        with worker_pool(given.workers) as pool, progress_bar() as bar, insistent(bar) as progress:
            result = run(given, overwrite=options.overwrite, executor=pool, progress=progress, tell=_tell)
    except RunInterrupted as stop:
        return say(f"Interrupted; {stop}, the same command goes on from there.", INTERRUPTED)
    except ConstraintsNotMet as missed:
        return say(str(missed), NO_RESULT)
    for role in ROLES:
        for s in result.scores:
            if s.role == role and s.job == result.chosen:
                print(f"NRMSE on {s.recording} ({role}): {s.nrmse:.4f}")
    print(f"chosen: {result.chosen}; {len(result.done)} jobs done now, {len(result.skipped)} before")
    if len(given.seeds) > 1 and result.fit.candidates and not any(c.drawn for c in result.fit.candidates):
        print("no start is drawn where there are so few: every seed gives the same model; use one seed, or more starts")
    for name in ("results.csv", "model.json", *(["report.html"] if given.report else []), "manifest.json"):
        print(result.folder / name)
    useless = min(result.fit.train_nrmse) >= 1.0
    return say("The model explains nothing of the training recording.", NO_RESULT) if useless else DONE


def _tell(line: str) -> None:
    print(line, flush=True)
