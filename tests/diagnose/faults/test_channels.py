"""Channels that were exchanged, moved, or late by half a swing."""

import time
from dataclasses import replace

import numpy as np
import pytest
from cart import cart
from tanks_rig import DT, M, recorded, tanks

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Recording
from pilfr_casadi.diagnose import preparation
from pilfr_casadi.diagnose.faults.channels import accept_best, find_gross_channel_errors, scale_channels, scale_time
from pilfr_casadi.diagnose.fits.workbench import Workbench
from pilfr_casadi.diagnose.preparation import first_refit, prepare
from pilfr_casadi.engine import make_engine
from pilfr_casadi.optimise import GaussNewton, Status
from pilfr_casadi.simulators import discretise
from problems.concealed import case


@pytest.mark.parametrize("exchanged", ["outputs", pytest.param("inputs", marks=pytest.mark.slow), "nothing"])
def test_exchanged_channels_are_told(exchanged):
    u, y = recorded()
    u, y = (u[:, ::-1] if exchanged == "inputs" else u), (y[:, ::-1] if exchanged == "outputs" else y)
    r = Recording(u[:600], y[:600], DT, ("q1", "q2"), ("upper", "lower"), initial="zero", hold="zero")
    found = pilfr.diagnose(tanks(1.15), r, laws=None if exchanged == "nothing" else (), workers=1)
    if exchanged == "nothing":
        assert found.verdict == "complete" and not found.gates
        return
    channels = ["upper", "lower"] if exchanged == "outputs" else ["q1", "q2"]
    assert found.verdict == "recording-fault"
    assert [(g.channel, g.finding, g.value) for g in found.gates] == [(", ".join(channels), "exchange", channels)]
    assert found.errors["train"]["after"] < 0.01 and "are exchanged" in found.sentence


def test_a_wrong_unit_is_said_in_words():
    (small, large) = (scale_channels("y", ("a", "b"), [1], factor).sentence for factor in (1e3, 1e-3))
    assert small == "In the recordings b is too small by a factor of 1000, as from a wrong unit"
    assert "b is too large by a factor of 1000" in large
    assert "the time is too large by a factor of 60," in scale_time(1 / 60).sentence


def test_equal_explanations_of_a_wrong_unit_are_told():
    """All outputs of a linear simulator in another unit are as if its input was in another."""
    u = pilfr.multisine(M, f_max=1.5, fs=1 / DT, rng=np.random.default_rng(0))
    r = Recording(u, u, DT, ("force",), ("pos",), initial="zero", hold="zero")
    y = cart().simulate(r) + 1e-4 * np.random.default_rng(1).standard_normal((M, 1))
    (fault,) = prepare(cart(50.0, 1.2), [r.with_(y=1e3 * y)], "zero", "auto").gates
    assert (fault.channel, fault.finding) == ("pos", "unit")
    assert "pos is too large by a factor of 1000, as from a wrong unit; or else force is too small" in fault.sentence
    assert "these recordings do not tell which" in fault.sentence


@pytest.mark.parametrize(("unit", "told"), [("m/s^2", {"9.807"}), ("", {"9.807", "9.549"})])
def test_a_factor_that_does_not_fit_the_unit_is_not_tried(unit, told):
    """A reading in g is not one in revolutions a minute, though 9.81 and 9.55 are nearly alike."""
    u = pilfr.multisine(M, f_max=1.5, fs=1 / DT, rng=np.random.default_rng(0))
    r = Recording(u, u, DT, ("force",), ("pos",), initial="zero", hold="zero")
    y = cart().simulate(r)
    y = y + 0.05 * np.std(y) * np.random.default_rng(1).standard_normal(y.shape)
    known = replace(cart(50.0, 1.2), units={"pos": unit, "force": "N"})
    (fault,) = prepare(known, [r.with_(y=y / 9.80665)], "zero", "auto").gates
    assert {factor for factor in ("9.807", "9.549") if factor in fault.sentence} == told


