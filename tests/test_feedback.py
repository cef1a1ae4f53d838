"""Observer, limits of observability, inversion."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import pilfr_casadi as pilfr
from pilfr_casadi import InputError
from pilfr_casadi.cli.demo import demo_recordings
from pilfr_casadi.control.kalman import ekf_step
from pilfr_casadi.models import play
from problems import observer as observer_problem

A = np.array([[0.7, 0.2], [-0.1, 0.8]])


def fitted(structure, values, samples=400, n_u=1, n_y=1, scale=1.0):
    """A fit that begins at the truth: of a model with given blocks, from its own outputs."""
    model = structure.model(n_u, n_y, values)
    rng = np.random.default_rng(3)
    u = scale * np.cumsum(rng.standard_normal((samples, n_u)), axis=0) / 5
    function = model.closed.mapaccum("run", samples)
    y = np.asarray(function(np.zeros(model.n_state), u.T, model.parameters.start)[1]).T
    record = pilfr.Recording(u, y + 1e-4 * rng.standard_normal(y.shape), 0.01, initial="zero")
    return pilfr.fit(model, record), record


def plays(r, w, nx=2, **blocks):
    n = len(r)
    values = {"A": A, "B_u": [[1.0], [0.5]], "B_w": [[0.3], [0.1]], "C_y": [[1.0, 0.4]], "C_z": [[0.5, 0.0]]}
    values |= {"D_zu": [[1.0]], "w": [w], "r": [r], **blocks}
    return pilfr.PILFR(
        nx, pilfr.PrandtlIshlinskii(pilfr.Play, n), {"D_yu": 0.0, "D_yw": 0.0}, {"r": (0, np.inf)}
    ), values


@pytest.fixture(scope="module")
def rig():
    records = demo_recordings()
    structure = pilfr.PILFR(5, pilfr.PrandtlIshlinskii(pilfr.Play, 10))
    return pilfr.fit(structure, records["train"], starts=3), records


@pytest.fixture(scope="module")
def small():
    return fitted(*plays([0.2, 1.0, 50.0], [0.5, 0.3, 0.2]))


# --- observer


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
    following = step(state, p, 0.7, 0.9)[0]
    np.testing.assert_allclose(
        np.asarray(following).ravel(), A @ state + 0.7 + (gain * (0.9 - c @ state)).ravel(), rtol=1e-10
    )


def test_covariance_of_a_play_is_kept_while_it_sticks_and_replaced_when_it_slips():
    q, u = ca.SX.sym("q"), ca.SX.sym("u")
    function = ca.Function("F", [q, u], [play(u, q, 1.0), ca.SX(0.0)])
    step = ekf_step(function, np.array([[1e-6]]), np.array([[1.0]]))
    sticks, slips = (float(step(0.0, 4.0, u, 0.0)[1]) for u in (0.5, 3.0))
    assert sticks == pytest.approx(4.0 + 1e-6, rel=1e-12)
    assert slips == pytest.approx(1e-6, rel=1e-9)


def test_wrong_memory_is_recovered_after_two_excursions():
    rows, _ = observer_problem.ratios(seeds=4)["extended"]
    assert np.max(rows[:, 2]) < 1.2
    assert np.max(rows[:, 1]) < 1.2


def test_memory_is_recovered_from_the_first_samples_of_a_recording(rig):
    fit, records = rig
    test = records["multisine"]
    function, start = fit.to_casadi(), 500
    known = np.asarray(function.mapaccum("run", start)(np.zeros(15), test.u[:start].T)[0])[:, -1]
    part = test.slice(start, 1500).with_(initial="estimate")
    estimated = fit.initial_state(part)
    m = len(part)

    def error(x0):
        y = np.asarray(function.mapaccum("run", m)(x0, part.u.T)[1]).T
        return np.sqrt(np.mean((y - part.y)[:150] ** 2))

    forgotten = known.copy()
    forgotten[5:] = 0
    assert error(estimated) < 1.2 * error(known)
    assert error(forgotten) > 3 * error(known)


def test_disturbance_takes_up_a_constant_error_of_the_sensor(small):
    fit, record = small
    made = pilfr.kalman_filter(fit, record, disturbance=True, share=0.1)
    states, predicted, P = made.run(record.u, record.y + 0.5)
    assert states.shape == (401, fit.model.n_state + 1) and P.shape == (6, 6)
    assert np.mean(states[200:, -1]) == pytest.approx(0.5, rel=0.2)
    assert np.sqrt(np.mean((predicted - record.y - 0.5)[200:] ** 2)) < 0.02


def test_what_the_filter_cannot_use_is_refused(small):
    fit, record = small
    with pytest.raises(pilfr.InputError, match="share of process noise"):
        pilfr.kalman_filter(fit, record, share=0.0)
    made = pilfr.kalman_filter(fit, record, share=1e-2)
    with pytest.raises(pilfr.InputError, match="given to the filter"):
        made.run(record.u, record.y, np.zeros(3))
    static, own = fitted(pilfr.PILFR(0), {"D_yu": [[2.0]]})
    with pytest.raises(pilfr.InputError, match="neither states nor memory"):
        pilfr.kalman_filter(static, own)


# --- limits of observability


def test_what_sticks_is_seen_in_sum_and_what_slips_early_is_wiped(small):
    fit, record = small
    made = pilfr.kalman_filter(fit, record, share=1e-2)
    rest = pilfr.visibility(fit, made, np.zeros(5), np.zeros((30, 1)))
    assert "stick over all 30 samples" in str(rest) and "weighted sum" in str(rest)
    assert rest.rank < 5
    made.spread[2:] = 1.0  # equally little is known beforehand of each memory
    jump = pilfr.visibility(fit, made, np.zeros(5), np.full((30, 1), 5.0))
    assert 2 in jump.unseen and 3 in jump.unseen  # they slip in the first sample, before w is formed
    assert "wiped out before a trace" in str(jump)
    assert "1 (r = " in str(jump)
    assert jump.left[4] < 0.5 and 4 not in jump.unseen  # the only one that sticks, at a level that the outputs see


def test_memory_without_weight_is_named():
    fit, record = fitted(*plays([0.2, 1.0], [0.5, 0.0]))
    made = pilfr.kalman_filter(fit, record, share=1e-2)
    weightless = fit.model.parameters.change(w={"value": [[0.5, 0.0]]})
    from dataclasses import replace

    fit = replace(fit, model=fit.model.with_parameters(weightless))
    made = replace(made, function=fit.to_casadi())
    assert "2 (r = " in str(said := pilfr.visibility(fit, made, np.zeros(4), np.zeros((20, 1))))
    assert "weight zero" in str(said)
    with pytest.raises(pilfr.InputError, match="give 4 numbers"):
        pilfr.visibility(fit, made, np.zeros(3), np.zeros((20, 1)))


# --- inverse of an element


@settings(max_examples=40, deadline=None)
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
        made = pilfr.inverse_element(r, sign * w, gain=sign * gain, operator=operator)
        memory = made.memory(memories[begin])
        assert np.all(made.r >= 0)
        for wanted, truth in zip(v[begin:], z[begin:], strict=True):
            memory, u = made.step(memory, sign * wanted)
            assert float(u) == pytest.approx(truth, abs=1e-9)


def test_the_inverse_is_a_prandtl_ishlinskii_element():
    made = pilfr.inverse_element([0.5, 1.0], [0.4, 0.3], gain=1.0)
    element = pilfr.PrandtlIshlinskii(pilfr.Play, 3)
    s, memory, p = np.zeros((3, 1)), made.memory(), {"r": ca.DM(made.r[None]), "w": ca.DM(made.w[None])}
    for v in (1.0, 2.0, 0.5, -3.0, 1.0):
        memory, u = made.step(memory, v)
        w, s = element.step(ca.DM([v]), s, p)
        assert float(w) == pytest.approx(float(u), abs=1e-13)


def test_what_has_no_inverse_says_why():
    with pytest.raises(pilfr.InputError, match="no inverse: its slope is 1 right after a reversal and 0 once"):
        pilfr.inverse_element([0.5, 1.0], [0.4, 0.6], operator=pilfr.Stop)
    with pytest.raises(pilfr.InputError, match="add a linear part"):
        pilfr.inverse_element([0.5], [1.0])
    with pytest.raises(pilfr.InputError, match="above zero, or all below"):
        pilfr.inverse_element([0.5], [-2.0], gain=1.0)
    with pytest.raises(pilfr.InputError, match="closed form"):
        pilfr.inverse_element([0.5], [1.0], gain=1.0, operator=pilfr.GeneralizedPlay)
    with pytest.raises(pilfr.InputError, match="2 thresholds and 1 weights"):
        pilfr.inverse_element([0.5, 1], [1.0], gain=1.0)
    with pytest.raises(pilfr.InputError, match="one each"):
        pilfr.inverse_element([0.5], [1.0], gain=1.0).memory([0.0, 0.0])


# --- inverse of a model


def test_the_inverse_of_a_minimum_phase_model_is_exact(small):
    fit, record = small
    made = pilfr.feedforward(fit, record, limits=(-100, 100))
    function = fit.to_casadi()
    assert made.ahead == 1
    rng = np.random.default_rng(0)
    u = 3 * np.sin(np.arange(200) / 9) + 0.3 * rng.standard_normal(200)
    y = np.asarray(function.mapaccum("run", 200)(np.zeros(5), u[None, :])[1]).ravel()
    np.testing.assert_allclose(made.inputs(y)[:-1, 0], u[:-1], atol=1e-9)


def test_inputs_stay_inside_their_limits_where_the_wanted_output_is_out_of_reach(small):
    fit, record = small
    made = pilfr.feedforward(fit, record, limits=(-1, 2))
    np.testing.assert_allclose(made.inputs(np.full(20, 1e3)), 2.0, rtol=1e-6)
    np.testing.assert_allclose(made.inputs(np.full(20, -1e3)), -1.0, rtol=1e-6)


def test_what_cannot_be_inverted_says_why(small):
    fit, record = small
    with pytest.raises(pilfr.InputError, match="look-ahead of -1"):
        pilfr.feedforward(fit, record, ahead=-1)
    with pytest.raises(pilfr.InputError, match="low below high"):
        pilfr.feedforward(fit, record, limits=(1, 0))
    values = {"A": A, "B_u": [[1.0], [0.5]], "C_y": np.eye(2)}
    two = fitted(pilfr.PILFR(2), values, n_y=2)
    with pytest.raises(pilfr.InputError, match="2 outputs and 1 input"):
        pilfr.feedforward(*two)
    values = {"A": A, "B_u": np.eye(2), "C_y": [[1.0, 0.4]]}
    with pytest.raises(pilfr.InputError, match="2 inputs and 1 output"):
        pilfr.feedforward(*fitted(pilfr.PILFR(2), values, n_u=2))
    # y_{k+1} = -0.5 u_k + u_{k-1} inverted one step ahead: a zero at 2
    delay = {"A": [[0.0, 0.0], [1.0, 0.0]], "B_u": [[1.0], [0.0]], "C_y": [[-0.5, 1.0]]}
    phase = fitted(pilfr.PILFR(2, fixed={"D_yu": 0.0}), delay)
    with pytest.raises(pilfr.InputError, match="no stable inverse with a look-ahead of 1 samples"):
        pilfr.feedforward(*phase, ahead=1)
    with pytest.raises(pilfr.InputError, match="reaches the output only after 1 "):
        pilfr.feedforward(*phase, ahead=0)


@pytest.mark.parametrize("limits", [3, "a", ("a", "b"), (np.nan, 1.0), (1.0, -1.0), (1.0, 2.0, 3.0)])
def test_a_compensator_without_usable_limits_is_refused(small, limits):
    fit, record = small[:2]
    with pytest.raises(InputError, match="Limits of the input"):
        pilfr.feedforward(fit, record, limits=limits)
