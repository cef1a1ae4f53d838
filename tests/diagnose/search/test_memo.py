"""Every hypothesis is fitted once: beside the same laws no law is begun again, and none is polished twice."""

from collections import Counter

import pytest
from diagnosis_rig import OFF, recordings, rig

from pilfr_casadi import laws
from pilfr_casadi._base import Stages
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.fits.floor import Floor
from pilfr_casadi.diagnose.search.moves import Search
from pilfr_casadi.diagnose.search.trials import Trials

TRIED = (laws.QuadraticDrag, laws.CubicStiffness)  # no strength of theirs may vary
CUBIC, DRAG = laws.CubicStiffness(values={"k_3": 4e5}), laws.QuadraticDrag(values={"c_2": 60.0})


@pytest.fixture
def fits(monkeypatch):
    """How often each law was begun beside its parent's, and each hypothesis fitted thoroughly."""
    begun, polished, found = Counter(), Counter(), {"begun": Trials._fit_briefly, "polished": Trials.converge}

    def begin(self, parent, entries, gain):
        begun[parent.key, (entries[0].port, type(entries[0].law))] += 1
        return found["begun"](self, parent, entries, gain)

    def converge(self, trial):
        polished[trial.key] += 1
        return found["polished"](self, trial)

    monkeypatch.setattr(Trials, "_fit_briefly", begin)
    monkeypatch.setattr(Trials, "converge", converge)
    return begun, polished


def searched(train, effects):
    bench = Workbench.of(rig(OFF), train, "zero")
    floor = Floor(1e-3 * bench.scale, "repeats")
    return Search(bench, bench.fit(bench.simulator), floor, TRIED, 1, Stages(lambda *_: None)).run(effects)


def test_one_effect_needs_each_hypothesis_once(fits):
    begun, polished = fits
    found = searched([r.slice(0, 800) for r in recordings(CUBIC, count=1)], 1)
    assert [(e.port, e.law.id) for e in found.best.laws] == [("ground-m1", "cubic_stiffness")]
    assert set(begun.values()) == {1} and set(polished.values()) == {1}
    assert set(polished) <= set(found.memo)


@pytest.mark.slow
def test_what_two_effects_are_exchanged_for_is_not_fitted_twice(fits):
    begun, polished = fits
    true = rig().with_element("ground-m1", CUBIC)
    train = [r.slice(0, 700) for r in recordings(DRAG, port="m1-m2", count=1, of=true)]
    found = searched(train, 2)
    assert {(e.port, e.law.id) for e in found.best.laws} == {
        ("ground-m1", "cubic_stiffness"),
        ("m1-m2", "quadratic_drag"),
    }
    assert set(polished.values()) == {1}
    assert set(begun.values()) == {1}, [pair for pair, times in begun.items() if times > 1]
    assert len(searched(train, 1).best.laws) == 1  # not more than were asked for


def test_an_interrupt_of_a_fit_keeps_what_there_is(monkeypatch):
    seen, whole = [], Trials.make_trial

    def struck(self, found, count):
        seen.append(count)
        if len(seen) > 4:
            raise KeyboardInterrupt
        return whole(self, found, count)

    monkeypatch.setattr(Trials, "make_trial", struck)
    found = searched(recordings(CUBIC, count=1), 2)
    assert found.interrupted and found.root.key in found.memo
    assert {len(key) for key in found.memo} == {0, 1}  # the laws that were fitted are kept, and no second one was tried
