"""A correction without a sure name grows by further laws as long as that predicts better."""

import numpy as np
from diagnosis_example import LAWS, recorded, rig

import pilfr_casadi as pilfr
from pilfr_casadi.diagnose.correction import find_unnamed_correction
from pilfr_casadi.laws import CubicStiffness, Saturation


def test_a_correction_grows_as_long_as_that_predicts_better():
    true = rig().with_element("ground", LAWS["ground"]).with_element("actuator:force", LAWS["actuator:force"])
    train, laws = recorded(true, 0, samples=500), (CubicStiffness, Saturation)
    search = pilfr.diagnose(rig(430.0, 5.0), train, laws=laws, effects=1, workers=1).evidence.search
    alone, _ = find_unnamed_correction(search)
    search.most_effects = np.inf
    grown, _ = find_unnamed_correction(search)
    assert len(alone.closest.effects) == 1 and len(grown.closest.effects) == 2
    assert grown.after < alone.after
