"""Inverses: of a Prandtl-Ishlinskii element, exactly, and of whole models, with their delays and zeros."""

import re
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from small_fits import A, fitted, refused

import pilfr_casadi as pilfr
from pilfr_casadi.control import analyse_response, feedforward, inverse_element, kalman_filter, roll_out
from pilfr_casadi.control.inverse import _gain_and_radius
from pilfr_casadi.models import play


@settings(max_examples=20, deadline=None)
@given(
    st.lists(st.floats(0, 3), min_size=1, max_size=6),
    st.integers(0, 10**6),
    st.sampled_from([pilfr.Play, pilfr.Stop]),
    st.integers(0, 80),
)
def test_the_inverse_gives_back_the_input_from_any_memory(thresholds, seed, operator, begin):
    rng = np.random.default_rng(seed)
    r = np.array(thresholds)
    w = rng.uniform(0.05, 1.0, len(r)) * np.where(rng.random(len(r)) < 0.5, 1.0, -0.1)
    gain = 1.0 if operator is pilfr.Play else 0.3 + np.sum(np.maximum(0, -w))
    z, q, memories, v = np.cumsum(rng.standard_normal(120)), np.zeros(len(r)), [], []
    for value in z:
        memories.append(q)
        q = play(value, q, r)
        v.append(gain * value + np.sum(w * (q if operator is pilfr.Play else value - q)))
    for sign in (1.0, -1.0):  # an output that falls as the input rises has an inverse too
        made = inverse_element(r, sign * w, gain=sign * gain, operator=operator)
        memory = made.memory(memories[begin])
        assert np.all(made.r >= 0)
        for wanted, truth in zip(v[begin:], z[begin:], strict=True):
            memory, u = made.step(memory, sign * wanted)
            assert float(u) == pytest.approx(truth, abs=1e-9)


def test_the_inverse_is_a_prandtl_ishlinskii_element():
    made = inverse_element([0.5, 1.0], [0.4, 0.3], gain=1.0)
    element = pilfr.PrandtlIshlinskii(pilfr.Play, 3)
    s, memory, p = np.zeros((3, 1)), made.memory(), {"r": ca.DM(made.r[None]), "w": ca.DM(made.w[None])}
    for v in (1.0, 2.0, 0.5, -3.0, 1.0):
        memory, u = made.step(memory, v)
        w, s = element.step(ca.DM([v]), s, p)
        assert float(w) == pytest.approx(float(u), abs=1e-13)


@pytest.mark.parametrize(
    ("r", "w", "options", "words"),
    [
        ([0.5, 1.0], [0.4, 0.6], {"operator": pilfr.Stop}, "slope is 1 right after a reversal and 0 once"),
        ([0.5], [1.0], {}, "add a linear part"),
        ([0.5], [-2.0], {"gain": 1.0}, "above zero, or all below"),
        ([0.5], [1.0], {"gain": 1.0, "operator": pilfr.GeneralizedPlay}, "closed form"),
    ],
)
def test_elements_without_an_inverse_say_why(r, w, options, words):
    refused(lambda: inverse_element(r, w, **options), words)


def test_an_inverse_and_its_memory_print_and_fit():
    made = inverse_element([0.2, 1.0], [0.5, 0.3], gain=1.0)
    assert "inverse element of 3 plays" in str(made) == repr(made)
    refused(lambda: made.memory([0.0]), "one each")


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
def test_unusable_arguments_of_an_inverse_are_refused(given, words):
    arguments = {"r": [0.1], "w": [1.0], "gain": 1.0, **given}
    refused(lambda: inverse_element(arguments.pop("r"), arguments.pop("w"), **arguments), words)


@pytest.mark.parametrize("memory", ["a", [np.nan, 0.0], [0.0], [[1], [2, 3]]])
def test_unusable_memories_are_refused(memory):
    inverse = inverse_element([0.1, 0.5], [1.0, 1.0], gain=1.0)
    refused(lambda: inverse.memory(memory))


def test_the_inverse_of_a_minimum_phase_model_is_exact(small):
    fit, record, _ = small
    made = feedforward(fit, record, limits=(-100, 100))
    function = fit.to_casadi()
    assert made.ahead == 1
    rng = np.random.default_rng(0)
    u = 3 * np.sin(np.arange(200) / 9) + 0.3 * rng.standard_normal(200)
    y = np.asarray(function.mapaccum("run", 200)(np.zeros(5), u[None, :])[1]).ravel()
    np.testing.assert_allclose(made.inputs(y)[:-1, 0], u[:-1], atol=1e-9)


