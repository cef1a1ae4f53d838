"""Excitation signals: random-phase and orthogonal multisines, Tukey-windowed realizations, sine sweeps, and PRBS.

One period of a multisine is Krikelis et al. (2024), Eq. 18–19, with k the sample index,

    u(k) = 1/√N Σ_n A_n sin(2π k n / N + φ_n),  n ≤ n_max = round(f_max N / f_s),  φ_n uniform in [0, 2π),

so it has exactly the chosen amplitudes at the bins n and nothing elsewhere. The bin at half the sampling frequency is
left out, because the size of a sine there depends on its phase. Grids of odd bins, and of odd bins with one left out at
random in every group of four, separate even from odd nonlinear distortion (Pintelon & Schoukens, System Identification,
2nd ed., 2012, Ch. 4). Orthogonal multisines excite several inputs (Dobrowiecki, Schoukens & Guillaume, IEEE Trans.
Instrum. Meas. 55, 2006): their input matrix is well conditioned at each bin.
"""

from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from .._base import InputError, is_whole, numbers, positive, whole

Grid = Literal["full", "odd", "odd-random"] | np.ndarray
Amplitude = Callable[[np.ndarray], np.ndarray] | np.ndarray | None
GROUP = 4  # consecutive odd bins of which one is left out in the "odd-random" grid (Pintelon & Schoukens, 2012)


