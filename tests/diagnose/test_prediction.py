"""Prediction focus: an observer leads an unstable simulator along recordings of its closed loop."""

from dataclasses import replace
from functools import partial

import casadi as ca
import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Recording, Simulator
from pilfr_casadi._base import InputError
from pilfr_casadi.diagnose import Workbench, repetitions
from pilfr_casadi.diagnose.prediction import drifts, observer, observer_keeps_up
from pilfr_casadi.diagnose.search.moves import Search
from pilfr_casadi.engine import make_engine
from pilfr_casadi.laws import CoulombFriction, CubicStiffness, Gain
from pilfr_casadi.simulators import discretise

DT, SAMPLES = 0.01, 1500
GAINS = 60.0, 8.0  # of the controller, which the simulator does not know


def levitation(a=25.0, d=0.5):
    """A body on a spring of negative stiffness, as in a magnetic bearing."""
    return Simulator(
        lambda x, u, p: {"q": x.v, "v": p.a * x.q - p.d * x.v + u.f},
        lambda x: {"gap": x.q},
        states=("q", "v"),
        inputs=("f",),
        parameters={"a": Parameter(a, bounds=(5, 1e5)), "d": Parameter(d, bounds=(0, 10))},
        ports=Port("guide", into={"v": -1.0}, across=lambda x: x.q, rate=lambda x: x.v, unit="N"),
        hold="zero",
    )


def controlled(seed, friction=1.5):
    """Record the body under its controller, with Coulomb friction in its guide."""
    rng = np.random.default_rng(seed)
    plant = levitation()
    if friction:
        plant = pilfr.close_loop(plant, CoulombFriction(), "guide")
        known = {"guide.F_c": friction, "guide.v_0": 0.01}
        own = {k: replace(p, value=known.get(k, p.value), bounds=(0, np.inf)) for k, p in plant.parameters.items()}
        plant = plant.with_parameters(own)
    model = discretise(plant, DT, "zero", 10)
    x, u = ca.SX.sym("x", model.n_state), ca.SX.sym("u")
    sample = ca.Function("sample", [x, u], [model.closed(x, u, model.parameters.start)[0]]).fold(model.substeps)
    reference = 4 * np.cumsum(rng.standard_normal(SAMPLES)) * DT
    x, y, u = np.zeros(2), np.zeros((SAMPLES, 1)), np.zeros((SAMPLES, 1))
    for k in range(SAMPLES):
        y[k] = x[0] + 1e-3 * rng.standard_normal()
        u[k] = -GAINS[0] * (y[k, 0] - reference[k]) - GAINS[1] * x[1] + rng.normal(0, 3)
        x = np.asarray(sample(x, np.full((1, model.substeps), u[k, 0]))).ravel()
    return Recording(u, y, DT, ("f",), ("gap",), hold="zero")


@pytest.fixture(scope="module")
def machine():
    return controlled(0), controlled(1)


@pytest.mark.parametrize("memory", [3.0, 0.1])
@pytest.mark.parametrize("push", [25.0, 0.0], ids=["unstable", "integrator"])
def test_every_eigenvalue_of_the_observer_forgets_within_its_memory(machine, memory, push):
    rig = replace(levitation(), dynamics=lambda x, u, p: {"q": x.v, "v": push * x.q - p.d * x.v + u.f})
    model = discretise(replace(rig, observer=observer(rig, machine[:1], "zero", memory)), DT, "zero", 1)
    read = [0.0, 0.0, 1.0]  # input, measured output, and that a sample is taken
    moved = [model.closed(unit, read, model.parameters.start)[0] for unit in np.eye(2)]
    step = np.column_stack([np.asarray(x).ravel() for x in moved])
    assert np.max(np.abs(np.linalg.eigvals(step))) <= np.exp(-DT / memory) + 1e-6


def test_predictions_read_each_measured_sample_once_and_later(machine):
    led = replace(levitation(), observer=np.array([[0.3], [2.0]]))
    r = machine[0]
    other = r.with_(y=r.y + 0.1 * (np.arange(SAMPLES) == 700)[:, None])
    before, after = led.simulate(r), led.simulate(other)
    changed = np.flatnonzero(np.abs(after - before)[:, 0] > 0)
    assert changed[0] == 701
    assert after[701] - before[701] == pytest.approx(0.3 * 0.1, rel=1e-6)


@pytest.mark.parametrize("substeps", [1, 4])
def test_the_engines_agree_on_predictions_and_their_slopes(machine, substeps):
    led = replace(levitation(), observer=np.array([[0.3], [2.0]]))
    model = discretise(pilfr.close_loop(led, CoulombFriction(), "guide"), DT, "zero", substeps)
    p, x = model.parameters.start, np.zeros(model.n_state)
    runs = [make_engine(model, engine).simulate(model.drive(machine[0]), p, x)[0] for engine in ("c", "vm")]
    assert np.allclose(*runs, rtol=0, atol=1e-10)


