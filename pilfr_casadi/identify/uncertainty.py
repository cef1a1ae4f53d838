"""Standard errors of a PI-LFR, which has gauge freedoms.

The outputs of a PI-LFR do not change under

- any change of the basis of the states, `x = T x'` (n_x² directions);
- a scaling of a port's signal, `(C_z, D_zu, r)_i -> α (...)` with `(B_w, D_yw)_i -> (...)/α`, memory included. The
  generalized play has two here: the scale of z, which the envelopes compensate, and the scale of the operators' output;
- a scaling of the weights, `w_i -> μ w_i` with `(B_w, D_yw)_i -> (...)/μ`;
- for a play with `r_ij = 0` (its output is z), a shift of `w_ij` that the linear blocks compensate;
- for a static network, the scalings of its signals, `slope_i -> slope_i/α` and `gain_i -> μ gain_i`;
- for generalized plays, a shift of all `r_i` against the two envelopes, and a shift of the output that `y_0`, the
  envelopes and the initial state compensate.

Each comes with an affine change of the initial states; `generators` yields their tangents. `covariance` works on the
orthogonal complement of these directions, spanned by Q, in the metric `D = diag(H)`: each variable is in units of its
own sensitivity. This gauge stays nearest to the fit.

    cov = D^-1/2 Q (Q'H~Q)^-1 Q'M~Q (Q'H~Q)^-1 Q' D^-1/2,    H~ = D^-1/2 H D^-1/2,    M~ = D^-1/2 M D^-1/2

`H = J'J/R` (plus priors) is the Gauss-Newton Hessian, and M the covariance of the gradient, `J'ΩJ/R²` (plus the priors'
share) with the covariance Ω of the noise (`gradient_covariance`). For white noise this is the classical `σ²/R H^-1`;
for coloured noise it is the covariance of the least-squares estimate (Ljung 1999, Chapter 9).

The errors describe how estimates vary from record to record with the noise. They do not cover the bias of a model that
is too simple, or another minimum. A gauge-invariant function f (an eigenvalue, a static gain) has the variance
`∇f' cov ∇f`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial

import numpy as np

from ..models import PILFR, GeneralizedPlay, Neighbours, Play, PrandtlIshlinskii, StaticNetwork
from ..optimise import Problem

Array = np.ndarray
Generator = tuple[dict[str, Array], Callable[[Array], Array]]
# powers of the scales of z and of the output in the parameters of an envelope (Eq. 14)
ENVELOPE = {"c": (0, 1), "a0": (-1, 1), "a": (0, 1), "b": (-1, 0), "d": (0, 0)}
STATES = ("A", "B_u", "B_w", "C_y", "C_z")  # blocks that depend on the coordinates of the states
FADED = 1e-30  # share of its matrix's largest sensitivity up to which an entry has no effect
LAGS = 40  # largest lag of the noise model
DEPENDENT = 1e-10  # singular value of unit vectors, over the largest, below which they depend on each other
AT_BOUND = 1e-9  # change of the normalised outputs that rounding at a bound may cause


def generators(structure: PILFR, values: Mapping[str, Array]) -> Iterator[Generator]:
    """Generate the tangents of the gauge orbit at `values`: the change of each block, and of the state with memory."""
    nx = structure.nx
    element = structure.element
    for k in range(nx * nx):
        e = np.zeros((nx, nx))
        e.flat[k] = 1.0
        change = {name: -e @ values[name] for name in ("B_u", "B_w")}
        change |= {name: values[name] @ e for name in ("C_y", "C_z")} | {"A": values["A"] @ e - e @ values["A"]}
        yield change, partial(_change_of_basis, e)
    if isinstance(element, PrandtlIshlinskii):
        for channel in range(element.channels):
            yield from _scale_channel(element, values, channel, nx)
            if isinstance(element.operator, Play):
                yield from _shift_weight(element, values, channel)
            if isinstance(element.operator, GeneralizedPlay) and element.operator.networks:
                yield from _shift_offset(element, values, channel, nx)
    if isinstance(element, StaticNetwork):
        for channel in range(element.channels):
            here = (np.arange(element.channels) == channel) * 1.0
            into = {name: values[name] * here[:, None] for name in ("C_z", "D_zu")}
            yield {**into, "slope": -values["slope"] * here[:, None]}, np.zeros_like
            out = {name: -values[name] * here for name in ("B_w", "D_yw")}
            yield {**out, "gain": values["gain"] * here[:, None]}, np.zeros_like


def _change_of_basis(e: Array, state: Array) -> Array:
    return np.concatenate([-e @ state[: len(e)], np.zeros(len(state) - len(e))])


def _scale_channel(
    element: PrandtlIshlinskii, values: Mapping[str, Array], channel: int, nx: int
) -> Iterator[Generator]:
    """Scale one channel, in powers of the scales of z, of the operators' output and of the weights."""
    here = np.arange(element.channels) == channel
    memory = np.concatenate([np.zeros(nx), np.repeat(here, element.n)])
    general = isinstance(element.operator, GeneralizedPlay)
    rounded = element.rounded and bool(np.any(values["eps"] > 0))
    scalings = [(1, 1, 0), (0, 0, 1)] if not general else [(0, 0, 1)]
    if general and element.operator.networks:
        scalings = [(1, 0, 0), (0, 1, 0), (0, 0, 1)]
    for of_z, of_v, of_w in scalings:
        if of_v and rounded:
            continue
        powers = {"C_z": of_z, "D_zu": of_z, "r": of_v, "w": of_w}
        if general and not of_w:
            powers |= {f"gamma_{side}_{k}": p * of_z + q * of_v for side in "lr" for k, (p, q) in ENVELOPE.items()}
        change = {name: power * values[name] * here[:, None] for name, power in powers.items()}
        change |= {name: -(of_v + of_w) * values[name] * here for name in ("B_w", "D_yw")}
        yield change, partial(np.multiply, of_v * memory)


