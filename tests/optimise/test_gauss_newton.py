"""Gauss-Newton SQP: convergence, feasibility, damping, and independence of units."""

import casadi as ca
import numpy as np
import pytest
from random_models import random_input, random_lfr, reference

from pilfr_casadi.data import Recording
from pilfr_casadi.identify import fit, linear_model
from pilfr_casadi.linear import subspace_matrices
from pilfr_casadi.models import PILFR, Neighbours, Play
from pilfr_casadi.optimise import Constraint, GaussNewton, Ipopt, Problem, Status, stable, unconstrained_step
from pilfr_casadi.optimise.gauss_newton import _Run, replace_rounding
from pilfr_casadi.optimise.quadratic_program import QuadraticProgram, Step


@pytest.fixture(scope="module")
def case():
    structure, values = random_lfr(3, nx=2, n=4)
    u = random_input(1, 1500)
    y = reference(Play, values, u, np.zeros(6))[0]
    y = y + 0.01 * y.std() * np.random.default_rng(0).normal(size=y.shape)
    return structure.model(1, 1, values), Recording(u, y, 0.01, initial="zero"), values


def sum_of_thresholds(values, unit=1.0, share=0.5):
    return Constraint(lambda p: unit * ca.sum1(ca.vec(p["r"])), upper=unit * share * float(values["r"].sum()), name="r")


class Scalar:
    """A problem in one variable, from its residual and slope; it stores the points of its derivatives."""

    lower, upper, g_lower, g_upper = np.full(1, -np.inf), np.full(1, np.inf), np.zeros(0), np.zeros(0)
    start, size, labels = np.zeros(1), 1, ("x",)

    def __init__(self, residual, slope):
        self.residual, self.slope, self.points = residual, slope, []

    def cost(self, theta):
        return 0.5 * float(self.residual(theta[0])) ** 2

    def normal(self, theta):
        self.points.append(float(theta[0]))
        e, slope = self.residual(theta[0]), self.slope(theta[0])
        return 0.5 * e**2, np.array([e * slope]), np.array([[slope**2]])

    def constraint_jacobian(self, theta):
        return np.zeros((0, 1))


def test_an_infeasible_start_is_solved_to_the_end(case):
    model, record, values = case
    problem = Problem(model, record, constraints=(sum_of_thresholds(values),))
    assert problem.constraint(problem.start)[0] > 1.5 * problem.g_upper[0]
    found = GaussNewton().solve(problem)
    cost, gradient, hessian = problem.normal(found.theta)
    slopes = problem.constraint_jacobian(found.theta)
    rest = gradient + found.multipliers[: problem.size] + slopes.T @ found.multipliers[problem.size :]
    assert found.status is Status.CONVERGED and found.violation == 0.0 and found.iterations > 10
    assert cost < 4.85e-5 and np.max(np.abs(rest) / np.sqrt(np.diag(hessian))) < 5e-5
    assert found.cost <= 1.001 * Ipopt().solve(problem).cost


@pytest.mark.parametrize("unit", [1e-10, 1e-4, 1e10])
def test_the_unit_of_a_constraint_does_not_matter(case, unit):
    model, record, values = case
    plain, other = (Problem(model, record, constraints=(sum_of_thresholds(values, k, 0.2),)) for k in (1.0, unit))
    one, two = (GaussNewton().solve(p) for p in (plain, other))
    assert one.status is two.status is Status.CONVERGED
    np.testing.assert_allclose(two.theta, one.theta, rtol=1e-6, atol=1e-9)
    assert other.constraint(two.theta)[0] <= other.g_upper[0] * (1 + 1e-8)
    assert two.violation <= 1e-8 * other.g_upper[0]
    assert two.multipliers[-1] * unit == pytest.approx(one.multipliers[-1], rel=1e-4)


def test_which_constraints_are_active_does_not_depend_on_their_unit(case):
    model, record, values = case
    total = float(values["r"].sum())
    for unit in (1e-10, 1.0, 1e10):
        for low, high, active in ((0.5, 2.0, False), (1.0, 2.0, True), (0.5, 1.0, True), (0.5, 1.001, False)):
            limit = Constraint(lambda p, k=unit: k * ca.sum1(ca.vec(p["r"])), unit * low * total, unit * high * total)
            problem = Problem(model, record, constraints=(limit,))
            assert problem.active_constraints(problem.start).tolist() == [active]


