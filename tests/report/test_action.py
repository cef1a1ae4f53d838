"""The element of a fitted simulator that an effect is."""

import numpy as np
from diagnosis_rig import recordings, rig

from pilfr_casadi.diagnose import Effect, Workbench
from pilfr_casadi.diagnose.offsets import Offset
from pilfr_casadi.laws import CoulombFriction
from pilfr_casadi.report.diagnosis_tables import element_of


def test_an_effect_is_found_behind_an_offset():
    simulator = rig().with_element("actuator:force", Offset()).with_element("ground-m1", CoulombFriction({"F_c": 1.0}))
    fitted = Workbench.of(simulator, recordings(count=1), "zero").run(simulator, {}, [np.zeros(4)])
    here, elsewhere = (Effect(port, "coulomb_friction", 0.9, "", "", {}, ()) for port in ("ground-m1", "m1-m2"))
    assert element_of(fitted, here) == 1
    assert element_of(fitted, elsewhere) is None
