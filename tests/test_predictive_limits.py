"""Limits of plans: each output limit is kept where that is possible, whatever another does; plans of two by two."""

import casadi as ca
import numpy as np
import pytest

from pilfr_casadi import PredictiveController

N = 15


def lags(*poles):
    """Outputs that lag behind an input each, by a sample at least."""
    x, u, a = ca.SX.sym("x", len(poles)), ca.SX.sym("u", len(poles)), ca.DM(poles)
    return ca.Function("F", [x, u], [a * x + (1 - a) * u, x])


def closed(function, controller, x, wanted, u, samples):
    """Outputs of a loop and its plans."""
    y, plans = [], []
    for _ in range(samples):
        plans.append(controller(x, np.tile(wanted, (N, 1)), u))
        u = plans[-1].u
        x, now = (np.asarray(v).ravel() for v in function(x, u))
        y.append(now)
    return np.array(y), plans


@pytest.mark.parametrize("solver", ["sqp", "ipopt"])
def test_an_output_beyond_its_limit_comes_back_at_once(solver):
    controller = PredictiveController(lags(0.8), N, inputs=(-3, 3), outputs=(-1.5, 1.5), solver=solver)
    y, plans = closed(lags(0.8), controller, np.array([1.9]), [2.0], np.array([1.9]), 5)
    assert y[0] == 1.9 and np.all(np.abs(y[1:] - 1.5) < 1e-6), y
    assert "beyond their limits by 0.4" in str(plans[0]) and "within their limits" in str(plans[-1])


@pytest.mark.parametrize("solver", ["sqp", "ipopt"])
def test_an_output_beyond_its_limit_gives_no_leave_to_another(solver):
    function = lags(0.99, 0.8)
    controller = PredictiveController(function, N, inputs=(-3, 3), outputs=(-1.5, 1.5), solver=solver)
    y, plans = closed(function, controller, np.array([2.0, 0.0]), [0.0, 1.9], np.array([2.0, 0.0]), 10)
    assert np.min(y[:, 0]) > 1.5  # the first takes longer than that
    assert np.max(y[:, 1]) < 1.5 + 1e-6 and abs(y[-1, 1] - 1.5) < 1e-6
    assert np.max([plan.outputs[:, 1].max() for plan in plans]) < 1.5 + 1e-6


@pytest.mark.parametrize("solver", ["sqp", "ipopt"])
@pytest.mark.parametrize("far", [2.0, 1e3, 1e5])
def test_limits_are_kept_and_reached_however_far_the_reference_is(solver, far):
    for options in ({}, {"y_scale": 0.5}):
        kept = PredictiveController(lags(0.8), N, inputs=(-3, 3), outputs=(-1.5, 1.5), solver=solver, **options)
        y, plans = closed(lags(0.8), kept, np.zeros(1), [far], np.zeros(1), 12)
        assert np.max(y) < 1.5 + 1e-6 and y[-1] > 1.5 - 1e-5 and plans[-1].converged
        free = PredictiveController(lags(0.8), N, inputs=(-3, 3), solver=solver, **options)
        plan = free(np.zeros(1), np.full((N, 1), far if far > 3 else 3.0), np.zeros(1))
        assert plan.u[0] == pytest.approx(3.0, abs=1e-5) and plan.converged


@pytest.mark.parametrize("solver", ["sqp", "ipopt"])
def test_limits_that_cannot_be_reached_are_come_close_to(solver):
    controller = PredictiveController(lags(0.8), N, inputs=(-1, 1), outputs=(50, 60), solver=solver)
    plan = controller(np.zeros(1), np.zeros((N, 1)), np.zeros(1))
    np.testing.assert_allclose(plan.inputs[:-1], 1.0, atol=1e-5)
    assert plan.converged and plan.slack == pytest.approx(50.0)


@pytest.mark.parametrize("solver", ["sqp", "ipopt"])
def test_rates_hold_to_the_last_digit(solver):
    controller = PredictiveController(lags(0.8), N, inputs=(-3, 3), rate=0.1, solver=solver)
    plan = controller(np.zeros(1), np.full((N, 1), 2.0), np.zeros(1))
    changes = np.diff(plan.inputs[:, 0], prepend=0.0)
    assert np.max(np.abs(changes)) <= 0.1 * (1 + 1e-12) and changes[0] > 0.0999