@pytest.mark.usefixtures("blank_figures")
def test_friction_in_an_unstable_machine_is_named_and_a_complete_simulator_is_too(machine, tmp_path):
    laws = (CoulombFriction, CubicStiffness)
    found = pilfr.diagnose(levitation(30.0, 1.0), machine[0], test=machine[1], laws=laws, workers=1)
    assert [(e.port, e.law) for e in found.effects] == [("guide", "coulomb_friction")]
    assert found.effects[0].parameters["F_c"]["value"] == pytest.approx(1.5, rel=0.05)
    assert found.errors["test"]["after"] < 0.3 * found.errors["test"]["before"]
    assert found.errors["free_run"]["after"] > 100 * found.errors["test"]["after"]
    assert "free run" in str(found) and "unstable by itself" in str(found)
    assert found.nrmse(machine[1]) == pytest.approx(found.errors["test"]["after"], rel=1e-6)
    page = found.report(tmp_path).read_text()
    assert "the error of predictions one sample ahead is" in page and "the same, free run" in page
    assert found.to_casadi().size1_in(1) == 1  # the exported step reads no measured output
    complete = pilfr.diagnose(levitation(30.0, 1.0), controlled(2, 0.0), laws=laws, workers=1)
    assert complete.verdict == "complete"


def cart():
    """A cart on rails: a free integrator."""
    return Simulator(
        lambda x, u, p: {"q": x.v, "v": p.k * u.f - p.d * x.v},
        lambda x: {"pos": x.q},
        states=("q", "v"),
        inputs=("f",),
        parameters={"k": Parameter(1.0, bounds=(0.1, 12)), "d": Parameter(0.2, bounds=(0, 5))},
        ports=Port("rails", into={"v": -1.0}, across=lambda x: x.q, rate=lambda x: x.v),
        hold="zero",
    )


def pushed(friction, push, noise):
    """Record the cart under its controller, with friction, while somebody pushes it at random."""
    rng, dt, count = np.random.default_rng(0), 0.1, 400
    wish, pos, vel = 0.2 * np.cumsum(rng.standard_normal(count)), 0.0, 0.0
    u, y = np.zeros((count, 1)), np.zeros((count, 1))
    for k in range(count):
        y[k] = pos + noise * rng.standard_normal()
        u[k] = -1.5 * (y[k, 0] - wish[k]) - 1.5 * vel
        more = push * rng.standard_normal()
        for _ in range(20):
            pos += dt / 20 * vel
            vel += dt / 20 * (1.3 * u[k, 0] - 0.3 * vel + more - friction * np.tanh(vel / 0.01))
    return Recording(u, y, dt, ("f",), ("pos",), hold="zero")


@pytest.mark.parametrize(("friction", "push"), [(0.0, 0.3), (0.4, 0.02)])
def test_laws_do_not_imitate_an_observer_that_forgets_sooner(friction, push):
    laws = (Gain, CoulombFriction)
    found = pilfr.diagnose(cart(), pushed(friction, push, 2e-3), laws=laws, focus="prediction", workers=1)
    named = [(e.port, e.law) for e in found.effects]
    assert named == ([("rails", "coulomb_friction")] if friction else [])
    assert found.corrected.parameters["k"].value == pytest.approx(1.3, rel=0.15)
    assert "Disturbances that nobody recorded move the machine" in str(found)


def test_laws_stay_if_the_time_ends_in_the_search_with_a_shorter_memory(monkeypatch):
    repeated = []

    def without_time(first, search):
        repeated.append(search)
        return again(first, partial(search.func, replace(search.args[0], deadline=0.0)))

    again = repetitions._repeat
    monkeypatch.setattr(repetitions, "_repeat", without_time)
    laws = (Gain, CoulombFriction)
    found = pilfr.diagnose(cart(), pushed(0.4, 0.02, 2e-3), laws=laws, focus="prediction", workers=1)
    assert repeated and [(e.port, e.law) for e in found.effects] == [("rails", "coulomb_friction")]


def test_effects_that_a_short_memory_hardly_shows_stay_if_they_are_the_likeliest_there_too(monkeypatch):
    """A sensor with little noise favours a memory of a sample, with which the simulator hardly predicts at all."""

    def forget_within_a_sample(search, simulator, memory):
        gain = observer(simulator, search.bench.recordings, search.bench.hold, 0.12)
        return replace(simulator, observer=gain), 0.12

    monkeypatch.setattr(repetitions, "forget_sooner", forget_within_a_sample)
    laws = (Gain, CoulombFriction)
    found = pilfr.diagnose(cart(), pushed(0.4, 0.02, 1e-3), laws=laws, focus="prediction", workers=1)
    assert [(e.port, e.law) for e in found.effects] == [("rails", "coulomb_friction")]
    assert "shows them too little" in str(found) and "forget its past within 4 s" in str(found)


