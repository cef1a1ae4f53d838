"""Observers: extended Kalman filters of fits and simulators, and the memory that the outputs do not show."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from diagnosis_rig import DT, recordings, rig as two_masses
from small_fits import A, fitted, plays, refused

import pilfr_casadi as pilfr
from pilfr_casadi.cli.demo import demo_recordings
from pilfr_casadi.control import PredictiveController, ekf_step, feedforward, kalman_filter, roll_out, visibility
from pilfr_casadi.diagnose import Diagnosis
from pilfr_casadi.laws import Delay, StopHysteresis
from pilfr_casadi.linear import steady_state_gain
from pilfr_casadi.models import play
from problems import observer as observer_problem

LAW = StopHysteresis().at({"w": 80.0, "r": np.geomspace(0.001, 0.04, 6)})


@pytest.fixture(scope="module")
def rig():
    records = demo_recordings()
    structure = pilfr.PILFR(5, pilfr.PrandtlIshlinskii(pilfr.Play, 10))
    return pilfr.fit(structure, records["train"], starts=3), records


def diagnosis(corrected, data, hold="zero"):
    empty = dict.fromkeys(("sentence", "effects", "candidates", "mismatch", "parameters", "errors", "floor"))
    return Diagnosis(
        verdict="complete",
        gates=(),
        **empty,
        corrected=corrected,
        refitted=corrected,
        hold=hold,
        train=tuple(data),
        substeps=4,
    )


@pytest.fixture(scope="module")
def corrected():
    train, test = recordings(LAW)
    return diagnosis(two_masses().with_element("ground-m1", LAW), [train]), train, test


def test_a_linear_model_gets_the_kalman_gain_of_the_riccati_equation():
    from scipy.linalg import solve_discrete_are

    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    c = np.array([[1.0, 0.4]])
    function = ca.Function("F", [x, u], [A @ x + u, c @ x])
    q, r = np.diag([0.1, 0.3]), np.array([[0.2]])
    step, p, state = ekf_step(function, q, r), np.eye(2), np.array([1.0, -1.0])
    for _ in range(200):
        _, p, predicted = step(state, p, 0.0, 0.0)
    p = np.asarray(p)
    assert float(predicted) == pytest.approx((c @ state).item(), abs=1e-14)
    np.testing.assert_allclose(p, solve_discrete_are(A.T, c.T, q, r), rtol=1e-10)
    gain = A @ p @ c.T / (c @ p @ c.T + r)
    np.testing.assert_allclose(steady_state_gain(A, c, q, r), gain, rtol=1e-9)
    following = step(state, p, 0.7, 0.9)[0]
    np.testing.assert_allclose(
        np.asarray(following).ravel(), A @ state + 0.7 + (gain * (0.9 - c @ state)).ravel(), rtol=1e-10
    )


def test_next_values_of_a_recording_are_inputs_that_act_until_the_next_sample():
    train = recordings(LAW)[0].with_(hold="next")
    simulator = two_masses().with_element("ground-m1", LAW)
    for source in (simulator, diagnosis(simulator, [train], hold="next")):
        run = roll_out(source, train, "test")
        np.testing.assert_allclose(run.y, simulator.simulate(train), rtol=0, atol=1e-3 * np.std(train.y))


def test_covariance_of_a_play_is_kept_while_it_sticks_and_replaced_when_it_slips():
    q, u = ca.SX.sym("q"), ca.SX.sym("u")
    function = ca.Function("F", [q, u], [play(u, q, 1.0), ca.SX(0.0)])
    step = ekf_step(function, np.array([[1e-6]]), np.array([[1.0]]))
    sticks, slips = (float(step(0.0, 4.0, u, 0.0)[1]) for u in (0.5, 3.0))
    assert sticks == pytest.approx(4.0 + 1e-6, rel=1e-12)
    assert slips == pytest.approx(1e-6, rel=1e-9)


@pytest.mark.slow
def test_wrong_memory_is_recovered_after_two_excursions():
    rows, _ = observer_problem.ratios(seeds=4)["extended"]
    assert np.max(rows[:, 2]) < 1.2
    assert np.max(rows[:, 1]) < 1.2


@pytest.mark.slow
def test_memory_is_recovered_from_the_first_samples_of_a_recording(rig):
    """Scored on the samples after those that the state is fitted to, from six beginnings within a multisine."""
    fit, records = rig
    test, function, errors = records["multisine"], fit.to_casadi(), []
    for start in (500, 800, 1200, 2000, 3000, 5000):
        known = np.asarray(function.mapaccum("run", start)(np.zeros(15), test.u[:start].T)[0])[:, -1]
        forgotten = known.copy()
        forgotten[5:] = 0
        part = test.slice(start, start + 1000).with_(initial="estimate")
        first, run = fit.scored_from(part), function.mapaccum("run", len(part))
        simulated = (np.asarray(run(x0, part.u.T)[1]).T for x0 in (known, fit.initial_state(part), forgotten))
        errors.append([np.sqrt(np.mean((y - part.y)[first:] ** 2)) for y in simulated])
    known_error, estimated_error, forgotten_error = np.mean(errors, axis=0)
    assert estimated_error < 1.2 * known_error
    assert forgotten_error > 1.5 * estimated_error


def test_disturbance_takes_up_a_constant_error_of_the_sensor(small):
    fit, record, _ = small
    made = kalman_filter(fit, record, disturbance=True, share=0.1)
    states, predicted, P = made.run(record.u, record.y + 0.5)
    assert states.shape == (401, fit.model.n_state + 1) and P.shape == (6, 6)
    assert np.mean(states[200:, -1]) == pytest.approx(0.5, rel=0.2)
    assert np.sqrt(np.mean((predicted - record.y - 0.5)[200:] ** 2)) < 0.02


def test_two_inputs_and_outputs_are_observed(square):
    fit, record = square
    for disturbance in (False, True):
        observer = kalman_filter(fit, record, disturbance=disturbance)
        states, predicted, P = observer.run(record.u, record.y)
        assert states.shape == (len(record) + 1, 2 + 2 * disturbance) and P.shape == (len(observer.x0),) * 2
        assert np.max(np.abs(predicted - record.y)[20:]) < 1e-3
    assert "no memory" in str(visibility(fit, observer, np.zeros(4), record.u[:10]))


def test_a_model_without_any_error_is_observed():
    from scipy.linalg import block_diag, expm
    from scipy.signal import dlsim

    u = np.random.default_rng(0).standard_normal((800, 2))
    a = block_diag(*(expm(0.01 * np.array([[0.0, 1.0], [-k, -3.0]])) for k in (130.0, 60.0, 200.0)))
    b, c = np.zeros((6, 2)), np.zeros((2, 6))
    b[[1, 3, 5], [0, 1, 1]], c[[0, 0, 1], [0, 2, 4]] = 0.01, (3.0, 0.2, 2.0)
    exact = pilfr.Recording(u, dlsim((a, b, c, np.zeros((2, 2)), 1.0), u)[1], 0.01, initial="zero")
    found = pilfr.fit(pilfr.PILFR(6), exact, starts=1)
    predicted = kalman_filter(found, exact).run(exact.u, exact.y)[1]
    assert np.all(np.std((exact.y - predicted)[50:], axis=0) < 1e-6 * np.std(exact.y, axis=0))
    refused(lambda: kalman_filter(found, exact, share=1e-9).run(exact.u, exact.y), "a larger share")


def test_covariances_of_states_of_unlike_sizes_are_taken(small):
    _, record, observer = small
    for P0 in (np.zeros((5, 5)), np.diag([1e-20, 1.0, 1e9, 0.0, 1e-6]), np.ones((5, 5)), observer.P0):
        assert np.all(np.isfinite(observer.run(record.u[:5], record.y[:5], None, P0)[1]))


def test_sticking_operators_are_seen_as_a_sum_and_an_early_slip_wipes_memory(small):
    fit, record, _ = small
    made = kalman_filter(fit, record, share=1e-2)
    rest = visibility(fit, made, np.zeros(5), np.zeros((30, 1)))
    assert "stick over all 30 samples" in str(rest) and "weighted sum" in str(rest)
    assert rest.rank < 5
    made.spread[2:] = 1.0  # equally little is known beforehand of each memory
    jump = visibility(fit, made, np.zeros(5), np.full((30, 1), 5.0))
    assert 2 in jump.unseen and 3 in jump.unseen  # they slip in the first sample, before w is formed
    assert "wiped out before a trace" in str(jump)
    assert "1 (r = " in str(jump)
    assert jump.left[4] < 0.5 and 4 not in jump.unseen  # the only one that sticks, at a level that the outputs see


def test_memory_without_weight_is_named():
    fit, record = fitted(*plays([0.2, 1.0], [0.5, 0.0]))
    made = kalman_filter(fit, record, share=1e-2)
    weightless = fit.model.parameters.change(w={"value": [[0.5, 0.0]]})
    fit = replace(fit, model=fit.model.with_parameters(weightless))
    made = replace(made, function=fit.to_casadi())
    assert "2 (r = " in str(said := visibility(fit, made, np.zeros(4), np.zeros((20, 1))))
    assert "its weight is zero" in str(said)
    refused(lambda: visibility(fit, made, np.zeros(3), np.zeros((20, 1))), "give 4 numbers")


def test_a_diagnosis_its_simulator_and_its_export_are_observed(corrected):
    found, train, test = corrected
    made = [kalman_filter(of, train, share=1e-2) for of in (found, found.corrected, found.export(start=train))]
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
    said = str(visibility(found, made[0], known, part.u[:4]))
    assert "Memory ground-m1.memory" in said and "(r = " in said, said
    controller = PredictiveController(made[0].function, 10, inputs=(-100, 100))
    assert np.all(np.isfinite(controller(known, test.y[500:510], train.u[499]).u))


def test_interpolated_inputs_are_observed_and_not_inverted():
    data = recordings(LAW, count=1, hold="linear")
    found = diagnosis(two_masses().with_element("ground-m1", LAW), data, "linear")
    observer = kalman_filter(found, data[0], share=1e-2)
    u = np.hstack([data[0].u, np.vstack([data[0].u[1:], data[0].u[-1:]])])
    error = (observer.run(u, data[0].y)[1] - data[0].y)[100:]
    assert np.std(error) < 2e-3 * np.std(data[0].y)
    refused(lambda: feedforward(found, data[0]), "input is interpolated between samples")


def test_next_values_act_one_step_earlier_in_an_observer():
    simulator, data = two_masses().with_element("ground-m1", LAW), recordings(LAW, count=1, hold="zero")
    late = data[0].with_(u=np.vstack([data[0].u[:1], data[0].u[:-1]]), hold="next")
    wanted = kalman_filter(diagnosis(simulator, data, "zero"), data[0])
    for given in (late, late.with_(hold=None)):
        observer = kalman_filter(diagnosis(simulator, [late], "next"), given)
        np.testing.assert_allclose(observer.Q, wanted.Q, rtol=1e-3)
    step = pilfr.exported(simulator, dt=DT, hold="next", start=late)
    np.testing.assert_allclose(kalman_filter(step, late).Q, wanted.Q, rtol=1e-3)


def test_a_simulator_in_discrete_time_is_observed_with_the_inputs_at_the_samples():
    sampled = pilfr.Simulator(
        lambda x, u: {"a": 0.5 * x.a + u.f}, lambda x: {"y": x.a}, ("a",), ("f",), hold="next", discrete=True
    )
    u = np.random.default_rng(0).standard_normal((200, 1))
    r = pilfr.Recording(u, np.zeros_like(u), 0.1, ("f",), ("y",), initial="zero", hold="next")
    np.testing.assert_allclose(roll_out(sampled, r, "test").y, sampled.simulate(r), rtol=0, atol=1e-12)


def test_an_observer_begins_at_the_time_of_the_recording():
    simulator = pilfr.Simulator(
        lambda x, u, t: {"a": -x.a + u.f + ca.sin(t)}, lambda x: {"y": x.a}, states=("a",), inputs=("f",)
    )
    u = np.random.default_rng(0).standard_normal((300, 1))
    planned = pilfr.Recording(u, np.empty((300, 0)), 0.05, ("f",), (), initial=[0.3], hold="zero", start=7.0)
    y = simulator.simulate(planned)
    exported = pilfr.exported(simulator, dt=0.05, start=planned)
    assert exported.x0() == pytest.approx([0.3, 7.0])
    assert np.asarray(exported.step.mapaccum("run", 300)(exported.x0(), u.T)[1]).ravel() == pytest.approx(y[:, 0])
    observer = kalman_filter(simulator, planned.with_(y=y, outputs=("y",)))
    assert observer.x0 == pytest.approx([0.0, 7.0])
    assert np.max(np.abs(observer.run(u, y)[1] - y)[5:]) < 1e-6


def test_an_observer_does_not_correct_the_time():
    simulator = pilfr.Simulator(
        lambda x, u, t: {"a": -x.a + u.f + 0.1 * ca.sin(t)}, lambda x: {"y": x.a}, states=("a",), inputs=("f",)
    )
    rng = np.random.default_rng(0)
    u = rng.standard_normal((300, 1))
    step = pilfr.exported(simulator, dt=0.1, hold="zero").step
    y = np.asarray(step.mapaccum("run", 300)(np.zeros(2), u.T)[1]).T + 1e-3 * rng.standard_normal((300, 1))
    record = pilfr.Recording(u, y, 0.1, inputs=("f",), outputs=("y",), initial="zero", hold="zero")
    observer = kalman_filter(simulator, record)
    states, _, P = observer.run(u, y)
    np.testing.assert_allclose(states[:, 1], 0.1 * np.arange(301), rtol=1e-12)
    assert np.array_equal(P[1], np.zeros(2))


@pytest.mark.parametrize("late", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_corrected_simulator_is_inverted(corrected, late):
    found, train, test = corrected
    if late:  # a shift register carries the input on, which memory of operators does not
        delayed = found.corrected.with_element("actuator:force", Delay().at({"T": 3 * DT}))
        found = diagnosis(delayed, [train])
    made = feedforward(found, train, ahead=10 if late else 7)
    assert made.delay >= 4 * late and "an approximate inverse" in str(made)
    wanted = 0.5 * np.convolve(test.y[:, 0], np.hanning(41) / 20, "same")[:400]
    step = found.export().step
    y = np.asarray(step.mapaccum("run", 400)(np.zeros(step.size1_in(0)), made.inputs(wanted).T)[1]).ravel()
    assert np.sqrt(np.mean((y - wanted) ** 2)) < 0.1 * np.std(wanted)


def test_models_of_another_recording_are_refused(corrected):
    found, train, _ = corrected
    export = found.export(start=train)
    other = pilfr.Recording(train.u, train.y, 2 * DT, inputs=("force",), outputs=("x2",), initial="zero")
    for verb in (kalman_filter, feedforward):
        for pair in ((export, other), (export, train.with_(outputs=("x1",))), (found, other), (found, None)):
            refused(lambda pair=pair, verb=verb: verb(*pair))


@pytest.mark.parametrize("share", ["a", [1e-3], np.inf, np.nan, 0, -1])
def test_unusable_shares_are_refused(small, share):
    refused(lambda: kalman_filter(*small[:2], share=share), "share of process noise")


def test_unusable_arguments_of_an_observer_are_refused(small):
    fit, record, observer = small
    u, y = record.u[:50], record.y[:50]
    refused(lambda: kalman_filter(None, record), "give a Fit")
    refused(lambda: kalman_filter(fit.model, record), "give a Fit")
    refused(lambda: kalman_filter(fit, record.u), "give a Recording")
    indefinite = np.eye(5) + 2 * (np.eye(5, k=1) + np.eye(5, k=-1))
    empty = np.diag([0.0, 1, 1, 1, 1]) + 0.1 * (np.eye(5, k=1) + np.eye(5, k=-1))
    for P0 in (np.eye(3), "a", np.full((5, 5), np.nan), -np.eye(5), np.triu(np.ones((5, 5))), indefinite, empty):
        refused(lambda P0=P0: observer.run(u, y, None, P0), "P0")
    for pair in ((None, y), (u, None), ("a", y), ([], []), (3.0, 4.0), (u, y[:10]), (u, np.where(y > 0, y, np.nan))):
        refused(lambda pair=pair: observer.run(*pair))
    refused(lambda: observer.run(u, y, np.zeros(3)), "given to the filter")
    refused(lambda: visibility(fit, observer, np.zeros(3), u), "give 5 numbers")
    refused(lambda: kalman_filter(*fitted(pilfr.PILFR(0), {"D_yu": [[2.0]]})), "neither states nor memory")
    refused(lambda: visibility(fit, None, np.zeros(5), u), "give a Fit and its kalman_filter")
    refused(lambda: visibility(None, observer, np.zeros(5), u), "give a Fit and its kalman_filter")
    linear, other = fitted(pilfr.PILFR(2), {"A": A, "B_u": [[1.0], [0.5]], "C_y": [[1.0, 0.4]]})
    blind = kalman_filter(linear, other, share=1e-3)
    refused(lambda: visibility(fit, blind, np.zeros(2), u), "the model's own observer")


def test_a_model_that_diverges_is_neither_observed_nor_inverted(small):
    fit, record, _ = small
    wild = fit.model.with_parameters(fit.model.parameters.change(A={"value": 3 * np.eye(2)}))
    for verb in (kalman_filter, feedforward):
        refused(lambda verb=verb: verb(replace(fit, model=wild), record), "diverges along the recording")


def test_a_machine_without_an_input_is_filtered():
    """Of a cooling curve, the predictions are off by the noise."""
    cooling = pilfr.Simulator(
        lambda x, p: {"T": -x.T / p.tau},
        lambda x: {"T": x.T},
        states=("T",),
        parameters={"tau": pilfr.Parameter(1.0, bounds=(0.1, 10))},
    )
    y = np.exp(-0.02 * np.arange(200) / 1.5)[:, None] + 1e-3 * np.random.default_rng(0).standard_normal((200, 1))
    given = pilfr.Recording(np.empty((200, 0)), y, 0.02, outputs=("T",))
    observer = kalman_filter(pilfr.fit(cooling, given), given)
    assert np.std((observer.run(given.u, given.y)[1] - given.y)[20:]) < 2e-3
