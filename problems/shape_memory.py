"""A shape-memory wire that lifts a load: hysteresis that differs on the way up and down, saturates, and lags.

Heating power u warms the wire with one time constant, `τ dT/dt = R u - T` (T above ambient). The wire is made of many
grains, each of which turns to austenite when T rises to its `A`, back to martensite when T falls to its `M < A`, and
keeps its phase in between: a Preisach model (Mayergoyz 2003, Mathematical Models of Hysteresis and their Applications,
Ch. 1; for shape-memory alloys Hughes & Wen 1997, Smart Materials and Structures 6). The stroke is proportional to the
share of austenite. Grains turn back over a wide range of temperatures and forth over a narrow one, so the ascending
branch is steep and late, the descending one flat and early, and both end where all grains have turned. No finite sum
of plays, stops or generalized plays is this wire: `A` and `M` scatter independently of each other.
"""

from __future__ import annotations

import numpy as np

from pilfr_casadi.data import Recording, multisine

FS = 10.0  # Hz
N_PERIOD = 2048
F_MAX = 0.1  # Hz
TIME_CONSTANT = 1.2  # s
RESISTANCE = 25.0  # K/W
STROKE = 4.0  # mm
GRAINS = 20000
NOISE = 0.005  # of the stroke's deviation
MEAN_POWER, POWER = 2.6, 0.75  # W, mean and standard deviation


def grains() -> tuple[np.ndarray, np.ndarray]:
    """Temperatures `A` and `M` (K above ambient) of every grain, evenly spread over their distributions."""
    from scipy.stats import gamma, norm, qmc

    p = np.clip(qmc.Halton(2, scramble=False).random(GRAINS + 1)[1:], 1e-9, 1 - 1e-9)
    a = norm.ppf(p[:, 0], 72.0, 4.0)
    return a, a - 6.0 - gamma.ppf(p[:, 1], 2.0, scale=7.0)


def temperature(u: np.ndarray) -> np.ndarray:
    """Temperature above ambient (M,) at the samples, the power u (M,) held between them, in periodic steady state."""
    decay, t, out = float(np.exp(-1 / (FS * TIME_CONSTANT))), 0.0, np.empty(len(u))
    for _ in range(2):
        for k, power in enumerate(u):
            out[k] = t
            t = decay * t + (1 - decay) * RESISTANCE * power
    return out


def austenite(t: np.ndarray) -> np.ndarray:
    """Share of austenite (M,) along temperatures (M,), in periodic steady state."""
    a, m = grains()
    phase, out = np.zeros(GRAINS, dtype=bool), np.empty(len(t))
    for _ in range(2):
        for k, now in enumerate(t):
            phase |= now >= a
            phase &= now > m
            out[k] = np.count_nonzero(phase) / GRAINS
    return out


def record(u: np.ndarray, rng: np.random.Generator, name: str = "") -> Recording:
    """One steady period of the stroke (mm) under the heating power u (W), with sensor noise."""
    y = STROKE * austenite(temperature(u))
    y += NOISE * np.std(y) * rng.standard_normal(len(u))
    units = {"power": "W", "stroke": "mm"}
    return Recording(u, y, 1 / FS, ("power",), ("stroke",), units, period=len(u), initial="periodic", name=name)


def excitation(rng: np.random.Generator) -> np.ndarray:
    """A period of heating power (N_PERIOD,), W, that visits large and small loops and never falls below zero."""
    return np.clip(MEAN_POWER + POWER * multisine(N_PERIOD, F_MAX, FS, rng), 0.0, None)


def swings(amplitudes: int = 8) -> np.ndarray:
    """Heating power (N_PERIOD,) that swings with shrinking, then growing amplitude: nested loops, W."""
    t = np.arange(N_PERIOD) / N_PERIOD
    return np.clip(MEAN_POWER + 2.2 * np.abs(2 * t - 1) * np.sin(2 * np.pi * 2 * amplitudes * t), 0.0, None)


def records(seed: int = 0) -> dict[str, list[Recording]]:
    """Training (two realizations), test (one), and `swings` (test), by name."""
    rng = np.random.default_rng(seed)
    drawn = [record(excitation(rng), rng, name) for name in ("train 1", "train 2", "multisine")]
    return {"train": drawn[:2], "multisine": drawn[2:], "swings": [record(swings(), rng, "swings")]}
