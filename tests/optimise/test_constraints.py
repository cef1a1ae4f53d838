"""Constraints: the bound on the spectral radius holds exactly; user-defined expressions."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, given, strategies as st
from hypothesis.extra import numpy as hnp

from pilfr_casadi._base import InputError
from pilfr_casadi.data import Recording
from pilfr_casadi.models import PILFR, Parameter, ParameterSet
from pilfr_casadi.optimise import Constraint, Problem, stable
from pilfr_casadi.optimise.constraints import SLACK, Rows, log_norm_of_power

matrices = st.integers(1, 5).flatmap(lambda n: hnp.arrays(float, (n, n), elements=st.floats(-2, 2, width=32)))


def log_radius(matrix):
    return np.log(max(np.max(np.abs(np.linalg.eigvals(matrix))), 1e-300))


@given(matrices, st.integers(0, 20))
def test_the_bound_is_never_below_the_spectral_radius(matrix, squarings):
    radius = np.max(np.abs(np.linalg.eigvals(matrix)))
    assume(radius > 1e-3)  # the eigenvalues of nearly nilpotent matrices are not known to rounding
    assert float(log_norm_of_power(ca.DM(matrix), squarings)) >= np.log(radius) - 1e-6


@given(st.integers(0, 10**6), st.integers(1, 8), st.floats(0.5, 1.5))
def test_exactly_known_spectra(seed, n, radius):
    """Orthogonal matrices times a radius, sheared: ρ is known to rounding, and the bound holds to rounding."""
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(n, n)))
    shear = np.eye(n) + np.triu(rng.normal(size=(n, n)), 1)
    matrix = radius * np.linalg.solve(shear, q @ shear)
    for squarings in (0, 4, 12, 20):
        assert float(log_norm_of_power(ca.DM(matrix), squarings)) >= np.log(radius) - 1e-12
    assert float(log_norm_of_power(ca.DM(matrix), 20)) <= np.log(radius) + 1e-4


@given(st.integers(0, 10**6), st.integers(1, 8))
def test_the_bound_is_tight(seed, n):
    matrix = np.random.default_rng(seed).normal(size=(n, n))
    gap = float(log_norm_of_power(ca.DM(matrix))) - log_radius(matrix)
    assert -1e-9 <= gap < 1e-3
    rough = [float(log_norm_of_power(ca.DM(matrix), k)) for k in (0, 3, 6, 12, 20)]
    assert np.all(np.diff(rough) <= 1e-12)  # more squarings, tighter


@pytest.mark.parametrize(
    "matrix", [np.zeros((3, 3)), np.triu(np.ones((3, 3)), 1), 1e150 * np.eye(2), 1e-100 * np.eye(2)]
)
def test_extreme_matrices_stay_in_range(matrix):
    x = ca.SX.sym("A", *matrix.shape)
    f = ca.Function("f", [x], [log_norm_of_power(x), ca.jacobian(log_norm_of_power(x), ca.vec(x))])
    value, slope = f(matrix)
    assert np.isfinite(float(value))
    assert float(value) >= log_radius(matrix) - 1e-9
    assert np.all(np.isfinite(np.asarray(slope)))


@given(st.integers(0, 10**6), st.integers(1, 5))
def test_gradient(seed, n):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(n, n))
    matrix /= np.max(np.abs(np.linalg.eigvals(matrix)))
    vector = ca.MX.sym("p", n * n)
    expression = log_norm_of_power(ca.reshape(vector, n, n), 6)
    f = ca.Function("f", [vector], [expression])
    slope = ca.Function("slope", [vector], [ca.jacobian(expression, vector)])
    at, h = matrix.ravel(order="F"), 1e-6
    central = [(float(f(at + h * e)) - float(f(at - h * e))) / (2 * h) for e in np.eye(n * n)]
    np.testing.assert_allclose(np.asarray(slope(at)).ravel(), central, rtol=1e-4, atol=1e-6)


def system():
    return ParameterSet({"A": Parameter([[0.5, 0.2], [0.0, 0.9]]), "gain": Parameter(2.0)})


def test_stable_bounds_any_square_expression():
    rows = Rows((stable(0.95), stable(1.0, lambda p: p["A"] * p["gain"], name="closed loop")), system())
    np.testing.assert_allclose(np.exp(rows.values(system().start)), [0.9, 1.8], rtol=1e-4)
    np.testing.assert_allclose(rows.upper, [np.log(0.95 * (1 + SLACK)), np.log(1 + SLACK)])
    assert np.all(np.isinf(rows.lower))
    assert rows.labels == ("spectral radius <= 0.95", "closed loop <= 1")
    assert rows.slope(system().start).shape == (2, 5)


def test_own_expressions_of_named_parameters():
    mine = Constraint(lambda p: ca.vertcat(p["A"][0, 1] * p["gain"], ca.trace(p["A"])), [-1.0, 0.0], [1.0, 2.0], "mine")
    tied = Constraint(lambda p: p["gain"] - 2, 0.0, 0.0)
    rows = Rows((mine, tied), system())
    np.testing.assert_allclose(rows.values(system().start), [0.4, 1.4, 0.0])
    assert rows.labels == ("mine[0]", "mine[1]", "constraint")
    assert rows.lower.tolist() == [-1, 0, 0]
    assert rows.upper.tolist() == [1, 2, 0]
    expected = [[0, 0, 2.0, 0, 0.2], [1, 0, 0, 1, 0], [0, 0, 0, 0, 1]]
    np.testing.assert_allclose(rows.slope(system().start), expected)


def test_no_constraints():
    rows, start = Rows((), system()), system().start
    assert rows.values(start).size == rows.slope(start).size == rows.lower.size == len(rows.labels) == 0


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: Rows((Constraint(lambda p: p["gain"], unit=0.0),), system()), "unit of the constraint"),
        (lambda: stable(0.0), "bound of 0.0 on the spectral radius was given; give a number above zero"),
        (
            lambda: Rows((Constraint(lambda p: p["mass"], name="m"),), system()),
            "'m' reads a parameter 'mass'",
        ),
        (lambda: Rows((Constraint(lambda p: p["gain"], 2.0, 1.0),), system()), "infeasible"),
        (lambda: Rows((Constraint(lambda p: p["gain"], upper=np.nan),), system()), "infeasible"),
        (
            lambda: Rows((Constraint(lambda p: p["A"], [0.0, 1.0]),), system()),
            "do not fit its 4 entries",
        ),
    ],
)
def test_invalid_constraints_are_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()


@pytest.mark.parametrize(
    "expression, words",
    [
        (lambda p: p["gain"] if p["A"][0, 0] > 0 else p["A"], "cannot be formed"),
        (lambda p: max(p["gain"], 1.0), "cannot be used on symbols"),
        (lambda p: None, "cannot be formed"),
        (lambda p: p["A"][5, 5], "cannot be formed"),
    ],
)
def test_invalid_expressions_are_refused_in_one_sentence(expression, words):
    with pytest.raises(InputError, match=words) as refused:
        Rows((Constraint(expression, upper=1.0, name="mine"),), system())
    assert "'mine'" in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "expression, words",
    [
        (lambda p: ca.log(-p["D_yu"] - 1), "no finite value"),
        (lambda p: p["y_0"] / 0, "no finite value"),
        (lambda p: ca.sqrt(p["y_0"]), "no finite slope"),
    ],
)
def test_constraints_without_a_finite_start_are_refused_in_one_sentence(expression, words):
    model = PILFR(1).model(1, 1, {"A": 0.5, "B_u": 1.0, "C_y": 1.0, "D_yu": 0.1})
    record = Recording(np.ones(20), np.ones(20), dt=0.1, initial="zero")
    with pytest.raises(InputError, match=words) as refused:
        Problem(model, record, constraints=(Constraint(expression, upper=1.0, name="mine"),), engine="vm")
    assert "'mine'" in str(refused.value) and "\n" not in str(refused.value)
