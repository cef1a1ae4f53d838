r"""Estimate the distribution of one value over many machines, and which machines do not belong to it.

Machine i has the estimate y_i with the known standard error s_i. A regular machine's value is drawn from a normal
distribution with the mean μ and the deviation τ between machines. A machine that differs may have any value in a wide
range of width D_i, its prior range. With π the share of machines that differ,

.. math::

    y_i \sim (1 - π) N(μ, τ^2 + s_i^2) + π N(μ, τ^2 + s_i^2 + D_i^2 / 12),

a contaminated normal distribution (Tukey 1960). The share has a Beta prior. Expectation maximisation (Dempster, Laird &
Rubin 1977) estimates it: the weight of a machine in μ and τ is its probability of being regular.
The deviation τ is estimated by restricted maximum likelihood (Patterson & Thompson 1971), as in random-effects
meta-analysis with known errors. The probability that τ differs from zero uses Schwarz's (1978) approximation of the
evidence for one further parameter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._base import with_nan

# Prior of the share of machines that differ, Beta(a, b): one in twenty, worth as much as twenty machines
DIFFERING, REGULAR = 1.0, 19.0
MAX_ITERATIONS = 200  # of expectation maximisation
TOLERANCE = 1e-6  # largest change of a probability at convergence
MAD_TO_STD = 1.4826  # standard deviation over median absolute deviation of a normal distribution
GRID, REFINEMENTS = 31, 4  # values of τ per grid, and the number of grids, each about the best of the last
TINY = 1e-300


@dataclass(frozen=True, eq=False)
class Population:
    """The distribution of a value over the machines.

    Attributes
    ----------
    mean, mean_error : float
        μ and its standard error, which is 0 if μ was given.
    deviation : float
        τ, the standard deviation between regular machines.
    varies : float
        Probability that τ is not zero, so that regular machines do not share one value.
    share : float
        π, the expected share of machines that differ.
    differs : array, shape (n,)
        Probability that each machine differs; nan if it has no value.
    """

    mean: float
    mean_error: float
    deviation: float
    varies: float
    share: float
    differs: np.ndarray

    def probability(self, value: float, error: float, width: float) -> float:
        """Compute the probability that a machine with this estimate differs."""
        v = self.deviation**2 + self.mean_error**2 + error**2
        return float(_posterior(np.array([value - self.mean]), np.array([v]), np.array([width]), self.share)[0])

    def to_dict(self) -> dict[str, float]:
        """Return the distribution, without the machines."""
        return {k: v for k, v in vars(self).items() if k != "differs"}

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> Population:
        """Make a population from the numbers of `to_dict`, with None for nan."""
        return cls(**with_nan(content), differs=np.zeros(0))


def estimate_population(
    values: Sequence[float] | np.ndarray,
    errors: Sequence[float] | np.ndarray,
    widths: Sequence[float] | np.ndarray | float,
    *,
    centre: float | None = None,
) -> Population:
    """Estimate the distribution of a value over machines.

    Parameters
    ----------
    values, errors : array, shape (n,)
        Estimate of each machine and its standard error; machines without finite numbers are left out.
    widths : array, shape (n,), or float
        Width of the range in which the value of a machine that differs may lie.
    centre : float, optional
        The known common value of all regular machines, such as a trend of zero; τ is then zero.
    """
    given = np.asarray(values, dtype=float), np.asarray(errors, dtype=float)
    known = np.isfinite(given[0]) & np.isfinite(given[1])
    y, s, d = given[0][known], given[1][known], np.broadcast_to(np.asarray(widths, dtype=float), known.shape)[known]
    differs = np.full(known.shape, np.nan)
    if not len(y):
        return Population(np.nan, np.nan, np.nan, 0.0, DIFFERING / (DIFFERING + REGULAR), differs)
    s = np.maximum(s, 1e-12 * max(float(np.max(np.abs(y))), TINY))
    mean, tau = (float(np.median(y)), 0.0) if centre is None else (centre, 0.0)
    if centre is None:
        tau = float(np.sqrt(max((MAD_TO_STD * np.median(np.abs(y - mean))) ** 2 - np.median(s**2), 0.0)))
    share, found, mean_error = DIFFERING / (DIFFERING + REGULAR), np.zeros(len(y)), 0.0
    for _ in range(MAX_ITERATIONS):
        before = found
        found = _posterior(y - mean, tau**2 + mean_error**2 + s**2, d, share)
        share = float((np.sum(found) + DIFFERING) / (len(y) + DIFFERING + REGULAR))
        if centre is None:
            tau = _estimate_deviation(y, s, 1 - found)
            mean, mean_error = _weighted_mean(y, s, tau, 1 - found)
        if np.max(np.abs(found - before)) < TOLERANCE:
            break
    differs[known] = found
    varies = 0.0 if centre is not None else _probability_of_variation(y, s, tau, 1 - found)
    return Population(mean, mean_error, tau, varies, share, differs)


def _posterior(off: np.ndarray, variance: np.ndarray, width: np.ndarray, share: float) -> np.ndarray:
    """Compute the probabilities that machines `off` the mean are drawn from the wide distribution."""
    wide = variance + width**2 / 12
    log_odds = np.log(share / (1 - share)) + 0.5 * (np.log(variance / wide) + off**2 * (1 / variance - 1 / wide))
    return _logistic(log_odds)


def _logistic(log_odds: Any) -> np.ndarray:
    """Convert logarithmic odds to probabilities."""
    return np.asarray(1 / (1 + np.exp(-np.clip(log_odds, -500, 500))))


def _weighted_mean(y: np.ndarray, s: np.ndarray, tau: Any, weight: np.ndarray) -> tuple[Any, Any]:
    """Compute the mean of regular machines and its standard error, for a deviation τ or a column of them."""
    precision = weight / (tau**2 + s**2)
    total = np.maximum(np.sum(precision, axis=-1), TINY)
    return np.sum(precision * y, axis=-1) / total, total**-0.5


def _restricted_likelihood(y: np.ndarray, s: np.ndarray, tau: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Compute the restricted log likelihood of each deviation in `tau`, (k,)."""
    column = np.asarray(tau)[:, None]
    mean, error = _weighted_mean(y, s, column, weight)
    variance = column**2 + s**2
    square = (y - mean[:, None]) ** 2
    return np.asarray(-0.5 * np.sum(weight * (np.log(variance) + square / variance), axis=1) + np.log(error))


