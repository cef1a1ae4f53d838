"""Early stopping: a part of the training data is held back, and the point is taken where its error is smallest.

Of one recording the end is held back, and simulated from the beginning; of several the last ones, with all that have
their inputs. Of steady periods the end would have the input of what is trained on, so the mean period is cut in time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..data import Recording, by_input, mean_period, repeats_itself
from ..models import Model
from ..optimise import GaussNewton, Problem, Progress, Solution, Status

PATIENCE = 20  # points in a row that do not improve on the best
CUT = (
    "the input repeats, so of the mean period the last {:.0f} % stopped the training and the rest was trained on; "
    "validation=0 trains on all, another realization is better"
)
SAME = (
    "the input repeats, so what stopped the training has the input of what was trained on, which proves little; give "
    "another realization"
)


def hold_back(
    recordings: Sequence[Recording], share: float
) -> tuple[tuple[Recording, ...], tuple[Recording, ...], str]:
    """What is trained on, what is looked at only to stop (scored on the part held back), and a sentence to tell, or "".

    Parameters
    ----------
    recordings : sequence of Recording
        Training data.
    share : float
        Share to hold back, above 0 and below 1.
    """
    groups = by_input(recordings)
    if len(groups) > 1:
        wanted, last = max(1, round(share * len(recordings))), set(groups[-1])
        for group in reversed(groups[1:-1]):
            last |= set(group) if len(last) + len(group) <= wanted else set()
        kept = tuple(r for i, r in enumerate(recordings) if i not in last)
        return kept, tuple(_from_rest(recordings[i]) for i in sorted(last)), ""
    pairs = [_cut(r, share) for r in recordings]
    told = ""
    if any(repeats_itself(r) or (r.begins == "periodic" and r.period) for r in recordings):
        told = CUT.format(100 * share) if all(r.begins == "periodic" for r in recordings) else SAME
    return tuple(kept for kept, _ in pairs), tuple(held for _, held in pairs), told


def _cut(r: Recording, share: float) -> tuple[Recording, Recording]:
    """One recording cut in time: what comes first, and the whole scored behind the cut."""
    if r.begins == "periodic" and r.period:
        whole = (len(r) - r.skip) // r.period * r.period
        mean = mean_period(r.slice(r.skip, r.skip + whole))
        cut = min(max(round((1 - share) * len(mean)), 2), len(mean) - 1)
        twice = mean.with_(u=np.tile(mean.u, (2, 1)), y=np.tile(mean.y, (2, 1)), initial="zero")
        return mean.slice(0, cut), _scored_from(twice, len(mean) + cut)  # a period from rest, and then what is scored
    cut = min(max(r.skip + round((1 - share) * (len(r) - r.skip)), r.skip + 2), len(r) - 1)
    return r.slice(0, cut), _scored_from(r, cut)


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
