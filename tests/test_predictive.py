"""Plans of predictive control: as good as the other solver's from any state, honest where not, and free of units."""

import casadi as ca
import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi import InputError, PredictiveController

N, R = 12, np.linspace(0.1, 1.6, 8)


def eight_plays(y_unit=1.0, u_unit=1.0):
    """Two states behind eight plays; an output of about 1 for an input of 1, in other units where asked for."""
    x, u = ca.SX.sym("x", 10), ca.SX.sym("u")
    q = [ca.fmin(u / u_unit + r, ca.fmax(u / u_unit - r, x[2 + i])) for i, r in enumerate(R)]
    v = 0.4 * u / u_unit + sum(0.6 / 8 * (1 + np.cos(i)) * q[i] for i in range(8))
    y = y_unit * (x[0] + 0.3 * x[1])
    return ca.Function("F", [x, u], [ca.vertcat(0.6 * x[0] + 0.3 * v, 0.5 * x[1] + 0.2 * x[0], *q), y])


WIDTHS = np.array([0.01, 0.617, 0.643, 1.268, 1.257, 1.907, 1.888, 2.669])


def sluggish():
    """An oscillator that is driven by as much hysteresis as input: plans from afar meet many kinks."""
    a, b = ca.DM([[0.939, -0.13], [0.272, 0.761]]), ca.DM([[-0.068, -0.081], [0.039, 0.046]])
    x, u, w = ca.SX.sym("x", 10), ca.SX.sym("u"), ca.DM([0.17, 0.326, 0.336, 0.242, 0.256, 0.147, 0.181, 0])
    z = 1.259 * u - 0.006 * x[0] - 0.001 * x[1]
    q = ca.fmin(z + WIDTHS, ca.fmax(z - WIDTHS, x[2:]))
    following = ca.mtimes(a, x[:2]) + ca.mtimes(b, ca.vertcat(u, ca.dot(w, q)))
    return ca.Function("F", [x, u], [ca.vertcat(following, q), -0.081 * x[0] - 0.141 * x[1]])


def drawn(cases, seed=3, R=WIDTHS):
    """States with memory, references and previous inputs, far from one another."""
    rng = np.random.default_rng(seed)
    for _ in range(cases):
        z, x = rng.uniform(-2, 2), np.append(0.2 * rng.standard_normal(2), rng.uniform(-2, 2, 8))
        x[2:] = np.clip(x[2:], z - R, z + R)
        yield x, 0.3 * np.sin(0.3 * np.arange(N) + rng.uniform(0, 6)), rng.uniform(-2, 2)


@pytest.mark.parametrize("limits", [{"outputs": (-0.3, 0.3), "rate": 0.5}, {"rate": 0.5}, {}])
def test_no_first_plan_is_stuck_at_a_kink(limits):
    costs, said = [], []
    for x, wanted, before in drawn(20):
        plans = [
            PredictiveController(sluggish(), N, inputs=(-3, 3), y_scale=0.1, solver=solver, **limits)(x, wanted, before)
            for solver in ("sqp", "ipopt")
        ]
        costs.append([plan.cost for plan in plans])
        said.append([plan.converged for plan in plans])
    ours, theirs = np.array(costs).T
    assert np.all(ours < 1.01 * theirs), np.max(ours / theirs)
    assert np.all(np.where(np.array(said)[:, 0], ours, 0.0) < 1.01 * np.minimum(ours, theirs))
    assert np.mean(np.array(said)[:, 1]) > 0.8  # IPOPT ends, though most optima lie in kinks


def test_first_plans_are_optima_nearby():
    function, rng, said, gains = sluggish(), np.random.default_rng(1), [], []
    run = function.mapaccum(N)
    for x, wanted, before in drawn(150, seed=11):
        controller = PredictiveController(function, N, inputs=(-3, 3), y_scale=0.1, rate=0.5)
        plan = controller(x, wanted, before)
        said.append(plan.converged)
        size = 10.0 ** rng.uniform(-4, -1, (60, 1)) * (rng.random((60, N)) < rng.uniform(0.05, 1, (60, 1)))
        for moved in np.clip(plan.inputs[:, 0] + 3 * size * rng.standard_normal((60, N)), -3, 3):
            y, changes = np.asarray(run(x, moved[None])[1])[0], np.diff(moved, prepend=before)
            cost = np.sum(((y - wanted) / 0.1) ** 2) + 1e-3 * np.sum((changes / 3) ** 2)
            gains.append(1 - cost / plan.cost if np.max(np.abs(changes)) <= 0.5 else 0.0)
    assert all(said) and np.max(gains) < 1e-3, (np.mean(said), np.max(gains))


