"""A piezo stage as an exact simulator: amplifier lag, Maxwell slip with many elements, a resonance.

Goldfarb & Celanovic (1997), IEEE Control Systems 17(3): the voltage behind the amplifier, less the Maxwell
resistance of stops `Σ w_j S_rj[v]`, drives mass, spring and damper. The resistance has 400 stops whose weights thin out
exponentially with the threshold; a model with a dozen plays is never of the same class. Between sub-steps the amplifier
moves monotonically towards the command, so the operators see every reversal; the mechanics are advanced exactly for the
mean of the force over a sub-step.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pilfr_casadi.data import Recording, multisine

FS = 1000.0  # Hz
RANGE = (0.0, 100.0)  # V
NOISE = 0.001  # µm, standard deviation of the sensor
SUBSTEPS = 10


@dataclass
class PiezoStage:
    """The stage in motion; `y` is the displacement in µm before the next voltage acts.

    Attributes
    ----------
    frequency, damping : float
        Of the resonance, Hz and share of critical damping.
    gain : float
        µm a volt for a small and slow motion, less what the stops hold back.
    held : float
        Share of a small motion that the stops hold back.
    lag : float
        Time constant of the amplifier, s.
    """

    frequency: float = 180.0
    damping: float = 0.04
    gain: float = 0.12
    held: float = 0.35
    lag: float = 4e-4
    elements: int = 400
    v: float = 0.0
    _x: np.ndarray = field(default_factory=lambda: np.zeros(2))

    def __post_init__(self) -> None:
        from scipy.linalg import expm

        r = np.linspace(0, 60, self.elements + 1)[1:]
        w = np.exp(-r / 20.0)
        self._r, self._w, self._q = r, self.held * w / w.sum(), np.zeros(self.elements)
        omega, h = 2 * np.pi * self.frequency, 1 / (FS * SUBSTEPS)
        a = np.array([[0, 1, 0], [-(omega**2), -2 * self.damping * omega, omega**2], [0, 0, 0.0]])
        self._step = expm(a * h)[:2]
        self._decay = float(np.exp(-h / self.lag))

    @property
    def y(self) -> float:
        """Displacement, µm."""
        return float(self._x[0])

    def advance(self, u: float) -> None:
        """Hold the voltage u, limited to the amplifier's range, for one sample."""
        u, before = float(np.clip(u, *RANGE)), self._force()
        for _ in range(SUBSTEPS):
            self.v = u + (self.v - u) * self._decay
            self._q = np.clip(self._q, self.v - self._r, self.v + self._r)
            after = self._force()
            self._x = self._step @ np.append(self._x, self.gain * (before + after) / 2)
            before = after

    def _force(self) -> float:
        return self.v - float(self._w @ (self.v - self._q))


def training(seed: int = 0, periods: int = 4) -> Recording:
    """A multisine up to 250 Hz on slow sweeps of the whole range, from rest at 0 V, 4096 samples."""
    rng, n = np.random.default_rng(seed), 1024
    fast = multisine(n, f_max=250.0, fs=FS, rng=rng)
    slow = multisine(n * periods, f_max=12.0, fs=FS, rng=rng)
    u = 50 + 6 * np.tile(fast, periods) + 18 * slow
    ramp = np.minimum(1.0, np.arange(len(u)) / 200)
    return record(np.clip(u * ramp, *RANGE), rng)


def record(u: np.ndarray, rng: np.random.Generator) -> Recording:
    """What the sensor says while the stage is driven from rest by u, V."""
    stage, y = PiezoStage(), np.zeros(len(u))
    for k, value in enumerate(u):
        y[k] = stage.y
        stage.advance(value)
    y += NOISE * rng.standard_normal(len(u))
    return Recording(
        u, y, 1 / FS, ("voltage",), ("displacement",), {"voltage": "V", "displacement": "µm"}, initial="zero"
    )
