"""A rest that swings at the simulator's own frequency."""

import numpy as np
import pytest
from diagnosis_rig import DT, OFF, recordings, rig
from scipy.signal import lfilter

import pilfr_casadi as pilfr
from pilfr_casadi import laws
from pilfr_casadi.engine import make_engine
from pilfr_casadi.simulators import discretise


def disturbed(size, seed=5):
    """Recordings with white noise in the force that is not recorded."""
    rng = np.random.default_rng(seed)
    (r,) = recordings(count=1)
    extra = size * np.std(r.u) * rng.standard_normal(r.u.shape)
    model = discretise(rig(), DT, "zero", 4)
    y = make_engine(model).simulate(model.drive(r.with_(u=extra)), model.parameters.start, np.zeros(model.n_state))[0]
    return r.with_(y=r.y + y)


def test_a_force_that_is_not_recorded_is_not_called_noise():
    found = pilfr.diagnose(rig(OFF), disturbed(0.02), laws=[laws.CubicStiffness])
    assert found.verdict == "unexplained"
    assert "swings at the simulator's own" in found.sentence


@pytest.mark.slow
@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_noise_white_or_coloured_is_not_a_missing_force(pole):
    rng = np.random.default_rng(2)
    (r,) = recordings(count=1)
    noise = lfilter([1], [1, -pole], rng.standard_normal(len(r)))
    found = pilfr.diagnose(rig(OFF), r.with_(y=r.y + 0.004 * np.std(r.y) * (noise / np.std(noise))[:, None]))
    assert found.verdict == "complete"
