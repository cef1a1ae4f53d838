"""Steady tones that no input holds, and a rest that swings at the simulator's own frequency."""

import numpy as np
import pytest
from diagnosis_rig import OFF, recordings, rig
from scipy.signal import lfilter
from simulated import outputs_of

import pilfr_casadi as pilfr
from pilfr_casadi import laws
from pilfr_casadi._base import Stages
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.faults.tones import find_ringing_mode, find_tone, find_tones
from pilfr_casadi.diagnose.fits.floor import Floor
from pilfr_casadi.diagnose.pipeline import add_tones
from pilfr_casadi.diagnose.posterior import Posterior
from pilfr_casadi.diagnose.search.moves import Search
from pilfr_casadi.diagnose.search.trials import Trial
from pilfr_casadi.diagnose.verdict import judge

# steady tones


COUNT, STEP = 4000, 5e-3
TIME = np.arange(COUNT) * STEP


def measured(e, u=None):
    """What is told of a residual beside an input, by default noise."""
    u = np.random.default_rng(1).standard_normal(COUNT) if u is None else u
    return find_tone(e, pilfr.Recording(u, e, STEP))


def noise(seed=0, pole=0.0):
    return lfilter([1], [1, -pole], np.random.default_rng(seed).standard_normal(COUNT))


@pytest.mark.parametrize("f", [7.013, 31.4, 49.97, 77.7])
def test_hum_is_found_to_a_part_of_a_line(f):
    found = measured(noise() + np.sin(2 * np.pi * f * TIME + 0.3))
    assert found is not None
    assert found[0] == pytest.approx(f, abs=0.1 / TIME[-1])
    assert found[1] == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("pole", [0.0, 0.9, 0.99])
def test_noise_is_no_tone(seed, pole):
    assert measured(noise(seed, pole)) is None


SINE = np.sin(2 * np.pi * 4.1 * TIME)
OTHER = np.sin(2 * np.pi * 4.1 * TIME) + np.sin(2 * np.pi * 6.3 * TIME)


@pytest.mark.parametrize(
    ("e", "u"),
    [
        (np.sin(2 * np.pi * 31.4 * TIME) * np.exp(-TIME / 4), None),  # dies out
        (np.sin(2 * np.pi * (31.4 + 0.1 * TIME) * TIME), None),  # wanders
        (np.sin(2 * np.pi * 4.1 * TIME + 1), SINE),  # the input's own
        (SINE**3, SINE),
        (np.sin(2 * np.pi * 26 * 4.1 * TIME), np.sign(SINE)),  # of a square wave, which has many
        (OTHER**2, OTHER),  # mixed
    ],
)
def test_what_comes_from_the_input_or_does_not_stay_is_no_tone(e, u):
    assert measured(e + 1e-2 * noise(), u) is None


def test_hum_on_a_sensor_is_told_where_nothing_is_missing():
    (r,) = recordings(count=1)
    hum = 0.02 * np.std(r.y) * np.sin(2 * np.pi * 49.97 * r.t)
    found = pilfr.diagnose(rig(OFF), r.with_(y=r.y + hum[:, None]), laws=[laws.CubicStiffness])
    assert found.verdict == "complete"
    assert found.sentence.startswith("Nothing is missing but a steady tone in x2")
    (gate,) = found.gates
    assert (gate.channel, gate.finding, gate.corrected, gate.fault) == ("x2", "tone", False, False)
    assert gate.value == pytest.approx(49.97, abs=0.02)


def test_hum_explains_nothing_of_physics_that_has_lost_its_name():
    """It was most of what the withdrawn law had left, and hardly anything of what the refit leaves."""
    friction = laws.CoulombFriction(values={"F_c": 10.0, "v_0": 0.01})
    (r,) = recordings(friction, count=1)
    hum = 0.03 * np.std(r.y) * np.sin(2 * np.pi * 49.97 * r.t)
    bench = Workbench.of(rig(OFF), [r.with_(y=r.y + hum[:, None])], "zero")
    refit, named = bench.fit(rig(OFF)), bench.fit(rig(OFF).with_element("ground-m1", friction))
    floor = Floor(0.02 * bench.scale, "periods", 4, np.full(1, 100.0))
    search = Search(bench, refit, floor, [laws.CoulombFriction], 1, Stages(lambda *_: None))
    for fitted, count in ((refit, 0), (named, 1)):
        search.keep(Trial.of(fitted, count, thorough=True))
    withdrawn = Posterior(search.best, 0.0, (), 0.0)
    assert search.best.laws and find_tones(bench, named)
    assert judge(search, withdrawn, add_tones(search, withdrawn, ())).kind == "unexplained"


@pytest.mark.slow
def test_an_uneven_encoder_is_named_at_its_sensor():
    (r,) = recordings(count=1)
    length = np.ptp(r.y) / 17.3
    uneven = 0.05 * np.std(r.y) * np.sin(2 * np.pi * r.y / length + 0.5)
    found = pilfr.diagnose(rig(OFF), r.with_(y=r.y + uneven))
    (effect,) = found.effects
    assert (found.verdict, effect.port, effect.law, effect.form) == (
        "missing-physics",
        "sensor:x2",
        "periodic_force",
        "ripple",
    )
    assert effect.parameters["L"]["value"] == pytest.approx(length, rel=0.01)
    assert found.gates == ()


# ringing modes


def disturbed(size, seed=5):
    """Recordings with white noise in the force that is not recorded."""
    rng = np.random.default_rng(seed)
    (r,) = recordings(count=1)
    extra = size * np.std(r.u) * rng.standard_normal(r.u.shape)
    return r.with_(y=r.y + outputs_of(rig(), r.with_(u=extra), substeps=4))


def test_a_rest_that_swings_at_an_own_frequency_is_told_from_noise():
    (r,) = recordings(count=1)
    noisy = r.with_(y=r.y + 0.02 * np.std(r.y) * np.random.default_rng(2).standard_normal(r.y.shape))
    modes = []
    for measured in (disturbed(0.02), noisy):
        bench = Workbench.of(rig(OFF), [measured], "zero")
        modes.append(find_ringing_mode(bench, bench.fit(rig(OFF))))
    assert modes[0] is not None and modes[1] is None


@pytest.mark.slow
def test_a_force_that_is_not_recorded_is_not_called_noise():
    found = pilfr.diagnose(rig(OFF), disturbed(0.02), laws=[laws.CubicStiffness], effects=1)
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