def test_predictions_are_advised_if_a_free_run_drifts_and_took_all_the_time(monkeypatch):
    monkeypatch.setattr(Search, "cut_short", True)
    found = pilfr.diagnose(cart(), pushed(0.4, 0.3, 2e-3), laws=(Gain,), workers=1)
    assert found.verdict == "unexplained" and "--focus prediction" in str(found)
    assert "there was no time for them" in str(found)


def test_predictions_that_time_ended_are_told_as_begun(monkeypatch):
    cut_short = property(lambda search: search.bench.simulator.observer is not None)
    monkeypatch.setattr(Search, "cut_short", cut_short)
    found = pilfr.diagnose(cart(), pushed(0.4, 0.3, 2e-3), laws=(Gain,), workers=1)
    assert found.verdict == "unexplained" and "time ran out before they gave an answer" in str(found)


def test_a_sensor_that_reads_more_does_not_forget_sooner():
    rig = replace(levitation(), observer=np.array([[0.3], [2.0]]))
    scaled = rig.with_element("sensor:gap", Gain().at({"g": 9.0}))

    def forgets(simulator):
        model = discretise(simulator, DT, "zero", 1)
        moved = [model.closed(unit, [0.0, 0.0, 1.0], model.parameters.start)[0] for unit in np.eye(2)]
        return np.column_stack([np.asarray(x).ravel() for x in moved])

    np.testing.assert_allclose(forgets(scaled), forgets(rig), atol=1e-12)


def test_the_focus_can_be_stated(machine):
    with pytest.raises(InputError, match="let the recordings lead it, by the focus 'prediction'"):
        pilfr.diagnose(levitation(), machine[0], focus="simulation")
    with pytest.raises(InputError, match="focus='errors' was given; use 'simulation', 'prediction' or None"):
        pilfr.diagnose(levitation(), machine[0], focus="errors")


def test_a_wrong_gain_is_refused():
    with pytest.raises(InputError, match="a row for each of 2 states and a column for each of 1 outputs"):
        replace(levitation(), observer=np.ones((1, 2)))


def test_what_grows_within_a_sample_cannot_be_led(machine):
    assert observer_keeps_up(levitation(), machine)
    assert not observer_keeps_up(levitation(2e4), machine)


@pytest.mark.parametrize(
    ("stiffness", "duration", "port", "there"),
    [
        (0.0, SAMPLES, "v", True),  # an integrator
        (25.0, SAMPLES, "v", False),  # a spring with a damper forgets
        (25.0, 100, "v", True),  # but not within a short recording
        (0.0, SAMPLES, "f", False),  # no force at the port gets into the integrator
    ],
)
def test_a_free_run_drifts_if_it_remembers_what_forces_have_done(stiffness, duration, port, there):
    simulator = Simulator(
        lambda x, u, p: {"q": x.v, "v": u.f - 0.5 * x.v - stiffness * x.q, "f": p.rate * (x.v - x.f)},
        lambda x: {"gap": x.q, "load": x.f},
        states=("q", "v", "f"),
        inputs=("f",),
        parameters={"rate": Parameter(9.0, bounds=(1, 100))},
        ports=Port("guide", into={port: -1.0}, across=lambda x: x.q, rate=lambda x: x.v, unit="N"),
    )
    r = Recording(np.ones(duration), np.ones((duration, 2)), DT, ("f",), ("gap", "load"), initial="zero")
    bench = Workbench.of(simulator, [r.with_(y=np.random.default_rng(0).normal(size=(duration, 2)))], "zero")
    assert drifts(bench, bench.fit(simulator)) is there


def test_an_observer_forgets_alike_behind_a_sensor_gain_and_hardly_behind_a_dead_sensor():
    r = pushed(0.0, 0.0, 2e-3)
    led = replace(cart(), observer=observer(cart(), [r], "zero", 0.5))

    def corrected(gain):
        model = discretise(led.with_element("sensor:pos", Gain().at({"g": gain})), r.dt, "zero", 1)
        x = ca.DM.zeros(model.n_state)
        u = ca.vertcat(*({"u": ca.DM(0), "y": ca.DM(1), "sampled": ca.DM(1)}[name] for name in model.reads))
        return model.closed(x, u, model.parameters.start)[0].full().ravel()

    plain = corrected(0.0)
    np.testing.assert_allclose(corrected(1.0), plain / 2, rtol=1e-12)
    assert np.max(np.abs(corrected(-1.0))) == 0 < np.max(np.abs(plain))
