r"""Linear state-space models by subspace identification, from a BLA or straight from recordings.

.. math:: x(k+1) = A x(k) + B u(k), \qquad y(k) = C x(k) + D u(k)

Both ways find the column space of the extended observability matrix from one singular value decomposition, take `A` and
`C` from its shift structure, reflect unstable eigenvalues into the unit circle, and solve `B` and `D` by linear least
squares. These are the start values of Krikelis et al. (2024), Sec. 5.3; refining them by output error is up to the fit.

:func:`frequency_subspace` follows McKelvey, Akçay & Ljung (1996), Subspace-based multivariable system identification
from frequency response data, IEEE Trans. Automatic Control 41(7), 960-979, algorithm 2 (any frequency grid, noise
weighting), with one change: where they stack powers ``1, z, ..., z^(r-1)``, whose rows are nearly dependent unless the
frequencies fill the unit circle, polynomials in ``z`` are used that are orthonormal on the weighted grid (Arnoldi;
Brubeck, Nakatsukasa & Trefethen (2021), Vandermonde with Arnoldi, SIAM Review 63(2), 405-415). Then the shift structure
is the Arnoldi recurrence, the rows of the input need no factorization, and weighted noise stays white.

:func:`time_subspace` is PO-MOESP, past inputs and outputs as instruments: Verhaegen (1994), Identification of the
deterministic part of MIMO state space models given in innovations form, Automatica 30(1), 61-74.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .bla import BLA
from .recording import InputError, Recording, check_for_identification

if TYPE_CHECKING:
    import control

Array = np.ndarray
Data = BLA | Recording | Iterable[Recording]

CHUNK = 8192  # rows handled at once in a sequential QR


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
    return _frequency_problem(bla, weight).solve([_order(nx)], block_rows)[0].system()


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
    return _TimeProblem(recordings, offset).solve([_order(nx)], block_rows)[0].system()


def singular_values(data: Data, block_rows: int | None = None, weight: bool = True) -> Array:
    """Singular values that the subspace identification sees, largest first: where they drop is the order.

    Parameters
    ----------
    data : BLA, Recording or iterable of Recording
        As for :func:`frequency_subspace` or :func:`time_subspace`.
    block_rows : int, optional
        As there; left out, as many as the data allow, at most 20.
    weight : bool
        As for :func:`frequency_subspace`.

    Returns
    -------
    array, (block_rows * n_y,)
    """
    problem = _frequency_problem(data, weight) if isinstance(data, BLA) else _TimeProblem(data, False)
    return problem.range_space(min(20, problem.most_rows) if block_rows is None else problem.rows(1, block_rows)[0])[1]


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


def select_order(data: Data, orders: Iterable[int] = range(1, 11), margin: float = 0.05) -> OrderSelection:
    """Try several orders on one part of the data and judge them on the other.

    Parameters
    ----------
    data : BLA, Recording or iterable of Recording
        Of a BLA every second frequency is held out, of a single recording the last 30 % of the samples, of several
        recordings the last 30 % of them, at least one.
    orders : iterable of int
        Orders to try.
    margin : float
        The recommended order is the smallest whose validation error is at most ``1 + margin`` times the best.

    Returns
    -------
    OrderSelection

    Raises
    ------
    InputError
        When there is no order, an order is not a whole number above zero, or the data are too few for it.
    """
    orders = tuple(sorted({_order(n) for n in orders}))
    if not orders or margin < 0:
        raise InputError(f"orders {orders} with a margin of {margin}: give at least one order and a margin of 0 or more.")
    error: Callable[[_Realization], float]
    if isinstance(data, BLA):
        problem: _Problem = _frequency_problem(data, True, slice(0, None, 2))
        error = _frequency_problem(data, True, slice(1, None, 2)).error
    else:
        records = check_for_identification(data)
        n_train = max(1, min(len(records) - 1, round(0.7 * len(records))))
        train, held = records[:n_train], records[n_train:]
        if not held:
            steady = records[0].slice(records[0].skip)
            train, held = steady.split(0.7)[:1], steady.split(0.7)[1:]
        problem, error = _TimeProblem(train, False), _TimeProblem(held, False).error
    models = problem.solve(orders, None)
    validation = np.array([error(m) for m in models])
    best = max((1 + margin) * np.min(validation), 1e-7)  # errors that small are rounding
    recommended = next(n for n, e in zip(orders, validation, strict=True) if e <= best)
    values = problem.range_space(min(20, problem.most_rows))[1]
    return OrderSelection(orders, np.array([problem.error(m) for m in models]), validation, recommended, margin, values)
