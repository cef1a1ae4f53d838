"""Answers other than a law at a declared port, on the smallest rigs that have them."""

from dataclasses import replace

import pytest
from diagnosis_rig import OFF, recordings, rig

import pilfr_casadi as pilfr
from pilfr_casadi import laws


def short(*hidden, **options):
    (r,) = recordings(*hidden, count=1, **options)
    return r.slice(0, 1200)


@pytest.mark.parametrize("known", [{"fixed": True}, {"value": 1.0, "bounds": (0.3, 5.0)}], ids=["fixed", "far"])
def test_a_value_that_cannot_go_where_it_should_is_told(known):
    simulator = rig(OFF)
    p = simulator.parameters
    held = simulator.with_parameters({**p, "k1": replace(p["k1"], **known)})
    found = pilfr.diagnose(held, short(), laws=(laws.LinearStiffness,), effects=1, workers=1)
    assert (found.verdict, found.effects, found.let_go) == ("complete", (), "k1"), str(found)
    assert found.parameters["k1"]["refit_with"] == pytest.approx(1100, rel=0.03)


def test_friction_where_no_port_is_declared_is_told_where_it_acts():
    friction = laws.CoulombFriction(values={"F_c": 10.0, "v_0": 0.01})
    full = rig(OFF)
    hidden = short(friction, port="ground-m1")
    found = pilfr.diagnose(
        replace(full, ports=full.ports[1:]), hidden, laws=(laws.CoulombFriction,), effects=1, workers=1
    )
    assert found.verdict == "unexplained" and "no law of the catalogue explains it" in found.sentence
    (note,) = [g for g in found.gates if g.finding == "undeclared"]
    assert (note.channel, note.value, note.corrected) == ("v1", "coulomb friction", False)
