"""Bad arguments of observer, inverse and controllers are one sentence; limits hold from any start."""

from dataclasses import replace

import numpy as np
import pytest
from test_feedback import A, fitted, plays

import pilfr_casadi as pilfr
from pilfr_casadi import InputError


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
