r"""Best linear approximation from any recordings, by the local polynomial method.

In a window around each frequency the response and the transient (leakage) are polynomials of the frequency, fitted by
linear least squares to the spectra: for a line at the distance ``d`` from that frequency,

.. math:: Y(d) = \sum_p G_p d^p\, U(d) + \sum_p t_p d^p + V(d), \qquad G_\text{BLA} = G_0,

the `t_p` one set for each recording, the variance of `V` from the residual. Source: Pintelon & Schoukens, System
Identification: A Frequency Domain Approach, 2nd ed., 2012, chapter 7; the BLA is Krikelis et al. (2024), Eq. 21.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable

import numpy as np

from .._base import InputError
from ..data import Recording, check_for_identification
from .bla import BLA

Array = np.ndarray
UNCERTAIN = 0.5  # relative deviation from which an estimate tells nothing
INFLATED = 1e6  # times the variance without leakage; broadband inputs have less than 10, a tone beside its line 1e13
REMEDY = "give an input that excites many frequencies by itself, or whole periods with `period` set."


def plain_bla(
    recordings: Recording | Iterable[Recording],
    order: int = 2,
    window: int | None = None,
    n_frequencies: int = 1000,
    floor: float = 0.01,
) -> BLA:
    """Estimate the BLA from any recordings by the local polynomial method.

    Parameters
    ----------
    recordings : Recording or iterable of Recording
        Of any length and with any input; samples up to `skip` are left out. Periodic ones that hold a whole number of
        periods are averaged over them first.
    order : int
        Order of the local polynomials of the response and the transient.
    window : int, optional
        Excited lines in a window, in the shortest recording (more in proportion in longer ones); left out, what the
        polynomials need and at least 10 degrees of freedom, and at least the distance of the frequencies returned.
    n_frequencies : int
        At most so many frequencies are returned, spread over the excited lines of the shortest recording.
    floor : float
        Lines at which no input reaches this share of its largest amplitude do not count as excited.

    Returns
    -------
    BLA
        `var_total` is from the residual of the local fits: noise, nonlinear distortion and what the polynomials cannot
        follow. Neighbours share data, so their errors are correlated. `var_noise` is ``None``.

    Raises
    ------
    InputError
        When samples are too few for the window, or the inputs cannot be told apart.

    Warns
    -----
    RuntimeWarning
        Where at half of the frequencies or more the deviation is above 50 % of the response, or the input cannot be
        told from leakage, as a tone beside its line.

    References
    ----------
    Pintelon & Schoukens (2012), Sec. 7.2.2 and 7.3.5; Krikelis et al. (2024), Eq. 21.
    """
    if order < 0 or n_frequencies < 1 or (window is not None and window < 1):
        raise InputError(
            f"order {order}, window {window} and n_frequencies {n_frequencies} must not be negative, nor the last two "
            "zero; leave them out for the defaults."
        )
    records = check_for_identification(recordings)
    scale = np.sqrt(np.mean([np.var(r.u[r.skip :], axis=0) for r in records], axis=0))
    if np.any(scale == 0):
        raise InputError(
            f"the input {records[0].inputs[int(np.argmin(scale))]!r} never changes in any recording; its response "
            "cannot be estimated, leave it out."
        )
    lines = [_excited_spectrum(r, scale, floor) for r in records]
    shortest = min(range(len(lines)), key=lambda r: len(lines[r][0]))
    available = len(lines[shortest][0])
    n_u, n_rec, n_poly = len(scale), len(records), order + 1
    step = max(1, -(-available // n_frequencies))
    if window is None:
        need = n_poly + -(-(n_poly * n_u + max(10, (n_poly * (n_u + n_rec)) // 2)) // n_rec)
        window = max(need, step)
    if window > available or n_rec * window <= n_poly * (n_u + n_rec):
        raise InputError(
            f"{n_rec} recording(s) with at least {available} excited lines cannot fill windows of {window} lines for "
            f"polynomials of order {order} and {n_u} input(s); record longer or lower the order."
        )
    grid = lines[shortest][0][step // 2 :: step]
    share = [max(window, min(len(f), round(window * len(f) / available))) for f, _, _ in lines]
    per_frequency = sum(share) * n_poly * (n_u + n_rec)
    chunk = max(1, int(4e6) // per_frequency)
    parts = [_local_polynomials(grid[k : k + chunk], lines, share, order) for k in range(0, len(grid), chunk)]
    G, var, good, inflation = (np.concatenate(p) for p in zip(*parts, strict=True))
    if not good.any():
        raise InputError(
            f"the {n_u} inputs {', '.join(records[0].inputs)} move together at every frequency; excite them "
            "independently or add recordings with other inputs."
        )
    _warn_of_nonsense(G[good], var[good], inflation[good], records[0])
    return BLA(grid[good], G[good] / scale, None, var[good] / scale**2, records[0].dt)


def _warn_of_nonsense(G: Array, var: Array, inflation: Array, record: Recording) -> None:
    """Warn where the estimate (F, n_y, n_u), inputs of unit size, or an input's part in it tells next to nothing."""
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.nan_to_num(np.sqrt(np.sum(var, axis=2) / np.sum(np.abs(G) ** 2, axis=2)), nan=0.0, posinf=np.inf)
    typical, hidden = np.median(share, axis=0), np.median(inflation, axis=0)
    if np.max(hidden) > INFLATED:
        warnings.warn(
            f"The spectrum of the input {record.inputs[int(np.argmax(hidden))]!r} cannot be told from leakage at most "
            f"frequencies, so its best linear approximation is not to be trusted; {REMEDY}",
            RuntimeWarning,
            stacklevel=3,
        )
    elif np.max(typical) > UNCERTAIN:
        warnings.warn(
            f"The best linear approximation of the output {record.outputs[int(np.argmax(typical))]!r} deviates by "
            f"{np.max(typical):.0%} of its own size at most frequencies; record longer with less noise, or {REMEDY}",
            RuntimeWarning,
            stacklevel=3,
        )


