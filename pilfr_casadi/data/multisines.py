"""Random-phase multisines, for one input and orthogonal for several.

One period is Krikelis et al. (2024), Eq. 18–19, with k the sample index,

    u(k) = 1/√N Σ_n A_n sin(2π k n / N + φ_n),  n ≤ n_max = round(f_max N / f_s),  φ_n uniform in [0, 2π),

so it has exactly the chosen amplitudes at the bins n and nothing elsewhere. The bin at half the sampling frequency is
left out: a sine there depends on its phase. Grids of odd bins, and of odd bins with one left out at random in every
group of four, tell even from odd nonlinear distortion (Pintelon & Schoukens, System Identification, 2nd ed., 2012,
Ch. 4). Several inputs are excited by orthogonal multisines (Dobrowiecki, Schoukens & Guillaume, IEEE Trans. Instrum.
Meas. 55, 2006), whose input matrix is well conditioned at each bin.
"""

from collections.abc import Callable
from typing import Literal

import numpy as np

from .._base import InputError

Grid = Literal["full", "odd", "odd-random"] | np.ndarray
Amplitude = Callable[[np.ndarray], np.ndarray] | np.ndarray | None
GROUP = 4  # consecutive odd bins of which one is left out in the "odd-random" grid


def excited_bins(
    n_samples: int,
    f_max: float,
    fs: float,
    *,
    f_min: float = 0.0,
    grid: Grid = "full",
    rng: np.random.Generator | None = None,
) -> np.ndarray:
    """Bins ``n`` (frequency ``n fs / n_samples``) that a multisine excites.

    Parameters
    ----------
    n_samples : int
        Samples per period.
    f_max, f_min : float
        Band, Hz; rounded to the nearest bin. Bin 0 and the one at ``fs / 2`` are never excited.
    fs : float
        Sampling frequency, Hz.
    grid : {"full", "odd", "odd-random"} or array of int
        All bins, the odd ones, the odd ones with one left out at random in every group of four, or the bins themselves.
    rng : numpy.random.Generator, optional
        Needed for ``"odd-random"``, which draws from it.

    Returns
    -------
    bins : array of int, sorted

    Raises
    ------
    InputError
        When the band holds no bin or reaches beyond ``fs / 2``, or the grid is unknown.
    """
    if n_samples < 3 or not fs > 0 or not 0 <= f_min <= f_max <= fs / 2:
        raise InputError(
            f"a multisine of {n_samples} samples at {fs:g} Hz cannot excite {f_min:g} to {f_max:g} Hz; choose at least "
            "3 samples and 0 <= f_min <= f_max <= fs/2."
        )
    top = (n_samples - 1) // 2
    if not isinstance(grid, str):
        bins = np.unique(np.asarray(grid, dtype=int))
        if bins.size == 0 or bins[0] < 1 or bins[-1] > top:
            raise InputError(f"the bins of the grid must lie from 1 to {top} for {n_samples} samples; choose those.")
        return bins
    if grid not in ("full", "odd", "odd-random"):
        raise InputError(f"the grid {grid!r} is unknown; use 'full', 'odd', 'odd-random' or an array of bins.")
    low, high = max(1, round(f_min * n_samples / fs)), min(top, round(f_max * n_samples / fs))
    bins = np.arange(low, high + 1)
    if grid != "full":
        bins = bins[bins % 2 == 1]
    if grid == "odd-random":
        if rng is None:
            raise InputError("the grid 'odd-random' is drawn at random; pass rng, a numpy.random.Generator.")
        starts = np.arange(0, len(bins) - GROUP + 1, GROUP)
        bins = np.delete(bins, starts + rng.integers(0, GROUP, len(starts)))
    if bins.size == 0:
        raise InputError(
            f"no bin of the grid {grid!r} lies from {f_min:g} to {f_max:g} Hz; bins are {fs / n_samples:g} Hz apart, "
            "so widen the band or lengthen the period."
        )
    return bins


def multisine(
    n_samples: int,
    f_max: float,
    fs: float,
    rng: np.random.Generator,
    *,
    f_min: float = 0.0,
    amplitude: Amplitude = None,
    grid: Grid = "full",
    periods: int = 1,
    rms: float | None = 1.0,
) -> np.ndarray:
    """Random-phase multisine, Krikelis et al. (2024), Eq. 18–19.

    Parameters
    ----------
    n_samples : int
        Samples per period.
    f_max, fs : float
        Highest excited and sampling frequency, Hz.
    rng : numpy.random.Generator
        Draws the grid, if that is random, then the phases.
    f_min : float
        Lowest excited frequency, Hz.
    amplitude : callable or array, optional
        Amplitude spectrum ``A_n``: a function of frequency in Hz, or one value for each excited bin. Flat by default.
    grid : {"full", "odd", "odd-random"} or array of int
        See :func:`excited_bins`; draw the bins there and pass them here where they must be known.
    periods : int
        Number of periods.
    rms : float, optional
        Root mean square of the signal, reached exactly. ``None`` leaves the scale of Eq. 18.

    Returns
    -------
    u : array, (n_samples * periods,)

    Raises
    ------
    InputError
        When band, grid, amplitude, periods or rms cannot be used.
    """
    bins = excited_bins(n_samples, f_max, fs, f_min=f_min, grid=grid, rng=rng)
    phasors = _amplitudes(bins, n_samples, fs, amplitude, rms) * _random_phasors(rng, bins.shape)
    return np.tile(_from_spectrum(phasors, bins, n_samples), count(periods, "periods"))