def excited_bins(
    n_samples: int,
    f_max: float,
    fs: float,
    *,
    f_min: float = 0.0,
    grid: Grid = "full",
    rng: np.random.Generator | None = None,
) -> np.ndarray:
    """Return the bins ``n`` (frequencies ``n fs / n_samples``) that a multisine excites; see :func:`multisine`.

    The band is rounded to the nearest bins; bin 0 and ``fs / 2`` are left out. A random grid is drawn from `rng`.
    """
    n_samples, fs = whole(n_samples, "n_samples", 1), positive(fs, "fs", "the sampling frequency in Hz")
    f_min = positive(f_min, "f_min", "the lowest frequency in Hz", zero=True)
    f_max = positive(f_max, "f_max", "the highest frequency in Hz", zero=True)
    if n_samples < 3 or not 0 <= f_min <= f_max <= fs / 2:
        raise InputError(
            f"a multisine of {n_samples} samples at {fs:g} Hz cannot excite {f_min:g} to {f_max:g} Hz; choose at least "
            "3 samples and 0 <= f_min <= f_max <= fs/2."
        )
    top = (n_samples - 1) // 2
    if not isinstance(grid, str):
        bins = np.unique(numbers(grid, "grid"))
        if bins.size == 0 or bins[0] < 1 or bins[-1] > top or np.any(bins % 1):
            raise InputError(
                f"the bins of the grid must be whole numbers from 1 to {top} for {n_samples} samples; give such bins."
            )
        return bins.astype(int)
    if grid not in ("full", "odd", "odd-random"):
        raise InputError(f"the grid {grid!r} is unknown; use 'full', 'odd', 'odd-random' or an array of bins.")
    low, high = max(1, round(f_min * n_samples / fs)), min(top, round(f_max * n_samples / fs))
    bins = np.arange(low, high + 1)
    if grid != "full":
        bins = bins[bins % 2 == 1]
    if grid == "odd-random":
        if rng is None:
            raise InputError("the grid 'odd-random' is random; pass rng, a numpy.random.Generator.")
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
    """Make a random-phase multisine, Krikelis et al. (2024), Eq. 18–19.

    Parameters
    ----------
    n_samples : int
        Samples per period.
    f_max, fs : float
        Highest excited and sampling frequency, Hz.
    rng : numpy.random.Generator
        Draws the random grid, if any, then the phases.
    f_min : float
        Lowest excited frequency, Hz.
    amplitude : callable or array, optional
        Amplitude spectrum ``A_n``: a function of frequency in Hz, or one value for each excited bin. Flat by default.
    grid : {"full", "odd", "odd-random"} or array of int
        All bins, the odd ones, the odd ones with one left out at random in every group of four, or the bins themselves.
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
        If band, grid, amplitude, periods or rms cannot be used.
    """
    u = orthogonal_multisine(
        1, n_samples, f_max, fs, rng, f_min=f_min, amplitude=amplitude, grid=grid, periods=periods, rms=rms
    )
    return u[0, :, 0]


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
    """Make multisines for several inputs whose spectra are orthogonal over `n_u` experiments.

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
        As :func:`multisine`, or if `matrix` does not exist for `n_u` inputs.
    """
    n_u = whole(n_u, "n_u", 1)
    _check_generator(rng)
    bins = excited_bins(n_samples, f_max, fs, f_min=f_min, grid=grid, rng=rng)
    phases = np.exp(1j * rng.uniform(0.0, 2.0 * np.pi, (n_u, bins.size)))
    phasors = _amplitudes(bins, n_samples, fs, amplitude, rms) * phases
    spectrum = np.zeros((n_u, n_u, n_samples // 2 + 1), dtype=complex)  # experiments, inputs, bins
    spectrum[..., bins] = -0.5j * n_samples * (_orthogonal_matrix(n_u, matrix)[:, :, None] * phasors[None, :, :])
    u = np.swapaxes(np.fft.irfft(spectrum, n_samples), 1, 2)
    return np.tile(u, (1, whole(periods, "periods", 1), 1))


def tukey_realizations(
    n_realizations: int,
    n_period: int,
    f_max: float,
    fs: float,
    rng: np.random.Generator,
    *,
    normalize: Literal["record", "steady"] = "record",
    **options: Any,
) -> np.ndarray:
    """Make the training signal of Krikelis et al. (2024), Sec. 6.2.1: multisine realizations that fade in and out.

    Each realization has 2 `n_period` samples: half a period ramped up, one full steady period, half a period ramped
    down by a Tukey (cosine-tapered) window. It starts and ends at zero, so realizations join without a step.

    Parameters
    ----------
    n_realizations : int
        Number of realizations, each with its own phases (and random grid).
    n_period : int
        Samples per period; even.
    f_max, fs, rng, **options
        As for :func:`multisine`: `f_min`, `amplitude` and `grid`.
    normalize : {"record", "steady"}
        Part that is scaled to unit standard deviation: the whole record, ramps included, or each steady period.

    Returns
    -------
    u : array, (2 * n_period * n_realizations,)

    Raises
    ------
    InputError
        As :func:`multisine`, or for an odd `n_period` or an unknown `normalize`.

    See Also
    --------
    steady_periods : the samples of the steady periods.
    """
    if n_period % 2:
        raise InputError(f"a period of {n_period} samples cannot be halved for the ramps; choose an even n_period.")
    if normalize not in ("record", "steady"):
        raise InputError(f"normalize is {normalize!r}; use 'record' or 'steady'.")
    half = n_period // 2
    ramp = np.sin(0.5 * np.pi * np.arange(half) / half) ** 2
    window = np.concatenate([ramp, np.ones(n_period), 1.0 - ramp])
    pieces = []
    for _ in range(whole(n_realizations, "n_realizations", 1)):
        period = multisine(n_period, f_max, fs, rng, **options)
        pieces.append(window * np.concatenate([period[half:], period, period[:half]]))
    u = np.concatenate(pieces)
    return u / u.std() if normalize == "record" else u


def steady_periods(n_realizations: int, n_period: int) -> tuple[slice, ...]:
    """Return the samples of the steady periods of :func:`tukey_realizations`, one slice for each realization."""
    starts = [2 * n_period * i + n_period // 2 for i in range(n_realizations)]
    return tuple(slice(start, start + n_period) for start in starts)


def sine_sweep(
    f0: float, f1: float, fs: float, *, rate: float | None = None, duration: float | None = None, amplitude: float = 1.0
) -> np.ndarray:
    """Make a sine whose frequency changes linearly, ``amplitude · sin(2π (f0 t + (f1 − f0) t² / 2T))``.

    Parameters
    ----------
    f0, f1 : float
        Frequencies at start and end, Hz; `f1` may be below `f0`.
    fs : float
        Sampling frequency, Hz.
    rate, duration : float
        Magnitude of the sweep rate in Hz/s, or the duration ``T`` in s; give one of them.
    amplitude : float
        Peak of the sine.

    Returns
    -------
    u : array, (round(T * fs),)

    Raises
    ------
    InputError
        If not exactly one of `rate` and `duration` is given, or a value cannot be used.
    """
    if (rate is None) == (duration is None):
        raise InputError("a sine sweep needs its rate in Hz/s or its duration in s; give exactly one of them.")
    if not fs > 0 or not (0 <= f0 <= fs / 2 and 0 <= f1 <= fs / 2) or (rate is not None and f0 == f1):
        raise InputError(
            f"a sweep from {f0:g} to {f1:g} Hz cannot be sampled at {fs:g} Hz; choose two frequencies from 0 to fs/2."
        )
    length = abs(f1 - f0) / rate if rate else duration
    if length is None or not np.isfinite(length) or round(length * fs) < 2:
        raise InputError(
            f"rate {rate} or duration {duration} gives no sweep; choose one above zero, of two samples or more."
        )
    t = np.arange(round(length * fs)) / fs
    return amplitude * np.sin(2 * np.pi * (f0 * t + 0.5 * (f1 - f0) / length * t**2))


def prbs(
    n_samples: int, rng: np.random.Generator, *, order: int | None = None, hold: int = 1, amplitude: float = 1.0
) -> np.ndarray:
    """Make a maximum-length pseudo-random binary sequence that starts at a random state.

    Parameters
    ----------
    n_samples : int
        Samples to make; the sequence repeats after ``hold * (2**order - 1)``.
    rng : numpy.random.Generator
        Draws the start.
    order : int, optional
        Length of the shift register, 2 to 32; by default the shortest that does not repeat within `n_samples`.
    hold : int
        Samples for which each value is held.
    amplitude : float
        The values are ``±amplitude``.

    Returns
    -------
    u : array, (n_samples,)

    Raises
    ------
    InputError
        If a value cannot be used.
    """
    from scipy.signal import max_len_seq

    _check_generator(rng)
    n_values = -(-whole(n_samples, "n_samples", 1) // whole(hold, "hold", 1))
    if order is None:
        order = max(2, int(n_values).bit_length())
    if not is_whole(order, 2, 32):
        raise InputError(f"the order of the binary sequence is {order!r}; give a whole number from 2 to 32.")
    seed = int(rng.integers(1, 2**order))
    state = np.array([seed >> i & 1 for i in range(order)], dtype=np.int8)
    values, _ = max_len_seq(order, state=state, length=n_values)
    return numbers(amplitude, "amplitude", ()) * np.repeat(2.0 * values - 1.0, hold)[:n_samples]


def _check_generator(rng: Any) -> None:
    if not isinstance(rng, np.random.Generator):
        raise InputError(f"rng={rng!r} was given; give a generator, such as numpy.random.default_rng(1).")


def _amplitudes(bins: np.ndarray, n_samples: int, fs: float, amplitude: Amplitude, rms: float | None) -> np.ndarray:
    """Return the amplitude of the sine at each bin, (n_bins,)."""
    given = np.ones(bins.size) if amplitude is None else amplitude
    a = numbers(given(bins * fs / n_samples) if callable(given) else given, "amplitude")
    if a.shape != bins.shape or (a < 0).any() or not a.any():
        raise InputError(
            f"the amplitude spectrum has the shape {a.shape} for {bins.size} excited bins; give each bin one "
            "value of at least 0, not all 0."
        )
    if rms is None:
        return a / np.sqrt(n_samples)
    positive(rms, "rms", "the root mean square of the signal (None for the scale of the amplitudes)")
    return a * (rms / np.sqrt(np.sum(a**2) / 2))


def _orthogonal_matrix(n: int, kind: str) -> np.ndarray:
    """Return the DFT or the Hadamard matrix, (n, n)."""
    if kind == "dft":
        index = np.arange(n)
        return np.exp(2j * np.pi * np.outer(index, index) / n)
    if kind != "hadamard":
        raise InputError(f"the matrix {kind!r} is unknown; use 'dft' or 'hadamard'.")
    if n & (n - 1):
        raise InputError(f"a Hadamard matrix for {n} inputs is not available, only for powers of two; use 'dft'.")
    from scipy.linalg import hadamard

    return np.asarray(hadamard(n, dtype=float))