def test_units_are_given_or_from_the_variables_sizes(case):
    model, record, values = case
    own = Constraint(lambda p: 3.0 * p["r"][0, 0], unit=7.0)
    problem = Problem(model, record, constraints=(own, Constraint(lambda p: 3.0 * p["D_yu"][0, 0])))
    size = 3.0 * abs(float(values["D_yu"][0, 0]))
    np.testing.assert_allclose(problem.constraint_units(problem.start), [7.0, size])


def test_infeasible_constraints_within_bounds_end_early(case):
    model, record, _ = case
    changes = {"w": {"bounds": (0, 1.2)}, "r": {"bounds": (0.01, 2.5)}}
    bounded = model.with_parameters(model.parameters.change(**changes))
    product = Constraint(lambda p: ca.dot(ca.vec(p["w"]), ca.vec(p["r"])), lower=13.0)
    found = GaussNewton().solve(Problem(bounded, record, constraints=(product,)))
    assert found.status is Status.INFEASIBLE and found.violation > 0.5 and found.iterations < 100


def test_a_correction_leaves_penalty_and_multipliers_alone(case, monkeypatch):
    model, record, _ = case
    curved = Constraint(lambda p: ca.sumsqr(p["C_z"]), 1.0, 1.0)
    problem = Problem(model, record, constraints=(curved,))
    run = _Run(GaussNewton(), problem, problem.start, None, None)
    run.penalty.weight, run.multipliers = 3.0, np.ones(problem.size + 1)
    run.cost, gradient, hessian = problem.normal(run.theta)
    wild = Step(np.zeros(problem.size), np.full(problem.size + 1, 1e9), True)
    monkeypatch.setattr(run, "_step", lambda *_: wild)
    forward = Step(0.1 * np.ones(problem.size), np.zeros(problem.size + 1), True)
    run._judge(forward, hessian, gradient, problem.constraint_jacobian(run.theta))
    assert run.penalty.weight == 3.0 and np.all(run.multipliers == 1.0)


def test_damping_remembers_the_largest_diagonal():
    problem = Scalar(lambda x: np.exp(-x), lambda x: -np.exp(-x))
    found = GaussNewton(max_iterations=2).solve(problem)
    first, second = problem.points[1], found.theta[0] - problem.points[1]
    assert first == pytest.approx(1 / 1.01)
    slope = np.exp(-first) ** 2
    assert second == pytest.approx(slope / (slope + found.history[0].damping * 1.0))
    assert found.history[0].damping > 1e-3


class Wavy(Scalar):
    """A cost that falls towards x = 7 under `0.3 x <= cos x`; linear steps do not leave the valley near 2π."""

    g_lower, g_upper, edge = np.full(1, -np.inf), np.zeros(1), 1.2019131

    def __init__(self, start):
        super().__init__(lambda x: 7.0 - x, lambda x: -1.0)
        self.start = np.array([start])

    def constraint(self, theta):
        return 0.3 * theta - np.cos(theta)

    def constraint_jacobian(self, theta):
        return (0.3 + np.sin(theta)).reshape(1, 1)

    def constraint_units(self, theta, squares=None):
        return np.ones(1)


@pytest.mark.parametrize("start", [-0.5, -1.0])
def test_a_run_that_strays_returns_to_its_best_feasible_point(start, monkeypatch):
    strays = Wavy(start)
    found = GaussNewton().solve(strays)
    assert max(strays.points) > 5.0  # the run has visited a region where the constraint cannot be met
    assert found.status is Status.CONVERGED and found.theta[0] == pytest.approx(strays.edge, abs=1e-5)
    assert found.cost == found.history[-1].cost and found.violation <= 1e-9
    monkeypatch.setattr("pilfr_casadi.optimise.gauss_newton.MOST_RETURNS", 0)
    ended = GaussNewton().solve(strays)
    assert ended.status is Status.SOLVER_FAILED and ended.theta[0] == start == strays.start[0]
    assert ended.cost == strays.cost(ended.theta) == ended.history[-1].cost


@pytest.mark.parametrize("most", range(1, 12))
def test_no_limit_ends_a_run_worse_than_a_feasible_point_it_has_seen(most):
    strays = Wavy(-0.5)
    found = GaussNewton(max_iterations=most).solve(strays)
    seen = [x for x in strays.points if 0.3 * x - np.cos(x) <= 0]
    assert found.violation <= 1e-6 and found.cost <= min(strays.cost(np.array([x])) for x in seen)
    assert found.status in (Status.MAX_ITERATIONS, Status.CONVERGED)
    there = GaussNewton(max_iterations=most).solve(strays, unfinished=True)
    assert there.status is Status.MAX_ITERATIONS and there.theta[0] > 5 and there.cost < found.cost


