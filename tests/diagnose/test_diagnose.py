"""The diagnosis end to end on a rig whose truth is known, and its honest other answers."""

import json
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from cart import cart
from diagnosis_rig import DT, OFF, SAMPLES, recordings, rig

import pilfr_casadi as pilfr
from pilfr_casadi import InputError, Parameter, Port, Recording, Simulator, multisine
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.arguments import match_tests
from pilfr_casadi.laws import CATALOGUE, Backlash, CoulombFriction, CubicStiffness, Delay, DirectionalDamping

IDS = {
    "cubic_stiffness",
    "quadratic_stiffness",
    "piecewise_stiffness",
    "clearance",
    "coulomb_friction",
    "stribeck_friction",
    "quadratic_drag",
    "cubic_damping",
    "hysteresis",
    "backlash",
    "saturation",
    "dead_zone",
    "static_curve",
    "delay",
    "creep",
    "drift",
    "periodic_force",
    "extra_mode",
    "linear_stiffness",
    "viscous_damping",
}


def test_the_catalogue_holds_every_law_of_the_contract():
    assert {law.id for law in CATALOGUE} >= IDS
    for law in CATALOGUE:
        assert law.equation
        assert law.source
        assert law.sentence
        assert set(law.strength) <= set(law.units)


@pytest.mark.parametrize(
    ("port", "law"),
    [
        pytest.param("ground-m1", CubicStiffness().at({"k_3": 4e5}), marks=pytest.mark.slow),
        pytest.param("m1-m2", CoulombFriction().at({"F_c": 4.0, "v_0": 1e-3}), marks=pytest.mark.slow),
        pytest.param("sensor:x2", Backlash().at({"r": 0.002}), marks=pytest.mark.slow),
    ],
    ids=lambda v: v if isinstance(v, str) else v.id,
)
def test_a_hidden_law_is_named_at_its_port(port, law):
    train, test = recordings(law, port=port), recordings(law, port=port, seed=7, count=1)
    found = pilfr.diagnose(rig(OFF), train, test=test)
    assert found.verdict == "missing-physics"
    assert [(e.port, e.law) for e in found.effects] == [(port, law.id)]
    assert found.effects[0].confidence > 0.8
    errors = found.errors["test"]
    assert errors["after"] < 1.3e-3 < errors["before"]
    for name, truth in (("k1", 1100), ("k2", 3000)):
        assert found.parameters[name]["refit_with"] == pytest.approx(truth, rel=0.03)
    answer = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert answer["verdict"] == "missing-physics"
    assert {"port", "law", "nrmse_train", "nrmse_validation", "delta_bic"} <= set(answer["candidates"][0])


@pytest.fixture(scope="module")
def plain():
    """A recording that the simulator can follow."""
    return recordings(count=1)


def test_nothing_missing_is_said(plain):
    found = pilfr.diagnose(rig(OFF), plain)
    assert found.verdict == "complete"
    assert not found.effects
    assert found.errors["test"] is None


FEW = (Backlash, CoulombFriction, CubicStiffness, Delay)


def test_a_wrong_sign_is_a_fault_of_the_recording():
    train = [r.with_(y=-r.y) for r in recordings(count=1)]
    found = pilfr.diagnose(rig(OFF), train, laws=FEW)
    assert found.verdict == "recording-fault"
    assert [(g.channel, g.finding) for g in found.gates] == [("x2", "sign")]


@pytest.mark.slow
def test_an_output_before_its_cause_is_a_fault_of_the_recording():
    train = [r.with_(y=np.vstack([r.y[7:], np.repeat(r.y[-1:], 7, axis=0)])) for r in recordings()]
    found = pilfr.diagnose(rig(OFF), train)
    assert found.verdict == "recording-fault"
    assert found.gates[-1].finding == "alignment"
    assert found.gates[-1].value == pytest.approx(-7 * 2e-3, abs=2e-4)


