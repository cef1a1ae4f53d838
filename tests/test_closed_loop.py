"""Closed loops on the true simulators: the figures that the README gives, on shorter paths."""

import sys

import numpy as np
import pytest

import pilfr_casadi as pilfr
from problems import mpc_masing, mpc_piezo
from problems.closed_loop import LINEAR, table
from problems.masing import simulate
from problems.masing_data import FS


def by_name(results):
    return {o.name: o for o in results}


def test_piezo_stage_is_tracked_with_a_fifth_of_the_linear_error():
    results, _ = mpc_piezo.outcomes(250, quick=True)
    found = by_name(results)
    for name in ("MPC, hysteresis model", "inverse on the observer's state", "inverse, no sensor"):
        assert found[name].error < 0.2 * found[LINEAR].error, table(results, "µm", 1e-3, mpc_piezo.TOLERANCE)
        assert found[name].violation < mpc_piezo.TOLERANCE


def test_masing_rig_is_tracked_with_half_of_the_linear_error():
    results, _ = mpc_masing.outcomes(250, quick=True)
    found = by_name(results)
    own = found["MPC, hysteresis model"]
    assert own.error < 0.5 * found[LINEAR].error, table(results, "m", 1 / FS, mpc_masing.TOLERANCE)
    assert own.violation < mpc_masing.TOLERANCE
    assert own.median < 1 / FS


def test_the_rig_in_motion_is_the_simulator():
    u = np.random.default_rng(0).standard_normal(300)
    rig, y = mpc_masing.RigInMotion(), []
    for value in u:
        y.append(rig.y)
        rig.advance(float(value))
    np.testing.assert_array_equal(y, simulate(u, FS).x2)


def small_model():
    structure = pilfr.PILFR(2, pilfr.PrandtlIshlinskii(pilfr.Play, 2))
    blocks = {"A": [[0.7, 0.2], [-0.1, 0.8]], "B_u": [[1.0], [0.5]], "B_w": [[0.3], [0.1]], "C_y": [[1.0, 0.4]]}
    model = structure.model(1, 1, {**blocks, "D_zu": [[1.0]], "w": [[0.5, 0.3]], "r": [[0.2, 1.0]]})
    import casadi as ca

    x, u = ca.SX.sym("x", 4), ca.SX.sym("u")
    return ca.Function("F", [x, u], model.closed(x, u, ca.DM(model.parameters.start)))


OPTIONS = {"inputs": (-1.0, 1.0), "outputs": (-3.0, 3.5), "move": 1e-2, "y_scale": 1.0, "u_scale": 1.0}


def inputs_of_both(theirs, horizon=8, samples=25):
    """Inputs of our solver in closed loop, and those that `theirs(x, reference, u_before)` gives at the same states."""
    function, path = small_model(), path_of(samples)
    ours, x, u, both = pilfr.PredictiveController(function, horizon, **OPTIONS), np.zeros(4), np.zeros(1), []
    for k in range(samples):
        ahead = path[np.minimum(k + np.arange(horizon), samples - 1)]
        other = theirs(x, ahead, u)
        u = ours(x, ahead, u).u
        both.append((u.item(), other))
        x = np.asarray(function(x, u)[0]).ravel()
    return np.array(both).T


def path_of(samples):
    return 4 * np.sin(np.arange(samples) / 4)


def test_multiple_shooting_by_ipopt_closes_the_same_loop():
    planner = pilfr.PredictiveController(small_model(), 8, solver="ipopt", **OPTIONS)
    ours, theirs = inputs_of_both(lambda x, ahead, u: planner(x, ahead, u).u.item())
    np.testing.assert_allclose(ours, theirs, atol=1e-6)


@pytest.mark.filterwarnings("ignore")
def test_do_mpc_closes_the_same_loop():
    pytest.importorskip("do_mpc", reason="do-mpc, an optional extra, is not installed")
    planner = pilfr.do_mpc_controller(small_model(), 8, path_of(25), **OPTIONS)
    planner.x0, planner.u0 = np.zeros((4, 1)), np.zeros((1, 1))
    planner.set_initial_guess()

    def theirs(x, ahead, u):
        planner.u0 = u[:, None]
        return np.asarray(planner.make_step(x[:, None])).item()

    ours, others = inputs_of_both(theirs)
    np.testing.assert_allclose(ours, others, atol=1e-6)


def test_without_do_mpc_one_sentence_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "do_mpc", None)
    with pytest.raises(pilfr.InputError, match=r"pip install pilfr-casadi\[do-mpc\]"):
        pilfr.do_mpc_model(small_model())
