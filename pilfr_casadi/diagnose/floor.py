"""The noise floor: from repeated periods, from repeated recordings, or estimated from a residual.

What repeats is rounded alike, so that a measured floor is at least the error of rounding to the sensor's steps.

The estimate takes third differences of the residual (normalised by √20): they remove slow model error and keep white
noise. They underestimate coloured noise. If a fit's residual cannot be told from noise (no local signal explains any of
it on held-out data), the residual itself is the floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..data import Recording

CORRELATED, P_VALUE = 0.5, 1e-4  # rank correlation, and its p-value, from which a residual's power depends on a signal
ABOVE_NOISE = 2.0  # ratio of the error to the noise from which results say that more is missing
FEWEST = 30.0  # effective samples that a residual has at least
LONGEST = 400  # longest correlation of a residual, in samples
DISTINCT_SHARE = 0.5  # share of the samples with distinct values above which a signal is not quantised
FEWEST_LEVELS = 10  # of a quantised signal; one with fewer is a switch
SAME_LEVEL = 1e-9  # distance of two values, over the range, below which they are one level


@dataclass(frozen=True, eq=False)
class Floor:
    """Standard deviation of each output's noise (n_y,), and its source."""

    deviation: np.ndarray
    source: str

    def beside(self, deviation: np.ndarray) -> Floor:
        """Return the floor with another independent error added, such as a surrogate's."""
        return Floor(np.hypot(self.deviation, deviation), self.source)

    def nrmse(self, scale: np.ndarray) -> float:
        """Compute the noise over the outputs' deviation, averaged over outputs."""
        return float(np.mean(self.deviation / scale))


def noise_floor(recordings: Sequence[Recording], residuals: Sequence[np.ndarray]) -> Floor:
    """Measure the floor on repeated data, or estimate it from residuals if nothing repeats."""
    return measured_floor(recordings) or Floor(white_part(residuals), "estimated")


def measured_floor(recordings: Sequence[Recording]) -> Floor | None:
    """Measure the floor on periods, else on recordings with the same input; None if there are neither."""
    found = [d for d in map(_from_periods, recordings) if d is not None]
    rounding = _sensor_steps(recordings) / np.sqrt(12)
    if found:
        return Floor(np.maximum(np.sqrt(np.mean(np.square(found), axis=0)), rounding), "periods")
    groups: dict[bytes, list[Recording]] = {}
    for r in recordings:
        groups.setdefault(r.u.tobytes(), []).append(r)
    repeats = [np.std([r.y[_settled(g) :] for r in g], axis=0, ddof=1) for g in groups.values() if len(g) > 1]
    if repeats:
        return Floor(np.maximum(np.sqrt(np.mean(np.concatenate(repeats) ** 2, axis=0)), rounding), "repeats")
    return None


def _sensor_steps(recordings: Sequence[Recording]) -> np.ndarray:
    """Find the step of each output's values, (n_y,); zero if most samples have a value of their own."""
    y = np.concatenate([r.y for r in recordings])
    out = np.zeros(y.shape[1])
    for i, column in enumerate(y.T):
        levels = np.unique(column)
        gaps = np.diff(levels)
        gaps = gaps[gaps > SAME_LEVEL * np.ptp(column)]
        if FEWEST_LEVELS <= len(levels) < DISTINCT_SHARE * len(column):
            out[i] = gaps.min()
    return out


def _settled(group: Sequence[Recording]) -> int:
    """Return the first compared sample of recordings of one input: late if their initial states may differ."""
    first = max(r.skip for r in group)
    alike = all(r.begins in ("zero", "periodic") for r in group)
    return first if alike else max(first, len(group[0]) // 2)


def _from_periods(r: Recording) -> np.ndarray | None:
    n = r.period
    if not n or r.begins != "periodic":
        return None
    y = r.y[r.skip :]
    count = len(y) // n
    if count < 2:
        return None
    folded = y[: count * n].reshape(count, n, -1)
    return np.asarray(np.sqrt(np.mean(np.var(folded, axis=0, ddof=1), axis=0)))


def third_differences(residual: np.ndarray) -> np.ndarray:
    """Return third differences (M - 3, n_y), normalised so that white noise keeps its deviation."""
    return np.asarray(np.diff(residual, 3, axis=0) / np.sqrt(20))


def white_part(residuals: Sequence[np.ndarray]) -> np.ndarray:
    """Estimate the white noise inside residuals, (n_y,): third differences, the smallest over recordings."""
    return np.asarray(np.min([np.sqrt(np.mean(third_differences(e) ** 2, axis=0)) for e in residuals], axis=0))


def effective_size(residuals: Sequence[np.ndarray]) -> float:
    """Count the independent samples: all samples over the residuals' correlation time `1 + 2 Σ ρ²`."""
    total = 0.0
    for e in residuals:
        for column in (e - e.mean(axis=0)).T:
            n = len(column)
            spectrum = np.abs(np.fft.rfft(column, 2 * n)) ** 2
            rho = np.fft.irfft(spectrum)[: min(LONGEST, n // 4)]
            rho = rho / rho[0] if rho[0] > 0 else np.zeros(1)
            total += n / (1 + 2 * float(np.sum(rho[1:] ** 2)))
    return total


def swells_with(residuals: Sequence[np.ndarray], signals: Sequence[np.ndarray]) -> bool:
    """Tell whether a residual's power follows any column of signals of the same length; that of noise does not.

    Test the rank correlation (Spearman 1904) of their powers over blocks longer than the residual's correlation time.
    """
    from scipy.stats import spearmanr

    def powers(v: np.ndarray, block: int) -> np.ndarray:
        count = len(v) // block
        return np.asarray(np.mean(v[: count * block].reshape(count, block) ** 2, axis=1))

    for k in range(residuals[0].shape[1]):
        own = [e[:, [k]] for e in residuals]
        memory = sum(map(len, own)) / max(effective_size(own), 1.0)
        blocks = [int(np.clip(4 * memory, 10, max(len(e) // 12, 10))) for e in own]
        loud = np.concatenate([powers(e[:, 0], b) for e, b in zip(own, blocks, strict=True)])
        for j in range(signals[0].shape[1]):
            other = np.concatenate([powers(v[:, j] - v[:, j].mean(), b) for v, b in zip(signals, blocks, strict=True)])
            if len(loud) < 8 or not np.ptp(other) > 0:
                continue
            rank, chance = spearmanr(loud, other)
            if rank > CORRELATED and chance < P_VALUE:
                return True
    return False
