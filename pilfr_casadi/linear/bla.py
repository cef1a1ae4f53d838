r"""Best linear approximation (BLA): frequency response functions with their variances, from periodic recordings.

The BLA is the linear model that explains the output best in the least-squares sense for the given class of inputs,
Krikelis et al. (2024), Eq. 21,

.. math:: G_\text{BLA} = \arg\min_G E\{|\tilde y(k) - G(q^{-1}) \tilde u(k)|^2\}.

:func:`robust_bla` averages over steady periods, whose scatter is noise, and over realizations of the input, whose
further scatter is nonlinear distortion. With several inputs each realization takes ``n_u`` experiments, best orthogonal
multisines: with the spectra of the experiments as columns, ``G = Y U⁻¹``
(Pintelon & Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., 2012, chapters 3, 4 and 7).

:func:`plain_bla` takes any recordings, by the local polynomial method (chapter 7 there). In a window around each
frequency the response and the transient (leakage) are polynomials of the frequency, fitted by linear least squares to
the spectra: for a line at the distance ``d`` from that frequency,

.. math:: Y(d) = \sum_p G_p d^p\, U(d) + \sum_p t_p d^p + V(d), \qquad G_\text{BLA} = G_0,

with one set of `t_p` for each recording, and the variance of `V` from the residual.

The spectra of :func:`robust_bla` are Fourier coefficients, ``DFT / N``: a line of amplitude ``a`` has the modulus
``a / 2``.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from .._base import InputError, numbers, positive, whole
from ..data import Recording, check_for_identification

Array = np.ndarray

EXCITED_SHARE = 1e-3  # share of the largest input amplitude below which a line counts as not excited
EXCITED_OVER_NOISE = 20  # power of a line over the input's own noise power above which the line counts as excited
SINGULAR = 1e4  # condition number of the input matrix above which a line is skipped
UNCERTAIN = 0.5  # relative standard deviation above which an estimate is useless
INFLATED = 1e6  # variance over that without leakage; broadband inputs have less than 10, a tone beside its line 1e13
REMEDY = "give an input that excites many frequencies by itself, or whole periods with `period` set."
CHUNK = int(4e6)  # entries of the local least-squares problems that are solved at once, for memory


@dataclass(frozen=True, eq=False, repr=False)
class BLA:
    """A frequency response function with its variances.

    The variances belong to the mean `G` over all realizations and periods: ``E|ΔG[k, i, j]|² = var[k, i, j]``. At the
    level of one realization (as in the paper's Fig. 8 and 13) they are `n_realizations` times as large.

    Parameters
    ----------
    frequency : array, (F,)
        Frequencies in Hz, increasing.
    G : complex array, (F, n_y, n_u)
        Response from each input to each output, output unit per input unit.
    var_noise : array, (F, n_y, n_u), optional
        Variance of `G` from noise alone; ``None`` where it cannot be estimated (a single period).
    var_total : array, (F, n_y, n_u), optional
        Variance of `G` from noise and nonlinear distortion; ``None`` where it cannot be estimated (a single
        realization).
    dt : float
        Time from one sample to the next, in seconds.
    n_realizations, n_periods : int
        Realizations averaged, and steady periods averaged in each.
    """

    frequency: Array
    G: Array
    var_noise: Array | None
    var_total: Array | None
    dt: float
    n_realizations: int = 1
    n_periods: int = 1

    @property
    def n_u(self) -> int:
        """Number of inputs."""
        return self.G.shape[2]

    @property
    def n_y(self) -> int:
        """Number of outputs."""
        return self.G.shape[1]

    def __repr__(self) -> str:
        text = f"{self.n_y} output(s), {self.n_u} input(s), {len(self.frequency)} frequencies from "
        text += f"{self.frequency[0]:.4g} to {self.frequency[-1]:.4g} Hz, "
        for name, var in (("noise", self.var_noise), ("total", self.var_total)):
            if var is not None:
                text += f"{name} {100 * np.sqrt(np.sum(var) / np.sum(np.abs(self.G) ** 2)):.3g} %, "
        text += f"{self.n_realizations} realization(s) of {self.n_periods} period(s)"
        return f"<BLA: {text}>"


@dataclass(frozen=True, eq=False)
class OutputSpectra:
    """Spectra of the outputs at the excited lines, at the level of one experiment with its periods averaged.

    `power` (F, n_y) is the mean squared modulus of the output's Fourier coefficients over the experiments at each
    `frequency` (F,) in Hz; `var_noise` is its part due to noise (``None`` with a single period) and `var_total`
    the part due to noise and nonlinear distortion (``None`` with a single realization).
    """

    frequency: Array
    power: Array
    var_noise: Array | None
    var_total: Array | None


@dataclass(frozen=True, eq=False)
class _Spectra:
    """Spectra of periodic experiments at the excited lines: `U` (M, n_u, P, F, n_u), `Y` (M, n_u, P, F, n_y)."""

    frequency: Array
    U: Array
    Y: Array
    dt: float

    def frf(self) -> tuple[Array, Array]:
        """Return the response of each realization, (M, F, n_y, n_u), and its inverted inputs, (M, F, n_u, n_u)."""
        inverse = np.linalg.inv(_as_columns(self.U))
        return _as_columns(self.Y) @ inverse, inverse

    def noise(self, G: Array) -> Array | None:
        """Return the variance of ``Y - G U`` of one experiment with its periods averaged, (M, n_u, F, n_y)."""
        n_periods = self.U.shape[2]
        if n_periods == 1:
            return None
        error = self.Y - np.einsum("mfij,mepfj->mepfi", G, self.U)
        error -= error.mean(axis=2, keepdims=True)
        return np.sum(np.abs(error) ** 2, axis=2) / (n_periods * (n_periods - 1))


def robust_bla(
    recordings: Recording | Iterable[Recording], period: int | None = None, lines: Sequence[int] | Array | None = None
) -> BLA:
    """Estimate the BLA, its noise variance and its total variance from periodic steady-state recordings.

    Parameters
    ----------
    recordings : Recording or iterable of Recording
        One per experiment, each a whole number P of steady periods after its `skip` samples, the same P in all. With
        ``n_u`` inputs each ``n_u`` recordings in the order given make one realization, and their inputs must be
        linearly independent at every line, best orthogonal multisines.
    period : int, optional
        Samples per period; by default the recordings' own.
    lines : array of int, optional
        Excited harmonics, 1 being one cycle per period. By default the lines at which every input exceeds 0.1 % of its
        largest amplitude and, with several periods, 20 times the power of its variation between periods.

    Returns
    -------
    BLA
        On the excited lines strictly between zero and the Nyquist frequency. `var_noise` is ``None`` with one period,
        `var_total` with one realization. Noise on measured inputs is included in both.

    Raises
    ------
    InputError
        If period and length, or the number of recordings and of inputs, do not fit, or the inputs of a realization
        depend on each other.

    References
    ----------
    Krikelis et al. (2024), Sec. 5.3 and 6.3; Pintelon & Schoukens (2012), Sec. 4.3 and 7.3 (the robust method).
    """
    spectra = _periodic_spectra(recordings, period, lines)
    G, inverse = spectra.frf()
    n = len(G)
    var = spectra.noise(G)
    var_noise = None
    if var is not None:  # δG = (δY - G δU) U⁻¹ in each realization
        var_noise = np.einsum("mefi,mfej->fij", var, np.abs(inverse) ** 2) / n**2
    var_total = None if n == 1 else np.var(G, axis=0, ddof=1) / n
    return BLA(spectra.frequency, G.mean(axis=0), var_noise, var_total, spectra.dt, n, spectra.U.shape[2])


def output_spectra(recordings: Recording | Iterable[Recording]) -> OutputSpectra:
    """Estimate the spectra of the outputs, of their noise, and of noise and nonlinear distortion together.

    The recordings are periodic, as for :func:`robust_bla`. The distortion is the scatter of ``Y - G U`` over the
    realizations, `G` being the BLA.
    """
    spectra = _periodic_spectra(recordings, None, None)
    G, _ = spectra.frf()
    n, n_u = spectra.U.shape[:2]
    U, Y = spectra.U.mean(axis=2), spectra.Y.mean(axis=2)
    var = spectra.noise(G)
    var_noise = None if var is None else var.mean(axis=(0, 1))
    var_total = None
    if n > 1:
        error = Y - np.einsum("fij,mefj->mefi", G.mean(axis=0), U)
        var_total = np.sum(np.abs(error) ** 2, axis=(0, 1)) / ((n - 1) * n_u)
    return OutputSpectra(spectra.frequency, np.mean(np.abs(Y) ** 2, axis=(0, 1)), var_noise, var_total)


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
        Recordings of any length with any input; samples up to `skip` are left out. A periodic recording of whole
        periods is averaged over them first.
    order : int
        Order of the local polynomials of the response and the transient.
    window : int, optional
        Excited lines in a window of the shortest recording (proportionally more in longer ones). By default it leaves
        at least 10 degrees of freedom and spans at least the distance of the frequencies returned.
    n_frequencies : int
        Largest number of frequencies returned, spread over the excited lines of the shortest recording.
    floor : float
        Lines at which no input reaches this share of its largest amplitude do not count as excited.

    Returns
    -------
    BLA
        `var_total` comes from the residual of the local fits: noise, nonlinear distortion and the misfit of the
        polynomials. Neighbouring frequencies share data, so their errors are correlated. `var_noise` is ``None``.

    Raises
    ------
    InputError
        If an argument is out of range, samples are too few for the window, or the inputs are linearly dependent.

    Warns
    -----
    RuntimeWarning
        If at half of the frequencies or more the standard deviation exceeds 50 % of the response, or the input cannot
        be distinguished from leakage (a tone between two lines).

    References
    ----------
    Pintelon & Schoukens (2012), Sec. 7.2.2 and 7.3.5; Krikelis et al. (2024), Eq. 21.
    """
    order, n_frequencies = whole(order, "order", 0), whole(n_frequencies, "n_frequencies", 1)
    window = window if window is None else whole(window, "window", 1)
    floor = positive(floor, "floor", "a share of the largest amplitude", zero=True)
    records = check_for_identification(recordings)
    scale = np.sqrt(np.mean([np.var(r.u[r.skip :], axis=0) for r in records], axis=0))
    if np.any(scale == 0):
        raise InputError(
            f"the input {records[0].inputs[int(np.argmin(scale))]!r} never changes in any recording; its response "
            "cannot be estimated, leave it out."
        )
    lines = [_excited_spectrum(r, scale, floor) for r in records]
    grid, share = _choose_windows(lines, order, window, n_frequencies)
    n_u = len(scale)
    chunk = max(1, CHUNK // (sum(share) * (order + 1) * (n_u + len(records))))
    parts = [_local_polynomials(grid[k : k + chunk], lines, share, order) for k in range(0, len(grid), chunk)]
    G, var, good, inflation = (np.concatenate(p) for p in zip(*parts, strict=True))
    if not good.any():
        raise InputError(
            f"the {n_u} inputs {', '.join(records[0].inputs)} move together at every frequency; excite them "
            "independently or add recordings with other inputs."
        )
    _warn_if_useless(G[good], var[good], inflation[good], records[0])
    return BLA(grid[good], G[good] / scale, None, var[good] / scale**2, records[0].dt)


def _periodic_spectra(
    recordings: Recording | Iterable[Recording], period: int | None, lines: Sequence[int] | Array | None
) -> _Spectra:
    records = check_for_identification(recordings)
    n_u = records[0].n_u
    if len(records) % n_u:
        raise InputError(
            f"{len(records)} recording(s) do not make whole realizations of {n_u} experiments each; with {n_u} inputs "
            f"give {n_u} recordings per realization, or use plain_bla."
        )
    U, Y = zip(*(_period_spectra(r, period) for r in records), strict=True)
    if len({x.shape for x in U}) > 1:
        raise InputError(
            f"the recordings hold {sorted({x.shape[0] for x in U})} periods of {sorted({2 * x.shape[1] for x in U})} "
            "samples; give them all the same (drop early periods by `skip`)."
        )
    N = period or records[0].period
    assert N is not None
    n_last = (N + 1) // 2  # the first line at or above the Nyquist frequency
    shape = (len(records) // n_u, n_u, *U[0].shape[:2])
    U_all, Y_all = np.reshape(U, (*shape, n_u)), np.reshape(Y, (*shape, -1))
    harmonics = _find_lines(U_all[..., :n_last, :]) if lines is None else np.unique(numbers(lines, "lines"))
    if harmonics.size == 0 or harmonics[0] < 1 or harmonics[-1] >= n_last or np.any(harmonics % 1):
        raise InputError(
            f"no usable excited lines among 1 to {n_last - 1}; check the period of {N} samples or give `lines`, whole "
            "numbers in that range."
        )
    harmonics = harmonics.astype(int)
    U_all, Y_all = U_all[..., harmonics, :], Y_all[..., harmonics, :]
    matrix = _as_columns(U_all)
    size = np.sqrt(np.mean(np.abs(matrix) ** 2, axis=(0, 1, 3)))  # units of the inputs must not matter
    good = np.all(np.linalg.cond(matrix / size[:, None]) < SINGULAR, axis=0)
    if not good.any():
        raise InputError(
            f"the {n_u} inputs are linearly dependent over the {n_u} experiments of a realization at every line; use "
            "orthogonal multisines, grouped by realization."
        )
    harmonics, U_all, Y_all = harmonics[good], U_all[..., good, :], Y_all[..., good, :]
    return _Spectra(harmonics / (N * records[0].dt), U_all, Y_all, records[0].dt)


def _period_spectra(r: Recording, period: int | None) -> tuple[Array, Array]:
    """Return the Fourier coefficients of each steady period, (P, N // 2 + 1, n_u) and (..., n_y)."""
    N = r.period if period is None else period
    if N is None:
        raise InputError(f"the period of {r.label} is not known; set `period`, in samples, or use plain_bla.")
    steady = len(r) - r.skip
    if N < 3 or steady % N:
        raise InputError(
            f"{r.label} has {steady} samples after the skipped ones, which are not whole periods of {N} samples; cut "
            "it or correct `period` or `skip`."
        )
    u, y = (x[r.skip :].reshape(-1, N, x.shape[1]) for x in (r.u, r.y))
    return np.fft.rfft(u, axis=1) / N, np.fft.rfft(y, axis=1) / N


def _as_columns(X: Array) -> Array:
    """Average over the periods, with the experiments as columns: (M, n_u, P, F, n) -> (M, F, n, n_u)."""
    return np.moveaxis(X.mean(axis=2), 1, -1)


def _find_lines(U: Array) -> Array:
    """Find the harmonics that all inputs excite, from spectra (M, n_u, P, F, n_u) that start at frequency zero."""
    n_periods = U.shape[2]
    power = np.mean(np.abs(U.mean(axis=2)) ** 2, axis=(0, 1))
    limit = EXCITED_SHARE**2 * power[1:].max(axis=0, initial=0.0) * np.ones_like(power)
    if n_periods > 1:
        noise = np.mean(np.var(U, axis=2, ddof=1), axis=(0, 1)) / n_periods
        limit = np.maximum(limit, EXCITED_OVER_NOISE * moving_mean(noise, 10))
    excited = np.all(power > limit, axis=1)
    excited[0] = False
    return np.flatnonzero(excited)


def moving_mean(x: Array, half: int) -> Array:
    """Average over the neighbours up to `half` away, along the first axis, fewer at the ends."""
    total = np.concatenate([np.zeros((1, *x.shape[1:])), np.cumsum(x, axis=0)])
    k = np.arange(len(x))
    first, last = np.maximum(k - half, 0), np.minimum(k + half + 1, len(x))
    return (total[last] - total[first]) / (last - first).reshape(-1, *(1,) * (x.ndim - 1))


def _warn_if_useless(G: Array, var: Array, inflation: Array, record: Recording) -> None:
    """Warn if the estimate (F, n_y, n_u), for inputs of unit size, is too uncertain or one input is mostly leakage."""
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.nan_to_num(np.sqrt(np.sum(var, axis=2) / np.sum(np.abs(G) ** 2, axis=2)), nan=0.0, posinf=np.inf)
    typical, hidden = np.median(share, axis=0), np.median(inflation, axis=0)
    if np.max(hidden) > INFLATED:
        warnings.warn(
            f"The spectrum of the input {record.inputs[int(np.argmax(hidden))]!r} is mostly leakage at most "
            f"frequencies, so its best linear approximation is not reliable; {REMEDY}",
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
    """Return frequencies and spectra where any input is excited, scaled to equal noise in recordings of any length."""
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


def _choose_windows(
    lines: list[tuple[Array, Array, Array]], order: int, window: int | None, n_frequencies: int
) -> tuple[Array, list[int]]:
    """Choose the frequencies to return, and the number of excited lines of each recording in a window around them."""
    shortest = min(lines, key=lambda spectrum: len(spectrum[0]))[0]
    available, n_u, n_rec, n_poly = len(shortest), lines[0][1].shape[1], len(lines), order + 1
    step = max(1, -(-available // n_frequencies))
    if window is None:
        need = n_poly + -(-(n_poly * n_u + max(10, (n_poly * (n_u + n_rec)) // 2)) // n_rec)
        window = max(need, step)
    if window > available or n_rec * window <= n_poly * (n_u + n_rec):
        raise InputError(
            f"{n_rec} recording(s) with at least {available} excited lines cannot fill windows of {window} lines for "
            f"polynomials of order {order} and {n_u} input(s); record longer or lower the order."
        )
    share = [max(window, min(len(f), round(window * len(f) / available))) for f, _, _ in lines]
    return shortest[step // 2 :: step], share


def _local_polynomials(
    grid: Array, lines: list[tuple[Array, Array, Array]], share: list[int], order: int
) -> tuple[Array, Array, Array, Array]:
    """Solve the local least-squares problems at the frequencies `grid`.

    Returns the response, its variance, whether it can be determined, and the inflation of the variance by input: the
    variance times the input's power over the noise's, which is 1 for one input without leakage.
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


def any_bla(recordings: Sequence[Recording]) -> BLA | None:
    """Estimate the BLA, for periodic recordings by the robust method; None if the recordings do not allow it."""
    try:
        return robust_bla(recordings) if all(r.period for r in recordings) else plain_bla(recordings)
    except InputError:
        return None
