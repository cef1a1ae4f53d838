"""Predictive control of the rig with a Masing spring, on the exact simulator (`python -m problems.mpc_masing`).

The models are fitted to a training record of `masing_data`; the controllers know nothing of the truth. The displacement
of mass 2 has to follow a sum of sines that is cut off just below the limit of the displacement.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pilfr_casadi.identify import fit
from pilfr_casadi.models import PILFR, Play, PrandtlIshlinskii

from .closed_loop import Outcome, Task, compare, program
from .masing import MasingRig, State, advance, stepper
from .masing_data import FS, records

LIMIT, MARGIN, TOLERANCE = (
    0.75e-3,
    0.01e-3,
    0.005e-3,
)  # m: of the displacement; kept from it; accepted beyond
FORCE = 3.0  # N


class RigInMotion:
    """The rig of `masing` sample by sample; `y` is x2 in m before the next force acts."""

    def __init__(self, rig: MasingRig | None = None, fs: float = FS, substeps: int = 8) -> None:
        rig = rig or MasingRig()
        self._step, self._spring, self._h, self._n = stepper(rig), rig.spring, 1.0 / (fs * substeps), substeps
        self._state: State = (0.0, 0.0, 0.0, 0.0)

    @property
    def y(self) -> float:
        """Displacement of mass 2, m."""
        return self._state[2]

    def advance(self, u: float) -> None:
        """Hold the force u, N, for one sample."""
        for _ in range(self._n):
            self._spring, self._state = advance(self._step, self._spring, self._state, self._h, u, 0.0)


def reference(samples: int) -> np.ndarray:
    """Sines of 0.7, 1.9 and 4.3 Hz, raised from rest within half a second, cut off at the limit less the margin."""
    t = np.arange(samples) / FS
    sines = zip((0.5, 0.45, 0.15), (0.7, 1.9, 4.3), (0.0, 1.0, 0.0), strict=True)
    path = sum(a * np.sin(2 * np.pi * f * t + phase) for a, f, phase in sines)
    return np.asarray(np.clip(1e-3 * np.minimum(1, t / 0.5) * path, MARGIN - LIMIT, LIMIT - MARGIN))


def outcomes(samples: int = 600, *, quick: bool = False, solvers: Sequence[str] = ()) -> tuple[list[Outcome], Task]:
    """Fit both models, close all loops."""
    train = records(100)["train"]
    linear = fit(PILFR(5), train)
    hysteresis = fit(PILFR(5, PrandtlIshlinskii(Play, 10)), train, starts=3)
    task = Task(
        RigInMotion, reference(samples), (-FORCE, FORCE), (-LIMIT, LIMIT), MARGIN, noise=1e-6, y_scale=1e-4, u_scale=1.0
    )
    return compare(task, linear, hysteresis, train, quick=quick, solvers=solvers), task


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table and draw the loops."""
    program(__doc__, "mpc_masing", outcomes, ("m", "N"), 1 / FS, TOLERANCE, arguments)


if __name__ == "__main__":
    main()