def orthogonal_multisine(
    n_u: int,
    n_samples: int,
    f_max: float,
    fs: float,
    rng: np.random.Generator,
    *,
    f_min: float = 0.0,
    amplitude: Amplitude = None,
    grid: Grid = "full",
    periods: int = 1,
    rms: float | None = 1.0,
    matrix: Literal["dft", "hadamard"] = "dft",
) -> np.ndarray:
    """Multisines for several inputs whose spectra are orthogonal over `n_u` experiments.

    At each excited bin the matrix of input spectra (inputs × experiments) is ``U = diag(A e^{jφ}) T`` with ``T`` the
    DFT or Hadamard matrix, so ``U Uᴴ`` is diagonal; each signal by itself is a random-phase multisine.

    Parameters
    ----------
    n_u : int
        Number of inputs, and of experiments.
    n_samples, f_max, fs, rng, f_min, amplitude, grid, periods, rms
        As for :func:`multisine`; all inputs have the same amplitude spectrum.
    matrix : {"dft", "hadamard"}
        ``T``; Hadamard (only changes of sign) needs `n_u` to be a power of two.

    Returns
    -------
    u : array, (n_u, n_samples * periods, n_u)
        Experiments, samples, inputs.

    Raises
    ------
    InputError
        As :func:`multisine`, and when there is no such matrix.
    """
    n_u = count(n_u, "n_u")
    bins = excited_bins(n_samples, f_max, fs, f_min=f_min, grid=grid, rng=rng)
    phasors = _amplitudes(bins, n_samples, fs, amplitude, rms) * _random_phasors(rng, (n_u, bins.size))
    spectra = _orthogonal(n_u, matrix)[:, :, None] * phasors[None, :, :]  # experiments, inputs, bins
    u = np.swapaxes(_from_spectrum(spectra, bins, n_samples), 1, 2)
    return np.tile(u, (1, count(periods, "periods"), 1))


def count(value: int, name: str) -> int:
    """Return a whole number of at least 1, or raise :class:`InputError` naming it."""
    if not isinstance(value, (int, np.integer)) or value < 1:
        raise InputError(f"{name} is {value!r}; give a whole number of at least 1.")
    return int(value)


def _random_phasors(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return np.exp(1j * rng.uniform(0.0, 2.0 * np.pi, shape))


def _amplitudes(bins: np.ndarray, n_samples: int, fs: float, amplitude: Amplitude, rms: float | None) -> np.ndarray:
    """Amplitude of the sine at each bin, (n_bins,)."""
    given = np.ones(bins.size) if amplitude is None else amplitude
    a = np.asarray(given(bins * fs / n_samples) if callable(given) else given, dtype=float)
    if a.shape != bins.shape or not np.isfinite(a).all() or (a < 0).any() or not a.any():
        raise InputError(
            f"the amplitude spectrum has the shape {a.shape} for {bins.size} excited bins; give each one finite "
            "value of at least 0, not all 0."
        )
    if rms is None:
        return a / np.sqrt(n_samples)
    if not rms > 0:
        raise InputError(f"rms is {rms!r}; give a value above zero, or None for the scale of the amplitudes.")
    return a * (rms / np.sqrt(np.sum(a**2) / 2))


def _from_spectrum(phasors: np.ndarray, bins: np.ndarray, n_samples: int) -> np.ndarray:
    """Sum of ``|phasor| sin(2πkn/N + arg phasor)`` over the bins (last axis), one period."""
    spectrum = np.zeros((*phasors.shape[:-1], n_samples // 2 + 1), dtype=complex)
    spectrum[..., bins] = -0.5j * n_samples * phasors
    return np.fft.irfft(spectrum, n_samples)


def _orthogonal(n: int, kind: str) -> np.ndarray:
    if kind == "dft":
        index = np.arange(n)
        return np.exp(2j * np.pi * np.outer(index, index) / n)
    if kind != "hadamard":
        raise InputError(f"the matrix {kind!r} is unknown; use 'dft' or 'hadamard'.")
    if n & (n - 1):
        raise InputError(f"a Hadamard matrix for {n} inputs is not available, only for powers of two; use 'dft'.")
    matrix = np.ones((1, 1))
    while len(matrix) < n:
        matrix = np.kron(matrix, np.array([[1.0, 1.0], [1.0, -1.0]]))
    return matrix
