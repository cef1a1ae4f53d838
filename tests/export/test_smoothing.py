"""Rounded steps are smooth, and their error is within the bound."""

import casadi as ca
import numpy as np
import pytest
from exported_fits import EVERY_LAW, lfr, mass_on_spring, one_sentence, wave, with_law
from hypothesis import given, settings, strategies as st

from pilfr_casadi import GeneralizedPlay, InputError, Play, Stop, exported
from pilfr_casadi.export import enclose, smooth_kinks
from pilfr_casadi.laws import StopHysteresis
from pilfr_casadi.models import fmin, generalized_play, play, stop

KINKS = ("FMAX", "FMIN", "FABS", "SIGN", "LT", "LE", "IF_ELSE_ZERO", "NOT", "FLOOR", "CEIL")
number = st.floats(-3, 3)
width = st.floats(0, 2)
eps = st.sampled_from([1e-6, 1e-3, 0.1, 1.0])


def kinks(function):
    """Operations of a function that have no derivative everywhere."""
    codes = {getattr(ca, f"OP_{k}"): k for k in KINKS}
    return [codes[i] for i in map(function.instruction_id, range(function.n_instructions())) if i in codes]


z, q, r = (ca.SX.sym(name) for name in "zqr")


def one(expression):
    return ca.Function("f", [ca.vertcat(z, q, r)], [expression], ["x"], ["y"])


PLAIN = {
    "play": (one(play(z, q, r)), 0.5),
    "stop": (one(stop(z, q, r)), 0.5),
    "generalized play": (one(generalized_play(z, q, r, lambda s: 2 * s - 1 + ca.tanh(s), lambda s: s + s**3 / 9)), 1.0),
    "max": (one(ca.fmax(z, q)), 0.5),
    "min": (one(fmin(z, q)), 0.5),
    "abs": (one(ca.fabs(z)), 0.5),
    "choice": (one(ca.if_else(z > 0, z, 0)), 0.5),
    "dead zone": (one(ca.fmax(z - r, 0) - ca.fmax(-z - r, 0)), 0.5),
}


@pytest.mark.parametrize("case", PLAIN)
@given(number, number, width, eps)
def test_one_operator_is_off_by_what_is_said(case, z, q, r, eps):
    exact, times = PLAIN[case]
    rounded, x = smooth_kinks(exact, eps), [z, q, r]
    assert not kinks(rounded)
    error = float(rounded(x)) - float(exact(x))
    ((low, high),) = enclose(exact, eps, [(v, v) for v in x])[0]
    assert abs(error) <= times * eps * (1 + 1e-9) + 1e-14
    assert low - 1e-12 <= float(rounded(x)) <= high + 1e-12 and low - 1e-12 <= float(exact(x)) <= high + 1e-12
    assert max(high - float(exact(x)), float(exact(x)) - low) <= times * eps * (1 + 1e-9) + 1e-12


@pytest.mark.parametrize("operator", [Play, Stop])
@given(st.integers(0, 10**6), eps)
@settings(max_examples=15)
def test_a_step_is_off_by_what_the_weights_say(operator, seed, eps):
    fitted, rng = lfr(operator, 3, 5, 2, 2, 2, seed % 7), np.random.default_rng(seed)
    exact, rounded = exported(fitted), exported(fitted, smooth=eps)
    x, u = 2 * rng.normal(size=13), 2 * rng.normal(size=2)
    states, outputs = rounded.bound(x, u)
    reach = np.sum(fitted.parameters["w"], axis=1) * eps / 2
    assert np.all(states[:3] <= np.abs(fitted.parameters["B_w"]) @ reach * (1 + 1e-6) + 1e-12)
    assert np.all(outputs <= np.abs(fitted.parameters["D_yw"]) @ reach * (1 + 1e-6) + 1e-12)
    assert np.all(states[3:] <= eps / 2 * (1 + 1e-6) + 1e-12)
    assert np.all(states[:3] >= 0.5 * np.abs(fitted.parameters["B_w"]) @ reach), "the bound is not idle"
    for found, true, bound in zip(rounded.step(x, u), exact.step(x, u), (states, outputs), strict=True):
        error = np.abs(np.asarray(found) - np.asarray(true)).ravel()
        assert np.all(error <= bound + 1e-12)
    assert exact.bound(x, u)[0] == pytest.approx(0, abs=1e-12)


