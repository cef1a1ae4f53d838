"""Stop, play and generalized play: defining properties, the paper's forms with its slips, and derivatives."""

import functools
import itertools

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, given, strategies as st

from pilfr_casadi._base import InputError
from pilfr_casadi.models import GeneralizedPlay, Play, Stop, generalized_play, play, stop
from pilfr_casadi.models.operators import fmax, fmin

numbers = st.floats(-5.0, 5.0, allow_subnormal=False)
thresholds = st.floats(0.0, 3.0, allow_subnormal=False)
paths = st.lists(numbers, min_size=1, max_size=15)
ULP = 4 * np.spacing(20.0)  # a few roundings of numbers below 20


def gamma_l(z):
    return z / 2 + (z / 4) ** 3


def gamma_r(z):
    return z / 2 + (z / 4) ** 3 - 0.1


def run(operator, path, q, r):
    """Outputs and play states along a path; `operator` is one of Play, Stop or the generalized play of Fig. 3."""
    outputs, states = [], []
    for z in path:
        if operator is Stop:
            v, q = Stop().step(z, q, r, {})
        elif operator is Play:
            v, q = Play().step(z, q, r, {})
        else:
            v = q = generalized_play(z, q, r, gamma_l, gamma_r)
        outputs.append(float(v))
        states.append(float(q))
    return np.array(outputs), np.array(states)


every_operator = pytest.mark.parametrize("operator", [Play, Stop, GeneralizedPlay])


# ---- properties of hysteresis operators ----


@given(paths, numbers, thresholds)
def test_play_plus_stop_is_the_input(path, q, r):
    v, memory = run(Play, path, q, r)
    s, same_memory = run(Stop, path, q, r)
    assert np.max(np.abs(v + s - path)) <= ULP  # Eq. 8
    assert np.max(np.abs(memory - same_memory)) <= ULP  # one number of memory, the same for both


@given(paths, numbers, thresholds)
def test_outputs_stay_within_their_bounds(path, q, r):
    s, _ = run(Stop, path, q, r)
    v, _ = run(Play, path, q, r)
    assert np.max(np.abs(s)) <= r
    assert np.max(np.abs(v - path)) <= r + ULP


@given(st.lists(st.tuples(numbers, numbers), min_size=1, max_size=15), numbers, thresholds)
def test_lipschitz_in_the_sup_norm(pairs, q, r):
    a, b = np.array(pairs).T
    apart = np.max(np.abs(a - b))
    assert np.max(np.abs(run(Play, a, q, r)[0] - run(Play, b, q, r)[0])) <= apart + ULP
    # the stop is the input less the play: 2, and not less (see below)
    assert np.max(np.abs(run(Stop, a, q, r)[0] - run(Stop, b, q, r)[0])) <= 2 * apart + ULP
    slope = 0.5 + 3 * 25.0 / 64.0  # of the envelopes, at most, over [-5, 5]
    difference = run(GeneralizedPlay, a, q, r)[0] - run(GeneralizedPlay, b, q, r)[0]
    assert np.max(np.abs(difference)) <= slope * apart + ULP


def test_the_stop_reaches_its_lipschitz_constant_2():
    a, b = [2.0, 0.0], [1.0, 1.0]
    assert run(Stop, a, 0.0, 1.0)[0][-1] - run(Stop, b, 0.0, 1.0)[0][-1] == -2.0 * np.max(np.abs(np.subtract(a, b)))


@given(numbers, numbers, numbers, thresholds)
def test_two_memories_never_move_apart(z, q1, q2, r):
    for step in (lambda q: play(z, q, r), lambda q: generalized_play(z, q, r, gamma_l, gamma_r)):
        assert abs(step(q1) - step(q2)) <= abs(q1 - q2) + ULP