def test_a_factor_on_all_outputs_fits_the_units_of_each():
    u, y = recorded()
    known = replace(tanks(1.15), units={"upper": "m/s^2", "lower": "m/s^2"})
    r = Recording(u, y / 9.80665, DT, ("q1", "q2"), ("upper", "lower"), initial="zero", hold="zero")
    y = r.y + 0.05 * np.std(r.y, axis=0) * np.random.default_rng(1).standard_normal(r.y.shape)
    (fault,) = prepare(known, [r.with_(y=y)], "zero", "auto").gates
    assert "upper, lower are too small by a factor of 9.807" in fault.sentence
    assert "lower are too small by a factor of 9.549" not in fault.sentence


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        ("small", "lower is too small by a factor of 1000,"),
        ("exchanged", "upper and lower are exchanged"),
        ("in for out", "q2 and lower are exchanged"),
        ("", ""),
    ],
)
def test_a_check_tells_gross_faults_of_channels_and_assesses_corrected_recordings(fault, told):
    """A time constant that is off by 3.6 is no unit."""
    u, y = recorded()
    levels = y * [1.0, 100.0]  # the lower one in cm
    wrong = {"small": levels * [1.0, 1e-3], "exchanged": levels[:, ::-1]}.get(fault, levels)
    if fault == "in for out":
        u, wrong = np.column_stack([u[:, 0], levels[:, 1]]), np.column_stack([levels[:, 0], u[:, 1]])
    rig = tanks(3.6 if not fault else 1.15, unit=100.0)
    found = pilfr.check(rig, Recording(u, wrong, DT, ("q1", "q2"), ("upper", "lower"), initial="zero", hold="zero"))
    faults = [spot.sentence for spot in found.blind_spots if spot.kind == "recording-fault"]
    assert len(faults) == bool(fault) and all(told in sentence for sentence in faults)
    assert found.error < 0.02 and {p.name: p.value for p in found.parameters} == pytest.approx(
        {"T1": 0.5, "T2": 1.3}, rel=0.01
    )
    assert found.next_record.startswith("Correct the recordings first") == bool(fault)


def test_half_of_the_time_is_left_to_try_gross_faults(monkeypatch):
    """A slow simulator was fitted to exchanged channels until the time was over."""
    u, y = recorded()
    r = Recording(u, y * [1e3, 1.0], DT, ("q1", "q2"), ("upper", "lower"), initial="zero", hold="zero")
    given, fit = [], Workbench.fit

    def timed(bench, *args, **options):
        given.append(bench.deadline - time.perf_counter())
        return fit(bench, *args, **options)

    monkeypatch.setattr(Workbench, "fit", timed)
    found = prepare(tanks(1.15), [r], "zero", "auto", until=time.perf_counter() + 100)
    assert [g.value for g in found.gates if g.fault] == [1e-3] and 40 < given[0] < 51 and max(given[1:]) > 90
    assert np.allclose(found.bench.recordings[0].y, y)


def test_a_refit_that_was_cut_short_for_no_fault_goes_on(monkeypatch):
    u, y = recorded()
    r = Recording(u, y, DT, ("q1", "q2"), ("upper", "lower"), initial="zero", hold="zero")
    fault, starts, fit = scale_channels("y", ("upper", "lower"), [0], 10.0), [], Workbench.fit

    def cut_short(bench, **_):
        found = fit(bench, bench.simulator, solver=GaussNewton(max_iterations=1))
        return replace(found, status=Status.TIME_LIMIT)

    def kept(bench, simulator, given=({},), **options):
        starts.append(given)
        return fit(bench, simulator, given, **options)

    monkeypatch.setattr(preparation, "find_gross_channel_errors", lambda bench, workers: [fault])
    monkeypatch.setattr(preparation, "refit", cut_short)
    monkeypatch.setattr(Workbench, "fit", kept)
    found = prepare(tanks(1.15), [r], "zero", "auto")
    assert not found.gates and found.without.cost < 0.01**2
    assert {} not in starts[-1] and len(starts[-1]) == 1