@pytest.mark.slow
def test_a_shift_is_whole_though_nobody_said_what_inputs_do_between_samples():
    """Half a sample more or less, and inputs held or interpolated: the one may look like the other."""
    cut = [(r.u[:-9], r.y[9:]) for r in recordings(hold="linear")]
    train = [pilfr.Recording(u, y, 2e-3, ("force",), ("x2",), initial="estimate") for u, y in cut]
    found = pilfr.diagnose(rig(OFF), train)
    assert (found.verdict, found.hold) == ("recording-fault", "linear")
    shift = next(g for g in found.gates if g.finding == "alignment")
    assert shift.value == pytest.approx(-9 * 2e-3, abs=1e-9)


def test_a_clipped_output_is_a_fault_of_the_recording():
    records = recordings(count=1)
    limit = 0.6 * max(np.abs(r.y).max() for r in records)
    found = pilfr.diagnose(rig(OFF), [r.with_(y=np.clip(r.y, -limit, limit)) for r in records], laws=FEW)
    assert found.verdict == "recording-fault"
    assert [g.finding for g in found.gates] == ["clipping"]


@pytest.mark.slow
def test_the_next_experiment_stays_within_the_users_limits():
    """A delay before or behind a linear rig is the same; only what the rig does not do linearly can tell them apart."""
    law = Delay(values={"T": 3.3e-3}, limits={"T": (0.0, 0.02)})
    train = [r.with_(initial="estimate") for r in recordings(law, port="sensor:x2")]
    found = pilfr.diagnose(rig(OFF), train, limits={"force": 7.0})
    assert [(e.law, e.indistinguishable) for e in found.effects] in (
        [("delay", (("actuator:force", "delay"),))],
        [("delay", (("sensor:x2", "delay"),))],
    )
    assert found.effects[0].confidence > 0.8  # the law is sure, the place is not
    assert (
        found.next_experiment["between"]
        == [["sensor:x2", "delay"], ["actuator:force", "delay"]][:: 1 if found.effects[0].port == "sensor:x2" else -1]
    )
    assert found.next_experiment.get("amplitude", 0.0) <= 7.0
    with pytest.raises(InputError, match="limit"):
        pilfr.diagnose(rig(OFF), train, limits={"voltage": 1.0})


def test_a_test_recording_without_outputs_is_refused_before_the_fits(plain, monkeypatch):
    monkeypatch.setattr(Workbench, "fit", None)  # nothing is fitted
    inputs_alone = plain[0].with_(y=np.empty((len(plain[0]), 0)), outputs=())
    with pytest.raises(pilfr.InputError, match="has no outputs to compare with; name the measured columns"):
        pilfr.diagnose(rig(), plain, test=inputs_alone)