@every_operator
@given(path=paths, q=numbers, r=thresholds, more=st.lists(st.floats(0.0, 1.0), max_size=4), repeats=st.integers(1, 3))
def test_rate_independence(operator, path, q, r, more, repeats):
    slow = [path[0]] * repeats
    arrivals = [repeats - 1]
    for a, b in itertools.pairwise(path):
        between = [a + (b - a) * share for share in sorted(more)]
        slow += [min(max(z, min(a, b)), max(a, b)) for z in between] + [b] * repeats
        arrivals.append(len(slow) - 1)
    fast_output, fast_state = run(operator, path, q, r)
    slow_output, slow_state = run(operator, slow, q, r)
    assert np.max(np.abs(slow_output[arrivals] - fast_output)) <= ULP
    assert np.max(np.abs(slow_state[arrivals] - fast_state)) <= ULP


@every_operator
@given(
    path=paths,
    q=numbers,
    r=thresholds,
    a=numbers,
    b=numbers,
    inner=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=8),
)
def test_wiping_out(operator, path, q, r, a, b, inner):
    """Madelung: at the end of a branch, a loop inside it is forgotten."""
    excursion = [min(max(a + (b - a) * share, min(a, b)), max(a, b)) for share in inner]
    before = run(operator, [*path, a, b], q, r)
    after = run(operator, [*path, a, b, *excursion, b], q, r)
    assert abs(before[0][-1] - after[0][-1]) <= ULP
    assert abs(before[1][-1] - after[1][-1]) <= ULP


layers = st.lists(st.tuples(st.floats(0.0, 2.0), thresholds), min_size=1, max_size=6)


def layer(operator, path, memory, operators):
    """Output of a Prandtl-Ishlinskii layer along a path, one memory for each (weight, threshold)."""
    return sum(w * run(operator, path, q, r)[0] for (w, r), q in zip(operators, memory, strict=True))


@pytest.mark.parametrize("operator", [Play, Stop])
@given(layers, paths, paths, numbers, numbers, st.lists(st.floats(0.0, 1.0), min_size=1, max_size=5))
def test_minor_loops_are_congruent(operator, operators, history_1, history_2, c, d, shares):
    up = [c + (d - c) * share for share in sorted(shares)]
    cycle = [*up, d, *reversed(up), c]
    memory = np.zeros(len(operators))
    loops = [layer(operator, [*h, *cycle, *cycle], memory, operators)[-len(cycle) :] for h in (history_1, history_2)]
    gap = loops[0] - loops[1]
    assert np.ptp(gap) <= 50 * ULP  # the loops differ by a constant


@given(layers, st.floats(0.1, 5.0), st.lists(st.floats(0.0, 1.0), min_size=1, max_size=8))
def test_masing_doubling(operators, top, shares):
    """Branches of stops are the virgin curve f doubled: F = f(top) - 2 f((top - z) / 2)."""
    memory = np.zeros(len(operators))

    def virgin(z):
        return sum(w * min(r, z) for w, r in operators)

    down = top - 2 * top * np.sort(shares)
    branch = layer(Stop, [top, *down], memory, operators)[1:]
    expected = [virgin(top) - 2 * virgin((top - z) / 2) for z in down]
    np.testing.assert_allclose(branch, expected, atol=50 * ULP)


# ---- the generalized play ----


@given(paths, numbers, thresholds)
def test_identity_envelopes_give_the_play(path, q, r):
    expected, _ = run(Play, path, q, r)
    for z, v in zip(path, expected, strict=True):
        q = generalized_play(z, q, r, lambda s: s, lambda s: s)
        assert q == v


@given(numbers, numbers, numbers, thresholds, st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))
def test_crossing_envelopes_are_well_posed(z, q, other, r, left, right):
    def low(s):
        return np.tanh(s) + left

    def high(s):
        return s / 3 + right

    v = generalized_play(z, q, r, low, high)
    bottom, top = low(z) - r, max(high(z) + r, low(z) - r)
    assert v == max(bottom, min(top, q)) == min(top, max(bottom, q))  # the order does not matter
    assert bottom <= v <= top
    if low(z) - r <= high(z) + r:
        assert v == max(low(z) - r, min(high(z) + r, q))  # Eq. 7 wherever it is a play
    # monotone in the memory and in the input
    assert (generalized_play(z, other, r, low, high) - v) * (other - q) >= 0
    assert (generalized_play(other, q, r, low, high) - v) * (other - z) >= -ULP


