"""Signals of a port's own: the strength of a law may vary with a load, a temperature, or any other expression."""

import casadi as ca
import numpy as np
import pytest

from pilfr_casadi import Parameter, Port, Recording, Simulator, diagnose
from pilfr_casadi._base import InputError
from pilfr_casadi.laws import CoulombFriction, ViscousDamping, scheduled

DT = 0.01


def servo(name="gear", **options):
    port = {
        "into": {"speed": -1.0},
        "across": lambda x: x.angle,
        "rate": lambda x: x.speed,
        "signals": {"load": lambda x, u: ca.fabs(u.torque - 2 * ca.sin(x.angle))},
    }
    return Simulator(
        lambda x, u, p: {"angle": x.speed, "speed": u.torque - 2 * ca.sin(x.angle) - p.d * x.speed},
        lambda x: {"encoder": x.angle},
        states=("angle", "speed"),
        inputs=("torque",),
        parameters={"d": Parameter(0.5, bounds=(0.0, 5.0))},
        ports=(Port(name, **{**port, **options}),),
    )


@pytest.fixture(scope="module")
def recording():
    rng = np.random.default_rng(3)
    t = DT * np.arange(900)
    u = sum(
        a * np.sin(w * t + f) for a, w, f in zip((1.5, 1.0, 0.8), (0.9, 2.3, 5.1), rng.uniform(0, 6, 3), strict=True)
    )
    return Recording(u, 0 * u, DT, ("torque",), ("encoder",), initial="zero", hold="zero")


@pytest.fixture(scope="module")
def loaded(recording):
    """Friction of 0.05 beside a fifth of the load, simulated apart from the package."""
    x, y, h = np.zeros(2), np.zeros(len(recording)), DT / 20

    def flow(x, torque):
        rest = torque - 2 * np.sin(x[0])
        return np.array([x[1], rest - 0.5 * x[1] - (0.05 + 0.2 * abs(rest)) * np.tanh(x[1] / 0.01)])

    for i, torque in enumerate(recording.u[:, 0]):
        y[i] = x[0]
        for _ in range(20):
            k = flow(x, torque)
            x = x + h * flow(x + h / 2 * k, torque)
    return recording.with_(y=y + 1e-4 * np.random.default_rng(4).standard_normal(len(y)))


@pytest.mark.parametrize("name", ["gear", "angle"])  # the name of a state too
def test_a_law_varies_with_a_signal_of_its_port(loaded, name):
    law = scheduled(CoulombFriction, "load")
    values = {"F_c": 0.05, "F_c_high": 0.65, "v_0": 0.01, "low": 0.0, "high": 3.0}
    simulated = servo(name).with_element(name, law().at(values)).simulate(loaded)
    assert np.std(simulated - loaded.y) < 0.01 * np.std(loaded.y)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gear", "angle"])
def test_friction_that_grows_with_the_load_is_named(loaded, name):
    found = diagnose(servo(name), loaded, laws=(CoulombFriction, ViscousDamping), effects=1, workers=1)
    (effect,) = found.effects
    assert (effect.port, effect.law) == (name, "coulomb_friction") and "load" in effect.form
    assert effect.confidence > 0.9
    assert found.errors["train"]["after"] < 0.02 * found.errors["train"]["before"]


def test_a_signal_that_cannot_be_used_is_refused(recording):
    with pytest.raises(InputError, match="`signals` of port 'gear' are"):
        servo(signals={"load": 3.0})
    with pytest.raises(InputError, match="is named 'z'; give a name like 'load'"):
        servo(signals={"z": lambda x: x.angle})
    with pytest.raises(InputError, match="'torque' of port 'gear' has the name of an input"):
        servo(signals={"torque": lambda u: u.torque}).with_element("gear", CoulombFriction()).simulate(recording)
    with pytest.raises(InputError, match="asks for 'w'"):
        servo(signals={"load": lambda w: w}).with_element("gear", CoulombFriction()).simulate(recording)