def test_inputs_stay_inside_their_limits_where_the_wanted_output_is_out_of_reach(small):
    fit, record, _ = small
    made = feedforward(fit, record, limits=(-1, 2))
    np.testing.assert_allclose(made.inputs(np.full(20, 1e3)), 2.0, rtol=1e-6)
    np.testing.assert_allclose(made.inputs(np.full(20, -1e3)), -1.0, rtol=1e-6)


def test_models_without_an_inverse_are_refused_with_the_reason():
    values = {"A": A, "B_u": [[1.0], [0.5]], "C_y": np.eye(2)}
    two = fitted(pilfr.PILFR(2), values, n_y=2)
    refused(lambda: feedforward(*two), r"1 input\(s\) and 2 output\(s\)")
    values = {"A": A, "B_u": np.eye(2), "C_y": [[1.0, 0.4]]}
    refused(lambda: feedforward(*fitted(pilfr.PILFR(2), values, n_u=2)), r"2 input\(s\) and 1 output\(s\)")
    # y_{k+1} = -0.5 u_k + u_{k-1} inverted one step ahead: a zero at 2
    delay = {"A": [[0.0, 0.0], [1.0, 0.0]], "B_u": [[1.0], [0.0]], "C_y": [[-0.5, 1.0]]}
    phase = fitted(pilfr.PILFR(2, fixed={"D_yu": 0.0}), delay)
    refused(lambda: feedforward(*phase, ahead=1), "no stable inverse with a look-ahead of 1 samples")
    refused(lambda: feedforward(*phase, ahead=0), "reaches the output only after 1 ")


def recorded(delay, noise, smooth, seed=0, samples=1500):
    """A machine of two states behind four plays and a delay, and its recording."""
    rng = np.random.default_rng(seed)
    window = np.ones(smooth) / np.sqrt(smooth)
    u = 1.2 * np.convolve(rng.standard_normal(samples + smooth - 1), window, "valid")
    r, s, x, y = np.array([0.1, 0.3, 0.6, 1.0]), np.zeros(4), np.zeros(2), np.zeros(samples)
    for k in range(samples):
        y[k] = x[0] + 0.5 * x[1]
        v = u[k - delay] if k >= delay else 0.0
        s = np.minimum(v + r, np.maximum(v - r, s))
        x = np.array([0.8 * x[0] + 0.2 * (v + 0.3 * s.sum()), 0.7 * x[1] + 0.3 * x[0]])
    y += noise * np.std(y) * rng.standard_normal(samples)
    return pilfr.Recording(u, y, 0.01, initial="zero", hold="zero")


SLOW = [(d, n, s) for d in (0, 1, 3, 6) for n in (1e-3, 1e-2) for s in (1, 8)]


@pytest.mark.parametrize(
    ("delay", "noise", "smooth"),
    [(1, 1e-3, 1), *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW)],
)
def test_a_fitted_delay_is_found_whatever_the_noise_of_the_fit(delay, noise, smooth):
    record = recorded(delay, noise, smooth, seed=delay)
    fit = pilfr.fit(pilfr.PILFR(2 + delay, pilfr.PrandtlIshlinskii(pilfr.Play, 6)), record, starts=2)
    response = analyse_response(fit, roll_out(fit, record, "feedforward"), record)
    assert response.delay == delay + 1
    assert np.max(response.markov[: delay + 1]) > 0  # small, but not zero
    made = feedforward(fit, record)
    assert (made.delay, made.ahead) == (delay + 1, delay + 1)
    samples = f"{delay + 1} sample" + "s" * (delay > 0)
    early = re.escape(f"{100 * response.early:.1g} %")
    assert re.fullmatch(
        f"An input reaches the output after {samples}, but it has {early} of its largest response before, "
        f"counted as a model error: an approximate inverse, for a path that is known {samples} ahead.",
        str(made),
    )
    if delay:
        words = f"only after {delay + 1} .* give ahead={delay + 1} or more"
        text = refused(lambda: feedforward(fit, record, ahead=delay), words)
        assert "stable" not in text and "phase" not in text
    wanted = 1.5 * np.sin(np.arange(400) / 25.0)
    u = made.inputs(wanted)
    y = fit.simulate(record.with_(u=u, y=np.zeros((400, 1))))[:, 0]
    late = slice(delay + 30, 400)
    assert np.sqrt(np.mean((y - wanted)[late] ** 2)) < 0.05 * np.std(wanted)


