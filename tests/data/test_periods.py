"""Periodic recordings: mean period, noise, weights, and whether an input is repeated."""

import numpy as np
import pytest

from pilfr_casadi._base import InputError
from pilfr_casadi.data import (
    Recording,
    group_by_input,
    keeps_its_period,
    mean_period,
    noise_weights,
    period_noise,
    repeats_itself,
)


def noisy(size=0.1, periods=4, level=1.0, seed=0, **options):
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=(500, 1)), level * rng.normal(size=(500, 2)) * [1.0, 5.0]
    y = np.tile(y, (periods, 1)) + size * level * rng.normal(size=(500 * periods, 2)) * [1.0, 5.0]
    return Recording(np.tile(u, (periods, 1)), y, 0.1, period=500, **options)


def test_noise_is_what_differs_between_periods():
    r = noisy(0.1)
    np.testing.assert_allclose(period_noise(r), [0.1, 0.5], rtol=0.05)
    one = mean_period(r)
    assert len(one) == 500 and one.initial == "periodic"
    np.testing.assert_allclose(one.y, r.y.reshape(4, 500, 2).mean(axis=0))
    late = r.with_(skip=500)
    np.testing.assert_allclose(mean_period(late).y, r.y[500:].reshape(3, 500, 2).mean(axis=0))


def test_noisy_recordings_count_less_and_levels_alike():
    quiet, loud, noise = noisy(0.001), noisy(0.001, level=3.0), noisy(0.12)
    weights = noise_weights([quiet, loud, noise], error=0.03)
    assert weights[0] / weights[1] == pytest.approx(3.0, rel=1e-3)
    assert weights[2] / weights[0] == pytest.approx(1 / np.sqrt(1 + (0.06 / 0.03) ** 2), rel=0.1)


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: period_noise(noisy(periods=1)), "has one period"),
        (lambda: mean_period(noisy().with_(period=None)), "period of the recording is not known"),
        (lambda: mean_period(noisy().with_(skip=3)), "1997 steady samples"),
        (lambda: noise_weights(noisy(), error=0.0), "above zero"),
    ],
)
def test_recordings_without_periods_are_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()


def wave(m, seed):
    return np.random.default_rng(seed).normal(size=m)


def driven(u, **options):
    return Recording(u, np.zeros((len(u), 0)), 0.1, **options)


def test_a_repeated_input_is_recognised():
    period = wave(100, 3)
    r = driven(np.tile(period, 3))
    assert repeats_itself(r) and repeats_itself(r.slice(0, 160)) and not repeats_itself(r.slice(0, 140))
    assert repeats_itself(driven(np.sin(0.3 * np.arange(200))))
    assert not repeats_itself(driven(wave(300, 4))) and not repeats_itself(driven(np.ones(50)))
    assert repeats_itself(r.with_(period=100, initial="periodic"))


def test_a_wrong_period_is_recognised():
    r = driven(np.tile(wave(100, 3), 3), period=100, initial="periodic")
    assert keeps_its_period(r) and not keeps_its_period(r.with_(period=90))
    assert keeps_its_period(r.with_(period=90, initial="zero"))


def test_recordings_are_grouped_by_their_input():
    period = wave(100, 3)
    r, other = driven(np.tile(period, 3)), driven(np.tile(wave(100, 4), 3))
    shifted, noisy = driven(np.roll(np.tile(period, 3), 40)), driven(np.tile(period, 2) + 0.005 * wave(200, 5))
    assert group_by_input([r, other, shifted, other.slice(0, 150), noisy]) == [[0, 2, 4], [1, 3]]