def test_test_data_that_was_trained_on_is_refused(plain):
    whole, m = plain[0], len(plain[0])

    def part(start, stop):
        return whole.with_(u=whole.u[start:stop], y=whole.y[start:stop], initial="estimate")

    for test in (whole, part(m // 2, m)):
        with pytest.raises(pilfr.InputError, match="equals a training recording or a part of one"):
            pilfr.diagnose(rig(), plain, test=test)
    for train, test in ((part(0, 500), part(300, 900)), (part(300, 900), part(0, 500))):
        with pytest.raises(pilfr.InputError, match=f"200 of the {len(test)} samples of a test recording are training"):
            pilfr.diagnose(rig(), train, test=test)


LOOSE = Backlash(values={"r": 1.0})


@pytest.mark.parametrize(
    ("factor", "words"),
    [(1e3, "too large by a factor of 1000"), (1e-3, "x2 is too small"), (-1, "x2 has the wrong sign")],
)
def test_a_wrong_channel_of_the_test_recordings_is_told_and_judges_nothing(factor, words):
    train, test = recordings(LOOSE, port="actuator:force", count=2)
    right = test.with_(name="right")
    for tests in (test.with_(y=factor * test.y), [right, test.with_(y=factor * test.y, name="wrong")]):
        found = pilfr.diagnose(rig(OFF), train, test=tests, laws=FEW)
        (fault,) = (g for g in found.gates if g.finding == "test fault")
        assert (found.verdict, found.outcome, fault.channel) == ("missing-physics", "", "x2")
        assert words in fault.sentence and fault.sentence in found.summary and "worse" not in found.summary
        assert "test range" not in {g.finding for g in found.gates}
        assert not any("test error" in text for text in found.warnings())
    assert "In the test recording wrong," in fault.sentence


def test_correct_tests_are_not_blamed_for_faults_of_the_training_data_nor_for_physics_of_their_own():
    train, test = recordings(count=2)
    found = pilfr.diagnose(rig(OFF), train.with_(y=-train.y), test=test, laws=FEW)
    assert [g.finding for g in found.gates if g.corrected] == ["sign"]
    assert "test correction" in {g.finding for g in found.gates} and not found.test_fault
    hard = CubicStiffness(values={"k_3": 4e5})
    loud = rig(OFF).with_element("ground-m1", hard).simulate(test.with_(u=60 * test.u))
    found = pilfr.diagnose(rig(OFF), train, test=test.with_(u=60 * test.u, y=loud), laws=FEW)
    assert found.errors["test"]["after"] > 1 and not found.test_fault
    (note,) = (g.sentence for g in found.gates if g.finding == "test range")
    assert note.startswith("The test recordings go beyond the training recordings: force reaches ")
    assert "x2 reaches" in note and "frequencies" not in note


def test_frequencies_of_the_test_recordings_that_training_does_not_have_are_told():
    t, (train, test) = DT * np.arange(SAMPLES), recordings(count=2)
    machine = rig().with_element("actuator:force", Delay(values={"T": 0.01}))
    train, test = (
        r.with_(u=u[:, None], y=machine.simulate(r.with_(u=u[:, None], y=np.zeros((len(u), 1)))))
        for r, u in ((train, 5 * np.sin(2 * np.pi * 1 * t)), (test, 5 * np.sin(2 * np.pi * 8 * t)))
    )
    found = pilfr.diagnose(rig(OFF), train, test=test, laws=())
    (note,) = (g.sentence for g in found.gates if g.finding == "test range")
    assert re.search(r" \S+ % of force is at frequencies that it hardly has in training", note)
    assert "force reaches" not in note


def test_an_offset_that_the_test_recordings_do_not_have_is_told():
    rng = np.random.default_rng(0)

    def dynamics(x, u, p):
        return {"T": (p.g * (u.heat + p.load) - x.T) / 10}

    def heater(load, g=1.0):
        gain, load = Parameter(g, bounds=(0.1, 10)), Parameter(load, fixed=True)
        return Simulator(
            dynamics, lambda x: {"T": x.T}, states=("T",), inputs=("heat",), parameters={"g": gain, "load": load}
        )

    def record(load, level, name):
        heat = level + np.repeat(rng.standard_normal(30), 20)[:, None]
        r = Recording(heat, np.zeros((600, 1)), 1.0, name=name, initial="zero", inputs="heat", outputs="T", hold="zero")
        return r.with_(y=heater(load).simulate(r) + 1e-3 * rng.standard_normal((600, 1)))

    train, test = record(1.0, 3.0, "train"), record(0.0, 0.0, "test")
    found = pilfr.diagnose(heater(0.0, 1.2), train, test=test, laws=())
    assert [g.finding for g in found.gates if g.fault] == ["offset"]
    errors = found.errors["test"]
    assert errors["before"] < 0.4 < errors["after"] and found.outcome == "worse"
    assert "with the offset of heat it follows the test recordings worse than without" in found.summary
    assert not found.refitted.elements and len(found.corrected.elements) == 1
    recurring = pilfr.diagnose(heater(0.0, 1.2), train, test=record(1.0, 0.0, "test"), laws=())
    errors = recurring.errors["test"]
    assert recurring.outcome == "better" and errors["after"] < 0.01 < errors["before"]


def test_an_offset_beside_an_effect_that_the_test_recordings_do_not_have_is_told():
    train, test = recordings(CubicStiffness(values={"k_3": 4e5}), count=2)
    shifted = train.with_(y=train.y + 2 * np.std(train.y))
    found = pilfr.diagnose(rig(OFF), shifted, test=test, laws=(CubicStiffness,))
    assert [e.law for e in found.effects] == ["cubic_stiffness"] and found.outcome == "worse"
    (note,) = (g.sentence for g in found.gates if g.finding == "test offset")
    assert note in found.summary and note.startswith("The test recordings hardly have the offset of x2: at zero offset")
    assert float(re.search(r"there is (\S+) %", note)[1]) < 1


def test_recordings_say_what_inputs_do_between_samples_before_arguments_and_simulator():
    train, test = (r.slice(0, 600) for r in recordings(hold="linear"))
    sloped = replace(rig(), hold="zero")
    found = pilfr.diagnose(sloped, train, test=test, hold="zero", laws=())
    assert found.hold == "linear"
    assert found.errors["test"]["nominal"] == pytest.approx(sloped.nrmse(test), rel=1e-3)
    held = test.with_(hold="zero")
    for call, words in (
        (lambda: found.nrmse(held), "states hold='zero', and the simulator was fitted with 'linear'"),
        (lambda: pilfr.diagnose(rig(), train, test=held, laws=()), "states hold='zero'"),
        (lambda: pilfr.diagnose(rig(), [train, held], laws=()), "differ in `hold`"),
        (lambda: pilfr.check(rig(), [train, held]), "differ in `hold`"),
        (lambda: pilfr.diagnose(rig(), train.with_(hold=None), test=test, laws=()), "state it for both"),
        (lambda: pilfr.diagnose(rig(), train, laws=(), limits=[1.0]), "amplitudes by input"),
    ):
        with pytest.raises(InputError, match=words):
            call()


def test_tests_may_begin_in_the_training_data_where_they_are_not_scored(plain):
    whole = plain[0]
    train, after = (
        whole.with_(u=whole.u[part], y=whole.y[part], initial="estimate") for part in (slice(0, 500), slice(400, 900))
    )
    assert len(match_tests(rig(), after.with_(skip=100), [train], "zero")) == 1
    still = np.zeros((600, 1))
    quiet = train.with_(u=still[:500], y=np.vstack([train.y[:400], still[:100]]))
    begin = train.with_(u=still[:500], y=np.vstack([still[:60], train.y[:440]]))
    assert len(match_tests(rig(), begin, [quiet], "zero")) == 1


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ({"workers": 0}, "workers is 0; give a whole number, 1 or more"),
        ({"effects": -1}, "effects is -1"),
        ({"progress": "yes"}, "progress = 'yes' was given; give True"),
        ({"hold": "cubic"}, "hold is 'cubic'"),
        ({"laws": ["friction"]}, "no law 'friction'; did you mean .*coulomb_friction"),
        ({"time_limit": "5"}, "time_limit='5' was given; give seconds"),
        ({"stand_in_error": np.nan}, "stand_in_error=nan was given"),
        ({"limits": {"force": "5"}}, "The limit of force is '5'"),
        ({"laws": [7]}, "laws holds 7; give classes of laws"),
    ],
)
def test_bad_options_are_refused_at_once(plain, option, words):
    with pytest.raises(pilfr.InputError, match=words):
        pilfr.diagnose(rig(), plain, **option)


