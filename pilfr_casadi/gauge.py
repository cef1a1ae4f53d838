"""Gauge freedoms of a PI-LFR, and standard errors that respect them.

The outputs of a PI-LFR do not change under

- any change of the basis of the states, `x = T x'` (n_x² directions);
- a scaling of a port's signal, `(C_z, D_zu, r)_i -> α (...)` with `(B_w, D_yw)_i -> (...)/α`, memory included. The
  generalized play has two here: the scale of z, which the envelopes take up, and that of the operators' output;
- a scaling of the weights, `w_i -> μ w_i` with `(B_w, D_yw)_i -> (...)/μ`;
- for a play with `r_ij = 0` (it passes z on), a shift of `w_ij` that the linear blocks take up.

`generators` gives the tangents of this orbit analytically. `covariance` works on their orthogonal complement, spanned
by Q, in the metric `D = diag(H)`, each variable in units of its own sensitivity: the gauge that stays nearest to the
fit.

    cov = D^-1/2 Q (Q'H~Q)^-1 Q'M~Q (Q'H~Q)^-1 Q' D^-1/2,    H~ = D^-1/2 H D^-1/2,    M~ = D^-1/2 M D^-1/2

`H = J'J/R` (plus priors) is the Gauss-Newton Hessian, and `M = J'ΩJ/R²` (plus the priors' share) carries the
covariance Ω of the residual: for each output an autoregression whose order BIC chooses. For white noise that order is
0 and this is the classical `σ²/R H^-1`; for a coloured residual it is the covariance of the least-squares estimate
(Ljung 1999, Chapter 9).

The errors say what another record with another noise would change. They do not know about bias: a model that is too
simple, or another minimum. A gauge-invariant function f (an eigenvalue, a static gain) has the variance `∇f' cov ∇f`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from .elements import PrandtlIshlinskii
from .lfr import PILFR
from .operators import GeneralizedPlay, Play
from .problem import Problem

Array = np.ndarray
Generator = tuple[dict[str, Array], Array]
# powers of the scales of z and of v in the parameters of an envelope (Eq. 14)
ENVELOPE = {"c": (0, 1), "a0": (-1, 1), "a": (0, 1), "b": (-1, 0), "d": (0, 0)}


def generators(structure: PILFR, values: Mapping[str, Array]) -> Iterator[Generator]:
    """Tangents of the gauge orbit at `values`: the change of each block, and the matrix that changes the state."""
    nx = structure.nx
    element = structure.element
    n_s = 0 if element is None else element.memory
    for k in range(nx * nx):
        e = np.zeros((nx, nx))
        e.flat[k] = 1.0
        state = np.zeros((nx + n_s, nx + n_s))
        state[:nx, :nx] = -e
        change = {name: -e @ values[name] for name in ("B_u", "B_w")} | {
            name: values[name] @ e for name in ("C_y", "C_z")
        }
        yield change | {"A": values["A"] @ e - e @ values["A"]}, state
    if isinstance(element, PrandtlIshlinskii):
        for channel in range(element.channels):
            yield from _channel_generators(element, values, channel, nx)


def _channel_generators(
    element: PrandtlIshlinskii, values: Mapping[str, Array], channel: int, nx: int
) -> Iterator[Generator]:
    """Scalings of one channel, in powers of the scales of z, of the operators' output and of the weights."""

    def row(name: str, power: int) -> Array:
        return power * values[name] * (np.arange(element.channels) == channel)[:, None]

    def column(name: str, power: int) -> Array:
        return power * values[name] * (np.arange(element.channels) == channel)

    still = np.zeros((nx + element.memory,) * 2)
    memory = still.copy()
    own = nx + channel * element.n + np.arange(element.n)
    memory[own, own] = 1.0
    general = isinstance(element.operator, GeneralizedPlay)
    rounded = element.rounded and np.any(values["eps"] > 0)
    if not general:
        scalings = [(1, 1, 0), (0, 0, 1)]
    elif element.operator.gamma_l is None and element.operator.gamma_r is None:
        scalings = [(1, 0, 0), (0, 1, 0), (0, 0, 1)]
    else:
        scalings = [(0, 0, 1)]
    for of_z, of_v, of_w in scalings:
        if of_v and rounded:
            continue
        change = {name: row(name, of_z) for name in ("C_z", "D_zu")} | {"r": row("r", of_v), "w": row("w", of_w)}
        change |= {name: column(name, -of_v - of_w) for name in ("B_w", "D_yw")}
        if general and (of_z or of_v):
            for side in ("l", "r"):
                for name, (p_z, p_v) in ENVELOPE.items():
                    change[f"gamma_{side}_{name}"] = row(f"gamma_{side}_{name}", p_z * of_z + p_v * of_v)
        yield change, memory if of_v else still
    if isinstance(element.operator, Play) and not rounded:
        for j in np.flatnonzero(values["r"][channel] == 0):
            weight = np.zeros(values["w"].shape)
            weight[channel, j] = 1.0
            b, d = values["B_w"][:, [channel]], values["D_yw"][:, [channel]]
            c, e = values["C_z"][[channel]], values["D_zu"][[channel]]
            yield {"w": weight, "A": -b @ c, "B_u": -b @ e, "C_y": -d @ c, "D_yu": -d @ e}, still


