"""Coloured noise: autoregressive models of residuals, to tell slow noise from missing physics.

Neighbouring samples of slow noise are alike, so that a force or a law follows it a little wherever it is flexible. Its
innovations are not alike, and no force follows them. A residual e of noise alone is taken as

    e_t = a_1 e_{t-1} + … + a_p e_{t-p} + ε_t

with independent innovations ε of one variance for each recording and output, and with coefficients for each output
(Ljung 1999, System Identification, ch. 4 and 10). The order p is the one with the least BIC (Schwarz 1978).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

ORDERS = (0, 1, 2, 4, 8)  # that are tried; a higher order also predicts a sine, which no noise is
MOST_ROWS = 50_000  # samples to which coefficients are fitted
FEWEST_PER_COEFFICIENT = 10  # samples of all recordings that are long enough
LEAST_LENGTH = 2  # of a recording that counts, in orders


def whitening_filters(residuals: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the filter (1, -a_1, …, -a_p) of each output that makes innovations of residuals, each (M, n_y)."""
    return [_likeliest([e[:, i] for e in residuals])[0] for i in range(residuals[0].shape[1])]


def log_likelihood(residuals: Sequence[np.ndarray]) -> float:
    """Compute the log likelihood of residuals, each (M, n_y), as coloured noise; each coefficient costs log(n)/2."""
    return sum(_likeliest([e[:, i] for e in residuals])[1] for i in range(residuals[0].shape[1]))


def whiten(columns: np.ndarray, filters: Sequence[np.ndarray], lengths: Sequence[int]) -> np.ndarray:
    """Filter the stacked outputs (R, n) of recordings of some lengths; the samples without a past are zero.

    R counts the outputs of a sample together, recording by recording.
    """
    from scipy.signal import lfilter

    out, n_y = np.empty_like(columns), len(filters)
    by_output = columns.reshape(-1, n_y, columns.shape[1]), out.reshape(-1, n_y, columns.shape[1])
    for i, taps in enumerate(filters):
        for begin, end in zip(np.cumsum([0, *lengths[:-1]]), np.cumsum(lengths), strict=True):
            white = lfilter(taps, [1.0], by_output[0][begin:end, i], axis=0)
            white[: len(taps) - 1] = 0.0
            by_output[1][begin:end, i] = white
    return out


def _likeliest(columns: Sequence[np.ndarray]) -> tuple[np.ndarray, float]:
    """Return the filter of the order with the least BIC, and its log likelihood less its cost."""
    first = max(p for p in ORDERS if p * FEWEST_PER_COEFFICIENT <= sum(map(len, _long_enough(columns, p))))
    columns, most = _long_enough(columns, first), [p for p in ORDERS if p <= first]
    n = sum(len(e) - first for e in columns)
    found = []
    for p in most:
        taps = _taps(columns, p, first)
        variances = [np.mean(np.convolve(e, taps)[first : len(e)] ** 2) for e in columns]
        logs = [(len(e) - first) * np.log(max(v, 1e-300)) for e, v in zip(columns, variances, strict=True)]
        found.append((taps, -0.5 * float(sum(logs) + p * np.log(n))))
    return max(found, key=lambda one: one[1])


def _long_enough(columns: Sequence[np.ndarray], p: int) -> list[np.ndarray]:
    """Select the recordings that say something about the order p."""
    return [e for e in columns if len(e) >= max(LEAST_LENGTH * p, 1)]


def _taps(columns: Sequence[np.ndarray], p: int, first: int) -> np.ndarray:
    """Fit the filter of order p to the samples from `first` on, each recording in units of its deviation."""
    if not p:
        return np.ones(1)
    step = -(-sum(map(len, columns)) // MOST_ROWS)
    past, now = [], []
    for e in columns:
        e = e / max(float(np.std(e)), 1e-300)
        at = np.arange(first, len(e), step)
        past.append(e[at[:, None] - np.arange(1, p + 1)])
        now.append(e[at])
    return np.append(1.0, -np.linalg.lstsq(np.concatenate(past), np.concatenate(now), rcond=1e-12)[0])
