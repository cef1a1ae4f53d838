r"""Subspace identification of linear state-space models, from a BLA or from recordings.

.. math:: x(k+1) = A x(k) + B u(k), \qquad y(k) = C x(k) + D u(k), \qquad G(z) = C (z I - A)^{-1} B + D

With `O` the extended observability matrix, of `r` block rows, from the leading left singular vectors of the data,

.. math:: O = [C; C A; \dots; C A^{r-1}], \qquad O_{1:r-1} A = O_{2:r}, \qquad C = O_1,

`A` is found by least squares, and its eigenvalues outside the unit circle are reflected into it. `B` and `D` follow by
least squares, because response and output are linear in them. This is done for a few `r`, and the model that explains
the data best is kept. These are the start values of Krikelis et al. (2024), Sec. 5.3; a fit refines them by output
error.

:class:`FrequencyProblem` follows McKelvey, Akçay & Ljung (1996), Subspace-based multivariable system identification
from frequency response data, IEEE Trans. Automatic Control 41(7), 960-979, algorithm 2 (any frequency grid, noise
weighting), with two changes. Instead of powers ``1, z, ..., z^(r-1)``, which are nearly dependent unless the
frequencies fill the unit circle, it uses polynomials in ``z`` that are orthonormal on the grid (Brubeck, Nakatsukasa &
Trefethen (2021), Vandermonde with Arnoldi, SIAM Review 63(2), 405-415); the shift structure then is the recurrence of
the polynomials. With several outputs it solves for `C`, `D` and for `B`, `D` in turn a few times, because `C` from the
singular vectors alone is the least certain part.

:class:`TimeProblem` is PO-MOESP, Verhaegen (1994), Identification of the deterministic part of MIMO state space models
given in innovations form, Automatica 30(1), 61-74. With the past inputs and outputs as instruments and the future
inputs projected off, all in Hankel matrices of `r` block rows, the future outputs span the range of `O`:

.. math::

    \begin{bmatrix} U_f \\ U_p \\ Y_p \\ Y_f \end{bmatrix} = L Q, \qquad
    \operatorname{range} \begin{bmatrix} L_{42} & L_{43} \end{bmatrix} = \operatorname{range} O,

factorized by a sequential QR over the samples of all recordings. `B` and `D` are fitted to the simulated output, with
an initial state (and an offset) for each recording.

:func:`select_order` identifies every order on one part of the data and judges it on the other. It recommends the
smallest order `n` whose error on the held-out part is within a margin `m` of the best,

.. math:: \min \{ n : e(n) \le (1 + m) \min_k e(k) \}.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .._base import InputError, Progress, whole
from ..data import Recording, as_recordings, as_tuple, check_for_identification
from ..models import or_one
from .bla import BLA, moving_mean
from .statespace import propagate, reflect_poles, resolvent

if TYPE_CHECKING:
    import control

Array = np.ndarray

ROUNDING = 1e-8  # smaller relative errors are rounding errors
LARGEST_ENTRY = 1e150  # entry of a triangular factor above which its square overflows
LADDER = tuple(round(4 * 1.5**k) for k in range(12))  # numbers of block rows to try: 4, 6, 9, 14, 20, 30, ...
TRIALS = 4  # numbers of block rows tried for each order, besides the first
BUDGET = 4e9  # multiplications (samples times rows squared) above which larger numbers of block rows are not tried
SWEEPS = 2  # alternations between solving for C, D and for B, D
CHUNK = 8192  # rows of a sequential QR that are handled at once, for memory


def frequency_subspace(bla: BLA, nx: int, weight: bool = True, block_rows: int | None = None) -> control.StateSpace:
    """Identify a linear state-space model from a frequency response function.

    Parameters
    ----------
    bla : BLA
        Response with `F` frequencies, on any grid.
    nx : int
        Order of the model.
    weight : bool
        Weight by the inverse of the total variance, smoothed over neighbouring frequencies, if the BLA has one; this
        minimises the error relative to the uncertainty. Without weights the largest part of the response counts most,
        which usually gives the smaller simulation error.
    block_rows : int, optional
        Block rows of the extended observability matrix; by default the best of a few numbers.

    Returns
    -------
    control.StateSpace
        Stable, discrete, with the `dt` of the BLA.

    Raises
    ------
    InputError
        If the order is not a whole number above zero or the frequencies are too few for it.

    References
    ----------
    McKelvey, Akçay & Ljung (1996), algorithm 2.
    """
    return FrequencyProblem(bla, weight).identify(nx, block_rows).system(bla.dt)


def time_subspace(
    recordings: Recording | Iterable[Recording], nx: int, offset: bool = False, block_rows: int | None = None
) -> control.StateSpace:
    """Identify a linear state-space model from one or several recordings.

    Parameters
    ----------
    recordings : Recording or iterable of Recording
        Samples up to `skip` are left out; each recording has its own initial state.
    nx : int
        Order of the model.
    offset : bool
        Estimate a constant offset of each output in each recording, which is not part of the model. For signals around
        an operating point.
    block_rows : int, optional
        Samples of the past and of the future in the data matrices; by default the best of a few numbers.

    Returns
    -------
    control.StateSpace
        Stable, discrete, with the `dt` of the recordings.

    Raises
    ------
    InputError
        If the order is not a whole number above zero or the samples are too few for it.

    References
    ----------
    Verhaegen (1994), PO-MOESP.
    """
    problem = TimeProblem(recordings, offset)
    return problem.identify(nx, block_rows).system(problem.dt)


def subspace_matrices(
    recordings: Recording | Iterable[Recording],
    nx: int,
    offset: bool = False,
    progress: Progress | None = None,
) -> Matrices:
    """Return the matrices of :func:`time_subspace`, without importing the control package.

    Order 0, a static gain, is allowed here. `progress` is called with ("subspace", done, total, smallest error so far).
    """
    if nx == 0:
        return _static_gain(as_recordings(recordings), offset)
    return TimeProblem(recordings, offset).identify(nx, progress=progress)


class Matrices(NamedTuple):
    """A linear model `A`, `B`, `C`, `D` in the units of the data."""

    A: Array
    B: Array
    C: Array
    D: Array

    def system(self, dt: float) -> control.StateSpace:
        """Return the model as an object of the control package, `dt` in s."""
        import control

        return control.StateSpace(self.A, self.B, self.C, self.D, dt)


class RangeSpace(NamedTuple):
    """Range of an extended observability matrix; the columns belong to falling singular values."""

    rows: Array  # without the last block row
    shifted: Array  # the same shifted by one step, with the same weights
    C: Array  # the first block row, for outputs divided by `y_scale`


class SubspaceProblem:
    """Turn range spaces into models and keep the best over a few numbers of block rows.

    A subclass supplies the attributes and the two methods.
    """

    dt: float
    u_scale: Array
    y_scale: Array
    most_rows: int
    affordable_rows: float
    size: float  # sum of squares of the (weighted) data
    too_few: str
    range_space: Callable[[int], RangeSpace]  # of `r` block rows
    triangular_factors: Callable[[Array, Array], list[Array]]  # `[K y]` of `K theta = y` for `B` and `D`, by input

    def least_rows(self, nx: int) -> int:
        """Return the fewest block rows that determine a model of order `nx`."""
        return -(-nx // len(self.y_scale)) + 1

    def ladder(self, nx: int, block_rows: int | None) -> list[int]:
        """Return the numbers of block rows to try for an order, from one ladder, so that orders share them."""
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

    def identify(
        self,
        nx: int,
        block_rows: int | None = None,
        progress: Progress | None = None,
        spaces: dict[int, RangeSpace] | None = None,
    ) -> Matrices:
        """Return the best model of one order over the numbers of block rows.

        `spaces` stores range spaces by their number of block rows, so that several orders can share them.
        """
        nx, spaces = whole(nx, "the order nx", 1), {} if spaces is None else spaces
        trials: list[tuple[Matrices, float]] = []
        steps = self.ladder(nx, block_rows)
        for k, r in enumerate(steps):
            if progress:
                progress("subspace", k, len(steps), min((error for _, error in trials), default=np.nan))
            if r not in spaces:
                spaces[r] = self.range_space(r)
            rows, shifted, C = (x[:, :nx] for x in spaces[r])
            A = np.linalg.lstsq(rows, shifted, rcond=None)[0]
            trials.append(self.complete(reflect_poles(A), C))
        best, error = min(trials, key=lambda trial: trial[1])
        if progress:
            progress("subspace", len(steps), len(steps), error)
        return best

    def complete(self, A: Array, C: Array) -> tuple[Matrices, float]:
        """Add the best `B` and `D` to `A` and scaled `C`; return the model and its relative error.

        If rounding makes the powers of a very non-normal `A` diverge, the model has no dynamics.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            blocks = self.triangular_factors(A, C)
        if not all(np.all(np.abs(R) < LARGEST_ENTRY) for R in blocks):
            n_u, C = len(self.u_scale), self.y_scale[:, None] * C
            return Matrices(0 * A, np.zeros((len(A), n_u)), C, np.zeros((len(C), n_u))), np.inf
        theta = [_least_squares(R[:, :-1], R[:, -1]) for R in blocks]
        BD = np.concatenate(theta).reshape(len(self.u_scale), -1)
        B, D = BD[:, : len(A)].T / self.u_scale, BD[:, len(A) :].T / self.u_scale
        error = self.relative_error(blocks, BD)
        return Matrices(A, B, self.y_scale[:, None] * C, self.y_scale[:, None] * D), error

    def relative_error(self, blocks: list[Array], BD: Array) -> float:
        """Return the residual of the problems ``[K y]`` for given `B` and `D`, over the size of the data."""
        theta = BD.reshape(len(blocks), -1)
        left = sum(float(np.sum((R[:, :-1] @ t - R[:, -1]) ** 2)) for R, t in zip(blocks, theta, strict=True))
        return float(np.sqrt(left / self.size))

    def error(self, model: Matrices) -> float:
        """Return the relative error of a model on the data of this problem."""
        C, D = model.C / self.y_scale[:, None], model.D / self.y_scale[:, None]
        BD = np.vstack([model.B * self.u_scale, D * self.u_scale]).T
        return self.relative_error(self.triangular_factors(model.A, C), BD)


