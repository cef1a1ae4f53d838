"""Predictive control: plans are optimal and keep their limits, from any state and in any units, by every solver."""

import re
import sys

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from small_fits import A, refused

import pilfr_casadi as pilfr
from pilfr_casadi import PredictiveController
from pilfr_casadi.control import do_mpc_controller, do_mpc_model
from problems import mpc_masing, mpc_piezo
from problems.closed_loop import LINEAR, table
from problems.masing import simulate
from problems.masing_data import FS

N = 12
THRESHOLDS = np.linspace(0.1, 1.6, 8)
WIDTHS = np.array([0.01, 0.617, 0.643, 1.268, 1.257, 1.907, 1.888, 2.669])
BOTH = pytest.mark.parametrize("solver", ["sqp", "ipopt"])


def eight_plays(y_unit=1.0, u_unit=1.0):
    """Two states behind eight plays; an output of about 1 for an input of 1, in other units on request."""
    x, u = ca.SX.sym("x", 10), ca.SX.sym("u")
    q = [ca.fmin(u / u_unit + r, ca.fmax(u / u_unit - r, x[2 + i])) for i, r in enumerate(THRESHOLDS)]
    v = 0.4 * u / u_unit + sum(0.6 / 8 * (1 + np.cos(i)) * q[i] for i in range(8))
    y = y_unit * (x[0] + 0.3 * x[1])
    return ca.Function("F", [x, u], [ca.vertcat(0.6 * x[0] + 0.3 * v, 0.5 * x[1] + 0.2 * x[0], *q), y])


def sluggish():
    """An oscillator driven by as much hysteresis as input: plans from afar meet many kinks."""
    a, b = ca.DM([[0.939, -0.13], [0.272, 0.761]]), ca.DM([[-0.068, -0.081], [0.039, 0.046]])
    x, u, w = ca.SX.sym("x", 10), ca.SX.sym("u"), ca.DM([0.17, 0.326, 0.336, 0.242, 0.256, 0.147, 0.181, 0])
    z = 1.259 * u - 0.006 * x[0] - 0.001 * x[1]
    q = ca.fmin(z + WIDTHS, ca.fmax(z - WIDTHS, x[2:]))
    following = ca.mtimes(a, x[:2]) + ca.mtimes(b, ca.vertcat(u, ca.dot(w, q)))
    return ca.Function("F", [x, u], [ca.vertcat(following, q), -0.081 * x[0] - 0.141 * x[1]])


def lags(*poles):
    """One output per input, each lagging behind by at least a sample."""
    x, u, a = ca.SX.sym("x", len(poles)), ca.SX.sym("u", len(poles)), ca.DM(poles)
    return ca.Function("F", [x, u], [a * x + (1 - a) * u, x])


def first_order(pole=0.9):
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    return ca.Function("f", [x, u], [pole * x + u, x])


def states_and_references(cases, seed=3):
    """States with memory, references and previous inputs of `sluggish`, far from one another."""
    rng = np.random.default_rng(seed)
    for _ in range(cases):
        z, x = rng.uniform(-2, 2), np.append(0.2 * rng.standard_normal(2), rng.uniform(-2, 2, 8))
        x[2:] = np.clip(x[2:], z - WIDTHS, z + WIDTHS)
        yield x, 0.3 * np.sin(0.3 * np.arange(N) + rng.uniform(0, 6)), rng.uniform(-2, 2)


def cost_of(function, inputs, x, wanted, before, y_scale, u_scale, move=1e-3):
    """The cost that the documentation states, for inputs (N, n_u) and a reference (N, n_y)."""
    y = np.asarray(function.mapaccum(len(inputs))(x, inputs.T)[1]).T
    changes = np.diff(inputs, axis=0, prepend=np.reshape(before, (1, -1)))
    return np.sum(((y - wanted) / y_scale) ** 2) + move * np.sum((changes / u_scale) ** 2)


# --- plans are optimal


