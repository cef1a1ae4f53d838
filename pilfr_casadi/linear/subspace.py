r"""Linear state-space models by subspace identification, from a BLA or straight from recordings.

.. math:: x(k+1) = A x(k) + B u(k), \qquad y(k) = C x(k) + D u(k)

Both ways find the column space of the extended observability matrix from one singular value decomposition, take `A` and
`C` from its shift structure, reflect unstable eigenvalues into the unit circle, and solve `B` and `D` by linear least
squares (`subspace_problem`). These are the start values of Krikelis et al. (2024), Sec. 5.3; refining them by output
error is up to the fit.

:func:`frequency_subspace` follows McKelvey, Akçay & Ljung (1996), algorithm 2 (`subspace_frequency`);
:func:`time_subspace` is PO-MOESP, Verhaegen (1994) (`subspace_time`).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from .._base import Progress
from ..data import Recording, as_recordings
from .bla import BLA
from .subspace_frequency import FrequencyProblem
from .subspace_problem import checked_order
from .subspace_time import TimeProblem

if TYPE_CHECKING:
    import control

Array = np.ndarray
Data = BLA | Recording | Iterable[Recording]


def frequency_subspace(bla: BLA, nx: int, weight: bool = True, block_rows: int | None = None) -> control.StateSpace:
    """Identify a linear state-space model from a frequency response function.

    Parameters
    ----------
    bla : BLA
        Response with `F` frequencies, on any grid.
    nx : int
        Order of the model.
    weight : bool
        Weight by the inverse of the total variance, smoothed over neighbouring frequencies, where the BLA has one: the
        model then is good in proportion to what is known. Without weights the largest part of the response counts
        most, which as a rule gives the smaller simulation error.
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
    McKelvey, Akçay & Ljung (1996), algorithm 2; see `subspace_frequency`.
    """
    problem = FrequencyProblem(bla, weight)
    return problem.solve([checked_order(nx)], block_rows)[0].system(problem.dt)


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
    Verhaegen (1994); see `subspace_time`.
    """
    problem = TimeProblem(recordings, offset)
    return problem.solve([checked_order(nx)], block_rows)[0].system(problem.dt)


def subspace_matrices(
    recordings: Recording | Iterable[Recording],
    nx: int,
    offset: bool = False,
    block_rows: int | None = None,
    progress: Progress | None = None,
) -> tuple[Array, Array, Array, Array]:
    """Matrices of :func:`time_subspace`, without the import of the control package.

    Parameters
    ----------
    recordings, nx, offset, block_rows
        As for :func:`time_subspace`; order 0, a static gain, is legal here.
    progress : callable, optional
        Called with ("subspace", done, total, smallest error so far).

    Returns
    -------
    A, B, C, D : array, (nx, nx), (nx, n_u), (n_y, nx), (n_y, n_u)

    Raises
    ------
    InputError
        As :func:`time_subspace`.
    """
    if nx == 0:
        return _static_gain(as_recordings(recordings), offset)
    model = TimeProblem(recordings, offset).solve([checked_order(nx)], block_rows, progress)[0]
    return model.A, model.B, model.C, model.D


def _static_gain(recordings: tuple[Recording, ...], offset: bool) -> tuple[Array, Array, Array, Array]:
    """Least-squares gain of the outputs over the inputs, each taken from its mean in the recording with `offset`."""
    parts = [(r.u[r.skip :], r.y[r.skip :]) for r in recordings]
    if offset:
        parts = [(u - np.mean(u, axis=0), y - np.mean(y, axis=0)) for u, y in parts]
    u, y = (np.concatenate(signals) for signals in zip(*parts, strict=True))
    n_u, n_y = u.shape[1], y.shape[1]
    return np.zeros((0, 0)), np.zeros((0, n_u)), np.zeros((n_y, 0)), np.linalg.lstsq(u, y, rcond=None)[0].T


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
    problem = FrequencyProblem(data, weight) if isinstance(data, BLA) else TimeProblem(data, offset)
    return problem.range_space(problem.ladder(1, block_rows or min(20, max(2, problem.most_rows)))[0]).values
