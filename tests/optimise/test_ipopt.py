"""`Ipopt` alone: endings, results, units, and its parts."""

import signal
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from pilfr_casadi._base import InputError, handled_interrupt
from pilfr_casadi.data import Recording
from pilfr_casadi.models import PILFR, Play, PrandtlIshlinskii
from pilfr_casadi.optimise import Constraint, GaussNewton, Ipopt, Problem, Status
from pilfr_casadi.optimise.ipopt import DampedHessian, Point, Scaled, _Callback
from problems.zoo import CASES


@pytest.fixture(scope="module")
def wiener():
    return CASES["pi_wiener"]().problem()


@pytest.fixture(scope="module")
def solution(wiener):
    return Ipopt().solve(wiener)


def test_unknown_hessian():
    with pytest.raises(InputError, match="'exact' is unknown"):
        Ipopt(hessian="exact")


def test_silent(wiener, capfd):
    Ipopt().solve(wiener)
    Ipopt(time_limit=0.0).solve(wiener)
    assert capfd.readouterr() == ("", "")


def test_options_of_ipopt(wiener, capfd):
    Ipopt(options={"print_level": 5}).solve(wiener)
    assert "inf_pr" in capfd.readouterr().out


def test_progress_and_history(wiener):
    seen = []
    found = Ipopt().solve(wiener, progress=seen.append)
    assert found.history == tuple(seen)
    assert [entry.number for entry in seen] == list(range(found.iterations + 1))
    assert seen[0].cost == pytest.approx(wiener.cost(wiener.start), rel=1e-2)
    assert np.all(np.diff([entry.seconds for entry in seen]) >= 0)
    assert all(entry.damping > 0 for entry in seen) and found.cost <= min(entry.cost for entry in seen) * (1 + 1e-5)


def test_a_start_of_ones_own_is_left_alone(wiener):
    start = wiener.start * 1.05
    kept = start.copy()
    assert Ipopt().solve(wiener, start).cost < wiener.cost(start)
    np.testing.assert_array_equal(start, kept)


def test_the_minimum_stays(wiener, solution):
    again = Ipopt().solve(wiener, solution.theta)
    assert again.status.converged and again.cost == pytest.approx(solution.cost, rel=1e-6)
    assert again.cost <= solution.cost


def test_repeatable(wiener, solution):
    np.testing.assert_array_equal(Ipopt().solve(wiener).theta, solution.theta)


def test_iteration_limit(wiener):
    found = Ipopt(max_iterations=3).solve(wiener)
    assert found.status is Status.MAX_ITERATIONS and found.iterations == 3
    assert found.cost < wiener.cost(wiener.start)


def test_time_limit(wiener):
    found = Ipopt(time_limit=0.0).solve(wiener)
    assert found.status is Status.TIME_LIMIT
    assert found.cost <= wiener.cost(wiener.start)


def test_diverging_start():
    problem = CASES["lti"]().problem()
    start = problem.start.copy()
    start[[problem.labels.index(f"A[{i},{i}]") for i in range(3)]] = 3.0
    found = Ipopt().solve(problem, start)
    assert found.status is Status.DIVERGED_START and found.cost == np.inf
    np.testing.assert_array_equal(found.theta, start)


def test_diverging_trial_points_are_survived(monkeypatch):
    problem = CASES["lti"]().problem()
    costs = []
    cost = problem.cost

    def steep(theta):
        """The cost, with a cliff just beyond the minimum."""
        value = cost(theta)
        value = np.inf if theta[0] > limit else value
        costs.append(value)
        return value

    at = Ipopt().solve(problem).theta
    start = problem.start
    limit = max(at[0], start[0]) + 0.01
    monkeypatch.setattr(problem, "cost", steep)
    found = Ipopt(damping=1e-6).solve(problem)
    assert np.inf in costs
    assert found.status.converged and found.cost == pytest.approx(cost(at), rel=1e-3)