def test_a_step_that_only_damping_makes_small_is_no_minimum():
    wall = Scalar(lambda x: 1.0 if x == 0 else 2.0, lambda x: -1.0)  # every trial is worse, against the slope
    stuck = GaussNewton().solve(wall)
    assert stuck.status is Status.SMALL_STEP and np.all(
        np.isnan(stuck.multipliers)
    )  # at a kink multipliers do not exist
    valley = Scalar(lambda x: 1.0 + x**2, lambda x: 2 * x)
    assert GaussNewton().solve(valley).status is Status.CONVERGED


def test_rounding_is_no_sensitivity():
    labels = ("A[0,0]", "A[1,0]", "A[0,1]", "A[1,1]", "D[0,0]", "E[0,0]")
    theta = np.array([0.5, 0.5, 0.5, 0.5, 1e-17, 0.0])
    squares = np.array([1.0, 1e-32, 0.0, 0.1, 1.0, 2.0])
    # rounding is small beside its neighbours and without effect; a tiny value or a zero alone is not rounding
    np.testing.assert_allclose(replace_rounding(squares, theta, Neighbours(labels)), [1.0, 4.0, 4.0, 0.1, 1.0, 2.0])
    # inputs in different units: the smaller column is not rounding
    mixed = replace_rounding(np.array([1e-12, 1e18]), np.array([1e6, 1e-9]), Neighbours(("B[0,0]", "B[0,1]")))
    np.testing.assert_array_equal(mixed, [1e-12, 1e18])


@pytest.mark.parametrize("nx", [3, 6])
def test_too_high_an_order_without_noise(nx):
    turn = 0.9 * np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    blocks = {"A": turn, "B_u": [[1.0], [0.5]], "C_y": [[1.0, 0.3]]}
    u = np.random.default_rng(0).normal(size=(2000, 1))
    silent = Recording(u, np.zeros((2000, 1)), 0.1, initial="zero")
    problem = Problem(PILFR(2).model(1, 1, blocks), silent, scale=np.ones(1))
    record = Recording(u, problem.simulate(problem.start)[0], 0.1, initial="zero")
    found = fit(PILFR(nx), record)
    assert found.status is Status.CONVERGED and found.train_nrmse[0] < 1e-9


def test_states_without_excitation_are_no_obstacle():
    """A third state whose responses are rounding, and an offset far from its start."""
    turn = 0.9 * np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    a, b, c = np.zeros((3, 3)), np.array([[1.0], [0.5], [1e-16]]), np.array([[1.0, 0.3, 1e-16]])
    a[:2, :2], a[2] = turn, [1e-16, 2e-16, 0.5]
    u = np.random.default_rng(0).normal(size=(2000, 1))
    silent = Recording(u, np.zeros((2000, 1)), 0.1, initial="zero")
    problem = Problem(PILFR(3).model(1, 1, {"A": a, "B_u": b, "C_y": c}), silent, scale=np.ones(1))
    record = Recording(u, problem.simulate(problem.start)[0], 0.1, initial="zero")
    shifted = PILFR(3).model(1, 1, {"A": 0.99 * a, "B_u": b, "C_y": c, "y_0": [1.0]})
    found = GaussNewton().solve(Problem(shifted, record))
    assert found.status is Status.CONVERGED and found.cost < 1e-18


def test_an_unstable_system_is_fitted_within_the_limit():
    u = np.random.default_rng(0).normal(size=(400, 1))
    silent = Recording(u, np.zeros((400, 1)), 0.1, initial="zero")
    problem = Problem(PILFR(1).model(1, 1, {"A": [[1.01]], "B_u": [[1.0]], "C_y": [[1.0]]}), silent, scale=np.ones(1))
    record = Recording(u, problem.simulate(problem.start)[0], 0.1, initial="zero")
    assert 0.999 < fit(PILFR(1), record).parameters["A"][0, 0] <= 1.0001


