"""A campaign: the jobs of a run file side by side, over processes, a cluster, or any other executor.

It differs from `run` in how the jobs are done and in what it tells of them: a job that fails, takes too long or loses
its worker is a result too, the table of errors can be read while it is at work, and a summary with box plots ends it.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from typing import Any

from .._base import InputError, Progress, close_hands
from ..identify import drawn
from ..models import PILFR, places
from .described import Run, read_run
from .execute import RunResult, carried_out
from .executor import AHEAD, Sent, check_executor, side_by_side
from .grid import Cell
from .jobs import Batch, Recordings, RunJob, attempt


def campaign(
    path: Any,
    *,
    out: Any = None,
    overwrite: bool = False,
    workers: int | None = None,
    executor: Executor | None = None,
    ahead: int = AHEAD,
    progress: Progress | None = None,
    tell: Callable[[str], None] | None = None,
) -> RunResult:
    """Execute all jobs of a run file, every cell of its grid with every seed, side by side.

    The numbers depend neither on the executor nor on the number of workers or the order in which they answer, as long
    as the workers are of one kind (processor, libraries). Called again, after whatever has ended it, it goes on with
    the jobs that are not complete.

    Parameters
    ----------
    path : path or Run
        The file, `.toml` or `.py`, or what `read_run` made of it.
    out : path, optional
        Folder of the results, in place of the file's.
    overwrite : bool
        Compute everything again, whatever is in the folder.
    workers : int, optional
        Processes, in place of the file's; 1 without a time limit is this process.
    executor : concurrent.futures.Executor, optional
        Where jobs run in place of these, for example `dask.distributed.Client(address).get_executor()`. Each of its
        workers does its jobs in a process beside it.
    ahead : int
        How many jobs the executor is given at a time; at least as many as it has workers.
    progress : callable
        Gets ("jobs", done, total, smallest training error so far).
    tell : callable
        Gets a line of text after every job.

    Returns
    -------
    RunResult

    Raises
    ------
    InputError
        If the run file or a recording cannot be used, no job gives a model, results were changed afterwards or are of
        other versions, the executor stops, or its workers are unfit.
    RunInterrupted
        On Ctrl-C; what is complete stays.
    """
    given = path if isinstance(path, Run) else read_run(path, "campaign")
    if workers is not None:
        if not isinstance(workers, int) or isinstance(workers, bool) or workers < 1:
            raise InputError(f"workers = {workers!r} was given; give a whole number, 1 or more.")
        given = replace(given, workers=workers)
    check_executor(executor)
    _check_seeds(given)
    perform = functools.partial(_perform, executor, ahead)
    return carried_out(given, perform, out, overwrite, progress, tell, campaign=True)


def seeds_advice(cell: Cell) -> str:
    """Say why every seed gives the same model of a cell, and what to do; empty where starts are random."""
    model, start, starts = cell.model, cell.search.get("start", ""), cell.search.get("starts", 1)
    if not isinstance(model, PILFR):
        return ""
    if model.element is None:
        return "a linear model has no starts, so every seed gives the same one; use one seed"
    if any(drawn(model, start, i) for i in range(min(starts, len(places(model)) + 1))):
        return ""
    first = len(places(model))
    more = f", or {first + 1} starts or more" if drawn(model, start, first) else ""
    return f"no start is random, so every seed gives the same model; use one seed, start = 'paper' in [solver]{more}"


def _check_seeds(run: Run) -> None:
    """Refuse seeds that would all give the same model; a linear model in a grid of others is none of them."""
    for cell in run.cells if len(run.seeds) > 1 else ():
        advice = seeds_advice(cell)
        if advice and cell.model.element is not None:
            raise InputError(f"{run.file}: {len(run.seeds)} seeds were given, but {advice}.")


def _perform(
    executor: Executor | None, ahead: int, given: Run, recordings: Recordings, jobs: Sequence[RunJob]
) -> Iterator[Batch]:
    options: dict[str, Any] = {"time_limit": given.time_limit, "retries": given.retries}
    function: Any = Sent(given, recordings)
    if executor is not None:
        yield from side_by_side(function, jobs, executor, ahead=ahead, **options)
    elif given.workers > 1 or given.time_limit is not None:
        pool = ThreadPoolExecutor(given.workers)
        try:
            yield from side_by_side(function, jobs, pool, ahead=2 * given.workers, **options)
        finally:
            _end(pool)
    else:
        for job in jobs:
            yield [(job, attempt(given, recordings, job))]


def _end(pool: ThreadPoolExecutor) -> None:
    """End a pool and its hands, those too that its threads have just been about to begin."""
    pool.shutdown(wait=False, cancel_futures=True)
    ending = threading.Thread(target=pool.shutdown, daemon=True)
    ending.start()
    while ending.is_alive():
        close_hands()
        ending.join(0.02)
    close_hands()
