"""The problem over the horizon: the same numbers as the recursion, and user-defined costs and constraints."""

import casadi as ca
import numpy as np
import pytest
from random_models import random_input, random_lfr

from pilfr_casadi.data import Recording
from pilfr_casadi.models import PILFR, Play, Stop
from pilfr_casadi.optimise import Constraint, GaussNewton, Problem, stable

LENGTH = 40


def recording(seed, n_u, n_y, **options):
    rng = np.random.default_rng(seed)
    return Recording(random_input(seed, LENGTH, n_u), rng.normal(size=(LENGTH, n_y)), 0.1, **options)


def recordings_of(kind, n_u, n_y, nx):
    make = {
        "zero": [dict(initial="zero")],
        "given": [dict(initial=np.linspace(-1.0, 1.0, nx))],
        "estimate": [dict(initial="estimate")],
        "periodic": [dict(initial="periodic", period=20, skip=0)],
        "several": [dict(initial="zero", skip=7), dict(initial="estimate"), dict(initial="estimate", skip=3)],
    }[kind]
    return [recording(seed, n_u, n_y, **options) for seed, options in enumerate(make)]


def four_periods_before(r):
    """Put four unscored periods before a recording in steady state; return others unchanged."""
    if r.begins != "periodic":
        return r
    u, y = (np.vstack([np.tile(x[: r.period], (4, 1)), x]) for x in (r.u, r.y))
    return Recording(u, y, r.dt, initial="zero", skip=4 * r.period + r.skip)


