"""Predictive control and inversion of a piezo stage, on the true simulator (`python -m problems.mpc_piezo`).

The stage of `piezo_stage` is identified from one record; then it has to scan with a changing amplitude, 22 Hz with
57 Hz on top at 1 kHz, cut off just below the limit of the displacement. The controllers know nothing of the truth.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pilfr_casadi.identify import fit
from pilfr_casadi.models import PILFR, Play, PrandtlIshlinskii

from .closed_loop import Outcome, Task, compare, program
from .piezo_stage import FS, NOISE, RANGE, PiezoStage, training

LIMITS, MARGIN, TOLERANCE = (0.0, 8.0), 0.02, 0.01  # µm: of the displacement; kept from it; accepted beyond


def reference(samples: int) -> np.ndarray:
    """Scan from rest to 5 µm within 50 ms, then 22 Hz with changing amplitude and 57 Hz."""
    t = np.arange(samples) / FS
    amplitude = 3 * np.minimum(1, 0.3 + 1.2 * np.abs(np.sin(2 * np.pi * 1.3 * t)))
    path = 5 + amplitude * np.sin(2 * np.pi * 22 * t) + 0.8 * np.sin(2 * np.pi * 57 * t)
    return np.asarray(np.clip(np.minimum(1, t / 0.05) * path, LIMITS[0], LIMITS[1] - MARGIN))


def outcomes(samples: int = 600, *, quick: bool = False, solvers: Sequence[str] = ()) -> tuple[list[Outcome], Task]:
    """Fit both models, close all loops."""
    train = training()
    linear = fit(PILFR(3), train)
    hysteresis = fit(PILFR(3, PrandtlIshlinskii(Play, 12)), train, starts=3)
    task = Task(PiezoStage, reference(samples), RANGE, LIMITS, MARGIN, noise=NOISE, y_scale=1.0, u_scale=10.0)
    return compare(task, linear, hysteresis, train, quick=quick, solvers=solvers), task


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table and draw the loops."""
    program(__doc__, "mpc_piezo", outcomes, ("µm", "V"), 1 / FS, TOLERANCE, arguments)


if __name__ == "__main__":
    main()
