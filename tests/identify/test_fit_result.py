"""The result of a fit: errors, limits, noise and priors, initial states, scored samples, and interrupts."""

import signal
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np
import pytest
from random_models import random_input, random_lfr, reference

from pilfr_casadi._base import InputError
from pilfr_casadi.data import Recording, nrmse
from pilfr_casadi.identify import DENSITY_PRIOR, FitContext, compare, fit, standard_errors
from pilfr_casadi.models import PILFR, Play, PrandtlIshlinskii
from pilfr_casadi.optimise import Constraint, GaussNewton, Problem, Status

X0 = np.array([3.0, -3.0, 0.0, 0.0, 0.0, 0.0])
SHORT = GaussNewton(max_iterations=3)


@dataclass
class Watching:
    """Gauss-Newton that stores each problem and its cost at the start."""

    problems: list = field(default_factory=list)
    costs: list = field(default_factory=list)

    def solve(self, problem, start=None, progress=None):
        self.problems.append(problem)
        self.costs.append(problem.cost(problem.start if start is None else start))
        return GaussNewton(tolerance=1e-4).solve(problem, start)


def simulated(seed, samples, state, noise=0.01):
    _, values = random_lfr(3, nx=2, n=4)
    u = random_input(seed, samples)
    y = reference(Play, values, u, state)[0]
    return u, y + noise * y.std() * np.random.default_rng(seed).normal(size=y.shape)


@pytest.fixture(scope="module")
def truth():
    structure, values = random_lfr(3, nx=2, n=4)
    return structure, values, structure.model(1, 1, values)


@pytest.fixture(scope="module")
def record():
    return Recording(*simulated(1, 1500, np.zeros(6)), 0.01, initial="zero")


@pytest.fixture(scope="module")
def moving():
    return Recording(*simulated(2, 1500, X0), 0.01, initial="estimate")


@pytest.fixture(scope="module")
def of_moving(truth, moving):
    return fit(truth[2], moving)


@pytest.fixture(scope="module")
def of_record(truth, record):
    return fit(truth[2], record)


# errors


def test_the_prior_of_the_search_does_not_shrink_standard_errors(truth, record):
    structure, values, model = truth
    tight = {k: {"prior": (values[k], 1e-4 * np.ones_like(values[k]))} for k in ("w", "r")}
    held = model.with_parameters(model.parameters.change(**tight))
    problems = [Problem(m, record, noise=0.01) for m in (held, model)]
    solution = GaussNewton().solve(problems[0])
    found = FitContext((record,), None).result(held, structure, problems[0], solution, DENSITY_PRIOR)
    with_prior, without = (standard_errors(p, solution.theta, structure) for p in problems)
    assert np.all(with_prior["r"] < 0.1 * without["r"])
    for name in ("w", "r"):
        np.testing.assert_allclose(found.errors[name], without[name], rtol=1e-9)
        assert found.model.parameters[name].prior is None


def test_undetermined_parameters_are_reported(of_record):
    errors = {"r": np.array([[0.1, np.inf, np.inf]]), "w": np.ones((1, 3))}
    told = replace(of_record, errors=errors, linear_nrmse=(0.25,))
    assert "the data alone do not determine 2 of 3 entries of r" in str(told)
    assert "of w" not in str(told) and "do not determine" not in str(replace(told, errors={"w": errors["w"]}))
    free = str(replace(told, errors={**errors, "A": np.full((4, 4), np.inf), "C_y": np.array([[1.0, np.inf]])}))
    assert (
        "entries of A, C_y have no standard error" in free and "16 of 16" not in free and "2 of 3 entries of r" in free
    )
    assert "judge poles, zeros and responses instead" in free
    assert "the linear model alone, to judge the element by: NRMSE 0.2500" in str(told)


def test_the_error_of_the_linear_model_is_reported(record):
    found = fit(PILFR(2, PrandtlIshlinskii(Play, 3)), record, starts=1)
    linear = fit(PILFR(2), record)
    assert found.linear_nrmse == pytest.approx(linear.train_nrmse, rel=0.01)
    assert found.train_nrmse[0] < 0.8 * found.linear_nrmse[0]


# limits


@pytest.mark.parametrize("low, high, listed", [(1.2, np.inf, True), (-np.inf, 0.8, True), (0.1, 10.0, False)])
def test_limits_on_either_side_are_listed(truth, record, low, high, listed):
    _, values, model = truth
    total = float(values["r"][0, 0])
    limit = Constraint(lambda p: p["r"][0, 0], low * total, high * total, name="first threshold")
    held = model.with_parameters(model.parameters.change(D_zu={"fixed": True}))  # which fixes the unit of z
    assert ("first threshold" in fit(held, record, constraints=[limit]).active) is listed


