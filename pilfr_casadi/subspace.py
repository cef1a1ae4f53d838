r"""Linear state-space models by subspace identification, from a BLA or straight from recordings.

.. math:: x(k+1) = A x(k) + B u(k), \qquad y(k) = C x(k) + D u(k)

Both ways find the column space of the extended observability matrix from one singular value decomposition, take `A` and
`C` from its shift structure, reflect unstable eigenvalues into the unit circle, and solve `B` and `D` by linear least
squares. These are the start values of Krikelis et al. (2024), Sec. 5.3; refining them by output error is up to the fit.

:func:`frequency_subspace` follows McKelvey, Akçay & Ljung (1996), Subspace-based multivariable system identification
from frequency response data, IEEE Trans. Automatic Control 41(7), 960-979, algorithm 2 (any frequency grid, noise
weighting), with two changes. Where they stack powers ``1, z, ..., z^(r-1)``, which are nearly dependent unless the
frequencies fill the unit circle, polynomials in ``z`` are used that are orthonormal on the grid (Brubeck, Nakatsukasa &
Trefethen (2021), Vandermonde with Arnoldi, SIAM Review 63(2), 405-415); the shift structure then is the recurrence of
the polynomials. And with several outputs `C`, `D` and `B`, `D` are solved for in turn a few times, as `C` from the
singular vectors alone is the least certain part.

:func:`time_subspace` is PO-MOESP, past inputs and outputs as instruments: Verhaegen (1994), Identification of the
deterministic part of MIMO state space models given in innovations form, Automatica 30(1), 61-74.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .bla import BLA, _moving_mean
from .recording import InputError, Recording, check_for_identification

if TYPE_CHECKING:
    import control

Array = np.ndarray
Data = BLA | Recording | Iterable[Recording]

CHUNK = 8192  # rows handled at once in a sequential QR
ROUNDING = 1e-8  # relative errors below are rounding
LADDER = tuple(round(4 * 1.5**k) for k in range(12))  # numbers of block rows to try: 4, 6, 9, 14, 20, 30, ...
TRIALS = 4  # how many of them for each order, besides the least
BUDGET = 4e9  # none above the first that takes more multiplications than this (samples times rows squared)
SWEEPS = 2  # turns of solving for C, D and for B, D


def frequency_subspace(bla: BLA, nx: int, weight: bool = True, block_rows: int | None = None) -> control.StateSpace:
    """Identify a linear state-space model from a frequency response function.

    Parameters
    ----------
    bla : BLA
        Response with `F` frequencies, on any grid.
    nx : int
        Order of the model.
    weight : bool
        Weight by the inverse of the total variance, smoothed over neighbouring frequencies, where the BLA has one.
    block_rows : int, optional
        Rows of the extended observability matrix, in outputs; left out, a few are tried and the one whose model fits
        the response best is kept.

    Returns
    -------
    control.StateSpace
        Stable, discrete, with the `dt` of the BLA.

    Raises
    ------
    InputError
        When the order is not a whole number above zero or the frequencies are too few for it.

    References
    ----------
    McKelvey, Akçay & Ljung (1996), algorithm 2; see the module docstring.
    """
    problem = _FrequencyProblem(bla, weight)
    return problem.solve([_order(nx)], block_rows)[0].system(problem.dt)


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
        Estimate (and leave out of the model) a constant offset of each output in each recording, as where signals are
        measured from an operating point.
    block_rows : int, optional
        Samples of the past and of the future in the data matrices; left out, a few are tried and the one whose model
        simulates the recordings best is kept.

    Returns
    -------
    control.StateSpace
        Stable, discrete, with the `dt` of the recordings.

    Raises
    ------
    InputError
        When the order is not a whole number above zero or the samples are too few for it.

    References
    ----------
    Verhaegen (1994); see the module docstring.
    """
    problem = _TimeProblem(recordings, offset)
    return problem.solve([_order(nx)], block_rows)[0].system(problem.dt)


def subspace_matrices(
    recordings: Recording | Iterable[Recording], nx: int, offset: bool = False, block_rows: int | None = None
) -> tuple[Array, Array, Array, Array]:
    """Matrices of :func:`time_subspace`, without the import of the control package.

    Parameters
    ----------
    recordings, nx, offset, block_rows
        As for :func:`time_subspace`.

    Returns
    -------
    A, B, C, D : array, (nx, nx), (nx, n_u), (n_y, nx), (n_y, n_u)

    Raises
    ------
    InputError
        As :func:`time_subspace`.
    """
    model = _TimeProblem(recordings, offset).solve([_order(nx)], block_rows)[0]
    return model.A, model.B, model.C, model.D


