"""Executing a run: finished jobs stay, and those that are missing or depend on something changed are done.

After every job its model is written, then the manifest, each atomically: wherever a run ends, by Ctrl-C, `kill -9` or a
power cut, the next one goes on with the first job that is not complete, and the results are those of a run that was
never interrupted. Executed twice on a machine, a run gives the same bytes in every file but `times.json`.

`run` does the jobs one after the other. `campaign` does them side by side, over processes, a cluster, or any other
executor; a job that fails, takes too long or loses its worker has an outcome too, the table of errors can be read at
any time, and a summary with box plots ends it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .._base import InputError, Progress, deferred_interrupt, digest, make_folder, whole
from ..data import Recording, keeps_its_period, read
from ..identify import Fit, is_drawn
from ..models import PILFR, places
from ..optimise import Status
from .executor import AHEAD, do_side_by_side
from .folder import MODEL, PAGE, PICTURE, SUMMARY, TABLE, Store, check_own, locked, read_times
from .jobs import Batch, RunJob, fold, input_digests, jobs_of, outcome
from .schema import ROLES, Cell, Run, read_run
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

FITTED = "the structure is chosen on what was fitted, which favours the larger; add folds or validation recordings"
Tell = Callable[[str], None]
Perform = Callable[[Store, Sequence[RunJob]], Iterator[Batch]]


class RunInterrupted(KeyboardInterrupt):
    """Ctrl-C in a run; `done` of `total` jobs are complete and stay so."""

    def __init__(self, done: int, total: int) -> None:
        super().__init__(f"{done} of {total} jobs are done")
        self.done, self.total = done, total


class NoModel(InputError):
    """No job of a run gave a model, and not because of its input; the manifest has the reason for each."""


class ConstraintsNotMet(NoModel):
    """No job of a run meets its constraints; the manifest says by how much each misses them."""


@dataclass(frozen=True, eq=False)
class RunResult:
    """A run that is complete.

    Attributes
    ----------
    folder : Path
        With `manifest.json`, `results.csv`, `jobs/ID/model.json`, and `model.json`, `report.html` of the job chosen; of
        a campaign with `summary.csv` and `spread.png` too. `times.json` says how long each job took.
    done, skipped, failed : tuple of str
        Ids of the jobs that were executed now, of those that had been before, and of those among both without a model.
    chosen : str
        Id of the job of the smallest error on the validation recordings, without any on the training; where a structure
        is selected, among its jobs.
    scores : tuple of Score
        Errors of every job on every recording.
    fit : Fit
        The model that is chosen.
    manifest : dict
        The content of `manifest.json`.
    summary : tuple of CellSummary
        Quartiles and failures of every cell of the grid on every recording.
    selection : Selection or None
        The structure that is recommended, where there are several and recordings or folds to judge them by.
    note : str
        A warning on the choice: that it was made among structures by what they were fitted to.
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
    tell: Tell | None = None,
) -> RunResult:
    """Execute a run file.

    Parameters
    ----------
    path : path or Run
        The file, `.toml` or `.py`, or the result of `read_run`.
    out : path, optional
        Folder of the results, in place of the file's: an empty one, a new one, or that of an earlier run.
    overwrite : bool
        Compute everything again, whatever an earlier run has left in the folder.
    engine : {"auto", "c", "vm"}, optional
        In place of the file's; results differ in the last digits, so keep to one.
    executor : concurrent.futures.Executor, optional
        Where the starts of a job run; the numbers are the same.
    progress : callable
        Gets (stage, done, total, smallest training error so far).
    tell : callable
        Gets a line of text after every job.

    Returns
    -------
    RunResult

    Raises
    ------
    InputError
        If the run file, a recording or the folder cannot be used, or results were changed afterwards;
        `NoModel`, which is one, if no job gives a model, and `ConstraintsNotMet` if none meets its constraints.
    RunInterrupted
        On Ctrl-C; complete jobs stay.
    """
    given = _read_run(path, "run", executor, out=out, engine=engine)

    def in_turn(place: Store, jobs: Sequence[RunJob]) -> Iterator[Batch]:
        for job in jobs:
            yield [(job, outcome(given, place.recordings, job, executor=executor, progress=progress))]

    return _execute(given, in_turn, overwrite, progress, tell)


