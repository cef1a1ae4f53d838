r"""Best linear approximation (BLA): frequency response functions with their variances, from periodic recordings.

The BLA is the linear model that explains the output best in the least-squares sense for the given class of inputs,
Krikelis et al. (2024), Eq. 21,

.. math:: G_\text{BLA} = \arg\min_G E\{|\tilde y(k) - G(q^{-1}) \tilde u(k)|^2\}.

:func:`robust_bla` averages over steady periods (what differs between periods is noise) and over realizations of the
input (what differs between them beyond the noise is nonlinear distortion); with several inputs each realization takes
``n_u`` experiments, best orthogonal multisines: with the spectra of the experiments side by side, ``G = Y U⁻¹``
(Pintelon & Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., 2012, chapters 3, 4 and 7).

All spectra are Fourier coefficients, ``DFT / N``: a line of amplitude ``a`` has the modulus ``a / 2``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from .._base import InputError
from ..data import Recording, check_for_identification

Array = np.ndarray

EXCITED = 1e-3  # share of the largest input amplitude below which a line counts as not excited
SINGULAR = 1e4  # condition number of the input matrix above which a line is left out


@dataclass(frozen=True, eq=False, repr=False)
class BLA:
    """A frequency response function with its variances.

    The variances are those of the mean `G` over all realizations and periods; an estimate ``G[k, i, j]`` scatters about
    the true one with ``E|ΔG|² = var``. For the level of one realization (as the paper's Fig. 8 and 13 show the total
    variance) multiply by the number of realizations: :attr:`var_total_realization`, :attr:`var_noise_realization`.

    Parameters
    ----------
    frequency : array, (F,)
        Frequencies in Hz, increasing.
    G : complex array, (F, n_y, n_u)
        Response from each input to each output, output unit per input unit.
    var_noise : array, (F, n_y, n_u), optional
        Variance of `G` from noise alone; ``None`` where it cannot be told (a single period).
    var_total : array, (F, n_y, n_u), optional
        Variance of `G` from noise and nonlinear distortion; ``None`` where it cannot be told (a single realization).
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

    @property
    def var_noise_realization(self) -> Array | None:
        """Noise variance at the level of one realization (its periods averaged), (F, n_y, n_u)."""
        return None if self.var_noise is None else self.var_noise * self.n_realizations

    @property
    def var_total_realization(self) -> Array | None:
        """Variance from noise and nonlinear distortion at the level of one realization, (F, n_y, n_u)."""
        return None if self.var_total is None else self.var_total * self.n_realizations

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

    Parameters
    ----------
    frequency : array, (F,)
        Frequencies in Hz.
    power : array, (F, n_y)
        Mean squared modulus of the output's Fourier coefficients over the experiments.
    var_noise : array, (F, n_y), optional
        The share of it that noise makes; ``None`` with a single period.
    var_total : array, (F, n_y), optional
        The share that noise and nonlinear distortion make; ``None`` with a single realization.
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
        """Response of each realization, (M, F, n_y, n_u), and the inverses of its input matrices, (M, F, n_u, n_u)."""
        inverse = np.linalg.inv(_side_by_side(self.U))
        return _side_by_side(self.Y) @ inverse, inverse

    def noise(self, G: Array) -> Array | None:
        """Variance of ``Y - G U`` of one experiment with its periods averaged, (M, n_u, F, n_y)."""
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
        linearly independent at every line: orthogonal multisines are best.
    period : int, optional
        Samples per period; left out, the recordings' own.
    lines : array of int, optional
        Excited harmonics, 1 being one cycle per period. Left out, they are found: every input exceeds 0.1 % of its
        largest amplitude and, with several periods, 20 times the power of its own variation between periods.

    Returns
    -------
    BLA
        On the excited lines strictly between zero and the Nyquist frequency. `var_noise` is ``None`` with one period,
        `var_total` with one realization. Noise on measured inputs is included in both.

    Raises
    ------
    InputError
        When period and length, or the number of recordings and of inputs, do not fit, or the inputs of a realization
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


def output_spectra(
    recordings: Recording | Iterable[Recording], period: int | None = None, lines: Sequence[int] | Array | None = None
) -> OutputSpectra:
    """Spectra of the outputs, of their noise, and of noise and nonlinear distortion together.

    Parameters
    ----------
    recordings, period, lines
        As for :func:`robust_bla`.

    Returns
    -------
    OutputSpectra
        The distortion is what ``Y - G U`` varies by between realizations, `G` being the BLA.

    Raises
    ------
    InputError
        As :func:`robust_bla`.
    """
    spectra = _periodic_spectra(recordings, period, lines)
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
    harmonics = _find_lines(U_all[..., :n_last, :]) if lines is None else np.unique(np.asarray(lines, dtype=int))
    if harmonics.size == 0 or harmonics[0] < 1 or harmonics[-1] >= n_last:
        raise InputError(
            f"no usable excited lines among 1 to {n_last - 1}; check the period of {N} samples or give `lines` there."
        )
    U_all, Y_all = U_all[..., harmonics, :], Y_all[..., harmonics, :]
    matrix = _side_by_side(U_all)
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
    """Fourier coefficients of each steady period of a recording, (P, N // 2 + 1, n_u) and (..., n_y)."""
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


def _side_by_side(X: Array) -> Array:
    """Mean over the periods, (M, n_u, P, F, n) -> (M, F, n, n_u): the experiments of a realization as columns."""
    return np.moveaxis(X.mean(axis=2), 1, -1)


def _find_lines(U: Array) -> Array:
    """Harmonics at which every input is excited, from spectra (M, n_u, P, F, n_u) that start at frequency zero."""
    n_periods = U.shape[2]
    power = np.mean(np.abs(U.mean(axis=2)) ** 2, axis=(0, 1))
    limit = EXCITED**2 * power[1:].max(axis=0, initial=0.0) * np.ones_like(power)
    if n_periods > 1:
        noise = np.mean(np.var(U, axis=2, ddof=1), axis=(0, 1)) / n_periods
        smooth = np.stack([moving_mean(x, 10) for x in noise.T], axis=1)
        limit = np.maximum(limit, 20 * smooth)
    excited = np.all(power > limit, axis=1)
    excited[0] = False
    return np.flatnonzero(excited)


def moving_mean(x: Array, half: int) -> Array:
    """Mean over the neighbours up to `half` away, along the first axis, fewer at the ends."""
    total = np.concatenate([np.zeros((1, *x.shape[1:])), np.cumsum(x, axis=0)])
    k = np.arange(len(x))
    first, last = np.maximum(k - half, 0), np.minimum(k + half + 1, len(x))
    return (total[last] - total[first]) / (last - first).reshape(-1, *(1,) * (x.ndim - 1))
