r"""Which structure of a grid to take: cross-validation, or a validation recording, over `nx`, `N`, operators and more.

The rule is that of `order_selection`: with :math:`e(c)` the error of a cell on what it has not been fitted to, take the
cell of the fewest free parameters among :math:`\{c : e(c) \le (1 + m) \min_k e(k)\}`. In each fold the seed of the
smallest training error stands for its cell, and :math:`e(c)` is the mean over the folds: what is held out judges, and
has no part in what is judged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .._base import InputError
from ..models import Model
from .jobs import RunJob

if TYPE_CHECKING:
    from .store import Store

MARGIN = 0.05


@dataclass(frozen=True, eq=False, repr=False)
class Selection:
    """How well the structures do on what they have not been fitted to, and which one to take.

    Attributes
    ----------
    names : tuple of str
        The cells by their values.
    parameters : tuple of int
        Free parameters of each.
    errors : tuple of float
        NRMSE held out; infinite where no job of the cell, or of one of its folds, gave a model.
    cell : int
        Number of the cell recommended.
    margin : float
        How much worse than the best it may be, as a share.
    judge : str
        What was held out.
    """

    names: tuple[str, ...]
    parameters: tuple[int, ...]
    errors: tuple[float, ...]
    cell: int
    margin: float
    judge: str

    def __repr__(self) -> str:
        width = max(len(name) for name in (*self.names, "structure"))
        rows = [f"{'structure':<{width}}  parameters       NRMSE"]
        for k, (name, n, e) in enumerate(zip(self.names, self.parameters, self.errors, strict=True)):
            rows.append(f"{name:<{width}}  {n:>10}  {e:>10.4f}{'  <- recommended' if k == self.cell else ''}")
        return "\n".join([*rows, f"fewest parameters within {100 * self.margin:g} % of the best on the {self.judge}"])


def select(place: Store, jobs: Sequence[RunJob]) -> Selection:
    """Compare the cells whose jobs these are.

    Raises
    ------
    InputError
        If no cell can be judged.
    """
    run, first = place.run, place.recordings["train"][0]
    counts, errors = [], []
    scores: dict[str, list[float]] = {}
    for s in place.scores(jobs):
        if s.role == ("held" if run.folds else "validation"):
            scores.setdefault(s.job, []).append(s.nrmse if np.isfinite(s.nrmse) else np.inf)
    for number, cell in enumerate(run.cells):
        model = cell.model.model(first.n_u, first.n_y) if not isinstance(cell.model, Model) else cell.model
        counts.append(int(model.parameters.free.sum()))
        parts: dict[int | None, list[RunJob]] = {k: [] for k in (range(run.folds) if run.folds else (None,))}
        for job in (j for j in jobs if j.cell == number and j.id in scores):
            parts[job.fold].append(job)
        best = [min(p, key=lambda j: place.entries[j.id]["train"]) if p else None for p in parts.values()]
        errors.append(float(np.mean([np.inf if j is None else np.mean(scores[j.id]) for j in best])))
    if not np.isfinite(min(errors)):
        entry = place.entries[jobs[0].id]
        raise InputError(f"{run.file}: no structure can be judged; {jobs[0].id}: {entry['sentence']}")
    enough = [k for k, e in enumerate(errors) if e <= (1 + MARGIN) * min(errors)]
    cell_number = min(enough, key=lambda k: (counts[k], errors[k]))
    judge = f"{run.folds} folds" if run.folds else "validation recordings"
    names = tuple(cell.name or "the model" for cell in run.cells)
    return Selection(names, tuple(counts), tuple(errors), cell_number, MARGIN, judge)