def campaign(
    path: Any,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    ahead: int = AHEAD,
    out: Any = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    tell: Tell | None = None,
) -> RunResult:
    """Execute all jobs of a run file, every cell of its grid with every seed, side by side.

    The numbers depend neither on the executor nor on the number of workers or the order in which they answer, as long
    as the workers are of one kind (processor, libraries). Called again, however it ended, it goes on with the jobs that
    are not complete.

    Parameters
    ----------
    workers : int, optional
        Processes, in place of the file's; 1 without a time limit is this process.
    executor : concurrent.futures.Executor, optional
        Where jobs run in place of these, for example `dask.distributed.Client(address).get_executor()`. Each of its
        workers does its jobs in a process beside it.
    ahead : int
        How many jobs the executor is given at a time; at least as many as it has workers.
    path, out, overwrite, progress, tell
        As for `run`.

    Returns
    -------
    RunResult

    Raises
    ------
    InputError
        As for `run`; also if earlier results are of other versions, the executor stops, or its workers are unfit.
    RunInterrupted
        On Ctrl-C; complete jobs stay.
    """
    workers = None if workers is None else whole(workers, "workers", 1)
    given = _read_run(path, "campaign", executor, out=out, workers=workers)
    for cell in given.cells if len(given.seeds) > 1 else ():
        advice = seeds_advice(cell)
        if advice and cell.model.element is not None:  # a linear model may be one of a grid
            raise InputError(f"{given.file}: {len(given.seeds)} seeds were given, but {advice}.")

    def in_processes(place: Store, jobs: Sequence[RunJob]) -> Iterator[Batch]:
        return do_side_by_side(given, place.recordings, jobs, executor, ahead)

    return _execute(given, in_processes, overwrite, progress, tell, campaign=True)


def _read_run(path: Any, kind: str, executor: Any, **changes: Any) -> Run:
    """Return the run with what is given in place of the file's."""
    given = path if isinstance(path, Run) else read_run(path, kind)
    if executor is not None and not callable(getattr(executor, "submit", None)):
        raise InputError(f"executor = {executor!r} was given; give a concurrent.futures.Executor, or leave it out.")
    return replace(given, **{name: value for name, value in changes.items() if value is not None})


def seeds_advice(cell: Cell) -> str:
    """Say why every seed gives the same model of a cell, and what to do; empty where starts are random."""
    model, start, starts = cell.model, cell.search.get("start", ""), cell.search.get("starts", 1)
    if not isinstance(model, PILFR):
        return ""
    if model.element is None:
        return "a linear model has no starts, so every seed gives the same one; use one seed"
    first = len(places(model))
    if any(is_drawn(model, start, i) for i in range(min(starts, first + 1))):
        return ""
    more = f", or {first + 1} starts or more" if is_drawn(model, start, first) else ""
    return f"no start is random, so every seed gives the same model; use one seed, start = 'paper' in [solver]{more}"


def _execute(
    given: Run,
    perform: Perform,
    overwrite: bool,
    progress: Progress | None,
    tell: Tell | None,
    campaign: bool = False,
) -> RunResult:
    """Execute a run whose jobs `perform` does, in any order."""
    folder = Path(given.out)
    check_own(folder, given.file, overwrite)
    inputs = input_digests(given)
    recordings = {role: tuple(_read(given, name) for name in given.files[role]) for role in ROLES}
    if given.folds:
        fold(recordings["train"], 0, given.folds)  # refuses recordings that are too short for it
    make_folder(folder)
    with locked(folder):
        place = Store(folder, given, inputs, recordings, overwrite, campaign)
        return _Execution(place, perform, progress or (lambda *_: None), tell or (lambda line: None)).execute()


