"""What a run amounts to: errors of every model on every recording, the one that is chosen, and a table."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..data import Recording
from .described import ROLES, Run
from .grid import grid_keys
from .jobs import Recordings, RunJob


@dataclass(frozen=True)
class Score:
    """NRMSE (Krikelis et al. 2024, Eq. 27) of a job's model on a recording; nan where it cannot be told."""

    job: str
    role: str
    recording: str
    nrmse: float


def scored_files(run: Run, recordings: Recordings) -> Iterator[tuple[str, str, Recording]]:
    """Role, name and recording of every file of a run."""
    for role in ROLES:
        for name, recording in zip(run.files[role], recordings[role], strict=True):
            yield role, name, recording


def chosen(scores: Sequence[Score], jobs: Sequence[str]) -> str:
    """Of these jobs the one of the smallest validation error, of the smallest training error without validation."""
    judge = "validation" if any(s.role == "validation" for s in scores) else "train"
    errors: dict[str, list[float]] = {}
    for s in scores:
        if s.role == judge and s.job in jobs:
            errors.setdefault(s.job, []).append(s.nrmse if np.isfinite(s.nrmse) else np.inf)
    return min(errors, key=lambda job: (float(np.mean(errors[job])), list(errors).index(job)))


def table(scores: Sequence[Score], jobs: Sequence[RunJob], entries: Mapping[str, Any], best: str) -> str:
    """results.csv: one row a job and recording, numbers to the last digit; one row for a job without a model."""
    keys = grid_keys(job.parameters for job in jobs) + ["fold"] * any(job.fold is not None for job in jobs)
    by_job: dict[str, list[Score]] = {}
    for s in scores:
        by_job.setdefault(s.job, []).append(s)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["job", "seed", "chosen", *keys, "status", "operators_used", "role", "recording", "nrmse"])
    for job in jobs:
        entry = entries[job.id]
        about = [job.id, job.parameters["seed"], int(job.id == best), *(job.parameters.get(k, "") for k in keys)]
        for s in by_job.get(job.id, [Score(job.id, "", "", np.nan)]):
            writer.writerow([*about, entry["status"], entry["operators_used"], s.role, s.recording, repr(s.nrmse)])
    return text.getvalue()


def reasons(entries: Mapping[str, Mapping[str, Any]], ids: Sequence[str]) -> list[str]:
    """Why jobs have no model: a line for every distinct reason, with the first job that has it."""
    found: dict[str, list[str]] = {}
    for job in ids:
        found.setdefault(entries[job]["sentence"], []).append(job)
    more = {text: f" and {len(jobs) - 1} more" if len(jobs) > 1 else "" for text, jobs in found.items()}
    return [f"{jobs[0]}{more[text]}: {text}" for text, jobs in found.items()]
