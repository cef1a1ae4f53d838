r"""Subspace identification of a linear model from recordings (PO-MOESP).

With the past inputs and outputs as instruments and the future inputs projected off, all in Hankel matrices of `r` block
rows, the future outputs span the range of the observability matrix:

.. math::

    \begin{bmatrix} U_f \\ U_p \\ Y_p \\ Y_f \end{bmatrix} = L Q, \qquad
    \operatorname{range} \begin{bmatrix} L_{42} & L_{43} \end{bmatrix} = \operatorname{range} O,

the factorization done by a sequential QR over the samples of all recordings. Source: Verhaegen (1994), Identification
of the deterministic part of MIMO state space models given in innovations form, Automatica 30(1), 61-74. `B` and `D` are
from the simulated output, with an initial state (and offset) for each recording.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ..data import Recording, check_for_identification
from .statespace import propagate
from .subspace_problem import BUDGET, RangeSpace, SubspaceProblem, or_one, triangle

Array = np.ndarray

CHUNK = 8192  # rows handled at once in a sequential QR


class TimeProblem(SubspaceProblem):
    """Subspace identification from recordings."""

    def __init__(self, recordings: Recording | Iterable[Recording], offset: bool) -> None:
        records = check_for_identification(recordings)
        self.dt, self.offset = records[0].dt, offset
        u, y = [r.u[r.skip :] for r in records], [r.y[r.skip :] for r in records]
        self.y_scale = or_one(np.std(np.concatenate(y), axis=0))
        self.u_scale = or_one(np.sqrt(np.mean(np.concatenate(u) ** 2, axis=0)))
        self.records = [(a / self.u_scale, b / self.y_scale) for a, b in zip(u, y, strict=True)]
        n = u[0].shape[1] + y[0].shape[1]
        lengths = np.array([len(a) for a in u])
        self.size = float(lengths.sum() * len(self.y_scale))
        r = np.arange(1, lengths.max() // 2 + 2)
        columns = np.maximum(lengths - 2 * r[:, None] + 1, 0).sum(axis=1)
        self.most_rows = int(np.max(r[columns >= 2 * r * n], initial=0))
        self.affordable_rows = np.sqrt(BUDGET / lengths.sum()) / (2 * n)
        self.too_few = f"{lengths.sum()} samples in {len(lengths)} recording(s) are too few"

    def range_space(self, r: int) -> RangeSpace:
        """See :meth:`SubspaceProblem.range_space`."""
        n_u, n_y = len(self.u_scale), len(self.y_scale)
        R = None
        for u, y in self.records:
            n = len(u) - 2 * r + 1
            if n < 1:
                continue
            windows = [
                _windows(u[r:], r),
                _windows(u[: len(u) - r], r),
                _windows(y[: len(y) - r], r),
                _windows(y[r:], r),
            ]
            mean = [w.mean(axis=0) if self.offset else 0.0 for w in windows]
            for k in range(0, n, CHUNK):
                rows = [
                    (w[k : k + CHUNK] - m).reshape(min(CHUNK, n - k), -1) for w, m in zip(windows, mean, strict=True)
                ]
                R = _folded(R, np.concatenate(rows, axis=1))
        assert R is not None
        past = r * (2 * n_u + n_y)
        left, values, _ = np.linalg.svd(R[r * n_u : past, past:].T)
        return RangeSpace(left[:-n_y], left[n_y:], left[:n_y], values)

    def reduced(self, A: Array, C: Array) -> list[Array]:
        """See :meth:`SubspaceProblem.reduced`."""
        n_u, n_y, nx = len(self.u_scale), len(self.y_scale), len(A)
        free = nx + n_y * self.offset  # initial state and offset: eliminated recording by recording
        total = None
        for u, y in self.records:
            x = np.zeros((n_u + 1, n_y, nx))
            x[n_u] = C
            R = None
            for k in range(0, len(u), CHUNK):
                m = min(CHUNK, len(u) - k)
                force = np.zeros((n_u + 1, n_y, m, nx))
                force[:n_u] = u[k : k + m].T[:, None, :, None] * C[:, None, :]
                response, last = propagate(A, force.reshape(-1, m, nx), x.reshape(-1, nx))
                x, response = last.reshape(x.shape), response.reshape(force.shape)
                K = np.zeros((n_y, m, free + n_u * (nx + n_y) + 1))
                K[..., :nx] = response[n_u]
                if self.offset:
                    K[..., nx:free] = np.eye(n_y)[:, None]
                for j in range(n_u):
                    first = free + j * (nx + n_y)
                    K[..., first : first + nx] = response[j]
                    K[..., first + nx : first + nx + n_y] = np.eye(n_y)[:, None] * u[k : k + m, j, None]
                K[..., -1] = y[k : k + m].T
                R = _folded(R, K.reshape(n_y * m, -1))
            assert R is not None
            total = _folded(total, R[free:, free:])
        assert total is not None
        return [total]


def _windows(x: Array, r: int) -> Array:
    """All windows of `r` samples, oldest first, (M - r + 1, r, n); a view."""
    return np.lib.stride_tricks.sliding_window_view(x, r, axis=0).swapaxes(1, 2)


def _folded(R: Array | None, rows: Array) -> Array:
    """Triangular factor of `R` with more rows below it, as many rows as columns."""
    folded = triangle(rows if R is None else np.concatenate([R, rows]))
    missing = folded.shape[1] - len(folded)
    return np.concatenate([folded, np.zeros((missing, folded.shape[1]))]) if missing else folded
