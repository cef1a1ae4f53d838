r"""Discrete linear state-space models: resolvent, reflection of the poles, states over time.

.. math:: x(k+1) = A x(k) + B u(k), \qquad y(k) = C x(k) + D u(k), \qquad G(z) = C (z I - A)^{-1} B + D

The resolvent takes one complex Schur form of `A` for all frequencies; the states are computed in pieces of the record,
all pieces at once, joined by powers of `A`. Both are plain NumPy, for any number of samples and frequencies.
"""

from __future__ import annotations

import numpy as np

Array = np.ndarray


def resolvent(A: Array, C: Array, z: Array) -> Array:
    """Return ``C (z I - A)⁻¹`` at every `z`, (F,) -> (F, n_y, nx), by one Schur form and substitution."""
    from scipy.linalg import schur

    T, V = schur(A, output="complex")
    c = C @ V
    X = np.empty((len(z), *C.shape), dtype=complex)
    for j in range(len(A)):
        X[..., j] = (c[:, j] + X[..., :j] @ T[:j, j]) / (z - T[j, j])[:, None]
    return X @ V.conj().T


def reflect_poles(A: Array) -> Array:
    """Move eigenvalues outside the unit circle (or on it) to ``1 / conj(lambda)``, strictly inside."""
    from scipy.linalg import schur

    if np.max(np.abs(np.linalg.eigvals(A))) < 1:
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

    The samples are cut into about sqrt(M) pieces that advance together, so that Python loops over sqrt(M) steps.

    Parameters
    ----------
    At : array, (nx, nx)
    v : array, (runs, M, nx)
    x0 : array, (runs, nx)

    Returns
    -------
    X, last : array, (runs, M, nx), (runs, nx)
    """
    runs, M, nx = v.shape
    length = int(np.ceil(np.sqrt(M)))
    pieces = -(-M // length)
    V = np.zeros((runs, pieces, length, nx))
    V.reshape(runs, -1, nx)[:, :M] = v
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
    X = X.reshape(runs, -1, nx)[:, :M]
    return X, X[:, -1] @ At + v[:, -1]
