r"""Linear state-space models: resolvent, states over time, modal coordinates, and Kalman gains.

.. math:: x(k+1) = A x(k) + B u(k), \qquad y(k) = C x(k) + D u(k), \qquad G(z) = C (z I - A)^{-1} B + D

The resolvent uses one complex Schur form of `A` for all frequencies. States are computed in pieces of the record, all
pieces at once, joined by powers of `A`.

**Modal coordinates** serve linear parts of high order. A full state matrix has n_x² entries, but a change of basis
x = T x' leaves only 2 n_x of them free. Every diagonalizable A is similar to a matrix of blocks with a pair of poles
each (and a single pole if n_x is odd): a complex pair, or any two real poles, since all four entries of a block are
free. The model class stays the same (except for defective A), while sensitivities cost a tenth at 15 states. With
`fixed={"A": modal(15)}` the model of Krikelis et al. (2024), Eq. 15, is identified in these coordinates, beginning with
the linear model (Sec. 5.3).

**Kalman gains** are the core of every state estimator of the package. With a state of covariance P, outputs
`y = C x + noise` of covariance R, and a step `x⁺ = A x`,

    S = C P C' + R,   K = A P C' S⁻¹,   P̂ = (I - K C) P (I - K C)' + K R K'   (A = I).

`A = I` gives the gain of a filter, which corrects the present state; any other A the gain of a one-step predictor. The
extended Kalman filter (`control.kalman_filter`) and the smoother of an unknown force (`diagnose`) call the update at
every sample. With the steady-state gain the predictor is itself a model,

    x⁺ = f(x, u, p) + γ K (y_measured - y),

which can be fitted like any other: γ is a fixed parameter named `observer`, 1 gives the predictor and 0 the simulation.
A fit that starts far from the truth anneals γ from 1 to 0. Anderson & Moore (1979), Optimal Filtering, ch. 4-5.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, whole
from ..data import Recording
from ..models import Model, Parameter, inject_outputs, or_one

Array = np.ndarray
DEFECTIVE = 1e10  # condition number of the eigenvectors above which A counts as defective to rounding
REAL = 1e-12  # imaginary part, next to the largest eigenvalue, below which an eigenvalue is real
INJECTION = "observer"  # name of the parameter γ
# factor on A that makes an unobservable integrator detectable; 1e-4 per sample is far below any fit
FADING = 1 - 1e-4


def resolvent(A: Array, C: Array, z: Array) -> Array:
    """Return ``C (z I - A)⁻¹`` at every `z`, (F,) -> (F, n_y, nx), by one Schur form and substitution."""
    from scipy.linalg import schur

    T, V = schur(A, output="complex")
    c = C @ V
    X = np.empty((len(z), *C.shape), dtype=complex)
    for j in range(len(A)):
        X[..., j] = (c[:, j] + X[..., :j] @ T[:j, j]) / (z - T[j, j])[:, None]
    return X @ V.conj().T


def spectral_radius(matrix: Array) -> float:
    """Return the largest modulus of the eigenvalues; zero for a matrix without rows."""
    return float(np.max(np.abs(np.linalg.eigvals(matrix)), initial=0.0))


def reflect_poles(A: Array) -> Array:
    """Move eigenvalues outside the unit circle (or on it) to ``1 / conj(lambda)``, strictly inside."""
    from scipy.linalg import schur

    if spectral_radius(A) < 1:
        return A
    T, V = schur(A, output="real")
    k = 0
    while k < len(T):
        two = k + 1 < len(T) and T[k + 1, k] != 0
        block = T[k : k + 2, k : k + 2] if two else T[k : k + 1, k : k + 1]
        radius = np.sqrt(abs(np.linalg.det(block))) if two else abs(block[0, 0])
        if radius >= 1:
            block *= min(radius**-2, (1 - 1e-6) / radius)
        k += 2 if two else 1
    return V @ T @ V.T


def propagate(At: Array, v: Array, x0: Array) -> tuple[Array, Array]:
    """Return the states of ``x(k+1) = x(k) At + v(k)`` (rows) for several runs, and the state after the last sample.

    At is (nx, nx), v (runs, M, nx) and x0 (runs, nx). The samples are cut into about sqrt(M) pieces that advance
    together, so that Python loops over sqrt(M) steps.
    """
    runs, M, nx = v.shape
    length = int(np.ceil(np.sqrt(M)))
    pieces = -(-M // length)
    V = np.zeros((runs, pieces, length, nx))
    V.reshape(runs, pieces * length, nx)[:, :M] = v
    gained = np.zeros((runs, pieces, nx))
    for i in range(length):
        gained = gained @ At + V[:, :, i]
    power = np.linalg.matrix_power(At, length)
    start = np.empty((runs, pieces, nx))
    x = x0
    for k in range(pieces):
        start[:, k] = x
        x = x @ power + gained[:, k]
    X = np.empty_like(V)
    x = start
    for i in range(length):
        X[:, :, i] = x
        x = x @ At + V[:, :, i]
    X = X.reshape(runs, pieces * length, nx)[:, :M]
    return X, X[:, -1] @ At + v[:, -1]


def states_from_rest(a: Array, b: Array, u: Array) -> Array:
    """Return the states (M, nx) of ``x(k+1) = a x(k) + b u(k)`` from zero, for inputs u (M, n_u)."""
    return propagate(a.T, (u @ b.T)[None], np.zeros((1, len(a))))[0][0]


def modal(nx: int) -> Array:
    """Return the pattern of `A` in modal coordinates: nan (free) in 2 × 2 blocks on the diagonal, zero elsewhere.

    Parameters
    ----------
    nx : int
        Number of states.

    Returns
    -------
    array, shape (nx, nx)
        For `PILFR(nx, element, fixed={"A": modal(nx)})`.

    Raises
    ------
    InputError
        If nx is not a whole number above zero.
    """
    block = np.arange(whole(nx, "the number of states nx", 1)) // 2
    return np.where(block[:, None] == block, np.nan, 0.0)


def is_modal(fixed: Mapping[str, Any], nx: int) -> bool:
    """Tell whether the fixed entries of a structure give `A` the pattern of modal coordinates."""
    given = np.asarray(fixed.get("A", 0.0), dtype=float)
    return nx > 0 and given.shape == (nx, nx) and np.array_equal(given, modal(nx), equal_nan=True)


def modal_basis(a: Array) -> Array:
    """Return a basis T (nx, nx) in which `T⁻¹ A T` has 2 × 2 blocks on the diagonal: complex poles first, sorted."""
    values, vectors = np.linalg.eig(a)
    scale = np.max(np.abs(values), initial=1e-300)
    columns: list[Array] = []
    upper = np.flatnonzero(values.imag > REAL * scale)
    for k in upper[np.argsort(np.angle(values[upper]))]:
        columns += [vectors[:, k].real, vectors[:, k].imag]
    real = np.flatnonzero(np.abs(values.imag) <= REAL * scale)
    columns += [vectors[:, k].real for k in real[np.argsort(values[real].real)]]
    basis = np.column_stack(columns)
    if not np.linalg.cond(basis) < DEFECTIVE:
        raise InputError("The linear model has equal poles that modal coordinates cannot hold; leave A free.")
    return basis


def change_basis(blocks: Mapping[str, Array], t: Array) -> dict[str, Array]:
    """Return the blocks with `x = T x'`."""
    back = np.linalg.inv(t)
    return {**blocks, "A": back @ blocks["A"] @ t, "B_u": back @ blocks["B_u"], "C_y": blocks["C_y"] @ t}


def scale_states(blocks: Mapping[str, Array], size: Array) -> dict[str, Array]:
    """Return the blocks with each state in units of its size, (nx,)."""
    a, b = blocks["A"] * size / size[:, None], blocks["B_u"] / size[:, None]
    return {**blocks, "A": a, "B_u": b, "C_y": blocks["C_y"] * size}


def in_modal_coordinates(blocks: Mapping[str, Array], recordings: tuple[Recording, ...]) -> dict[str, Array]:
    """Transform `A`, `B_u`, `C_y` to modal coordinates, with states of unit rms over the recordings."""
    out = change_basis(blocks, modal_basis(blocks["A"]))
    out["A"] = np.where(np.isnan(modal(len(out["A"]))), out["A"], 0.0)
    states = [states_from_rest(out["A"], out["B_u"], r.u) for r in recordings]
    return scale_states(out, or_one(np.sqrt(np.mean(np.concatenate(states) ** 2, axis=0))))


def innovation_gain(S: Any, P: Any, C: Any, A: Any = None) -> Any:
    """Compute the gain `A P C' S⁻¹`, (n, n_y), for arrays or CasADi matrices; A is the identity by default."""
    solve = ca.solve if isinstance(P, ca.MX) else np.linalg.solve
    return _transpose(solve(S, C @ P if A is None else C @ P @ A.T))


def _transpose(matrix: Any) -> Any:
    """Transpose a matrix, or each of a stack."""
    return matrix.mT if isinstance(matrix, np.ndarray) else matrix.T


def measurement_update(P: Any, C: Any, R: Any) -> tuple[Any, Any, Any]:
    """Compute the innovation covariance S, the filter gain, and the covariance after a measurement.

    Takes arrays or CasADi matrices; P and R may be stacks of arrays.
    """
    S = C @ P @ C.T + R
    gain = innovation_gain(S, P, C)
    left = np.eye(P.shape[-1]) - gain @ C
    return S, gain, left @ P @ _transpose(left) + gain @ R @ _transpose(gain)


def steady_state_gain(a: Array, c: Array, q: Array, r: Array) -> Array:
    """Compute the steady-state gain of the one-step predictor, (n_x, n_y); zero if there is none.

    a and c are the state and output matrices, q and r the covariances of the process and the measurement noise.
    """
    from scipy.linalg import solve_discrete_are

    n = len(a)
    if not n:
        return np.zeros((0, len(c)))
    for fading in (1.0, FADING):
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # balancing may overflow; the gain is checked below
                p = solve_discrete_are(fading * a.T, c.T, q + 1e-12 * np.trace(q) / n * np.eye(n), r)
                gain = innovation_gain(c @ p @ c.T + r, p, c, a)
                radius = spectral_radius(a - gain @ c)
        except (np.linalg.LinAlgError, ValueError):
            continue
        if radius < 1 + 1e-6 and np.all(np.isfinite(gain)):
            return np.asarray(gain)
    return np.zeros((n, len(c)))


def with_output_injection(model: Model, gain: Array) -> Model:
    """Add output injection to a closed model: it reads the measured output; its parameter `observer` is fixed at 0.

    `gain` (k, n_y) acts on the first k states, never on memory.
    """
    return inject_outputs(model, gain, {INJECTION: Parameter(0.0, bounds=(0.0, 1.0), fixed=True)})
