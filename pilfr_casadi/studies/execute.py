"""Executing a run: what has been done is left as it is, what is missing or depends on something changed is done.

After every job its model is written, then the manifest, each atomically: wherever a run ends, by Ctrl-C, `kill -9` or a
power cut, the next one goes on with the first job that is not complete, and the results are those of a run that was
never interrupted. Executed twice on a machine, a run gives the same bytes in every file but `times.json`.

`run` does the jobs one after the other, `campaign` (in its own file) many side by side; all else is the same.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .._base import InputError, Progress, deferred_interrupt
from ..data import Recording, keeps_its_period, read
from ..export import digest, made
from ..identify import Fit, load
from ..models import Model
from ..optimise import Status
from .described import ROLES, Run, read_run
from .executor import check_executor
from .folder import MODEL, PAGE, PICTURE, SUMMARY, TABLE, check_own, read_times, sweep
from .folds import fold
from .jobs import Batch, Recordings, RunJob, input_digests, jobs_of, outcome
from .manifest import alone
from .results import Score, chosen, reasons, table
from .selection import Selection, select
from .store import Store
from .summary import CellSummary, box_plots, summarised, summary_table

FITTED = "the structure is chosen on what was fitted, which favours the larger; add folds or validation recordings"
Tell = Callable[[str], None]
Perform = Callable[[Run, Recordings, Sequence[RunJob]], Iterator[Batch]]


class RunInterrupted(KeyboardInterrupt):
    """Ctrl-C in a run; `done` of `total` jobs are complete and stay so."""

    def __init__(self, done: int, total: int) -> None:
        super().__init__(f"{done} of {total} jobs are done")
        self.done, self.total = done, total


class NoModel(InputError):
    """No job of a run gave a model, and not because of what it was given; the manifest says why of each."""


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
        What `manifest.json` says.
    summary : tuple of CellSummary
        Quartiles and failures of every cell of the grid on every recording.
    selection : Selection or None
        The structure that is recommended, where there are several and recordings or folds to judge them by.
    note : str
        What to know of the choice: that it was made among structures by what they were fitted to.
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
        The file, `.toml` or `.py`, or what `read_run` made of it.
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
        On Ctrl-C; what is complete stays.
    """
    given = path if isinstance(path, Run) else read_run(path)
    given = given if engine is None else replace(given, engine=engine)
    check_executor(executor)

    def in_turn(given: Run, recordings: Recordings, jobs: Sequence[RunJob]) -> Iterator[Batch]:
        for job in jobs:
            yield [(job, outcome(given, recordings, job, executor=executor, progress=progress))]

    return carried_out(given, in_turn, out, overwrite, progress, tell)


def carried_out(
    given: Run,
    perform: Perform,
    out: Any,
    overwrite: bool,
    progress: Progress | None,
    tell: Tell | None,
    *,
    campaign: bool = False,
) -> RunResult:
    """Execute a run whose jobs `perform` does, in any order; a campaign's tables can be read while it is at work."""
    folder = Path(out if out is not None else given.out)
    try:
        check_own(folder, given.file, overwrite)
    except OSError as error:
        raise InputError(f"The folder {folder} cannot be read ({error.strerror}); give another one.") from None
    inputs = input_digests(given)
    recordings = {role: tuple(_read(given, name) for name in given.files[role]) for role in ROLES}
    if given.folds:
        fold(recordings["train"], 0, given.folds)  # refuses recordings that are too short for it
    made(folder)
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(alone(folder))
            sweep(folder)
        except OSError as error:
            raise InputError(f"The folder {folder} cannot be written ({error.strerror}); give another one.") from None
        place = Store(folder, given, inputs, recordings, overwrite, campaign)
        return _Execution(place, perform, progress or (lambda *_: None), tell or (lambda line: None)).carry_out()


