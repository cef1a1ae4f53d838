"""The force in a port is recovered from the outputs, whatever law was fitted there."""

import numpy as np
import pytest
from diagnosis_example import NOISE, PAIRS, as_it_stands, example, recorded, rig

from pilfr_casadi.diagnose import Workbench, hidden_force
from pilfr_casadi.laws import CubicStiffness, Saturation


@pytest.mark.parametrize(("port", "law"), PAIRS)
def test_the_recovered_force_is_the_hidden_one(port, law):
    d = example(port=port, law=law)
    bench = Workbench.of(d.refitted, d.train, d.hold)
    fitted = as_it_stands(bench, d.corrected)
    hidden = hidden_force(bench, fitted, port, 0, NOISE * bench.scale)
    assert np.std(hidden.force - hidden.law_held) < 0.2 * np.std(hidden.law)
    assert np.corrcoef(hidden.force, hidden.law_held)[0, 1] > 0.98
    assert np.median(np.abs(hidden.force - hidden.law_held) / hidden.std) < 2


def test_the_recovered_force_owes_nothing_to_the_law():
    d = example()
    bench = Workbench.of(d.refitted, [r.with_(start=7.0) for r in d.train], d.hold)
    blind = as_it_stands(bench, rig())
    hidden = hidden_force(bench, blind, "ground", None, NOISE * bench.scale)
    assert hidden.t[0] == 7.0  # a piece of a recording keeps that recording's time
    true = 2.0e4 * hidden.z**3
    assert len(hidden.law) == 0
    assert np.std(hidden.force - true) < 0.25 * np.std(true)
    wrong = rig().with_element("ground", CubicStiffness().at({"k_3": 1.0e4}))
    other = hidden_force(bench, as_it_stands(bench, wrong), "ground", 0, NOISE * bench.scale)
    assert np.std(other.force - hidden.force) < 0.1 * np.std(hidden.force)


@pytest.mark.parametrize("hold", ["zero", "next"])
def test_the_force_of_an_actuator_acts_while_its_input_does(hold):
    corrected = rig().with_element("actuator:force", Saturation().at({"L": 6.0}))
    r = recorded(corrected, 0, samples=600, hold=hold)
    y = corrected.simulate(r)
    r = r.with_(y=y + NOISE * np.std(y) * np.random.default_rng(1).standard_normal(y.shape))
    bench = Workbench.of(rig(), [r], hold)
    hidden = hidden_force(bench, as_it_stands(bench, corrected), "actuator:force", 0, NOISE * bench.scale)
    size = np.std(hidden.law_held)
    assert size > 0 and np.std(hidden.force - hidden.law_held) < 0.25 * size
    assert np.std(np.clip(hidden.z, -6, 6) - hidden.z - hidden.law_held) < 1e-6 * size
