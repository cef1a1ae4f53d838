"""Early stopping: a part of the training data is held back, and the point is taken where its error is smallest.

Of one recording the end is held back, and simulated from the beginning; of several the last ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .gauss_newton import GaussNewton
from .model import Model
from .problem import Problem
from .recording import InputError, Recording
from .solution import Progress, Solution, Status

PATIENCE = 20  # points in a row that do not improve on the best


def hold_back(recordings: Sequence[Recording], share: float) -> tuple[tuple[Recording, ...], tuple[Recording, ...]]:
    """What is trained on, and what is looked at only to stop: the same, but scored on the part held back.

    Parameters
    ----------
    recordings : sequence of Recording
        Training data.
    share : float
        Share to hold back, above 0 and below 1.

    Raises
    ------
    InputError
        If a single recording in periodic steady state has one period, which cannot be cut.
    """
    if len(recordings) > 1:
        n = min(max(1, round(share * len(recordings))), len(recordings) - 1)
        return tuple(recordings[:-n]), tuple(_from_rest(r) for r in recordings[-n:])
    (r,) = recordings
    cut = r.skip + round((1 - share) * (len(r) - r.skip))
    if r.begins == "periodic" and r.period:
        periods = len(r) // r.period
        cut = (periods - max(1, round(share * periods))) * r.period
        if cut < r.skip + r.period:
            raise InputError(
                "Early stopping holds back a part of the recording, which has one period only; give several "
                "recordings or periods, or validation=0."
            )
    cut = min(max(cut, r.skip + 2), len(r) - 1)
    return (r.slice(0, cut),), (_scored_from(r, cut),)


def _from_rest(recording: Recording) -> Recording:
    """Where the initial state is to be estimated, zero, and the first fifth is not scored."""
    if recording.begins != "estimate":
        return recording
    return _scored_from(recording.with_(initial="zero"), max(recording.skip, len(recording) // 5))


def _scored_from(recording: Recording, skip: int) -> Recording:
    """The recording with more samples that are not scored: behind them there need be no whole period."""
    kept = recording.period if recording.period and len(recording) - skip >= recording.period else None
    return recording.with_(skip=skip, period=kept)


class Watch:
    """Looks at every point of a solve and remembers the one with the smallest error on what is held back."""

    def __init__(self, problem: Problem, patience: int = PATIENCE) -> None:
        self.problem, self.patience = problem, patience
        self.best, self.theta, self.failed = np.inf, np.zeros(0), 0

    def __call__(self, theta: np.ndarray) -> bool:
        """Whether it is time to stop."""
        cost = self.problem.cost(theta[: self.problem.size])
        if cost < self.best or not self.theta.size:
            self.best, self.theta, self.failed = cost, theta.copy(), 0
        else:
            self.failed += 1
        return self.failed >= self.patience


def solve_watched(
    solver: GaussNewton, problem: Problem, held: Problem, start: np.ndarray, progress: Progress | None = None
) -> Solution:
    """The solver's solution, moved back to the point with the smallest error on `held`."""
    watch = Watch(held)
    solution = solver.solve(problem, start, progress, watch)
    if not watch.theta.size or solution.status is Status.INTERRUPTED:
        return solution
    if watch(solution.theta) or watch.failed:
        cost = problem.cost(watch.theta)
        return replace(solution, theta=watch.theta, cost=cost, status=Status.STOPPED_EARLY)
    return solution


def held_problem(model: Model, held: Sequence[Recording], problem: Problem) -> Problem:
    """The problem that scores what is held back, with the engine and scale of the one that trains."""
    return Problem(model, held, engine=problem.engine, scale=problem.scale)