class _Execution:
    """The jobs of a run in a folder: those of the cross-validation first, then those on all of the training."""

    def __init__(self, place: Store, perform: Perform, progress: Progress, tell: Tell) -> None:
        self.place, self.perform, self.progress, self.tell = place, perform, progress, tell
        self.done: list[str] = []
        self.skipped: list[str] = []
        self.total = 0

    def carry_out(self) -> RunResult:
        try:
            return self._carried_out()
        except KeyboardInterrupt:
            raise RunInterrupted(len(self.done) + len(self.skipped), self.total) from None

    def _carried_out(self) -> RunResult:
        place, given = self.place, self.place.run
        held: tuple[RunJob, ...] = ()
        selection = None
        jobs = jobs_of(given, place.inputs)
        self.total = len(jobs)
        if given.folds:
            held = jobs_of(given, place.inputs, place.recordings["train"])
            self._all(held)
            selection = select(place, held)
            jobs = tuple(j for j in jobs if j.cell == selection.cell)
        self._all(jobs, held)
        if not given.folds and given.files["validation"] and len(given.cells) > 1:
            selection = select(place, jobs)
        return self._finished((*held, *jobs), selection)

    def _all(self, jobs: Sequence[RunJob], before: Sequence[RunJob] = ()) -> None:
        """Do those jobs that are not complete."""
        place = self.place
        self.total = total = len(before) + len(jobs)
        ready = [j for j in jobs if place.complete(j)]
        self.skipped += [j.id for j in ready]
        if place.campaign and ready:
            self.tell(f"{len(ready)} jobs done before")
        for job in () if place.campaign else ready:
            self.tell(f"{job.id}: done before")
        place.write_table((*before, *ready))
        try:
            for batch in self.perform(place.run, place.recordings, [j for j in jobs if j not in ready]):
                with deferred_interrupt():  # what has been done is not to be lost
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
            with deferred_interrupt():  # however it ends, the table has all that is done
                place.write_table((*before, *ready), last=True)

    def _finished(self, jobs: Sequence[RunJob], selection: Selection | None) -> RunResult:
        """Errors, tables, and model and page of the job that is chosen."""
        place, given = self.place, self.place.run
        manifest, entries = place.manifest, place.entries
        whole = [j for j in jobs if j.fold is None and (selection is None or j.cell == selection.cell)]
        usable = [j for j in whole if place.has_model(j)]
        if not usable:
            about = "; ".join(reasons(entries, [j.id for j in whole]))
            if all(entries[j.id]["status"] == Status.INFEASIBLE.name for j in whole):
                raise ConstraintsNotMet(f"{given.file}: no job meets its constraints; {about}")
            kind = InputError if all(entries[j.id].get("refused") for j in whole) else NoModel
            raise kind(f"{given.file}: no job gave a model; {about}")
        scores = place.scores(jobs, last=True)
        best = chosen(scores, [j.id for j in usable])
        job = next(j for j in usable if j.id == best)
        times = read_times(place.path)
        fit = replace(self._model(job), engine=given.engine)
        summary = summarised(given, jobs, scores, times, entries)
        manifest.content["chosen"] = best
        manifest.content.pop("choice", None)
        note = FITTED if len(given.cells) > 1 and selection is None else ""
        if note:
            manifest.content["choice"] = note
        manifest.put(TABLE, table(scores, jobs, entries, best))
        manifest.put(MODEL, (place.path / job.model_file).read_text(encoding="utf-8"))
        if place.campaign:
            manifest.put(SUMMARY, summary_table(given, summary))
            manifest.put(PICTURE, box_plots(given, jobs, scores))
        key = digest([manifest.content["files"][MODEL], place.inputs, given.files, str(given.reading)])
        if given.report and (manifest.content.get("report") != key or not manifest.holds(PAGE)):
            from ..report import fit_page

            self.tell("writing the report")
            recordings = place.recordings
            judged = recordings["validation"] + recordings["test"]
            manifest.put(PAGE, fit_page(fit, recordings["train"], judged, model_file=MODEL).html())
            manifest.content["report"] = key
        manifest.content.pop("writing", None)
        manifest.write()
        failed = tuple(j.id for j in jobs if not place.ended_well(j))
        fit = replace(fit, seconds=times.get(best, 0.0))
        parts = tuple(self.done), tuple(self.skipped), failed
        return RunResult(place.path, *parts, best, tuple(scores), fit, manifest.content, summary, selection, note)

    def _model(self, job: RunJob) -> Fit:
        own = self.place.run.cells[job.cell].model
        return load(self.place.path / job.model_file, model=own if isinstance(own, Model) else None)


def _read(given: Run, name: str) -> Recording:
    options = dict(given.reading)
    inputs, outputs = options.pop("inputs"), options.pop("outputs")
    try:
        found = read(given.located(name), inputs, outputs, **options)
    except TypeError as error:
        raise InputError(f"{given.file}: {error}.") from None
    if not keeps_its_period(found):
        raise InputError(
            f'{given.file}: the input of {name} does not repeat after {found.period} samples, as initial = "periodic" '
            'says of every recording of the run; correct `period`, or give initial = "estimate".'
        )
    return found
