"""The results of a run in its folder: which jobs are complete, their models, and their errors on every recording."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .._base import digest
from ..identify import load
from ..models import Model
from .executor import FAILED, Batch, versions
from .folder import RUN, TABLE, Manifest, refuse_other_versions
from .jobs import MODEL, WITHOUT_MODEL, Recordings, RunJob, error_of, scored_files
from .run_file import Run
from .summary import Score, results_table

TABLE_PAUSE = 1.0  # least seconds between two updates of the table of a running campaign


class Store:
    """Read and write the results of a run; refuse edited files."""

    def __init__(
        self, path: Path, run: Run, inputs: Mapping[str, str], recordings: Recordings, overwrite: bool, campaign: bool
    ) -> None:
        self.path, self.run, self.inputs, self.recordings, self.campaign = path, run, inputs, recordings, campaign
        self.manifest = Manifest(path) if overwrite else Manifest.read(path)
        for name in RUN.files:
            self.manifest.holds(name)
        if campaign:
            refuse_other_versions(self.manifest)
        described = {"file": run.file.name, "said": run.plain_tables}
        self.manifest.content |= {"run": described, "versions": versions(), "inputs": dict(inputs)}
        self.manifest.write()
        self.written = -np.inf

    def is_complete(self, job: RunJob) -> bool:
        """Tell whether a job finished with the same inputs, and its model is unchanged on disk."""
        if not self.manifest.is_settled(job, self.run.time_limit if self.campaign else None):
            return False
        if not self.campaign and self.manifest.entries[job.id]["status"] == FAILED:
            return False
        return not self.has_model(job) or self.manifest.holds(job.model_file)

    def gave_model(self, job: RunJob) -> bool:
        """Tell whether a job gave a model that meets its constraints."""
        return self.manifest.entries[job.id]["status"] not in WITHOUT_MODEL

    def has_model(self, job: RunJob) -> bool:
        """Tell whether the folder has a model of a job; models of a cross-validation are not kept."""
        return job.fold is None and self.gave_model(job)

    def record(self, batch: Batch) -> None:
        """Record finished jobs and their errors in the manifest."""
        for _, found in batch:
            for name, error in found.errors.items():
                model = digest(str(found.files[MODEL]).encode())
                self.manifest.content["scores"][self._score_key(model, name)] = error
        self.manifest.record(batch)

    def scores(self, jobs: Sequence[RunJob], last: bool = False) -> list[Score]:
        """Return the errors of the jobs' models; compute missing ones. `last` drops the entries of other models."""
        out, used, known = [], set(), self.manifest.content["scores"]
        for job in (j for j in jobs if self.gave_model(j)):
            if job.fold is not None:
                entry, name = self.manifest.entries[job.id], f"fold {job.fold}"
                out += [Score(job.id, "train", name, entry["train"]), Score(job.id, "held", name, entry["held"])]
                continue
            fit = None
            for role, name, recording in scored_files(self.run, self.recordings):
                key = self._score_key(self.manifest.content["files"][job.model_file], name)
                if key not in known:
                    fit = fit or self.load(job)
                    known[key] = error_of(replace(fit, engine=self.run.engine), recording)
                used.add(key)
                out.append(Score(job.id, role, name, np.nan if known[key] is None else float(known[key])))
        if last:
            self.manifest.content["scores"] = {key: error for key, error in known.items() if key in used}
        return out

    def load(self, job: RunJob) -> Any:
        """Load the model of a job."""
        own = self.run.cells[job.cell].model
        return load(self.path / job.model_file, model=own if isinstance(own, Model) else None)

    def _score_key(self, model: str, name: str) -> str:
        reading = {k: str(v) for k, v in self.run.reading.items()}
        return digest({"model": model, "data": self.inputs[name], "reading": reading})

    def write_table(self, jobs: Sequence[RunJob], last: bool = False) -> None:
        """Write the errors so far of a running campaign, at most once per `TABLE_PAUSE` except the last time."""
        if not self.campaign or (not last and time.monotonic() < self.written + TABLE_PAUSE) or not jobs:
            return
        self.manifest.put({TABLE: results_table(self.scores(jobs), jobs, self.manifest.entries, "")})
        self.written = time.monotonic()
