"""How a search is begun anew, with the other hold or without a shift, and what an interrupt on the way leaves."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis_rig import OFF, recordings, rig
from test_timing import shaken, spring

import pilfr_casadi as pilfr
from pilfr_casadi import InputError, laws
from pilfr_casadi._base import Stages
from pilfr_casadi.diagnose import pipeline
from pilfr_casadi.diagnose.floor import Floor
from pilfr_casadi.diagnose.hypotheses import UntilInterrupted
from pilfr_casadi.diagnose.preparation import Prepared
from pilfr_casadi.diagnose.verdict import Verdict


def a_request(hold=None):
    """A diagnosis of two effects, of nothing in particular."""
    return pipeline.Request(
        SimpleNamespace(hold=None), (), (), hold, "auto", 1, 2, 0.0, np.inf, Stages(lambda *_: None), "simulation"
    )


@pytest.mark.parametrize("said", [None, "zero"])
def test_how_inputs_are_held_is_asked_of_the_data_unless_it_is_said(said):
    found = pilfr.diagnose(spring(), shaken("linear", m=1200), hold=said, laws=())
    assert found.hold == (said or "linear")
    assert (found.errors["train"]["after"] < 1e-3) is (said is None)


@pytest.mark.parametrize(("nearer", "interrupted"), [(True, False), (False, False), (True, True)])
def test_what_seems_early_beside_something_unexplained_is_searched_as_it_is(monkeypatch, nearer, interrupted):
    early_or_not = []
    gates = (SimpleNamespace(finding="alignment", value=-0.1),)

    class Unsure:
        def __init__(self, *given, **more):
            self.interrupted, self.out_of_time = interrupted, False
            whole = 1.0 if early_or_not[-1] else 0.1 if nearer else 0.9
            self.best = SimpleNamespace(mean_square=whole)

        def run(self, effects):
            return self

        def can_improve(self, trial):
            return True

        def until_interrupted(self):
            return UntilInterrupted(self)

    def prepare(*given, early, say):
        early_or_not.append(early)
        bench = SimpleNamespace(scale=np.ones(1))
        floor = Floor(np.zeros(1), "periods")
        return Prepared(bench, None, 0.0, gates if early else (), floor)

    monkeypatch.setattr(pipeline, "prepare", prepare)
    monkeypatch.setattr(pipeline, "Search", Unsure)
    ready, _ = pipeline._search(a_request())
    assert early_or_not == ([True] if interrupted else [True, False])
    assert ready.gates == (() if nearer and not interrupted else gates)


class Searched:
    """A finished search, as far as the choice of a hold reads it."""

    def __init__(self, whole, interrupted=False, fits=3):
        self.best, self.interrupted, self.out_of_time = SimpleNamespace(mean_square=whole), interrupted, False
        self.bench = SimpleNamespace(with_other_hold=lambda: SimpleNamespace(hold="linear"))
        self.memo = dict.fromkeys(range(fits))

    def other_hold_fits_better(self):
        return True

    def until_interrupted(self):
        return UntilInterrupted(self)

    def resume(self, effects):
        return self


@pytest.mark.parametrize(
    ("again", "taken"),
    [
        (Searched(0.5), True),
        (Searched(1.5), False),
        (Searched(0.5, interrupted=True, fits=1), False),
        (InputError("it cannot be run so"), False),
    ],
)
def test_the_search_with_the_other_hold_is_taken_where_it_comes_nearer(monkeypatch, again, taken):
    first, ready = Searched(1.0), SimpleNamespace(gates=())

    def searched(one):
        if one.hold is None:
            return ready, first
        if isinstance(again, InputError):
            raise again
        return SimpleNamespace(gates=()), again

    monkeypatch.setattr(pipeline, "stated_hold", lambda *given: given[2])
    monkeypatch.setattr(pipeline, "_search", searched)
    monkeypatch.setattr(pipeline, "hold_note", lambda *given: given[1])
    monkeypatch.setattr(pipeline, "replace", lambda of, **more: SimpleNamespace(**{**vars(of), **more}))
    prepared, search = pipeline._search_both_holds(a_request())
    assert search is (again if taken else first)
    assert prepared.gates == (("linear",) if taken else ())
    assert search.interrupted is getattr(again, "interrupted", False)


@pytest.mark.parametrize("unfinished", [False, True])
def test_an_answer_that_is_there_outlives_an_interrupt_of_what_adds_to_it(monkeypatch, unfinished):
    def interrupted(search):
        search.interrupted = True
        return ()

    best = SimpleNamespace(fitted=None, mean_square=1.0)
    search = SimpleNamespace(interrupted=unfinished, out_of_time=False, past_deadline=False, bench=None, root=best)
    answer = SimpleNamespace(best=best, sure=0.0, effects=())
    monkeypatch.setattr(pipeline, "posterior", lambda search: answer)
    monkeypatch.setattr(pipeline, "named_correction", lambda *given: None)
    monkeypatch.setattr(pipeline, "tones", lambda *given: ())
    monkeypatch.setattr(pipeline, "judge", lambda *given: Verdict("unexplained", "Something is missing."))
    monkeypatch.setattr(pipeline, "find_pinned_parameters", lambda *given: None)
    monkeypatch.setattr(pipeline, "clipped_input", lambda *given: None)
    monkeypatch.setattr(pipeline, "mean_nrmse", lambda *given: 0.5)
    monkeypatch.setattr(pipeline, "find_undeclared_port", interrupted)
    monkeypatch.setattr(pipeline, "find_untried_laws", lambda search: ())
    monkeypatch.setattr(pipeline, "find_varying_values", lambda search: ())
    found = pipeline.conclude(search, ())
    assert search.interrupted and found.verdict.kind == "unexplained"
    assert ("interrupted before" in found.verdict.sentence) == unfinished


def test_two_effects_at_two_ports_are_both_named():
    one = laws.CubicStiffness(values={"k_3": 4e5})
    true = [("ground-m1", one), ("m1-m2", laws.CoulombFriction(values={"F_c": 4.0, "v_0": 0.01}))]
    whole = recordings_of(true)[0]
    tried = (laws.CubicStiffness, laws.CoulombFriction)
    found = pilfr.diagnose(rig(OFF), whole.slice(0, 700), test=whole.slice(700, 1100), laws=tried, workers=1)
    assert {(e.port, e.law) for e in found.effects} == {(port, law.id) for port, law in true}, str(found)
    assert min(e.confidence for e in found.effects) > 0.8
    assert found.errors["train"]["after"] < 1.2 * found.floor["nrmse"]
    # each by itself leaves most of the error on the test recording
    assert min(e.test_without for e in found.effects) > 3 * found.errors["test"]["after"]


def recordings_of(placed):
    """A recording of the rig with laws at several ports."""
    true = rig()
    for port, law in placed[:-1]:
        true = true.with_element(port, law)
    port, law = placed[-1]
    return recordings(law, port=port, count=1, of=true)


@pytest.mark.parametrize(
    "missing", [(), (laws.CoulombFriction().at({"F_c": 40.0, "v_0": 0.02}),)], ids=["none", "friction"]
)
def test_a_simulator_without_a_free_parameter_is_diagnosed(missing):
    held = rig()
    held = held.with_parameters({name: replace(p, fixed=True) for name, p in held.parameters.items()})
    record = recordings(*missing, count=1)[0].slice(0, 700)
    tried = [laws.CoulombFriction, laws.CubicStiffness]
    found = pilfr.diagnose(held, record, workers=1, laws=tried, effects=1)
    named = [(e.port, e.law) for e in found.effects]
    assert named == ([("ground-m1", "coulomb_friction")] if missing else [])
    assert found.verdict == ("missing-physics" if missing else "complete")
