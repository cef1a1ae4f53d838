"""Laws that were found elsewhere, fitted to further recordings."""

import numpy as np
import pytest
from fleet_rig import PORT, recording, rig
from simulated import outputs_of

from pilfr_casadi._base import InputError
from pilfr_casadi.diagnose import refit_error, replicate
from pilfr_casadi.laws import CoulombFriction

FRICTION = [(PORT, CoulombFriction({"F_c": 3.0, "v_0": 0.01}, {"F_c": (0.0, np.inf), "v_0": (5e-4, 0.5)}))]


@pytest.fixture(scope="module")
def days():
    return [recording(1300.0, seed) for seed in (0, 1)]


def test_values_errors_and_evidence_of_a_machine_with_the_law(days):
    found = replicate(rig(), days, FRICTION)
    for name, true in (("k", 1300.0), (f"{PORT}.F_c", 5.0)):
        for values in (found.estimate, *found.by_recording):
            assert values.values[name] == pytest.approx(true, abs=4 * values.errors[name])
            assert 0 < values.errors[name] < 0.01 * true
    assert found.gain > 5 and found.nrmse_after < 0.1 * found.nrmse_before
    assert abs(found.remainder) < 4 * found.remainder_error and found.noise == pytest.approx(3e-3, rel=0.1)
    assert found.nrmse_before == pytest.approx(refit_error(rig(), days))
    assert found.widths["k"] == pytest.approx(1300 * np.log(4000 / 300), rel=0.05)
    assert found.simulator.parameters["k"].value == pytest.approx(found.estimate.values["k"])


def test_a_law_that_a_machine_lacks_gains_nothing():
    smooth = recording(1300.0, 3, friction=0.0)
    found = replicate(rig(), smooth, FRICTION)
    assert found.gain < 0 and found.by_recording == () and found.remainder < 0.2


def test_samples_at_rest_are_no_evidence(days):
    """A machine moves for 240 samples, and then stands."""
    rng, moved, gains = np.random.default_rng(1), days[0], []
    true = rig().with_element(PORT, CoulombFriction({"F_c": 5.0, "v_0": 5e-3})).with_parameters({"k": 1300.0})
    for count in (1000, 4000):
        r = moved.with_(u=np.vstack([moved.u, np.zeros((count, 1))]), y=np.zeros((len(moved) + count, 1)))
        noise = 3e-3 * np.std(moved.y) * rng.standard_normal(r.y.shape)
        gains.append(replicate(rig(), r.with_(y=outputs_of(true, r, substeps=20) + noise), FRICTION).gain)
    assert 0 < gains[1] <= gains[0]


def test_without_laws_the_rest_is_told(days):
    found = replicate(rig(), days)
    assert found.gain == 0.0 and found.remainder > 2 and len(found.residuals) == 2
    with pytest.raises(InputError, match="hold"):
        replicate(rig(), days, hold="cubic")


def test_errors_before_and_after_are_comparable():
    """In a recording with small signals, relative errors are large; without laws hardly anything changes."""
    rng, large = np.random.default_rng(0), recording(1300.0, 0, friction=0.0)
    small = large.with_(
        u=0.02 * large.u, y=0.02 * large.y + 3e-3 * np.std(large.y) * rng.standard_normal(large.y.shape)
    )
    found = replicate(rig(), [large, small])
    assert found.nrmse_after == pytest.approx(found.nrmse_before, rel=0.05)