@pytest.mark.parametrize("at", [0, 2])
def test_interrupted_by_the_progress_function(wiener, at):
    def progress(iteration):
        if iteration.number == at:
            raise KeyboardInterrupt

    found = Ipopt().solve(wiener, progress=progress)
    assert found.status is Status.INTERRUPTED
    assert found.cost <= wiener.cost(wiener.start) and found.iterations == at


@pytest.mark.parametrize("calls", [1, 3, 12])
def test_interrupted_by_a_signal(wiener, monkeypatch, calls):
    cost, left = wiener.cost, [calls]

    def interrupt(theta):
        left[0] -= 1
        if left[0] == 0:
            signal.raise_signal(signal.SIGINT)
        return cost(theta)

    monkeypatch.setattr(wiener, "cost", interrupt)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        found = Ipopt(tolerance=0.0).solve(wiener)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert found.status is Status.INTERRUPTED and left[0] <= 0
    np.testing.assert_array_equal(np.clip(found.theta, wiener.lower, wiener.upper), found.theta)


def test_errors_of_the_progress_function_are_raised(wiener):
    def progress(iteration):
        raise ZeroDivisionError("in the user's function")

    with pytest.raises(ZeroDivisionError, match="user's function"):
        Ipopt().solve(wiener, progress=progress)


def test_an_infeasible_start_becomes_feasible(wiener):
    def slope(p):
        return ca.sum2(p["w"])

    problem = CASES["pi_wiener"]().problem(constraints=(Constraint(slope, 2.0, 2.0),))
    assert abs(problem.constraint(problem.start)[0] - 2.0) > 0.5
    found = Ipopt().solve(problem)
    assert found.status.converged and found.violation <= 1e-9


def in_other_units(record, u, y):
    return Recording(record.u * u, record.y * y, record.dt, initial="zero")


@pytest.mark.parametrize("u, y", [(1e3, 1.0), (1.0, 1e-6), (1e-4, 1e5)])
def test_units_do_not_matter(u, y):
    case = CASES["lti"]()
    plain = case.problem()
    model = case.model
    scaled = {"B_u": u, "C_y": 1 / y, "D_yu": u / y, "y_0": 1 / y}
    changes = {name: {"value": model.parameters[name].value / by} for name, by in scaled.items()}
    other = Problem(model.with_parameters(model.parameters.change(**changes)), in_other_units(case.recordings[0], u, y))
    one, two = Ipopt().solve(plain), Ipopt().solve(other)
    assert two.iterations == one.iterations and two.cost == pytest.approx(one.cost, rel=1e-9)
    at = slice(0, 9)  # the poles have no unit
    np.testing.assert_allclose(two.theta[at], one.theta[at], rtol=1e-5, atol=1e-8)