def cart_recording():
    u = 10 * multisine(200, f_max=3.0, fs=20, rng=np.random.default_rng(0))
    r = Recording(u, u, 0.05, ("force",), ("pos",), initial="zero", hold="zero")
    return r.with_(y=cart(k=60.0).simulate(r))


@pytest.mark.parametrize(
    "port",
    [
        Port("ground", lambda x: {"vel": 1 / x.pos}, lambda x: x.pos),
        Port("ground", {"vel": -1.0}, lambda x: 1 / x.pos, lambda x: x.vel),
    ],
)
def test_a_port_that_divides_by_zero_is_refused(port):
    with pytest.raises(InputError, match="port 'ground' is not finite along the recordings"):
        pilfr.diagnose(cart(ports=port), cart_recording(), laws=["CoulombFriction"], effects=1, workers=1, engine="vm")


def test_a_port_without_a_force_warns_of_nothing():
    train = cart_recording()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pilfr.check(cart(ports=Port("ground", {"vel": 0.0}, lambda x: x.pos)), train, laws=["CoulombFriction"])


def test_an_output_that_is_no_number_is_said():
    broken = replace(cart(), outputs=lambda x: {"pos": x.pos / (x.vel - x.vel)})
    with pytest.raises(InputError, match="pos is not finite 0 s into"):
        pilfr.diagnose(broken, cart_recording(), workers=1)