@pytest.mark.parametrize("operator", [Play, Stop])
@pytest.mark.parametrize("kind", ["zero", "given", "estimate", "periodic", "several"])
def test_same_numbers_as_the_recursion(kind, operator, monkeypatch):
    monkeypatch.setattr("pilfr_casadi.optimise.problem.MOST_WRITTEN_PERIODS", 4)
    sizes = dict(n_u=2, n_y=2, n_w=2)
    priors = {"A": (0.1, 0.5), "w": (0.2, 0.3)}
    structure, values = random_lfr(5, nx=3, n=3, operator=operator, priors=priors, fixed={"D_yu": 0.0}, **sizes)
    limits = (stable(0.99), Constraint(lambda p: ca.sum2(p["w"]), upper=3.0))
    records = recordings_of(kind, 2, 2, 3)
    weights = 1.0 + np.arange(len(records))
    options = dict(constraints=limits, l1={"w": 0.01}, noise=0.1, weights=weights)
    model = structure.model(2, 2, values)
    nlp = Problem(model, records, **options).to_nlp()
    problem = Problem(model, [four_periods_before(r) for r in records], **options)
    f = ca.Function("f", [nlp.x], [nlp.f, ca.gradient(nlp.f, nlp.x), nlp.residual, nlp.g, *nlp.simulated])
    rng = np.random.default_rng(0)
    for _ in range(3):
        theta = problem.start + 0.03 * rng.normal(size=problem.size)
        value, gradient, residual, g, *simulated = (np.asarray(a) for a in f(theta))
        cost, slope, _ = problem.normal(theta)
        assert float(value.item()) == pytest.approx(cost, rel=1e-12)
        np.testing.assert_allclose(gradient.ravel(), slope, rtol=1e-8, atol=1e-10 * np.max(np.abs(slope)))
        np.testing.assert_allclose(residual.ravel(), problem.residual(theta), rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(g.ravel(), problem.constraint(theta), rtol=1e-12)
        for ours, theirs in zip(problem.simulate(theta), simulated, strict=True):
            np.testing.assert_allclose(theirs.T, ours[-LENGTH:], rtol=1e-10, atol=1e-12)


def test_layout():
    structure, values = random_lfr(1, n=2, bounds={"w": (0.0, 5.0)}, fixed={"D_zu": 0.5})
    records = recordings_of("several", 1, 1, 3)
    problem = Problem(structure.model(1, 1, values), records, constraints=(stable(0.9),))
    nlp = problem.to_nlp()
    assert nlp.x.shape == (problem.size, 1) and nlp.residual.shape == (problem.residuals, 1)
    assert [y.shape for y in nlp.simulated] == [(1, LENGTH)] * 3
    for ours, theirs in (("x0", "start"), ("lbx", "lower"), ("ubx", "upper"), ("lbg", "g_lower"), ("ubg", "g_upper")):
        np.testing.assert_array_equal(getattr(nlp, ours), getattr(problem, theirs))
    rng = np.random.default_rng(0)
    theta = problem.start + rng.normal(size=problem.size)
    names = list(problem.model.parameters)
    f = ca.Function("named", [nlp.x], [*(nlp.parameters[n] for n in names), *nlp.initial])
    found = [np.asarray(a) for a in f(theta)]
    expected = problem.model.parameters.unpack(problem.parameters(theta))
    for name, value in zip(names, found[: len(names)], strict=True):
        np.testing.assert_array_equal(value.ravel(order="F"), expected[name].ravel(order="F"))
    assert expected["D_zu"].item() == 0.5
    for state, value in zip(problem.initial_states(theta), found[len(names) :], strict=True):
        np.testing.assert_array_equal(value.ravel(), state)


def _lag():
    """A lag of gain 2 identified from a noisy step, and the problem over the horizon."""
    rng = np.random.default_rng(3)
    u = np.concatenate([np.zeros(5), np.ones(55)])
    y = np.zeros(60)
    for k in range(59):
        y[k + 1] = 0.9 * y[k] + 0.2 * u[k]
    record = Recording(u, y + 0.1 * rng.standard_normal(60), 0.1, initial="zero")
    structure = PILFR(1, fixed={"C_y": 1.0, "D_yu": 0.0}, bounds={"A": (0.0, 0.99)}, offset=False)
    return Problem(structure.model(1, 1, {"A": [[0.8]], "B_u": [[0.1]]}), record)


def test_any_solver_takes_the_horizon():
    problem = _lag()
    nlp = problem.to_nlp()
    quiet = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes"}}
    solver = ca.nlpsol("solver", "ipopt", {"x": nlp.x, "f": nlp.f, "g": nlp.g}, quiet)
    theta = np.asarray(solver(x0=nlp.x0, lbx=nlp.lbx, ubx=nlp.ubx, lbg=nlp.lbg, ubg=nlp.ubg)["x"]).ravel()
    assert solver.stats()["success"]
    ours = GaussNewton(tolerance=1e-9).solve(problem)
    np.testing.assert_allclose(theta, ours.theta, rtol=1e-5)
    assert problem.cost(theta) == pytest.approx(ours.cost, rel=1e-9)


def test_constraint_on_a_simulated_output_and_a_cost_of_ones_own():
    problem = _lag()
    nlp = problem.to_nlp()
    free = GaussNewton().solve(problem).theta
    before = problem.simulate(free)[0]
    limit = 0.9 * float(before.max())
    own = 0.1 * (nlp.parameters["A"] - 0.85) ** 2
    quiet = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes"}}
    program = {"x": nlp.x, "f": nlp.f + own, "g": ca.vertcat(nlp.g, nlp.simulated[0].T)}
    solver = ca.nlpsol("solver", "ipopt", program, quiet)
    limits = {"lbg": np.append(nlp.lbg, np.full(60, -np.inf)), "ubg": np.append(nlp.ubg, np.full(60, limit))}
    theta = np.asarray(solver(x0=nlp.x0, lbx=nlp.lbx, ubx=nlp.ubx, **limits)["x"]).ravel()
    assert solver.stats()["success"]
    after = problem.simulate(theta)[0]
    assert limit - 1e-4 < after.max() <= limit + 1e-6
    assert problem.cost(theta) > problem.cost(free)
    # the user's cost pulls the pole to its target
    plain = ca.nlpsol("plain", "ipopt", {**program, "f": nlp.f}, quiet)
    without = np.asarray(plain(x0=nlp.x0, lbx=nlp.lbx, ubx=nlp.ubx, **limits)["x"]).ravel()
    pole = problem.labels.index("A[0,0]")
    assert abs(theta[pole] - 0.85) < abs(without[pole] - 0.85)
