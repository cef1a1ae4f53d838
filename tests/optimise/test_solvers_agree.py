"""Every solver faces every problem of the zoo from the same start: same cost, exact bounds, same constraints."""

import functools

import casadi as ca
import numpy as np
import pytest

from pilfr_casadi.identify import fit
from pilfr_casadi.optimise import Constraint, GaussNewton, Ipopt, Problem, Status, stable
from pilfr_casadi.optimise.constraints import SLACK
from problems import zoo
from problems.zoo import CASES

SOLVERS = {
    "gauss-newton": GaussNewton(),
    "ipopt": Ipopt(),
    "ipopt-bfgs": Ipopt(hessian="limited-memory", max_iterations=2000),
}
FIRST = ("gauss-newton", "ipopt")
EVERY_CASE = pytest.mark.parametrize("name", CASES)
EVERY_SOLVER = pytest.mark.parametrize("solver", SOLVERS)


@functools.cache
def case(name):
    return CASES[name]()


@functools.cache
def problem(name):
    return case(name).problem()


@functools.cache
def solution(name, solver):
    return SOLVERS[solver].solve(problem(name))


def solve_all(p, solvers=tuple(SOLVERS)):
    """Solve one problem by several solvers; check that they converge within 2 % of each other."""
    found = [SOLVERS[name].solve(p) for name in solvers]
    for s in found:
        assert s.status.converged, s.status
        assert s.cost == pytest.approx(found[0].cost, rel=0.02)
        assert np.all(s.theta >= p.lower) and np.all(s.theta <= p.upper)
    return found


def at_bounds(p, theta):
    return [label for label, t, a, b in zip(p.labels, theta, p.lower, p.upper, strict=True) if t in (a, b)]


@EVERY_CASE
def test_costs_agree_and_reach_the_noise(name):
    costs = {solver: solution(name, solver).cost for solver in ("gauss-newton", "ipopt")}
    assert costs["ipopt"] == pytest.approx(costs["gauss-newton"], rel=0.02)
    assert case(name).floor < 0.05 * problem(name).cost(problem(name).start)
    if case(name).exact:
        assert max(costs.values()) < 1.02 * case(name).floor


# the quasi-Newton approximation takes another path; on the Wiener and the two-channel case to another minimum
@pytest.mark.parametrize("name", [n for n in CASES if n not in ("pi_wiener", "mimo_lfr")])
def test_quasi_newton_agrees(name):
    assert solution(name, "ipopt-bfgs").cost == pytest.approx(solution(name, "gauss-newton").cost, rel=0.02)


# hundreds of iterations
SLOWEST = ("mimo_lfr", "ipopt-bfgs")
PAIRS = [(name, solver) for name in CASES for solver in SOLVERS]


@pytest.mark.parametrize(
    ("name", "solver"), [pytest.param(*pair, marks=[pytest.mark.slow] if pair == SLOWEST else []) for pair in PAIRS]
)
def test_solutions_are_consistent(name, solver):
    p, s = problem(name), solution(name, solver)
    assert s.status.converged
    assert np.all(s.theta >= p.lower) and np.all(s.theta <= p.upper)
    assert s.cost == p.cost(s.theta) <= p.cost(p.start)
    assert s.violation == 0.0 and s.iterations > 0 and s.seconds > 0
    assert s.multipliers.shape == (p.size,)
    # positive at an upper bound, negative at a lower one, zero in between
    assert np.all(s.theta[s.multipliers < 0] == p.lower[s.multipliers < 0])
    assert np.all(s.theta[s.multipliers > 0] == p.upper[s.multipliers > 0])


@pytest.mark.parametrize("name", ["pi_hammerstein", "pi_wiener"])
def test_active_bounds_are_the_same_and_listed(name):
    p = problem(name)
    active = at_bounds(p, solution(name, "ipopt").theta)
    assert active and active == at_bounds(p, solution(name, "gauss-newton").theta)
    found = fit(case(name).model, case(name).recordings, solver=Ipopt())
    assert [line.split(" = ")[0] for line in found.active] == active


def test_multipliers_of_bounds_agree():
    one, two = (solution("pi_wiener", s).multipliers for s in ("gauss-newton", "ipopt"))
    held = one != 0
    assert held.sum() >= 2
    np.testing.assert_allclose(two[held], one[held], rtol=0.01)


@pytest.mark.parametrize("solver", ["gauss-newton", "ipopt"])
@pytest.mark.parametrize("name", ["backlash_loop", "asymmetric", "pi_wiener"])
def test_truth_is_found(name, solver):
    p = problem(name)
    found = p.model.parameters.unpack(p.parameters(solution(name, solver).theta))
    for key, value in case(name).truth.items():
        if name == "pi_wiener":  # weights and the unit of z trade against each other but for the known thresholds
            np.testing.assert_allclose(found[key], value, atol=0.03)
        else:
            np.testing.assert_allclose(found[key], value, rtol=0.05, atol=0.02)