class _Execution:
    """The jobs of a run in a folder: those of the cross-validation first, then those on all of the training."""

    def __init__(self, place: Store, perform: Perform, progress: Progress, tell: Tell) -> None:
        self.place, self.perform, self.progress, self.tell = place, perform, progress, tell
        self.done: list[str] = []
        self.skipped: list[str] = []
        self.total = 0

    def execute(self) -> RunResult:
        """Do all jobs that are not complete, then choose among their models."""
        try:
            jobs, selection = self._do_jobs()
            return self._finish(jobs, selection)
        except KeyboardInterrupt:
            raise RunInterrupted(len(self.done) + len(self.skipped), self.total) from None

    def _do_jobs(self) -> tuple[Sequence[RunJob], Selection | None]:
        place, given = self.place, self.place.run
        first = place.recordings["train"][0]
        folds: tuple[RunJob, ...] = ()
        selection = None
        jobs = jobs_of(given, place.inputs)
        self.total = len(jobs)
        if given.folds:
            folds = jobs_of(given, place.inputs, place.recordings["train"])
            self._do_missing(folds)
            selection = select(given, folds, place.scores(folds), place.entries, first)
            jobs = tuple(j for j in jobs if j.cell == selection.cell)
        self._do_missing(jobs, folds)
        if not given.folds and given.files["validation"] and len(given.cells) > 1:
            selection = select(given, jobs, place.scores(jobs), place.entries, first)
        return (*folds, *jobs), selection

    def _do_missing(self, jobs: Sequence[RunJob], before: Sequence[RunJob] = ()) -> None:
        """Do those jobs that are not complete."""
        place = self.place
        self.total = total = len(before) + len(jobs)
        ready = [j for j in jobs if place.complete(j)]
        self.skipped += [j.id for j in ready]
        if ready:
            self.tell(f"{len(ready)} jobs done before")
        place.write_table((*before, *ready))
        ready_ids = {j.id for j in ready}
        try:
            for batch in self.perform(place, [j for j in jobs if j.id not in ready_ids]):
                with deferred_interrupt():  # a job that is done must not be lost
                    place.note(batch)
                    ready += [job for job, _ in batch]
                    self.done += [job.id for job, _ in batch]
                for job, found in batch:
                    none = f"no model ({found.entry['status'].lower().replace('_', ' ')})"
                    self.tell(f"{job.id}: {found.entry['sentence'] if place.ended_well(job) else none}")
                place.write_table((*before, *ready))
                best = min(place.entries[j.id].get("train", np.inf) for j in ready)
                self.progress("jobs", len(before) + len(ready), total, best)
        finally:
            with deferred_interrupt():  # however it ends, the table has all jobs that are done
                place.write_table((*before, *ready), last=True)

    def _finish(self, jobs: Sequence[RunJob], selection: Selection | None) -> RunResult:
        """Write errors, tables, and model and page of the job that is chosen."""
        place, given = self.place, self.place.run
        manifest, entries = place.manifest, place.entries
        usable = self._usable([j for j in jobs if j.fold is None and (selection is None or j.cell == selection.cell)])
        scores = place.scores(jobs, last=True)
        best = choose_job(scores, [j.id for j in usable])
        job = next(j for j in usable if j.id == best)
        times = read_times(place.path)
        fit = replace(place.load(job), engine=given.engine)
        summary = summarise(given, jobs, scores, times, entries)
        note = FITTED if len(given.cells) > 1 and selection is None else ""
        manifest.content.pop("choice", None)
        manifest.content |= {"chosen": best, **({"choice": note} if note else {})}
        manifest.put(TABLE, results_table(scores, jobs, entries, best))
        manifest.put(MODEL, (place.path / job.model_file).read_text(encoding="utf-8"))
        if place.campaign:
            manifest.put(SUMMARY, summary_table(given, summary))
            manifest.put(PICTURE, box_plots(given, jobs, scores))
        if given.report:
            self._write_page(fit)
        manifest.content.pop("writing", None)
        manifest.write()
        failed = tuple(j.id for j in jobs if not place.ended_well(j))
        fit = replace(fit, seconds=times.get(best, 0.0))
        parts = tuple(self.done), tuple(self.skipped), failed
        return RunResult(place.path, *parts, best, tuple(scores), fit, manifest.content, summary, selection, note)

    def _usable(self, jobs: Sequence[RunJob]) -> list[RunJob]:
        """Return the jobs with a model."""
        file, entries = self.place.run.file, self.place.entries
        usable = [j for j in jobs if self.place.has_model(j)]
        if not usable:
            about = "; ".join(reasons(entries, [j.id for j in jobs]))
            if all(entries[j.id]["status"] == Status.INFEASIBLE.name for j in jobs):
                raise ConstraintsNotMet(f"{file}: no job meets its constraints; {about}")
            kind = InputError if all(entries[j.id].get("refused") for j in jobs) else NoModel
            raise kind(f"{file}: no job gave a model; {about}")
        return usable

    def _write_page(self, fit: Fit) -> None:
        """Write the page about the model that is chosen, unless it is there."""
        place, given, manifest = self.place, self.place.run, self.place.manifest
        key = digest([manifest.content["files"][MODEL], place.inputs, given.files, str(given.reading)])
        if manifest.content.get("report") == key and manifest.holds(PAGE):
            return
        from ..report import fit_page

        self.tell("writing the report")
        self.progress("writing the report", 0, 0, np.nan)
        judged = place.recordings["validation"] + place.recordings["test"]
        manifest.put(PAGE, fit_page(fit, place.recordings["train"], judged, model_file=MODEL).html())
        manifest.content["report"] = key


def _read(given: Run, name: str) -> Recording:
    options = dict(given.reading)
    found = read(given.located(name), options.pop("inputs"), options.pop("outputs"), **options)
    if not keeps_its_period(found):
        raise InputError(
            f'{given.file}: the input of {name} does not repeat after {found.period} samples, as initial = "periodic" '
            'says of every recording of the run; correct `period`, or give initial = "estimate".'
        )
    return found