class FrequencyProblem(SubspaceProblem):
    """Identify from the response at some of the frequencies of a BLA."""

    def __init__(self, bla: BLA, weight: bool, part: slice = slice(None)) -> None:
        G, self.dt = np.asarray(bla.G, dtype=complex)[part], bla.dt
        frequency = np.asarray(bla.frequency, dtype=float)[part]
        if G.ndim != 3 or len(G) != len(frequency) or not np.all(np.isfinite(G)):
            raise InputError("G of the BLA must be finite, of shape (frequencies, outputs, inputs); check the BLA.")
        if np.any(frequency < 0) or np.any(frequency > 0.5000001 / bla.dt):
            raise InputError(
                f"the BLA has frequencies outside 0 to {0.5 / bla.dt:g} Hz, half the sampling rate; check the unit of "
                "frequency and dt."
            )
        self.z = np.exp(2j * np.pi * frequency * bla.dt)
        self.y_scale, self.u_scale = _balanced_units(np.sqrt(np.mean(np.abs(G) ** 2, axis=0)))
        units = self.y_scale[:, None] / self.u_scale
        self.G = G / units
        self.var = np.ones(G.shape)
        self.weighted = weight and bla.var_total is not None
        if self.weighted:
            var = moving_mean(np.asarray(bla.var_total)[part], 5) / units**2
            self.var = var + ROUNDING**2 * np.mean(np.abs(self.G) ** 2)
        self.size = max(float(np.sum(np.abs(self.G) ** 2 / self.var)), 1e-300)
        F, n_y, n_u = G.shape
        self.affordable_rows = np.sqrt(BUDGET / (F * n_u)) / n_y
        self.most_rows = (2 * F * n_u - 1) // (n_y + n_u) if 2 * F > 2 else 0
        self.too_few = f"{F} frequencies are too few"

    def range_space(self, r: int) -> RangeSpace:
        """Return the range space of `r` block rows."""
        F, n_y, n_u = self.G.shape
        P, H = _orthonormal_polynomials(self.z, r)
        Q = P * np.sqrt(np.mean(1 / self.var, axis=(1, 2)))
        T = _real((Q[:, None, None, :] * self.G.transpose(1, 2, 0)).reshape(-1, F))
        inputs = np.linalg.qr(_real(Q).T)[0].T
        T -= (T @ inputs.T) @ inputs  # project off the rows of the input, the same for every input
        T = T.reshape(r * n_y, n_u * 2 * F)
        K = np.eye(r * n_y)
        if self.weighted:  # covariance of the noise in T is K K'
            for i in range(n_y):
                covariance = ((Q * self.var[:, i].sum(axis=1)) @ Q.conj().T).real
                K[i::n_y, i::n_y] = np.linalg.cholesky(covariance)
            T = np.linalg.solve(K, T)
        left, _, _ = np.linalg.svd(_triangle(T.T).T)
        basis = (K @ left).reshape(r, n_y, -1)
        shifted = np.einsum("ij,iok->jok", H, basis).reshape((r - 1) * n_y, -1)
        m = len(shifted)
        return RangeSpace(left[:m], np.linalg.solve(K[:m, :m], shifted), basis[0] / P[0, 0].real)

    def triangular_factors(self, A: Array, C: Array) -> list[Array]:
        """Return triangular factors ``[K y]`` of the problems ``K theta = y`` for `B` and `D`, by input."""
        return _response_problems(A, C, self.z, self.G, self.var)

    def complete(self, A: Array, C: Array) -> tuple[Matrices, float]:
        """Complete the model as :meth:`SubspaceProblem.complete` does; with several outputs solve for `C` as well."""
        model, error = super().complete(A, C)
        if len(self.y_scale) > 1:
            G, var = self.G.swapaxes(1, 2), self.var.swapaxes(1, 2)
            for _ in range(SWEEPS):  # the transposed response is linear in C and D
                blocks = _response_problems(A.T, (model.B * self.u_scale).T, self.z, G, var)
                C = np.array([_least_squares(R[:, :-1], R[:, -1])[: len(A)] for R in blocks])
                model, error = super().complete(A, C)
        return model, error


