"""The same filter in all sensors, which no recording tells from one at the actuator."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis_rig import OFF, recordings, rig
from scipy.signal import butter, lfilter

import pilfr_casadi as pilfr
from pilfr_casadi import laws
from pilfr_casadi.compiled import make_engine
from pilfr_casadi.integration import discretise

TRIED = [laws.Lag, laws.Resonance, laws.Delay, laws.CubicStiffness]


def both(simulator):
    """The rig with both positions measured."""
    return replace(simulator, outputs=lambda x: {"x1": x.p1, "x2": x.p2})


def filtered(order, cutoff, outputs=(0, 1)):
    """A recording with the same low-pass filter in some of its two sensors."""
    rng = np.random.default_rng(4)
    (r,) = recordings(count=1, hold="zero")
    model = discretise(both(rig()), r.dt, "zero", 4)
    y = make_engine(model).simulate(model.drive(r), model.parameters.start, np.zeros(model.n_state))[0]
    for i in outputs:
        y[:, i] = lfilter(*butter(order, cutoff, fs=1 / r.dt), y[:, i])
    return r.with_(y=y + 2e-3 * np.std(y, axis=0) * rng.standard_normal(y.shape), outputs=("x1", "x2"))


@pytest.mark.parametrize("order, form", [(1, "lag"), (2, "resonance")])
def test_one_filter_in_all_sensors_is_no_sure_actuator(order, form):
    found = pilfr.diagnose(both(rig(OFF)), filtered(order, 12.0), laws=TRIED)
    (effect,) = found.effects
    assert (effect.law, effect.form) == ("extra_mode", form)
    assert ("sensor:x1 + sensor:x2", "extra_mode") in effect.indistinguishable
    assert effect.confidence == pytest.approx(0.5, abs=0.05)
    assert "every sensor has the same (sensor:x1 + sensor:x2)" in found.sentence
    ports = [port for port, _ in found.next_experiment["between"]]
    assert ports == ["actuator:force", "sensor:x1 + sensor:x2"]


def test_a_filter_in_one_sensor_of_two_is_told_from_that():
    found = pilfr.diagnose(both(rig(OFF)), filtered(1, 12.0, [1]), laws=TRIED)
    (effect,) = found.effects
    assert (effect.port, effect.law, effect.indistinguishable) == ("sensor:x2", "extra_mode", ())
    assert effect.confidence > 0.9


def test_what_is_linear():
    assert both(rig()).linear
    assert not replace(rig(), outputs=lambda x: {"x2": x.p2 + x.p2**2}).linear
    assert not replace(rig(), outputs=lambda x, t: {"x2": x.p2 * t}).linear
    assert replace(rig(), outputs=lambda x, t: {"x2": x.p2 + 9.81}).linear
