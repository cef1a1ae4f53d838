"""Compliances and gaps that a simulator takes for rigid: a joint seen on its far side, laws in line with a term."""

from dataclasses import replace

import numpy as np
import pytest
from cart import GROUND, cart

from pilfr_casadi import InputError, Parameter, Port, Recording, Simulator, diagnose, multisine
from pilfr_casadi.diagnose.arguments import add_scaled_laws
from pilfr_casadi.laws import (
    Compliance,
    CoulombFriction,
    ElasticDrive,
    ElasticDriveSeenAtLoad,
    ElasticJoint,
    LineGap,
    Local,
    seen_by,
)
from problems import elastic_joint, loose_mount

MOUNT = {"m": 2.0, "k": 1000.0, "d": 20.0, "k_3": 1e6}
RIGID = {"J": 0.02, "d": 0.0, "F_c": 0.0, "T": 0.003}


def test_a_joint_seen_on_its_far_side_follows_a_motor_and_a_link_on_a_spring():
    true = {"J": 0.02, "d": 0.2, "F_c": 0.3, "T": 0.003}
    stiffness, damping, share = 12.0, 0.05, 0.4
    elastic = {**true, "J": true["J"] / (1 - share)}  # the law's mass stands behind the simulator's
    link = true["J"] / (1 - share) * share
    record = elastic_joint._run(elastic, (stiffness, damping, share), "link", np.random.default_rng(1))
    resonance = np.sqrt(stiffness / link)
    law = ElasticJoint().at({"k_a": stiffness, "W": resonance, "D": damping / (2 * resonance * link)})
    rigid = elastic_joint.simulator(true, "link")
    assert rigid.with_element("joint", law).nrmse(record) < 2 * elastic_joint.NOISE
    assert rigid.nrmse(record) > 0.1


def test_a_joint_is_no_elastic_one_where_no_output_reads_its_coordinate():
    plain = elastic_joint.simulator({"J": 0.02, "d": 0.2, "F_c": 0.3, "T": 0.003}, "link")
    port = plain.ports[0]
    assert plain.shown_states(port) == ("angle", "speed")
    assert plain.shown_states(plain.port("sensor:link")) is None
    hidden = Simulator(
        plain.dynamics, lambda x: {"torque": x.torque}, plain.states, plain.inputs, plain.parameters, plain.ports
    )
    assert hidden.shown_states(port) is None
    with pytest.raises(InputError, match="no output reads"):
        hidden.with_element("joint", ElasticJoint())
    relative = Port("between", port.into, lambda x: x.angle - x.torque, lambda x: x.speed)
    assert plain.shown_states(relative) is None


@pytest.mark.slow
def test_the_links_speed_tells_of_an_elastic_joint():
    rig, train, test = elastic_joint.recorded(1, True)
    found = diagnose(rig, train, test=test)
    assert [(e.port, e.law, e.form) for e in found.effects] == [("joint", "extra_mode", "elastic joint")]
    assert found.errors["test"]["after"] < 2 * elastic_joint.NOISE


@pytest.mark.parametrize(
    ("kind", "extra", "law"), [("gap", 2e-3, LineGap().at({"g": 2e-3})), ("bracket", 2e3, Compliance().at({"k": 2e3}))]
)
def test_a_law_in_line_with_a_spring_of_any_curve_follows_the_truth(kind, extra, law):
    record, rig = loose_mount.run(MOUNT, kind, extra, np.random.default_rng(2)), loose_mount.simulator(MOUNT)
    # a damper sets in over a share of the gap, as a contact does
    assert rig.with_element("mount", law).nrmse(record) < (0.02 if kind == "gap" else 2 * loose_mount.NOISE)
    assert rig.nrmse(record) > 0.1


@pytest.mark.parametrize(
    ("seen", "kind"), [pytest.param("motor", ElasticDrive, marks=pytest.mark.slow), ("link", ElasticDriveSeenAtLoad)]
)
def test_a_rotor_before_a_joint_is_a_mass_behind_it(seen, kind):
    """Without friction, the motor and the link may change places."""
    stiffness, damping, share = 12.0, 0.05, 0.4
    record = elastic_joint._run({**RIGID, "J": 0.05}, (stiffness, damping, share), seen, np.random.default_rng(1))
    rotor = 0.05 * (1 - share)
    plain = elastic_joint.simulator({**RIGID, "J": 0.05 * share}, seen)
    drive = replace(plain.ports[0], term=lambda x: -x.torque)
    resonance = np.sqrt(stiffness / rotor)
    law = kind().at({"k": stiffness, "W": resonance, "D": damping / (2 * resonance * rotor)})
    elastic = replace(plain, ports=(drive,)).with_element("joint", law)
    assert elastic.nrmse(record) < 2 * elastic_joint.NOISE


def axis(sensors, **options):
    """A rigid axis: a torque moves one inertia; `sensors` are its outputs."""
    port = Port("axis", lambda p: {"speed": -1 / p.J}, lambda x: x.angle, lambda x: x.speed, "N m", "rad", **options)
    return Simulator(
        lambda x, u, p: {"angle": x.speed, "speed": (u.torque - p.d * x.speed) / p.J},
        lambda x: {name: x.angle for name in sensors},
        states=("angle", "speed"),
        inputs=("torque",),
        parameters={"J": Parameter(0.02, bounds=(1e-3, 0.2)), "d": Parameter(0.1, bounds=(0, 2))},
        ports=port,
        units={"torque": "N m"},
    )


