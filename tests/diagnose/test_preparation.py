"""Dull faults beside an unsaid hold, and constants: what the search starts from is right again."""

import re
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis_rig import OFF, recordings, refitted, rig
from tank import tank
from tanks_rig import DT, recorded, tanks

from pilfr_casadi import InputError, Parameter, Recording, Simulator, multisine
from pilfr_casadi.diagnose import Workbench, preparation
from pilfr_casadi.diagnose.faults.gates import Checked
from pilfr_casadi.diagnose.faults.offsets import find_offsets, list_offsets, share_of_constants, update_offsets
from pilfr_casadi.diagnose.preparation import prepare
from pilfr_casadi.laws import AsymmetricSaturation
from pilfr_casadi.optimise import Status


def unsaid(r, u, y, initial="zero"):
    """A recording of other samples, of which nobody says what inputs do between them."""
    return Recording(u, y, r.dt, r.inputs, r.outputs, initial=initial)


@pytest.mark.slow
def test_a_shift_and_the_hold_are_told_apart():
    """Half a sample more or less, and inputs held or interpolated: the one may look like the other."""
    (r,) = recordings(count=1, hold="linear")
    found = prepare(rig(OFF), [unsaid(r, r.u[:900], r.y[9:909], "estimate")], None, "auto")
    (shift,) = [g for g in found.gates if g.finding == "alignment"]
    assert shift.value == pytest.approx(-9 * r.dt, abs=1e-9)
    assert found.bench.hold == "linear" and found.without.cost < 0.003**2


def test_across_a_gap_the_hold_is_chosen_again():
    (r,) = recordings(count=1, hold="linear")
    keep = np.r_[0:500, 525:1000]
    found = prepare(rig(OFF), [unsaid(r, r.u[keep], r.y[keep])], None, "auto")
    (gap,) = [g for g in found.gates if g.finding == "gap"]
    assert gap.value == [pytest.approx(500 * r.dt)] and [len(p) for p in found.bench.recordings] == [500, 475]
    assert found.bench.hold == "linear" and found.without.cost < 0.003**2


def of_tanks(y):
    return Recording(recorded()[0], y, DT, ("q1", "q2"), ("upper", "lower"), initial="zero", hold="zero")


@pytest.mark.slow
def test_a_wrong_sign_beside_another_zero_is_told():
    y = recorded()[1] * [-1, 1] + [3.0, 0]
    found = prepare(tanks(1.15), [of_tanks(y)], "zero", "auto")
    assert [(g.channel, g.finding) for g in found.gates] == [("upper", "sign"), ("upper", "offset")]
    assert re.search(r"error falls from \S+ % to \S+ % of the outputs' deviation", found.gates[0].sentence)
    assert found.without.values["sensor:upper.w_0"] == pytest.approx(-3.0, rel=0.01)
    assert found.without.cost < 0.01**2


def test_a_constant_of_a_sensor_is_found_and_kept():
    known = replace(tanks(1.15), units={"lower": "m"})
    bench = Workbench.of(known, [of_tanks(recorded()[1] + [0, 0.3])], "zero")
    found = find_offsets(refitted(bench))
    fitted, (gate,) = found.fitted, found.gates
    assert (gate.channel, gate.finding, gate.fault) == ("lower", "offset", True)
    assert gate.value == pytest.approx(0.3, rel=0.02) and f"offset of about {gate.value:.3g} m;" in gate.sentence
    (again,) = list_offsets(fitted.simulator.elements, fitted.values)
    assert again.value == gate.value and "parameter of the corrected simulator" in again.sentence
    (told,) = update_offsets([gate], fitted, {gate.parameter: np.array(0.03)}, False, False)
    assert "may be a part of that" in told.sentence and " m;" in told.sentence
    (told,) = update_offsets([gate], fitted, {gate.parameter: np.array(0.03)}, True, False)
    assert f"offset of about {gate.value:.3g} m;" in told.sentence
    uncertain = [gate], fitted, {gate.parameter: np.array(0.3)}
    assert not update_offsets(*uncertain, True, False)  # the effects may have replaced it
    (told,) = update_offsets(*uncertain, False, False)  # the refitted simulator has it
    assert told.sentence.endswith(f"Beside the correction it is {gate.value:.3g} m, and may be zero.")


@pytest.mark.parametrize("initial", ["zero", "estimate"])
def test_constants_that_look_alike_to_first_order_are_told_apart_by_their_refits(initial):
    """A constant input acts like a constant of the sensor behind it, but not at the known start."""
    r = of_tanks(recorded()[1] + [0, 0.3]).with_(initial=initial)
    bench = Workbench.of(tanks(1.15), [r], "zero")
    ready = refitted(bench)
    share = share_of_constants(bench, ready.fitted, ["actuator:q2", "sensor:lower"])
    assert share["actuator:q2"] == pytest.approx(share["sensor:lower"])
    channels = [g.channel for g in find_offsets(ready).gates]
    assert channels == ["lower"] if initial == "zero" else len(channels) == 1


