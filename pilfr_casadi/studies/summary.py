"""What a study shows: quartiles and failures of every cell on every recording, as a table and as box plots.

The box plots are those of Krikelis et al. (2024), Fig. 11.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .described import Run
from .grid import Cell, grid_keys
from .jobs import RunJob
from .results import Score

QUARTILES = ("smallest", "lower_quartile", "median", "upper_quartile", "largest")
FOLDS = "folds"


@dataclass(frozen=True)
class CellSummary:
    """Errors of one cell's jobs on one recording.

    Attributes
    ----------
    cell : dict
        Values of the cell in the grid.
    role, recording : str
        `held` and `train` on `folds` are those of the cross-validation.
    jobs, failed : int
        How many there are, and how many of them failed: without a model, with one that explains nothing of the
        training (an NRMSE of 0.99 or more, that of a constant), or without a finite error there.
    quartiles : tuple of float
        Smallest, lower quartile, median, upper quartile and largest NRMSE of all that have a finite one.
    seconds : float
        Median time of a job.
    """

    cell: Mapping[str, Any]
    role: str
    recording: str
    jobs: int
    failed: int
    quartiles: tuple[float, ...]
    seconds: float

    @property
    def failure_rate(self) -> float:
        """Share of the jobs that failed."""
        return self.failed / self.jobs


def errors_by_cell(
    run: Run, jobs: Sequence[RunJob], scores: Sequence[Score]
) -> dict[tuple[str, str], dict[int, dict[str, float]]]:
    """(Role, recording) -> number of the cell -> job -> NRMSE, infinite where the job has none."""
    known = {(s.job, s.role, FOLDS if s.recording.startswith("fold ") else s.recording): s.nrmse for s in scores}
    whole = [(role, name) for role, names in run.files.items() for name in names]
    pairs = [(p, False) for p in whole] + [((role, FOLDS), True) for role in ("train", "held") if run.folds]
    out: dict[tuple[str, str], dict[int, dict[str, float]]] = {}
    for (role, name), folds in pairs:
        for job in (j for j in jobs if (j.fold is not None) == folds):
            error = known.get((job.id, role, name), np.inf)
            cells = out.setdefault((role, name), {})
            cells.setdefault(job.cell, {})[job.id] = error if np.isfinite(error) else np.inf
    return out


def summarised(
    run: Run,
    jobs: Sequence[RunJob],
    scores: Sequence[Score],
    times: Mapping[str, float],
    entries: Mapping[str, Mapping[str, Any]],
) -> tuple[CellSummary, ...]:
    """One summary a recording and cell."""
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
    """summary.csv: one row a recording and cell, numbers to the last digit."""
    keys = grid_keys(cell.values for cell in run.cells)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["role", "recording", *keys, "jobs", "failed", "failure_rate", *QUARTILES])
    for s in summary:
        about = [s.role, s.recording, *(s.cell.get(k, "") for k in keys), s.jobs, s.failed, repr(s.failure_rate)]
        writer.writerow([*about, *map(repr, s.quartiles)])
    return text.getvalue()


def box_plots(run: Run, jobs: Sequence[RunJob], scores: Sequence[Score]) -> bytes:
    """Box plots of all cells, one picture a recording, as PNG."""
    from ..plots import compared_spread

    cells = [cell.values for cell in run.cells]
    keys = [k for k in grid_keys(cells) if len({values.get(k) for values in cells}) > 1]
    found = errors_by_cell(run, jobs, scores)
    if any(role == "held" for role, _ in found):  # the models on all of the training are those of one cell
        found = {key: cells for key, cells in found.items() if key[1] == FOLDS}
    sets = {
        f"{name} ({role})": {_label(run.cells[number], keys): list(e.values()) for number, e in cells.items()}
        for (role, name), cells in found.items()
    }
    buffer = io.BytesIO()
    compared_spread(sets, x=", ".join(keys)).savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


def _label(cell: Cell, keys: Sequence[str]) -> str:
    return "\n".join(str(cell.values.get(k, "-")) for k in keys) or "all jobs"
