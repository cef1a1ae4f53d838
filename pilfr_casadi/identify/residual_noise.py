"""What the residual of a fit says about the noise, and so about the scatter of the gradient.

Each output's noise is an autoregression whose order BIC chooses, none for white noise. A fit takes out of its
residual what the parameters could follow, which looks like noise that avoids those frequencies: the residual of white
noise has the covariance `σ² (I - P)`, `P = J H^-1 J' / R`. Its autocovariances are corrected for that before they are
used, and the noise is never taken to be weaker in any direction of the parameters than white noise of the same
variance. What is left of the bias counts where coloured noise meets many parameters in a narrow band.
"""

from __future__ import annotations

import numpy as np

from ..optimise import Problem

Array = np.ndarray
LAGS = 40


def gradient_covariance(problem: Problem, theta: Array, weights: Array) -> Array:
    """Covariance of the gradient of the cost at a solution, priors included.

    Parameters
    ----------
    problem : Problem
        Problem that was solved.
    theta : array, shape (size,)
        Its solution.
    weights : array, shape (size, k)
        Coordinates in which the Gauss-Newton Hessian is the identity.

    Returns
    -------
    array, shape (k, k)
        `weights' J'ΩJ weights / R²`, and `(I - weights' J'J weights / R) σ²/R` for the priors.
    """
    from scipy.linalg import eigh, solve_banded

    total, n_y, k = problem.residuals, problem.model.n_y, weights.shape[1]
    lags = _autocovariances(problem, theta, weights)
    lags[:, 0] = np.maximum(lags[:, 0], 1e-12 * lags[:, 0].max())
    models = [_autoregression(c, total // n_y) for c in lags]
    white, coloured, informed = (np.zeros((k, k)) for _ in range(3))
    for _, jac, columns in problem.stretches(theta):
        slope = jac @ weights[columns]
        informed += slope.T @ slope / total
        for i, (polynomial, variance) in enumerate(models):
            own = slope[i::n_y]
            if not len(own):
                continue
            white += lags[i, 0] * own.T @ own
            # Ω = variance L^-1 L^-T with the banded triangle L of the polynomial
            filtered = solve_banded((0, len(polynomial) - 1), np.tile(polynomial[::-1, None], len(own)), own)
            coloured += variance * filtered.T @ filtered
    prior = (np.eye(k) - informed) * lags[:, 0].mean() / total
    white, coloured = white / total**2 + prior, coloured / total**2 + prior
    if not k or not np.any(lags) or all(len(polynomial) == 1 for polynomial, _ in models):
        return white
    ratio, vectors = eigh(coloured, white)
    vectors = white @ vectors
    return np.asarray(vectors * np.maximum(ratio, 1.0) @ vectors.T)


def _autocovariances(problem: Problem, theta: Array, weights: Array) -> Array:
    """Autocovariances of each output's noise, shape (n_y, lags), corrected for what the fit took out."""
    total, n_y = problem.residuals, problem.model.n_y
    most = min(LAGS, total // n_y // 20)
    residual, taken = np.zeros((2, n_y, most + 1))
    for e, jac, columns in problem.stretches(theta):
        slope = jac @ weights[columns] / np.sqrt(total)
        for i in range(n_y):
            for lag in range(min(most, len(e) // n_y - 1) + 1):
                a, b = slice(i, len(e) - lag * n_y, n_y), slice(i + lag * n_y, None, n_y)
                residual[i, lag] += e[a] @ e[b]
                taken[i, lag] += np.sum(slope[a] * slope[b])
    count = total / n_y
    variance = residual[:, :1] / np.maximum(count - taken[:, :1], 1.0)
    return np.asarray((residual + variance * taken) / count)


def _autoregression(lags: Array, samples: int) -> tuple[Array, float]:
    """Autoregression `polynomial(q^-1) e = white` of a signal: its polynomial and the variance of the white part.

    Yule-Walker by the recursion of Levinson and Durbin; the order has the smallest BIC.
    """
    polynomial, variance = np.ones(1), float(lags[0])
    best, criterion = (polynomial, variance), 0.0
    for order in range(1, len(lags)):
        reflection = -float(polynomial @ lags[order:0:-1]) / max(variance, 1e-300)
        if not abs(reflection) < 1:
            break
        extended = np.append(polynomial, 0.0)
        polynomial, variance = extended + reflection * extended[::-1], variance * (1 - reflection**2)
        value = samples * np.log(variance / lags[0]) + order * np.log(samples)
        if value < criterion:
            best, criterion = (polynomial, variance), value
    return best