@pytest.mark.slow
def test_standard_errors_of_the_response_are_those_of_fits_to_other_noise():
    def response(seed):
        record = recorded(1, 1e-2, 4, seed=0)
        noise = 1e-2 * np.std(record.y) * np.random.default_rng(100 + seed).standard_normal(record.y.shape)
        again = record.with_(y=record.y + noise)
        fit = pilfr.fit(pilfr.PILFR(3, pilfr.PrandtlIshlinskii(pilfr.Play, 4)), again, starts=1)
        found = analyse_response(fit, roll_out(fit, again, "feedforward"), again)
        return found.markov[:3] / found.markov[2], found.errors[:3] / found.markov[2]

    found, errors = (np.array(v) for v in zip(*map(response, range(12)), strict=True))
    expected = np.median(errors, axis=0)
    assert np.all(found[:, :2] < 4 * expected[:2])
    assert np.all(np.mean(found[:, :2] ** 2, axis=0) ** 0.5 > 0.1 * expected[:2])  # the errors are not far too large


def chain(delay, first=(1.0,)):
    """`y_k = Σ first_j u_{k-delay-j}` exactly."""
    n = delay + len(first) - 1
    c = np.zeros((1, n))
    c[0, delay - 1 :] = first
    values = {"A": np.eye(n, k=-1), "B_u": np.eye(n)[:, :1], "C_y": c}
    return fitted(pilfr.PILFR(n, fixed={"D_yu": 0.0}), values, samples=60 * (n + 2))


def test_a_long_delay_is_inverted_with_the_preview_it_needs():
    fit, record = chain(8)
    made = feedforward(fit, record, limits=(-10, 10))
    assert (made.delay, made.ahead, len(made.zeros)) == (8, 8, 0)
    longer = feedforward(fit, record, ahead=10)
    assert str(longer) == (
        "An input reaches the output after 8 samples, but a longer look-ahead was given: an approximate inverse, "
        "for a path that is known 10 samples ahead."
    )
    wanted = np.sin(np.arange(100) / 9.0) * np.ptp(record.u) / 3
    np.testing.assert_allclose(made.inputs(wanted)[:60, 0], wanted[8:68], atol=1e-3)
    refused(lambda: feedforward(fit, record, ahead=5), r"The look-ahead is 5 samples, but .* only after 8 ")


def test_zeros_outside_the_unit_circle_are_listed_and_said_to_make_the_inverse_approximate():
    fit, record = chain(1, (-0.5, 1.0))  # a zero at 2
    made = feedforward(fit, record)
    assert made.delay == 1 and made.ahead > 1
    assert made.zeros == pytest.approx([2.0], rel=1e-2)
    assert re.search(r"would be unstable \(zeros on or outside the unit circle at (2|2\.0\d+|1\.9\d+)\)", str(made))
    assert str(made).endswith(f"an approximate inverse, for a path that is known {made.ahead} samples ahead.")
    same = feedforward(fit, record, ahead=made.ahead)
    assert str(same) == str(made) and same.zeros == pytest.approx([2.0], rel=1e-2)
    refused(lambda: feedforward(fit, record, ahead=1), r"non-minimum phase: zeros on or outside the unit circle at")


def test_a_pair_of_zeros_is_named_once():
    fit, record = chain(1, (1.0, -2.0, 2.0))  # zeros at 1 ± i
    try:
        text = str(feedforward(fit, record))
    except pilfr.InputError as error:
        text = str(error)
    assert re.search(r"at (1|0\.99\d+|1\.00\d+) ± (1|0\.99\d+|1\.00\d+)i[);]", text), text


def test_an_inverse_is_called_exact_where_it_gives_back_the_models_own_output():
    values = {"A": A, "B_u": [[1.0], [0.5]], "C_y": [[1.0, 0.4]]}
    for fixed, word in (({"D_yu": 0.0}, "the exact inverse"), ({}, "an approximate inverse")):
        fit, record = fitted(pilfr.PILFR(2, fixed=fixed), values)
        made = feedforward(fit, record, limits=(-50, 50))
        assert (made.delay, made.ahead) == (1, 1) and word in str(made)
        y = fit.simulate(record)[:, 0]
        again = fit.simulate(record.with_(u=made.inputs(y)))[:, 0]
        assert (np.max(np.abs(again - y)) < 1e-10 * np.max(np.abs(y))) == (word == "the exact inverse")


@pytest.mark.parametrize(("direct", "word"), [(0.5, "the exact inverse"), (-0.5, "an approximate inverse")])
def test_an_output_that_more_than_one_input_gives_has_no_exact_inverse(direct, word):
    element = pilfr.PrandtlIshlinskii(pilfr.Play, 2)
    values = {"D_yu": [[direct]], "D_yw": [[1.0]], "D_zu": [[1.0]], "w": [[0.4, 0.6]], "r": [[0.2, 0.6]]}
    made = feedforward(*fitted(pilfr.PILFR(0, element), values))
    assert made.delay == made.ahead == 0 and word in str(made)
    assert ("rises with the input in places and falls in others" in str(made)) == (direct < 0)


