"""Execute a run: keep finished jobs, execute missing or outdated ones.

Every job writes its model, then the manifest, each atomically. However a run ends (Ctrl-C, `kill -9`, a power cut), the
next one continues with the first job that is not complete and gives the same results as an uninterrupted run. On one
machine, every execution of a run writes the same bytes to all files except `times.json`.

`run` executes the jobs one after the other. `campaign` executes them side by side, in processes, on a cluster, or on
any other executor. A job that fails, takes too long or loses its worker is recorded too. The table of errors can be
read at any time, and a campaign ends with a summary and box plots.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .._base import InputError, Progress, check_executor, deferred_interrupt, digest, make_folder, whole
from ..data import Recording, keeps_its_period, read
from ..identify import Fit, is_drawn
from ..models import PILFR, places
from ..optimise import Status
from .executor import AHEAD, Batch, Effort, run_side_by_side
from .folder import PAGE, PICTURE, SUMMARY, TABLE, check_own, lock_folder, read_times
from .jobs import MODEL, RunJob, execute_job, fold, input_digests, jobs_of
from .run_file import ROLES, Cell, Run, read_run
from .store import Store
from .summary import (
    CellSummary,
    Score,
    Selection,
    box_plots,
    choose_job,
    reasons,
    results_table,
    select,
    summarise,
    summary_table,
)

CHOSEN_ON_TRAINING = (
    "the structure is chosen on the training recordings, which favours larger models; "
    "add folds or validation recordings"
)
PrintLine = Callable[[str], None]
Runner = Callable[[Store, Sequence[RunJob]], Iterator[Batch]]


class RunInterrupted(KeyboardInterrupt):
    """Ctrl-C in a run; `done` of `total` jobs are complete and are kept."""

    def __init__(self, done: int, total: int) -> None:
        super().__init__(f"{done} of {total} jobs are done")
        self.done, self.total = done, total


class NoModel(InputError):
    """No job of a run gave a model, although its input was usable; the manifest states each reason."""


class ConstraintsNotMet(NoModel):
    """No job of a run meets its constraints; the manifest states by how much each job violates them."""


@dataclass(frozen=True, eq=False)
class RunResult:
    """The result of a complete run.

    Attributes
    ----------
    folder : Path
        Holds `manifest.json`, `results.csv`, `jobs/ID/model.json`, and `model.json` and `report.html` of the chosen
        job; after a campaign also `summary.csv` and `spread.png`. `times.json` holds the time of each job.
    done, skipped, failed : tuple of str
        Ids of the jobs executed now, of the jobs executed before, and of all jobs without a model.
    chosen : str
        Id of the job with the smallest validation error (training error if there are no validation recordings); if a
        structure was selected, only its jobs count.
    scores : tuple of Score
        Errors of every job on every recording.
    fit : Fit
        The model of the chosen job.
    manifest : dict
        The content of `manifest.json`.
    summary : tuple of CellSummary
        Quartiles and failures of every cell of the grid on every recording.
    selection : Selection or None
        The recommended structure, if there are several, and folds or validation recordings to judge them by.
    note : str
        A warning if structures were compared on the recordings they were fitted to.
    """

    folder: Path
    done: tuple[str, ...]
    skipped: tuple[str, ...]
    failed: tuple[str, ...]
    chosen: str
    scores: tuple[Score, ...]
    fit: Fit
    manifest: dict[str, Any]
    summary: tuple[CellSummary, ...] = ()
    selection: Selection | None = None
    note: str = ""


def run(
    path: Any,
    *,
    out: Any = None,
    overwrite: bool = False,
    engine: str | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
    tell: PrintLine | None = None,
) -> RunResult:
    """Execute a run file.

    Parameters
    ----------
    path : path or Run
        The file, `.toml` or `.py`, or the result of `read_run`.
    out : path, optional
        Folder of the results, instead of the folder in the file: empty, new, or from an earlier run.
    overwrite : bool
        Compute everything again, even if the folder has results of an earlier run.
    engine : {"auto", "c", "vm"}, optional
        Engine instead of the one in the file. Results of the engines may differ in the last digits, so keep to one.
    executor : concurrent.futures.Executor, optional
        Executor for the starts of a job; it does not change the numbers.
    progress : callable
        Called with (stage, done, total, smallest training error so far).
    tell : callable
        Called with a line of text after every job.

    Returns
    -------
    RunResult

    Raises
    ------
    InputError
        If the run file, a recording or the folder cannot be used, or results were changed afterwards. Its subclass
        `NoModel` is raised if no job gives a model, `ConstraintsNotMet` if no job meets its constraints.
    RunInterrupted
        On Ctrl-C; complete jobs are kept.
    """
    given = _read_run(path, "run", executor, out=out, engine=engine)

    def run_in_turn(store: Store, jobs: Sequence[RunJob]) -> Iterator[Batch]:
        for job in jobs:
            yield [(job, execute_job(given, store.recordings, job, executor=executor, progress=progress))]

    return _execute(given, run_in_turn, overwrite, progress, tell)


def campaign(
    path: Any,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    ahead: int = AHEAD,
    out: Any = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    tell: PrintLine | None = None,
) -> RunResult:
    """Execute all jobs of a run file, every cell of its grid with every seed, side by side.

    The numbers depend neither on the executor nor on the number of workers or the order of their answers, provided that
    all workers have the same kind of processor and the same libraries. Called again, it continues with the jobs that
    are not complete.

    Parameters
    ----------
    workers : int, optional
        Number of processes, instead of the number in the file; 1 without a time limit runs in this process.
    executor : concurrent.futures.Executor, optional
        Runs the jobs instead of these processes, for example `dask.distributed.Client(address).get_executor()`. Each
        worker runs its jobs in a process beside it.
    ahead : int
        Number of jobs submitted to the executor at a time; at least its number of workers.
    path, out, overwrite, progress, tell
        As for `run`.

    Returns
    -------
    RunResult

    Raises
    ------
    InputError
        As for `run`; also if earlier results come from other versions, the executor stops, or its workers cannot run
        this package.
    RunInterrupted
        On Ctrl-C; complete jobs are kept.
    """
    workers = None if workers is None else whole(workers, "workers", 1)
    given = _read_run(path, "campaign", executor, out=out, workers=workers)
    for cell in given.cells if len(given.seeds) > 1 else ():
        advice = seeds_advice(cell)
        if advice and cell.model.element is not None:  # a linear model may be one of a grid
            raise InputError(f"{given.file}: {len(given.seeds)} seeds were given, but {advice}.")

    def run_in_processes(store: Store, jobs: Sequence[RunJob]) -> Iterator[Batch]:
        work = functools.partial(execute_job, given, store.recordings)
        effort = Effort(given.workers, given.time_limit, given.retries)
        return run_side_by_side(work, jobs, effort, executor, ahead)

    return _execute(given, run_in_processes, overwrite, progress, tell, campaign=True)


def _read_run(path: Any, kind: str, executor: Any, **changes: Any) -> Run:
    """Read the run; `changes` that are not None override values of the file."""
    given = path if isinstance(path, Run) else read_run(path, kind)
    check_executor(executor)
    return replace(given, **{name: value for name, value in changes.items() if value is not None})


def seeds_advice(cell: Cell) -> str:
    """Explain why every seed gives a cell the same model, and what to change; empty if starts are random."""
    model, start, starts = cell.model, cell.search.get("start", ""), cell.search.get("starts", 1)
    if not isinstance(model, PILFR):
        return ""
    if model.element is None:
        return "a linear model has no starts, so every seed gives the same model; use one seed"
    first = len(places(model))
    if any(is_drawn(model, start, i) for i in range(min(starts, first + 1))):
        return ""
    more = f", or {first + 1} starts or more" if is_drawn(model, start, first) else ""
    return f"no start is random, so every seed gives the same model; use one seed, start = 'paper' in [solver]{more}"


def _execute(
    given: Run,
    runner: Runner,
    overwrite: bool,
    progress: Progress | None,
    print_line: PrintLine | None,
    campaign: bool = False,
) -> RunResult:
    """Execute a run; `runner` executes the jobs, in any order."""
    folder = Path(given.out)
    check_own(folder, given.file, overwrite)
    inputs = input_digests(given)
    recordings = {role: tuple(_read_recording(given, name) for name in given.files[role]) for role in ROLES}
    if given.folds:
        fold(recordings["train"], 0, given.folds)  # refuses recordings that are too short
    make_folder(folder)
    with lock_folder(folder):
        store = Store(folder, given, inputs, recordings, overwrite, campaign)
        return _Execution(store, runner, progress or (lambda *_: None), print_line or (lambda line: None)).execute()


class _Execution:
    """The execution of a run: first the cross-validation, then the jobs on all training recordings."""

    def __init__(self, store: Store, runner: Runner, progress: Progress, print_line: PrintLine) -> None:
        self.store, self.runner, self.progress, self.print_line = store, runner, progress, print_line
        self.done: list[str] = []
        self.skipped: list[str] = []
        self.total = 0

    def execute(self) -> RunResult:
        """Execute all jobs that are not complete, then choose among their models."""
        try:
            jobs, selection = self._run_jobs()
            return self._finish(jobs, selection)
        except KeyboardInterrupt:
            raise RunInterrupted(len(self.done) + len(self.skipped), self.total) from None

    def _run_jobs(self) -> tuple[Sequence[RunJob], Selection | None]:
        store, given = self.store, self.store.run
        first = store.recordings["train"][0]
        folds: tuple[RunJob, ...] = ()
        selection = None
        jobs = jobs_of(given, store.inputs)
        self.total = len(jobs)
        if given.folds:
            folds = jobs_of(given, store.inputs, store.recordings["train"])
            self._run_missing(folds)
            selection = select(given, folds, store.scores(folds), store.manifest.entries, first)
            jobs = tuple(j for j in jobs if j.cell == selection.cell)
        self._run_missing(jobs, folds)
        if not given.folds and given.files["validation"] and len(given.cells) > 1:
            selection = select(given, jobs, store.scores(jobs), store.manifest.entries, first)
        return (*folds, *jobs), selection

    def _run_missing(self, jobs: Sequence[RunJob], before: Sequence[RunJob] = ()) -> None:
        """Execute the jobs that are not complete; the jobs `before` are."""
        store = self.store
        self.total = total = len(before) + len(jobs)
        ready = [j for j in jobs if store.is_complete(j)]
        self.skipped += [j.id for j in ready]
        if ready:
            self.print_line(f"{len(ready)} jobs done before")
        store.write_table((*before, *ready))
        ready_ids = {j.id for j in ready}
        try:
            for batch in self.runner(store, [j for j in jobs if j.id not in ready_ids]):
                if batch:
                    with deferred_interrupt():  # a finished job must not be lost
                        self._record(batch)
                        ready += [job for job, _ in batch]
                    store.write_table((*before, *ready))
                best = min((store.manifest.entries[j.id].get("train", np.inf) for j in ready), default=np.inf)
                self.progress("jobs", len(before) + len(ready), total, best)
        finally:
            with deferred_interrupt():  # the table has all finished jobs, however the run ends
                store.write_table((*before, *ready), last=True)

    def _record(self, batch: Batch) -> None:
        """Record finished jobs, and print a line about each."""
        self.store.record(batch)
        self.done += [job.id for job, _ in batch]
        for job, found in batch:
            failure = f"no model ({found.entry['status'].lower().replace('_', ' ')})"
            self.print_line(f"{job.id}: {found.entry['sentence'] if self.store.gave_model(job) else failure}")

    def _finish(self, jobs: Sequence[RunJob], selection: Selection | None) -> RunResult:
        """Write the tables, and the model and page of the chosen job."""
        store, given = self.store, self.store.run
        manifest, entries = store.manifest, store.manifest.entries
        usable = self._select_usable(jobs, selection)
        scores = store.scores(jobs, last=True)
        best = choose_job(scores, [j.id for j in usable])
        job = next(j for j in usable if j.id == best)
        times = read_times(store.path)
        fit = replace(store.load(job), engine=given.engine)
        summary = summarise(given, jobs, scores, times, entries)
        note = CHOSEN_ON_TRAINING if len(given.cells) > 1 and selection is None else ""
        manifest.content.pop("choice", None)
        manifest.content |= {"chosen": best, **({"choice": note} if note else {})}
        model = (store.path / job.model_file).read_text(encoding="utf-8")
        manifest.put({TABLE: results_table(scores, jobs, entries, best), MODEL: model})
        if store.campaign:
            manifest.put({SUMMARY: summary_table(given, summary), PICTURE: box_plots(given, jobs, scores)})
        if given.report:
            self._write_page(fit)
        manifest.content.pop("writing", None)
        manifest.write()
        failed = tuple(j.id for j in jobs if not store.gave_model(j))
        fit = replace(fit, seconds=times.get(best, 0.0))
        parts = tuple(self.done), tuple(self.skipped), failed
        return RunResult(store.path, *parts, best, tuple(scores), fit, manifest.content, summary, selection, note)

    def _select_usable(self, jobs: Sequence[RunJob], selection: Selection | None) -> list[RunJob]:
        """Return the jobs of the selected cell that have a model; refuse a run without any."""
        file, entries = self.store.run.file, self.store.manifest.entries
        jobs = [j for j in jobs if j.fold is None and (selection is None or j.cell == selection.cell)]
        usable = [j for j in jobs if self.store.has_model(j)]
        if not usable:
            about = "; ".join(reasons(entries, [j.id for j in jobs]))
            if all(entries[j.id]["status"] == Status.INFEASIBLE.name for j in jobs):
                raise ConstraintsNotMet(f"{file}: no job meets its constraints; {about}")
            kind = InputError if all(entries[j.id].get("refused") for j in jobs) else NoModel
            raise kind(f"{file}: no job gave a model; {about}")
        return usable

    def _write_page(self, fit: Fit) -> None:
        """Write the page about the chosen model, unless it is up to date."""
        store, given, manifest = self.store, self.store.run, self.store.manifest
        key = digest([manifest.content["files"][MODEL], store.inputs, given.files, str(given.reading)])
        if manifest.content.get("report") == key and manifest.holds(PAGE):
            return
        from ..report import fit_page

        self.print_line("writing the report")
        self.progress("writing the report", 0, 0, np.nan)
        judged = store.recordings["validation"] + store.recordings["test"]
        manifest.put({PAGE: fit_page(fit, store.recordings["train"], judged, model_file=MODEL).html()})
        manifest.content["report"] = key


def _read_recording(given: Run, name: str) -> Recording:
    options = dict(given.reading)
    found = read(given.path_of(name), options.pop("inputs"), options.pop("outputs"), **options)
    if not keeps_its_period(found):
        raise InputError(
            f'{given.file}: the input of {name} does not repeat after {found.period} samples, but initial = "periodic" '
            'claims this for every recording of the run; correct `period`, or give initial = "estimate".'
        )
    return found
