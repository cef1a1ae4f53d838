"""Physics that acts where no port is declared."""

from dataclasses import replace

import pytest
from diagnosis_rig import OFF, recordings, rig

import pilfr_casadi as pilfr
from pilfr_casadi import laws


@pytest.mark.slow
def test_a_law_that_no_declared_port_reaches_is_told_where_it_acts():
    friction = laws.CoulombFriction(values={"F_c": 10.0, "v_0": 0.01})
    full = rig(OFF)
    found = pilfr.diagnose(replace(full, ports=full.ports[1:]), recordings(friction, port="ground-m1", count=1))
    assert found.verdict == "unexplained"
    (note,) = [g for g in found.gates if g.finding == "undeclared"]
    assert (note.channel, note.value, note.corrected) == ("v1", "coulomb friction", False)
    assert "No declared port reaches it" in str(found)