@pytest.mark.parametrize("limits", [{"outputs": (-0.3, 0.3), "rate": 0.5}, {}])
def test_first_plans_cost_no_more_than_those_of_ipopt(limits):
    options = {"inputs": (-3, 3), "y_scale": 0.1, **limits}
    ipopt = PredictiveController(sluggish(), N, solver="ipopt", **options)
    for given_state in states_and_references(8):
        ours = PredictiveController(sluggish(), N, **options)(*given_state)
        theirs = ipopt(*given_state)
        assert ours.cost < 1.01 * theirs.cost


def test_no_random_change_lowers_the_cost_of_a_first_plan():
    function, rng, converged, gains = sluggish(), np.random.default_rng(1), [], []
    for x, wanted, before in states_and_references(25, seed=11):
        plan = PredictiveController(function, N, inputs=(-3, 3), y_scale=0.1)(x, wanted, before)
        converged.append(plan.converged)
        assert plan.cost == pytest.approx(cost_of(function, plan.inputs, x, wanted[:, None], before, 0.1, 3.0))
        for size in 10.0 ** rng.uniform(-4, -1, 30):
            moved = np.clip(plan.inputs + 3 * size * rng.standard_normal((N, 1)) * (rng.random((N, 1)) < 0.5), -3, 3)
            gains.append(1 - cost_of(function, moved, x, wanted[:, None], before, 0.1, 3.0) / plan.cost)
    assert np.mean(converged) > 0.9 and np.max(gains) < 1e-3


@BOTH
def test_a_plan_is_never_worse_than_the_last_one_shifted(solver):
    function, controller = sluggish(), PredictiveController(sluggish(), N, inputs=(-3, 3), y_scale=0.1, solver=solver)
    last = None
    for x, wanted, before in states_and_references(6):
        plan = controller(x, wanted, before)
        if last is not None:
            start = np.vstack([last[1:], last[-1:]])
            assert plan.cost <= cost_of(function, start, x, wanted[:, None], before, 0.1, 3.0) * (1 + 1e-9)
        last = plan.inputs


def test_a_plan_that_was_cut_short_is_not_called_converged():
    options, cut = {"inputs": (-3, 3), "y_scale": 0.1, "rate": 0.5}, 0
    short = PredictiveController(sluggish(), N, iterations=1, **options)
    for x, wanted, before in states_and_references(20):  # each begins with the plan of another
        whole = PredictiveController(sluggish(), N, **options)(x, wanted, before)
        plan = short(x, wanted, before)
        stuck = plan.cost > 1.01 * whole.cost
        cut += stuck
        assert not (stuck and plan.converged)
    assert cut


def test_both_solvers_find_the_same_plan_inside_all_limits(small):
    limits = {"inputs": (-2.0, 2.0), "outputs": (-4.0, 4.5), "rate": 0.7, "move": 1e-2}
    x, wanted = np.array([0.5, -0.3, 0.2, -0.1, 0.0]), 6 * np.sin(np.arange(15) / 4)
    plans = [PredictiveController(small[0], 15, solver=s, **limits)(x, wanted, [0.1]) for s in ("sqp", "ipopt")]
    for plan in plans:
        assert plan.converged
        assert np.max(np.abs(plan.inputs)) <= 2.0
        assert np.max(np.abs(np.diff(plan.inputs[:, 0], prepend=0.1))) <= 0.7 + 1e-6
        assert np.max(plan.outputs) <= 4.5 + 1e-4 and plan.slack <= 1e-4
    assert np.max(plans[0].outputs) > 4.4  # a limit is active
    assert plans[0].cost == pytest.approx(plans[1].cost, rel=1e-3)