def test_networks_are_monotone_envelopes():
    element = GeneralizedPlay(neurons=4)
    p = {k: np.array(v.value) for k, v in element.parameters(2).items()}
    rng = np.random.default_rng(0)
    for name, value in p.items():
        p[name] = value + rng.uniform(0, 1, value.shape)
    z = np.linspace(-4, 4, 200)
    for side in ("l", "r"):
        for channel in (0, 1):
            assert np.all(np.diff(element.envelope(side, z, p, channel)) > 0)


def test_user_defined_envelopes_read_named_parameters():
    element = GeneralizedPlay(gamma_l=lambda z, p: p["slope"] * z, gamma_r=lambda z, p: p["slope"] * z)
    v, q = element.step(2.0, 0.0, 0.5, {"slope": 3.0})
    assert v == q == 5.5
    assert not any(name.startswith("gamma") for name in element.parameters(1))


def test_a_network_needs_a_whole_number_of_neurons():
    for wrong in (-1, 2.5, np.inf, "3", None):
        with pytest.raises(InputError, match=f"An envelope has {wrong!r} neurons; give a whole number"):
            GeneralizedPlay(neurons=wrong)


# ---- the paper's forms and its slips (errata) ----


def relu(x):
    return max(x, 0.0)  # Eq. 12


def sslu(x):
    return 1.0 if x >= 1 else -1.0 if x <= -1 else x  # Eq. 10


positive = st.floats(1e-3, 3.0)


@given(paths, numbers, positive)
def test_eq_9_and_10_are_the_stop(path, q, r):
    expected, _ = run(Stop, path, q, r)
    u_before, y = 0.0, -q  # Eq. 4 has u(-1) and y_0; the memory is their difference
    for u, s in zip(path, expected, strict=True):
        y = r * sslu((u - u_before + y) / r)
        u_before = u
        assert abs(y - s) <= 20 * ULP


def test_eq_9_as_printed_is_not_defined_at_zero_threshold():
    with pytest.raises(ZeroDivisionError):
        0.0 * sslu((1.0 - 0.0 + 0.0) / 0.0)
    assert stop(1.0, 0.0, 0.0) == 0.0
    r = ca.SX.sym("r")
    slope = ca.Function("slope", [r], [ca.jacobian(stop(1.0, 0.0, r), r)])
    assert float(slope(0.0)) == 1.0


@given(paths, numbers, thresholds)
def test_eq_11_is_the_play(path, q, r):
    expected, _ = run(Play, path, q, r)
    y = q
    for u, v in zip(path, expected, strict=True):
        s_1, s_2 = relu(u - y + r), relu(u - y - r)
        y = u - s_1 + s_2 + r
        assert abs(y - v) <= 20 * ULP


def test_a_1_as_printed_looks_one_sample_too_far_back():
    path, r = [2.0, 2.0], 0.5  # an input at rest
    expected, _ = run(Play, path, 0.0, r)
    right, printed = [0.0, 0.0], [0.0, 0.0]
    for u in path:
        right.append(u + relu(u - right[-1] - r) - relu(u - right[-1] + r) + r)
        printed.append(u + relu(u - printed[-2] - r) - relu(u - printed[-1] + r) + r)  # s_2 with y(k-2)
    assert right[2:] == expected.tolist() == [1.5, 1.5]
    assert printed[2:] == [1.5, 3.0]


@given(paths, numbers, st.floats(0.1, 3.0))
def test_eq_13_is_the_generalized_play(path, q, r):
    expected, _ = run(GeneralizedPlay, path, q, r)
    y = q
    for u, v in zip(path, expected, strict=True):
        s = gamma_r(u) + r - relu(gamma_r(u) + r - y)
        y = gamma_l(u) - r + relu(-gamma_l(u) + r + s)
        assert abs(y - v) <= 20 * ULP


