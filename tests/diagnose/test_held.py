"""Values that are held where a linear law would let them go."""

from dataclasses import replace

import pytest
from diagnosis_rig import OFF, recordings, rig

import pilfr_casadi as pilfr
from pilfr_casadi.report.diagnosis_tables import headline


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_value_whose_bounds_are_powers_of_ten_away_is_told_and_no_law_is_named_for_it():
    """As a stiffness in N/mm where the equations take N/m: what is seen cancels the simulator's own outputs."""
    simulator = rig(OFF)
    p = simulator.parameters
    far = replace(p["k1"], value=1.0, bounds=(0.3, 5.0))
    found = pilfr.diagnose(simulator.with_parameters({**p, "k1": far}), recordings())
    assert (found.verdict, found.effects, found.let_go) == ("complete", (), "k1"), str(found)
    assert "by its bounds at 5" in found.sentence
    assert found.parameters["k1"]["refit_with"] == pytest.approx(1100, rel=0.02)