def test_plans_of_a_model_with_two_inputs_are_optimal(square):
    function, n = square[0].to_casadi(), 6
    wanted = np.array([[1.0, -1.0]] * n)
    controller = PredictiveController(function, n, inputs=(-1, 1))
    plan = controller(np.zeros(2), wanted, np.zeros(2))
    scales = controller.y_scale.reshape(n, 2), controller.u_scale.reshape(n, 2)
    assert plan.inputs.shape == plan.outputs.shape == (n, 2)
    rng = np.random.default_rng(0)
    for _ in range(50):
        other = np.clip(plan.inputs + 1e-2 * rng.standard_normal((n, 2)), -1, 1)
        assert cost_of(function, other, np.zeros(2), wanted, np.zeros(2), *scales) >= plan.cost


# --- scales


def close_loop(controller, path, x, u):
    """Outputs and plans of a loop along a path (samples + N, n_y), from the state x and the input u."""
    y, plans = [], []
    for k in range(len(path) - N):
        plans.append(controller(x, path[k : k + N], u))
        u = plans[-1].u
        x, now = (np.asarray(v).ravel() for v in controller.function(x, u))
        y.append(now)
    return np.array(y), plans


def constant(values, samples):
    """A constant path."""
    return np.tile(values, (samples + N, 1))


def test_a_loop_needs_no_scales_in_any_units():
    path, errors, converged, scales = 0.9 * np.sin(np.arange(90) / 9), [], [], []
    for y_unit, u_unit in ((1.0, 1.0), (1e-6, 1.0), (1e5, 1e-3)):
        function = eight_plays(y_unit, u_unit)
        for outputs in (None, (-0.8 * y_unit, 0.8 * y_unit)):
            controller = PredictiveController(function, N, inputs=(-3 * u_unit, 3 * u_unit), outputs=outputs)
            y, plans = close_loop(controller, y_unit * path, np.zeros(10), np.zeros(1))
            wanted = path[: len(y)] if outputs is None else np.clip(path[: len(y)], -0.8, 0.8)
            errors.append(np.sqrt(np.mean((y[:, 0] / y_unit - wanted)[10:] ** 2)))
            converged.append(np.mean([plan.converged for plan in plans]))
            scales.append(controller.y_scale[0] / y_unit)
    assert np.max(errors) < 0.02 * np.std(path), errors
    np.testing.assert_allclose(scales[2:], scales[:2] * 2, rtol=1e-9)
    np.testing.assert_allclose(errors[2:], errors[:2] * 2, rtol=0.1)  # rounding picks the side of a kink
    assert np.min(converged) > 0.8, converged


def test_scales_that_are_given_are_taken():
    controller = PredictiveController(eight_plays(), N, inputs=(-3, 3), outputs=(-9, 9), y_scale=0.7, u_scale=2.0)
    assert np.all(controller.y_scale == 0.7) and np.all(controller.u_scale == 2.0)
    free = PredictiveController(eight_plays(), N, inputs=(-np.inf, 3))
    assert np.all(free.u_scale == 1.0) and np.all(free.y_scale > 0)
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    deaf = PredictiveController(ca.Function("deaf", [x, u], [0.5 * x, x]), N, inputs=(-1, 1))
    assert np.all(deaf.y_scale == 1.0)


# --- limits


def test_limits_hold_by_default_for_a_reference_beyond_them():
    controller = PredictiveController(eight_plays(1e-4), N, inputs=(-3, 3), outputs=(-8e-5, 8e-5))
    y, _ = close_loop(controller, constant([1.2e-4], 28), np.zeros(10), np.zeros(1))
    assert np.max(y) < 8e-5 * 1.001 and y[-1] > 7.9e-5


@BOTH
def test_an_output_beyond_its_limit_comes_back_at_once(solver):
    controller = PredictiveController(lags(0.8), N, inputs=(-3, 3), outputs=(-1.5, 1.5), solver=solver)
    y, plans = close_loop(controller, constant([2.0], 5), np.array([1.9]), np.array([1.9]))
    assert y[0] == 1.9 and np.all(np.abs(y[1:] - 1.5) < 1e-6), y
    assert "beyond their limits by 0.4" in str(plans[0]) and "within their limits" in str(plans[-1])
    without = PredictiveController(lags(0.8), N, inputs=(-3, 3), solver=solver)
    assert "limits" not in str(close_loop(without, constant([2.0], 1), np.zeros(1), np.zeros(1))[1][0])


