"""A known DC gain: met beside poles of 1, and reported where it holds only beyond the recordings."""

import casadi as ca
import numpy as np
import pytest
from random_models import coupled_plays

import pilfr_casadi as pilfr
from pilfr_casadi._base import InputError
from pilfr_casadi.identify import describe_reached_gain
from pilfr_casadi.optimise import Gain, Problem, Solution, Status, dc_gain, limits_of
from pilfr_casadi.optimise.gauss_newton import ExactPenalty

PLAYS = pilfr.PrandtlIshlinskii(pilfr.Play, 3)


@pytest.mark.slow
@pytest.mark.parametrize("seed, gain", [(5, 2.0), (8, 2.0), (10, 2.0), (11, 1.0)])
def test_a_gain_far_from_the_data_is_met(seed, gain):
    """Beside a slow pole a gain has immense slopes, at a pole of 1 no value; some starts may miss it."""
    fit = pilfr.fit(pilfr.PILFR(2, PLAYS), coupled_plays(seed), starts=4, constraints=[dc_gain(gain)])
    assert fit.status.converged and all(limit.met for limit in fit.limits)


def test_a_gain_at_an_integrator_has_no_value(record):
    model = pilfr.PILFR(1, bounds={"A": (0.0, 1.0)}).model(1, 1, {"A": [[1.0]], "B_u": [[1.0]], "C_y": [[1.0]]})
    with pytest.raises(InputError, match="'DC gain = 1' has no finite value at the start values"):
        Problem(model, record, constraints=[dc_gain(1.0)])
    model = model.with_parameters(model.parameters.change(A={"value": [[0.9]]}))
    problem = Problem(model, record, constraints=[dc_gain(1.0)])
    penalty = ExactPenalty(problem)
    assert penalty.violations(np.array([0.9, 1.0, 1.0, 0.0, 0.0]))[0] == pytest.approx(9.0)
    assert penalty.violations(np.array([1.0, 1.0, 1.0, 0.0, 0.0]))[0] == np.inf


def test_a_unit_near_a_pole_is_replaced(record):
    model = pilfr.PILFR(1).model(1, 1, {"A": [[1 - 1e-9]], "B_u": [[1.0]], "C_y": [[1.0]]})
    problem = Problem(model, record, constraints=[dc_gain(1.0)])
    penalty, away = ExactPenalty(problem), np.array([0.9, 1.0, 1.0, 0.0, 0.0])
    penalty.measure_units(problem.start, np.ones(problem.size))
    assert (
        penalty.unit[0] > 1e11 and penalty.violation(away) < 1e-10
    )  # the gain is off by 9, but the violation looks tiny
    assert penalty.shrink_units(away) and penalty.unit[0] < 200 and penalty.violation(away) > 0.05
    assert not penalty.shrink_units(away)


@pytest.mark.parametrize("gain, says", [(1.0, ""), (3.0, "1 of 3 operators never slip in them; within them it is 1.0")])
def test_a_gain_that_plays_reach_only_beyond_the_recording_is_reported(record, gain, says):
    fit = pilfr.fit(pilfr.hammerstein(1, PLAYS), record, starts=2, constraints=[dc_gain(gain)])
    assert fit.limits[-1].met and (says in str(fit) if says else "beyond the recordings" not in str(fit))
    beyond_z = fit.parameters["r"] > np.max(np.abs(fit.signals(record)["z"]))
    assert np.any(beyond_z & (fit.parameters["w"] > 0.1)) == bool(says)


def test_a_gain_that_a_slow_pole_reaches_late_is_reported(record):
    slow = pilfr.PILFR(2, fixed={"A": np.diag([0.8, 1 - 1e-5])})
    known = {"A": slow.fixed["A"], "B_u": [[0.2], [1e-5]], "C_y": [[1.0, 1.0]]}
    problem = Problem(slow.model(1, 1, known), record, constraints=[dc_gain(2.0)])
    assert describe_reached_gain(problem, problem.start) == (
        "DC gain = 2 holds only beyond the recordings: the response takes more than the 1200 recorded samples to "
        "settle; within them it is 1.01"
    )
    fast = Problem(slow.model(1, 1, {**known, "C_y": [[2.0, 0.0]]}), record, constraints=[dc_gain(2.0)])
    assert describe_reached_gain(fast, fast.start) == ""