def gauge_tangents(problem: Problem, theta: Array, structure: PILFR, held: Array) -> Array:
    """Directions of θ that change no output and move no entry that is fixed, given or in `held`: shape (size, k).

    held : bool array, shape (size,)
        Variables that must not move, such as those at an active bound.
    """
    parameters = problem.model.parameters
    values = parameters.unpack(problem.parameters(theta))
    states = problem.initial_states(theta)
    estimated = [isinstance(r.initial, str) and r.initial == "estimate" for r in problem.recordings]
    columns = []
    for change, matrix in generators(structure, values):
        blocks = [np.ravel(change.get(name, np.zeros(p.value.shape)), order="F") for name, p in parameters.items()]
        columns.append(np.concatenate([*blocks, *(matrix @ s for s in states)]))
    if not columns:
        return np.zeros((problem.size, 0))
    n = len(states[0])
    moving = np.concatenate([parameters.free, np.repeat(estimated, n)]).astype(bool)
    everything = np.column_stack(columns)
    everything = everything / np.maximum(np.linalg.norm(everything, axis=0), 1e-300)
    inside, outside = everything[moving], everything[~moving]
    return inside @ _null_space(np.concatenate([outside, inside[held]]))


def _null_space(rows: Array, tolerance: float = 1e-10) -> Array:
    """Orthonormal basis of the vectors that every row maps to zero, rows scaled to unit length."""
    length = np.linalg.norm(rows, axis=1)
    rows = rows[length > 0] / length[length > 0, None]
    if not len(rows):
        return np.eye(rows.shape[1])
    return _complement(rows.T, tolerance)


def _complement(columns: Array, tolerance: float = 1e-10) -> Array:
    """Orthonormal basis of the orthogonal complement of some columns, which may depend on each other."""
    from scipy.linalg import qr

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
    sensitivity = np.sqrt(np.diag(hessian))
    held = _snap_to_bounds(problem, theta, sensitivity)
    tangents = np.zeros((problem.size, 0)) if structure is None else gauge_tangents(problem, theta, structure, held)
    slopes = problem.constraint_jacobian(theta)[_active_constraints(problem, theta)]
    # a gauge direction that an active constraint forbids is no freedom
    tangents = tangents @ _null_space(slopes @ tangents)
    used = np.flatnonzero(~held & (sensitivity > 0))
    square, unit = np.ix_(used, used), sensitivity[used]
    removed = np.column_stack([tangents[used] * unit[:, None], slopes[:, used].T / unit[:, None]])
    length = np.linalg.norm(removed, axis=0)
    basis = _complement(removed[:, length > 0] / length[length > 0])
    values, vectors = np.linalg.eigh(basis.T @ (hessian[square] / unit / unit[:, None]) @ basis)
    least = 1e-14 * len(used) * values.max(initial=0.0)
    seen, directions = values > least, basis @ vectors
    noise = _noise(problem, theta, hessian, int(seen.sum()))[square] / unit / unit[:, None]
    inverse = directions[:, seen] / values[seen] @ directions[:, seen].T
    inner = inverse @ noise @ inverse
    # a direction that is not seen counts as one of which the data says just too little
    hidden = np.sum(directions[:, ~seen] ** 2, axis=1) > least * np.diag(inverse)
    inner[hidden, hidden] = np.inf
    out = np.zeros((problem.size, problem.size))
    out[square] = inner / unit / unit[:, None]
    blind = np.flatnonzero(~held & (sensitivity == 0))
    out[blind, blind] = np.inf
    return out, held


