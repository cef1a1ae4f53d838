"""The progress of a diagnosis: each stage by its name, and the smallest error so far, which never rises."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .._base import Progress


@dataclass(eq=False)
class Stages:
    """A `Progress` that keeps the smallest error over all stages.

    Attributes
    ----------
    report : callable
        Called with (stage, done, total, smallest error so far).
    prefix : str
        Stands before each stage's name, as in "other hold: fits".
    best : list of float
        The smallest error, shared with the reporters made by `under`.
    """

    report: Progress
    prefix: str = ""
    best: list[float] = field(default_factory=lambda: [np.inf])

    def __call__(self, stage: str, done: int, total: int, best: float = np.inf) -> None:
        """Report that `done` of `total` parts of a stage are finished; `best` is an error found in it."""
        if np.isfinite(best):
            self.best[0] = min(self.best[0], best)
        self.report(f"{self.prefix}{stage}", done, total, self.best[0])

    def under(self, prefix: str) -> Stages:
        """Make a reporter for a search inside the search; it shares the smallest error."""
        return Stages(self.report, f"{prefix}{self.prefix}", self.best)
