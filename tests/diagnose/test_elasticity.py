"""Compliances that a simulator takes for rigid: a joint seen on its far side."""

import numpy as np
import pytest

from pilfr_casadi import InputError, Port, Simulator, diagnose
from pilfr_casadi.laws import ElasticJoint
from problems import elastic_joint


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
    with pytest.raises(InputError, match="none reads its coordinate"):
        hidden.with_element("joint", ElasticJoint())
    relative = Port("between", port.into, lambda x: x.angle - x.torque, lambda x: x.speed)
    assert plain.shown_states(relative) is None


@pytest.mark.slow
def test_the_links_speed_tells_of_an_elastic_joint():
    rig, train, test = elastic_joint.recorded(1, True)
    found = diagnose(rig, train, test=test)
    assert [(e.port, e.law, e.form) for e in found.effects] == [("joint", "extra_mode", "elastic joint")]
    assert found.errors["test"]["after"] < 2 * elastic_joint.NOISE