def test_the_linear_model_finds_the_offset():
    structure, values = random_lfr(5, nx=2, n_w=0, radius=0.9)
    u = 3.0 + random_input(4, 800)
    silent = Recording(u, np.zeros((800, 1)), 0.1, initial="zero")
    problem = Problem(structure.model(1, 1, {**values, "y_0": np.array([5.0])}), silent, scale=np.ones(1))
    record = Recording(u, problem.simulate(problem.start)[0], 0.1, initial="zero")
    model, _, _ = linear_model([record], PILFR(2))
    assert model.parameters["y_0"].value[0] == pytest.approx(5.0, abs=0.05)
    assert abs(record.y.mean() - 5.0) > 1.0
    assert subspace_matrices([record], 2, offset=True)[0].shape == (2, 2)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("offset", [True, False])
def test_a_double_integrator_is_within_the_limit(seed, offset):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(1000, 1))
    blocks = {"A": [[1.0, 0.1], [0.0, 1.0]], "B_u": [[0.005], [0.1]], "C_y": [[1.0, 0.0]]}
    silent = Recording(u, np.zeros((1000, 1)), 0.1, initial="zero")
    problem = Problem(PILFR(2).model(1, 1, blocks), silent, scale=np.ones(1), constraints=(stable(),))
    assert problem.constraint(problem.start)[0] < problem.g_upper[0]
    y = problem.simulate(problem.start)[0]
    found = fit(
        PILFR(2, offset=offset), Recording(u, y + 0.01 * y.std() * rng.normal(size=y.shape), 0.1, initial="zero")
    )
    assert found.status is Status.CONVERGED and found.train_nrmse[0] < 0.0107
    assert np.max(np.abs(np.linalg.eigvals(found.parameters["A"]))) <= 1 + 1e-4


def test_a_cost_of_zero_is_converged():
    nothing = Scalar(lambda x: 1e-13, lambda x: 1e-13)
    found = GaussNewton().solve(nothing)
    assert found.status is Status.CONVERGED and found.iterations == 0


@pytest.mark.parametrize("wrapped", [False, True])
def test_interrupted_between_two_iterations(case, wrapped):
    model, record, _ = case

    def strike(entry):
        if entry.number == 2 and wrapped:
            raise SystemError("returned a result with an exception set") from KeyboardInterrupt()
        if entry.number == 2:
            raise KeyboardInterrupt

    problem = Problem(model, record)
    found = GaussNewton(tolerance=1e-12).solve(problem, problem.start * 1.05, strike)
    assert found.status is Status.INTERRUPTED and np.isfinite(found.cost)


def test_a_step_inside_its_limits_solves_the_quadratic_program():
    rng = np.random.default_rng(0)
    for case in range(30):
        n, n_g = int(rng.integers(1, 8)), int(rng.integers(0, 3))
        root = rng.standard_normal((n, n))
        h, g, a = root @ root.T + 0.1 * np.eye(n), rng.standard_normal(n), rng.standard_normal((n_g, n))
        room = 10.0 ** rng.uniform(-1, 3)
        limits = (np.full(n, -room), np.full(n, room), a, np.full(n_g, -room), np.full(n_g, room))
        ours, qrqp = QuadraticProgram(n, n_g, "daqp"), QuadraticProgram(n, n_g, "qrqp")
        d, multipliers, good = ours(h, g, *limits)
        expected = np.asarray(
            qrqp._solver(h=h, g=g, lbx=limits[0], ubx=limits[1], a=a, lba=limits[3], uba=limits[4])["x"]
        ).ravel()
        assert good, case
        np.testing.assert_allclose(d, expected, atol=1e-7 * max(1.0, np.max(np.abs(expected))))
        gradient = h @ d + g + multipliers[:n] + a.T @ multipliers[n:]
        np.testing.assert_allclose(gradient, 0, atol=1e-7 * max(1.0, np.max(np.abs(multipliers), initial=0.0)))


def test_an_indefinite_or_nan_matrix_has_no_unconstrained_step():
    assert unconstrained_step(-np.eye(2), np.ones(2)) is None
    assert unconstrained_step(np.full((2, 2), np.nan), np.ones(2)) is None


def test_infinite_or_nan_limits_give_no_step():
    h, g, a, low, high = np.eye(1), np.ones(1), np.ones((1, 1)), np.full(1, -np.inf), np.full(1, np.inf)
    for upper in (-np.inf, np.nan):
        d, multipliers, good = QuadraticProgram(1, 1, "daqp")(h, g, low, high, a, low, np.full(1, upper))
        assert not good and np.all(d == 0) and multipliers.shape == (2,)