def singular_values(data: Data, block_rows: int | None = None, weight: bool = True, offset: bool = False) -> Array:
    """Singular values that the subspace identification sees, largest first: where they drop is the order.

    Parameters
    ----------
    data : BLA, Recording or iterable of Recording
        As for :func:`frequency_subspace` or :func:`time_subspace`.
    block_rows : int, optional
        As there; left out, as many as the data allow, at most 20.
    weight : bool
        For a BLA: as for :func:`frequency_subspace`.
    offset : bool
        For recordings: as for :func:`time_subspace`.

    Returns
    -------
    array, (block_rows * n_y,)

    Raises
    ------
    InputError
        When the data are too few.
    """
    problem = _FrequencyProblem(data, weight) if isinstance(data, BLA) else _TimeProblem(data, offset)
    return problem.range_space(problem.ladder(1, block_rows or min(20, max(2, problem.most_rows)))[0]).values


@dataclass(frozen=True, eq=False, repr=False)
class OrderSelection:
    """How well linear models of several orders do, and which order to take.

    Parameters
    ----------
    orders : tuple of int
        Orders tried.
    train, validation : array, (n_orders,)
        Error relative to the data: simulation error over standard deviation (Krikelis et al. (2024), Eq. 27, averaged
        over outputs) for recordings, weighted error of the response for a BLA; on the part identified from and on the
        part held out.
    recommended : int
        Smallest order whose validation error is within `margin` of the best.
    margin : float
        That margin, as a share of the best error.
    singular_values : array
        From :func:`singular_values`.
    """

    orders: tuple[int, ...]
    train: Array
    validation: Array
    recommended: int
    margin: float
    singular_values: Array

    def __repr__(self) -> str:
        rows = [f"{'order':>5}  {'train':>10}  {'validation':>10}"]
        for n, a, b in zip(self.orders, self.train, self.validation, strict=True):
            rows.append(f"{n:>5}  {a:>10.3e}  {b:>10.3e}{'  <- recommended' if n == self.recommended else ''}")
        return "\n".join([*rows, f"smallest order within {100 * self.margin:g} % of the best on the validation part"])


def select_order(
    data: Data, orders: Iterable[int] = range(1, 11), margin: float = 0.05, offset: bool = False
) -> OrderSelection:
    """Try several orders on one part of the data and judge them on the other.

    Parameters
    ----------
    data : BLA, Recording or iterable of Recording
        Of a BLA every second frequency is held out, of a single recording the last 30 % of the samples, of several
        recordings the last 30 % of them, at least one.
    orders : iterable of int
        Orders to try; those too high for the data are left out, unless all are.
    margin : float
        The recommended order is the smallest whose validation error is at most ``1 + margin`` times the best.
    offset : bool
        For recordings: as for :func:`time_subspace`.

    Returns
    -------
    OrderSelection

    Raises
    ------
    InputError
        When there is no order, an order is not a whole number above zero, or the data are too few for it.
    """
    tried = sorted({_order(n) for n in orders})
    if not tried or margin < 0:
        raise InputError(
            f"orders {tried} with a margin of {margin}: give at least one order and a margin of 0 or more."
        )
    train: _Problem
    held: _Problem
    if isinstance(data, BLA):
        train, held = (_FrequencyProblem(data, True, slice(k, None, 2)) for k in (0, 1))
    else:
        records = check_for_identification(data)
        if len(records) == 1:
            records = records[0].slice(records[0].skip).split(0.7)
        n_train = max(1, min(len(records) - 1, round(0.7 * len(records))))
        train, held = _TimeProblem(records[:n_train], offset), _TimeProblem(records[n_train:], offset)
    tried = [n for n in tried if train.least_rows(n) <= train.most_rows] or tried[:1]
    models = train.solve(tried, None)
    train_error, error = (np.array([part.error(m) for m in models]) for part in (train, held))
    good_enough = max((1 + margin) * np.min(error), ROUNDING)
    recommended = next(n for n, e in zip(tried, error, strict=True) if e <= good_enough)
    values = train.range_space(min(20, train.most_rows)).values
    return OrderSelection(tuple(tried), train_error, error, recommended, margin, values)


def frequency_response(system: Any, frequency: Array) -> Array:
    """Frequency response of a discrete state-space model, fast for many frequencies.

    Parameters
    ----------
    system : control.StateSpace
        Or anything with `A`, `B`, `C`, `D` and `dt`.
    frequency : array, (F,)
        Frequencies in Hz.

    Returns
    -------
    complex array, (F, n_y, n_u)
        Not finite at a pole.
    """
    z = np.exp(2j * np.pi * np.asarray(frequency) * system.dt)
    with np.errstate(divide="ignore", invalid="ignore"):
        return _resolvent(np.asarray(system.A), np.asarray(system.C), z) @ np.asarray(system.B) + np.asarray(system.D)


