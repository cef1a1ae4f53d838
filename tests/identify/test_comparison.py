"""`compare` gives models of every kind the same start and scores the same samples."""

import re

import control
import numpy as np
import pytest
from diagnosis_example import example

import pilfr_casadi as pilfr
from pilfr_casadi import InputError, Parameter, Recording, Simulator
from pilfr_casadi.models import PILFR

DT = 0.05


def rig(k=4.0, **more):
    return Simulator(
        lambda x, u, p: dict(pos=x.vel, vel=u.force - p.k * x.pos - 0.4 * x.vel),
        lambda x: dict(position=x.pos, speed=x.vel),
        states=("pos", "vel"),
        inputs=("force",),
        parameters=dict(k=Parameter(k, bounds=(1.0, 9.0))),
        hold="zero",
        **more,
    )


@pytest.fixture(scope="module")
def moving():
    """A machine in motion at the beginning of the recording."""
    rng = np.random.default_rng(0)
    r = Recording(rng.normal(size=400), np.zeros((400, 2)), DT, "force", ("position", "speed"), initial=[2.0, -1.0])
    return r.with_(y=rig().simulate(r), initial="estimate", name="run 3")


def test_a_simulator_and_a_fit_get_the_same_estimated_start(moving):
    assert rig().nrmse(moving) < 1e-6
    found = pilfr.compare(moving, {"truth": rig(), "refitted": pilfr.fit(rig(5.0), moving), "stiff": rig(5.0)})
    assert found.nrmse["truth"] < 1e-6 and found.nrmse["refitted"] < 1e-4 and found.nrmse["stiff"] > 0.1
    assert found.recording.skip > 0
    np.testing.assert_array_equal(found.simulated["truth"].shape, moving.y.shape)


def test_no_model_is_scored_on_samples_that_a_start_was_fitted_to(moving):
    big = pilfr.fit(PILFR(nx=6), moving, starts=1)
    alone = pilfr.compare(moving, {"truth": rig()})
    beside = pilfr.compare(moving, {"truth": rig(), "black box": big})
    assert beside.recording.skip > alone.recording.skip
    e = beside.simulated["black box"] - moving.y
    scored = beside.recording.skip
    expected = np.sqrt(np.mean(e[scored:] ** 2, axis=0)) / np.std(moving.y[scored:], axis=0)
    np.testing.assert_allclose(beside.errors["black box"], expected, rtol=1e-9)


def test_a_fit_does_not_use_its_state_from_the_training_recording(moving):
    fitted = pilfr.fit(rig(5.0), moving)
    again = pilfr.compare(moving.with_(y=moving.y + 0), {"fit": fitted})
    assert again.nrmse == pilfr.compare(moving, {"fit": fitted}).nrmse


def test_every_model_begins_at_a_given_state(moving):
    r = moving.with_(initial="zero")
    found = pilfr.compare(r, {"truth": rig()})
    assert found.nrmse["truth"] == pytest.approx(rig().nrmse(r)) and found.recording.skip == 0
    assert "begins at zero; all samples are scored" in str(found)


def test_models_of_every_kind_and_channels_in_any_order(moving):
    given = moving.with_(y=moving.y[:, ::-1], outputs=("speed", "position"), initial="zero")
    space = control.ss(
        [[0, 1], [-4.0, -0.4]], [[0], [1.0]], np.eye(2), 0, inputs=["force"], outputs=["position", "speed"]
    )
    fitted = pilfr.fit(PILFR(nx=2), given, starts=1)
    found = pilfr.compare(given, {"simulator": rig(), "state space": space, "fit": fitted, "model": fitted.model})
    assert found.errors["simulator"] == pytest.approx(found.errors["state space"], rel=1e-4)
    assert found.errors["fit"] == pytest.approx(found.errors["model"], rel=1e-9)
    rows = str(found).splitlines()
    assert re.split(r"\s+", rows[0]) == ["NRMSE", "speed", "position", "mean"] and len(rows) == 6
    assert len(found.plot().axes) == 4


def test_a_diagnosis_is_compared_with_its_corrected_recording():
    d = example()
    r = d.train[0]
    found = pilfr.compare(r, {"as given": rig_of(d), "corrected": d})
    assert found.nrmse["corrected"] == pytest.approx(d.nrmse(r), rel=1e-6)


def rig_of(diagnosis):
    return diagnosis.refitted


def test_diverging_models_are_reported(moving):
    wild = Simulator(
        lambda x, u: dict(pos=x.vel, vel=u.force + 60.0 * x.pos),
        lambda x: dict(position=x.pos, speed=x.vel),
        states=("pos", "vel"),
        inputs=("force",),
        parameters={},
    )
    found = pilfr.compare(moving.with_(initial="zero"), {"wild": wild, "truth": rig()})
    assert "diverges" in str(found).splitlines()[1] and found.nrmse["truth"] < 1


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda r: r.y, "A ndarray was given to compare; give a Recording first"),
        (lambda r: r.with_(y=np.zeros((400, 0)), outputs=()), "has no outputs to compare with"),
        (lambda r: r.with_(inputs=("torque",)), "simulated: .* has no input 'force'"),
        (lambda r: r.with_(outputs=("position", "angle")), "simulated: .* has no output 'speed'"),
        (lambda r: r.with_(y=np.column_stack([r.y[:, 0], np.ones(400)])), "the output 'speed' never changes"),
    ],
)
def test_invalid_comparisons_are_refused(moving, change, said):
    with pytest.raises(InputError, match=said):
        pilfr.compare(change(moving), rig())
    with pytest.raises(InputError, match="No model was given"):
        pilfr.compare(moving, {})


def test_a_simulator_draws_itself_beside_a_recording(moving):
    figure = rig(5.0).plot(moving)
    assert len(figure.axes) == 4
    assert "simulated" in figure.axes[0].get_legend_handles_labels()[1][1]


def test_a_recording_draws_its_channels(moving):
    axes = moving.plot().axes
    assert len(axes) == 6 and axes[2].get_ylabel() == "position" and axes[0].get_xlabel() == "time [s]"
