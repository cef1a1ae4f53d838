r"""Summarise the errors of a run in tables and box plots, choose a model, and recommend a structure.

Box plots as in Krikelis et al. (2024), Fig. 11.

A structure is selected by cross-validation, or by a validation recording, with the rule of `select_order`. With
:math:`e(c)` the error of a cell on recordings that it was not fitted to, take the cell with the fewest free parameters
among :math:`\{c : e(c) \le (1 + m) \min_k e(k)\}`. In each fold the seed with the smallest training error represents
its cell, and :math:`e(c)` is the mean over the folds. The held-out part does not influence the choice of the seed.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._base import InputError, csv_text
from ..data import Recording
from ..models import Model
from .jobs import RunJob
from .run_file import Run, grid_keys

QUARTILES = ("smallest", "lower_quartile", "median", "upper_quartile", "largest")
FOLDS = "folds"
SELECTION_MARGIN = 0.05  # excess error, relative to the smallest, allowed for a smaller structure; as in select_order


@dataclass(frozen=True)
class Score:
    """NRMSE (Krikelis et al. 2024, Eq. 27) of a job's model on a recording; nan if it cannot be computed."""

    job: str
    role: str
    recording: str
    nrmse: float


def choose_job(scores: Sequence[Score], jobs: Sequence[str]) -> str:
    """Return the job with the smallest validation error (training error if there are no validation recordings)."""
    judge = "validation" if any(s.role == "validation" for s in scores) else "train"
    errors = {job: error for job, error in mean_errors(scores, judge).items() if job in jobs}
    return min(errors, key=lambda job: errors[job])


def mean_errors(scores: Sequence[Score], role: str) -> dict[str, float]:
    """Map each job with scores of a role to its mean NRMSE, infinite if one cannot be computed."""
    errors: dict[str, list[float]] = {}
    for s in scores:
        if s.role == role:
            errors.setdefault(s.job, []).append(s.nrmse if np.isfinite(s.nrmse) else np.inf)
    return {job: float(np.mean(of_job)) for job, of_job in errors.items()}


def results_table(scores: Sequence[Score], jobs: Sequence[RunJob], entries: Mapping[str, Any], best: str) -> str:
    """Write results.csv: one row per job and recording, or per job without a model; numbers with all digits."""
    keys = grid_keys(job.parameters for job in jobs) + ["fold"] * any(job.fold is not None for job in jobs)
    by_job: dict[str, list[Score]] = {}
    for s in scores:
        by_job.setdefault(s.job, []).append(s)
    heads = ["job", "seed", "chosen", *keys, "status", "operators_used", "role", "recording", "nrmse"]
    rows: list[list[Any]] = [heads]
    for job in jobs:
        entry = entries[job.id]
        about = [job.id, job.parameters["seed"], int(job.id == best), *(job.parameters.get(k, "") for k in keys)]
        for s in by_job.get(job.id, [Score(job.id, "", "", np.nan)]):
            rows.append([*about, entry["status"], entry.get("operators_used", ""), s.role, s.recording, repr(s.nrmse)])
    return csv_text(rows)


def reasons(entries: Mapping[str, Mapping[str, Any]], ids: Sequence[str]) -> list[str]:
    """Explain why jobs have no model, in one line per distinct reason, with its first job."""
    found: dict[str, list[str]] = {}
    for job in ids:
        found.setdefault(entries[job]["sentence"], []).append(job)
    more = {text: f" and {len(jobs) - 1} more" if len(jobs) > 1 else "" for text, jobs in found.items()}
    return [f"{jobs[0]}{more[text]}: {text}" for text, jobs in found.items()]


@dataclass(frozen=True)
class CellSummary:
    """Errors of one cell's jobs on one recording; a cross-validation has the roles `held` and `train` on `folds`.

    A job failed if it has no model, if its model explains nothing of the training data (an NRMSE of 0.99 or more, like
    a constant), or if its error on this recording is not finite.
    """

    cell: Mapping[str, Any]
    role: str
    recording: str
    jobs: int
    failed: int
    quartiles: tuple[float, ...]  # smallest, lower quartile, median, upper quartile and largest finite NRMSE
    seconds: float  # median time of a job

    @property
    def failure_rate(self) -> float:
        """Share of the jobs that failed."""
        return self.failed / self.jobs


def errors_by_cell(
    run: Run, jobs: Sequence[RunJob], scores: Sequence[Score]
) -> dict[tuple[str, str], dict[int, dict[str, float]]]:
    """Map (role, recording) -> number of the cell -> job -> NRMSE, infinite if the job has none."""
    held_out = {job.id for job in jobs if job.fold is not None}
    known = {(s.job, s.role, FOLDS if s.job in held_out else s.recording): s.nrmse for s in scores}
    whole = [(role, name) for role, names in run.files.items() for name in names]
    pairs = [(p, False) for p in whole] + [((role, FOLDS), True) for role in ("train", "held") if run.folds]
    out: dict[tuple[str, str], dict[int, dict[str, float]]] = {}
    for (role, name), folds in pairs:
        for job in (j for j in jobs if (j.fold is not None) == folds):
            error = known.get((job.id, role, name), np.inf)
            of_cell = out.setdefault((role, name), {}).setdefault(job.cell, {})
            of_cell[job.id] = error if np.isfinite(error) else np.inf
    return out