def started(curved, level, offset):
    """A recording, said to begin at zero, of a tank that begins at a level and has a sensor with an offset."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(0, 8, 20), 20)[:, None]
    blank = Recording(u, 0 * u, 3.0, ("pump",), ("level",), initial=[level], hold="zero")
    y = tank(curved=curved).simulate(blank) + offset
    return blank.with_(y=y + 1e-3 * np.std(y) * rng.standard_normal(y.shape), initial="zero")


@pytest.mark.parametrize(
    ("curved", "level", "offset", "found"),
    [
        (0.0, 0.25, 0.0, "start"),
        (1e-4, 0.25, 0.0, "start"),
        (0.0, 0.0, 0.25, "offset"),
        (1e-4, 0.0, 0.25, "offset"),
        (1e-4, 0.0, 0.05, "offset"),
    ],
)
def test_a_wrong_start_is_told_from_a_wrong_zero_of_the_sensor(curved, level, offset, found):
    """Beside missing physics as well, though a constant that is fitted then misses the first sample too."""
    gates = prepare(tank(outflow=1.5e-4), [started(curved, level, offset)], "zero", "auto").gates
    faults, miss = [g.finding for g in gates if g.fault], "level would begin at 0, but its first sample is 0."
    assert faults[0] == found and (faults[1:] == [] or found == "start"), [g.sentence for g in gates]
    told = [miss in g.sentence for g in gates if g.finding == "start"]
    assert told == [True], "the other explanation is told as well"


def test_a_worse_explanation_is_not_called_better():
    gates = prepare(tank(outflow=1.5e-4), [started(1e-3, 1.0, 0.0)], "zero", "auto").gates
    assert not any("explains that better" in g.sentence for g in gates)


def test_a_start_and_a_zero_that_fit_as_well_are_both_told():
    integrator = Simulator(
        lambda x, u, p: {"x": p.k * u.u},
        lambda x: {"y": x.x},
        ("x",),
        ("u",),
        parameters={"k": Parameter(1.0, bounds=(0.1, 10))},
    )
    rng = np.random.default_rng(2)
    u = np.repeat(rng.standard_normal(40), 10)[:, None]
    blank = Recording(u, 0 * u, 0.05, ("u",), ("y",), initial="zero", hold="zero")
    y = 0.5 + integrator.simulate(blank) + 1e-3 * rng.standard_normal(u.shape)
    (fault,) = (g for g in prepare(integrator, [blank.with_(y=y)], "zero", "vm").gates if g.finding == "start")
    assert "a wrong zero of the sensor explains that as well" in fault.sentence


def test_a_start_is_not_blamed_on_a_zero_where_another_sensor_is_noisy():
    lags = Simulator(
        lambda x, u, p: {"y": p.k * u.u - x.y, "z": u.u - 0.2 * x.z},
        lambda x: {"y": x.y, "z": x.z},
        ("y", "z"),
        ("u",),
        parameters={"k": Parameter(1.0, bounds=(0.1, 10))},
    )
    rng = np.random.default_rng(3)
    u = np.repeat(rng.standard_normal(40), 10)[:, None]
    blank = Recording(u, np.zeros((400, 2)), 0.05, ("u",), ("y", "z"), initial=[0.0, 0.5], hold="zero")
    y = lags.simulate(blank) + rng.standard_normal((400, 2)) * [1e-3, 0.05]
    gates = prepare(lags, [blank.with_(y=y, initial="zero")], "zero", "vm").gates
    assert [(g.finding, g.corrected) for g in gates] == [("start", True)], [g.sentence for g in gates]


def unsaid_tanks():
    return Workbench.of(tanks(1.15), [of_tanks(recorded()[1]).with_(hold=None)], "linear")


def test_a_hold_with_which_the_simulation_diverges_is_not_used(monkeypatch):
    first = preparation.first_refit

    def diverging(bench, gates=()):
        if bench.hold == "zero":
            raise InputError("The simulation diverges.")
        return first(bench, gates)

    monkeypatch.setattr(preparation, "first_refit", diverging)
    given = unsaid_tanks()
    ready = prepare(given.simulator, given.recordings, None, "auto")
    assert ready.without.cost < 0.05**2
    with pytest.raises(InputError, match="diverges"):
        prepare(given.simulator, given.recordings, "zero", "auto")
    monkeypatch.setattr(Workbench, "fit", lambda *_, **__: diverging(replace(given, hold="zero")))
    (note,) = preparation.choose_hold(Checked(given, given.run_given()))[1]
    assert (note.finding, note.value) == ("hold", "linear") and "otherwise it diverges" in note.sentence


def test_a_refit_that_was_cut_short_chooses_no_hold():
    begun = preparation.first_refit(unsaid_tanks())
    now, notes = preparation.choose_hold(begun)
    assert now.bench.hold == "zero" and [g.value for g in notes] == ["zero"]  # as recorded
    late = replace(begun, fitted=replace(begun.fitted, status=Status.TIME_LIMIT))
    assert preparation.choose_hold(late) == (late, ())


def test_checks_that_the_time_limit_left_out_are_told():
    r = of_tanks(recorded()[1] + [0, 0.3])
    found = prepare(tanks(1.15), [r], "zero", "auto", until=0.0)
    assert [g.finding for g in found.gates] == ["unchecked"] and not found.gates[0].fault
    assert found.without.cost < 1  # the first refit is made in any case
    assert "unchecked" not in [g.finding for g in prepare(tanks(1.15), [r], "zero", "auto").gates]


def test_another_hold_that_the_time_limit_left_out_is_told_where_a_channel_is_at_fault():
    r = of_tanks(1e3 * recorded()[1]).with_(hold=None)
    told = "looked for with another hold of the inputs: another channel may be at fault"
    found = prepare(tanks(1.15), [r], None, "auto", until=0.0)
    assert "unit" in {g.finding for g in found.gates}
    assert [told in g.sentence for g in found.gates if g.finding == "unchecked"] == [True, False]
    for stated, until in (("zero", 0.0), (None, np.inf)):
        found = prepare(tanks(1.15), [r], stated, "auto", until=until)
        assert not any(told in g.sentence for g in found.gates)


def test_no_check_is_left_out_where_the_time_ends_with_the_last_one(monkeypatch):
    until, begun = time.perf_counter() + 1e4, []
    monkeypatch.setattr(preparation, "find_offsets", lambda now: begun.append(now) or now)
    clock = SimpleNamespace(perf_counter=lambda: np.inf if begun else time.perf_counter())
    monkeypatch.setattr(preparation, "time", clock)
    assert not prepare(tanks(1.15), [of_tanks(recorded()[1])], "zero", "auto", until=until).gates and begun


@pytest.mark.parametrize("pressed_by", ["fit", "check"])
def test_checks_that_an_interrupt_left_out_are_told(monkeypatch, pressed_by):
    def press(now):
        if pressed_by == "check":
            raise KeyboardInterrupt
        now.bench.interrupt.pressed = True
        return now

    monkeypatch.setattr(preparation, "find_wrong_start", press)
    monkeypatch.setattr(preparation, "find_offsets", lambda now: pytest.fail("a check after Ctrl-C"))
    found = prepare(tanks(1.15), [of_tanks(recorded()[1] + [0, 0.3])], "zero", "auto")
    assert [g.finding for g in found.gates] == ["unchecked"] and found.bench.interrupt.pressed


@pytest.mark.parametrize(("side", "channel"), [("u", "force"), ("y", "x2")])
def test_offsets_that_differ_between_recordings_are_subtracted(side, channel):
    size = {"u": 20.0, "y": 0.02}[side]
    both = zip(recordings(count=2), (size, -size / 2), strict=True)
    bench = Workbench.of(rig(OFF), [r.with_(**{side: getattr(r, side) + v}) for r, v in both], "zero")
    found = find_offsets(refitted(bench))
    (gate,) = found.gates
    assert gate.finding == "offset" and gate.fault and found.cost < 0.01**2
    assert gate.channel == channel and gate.value == pytest.approx([size, -size / 2], rel=0.02)


def test_a_mean_force_of_missing_physics_is_no_offset():
    """A skew saturation pushes an axis to one side, in each recording by a mean of its own."""
    axis = Simulator(
        lambda x, u, p: {"position": x.speed, "speed": u.force - p.d * x.speed},
        lambda x: {"position": x.position},
        states=("position", "speed"),
        inputs=("force",),
        parameters={"d": Parameter(2.0, bounds=(0.1, 20))},
    )
    rng, train = np.random.default_rng(0), []
    for amplitude in (1.0, 2.0):
        force = amplitude * multisine(1500, f_max=2.0, fs=50.0, rng=rng)
        blank = Recording(force, np.zeros(1500), 0.02, ("force",), ("position",), initial="zero", hold="zero")
        y = axis.with_element("actuator:force", AsymmetricSaturation().at({"low": -2.0, "high": 1.2})).simulate(blank)
        train.append(blank.with_(y=y + 1e-3 * np.std(y) * rng.standard_normal(y.shape)))
    bench = Workbench.of(axis, train, "zero")
    found = find_offsets(refitted(bench))
    assert not any(isinstance(gate.value, list) for gate in found.gates)


def test_the_error_as_given_compares_with_that_of_the_refit():
    """Where the machine rattles while it starts, in the samples to which an unknown initial state is fitted."""
    (r,) = recordings(count=1)
    y = r.y[:500].copy()
    y[10:50] += 0.5 * np.std(y) * np.sin(np.linspace(0, 12 * np.pi, 40))[:, None]
    started = Recording(r.u[:500], y, r.dt, r.inputs, r.outputs, initial="estimate", hold="zero")
    found = prepare(rig(), [started], "zero", "vm")
    assert found.bench.nrmse(found.without) <= found.nominal < 0.2