class TimeProblem(SubspaceProblem):
    """Identify from recordings."""

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
        """Return the range space of `r` block rows."""
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
                R = _fold_qr(R, np.concatenate(rows, axis=1))
        assert R is not None
        past = r * (2 * n_u + n_y)
        left, _, _ = np.linalg.svd(R[r * n_u : past, past:].T)
        return RangeSpace(left[:-n_y], left[n_y:], left[:n_y])

    def triangular_factors(self, A: Array, C: Array) -> list[Array]:
        """Return triangular factors ``[K y]`` of the problems ``K theta = y`` for `B` and `D`, by input."""
        n_u, n_y, nx = len(self.u_scale), len(self.y_scale), len(A)
        free = nx + n_y * self.offset  # initial state and offset, eliminated recording by recording
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
                R = _fold_qr(R, K.reshape(n_y * m, -1))
            assert R is not None
            total = _fold_qr(total, R[free:, free:])
        assert total is not None
        return [total]


def _static_gain(recordings: tuple[Recording, ...], offset: bool) -> Matrices:
    """Fit a static gain by least squares; with `offset`, to each recording's signals minus their means."""
    parts = [(r.u[r.skip :], r.y[r.skip :]) for r in recordings]
    if offset:
        parts = [(u - np.mean(u, axis=0), y - np.mean(y, axis=0)) for u, y in parts]
    u, y = (np.concatenate(signals) for signals in zip(*parts, strict=True))
    n_u, n_y = u.shape[1], y.shape[1]
    gain = np.linalg.lstsq(u, y, rcond=None)[0].T
    return Matrices(np.zeros((0, 0)), np.zeros((0, n_u)), np.zeros((n_y, 0)), gain)


