"""When a channel is early, late or of another clock, and how inputs are held."""

import numpy as np
import pytest
from diagnosis_rig import DT, OFF, recordings, rig
from spring_rig import shaken, spring

from pilfr_casadi._base import Stages
from pilfr_casadi.data import Recording
from pilfr_casadi.diagnose import Workbench, diagnose
from pilfr_casadi.diagnose.faults.gates import Checked, Gate, accept, correct
from pilfr_casadi.diagnose.faults.timing import TimeShift, _screen_shifts, find_time_shift
from pilfr_casadi.diagnose.fits.floor import Floor
from pilfr_casadi.diagnose.preparation import hold_note
from pilfr_casadi.diagnose.search.moves import Search
from pilfr_casadi.laws import (
    CoulombFriction,
    CubicStiffness,
    Lag,
    Mode,
)
from pilfr_casadi.models import Parameter
from pilfr_casadi.simulators import Port, Simulator


def test_a_clock_between_the_rates_looked_at_is_found_and_is_that_of_both_outputs():
    bench = Workbench.of(spring(), [shaken("zero", 3.36e-3)], "zero")
    found = find_time_shift(Checked(bench, bench.fit(bench.simulator)))
    gates = found.gates
    assert [(g.channel, g.finding) for g in gates] == [("pos, vel", "clock")] and isinstance(gates[0], Gate)
    assert gates[0].value == pytest.approx(-3.36e-3, rel=0.02)
    assert found.cost**0.5 < 0.02


def slow_and_late(late):
    """A resonance far above its slow input, so that a refit follows a late output in part, by other values."""
    simulator = Simulator(
        lambda x, u, p: {"pos": x.vel, "vel": p.k * (u.force - x.pos) - p.d * x.vel},
        lambda x: {"pos": x.pos},
        states=("pos", "vel"),
        inputs=("force",),
        parameters={"k": Parameter(130.0, bounds=(5, 500)), "d": Parameter(1.6, bounds=(0, 20))},
    )
    rng, m = np.random.default_rng(0), 3000
    u = rng.standard_normal(m)
    for _ in range(3):
        u = np.convolve(u, np.ones(30) / 30**0.5, "same")
    blank = Recording(u[:, None], np.zeros((m, 1)), 0.02, ("force",), ("pos",), initial="zero")
    y = simulator.with_parameters({"k": 100.0, "d": 1.9}).simulate(blank)
    y += 1e-3 * y.std() * rng.standard_normal(y.shape)
    return simulator, Recording(u[late:, None], y[:-late], 0.02, ("force",), ("pos",))


@pytest.mark.parametrize("late", [16, pytest.param(22, marks=pytest.mark.slow)])
def test_a_late_output_is_found_though_the_refit_follows_it_by_wrong_values(late):
    simulator, recording = slow_and_late(late)
    bench = Workbench.of(simulator, [recording], "zero")
    plain = bench.fit(simulator)
    assert 0.1 < plain.cost**0.5 < 0.3 and not 90 < plain.values["k"] < 110
    found = find_time_shift(Checked(bench, plain))
    assert [(g.channel, g.finding, round(g.value / 0.02, 2)) for g in found.gates] == [("pos", "alignment", late)]
    assert found.cost**0.5 < 1.1e-3


def test_a_run_that_diverges_at_the_users_values_tells_of_no_shift():
    simulator = spring().with_parameters({"d": Parameter(-9.0, bounds=(-50, 20))})
    bench = Workbench.of(simulator, [shaken("zero", law=CubicStiffness(values={"k_3": 1e4}))], "zero")
    plain = bench.fit(simulator, [{"d": 1.4}])
    assert [s.finding for s in _screen_shifts(bench, plain)] == []


@pytest.mark.parametrize("late", [0, 5])
def test_a_shift_that_leaves_hardly_a_sample_inside_short_recordings_is_no_fault(late):
    simulator, _ = slow_and_late(1)
    true, rng, short = simulator.with_parameters({"k": 100.0, "d": 1.9}), np.random.default_rng(3), []
    for _ in range(8):
        u = np.convolve(rng.standard_normal(60 + late), np.ones(4) / 2, "same")
        blank = Recording(u[:, None], np.zeros((60 + late, 1)), 0.02, ("force",), ("pos",), initial="zero")
        y = true.simulate(blank)
        y += 0.3 * (late == 0) * y**3 / y.std() ** 2 + 1e-3 * y.std() * rng.standard_normal(y.shape)
        short.append(Recording(u[late:, None], y[: len(y) - late], 0.02, ("force",), ("pos",)))
    bench = Workbench.of(simulator, short, "zero")
    found = find_time_shift(Checked(bench, bench.fit(simulator)))
    assert all(abs(g.value) < 30 * bench.dt for g in found.gates)