def _estimate_deviation(y: np.ndarray, s: np.ndarray, weight: np.ndarray) -> float:
    """Estimate τ by the largest restricted likelihood, on a grid of zero and logarithmic steps, which is refined."""
    low, high = 1e-3 * float(np.min(s)), 2 * float(np.ptp(y)) + float(np.min(s))
    grid = np.append(0.0, np.geomspace(low, high, GRID))
    for _ in range(REFINEMENTS):
        k = int(np.argmax(_restricted_likelihood(y, s, grid, weight)))
        if grid[k] == 0.0:
            return 0.0
        least = 1 if grid[0] == 0.0 else 0
        grid = np.geomspace(grid[max(k - 1, least)], grid[min(k + 1, len(grid) - 1)], GRID)
    return float(grid[GRID // 2])


def _probability_of_variation(y: np.ndarray, s: np.ndarray, tau: float, weight: np.ndarray) -> float:
    """Compute the probability that τ is not zero; its prior is one half."""
    count = max(float(np.sum(weight)), 1.0)
    with_it, without = _restricted_likelihood(y, s, np.array([tau, 0.0]), weight)
    gain = with_it - without - 0.5 * np.log(count)
    return float(_logistic(gain)) if count > 1 else 0.0


def combine(values: np.ndarray, errors: np.ndarray) -> tuple[float, float]:
    """Return the weighted mean of a value over recordings, and its error with the factor of Birge (1932)."""
    if not len(values) or not np.all(np.isfinite(values) & np.isfinite(errors) & (errors > 0)):
        return np.nan, np.nan
    w = 1 / np.maximum(errors, TINY) ** 2
    mean = float(np.sum(w * values) / np.sum(w))
    return mean, float(np.sqrt(_birge_ratio(w, values - mean, 1) / np.sum(w)))


def _birge_ratio(weights: np.ndarray, residuals: np.ndarray, unknowns: int) -> float:
    """Return χ² per degree of freedom, at least 1: the factor on the variance if values scatter more than expected."""
    freedom = len(residuals) - unknowns
    return max(float(np.sum(weights * residuals**2) / freedom), 1.0) if freedom > 0 else 1.0


def slope(times: np.ndarray, values: np.ndarray, errors: np.ndarray) -> tuple[float, float]:
    """Fit a line by weighted least squares; return its slope and standard error, nan if fewer than two times differ.

    The error has the factor of Birge (1932).
    """
    known = np.isfinite(values) & np.isfinite(errors) & (errors > 0)
    t, y, w = times[known], values[known], 1 / np.maximum(errors[known], TINY) ** 2
    if len(np.unique(t)) < 2:
        return np.nan, np.nan
    about = t - np.sum(w * t) / np.sum(w)
    sxx = float(np.sum(w * about**2))
    found = float(np.sum(w * about * y) / sxx)
    left = y - np.sum(w * y) / np.sum(w) - found * about
    return found, float(np.sqrt(_birge_ratio(w, left, 2) / sxx))
