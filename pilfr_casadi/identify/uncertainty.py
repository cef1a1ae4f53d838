"""Standard errors that respect the gauge freedoms of a PI-LFR.

`orbit.generators` gives the directions that change no output. `covariance` works on their orthogonal complement,
spanned by Q, in the metric `D = diag(H)`, each variable in units of its own sensitivity: the gauge that stays nearest
to the fit.

    cov = D^-1/2 Q (Q'H~Q)^-1 Q'M~Q (Q'H~Q)^-1 Q' D^-1/2,    H~ = D^-1/2 H D^-1/2,    M~ = D^-1/2 M D^-1/2

`H = J'J/R` (plus priors) is the Gauss-Newton Hessian, and M the covariance of the gradient, `J'ΩJ/R²` (plus the priors'
share) with the covariance Ω of the noise as `residual_noise` finds it. For white noise this is the classical
`σ²/R H^-1`; for coloured noise it is the covariance of the least-squares estimate (Ljung 1999, Chapter 9).

The errors say what another record with another noise would change. They do not know about bias: a model that is too
simple, or another minimum. A gauge-invariant function f (an eigenvalue, a static gain) has the variance `∇f' cov ∇f`.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..models import PILFR, Neighbours, generators
from ..optimise import Problem

Array = np.ndarray
STATES = ("A", "B_u", "B_w", "C_y", "C_z")  # blocks that a change of coordinates of the states changes
FADED = 1e-30  # share of its matrix's largest sensitivity below which an entry counts as not seen


def gauge_tangents(problem: Problem, theta: Array, structure: PILFR, held: Array) -> Array:
    """Directions of θ that change no output and move no entry that is fixed, given or in `held`: shape (size, k).

    held : bool array, shape (size,)
        Variables that must not move, such as those at an active bound.
    """
    inside, outside = orbit_tangents(problem, theta, structure)
    size = np.maximum(np.sqrt(np.sum(inside**2, axis=0) + np.sum(outside**2, axis=0)), 1e-300)
    inside, outside = inside / size, outside / size
    return inside @ null_space(np.concatenate([outside, inside[held]])) if inside.size else inside


def orbit_tangents(problem: Problem, theta: Array, structure: PILFR) -> tuple[Array, Array]:
    """The orbit's generators (one a column) as changes of the variables (size, k), and of what is none (m, k)."""
    parameters = problem.model.parameters
    values = parameters.unpack(problem.parameters(theta))
    states = problem.initial_states(theta)
    estimated = [r.begins == "estimate" for r in problem.recordings]
    columns = []
    for change, move in generators(structure, values):
        blocks = [np.ravel(change.get(name, np.zeros(p.value.shape)), order="F") for name, p in parameters.items()]
        columns.append(np.concatenate([*blocks, *(move(s) for s in states)]))
    n = len(states[0])
    moving = np.concatenate([parameters.free, np.repeat(estimated, n)]).astype(bool)
    everything = np.column_stack(columns) if columns else np.zeros((len(moving), 0))
    return everything[moving], everything[~moving]


def null_space(rows: Array, tolerance: float = 1e-10) -> Array:
    """Orthonormal basis of the vectors that every row maps to zero, rows scaled to unit length."""
    length = np.linalg.norm(rows, axis=1)
    rows = rows[length > 0] / length[length > 0, None]
    if not len(rows):
        return np.eye(rows.shape[1])
    return _complement(rows.T, tolerance)


def _complement(columns: Array, tolerance: float = 1e-10) -> Array:
    """Orthonormal basis of the orthogonal complement of some columns, which may depend on each other."""
    from scipy.linalg import qr

    q, r = np.linalg.qr(columns, mode="complete")
    diagonal = np.abs(np.diag(r))
    if np.any(diagonal <= tolerance * diagonal.max(initial=0.0)):  # dependent: the slower way tells how many are not
        q, r, _ = qr(columns, pivoting=True)
        diagonal = np.abs(np.diag(r))
    return np.asarray(q[:, int(np.sum(diagonal > tolerance * diagonal.max(initial=0.0))) :])


def covariance(problem: Problem, theta: Array, structure: PILFR | None = None) -> Array:
    """Covariance of the variables θ at a solution, gauge directions and active constraints removed.

    Parameters
    ----------
    problem : Problem
        The problem that was solved.
    theta : array, shape (size,)
        Its solution.
    structure : PILFR, optional
        Says which gauge freedoms the model has; without it there are none.

    Returns
    -------
    array, shape (size, size)
        Rows and columns of variables at an active bound are zero; the variance of what the data leaves open is
        infinite.
    """
    return _covariance(problem, theta, structure)[0]


def variance(matrix: Array, slope: Array) -> Array:
    """Covariance of functions of θ by the delta method.

    Parameters
    ----------
    matrix : array, shape (n, n)
        From `covariance`.
    slope : array, shape (..., n)
        Derivatives of the functions with respect to θ. Where they are zero, an infinite variance does not count.

    Returns
    -------
    array, shape (..., ...)
        `slope matrix slope'`.
    """
    slope = np.asarray(slope, dtype=float)
    unknown = np.isinf(np.diag(matrix))
    finite = np.where(unknown[:, None] & unknown, 0.0, matrix)
    out = slope @ finite @ slope.T
    blind = np.any(slope[..., unknown] != 0, axis=-1)
    return np.asarray(np.where(blind[..., None] & blind if out.ndim else blind, np.inf, out))


