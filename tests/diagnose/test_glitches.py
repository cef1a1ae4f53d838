"""Single samples far off their neighbours."""

import numpy as np
import pytest
from diagnosis_rig import OFF, recordings, rig

import pilfr_casadi as pilfr
from pilfr_casadi import laws
from pilfr_casadi.diagnose.glitches import glitches, mended, without_glitches

PLACES = [100, 108, 900, 1500]


def spoilt(r, places=PLACES, size=3.0):
    """The recording with some samples off by a few deviations."""
    y = np.array(r.y)
    y[places, 0] += size * np.std(y) * np.resize([1, -1], len(places))
    return r.with_(y=y)


def test_glitches_are_found_replaced_and_told():
    (r,) = recordings(count=1)
    (clean,), (gate,) = without_glitches([spoilt(r)])
    assert (gate.channel, gate.finding, gate.value, gate.corrected, gate.fault) == ("x2", "glitch", 4, True, True)
    assert "the first at t = 0.2 s" in gate.sentence
    np.testing.assert_array_equal(np.flatnonzero(clean.y != spoilt(r).y), PLACES)
    assert np.max(np.abs(clean.y - r.y)) < 0.01 * np.std(r.y)
    np.testing.assert_array_equal(mended(r).y, r.y)


@pytest.mark.parametrize("kind", ["noise", "step", "pulse", "shock", "coarse", "short"])
def test_what_lasts_longer_than_a_sample_is_no_glitch(kind):
    rng = np.random.default_rng(3)
    y = np.sin(np.arange(4000) / 40) + 1e-3 * rng.standard_normal(4000)
    if kind == "noise":
        y = rng.standard_normal(4000)
    if kind == "step":
        y[2000:] += 3
    if kind == "pulse":
        y[2000:2003] += 3
    if kind == "shock":
        y[2000:] += 3 * np.exp(-np.arange(2000) / 4) * np.cos(np.arange(2000))
    if kind == "coarse":
        y = np.round(y, 1)
    if kind == "short":
        y = y[:40]
        y[20] += 3
    assert not len(glitches(y)[0])


@pytest.mark.slow
def test_friction_is_named_beside_glitches():
    train = [spoilt(r) for r in recordings(laws.CoulombFriction(values={"F_c": 10.0, "v_0": 0.01}))]
    found = pilfr.diagnose(rig(OFF), train)
    assert [(e.port, e.law) for e in found.effects] == [("ground-m1", "coulomb_friction")]
    assert "glitch" in [g.finding for g in found.gates]