@pytest.mark.parametrize("stiffening", [0.0, 1e4])
def test_what_seems_early_while_more_is_wrong_may_be_no_fault(stiffening):
    law = CubicStiffness(values={"k_3": stiffening})
    bench = Workbench.of(spring(), [shaken("zero", law=law, early=6)], "zero")
    plain = bench.fit(spring())
    for early in (True, False):
        gates = find_time_shift(Checked(bench, plain), correct_early=early).gates
        assert [g.finding for g in gates] == (["alignment"] if early or not stiffening else [])


@pytest.mark.parametrize(("hold", "advised"), [("zero", True), ("next", False)])
def test_next_values_are_no_advice_where_they_are_stated(hold, advised):
    bench = Workbench.of(spring(), [shaken(hold, early=1)], hold)
    (early,) = find_time_shift(Checked(bench, bench.fit(spring()))).gates
    assert "too early" in early.sentence and ("hold 'next'" in early.sentence) is advised


def test_why_a_hold_was_chosen_is_said():
    assert "fit better (error 1.3 times smaller)" in hold_note(spring(), "linear", 1.3).sentence
    assert "error 1.03 times smaller; state the hold if you know it)" in hold_note(spring(), "linear", 1.03).sentence
    assert (
        "inputs that are interpolated there fit no worse and are used" in hold_note(spring(), "linear", 1.0004).sentence
    )


@pytest.mark.slow
def test_a_shift_that_missing_friction_hides_is_found_beside_it():
    """With neither, the refit is in a wrong place; a mode of the sensor would imitate the lead."""
    as_recorded = recordings(CoulombFriction().at({"F_c": 10.0, "v_0": 0.005}), count=1)
    early = [r.with_(u=r.u[:-1], y=r.y[1:], initial="estimate") for r in as_recorded]
    found = diagnose(rig(OFF), early, laws=(CoulombFriction, Mode), hold="zero")
    assert [(e.port, e.law) for e in found.effects] == [("ground-m1", "coulomb_friction")]
    assert [(g.channel, g.value) for g in found.gates if g.finding == "alignment"] == [("x2", -DT)]
    assert "(beside Coulomb friction (smooth) at ground-m1)" in str(found)
    assert found.errors["train"]["after"] < 2e-3


def test_a_search_finds_a_shift_beside_its_first_law():
    law = CoulombFriction().at({"F_c": 0.3, "v_0": 0.02})
    early = shaken("zero", m=600, law=law, early=1).with_(initial="estimate")
    bench = Workbench.of(spring(), [early], "zero")
    floor = Floor(1e-4 * bench.scale, "estimated")
    found = Search(bench, bench.fit(spring()), floor, (CoulombFriction,), 1, Stages(lambda *_: None)).run(1)
    assert (found.shift.channel, found.shift.value) == ("pos, vel", -bench.dt)
    assert found.shift.sentence.endswith("(beside Coulomb friction (smooth) at ground).")


def two_motors(m=800, late=0, seed=5):
    """A body that two motors drive with their own gains; the second input is recorded so many samples late."""
    simulator = Simulator(
        lambda x, u, p: {"v": p.a * u.left + p.b * u.right - p.d * x.v},
        lambda x: {"v": x.v},
        states=("v",),
        inputs=("left", "right"),
        parameters={n: Parameter(v, bounds=(0.1, 20)) for n, v in (("a", 2.0), ("b", 3.0), ("d", 1.5))},
    )
    rng, keep = np.random.default_rng(seed), abs(late)
    u = np.stack([np.convolve(c, np.ones(4) / 2, "same") for c in rng.standard_normal((2, m))], axis=1)
    blank = Recording(u, np.zeros((m, 1)), 0.02, ("left", "right"), ("v",), initial="zero")
    y = simulator.with_parameters({"a": 2.4, "b": 2.6, "d": 1.9}).simulate(blank)
    y += 1e-3 * y.std() * rng.standard_normal(y.shape)
    recorded = np.stack([u[:, 0], np.roll(u[:, 1], late)], axis=1)[keep : m - keep]
    return simulator, Recording(recorded, y[keep : m - keep], 0.02, ("left", "right"), ("v",), initial="estimate")