def test_ctrl_c_in_the_search_of_gross_faults_keeps_the_first_refit(monkeypatch):
    u, y = recorded()
    r = Recording(u, y, DT, ("q1", "q2"), ("upper", "lower"), initial="zero", hold="zero")

    def press(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(
        preparation, "find_gross_channel_errors", lambda bench, workers: [scale_channels("y", ("a", "b"), [0], 9.0)]
    )
    monkeypatch.setattr(preparation, "refit", press)
    found = prepare(tanks(1.15), [r], "zero", "auto")
    assert [g.finding for g in found.gates] == ["unchecked"] and found.without.cost < 0.01**2


def with_still_output(wrong):
    """The tanks and a third output, whose gain is zero at the given values; the second one is 1000 times too large."""
    u, y = recorded()
    base = tanks(1.15)
    rig = replace(
        base,
        outputs=lambda x, u, p: {"upper": x.h1, "lower": x.h2, "third": p.gain * x.h1},
        parameters={**base.parameters, "gain": Parameter(0.0, bounds=(0, 5))},
    )
    y = np.column_stack([y * [1.0, 1e3 if wrong else 1.0], 0.5 * y[:, 0]])
    r = Recording(u, y, DT, ("q1", "q2"), ("upper", "lower", "third"), initial="zero", hold="zero")
    return Workbench.of(rig, [r], "zero")


@pytest.mark.parametrize("wrong", [True, False])
def test_an_output_that_stands_still_hides_no_gross_fault(wrong):
    bench = with_still_output(wrong)
    faults = accept_best(first_refit(bench), find_gross_channel_errors(bench)).gates
    assert [(g.channel, g.value) for g in faults] == [("lower", 1e-3)] * wrong


def test_the_cost_of_a_run_that_diverges_is_infinite():
    u = 1e3 * np.ones((M, 1))
    r = Recording(u, np.linspace(0, 1, M), DT, ("force",), ("pos",), initial="zero", hold="zero")
    bench = Workbench.of(cart(d=-30.0, d_bounds=(-50, 5)), [r], "zero")
    assert bench.run_given().cost == np.inf


def test_an_interrupt_in_the_first_fit_leaves_the_recordings_as_they_are(monkeypatch):
    given, fit = with_still_output(wrong=True), Workbench.fit

    def pressed(bench, *args, **options):
        bench.interrupt.pressed = True
        return fit(bench, *args, **options)

    monkeypatch.setattr(Workbench, "fit", pressed)
    found = prepare(given.simulator, given.recordings, "zero", "auto")
    assert [g.finding for g in found.gates] == ["unchecked"] and found.bench.recordings == given.recordings


@pytest.mark.parametrize("alike", [True, False])
def test_a_correction_that_does_not_suit_the_test_recordings_is_told(alike):
    """The test recordings are corrected as the training recordings were, though they may be right as they are."""
    u, y = recorded()
    right = Recording(u, y, DT, ("q1", "q2"), ("upper", "lower"), hold="zero")
    wrong, half = right.with_(y=y[:, ::-1]), len(u) // 2
    test = (wrong if alike else right).slice(half, len(u))
    found = pilfr.diagnose(tanks(1.15), wrong.slice(0, half), test=test, laws=())
    told = [g.sentence for g in found.gates if g.finding == "test correction"]
    assert len(told) == (not alike)
    if told:
        assert "Check whether they have the same faults." in told[0]


@pytest.mark.slow
@pytest.mark.parametrize(("moved", "verdict"), [(0.3, "recording-fault"), (1e-3, "complete")])
def test_an_offset_that_was_the_mismatch_is_a_fault(moved, verdict):
    u, y = recorded()
    r = Recording(u, y + np.array([0.0, moved]), DT, ("q1", "q2"), ("upper", "lower"), initial="zero", hold="zero")
    found = pilfr.diagnose(tanks(1.15), r)
    assert found.verdict == verdict
    if verdict == "recording-fault":
        (gate,) = found.gates
        assert (gate.channel, gate.finding) == ("lower", "offset") and gate.value == pytest.approx(moved, rel=0.02)
        assert "lower has a constant offset" in found.sentence
        assert f"offset of lower = {gate.value:.4g}" in str(found)


def beam(off=1.0):
    """One lightly damped mode."""
    return cart(k=40.0 * off, d=0.08 * off, ports=())


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["late", "sign"])
def test_late_by_half_a_swing_is_no_wrong_sign(fault):
    rng, model, late = np.random.default_rng(1), discretise(beam(), DT), 10
    u = pilfr.multisine(M + late, f_max=3.0, fs=1 / DT, rng=rng)
    r = Recording(u, np.zeros(M + late), DT, ("force",), ("pos",), initial="zero", hold="zero")
    y = make_engine(model).simulate(model.drive(r), model.parameters.start, np.zeros(2))[0]
    y += 5e-3 * np.std(y) * rng.standard_normal(y.shape)
    u, y = (u[late:], y[:M]) if fault == "late" else (u[:M], -y[:M])
    found = pilfr.diagnose(beam(1.1), Recording(u, y, DT, ("force",), ("pos",), initial="estimate", hold="zero"))
    assert found.verdict == "recording-fault"
    assert [g.finding for g in found.gates] == [{"late": "alignment", "sign": "sign"}[fault]]


@pytest.mark.slow
def test_of_two_near_units_the_wrong_hold_does_not_choose():
    """Degrees for radians: with inputs held instead of interpolated, a sixtieth fits better."""
    hidden = case(3660)
    found = prepare(hidden.simulator, hidden.train, None, "auto", 2)
    units = [g for g in found.gates if g.finding == "unit"]
    assert [g.channel for g in units] == ["t_case"] and units[0].value == pytest.approx(180 / np.pi)
    assert found.bench.hold == "linear"