def summarise(
    run: Run,
    jobs: Sequence[RunJob],
    scores: Sequence[Score],
    times: Mapping[str, float],
    entries: Mapping[str, Mapping[str, Any]],
) -> tuple[CellSummary, ...]:
    """Summarise each cell on each recording."""
    out = []
    for (role, name), cells in errors_by_cell(run, jobs, scores).items():
        for number, errors in cells.items():
            given = np.array(list(errors.values()))
            finite = given[np.isfinite(given)]
            quartiles = np.percentile(finite, (0, 25, 50, 75, 100)) if len(finite) else np.full(5, np.nan)
            seconds = float(np.median([times.get(job, 0.0) for job in errors]))
            cell = run.cells[number].values
            failed = sum(not np.isfinite(e) or entries[job].get("explains_nothing", False) for job, e in errors.items())
            out.append(CellSummary(cell, role, name, len(given), failed, tuple(map(float, quartiles)), seconds))
    return tuple(out)


def summary_table(run: Run, summary: Sequence[CellSummary]) -> str:
    """Write summary.csv: one row per recording and cell, numbers with all digits."""
    keys = grid_keys(cell.values for cell in run.cells)
    rows: list[list[Any]] = [["role", "recording", *keys, "jobs", "failed", "failure_rate", *QUARTILES]]
    for s in summary:
        about = [s.role, s.recording, *(s.cell.get(k, "") for k in keys), s.jobs, s.failed, repr(s.failure_rate)]
        rows.append([*about, *map(repr, s.quartiles)])
    return csv_text(rows)


def box_plots(run: Run, jobs: Sequence[RunJob], scores: Sequence[Score]) -> bytes:
    """Draw box plots of all cells, one panel per recording, as PNG."""
    from ..plots import compared_spread

    cells = [cell.values for cell in run.cells]
    keys = [k for k in grid_keys(cells) if len({values.get(k) for values in cells}) > 1]
    labels = ["\n".join(str(values.get(k, "-")) for k in keys) or "all jobs" for values in cells]
    found = errors_by_cell(run, jobs, scores)
    if any(role == "held" for role, _ in found):  # only one cell has models on all training recordings
        found = {key: cells for key, cells in found.items() if key[1] == FOLDS}
    sets = {
        f"{name} ({role})": {labels[number]: list(e.values()) for number, e in of_cell.items()}
        for (role, name), of_cell in found.items()
    }
    buffer = io.BytesIO()
    compared_spread(sets, x=", ".join(keys)).savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


@dataclass(frozen=True, eq=False, repr=False)
class Selection:
    """Errors of the structures on held-out recordings, and the recommended structure."""

    names: tuple[str, ...]  # the cells by their values
    parameters: tuple[int, ...]  # free parameters of each
    errors: tuple[float, ...]  # held-out NRMSE; infinite if the cell, or one of its folds, has no model
    cell: int  # number of the recommended cell
    margin: float  # its largest excess error, relative to the smallest error
    judge: str  # the recordings that were held out

    def __repr__(self) -> str:
        width = max(len(name) for name in (*self.names, "structure"))
        rows = [f"{'structure':<{width}}  parameters       NRMSE"]
        for k, (name, n, e) in enumerate(zip(self.names, self.parameters, self.errors, strict=True)):
            rows.append(f"{name:<{width}}  {n:>10}  {e:>10.4f}{'  <- recommended' if k == self.cell else ''}")
        return "\n".join([*rows, f"fewest parameters within {100 * self.margin:g} % of the best on the {self.judge}"])


def select(
    run: Run,
    jobs: Sequence[RunJob],
    scores: Sequence[Score],
    entries: Mapping[str, Mapping[str, Any]],
    recording: Recording,
) -> Selection:
    """Compare the cells of a run by cross-validation, or by the errors on the validation recordings.

    Only the numbers of inputs and outputs of `recording` are used, so any recording of the run serves.
    """
    counts, errors = [], []
    judged = mean_errors(scores, "held" if run.folds else "validation")
    for number, cell in enumerate(run.cells):
        own = cell.model
        model = own if isinstance(own, Model) else own.model(recording.n_u, recording.n_y)
        counts.append(int(model.parameters.free.sum()))
        parts: dict[int | None, list[RunJob]] = {k: [] for k in (range(run.folds) if run.folds else (None,))}
        for job in (j for j in jobs if j.cell == number and j.id in judged):
            parts[job.fold].append(job)
        best = [min(p, key=lambda j: entries[j.id]["train"]) if p else None for p in parts.values()]
        errors.append(float(np.mean([np.inf if j is None else judged[j.id] for j in best])))
    if not np.isfinite(min(errors)):
        failed = [job.id for job in jobs if not np.isfinite(judged.get(job.id, np.inf))]
        raise InputError(f"{run.file}: no structure can be judged; {'; '.join(reasons(entries, failed))}")
    enough = [k for k, e in enumerate(errors) if e <= (1 + SELECTION_MARGIN) * min(errors)]
    names = tuple(cell.name or "the model" for cell in run.cells)
    judge = f"{run.folds} folds" if run.folds else "validation recordings"
    take = min(enough, key=lambda k: (counts[k], errors[k]))
    return Selection(names, tuple(counts), tuple(errors), take, SELECTION_MARGIN, judge)