@EVERY_SOLVER
def test_physical_parameters_of_the_rig(solver):
    p = problem("masing_grey")
    found = p.model.parameters.unpack(p.parameters(solution("masing_grey", solver).theta))
    truth = case("masing_grey").truth
    # the last stop never slips far, so it shares its stiffness with k1
    for key, share in (("k1", 0.06), ("d1", 0.03), ("k2", 0.03), ("d2", 0.04)):
        assert found[key] == pytest.approx(truth[key], rel=share)
    assert np.sqrt(2 * solution("masing_grey", solver).cost) < 0.010


def test_linear_constraints():
    limits = (
        Constraint(lambda p: ca.sum2(p["w"]), 1.0, 1.0, name="slope"),
        Constraint(lambda p: p["w"][0, 1], upper=0.25, name="second weight"),
    )
    p = case("pi_wiener").problem(constraints=limits)
    found = solve_all(p)
    for s in found:
        g = p.constraint(s.theta)
        assert abs(g[0] - 1.0) <= 1e-9 and g[1] <= 0.25 + 1e-9
        np.testing.assert_allclose(s.multipliers[p.size :], found[0].multipliers[p.size :], rtol=0.02)
    assert np.all(found[0].multipliers[p.size :] > 0)


def test_spectral_radius():
    p = case("lti").problem(constraints=(stable(0.94),))
    found = solve_all(p, FIRST)  # BFGS finds the same minimum, and may circle there: the limit has a kink
    for s in found:
        a = p.model.parameters.unpack(p.parameters(s.theta))["A"]
        assert 0.93999 < np.max(np.abs(np.linalg.eigvals(a))) <= 0.94 * (1 + SLACK + 1e-6)
        assert s.violation <= 1e-6
        assert s.multipliers[-1] == pytest.approx(found[0].multipliers[-1], rel=0.05) and s.multipliers[-1] > 0


@pytest.mark.parametrize("value, sign", [(1.2, 1), (2.5, -1)])
def test_dc_gain(value, sign):
    def gain(p):
        return (p["C_y"] @ ca.solve(ca.MX.eye(3) - p["A"], p["B_u"]) + p["D_yu"])[0]

    p = case("lti").problem(constraints=(Constraint(gain, value, value, name="DC gain"),))
    found = solve_all(p)
    for s in found:
        v = p.model.parameters.unpack(p.parameters(s.theta))
        reached = (v["C_y"] @ np.linalg.solve(np.eye(3) - v["A"], v["B_u"]) + v["D_yu"])[0, 0]
        assert abs(reached - value) <= 1e-6 and s.violation <= 1e-6
        assert s.multipliers[-1] == pytest.approx(found[0].multipliers[-1], rel=0.01)
        assert np.sign(s.multipliers[-1]) == sign


def test_l1_prunes_to_exactly_zero():
    p = case("masing_grey").problem(l1={"w": 1e-6})
    for s in solve_all(p):
        assert at_bounds(p, s.theta) == ["w[0,0]"]


def test_priors_pull():
    c = case("masing_grey")
    priors = {"k1": {"prior": (1100.0, 20.0)}, "d1": {"prior": (20.0, 0.5)}}
    p = Problem(c.model.with_parameters(c.model.parameters.change(**priors)), c.recordings, noise=0.009)
    at = [p.labels.index("k1"), p.labels.index("d1")]
    free = solution("masing_grey", "gauss-newton").theta[at]
    found = solve_all(p)
    for s in found:
        np.testing.assert_allclose(s.theta[at], found[0].theta[at], rtol=1e-3)
        assert np.all(np.abs(s.theta[at] - [1100.0, 20.0]) < np.abs(free - [1100.0, 20.0]))


@pytest.mark.parametrize(
    "limits",
    [
        (Constraint(lambda p: p["w"][0, 1], lower=0.3), Constraint(lambda p: p["w"][0, 1], upper=0.2)),
        (Constraint(lambda p: p["w"][0, 1], upper=-0.1),),
        (Constraint(lambda p: ca.sumsqr(p["A"]), upper=-1.0),),
    ],
    ids=["contradiction", "against a bound", "nowhere"],
)
@pytest.mark.parametrize(
    "solver", [*FIRST, *(pytest.param(s, marks=pytest.mark.slow) for s in SOLVERS if s not in FIRST)]
)
def test_infeasible_constraints(limits, solver):
    p = case("pi_wiener").problem(constraints=limits)
    s = SOLVERS[solver].solve(p)
    assert s.status is Status.INFEASIBLE
    assert s.violation >= 0.05 * (1 - 1e-12)  # the least that contradicting limits allow, up to rounding
    assert np.all(s.theta >= p.lower)


def test_zoo_as_a_program(capsys, monkeypatch):
    """Two cases are enough here; the tests above cover the others."""
    monkeypatch.setattr(zoo, "CASES", {name: CASES[name] for name in ("lti", "pi_wiener")})
    zoo.main([])
    _, lti, wiener = capsys.readouterr().out.splitlines()
    assert lti.split()[0] == "lti" and wiener.split()[0] == "pi_wiener"
    assert "w[0,2]" in wiener
