"""Executing a run: what has been done is left as it is, what is missing or depends on something changed is done.

After every job its model is written, then the manifest, each atomically: wherever a run ends, by Ctrl-C, `kill -9` or a
power cut, the next one goes on with the first job that is not complete, and the results are those of a run that was
never interrupted. Executed twice on a machine, a run gives the same bytes in every file but `times.json`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..export import load, made
from ..export.saving import model_text
from ..fitted import Fit
from ..model import Model
from ..readers import read
from ..recording import InputError, Recording
from ..solution import Status
from ..sparse import operators_used
from .described import ROLES, Run, read_run
from .folder import MODEL, PAGE, TABLE, check_own, note_time, read_times, sweep
from .jobs import RunJob, execute, input_digests, jobs_of, timeless
from .manifest import Manifest, alone, digest, versions
from .results import Score, chosen, scored, table

Progress = Callable[[str, int, int, float], None]


class RunInterrupted(KeyboardInterrupt):
    """Ctrl-C in a run; `done` of `total` jobs are complete and stay so."""

    def __init__(self, done: int, total: int) -> None:
        super().__init__(f"{done} of {total} jobs are done")
        self.done, self.total = done, total


class ConstraintsNotMet(InputError):
    """No job of a run meets its constraints; the manifest says by how much each misses them."""


@dataclass(frozen=True, eq=False)
class RunResult:
    """A run that is complete.

    Attributes
    ----------
    folder : Path
        With `manifest.json`, `results.csv`, `jobs/ID/model.json`, and `model.json`, `report.html` of the job chosen;
        `times.json` says how long each job took.
    done, skipped : tuple of str
        Ids of the jobs that were executed now, and of those that had been before.
    chosen : str
        Id of the job of the smallest error on the validation recordings, without any on the training.
    scores : tuple of Score
        Errors of every job on every recording.
    fit : Fit
        The model that is chosen.
    manifest : dict
        What `manifest.json` says.
    """

    folder: Path
    done: tuple[str, ...]
    skipped: tuple[str, ...]
    chosen: str
    scores: tuple[Score, ...]
    fit: Fit
    manifest: dict[str, Any]


def run(
    path: Any,
    *,
    out: Any = None,
    overwrite: bool = False,
    engine: str | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
    tell: Callable[[str], None] | None = None,
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
        `ConstraintsNotMet`, which is one, if no job meets its constraints.
    RunInterrupted
        On Ctrl-C; what is complete stays.
    """
    given = path if isinstance(path, Run) else read_run(path)
    tell = tell or (lambda line: None)
    given = given if engine is None else replace(given, engine=engine)
    folder = Path(out if out is not None else given.out)
    try:
        check_own(folder, given.file, overwrite)
    except OSError as error:
        raise InputError(f"The folder {folder} cannot be read ({error.strerror}); give another one.") from None
    inputs = input_digests(given)
    jobs = jobs_of(given, inputs)
    recordings = {role: tuple(_read(given, name) for name in given.files[role]) for role in ROLES}
    made(folder)
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(alone(folder))
            sweep(folder)
        except OSError as error:
            raise InputError(f"The folder {folder} cannot be written ({error.strerror}); give another one.") from None
        return _run(given, folder, inputs, jobs, recordings, overwrite, executor, progress, tell)


def _run(
    given: Run,
    folder: Path,
    inputs: dict[str, str],
    jobs: tuple[RunJob, ...],
    recordings: Mapping[str, tuple[Recording, ...]],
    overwrite: bool,
    executor: Executor | None,
    progress: Progress | None,
    tell: Callable[[str], None],
) -> RunResult:
    manifest = _manifest(folder, overwrite)
    entries = manifest.content["jobs"]
    ready = [j.id for j in jobs if _complete(manifest, j)]
    manifest.content |= {"run": {"file": given.file.name, "said": given.said}, "versions": versions(), "inputs": inputs}
    manifest.write()
    done: list[str] = []
    try:
        for job in jobs:
            if job.id in ready:
                tell(f"{job.id}: done before")
                continue
            fit = execute(given, job, recordings, executor=executor, progress=progress)
            if fit.status is Status.INTERRUPTED:
                raise KeyboardInterrupt
            entries[job.id] = _entry(job, fit)
            if fit.status is not Status.INFEASIBLE:
                manifest.put(job.model_file, model_text(timeless(fit)))
            manifest.write()
            note_time(folder, job.id, fit.seconds)
            done.append(job.id)
            tell(f"{job.id}: {entries[job.id]['sentence']}")
        return _finished(given, manifest, jobs, recordings, tuple(done), tuple(ready), tell)
    except KeyboardInterrupt:
        raise RunInterrupted(len(done) + len(ready), len(jobs)) from None


