"""What was accepted, looked at again: a strength beside what it is traded for, and laws that a second effect hid."""

from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis_rig import DT, recordings, rig

import pilfr_casadi as pilfr
from pilfr_casadi.diagnose import Workbench, preparation, review, search_start
from pilfr_casadi.diagnose.choice import Choice
from pilfr_casadi.diagnose.first_effect import led_out
from pilfr_casadi.diagnose.floor import Floor
from pilfr_casadi.diagnose.proof import deviations, shown
from pilfr_casadi.diagnose.rivals import WIDER, rivals_beside
from pilfr_casadi.diagnose.screen import Scored
from pilfr_casadi.diagnose.search import Pass, Search
from pilfr_casadi.diagnose.search_start import Asked
from pilfr_casadi.laws import (
    CATALOGUE,
    Attached,
    CoulombFriction,
    CubicStiffness,
    Local,
    Mode,
    PreslidingStribeckFriction,
    Relaxation,
    StribeckFriction,
)
from pilfr_casadi.optimise import GaussNewton


@pytest.fixture(scope="module")
def relaxed():
    """A slow relaxation, fitted beside the spring that its stiffness can be traded for."""
    law = Relaxation().at({"k_v": 400.0, "T": 1.0})
    bench = Workbench.of(rig(), recordings(law, port="m1-m2", count=1, noise=2e-2), "zero")
    placed = rig().with_element("m1-m2", law.at(law.values, {"T": (5 * DT, 10.0)}))
    return bench, bench.fit(placed, [{}])


def test_a_strength_that_is_plain_to_see_is_shown_though_it_can_be_traded(relaxed):
    bench, fitted = relaxed
    prefix = fitted.simulator.elements[-1].prefix
    alone = fitted.values[f"{prefix}k_v"] / deviations(bench, fitted)[f"{prefix}k_v"]
    assert shown(bench, fitted) > 3 * alone


def test_nothing_is_not_shown():
    law = Relaxation().at({"k_v": 1.0, "T": 1.0}, {"T": (5 * DT, 10.0)})
    bench = Workbench.of(rig(), recordings(None, count=1, noise=2e-2), "zero")
    assert shown(bench, bench.fit(rig().with_element("m1-m2", law), [{}])) < 3


def _scored(port, kind):
    z = np.sin(np.linspace(0, 20, 400))
    local = Local(z, np.gradient(z, DT), DT, (400,))
    start = {name: 0.1 for name in kind.units}
    return Scored(port, kind(), 0.5, (start,), local, 1.0)


def _at_its_values(simulator):
    return SimpleNamespace(simulator=simulator, values={k: p.value for k, p in simulator.parameters.items()})


@pytest.fixture
def searched():
    """Dry friction at one port, a second effect at the other; and what the screen scored of the first."""
    winner = SimpleNamespace(port="ground-m1", law=CoulombFriction())
    fitted = SimpleNamespace(port="ground-m1", law=PreslidingStribeckFriction(), fitted=None)
    scored = [_scored(port, kind) for port in ("m1-m2", "ground-m1") for kind in CATALOGUE if "parallel" in kind.places]
    fitted.fitted = _at_its_values(rig().with_element("ground-m1", fitted.law))
    both = rig().with_element("ground-m1", CoulombFriction()).with_element("m1-m2", CubicStiffness())
    first = SimpleNamespace(choice=SimpleNamespace(winner=winner), candidates=(winner, fitted), scored=tuple(scored))
    return SimpleNamespace(passes=[first, None], bench=SimpleNamespace(simulator=rig()), base=_at_its_values(both))


def test_a_wider_law_that_the_screen_did_not_let_through_is_put_up_beside_a_second_effect(searched):
    kept = searched.base.simulator.elements[-1]
    before, *wider = rivals_beside(searched, rig(), kept)
    assert isinstance(before.element.law, PreslidingStribeckFriction)
    assert 1 <= len(wider) <= WIDER and {r.element.port for r in wider} == {"ground-m1"}
    assert {r.element.law.id for r in wider} <= {"stribeck_friction", "hysteresis"}
    assert not any(r.element.law.scaled_by or isinstance(r.element.law, PreslidingStribeckFriction) for r in wider)
    searched.passes[0].scored = tuple(s for s in searched.passes[0].scored if isinstance(s.law, StribeckFriction))
    assert [type(r.element.law) for r in rivals_beside(searched, rig(), kept)[1:]] == [StribeckFriction]
    at_its_port = rig().with_element("ground-m1", CoulombFriction()).elements[-1]
    assert rivals_beside(searched, rig(), at_its_port) == []  # two that rub at one port are one