@pytest.mark.parametrize("path", ["linear", "refit", "search"])
def test_every_path_of_fit_limits_the_radius(record, of_record, path):
    watching = Watching()
    task = {
        "linear": PILFR(2, fixed={"D_yu": 0.0}),
        "refit": replace(of_record, structure=PILFR(2, PrandtlIshlinskii(Play, 4))),
        "search": PILFR(2, PrandtlIshlinskii(Play, 3)),
    }[path]
    fit(task, record, solver=watching, starts=1, stable=0.99)
    assert all("spectral radius <= 0.99" in p.g_labels for p in watching.problems) and watching.problems
    again = Watching()
    fit(task, record, solver=again, starts=1, stable=False)
    assert not any(p.g_labels for p in again.problems)


def test_a_recording_at_rest_among_others(truth, record):
    rest = Recording(np.zeros((200, 1)), np.zeros((200, 1)), 0.01, initial="zero")
    model = truth[2]
    calm = model.with_parameters(model.parameters.change(y_0={"value": np.zeros(1)}))
    found = fit(calm, [record, rest], solver=SHORT)
    assert np.all(np.isfinite(found.train_nrmse))
    pooled = np.std(np.concatenate([record.y, rest.y]))
    expected = np.sqrt(np.mean(found.simulate(rest) ** 2)) / pooled
    assert found.train_nrmse[1] == pytest.approx(expected)
    assert found.nrmse([record, rest]) == pytest.approx((found.nrmse(record) + expected) / 2)
    with pytest.raises(InputError, match="never changes"):
        found.nrmse(rest)


# noise and priors


def test_a_prior_has_the_same_effect_on_every_path_of_fit(truth, record):
    _, values, model = truth
    mean = values["D_yu"] + 0.1
    pulled = model.with_parameters(model.parameters.change(D_yu={"prior": (mean, 0.05)}))
    found = fit(pulled, record)
    error = found.train_nrmse[0]
    assert error < 0.0105  # with noise = 1 the prior would hold D_yu 0.1 off
    again, given = fit(found, record), fit(pulled, record, noise=error)
    assert again.parameters["D_yu"] == pytest.approx(found.parameters["D_yu"], abs=2e-4)
    assert given.parameters["D_yu"] == pytest.approx(found.parameters["D_yu"], abs=2e-4)
    strong = fit(pulled, record, noise=1.0)
    assert abs(strong.parameters["D_yu"] - found.parameters["D_yu"]) > 0.015


@pytest.mark.parametrize("element", [None, PrandtlIshlinskii(Play, 3)], ids=["linear", "pi-lfr"])
def test_the_noise_is_the_error_reached(record, element):
    watching = Watching()
    structure = PILFR(2, element, priors={"D_yu": (0.5, 0.1)})
    found = fit(structure, record, solver=watching, starts=1)
    last = watching.problems[-1].noise
    assert last == pytest.approx(found.train_nrmse[0], rel=0.1)
    if element:
        assert watching.problems[0].noise < 0.2  # the error that the search reached
    fixed = Watching()
    fit(structure, record, solver=fixed, starts=1, noise=0.3)
    assert {p.noise for p in fixed.problems} == {0.3}


# initial states


def test_states_are_stored_by_recording_and_kind_of_start(of_moving, moving, of_record, record):
    np.testing.assert_allclose(of_moving.initial_state(moving)[:2], X0[:2], rtol=0.2)
    assert not of_moving.initial_state(moving.with_(initial="zero")).any()
    steady = of_moving.initial_state(moving.with_(initial="periodic", period=len(moving)))
    assert np.max(np.abs(steady[:2] - X0[:2])) > 1.0
    assert of_record.initial_state(record.with_(initial="estimate")).any()


def test_a_refit_starts_where_the_fit_ended(of_moving, moving):
    watching = Watching()
    fit(of_moving, moving, solver=watching)
    assert watching.costs[0] == pytest.approx(of_moving.solution.cost, rel=1e-9)
    other = Recording(*simulated(5, 600, X0), 0.01)
    fit(of_moving, other, solver=watching)
    assert watching.costs[1] < 1e-3  # from rest it would be more than 0.01


def test_the_initial_state_is_fitted_to_the_first_samples_alone(of_record):
    u, y = simulated(6, 400, X0)
    other = y.copy()
    other[60:] = 7.0
    one, two = (of_record.initial_state(Recording(u, values, 0.01)) for values in (y, other))
    np.testing.assert_array_equal(one, two)
    assert np.any(one != of_record.initial_state(Recording(u, np.roll(y, 5, axis=0), 0.01)))


def test_samples_of_the_initial_state_are_not_scored(of_record, of_moving, moving):
    u, y = simulated(6, 400, X0)
    test = Recording(u, y, 0.01)
    assert of_record.scored_from(test) == 60  # ten a state, operators included
    assert of_record.nrmse(test) == nrmse(y, of_record.simulate(test), skip=60)
    assert of_record.scored_from(test.with_(skip=90)) == 90
    assert of_record.scored_from(test.with_(initial="zero")) == 0
    assert of_moving.scored_from(moving) == 0
    assert of_moving.nrmse(moving) == pytest.approx(of_moving.train_nrmse[0])
    with pytest.raises(InputError, match="has 60 samples, but its initial state is fitted to the first 60"):
        of_record.nrmse(Recording(u[:60], y[:60], 0.01))
    assert of_record.simulate(Recording(u[:60], y[:60], 0.01)).shape == (60, 1)