def _triangle(rows: Array) -> Array:
    """Return the triangular factor `R` of the rows."""
    R: Any = np.linalg.qr(rows, mode="r")
    return R


def _least_squares(K: Array, y: Array) -> Array:
    """Solve a least-squares problem with columns scaled to one length."""
    length = or_one(np.linalg.norm(K, axis=0))
    return np.linalg.lstsq(K / length, y, rcond=1e-13)[0] / length


def _balanced_units(size: Array) -> tuple[Array, Array]:
    """Find scales of outputs (rows) and inputs (columns) that give all rows and columns of `size` unit rms."""
    rows, columns = np.ones(size.shape[0]), np.ones(size.shape[1])
    for _ in range(100):
        rows = or_one(np.sqrt(np.mean((size * columns) ** 2, axis=1)))
        columns = 1 / or_one(np.sqrt(np.mean((size / rows[:, None]) ** 2, axis=0)))
    return rows, columns


def _orthonormal_polynomials(z: Array, r: int) -> tuple[Array, Array]:
    """Build polynomials of degree 0 to r - 1 that are orthonormal over `z` and its conjugates.

    Returns the values at `z`, (r, F), and the real recurrence `H`, (r, r - 1): ``z p_j = sum_i H[i, j] p_i``.
    """
    P, H = np.empty((r, len(z)), dtype=complex), np.zeros((r, r - 1))
    P[0] = 1 / np.sqrt(len(z))
    for j in range(r - 1):
        v = z * P[j]
        for _ in range(2):
            h = (P[: j + 1].conj() @ v).real
            H[: j + 1, j] += h
            v -= h @ P[: j + 1]
        H[j + 1, j] = np.linalg.norm(v)
        P[j + 1] = v / H[j + 1, j]
    return P, H


def _real(X: Array) -> Array:
    return np.concatenate([X.real, X.imag], axis=1)


