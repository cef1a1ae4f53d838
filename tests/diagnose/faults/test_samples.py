"""Glitches, stale samples, and periods that have not settled."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis_rig import OFF, recordings, refitted, rig
from simulated import outputs_of

import pilfr_casadi as pilfr
from pilfr_casadi import laws
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.faults import samples
from pilfr_casadi.diagnose.faults.samples import (
    find_frozen_channels,
    find_glitches,
    find_held_outputs,
    mend,
    mend_stale_samples,
    open_unsettled,
    remove_glitches,
    share_of_repeats,
)
from pilfr_casadi.diagnose.fits.floor import measured_floor

# single samples far off their neighbours


PLACES = [100, 108, 900, 1500]


def spoilt(r, places=PLACES, size=3.0):
    """The recording with some samples off by a few deviations."""
    y = np.array(r.y)
    y[places, 0] += size * np.std(y) * np.resize([1, -1], len(places))
    return r.with_(y=y)


def test_glitches_are_found_replaced_and_told():
    (r,) = recordings(count=1)
    (clean,), (gate,) = remove_glitches([spoilt(r)])
    assert (gate.channel, gate.finding, gate.value, gate.corrected, gate.fault) == ("x2", "glitch", 4, True, True)
    assert "the first at t = 0.2 s" in gate.sentence
    np.testing.assert_array_equal(np.flatnonzero(clean.y != spoilt(r).y), PLACES)
    assert np.max(np.abs(clean.y - r.y)) < 0.01 * np.std(r.y)
    np.testing.assert_array_equal(mend(r).y, r.y)


@pytest.mark.parametrize("kind", ["noise", "step", "pulse", "shock", "coarse", "toggle", "short"])
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
    if kind == "toggle":  # of the last digit
        y = np.round(np.sin(np.arange(4000) / 400), 1)
        y[1000] += 0.1
    if kind == "short":
        y = y[:40]
        y[20] += 3
    assert not len(find_glitches(y)[0])


def test_a_lost_sample_of_a_channel_that_rests_is_a_glitch():
    """The two values that it has are no quantisation."""
    y = np.full(1400, 23.0)
    y[700] = 0.0
    assert find_glitches(y)[0].tolist() == [700]


@pytest.mark.parametrize("kind", ["frozen", "both", "rest", "limit", "coarse", "slow"])
def test_a_channel_that_stands_still_while_the_machine_moves_is_noted(kind):
    rng, t = np.random.default_rng(0), np.arange(600)
    drive = np.sin(t / 30) + 0.01 * rng.standard_normal(600)
    y = np.cos(t / 30) + 0.01 * rng.standard_normal(600)
    if kind == "coarse":
        y = np.round(y, 1)
    y[300:340] = y[300]
    if kind == "both":
        drive[300:340] = drive[300]
    if kind == "rest":  # until the input changes
        drive[300:341] = drive[300]
    if kind == "limit":
        y = np.maximum(y, y[300])
    if kind == "slow":
        y[340:] += y[300] - y[340]  # it goes on from where it stood
    inputs = np.column_stack([drive, rng.standard_normal(600)] if kind == "both" else [drive])
    r = pilfr.Recording(inputs, y[:, None], 0.1, inputs=("u", "v")[: inputs.shape[1]], outputs=("y",))
    found = find_frozen_channels([r])
    assert [g.channel for g in found] == {"frozen": ["y"], "both": ["u", "y"]}.get(kind, [])
    assert all(g.value == 40 and "from t = 30 s to 33.9 s" in g.sentence for g in found)
    ends = {"u": "Unless it was held there, cut the recording, or empty the repeated cells."}
    ends["y"] = "Unless the machine stuck there, cut the recording."
    assert all(g.sentence.endswith(ends[g.channel]) for g in found)


@pytest.mark.parametrize("late", [0, 1])
def test_the_answer_to_a_pulse_of_an_input_is_no_glitch(late):
    """As the flow of a brook on the day of a thunderstorm, or on the next day."""
    rng = np.random.default_rng(0)
    rain = np.zeros((1000, 1))
    rain[[300, 620], 0] = 18.0, 12.0
    y = 0.3 + 0.02 * rng.standard_normal(1000) + 0.3 * np.roll(rain[:, 0], late)
    y[800] += 4.0  # nothing drives it
    r = pilfr.Recording(rain, y[:, None], 1.0, inputs=("rain",), outputs=("flow",))
    assert np.flatnonzero(mend(r).y != r.y).tolist() == [800]
    assert find_glitches(y)[0].tolist() == [300 + late, 620 + late, 800]


@pytest.mark.slow
def test_friction_is_named_beside_glitches():
    train = [spoilt(r) for r in recordings(laws.CoulombFriction(values={"F_c": 10.0, "v_0": 0.01}))]
    found = pilfr.diagnose(rig(OFF), train)
    assert [(e.port, e.law) for e in found.effects] == [("ground-m1", "coulomb_friction")]
    assert "glitch" in [g.finding for g in found.gates]


# samples that repeat the one before, among those that never do


def lost(r, share, side="y", seed=0):
    """The recording with some samples that repeat the one before."""
    v = np.array(getattr(r, side))
    for k in np.flatnonzero(np.random.default_rng(seed).random(len(v)) < share):
        v[k] = v[max(k - 1, 0)]
    return r.with_(**{side: v})


@pytest.mark.parametrize(("side", "channel"), [("u", "force"), ("y", "x2")])
def test_stale_samples_are_interpolated(side, channel):
    (r,) = recordings(count=1)
    bench = Workbench.of(rig(OFF), [lost(r, 0.1, side)], "zero")
    found = mend_stale_samples(refitted(bench))
    (gate,) = found.gates
    assert (gate.channel, gate.finding, gate.corrected, gate.fault) == (channel, "stale", True, True)
    assert gate.value == pytest.approx(0.1, abs=0.02)
    assert found.cost < 0.01**2


def test_repeats_of_a_coarse_sensor_whose_record_was_resampled_are_not_stale():
    rng = np.random.default_rng(0)
    t = np.arange(4000.0)
    y = np.round(60 * np.sin(0.05 * t) + 20 * np.sin(0.11 * t) + rng.standard_normal(t.size))
    resampled = np.interp(t, np.sort(t + 0.03 * rng.uniform(-1, 1, t.size)), y)
    assert np.mean(np.diff(resampled) == 0) > 0.02
    assert share_of_repeats([resampled]) == 0


@pytest.mark.parametrize("led", [False, True], ids=["as it was", "led to a better refit"])
def test_stale_samples_beside_missing_physics_are_noted(monkeypatch, led):
    if led:  # the correction only led the refit out of a local minimum
        monkeypatch.setattr(samples, "accept", lambda now, after, fault: now.then(now.bench, now.fitted))
    (r,) = recordings(laws.CoulombFriction(values={"F_c": 10.0, "v_0": 0.01}), count=1)
    bench = Workbench.of(rig(OFF), [lost(r, 0.1)], "zero")
    (gate,) = mend_stale_samples(refitted(bench)).gates
    assert (gate.channel, gate.finding, gate.corrected, gate.fault) == ("x2", "stale", False, False)


@pytest.mark.parametrize("kind", ["clean", "coarse", "resting", "clipped", "encoder"])
def test_a_converter_and_a_rest_are_not_stale(kind):
    (r,) = recordings(count=1)
    y = np.array(r.y)
    if kind == "coarse":
        y = np.round(y / np.std(y), 1) * np.std(y)
    if kind == "resting":
        y[:400] = y[400]
    if kind == "clipped":
        y = np.clip(y, *np.quantile(y, [0.05, 0.95]))
    if kind == "encoder":  # more levels than half of the samples, and slow ways between them
        y = np.round(np.linspace(0, 1, len(y))[:, None] ** 4 + 0.01 * y / np.std(y), 3)
    assert not share_of_repeats([y[:, 0]])


# periodic recordings whose periods still differ by what dies away


def held(r, k):
    """The recording with its output measured at every k-th sample alone."""
    return r.with_(y=r.y[np.arange(len(r)) // k * k])


def test_an_output_that_was_measured_at_a_slower_rate_is_told():
    (r,) = recordings(count=1)
    (gate,) = find_held_outputs([held(r, 5)])
    assert (gate.channel, gate.finding, gate.value, gate.corrected) == ("x2", "held", 5, False)
    assert f"a delay of about {2 * r.dt:.3g} s" in gate.sentence and f"resample={r.dt:g}" in gate.sentence
    checked = pilfr.check(rig(OFF), held(r, 5))
    assert gate.sentence in [spot.sentence for spot in checked.blind_spots]
    assert checked.next_record == "Leave the repeated values of x2 out first."


def test_an_output_that_was_measured_at_half_the_rate_is_not_stale_as_well():
    (r,) = recordings(count=1)
    r = held(r.slice(0, 1001), 2)  # of an odd number of samples, more than half differ
    now = refitted(Workbench.of(rig(OFF), [r], "zero"))
    now = replace(now, gates=tuple(find_held_outputs([r])))
    assert [gate.finding for gate in mend_stale_samples(now).gates] == ["held"]


@pytest.mark.parametrize("kind", ["noise", "encoder", "driven"])
def test_outputs_that_change_regularly_for_other_reasons_are_not(kind):
    (r,) = recordings(count=1)
    if kind == "encoder":  # at constant speed
        r = r.with_(y=0.01 * (np.arange(len(r))[:, None] // 5))
    if kind == "driven":  # by held levels, without memory or noise
        u = r.u[np.arange(len(r)) // 10 * 10]
        r = r.with_(u=u, y=np.tanh(u))
    assert find_held_outputs([r]) == []


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
    kept, gates = open_unsettled([periodic(0.0, 0.05, seed), periodic(0.0, 1e-3, seed + 50)])
    assert not gates
    assert all(r.initial == "periodic" and r.period == 500 for r in kept)


def test_what_dies_away_is_said_and_the_initial_state_estimated():
    whole, dying = periodic(0.0), periodic(0.1)
    kept, (gate,) = open_unsettled([whole, dying])
    assert all(r.initial == "estimate" and r.period is None for r in kept)
    assert (gate.finding, gate.channel, gate.corrected, gate.fault) == ("transient", "y", True, False)
    assert "has not settled in first" in gate.sentence
    assert gate.change(dying).initial == "estimate"


@pytest.mark.slow
def test_a_diagnosis_of_recordings_that_have_not_settled_finds_nothing_missing():
    """From rest, the rig takes some periods to settle; said to be periodic, it is not yet."""
    (one,) = recordings(count=1, seed=3)
    force = np.tile(one.u[:625], (4, 1))
    r = one.with_(u=force, y=np.zeros((2500, 1)))
    y = outputs_of(rig(), r, substeps=8)
    noise = 1e-3 * np.std(y) * np.random.default_rng(1).standard_normal(y.shape)
    found = pilfr.diagnose(rig(OFF), r.with_(y=y + noise, initial="periodic", period=625))
    assert found.verdict == "complete"
    assert [g.finding for g in found.gates] == ["transient"]


def test_a_given_state_is_neither_periodic_nor_in_the_way():
    """What a recording begins with may be numbers, though it has a period."""
    r = periodic(0.1).with_(initial=np.array([1.0, 2.0]))
    assert r.begins == "given"
    kept, gates = open_unsettled([r])
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