A = [[0.8622, -0.0014, 0.1846, -0.0142], [0.0121, 0.8605, 0.0097, 0.1861]]
A += [[-0.0889, -0.0095, 0.9761, 0.0089], [0.0113, -0.0883, -0.0039, 0.975]]
B_U = [[-0.0018222, -0.45575], [0.0030919, -0.60995], [-0.02109, -5.8091], [0.024291, -6.1048]]
B_W = [[-0.0257, 0.0217], [0.0329, 0.0265], [-0.0255, 0.0229], [0.0382, 0.0201]]
C_Y = [[-120.17, 75.809, -4.111, 4.2161], [-1.4393e-4, -1.3061e-4, 1.0382e-5, 8.5671e-6]]
C_Z, D_ZU = (
    [[-0.4479, 0.4143, 0.2249, -0.1571], [-0.2891, -0.0909, -0.5639, -0.6338]],
    [[-0.28374, -4.319], [0.018536, -27.489]],
)
D_YU, D_YW = [[-0.18744, -20.902], [1.7332e-7, 6.8862e-7]], [[-11.084, -3.9368], [-3.9134e-6, -3.6805e-5]]
W, WIDTHS = [[0.2688, 0.0768, 0.1578], [0.5708, 0.3775, 0.0971]], [[1.9594, 3.3583, 4.2506], [0.2297, 0.8097, 1.8146]]


def stage():
    """Two crossed axes in unlike units, identified with three plays behind each of two signals."""
    x, u = ca.SX.sym("x", 10), ca.SX.sym("u", 2)
    z = ca.mtimes(ca.DM(C_Z), x[:4]) + ca.mtimes(ca.DM(D_ZU), u)
    memory, widths = (x[4:7], x[7:10]), ca.DM(WIDTHS)
    q = [ca.fmin(z[i] + widths[i, :].T, ca.fmax(z[i] - widths[i, :].T, memory[i])) for i in range(2)]
    v = ca.vertcat(*(ca.dot(ca.DM(W[i]), q[i]) for i in range(2)))
    following = ca.mtimes(ca.DM(A), x[:4]) + ca.mtimes(ca.DM(B_U), u) + ca.mtimes(ca.DM(B_W), v)
    y = ca.mtimes(ca.DM(C_Y), x[:4]) + ca.mtimes(ca.DM(D_YU), u) + ca.mtimes(ca.DM(D_YW), v)
    return ca.Function("F", [x, u], [ca.vertcat(following, *q), y])


def test_plans_of_two_by_two_end_in_optima_among_kinks():
    function, t = stage(), np.arange(45 + N)
    path = np.c_[300 * np.sin(0.05 * t), 1e-3 * np.cos(0.03 * t)] * np.minimum(1, t / 50)[:, None]
    most, rng = np.array([15.0, 0.06]), np.random.default_rng(0)
    options = {"inputs": (-most, most)}
    controller = PredictiveController(function, N, **options)
    x, u, said, shares, gains = np.zeros(10), np.zeros(2), [], [], []
    for k in range(45):
        before, plan = u, controller(x, path[k : k + N], u)
        said.append(plan.converged)
        if k % 3 == 0:
            other = PredictiveController(function, N, solver="ipopt", **options)(x, path[k : k + N], u)
            shares.append(plan.cost / other.cost)
            run = function.mapaccum(N)
            for size in 10.0 ** -np.arange(1, 6).repeat(20):
                moved = np.clip(plan.inputs + size * most * rng.standard_normal((N, 2)), *options["inputs"])
                y, changes = np.asarray(run(x, moved.T)[1]).T, np.diff(moved, axis=0, prepend=before[None])
                cost = np.sum(((y - path[k : k + N]).ravel() / controller.y_scale) ** 2)
                cost += 1e-3 * np.sum((changes.ravel() / controller.u_scale) ** 2)
                gains.append(1 - cost / plan.cost)
        u = plan.u
        x = np.asarray(function(x, u)[0]).ravel()
    assert np.mean(said) > 0.95, np.mean(said)
    assert np.quantile(shares, 0.8) < 1.01 and np.max(shares) < 1.1, np.sort(shares)
    assert np.max(gains) < 1e-3, np.max(gains)
