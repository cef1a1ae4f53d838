"""A law with memory that no reversal shows: it follows any curve, and is not named."""

import numpy as np
import pytest
from cart import cart

from pilfr_casadi import Recording, diagnose
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.linearise import turns_back
from pilfr_casadi.laws import Backlash, CoulombFriction, StopHysteresis
from pilfr_casadi.laws.hysteresis import BoucWen

DT = 0.02


def driven(course, noise=0.0):
    """A recording of the cart along a course of its force, with noise of a share of the output's deviation."""
    u = np.asarray(course, dtype=float)[:, None]
    y = cart().simulate(Recording(u, 0 * u, DT, ("force",), ("pos",), initial="zero", hold="zero"))
    y = y + noise * np.std(y) * np.random.default_rng(0).standard_normal(y.shape)
    return Recording(u, y, DT, ("force",), ("pos",), initial="zero", hold="zero")


UP = np.linspace(0, 40, 1500)  # so slowly that the cart hardly swings
UP_AND_DOWN = np.concatenate([UP[::2], UP[::-2]])


@pytest.mark.parametrize(("course", "turns"), [(UP, False), (UP_AND_DOWN, True)])
def test_a_motion_turns_back_or_not(course, turns):
    r = driven(course)
    bench = Workbench.of(cart(), [r], "zero", "vm")
    fitted = bench.run(bench.simulator, {}, [np.zeros(2)])
    assert [turns_back(bench, fitted, port) for port in ("ground", "actuator:force", "sensor:pos")] == [turns] * 3


@pytest.mark.parametrize("other", [UP_AND_DOWN, UP[::-1] - 60])
def test_several_recordings_may_turn_back_together(other):
    bench = Workbench.of(cart(), [driven(UP), driven(other)], "zero", "vm")
    assert turns_back(bench, bench.run(bench.simulator, {}, [np.zeros(2)] * 2), "actuator:force")


@pytest.mark.parametrize("law", [StopHysteresis, BoucWen, Backlash])
def test_hysteresis_and_backlash_depend_on_reversals_and_friction_does_not(law):
    assert law.turns and not CoulombFriction.turns


@pytest.mark.parametrize(("course", "sure"), [(UP, False), (UP_AND_DOWN, True)])
def test_hysteresis_is_named_only_where_the_motion_turns_back(course, sure):
    r = driven(course)
    stop = StopHysteresis().at({"w": np.full(6, 8.0), "r": np.linspace(0.1, 0.6, 6)})
    y = cart().with_element("ground", stop).simulate(r)
    y = y + 2e-3 * np.std(y) * np.random.default_rng(1).standard_normal(y.shape)
    found = diagnose(cart(), r.with_(y=y), laws=[StopHysteresis], effects=1, workers=1)
    assert (found.verdict == "missing-physics" and found.effects[0].confidence > 0.9) is sure
