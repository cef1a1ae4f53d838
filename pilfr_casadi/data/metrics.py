"""Errors of a simulated output against a measured one.

The normalised error is Krikelis et al. (2024), Eq. 27: each output is scaled by its own standard deviation,

    e_i = sqrt( 1/M Σ_k ((y_i(k) − ŷ_i(k)) / σ_yi)² ),

averaged over the outputs. A simulation that diverges (infinite or not a number) has an infinite error.

Correlations of residuals with themselves and with inputs are judged in standard deviations of a chance correlation. If
a residual e is independent of an input u, their correlation at a lag is normal with the variance

    1/N Σ_k ρ_e(k) ρ_u(k),

with the autocorrelations ρ of both (Ljung 1999, System Identification, sec. 16.6). The residual of a free-run
simulation is coloured even for a perfect model, since it has the noise of the output; but it must not depend on the
input, nor on the input's square (Billings & Voon 1986, International Journal of Control 44).
"""

from collections.abc import Sequence

import numpy as np

from .._base import InputError, is_whole, whole

CONSTANT_ERROR = 0.99  # NRMSE above which a simulation is no better than a constant, whose NRMSE is 1
DIVERGING = 1e4  # NRMSE from which tables and pages only say that a simulation diverges
BAND = 2.5758  # standard deviations that a normal value exceeds in 1 of 100 cases
NOTHING_SENTENCE = "The model explains nothing of the training recordings: it is no better than a constant."


def rmse_per_output(y: np.ndarray, y_hat: np.ndarray, skip: int = 0) -> np.ndarray:
    """Return the root mean square error of each output, in the unit of that output.

    Parameters
    ----------
    y : array, (M, n_y) or (M,)
        Measured outputs.
    y_hat : array, of the shape of `y`
        Simulated outputs.
    skip : int
        Leading samples that are not scored.

    Returns
    -------
    errors : array, (n_y,)
        Infinite for an output whose simulation is not finite.

    Raises
    ------
    InputError
        If shapes differ, no sample is left after `skip`, or `y` is not finite.
    """
    measured, simulated = _scored_samples(y, y_hat, skip)
    with np.errstate(over="ignore", invalid="ignore"):
        errors = np.sqrt(np.mean((measured - simulated) ** 2, axis=0))
    return np.where(np.isfinite(errors), errors, np.inf)


def rmse(y: np.ndarray, y_hat: np.ndarray, skip: int = 0) -> float:
    """Return the root mean square error, averaged over the outputs; see :func:`rmse_per_output`."""
    return float(np.mean(rmse_per_output(y, y_hat, skip)))


def nrmse(y: np.ndarray, y_hat: np.ndarray, skip: int = 0, resting: np.ndarray | None = None) -> float:
    """Return the error relative to the standard deviation of the output, averaged over outputs.

    Krikelis et al. (2024), Eq. 27; 0 is perfect, 1 is as good as the mean of the output. Parameters are those of
    :func:`rmse_per_output`. An output that never changes is scaled by its entry of `resting`, (n_y,), if given.

    Raises
    ------
    InputError
        As :func:`rmse_per_output`, and if an output is constant and there is no scale for it.
    """
    errors = rmse_per_output(y, y_hat, skip)
    measured, _ = _scored_samples(y, y_hat, skip)
    sigma = measured.std(axis=0)
    constant = sigma <= 1e-14 * np.abs(measured).max(axis=0)
    if resting is not None:
        sigma = np.where(constant, resting, sigma)
    elif np.any(constant):
        raise InputError(
            f"output {int(np.argmax(constant)) + 1} of {len(sigma)} never changes, so it has no error relative to its "
            "standard deviation; leave it out or use rmse."
        )
    return float(np.mean(errors / sigma))


def explains_nothing(errors: Sequence[float]) -> bool:
    """Tell whether the NRMSEs on all recordings are no better than a constant's: `CONSTANT_ERROR` or more."""
    return bool(errors) and min(errors) >= CONSTANT_ERROR


def _scored_samples(y: np.ndarray, y_hat: np.ndarray, skip: int) -> tuple[np.ndarray, np.ndarray]:
    """Check both outputs; return their samples after `skip`, (M, n_y) each."""
    y, y_hat = np.asarray(y, dtype=float), np.asarray(y_hat, dtype=float)
    if y.shape != y_hat.shape or y.ndim not in (1, 2):
        raise InputError(
            f"measured outputs have the shape {y.shape} and simulated ones {y_hat.shape}; give both as "
            "(samples, outputs)."
        )
    if not is_whole(skip, 0, len(y) - 1):
        raise InputError(f"skip is {skip!r} of {len(y)} samples; at least one sample must be scored.")
    measured, simulated = (a[skip:].reshape(len(y) - skip, -1) for a in (y, y_hat))
    if not np.isfinite(measured).all():
        raise InputError("the measured outputs have values that are not finite; repair or cut out that piece.")
    return measured, simulated


def correlation(a: np.ndarray, b: np.ndarray, lags: int) -> np.ndarray:
    """Return the correlation of a(t + k) with b(t), both (M,), for k = -lags ... lags, (2 lags + 1,).

    InputError is raised if the lags are not a whole number below the number of samples, or a signal is constant.
    """
    from scipy.signal import correlate

    if whole(lags, "lags", 1) >= len(a):
        raise InputError(f"lags={lags} was given for {len(a)} samples; give fewer lags than samples.")
    a, b = a - np.mean(a), b - np.mean(b)
    size = float(np.sqrt((a @ a) * (b @ b)))
    if not size > 0:
        raise InputError("a signal that never changes has no correlation; leave it out.")
    return correlate(a, b, method="fft")[len(b) - 1 - lags : len(b) + lags] / size


def chance(a: np.ndarray, b: np.ndarray, lags: int) -> float:
    """Return the standard deviation of the correlation between two independent coloured signals, both (M,).

    The autocorrelations are summed up to `lags` and tapered to zero there, so that their noise does not add up.
    """
    taper = np.bartlett(2 * lags + 3)[1:-1]
    total = float(np.sum(taper * correlation(a, a, lags) * correlation(b, b, lags)))
    return float(np.sqrt(max(total, 1.0 / len(a)) / len(a)))
