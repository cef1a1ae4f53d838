"""Without an input that changes, a constant load acts like an offset, and no clock is wrong against another."""

import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Recording, Simulator
from pilfr_casadi.laws import CoulombFriction, Relaxation

CAR = Simulator(
    lambda x, p: {"speed": -p.loss * x.speed},
    lambda x: {"speed": x.speed},
    states=("speed",),
    parameters={"loss": Parameter(0.01, "1/s", bounds=(0, 0.2))},
    ports=Port("wheels", {"speed": -1 / 1000}, lambda x: x.speed, unit="N", across_unit="m/s"),
    units={"speed": "m/s"},
)


def coast(friction, m, start=25.0, dt=0.25):
    """A coast-down that ends before the car stands."""
    rubbing = CoulombFriction().at({"F_c": friction, "v_0": 0.01})
    r = Recording(np.empty((m, 0)), np.empty((m, 0)), dt, initial=[start])
    y = CAR.with_parameters({"loss": 0.004}).with_element("wheels", rubbing).simulate(r)
    y = y + 0.02 * np.random.default_rng(0).standard_normal(y.shape)
    return r.with_(y=y, outputs=("speed",), initial="estimate")


@pytest.mark.parametrize(("friction", "m"), [(300.0, 240), (150.0, 300)])
def test_the_dry_friction_of_a_coast_down_is_no_fault_of_the_recording(friction, m):
    found = pilfr.diagnose(CAR, coast(friction, m), laws=("coulomb_friction", "drift", "quadratic_drag"))
    assert not [gate for gate in found.gates if gate.corrected or gate.fault], found
    (effect,) = found.effects
    assert (effect.law, effect.port) == ("coulomb_friction", "wheels")
    assert float(found.corrected.parameters["wheels.F_c"].value) == pytest.approx(friction, rel=0.05)


def test_a_law_that_remembers_is_tried_without_an_input():
    """Its state begins where the machine was before: with no input, a run from rest does not tell where that may be."""
    pendulum = Simulator(
        lambda x, p: {"angle": x.speed, "speed": -(p.w**2) * x.angle - p.d * x.speed},
        lambda x: {"angle": x.angle},
        states=("angle", "speed"),
        parameters={"w": Parameter(5.0, bounds=(3, 9)), "d": Parameter(0.1, bounds=(0, 1))},
        ports=Port("bearing", {"speed": -1.0}, lambda x: x.angle, lambda x: x.speed),
    )
    soft = pendulum.with_element("bearing", Relaxation().at({"k_v": 6.0, "T": 0.5}))
    r = Recording(np.empty((200, 0)), np.empty((200, 0)), 0.03, initial=[0.8, 0.0, 0.0])
    y = soft.simulate(r)
    y = y + 0.002 * np.random.default_rng(0).standard_normal(y.shape)
    r = r.with_(y=y, outputs=("angle",), initial="estimate")
    fitted = pilfr.fit(pendulum, r, starts=1)
    assert fitted.nrmse(r) < 1.5 * fitted.train_nrmse[0]
    found = pilfr.diagnose(pendulum, r, laws=("creep",), effects=1)
    assert any(c["law"] == "creep" for c in found.candidates), found