@BOTH
def test_an_output_beyond_its_limit_does_not_permit_another(solver):
    controller = PredictiveController(lags(0.99, 0.8), N, inputs=(-3, 3), outputs=(-1.5, 1.5), solver=solver)
    y, plans = close_loop(controller, constant([0.0, 1.9], 10), np.array([2.0, 0.0]), np.array([2.0, 0.0]))
    assert np.min(y[:, 0]) > 1.5  # the first takes longer than that
    assert np.max(y[:, 1]) < 1.5 + 1e-6 and abs(y[-1, 1] - 1.5) < 1e-6
    assert np.max([plan.outputs[:, 1].max() for plan in plans]) < 1.5 + 1e-6


@BOTH
@pytest.mark.parametrize("far", [2.0, 1e3, 1e5])
def test_limits_are_kept_and_reached_however_far_the_reference_is(solver, far):
    for options in ({}, {"y_scale": 0.5}):
        kept = PredictiveController(lags(0.8), N, inputs=(-3, 3), outputs=(-1.5, 1.5), solver=solver, **options)
        y, plans = close_loop(kept, constant([far], 12), np.zeros(1), np.zeros(1))
        assert np.max(y) < 1.5 + 1e-6 and y[-1] > 1.5 - 1e-5 and plans[-1].converged
        free = PredictiveController(lags(0.8), N, inputs=(-3, 3), solver=solver, **options)
        plan = free(np.zeros(1), np.full((N, 1), far if far > 3 else 3.0), np.zeros(1))
        assert plan.u[0] == pytest.approx(3.0, abs=1e-5) and plan.converged


@BOTH
def test_limits_that_cannot_be_reached_are_approached(solver):
    controller = PredictiveController(lags(0.8), N, inputs=(-1, 1), outputs=(50, 60), solver=solver)
    plan = controller(np.zeros(1), np.zeros((N, 1)), np.zeros(1))
    np.testing.assert_allclose(plan.inputs[:-1], 1.0, atol=1e-5)
    assert plan.converged and plan.slack == pytest.approx(50.0)


@BOTH
def test_rates_hold_to_the_last_digit(solver):
    controller = PredictiveController(lags(0.8), N, inputs=(-3, 3), rate=0.1, solver=solver)
    plan = controller(np.zeros(1), np.full((N, 1), 2.0), np.zeros(1))
    changes = np.diff(plan.inputs[:, 0], prepend=0.0)
    assert np.max(np.abs(changes)) <= 0.1 * (1 + 1e-12) and changes[0] > 0.0999


@BOTH
def test_a_rate_of_one_input_holds_where_the_other_has_none(square, solver):
    controller = PredictiveController(square[0], 8, inputs=([-3, -5], [3, 5]), rate=[0.2, np.inf], solver=solver)
    plan = controller(np.zeros(2), np.tile([1.0, -2.0], (8, 1)), np.zeros(2))
    moves = np.max(np.abs(np.diff(plan.inputs, axis=0, prepend=0.0)), axis=0)
    assert plan.converged and moves[0] <= 0.2 + 1e-6 and moves[1] > 0.5


@settings(max_examples=12, deadline=None)
@given(st.floats(-3, 3), st.lists(st.floats(-20, 20), min_size=2, max_size=4), st.floats(0.05, 1.0), st.floats(-20, 20))
def test_rates_and_limits_hold_whatever_was_applied_before(x, befores, rate, level):
    """Also where the last plan was not followed, as under a manual mode."""
    controller = PredictiveController(first_order(), 6, inputs=(-1.0, 1.0), outputs=(-2.0, 2.0), rate=rate)
    for before in befores:
        u = controller([x], np.full(6, level), [before]).inputs[:, 0]
        assert np.all(np.abs(u) <= 1.0 + 1e-9)
        first = max(rate, abs(before) - 1.0)  # as large as it takes to come back inside the limits
        assert abs(u[0] - before) <= first + 1e-6 and np.all(np.abs(np.diff(u)) <= rate + 1e-6)