def _manifest(folder: Path, overwrite: bool) -> Manifest:
    """The folder's manifest, its results checked, or an empty one."""
    if overwrite:
        return Manifest.fresh(folder)
    manifest = Manifest.found(folder)
    if manifest is None:
        return Manifest.fresh(folder)
    for name in (TABLE, MODEL, PAGE):
        manifest.holds(name)
    return manifest


def _complete(manifest: Manifest, job: RunJob) -> bool:
    """Whether a job has been done from the same inputs, and its model is there as it was written."""
    entry = manifest.content["jobs"].get(job.id, {})
    if entry.get("key") != job.key:
        return False
    return entry.get("status") == Status.INFEASIBLE.name or manifest.holds(job.model_file)


def _entry(job: RunJob, fit: Fit) -> dict[str, Any]:
    missed = [str(limit) for limit in fit.limits if not limit.met]
    error = ", ".join(f"{e:.4f}" for e in fit.train_nrmse)
    infeasible = fit.status is Status.INFEASIBLE
    sentence = (
        f"{fit.status.value} ({'; '.join(missed)})" if infeasible else f"NRMSE on training {error}. {fit.status.value}"
    )
    about = {"key": job.key, "status": fit.status.name, "sentence": sentence, "operators": operators_used(fit)}
    return {**job.parameters, **about}


def _finished(
    given: Run,
    manifest: Manifest,
    jobs: tuple[RunJob, ...],
    recordings: Mapping[str, tuple[Recording, ...]],
    done: tuple[str, ...],
    skipped: tuple[str, ...],
    tell: Callable[[str], None],
) -> RunResult:
    """Errors, the table, and model and page of the job that is chosen."""
    folder, entries = manifest.folder, manifest.content["jobs"]
    usable = [j for j in jobs if entries[j.id]["status"] != Status.INFEASIBLE.name]
    if not usable:
        first = f"{jobs[0].id}: {entries[jobs[0].id]['sentence']}"
        raise ConstraintsNotMet(f"{given.file}: no job meets its constraints; {first}")
    equations = given.model if isinstance(given.model, Model) else None
    fits = {j.id: replace(load(folder / j.model_file, model=equations), engine=given.engine) for j in usable}
    scores = [s for j in usable for s in scored(manifest, given, j, fits[j.id], recordings)]
    best = chosen(scores)
    manifest.content["chosen"] = best
    manifest.put(TABLE, table(scores, usable, entries, best))
    manifest.put(MODEL, (folder / f"jobs/{best}" / MODEL).read_text(encoding="utf-8"))
    key = digest([manifest.content["files"][MODEL], manifest.content["inputs"], given.files, str(given.reading)])
    if given.report and (manifest.content.get("report") != key or not manifest.holds(PAGE)):
        from ..report.fit_page import fit_page

        tell("writing the report")
        judged = recordings["validation"] + recordings["test"]
        manifest.put(PAGE, fit_page(fits[best], recordings["train"], judged, model_file=MODEL).html())
        manifest.content["report"] = key
    manifest.content.pop("writing", None)
    manifest.write()
    fit = replace(fits[best], seconds=read_times(folder).get(best, 0.0))
    return RunResult(folder, done, skipped, best, tuple(scores), fit, manifest.content)


def _read(given: Run, name: str) -> Recording:
    options = dict(given.reading)
    inputs, outputs = options.pop("inputs"), options.pop("outputs")
    try:
        return read(given.located(name), inputs, outputs, **options)
    except TypeError as error:
        raise InputError(f"{given.file}: {error}.") from None
