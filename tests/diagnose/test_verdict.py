"""The verdict in words, and offsets beside it."""

from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis_rig import recordings, rig

from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.correction import Correction
from pilfr_casadi.diagnose.offsets import Offset, without_idle_offsets
from pilfr_casadi.diagnose.verdict import _describe_vanished, closest_law
from pilfr_casadi.laws import CoulombFriction


def test_only_what_is_the_users_own_is_told_to_come_out_as_zero():
    """An offset that was looked for is none of it."""
    offset = SimpleNamespace(prefix="actuator:u.", law=SimpleNamespace(id="offset"))
    drag = SimpleNamespace(prefix="guide.", law=SimpleNamespace(id="coulomb_friction"))
    own = SimpleNamespace(parameters=dict.fromkeys(("d", "actuator:u.w_0", "guide.F_c")), elements=(offset, drag))
    before, after = (SimpleNamespace(fitted=SimpleNamespace(values=dict.fromkeys(own.parameters, v))) for v in (1, 0))
    search = SimpleNamespace(bench=SimpleNamespace(simulator=own), root=before)
    found = SimpleNamespace(effects=("a law",), best=after)
    assert _describe_vanished(search, found) == " Beside it, d and guide.F_c come out as zero."


@pytest.mark.parametrize("offset", [0.0, 3.0])
def test_an_offset_that_earns_nothing_beside_a_law_is_held_at_nothing(offset):
    placed = rig().with_element("actuator:force", Offset())
    law = CoulombFriction().at({"F_c": 4.0, "v_0": 0.01}, {"v_0": (1e-4, 1.0), "F_c": (0.0, np.inf)})
    train = [r.with_(u=r.u - offset) for r in recordings(law.at({"F_c": 4.0, "v_0": 0.01}), count=1)]
    bench = Workbench.of(placed, train, "zero")
    fitted = bench.fit(placed.with_element("ground-m1", law), [{"actuator:force.w_0": 2.0}])
    found = without_idle_offsets(bench, fitted)
    assert bool(np.all(found.simulator.parameters["actuator:force.w_0"].fixed)) is (offset == 0)
    assert found.values["actuator:force.w_0"] == pytest.approx(offset, abs=0.02 * offset)
    assert found.values["ground-m1.F_c"] == pytest.approx(4.0, rel=0.03)


def test_a_refit_that_was_compared_with_nothing_is_not_said_to_predict_best():
    shares = {"named": 0.0, "learned": 0.0, "left": 1.0}
    assert "no time left to compare" in Correction((), shares).sentence
    assert "nothing that was tried" in Correction((), shares, before=0.1, after=0.1).sentence


def test_the_closest_law_is_the_one_that_promises_most():
    """A delay that explains nothing may be the likeliest where hardly any sample counts."""
    cube, delay = (SimpleNamespace(laws=("law",), ms=ms) for ms in (0.5, 1.0))
    search = SimpleNamespace(memo={0: SimpleNamespace(laws=(), ms=1.1), 1: delay, 2: cube})
    search.optimistic_evidence = lambda t: -t.ms
    assert closest_law(search, delay) is cube
