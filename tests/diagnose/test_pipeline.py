"""How a search is begun anew, with the other hold or without a shift, and what an interrupt on the way leaves."""

import signal
from dataclasses import replace

import numpy as np
import pytest
from diagnosis_example import recorded, rig as cart_rig
from diagnosis_rig import OFF, recordings, rig
from spring_rig import shaken, spring

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Recording, Simulator, laws
from pilfr_casadi._base import Stages
from pilfr_casadi.diagnose.arguments import Request
from pilfr_casadi.diagnose.faults.gates import Gate
from pilfr_casadi.diagnose.faults.offsets import WrongStart
from pilfr_casadi.diagnose.preparation import prepare
from pilfr_casadi.diagnose.repetitions import _search_once


def diagnosed(simulator, r, tried=(), press="", after="", **options):
    """Diagnose; press Ctrl-C when the stage `press` begins, of several the first one after `after`.

    Also returns the stages in their order.
    """
    stages, pressed = [], []

    def note(stage, done, total, best):
        if done == 0:
            stages.append(stage)
            if stage == press and after in ("", *stages[:-1]) and not pressed:
                pressed.append(stage)
                signal.raise_signal(signal.SIGINT)

    found = pilfr.diagnose(simulator, r, laws=tried, workers=1, progress=note, **options)
    assert found.interrupted is bool(press)
    return found, stages


@pytest.mark.parametrize("said", [None, pytest.param("zero", marks=pytest.mark.slow)])
def test_how_inputs_are_held_is_asked_of_the_data_unless_it_is_said(said):
    found = pilfr.diagnose(spring(), shaken("linear", m=500), hold=said, laws=(), workers=1)
    assert found.hold == (said or "linear")
    assert (found.errors["train"]["after"] < 1e-3) is (said is None)


def test_a_hold_that_is_said_is_not_asked_of_the_data():
    found = prepare(spring(), [shaken("linear", m=500)], "zero", "auto")
    assert found.bench.hold == "zero" and found.without.cost > 1e-3**2


def stiffened(k_3, m, **options):
    """A recording of the spring, which stiffens, with interpolated inputs unless another hold is given."""
    return shaken(options.pop("hold", "linear"), m=m, law=laws.CubicStiffness(values={"k_3": k_3}), **options)


@pytest.mark.slow
@pytest.mark.parametrize("press", ["", "other hold: checks and refit"], ids=["taken", "interrupted"])
def test_a_law_shows_that_the_other_hold_is_nearer(press):
    """Beside the error of the refit, that of the hold hardly counts."""
    found, stages = diagnosed(spring(), stiffened(1e6, 400), (laws.CubicStiffness,), press, effects=1)
    assert stages[0] == "checks and refit" and "other hold: checks and refit" in stages
    assert found.hold == ("zero" if press else "linear")
    assert [g.finding for g in found.gates] == ([] if press else ["hold"])
    assert [e.law for e in found.effects] == ["cubic_stiffness"]
    assert (found.errors["train"]["after"] < 0.01) is not bool(press)


def test_a_law_shows_that_inputs_are_band_limited():
    found, stages = diagnosed(spring(), stiffened(1e6, 400, hold="band-limited"), (laws.CubicStiffness,), effects=1)
    assert found.hold == "band-limited" and "other hold: checks and refit" in stages
    (note,) = (g.sentence for g in found.gates if g.finding == "hold")
    assert "inputs that are band-limited there fit better" in note
    assert [e.law for e in found.effects] == ["cubic_stiffness"] and found.errors["train"]["after"] < 0.01


def leak(a=1.0):
    """A tank with a pinned outlet, whose smaller time constant looks like an early output."""
    return Simulator(
        lambda x, u, p: {"h": p.gain * u.q - p.a * x.h},
        lambda x: {"level": x.h},
        ("h",),
        ("q",),
        {"a": Parameter(a, fixed=True), "gain": Parameter(1.0, bounds=(0.1, 10))},
        Port("outlet", {"h": -1.0}, lambda x: x.h),
    )


@pytest.fixture(scope="module")
def leaking():
    """A recording of the tank with a larger outlet, at frequencies near to each other."""
    rng, t = np.random.default_rng(0), 0.05 * np.arange(160)
    u = sum(np.cos(2 * np.pi * f * t + rng.uniform(0, 6.28)) for f in np.linspace(0.2, 0.5, 7))
    blank = Recording(u, u, 0.05, ("q",), ("level",), initial="zero", hold="zero")
    y = leak(3.0).simulate(blank)
    return blank.with_(y=y + 1e-3 * np.std(y) * rng.standard_normal(y.shape), initial="estimate")


