"""Laws that begin as if the signal had stood still before, and recordings about a working point."""

import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Recording, Simulator
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.faults.offsets import Offset
from pilfr_casadi.diagnose.preparation import prepare
from pilfr_casadi.engine import make_engine
from pilfr_casadi.laws import (
    CATALOGUE,
    Backlash,
    Creep,
    Delay,
    Lag,
    Local,
    Magnitude,
    Quadratic,
    Resonance,
    TwoStageCreep,
    unit_forces,
)
from pilfr_casadi.simulators import discretise

DT, M = 0.05, 1500


def tank(off=1.0):
    """Level of a tank and of another behind it."""
    return Simulator(
        lambda x, u, p: {"h1": (u.q - x.h1) / p.T1, "h2": (x.h1 - x.h2) / p.T2},
        lambda x: {"upper": x.h1, "lower": x.h2},
        states=("h1", "h2"),
        inputs=("q",),
        parameters={"T1": Parameter(0.5 * off, bounds=(0.2, 1.2)), "T2": Parameter(1.3 * off, bounds=(0.5, 3))},
    )


def recorded(level, seed=0, change=lambda y: y):
    """Both levels about a working point, the inflow moving in steps."""
    rng, model = np.random.default_rng(seed), discretise(tank(), DT)
    u = level + np.repeat(rng.uniform(-1, 1, M // 6), 6)[:, None]
    r = Recording(u, np.zeros((M, 2)), DT, ("q",), ("upper", "lower"), initial="estimate", hold="zero")
    state = np.full(model.n_state, level)
    y = make_engine(model).simulate(model.drive(r), model.parameters.start, state)[0]
    return r.with_(y=change(y + 2e-3 * rng.standard_normal(y.shape)))


def placed(law):
    """The tanks with a sensor that has an offset of 2 and then the law."""
    return tank().with_element("sensor:upper", Offset().at({"w_0": 2.0})).with_element("sensor:upper", law)


@pytest.mark.parametrize("kind", [Delay, Lag, Resonance, Creep, TwoStageCreep])
def test_a_law_begins_as_if_the_signal_had_stood_still(kind):
    law = kind()
    shape = next(law.shapes(Local(np.ones(M), np.zeros(M), DT, (M,))))
    strengths = dict.fromkeys(law.strength, 0.3)
    simulator = placed(law.at({**shape, **strengths}))
    model = discretise(simulator, DT, substeps=4)
    x, u = np.array([5.0, 5.0]), np.array([5.0])
    state = model.rest_at(x, u, model.parameters.start)
    assert np.array_equal(state[:2], x) and len(state) == model.n_state and np.max(state[2:]) == 7
    r = recorded(5.0).with_(u=np.full((M, 1), 5.0))
    y, after = make_engine(model).simulate(model.drive(r), model.parameters.start, state)
    np.testing.assert_allclose(y, np.broadcast_to(y[0], y.shape), rtol=1e-9)
    np.testing.assert_allclose(after, state, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "kind", [k for k in CATALOGUE if not k.in_line and ((k.order and k.follows) or k.shifts)], ids=lambda k: k.__name__
)
def test_the_screen_sees_nothing_where_the_signal_stands(kind):
    z = np.full(50, 7.0)
    shapes = list(kind().shapes(Local(z, 0 * z, DT, (50,))))
    still, sudden = (
        unit_forces(kind(), Local(z, 0 * z, DT, (50,), from_zero=(begun,)), shapes) for begun in (False, True)
    )
    np.testing.assert_allclose(still, still[:1] + 0 * still, atol=1e-9)
    assert np.ptp(sudden, axis=0).max() > 1


def test_only_what_begins_somehow_begins_where_its_signal_stands():
    simulator, r = placed(Lag().at({"T": 0.1})), recorded(5.0)
    for initial, expected in (("estimate", 7.0), ("zero", 0.0), ([5.0, 5.0], 7.0)):
        bench = Workbench.of(simulator, [r.with_(initial=initial)], "zero")
        model = bench.model(simulator)
        begun = bench.initial_states(model, model.parameters.start, [np.array([5.0, 5.0])])[0]
        assert begun[2] == expected


@pytest.mark.parametrize("law", [Lag().at({"T": 0.1}), Creep().at({"T": 2.0, "c": 0.3}), Backlash().at({"r": 1.0})])
def test_a_stated_level_is_no_transient_of_a_law(law):
    simulator = placed(law)
    still = recorded(5.0).with_(u=np.full((M, 1), 5.0), initial=[5.0, 5.0])
    y = simulator.simulate(still)
    np.testing.assert_allclose(y, np.broadcast_to(y[0], y.shape), rtol=1e-9)
    assert y[0, 0] >= 6


def findings(r, off=1.15):
    return [(g.channel, g.finding) for g in prepare(tank(off), [r], "zero", "auto").gates]


@pytest.mark.slow
def test_a_lag_is_not_taken_for_a_late_recorder():
    lagging, r = tank().with_element("sensor:lower", Lag().at({"T": 8 * DT})), recorded(30.0)
    r = r.with_(initial=[30.0, 30.0])
    noise = 2e-3 * np.random.default_rng(1).standard_normal(r.y.shape)
    assert findings(r.with_(y=lagging.simulate(r) + noise)) == []
    late = tank().simulate(r)
    late[:, 1] = np.append(np.full(8, 30.0), late[:-8, 1])
    assert findings(r.with_(y=late + noise)) == [("lower", "alignment")]


def test_a_stated_start_that_the_first_sample_contradicts_is_estimated():
    assert findings(recorded(30.0).with_(initial="zero")) == [("initial state", "start")]
    assert findings(recorded(30.0).with_(initial=[30.0, 30.0])) == []


@pytest.mark.slow
def test_a_late_sensor_about_a_working_point_is_a_delay():
    late = 3

    def change(y):
        return np.column_stack([y[:, 0], np.append(np.full(late, y[0, 1]), y[:-late, 1])])

    found = pilfr.diagnose(tank(1.15), recorded(30.0, change=change))
    assert [(e.port, e.law) for e in found.effects] == [("sensor:lower", "delay")]
    assert found.effects[0].parameters["T"]["value"] == pytest.approx(late * DT, rel=0.05)


@pytest.mark.slow
def test_degrees_fahrenheit_are_a_fault_of_the_recording():
    found = pilfr.diagnose(tank(1.15), recorded(30.0, change=lambda y: y * [1, 1.8] + [0, 32]))
    assert found.verdict == "recording-fault"
    gates = {(g.channel, g.finding): g.value for g in found.gates}
    assert gates["lower", "unit"] == pytest.approx(1 / 1.8)
    assert gates["lower", "offset"] == pytest.approx(32 / 1.8, rel=0.01)
    assert "factor of 1.8 and an offset" in found.sentence


def test_an_offset_alone_is_a_fault_but_no_wrong_unit():
    given = recorded(30.0, change=lambda y: y + np.array([0.0, 12.0])).slice(0, 600)
    found = pilfr.diagnose(tank(1.15), given, laws=(Delay, Quadratic), effects=1, workers=1)
    assert [(g.channel, g.finding) for g in found.gates] == [("lower", "offset")]
    assert found.verdict == "recording-fault"
    assert "constant offset" in found.sentence and not found.effects


def test_a_curve_that_the_signal_sees_only_a_straight_part_of_is_not_tried():
    z = np.linspace(-1, 1, 200)
    for law, level, tried in (
        (Magnitude(), 0.0, True),
        (Magnitude(), 0.95, False),
        (Magnitude(), -3.0, False),
        (Quadratic(), 3.0, True),
        (Quadratic(), 30.0, False),
    ):
        assert bool(law.why_not(Local(z + level, z, DT, (200,)))) is not tried