def simulate_states(system: Any, u: Array, x0: Array | None = None) -> Array:
    """State trajectory of a discrete state-space model.

    Parameters
    ----------
    system : control.StateSpace
        Or anything with `A` (nx, nx) and `B` (nx, n_u).
    u : array, (M, n_u)
        Inputs.
    x0 : array, (nx,), optional
        State at the first sample; zero if left out.

    Returns
    -------
    array, (M, nx)

    Raises
    ------
    InputError
        When the shapes of `u` or `x0` do not fit the model.
    """
    A, B = np.asarray(system.A, dtype=float), np.asarray(system.B, dtype=float)
    u = np.asarray(u, dtype=float)
    if u.ndim != 2 or u.shape[1] != B.shape[1]:
        raise InputError(f"u has the shape {u.shape}; the model needs (samples, {B.shape[1]}).")
    start = np.zeros(len(A)) if x0 is None else np.asarray(x0, dtype=float)
    if start.shape != (len(A),):
        raise InputError(f"x0 has the shape {start.shape}; the model has {len(A)} states.")
    return _propagate(A.T, (u @ B.T)[None], start[None])[0][0]


def simulate_lti(system: Any, u: Array, x0: Array | None = None) -> Array:
    """Output of a discrete state-space model.

    Parameters
    ----------
    system : control.StateSpace
        Or anything with `A`, `B`, `C` and `D`.
    u : array, (M, n_u)
        Inputs.
    x0 : array, (nx,), optional
        State at the first sample; zero if left out.

    Returns
    -------
    array, (M, n_y)

    Raises
    ------
    InputError
        When the shapes of `u` or `x0` do not fit the model.
    """
    return simulate_states(system, u, x0) @ np.asarray(system.C).T + np.asarray(u) @ np.asarray(system.D).T


def unit_variance(system: Any, u: Array | Sequence[Array]) -> control.StateSpace:
    """Scale the states so that each has unit variance under an input, Krikelis et al. (2024), Sec. 5.3.

    Parameters
    ----------
    system : control.StateSpace
        Discrete model.
    u : array, (M, n_u), or several of them
        Inputs of one or several runs, each from the zero state on.

    Returns
    -------
    control.StateSpace
        The same model in other coordinates. A state that the inputs do not move keeps its scale.

    Raises
    ------
    InputError
        When `u` does not fit the model, or the states grow without bound under it.
    """
    import control

    with np.errstate(over="ignore", invalid="ignore"):
        x = np.concatenate([simulate_states(system, run) for run in ([u] if isinstance(u, np.ndarray) else u)])
        std = np.std(x, axis=0)
    if not np.all(np.isfinite(std)):
        raise InputError("the states of the model grow without bound under this input; give a stable model.")
    std[std <= 1e-12 * np.max(np.abs(x), axis=0, initial=0.0)] = 1.0
    A, B, C = (np.asarray(M) for M in (system.A, system.B, system.C))
    return control.StateSpace(A * std / std[:, None], B / std[:, None], C * std, system.D, system.dt)


@dataclass(frozen=True, eq=False)
class _Matrices:
    """`A`, `B`, `C`, `D` in the units of the data."""

    A: Array
    B: Array
    C: Array
    D: Array

    def system(self, dt: float) -> control.StateSpace:
        import control

        return control.StateSpace(self.A, self.B, self.C, self.D, dt)


class _RangeSpace(NamedTuple):
    rows: Array
    shifted: Array
    C: Array
    values: Array


