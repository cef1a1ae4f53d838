"""Calls through buffers equal calls of CasADi, also for more points than a block and for none."""

import casadi as ca
import numpy as np
import pytest

from pilfr_casadi.models import Buffered, accumulate_steps, map_points
from pilfr_casadi.models.model import BLOCK


@pytest.fixture(scope="module")
def parts():
    x, u, p = ca.SX.sym("x", 3), ca.SX.sym("u"), ca.SX.sym("p", 2)
    blocks = [ca.densify(ca.jacobian(ca.sin(x) * p[0] + u, x)), ca.vertcat(x[0] * p[1], u)]
    step = ca.Function("step", [x, u, p], [0.5 * ca.sin(x) * p[0] + u, x[1] + u])
    return ca.Function("blocks", [x, u, p], blocks), step


@pytest.mark.parametrize("count", [1, BLOCK - 1, BLOCK, 3 * BLOCK + 7])
def test_every_point(parts, count):
    rng = np.random.default_rng(0)
    x, u, p = rng.normal(size=(count, 3)), rng.normal(size=(count, 1)), np.array([0.7, -2.0])
    found = map_points(parts[0], x, u, p)
    assert [a.shape for a in found] == [(count, 3, 3), (count, 2, 1)]
    for k in (0, count // 2, count - 1):
        for a, expected in zip(found, parts[0](x[k], u[k], p), strict=True):
            assert np.array_equal(a[k], np.asarray(expected))


@pytest.mark.parametrize("count", [1, BLOCK, 2 * BLOCK + 5])
def test_every_step(parts, count):
    rng = np.random.default_rng(1)
    state, u, p = rng.normal(size=3), rng.normal(size=(count, 1)), np.tile([0.7, -2.0], (count, 1))
    states, seen = accumulate_steps(parts[1], state, u, p)
    for k in range(count):
        state, y = (np.asarray(v).ravel() for v in parts[1](state, u[k], p[k]))
        assert np.array_equal(states[k], state) and np.array_equal(seen[k], y)


def test_without_states():
    x, u = ca.SX.sym("x", 0), ca.SX.sym("u")
    step = ca.Function("static", [x, u], [x, 2 * u])
    u = np.arange(5.0)[:, None]
    assert np.array_equal(map_points(step, np.zeros((5, 0)), u)[1][:, :, 0], 2 * u)
    assert np.array_equal(accumulate_steps(step, np.zeros(0), u)[1], 2 * u)


def test_entries_that_a_function_does_not_store_are_zero():
    """A buffer would keep what the memory held before."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    sparse = ca.vertcat(ca.SX(1, 1), u, ca.SX(1, 1))
    function = ca.Function("sparse", [x, u], [x + u, sparse, ca.SX(2, 1)])
    u_at = np.arange(1.0, 100.0)[:, None]
    expected = np.column_stack([0 * u_at, u_at, 0 * u_at])
    _, some, none = map_points(function, np.zeros((99, 2)), u_at)
    assert np.array_equal(some[:, :, 0], expected) and not none.any()
    _, some, none = accumulate_steps(function, np.zeros(2), u_at)
    assert np.array_equal(some, expected) and not none.any()
    _, some, none = Buffered(function)(np.zeros(2), np.array([3.0]))
    assert np.array_equal(some, [0, 3, 0]) and not none.any()
