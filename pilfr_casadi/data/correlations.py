"""Correlations of residuals with themselves and with inputs, in standard deviations of pure chance.

If a residual e is independent of an input u, their correlation at a lag is normal with the variance

    1/N Σ_k ρ_e(k) ρ_u(k),

with the autocorrelations ρ of both (Ljung 1999, System Identification, sec. 16.6). The residual of a free-run
simulation is coloured even for a perfect model, since it holds the noise of the output; it may then still not depend on
the input, nor on the input's square (Billings & Voon 1986, International Journal of Control 44).
"""

from __future__ import annotations

import numpy as np

from .._base import InputError, whole

BAND = 2.5758  # standard deviations that a normal value exceeds in 1 of 100 cases
Array = np.ndarray


def correlation(a: Array, b: Array, lags: int) -> Array:
    """Return the correlation of a(t + k) with b(t), both (M,), for k = -lags ... lags, (2 lags + 1,).

    Raises
    ------
    InputError
        If the lags are not a whole number below the number of samples, or a signal is constant.
    """
    if whole(lags, "lags", 1) >= len(a):
        raise InputError(f"lags={lags} were asked of {len(a)} samples; give fewer.")
    a, b = a - np.mean(a), b - np.mean(b)
    size = float(np.sqrt((a @ a) * (b @ b)))
    if not size > 0:
        raise InputError("a signal that never changes has no correlation; leave it out.")
    length = 2 ** int(np.ceil(np.log2(len(a) + lags + 1)))
    product = np.fft.irfft(np.fft.rfft(a, length) * np.conj(np.fft.rfft(b, length)), length)
    return np.concatenate([product[-lags:], product[: lags + 1]]) / size


def chance(a: Array, b: Array, lags: int) -> float:
    """Return the standard deviation of the correlation of two independent signals (M,) with their own colours.

    The sum over the autocorrelations takes `lags` lags, tapered to zero there, so that their noise does not add up.
    """
    taper = np.bartlett(2 * lags + 3)[1:-1]
    together = float(np.sum(taper * correlation(a, a, lags) * correlation(b, b, lags)))
    return float(np.sqrt(max(together, 1.0 / len(a)) / len(a)))