def test_a_model_without_response_to_the_input_is_refused():
    fit, record = fitted(pilfr.PILFR(2), {"A": A, "B_u": [[1.0], [0.5]], "C_y": [[1.0, 0.4]]})
    blocks = {"B_u": {"value": np.zeros((2, 1))}, "D_yu": {"value": np.zeros((1, 1))}}
    unresponsive = replace(fit, model=fit.model.with_parameters(fit.model.parameters.change(**blocks)))
    refused(lambda: feedforward(unresponsive, record), "nothing to invert")


@pytest.mark.parametrize("ahead", [True, 1.5, "3", -1, 10**6])
def test_unusable_look_aheads_are_refused(small, ahead):
    fit, record, _ = small
    refused(lambda: feedforward(fit, record, ahead=ahead), "whole number from 0 to 1000")


def test_other_objects_than_a_fit_and_a_recording_are_refused(small):
    fit, record, _ = small
    for pair in ((fit.to_casadi(), record), (fit, record.u), (None, None)):
        refused(lambda pair=pair: feedforward(*pair), "was given to feedforward")


def test_unusable_states_and_observers_are_refused(small):
    fit, record, observer = small
    made = feedforward(fit, record)
    refused(lambda: made.inputs(np.ones(9), np.zeros(3)), "A state of 3 numbers .* give 5, memory included")
    for thing in (3, "a", fit, observer.step):
        refused(lambda thing=thing: feedforward(fit, record, observer=thing), "give a kalman_filter of this fit")
    changed = fit.model.parameters.change(w={"value": [[0.5, 0.3, 0.21]]})
    for other in (replace(fit, model=fit.model.with_parameters(changed)), fitted(pilfr.PILFR(3), {})[0]):
        foreign = kalman_filter(other, record, share=1e-3)
        refused(lambda foreign=foreign: feedforward(fit, record, observer=foreign), "belongs to another model")
    with_disturbance = kalman_filter(fit, record, share=1e-3, disturbance=True)
    for accepted, n in ((observer, 5), (with_disturbance, 6)):
        assert feedforward(fit, record, observer=accepted).step.size1_in(0) == n


@pytest.mark.parametrize(
    "limits",
    [3, "a", ("a", "b"), (1.0, 2.0, 3.0), (np.nan, 1.0), (1.0, -1.0), (1.0, 1.0), (0.0, np.inf), (-np.inf, np.inf)],
)
def test_unusable_limits_are_refused(small, limits):
    fit, record, _ = small
    refused(lambda: feedforward(fit, record, limits=limits), "The input limits")


@pytest.mark.parametrize("hold", ["zero", "next"])
def test_the_response_of_a_fitted_simulator_is_that_of_whole_samples(hold):
    """Its standard errors do not depend on the number of sub-steps."""

    def store(substeps):
        return pilfr.Simulator(
            lambda x, u, p: dict(a=u.q - p.g * x.a),
            lambda x: dict(y=x.a),
            states=("a",),
            inputs=("q",),
            parameters=dict(g=pilfr.Parameter(1.5, bounds=(0.1, 10))),
            substeps=substeps,
        )

    rng = np.random.default_rng(0)
    r = pilfr.Recording(rng.standard_normal(200), np.zeros(200), 0.3, "q", "y", initial="zero", hold=hold)
    r = r.with_(y=store(4).simulate(r) + 0.01 * rng.standard_normal((200, 1)))
    errors = []
    for substeps in (4, 8):
        fit = pilfr.fit(store(substeps), r)
        errors.append(analyse_response(fit, roll_out(fit, r, "test"), r).errors[1:6])
    np.testing.assert_allclose(*errors, rtol=1e-3)


def test_the_gain_along_next_values_is_that_of_the_inputs_that_act():
    """Where the gain depends on the input, the inputs of another sample gave another one."""
    simulator = pilfr.Simulator(
        lambda x, u: dict(a=u.q + 0.2 * u.q**3 - x.a), lambda x: dict(y=x.a), states=("a",), inputs=("q",)
    )
    v = np.random.default_rng(0).standard_normal((200, 1))
    held = pilfr.Recording(v, np.zeros(200), 0.3, "q", "y", initial="zero", hold="zero")
    held = held.with_(y=simulator.simulate(held))
    late = held.with_(u=np.vstack([v[:1], v[:-1]]), hold="next")
    found = []
    for r in (held, late):
        run = roll_out(simulator, r, "test")
        found.append(_gain_and_radius(run, analyse_response(simulator, run, r), 1))
    np.testing.assert_allclose(*found, rtol=1e-9)