@pytest.mark.slow
def test_what_seems_early_and_is_a_law_is_searched_as_it_is(leaking):
    found, stages = diagnosed(leak(), leaking, (laws.LinearStiffness,), effects=1, engine="vm")
    assert stages.count("checks and refit") == 2 and found.gates == ()
    assert (found.verdict, found.freed) == ("complete", "a")
    assert found.errors["train"]["after"] < 1.2e-3


def test_an_interrupt_of_the_second_search_leaves_the_shift(leaking):
    found, stages = diagnosed(leak(), leaking, (), "checks and refit", "flexible", effects=0, engine="vm")
    assert stages.count("checks and refit") == 2
    assert [(g.channel, g.finding) for g in found.gates] == [("level", "alignment")]


@pytest.mark.slow
def test_a_channel_that_is_early_beside_something_unexplained_stays_shifted():
    r = stiffened(5e3, 600, hold="zero", early=6)
    found, stages = diagnosed(spring(), r, (), effects=0, hold="zero")
    assert stages.count("checks and refit") == 2
    assert [(g.channel, g.finding, g.value) for g in found.gates] == [("pos, vel", "alignment", -0.12)]


@pytest.mark.parametrize(
    ("after", "answered"), [pytest.param("conclusion", True, marks=pytest.mark.slow), ("checks and refit", False)]
)
def test_an_answer_that_is_there_outlives_an_interrupt_of_what_adds_to_it(leaking, after, answered):
    """In the conclusion, other ports are searched where no law at a declared one explains the mismatch."""
    r = leaking.with_(u=leaking.u[::-1])  # no shift explains it
    pump = replace(leak(), ports=(Port("pump", {"h": -1.0}, lambda u: u.q),))  # the outlet has no port
    found, _ = diagnosed(pump, r, (), "screen", after, effects=0, engine="vm")
    assert found.verdict == "unexplained"
    assert ("interrupted before" in found.sentence) is not answered


def test_two_effects_at_two_ports_are_both_named():
    true = cart_rig().with_element("ground", laws.CubicStiffness().at({"k_3": 2e4}))
    true = true.with_element("actuator:force", laws.Saturation().at({"L": 10.0}))
    train, test = (recorded(true, seed, samples=n) for seed, n in ((0, 500), (1, 400)))
    tried = (laws.CubicStiffness, laws.Saturation)
    found = pilfr.diagnose(cart_rig(430.0, 5.0), train, test=test, laws=tried, hold="zero", workers=1)
    assert_both_are_named(found, {("ground", "cubic_stiffness"), ("actuator:force", "saturation")})


@pytest.mark.slow
def test_two_effects_between_two_masses_are_both_named():
    one = laws.CubicStiffness(values={"k_3": 4e5})
    true = [("ground-m1", one), ("m1-m2", laws.CoulombFriction(values={"F_c": 4.0, "v_0": 0.01}))]
    whole = recordings_of(true)[0]
    tried = (laws.CubicStiffness, laws.CoulombFriction)
    found = pilfr.diagnose(rig(OFF), whole.slice(0, 700), test=whole.slice(700, 1100), laws=tried, workers=1)
    assert_both_are_named(found, {(port, law.id) for port, law in true})


def assert_both_are_named(found, true):
    """Both effects are named surely, nothing but noise is left, and each is needed on the test recording."""
    assert {(e.port, e.law) for e in found.effects} == true, str(found)
    assert min(e.confidence for e in found.effects) > 0.8
    assert found.errors["train"]["after"] < 1.2 * found.floor["nrmse"]
    # each by itself leaves most of the error on the test recording
    assert min(e.test_without for e in found.effects) > 3 * found.errors["test"]["after"]


def recordings_of(placed):
    """A recording of the rig with laws at several ports."""
    true = rig()
    for port, law in placed[:-1]:
        true = true.with_element(port, law)
    port, law = placed[-1]
    return recordings(law, port=port, count=1, of=true)


