"""The verdict in words, and offsets beside it."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from cart import cart
from diagnosis_rig import recordings, rig
from scipy.signal import lfilter
from tank import tank

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Recording, Simulator, multisine
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.correction import Correction, find_unnamed_correction
from pilfr_casadi.diagnose.faults.offsets import Offset, fix_idle_offsets, list_offsets, update_offsets
from pilfr_casadi.diagnose.fits.evidence import standard_errors
from pilfr_casadi.diagnose.fits.flexible_forces import flexible_shares, innovation_share
from pilfr_casadi.diagnose.posterior import posterior
from pilfr_casadi.diagnose.verdict import closest_hypothesis, judge
from pilfr_casadi.laws import CATALOGUE, CoulombFriction, CubicDamping, Delay, Power as StaticPower, Relaxation
from pilfr_casadi.report.diagnosis_tables import nameless_blocks


def test_a_value_of_the_simulator_that_a_law_replaces_is_told_to_come_out_as_zero():
    """Without the law, the damping has to stand for it."""
    u = 10 * multisine(200, f_max=3.0, fs=20.0, rng=np.random.default_rng(1))
    blank = Recording(u, u, 0.05, ("force",), ("pos",), initial="zero", hold="zero")
    true = cart(d=-0.01, d_bounds=(-1, 5)).with_element("ground", CubicDamping().at({"c_3": 0.3}))
    y = true.simulate(blank)
    r = blank.with_(y=y + 1e-3 * np.std(y) * np.random.default_rng(2).standard_normal(y.shape))
    found = pilfr.diagnose(cart(), r, laws=(CubicDamping,), effects=1, workers=1)
    assert found.parameters["d"]["refit_without"] > 1
    replaced = "The simulator's own d comes out as zero: it is replaced."
    assert found.sentence == f"The simulator leaves out cubic damping at ground. {replaced}"


def test_slow_noise_that_two_periods_show_is_no_missing_physics():
    """A flexible force follows half of it: its mean over both periods repeats with the input."""
    u = np.tile(10 * multisine(400, f_max=3.0, fs=20.0, rng=np.random.default_rng(1)), 2)
    blank = Recording(u, u, 0.05, ("force",), ("pos",), initial="periodic", period=400, hold="zero")
    y = cart().simulate(blank)
    slow = lfilter([1], [1, -0.98], np.random.default_rng(2).standard_normal(len(y) + 500))[500:, None]
    r = blank.with_(y=y + 0.15 * np.std(y) * slow / np.std(slow))
    found = pilfr.diagnose(cart(), r, laws=(CoulombFriction, CubicDamping), effects=1, workers=1)
    assert max(found.evidence.search.flexible(found.evidence.search.root).values()) > 0.3
    assert found.verdict == "complete"
    assert "the rest is as large as the noise" in found.sentence


def test_noise_of_another_level_in_each_recording_is_no_missing_physics():
    """It grows with the amplitude, as of a sensor that is set to another range."""
    recordings = []
    for seed, amplitude in enumerate((1.0, 0.5, 0.25)):
        rng = np.random.default_rng(seed)
        u = 10 * amplitude * multisine(600, f_max=3.0, fs=20.0, rng=rng)
        blank = Recording(u, u, 0.05, ("force",), ("pos",), initial="zero", hold="zero")
        y = cart().simulate(blank)
        recordings.append(blank.with_(y=y + 4e-3 * amplitude * rng.standard_normal(y.shape)))
    found = pilfr.diagnose(cart(), recordings, laws=(CoulombFriction, CubicDamping), effects=1, workers=1)
    assert found.verdict == "complete", found.sentence


def levels(seed, dt):
    """A blank recording of a pump whose voltage steps at random."""
    u = np.repeat(np.random.default_rng(seed).uniform(1, 5, 25), 60)[:, None]
    return Recording(u, u, dt, ("pump",), ("level",), initial="zero", hold="zero")


@pytest.mark.parametrize("pole", [0.3, 0.6])
def test_noise_in_a_slow_machine_does_not_swell_with_it(pole):
    """The rates of the measured level are those of the noise."""
    blank = levels(3, 0.5)
    noise = lfilter([1], [1, -pole], np.random.default_rng(1).standard_normal((len(blank), 1)), axis=0)
    found = pilfr.diagnose(tank(), blank.with_(y=tank().simulate(blank) + 2e-3 * noise), laws=(StaticPower,), workers=1)
    assert found.verdict == "complete", found.sentence


@pytest.mark.parametrize("switches", [True, False])
def test_what_a_gain_that_switches_leaves_is_no_slow_noise(switches):
    """Over long blocks the power of a steady input hardly varies: only the samples show what drives the error."""
    transducer = Simulator(
        lambda x, u, p: {},
        lambda x, u, p: {"reading": p.gain * u.drive},
        states=(),
        inputs=("drive",),
        parameters={"gain": Parameter(2.5, bounds=(1, 5))},
    )
    rng, t = np.random.default_rng(4), np.arange(3000) * 0.01
    u = np.sin(4 * np.pi * t + 0.1 * np.cumsum(rng.standard_normal(3000)))[:, None]
    gain = 1 + 0.03 * np.where(np.sin(2 * np.pi * t / 12) > 0, 1, -1)[:, None]
    slow = lfilter([1], [1, -0.98], rng.standard_normal((3300, 1)), axis=0)[300:]
    y = 2.5 * u * gain if switches else 2.5 * u + 0.03 * slow * np.std(u) / np.std(slow)
    noise = 1e-3 * np.std(u) * rng.standard_normal(u.shape)
    r = Recording(u, y + noise, 0.01, ("drive",), ("reading",), hold="zero")
    found = pilfr.diagnose(transducer, r, laws=("saturation",), effects=1, workers=1)
    assert found.verdict == ("unexplained" if switches else "complete"), found.sentence


def drifted(seed, laws, **options):
    """The verdict on a tank whose sensor drifts."""
    rng, blank = np.random.default_rng([seed, 1]), levels(seed, 2.0)
    white = rng.standard_normal((len(blank), 1))
    drift = lfilter([0.1], [1, -0.995], rng.standard_normal((len(blank) + 2000, 1)), axis=0)[2000:]
    y = tank().simulate(blank)
    noisy = blank.with_(y=y + np.std(y) * (0.003 * white + 0.008 * drift))
    return pilfr.diagnose(tank(), noisy, laws=laws, workers=1, **options).verdict


def test_the_drift_of_a_sensor_is_not_called_missing_physics():
    """Its few independent samples follow any force a little, and neighbouring blocks are alike."""
    assert drifted(3, (StaticPower,), effects=1) == "complete"


@pytest.mark.slow
def test_the_drift_of_a_sensor_is_hardly_called_missing_physics():
    assert sum(drifted(seed, (StaticPower, CoulombFriction)) == "complete" for seed in range(6)) >= 5


@pytest.mark.parametrize("seed", [pytest.param(2, marks=pytest.mark.slow), 3])
def test_slow_physics_outside_the_catalogue_is_no_slow_noise(seed):
    """A filter for the whole residual would predict the curved outflow of a slow tank, and leave nothing to explain."""
    blank = levels(seed, 2.0)
    y = tank(curved=3e-5).simulate(blank)
    noise = 0.005 * np.std(y) * np.random.default_rng(seed + 10).standard_normal(y.shape)
    found = pilfr.diagnose(tank(), blank.with_(y=y + noise), laws=(Relaxation,), workers=1)
    assert found.verdict == "unexplained", found.sentence


@pytest.mark.parametrize(
    ("k", "T", "share", "load"), [(1.0, 20.0, 0.002, 40.0), pytest.param(4.0, 30.0, 0.01, 30.0, marks=pytest.mark.slow)]
)
def test_creep_under_a_load_before_the_recording_is_no_slow_noise(k, T, share, load):
    """The law begins at a state that the recorded inputs never bring about."""
    u = 10 * np.asarray(multisine(1200, f_max=2.0, fs=20.0, rng=np.random.default_rng(2))).reshape(-1, 1)
    whole = np.concatenate([load + u[np.arange(6000) % 1200], u])
    true = cart().with_element("ground", Relaxation().at({"k_v": k, "T": T}))
    before = Recording(whole, whole, 0.05, ("force",), ("pos",), initial="zero", hold="zero")
    y = true.simulate(before)[6000:]
    y = y + share * np.std(y) * np.random.default_rng(3).standard_normal(y.shape)
    train = Recording(u, y, 0.05, ("force",), ("pos",), initial="estimate", hold="zero")
    found = pilfr.diagnose(cart(), train, laws=(Relaxation, CubicDamping), effects=1, workers=1)
    assert [e.law for e in found.effects] == ["creep"], found.sentence


@pytest.mark.parametrize("kind", ["random", "sweep", "sine"])
def test_a_force_is_told_from_slow_noise(kind):
    """A force explains the innovations of the residual as well."""
    t = 0.05 * np.arange(1200)
    signals = {
        "random": 20 * multisine(1200, f_max=3.0, fs=20.0, rng=np.random.default_rng(1)),
        "sweep": 10 * np.sin(2 * np.pi * (0.2 + 0.015 * t) * t)[:, None],
        "sine": 10 * np.sin(2 * np.pi * 0.7 * t)[:, None],
    }
    blank = Recording(signals[kind], signals[kind], 0.05, ("force",), ("pos",), initial="zero", hold="zero")
    y = cart().with_element("ground", CubicDamping().at({"c_3": 0.05})).simulate(blank)
    noise = 1e-3 * np.std(y) * np.random.default_rng(2).standard_normal(y.shape)
    bench = Workbench.of(cart(), [blank.with_(y=y + noise)], "zero")
    refit = bench.fit(cart())
    assert max(flexible_shares(bench, refit).values()) > 0.5
    assert innovation_share(bench, refit) > 0.1


@pytest.mark.parametrize("offset", [0.0, 3.0])
def test_an_offset_that_earns_nothing_beside_a_law_is_held_at_nothing(offset):
    placed = rig().with_element("actuator:force", Offset())
    law = CoulombFriction().at({"F_c": 4.0, "v_0": 0.01}, {"v_0": (1e-4, 1.0), "F_c": (0.0, np.inf)})
    train = [r.with_(u=r.u - offset) for r in recordings(law.at({"F_c": 4.0, "v_0": 0.01}), count=1)]
    bench = Workbench.of(placed, train, "zero")
    fitted = bench.fit(placed.with_element("ground-m1", law), [{"actuator:force.w_0": 2.0}])
    found = fix_idle_offsets(bench, fitted)
    assert bool(np.all(found.simulator.parameters["actuator:force.w_0"].fixed)) is (offset == 0)
    assert found.values["actuator:force.w_0"] == pytest.approx(offset, abs=0.02 * offset)
    assert found.values["ground-m1.F_c"] == pytest.approx(4.0, rel=0.03)


def test_a_refit_that_was_compared_with_nothing_is_not_said_to_predict_best():
    shares = {"named": 0.0, "learned": 0.0, "left": 1.0}
    assert "no time left to compare" in Correction((), shares).sentence
    assert "nothing that was tried" in Correction((), shares, before=0.1, after=0.1).sentence
    untested = Correction((("guide", "coulomb_friction", "smooth"),), {**shares, "named": 0.8}, late=True).sentence
    assert "far better" in untested and "no time left to test" in untested


def of_cart(seed, simulator=None, dt=0.05, **changes):
    """A noisy recording of a cart."""
    rng = np.random.default_rng(seed)
    u = 10 * multisine(600, f_max=3.0, fs=20.0, rng=rng)
    blank = Recording(u, u, 0.05, ("force",), ("pos",), initial="zero", hold="zero")
    y = (simulator or cart()).simulate(blank)
    return blank.with_(y=y + 1e-3 * np.std(y) * rng.standard_normal(y.shape), dt=dt, **changes)


def test_of_several_faults_the_one_that_was_the_mismatch_is_told():
    r = of_cart(1)
    y = -r.y
    y[300] += 5.0
    found = pilfr.diagnose(cart(), r.with_(y=y), laws=(CoulombFriction,), effects=1, workers=1)
    assert found.verdict == "recording-fault" and "wrong sign" in found.sentence
    assert {g.finding for g in found.gates if g.fault} >= {"sign", "glitch"}


def test_recordings_of_a_logger_with_a_wrong_unit_of_time_are_corrected_before_their_step_is_checked():
    slow, other = (of_cart(seed, dt=50.0) for seed in (1, 2))  # in ms
    found = pilfr.diagnose(cart(), slow, test=other, laws=(CoulombFriction,), effects=1, workers=1)
    assert found.verdict == "recording-fault" and [g.finding for g in found.gates] == ["time-unit"]
    assert found.nrmse(other) == pytest.approx(found.errors["test"]["after"], rel=1e-9)
    assert found.nrmse(other) < 0.002


def test_a_known_offset_of_the_user_stays_in_the_corrected_simulator():
    offset = cart().with_element("sensor:pos", Offset().at({"w_0": 2.0}))
    name = f"{offset.elements[-1].prefix}w_0"
    known = offset.with_parameters({**offset.parameters, name: replace(offset.parameters[name], fixed=True)})
    train, test = of_cart(1, known), of_cart(2, known)
    found = pilfr.diagnose(known, train, test=test, laws=(CoulombFriction,), effects=1, workers=1)
    assert (
        found.verdict == "complete"
        and found.corrected.elements[-1].own(found.corrected.parameter_set.unpack(found.corrected.parameter_set.start))[
            "w_0"
        ]
        == 2.0
    )
    assert found.nrmse(test) == pytest.approx(found.errors["test"]["after"], rel=1e-9)
    assert found.nrmse(test) < 0.002 and "pos" in str(found)


def test_samples_that_do_not_count_do_not_make_a_value_more_certain():
    r = of_cart(1)
    errors = []
    for counted in (r.with_(skip=400), r.slice(400).with_(initial="estimate")):
        bench = Workbench.of(cart(), [counted], "zero")
        errors.append(standard_errors(bench, bench.fit(bench.simulator)))
    for name in ("d", "k"):
        assert errors[0][name] == pytest.approx(errors[1][name], rel=0.3)


def test_an_offset_whose_error_is_unknown_stays_told():
    offset = cart().with_element("sensor:pos", Offset().at({"w_0": 0.5}))
    bench = Workbench.of(offset, [of_cart(1, offset)], "zero")
    fitted = bench.fit(offset, [{}])
    (gate,) = list_offsets(fitted.simulator.elements, fitted.values)
    for error, told in ((np.nan, 1), (0.3, 0), (1e-3, 1)):
        assert len(update_offsets([gate], fitted, {gate.parameter: np.array(error)}, True, True)) == told
    ringing = replace(fitted, residual=[np.sin(np.arange(len(e)))[:, None] for e in fitted.residual])
    assert update_offsets([gate], ringing, {gate.parameter: np.array(0.3)}, True, True)  # whose mean is known well


@pytest.mark.parametrize("laws", [(), (CoulombFriction,)])
def test_nothing_is_missing_where_the_simulator_meets_the_recordings_exactly(laws):
    """Recordings that were simulated with it leave an error of zero."""
    u = 10 * multisine(200, f_max=3.0, fs=20.0, rng=np.random.default_rng(1))
    blank = Recording(u, u, 0.05, ("force",), ("pos",), initial="zero", hold="zero")
    found = pilfr.diagnose(cart(), blank.with_(y=cart().simulate(blank)), laws=laws, workers=1)
    assert found.verdict == "complete" and found.errors["train"]["after"] < 1e-12


@pytest.fixture(scope="module")
def dry_friction():
    """A recording of a cart with dry friction, without noise."""
    u = 10 * multisine(200, f_max=3.0, fs=20.0, rng=np.random.default_rng(1))
    blank = Recording(u, u, 0.05, ("force",), ("pos",), initial="zero", hold="zero")
    true = cart().with_element("ground", CoulombFriction().at({"F_c": 3.0, "v_0": 0.01}))
    return blank.with_(y=true.simulate(blank))


def test_a_search_that_the_time_limit_ended_does_not_blame_the_catalogue(dry_friction):
    found = pilfr.diagnose(cart(), dry_friction, laws=(CubicDamping,), effects=1, workers=1)
    search = found.evidence.search
    answer = replace(posterior(search), effects=())
    assert "none of the laws tried (cubic damping) explains all of it" in judge(search, answer, ()).sentence
    search.laws = CATALOGUE
    assert "no law of the catalogue explains all of it" in judge(search, answer, ()).sentence
    search.out_of_time = True
    said = judge(search, answer, ()).sentence
    assert "the time limit ended the search after one effect, which does not explain all of it" in said


def test_without_laws_no_law_is_blamed_and_an_offset_is_no_closest_law(dry_friction):
    found = pilfr.diagnose(cart(), dry_friction.with_(y=0.2 + dry_friction.y), laws=(), workers=1)
    assert found.sentence.startswith("Physics is missing, and no law (none was allowed) explains it.")
    search = found.evidence.search
    assert any(t.laws for t in search.memo.values()) and closest_hypothesis(search) is None
    search.laws, search.memo = CATALOGUE, {frozenset(): search.root}
    said = judge(search, replace(posterior(search), effects=()), ()).sentence
    assert said.startswith("Physics is missing, and no law was fitted, because all that is left may be noise.")


def test_where_no_effect_is_allowed_the_rest_is_not_called_noise(dry_friction):
    found = pilfr.diagnose(cart(), dry_friction, laws=None, effects=0, workers=1)
    assert found.sentence.startswith("Physics is missing, and no law was fitted, as asked for. Refitted,"), (
        found.sentence
    )


def test_a_law_without_a_sure_name_may_leave_only_the_noise(dry_friction):
    true = cart().with_element("ground", CubicDamping().at({"c_3": 0.5}))
    y = true.simulate(dry_friction)
    noise = 0.01 * np.std(y) * np.random.default_rng(0).standard_normal(y.shape)
    found = pilfr.diagnose(cart(), dry_friction.with_(y=y + noise), laws=(CubicDamping,), effects=1, workers=1)
    said = judge(found.evidence.search, replace(posterior(found.evidence.search), effects=()), ()).sentence
    assert said.startswith("Physics is missing, most likely at ground. The closest law, cubic damping at ground, remo")
    assert said.endswith("down to the noise; but it is not sure that it is the physics, so the name is not stated.")


def test_laws_without_a_sure_name_are_printed_with_those_that_explain_as_much(dry_friction):
    """A delay of a linear machine acts alike at its input and at its output."""
    true = cart().with_element("actuator:force", Delay().at({"T": 0.12}))
    y = true.simulate(dry_friction)
    noise = 0.01 * np.std(y) * np.random.default_rng(0).standard_normal(y.shape)
    found = pilfr.diagnose(cart(), dry_friction.with_(y=y + noise), laws=(Delay,), effects=1, workers=1)
    best = posterior(found.evidence.search).best
    (e,) = best.laws
    unnamed = replace(found.correction, closest=best, elements=((e.port, e.law.id, e.law.form),))
    shown = str(replace(found, effects=(), verdict="unexplained", correction=unnamed))
    other = {"actuator:force", "sensor:pos"} - {e.port}
    assert f"without a sure name: delay at {e.port}\n  {e.law.equation}\n  T = 0.1" in shown
    assert f"\n  cannot be told apart from delay at {(twin := other.pop())}\n" in shown
    page = nameless_blocks(replace(found, effects=(), verdict="unexplained", correction=unnamed))
    assert page[0].text == f"Delay at {e.port}:" and page[1].code == e.law.equation
    assert page[2].rows[0][0] == "T" and page[3].text == f"These recordings cannot tell it apart from delay at {twin}."


def test_one_hypothesis_is_told_where_the_time_ended_before_a_comparison(dry_friction):
    """The closest law, the corrected simulator and the shares are all of that one."""
    found = pilfr.diagnose(cart(), dry_friction, laws=(CubicDamping,), effects=1, workers=1)
    search = found.evidence.search
    search.bench = replace(search.bench, deadline=0.0)
    answer = replace(posterior(search), effects=())
    correction, fitted = find_unnamed_correction(search)
    assert correction.late and correction.closest.fitted is fitted
    said = judge(search, answer, (), correction.closest).sentence
    assert f"removes {100 * correction.shares['named']:.0f} % of the mismatch" in said


def test_a_large_error_of_a_few_times_the_noise_is_not_said_to_be_complete():
    """It may be slow noise as well, and the sentence says so."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-10, 10, 40), 10)[:, None]
    blank = Recording(u, u, 0.05, ("force",), ("pos",), initial="zero", hold="zero")
    y, slow = cart().simulate(blank), lfilter([1], [1, -0.9], rng.standard_normal((600, 1)), axis=0)[200:]
    r = blank.with_(y=y + 0.2 * np.std(y) * slow / np.std(slow))
    found = pilfr.diagnose(cart(), r, laws=(CoulombFriction,), effects=1, workers=1)
    assert found.verdict == "unexplained"
    assert found.sentence.startswith(
        "Physics is missing, or the noise is large and slow, and none of the laws tried (C"
    )


