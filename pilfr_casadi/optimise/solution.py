"""What every solver returns: the best point with a status that is a sentence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

import numpy as np


class Status(Enum):
    """How a solve ended; the value is the sentence shown to the user."""

    CONVERGED = "Converged: no admissible step improves the fit noticeably."
    SMALL_STEP = "Converged: the last steps were too small to matter."
    STOPPED_EARLY = "Stopped early: the error on the data held back was smallest here."
    MAX_ITERATIONS = "Not converged: the iteration limit was reached; the best point so far is returned."
    TIME_LIMIT = "Not converged: the time limit was reached; the best point so far is returned."
    INTERRUPTED = "Not converged: interrupted; the best point so far is returned."
    DIVERGED_START = "Failed: the simulation diverges at the start values; start from a stable model."
    DIVERGES = "Failed: the model diverges along the training recordings; bound its radius, or free what is fixed."
    INFEASIBLE = "Failed: the constraints cannot be met from this start; loosen them or start elsewhere."
    RESTORED = "Not converged: the exact bounds are met by scaling the model alone; loosen them or start elsewhere."
    SOLVER_FAILED = "Not converged: the solver stopped early; the best point so far is returned."

    @property
    def converged(self) -> bool:
        """Whether the result is what was looked for: a minimum, or the best point on data held back."""
        return self in (Status.CONVERGED, Status.SMALL_STEP, Status.STOPPED_EARLY)

    @property
    def advice(self) -> str:
        """What to do about it, in one sentence; empty where nothing is to be done or the status says it."""
        return ADVICE.get(self, "")


ADVICE = {
    Status.MAX_ITERATIONS: "Judge it by its error on a test recording; to go on, give a solver more iterations, as in "
    "solver=GaussNewton(max_iterations=1000).",
    Status.TIME_LIMIT: "Judge it by its error on a test recording; to go on, give more time.",
    Status.SOLVER_FAILED: "Judge it by its error on a test recording; to go on, fit again from it or from more starts.",
}


@dataclass(frozen=True)
class Iteration:
    """One line of a solver's history."""

    number: int
    cost: float
    seconds: float
    step: float = 0.0
    damping: float = 0.0


@dataclass(frozen=True, eq=False)
class Solution:
    """A solver's result.

    Attributes
    ----------
    theta : numpy.ndarray
        Variables, shape (n,), inside their bounds.
    cost : float
        Objective there.
    violation : float
        Largest violation of the general constraints (0 where they hold).
    multipliers : numpy.ndarray
        Multipliers of bounds (n,) followed by those of the general constraints (n_g,); positive at an upper limit.
    """

    theta: np.ndarray
    cost: float
    status: Status
    iterations: int
    seconds: float
    violation: float = 0.0
    multipliers: np.ndarray = field(default_factory=lambda: np.zeros(0))
    history: tuple[Iteration, ...] = ()
    message: str = ""


Progress = Callable[[Iteration], None]
