"""Steps with the sides of every kink held: the step itself where they are its own, and affine where that is."""

import casadi as ca
import numpy as np
from hypothesis import given, settings, strategies as st

from pilfr_casadi.export import with_sides

seeds = st.integers(0, 2**32 - 1)


def kinked():
    """A play, a stop, a choice and an absolute value around a linear state."""
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u", 2)
    play, stop = ca.fmin(u[0] + 0.5, ca.fmax(u[0] - 0.5, x[1])), ca.fmax(-0.3, ca.fmin(0.3, x[2] + u[1]))
    chosen = ca.if_else(x[0] > u[0], x[0], u[0])
    following = ca.vertcat(0.7 * x[0] + play - ca.fabs(u[1] - x[0]), play, stop)
    return ca.Function("F", [x, u], [following, ca.vertcat(x[0] + 0.2 * stop, chosen)])


@given(seeds)
@settings(max_examples=40)
def test_held_sides_are_the_step_itself_on_its_own_sides(seed):
    rng = np.random.default_rng(seed)
    function, held, free = kinked(), with_sides(kinked(), held=True), with_sides(kinked(), held=False)
    assert held.size1_in(2) == held.size1_out(2) == free.size1_out(2) == 6
    x, u = rng.standard_normal(3), rng.standard_normal(2)
    *there, gaps = (np.asarray(v).ravel() for v in free(x, u, 0))
    own = (gaps >= 0).astype(float)
    for found, wanted in zip(held(x, u, own), (*function(x, u), gaps), strict=True):
        np.testing.assert_allclose(np.asarray(found).ravel(), np.asarray(wanted).ravel(), atol=1e-12)
    for found, wanted in zip(there, function(x, u), strict=True):
        np.testing.assert_allclose(found, np.asarray(wanted).ravel(), atol=1e-12)
    one, two = rng.standard_normal((2, 5))
    ends = [
        np.concatenate([np.asarray(v).ravel() for v in held(p[:3], p[3:], own)]) for p in (one, two, one + two, 0 * one)
    ]
    np.testing.assert_allclose(ends[2] + ends[3], ends[0] + ends[1], atol=1e-12)


def test_a_step_without_kinks_has_no_sides():
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    held = with_sides(ca.Function("F", [x, u], [ca.tanh(x) + u, x]), held=True)
    assert held.size1_in(2) == 0 and held.size1_out(2) == 0