@BOTH
def test_a_previous_input_outside_its_limits_is_brought_back(solver):
    controller = PredictiveController(first_order(), 6, inputs=(-1.0, 1.0), rate=0.1, solver=solver)
    plan = controller([0.0], np.zeros(6), [5.0])
    assert plan.converged and plan.u[0] == pytest.approx(1.0, abs=1e-6)


@BOTH
@pytest.mark.filterwarnings("ignore")
def test_a_plan_that_diverges_is_not_called_converged(solver):
    controller = PredictiveController(first_order(1e8), 60, inputs=(-1.0, 1.0), solver=solver)
    plan = controller([1.0], np.zeros(60), [0.0])
    assert not plan.converged and np.all(np.abs(plan.inputs) <= 1.0)


# --- closed loops


def small_model():
    x, u = ca.SX.sym("x", 4), ca.SX.sym("u")
    structure = pilfr.PILFR(2, pilfr.PrandtlIshlinskii(pilfr.Play, 2))
    blocks = {"A": A, "B_u": [[1.0], [0.5]], "B_w": [[0.3], [0.1]], "C_y": [[1.0, 0.4]]}
    model = structure.model(1, 1, {**blocks, "D_zu": [[1.0]], "w": [[0.5, 0.3]], "r": [[0.2, 1.0]]})
    return ca.Function("F", [x, u], model.closed(x, u, ca.DM(model.parameters.start)))


OPTIONS = {"inputs": (-1.0, 1.0), "outputs": (-3.0, 3.5), "move": 1e-2, "y_scale": 1.0, "u_scale": 1.0}
PATH = 4 * np.sin(np.arange(25) / 4)


def inputs_of_both(theirs, horizon=8):
    """Inputs of SQP in closed loop, and those that `theirs(x, reference, u_before)` gives at the same states."""
    function, x, u, both = small_model(), np.zeros(4), np.zeros(1), []
    ours = PredictiveController(function, horizon, **OPTIONS)
    for k in range(len(PATH)):
        ahead = PATH[np.minimum(k + np.arange(horizon), len(PATH) - 1)]
        other = theirs(x, ahead, u)
        u = ours(x, ahead, u).u
        both.append((u.item(), other))
        x = np.asarray(function(x, u)[0]).ravel()
    return np.array(both).T


def test_ipopt_closes_the_same_loop():
    planner = PredictiveController(small_model(), 8, solver="ipopt", **OPTIONS)
    ours, theirs = inputs_of_both(lambda x, ahead, u: planner(x, ahead, u).u.item())
    np.testing.assert_allclose(ours, theirs, atol=1e-6)


@pytest.mark.filterwarnings("ignore")
def test_do_mpc_closes_the_same_loop():
    pytest.importorskip("do_mpc", reason="do-mpc, an optional extra, is not installed")
    planner = do_mpc_controller(small_model(), 8, PATH, **OPTIONS)
    planner.x0, planner.u0 = np.zeros((4, 1)), np.zeros((1, 1))
    planner.set_initial_guess()

    def theirs(x, ahead, u):
        planner.u0 = u[:, None]
        return np.asarray(planner.make_step(x[:, None])).item()

    ours, others = inputs_of_both(theirs)
    np.testing.assert_allclose(ours, others, atol=1e-6)