@pytest.mark.parametrize(
    "missing",
    [
        pytest.param((), id="none"),
        pytest.param((laws.CoulombFriction().at({"F_c": 40.0, "v_0": 0.02}),), id="friction", marks=pytest.mark.slow),
    ],
)
def test_a_simulator_without_a_free_parameter_is_diagnosed(missing):
    held = rig()
    held = held.with_parameters({name: replace(p, fixed=True) for name, p in held.parameters.items()})
    record = recordings(*missing, count=1)[0].slice(0, 700)
    tried = [laws.CoulombFriction, laws.CubicStiffness]
    found = pilfr.diagnose(held, record, workers=1, laws=tried, effects=1)
    named = [(e.port, e.law) for e in found.effects]
    assert named == ([("ground-m1", "coulomb_friction")] if missing else [])
    assert found.verdict == ("missing-physics" if missing else "complete")


def oven(heat=1400.0, inner=5.0, outer=2.5, radiating=0.0):
    """A heated load in a wall, temperatures above the room's; the wall may radiate."""

    def dynamics(x, u, p):
        through, hot = p.inner * (x.wall - x.load), x.wall + 295.0
        outside = p.outer * x.wall + radiating * (hot**4 - 295.0**4)
        return {"wall": (u.power - through - outside) / p.heat, "load": (through - 0.8 * x.load) / 4500}

    return Simulator(
        dynamics,
        lambda x: {"load": x.load},
        ("wall", "load"),
        ("power",),
        {
            "heat": Parameter(heat, bounds=(500, 4000)),
            "inner": Parameter(inner, bounds=(1, 20)),
            "outer": Parameter(outer, bounds=(0, 10)),
        },
        Port("walls", lambda p: {"wall": -1 / p.heat}, lambda x: x.wall, unit="W", across_unit="K"),
        hold="zero",
    )


def heated(warm, offset):
    """A recording, said to begin at zero, of a radiating oven that begins warm and has a sensor with an offset."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(0, 2500, 12), 40)[:, None]
    blank = Recording(u, 0 * u, 15.0, ("power",), ("load",), initial=[warm, warm])
    y = oven(1500.0, 6.0, 1.8, radiating=1.2e-8).simulate(blank) + offset
    return blank.with_(y=y + 0.3 * rng.standard_normal(y.shape), initial="zero")


@pytest.mark.parametrize(
    ("warm", "offset", "press"),
    [(22.0, 0.0, ""), (0.0, 22.0, ""), (22.0, 0.0, "unknown start: checks and refit")],
    ids=["start", "zero", "interrupted"],
)
def test_missing_physics_shows_whether_the_start_or_the_zero_of_a_sensor_is_wrong(warm, offset, press):
    """Unknown radiation makes a wrong zero look likelier than a wrong start."""
    tried = (laws.Radiation, laws.PiecewiseStiffness)
    found, stages = diagnosed(oven(), heated(warm, offset), tried, press, effects=1)
    (gate,) = (g for g in found.gates if g.finding == "start")
    assert stages.count("unknown start: checks and refit") == 1
    assert gate.corrected is (warm > 0 and not press), gate.sentence
    assert ("a search with them estimated follows better" in gate.sentence) is gate.corrected
    if not press:
        assert [e.law for e in found.effects] == ["radiation"]
        assert [g.finding for g in found.gates if g.fault and g is not gate] == (["offset"] if offset else [])


def test_a_repeated_search_knows_the_corrections_of_its_recordings():
    """So no repetition of a repetition loses a finding, or the error at the values given."""
    r = stiffened(1e6, 200).with_(initial="zero")
    request = Request(spring(), (r,), (), "linear", "auto", 1, 0, 0.0, np.inf, Stages(lambda *_: None))
    start = WrongStart("initial state", "start", "zero", change=lambda one: one.with_(initial="estimate"))
    shown = Gate("force", "unit", 1.0, change=lambda one: one.with_(u=2 * one.u))
    once = request.corrected((start,), 0.7, "unknown start: ")
    twice = once.corrected((shown,), 0.7, "again: ")
    assert twice.recordings[0].begins == "estimate" and np.array_equal(twice.recordings[0].u, 2 * r.u)
    for asked, gates in ((once, (start,)), (twice, (start, shown))):
        found = _search_once(asked, correct_early=False)
        assert found.ready.gates[: len(gates)] == gates and found.ready.nominal == 0.7
        assert found.search.bench.recordings[0].begins == "estimate"