def _shift_weight(element: PrandtlIshlinskii, values: Mapping[str, Array], channel: int) -> Iterator[Generator]:
    """Shift the weight of a play with r = 0, whose output is z, to the linear blocks."""
    b, d = values["B_w"][:, [channel]], values["D_yw"][:, [channel]]
    c, e = values["C_z"][[channel]], values["D_zu"][[channel]]
    if element.rounded and np.any(values["eps"] > 0):
        return
    for j in np.flatnonzero(values["r"][channel] == 0):
        weight = np.zeros(values["w"].shape)
        weight[channel, j] = 1.0
        yield {"w": weight, "A": -b @ c, "B_u": -b @ e, "C_y": -d @ c, "D_yu": -d @ e}, np.zeros_like


def _shift_offset(
    element: PrandtlIshlinskii, values: Mapping[str, Array], channel: int, nx: int
) -> Iterator[Generator]:
    """Shift thresholds against the envelopes, and the output's offset against the blocks that follow it."""
    here = (np.arange(element.channels) == channel)[:, None] * 1.0
    yield {"r": here * np.ones(values["r"].shape), "gamma_l_c": here, "gamma_r_c": -here}, np.zeros_like
    to_state = np.eye(nx) - values["A"]
    if nx and not np.linalg.cond(to_state) < 1e10:
        return
    total = values["w"][channel].sum()
    state = np.linalg.solve(to_state, values["B_w"][:, channel] * total)
    z = (values["C_z"] @ state)[:, None]
    change = {"y_0": -values["C_y"] @ state - values["D_yw"][:, channel] * total}
    for side in "lr":
        change[f"gamma_{side}_c"] = here - values[f"gamma_{side}_a0"] * z
        change[f"gamma_{side}_d"] = -values[f"gamma_{side}_b"] * z
    shift = np.concatenate([state, np.repeat(here.ravel(), element.n)])
    yield change, lambda _: shift


def gauge_tangents(problem: Problem, theta: Array, structure: PILFR, at_bound: Array) -> Array:
    """Find the directions of θ (size, k) that change no output, no fixed entry and no variable `at_bound` (size,)."""
    inside, outside = orbit_tangents(problem, theta, structure)
    size = np.maximum(np.sqrt(np.sum(inside**2, axis=0) + np.sum(outside**2, axis=0)), 1e-300)
    inside, outside = inside / size, outside / size
    return inside @ null_space(np.concatenate([outside, inside[at_bound]])) if inside.size else inside


