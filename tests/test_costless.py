"""Constraints that cost nothing: the same model is found where it meets them, and a fit is no worse under them."""

import casadi as ca
import numpy as np
import pytest
from random_models import random_input, random_lfr

import pilfr_casadi as pilfr
from pilfr_casadi.identify import costless
from pilfr_casadi.models import Play, Stop
from pilfr_casadi.optimise import Constraint, Problem
from problems.constrained import three_plays


def weights_within(bound):
    return Constraint(lambda p: ca.sum2(p["w"]), upper=bound, name="sum of weights")


def problem_of(constraints, operator=Play, initial="zero", fixed=(), prior=None):
    structure, values = random_lfr(0, nx=2, n=3, operator=operator)
    u = random_input(np.random.default_rng(1), 120)[:, :1]
    model = structure.model(1, 1, values)
    changes = {name: {"fixed": True} for name in fixed}
    if prior:
        changes["B_w"] = {"prior": (model.parameters["B_w"].value, prior)}
    model = model.with_parameters(model.parameters.change(**changes))
    y = np.sin(np.arange(120.0))[:, None]
    return Problem(model, pilfr.Recording(u, y, 0.1, initial=initial), constraints=constraints, engine="vm")


def total(problem, theta):
    return float(problem.model.parameters.unpack(problem.parameters(theta))["w"].sum())


@pytest.mark.parametrize("operator", [Play, Stop])
@pytest.mark.parametrize("initial", ["zero", "estimate"])
@pytest.mark.parametrize("share", [0.5, 1e-3])
def test_the_same_model_is_found_inside(operator, initial, share):
    free = problem_of((), operator, initial)
    bound = share * total(free, free.start)
    problem = problem_of([weights_within(bound)], operator, initial)
    moved = costless(problem, problem.start)
    assert total(problem, moved) <= bound * (1 + 1e-5)
    assert problem.cost(moved) == pytest.approx(problem.cost(problem.start), rel=1e-6)
    np.testing.assert_allclose(problem.residual(moved), problem.residual(problem.start), atol=1e-5)


def test_states_may_turn_too():
    upper = Constraint(lambda p: p["C_y"][0, 0], upper=-1.0, name="first entry of C_y")
    problem = problem_of([upper, weights_within(0.01)])
    assert float(problem.constraint(problem.start)[0]) > -1.0
    moved = costless(problem, problem.start)
    g = problem.constraint(moved)
    assert g[0] <= -1.0 + 1e-5 and g[1] <= 0.01 + 1e-7
    assert problem.cost(moved) == pytest.approx(problem.cost(problem.start), rel=1e-4)


@pytest.mark.parametrize(
    "options",
    [
        {"constraints": [weights_within(100.0)]},  # met already
        {"constraints": [Constraint(lambda p: p["w"][0, 0] / p["w"][0, 1], upper=1e-3)]},  # no scale changes it
        {"constraints": [weights_within(0.01)], "fixed": ("D_yw", "D_zu")},  # which nothing takes up
        {"constraints": [weights_within(0.01)], "prior": 1e-3},  # B_w has its price
    ],
)
def test_a_start_stays_where_moving_is_no_use(options):
    problem = problem_of(**options)
    np.testing.assert_array_equal(costless(problem, problem.start), problem.start)


def test_a_fit_is_no_worse_under_a_constraint_that_costs_nothing():
    record = three_plays(0, 800)
    full = pilfr.fit(pilfr.PILFR(1, pilfr.PrandtlIshlinskii(Play, 6)), record, starts=1)
    for share in (0.5, 0.05, 0.005):
        bound = share * float(full.parameters["w"].sum())
        held = pilfr.fit(full, record, constraints=[weights_within(bound)])
        assert float(held.parameters["w"].sum()) <= bound * (1 + 1e-5)
        assert held.solution.cost <= full.solution.cost * (1 + 1e-3)