def _snap_to_bounds(problem: Problem, theta: Array, sensitivity: Array, tolerance: float = 1e-9) -> Array:
    """Move variables that are within rounding of a bound onto it, in place; returns which (size,), bool.

    Within rounding means that the move changes the normalised outputs by less than `tolerance`.
    """
    held = np.zeros(problem.size, dtype=bool)
    for bound in (problem.lower, problem.upper):
        near = np.isfinite(bound)
        near[near] = np.abs(theta - bound)[near] * np.where(sensitivity > 0, sensitivity, np.inf)[near] <= tolerance
        near |= theta == bound
        theta[near] = bound[near]
        held |= near
    return held


def _active_constraints(problem: Problem, theta: Array, tolerance: float = 1e-7) -> Array:
    if not len(problem.g_lower):
        return np.zeros(0, dtype=bool)
    g = problem.constraint(theta)
    return (g >= problem.g_upper - tolerance) | (g <= problem.g_lower + tolerance)


def _noise(problem: Problem, theta: Array, hessian: Array, estimated: int) -> Array:
    """Covariance of the gradient: `J'ΩJ/R²` plus the priors' share, shape (size, size)."""
    from scipy.signal import lfilter

    total, n_y = problem.residuals, problem.model.n_y
    lost = total / (total - estimated) if total > estimated else np.inf
    lengths = [(len(r) - r.skip) * n_y for r in problem.recordings]
    pieces = [e.reshape(-1, n_y) for e in np.split(problem.residual(theta), np.cumsum(lengths)[:-1])]
    models = [_autoregression([e[:, i] for e in pieces]) for i in range(n_y)]
    out, plain = np.zeros((problem.size,) * 2), np.zeros((problem.size,) * 2)
    for _, jac, columns in problem.stretches(theta):
        where = np.ix_(columns, columns)
        plain[where] += jac.T @ jac
        for i, (polynomial, variance) in enumerate(models):
            # J'ΩJ with Ω = variance G G', G = 1/polynomial: filter J backwards in time
            filtered = lfilter([1.0], polynomial, jac[i::n_y][::-1], axis=0) if len(polynomial) > 1 else jac[i::n_y]
            out[where] += variance * filtered.T @ filtered
    mean_square = float(sum(np.sum(e**2) for e in pieces)) / total
    return lost * (out / total + mean_square * (hessian - plain / total)) / total


def _autoregression(pieces: list[Array]) -> tuple[Array, float]:
    """Autoregression `polynomial(q^-1) e = white` of pieces of a signal: polynomial and variance of the white part.

    Yule-Walker by the recursion of Levinson and Durbin; the order has the smallest BIC.
    """
    samples = sum(len(e) for e in pieces)
    most = min(40, max(len(e) for e in pieces) // 20)
    lags = [sum(float(e[: max(len(e) - lag, 0)] @ e[lag:]) for e in pieces) / samples for lag in range(most + 1)]
    polynomial, variance = np.ones(1), lags[0]
    best, criterion = (polynomial, variance), 0.0
    for order in range(1, most + 1):
        if variance <= 0:
            break
        reflection = -float(polynomial @ np.array(lags[order:0:-1])) / variance
        extended = np.append(polynomial, 0.0)
        polynomial, variance = extended + reflection * extended[::-1], variance * (1 - reflection**2)
        value = samples * np.log(max(variance, 1e-300) / lags[0]) + order * np.log(samples)
        if value < criterion:
            best, criterion = (polynomial, variance), value
    return best
