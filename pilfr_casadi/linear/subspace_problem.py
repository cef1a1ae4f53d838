r"""What subspace identification does alike from a response and from records: from a range space to the best model.

With `O` the extended observability matrix, of `r` block rows, from the leading left singular vectors of the data,

.. math:: O = [C; C A; \dots; C A^{r-1}], \qquad O_{1:r-1} A = O_{2:r}, \qquad C = O_1,

`A` by least squares; eigenvalues of `A` outside the unit circle are reflected into it; `B` and `D`, in which response
and output are linear, by least squares. This is done for a few `r`, and the model that explains the data best is kept.
Sources: McKelvey, Akçay & Ljung (1996) and Verhaegen (1994), in full in `subspace_frequency` and `subspace_time`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .._base import InputError, Progress
from ..models import or_one
from .statespace import reflected

if TYPE_CHECKING:
    import control

Array = np.ndarray

ROUNDING = 1e-8  # relative errors below are rounding
LADDER = tuple(round(4 * 1.5**k) for k in range(12))  # numbers of block rows to try: 4, 6, 9, 14, 20, 30, ...
TRIALS = 4  # how many of them for each order, besides the least
BUDGET = 4e9  # none above the first that takes more multiplications than this (samples times rows squared)


@dataclass(frozen=True, eq=False)
class Matrices:
    """`A`, `B`, `C`, `D` in the units of the data."""

    A: Array
    B: Array
    C: Array
    D: Array

    def system(self, dt: float) -> control.StateSpace:
        """The model as an object of the control package, `dt` in s."""
        import control

        return control.StateSpace(self.A, self.B, self.C, self.D, dt)


class RangeSpace(NamedTuple):
    """The four arrays of :meth:`SubspaceProblem.range_space`."""

    rows: Array
    shifted: Array
    C: Array
    values: Array


class SubspaceProblem:
    """From range spaces to models, the best over a few numbers of block rows.

    A problem supplies its data's numbers, :meth:`range_space` and :meth:`reduced`.
    """

    dt: float
    u_scale: Array
    y_scale: Array
    most_rows: int
    affordable_rows: float
    size: float  # sum of squares of the (weighted) data
    too_few: str

    def range_space(self, r: int) -> RangeSpace:
        """Range space of `r` block rows, with as many columns as singular values.

        Returns
        -------
        RangeSpace
            The observability matrix without its last block row, the same shifted by one step (both weighted alike), its
            first block row `C` in outputs divided by `y_scale`, and the singular values.
        """
        raise NotImplementedError

    def reduced(self, A: Array, C: Array) -> list[Array]:
        """Triangular factors ``[K y]`` of the least-squares problems ``K theta = y`` for `B` and `D`, by input."""
        raise NotImplementedError

    def least_rows(self, nx: int) -> int:
        """Fewest block rows that carry a model of order `nx`."""
        return -(-nx // len(self.y_scale)) + 1

    def ladder(self, nx: int, block_rows: int | None) -> list[int]:
        """Numbers of block rows to try for an order: steps of one common ladder, so that orders share them."""
        least = self.least_rows(nx)
        if least > self.most_rows:
            raise InputError(f"{self.too_few} for order {nx}; record more or choose a lower order.")
        if block_rows is not None:
            if not least <= block_rows <= self.most_rows:
                raise InputError(
                    f"block_rows is {block_rows}; for order {nx} and these data give {least} to {self.most_rows}."
                )
            return [block_rows]
        first = min(least + 1, self.most_rows)
        steps = [r for r in LADDER if first < r <= self.most_rows][:TRIALS]
        return [first, *steps[:1], *(r for r in steps[1:] if r <= self.affordable_rows)]

    def solve(self, orders: list[int], block_rows: int | None, progress: Progress | None = None) -> list[Matrices]:
        """Return the best model of each order; `progress` is called with (stage, done, total, smallest error)."""
        spaces: dict[int, RangeSpace] = {}
        models: list[Matrices] = []
        errors: list[float] = []
        for nx in orders:
            trials: list[tuple[Matrices, float]] = []
            steps = self.ladder(nx, block_rows)
            for k, r in enumerate(steps):
                if progress:
                    done, total = (k, len(steps)) if len(orders) == 1 else (len(models), len(orders))
                    stage = "subspace" if len(orders) == 1 else "orders"
                    progress(stage, done, total, min((*errors, *(e for _, e in trials)), default=np.nan))
                if r not in spaces:
                    spaces[r] = self.range_space(r)
                rows, shifted, C = (x[:, :nx] for x in spaces[r][:3])
                A = np.linalg.lstsq(rows, shifted, rcond=None)[0]
                trials.append(self.complete(reflected(A), C))
            best = min(trials, key=lambda trial: trial[1])
            models.append(best[0])
            errors.append(best[1])
        if progress and orders:
            total = len(orders) if len(orders) > 1 else len(steps)
            progress("orders" if len(orders) > 1 else "subspace", total, total, min(errors))
        return models

    def complete(self, A: Array, C: Array) -> tuple[Matrices, float]:
        """Add the best `B` and `D` to `A` and scaled `C`; return the model and its relative error.

        Where `A` is so far from normal that rounding makes it grow without end, the model has no dynamics.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            blocks = self.reduced(A, C)
        if not all(np.all(np.isfinite(R)) for R in blocks):
            n_u, C = len(self.u_scale), self.y_scale[:, None] * C
            return Matrices(0 * A, np.zeros((len(A), n_u)), C, np.zeros((len(C), n_u))), np.inf
        theta = [least_squares(R[:, :-1], R[:, -1]) for R in blocks]
        BD = np.concatenate(theta).reshape(len(self.u_scale), -1)
        B, D = BD[:, : len(A)].T / self.u_scale, BD[:, len(A) :].T / self.u_scale
        error = self.relative_error(blocks, BD)
        return Matrices(A, B, self.y_scale[:, None] * C, self.y_scale[:, None] * D), error

    def relative_error(self, blocks: list[Array], BD: Array) -> float:
        """What `B` and `D` leave of the problems ``[K y]``, over the size of the data."""
        theta = BD.reshape(len(blocks), -1)
        left = sum(float(np.sum((R[:, :-1] @ t - R[:, -1]) ** 2)) for R, t in zip(blocks, theta, strict=True))
        return float(np.sqrt(left / self.size))

    def error(self, model: Matrices) -> float:
        """Relative error of a model on the data of this problem."""
        C, D = model.C / self.y_scale[:, None], model.D / self.y_scale[:, None]
        BD = np.vstack([model.B * self.u_scale, D * self.u_scale]).T
        return self.relative_error(self.reduced(model.A, C), BD)


def checked_order(nx: int) -> int:
    """The order as an int.

    Raises
    ------
    InputError
        When it is not a whole number above zero.
    """
    if isinstance(nx, bool) or not isinstance(nx, (int, np.integer)) or nx < 1:
        raise InputError(f"the order nx is {nx!r}; give a whole number of at least 1.")
    return int(nx)


def triangle(rows: Array) -> Array:
    """Triangular factor `R` of the rows."""
    R: Any = np.linalg.qr(rows, mode="r")
    return R


def least_squares(K: Array, y: Array) -> Array:
    """Least squares with columns scaled to one length."""
    length = or_one(np.linalg.norm(K, axis=0))
    return np.linalg.lstsq(K / length, y, rcond=1e-13)[0] / length