def test_a_mode_of_a_signal_is_put_up_against_parts_that_are_carried_along(searched):
    mode = Mode().at({"c_1": 0.1, "c_2": 0.0, "W": 30.0, "D": 0.1})
    both = rig().with_element("sensor:x2", mode).with_element("m1-m2", CubicStiffness())
    first = searched.passes[0]
    first.choice.winner = SimpleNamespace(port="sensor:x2", law=mode)
    searched.base = _at_its_values(both)
    (carried,) = rivals_beside(searched, rig(), both.elements[-1])
    assert carried.element.port == "ground-m1" and isinstance(carried.element.law, Attached)
    assert carried.values[f"{carried.element.prefix}W"] == 30.0


def test_what_a_bound_holds_at_nothing_is_not_shown():
    law = Relaxation().at({"k_v": -200.0, "T": 1.0})
    bench = Workbench.of(rig(), recordings(law, port="m1-m2", count=1), "zero")
    bounded = law.at({"k_v": 1.0, "T": 1.0}, {"T": (5 * DT, 10.0), "k_v": (0.0, np.inf)})
    fitted = bench.fit(rig().with_element("m1-m2", bounded), [{}])
    assert fitted.values[f"{fitted.simulator.elements[-1].prefix}k_v"] == 0.0
    assert shown(bench, fitted) == 0.0


def test_a_law_that_only_led_the_simulator_out_of_a_dead_end_is_no_physics():
    bench = Workbench.of(rig(), recordings(None, count=1), "zero")
    stuck = bench.fit(rig((3.0, 1.0, 1.0, 1.0)), solver=GaussNewton(max_iterations=1))
    search = Search(bench, stuck, Floor(np.full(1, 1e-3), "estimated"), (), 1, lambda *_: None)
    search.base = bench.fit(rig().with_element("ground-m1", CubicStiffness()))
    assert led_out(search)
    alone = bench.fit(rig(), [search.led_to])
    assert alone.cost < 1e-3 * stuck.cost
    search.without, search.led_to = alone, {}
    search.base = bench.fit(rig().with_element("ground-m1", CubicStiffness()))
    assert not led_out(search) and not search.led_to


@pytest.fixture
def stuck_refit(monkeypatch):
    """Recordings that lack nothing, of a simulator whose refit stays in a local minimum."""
    refit = preparation.refitted

    def stuck(bench, starts=()):
        if starts:
            return refit(bench, starts)
        return bench.fit(bench.simulator, solver=GaussNewton(max_iterations=1))

    monkeypatch.setattr(preparation, "refitted", stuck)
    return recordings(None, count=1)


@pytest.mark.slow
def test_a_shift_that_only_led_out_of_a_dead_end_is_no_fault(stuck_refit):
    found = pilfr.diagnose(rig((1.4, 0.8, 0.8, 1.2)), stuck_refit)
    assert (found.verdict, found.gates) == ("complete", ()), str(found)


def test_a_search_begins_anew_from_where_a_law_has_led(monkeypatch):
    begun, values = [], {"k1": 3.0}

    class Led:
        def __init__(self, *given, may_be_led, times, **more):
            self.interrupted, self.may_be_led, self.times = False, may_be_led, times
            self.led_to, self.passes, self.base, self.without = {}, ["a law"], None, "refitted"

        def run(self, effects):
            self.led_to = values if self.may_be_led else {}
            return self

    def prepare(*given, **_):
        begun.append(given[5])
        if stops and len(begun) == 2:
            raise KeyboardInterrupt
        return SimpleNamespace(bench=None, without=None, floor=None, gates=())

    monkeypatch.setattr(search_start, "prepare", prepare)
    monkeypatch.setattr(search_start, "Search", Led)
    asked = Asked(rig(), (), (), "zero", "auto", 1, 2, 0.0, None)
    stops = False
    _, search = search_start.prepared_search(asked)
    assert begun == [(), [values]] and not search.may_be_led
    assert list(search.times) == ["checks and refit"]
    begun.clear()
    stops = True
    _, search = search_start.prepared_search(asked)
    assert search.interrupted and search.passes == [] and search.base == "refitted"