@pytest.mark.parametrize(
    ("late", "words"),
    [
        (7, "right is recorded 7 samples (0.14 s) too late; "),
        (-7, "right is recorded 7 samples (0.14 s) too early, or the machine delays it by as much; "),
    ],
)
def test_an_input_recorded_late_leads_its_effect_and_one_recorded_early_may_be_a_delay(late, words):
    simulator, recording = two_motors(late=late)
    bench = Workbench.of(simulator, [recording], "zero")
    (shift,) = find_time_shift(Checked(bench, bench.fit(simulator))).gates
    assert (shift.channel, shift.finding) == ("right", "alignment") and shift.sentence.startswith(words)
    assert shift.value == pytest.approx(late * 0.02) and shift.leads == (late > 0)


@pytest.mark.parametrize(("late", "findings"), [(2, ["alignment"]), (-2, [])])
def test_a_short_shift_of_an_input_is_a_fault_only_if_no_delay_explains_it(late, findings):
    simulator, recording = two_motors(late=late)
    bench = Workbench.of(simulator, [recording], "zero")
    assert [g.finding for g in find_time_shift(Checked(bench, bench.fit(simulator))).gates] == findings


def test_a_shift_is_judged_on_the_samples_that_it_keeps():
    """A constant input may be read at any time; where that left out the worse part, it seemed to help."""
    car = Simulator(
        lambda x, u, p: {"heading": p.gain * u.speed * u.steering},
        lambda x: {"heading": x.heading},
        ("heading",),
        ("steering", "speed"),
        {"gain": Parameter(3.0, bounds=(1, 9))},
        Port("yaw", {"heading": -1.0}, lambda x: x.heading),
    )
    u = np.column_stack([np.repeat([0.0, 0.2, -0.1, 0.05], 30), np.full(120, 0.3)])
    blank = Recording(u, 0 * u[:, :1], 0.025, car.inputs, ("heading",), initial="zero", hold="zero")
    late = car.with_element("actuator:steering", Lag().at({"T": 0.03}))
    wandering = np.where(np.arange(120) < 60, 0.0, 0.3 * np.sin(np.arange(120)))[:, None]
    bench = Workbench.of(car, [blank.with_(y=late.simulate(blank) + wandering)], "zero")
    refitted = bench.fit(bench.simulator)
    assert not any(fault.channel == "speed" for fault in _screen_shifts(bench, refitted))
    now = Checked(bench, refitted)
    assert not find_time_shift(now).gates
    fault = TimeShift("speed", "alignment", 0.0, kind="u", columns=(1,)).at(60 * 0.025, 0.025)
    after = correct(now, fault)
    assert after.cost < 0.25 * now.cost and not accept(now, after, fault).gates


def test_a_shift_that_keeps_only_rest_shows_nothing():
    """Constant inputs could be read so late that nothing was left but rest; they took the place of the true shift."""
    names = ("force", "a", "b", "c", "d")
    cart = Simulator(
        lambda x, u, p: {"v": p.gain * u.force - p.drag * x.v},
        lambda x: {"v": x.v},
        ("v",),
        names,
        {"gain": Parameter(3.0, bounds=(1, 9)), "drag": Parameter(1.0, bounds=(0.1, 9))},
        Port("wheels", {"v": -1.0}, lambda x: x.v),
    )
    force = np.concatenate([np.zeros(250), np.repeat(np.random.default_rng(0).uniform(-1, 1, 10), 5)])
    u = np.column_stack([force, *np.full((4, 300), 0.3)])
    blank = Recording(u, 0 * u[:, :1], 0.05, names, ("v",), initial="zero", hold="zero")
    y = np.vstack([np.zeros((8, 1)), np.round(cart.simulate(blank), 2)[:-8]])
    bench = Workbench.of(cart, [blank.with_(y=y)], "zero", "vm")
    (found,) = find_time_shift(Checked(bench, bench.fit(cart))).gates
    assert found.channel == "force" and found.delay == pytest.approx(0.4)
