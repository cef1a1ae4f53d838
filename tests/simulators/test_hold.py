"""Inputs between samples: next values are held values one sample earlier, and act on outputs in their own sample."""

from dataclasses import replace

import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Recording, Simulator
from pilfr_casadi.laws import Backlash, CubicStiffness, Delay

DT = 0.3


def store(direct=0.0):
    """Two stores behind each other, with a direct path from the input to the output."""
    return Simulator(
        lambda x, u, p: dict(a=u.q - p.g * x.a, b=p.g * x.a - p.h * x.b),
        lambda x, u: dict(y=x.b + direct * u.q),
        states=("a", "b"),
        inputs=("q",),
        parameters=dict(g=Parameter(1.5, bounds=(0.1, 10)), h=Parameter(0.7, bounds=(0.1, 10))),
        ports=(Port("leak", into=dict(b=-1.0), across=lambda x: x.b),),
    )


def recording(samples=200, hold=None):
    u = np.random.default_rng(0).standard_normal((samples, 1))
    return Recording(u, np.zeros((samples, 1)), DT, ("q",), ("y",), initial="zero", hold=hold)


def test_next_values_act_one_sample_earlier_than_held_ones_and_on_outputs_at_their_own_sample():
    r, direct = recording(hold="next"), 0.5
    earlier = r.with_(u=np.vstack([r.u[1:], r.u[-1:]]), hold="zero")
    wanted = store().simulate(earlier)
    np.testing.assert_allclose(store().simulate(r), wanted, rtol=0, atol=1e-12)
    np.testing.assert_allclose(store(direct).simulate(r), wanted + direct * r.u, rtol=0, atol=1e-12)


def test_means_until_a_sample_keep_their_integral_at_another_step(tmp_path):
    u = np.arange(1.0, 13.0)[:, None]
    r = Recording(u, 0 * u, 1.0, ("q",), ("y",), initial="zero", hold="next")
    assert r.resample(3.0).u[1:, 0] == pytest.approx([3.0, 6.0, 9.0])  # of samples 2 to 4, 5 to 7, 8 to 10
    assert r.resample(0.5).u[1:5, 0] == pytest.approx([2.0, 2.0, 3.0, 3.0])
    np.savetxt(tmp_path / "r.csv", np.column_stack([r.t, r.u, r.y]), delimiter=",", header="t,q,y", comments="")
    read = pilfr.read_csv(tmp_path / "r.csv", inputs="q", outputs="y", hold="next", resample=3.0)
    assert (read.hold, read.u[1:, 0].tolist()) == ("next", pytest.approx([3.0, 6.0, 9.0]))


@pytest.mark.parametrize("law", [Backlash().at({"r": 0.3}), Delay().at({"T": 0.4})], ids=lambda law: law.id)
def test_memory_of_inputs_follows_the_next_values(law):
    r = recording(hold="next")
    earlier = r.with_(u=np.vstack([r.u[1:], r.u[-1:]]), hold="zero")
    simulator = store().with_element("actuator:q", law)
    np.testing.assert_allclose(simulator.simulate(r)[5:], simulator.simulate(earlier)[5:], rtol=0, atol=1e-9)


def test_memory_of_a_sensor_does_not_yet_know_the_next_values():
    """The outputs are those of finer steps, just before the input jumps."""
    finer, r = 40, recording(hold="next")
    simulator = store(direct=1.0).with_element("sensor:y", Backlash().at({"r": 0.3}))
    u = np.repeat(r.u[1:], finer, axis=0)
    fine = Recording(u, np.zeros_like(u), DT / finer, ("q",), ("y",), initial="zero", hold="zero")
    wanted = simulator.simulate(fine)[finer - 1 :: finer]
    error = simulator.simulate(r)[1:] - wanted
    assert np.std(error) < 0.025 * np.std(wanted)


def test_a_simulator_in_discrete_time_reads_its_inputs_at_the_samples():
    def sampled(hold):
        dynamics, outputs = lambda x, u: dict(a=0.5 * x.a + u.q), lambda x: dict(y=x.a)
        return Simulator(dynamics, outputs, states=("a",), inputs=("q",), parameters={}, discrete=True, hold=hold)

    np.testing.assert_array_equal(sampled("next").simulate(recording()), sampled("zero").simulate(recording()))


def test_the_input_of_an_exported_step_acts_until_the_next_one():
    step, held = (pilfr.exported(store(0.5), dt=DT, hold=hold, substeps=4) for hold in ("next", "zero"))
    assert step.inputs == held.inputs == ("q",)
    x, u = np.array([0.3, -0.2]), np.array([1.7])
    for found, wanted in zip(step.step(x, u), held.step(x, u), strict=True):
        np.testing.assert_allclose(found.full(), wanted.full(), rtol=0, atol=1e-14)


def test_a_diagnosis_finds_that_inputs_are_means_until_their_sample():
    law = CubicStiffness().at({"k_3": 1.5})
    true = store().with_parameters({"g": 2.0, "h": 1.0}).with_element("leak", law)
    y = true.simulate(recording(400, "next"))
    noisy = y + 0.002 * np.std(y) * np.random.default_rng(1).standard_normal(y.shape)
    r = recording(400).with_(y=noisy)
    found = pilfr.diagnose(store(), r, laws=(CubicStiffness,), workers=1)
    assert (found.hold, found.verdict) == ("next", "missing-physics"), str(found)
    assert "inputs that are at their next value there fit better" in str(found)
    assert found.errors["train"]["after"] < 0.003
    assert found.corrected.nrmse(replace(r, hold="next")) == pytest.approx(found.errors["train"]["after"], rel=1e-3)