@pytest.mark.parametrize("nearer", [True, False])
def test_what_seems_early_beside_something_unexplained_is_searched_as_it_is(monkeypatch, nearer):
    early_or_not = []

    class Unsure:
        def __init__(self, *given, **more):
            self.interrupted, self.led_to = False, {}
            early = early_or_not[-1]
            self.base = SimpleNamespace(cost=1.0 if early else 0.1 if nearer else 0.9)

        def run(self, effects):
            return self

        def certainty(self):
            return 0.1

    def prepare(*given, **_):
        early_or_not.append(given[6])
        return SimpleNamespace(bench=None, without=None, floor=None, gates=gates if given[6] else ())

    gates = (SimpleNamespace(finding="alignment", value=-0.1),)
    monkeypatch.setattr(search_start, "prepare", prepare)
    monkeypatch.setattr(search_start, "Search", Unsure)
    ready, _ = search_start.prepared_search(Asked(rig(), (), (), "zero", "auto", 1, 2, 0.0, None))
    assert early_or_not == [True, False] and ready.gates == (() if nearer else gates)


@pytest.mark.parametrize(
    ("wins", "holds", "gives"), [("rival", True, True), ("rival", False, False), ("stay", True, False)]
)
def test_an_effect_gives_way_to_a_rival_that_wins_and_holds_on_everything(monkeypatch, wins, holds, gives):
    both = {name: SimpleNamespace(name=name, fitted=f"{name} fitted") for name in ("stay", "rival")}
    won = Choice(both[wins], (), 50.0, 0.1, 3.0)
    monkeypatch.setattr(review, "choose", lambda *_: won)
    step = Pass(Choice(both["stay"], (), 40.0, 0.2, 2.0), (), (), (1.0, 1.0), True)
    search = SimpleNamespace(
        passes=[step],
        floor2=1e-6,
        base="as it was",
        effective_samples=lambda tried: 100.0,
        polished=lambda c: c if holds else None,
    )
    assert review._gives_way(search, 0, both["stay"], [both["rival"]]) is gives
    assert search.base == ("rival fitted" if gives else "as it was")
    assert search.passes[0].choice.margin == (3.0 if holds else 2.0)
    monkeypatch.setattr(review, "choose", lambda *_: None)
    assert not review._gives_way(search, 0, both["stay"], [])


@pytest.mark.parametrize(("errors", "alone"), [((1.02, 5.0), 0), ((5.0, 1.02), 1), ((1.2, 1.2), None)])
def test_one_of_two_effects_that_does_as_well_alone_stays_alone(monkeypatch, errors, alone):
    first, second = CubicStiffness(), CoulombFriction().at({"F_c": 1.0, "v_0": 0.01})
    both = rig().with_element("m1-m2", second).with_element("ground-m1", first)  # as found together: in any order
    ports, values = ("ground-m1", "m1-m2"), {k: p.value for k, p in both.parameters.items()}

    def attempt(bench, simulator, starts, **_):
        (port,) = (e.port for e in simulator.elements)
        return SimpleNamespace(error=errors[ports.index(port)], fitted=f"{port} alone")

    monkeypatch.setattr(review, "attempt", attempt)
    winners = [SimpleNamespace(error=1.0, name=(p, law.id)) for p, law in zip(ports, (first, second), strict=True)]
    passes = [Pass(Choice(w, (), 1.0, 0.1, 2.0), (), (), (1.0, 1.0), True) for w in winners]
    base = SimpleNamespace(simulator=both, values=values, begin=[])
    search = SimpleNamespace(bench=None, base=base, passes=list(passes), polished=lambda c: c)
    assert review.one_does_alone(search) is (alone is not None)
    assert len(search.passes) == (2 if alone is None else 1)
    assert search.base == (base if alone is None else f"{ports[alone]} alone")
