"""Values that are held where a linear law would let them go."""

from dataclasses import replace

import pytest
from diagnosis_rig import OFF, recordings, rig

import pilfr_casadi as pilfr
from pilfr_casadi.report.diagnosis_tables import headline


@pytest.mark.parametrize(("held", "words"), [({"fixed": True}, "held at"), ({"bounds": (1200, 9000)}, "by its bounds")])
def test_a_value_that_is_held_is_told_in_place_of_a_spring(held, words):
    simulator = rig(OFF)
    p = simulator.parameters
    found = pilfr.diagnose(simulator.with_parameters({**p, "k1": replace(p["k1"], **held)}), recordings())
    assert (found.verdict, found.effects) == ("complete", ())
    assert "with k1 = 1" in found.sentence and words in found.sentence
    assert found.let_go == "k1" and "% with k1 let go" in headline(found).replace("\u00a0", " ")
    assert found.parameters["k1"]["refit_with"] == pytest.approx(1100, rel=0.02)
    assert found.errors["train"]["after"] < 0.01 < found.errors["train"]["before"]
