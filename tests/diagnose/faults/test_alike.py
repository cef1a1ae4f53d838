"""Faults that look alike on a ramp, a decay or a sine: constants, shifts, clock rates and lost samples."""

import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Recording, Simulator
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.faults.gates import Checked, settle
from pilfr_casadi.diagnose.faults.lost_samples import find_output_gaps
from pilfr_casadi.diagnose.faults.offsets import Offset, find_offsets
from pilfr_casadi.diagnose.faults.timing import RATES, TimeShift, find_time_shift
from pilfr_casadi.laws import CoulombFriction, QuadraticDrag


def car():
    """A car that rolls out, without its dry friction."""
    return Simulator(
        lambda x, u, p: {"speed": -p.loss * x.speed - 9.81 * u.slope},
        lambda x: {"speed": x.speed},
        states=("speed",),
        inputs=("slope",),
        parameters={"loss": Parameter(0.01, bounds=(0, 0.2))},
        ports=(Port("car", {"speed": -1.0}, lambda x: x.speed, unit="m/s^2", across_unit="m/s"),),
    )


def rolled_out(seed, dry=0.03, loss=0.004, noise=0.1, begin=8.0, zero=0.0):
    """A recording of the car until it stands; `zero` is the zero of its sensor."""
    rng, speed, y = np.random.default_rng(seed), begin, []
    for _ in range(170):
        y.append(speed)
        for _ in range(20):
            speed = max(speed - 0.05 * (dry + loss * speed), 0)
    u = np.zeros((170, 1))
    u[-1] = 1e-6
    y = np.array(y)[:, None] + zero + noise * rng.standard_normal((170, 1))
    return Recording(u, y, 1.0, ("slope",), ("speed",), hold="zero")


def wheel():
    """A wheel whose speed follows its command at once."""
    return Simulator(
        lambda x, u, p: {"speed": (p.gain * u.command - x.speed) / p.lag},
        lambda x: {"speed": x.speed},
        states=("speed",),
        inputs=("command",),
        parameters={"gain": Parameter(1.0, bounds=(0.1, 5)), "lag": Parameter(0.1, fixed=True)},
        ports=(Port("shaft", lambda p: {"speed": -1.0 / p.lag}, lambda x: x.speed, unit="rpm", across_unit="rpm"),),
    )


def turned(command, speed, noise, seed=0):
    """A recording of the wheel."""
    y = speed + noise * np.random.default_rng(seed).standard_normal(len(speed))
    return Recording(command[:, None], y[:, None], 1.0, ("command",), ("speed",), hold="linear")


def refitted(simulator, *train):
    bench = Workbench.of(simulator, train, train[0].hold)
    return Checked(bench, bench.fit(simulator))


def test_a_clock_rate_stays_within_the_range_that_is_tried():
    """Each step could double it, until the output was a constant."""
    now = refitted(car(), rolled_out(1))
    rate = TimeShift("speed", "clock", 0.0).at(-RATES[-1], 1.0)
    assert abs(settle(now, rate)[0].value) < 1.06 * RATES[-1]
    assert not [g for g in find_time_shift(now).gates if g.finding == "clock"]


@pytest.mark.parametrize("dead", [0.0, 20.0])
def test_a_constant_on_a_staircase_is_no_shift_and_no_clock(dead):
    command = np.arange(-540.0, 551, 10)
    speed = 0.95 * np.sign(command) * np.maximum(abs(command + 23) - dead, 0)
    (found,) = find_time_shift(refitted(wheel(), turned(command, speed, 5.0).with_(hold="zero"))).gates
    assert found.finding == "offset" and 15 < found.value < 40
    assert "; or else speed is recorded " in found.sentence
    assert "too early: these recordings do not tell which; with it as a parameter" in found.sentence


