r"""Estimate the distribution of one value over many machines, and which machines do not belong to it.

Machine i has the estimate y_i with the known standard error s_i. A regular machine's value is drawn from a normal
distribution with the mean μ and the deviation τ between machines. A machine that differs may have any value in a wide
range of width D_i, its prior range. With π the share of machines that differ,

.. math::

    y_i \sim (1 - π) N(μ, τ^2 + s_i^2) + π N(μ, τ^2 + s_i^2 + D_i^2 / 12),

a contaminated normal distribution (Tukey 1960). The share has a Beta prior. Each machine is compared with the others:
its probability follows from theirs, with which they weigh in μ, τ and the share, until all agree (collapsed variational
Bayes of zeroth order, Asuncion et al. 2009). Few machines hardly determine τ, so the comparison is averaged over it
(Gelman et al. 2013, Bayesian Data Analysis, ch. 5): it is zero, or its logarithm is uniform, and each value weighs as
its restricted likelihood (Patterson & Thompson 1971), as in random-effects meta-analysis with known errors. The same
average judges a new machine. The deviation that is stated has the largest restricted likelihood. The probability that
it differs from zero uses Schwarz's (1978) approximation of the evidence for one further parameter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._base import with_nan

# Prior of the share of machines that differ, Beta(a, b): one in twenty, worth as much as twenty machines
DIFFERING, REGULAR = 1.0, 19.0
MAX_ITERATIONS = 200  # of the comparison of each machine with the others
TOLERANCE = 1e-6  # largest change of a probability at convergence
MAD_TO_STD = 1.4826  # standard deviation over median absolute deviation of a normal distribution
GRID, REFINEMENTS = 31, 4  # values of τ per grid, and the number of grids, each about the best of the last
STEP = 1.1  # ratio of one value of τ to the next in the average
TINY = 1e-300


@dataclass(frozen=True, eq=False)
class Population:
    """The distribution of a value over the machines.

    Attributes
    ----------
    mean, mean_error : float
        μ and its standard error, which is 0 if μ was given.
    deviation : float
        τ, the standard deviation between regular machines, at its largest likelihood.
    varies : float
        Probability that τ is not zero, so that regular machines do not share one value.
    share : float
        π, the expected share of machines that differ.
    differs : array, shape (n,)
        Probability that each machine differs from the others; nan if it has no value.
    spread : array, shape (4, k)
        Possible values of τ, and for each the logarithm of its weight, μ and the standard error of μ.
    """

    mean: float
    mean_error: float
    deviation: float
    varies: float
    share: float
    differs: np.ndarray
    spread: np.ndarray

    def probability(self, value: float, error: float, width: float) -> float:
        """Compute the probability that a machine with this estimate differs."""
        return float(_posterior(np.array(value), np.array(error), np.array(width), np.array(self.share), self.spread))

    def to_dict(self) -> dict[str, Any]:
        """Return the distribution, without the machines."""
        return {k: v for k, v in vars(self).items() if k != "differs"}

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> Population:
        """Make a population from the content of `to_dict`, with None for nan; older files have a single value of τ."""
        own = with_nan(content)
        spread = own.get("spread") or [[own["deviation"]], [0.0], [own["mean"]], [own["mean_error"]]]
        return cls(**{**own, "spread": np.array(spread, dtype=float)}, differs=np.zeros(0))


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
    share = DIFFERING / (DIFFERING + REGULAR)
    if not len(y):
        return Population(np.nan, np.nan, np.nan, 0.0, share, differs, np.full((4, 1), np.nan))
    s = np.maximum(s, max(1e-12 * float(np.max(np.abs(y))), TINY**0.5))
    mean, tau, mean_error = (float(np.median(y)) if centre is None else centre), 0.0, 0.0
    with_others = np.vstack([1 - np.eye(len(y)), np.ones(len(y))])  # each machine, and at last a new one
    if centre is None:
        grid, log_prior = _deviation_prior(y, s, d, with_others)
        tau = float(np.sqrt(max((MAD_TO_STD * np.median(np.abs(y - mean))) ** 2 - np.median(s**2), 0.0)))
    spread = np.broadcast_to(np.reshape([tau, 0.0, mean, 0.0], (4, 1, 1)), (4, len(with_others), 1))
    shares, found = np.full(len(with_others), share), np.full(len(y), np.nan)
    for _ in range(MAX_ITERATIONS):
        before, found = found, _posterior(y, s, d, shares[:-1], spread[:, :-1])
        if np.max(np.abs(found - before)) < TOLERANCE:
            break
        shares = (with_others @ found + DIFFERING) / (np.sum(with_others, axis=1) + DIFFERING + REGULAR)
        if centre is None:
            weight = with_others * np.maximum(1 - found, TINY**0.5)
            likelihood, *means = _restricted_likelihood(y, s, grid, weight)
            log_weight = log_prior + likelihood - np.max(likelihood, axis=1, keepdims=True)
            spread = np.stack([np.broadcast_to(grid, log_weight.shape), log_weight, *means])
    else:
        found = (found + before) / 2  # as of two machines far apart, of which either may differ
    differs[known], varies = found, 0.0
    if centre is None:
        tau = _estimate_deviation(y, s, weight[-1])
        _, (mean,), (mean_error,) = _restricted_likelihood(y, s, np.array([tau]), weight[-1])
        varies = _probability_of_variation(y, s, tau, weight[-1])
    new = spread[:, -1, np.isfinite(spread[1, -1])]
    return Population(float(mean), float(mean_error), tau, varies, float(shares[-1]), differs, new)


def _posterior(y: np.ndarray, s: np.ndarray, width: np.ndarray, share: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Compute the probabilities that values are drawn from the wide distribution, averaged over their `spread`."""
    from scipy.special import expit, logsumexp

    tau, log_weight, mean, mean_error = spread
    off, variance = y[..., None] - mean, np.maximum(tau**2 + mean_error**2 + s[..., None] ** 2, TINY)
    wide = variance + width[..., None] ** 2 / 12
    differs, regular = (logsumexp(log_weight - 0.5 * (np.log(v) + off**2 / v), axis=-1) for v in (wide, variance))
    return np.asarray(expit(np.log(share / (1 - share)) + differs - regular))


