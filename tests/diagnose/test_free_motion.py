"""Without an input that changes, a constant load acts like an offset, and no clock is wrong against another."""

import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Recording, Simulator
from pilfr_casadi.laws import CoulombFriction

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
