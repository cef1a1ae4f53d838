"""What a run amounts to: errors of every model on every recording, the one that is chosen, a table and a page."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..fitted import Fit
from ..recording import InputError, Recording
from .described import ROLES, Run
from .jobs import RunJob
from .manifest import Manifest, digest

COLUMNS = ("job", "seed", "chosen", "status", "operators", "role", "recording", "nrmse")


@dataclass(frozen=True)
class Score:
    """NRMSE (Krikelis et al. 2024, Eq. 27) of a job's model on a recording; nan where it cannot be told."""

    job: str
    role: str
    recording: str
    nrmse: float


def scored(
    manifest: Manifest, run: Run, job: RunJob, fit: Fit, recordings: Mapping[str, tuple[Recording, ...]]
) -> list[Score]:
    """Errors of a job's model, those that the manifest has already taken from there."""
    out, known = [], manifest.content["scores"]
    model, reading = manifest.content["files"][job.model_file], {k: str(v) for k, v in run.reading.items()}
    for role in ROLES:
        for name, recording in zip(run.files[role], recordings[role], strict=True):
            key = digest({"model": model, "data": manifest.content["inputs"][name], "reading": reading})
            if key not in known:
                known[key] = _error(fit, recording)
            value = known[key]
            out.append(Score(job.id, role, name, np.nan if value is None else float(value)))
    return out


def _error(fit: Fit, recording: Recording) -> float | None:
    try:
        error = fit.nrmse(recording)
    except InputError:
        return None
    return error if np.isfinite(error) else None


def chosen(scores: Sequence[Score]) -> str:
    """The job of the smallest validation error, of the smallest training error where there is no validation."""
    judge = "validation" if any(s.role == "validation" for s in scores) else "train"
    errors: dict[str, list[float]] = {}
    for s in scores:
        if s.role == judge:
            errors.setdefault(s.job, []).append(s.nrmse if np.isfinite(s.nrmse) else np.inf)
    return min(errors, key=lambda job: (float(np.mean(errors[job])), list(errors).index(job)))


def table(scores: Sequence[Score], jobs: Sequence[RunJob], entries: Mapping[str, Any], best: str) -> str:
    """results.csv: one row a job and recording, numbers to the last digit."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for job in jobs:
        entry = entries[job.id]
        for s in (s for s in scores if s.job == job.id):
            about = [job.id, job.parameters.get("seed", ""), int(job.id == best), entry["status"], entry["operators"]]
            writer.writerow([*about, s.role, s.recording, repr(s.nrmse)])
    return text.getvalue()
