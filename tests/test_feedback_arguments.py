"""Bad arguments of observer, inverse and controllers are one sentence; limits hold from any start."""

import re
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from test_feedback import A, fitted, plays

import pilfr_casadi as pilfr
from pilfr_casadi import InputError, PredictiveController
from pilfr_casadi.control.asked import planned_with


def refused(call, words=None):
    with pytest.raises(InputError, match=words) as error:
        call()
    text = str(error.value)
    assert "\n" not in text and text.endswith(".") and len(text) < 400, text


@pytest.fixture(scope="module")
def small():
    fit, record = fitted(*plays([0.2, 1.0, 50.0], [0.5, 0.3, 0.2]))
    return fit, record, pilfr.kalman_filter(fit, record, share=1e-3)


@pytest.fixture(scope="module")
def square():
    return fitted(pilfr.PILFR(2), {"A": A, "B_u": np.eye(2), "C_y": np.eye(2)}, n_u=2, n_y=2)


def first_order(pole=0.9):
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    return ca.Function("f", [x, u], [pole * x + u, x])


@pytest.mark.parametrize("share", ["a", [1e-3], np.inf, np.nan, 0, -1])
def test_shares_that_are_none(small, share):
    refused(lambda: pilfr.kalman_filter(*small[:2], share=share), "share of process noise")


def test_what_the_observer_cannot_use(small):
    fit, record, observer = small
    u, y = record.u[:50], record.y[:50]
    refused(lambda: pilfr.kalman_filter(None, record), "give a Fit")
    refused(lambda: pilfr.kalman_filter(fit.model, record), "give a Fit")
    refused(lambda: pilfr.kalman_filter(fit, record.u), "give a Recording")
    indefinite = np.eye(5) + 2 * (np.eye(5, k=1) + np.eye(5, k=-1))
    empty = np.diag([0.0, 1, 1, 1, 1]) + 0.1 * (np.eye(5, k=1) + np.eye(5, k=-1))
    for P0 in (np.eye(3), "a", np.full((5, 5), np.nan), -np.eye(5), np.triu(np.ones((5, 5))), indefinite, empty):
        refused(lambda P0=P0: observer.run(u, y, None, P0), "P0")
    for pair in ((None, y), (u, None), ("a", y), ([], []), (3.0, 4.0), (u, y[:10]), (u, np.where(y > 0, y, np.nan))):
        refused(lambda pair=pair: observer.run(*pair))
    refused(lambda: pilfr.visibility(fit, None, np.zeros(5), u), "give a Fit and its kalman_filter")
    refused(lambda: pilfr.visibility(None, observer, np.zeros(5), u), "give a Fit and its kalman_filter")
    linear, other = fitted(pilfr.PILFR(2), {"A": A, "B_u": [[1.0], [0.5]], "C_y": [[1.0, 0.4]]})
    blind = pilfr.kalman_filter(linear, other, share=1e-3)
    refused(lambda: pilfr.visibility(fit, blind, np.zeros(2), u), "the model's own observer")


def test_a_model_that_diverges_is_neither_observed_nor_inverted(small):
    fit, record, _ = small
    wild = fit.model.with_parameters(fit.model.parameters.change(A={"value": 3 * np.eye(2)}))
    for verb in (pilfr.kalman_filter, pilfr.feedforward):
        refused(lambda verb=verb: verb(replace(fit, model=wild), record), "diverges along the recording")


def test_covariances_of_states_of_unlike_sizes_are_taken(small):
    _, record, observer = small
    for P0 in (np.zeros((5, 5)), np.diag([1e-20, 1.0, 1e9, 0.0, 1e-6]), np.ones((5, 5)), observer.P0):
        assert np.all(np.isfinite(observer.run(record.u[:5], record.y[:5], None, P0)[1]))


def test_what_a_compensator_cannot_work_on(small):
    fit, record, observer = small
    made = pilfr.feedforward(fit, record)
    refused(lambda: made.inputs(np.ones(9), np.zeros(3)), "A state of 3 numbers .* give 5, memory included")
    for thing in (3, "a", fit, observer.step):
        refused(lambda thing=thing: pilfr.feedforward(fit, record, observer=thing), "give a kalman_filter of this fit")
    changed = fit.model.parameters.change(w={"value": [[0.5, 0.3, 0.21]]})
    for other in (replace(fit, model=fit.model.with_parameters(changed)), fitted(pilfr.PILFR(3), {})[0]):
        theirs = pilfr.kalman_filter(other, record, share=1e-3)
        refused(lambda theirs=theirs: pilfr.feedforward(fit, record, observer=theirs), "one of another model")
    with_disturbance = pilfr.kalman_filter(fit, record, share=1e-3, disturbance=True)
    for own, n in ((observer, 5), (with_disturbance, 6)):
        assert pilfr.feedforward(fit, record, observer=own).step.size1_in(0) == n


