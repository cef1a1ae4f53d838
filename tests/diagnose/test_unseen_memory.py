"""A law with memory that the recordings do not show: it follows any curve, and is not named."""

import numpy as np
import pytest
from cart import cart

from pilfr_casadi import Recording, diagnose
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.fits.force_recovery import is_curve, signals_along
from pilfr_casadi.laws import Backlash, StopHysteresis

DT = 0.02
UP = np.linspace(0, 40, 1500)  # so slowly that the cart hardly swings
UP_AND_DOWN = np.concatenate([UP[::2], UP[::-2]])
CYCLE = 2 * np.sin(2 * np.pi * 0.2 * DT * np.arange(1500))
STEPS = np.repeat([0.0, 10.0, 40.0], 500)
COURSES = {
    "up": ([UP], True),
    "up twice": ([UP, UP / 2], True),
    "steps up": ([STEPS], True),
    "up and down": ([UP_AND_DOWN], False),
    "up, and down": ([UP, UP[::-1]], False),
    "two working points": ([CYCLE, 100 + CYCLE], False),
    "small cycles on a ramp": ([UP + CYCLE], False),
}


def driven(course):
    """A recording of the cart along a course of its force, from rest."""
    u = np.asarray(course, dtype=float)[:, None]
    blank = Recording(u, 0 * u, DT, ("force",), ("pos",), initial="zero", hold="zero")
    return blank.with_(y=cart().simulate(blank))


@pytest.mark.parametrize(("courses", "curve"), COURSES.values(), ids=COURSES)
def test_a_backlash_shows_where_it_turns_by_more_than_its_play(courses, curve):
    simulator = cart().with_element("actuator:force", Backlash().at({"r": 0.5}))
    recordings = [driven(course) for course in courses]
    bench = Workbench.of(simulator, recordings, "zero", "vm")
    z, _, w = signals_along(bench, bench.run(simulator, {}, [np.zeros(2)] * len(recordings)))
    assert is_curve(z, w) is curve


def test_any_curve_is_one_however_often_it_is_passed():
    z = 3 * np.sin(np.linspace(0, 40, 999))
    assert is_curve(z, np.tanh(2 * z)) and is_curve(z, np.abs(z)) and not is_curve(z, np.tanh(2 * np.roll(z, 3)))


def test_a_force_that_depends_on_the_level_before_is_no_curve():
    """A held input has few levels; from one recording to another, the force at one of them differs."""
    z = np.repeat([0.0, -1.0, 0.0, 0.0, 1.0, 0.0], 100)
    w = np.repeat([0.0, -0.8, -0.2, 0.0, 0.8, 0.2], 100)
    rounding = 1e-14 * np.random.default_rng(0).standard_normal(600)
    assert not is_curve(z, w) and not is_curve(z + rounding, w)
    assert is_curve(z, 0.8 * z) and is_curve(z[:300], np.repeat([0.0, -0.8, 0.0], 100))


@pytest.mark.parametrize("period", [25, 25.001])
def test_memory_shows_over_periods_that_repeat(period):
    phase = 2 * np.pi * np.arange(1000) / period
    z, w = np.sin(phase), np.sin(phase - 0.3)
    assert not is_curve(z, w) and is_curve(z, z**3)


@pytest.mark.parametrize(("course", "sure"), [(UP, False), (UP_AND_DOWN, True)])
def test_hysteresis_is_named_only_where_its_memory_shows(course, sure):
    r = driven(course)
    stop = StopHysteresis().at({"w": np.full(6, 8.0), "r": np.linspace(0.1, 0.6, 6)})
    y = cart().with_element("ground", stop).simulate(r)
    y = y + 2e-3 * np.std(y) * np.random.default_rng(1).standard_normal(y.shape)
    found = diagnose(cart(), r.with_(y=y), laws=[StopHysteresis], effects=1, workers=1)
    assert (found.verdict == "missing-physics" and found.effects[0].confidence > 0.9) is sure