def _excited_spectrum(r: Recording, scale: Array, floor: float) -> tuple[Array, Array, Array]:
    """Frequencies and spectra of one recording where any input is excited; equal noise in recordings of any length."""
    u, y = r.u[r.skip :] / scale, r.y[r.skip :]
    weight = 1.0
    if r.period is not None and len(u) % r.period == 0:
        weight = np.sqrt(len(u) // r.period)
        u, y = (x.reshape(-1, r.period, x.shape[1]).mean(axis=0) for x in (u, y))
    N = len(u)
    U, Y = (weight * np.fft.rfft(x - x.mean(axis=0), axis=0)[: (N + 1) // 2] / np.sqrt(N) for x in (u, y))
    size = np.abs(U)
    excited = np.flatnonzero(np.any(size > floor * size.max(axis=0), axis=1))
    return excited / (N * r.dt), U[excited], Y[excited]


def _local_polynomials(
    grid: Array, lines: list[tuple[Array, Array, Array]], share: list[int], order: int
) -> tuple[Array, Array, Array, Array]:
    """Local least squares at the frequencies `grid`: response, its variance, whether it can be told, and at what price.

    The last is, by input, variance times the input's power over the noise's: 1 for one input without leakage.
    """
    n_u, n_y, n_rec, n_poly = lines[0][1].shape[1], lines[0][2].shape[1], len(lines), order + 1
    ends = np.concatenate([[0], np.cumsum(share)])
    K = np.zeros((len(grid), ends[-1], n_poly * (n_u + n_rec)), dtype=complex)
    Y = np.empty((len(grid), ends[-1], n_y), dtype=complex)
    x = np.empty((len(grid), ends[-1]))
    for r, (f, _, _) in enumerate(lines):
        first = np.clip(np.searchsorted(f, grid) - share[r] // 2, 0, len(f) - share[r])
        index = first[:, None] + np.arange(share[r])
        x[:, ends[r] : ends[r + 1]] = f[index] - grid[:, None]
        Y[:, ends[r] : ends[r + 1]] = lines[r][2][index]
        K[:, ends[r] : ends[r + 1], :n_u] = lines[r][1][index]
    size = np.max(np.abs(x), axis=1)
    powers = (x / size[:, None])[..., None] ** np.arange(n_poly)
    U = K[..., :n_u].copy()
    for p in range(n_poly):
        K[..., p * n_u : (p + 1) * n_u] = U * powers[..., p, None]
        for r in range(n_rec):
            K[:, ends[r] : ends[r + 1], n_poly * n_u + r * n_poly + p] = powers[:, ends[r] : ends[r + 1], p]
    length = np.linalg.norm(K, axis=1)
    length[length == 0] = 1.0
    Q, R = np.linalg.qr(K / length[:, None, :])
    diagonal = np.abs(np.diagonal(R, axis1=1, axis2=2))
    good = diagonal.min(axis=1) > 1e-8 * diagonal.max(axis=1)
    R[~good] = np.eye(R.shape[1])
    inverse = np.linalg.inv(R) / length[:, :, None]
    coefficients = Q.conj().swapaxes(1, 2) @ Y
    dof = ends[-1] - K.shape[2]
    var = (np.sum(np.abs(Y) ** 2, axis=1) - np.sum(np.abs(coefficients) ** 2, axis=1)) / dof
    response = (inverse[:, :n_u] @ coefficients).swapaxes(1, 2)
    gain = np.sum(np.abs(inverse[:, :n_u]) ** 2, axis=2)
    inflation = gain * np.sum(np.abs(U) ** 2, axis=1)
    return response, np.maximum(var, 0.0)[:, :, None] * gain[:, None, :], good, inflation