class _Problem:
    """What the two ways share: from range spaces to models, the best over a few numbers of block rows.

    A problem supplies `range_space(r)`: with as many columns as singular values, the observability matrix without its
    last block row, the same shifted by one step (both weighted alike), its first block row `C` in outputs divided by
    `y_scale`, and the singular values; and `reduced(A, C)`: triangular factors ``[K y]`` of the least-squares problems
    ``K theta = y`` for `B` and `D`, input after input.
    """

    dt: float
    u_scale: Array
    y_scale: Array
    most_rows: int
    affordable_rows: float
    size: float  # sum of squares of the (weighted) data
    too_few: str

    def range_space(self, r: int) -> _RangeSpace:
        raise NotImplementedError

    def reduced(self, A: Array, C: Array) -> list[Array]:
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

    def solve(self, orders: list[int], block_rows: int | None) -> list[_Matrices]:
        """Return the best model of each order."""
        spaces: dict[int, _RangeSpace] = {}
        models = []
        for nx in orders:
            trials = []
            for r in self.ladder(nx, block_rows):
                if r not in spaces:
                    spaces[r] = self.range_space(r)
                rows, shifted, C = (x[:, :nx] for x in spaces[r][:3])
                A = np.linalg.lstsq(rows, shifted, rcond=None)[0]
                trials.append(self.complete(_reflected(A), C))
            models.append(min(trials, key=lambda trial: trial[1])[0])
        return models

    def complete(self, A: Array, C: Array) -> tuple[_Matrices, float]:
        """Add the best `B` and `D` to `A` and scaled `C`; return the model and its relative error."""
        blocks = self.reduced(A, C)
        theta = [_least_squares(R[:, :-1], R[:, -1]) for R in blocks]
        BD = np.concatenate(theta).reshape(len(self.u_scale), -1)
        B, D = BD[:, : len(A)].T / self.u_scale, BD[:, len(A) :].T / self.u_scale
        error = self.relative_error(blocks, BD)
        return _Matrices(A, B, self.y_scale[:, None] * C, self.y_scale[:, None] * D), error

    def relative_error(self, blocks: list[Array], BD: Array) -> float:
        theta = BD.reshape(len(blocks), -1)
        left = sum(float(np.sum((R[:, :-1] @ t - R[:, -1]) ** 2)) for R, t in zip(blocks, theta, strict=True))
        return float(np.sqrt(left / self.size))

    def error(self, model: _Matrices) -> float:
        """Relative error of a model on the data of this problem."""
        C, D = model.C / self.y_scale[:, None], model.D / self.y_scale[:, None]
        BD = np.vstack([model.B * self.u_scale, D * self.u_scale]).T
        return self.relative_error(self.reduced(model.A, C), BD)


class _FrequencyProblem(_Problem):
    """Subspace identification from the response at some of the frequencies of a BLA."""

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
            var = _moving_mean(np.asarray(bla.var_total)[part], 5) / units**2
            self.var = var + ROUNDING**2 * np.mean(np.abs(self.G) ** 2)
        self.size = max(float(np.sum(np.abs(self.G) ** 2 / self.var)), 1e-300)
        F, n_y, n_u = G.shape
        self.affordable_rows = np.sqrt(BUDGET / (F * n_u)) / n_y
        self.most_rows = (2 * F * n_u - 1) // (n_y + n_u) if 2 * F > 2 else 0
        self.too_few = f"{F} frequencies are too few"

    def range_space(self, r: int) -> _RangeSpace:
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
        left, values, _ = np.linalg.svd(_triangle(T.T).T)
        basis = (K @ left).reshape(r, n_y, -1)
        shifted = np.einsum("ij,iok->jok", H, basis).reshape((r - 1) * n_y, -1)
        m = len(shifted)
        return _RangeSpace(left[:m], np.linalg.solve(K[:m, :m], shifted), basis[0] / P[0, 0].real, values)

    def reduced(self, A: Array, C: Array) -> list[Array]:
        return _response_problems(A, C, self.z, self.G, self.var)

    def complete(self, A: Array, C: Array) -> tuple[_Matrices, float]:
        model, error = super().complete(A, C)
        if len(self.y_scale) > 1:
            G, var = self.G.swapaxes(1, 2), self.var.swapaxes(1, 2)
            for _ in range(SWEEPS):  # C and D are to the transposed response what B and D are to the response
                blocks = _response_problems(A.T, (model.B * self.u_scale).T, self.z, G, var)
                C = np.array([_least_squares(R[:, :-1], R[:, -1])[: len(A)] for R in blocks])
                model, error = super().complete(A, C)
        return model, error