def _response_problems(A: Array, C: Array, z: Array, G: Array, var: Array) -> list[Array]:
    """Return triangular factors ``[K y]`` of ``(C (z I - A)⁻¹ b + d) / std = G[:, :, j] / std``, one for each j."""
    F, n_y, n_u = G.shape
    K = np.empty((F, n_y, len(A) + n_y + 1), dtype=complex)
    K[..., : len(A)] = resolvent(A, C, z)
    K[..., len(A) : -1] = np.eye(n_y)
    blocks = []
    for j in range(n_u):
        K[..., -1] = G[..., j]
        rows = (K / np.sqrt(var[..., j, None])).reshape(F * n_y, -1)
        blocks.append(_triangle(np.concatenate([rows.real, rows.imag])))
    return blocks


def _windows(x: Array, r: int) -> Array:
    """Return all windows of `r` samples, oldest first, (M - r + 1, r, n); a view."""
    return np.lib.stride_tricks.sliding_window_view(x, r, axis=0).swapaxes(1, 2)


def _fold_qr(R: Array | None, rows: Array) -> Array:
    """Return the square triangular factor of `R` with more rows below it."""
    folded = _triangle(rows if R is None else np.concatenate([R, rows]))
    missing = folded.shape[1] - len(folded)
    return np.concatenate([folded, np.zeros((missing, folded.shape[1]))]) if missing else folded


@dataclass(frozen=True, eq=False, repr=False)
class OrderSelection:
    """Errors of linear models of several orders, and the recommended order.

    Parameters
    ----------
    orders : tuple of int
        Orders tried.
    train, validation : array, (n_orders,)
        Error relative to the data: simulation error over standard deviation (Krikelis et al. (2024), Eq. 27, averaged
        over outputs) for recordings, weighted error of the response for a BLA; on the part used to identify and on the
        held-out part.
    recommended : int
        Smallest order whose validation error is within `margin` of the best.
    margin : float
        The margin, as a share of the best error.
    """

    orders: tuple[int, ...]
    train: Array
    validation: Array
    recommended: int
    margin: float

    def __repr__(self) -> str:
        rows = [f"{'order':>5}  {'train':>10}  {'validation':>10}"]
        for n, a, b in zip(self.orders, self.train, self.validation, strict=True):
            rows.append(f"{n:>5}  {a:>10.3e}  {b:>10.3e}{'  <- recommended' if n == self.recommended else ''}")
        return "\n".join([*rows, f"smallest order within {100 * self.margin:g} % of the best on the validation part"])


def select_order(
    data: BLA | Recording | Iterable[Recording],
    orders: int | Iterable[int] = range(1, 11),
    margin: float = 0.05,
    offset: bool = False,
    progress: Progress | None = None,
) -> OrderSelection:
    """Identify models of several orders on one part of the data and judge them on the other.

    Parameters
    ----------
    data : BLA, Recording or iterable of Recording
        The held-out part is every second frequency of a BLA, the last 30 % of the samples of a single recording, or the
        last 30 % of several recordings, at least one.
    orders : int or iterable of int
        Orders to try; orders too high for the data are skipped, unless all are too high.
    margin : float
        The recommended order is the smallest whose validation error is at most ``1 + margin`` times the best.
    offset : bool
        For recordings: as for :func:`time_subspace`.
    progress : callable, optional
        Called with ("choosing the order", done, total, nan).

    Raises
    ------
    InputError
        If there is no order, an order is not a whole number above zero, or the data are too few for it.
    """
    tried = sorted({whole(n, "the order nx", 1) for n in as_tuple(orders)})
    if not tried or not margin >= 0:
        raise InputError(
            f"orders {tried} with a margin of {margin}: give at least one order and a margin of 0 or more."
        )
    train: SubspaceProblem
    validation: SubspaceProblem
    if isinstance(data, BLA):
        train, validation = (FrequencyProblem(data, True, slice(k, None, 2)) for k in (0, 1))
    else:
        records = check_for_identification(data)
        if len(records) == 1:
            records = records[0].slice(records[0].skip).split(0.7)
        n_train = max(1, min(len(records) - 1, round(0.7 * len(records))))
        train, validation = TimeProblem(records[:n_train], offset), TimeProblem(records[n_train:], offset)
    tried = [n for n in tried if train.least_rows(n) <= train.most_rows] or tried[:1]
    models: list[Matrices] = []
    spaces: dict[int, RangeSpace] = {}
    for nx in tried:
        if progress:
            progress("choosing the order", len(models), len(tried), np.nan)
        models.append(train.identify(nx, spaces=spaces))
    if progress:
        progress("choosing the order", len(tried), len(tried), np.nan)
    train_error, error = (np.array([part.error(m) for m in models]) for part in (train, validation))
    good_enough = max((1 + margin) * np.min(error), ROUNDING)
    recommended = next(n for n, e in zip(tried, error, strict=True) if e <= good_enough)
    return OrderSelection(tuple(tried), train_error, error, recommended, margin)