A_2 = [[0.8622, -0.0014, 0.1846, -0.0142], [0.0121, 0.8605, 0.0097, 0.1861]]
A_2 += [[-0.0889, -0.0095, 0.9761, 0.0089], [0.0113, -0.0883, -0.0039, 0.975]]
B_U = [[-0.0018222, -0.45575], [0.0030919, -0.60995], [-0.02109, -5.8091], [0.024291, -6.1048]]
B_W = [[-0.0257, 0.0217], [0.0329, 0.0265], [-0.0255, 0.0229], [0.0382, 0.0201]]
C_Y = [[-120.17, 75.809, -4.111, 4.2161], [-1.4393e-4, -1.3061e-4, 1.0382e-5, 8.5671e-6]]
C_Z, D_ZU = (
    [[-0.4479, 0.4143, 0.2249, -0.1571], [-0.2891, -0.0909, -0.5639, -0.6338]],
    [[-0.28374, -4.319], [0.018536, -27.489]],
)
D_YU, D_YW = [[-0.18744, -20.902], [1.7332e-7, 6.8862e-7]], [[-11.084, -3.9368], [-3.9134e-6, -3.6805e-5]]
W, WIDTHS_2 = [[0.2688, 0.0768, 0.1578], [0.5708, 0.3775, 0.0971]], [[1.9594, 3.3583, 4.2506], [0.2297, 0.8097, 1.8146]]


def stage():
    """Two crossed axes in unlike units, identified with three plays behind each of two signals."""
    x, u = ca.SX.sym("x", 10), ca.SX.sym("u", 2)
    z = ca.mtimes(ca.DM(C_Z), x[:4]) + ca.mtimes(ca.DM(D_ZU), u)
    memory, widths = (x[4:7], x[7:10]), ca.DM(WIDTHS_2)
    q = [ca.fmin(z[i] + widths[i, :].T, ca.fmax(z[i] - widths[i, :].T, memory[i])) for i in range(2)]
    v = ca.vertcat(*(ca.dot(ca.DM(W[i]), q[i]) for i in range(2)))
    following = ca.mtimes(ca.DM(A_2), x[:4]) + ca.mtimes(ca.DM(B_U), u) + ca.mtimes(ca.DM(B_W), v)
    y = ca.mtimes(ca.DM(C_Y), x[:4]) + ca.mtimes(ca.DM(D_YU), u) + ca.mtimes(ca.DM(D_YW), v)
    return ca.Function("F", [x, u], [ca.vertcat(following, *q), y])


@pytest.mark.slow
def test_two_inputs_behind_plays_track_as_by_ipopt():
    """Most plans stop at a kink here, by either solver; where they stop scatters the errors by a quarter."""
    function, samples, horizon = stage(), 60, 15
    t = np.arange(samples + horizon)
    path = np.c_[300 * np.sin(0.05 * t), 1e-3 * np.cos(0.03 * t)] * np.minimum(1, t / 50)[:, None]
    most, errors = np.array([15.0, 0.06]), {}
    for solver in ("sqp", "ipopt"):
        controller = PredictiveController(function, horizon, inputs=(-most, most), solver=solver, iterations=40)
        x, u, y = np.zeros(10), np.zeros(2), []
        for k in range(samples):
            u = controller(x, path[k : k + horizon], u).u
            x, now = (np.asarray(v).ravel() for v in function(x, u))
            y.append(now)
        errors[solver] = np.sqrt(np.mean(((np.array(y) - path[:samples]) / controller.y_scale[:2])[20:] ** 2))
    assert errors["sqp"] < 1.3 * errors["ipopt"] < 0.013, errors


@pytest.mark.slow
def test_piezo_stage_is_tracked_with_a_fifth_of_the_linear_error():
    found = {o.name: o for o in mpc_piezo.outcomes(250, quick=True)[0]}
    for name in ("MPC, hysteresis model", "inverse on the observer's state", "inverse, no sensor"):
        own = found[name]
        assert own.error < 0.2 * found[LINEAR].error, table([*found.values()], "µm", 1e-3, mpc_piezo.TOLERANCE)
        assert own.violation < mpc_piezo.TOLERANCE