def test_a_plan_that_was_cut_short_is_not_called_converged(monkeypatch):
    monkeypatch.setattr("pilfr_casadi.control.mpc_sqp.ENTERED", 1)
    options, worse = {"inputs": (-3, 3), "y_scale": 0.1, "rate": 0.5}, 0
    short = PredictiveController(sluggish(), N, iterations=1, **options)
    for x, wanted, before in drawn(20):  # each begins with the plan of another
        whole = PredictiveController(sluggish(), N, **options)(x, wanted, before)
        for _ in range(3):
            plan = short(x, wanted, before)
            stuck = plan.cost > 1.01 * whole.cost
            worse += stuck
            assert not (stuck and plan.converged)
    assert worse


def loop(controller, function, path):
    """Outputs, and whether each plan converged."""
    x, u, y, said = np.zeros(10), np.zeros(1), [], []
    for k in range(len(path) - N):
        plan = controller(x, path[k : k + N], u)
        u = plan.u
        x, now = function(x, u)
        x = np.asarray(x).ravel()
        y.append(float(now))
        said.append(plan.converged)
    return np.array(y), np.array(said)


def test_a_loop_needs_no_scales_in_any_units():
    path, errors, steps, scales = 0.9 * np.sin(np.arange(150) / 9), [], [], []
    for y_unit, u_unit in ((1.0, 1.0), (1e-6, 1.0), (1e-4, 1e3), (1e5, 1e-3)):
        function = eight_plays(y_unit, u_unit)
        for outputs in (None, (-0.8 * y_unit, 0.8 * y_unit)):
            controller = PredictiveController(function, N, inputs=(-3 * u_unit, 3 * u_unit), outputs=outputs)
            scale = controller.y_scale.copy()
            y, said = loop(controller, function, y_unit * path)
            wanted = path[: len(y)] if outputs is None else np.clip(path[: len(y)], -0.8, 0.8)
            errors.append(np.sqrt(np.mean((y / y_unit - wanted)[10:] ** 2)))
            steps.append(np.mean(said))
            scales.append(scale[0] / y_unit)
            np.testing.assert_array_equal(controller.y_scale, scale)
    assert np.max(errors) < 0.02 * np.std(path), errors
    np.testing.assert_allclose(scales[2:], scales[:2] * 3, rtol=1e-9)
    np.testing.assert_allclose(errors[2:], errors[:2] * 3, rtol=0.1)  # rounding picks the side of a kink
    assert np.min(steps) > 0.8, steps


def test_limits_hold_by_default_for_a_reference_beyond_them():
    function = eight_plays(1e-4)
    controller = PredictiveController(function, N, inputs=(-3, 3), outputs=(-8e-5, 8e-5))
    y, _ = loop(controller, function, np.full(40, 1.2e-4))
    assert np.max(y) < 8e-5 * 1.001 and y[-1] > 7.9e-5


def test_scales_that_are_given_are_taken():
    controller = PredictiveController(eight_plays(), N, inputs=(-3, 3), outputs=(-9, 9), y_scale=0.7, u_scale=2.0)
    assert np.all(controller.y_scale == 0.7) and np.all(controller.u_scale == 2.0)
    free = PredictiveController(eight_plays(), N, inputs=(-np.inf, 3))
    assert np.all(free.u_scale == 1.0) and np.all(free.y_scale > 0)
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    deaf = PredictiveController(ca.Function("deaf", [x, u], [0.5 * x, x]), N, inputs=(-1, 1))
    assert np.all(deaf.y_scale == 1.0)


def test_nothing_is_said_of_output_limits_that_were_not_asked_for():
    x, wanted, before = next(drawn(1))
    for outputs, words in ((None, False), ((-9.0, 9.0), True)):
        plan = PredictiveController(eight_plays(), N, inputs=(-3, 3), outputs=outputs)(x, wanted, before)
        assert ("limits" in str(plan)) == words


def square():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 2)
    return ca.Function("F", [x, u], [ca.mtimes(ca.DM([[0.7, 0.2], [-0.1, 0.8]]), x) + u, x])


@pytest.mark.filterwarnings("ignore")
def test_do_mpc_takes_scales_and_limits_for_each_signal():
    pytest.importorskip("do_mpc", reason="do-mpc, an optional extra, is not installed")
    wanted = np.tile([0.5, -0.3], (20, 1))
    options = {
        "inputs": ([-0.2, -1.0], [0.2, 1.0]),
        "outputs": ([-1.0, -np.inf], [1.0, np.inf]),
        "y_scale": [0.1, 0.4],
        "u_scale": [1.0, 2.0],
        "move": 0.1,
    }
    theirs = pilfr.do_mpc_controller(square(), 6, wanted, **options)
    theirs.x0, theirs.u0 = np.zeros((2, 1)), np.zeros((2, 1))
    theirs.set_initial_guess()
    ours = PredictiveController(square(), 6, **options)(np.zeros(2), wanted[:6], np.zeros(2))
    np.testing.assert_allclose(theirs.make_step(np.zeros((2, 1))).ravel(), ours.u, atol=1e-5)
    with pytest.raises(InputError, match="changes over the horizon"):
        pilfr.do_mpc_controller(square(), 6, wanted, inputs=(-1, 1), y_scale=np.arange(1.0, 13.0).reshape(6, 2))
