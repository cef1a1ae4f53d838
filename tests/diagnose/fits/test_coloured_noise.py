"""Coloured noise as an autoregression, and laws against it."""

import numpy as np
import pytest
from scipy.signal import lfilter
from tank import tank

import pilfr_casadi as pilfr
from pilfr_casadi import Recording
from pilfr_casadi.diagnose.fits.coloured_noise import log_likelihood, whiten, whitening_filters
from pilfr_casadi.laws import TwoStageRelaxation


def slow(pole, length=2000, seed=0, outputs=1):
    rng = np.random.default_rng(seed)
    return lfilter([1], [1, -pole], rng.standard_normal((length + 500, outputs)), axis=0)[500:]


@pytest.mark.parametrize("pole", [0.0, 0.9, 0.99])
def test_the_innovations_of_slow_noise_are_white(pole):
    residuals = [slow(pole, seed=seed) for seed in range(2)]
    filters = whitening_filters(residuals)
    assert len(filters) == 1 and (len(filters[0]) == 1) is (pole == 0)
    white = whiten(np.concatenate(residuals), filters, [2000, 2000])[:, 0]
    inside = white[100:2000]
    assert np.std(inside) == pytest.approx(1.0, rel=0.05)
    assert abs(np.corrcoef(inside[1:], inside[:-1])[0, 1]) < 0.05


def test_each_output_and_each_recording_is_filtered_by_itself():
    both = slow(0.9, outputs=2) * [1.0, 30.0]
    both[:, 1] = np.random.default_rng(1).standard_normal(2000)
    filters = whitening_filters([both])
    assert [len(f) > 1 for f in filters] == [True, False]
    apart = whiten(np.tile(both.reshape(-1, 1), (2, 1)), filters, [2000, 2000])
    once = whiten(both.reshape(-1, 1), filters, [2000])
    assert apart == pytest.approx(np.tile(once, (2, 1)))
    assert not np.any(once.reshape(-1, 2)[: len(filters[0]) - 1, 0])


def test_what_follows_slow_noise_by_chance_is_hardly_likelier():
    """A ramp takes much of the power of a random walk, and little of its innovations; of white noise it is no part."""
    walk, ramp = np.cumsum(slow(0.0), axis=0), np.linspace(-1, 1, 2000)[:, None]
    walk -= np.mean(walk)
    rest = walk - ramp * np.sum(ramp * walk) / np.sum(ramp**2)
    assert np.mean(rest**2) < 0.7 * np.mean(walk**2)
    assert log_likelihood([rest]) - log_likelihood([walk]) < 5
    white = slow(0.0, seed=3)
    assert log_likelihood([white]) - log_likelihood([white + 0.5 * ramp]) > 50


def test_a_short_recording_does_not_hide_the_colour():
    walk, ramp = np.cumsum(slow(0.0), axis=0), np.linspace(-1, 1, 2000)[:, None]
    rest = walk - ramp * np.sum(ramp * walk) / np.sum(ramp**2)
    for short in (slow(0.0, length=9), slow(0.0, length=19)):
        assert log_likelihood([rest, short]) - log_likelihood([walk, short]) < 10


def test_the_level_of_the_noise_may_differ_between_recordings():
    quiet, loud = slow(0.9), slow(0.9, seed=1)
    apart = log_likelihood([quiet, 100 * loud]) - log_likelihood([quiet, loud])
    assert apart == pytest.approx(-2000 * np.log(100), rel=0.01)


def walked(seed, **options):
    """What is told of a slow tank whose sensor walks at random, with creep as the only law."""
    slow_tank, rng = tank(outflow=1e-4), np.random.default_rng(seed)
    u = np.repeat(rng.uniform(1, 5, 40), 30)[:, None]
    blank = Recording(u, u, 2.0, ("pump",), ("level",), initial="estimate", hold="zero")
    y = slow_tank.simulate(blank.with_(initial=[0.3]))
    walk = np.cumsum(rng.standard_normal(y.shape), axis=0) / len(y) ** 0.5
    noisy = blank.with_(y=y + np.std(y) * (0.003 * rng.standard_normal(y.shape) + 0.03 * walk))
    return pilfr.diagnose(slow_tank, noisy, laws=(TwoStageRelaxation,), workers=1, **options)


def test_a_random_walk_of_a_sensor_is_no_creep():
    """Creep would follow it by first states that it never reaches otherwise."""
    found = walked(2, effects=1)
    assert (found.verdict, found.effects) == ("complete", ()), found.sentence


@pytest.mark.slow
def test_hardly_a_random_walk_of_a_sensor_is_creep():
    found = [walked(seed) for seed in range(1, 7)]  # the first resembles the tank's own motions: it stays unexplained
    assert not any(d.effects for d in found), [d.sentence for d in found]
    assert sum(d.verdict == "complete" for d in found) >= 5
