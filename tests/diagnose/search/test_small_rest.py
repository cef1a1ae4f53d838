"""An effect whose trace is smaller than the formula error of the law beside it."""

import pytest
from diagnosis_example import recorded, rig

import pilfr_casadi as pilfr
from pilfr_casadi import laws
from pilfr_casadi.diagnose.search.trials import Trial


@pytest.fixture(scope="module")
def diagnosis():
    true = rig().with_element("ground", laws.CoulombFriction().at({"F_c": 3.0, "v_0": 0.02}))
    true = true.with_element("actuator:force", laws.Saturation().at({"L": 36.6}))  # the peaks alone pass it
    measured = recorded(true, 0, samples=500, noise=3e-4)
    tried = (laws.CoulombFriction, laws.Saturation)
    return pilfr.diagnose(rig(430.0, 5.0), measured, laws=tried, hold="zero", workers=1)


@pytest.mark.slow
def test_a_small_rest_is_explained_if_noise_alone_is_left(diagnosis):
    search = diagnosis.evidence.search
    (alone,) = [t for t in search.memo.values() if [e.port for e in t.effects] == ["ground"] and len(t.laws) == 1]
    assert alone.mean_square < 1e-3 * search.root.mean_square  # less than a formula may leave
    assert [(e.port, e.law) for e in diagnosis.effects] == [
        ("ground", "coulomb_friction"),
        ("actuator:force", "saturation"),
    ]
    assert min(e.confidence for e in diagnosis.effects) > 0.8
    assert diagnosis.effects[1].parameters["L"]["value"] == pytest.approx(36.6, abs=0.1)
    assert diagnosis.errors["train"]["after"] < 1.2 * 3e-4


@pytest.mark.slow
def test_a_law_that_does_nothing_predicts_as_the_hypothesis_without_it(diagnosis):
    search = diagnosis.evidence.search
    best = search.best
    idle = best.fitted.simulator.with_element("sensor:pos", laws.Saturation().at({"L": 100.0}))
    values = {**best.fitted.values, **idle.elements[-1].named({"L": 100.0})}
    fitted = search.bench.run(idle, values, best.fitted.begin)
    trial = Trial(fitted.last_elements(3), fitted, fitted.cost, fitted.cost, thorough=True)
    assert search.held_out(trial) is search.held_out(best)