def test_outputs_are_not_needed_to_simulate(of_record):
    u, y = simulated(6, 400, np.zeros(6))
    bare, full = (Recording(u, outputs, 0.01, initial="zero") for outputs in (np.zeros((400, 0)), y))
    np.testing.assert_array_equal(of_record.simulate(bare), of_record.simulate(full))
    with pytest.raises(InputError, match="1 inputs and 0 outputs"):
        of_record.simulate(bare.with_(initial="estimate"))


@pytest.mark.parametrize("engine", ["c", "vm"])
def test_the_engine_is_kept(truth, record, engine):
    assert fit(truth[2], record, engine=engine, solver=SHORT).engine == engine


# interrupts


def test_ctrl_c_after_the_last_solve_loses_nothing(truth, record, monkeypatch):
    build = FitContext._result

    def struck(*args):
        signal.raise_signal(signal.SIGINT)
        return build(*args)

    monkeypatch.setattr(FitContext, "_result", struck)
    found = fit(truth[2], record)
    assert found.status is Status.INTERRUPTED and found.train_nrmse[0] < 0.0105


@pytest.mark.parametrize("priors", [{}, {"D_yu": (0.5, 0.1)}], ids=["plain", "with a prior"])
@pytest.mark.parametrize("at", ["solve", "standard errors"])
def test_an_interrupt_by_the_progress_function(record, at, priors):
    def strike(stage, *_):
        if stage == at:
            raise KeyboardInterrupt

    structure = PILFR(2, PrandtlIshlinskii(Play, 3), priors=priors)
    found = fit(structure, record, starts=1, progress=strike)
    assert found.status is Status.INTERRUPTED and found.structure == structure
    assert found.train_nrmse[0] < found.linear_nrmse[0] and len(found.candidates) == 1


def test_an_interrupt_between_two_solves(record, monkeypatch):
    structure = PILFR(2, PrandtlIshlinskii(Play, 3), priors={"D_yu": (0.5, 0.1)})

    def struck(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(FitContext, "iterate_noise", struck)
    for task in (structure, structure.model(1, 1, {"D_yu": 0.4}), PILFR(2, priors={"D_yu": (0.5, 0.1)})):
        found = fit(task, record, starts=1)
        assert found.status is Status.INTERRUPTED and np.isfinite(found.train_nrmse[0])


def test_constraints_are_found_by_name(record, truth):
    limit = Constraint(lambda p: ca.sum1(ca.vec(p["w"])), upper=1.0, name="sum of the weights")
    scales = {name: {"fixed": True} for name in ("D_zu", "D_yw")}  # which leave the scale of the weights alone free
    model = truth[2].with_parameters(truth[2].parameters.change(**scales))
    assert "sum of the weights" in fit(model, record, constraints=limit).active


def test_the_command_line_reports_unscored_samples(of_record):
    from pilfr_casadi.cli import describe_test_error

    u, y = simulated(6, 400, X0)
    line = describe_test_error(of_record, Recording(u, y, 0.01, name="test"))
    assert line.startswith(f"NRMSE on test: {of_record.nrmse(Recording(u, y, 0.01)):.4f}")
    assert line.endswith("the first 60 samples estimate the initial state and are not scored")
    assert "not scored" not in describe_test_error(of_record, Recording(u, y, 0.01, initial="zero"))
    assert describe_test_error(of_record, Recording(u[:50], y[:50], 0.01, name="short")).startswith(
        "no NRMSE on short: The recording"
    )


def test_channels_in_another_order_are_matched_by_name():
    u = np.random.default_rng(0).standard_normal((300, 2))
    y = np.column_stack([np.convolve(u[:, 0], [0, 1, 0.5])[:300], np.convolve(u[:, 1], [0, 0, 2.0])[:300]])
    given = Recording(u, y, 0.01, inputs=("left", "right"), outputs=("near", "far"), initial="zero")
    turned = given.in_order(("right", "left"), ("far", "near"))
    found = fit(PILFR(4), given, starts=1)
    np.testing.assert_array_equal(found.simulate(turned), found.simulate(given))
    assert found.nrmse(turned) == pytest.approx(found.nrmse(given), rel=1e-6)
    again = fit(found, turned)
    np.testing.assert_allclose(again.simulate(given), found.simulate(given), atol=1e-6)
    np.testing.assert_allclose(fit(found.model, turned).simulate(given), found.simulate(given), atol=1e-6)
    errors = compare(turned, {"fit": found, "model": found.model}).errors
    np.testing.assert_allclose(errors["fit"], errors["model"], atol=1e-9)
    assert np.all(errors["fit"] < 1e-3)
