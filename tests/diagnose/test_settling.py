"""Periodic recordings whose periods still differ by what dies away."""

import numpy as np
import pytest
from diagnosis_rig import OFF, recordings, rig

import pilfr_casadi as pilfr
from pilfr_casadi.diagnose.floor import measured_floor
from pilfr_casadi.diagnose.settling import without_transients


def periodic(decay, noise=1e-3, seed=0):
    """Four periods of a rig's answer, with something on top that dies away."""
    rng = np.random.default_rng(seed)
    t = np.arange(2000) / 500
    u = np.tile(pilfr.multisine(500, f_max=20.0, fs=500.0, rng=rng), 4)
    y = np.tile(rng.standard_normal(500), 4) + decay * np.exp(-t) * np.sin(9 * t)
    return pilfr.Recording(
        u, y + noise * rng.standard_normal(2000), 1 / 500, period=500, initial="periodic", hold="zero", name="first"
    )


@pytest.mark.parametrize("seed", range(20))
def test_noise_is_no_transient(seed):
    kept, gates = without_transients([periodic(0.0, 0.05, seed), periodic(0.0, 1e-3, seed + 50)])
    assert not gates
    assert all(r.initial == "periodic" and r.period == 500 for r in kept)


def test_what_dies_away_is_said_and_the_initial_state_estimated():
    whole, dying = periodic(0.0), periodic(0.1)
    kept, (gate,) = without_transients([whole, dying])
    assert all(r.initial == "estimate" and r.period is None for r in kept)
    assert (gate.finding, gate.channel, gate.corrected, gate.fault) == ("transient", "y", True, False)
    assert "has not settled in first" in gate.sentence
    assert gate.change(dying).initial == "estimate"


@pytest.mark.slow
def test_a_diagnosis_of_recordings_that_have_not_settled_finds_nothing_missing():
    """From rest, the rig takes some periods to settle; said to be periodic, it is not yet."""
    (one,) = recordings(count=1, seed=3)
    force = np.tile(one.u[:625], (4, 1))
    from pilfr_casadi.engine import make_engine
    from pilfr_casadi.simulators import discretise

    model = discretise(rig(), one.dt, "zero", 8)
    r = one.with_(u=force, y=np.zeros((2500, 1)))
    y = make_engine(model).simulate(model.drive(r), model.parameters.start, np.zeros(model.n_state))[0]
    noise = 1e-3 * np.std(y) * np.random.default_rng(1).standard_normal(y.shape)
    found = pilfr.diagnose(rig(OFF), r.with_(y=y + noise, initial="periodic", period=625))
    assert found.verdict == "complete"
    assert [g.finding for g in found.gates] == ["transient"]


def test_a_given_state_is_neither_periodic_nor_in_the_way():
    """What a recording begins with may be numbers, though it has a period."""
    r = periodic(0.1).with_(initial=np.array([1.0, 2.0]))
    assert r.begins == "given"
    kept, gates = without_transients([r])
    assert not gates and kept[0] is r
    assert measured_floor([r, r.with_(y=r.y + 1e-3)]).source == "repeats"


def test_repeats_that_began_in_other_states_are_compared_late():
    """The way from another state is no noise; recordings may leave out different numbers of samples at the begin."""
    rng, t = np.random.default_rng(0), np.arange(4000)
    u = rng.standard_normal((4000, 1))
    one, other = (
        pilfr.Recording(u, (a * np.exp(-t / 100.0) + 0.01 * rng.standard_normal(4000))[:, None], 1e-3, skip=skip)
        for a, skip in ((1.0, 0), (-1.0, 50))
    )
    assert measured_floor([one, other]).deviation[0] == pytest.approx(0.01, rel=0.1)
    at_rest = measured_floor([r.with_(initial="zero") for r in (one, other)])
    assert at_rest.deviation[0] > 0.05