def test_two_inputs_and_outputs_are_observed(square):
    fit, record = square
    for disturbance in (False, True):
        observer = pilfr.kalman_filter(fit, record, disturbance=disturbance)
        states, predicted, P = observer.run(record.u, record.y)
        assert states.shape == (len(record) + 1, 2 + 2 * disturbance) and P.shape == (len(observer.x0),) * 2
        assert np.max(np.abs(predicted - record.y)[20:]) < 1e-3
    assert "no memory" in str(pilfr.visibility(fit, observer, np.zeros(4), record.u[:10]))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"r": ["a"]}, "thresholds cannot be"),
        ({"r": [1j]}, "thresholds cannot be"),
        ({"r": [np.nan]}, "thresholds holds"),
        ({"r": [-0.1]}, "A threshold is -0.1"),
        ({"r": [0.1, 0.2]}, "2 thresholds and 1 weights"),
        ({"w": None}, "weights"),
        ({"gain": "a"}, "gain cannot be"),
        ({"gain": None}, "gain"),
        ({"gain": [1.0, 2.0]}, "gain cannot be"),
        ({"gain": np.inf}, "gain holds"),
        ({"name": "a b"}, "letters, digits"),
        ({"name": None}, "letters, digits"),
        ({"operator": None}, "give Play or Stop"),
    ],
)
def test_elements_that_cannot_be_inverted(given, words):
    arguments = {"r": [0.1], "w": [1.0], "gain": 1.0, **given}
    refused(lambda: pilfr.inverse_element(arguments.pop("r"), arguments.pop("w"), **arguments), words)


@pytest.mark.parametrize("memory", ["a", [np.nan, 0.0], [0.0], [[1], [2, 3]]])
def test_memories_that_are_none(memory):
    inverse = pilfr.inverse_element([0.1, 0.5], [1.0, 1.0], gain=1.0)
    refused(lambda: inverse.memory(memory))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"iterations": 0}, "iterations"),
        ({"iterations": "a"}, "iterations"),
        ({"iterations": 2.5}, "iterations"),
        ({"solver": None}, "'sqp' or 'ipopt'"),
        ({"move": "a"}, "move"),
        ({"move": None}, "move"),
        ({"move": np.inf}, "move"),
        ({"horizon": True}, "horizon"),
        ({"horizon": 0}, "horizon"),
        ({"inputs": (None, 1.0)}, "A limit of the inputs is None"),
        ({"outputs": (None, 1.0)}, "A limit of the outputs is None"),
        ({"outputs": (1.0, 1.0)}, "outputs is not below"),
        ({"function": ca.Function("g", [ca.SX.sym("x")], [ca.SX(1)])}, r"give \(x, u\) -> \(x_next, y\)"),
        ({"rate": "a"}, "rate"),
    ],
)
def test_controllers_that_cannot_be_made(change, words):
    arguments = {"function": first_order(), "horizon": 5, "inputs": (-1.0, 1.0), **change}
    refused(lambda: PredictiveController(arguments.pop("function"), arguments.pop("horizon"), **arguments), words)


def test_a_transposed_reference_is_refused(square):
    controller = PredictiveController(square[0].to_casadi(), 8, inputs=(-5, 5))
    wanted = np.tile([1.0, -2.0], (8, 1))
    np.testing.assert_allclose(controller(np.zeros(2), wanted, np.zeros(2)).outputs[-1], [1.0, -2.0], atol=1e-3)
    for reference in (wanted.T, wanted.ravel(), wanted[:4], wanted[:, :1], 1.0):
        refused(lambda reference=reference: controller(np.zeros(2), reference, np.zeros(2)), re.escape("give (8, 2)"))


@pytest.mark.parametrize("solver", ["sqp", "ipopt"])
def test_a_rate_of_one_input_holds_where_the_other_has_none(square, solver):
    controller = PredictiveController(
        square[0].to_casadi(), 8, inputs=([-3, -5], [3, 5]), rate=[0.2, np.inf], solver=solver
    )
    plan = controller(np.zeros(2), np.tile([1.0, -2.0], (8, 1)), np.zeros(2))
    moves = np.max(np.abs(np.diff(plan.inputs, axis=0, prepend=0.0)), axis=0)
    assert plan.converged and moves[0] <= 0.2 + 1e-6 and moves[1] > 0.5


