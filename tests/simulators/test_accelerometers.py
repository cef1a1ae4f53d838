"""Outputs that measure a state's derivative, such as accelerations, include the force at a port."""

import casadi as ca
import numpy as np
import pytest
from simulated import outputs_of

import pilfr_casadi as pilfr
from pilfr_casadi import InputError, Parameter, Port, Recording, Simulator
from pilfr_casadi.laws import CoulombFriction, CubicStiffness, ViscousDamping

DT, SAMPLES = 2e-3, 1500
MOUNT = Port("mount", lambda p: {"vel": -1 / p.m}, lambda x: x.pos, lambda x: x.vel, "N", "m")


def acceleration(x, u, p):
    return (u.force - p.k * x.pos - p.d * x.vel) / p.m


def rig(outputs, ports=(MOUNT,), k=8000.0):
    """A mass on a spring and a damper."""
    return Simulator(
        lambda x, u, p: {"pos": x.vel, "vel": acceleration(x, u, p)},
        outputs,
        ("pos", "vel"),
        ("force",),
        {
            "m": Parameter(2.0, "kg", fixed=True),
            "k": Parameter(k, "N/m", (1e3, 2e4)),
            "d": Parameter(8.0, "N s/m", (0, 100)),
        },
        ports,
    )


def factors(simulator):
    """Effect of a unit force at the first port on each state's derivative and output."""
    x, u, p, t = simulator.symbols()
    found = simulator.into(simulator.all_ports()[0], x, u, p, t)
    vector = ca.vertcat(*p._values.values())
    values = [float(v.value) for v in simulator.parameters.values()]
    return {name: float(ca.Function("f", [vector], [factor])(values)) for name, factor in found.items()}


def by_formula(x, u, p):
    return {"acc": acceleration(x, u, p)}


def in_gravities(x, u, p):
    return {"acc": (p.k * x.pos + p.d * x.vel - u.force) / (-9.81 * p.m)}  # in another order


def by_rates(x, dx):
    return {"acc": dx.vel}


def force_cell(x, p, dx):
    return {"acc": p.m * dx.vel}


@pytest.mark.parametrize(
    ("outputs", "factor"),
    [(by_formula, -0.5), (in_gravities, -0.5 / 9.81), (by_rates, -0.5), (force_cell, -1.0)],
    ids=lambda v: getattr(v, "__name__", ""),
)
def test_an_accelerometer_feels_the_force_at_a_port(outputs, factor):
    assert factors(rig(outputs)) == pytest.approx({"acc": factor, "vel": -0.5})


def test_without_declared_ports_it_does_as_well():
    simulator = rig(by_formula, ports=())
    x, u, p, t = simulator.symbols()
    assert {k: float(v) for k, v in simulator.into(simulator.port("equation:vel"), x, u, p, t).items()} == {
        "vel": -1.0,
        "acc": -1.0,
    }


def test_what_the_port_says_itself_stands():
    port = Port("mount", {"vel": -0.5, "acc": 3.0}, lambda x: x.pos, lambda x: x.vel)
    assert factors(rig(by_formula, (port,))) == {"vel": -0.5, "acc": 3.0}


@pytest.mark.parametrize(
    "outputs",
    [
        lambda x: {"y": x.pos},
        lambda x: {"y": 2 * x.vel},  # the derivative of the position, but no force changes it at once
        lambda x, p: {"y": p.k * x.pos + p.d * x.vel},  # what the spring and the damper transmit
        lambda x, u, p: {"y": (u.force - p.k * x.pos) / p.m},
    ],
    ids=["position", "speed", "transmitted force", "another formula"],
)
def test_other_outputs_do_not(outputs):
    assert set(factors(rig(outputs))) == {"vel"}


def test_a_decay_is_no_multiple_of_its_state():
    """dT/dt = -T: an output T or -T measures the state, not its derivative."""
    for sign in (1, -1):
        cooling = Simulator(
            lambda x: {"T": -x.T},
            lambda x, sign=sign: {"y": sign * x.T},
            ("T",),
            ports=Port("wall", {"T": 1.0}, lambda x: x.T),
        )
        assert factors(cooling) == {"T": 1.0}


def test_outputs_are_linear_in_dx():
    with pytest.raises(InputError, match="not linear in dx"):
        rig(lambda x, dx: {"power": dx.vel**2})


def blank(seed=0):
    u = 40.0 * pilfr.multisine(SAMPLES, f_max=40.0, fs=1 / DT, rng=np.random.default_rng(seed))
    return Recording(u, np.zeros(SAMPLES), DT, ("force",), ("acc",), hold="zero", initial="zero")


def with_law(outputs):
    return rig(outputs).with_element("mount", CubicStiffness().at({"k_3": 4e7}))


def test_the_ways_to_write_an_acceleration_simulate_alike():
    own = Port("mount", lambda p: {"vel": -1 / p.m, "acc": -1 / p.m}, lambda x: x.pos, lambda x: x.vel)
    named = rig(by_formula, (own,)).with_element("mount", CubicStiffness().at({"k_3": 4e7}))
    r = blank()
    expected = outputs_of(named, r, substeps=8)
    for outputs in (by_formula, by_rates):
        y = outputs_of(with_law(outputs), r, substeps=8)
        np.testing.assert_allclose(y, expected, atol=1e-12 * np.std(expected))
    assert np.std(expected - outputs_of(rig(by_formula), r, substeps=8)) > 0.1 * np.std(expected)


@pytest.mark.slow
def test_a_stiffening_mount_is_found_by_an_accelerometer():
    rng = np.random.default_rng(5)
    recordings = []
    for seed in (1, 2):
        y = outputs_of(with_law(by_formula), blank(seed), substeps=8)
        recordings.append(blank(seed).with_(y=y + 3e-3 * np.std(y) * rng.standard_normal(y.shape)))
    laws = (CubicStiffness, CoulombFriction, ViscousDamping)
    found = pilfr.diagnose(rig(by_formula, k=7000.0), recordings[0], test=recordings[1], laws=laws, workers=1)
    assert [(e.port, e.law) for e in found.effects] == [("mount", "cubic_stiffness")] and found.effects[
        0
    ].confidence > 0.9
    assert found.errors["test"]["after"] < 4e-3