def test_an_offset_is_told_beside_which_nothing_is_missing():
    true = cart().with_element("sensor:pos", Offset().at({"w_0": 5e-4}))
    found = pilfr.diagnose(cart(), of_cart(1, true), laws=(CoulombFriction,), effects=1, workers=1)
    assert found.sentence.startswith("Nothing is missing but the offset of pos, as far as the laws tried can show")


def test_a_law_that_removes_much_of_the_mismatch_says_where_it_acts():
    """The drag of a bicycle in wind: a force beside the linearised simulator shows little at its port."""
    rng, t = np.random.default_rng(0), 1.0
    power, wind = np.repeat(rng.uniform(50, 400, 30), 25), np.repeat(rng.uniform(-1, 1, 75), 10)
    speed = np.full(750, 6.0)
    for k in range(749):
        v = speed[k]
        for _ in range(10):
            v += t / 10 * (power[k] / max(v, 1) - 4 - 0.3 * abs(v + wind[k]) * (v + wind[k])) / 80
        speed[k + 1] = v
    bicycle = Simulator(
        lambda x, u, p: {"v": (u.P / ca.fmax(x.v, 1.0) - p.rolling) / p.m},
        lambda x: {"v": x.v},
        states=("v",),
        inputs=("P",),
        parameters={"m": Parameter(80.0, bounds=(60, 100)), "rolling": Parameter(5.0, bounds=(0, 40))},
        ports=Port("road", lambda p: {"v": -1 / p.m}, lambda x: x.v),
    )
    y = (speed + 0.02 * rng.standard_normal(750))[:, None]
    recording = Recording(power[:, None], y, t, inputs="P", outputs="v", hold="zero")
    found = pilfr.diagnose(bicycle, recording, laws=("quadratic_drag",), effects=1)
    assert found.verdict == "unexplained" and "quadratic drag at road, removes 34 %" in found.sentence
    assert found.sentence.startswith("Physics is missing, most likely at road,")


def test_samples_at_rest_are_no_evidence():
    """A cart moves for 120 samples, and every model lets it stand afterwards."""
    u = np.concatenate([np.repeat([8.0, 0, -8.0, 0], 15), np.zeros(3060)])[:, None]
    blank = Recording(u, u, 0.05, ("force",), ("pos",), initial="zero", hold="zero")
    dry = cart().with_element("ground", CoulombFriction(values={"F_c": 3.0}))
    found = pilfr.diagnose(cart(), blank.with_(y=dry.simulate(blank)), laws=(CoulombFriction,), effects=1)
    assert found.evidence.search.count < 120
