"""The one scale of all hypotheses: log evidence, and what a posterior makes of it."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from diagnosis_rig import OFF, recordings, rig

import pilfr_casadi as pilfr
from pilfr_casadi import laws
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.fits.evidence import (
    WRONG_MODEL_SAMPLES,
    EffectiveSamples,
    information,
    log_evidence,
    log_prior,
    runs_away,
    spread,
)
from pilfr_casadi.diagnose.posterior import share_named
from pilfr_casadi.optimise import Problem

NONE = np.zeros(0)


def test_samples_of_noise_count_and_those_of_a_wrong_model_do_not_shout():
    few, many = (EffectiveSamples(1e-4, count) for count in (500, 50_000))
    assert many.at(1.0) == pytest.approx(few.at(1.0), rel=0.02) == pytest.approx(WRONG_MODEL_SAMPLES, rel=0.02)
    assert few.at(1e-4) > 10 * few.at(1.0)
    assert few.at(1e-4) < 500


@pytest.mark.parametrize("n", [8.0, 150.0])
def test_a_parameter_has_to_pay_for_itself(n):
    """One that the data determine well costs half the logarithm of its information; a dead one costs nothing."""
    alone = log_evidence(0.01, NONE, 0.0, n)
    assert log_evidence(0.01, np.array([0.0]), 0.0, n) == alone
    dear, dearer = (alone - log_evidence(0.01, np.array([size]), 0.0, n) for size in (1.0, 4.0))
    assert dearer - dear == pytest.approx(0.5 * np.log(4), rel=0.05)
    assert log_evidence(0.01 * np.exp(-2.6 * dear / n), np.array([1.0]), 0.0, n) > alone


def test_what_diverges_has_no_evidence():
    assert log_evidence(np.inf, NONE, 0.0, 8.0) == -np.inf


def test_the_prior_is_shared_by_ports_laws_and_forms():
    placed = rig().with_element("ground-m1", laws.CubicStiffness()).elements
    one = {"ground-m1": (laws.CubicStiffness(), laws.ViscousDamping())}
    two = {**one, "m1-m2": one["ground-m1"]}
    forms = {"ground-m1": (*one["ground-m1"], laws.QuinticStiffness())}
    assert log_prior((), one) == 0
    assert log_prior(placed, one) - log_prior(placed, two) == pytest.approx(np.log(2))
    assert log_prior(placed, one) - log_prior(placed, forms) == pytest.approx(np.log(2))
    assert log_prior(placed, one, doubtful=True) < log_prior(placed, one)


def test_laws_of_the_domain_of_a_port_are_likelier_and_no_law_is_so_at_a_mechanical_one():
    port = pilfr.Port("wall", {"T": -1.0}, lambda x: x.T, unit="W", across_unit="K")
    warm = pilfr.Simulator(lambda x: {"T": -x.T}, lambda x: {"y": x.T}, states=("T",), ports=port)
    there = {"wall": (laws.Radiation(), laws.CubicStiffness(), laws.ViscousDamping())}
    own, general = (warm.with_element("wall", law).elements for law in there["wall"][:2])
    for domains in (None, {"wall": "unknown"}, {"wall": "mechanical"}):
        assert log_prior(own, there, domains=domains) == log_prior(general, there) == np.log(1 / 6)
    known = {"wall": "thermal"}
    assert log_prior(own, there, domains=known) == pytest.approx(log_prior(general, there, domains=known) + np.log(4))
    ids = (log_prior(warm.with_element("wall", law).elements, there, domains=known) for law in there["wall"])
    assert sum(map(np.exp, ids)) == pytest.approx(0.5)  # one more effect is as likely as not


def test_a_law_that_is_rare_in_the_domain_of_a_port_is_less_likely():
    room = pilfr.Simulator(lambda x: {"T": -x.T}, lambda x: {"y": x.T}, states=("T",))
    there = {"sensor:y": (laws.Backlash(), laws.Saturation())}
    play, limit = (room.with_element("sensor:y", law).elements for law in there["sensor:y"])
    for domain, ratio in (("thermal", 4), ("mechanical", 1), ("unknown", 1)):
        domains = {"sensor:y": domain}
        assert log_prior(limit, there, domains=domains) - log_prior(play, there, domains=domains) == pytest.approx(
            np.log(ratio)
        )


def test_a_dead_zone_is_less_likely_at_a_sensor_than_at_an_actuator():
    machine = pilfr.Simulator(lambda x, u: {"v": u.f - x.v}, lambda x: {"y": x.v}, states=("v",), inputs=("f",))
    ratios = []
    for port in ("actuator:f", "sensor:y"):
        there = {port: (laws.DeadZone(), laws.Saturation())}
        gap, limit = (log_prior(machine.with_element(port, law).elements, there) for law in there[port])
        ratios.append(gap - limit)
    assert ratios == pytest.approx([0, -np.log(4)])


def test_a_parameters_unit_does_not_change_its_information():
    train = recordings(laws.CubicStiffness(values={"k_3": 3e5}), count=1)
    bench = Workbench.of(rig(OFF), train, "zero")
    fitted = bench.fit(rig(OFF).with_element("ground-m1", laws.CubicStiffness()))
    (told,) = information(bench, fitted, fitted.simulator.elements)
    assert 0 < told <= 1  # its prior width moves the outputs by their deviation, the simulator's own follow a part
    softer = replace(bench, scale=2 * bench.scale)
    assert information(softer, fitted, fitted.simulator.elements)[0] == pytest.approx(told, rel=1e-6)
    assert information(bench, fitted, ()).size == 0


def test_values_that_two_levels_of_an_input_hardly_determine_spread_predictions_between_them():
    """A line through two levels predicts those between them; a parabola through two levels does not."""
    device = pilfr.Simulator(
        lambda: {},
        lambda u, p: {"force": p.area * u.pressure + p.offset},
        inputs=("pressure",),
        parameters={
            "area": pilfr.Parameter(1.0, bounds=(-10, 10)),
            "offset": pilfr.Parameter(0.0, bounds=(-10, 10)),
        },
    )
    rng = np.random.default_rng(0)
    records = []
    for level in (1.0, 7.0):
        y = level + 0.01 * rng.standard_normal((200, 1))
        records.append(pilfr.Recording(np.full((200, 1), level), y, 0.01, inputs=("pressure",), outputs=("force",)))
    bench = Workbench.of(device, records, "zero")
    line, parabola = (
        bench.fit(s) for s in (device, device.with_element("sensor:force", laws.Quadratic(limits={"a_2": (-1, 1)})))
    )
    v = (0.01 / bench.scale[0]) ** 2
    of_line, of_parabola = (spread(bench, f, f.simulator.elements, v, 100.0) for f in (line, parabola))
    assert of_line < 0.1 * v  # two values from a hundred samples
    assert of_parabola > 100 * v


def test_other_inputs_that_lead_past_an_unstable_rest_do_not_count_as_ignorance_of_the_parameters():
    """Between two wells, inputs 0.7 times as large come to rest on the ridge, where any small change grows."""
    wells = pilfr.Simulator(
        lambda x, u, p: {"x": p.a * (x.x - x.x**3) + u.push},
        lambda x: {"x": x.x},
        states=("x",),
        inputs=("push",),
        parameters={"a": pilfr.Parameter(1.0, bounds=(0.2, 5))},
        hold="zero",
    )
    t = 0.1 * np.arange(600)
    push = pilfr.Recording(0.66 * np.sin(0.2 * t), np.zeros(600), 0.1, ("push",), ("x",), initial="zero")
    y = wells.simulate(push) + 0.01 * np.random.default_rng(0).standard_normal((600, 1))
    bench = Workbench.of(wells, [push.with_(y=y)], "zero")
    fitted = bench.fit(wells)
    assert spread(bench, fitted, (), fitted.cost, 600.0) < 0.01 * fitted.cost  # one value from 600 samples


def test_a_vibration_that_does_not_occur_does_not_make_predictions_less_sure():
    """The recording begins in the course of a slow motion, which hardly excites a plate that hardly damps."""
    plate = pilfr.Simulator(
        lambda x, u, p: {"q": x.v, "v": p.w**2 * (u.force - x.q) - 2 * p.zeta * p.w * x.v},
        lambda x: {"q": x.q},
        states=("q", "v"),
        inputs=("force",),
        parameters={"w": pilfr.Parameter(60.0, bounds=(30, 120)), "zeta": pilfr.Parameter(1e-3, bounds=(1e-4, 0.1))},
        hold="linear",
    )
    t = 0.01 * np.arange(800)[:, None] + 1
    force = np.sin(1.3 * t) + np.sin(2.1 * t + 1)
    y = force + 0.05 * np.random.default_rng(0).standard_normal(force.shape)
    bench = Workbench.of(plate, [pilfr.Recording(force, y, 0.01, ("force",), ("q",))], "linear")
    fitted = bench.fit(plate)
    assert spread(bench, fitted, (), fitted.cost, 800.0) < 4 / 800 * fitted.cost  # two values and two states


def test_first_states_of_laws_do_not_make_predictions_less_sure_and_those_of_the_simulator_do():
    """Each piece of a recording has a first state of the lag, which says nothing of other inputs, and of the heater."""
    heater = pilfr.Simulator(
        lambda x, u, p: {"T": (p.g * u.heat - x.T) / p.tau},
        lambda x: {"T": x.T},
        states=("T",),
        inputs=("heat",),
        parameters={"g": pilfr.Parameter(1.0, bounds=(0.1, 10)), "tau": pilfr.Parameter(5.0, bounds=(0.5, 50))},
        hold="zero",
    )
    rng = np.random.default_rng(0)
    heat = np.repeat(rng.standard_normal((40, 1)), 20, axis=0)
    whole = pilfr.Recording(heat, np.zeros((800, 1)), 1.0, ("heat",), ("T",), initial="zero")
    whole = whole.with_(y=heater.simulate(whole) + 0.1 * rng.standard_normal((800, 1)))
    by_heater, by_lag = [], []
    for count in (1, 2, 4, 8):
        pieces = [
            r.with_(initial="estimate") for r in (whole.slice(k, k + 800 // count) for k in range(0, 800, 800 // count))
        ]
        bench = Workbench.of(heater, pieces, "zero")
        alone, lagged = (bench.fit(s) for s in (heater, heater.with_element("sensor:T", laws.Lag().at({"T": 2.0}))))
        of_both = [spread(bench, f, f.simulator.elements, f.cost, 8.0) / f.cost for f in (alone, lagged)]
        by_heater.append(of_both[0])
        by_lag.append(of_both[1] - of_both[0])
    assert max(by_lag) < 0.4  # one value more, eight samples
    assert by_heater[-1] - by_heater[0] == pytest.approx(7 / 8, abs=0.1)  # seven states more


def test_the_more_a_force_would_follow_of_the_rest_the_less_the_name_is_believed():
    shares = [share_named(s) for s in (0.0, 0.003, 0.03, 0.3, 1.0)]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > 0.95 and shares[-1] < 0.2


def test_the_same_law_at_two_ports_that_cannot_be_told_apart_is_sure_all_the_same():
    """Two dampers in series positions of one body: between the same two points."""
    simulator = rig(OFF)
    first = simulator.port("ground-m1")
    twin = replace(simulator, ports=(*simulator.ports, replace(first, name="twin")))
    train = recordings(laws.CubicStiffness(values={"k_3": 3e5}), count=1)
    tried = (laws.CubicStiffness, laws.QuadraticDrag)
    found = pilfr.diagnose(twin, train[0].slice(0, 700), laws=tried, effects=1, hold="zero", workers=1)
    (effect,) = found.effects
    assert effect.law == "cubic_stiffness" and effect.confidence > 0.9
    assert {effect.port, *(port for port, _ in effect.indistinguishable)} == {"ground-m1", "twin"}
    assert " at ground-m1 (or twin)." in found.sentence or " at twin (or ground-m1)." in found.sentence


def test_derivatives_that_overflow_give_no_information(monkeypatch):
    """As at the edge of divergence; no decomposition would exist."""
    law = laws.CoulombFriction().at({"F_c": 4.0, "v_0": 0.01})
    simulator = rig().with_element("ground-m1", law)
    bench = Workbench.of(simulator, recordings(law, count=1), "zero")
    fitted = bench.run(simulator, {}, [np.zeros(len(simulator.states))])
    size = len(bench.problem_at(fitted)[1])
    square = np.full((size, size), 1e200) - 2e200 * np.eye(size)
    monkeypatch.setattr(Problem, "normal", lambda self, theta: (1.0, np.zeros(size), square))
    assert np.all(np.isinf(information(bench, fitted, fitted.last_elements(1))))


@pytest.mark.parametrize(("stiffness", "away"), [(0.0, False), (300.0, False), (-700.0, True)])
def test_a_stiffness_that_is_negative_at_a_level_of_an_input_runs_away_there(stiffness, away):
    """The recording visits the level for a moment only, and is followed."""
    simulator = pilfr.Simulator(
        lambda x, u, p: {"pos": x.vel, "vel": u.force - 400.0 * x.pos - p.d * x.vel},
        lambda x: {"pos": x.pos},
        states=("pos", "vel"),
        inputs=("force", "heat"),
        parameters={"d": pilfr.Parameter(4.0, bounds=(0, 20))},
        ports=pilfr.Port("ground", {"vel": -1.0}, lambda x: x.pos, lambda x: x.vel, "N", "m"),
    )
    rng = np.random.default_rng(1)
    heat = (np.arange(600) // 5 == 60).astype(float)
    u = np.column_stack([np.convolve(rng.standard_normal(600), np.ones(8) / 8, "same"), heat])
    r = pilfr.Recording(u, u[:, :1], 0.01, ("force", "heat"), ("pos",), initial="zero")
    r = r.with_(y=simulator.simulate(r))
    bench = Workbench.of(simulator, [r], "zero")
    refitted = bench.fit(simulator)
    shape = {"k_1": 0.0, "k_1_high": stiffness, "low": 0.0, "high": 1.0}
    varied = simulator.with_element("ground", laws.scheduled(laws.LinearStiffness, "heat")().at(shape))
    found = bench.run(varied, {}, refitted.initial)
    assert found.cost < 0.1 and runs_away(bench, found, refitted) == away


def test_a_pendulum_that_turns_over_at_a_held_torque_does_not_run_away():
    arm = pilfr.Simulator(
        lambda x, u, p: {"angle": x.speed, "speed": (u.torque - p.d * x.speed - ca.sin(x.angle)) / 0.02},
        lambda x: {"angle": x.angle},
        states=("angle", "speed"),
        inputs=("torque",),
        parameters={"d": pilfr.Parameter(0.03, bounds=(0, 1))},
    )
    torque = np.clip(0.5 * np.repeat(np.random.default_rng(5).standard_normal(80), 10), -0.65, 0.65)
    r = pilfr.Recording(torque, np.zeros(800), 0.01, ("torque",), ("angle",), hold="zero", initial="zero")
    r = r.with_(y=arm.simulate(r))
    bench = Workbench.of(arm, [r], "zero")
    refitted = bench.fit(arm)
    stronger = arm.with_element("actuator:torque", laws.PowerWithGain().at({"a": 0.0, "n": 0.5, "b": 0.3}))
    found = bench.run(stronger, {}, refitted.initial)
    held = r.with_(u=np.full((800, 1), 0.65))
    assert np.max(np.abs(arm.simulate(held))) < 4 < 50 < np.max(np.abs(stronger.simulate(held)))
    assert not runs_away(bench, found, refitted)