def standard_errors(problem: Problem, theta: Array, structure: PILFR | None = None) -> dict[str, Array]:
    """Standard errors of the model's parameters by name, in the gauge described above; see `covariance`.

    Returns
    -------
    dict
        One array of the parameter's shape by name: nan where an entry is fixed or at an active bound, inf where the
        data says nothing about it.
    """
    parameters = problem.model.parameters
    matrix, held = _covariance(problem, theta, structure)
    errors = np.where(held, np.nan, np.sqrt(np.diag(matrix)))
    full = np.full(parameters.size, np.nan)
    full[parameters.free] = errors[: int(parameters.free.sum())]
    return parameters.unpack(full)


def _covariance(problem: Problem, theta: Array, structure: PILFR | None) -> tuple[Array, Array]:
    theta = np.array(theta, dtype=float)
    _, _, hessian = problem.normal(theta)
    if not np.all(np.isfinite(hessian)):
        return np.diag(np.full(problem.size, np.inf)), np.zeros(problem.size, dtype=bool)
    given = theta.copy()
    held = _snap_to_bounds(problem, theta, np.sqrt(np.diag(hessian)))
    if np.any(theta != given):  # a threshold on its bound may slip where it stuck
        _, _, hessian = problem.normal(theta)
    sensitivity = np.sqrt(np.diag(hessian))
    # what only a transient showed that has long faded: its derivative is a number, and says nothing
    sensitivity = np.where(sensitivity > FADED * Neighbours(problem.labels).largest(sensitivity), sensitivity, 0.0)
    tangents = np.zeros((problem.size, 0)) if structure is None else gauge_tangents(problem, theta, structure, held)
    slopes = problem.constraint_jacobian(theta)[problem.active_constraints(theta)]
    # a gauge direction that an active constraint forbids is no freedom; a constraint on a spectral radius or a gain
    # forbids none, but for rounding
    forbidden, size = slopes @ tangents, np.abs(slopes) @ np.abs(tangents)
    tangents = tangents @ null_space(np.where(np.abs(forbidden) > 1e-4 * size, forbidden, 0.0))
    used = np.flatnonzero(~held & (sensitivity > 0))
    square, unit = np.ix_(used, used), sensitivity[used]
    removed = np.column_stack([tangents[used] * unit[:, None], slopes[:, used].T / unit[:, None]])
    length = np.linalg.norm(removed, axis=0)
    basis = _complement(removed[:, length > 0] / length[length > 0])
    values, vectors = np.linalg.eigh(basis.T @ (hessian[square] / unit / unit[:, None]) @ basis)
    least = 1e-14 * len(used) * values.max(initial=0.0)
    seen, directions = values > least, basis @ vectors
    # coordinates in which the Hessian is the identity
    weights = np.zeros((problem.size, int(seen.sum())))
    weights[used] = directions[:, seen] / np.sqrt(values[seen]) / unit[:, None]
    out = weights @ gradient_covariance(problem, theta, weights) @ weights.T
    # a direction that is not seen counts as one of which the data says just too little
    inverse = np.sum(directions[:, seen] ** 2 / values[seen], axis=1)
    hidden = used[np.sum(directions[:, ~seen] ** 2, axis=1) > least * inverse]
    if problem.residuals <= seen.sum():
        hidden = used
    blind = np.flatnonzero(~held & (sensitivity == 0))
    out[hidden, hidden] = out[blind, blind] = np.inf
    return out, held


def _snap_to_bounds(problem: Problem, theta: Array, sensitivity: Array, tolerance: float = 1e-9) -> Array:
    """Move variables that are within rounding of a bound onto it, in place; returns which (size,), bool.

    Within rounding means that the move changes the normalised outputs by less than `tolerance`, by the sensitivity at
    either end: what hardly counts where it is, such as the slope of a saturated neuron, may count at a bound far away.
    """
    given, held = theta.copy(), np.zeros(problem.size, dtype=bool)
    for bound in (problem.lower, problem.upper):
        near = np.isfinite(bound) & (sensitivity > 0)
        near[near] = np.abs(theta - bound)[near] * sensitivity[near] <= tolerance
        near |= theta == bound
        theta[near] = bound[near]
        held |= near
    if np.any(theta != given):
        there = np.sqrt(np.diag(problem.normal(theta)[2]))
        far = ~(np.abs(theta - given) * there <= tolerance)
        theta[far] = given[far]
        held &= ~far
    return held


def describe_unknown_errors(errors: Mapping[str, np.ndarray]) -> list[str]:
    """What it means that standard errors are infinite, none where none is."""
    count = {name: int(np.sum(np.isinf(e))) for name, e in errors.items()}
    turned = [name for name in STATES if count.get(name)]
    others = [f"{count[k]} of {np.size(e)} entries of {k}" for k, e in errors.items() if count[k] and k not in turned]
    out = [f"the data alone says nothing about {', '.join(others)}"] if others else []
    if turned:
        out.append(
            f"entries of {', '.join(turned)} have no standard error of their own: others, as in other coordinates of "
            "the states, give the same outputs; judge poles, zeros and responses instead"
        )
    return out


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
