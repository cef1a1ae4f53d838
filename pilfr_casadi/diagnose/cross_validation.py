"""Block cross-validation of fitted simulators: the error on stretches of the recordings that a fit does not score.

Every recording is cut into blocks, and the blocks are dealt to a few folds in turn. For each fold a simulator is fitted
again, from its fitted values, to the other folds: it is simulated through the held-out blocks, whose samples are not
scored. So the state at the beginning of a block needs no estimate, and a block is predicted from its inputs and from
the time before it, as a recording is that nobody has fitted. Neighbouring samples say the same thing, and so whole
blocks are held out (Burman, Chow & Nolan 1994, Biometrika 81(2)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .._base import InputError
from ..identify import solve_within_bounds
from ..optimise import GaussNewton, Problem
from .workbench import ENDLESS, Fitted, Workbench

FOLDS, ROUNDS = 4, 2  # fits, and blocks of a recording in each: eight blocks, spread over the recording
LEAD = 0.5  # of a block, at the start of a recording with an unknown initial state, which only these samples tell
# the fit to all blocks is near each of these; what has not settled after so many steps is judged as it stands
AGAIN = GaussNewton(max_iterations=8, tolerance=1e-2, patience=2)


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Errors of a simulator on blocks that it was not fitted to.

    Attributes
    ----------
    squares : array, shape (n,)
        Mean square error of each block, outputs in units of their deviation; infinite where the simulation diverges.
    lengths : array, shape (n,)
        Samples of each block.
    """

    squares: np.ndarray
    lengths: np.ndarray

    @property
    def error(self) -> float:
        """Rms error over all blocks, in units of the outputs' deviation."""
        return float(np.sqrt(np.average(self.squares, weights=self.lengths)))

    def better_than(self, other: HeldOut) -> float:
        """By how many standard errors the rms error of a block is below that of another simulator, on average."""
        if not np.all(np.isfinite(self.squares)):
            return -np.inf
        if not np.all(np.isfinite(other.squares)):
            return np.inf
        gain = np.sqrt(other.squares) - np.sqrt(self.squares)
        spread = float(np.std(gain, ddof=1)) / np.sqrt(len(gain))
        return float(np.mean(gain)) / max(spread, 1e-300)


def blocks_of(bench: Workbench) -> list[np.ndarray]:
    """Number of each sample's block in its recording, (M,) for each recording; -1 where samples are in no block."""
    out = []
    for r in bench.recordings:
        lead = int(LEAD * (len(r) - r.skip) / (FOLDS * ROUNDS)) if r.begins == "estimate" else 0
        numbers, begin = np.full(len(r), -1), r.skip + lead
        numbers[begin:] = np.arange(len(r) - begin) * FOLDS * ROUNDS // max(len(r) - begin, 1)
        out.append(numbers)
    return out


def held_out_errors(bench: Workbench, fitted: Fitted) -> HeldOut:
    """Fit a simulator again to all but every fold of blocks in turn, and give its errors on the blocks left out."""
    blocks = blocks_of(bench)
    squares = [np.full(FOLDS * ROUNDS, np.inf) for _ in blocks]
    for fold in range(FOLDS):
        left = [(b >= 0) & (b % FOLDS == fold) for b in blocks]
        for k, e in enumerate(_errors_without(bench, fitted, left)):
            for block in range(fold, FOLDS * ROUNDS, FOLDS):
                here = blocks[k] == block
                with np.errstate(over="ignore", invalid="ignore"):
                    value = float(np.mean(e[here] ** 2)) if np.any(here) else 0.0
                squares[k][block] = value if value < ENDLESS else np.inf
    lengths = [np.bincount(b[b >= 0], minlength=FOLDS * ROUNDS) for b in blocks]
    return HeldOut(np.concatenate(squares), np.concatenate(lengths).astype(float))


def _errors_without(bench: Workbench, fitted: Fitted, left: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Scaled errors (M, n_y) of each recording, by a fit that does not score the samples `left` out."""
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
