"""Physics that acts where no port is declared."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
from diagnosis_rig import OFF, recordings, rig

import pilfr_casadi as pilfr
from pilfr_casadi import laws
from pilfr_casadi.diagnose import conclusion
from pilfr_casadi.diagnose.correction import Correction


@pytest.mark.slow
def test_a_law_that_no_declared_port_reaches_is_told_where_it_acts():
    friction = laws.CoulombFriction(values={"F_c": 10.0, "v_0": 0.01})
    full = rig(OFF)
    found = pilfr.diagnose(replace(full, ports=full.ports[1:]), recordings(friction, port="ground-m1", count=1))
    assert found.verdict == "unexplained"
    (note,) = [g for g in found.gates if g.finding == "undeclared"]
    assert (note.channel, note.value, note.corrected) == ("v1", "coulomb friction", False)
    assert "No declared port reaches it" in str(found)


@pytest.mark.parametrize("unfinished", [False, True])
def test_an_answer_that_is_there_outlives_an_interrupt_of_what_adds_to_it(monkeypatch, unfinished):
    def interrupted(search):
        search.interrupted = True
        return ()

    refit = Correction((), {"named": 0.0, "learned": 0.0, "left": 1.0})
    search = SimpleNamespace(interrupted=unfinished, bench=None, without=None)
    monkeypatch.setattr(conclusion, "judge", lambda *given: ("unexplained", "Something is missing."))
    monkeypatch.setattr(conclusion, "find_correction", lambda search: (refit, None))
    monkeypatch.setattr(conclusion, "as_named", lambda *given: refit)
    monkeypatch.setattr(conclusion, "held_value", lambda search: None)
    monkeypatch.setattr(conclusion, "clipped_input", lambda *given: None)
    monkeypatch.setattr(conclusion, "mean_nrmse", lambda *given: 0.5)
    monkeypatch.setattr(conclusion, "beyond_the_ports", interrupted)
    monkeypatch.setattr(conclusion, "varying", lambda search: ())
    found = conclusion.concluded(search, ())
    assert search.interrupted and found.verdict == "unexplained"
    assert ("interrupted before" in found.sentence) == unfinished