def two_ports(seed=0):
    """A PI-LFR with `B_w = D_yw = 0`: every column of the element vanishes at the start."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(400, 1)).cumsum(axis=0) / 10
    y, x, q = np.zeros((400, 1)), 0.0, 0.0
    for k in range(400):
        q = max(u[k, 0] - 0.3, min(u[k, 0] + 0.3, q))
        y[k] = x
        x = 0.8 * x + 0.1 * u[k, 0] + 0.2 * q
    structure = PILFR(1, PrandtlIshlinskii(Play, 2), fixed={"D_yu": 0.0, "C_y": 1.0}, offset=False)
    start = {"A": [[0.8]], "B_u": [[0.3]], "D_zu": [[1.0]], "r": [[0.0, 0.5]]}
    record = Recording(u, y + 0.01 * y.std() * rng.normal(size=y.shape), 0.1, initial="zero")
    return Problem(structure.model(1, 1, start), record)


def test_vanishing_columns():
    problem = two_ports()
    _, _, h = problem.normal(problem.start)
    assert np.sum(np.diag(h) == 0) >= 4
    one, two = GaussNewton().solve(problem), Ipopt().solve(problem)
    assert two.status.converged and two.cost == pytest.approx(one.cost, rel=0.02)
    assert two.cost < 6e-5


def test_scales():
    problem = two_ports()
    scaled = Scaled(problem, problem.start, 0.1)
    x = problem.start * scaled.s
    point = scaled.point(x)
    assert point.value == 1.0 and np.all(np.isfinite(scaled.s)) and np.all(scaled.s > 0)
    np.testing.assert_array_equal(scaled.theta(x), problem.start)
    # the gradient in scaled units, against differences
    for i in range(problem.size):
        d = np.zeros(problem.size)
        d[i] = 1e-6
        rise = (problem.cost((x + d) / scaled.s) - problem.cost((x - d) / scaled.s)) / scaled.unit / 2e-6
        assert rise == pytest.approx(point.gradient[i], abs=1e-4)


def test_curvature_of_constraints():
    limits = (Constraint(lambda p: ca.sumsqr(p["w"]) * p["A"], upper=1.0), Constraint(lambda p: ca.sum2(p["w"])))
    problem = CASES["pi_wiener"]().problem(constraints=limits)
    scaled = Scaled(problem, problem.start, 0.1)
    x, lam = problem.start * scaled.s, np.array([0.7, -0.3] * 3)[: len(problem.g_lower)]
    h = scaled.curvature(x, lam)
    slopes = []
    for i in range(problem.size):
        d = np.zeros(problem.size)
        d[i] = 1e-5
        slopes.append(lam @ (scaled.slope(x + d) - scaled.slope(x - d)) / 2e-5)
    np.testing.assert_allclose(h, np.array(slopes), atol=1e-6)
    assert np.max(np.abs(h)) > 1e-3


def quadratic(x, h, curve=0.0):
    """A point of `1/2 x'hx` under one constraint `x_0 + curve x_1²/2`."""
    x = np.asarray(x, dtype=float)
    slope = np.array([[1.0, curve * x[1]]])
    return Point(x, 0.5 * x @ h @ x, h @ x, h, np.array([x[0] + curve * x[1] ** 2 / 2]), slope)


def test_damping_falls_where_the_model_is_right():
    h, damping = np.diag([2.0, 1.0]), DampedHessian(0.3, 2)
    first = damping.at(quadratic([1.0, 1.0], h), np.zeros(1), 1)
    np.testing.assert_allclose(first, h * 1.3)
    damping.at(quadratic([0.5, 0.2], h), np.zeros(1), 1)
    assert damping.damping.value == pytest.approx(0.1)


@pytest.mark.parametrize(
    "change, multipliers, trials",
    [
        (dict(), [0.0], 3),  # the line search had to shorten the step
        (dict(value=5.0), [0.0], 1),  # the cost rose where it should have fallen
        (dict(), [10.0], 1),  # the constraint bends
    ],
)
def test_damping_grows(change, multipliers, trials):
    h, damping = np.diag([2.0, 1.0]), DampedHessian(0.3, 2)
    damping.at(quadratic([1.0, 1.0], h, curve=1.0), np.zeros(1), 1)
    damping.at(replace(quadratic([0.5, 0.2], h, curve=1.0), **change), np.array(multipliers), trials)
    assert damping.damping.value > 0.5


def test_callback():
    caught = []

    def halve(x):
        if x[0] < 0:
            raise ValueError("negative")
        return [x / 2, np.sum(x)]

    shapes = {"half": ca.Sparsity.dense(2, 1), "sum": ca.Sparsity.dense(1, 1)}
    f = _Callback("halve", {"x": ca.Sparsity.dense(2, 1)}, shapes, halve, caught.append)
    half, total = f([4.0, 2.0])
    assert f.name_out() == ["half", "sum"] and np.asarray(half).ravel().tolist() == [2.0, 1.0] and float(total) == 6.0
    assert np.all(np.isnan(np.asarray(f([-1.0, 0.0])[0])))
    assert [str(error) for error in caught] == ["negative"]


def test_interrupts_of_other_handlers_are_passed_on():
    called = []
    before = signal.signal(signal.SIGINT, lambda *_: called.append("theirs"))
    try:
        with handled_interrupt(lambda: called.append("ours")):
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)
    assert called == ["theirs"]