def _deviation_prior(
    y: np.ndarray, s: np.ndarray, width: np.ndarray, with_others: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Make a grid of τ, (k,), and the logarithm of its prior for the machines of each row of `with_others`, (m, k).

    One half is at zero. The other half is uniform in the logarithm of τ, from where it matters beside the errors of
    these machines to the largest that their values and the widths admit.
    """
    others = with_others > 0
    least, lowest = (np.min(np.where(others, a, np.inf), axis=1) for a in (s, y))
    highest = np.max(np.where(others, y, -np.inf), axis=1)
    low, high = 0.1 * least, 2 * (highest - lowest) + np.max(width)
    grid = np.append(0.0, low[-1] * STEP ** np.arange(1 + np.log(max(high[-1] / low[-1], 1.0)) / np.log(STEP)))
    inside = (grid >= low[:, None]) & (grid <= high[:, None])
    inside[:, 0] = True
    count = np.maximum(np.sum(inside, axis=1, keepdims=True) - 1, 1)
    return grid, np.where(inside, np.where(grid > 0, -np.log(count), 0.0), -np.inf)


def _restricted_likelihood(
    y: np.ndarray, s: np.ndarray, tau: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the restricted log likelihood of each deviation in `tau`, (k,), the mean and its standard error.

    The weights of the machines are (n,), or (m, n) for m results at once, (m, k).
    """
    variance = tau[:, None] ** 2 + s**2
    precision = np.sum(np.atleast_2d(weight), axis=0) / variance
    about = np.sum(precision * y, axis=1) / np.sum(precision, axis=1)  # differences from it keep their digits
    off = y - about[:, None]
    total = np.maximum(weight @ (1 / variance).T, TINY)
    shift = weight @ (off / variance).T / total
    square = np.maximum(weight @ (off**2 / variance).T - shift**2 * total, 0.0)
    return -0.5 * (weight @ np.log(variance).T + square + np.log(total)), about + shift, total**-0.5


def _estimate_deviation(y: np.ndarray, s: np.ndarray, weight: np.ndarray) -> float:
    """Estimate τ by the largest restricted likelihood, on a grid of zero and logarithmic steps, which is refined."""
    low, high = 1e-3 * float(np.min(s)), 2 * float(np.ptp(y)) + float(np.min(s))
    grid = np.append(0.0, np.geomspace(low, high, GRID))
    for _ in range(REFINEMENTS):
        k = int(np.argmax(_restricted_likelihood(y, s, grid, weight)[0]))
        if grid[k] == 0.0:
            return 0.0
        least = 1 if grid[0] == 0.0 else 0
        grid = np.geomspace(grid[max(k - 1, least)], grid[min(k + 1, len(grid) - 1)], GRID)
    return float(grid[GRID // 2])


def _probability_of_variation(y: np.ndarray, s: np.ndarray, tau: float, weight: np.ndarray) -> float:
    """Compute the probability that τ is not zero; its prior is one half."""
    from scipy.special import expit

    count = max(float(np.sum(weight)), 1.0)
    with_it, without = _restricted_likelihood(y, s, np.array([tau, 0.0]), weight)[0]
    gain = with_it - without - 0.5 * np.log(count)
    return float(expit(gain)) if count > 1 else 0.0


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
