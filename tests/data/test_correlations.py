"""Residual tests keep their promise: 1 of 100 chance values beyond the band, and a dependence is seen."""

import numpy as np
import pytest
from scipy.signal import lfilter

from pilfr_casadi import InputError
from pilfr_casadi.data import BAND, chance, correlation


def test_a_correlation_is_that_of_shifted_samples():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 500))
    found = correlation(a, b, 3)
    a, b = a - a.mean(), b - b.mean()
    assert found[3 + 2] == pytest.approx(a[2:] @ b[:-2] / np.sqrt((a @ a) * (b @ b)))
    assert found[3 - 1] == pytest.approx(a[:-1] @ b[1:] / np.sqrt((a @ a) * (b @ b)))
    assert correlation(a, a, 3)[3] == pytest.approx(1.0)


@pytest.mark.parametrize("pole", [0.0, 0.9], ids=["white", "coloured"])
def test_one_of_a_hundred_independent_values_is_beyond_the_band(pole):
    rng = np.random.default_rng(1)
    beyond = []
    for _ in range(60):
        e, u = lfilter([1.0], [1.0, -pole], rng.normal(size=(2, 2000)), axis=1)
        beyond.append(np.mean(np.abs(correlation(e, u, 100) / chance(e, u, 100)) > BAND))
    assert 0.004 < np.mean(beyond) < 0.02


def test_a_dependence_on_the_input_or_its_square_is_seen():
    rng = np.random.default_rng(2)
    u, noise = rng.normal(size=(2, 2000))
    assert np.argmax(np.abs(correlation(np.roll(u, 7) + noise, u, 50) / chance(noise, u, 50))) == 50 + 7
    square = (u - u.mean()) ** 2
    e = np.roll(square, 3) + noise
    assert np.max(np.abs(correlation(e, square, 20))) / chance(e, square, 20) > 5


def test_signals_without_a_correlation_are_refused():
    with pytest.raises(InputError, match="never changes"):
        correlation(np.ones(50), np.arange(50.0), 5)
    with pytest.raises(InputError, match="lags=60 was given for 50 samples"):
        correlation(np.arange(50.0), np.arange(50.0), 60)
