"""The periodic steady state: a fixed point, its slope, and memory that a period does not determine."""

import numpy as np
import pytest
from random_models import random_input, random_lfr

from pilfr_casadi._base import InputError
from pilfr_casadi.data import Recording
from pilfr_casadi.engine import make_engine
from pilfr_casadi.identify import fit
from pilfr_casadi.models import PILFR, Play, PrandtlIshlinskii, Stop
from pilfr_casadi.optimise import Problem
from pilfr_casadi.optimise.steady_state import steady_slope


def steady(seed=0, length=80, **options):
    u, y = random_input(seed, length, 1), random_input([seed, 1], length, 1)
    return Recording(u, y, 0.1, **{"period": 40, "initial": "periodic", **options})


@pytest.mark.parametrize("operator", [Play, Stop])
def test_many_periods_lead_to_the_fixed_point(operator):
    structure, values = random_lfr(0, operator=operator)
    model, records = structure.model(1, 1, values), [steady(0), steady(1, skip=10)]
    before = [[np.tile(x[:40], (60, 1)) for x in (r.u, r.y)] for r in records]
    led = [
        Recording(np.vstack([u, r.u]), np.vstack([y, r.y]), 0.1, initial="zero", skip=2400 + r.skip)
        for r, (u, y) in zip(records, before, strict=True)
    ]
    exact, warm = (Problem(model, given, engine="vm") for given in (records, led))
    theta = exact.start + 1e-3 * np.random.default_rng(1).normal(size=exact.size)
    theta = np.clip(theta, exact.lower, exact.upper)
    for a, (u, _), zero in zip(exact.first_states(theta), before, warm.first_states(theta), strict=True):
        b = warm.engine.simulate(u, warm.parameters(theta), zero)[1]
        np.testing.assert_allclose(a, b, atol=1e-8)
    for a, b in zip(exact.normal(theta), warm.normal(theta), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-7 * np.max(np.abs(b)))
    jac = exact.jacobian(theta)
    np.testing.assert_allclose(jac, warm.jacobian(theta), atol=1e-7 * np.max(np.abs(jac)))
    np.testing.assert_allclose(jac.T @ jac / exact.residuals, exact.normal(theta)[2], atol=1e-12 * np.max(jac**2))


def test_memory_that_never_moves_has_no_slope():
    after = np.array([[1.0, 2.0, 0.5, 0.0], [0.0, 0.0, 0.0, 1.0]])
    np.testing.assert_allclose(steady_slope(after, 2), [[2.0, 4.0], [0.0, 0.0]])


def test_weights_scale_residuals_and_threads_change_nothing():
    structure, values = random_lfr(0)
    model, records = structure.model(1, 1, values), [steady(0), steady(1), steady(2, initial="zero")]
    plain, weighted = (Problem(model, records, weights=w) for w in (None, [1.0, 3.0, 0.5]))
    weighted.threads = 2
    e, f = (p.residual(p.start).reshape(3, -1) for p in (plain, weighted))
    np.testing.assert_allclose(f, e * np.array([[1.0], [3.0], [0.5]]), atol=1e-14)
    again = Problem(model, records, weights=[1.0, 3.0, 0.5])
    for a, b in zip(weighted.normal(weighted.start), again.normal(again.start), strict=True):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(InputError, match="2 weights"):
        Problem(model, records, weights=[1.0, 1.0])


@pytest.mark.parametrize("pole", [0.999, 0.9999, 0.99999, -0.9999])
def test_slow_poles_settle(pole):
    """The periodic state in closed form: `x = (1 - a^N)^-1 Σ a^(N-1-k) (1 - a) u_k`."""
    n = 256
    u = np.random.default_rng(0).normal(size=n) + 1
    forced = 0.0
    for v in u:
        forced = pole * forced + (1 - pole) * v
    x, y = forced / (1 - pole**n), []
    for v in u:
        y.append(x + 0.01 * v)
        x = pole * x + (1 - pole) * v
    model = PILFR(1, offset=False).model(1, 1, {"A": [[pole]], "B_u": [[1 - pole]], "C_y": [[1.0]], "D_yu": [[0.01]]})
    problem = Problem(model, [Recording(np.tile(u, 2), np.tile(y, 2), 0.1, period=n, initial="periodic")])
    assert problem.cost(problem.start) < 1e-16
    theta, h = problem.start + 1e-7, np.array([1e-9, 0, 0, 0])
    slope = (problem.residual(theta + h) - problem.residual(theta - h)) / 2e-9
    np.testing.assert_allclose(problem.jacobian(theta)[:, 0], slope, rtol=1e-4, atol=1e-4 * np.abs(slope).max())


def test_without_a_steady_state_the_cost_is_infinite():
    u = np.random.default_rng(0).normal(size=64) + 1
    model = PILFR(1, offset=False).model(1, 1, {"A": [[1.0]], "B_u": [[1.0]], "C_y": [[1.0]], "D_yu": [[0.0]]})
    problem = Problem(model, [Recording(np.tile(u, 2), np.tile(u, 2), 0.1, period=64, initial="periodic")])
    assert problem.cost(problem.start) == np.inf


@pytest.mark.parametrize("weight, width, resting", [(0.5, 5.0, 1), (0.5, 0.3, 0), (0.0, 5.0, 0)])
def test_memory_that_a_period_does_not_determine_is_reported(weight, width, resting):
    """A wide play that never slips may rest anywhere; this matters only if it has a weight."""
    u = np.tile(np.sin(2 * np.pi * np.arange(100) / 100), 2)
    values = {"D_zu": [[1.0]], "D_yw": [[1.0]], "r": [[0.1, width]], "w": [[1.0, weight]]}
    model = PILFR(0, PrandtlIshlinskii(Play, 2), offset=False).model(1, 1, values)
    held = {k: {"fixed": True} for k in model.parameters if k != "D_yu"}
    y = make_engine(model, "vm").simulate(u[:, None], model.parameters.start, np.zeros(2))[0]
    record = Recording(u, y + 0.1 * u[:, None], 0.1, period=100, initial="periodic", name="sine")
    held = model.with_parameters(model.parameters.change(**held))
    found = fit(held, record)
    assert ("never slip in a steady period: 1 in recording 'sine'" in str(found)) == bool(resting)
    assert "never slip" not in str(fit(held, record.with_(initial="zero")))
    state = found.initial_state(record)
    if resting:  # with another memory there is another steady state, of another mean
        shifted = [found.simulate(record.with_(initial=state + np.array([0.0, q]))) for q in (0.0, 2.0)]
        np.testing.assert_allclose(shifted[1] - shifted[0], 2.0 * weight, rtol=1e-9)
