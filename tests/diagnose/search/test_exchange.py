"""Two effects whose ports are taken for each other's by the first, which is chosen while the second is missing."""

import numpy as np
import pytest
from simulated import outputs_of

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Simulator, laws

DT, SAMPLES = 4e-3, 3000


def _dynamics(x, u, p):
    belt = p.k * (x.a - x.b) + p.d * (x.va - x.vb)
    return {
        "a": x.va,
        "va": (u.force - p.ca * x.va - p.kr * x.a - belt) / p.J,
        "b": x.vb,
        "vb": (belt - p.cb * x.vb) / p.m,
    }


def drive(m, k, d, ca, cb, kr):
    """A motor that pulls a carriage by a belt."""
    return Simulator(
        _dynamics,
        lambda x: {"motor": x.a, "carriage": x.b},
        states=("a", "va", "b", "vb"),
        inputs=("force",),
        parameters={
            "J": Parameter(1.6, unit="kg", fixed=True),
            "m": Parameter(m, unit="kg", bounds=(1, 8)),
            "k": Parameter(k, unit="N/m", bounds=(5e3, 1e5)),
            "d": Parameter(d, unit="N s/m", bounds=(0, 500)),
            "ca": Parameter(ca, unit="N s/m", bounds=(0, 200)),
            "cb": Parameter(cb, unit="N s/m", bounds=(0, 200)),
            "kr": Parameter(kr, unit="N/m", bounds=(5, 500)),
        },
        ports=(
            Port("pulley", lambda p: {"va": -1 / p.J}, lambda x: x.a, lambda x: x.va, "N", "m"),
            Port("rail", lambda p: {"vb": -1 / p.m}, lambda x: x.b, lambda x: x.vb, "N", "m"),
        ),
    )


def recorded(seed):
    """A recording of the drive with an uneven pulley and a rail that rubs."""
    rng = np.random.default_rng(seed)
    true = drive(3.1, 2.2e4, 30.0, 9.0, 4.0, 60.0)
    true = true.with_element("pulley", laws.PeriodicForce(values={"a": 1.22, "b": 1.03, "L": 2 * np.pi * 0.012}))
    true = true.with_element("rail", laws.CoulombFriction(values={"F_c": 3.2, "v_0": 2e-3}))
    t, f = np.arange(SAMPLES) * DT, np.linspace(0.1, 6, 60)
    u = np.sum(np.sin(2 * np.pi * f * t[:, None] + rng.uniform(0, 2 * np.pi, 60)), axis=1)
    u = 11 * u / np.std(u)
    blank = pilfr.Recording(
        u, np.zeros((SAMPLES, 2)), DT, ("force",), ("motor", "carriage"), initial="zero", hold="zero"
    )
    y = outputs_of(true, blank, substeps=12)
    return blank.with_(y=y + 4e-3 * np.std(y, axis=0) * rng.standard_normal(y.shape))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 6])  # at each other's ports, and both at the pulley
def test_laws_that_follow_better_at_other_ports_go_there(seed):
    simulator = drive(2.8, 2e4, 25.0, 8.0, 5.0, 66.0)
    found = pilfr.diagnose(simulator, recorded(seed), laws=[laws.CoulombFriction, laws.PeriodicForce])
    assert {(e.port, e.law) for e in found.effects} == {("rail", "coulomb_friction"), ("pulley", "periodic_force")}
    assert found.errors["train"]["after"] < 1.1 * found.floor["nrmse"]
    assert min(e.confidence for e in found.effects) > 0.8


@pytest.mark.slow
def test_a_law_that_only_asks_for_finer_steps_is_no_effect():
    """A sharp dead zone of interpolated inputs needs fine steps; a fast mode beside it only has them."""
    rng = np.random.default_rng(1)
    t, f = np.arange(SAMPLES) * DT, np.linspace(0.3, 12, 50)
    u = 3 * np.sum(np.sin(2 * np.pi * f * t[:, None] + rng.uniform(0, 2 * np.pi, 50)), axis=1) / 5
    blank = pilfr.Recording(u, np.zeros(SAMPLES), DT, ("force",), ("pos",), initial="zero", hold="linear")
    mass = Simulator(
        lambda x, u, p: {"x": x.v, "v": u.force - p.k * x.x - p.d * x.v},
        lambda x: {"pos": x.x},
        states=("x", "v"),
        inputs=("force",),
        parameters={"k": Parameter(5e3, bounds=(2e3, 1e4)), "d": Parameter(3.0, bounds=(0, 30))},
        ports=(Port("ground", {"v": -1.0}, lambda x: x.x, lambda x: x.v, "N", "m"),),
    )
    true = mass.with_element("actuator:force", laws.DeadZone(values={"g": 1.2}))
    y = outputs_of(true, blank, "linear", 40)
    recording = blank.with_(y=y + 2e-4 * np.std(y) * rng.standard_normal(y.shape))
    found = pilfr.diagnose(mass, recording, laws=[laws.DeadZone, laws.Mode, laws.Attached], workers=1)
    assert [(e.port, e.law) for e in found.effects] == [("actuator:force", "dead_zone")]
    assert found.errors["train"]["after"] < 5e-4
