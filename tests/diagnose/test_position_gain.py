"""A stage as its user writes it, without ports: its force constant falls with the stroke, its damper has two sides."""

import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Recording, Simulator, laws

STAGE = Simulator(
    lambda x, u, p: {"pos": x.vel, "vel": (p.K * u.current - p.d * x.vel - p.k * x.pos) / 0.09},
    lambda x: {"stroke": 1e3 * x.pos},
    states=("pos", "vel"),
    inputs=("current",),
    parameters={
        "K": Parameter(6.6, bounds=(2, 20)),
        "d": Parameter(1.3, bounds=(0, 20)),
        "k": Parameter(800.0, bounds=(200, 3000)),
    },
)


def recording(law, samples=900):
    rng = np.random.default_rng(3)
    current = 0.12 * pilfr.multisine(samples, f_max=40, fs=1000, rng=rng) / 0.3
    r = Recording(current, np.zeros(samples), 1e-3, ("current",), ("stroke",), hold="zero", initial="zero")
    true = STAGE.with_parameters({"K": Parameter(7.5), "d": Parameter(1.1), "k": Parameter(900.0)})
    y = true.with_element("equation:vel", law).simulate(r)
    return r.with_(y=y + 0.003 * np.std(y) * rng.standard_normal(y.shape))


@pytest.mark.slow
def test_a_force_constant_that_varies_with_the_position_is_named():
    hidden = laws.scaled(laws.QuadraticStiffness, "current")().at({"k_2": 1.2e6})
    tried = (laws.QuadraticStiffness, laws.CubicStiffness, laws.CoulombFriction)
    found = pilfr.diagnose(STAGE, recording(hidden), laws=tried, effects=1, workers=1)
    (effect,) = found.effects
    assert (effect.law, effect.form) == ("quadratic_stiffness", "scaled by current"), str(found)
    assert effect.parameters["k_2"]["value"] == pytest.approx(1.2e6, rel=0.03)
    assert "where w is subtracted from the derivative of vel and z the local" in str(found)


GALVANOMETER = Simulator(
    lambda x, u, p: {"angle": x.rate, "rate": 1e4 * (p.K * u.current - p.k * x.angle) - p.d * x.rate},
    lambda x: {"angle": x.angle},
    states=("angle", "rate"),
    inputs=("current",),
    parameters={
        "K": Parameter(30.0, bounds=(5, 100)),
        "k": Parameter(34.0, bounds=(5, 100)),
        "d": Parameter(120.0, bounds=(0, 2000)),
    },
    ports=Port("flexure", into={"rate": -1.0}, across=lambda x: x.angle, rate=lambda x: x.rate),
)


@pytest.mark.slow
def test_a_weak_effect_that_imitates_a_varying_gain_beside_a_saturation_gives_way_to_it():
    rng = np.random.default_rng(1)
    current = pilfr.multisine(2400, f_max=300, fs=1e4, rng=rng)
    current *= 1.7 / np.std(current)
    r = Recording(current, np.zeros(2400), 1e-4, ("current",), ("angle",), hold="zero", initial="zero")
    true = GALVANOMETER.with_parameters({"K": Parameter(32.0), "k": Parameter(32.0), "d": Parameter(160.0)})
    true = true.with_element("actuator:current", laws.SoftSaturation().at({"L": 2.2}))
    y = true.with_element("flexure", laws.scaled(laws.QuadraticStiffness, "current")().at({"k_2": 3200.0})).simulate(r)
    r = r.with_(y=y + 0.008 * np.std(y) * rng.standard_normal(y.shape))
    tried = (laws.SoftSaturation, laws.CubicStiffness, laws.QuadraticStiffness)
    found = pilfr.diagnose(GALVANOMETER, r, laws=tried, workers=1)
    assert {(e.law, e.form) for e in found.effects} == {
        ("saturation", "soft"),
        ("quadratic_stiffness", "scaled by current"),
    }, str(found)


def test_values_that_can_be_identified_only_together_have_no_standard_errors():
    hidden = laws.DirectionalDamping().at({"c_1": 0.0, "c_0": 8.0})
    free = STAGE.with_parameters({**STAGE.parameters, "d": Parameter(1.3, bounds=(-50, 50))})  # away from its bounds
    found = pilfr.diagnose(free, recording(hidden), laws=(laws.DirectionalDamping,), effects=1, workers=1)
    (effect,) = found.effects
    assert effect.parameters["c_0"]["value"] == pytest.approx(8.0, rel=0.05), str(found)
    assert effect.parameters["c_0"]["std"] > 0
    assert effect.parameters["c_1"]["std"] is None and found.parameters["d"]["std"] is None
    assert found.parameters["k"]["std"] > 0