class _TimeProblem(_Problem):
    """Subspace identification from recordings."""

    def __init__(self, recordings: Recording | Iterable[Recording], offset: bool) -> None:
        records = check_for_identification(recordings)
        self.dt, self.offset = records[0].dt, offset
        u, y = [r.u[r.skip :] for r in records], [r.y[r.skip :] for r in records]
        self.y_scale = _or_one(np.std(np.concatenate(y), axis=0))
        self.u_scale = _or_one(np.sqrt(np.mean(np.concatenate(u) ** 2, axis=0)))
        self.records = [(a / self.u_scale, b / self.y_scale) for a, b in zip(u, y, strict=True)]
        n = u[0].shape[1] + y[0].shape[1]
        lengths = np.array([len(a) for a in u])
        self.size = float(lengths.sum() * len(self.y_scale))
        r = np.arange(1, lengths.max() // 2 + 2)
        columns = np.maximum(lengths - 2 * r[:, None] + 1, 0).sum(axis=1)
        self.most_rows = int(np.max(r[columns >= 2 * r * n], initial=0))
        self.affordable_rows = np.sqrt(BUDGET / lengths.sum()) / (2 * n)
        self.too_few = f"{lengths.sum()} samples in {len(lengths)} recording(s) are too few"

    def range_space(self, r: int) -> _RangeSpace:
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
        return _RangeSpace(left[:-n_y], left[n_y:], left[:n_y], values)

    def reduced(self, A: Array, C: Array) -> list[Array]:
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
                response, last = _propagate(A, force.reshape(-1, m, nx), x.reshape(-1, nx))
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


def _order(nx: int) -> int:
    if isinstance(nx, bool) or not isinstance(nx, (int, np.integer)) or nx < 1:
        raise InputError(f"the order nx is {nx!r}; give a whole number of at least 1.")
    return int(nx)


def _or_one(scale: Array) -> Array:
    return np.where(scale > 0, scale, 1.0)


def _balanced_units(size: Array) -> tuple[Array, Array]:
    """Scales of outputs (rows) and inputs (columns) that make every row and column of `size` one in mean square."""
    rows, columns = np.ones(size.shape[0]), np.ones(size.shape[1])
    for _ in range(100):
        rows = _or_one(np.sqrt(np.mean((size * columns) ** 2, axis=1)))
        columns = 1 / _or_one(np.sqrt(np.mean((size / rows[:, None]) ** 2, axis=0)))
    return rows, columns


def _orthonormal_polynomials(z: Array, r: int) -> tuple[Array, Array]:
    """Polynomials of degree 0 to r - 1 at `z`, orthonormal over `z` and its conjugates.

    Returns the values, (r, F), and the real recurrence `H`, (r, r - 1): ``z p_j = sum_i H[i, j] p_i``.
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
    """Triangular factors ``[K y]`` of ``(C (z I - A)⁻¹ b + d) / std = G[:, :, j] / std``, one for each input j."""
    F, n_y, n_u = G.shape
    K = np.empty((F, n_y, len(A) + n_y + 1), dtype=complex)
    K[..., : len(A)] = _resolvent(A, C, z)
    K[..., len(A) : -1] = np.eye(n_y)
    blocks = []
    for j in range(n_u):
        K[..., -1] = G[..., j]
        rows = (K / np.sqrt(var[..., j, None])).reshape(F * n_y, -1)
        blocks.append(_triangle(np.concatenate([rows.real, rows.imag])))
    return blocks


def _resolvent(A: Array, C: Array, z: Array) -> Array:
    """``C (z I - A)⁻¹`` at every `z`, (F, n_y, nx), by one Schur form and substitution."""
    from scipy.linalg import schur

    T, V = schur(A, output="complex")
    c = C @ V
    X = np.empty((len(z), *C.shape), dtype=complex)
    for j in range(len(A)):
        X[..., j] = (c[:, j] + X[..., :j] @ T[:j, j]) / (z - T[j, j])[:, None]
    return X @ V.conj().T


def _reflected(A: Array) -> Array:
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


def _propagate(At: Array, v: Array, x0: Array) -> tuple[Array, Array]:
    """States of ``x(k+1) = x(k) At + v(k)`` (rows) for several runs at once, and the state after the last sample.

    The samples are cut into about sqrt(M) pieces that are run side by side, so that Python loops over sqrt(M) steps.

    Parameters
    ----------
    At : array, (nx, nx)
    v : array, (runs, M, nx)
    x0 : array, (runs, nx)
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


def _windows(x: Array, r: int) -> Array:
    """All windows of `r` samples, oldest first, (M - r + 1, r, n); a view."""
    return np.lib.stride_tricks.sliding_window_view(x, r, axis=0).swapaxes(1, 2)


def _triangle(rows: Array) -> Array:
    R: Any = np.linalg.qr(rows, mode="r")
    return R


def _folded(R: Array | None, rows: Array) -> Array:
    """Triangular factor of `R` with more rows below it, as many rows as columns."""
    folded = _triangle(rows if R is None else np.concatenate([R, rows]))
    missing = folded.shape[1] - len(folded)
    return np.concatenate([folded, np.zeros((missing, folded.shape[1]))]) if missing else folded


def _least_squares(K: Array, y: Array) -> Array:
    """Least squares with columns scaled to one length."""
    length = _or_one(np.linalg.norm(K, axis=0))
    return np.linalg.lstsq(K / length, y, rcond=1e-13)[0] / length
