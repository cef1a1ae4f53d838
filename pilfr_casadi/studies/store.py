"""The results of a run in its folder: which jobs are complete, what has just been done, and the table of all errors."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .._base import InputError
from ..export import digest
from ..identify import load
from ..models import Model
from ..optimise import Status
from .described import Run
from .folder import MODEL, PAGE, PICTURE, SUMMARY, TABLE, note_times
from .jobs import FAILED, LOST, TIMED_OUT, Outcome, Recordings, RunJob, error_of
from .manifest import NAME, Manifest, versions
from .results import Score, scored_files, table

PAUSE = 1.0  # seconds between two tables of a campaign at work


class Store:
    """What a run has written, and writes.

    Raises
    ------
    InputError
        If files of the run were changed afterwards; for a campaign also if its results are of other versions.
    """

    def __init__(
        self, path: Path, run: Run, inputs: Mapping[str, str], recordings: Recordings, overwrite: bool, campaign: bool
    ) -> None:
        self.path, self.run, self.inputs, self.recordings, self.campaign = path, run, inputs, recordings, campaign
        self.manifest = _manifest(path, overwrite)
        if campaign:
            _refuse_other_versions(self.manifest)
        said = {"file": run.file.name, "said": run.said}
        self.manifest.content |= {"run": said, "versions": versions(), "inputs": dict(inputs)}
        self.manifest.write()
        self.written = -np.inf

    @property
    def entries(self) -> dict[str, Any]:
        """What the manifest says of each job."""
        entries: dict[str, Any] = self.manifest.content["jobs"]
        return entries

    def complete(self, job: RunJob) -> bool:
        """Whether a job has been done from the same inputs, and its model is there as it was written."""
        entry = self.entries.get(job.id, {})
        if entry.get("key") != job.key or entry["status"] == LOST:
            return False
        if entry["status"] == TIMED_OUT:  # more time, and it is tried again
            return self.campaign and self.run.time_limit is not None and self.run.time_limit <= entry["time_limit"]
        if entry["status"] == FAILED:
            return self.campaign
        return not self.has_model(job) or self.manifest.holds(job.model_file)

    def ended_well(self, job: RunJob) -> bool:
        """Whether a job gave a model that meets its constraints."""
        return self.entries[job.id]["status"] not in (FAILED, TIMED_OUT, LOST, Status.INFEASIBLE.name)

    def has_model(self, job: RunJob) -> bool:
        """Whether there is a model of a job."""
        return job.fold is None and self.ended_well(job)

    def note(self, batch: Sequence[tuple[RunJob, Outcome]]) -> None:
        """Write the models of jobs that have been done, then what the manifest says of them."""
        entries = {job.id: {**job.parameters, "key": job.key, **found.entry} for job, found in batch}
        models = {job.model_file: found.model for job, found in batch if found.model is not None}
        for job, found in batch:
            for name, error in found.errors.items():
                model = digest(models[job.model_file].encode())
                self.manifest.content["scores"][self._score_key(model, name)] = error
        note_times(self.path, {job.id: found.seconds for job, found in batch})
        self.manifest.put_all(models, entries)

    def scores(self, jobs: Sequence[RunJob], last: bool = False) -> list[Score]:
        """Errors of the jobs' models, those that the manifest knows from there; at `last` it forgets all others."""
        out, used = [], set()
        for job in (j for j in jobs if self.ended_well(j)):
            if job.fold is not None:
                entry = self.entries[job.id]
                name = f"fold {job.fold}"
                out += [Score(job.id, "train", name, entry["train"]), Score(job.id, "held", name, entry["held"])]
                continue
            known, fit = self.manifest.content["scores"], None
            for role, name, recording in scored_files(self.run, self.recordings):
                key = self._score_key(self.manifest.content["files"][job.model_file], name)
                if key not in known:
                    own = self.run.cells[job.cell].model
                    fit = fit or load(self.path / job.model_file, model=own if isinstance(own, Model) else None)
                    known[key] = error_of(replace(fit, engine=self.run.engine), recording)
                value = known[key]
                used.add(key)
                out.append(Score(job.id, role, name, np.nan if value is None else float(value)))
        if last:
            kept = self.manifest.content["scores"]
            self.manifest.content["scores"] = {key: error for key, error in kept.items() if key in used}
        return out

    def _score_key(self, model: str, name: str) -> str:
        reading = {k: str(v) for k, v in self.run.reading.items()}
        return digest({"model": model, "data": self.inputs[name], "reading": reading})

    def write_table(self, jobs: Sequence[RunJob], last: bool = False) -> None:
        """The errors so far, for readers of a campaign that is at work; not too often, but for the last time."""
        if not self.campaign or (not last and time.monotonic() < self.written + PAUSE) or not jobs:
            return
        self.manifest.put(TABLE, table(self.scores(jobs), jobs, self.entries, ""))
        self.written = time.monotonic()


def _manifest(folder: Path, overwrite: bool) -> Manifest:
    """The folder's manifest, its results checked, or an empty one."""
    if overwrite:
        return Manifest.fresh(folder)
    manifest = Manifest.found(folder)
    if manifest is None:
        return Manifest.fresh(folder)
    for name in (TABLE, MODEL, PAGE, SUMMARY, PICTURE):
        manifest.holds(name)
    return manifest


def _refuse_other_versions(manifest: Manifest) -> None:
    """Results of different versions are not mixed in one campaign, whose point is to compare them."""
    before, now = manifest.content.get("versions", {}), versions()
    for name in now:
        if manifest.content["jobs"] and before.get(name) != now[name]:
            raise InputError(
                f"{manifest.folder / NAME} has results of {name} {before.get(name)}, and this is {now[name]}; give "
                "another --out, or --overwrite to compute everything again."
            )