@given(numbers, numbers, numbers, thresholds)
def test_eq_4_begins_the_stop(u, u_before, y_0, r):
    expected = min(r, max(-r, u - u_before + y_0))
    assert abs(stop(u, u_before - y_0, r) - expected) <= ULP


def test_eq_4_as_printed_leaves_the_threshold():
    r, u, u_before, y_0 = 0.5, 3.0, 0.0, 0.0
    printed = max(r, max(-r, u - u_before + y_0))
    assert printed > r  # Eq. 3 bounds the output by r
    assert stop(u, u_before - y_0, r) == r


@given(numbers, numbers, thresholds)
def test_eq_6_begins_the_play(u, y_0, r):
    assert play(u, y_0, r) == max(u - r, min(u + r, y_0))


def test_eq_7_needs_more_than_ordered_envelopes():
    """Neither γ_l ≥ γ_r (text) nor γ_l < γ_r (appendix) is the condition: it is γ_l - r ≤ γ_r + r."""
    z, q, r = 1.0, 0.0, 0.5

    def printed(left, right):
        return max(left - r, min(right + r, q)), min(right + r, max(left - r, q))

    both_ways = printed(3.0, 1.0)  # γ_l ≥ γ_r as in the text, but too far
    assert both_ways[0] != both_ways[1]
    v = generalized_play(z, q, r, lambda s: 3.0 * s, lambda s: 1.0 * s)
    assert v == 2.5
    for left, right in ((1.0, 0.5), (0.5, 1.0)):  # either order is fine within the condition
        a, b = printed(left, right)
        assert a == b == generalized_play(z, q, r, lambda s, k=left: k * s, lambda s, k=right: k * s)


# ---- derivatives ----


FUNCTIONS = {
    "play": play,
    "stop": stop,
    "generalized": lambda z, q, r: generalized_play(z, q, r, gamma_l, gamma_r),
}


@functools.cache
def slope_of(name):
    symbols = [ca.SX.sym(letter) for letter in "zqr"]
    return ca.Function("slope", symbols, [ca.densify(ca.jacobian(FUNCTIONS[name](*symbols), ca.vertcat(*symbols)))])


def derivative(name, at):
    """∂v/∂(z, q, r) of an operator by CasADi at a point."""
    return np.asarray(slope_of(name)(*at)).ravel()


