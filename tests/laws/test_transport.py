"""A delay by a flow: against an exact pipe, in a screen, where it can stand, and found in a diagnosis."""

from dataclasses import replace

import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi.diagnose import add_scaled_laws
from pilfr_casadi.laws import CATALOGUE, Creep, Delay, Lag, Local, carried, unit_forces
from problems.other_domains import recorded

DT, VOLUME = 0.1, 0.6


def pipe():
    """A mixed vessel whose outlet is measured, through a pipe that the equations do not have."""
    return pilfr.Simulator(
        lambda x, u, p: {"T": u.flow * (u.inlet - x.T) / p.V},
        lambda x: {"outlet": x.T},
        states=("T",),
        inputs=("flow", "inlet"),
        parameters={"V": pilfr.Parameter(0.5, bounds=(0.1, 5.0))},
        units={"flow": "L/s", "inlet": "degC", "outlet": "degC"},
    )


def signals(samples=1200):
    """A flow that rests for a while, and an inlet temperature."""
    t = DT * np.arange(samples)
    flow = np.clip(0.3 + 0.3 * np.sin(0.4 * t), 0.0, None) * (np.abs(t - 60) > 8)
    return np.column_stack([flow, 20 + 5 * np.sign(np.sin(0.17 * t))])


def behind_the_pipe(y, flow, volume=VOLUME):
    """The signal behind a pipe of a volume: what came in as much flow before."""
    passed = np.concatenate([[0.0], np.cumsum(flow[:-1] * DT)])
    return np.interp(passed - volume, passed, y)


def test_the_signal_arrives_when_the_volume_has_passed():
    blank = pilfr.Recording(signals(), np.zeros((1200, 1)), DT, ("flow", "inlet"), ("outlet",), initial=[20.0])
    plain = pilfr.close_loop(pipe(), carried("flow")().at({"V": VOLUME}), "sensor:outlet")
    y = pipe().simulate(blank)[:, 0]
    exact, delayed = behind_the_pipe(y, blank.u[:, 0]), plain.simulate(blank)[:, 0]
    assert delayed.shape == exact.shape
    later = passed_twice(blank.u[:, 0])
    assert np.std((delayed - exact)[later]) < 0.05 * np.std(exact)
    still = (blank.u[:, 0] == 0) & later
    assert np.ptp(delayed[still]) < 1e-6 * np.std(exact) < np.std((y - exact)[later])


def passed_twice(flow):
    """The samples after the pipe's content has been exchanged twice."""
    return np.cumsum(flow) * DT > 2 * VOLUME


def test_the_screen_knows_the_exact_pipe():
    u = signals()
    z = 20 + np.sin(0.3 * DT * np.arange(len(u)))
    local = Local(z, np.gradient(z, DT), DT, (700, 500), inputs={"flow": u[:, 0]}, from_zero=(False, False))
    found = unit_forces(carried("flow")(), local, [{"V": VOLUME}, {"V": 0.1}])
    expected = np.concatenate([behind_the_pipe(z[a:b], u[a:b, 0]) - z[a:b] for a, b in ((0, 700), (700, 1200))])
    np.testing.assert_allclose(found[:, 0, 0], expected, atol=1e-12)
    assert found.shape == (1200, 2, 1)


@pytest.mark.parametrize(
    ("flow", "reason"),
    [(np.ones(50), "constant"), (np.linspace(-1, 1, 50), "changes its sign"), (None, "no signal flow")],
)
def test_only_a_flow_of_one_direction_carries(flow, reason):
    z = np.sin(np.arange(50.0))
    local = Local(z, np.gradient(z), 1.0, (50,), inputs={} if flow is None else {"flow": flow})
    assert reason in carried("flow")().why_not(local)


def test_it_is_tried_with_every_input_that_may_be_a_flow_but_the_signal_itself():
    """A temperature carries nothing along; where units are not stated, any input may be a flow."""

    def tried(simulator):
        added = [law for law in add_scaled_laws(CATALOGUE, simulator) if law.carried_by]
        return {(p.name, law.carried_by) for p in simulator.all_ports() for law in added if p.admits(law)}

    by_flow = {("actuator:inlet", "flow"), ("sensor:outlet", "flow")}
    assert tried(pipe()) == by_flow
    unstated = replace(pipe(), units={})
    assert tried(unstated) == by_flow | {("actuator:flow", "inlet"), ("sensor:outlet", "inlet")}
    assert not any(law.carried_by for law in add_scaled_laws(CATALOGUE[:5], pipe()))


@pytest.mark.slow
def test_a_pipe_before_the_thermometer_is_named():
    simulator, train, test = recorded("pipe", 1)
    tried = (Delay, Lag, Creep, carried("flow"), carried("power"))
    found = pilfr.diagnose(simulator, train.slice(0, 400), test=test.slice(0, 400), laws=tried, effects=1, workers=1)
    named = [(e.port, e.law, e.form) for e in found.effects]
    assert named == [("sensor:outlet", "delay", "carried by flow")], str(found)
    assert found.effects[0].confidence > 0.9 and found.errors["test"]["after"] < 0.1 * found.errors["test"]["before"]
    assert "V = " in str(found) and "kg" in str(found)
