"""Statistics over machines: what varies, and which machines differ, on drawn populations."""

import json

import numpy as np
import pytest

from pilfr_casadi._base import json_text, to_json
from pilfr_casadi.studies import Population, estimate_population, slope


def drawn(rng, n, mean=100.0, tau=5.0, error=1.0):
    errors = error * rng.uniform(0.5, 1.5, n)
    return mean + tau * rng.standard_normal(n) + errors * rng.standard_normal(n), errors


def test_mean_and_deviation_are_recovered():
    values, errors = drawn(np.random.default_rng(0), 400)
    found = estimate_population(values, errors, 500.0)
    assert found.mean == pytest.approx(100, abs=4 * found.mean_error) and found.mean_error < 0.4
    assert found.deviation == pytest.approx(5.0, rel=0.15) and found.varies > 0.99
    assert found.differs.max() < 0.5 and found.share < 0.02


def test_a_shared_value_has_no_deviation_between_machines():
    wrong = missed = 0
    for seed in range(40):
        values, errors = drawn(np.random.default_rng(seed), 12, tau=0.0)
        wrong += estimate_population(values, errors, 500.0).varies > 0.5
        missed += estimate_population(*drawn(np.random.default_rng(seed), 12, tau=2.0), 500.0).varies < 0.5
    assert wrong <= 6 and missed <= 6


def test_machines_that_differ_stand_out_and_do_not_widen_the_population():
    hits = alarms = total = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        values, errors = drawn(rng, 100)
        values[:4] += rng.choice([-1, 1], 4) * rng.uniform(40, 150, 4)
        found = estimate_population(values, errors, 500.0)
        hits, alarms, total = (
            hits + np.sum(found.differs[:4] > 0.5),
            alarms + np.sum(found.differs[4:] > 0.5),
            total + 96,
        )
        assert found.deviation == pytest.approx(5.0, rel=0.35)
    assert hits == 80 and alarms <= 0.005 * total


def test_units_and_origin_do_not_matter():
    values, errors = drawn(np.random.default_rng(3), 30)
    values[7] += 60
    one = estimate_population(values, errors, 500.0)
    other = estimate_population(1e-6 * (values - 40), 1e-6 * errors, 500.0e-6)
    assert np.allclose(one.differs, other.differs, atol=1e-5) and one.differs[7] > 0.99
    assert other.mean == pytest.approx(1e-6 * (one.mean - 40), rel=1e-6)


def test_an_uncertain_value_does_not_differ_and_a_missing_one_is_left_out():
    values, errors = drawn(np.random.default_rng(4), 20)
    values[0], errors[0] = 300.0, 400.0
    values[1] = np.nan
    found = estimate_population(values, errors, 500.0)
    assert found.differs[0] < 0.2 and np.isnan(found.differs[1]) and np.isfinite(found.mean)


def test_four_machines_are_enough_for_a_gross_difference_only():
    found = estimate_population([100.0, 103.0, 98.0, 240.0], np.ones(4), 500.0)
    assert found.differs[3] > 0.5 > found.differs[:3].max()
    assert estimate_population([100.0, 103.0, 98.0, 107.0], np.ones(4), 500.0).differs.max() < 0.5


@pytest.mark.parametrize("size", [4, *(pytest.param(size, marks=pytest.mark.slow) for size in (5, 8, 20))])
def test_few_regular_machines_give_few_false_alarms(size):
    """The deviation of few machines is hardly known: a value far out may be one of theirs."""
    alarms = []
    for seed in range(100):
        values, errors = drawn(np.random.default_rng(seed), size)
        alarms.append(estimate_population(values, errors, 500.0).differs.max())
        values[0] += 150.0
        assert estimate_population(values, errors, 500.0).differs[0] > 0.5
    assert np.mean(np.array(alarms) > 0.5) <= 0.05 and max(alarms) < 0.95


def test_a_new_machine_is_judged_as_one_of_the_fleet():
    for size, outlier in ((60, 0.0), (6, 0.0), (6, 60.0), (4, 150.0), (4, 1e6)):
        values, errors = drawn(np.random.default_rng(5), size)
        values[3] += outlier
        found = estimate_population(values, errors, 500.0)
        others = np.arange(size) != 3
        rest = estimate_population(values[others], errors[others], 500.0)
        assert rest.probability(values[3], errors[3], 500.0) == pytest.approx(found.differs[3], abs=0.02)
        assert (found.differs[3] > 0.5) == (outlier > 0)
        mean = np.mean(values[others])
        assert rest.probability(mean, 1.0, 500.0) < 0.05 < 0.5 < rest.probability(mean + 150, 1.0, 500.0)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("width", [0.0, 1e-200, 1e-9, 1e-3, 1.0])
@pytest.mark.parametrize("error", [0.0, 1e-9, 1.0])
def test_widths_may_be_narrow(width, error):
    """Within such a width, a machine that differs looks as a regular one does; the prior of the share is left."""
    for size in (1, 2, 5, 20):
        values, errors = drawn(np.random.default_rng(size), size, error=error)
        found = estimate_population(values, errors, width)
        assert np.all((found.differs >= 0) & (found.differs <= 1)) and 0 <= found.probability(1e3, error, width) <= 1
        if size > 4:
            assert found.differs.max() < 0.1


def test_a_population_is_read_from_its_file():
    found = estimate_population(*drawn(np.random.default_rng(2), 5), 500.0)
    content = json.loads(json_text(to_json(found.to_dict())))
    estimates = [(110.0, 1.0, 500.0), (150.0, 0.0, 500.0), (300.0, 1.0, 500.0), (1e9, 1.0, 1e-3)]
    read = Population.of(content)
    assert [read.probability(*e) for e in estimates] == [found.probability(*e) for e in estimates]
    del content["spread"]  # as older files: only the most probable deviation is known
    old, (value, error, width) = Population.of(content), estimates[0]
    v = found.deviation**2 + found.mean_error**2 + error**2
    ratio = np.sqrt(v / (v + width**2 / 12)) * np.exp(
        0.5 * (value - found.mean) ** 2 * (1 / v - 1 / (v + width**2 / 12))
    )
    odds = ratio * found.share / (1 - found.share)
    assert old.probability(value, error, width) == pytest.approx(odds / (1 + odds), rel=1e-9)
    nothing = Population.of(json.loads(json_text(to_json(estimate_population([np.nan], [1.0], 1.0).to_dict()))))
    assert np.isnan(nothing.mean) and np.isnan(nothing.probability(1.0, 1.0, 1.0))


def test_trends_about_a_known_centre():
    rng = np.random.default_rng(6)
    slopes, errors = 0.02 * rng.standard_normal(50), np.full(50, 0.02)
    slopes[:5] += 0.3
    found = estimate_population(slopes, errors, 5.0, centre=0.0)
    assert np.all(found.differs[:5] > 0.9) and np.sum(found.differs[5:] > 0.5) == 0
    assert found.mean == 0.0 and found.deviation == 0.0
    assert found.probability(0.3, 0.02, 5.0) > 0.9 and found.probability(0.02, 0.02, 5.0) < 0.1


def test_the_slope_has_an_honest_error():
    t, truth, inside = np.arange(6.0), 2.0, 0
    for seed in range(300):
        y = truth * t + 0.5 * np.random.default_rng(seed).standard_normal(6)
        found, error = slope(t, y, np.full(6, 0.5))
        inside += abs(found - truth) < 2 * error
    assert inside > 0.93 * 300
    assert slope(t, truth * t, np.full(6, 0.5))[0] == pytest.approx(truth)
    assert np.isnan(slope(np.zeros(3), np.ones(3), np.ones(3))[0])