@pytest.mark.parametrize(
    "operator, slope, r, says",
    [
        (pilfr.Play, 0.0, [0.0, 9.0], "1 of 2 operators have no threshold"),
        (pilfr.Play, 0.0, [1e-3, 9.0], ""),
        (pilfr.Stop, 1.0, [0.0, 9.0], "1 of 2 operators have no threshold"),
        (pilfr.Stop, 0.0, [1e-3, 9.0], "1 of 2 operators never slip"),
        (pilfr.Stop, 0.0, [1e-3, 1e-3], ""),
        (pilfr.Play, 0.5, [0.0, 9.0], ""),
    ],
)
def test_which_operators_keep_a_gain_beyond_the_recording(record, operator, slope, r, says):
    structure = pilfr.hammerstein(0, pilfr.PrandtlIshlinskii(operator, 2))
    model = structure.model(1, 1, {"D_yw": [[1.0]], "w": [[0.5, 0.5]], "r": [r]})
    free = Problem(model, record)
    gain = float(Gain(slope)({k: ca.DM(v) for k, v in model.parameters.unpack(free.parameters(free.start)).items()}))
    problem = Problem(model, record, constraints=[dc_gain(gain, slope=slope)])
    told = describe_reached_gain(problem, problem.start)
    assert says in told if says else told == ""


def two_by_two(n=300):
    """Two outputs of two inputs with almost no dynamics."""
    rng = np.random.default_rng(2)
    u, x = rng.normal(size=(n, 2)), np.zeros(2)
    y = np.empty((n, 2))
    for k in range(n):
        y[k] = x
        x = 0.5 * x + 0.5 * u[k] @ np.array([[2.0, -0.2], [0.4, 1.0]])
    return pilfr.Recording(u, y + 1e-3 * rng.normal(size=y.shape), 0.01, initial="zero")


def test_gains_of_several_channels_are_named_and_met_row_by_row():
    wanted = np.array([[2.0, 0.4], [-0.2, 1.0]])
    fit = pilfr.fit(pilfr.PILFR(2), two_by_two(), constraints=[dc_gain(wanted, within=1e-3)])
    limits = [limit for limit in fit.limits if limit.name.startswith("DC gain")]
    assert [limit.name for limit in limits] == [f"DC gain = 2, 0.4; -0.2, 1 ± 0.001[{i}]" for i in range(4)]
    assert np.allclose([limit.value for limit in limits], wanted.ravel(), atol=1.01e-3)
    assert np.allclose([limit.lower for limit in limits], wanted.ravel() - 1e-3)


def test_a_small_limit_is_met_to_less_than_a_hundredth():
    model = pilfr.PILFR(2).model(2, 2, {"A": 0.5 * np.eye(2), "B_u": np.eye(2), "C_y": [[1.0, 0.5], [1.0, 1.0]]})
    gain = np.array([[2.0, 1.0], [2.0, 2.0]])
    gain[0, 1] = 1e-6
    parameters = model.parameters.change(D_yu={"value": [[0.0, -1.0 + 1.01e-6], [0.0, 0.0]]})
    problem = Problem(model.with_parameters(parameters), two_by_two(), constraints=[dc_gain(gain)])
    solution = Solution(problem.start, 1.0, Status.SOLVER_FAILED, 0, 0.0)
    assert [limit.met for limit in limits_of(problem, solution)][:4] == [True, False, True, True]


@pytest.mark.parametrize("value", [[1.0, 2.0, 3.0, 4.0], [[1.0, 2.0]], [[1.0], [2.0]], [1.0, 2.0], np.ones((1, 1))])
def test_a_gain_of_another_shape_is_refused(value):
    shape = str(np.shape(value)).replace("(", r"\(").replace(")", r"\)")
    with pytest.raises(InputError, match=rf"dc_gain have the shape {shape}; give one number.* of shape \(2, 2\)\.$"):
        pilfr.fit(pilfr.PILFR(2), two_by_two(), constraints=[dc_gain(value, within=0.1)])


def test_a_plain_list_is_enough_for_one_output():
    record = two_by_two()
    one = pilfr.Recording(record.u, record.y[:, 0], 0.01, initial="zero")
    for value in ([2.0, 0.4], [[2.0, 0.4]]):
        fit = pilfr.fit(pilfr.PILFR(2), one, constraints=[dc_gain(value, within=0.01)])
        assert all(limit.met for limit in fit.limits)
    with pytest.raises(InputError, match=r"of shape \(1, 2\)"):
        pilfr.fit(pilfr.PILFR(2), one, constraints=[dc_gain([2.0, 0.4, 1.0])])