@pytest.mark.parametrize("name", FUNCTIONS)
@given(z=numbers, q=numbers, r=st.floats(0.01, 3.0))
def test_derivatives_away_from_kinks(name, z, q, r):
    function, h = FUNCTIONS[name], 1e-6
    edges = (z - r - q, z + r - q) if name != "generalized" else (gamma_l(z) - r - q, gamma_r(z) + r - q)
    assume(min(abs(e) for e in edges) > 1e-4)
    assume(abs(gamma_l(z) - gamma_r(z) - 2 * r) > 1e-4)
    at = np.array([z, q, r])
    central = [(function(*(at + h * e)) - function(*(at - h * e))) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(derivative(name, at), central, atol=1e-8)


@given(numbers, st.sampled_from([0.25, 0.5, 1.0]))
def test_at_a_kink_the_operator_sticks(z, r):
    z = np.round(4 * z) / 4  # sums below are exact, so the kink is met
    for edge in (z - r, z + r):
        np.testing.assert_array_equal(derivative("play", (z, edge, r)), [0.0, 1.0, 0.0])
        np.testing.assert_array_equal(derivative("stop", (z, edge, r)), [1.0, -1.0, 0.0])


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_at_zero_threshold_the_derivative_is_one_sided(side):
    """Fits reach the bound r = 0 exactly; the derivative there must be the one-sided one, not half of it."""
    z, q = 0.75, 0.75 + side * 0.5
    np.testing.assert_array_equal(derivative("play", (z, q, 0.0)), [1.0, 0.0, side])
    np.testing.assert_array_equal(derivative("stop", (z, q, 0.0)), [0.0, 0.0, -side])
    h = 1e-3
    assert (play(z, q, h) - play(z, q, 0.0)) / h == pytest.approx(side)
    assert (stop(z, q, h) - stop(z, q, 0.0)) / h == pytest.approx(-side)


# ---- one function for numbers and symbols ----


@pytest.mark.parametrize("name", FUNCTIONS)
@given(st.lists(st.tuples(numbers, numbers, thresholds), min_size=1, max_size=6), st.sampled_from([0.0, 0.1, 1.0]))
def test_numbers_arrays_and_symbols_agree(name, rows, eps):
    def evaluate(*args):
        if name == "generalized":
            return generalized_play(*args, gamma_l, gamma_r, eps)
        return FUNCTIONS[name](*args, eps)

    z, q, r = np.array(rows).T
    expected = [float(evaluate(*row)) for row in rows]
    np.testing.assert_array_equal(evaluate(z, q, r), expected)
    np.testing.assert_array_equal(np.asarray(evaluate(ca.DM(z), ca.DM(q), ca.DM(r))).ravel(), expected)
    for kind in (ca.SX, ca.MX):
        symbols = [kind.sym(letter, len(rows)) for letter in "zqr"]
        values = ca.Function("v", symbols, [evaluate(*symbols)])(z, q, r)
        np.testing.assert_allclose(np.asarray(values).ravel(), expected, atol=ULP)


@given(numbers, numbers, st.floats(0.0, 2.0))
def test_a_symbolic_width_of_the_rounding_is_the_same(a, b, eps):
    width = ca.SX.sym("eps")
    for function in (fmax, fmin):
        f = ca.Function("f", [width], [function(a, b, width), ca.jacobian(function(a, b, width), width)])
        value, slope = f(eps)
        assert float(value) == pytest.approx(function(a, b, eps), abs=ULP)
        assert np.isfinite(float(slope))


# ---- rounded kinks ----


@given(numbers, numbers, st.floats(1e-3, 2.0))
def test_a_rounded_maximum(a, b, eps):
    top = fmax(a, b, eps)
    assert 0 <= top - max(a, b) <= eps / 4 + ULP
    assert fmax(a, a, eps) == pytest.approx(a + eps / 4)
    assert fmin(a, b, eps) == -fmax(-a, -b, eps)
    if abs(a - b) >= eps:
        assert top == max(a, b)  # compact support: nothing changes outside the band


@given(paths, numbers, thresholds, st.floats(1e-3, 2.0))
def test_bounds_of_a_rounded_play(path, q, r, eps):
    """One step is off by at most eps/4, a record of any length by at most eps."""
    exact = rounded = q
    for z in path:
        assert abs(play(z, rounded, r, eps) - play(z, rounded, r)) <= eps / 4 + ULP
        exact, rounded = play(z, exact, r), play(z, rounded, r, eps)
        assert abs(rounded - exact) <= eps + ULP


def test_a_rounded_play_reaches_the_bound_over_a_record():
    eps = q = 0.5
    for _ in range(2000):  # the same touch again and again: a rounded play creeps out of the band
        q = play(1.0 + 0.5, q, 1.0, eps)
    assert eps / 4 < q - 0.5 <= eps
    assert q - 0.5 > 0.99 * eps


@given(numbers, thresholds, st.floats(1e-3, 0.3), st.floats(-1.0, 1.0))
def test_no_memory_leaks_away_from_the_edges(z, r, eps, share):
    assume(r > eps)
    q = z + share * (r - eps)
    assume(abs(q - z) <= r - eps)
    for _ in range(50):
        assert play(z, q, r, eps) == q


@given(numbers, numbers, thresholds, st.floats(1e-3, 2.0))
def test_rounded_play_plus_rounded_stop(z, q, r, eps):
    assert abs(play(z, q, r, eps) + stop(z, q, r, eps) - z) <= ULP


def test_names_of_operators():
    assert {k.name for k in (Play(), Stop(), GeneralizedPlay())} == {"play", "stop", "generalized_play"}