@settings(max_examples=60, deadline=None)
@given(st.floats(-3, 3), st.lists(st.floats(-20, 20), min_size=2, max_size=4), st.floats(0.05, 1.0), st.floats(-20, 20))
def test_rates_and_limits_hold_whatever_was_applied_before(x, befores, rate, level):
    """Also where the last plan was not followed, as under a manual mode."""
    controller = PredictiveController(first_order(), 6, inputs=(-1.0, 1.0), outputs=(-2.0, 2.0), rate=rate)
    for before in befores:
        plan = controller([x], np.full(6, level), [before])
        u = plan.inputs[:, 0]
        assert np.all(np.abs(u) <= 1.0 + 1e-9)
        first = max(rate, abs(before) - 1.0)  # as large as it takes to come back inside the limits
        assert abs(u[0] - before) <= first + 1e-6 and np.all(np.abs(np.diff(u)) <= rate + 1e-6)


@pytest.mark.parametrize("solver", ["sqp", "ipopt"])
def test_a_previous_input_outside_its_limits_is_brought_back(solver):
    controller = PredictiveController(first_order(), 6, inputs=(-1.0, 1.0), rate=0.1, solver=solver)
    plan = controller([0.0], np.zeros(6), [5.0])
    assert plan.converged and plan.u[0] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("solver", ["sqp", "ipopt"])
def test_a_plan_that_diverges_is_not_called_converged(solver):
    controller = PredictiveController(first_order(1e8), 60, inputs=(-1.0, 1.0), solver=solver)
    plan = controller([1.0], np.zeros(60), [0.0])
    assert not plan.converged and np.all(np.abs(plan.inputs) <= 1.0)


def test_do_mpc_gets_the_same_sentences():
    make = pilfr.do_mpc_controller
    function, limits = first_order(), {"inputs": (-1.0, 1.0)}
    refused(lambda: make(3, 5, np.zeros(9), **limits), "casadi.Function")
    refused(lambda: make(function, 0, np.zeros(9), **limits), "horizon")
    refused(lambda: make(function, 5, "a", **limits), "reference")
    refused(lambda: make(function, 5, np.zeros((9, 2)), **limits), re.escape("give (samples, 1)"))
    refused(lambda: make(function, 5, [np.nan] * 9, **limits), "finite")
    refused(lambda: make(function, 5, np.zeros(9), inputs=(1.0, -1.0)), "low below high")


def test_what_a_controller_plans_with_is_what_do_mpc_takes(small):
    pytest.importorskip("do_mpc")
    fit, _, observer = small
    for plant in (fit, observer, fit.export(), fit.to_casadi()):
        function = planned_with(plant)
        model = pilfr.do_mpc_model(plant)
        assert model.x.shape[0] == function.size1_in(0) and model.u.shape[0] == function.size1_in(1)
        assert pilfr.PredictiveController(plant, 3, inputs=(-1, 1)).function.size1_in(0) == function.size1_in(0)
    refused(lambda: pilfr.do_mpc_model("f"), "A str cannot be planned with; give a Fit")


def test_what_is_printed_is_short_and_readable(small):
    fit, _, observer = small
    controller = PredictiveController(fit, 4, inputs=(-1, 1), outputs=(-9, 9), rate=0.5)
    plan = controller(np.zeros(controller.function.size1_in(0)), np.zeros(4), [0.0])
    inverse = pilfr.inverse_element([0.2, 1.0], [0.5, 0.3], gain=1.0)
    for thing, words in (
        (observer, "extended Kalman filter of 5 states (memory included), 1 inputs and 1 outputs"),
        (controller, "over 4 samples by sqp: 5 states, 1 inputs, 1 outputs, limits of the inputs and outputs, rates"),
        (plan, "plan over 4 samples, converged in"),
        (inverse, "inverse element of 3 plays"),
    ):
        assert words in str(thing) == repr(thing) and len(str(thing)) < 300 and "array(" not in str(thing), str(thing)
    assert "process noise a step: 0.001 of each" in str(observer) and "outputs within their limits" in str(plan)


def test_interpolated_inputs_are_refused():
    dynamics, outputs = (lambda x, u: dict(v=u.f - 4.0 * x.v)), (lambda x: dict(v=x.v))
    simulator = pilfr.Simulator(dynamics, outputs, states=("v",), inputs=("f",))
    linear, zero = pilfr.exported(simulator, dt=0.1, hold="linear"), pilfr.exported(simulator, dt=0.1)
    refused(lambda: PredictiveController(linear, 5, inputs=(-1.0, 1.0)), "interpolated")
    refused(lambda: pilfr.do_mpc_controller(linear, 5, np.zeros(9), inputs=(-1.0, 1.0)), "interpolated")
    assert PredictiveController(zero, 5, inputs=(-1.0, 1.0)).function.size1_in(1) == 1
