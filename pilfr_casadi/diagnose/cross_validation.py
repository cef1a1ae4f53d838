"""Cross-validation of fitted simulators: the error on parts of the recordings that are excluded from the fit.

Every recording is cut into blocks, and the blocks are dealt to a few folds in turn. For each fold, a simulator is
refitted to the other folds, starting at its fitted values. It is simulated through the held-out blocks, whose samples
are not scored. The state at the beginning of a block therefore needs no estimate: it follows from the inputs and the
time before. Neighbouring samples are correlated, and so whole blocks are held out (Burman, Chow & Nolan 1994,
Biometrika 81(2)).

Samples after a block still constrain a simulation that drifts, for example behind a free integrator. Therefore the
second half of every recording is also predicted, from a fit to the first half (Tashman 2000, Int. J. Forecasting
16(4)). The larger of both errors counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .._base import InputError, side_by_side
from ..identify import solve_within_bounds
from ..optimise import GaussNewton, Problem
from .workbench import DIVERGED, Fitted, Workbench

FOLDS, ROUNDS = 4, 2  # folds, and blocks of a recording in each fold: eight blocks, spread over the recording
# share of a block at the start of a recording that is never held out: it determines the unknown initial state
LEAD = 0.5
# The fit to all blocks is near each of these fits; a fit that has not converged after so many steps is used as it is.
AGAIN = GaussNewton(max_iterations=8, tolerance=1e-2, patience=2)


@dataclass(frozen=True)
class HeldOut:
    """Mean square errors of a simulator on data that it was not fitted to, outputs in units of their deviation.

    Attributes
    ----------
    blocks, ahead : float
        On held-out blocks, and on the second halves; infinite if the simulation diverges.
    spread : float
        Mean square uncertainty of predictions for other inputs; see `evidence.spread`.
    """

    blocks: float
    ahead: float
    spread: float = 0.0

    @property
    def mean_square(self) -> float:
        """The larger of the two errors plus the spread for other inputs."""
        return max(self.blocks, self.ahead) + self.spread

    @property
    def expected(self) -> float:
        """Root of the mean square."""
        return float(np.sqrt(self.mean_square))

    @property
    def error(self) -> float:
        """Root of the larger of the two errors."""
        return float(np.sqrt(max(self.blocks, self.ahead)))


def blocks_of(bench: Workbench) -> list[np.ndarray]:
    """Return the number of each sample's block, (M,) for each recording; -1 for samples in no block."""
    out = []
    for r in bench.recordings:
        lead = int(LEAD * (len(r) - r.skip) / (FOLDS * ROUNDS)) if r.begins == "estimate" else 0
        numbers, begin = np.full(len(r), -1), r.skip + lead
        numbers[begin:] = np.arange(len(r) - begin) * FOLDS * ROUNDS // max(len(r) - begin, 1)
        out.append(numbers)
    return out


def held_out_errors(bench: Workbench, fitted: Fitted, workers: int = 1) -> HeldOut:
    """Refit without each fold of blocks and without the second halves; return the errors on the omitted parts."""
    blocks = blocks_of(bench)
    folds = [[(b >= 0) & (b % FOLDS == fold) for b in blocks] for fold in range(FOLDS)]
    later = [b >= FOLDS * ROUNDS // 2 for b in blocks]
    *squares, second = side_by_side(lambda left: _sum_of_squares(bench, fitted, left), [*folds, later], workers)
    scored = bench.recordings[0].y.shape[1] * sum(int(np.sum(b >= 0)) for b in blocks)
    ahead = bench.recordings[0].y.shape[1] * sum(int(np.sum(left)) for left in later)
    return HeldOut(sum(squares) / max(scored, 1), second / max(ahead, 1))


def _sum_of_squares(bench: Workbench, fitted: Fitted, left: Sequence[np.ndarray]) -> float:
    """Compute the sum of squares over the omitted samples; infinite if the simulation diverges."""
    with np.errstate(over="ignore", invalid="ignore"):
        pairs = zip(_errors_without(bench, fitted, left), left, strict=True)
        value = float(sum(np.sum(e[here] ** 2) for e, here in pairs))
    return value if value < DIVERGED else np.inf


def _errors_without(bench: Workbench, fitted: Fitted, left: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Compute the scaled errors (M, n_y) of each recording from a fit that does not score the samples in `left`."""
    model = fitted.model.with_parameters(fitted.model.parameters.at(fitted.vector))
    states = [s for s, r in zip(fitted.initial, bench.recordings, strict=True) if r.begins == "estimate"]
    if not np.any(model.parameters.free) and not states:
        return [e / bench.scale for e in fitted.residual]
    problem = Problem(model, bench.recordings, engine=fitted.engine, scale=bench.scale, scored=[~mask for mask in left])
    theta = np.concatenate([problem.start[: problem.n_free], *states])
    try:
        with np.errstate(all="ignore"):
            found = solve_within_bounds(problem, theta, AGAIN).theta
            simulated = problem.simulate(found)
    except (InputError, RuntimeError, FloatingPointError, np.linalg.LinAlgError):
        return [np.full(r.y.shape, np.inf) for r in bench.recordings]
    with np.errstate(over="ignore", invalid="ignore"):
        return [(y - r.y) / bench.scale for y, r in zip(simulated, bench.recordings, strict=True)]
