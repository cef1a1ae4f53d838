r"""Bounds on a spectral radius as smooth rows, also where eigenvalues meet.

With `Q` from a real Schur form of `M / c` at some point and `S = I + X`, X strictly block lower triangular,

    F = S⁻¹ Q' (M / c) Q S,    F below its 2 x 2 diagonal blocks = 0,

says that F has the eigenvalues of its diagonal blocks. Both of a block lie in the unit disc if and only if (Jury)

    1 - det >= 0,   1 - tr + det >= 0,   1 + tr + det >= 0,

and so `ρ(M) <= c`: polynomials in M and in the unknowns X, without the kinks and infinite slopes that eigenvalues have
where they meet. At the point itself X = 0. Blocks hold complex pairs and those real eigenvalues that are nearest to
each other, which alone may become a pair.
"""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

Array = np.ndarray


def block_starts(n: int) -> list[int]:
    """First index of each diagonal block: two by two, a last single one where n is odd."""
    return list(range(0, n, 2))


def below_blocks(n: int) -> Array:
    """Mask (n, n) of what lies below the diagonal blocks."""
    block = np.arange(n) // 2
    return np.asarray(block[:, None] > block[None, :])


@lru_cache(maxsize=32)
def bounded_rows(n: int, lifted: bool = True) -> ca.Function:
    """`(M, X) -> (held, low)`: Jury's rows of the diagonal blocks, and what is below them; M (n, n) over its bound.

    X holds the entries of `below_blocks` in CasADi's order (column by column); without `lifted` there are none, and M
    has to be block triangular as it is.
    """
    mask = below_blocks(n)
    m = ca.SX.sym("M", n, n)
    low = [(int(i), int(j)) for j, i in zip(*np.nonzero(mask.T), strict=True)]
    x = ca.SX.sym("X", len(low) if lifted else 0)
    step = ca.SX.zeros(n, n)
    for k, (i, j) in enumerate(low if lifted else []):
        step[i, j] = x[k]
    inverse, power = ca.SX.eye(n), ca.SX.eye(n)
    for _ in range((n + 1) // 2 - 1):  # X is nilpotent
        power = -ca.mtimes(power, step)
        inverse = inverse + power
    f = ca.mtimes([inverse, m, ca.SX.eye(n) + step])
    held = []
    for i in block_starts(n):
        if i + 1 < n:
            trace, det = f[i, i] + f[i + 1, i + 1], f[i, i] * f[i + 1, i + 1] - f[i, i + 1] * f[i + 1, i]
            held += [1 - det, 1 - trace + det, 1 + trace + det]
        else:
            held += [1 - f[i, i], 1 + f[i, i]]
    out = [ca.vertcat(*held), ca.vertcat(*(f[i, j] for i, j in low)) if lifted else ca.SX(0, 1)]
    return ca.Function("bounded_rows", [m, x], [ca.densify(o) for o in out], ["M", "X"], ["held", "low"])


def paired_schur(matrix: Array) -> tuple[Array, Array]:
    """Orthogonal Q and block upper triangular T (n, n) with `M = Q T Q'`, complex pairs and nearest reals in blocks."""
    from scipy.linalg import lapack, schur

    t, q = schur(np.asarray(matrix, dtype=float))
    n = len(t)
    for i in block_starts(n)[:-1]:
        part = np.ascontiguousarray(t[i:, i:])
        first = np.zeros(n - i, dtype=np.int32)
        first[list(_first_pair(part))] = 1
        moved, turn = lapack.dtrsen(first, part, np.eye(n - i), job="N")[:2]
        t[i:, i:], t[:i, i:], q[:, i:] = moved, t[:i, i:] @ turn, q[:, i:] @ turn
    return q, np.where(below_blocks(n), 0.0, t)


def _first_pair(t: Array) -> tuple[int, int]:
    """The diagonal entries of a real Schur form that go into one block first."""
    double = np.flatnonzero(np.diag(t, -1))
    if len(double):
        return int(double[0]), int(double[0]) + 1
    order = np.argsort(np.diag(t))
    value = np.diag(t)[order]
    if len(order) % 2 == 0:
        return int(order[0]), int(order[1])
    # an odd one stays alone: the one that leaves the smallest gaps
    gaps = [np.sum(np.diff(np.delete(value, k))[::2]) for k in range(0, len(order), 2)]
    left = np.delete(order, 2 * int(np.argmin(gaps)))
    return int(left[0]), int(left[1])
