"""Compliances and gaps that a simulator takes for rigid: a joint seen on its far side, laws in line with a term."""

from dataclasses import replace

import numpy as np
import pytest

from pilfr_casadi import InputError, Port, Simulator, diagnose
from pilfr_casadi.laws import Compliance, ElasticDrive, ElasticDriveSeenAtLoad, ElasticJoint, LineGap, Local
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


@pytest.mark.parametrize(("seen", "kind"), [("motor", ElasticDrive), ("link", ElasticDriveSeenAtLoad)])
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