@pytest.mark.slow
def test_masing_rig_is_tracked_with_half_of_the_linear_error():
    found = {o.name: o for o in mpc_masing.outcomes(250, quick=True)[0]}
    own = found["MPC, hysteresis model"]
    assert own.error < 0.5 * found[LINEAR].error, table([*found.values()], "m", 1 / FS, mpc_masing.TOLERANCE)
    assert own.violation < mpc_masing.TOLERANCE
    assert own.median < 1 / FS


def test_the_rig_in_motion_is_the_simulator():
    u = np.random.default_rng(0).standard_normal(300)
    rig, y = mpc_masing.RigInMotion(), []
    for value in u:
        y.append(rig.y)
        rig.advance(float(value))
    np.testing.assert_array_equal(y, simulate(u, FS).x2)


# --- do-mpc


@pytest.mark.filterwarnings("ignore")
def test_do_mpc_takes_scales_and_limits_for_each_signal():
    pytest.importorskip("do_mpc", reason="do-mpc, an optional extra, is not installed")
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 2)
    function = ca.Function("F", [x, u], [ca.mtimes(ca.DM(A), x) + u, x])
    wanted = np.tile([0.5, -0.3], (20, 1))
    options = {"inputs": ([-0.2, -1.0], [0.2, 1.0]), "outputs": ([-1.0, -np.inf], [1.0, np.inf])}
    options |= {"y_scale": [0.1, 0.4], "u_scale": [1.0, 2.0], "move": 0.1}
    theirs = do_mpc_controller(function, 6, wanted, **options)
    theirs.x0, theirs.u0 = np.zeros((2, 1)), np.zeros((2, 1))
    theirs.set_initial_guess()
    ours = PredictiveController(function, 6, **options)(np.zeros(2), wanted[:6], np.zeros(2))
    np.testing.assert_allclose(theirs.make_step(np.zeros((2, 1))).ravel(), ours.u, atol=1e-5)
    scales = np.arange(1.0, 13.0).reshape(6, 2)
    refused(lambda: do_mpc_controller(function, 6, wanted, inputs=(-1, 1), y_scale=scales), "changes over the horizon")


def test_do_mpc_accepts_every_model_of_a_controller(small):
    pytest.importorskip("do_mpc")
    fit, _, observer = small
    for given_model in (fit, observer, fit.export(), fit.to_casadi()):
        model = do_mpc_model(given_model)
        assert (model.x.shape[0], model.u.shape[0]) == (5, 1)
        assert PredictiveController(given_model, 3, inputs=(-1, 1)).function.size1_in(0) == 5
    refused(lambda: do_mpc_model("f"), "A str cannot be used for planning; give a Fit")


def test_without_do_mpc_an_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "do_mpc", None)
    refused(lambda: do_mpc_model(small_model()), r"pip install pilfr-casadi\[do-mpc\]")


# --- arguments


def test_a_plan_and_a_controller_print_in_a_line_or_two(small):
    controller = PredictiveController(small[0], 4, inputs=(-1, 1), outputs=(-9, 9), rate=0.5)
    plan = controller(np.zeros(5), np.zeros(4), [0.0])
    for thing, words in (
        (controller, "over 4 samples by sqp: 5 states, 1 inputs, 1 outputs, limits of the inputs and outputs, rates"),
        (plan, "plan over 4 samples, converged in"),
    ):
        assert words in str(thing) == repr(thing) and len(str(thing)) < 300 and "array(" not in str(thing), str(thing)
    assert "outputs within their limits" in str(plan)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"function": 3}, "casadi.Function"),
        ({"function": ca.Function("g", [ca.SX.sym("x")], [ca.SX(1)])}, r"give \(x, u\) -> \(x_next, y\)"),
        ({"horizon": 2.5}, "horizon"),
        ({"horizon": True}, "horizon"),
        ({"horizon": 0}, "horizon"),
        ({"inputs": 3}, r"\(low, high\)"),
        ({"inputs": ("a", "b")}, "numbers"),
        ({"inputs": (np.nan, 1.0)}, "not finite"),
        ({"inputs": (None, 1.0)}, "A limit of the inputs is None"),
        ({"inputs": (1, 0)}, "low below high"),
        ({"outputs": (None, 1.0)}, "A limit of the outputs is None"),
        ({"outputs": (np.zeros(3), np.ones(3))}, "shape"),
        ({"outputs": (1.0, 1.0)}, "outputs is not below"),
        ({"rate": "a"}, "rate"),
        ({"y_scale": 0}, "above zero"),
        ({"y_scale": np.nan}, "not finite"),
        ({"move": -1}, "above zero"),
        ({"move": "a"}, "move"),
        ({"move": None}, "move"),
        ({"move": np.inf}, "move"),
        ({"iterations": 0}, "iterations"),
        ({"iterations": "a"}, "iterations"),
        ({"iterations": 2.5}, "iterations"),
        ({"solver": None}, "'sqp' or 'ipopt'"),
        ({"solver": "qp"}, "solver 'qp'"),
    ],
)
def test_unusable_options_are_refused(change, words):
    arguments = {"function": first_order(), "horizon": 5, "inputs": (-1.0, 1.0), **change}
    refused(lambda: PredictiveController(arguments.pop("function"), arguments.pop("horizon"), **arguments), words)