def orbit_tangents(problem: Problem, theta: Array, structure: PILFR) -> tuple[Array, Array]:
    """Write the generators as columns: changes of the variables (size, k), and of all other entries (m, k)."""
    parameters = problem.model.parameters
    values = problem.values(theta)
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


def null_space(rows: Array) -> Array:
    """Find an orthonormal basis of the vectors that every row maps to zero, rows scaled to unit length."""
    from scipy import linalg

    length = np.linalg.norm(rows, axis=1)
    rows = rows[length > 0] / length[length > 0, None]
    return np.asarray(linalg.null_space(rows, rcond=DEPENDENT)) if len(rows) else np.eye(rows.shape[1])


def covariance(problem: Problem, theta: Array, structure: PILFR | None = None) -> Array:
    """Compute the covariance of θ at a solution, gauge directions and active constraints removed.

    Parameters
    ----------
    problem : Problem
        The problem that was solved.
    theta : array, shape (size,)
        Solution of the problem.
    structure : PILFR, optional
        Structure that tells the gauge freedoms of the model; without it there are none.

    Returns
    -------
    array, shape (size, size)
        Rows and columns of variables at an active bound are zero; variables that the data do not determine have
        an infinite variance.
    """
    return _covariance(problem, theta, structure)[0]


def variance(matrix: Array, slope: Array) -> Array:
    """Compute the covariance of functions of θ by the delta method.

    Parameters
    ----------
    matrix : array, shape (n, n)
        Covariance of θ, from `covariance`.
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
    """Compute the standard errors of the model's parameters by name, in the gauge described above; see `covariance`.

    Returns
    -------
    dict
        One array of the parameter's shape by name: nan where an entry is fixed or at an active bound, inf where the
        data do not determine it.
    """
    parameters = problem.model.parameters
    matrix, at_bound = _covariance(problem, theta, structure)
    errors = np.where(at_bound, np.nan, np.sqrt(np.diag(matrix)))
    full = np.full(parameters.size, np.nan)
    full[parameters.free] = errors[: int(parameters.free.sum())]
    return parameters.unpack(full)


def _covariance(problem: Problem, theta: Array, structure: PILFR | None) -> tuple[Array, Array]:
    """Compute the covariance of θ, and the mask (size,) of variables at an active bound; see `covariance`."""
    theta = np.array(theta, dtype=float)
    _, _, hessian = problem.normal(theta)
    if not np.all(np.isfinite(hessian)):
        return np.diag(np.full(problem.size, np.inf)), np.zeros(problem.size, dtype=bool)
    given = theta.copy()
    at_bound = snap_to_bounds(problem, theta, np.sqrt(np.diag(hessian)))
    if np.any(theta != given):  # a threshold on its bound may slip where it stuck
        _, _, hessian = problem.normal(theta)
    sensitivity = np.sqrt(np.diag(hessian))
    # drop entries that act only through a transient that has long faded: their derivative is rounding
    sensitivity = np.where(sensitivity > FADED * Neighbours(problem.labels).largest(sensitivity), sensitivity, 0.0)
    tangents = np.zeros((problem.size, 0)) if structure is None else gauge_tangents(problem, theta, structure, at_bound)
    slopes = problem.constraint_jacobian(theta)[problem.active_constraints(theta)]
    # an active constraint may exclude a gauge direction; constraints on a spectral radius or a gain exclude none, apart
    # from rounding
    forbidden, size = slopes @ tangents, np.abs(slopes) @ np.abs(tangents)
    tangents = tangents @ null_space(np.where(np.abs(forbidden) > 1e-4 * size, forbidden, 0.0))
    used = np.flatnonzero(~at_bound & (sensitivity > 0))
    square, unit = np.ix_(used, used), sensitivity[used]
    removed = np.column_stack([tangents[used] * unit[:, None], slopes[:, used].T / unit[:, None]])
    basis = null_space(removed.T)
    values, vectors = np.linalg.eigh(basis.T @ (hessian[square] / unit / unit[:, None]) @ basis)
    least = 1e-14 * len(used) * values.max(initial=0.0)
    determined, directions = values > least, basis @ vectors
    # coordinates in which the Hessian is the identity
    weights = np.zeros((problem.size, int(determined.sum())))
    weights[used] = directions[:, determined] / np.sqrt(values[determined]) / unit[:, None]
    out = weights @ gradient_covariance(problem, theta, weights) @ weights.T
    # a direction without effect is treated as one whose effect is just too small to count
    inverse = np.sum(directions[:, determined] ** 2 / values[determined], axis=1)
    undetermined = used[np.sum(directions[:, ~determined] ** 2, axis=1) > least * inverse]
    if problem.residuals <= determined.sum():
        undetermined = used
    without_effect = np.flatnonzero(~at_bound & (sensitivity == 0))
    out[undetermined, undetermined] = out[without_effect, without_effect] = np.inf
    return out, at_bound


def snap_to_bounds(problem: Problem, theta: Array, sensitivity: Array) -> Array:
    """Move variables within rounding of a bound onto it, in place; return the mask (size,) of variables at a bound.

    A variable is within rounding if the move changes the normalised outputs by less than `AT_BOUND`, by the sensitivity
    at both ends: a variable without effect here, such as the slope of a saturated neuron, may have one at the bound.
    """
    given, at_bound = theta.copy(), np.zeros(problem.size, dtype=bool)
    for bound in (problem.lower, problem.upper):
        near = np.isfinite(bound) & (sensitivity > 0)
        near[near] = np.abs(theta - bound)[near] * sensitivity[near] <= AT_BOUND
        near |= theta == bound
        theta[near] = bound[near]
        at_bound |= near
    if np.any(theta != given):
        there = np.sqrt(np.diag(problem.normal(theta)[2]))
        far = ~(np.abs(theta - given) * there <= AT_BOUND)
        theta[far] = given[far]
        at_bound &= ~far
    return at_bound


def describe_unknown_errors(errors: Mapping[str, np.ndarray]) -> list[str]:
    """Explain infinite standard errors; an empty list where there are none."""
    count = {name: int(np.sum(np.isinf(e))) for name, e in errors.items()}
    turned = [name for name in STATES if count.get(name)]
    others = [f"{count[k]} of {np.size(e)} entries of {k}" for k, e in errors.items() if count[k] and k not in turned]
    out = [f"the data alone do not determine {', '.join(others)}"] if others else []
    if turned:
        out.append(
            f"entries of {', '.join(turned)} have no standard error, because other values (other coordinates of the "
            "states) give the same outputs; judge poles, zeros and responses instead"
        )
    return out


def gradient_covariance(problem: Problem, theta: Array, weights: Array) -> Array:
    """Compute the covariance (k, k) of the gradient of the cost at a solution, priors included.

    It is `W' J'ΩJ W / R²`, and `(I - W' J'J W / R) σ²/R` for the priors, with the columns W of `weights` (size, k):
    coordinates in which the Gauss-Newton Hessian is the identity.
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
    """Estimate the autocovariances of each output's noise, shape (n_y, lags), corrected for the fitted part."""
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
    """Fit an autoregression `polynomial(q^-1) e = white`; return its polynomial and the variance of the white part.

    Yule-Walker by the recursion of Levinson and Durbin; the order has the smallest BIC. An exact fit leaves nothing.
    """
    polynomial, variance = np.ones(1), float(lags[0])
    best, criterion = (polynomial, variance), 0.0
    for order in range(1, len(lags) if variance > 0 else 0):
        reflection = -float(polynomial @ lags[order:0:-1]) / max(variance, 1e-300)
        if not abs(reflection) < 1:
            break
        extended = np.append(polynomial, 0.0)
        polynomial, variance = extended + reflection * extended[::-1], variance * (1 - reflection**2)
        value = samples * np.log(variance / lags[0]) + order * np.log(samples)
        if value < criterion:
            best, criterion = (polynomial, variance), value
    return best
