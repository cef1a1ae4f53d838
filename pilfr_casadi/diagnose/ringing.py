"""Whether a rest swings at one of the simulator's own frequencies, as noise does not.

A force that is not recorded, or one that depends on more than a port's coordinate and the time, leaves such a rest: no
law at any port explains it, and yet something is missing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .linearise import linearised

if TYPE_CHECKING:
    from .workbench import Fitted, Workbench

LIGHT = 0.15  # damping ratio below which a mode rings
LOUD = 10.0  # times the spectrum around it
FINE = 10  # lines of the spectrum up to a mode
AVERAGED = 4  # half-overlapping segments that its spectrum is averaged over at least
AROUND = 1.2, 1.8  # times a mode's frequency, above and below, where the spectrum is compared with


def ringing(bench: Workbench, fitted: Fitted) -> float | None:
    """Frequency, Hz, of a lightly damped mode that stands out of a fit's residual, or None."""
    a = linearised(bench, fitted)[1][0].mean[0]
    with np.errstate(divide="ignore"):
        poles = np.log(np.linalg.eigvals(a).astype(complex)) * fitted.model.substeps / bench.dt
    modes = [abs(s) / (2 * np.pi) for s in poles if s.imag > 0 and -s.real < LIGHT * abs(s)]
    rest = [e[r.skip :, i] for e, r in zip(fitted.residual, bench.recordings, strict=True) for i in range(r.n_y)]
    return next((f for f in sorted(modes) if any(_stands_out(e, f * bench.dt) for e in rest)), None)


def _stands_out(e: np.ndarray, f: float) -> bool:
    """Whether the spectrum of e at frequency f, a share of the sampling rate, is far above that around it."""
    from scipy.signal import welch

    length = int(np.ceil(FINE / f))
    if AROUND[1] * f > 0.5 or 2 * len(e) // length - 1 < AVERAGED:
        return False
    lines, power = welch(e, nperseg=length)
    far = np.maximum(lines / f, f / np.maximum(lines, 1e-12))
    around = power[(far > AROUND[0]) & (far < AROUND[1])]
    return bool(np.max(power[far < 1 + 1.5 / FINE]) > LOUD * np.median(around))
