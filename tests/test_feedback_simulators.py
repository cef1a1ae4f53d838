"""Observer, limits of observability and inverse of a corrected simulator, as of a fit."""

import casadi as ca
import numpy as np
import pytest
from diagnosis_rig import DT, recordings, rig

import pilfr_casadi as pilfr
from pilfr_casadi import InputError
from pilfr_casadi.diagnose import Diagnosis
from pilfr_casadi.laws import Delay, StopHysteresis

LAW = StopHysteresis().at({"w": 80.0, "r": np.geomspace(0.001, 0.04, 6)})


def diagnosis(corrected, data, hold="zero"):
    empty = dict.fromkeys(("sentence", "effects", "candidates", "gates", "mismatch", "parameters", "errors", "floor"))
    return Diagnosis(
        verdict="complete", **empty, corrected=corrected, refitted=corrected, hold=hold, train=tuple(data), substeps=4
    )


@pytest.fixture(scope="module")
def corrected():
    train, test = recordings(LAW)
    return diagnosis(rig().with_element("ground-m1", LAW), [train]), train, test


def test_a_diagnosis_its_simulator_and_its_export_are_observed(corrected):
    found, train, test = corrected
    made = [pilfr.kalman_filter(of, train) for of in (found, found.corrected, found.export(start=train))]
    steps = [np.asarray(o.function(np.full(len(o.x0), 1e-3), 1.0)[0]) for o in made]
    np.testing.assert_allclose(steps[1], steps[0], rtol=1e-3)  # sub-steps of its own
    assert np.array_equal(steps[2], steps[0]) and np.array_equal(made[2].Q, made[0].Q)
    assert np.sqrt(made[0].R[0, 0]) == pytest.approx(1e-3 * np.std(train.y), rel=0.2)  # the noise that was added
    known = np.asarray(found.export().step.mapaccum("known", 500)(np.zeros(len(made[0].x0)), train.u[:500].T)[0])[:, -1]
    wrong = known.copy()
    wrong[4:] = np.max(np.abs(known[4:]))
    part = train.slice(500, 2500)
    right, told = (made[0].run(part.u, part.y, x0)[1] for x0 in (known, wrong))
    late = slice(1000, None)
    assert np.std((told - part.y)[late]) < 1.2 * np.std((right - part.y)[late]) < 2e-3 * np.std(part.y)
    said = str(pilfr.visibility(found, made[0], known, part.u[:4]))
    assert "Memory ground-m1.memory" in said and "(r = " in said, said
    controller = pilfr.PredictiveController(made[0].function, 10, inputs=(-100, 100))
    assert np.all(np.isfinite(controller(known, test.y[500:510], train.u[499]).u))


def test_interpolated_inputs_are_observed_and_not_inverted():
    data = recordings(LAW, count=1, hold="linear")
    found = diagnosis(rig().with_element("ground-m1", LAW), data, "linear")
    observer = pilfr.kalman_filter(found, data[0])
    u = np.hstack([data[0].u, np.vstack([data[0].u[1:], data[0].u[-1:]])])
    error = (observer.run(u, data[0].y)[1] - data[0].y)[100:]
    assert np.std(error) < 2e-3 * np.std(data[0].y)
    with pytest.raises(InputError, match="input is interpolated between samples") as refused:
        pilfr.feedforward(found, data[0])
    assert str(refused.value).endswith(".") and "\n" not in str(refused.value)


def test_the_time_is_no_state_to_be_corrected():
    simulator = pilfr.Simulator(
        lambda x, u, t: {"a": -x.a + u.f + 0.1 * ca.sin(t)}, lambda x: {"y": x.a}, states=("a",), inputs=("f",)
    )
    rng = np.random.default_rng(0)
    u = rng.standard_normal((300, 1))
    step = pilfr.exported(simulator, dt=0.1, hold="zero").step
    y = np.asarray(step.mapaccum("run", 300)(np.zeros(2), u.T)[1]).T + 1e-3 * rng.standard_normal((300, 1))
    record = pilfr.Recording(u, y, 0.1, inputs=("f",), outputs=("y",), initial="zero", hold="zero")
    observer = pilfr.kalman_filter(simulator, record)
    states, _, P = observer.run(u, y)
    np.testing.assert_allclose(states[:, 1], 0.1 * np.arange(301), rtol=1e-12)
    assert np.array_equal(P[1], np.zeros(2))


@pytest.mark.parametrize("late", [False, True])
def test_a_corrected_simulator_is_inverted(corrected, late):
    found, train, test = corrected
    if late:  # a shift register carries the input on, which memory of operators does not
        delayed = found.corrected.with_element("actuator:force", Delay().at({"T": 3 * DT}))
        found = diagnosis(delayed, [train])
    made = pilfr.feedforward(found, train)
    assert made.delay >= 4 * late and "an approximate inverse" in str(made)
    wanted = 0.5 * np.convolve(test.y[:, 0], np.hanning(41) / 20, "same")[:1000]
    step = found.export().step
    y = np.asarray(step.mapaccum("run", 1000)(np.zeros(step.size1_in(0)), made.inputs(wanted).T)[1]).ravel()
    assert np.sqrt(np.mean((y - wanted) ** 2)) < 0.1 * np.std(wanted)


def test_what_does_not_fit_the_recording_is_refused(corrected):
    found, train, _ = corrected
    export = found.export(start=train)
    other = pilfr.Recording(train.u, train.y, 2 * DT, inputs=("force",), outputs=("x2",), initial="zero")
    for verb in (pilfr.kalman_filter, pilfr.feedforward):
        for given, record in ((export, other), (export, train.with_(outputs=("x1",))), (found, other), (found, None)):
            with pytest.raises(InputError) as error:
                verb(given, record)
            assert "\n" not in str(error.value) and str(error.value).endswith("."), error.value