@pytest.mark.parametrize(
    ("place", "value"), [(0, [np.nan]), (0, [0.0, 0.0]), (1, [np.nan] * 5), (1, np.zeros(4)), (2, np.nan)]
)
def test_states_and_references_that_do_not_fit_are_refused(place, value):
    controller = PredictiveController(first_order(), 5, inputs=(-1.0, 1.0))
    arguments = [[0.0], [0.1] * 5, 0.0]
    assert controller(*arguments).converged
    arguments[place] = value
    refused(lambda: controller(*arguments), r"finite|numbers|has the shape \(4,\); give \(5, 1\)")


def test_a_transposed_reference_is_refused(square):
    controller = PredictiveController(square[0], 8, inputs=(-5, 5))
    wanted = np.tile([1.0, -2.0], (8, 1))
    np.testing.assert_allclose(controller(np.zeros(2), wanted, np.zeros(2)).outputs[-1], [1.0, -2.0], atol=1e-3)
    for reference in (wanted.T, wanted.ravel(), wanted[:4], wanted[:, :1], 1.0):
        refused(lambda reference=reference: controller(np.zeros(2), reference, np.zeros(2)), re.escape("give (8, 2)"))


def test_do_mpc_gets_the_same_errors():
    limits = {"inputs": (-1.0, 1.0)}
    refused(lambda: do_mpc_controller(3, 5, np.zeros(9), **limits), "casadi.Function")
    refused(lambda: do_mpc_controller(first_order(), 0, np.zeros(9), **limits), "horizon")
    refused(lambda: do_mpc_controller(first_order(), 5, "a", **limits), "reference")
    refused(lambda: do_mpc_controller(first_order(), 5, np.zeros((9, 2)), **limits), re.escape("give (samples, 1)"))
    refused(lambda: do_mpc_controller(first_order(), 5, [np.nan] * 9, **limits), "finite")
    refused(lambda: do_mpc_controller(first_order(), 5, np.zeros(9), inputs=(1.0, -1.0)), "low below high")


def test_interpolated_inputs_are_refused():
    dynamics, outputs = (lambda x, u: dict(v=u.f - 4.0 * x.v)), (lambda x: dict(v=x.v))
    simulator = pilfr.Simulator(dynamics, outputs, states=("v",), inputs=("f",))
    linear, zero = pilfr.exported(simulator, dt=0.1, hold="linear"), pilfr.exported(simulator, dt=0.1)
    refused(lambda: PredictiveController(linear, 5, inputs=(-1.0, 1.0)), "interpolated")
    refused(lambda: do_mpc_controller(linear, 5, np.zeros(9), inputs=(-1.0, 1.0)), "interpolated")
    assert PredictiveController(zero, 5, inputs=(-1.0, 1.0)).function.size1_in(1) == 1