def test_a_missing_column_is_said(plain):
    train = [r.with_(outputs=("x3",)) for r in plain]
    with pytest.raises(pilfr.InputError, match="no output 'x2'"):
        pilfr.diagnose(rig(), train)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("left_out", "hidden", "port", "name", "strength"),
    [
        ("d1", None, "ground-m1", "viscous_damping", {"c_1": 8.0}),
        ("k1", None, "ground-m1", "linear_stiffness", {"k_1": 1100.0}),
        ("d2", DirectionalDamping().at({"c_0": 2.0}), "m1-m2", "viscous_damping", {"c_1": 4.0, "c_0": 2.0}),
    ],
)
def test_a_spring_or_damper_that_was_left_out_is_named(left_out, hidden, port, name, strength):
    full = rig(OFF)
    none = {left_out: replace(full.parameters[left_out], value=0.0, bounds=(0.0, 1.0), fixed=True)}
    found = pilfr.diagnose(full.with_parameters({**full.parameters, **none}), recordings(hidden, port=port))
    assert [(e.port, e.law) for e in found.effects] == [(port, name)]
    assert found.effects[0].confidence > 0.8
    for symbol, truth in strength.items():
        assert found.effects[0].parameters[symbol]["value"] == pytest.approx(truth, rel=0.05)


def test_values_that_are_known_only_together_say_so():
    """Of a product, the factors have no standard errors; a note names them."""
    rng = np.random.default_rng(0)
    u = rng.standard_normal(400)
    r = pilfr.Recording(u, 6 * u + 0.01 * rng.standard_normal(400), 0.01, ("volt",), ("gauge",), initial="zero")
    amplifier = pilfr.Simulator(
        lambda: {},
        lambda u, p: {"gauge": p.gain * p.sensitivity * u.volt + p.zero},
        inputs=("volt",),
        parameters={name: pilfr.Parameter(2.0) for name in ("gain", "sensitivity")} | {"zero": pilfr.Parameter(0.0)},
    )
    found = pilfr.diagnose(amplifier, r, laws=[Delay], workers=1)
    assert found.verdict == "complete"
    (note,) = [g for g in found.gates if g.finding == "combination"]
    assert note.sentence == (
        "These recordings determine gain and sensitivity only in combination, so they have no standard errors."
    )
    assert found.parameters["gain"]["std"] is None
    assert found.parameters["zero"]["std"] is not None


def test_values_without_effect_are_a_blind_spot_and_no_combination():
    """An input that stands still hides its gains; no combination of them is determined."""
    rng = np.random.default_rng(0)
    u = np.column_stack([rng.standard_normal(400), np.zeros(400)])
    y = 2 * u[:, 0] + 0.01 * rng.standard_normal(400)
    r = pilfr.Recording(u, y, 0.01, ("volt", "aux"), ("gauge",), initial="zero")
    amplifier = pilfr.Simulator(
        lambda: {},
        lambda u, p: {"gauge": p.g * u.volt + p.a * u.aux + p.b * u.aux**2},
        inputs=("volt", "aux"),
        parameters={name: pilfr.Parameter(1.5) for name in ("g", "a", "b")},
    )
    found = pilfr.diagnose(amplifier, r, laws=[Delay], workers=1)
    assert "combination" not in [g.finding for g in found.gates]
    assert ("dead", ("a", "b")) in [(spot.kind, spot.names) for spot in found.blind_spots]