def recorded_axis(sensors, seed=1, samples=3000):
    """A motor, a spring and a load with dry friction: motor 8e-3, load 12e-3 kg m^2, 12 N m/rad, 0.2 N m."""
    u = 2 * multisine(samples, f_max=25.0, fs=250.0, rng=np.random.default_rng(seed))
    blank = Recording(u, np.zeros((samples, len(sensors))), 0.004, ("torque",), sensors, initial="zero", hold="zero")
    law = ElasticDrive if len(sensors) == 1 else seen_by(ElasticDrive, sensors[0])
    drive = law().at({"k": 12.0, "W": np.sqrt(12 / 8e-3), "D": 0.03})
    friction = CoulombFriction().at({"F_c": 0.2, "v_0": 0.05})
    true = axis(sensors).with_parameters({"J": 0.012}).with_element("axis", drive).with_element("axis", friction)
    y = true.simulate(blank)
    return blank.with_(y=y + 1e-3 * np.std(y, axis=0) * np.random.default_rng(seed + 1).standard_normal(y.shape))


def test_the_force_of_a_drive_is_found_in_the_equations():
    own, given = axis(("motor",)), axis(("motor",), term=lambda u: -u.torque)
    port, declared = own.port("axis"), given.port("axis")
    assert port.found and not declared.found
    alike = [
        s.with_element("axis", ElasticDrive().at({"k": 12.0, "W": 40.0, "D": 0.05})).simulate(recorded_axis(("motor",)))
        for s in (own, given)
    ]
    assert np.allclose(*alike, rtol=1e-9)
    assert port.admits(ElasticDrive) and not port.admits(LineGap)  # it does not vary with the coordinate
    with pytest.raises(InputError, match="names none"):
        own.with_element("axis", LineGap())
    lagged = elastic_joint.simulator({"J": 0.02, "d": 0.2, "F_c": 0.3, "T": 0.003}, "link")
    assert lagged.port("joint").found  # by a state that only the input moves
    assert not cart(ports=(replace(GROUND, domain="electrical"),)).port("ground").found


def test_the_motion_of_the_ground_is_no_drive():
    rig = cart()
    moved = replace(rig, units={"force": "m"}, ports=(GROUND,))
    assert rig.port("ground").found and not moved.port("ground").found


def test_one_of_two_sensors_is_on_the_far_side():
    rig, record = axis(("motor", "load")), recorded_axis(("motor", "load"))
    assert rig.readers(rig.port("axis")) == ("motor", "load")
    motor, load = record.y.T
    assert np.std(motor - load) > 0.005 * np.std(load)
    tried = [law.form for law in add_scaled_laws((ElasticDrive,), rig)]
    assert tried == ["elastic drive", "elastic drive, seen by load", "elastic drive, seen by motor"]
    assert [law.form for law in add_scaled_laws((ElasticDrive,), axis(("motor",)))] == ["elastic drive"]
    assert seen_by(ElasticDrive, "load").strength == ElasticDrive.strength  # the force is not linear in k
    with pytest.raises(InputError, match="laws that outputs see"):
        seen_by(LineGap, "motor")


@pytest.mark.slow
@pytest.mark.xfail(reason="without a controller the axis drifts, and the search along the free run misses the drive")
def test_an_elastic_drive_with_friction_is_named_without_a_term():
    sensors = ("motor",)
    found = diagnose(axis(sensors), recorded_axis(sensors), test=recorded_axis(sensors, seed=5))
    assert {(e.port, e.law) for e in found.effects} == {("axis", "coulomb_friction"), ("axis", "extra_mode")}
    assert found.errors["test"]["after"] < 2e-3


def test_a_term_is_there_with_its_sign_and_laws_in_line_want_one():
    rig = loose_mount.simulator(MOUNT)
    port = rig.ports[0]
    assert port.admits(LineGap) and not replace(port, term=None).admits(LineGap)
    with pytest.raises(InputError, match="names none"):
        replace(rig, ports=(replace(port, term=None),)).with_element("mount", LineGap())
    with pytest.raises(InputError, match="other sign"):
        replace(rig, ports=(replace(port, term=lambda z, p: -p.k * z),))
    with pytest.raises(InputError, match="give a function"):
        replace(port, term=3.0)


def test_a_law_in_line_says_why_a_term_is_none_for_it():
    t = np.linspace(0, 9, 300)
    local = Local(np.sin(t), np.cos(t), t[1], (300,), readers=("z",))
    spring, drive = (replace(local, term=term) for term in (lambda z, dz: 5 * z, lambda z, dz: np.sin(3 * t)))
    damped, curved = (replace(local, term=term) for term in (lambda z, dz: 5 * z + dz, lambda z, dz: z + dz**3))
    assert "names no term" in LineGap().why_not(local)
    assert not LineGap().why_not(spring) and not ElasticDrive().why_not(drive) and not Compliance().why_not(damped)
    assert "does not vary" in LineGap().why_not(drive) and "varies" in ElasticDrive().why_not(spring)
    assert "no damper" in Compliance().why_not(spring) and "not linear" in Compliance().why_not(curved)


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(loose_mount.KINDS))
def test_a_loose_mount_is_told_from_a_soft_bracket_and_a_tight_one(kind):
    rig, train, test = loose_mount.recorded(0, kind)
    found = diagnose(rig, train, test=test)
    law = loose_mount.KINDS[kind]
    assert [(e.port, e.law) for e in found.effects] == ([("mount", law)] if law else [])
    assert found.errors["test"]["after"] < 2 * loose_mount.NOISE
