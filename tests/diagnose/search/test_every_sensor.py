"""The same filter in all sensors, which no recording tells from one at the actuator."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis_rig import OFF, recordings, rig
from scipy.signal import butter, lfilter
from simulated import outputs_of

import pilfr_casadi as pilfr
from pilfr_casadi import laws

TRIED = [laws.Lag, laws.Resonance, laws.Delay, laws.CubicStiffness]


def both(simulator):
    """The rig with both positions measured."""
    return replace(simulator, outputs=lambda x: {"x1": x.p1, "x2": x.p2})


def filtered(order, cutoff, outputs=(0, 1), law=None):
    """A recording with the same low-pass filter in some of its two sensors, and a law between ground and m1."""
    rng = np.random.default_rng(4)
    (r,) = recordings(count=1, hold="zero")
    true = both(rig()) if law is None else both(rig()).with_element("ground-m1", law)
    y = outputs_of(true, r, substeps=8)
    for i in outputs:
        y[:, i] = lfilter(*butter(order, cutoff, fs=1 / r.dt), y[:, i])
    return r.with_(y=y + 2e-3 * np.std(y, axis=0) * rng.standard_normal(y.shape), outputs=("x1", "x2"))


@pytest.mark.slow
@pytest.mark.parametrize("order, form", [(1, "lag"), (2, "resonance")])
def test_one_filter_in_all_sensors_is_no_sure_actuator(order, form):
    found = pilfr.diagnose(both(rig(OFF)), filtered(order, 12.0), laws=TRIED)
    (effect,) = found.effects
    assert (effect.law, effect.form) == ("extra_mode", form)
    assert ("sensor:x1 + sensor:x2", "extra_mode") in effect.indistinguishable
    assert "sensor:x1 + sensor:x2" in str(found)
    assert "between" in found.next_experiment


@pytest.mark.slow
def test_a_filter_in_one_sensor_of_two_is_told_from_that():
    found = pilfr.diagnose(both(rig(OFF)), filtered(1, 12.0, [1]), laws=TRIED)
    (effect,) = found.effects
    assert (effect.port, effect.law, effect.indistinguishable) == ("sensor:x2", "extra_mode", ())
    assert effect.confidence > 0.9


@pytest.mark.slow
def test_beside_friction_filters_in_all_sensors_are_told_from_one_at_the_actuator():
    friction = laws.CoulombFriction(values={"F_c": 10.0, "v_0": 0.01})
    tried = [laws.Lag, laws.Resonance, laws.CoulombFriction]
    found = pilfr.diagnose(both(rig(OFF)), filtered(2, 12.0, law=friction), laws=tried)
    named = {(e.port, e.law) for e in found.effects}
    assert named == {("sensor:x1", "extra_mode"), ("sensor:x2", "extra_mode"), ("ground-m1", "coulomb_friction")}
    assert found.errors["train"]["after"] < 1.2 * found.floor["nrmse"]
    for e in (e for e in found.effects if e.law == "extra_mode"):
        assert e.parameters["W"]["value"] == pytest.approx(2 * np.pi * 12, rel=0.05)