def test_a_shift_that_a_gain_imitates_is_noted_and_not_corrected():
    """On an exponential decay both are the same."""
    simulator = wheel().with_parameters({"gain": Parameter(1.0, fixed=True), "lag": Parameter(0.1, bounds=(0.01, 1))})
    command, speed = (np.exp(-(np.arange(150) + early) / 40) for early in (0, 5))
    now = refitted(simulator, turned(command, speed, 0.002))
    found = find_time_shift(now)
    (note,) = found.gates
    assert (note.channel, note.finding, note.value, note.corrected, note.fault) == (
        "speed",
        "alignment",
        -5.0,
        False,
        False,
    )
    assert note.sentence == (
        "speed is recorded 5 samples (5 s) too early, or else a gain at actuator:command or a gain at sensor:speed "
        "acts like that: these recordings do not tell which, and no time is changed."
    )
    assert found.bench is now.bench and found.fitted is now.fitted


@pytest.mark.parametrize(("late", "samples", "seed"), [(6.0, 220, 1), (11.4, 109, 1), (20.0, 150, 0)])
def test_a_delayed_sine_is_not_early_by_the_rest_of_its_period(late, samples, seed):
    command, speed = (np.sin(2 * np.pi * (np.arange(samples) - shift) / 64) for shift in (0, late))
    found = find_time_shift(refitted(wheel(), turned(command, 0.95 * speed, 0.005, seed))).gates
    assert [g.value for g in found] == ([20.0] if late == 20 else [])  # a short delay is physics


@pytest.mark.parametrize(("seed", "dry", "loss"), [(0, 0.03, 0.004), (3, 0.03, 0.004), (1, 0.05, 0.0)])
def test_a_decay_with_dry_friction_has_lost_no_samples(seed, dry, loss):
    assert not find_output_gaps(refitted(car(), rolled_out(seed, dry, loss))).gates


def test_a_constant_that_may_be_a_load_is_told_as_that():
    """The zero of a sensor is hardly off by more than its output moves."""
    (found,) = find_offsets(refitted(car(), rolled_out(3))).gates
    assert found.channel == "slope" and "or a constant load acts like one, as do dry friction" in found.sentence
    (found,) = find_offsets(refitted(car(), rolled_out(0, 0.0, 0.02, zero=-0.5))).gates
    assert found.channel == "speed" and found.value == pytest.approx(-0.5, abs=0.1)
    assert ", or a constant load at car acts like one, or the input slope has one of about 0.001" in found.sentence


@pytest.mark.parametrize("load", [0.05, 3.0])
def test_an_offset_above_all_that_its_input_ever_was_is_doubted(load):
    u = 0.5 * np.sin(0.05 * np.arange(600))[:, None]
    vessel = Simulator(
        lambda x, u, p: {"level": u.flow - p.out * x.level},
        lambda x: {"level": x.level},
        states=("level",),
        inputs=("flow",),
        parameters={"out": Parameter(0.5, bounds=(0.05, 5.0))},
    )
    blank = Recording(u + load, np.zeros_like(u), 0.1, ("flow",), ("level",), initial=[0.0], hold="zero")
    y = vessel.simulate(blank) + 1e-3 * np.random.default_rng(0).standard_normal(u.shape)
    (found,) = find_offsets(refitted(vessel, blank.with_(u=u, y=y))).gates
    assert found.channel == "flow" and found.value == pytest.approx(load, rel=0.05)
    assert ("that is more than flow ever was, which speaks for a constant load" in found.sentence) is (load > 1)


def test_friction_that_an_offset_hides_is_not_said_to_look_like_damping():
    offset = car().with_element("sensor:speed", Offset())
    found = pilfr.check(offset, rolled_out(0), laws=(CoulombFriction, QuadraticDrag))
    said = [spot.sentence for spot in found.blind_spots if spot.kind == "followed"]
    assert "Coulomb friction (smooth) at car cannot be distinguished from an offset of speed." in said


def test_nothing_is_said_to_be_missing_only_as_far_as_the_laws_tried_can_show():
    r = rolled_out(0, 0.0, 0.02)
    sentence = pilfr.diagnose(car(), r, laws=(CoulombFriction,), workers=1).sentence
    assert sentence.startswith("Nothing is missing, as far as the laws tried can show (Coulomb friction): refitted")