def test_the_bound_is_reached_where_a_play_begins_to_slip():
    fitted = lfr(Play, 0, 1)
    x, u = np.zeros(1), fitted.parameters["r"][0] / fitted.parameters["D_zu"][0]
    error = exported(fitted, smooth=0.2).step(x, u)[0] - exported(fitted).step(x, u)[0]
    assert abs(float(error)) == pytest.approx(0.1, rel=0.2)


def test_a_generalized_play_and_many_steps():
    fitted, rng = lfr(GeneralizedPlay(2), 2, 3), np.random.default_rng(0)
    rounded, exact = exported(fitted, smooth=1e-3), exported(fitted)
    assert not kinks(rounded.step)
    for _ in range(20):
        x, u = rng.normal(size=5), rng.normal(size=1)
        bound = rounded.bound(x, u)
        assert np.all(bound[0][2:] <= 1e-3 * (1 + 1e-6))
        for found, true, limit in zip(rounded.step(x, u), exact.step(x, u), bound, strict=True):
            assert np.all(np.abs(np.asarray(found - true)).ravel() <= limit + 1e-12)


@pytest.mark.parametrize("kind", EVERY_LAW, ids=lambda kind: kind.__name__)
def test_every_law_can_be_smoothed(kind):
    given = {"dt": 0.02, "substeps": 2}
    exact, rounded = exported(with_law(kind), **given), exported(with_law(kind), **given, smooth=1e-4)
    assert not kinks(rounded.step)
    errors, x = [], exact.x0()
    for k, u in enumerate(wave(with_law(kind), 0.02, 3.0).u):
        following = exact.step(x, u)
        if k % 15 == 14:
            for found, true, limit in zip(rounded.step(x, u), following, rounded.bound(x, u), strict=True):
                assert np.all(np.abs(np.asarray(found - true)).ravel() <= limit + 1e-10)
                errors.append(np.max(limit))
        x = following[0]
    assert max(errors) < 0.1
    if not kinks(exact.step):
        assert max(errors) < 1e-9


def test_sub_steps_in_a_loop_are_smoothed_too():
    simulator = mass_on_spring().with_element("ground", StopHysteresis({"w": 5.0, "r": np.linspace(0.1, 0.6, 6)}))
    exact, rounded = (exported(simulator, dt=0.05, hold="linear", substeps=9, smooth=e) for e in (0.0, 1e-3))
    rng = np.random.default_rng(1)
    for _ in range(10):
        x, u = rng.normal(size=8), rng.normal(size=2)
        bound = rounded.bound(x, u)
        for found, true, limit in zip(rounded.step(x, u), exact.step(x, u), bound, strict=True):
            error = np.abs(np.asarray(found - true)).ravel()
            assert np.all(error <= limit + 1e-12)
        assert 0 < bound[0][1] < 0.1


def test_what_nothing_is_known_of():
    known = ca.Function("f", [z], [ca.tan(z)], ["x"], ["y"])
    with pytest.raises(InputError, match="'tan'") as error:
        enclose(known, 0.1, [(0.1, 0.1)])
    one_sentence(error)


@given(number, number, eps)
def test_other_operations_are_enclosed(a, b, eps):
    """For any operation on a rounded value, the enclosure holds the rounded and the exact result."""
    c = ca.fmax(z, q)
    expressions = [
        ca.sin(c), ca.cos(c), ca.exp(c), ca.tanh(c), c**2, c**3, c**-1, 1 / (5 + c), c * z - q * c, ca.sqrt(c + 4),
        (ca.fabs(z) + 0.1) ** (1.5 + 0.1 * c), ca.cosh(c), ca.atan(c), ca.log(c + 4), ca.sign(c) * ca.fabs(c) ** 1.5,
        ca.if_else(ca.logic_and(c > 0.5, q < 1), c, 2), ca.if_else(c == z, 1, 0), ca.acos(c / 4), 2 * c,
    ]  # fmt: skip
    f = ca.Function("f", [ca.vertcat(z, q)], [ca.vertcat(*expressions)], ["x"], ["y"])
    ends = np.array(enclose(f, eps, [(a, a), (b, b)])[0])
    for values in (f([a, b]), smooth_kinks(f, eps)([a, b])):
        v = np.asarray(values).ravel()
        size = 1e-9 * (1 + np.abs(v))
        assert np.all((ends[:, 0] - size <= v) | np.isnan(v)) and np.all((v <= ends[:, 1] + size) | np.isnan(v))
