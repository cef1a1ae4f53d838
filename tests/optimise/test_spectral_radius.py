"""Bounds on spectral radii: the bounded matrices, smooth rows where eigenvalues meet, and minima inside."""

import pickle
import time

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, strategies as st
from random_models import coupled_plays
from scipy.optimize import minimize

import pilfr_casadi as pilfr
from pilfr_casadi._base import InputError
from pilfr_casadi.optimise import Problem, Status, describe_unbounded, solve_within_radii, stability_limits, stable
from pilfr_casadi.optimise.constraints import least_radius
from pilfr_casadi.optimise.exact_limits import SchurProblem, below_blocks, jury_rows, schur_basis
from problems.constrained import radius

PLAYS = pilfr.PrandtlIshlinskii(pilfr.Play, 3)
FINE = pilfr.GaussNewton(tolerance=1e-9, max_iterations=500)
DEMO = "pilfr_casadi/cli/demo_data/train.csv"


@pytest.fixture(scope="module")
def demo(request):
    path = request.config.rootpath / DEMO
    return pilfr.read_csv(path, inputs="u", outputs="x2", initial="zero")


@given(st.integers(0, 10**6), st.integers(1, 7), st.booleans())
def test_a_schur_basis_puts_pairs_in_blocks(seed, n, symmetric):
    m = np.random.default_rng(seed).normal(size=(n, n))
    m = m + m.T if symmetric else m
    q = schur_basis(m)
    np.testing.assert_allclose(q @ q.T, np.eye(n), atol=1e-12)
    np.testing.assert_allclose((q.T @ m @ q)[below_blocks(n)], 0, atol=1e-10)


@given(st.integers(0, 10**6), st.integers(1, 7), st.sampled_from([0.5, 0.999, 1.001, 2.0]))
def test_jurys_rows_hold_exactly_inside_the_radius(seed, n, share):
    m = np.random.default_rng(seed).normal(size=(n, n))
    q = schur_basis(m)
    held, low = jury_rows(n)(share * (q.T @ m @ q) / radius_of(m), 0)
    assert (np.min(np.asarray(held)) >= 0) == (share < 1)
    np.testing.assert_allclose(np.asarray(low), 0, atol=1e-9)


def radius_of(m):
    return np.max(np.abs(np.linalg.eigvals(m)))


@given(st.integers(0, 10**6), st.integers(2, 6))
def test_rows_with_unknowns_have_the_eigenvalues_of_the_blocks(seed, n):
    """F = S⁻¹ M S for any X; if the rows below the blocks vanish, the blocks have the radius."""
    rng = np.random.default_rng(seed)
    t = np.where(below_blocks(n), 0.0, rng.normal(size=(n, n)))
    t /= 1.01 * radius_of(t)
    step = np.eye(n) + np.where(below_blocks(n), rng.normal(size=(n, n)), 0.0)
    held, low = jury_rows(n)(step @ t @ np.linalg.inv(step), (step - np.eye(n)).T[below_blocks(n).T])
    assert np.min(np.asarray(held)) >= 0
    np.testing.assert_allclose(np.asarray(low), 0, atol=1e-8 * np.linalg.cond(step))


def test_derivatives_of_the_rows(record):
    fit = pilfr.fit(pilfr.PILFR(3, PLAYS), record, starts=1)
    full = stable(0.7, lambda p: p["A"] + p["B_w"] @ ca.diag(ca.sum2(p["w"])) @ p["C_z"], exact=True)
    problem = Problem(fit.model, record, constraints=(stable(0.7, exact=True), full, pilfr.ordered("r")))
    schur = SchurProblem(problem, problem.start, 1e-6)
    rng = np.random.default_rng(0)
    x = schur.start + 1e-3 * rng.normal(size=schur.size)
    slope = schur.constraint_jacobian(x)
    for _ in range(5):
        d = rng.normal(size=schur.size)
        central = (schur.constraint(x + 1e-6 * d) - schur.constraint(x - 1e-6 * d)) / 2e-6
        np.testing.assert_allclose(slope @ d, central, rtol=1e-5, atol=1e-6)
    assert schur.cost(x) == problem.cost(x[: problem.size])


@pytest.mark.parametrize("bound", [0.6, *(pytest.param(b, marks=pytest.mark.slow) for b in (0.79, 0.3))])
def test_no_feasible_point_nearby_is_better(record, bound):
    """SLSQP with the bound by trace and determinant finds no better point from there or from random points."""
    fit = pilfr.fit(pilfr.PILFR(2), record, stable=bound, solver=FINE)
    assert fit.status.converged and radius_of(fit.parameters["A"]) <= bound
    problem = Problem(fit.model, record)
    where = [problem.labels.index(f"A[{i},{j}]") for i in range(2) for j in range(2)]
    size = np.maximum(np.abs(problem.start), 1e-2)

    def room(x):
        a, b, c, d = (x * size)[where] / bound
        return np.array([1 - (a * d - b * c), 1 - (a + d) + a * d - b * c, 1 + (a + d) + a * d - b * c])

    best, rng = problem.cost(problem.start), np.random.default_rng(0)
    for step in (0.0, 1e-3, 1e-2):
        begin = problem.start / size + step * rng.normal(size=problem.size)
        options = {"method": "SLSQP", "options": {"maxiter": 300, "ftol": 1e-12}}
        found = minimize(
            lambda x: problem.cost(x * size) / best,
            begin,
            jac=lambda x: problem.normal(x * size)[1] * size / best,
            constraints=[{"type": "ineq", "fun": room}],
            **options,
        )
        assert np.min(room(found.x)) > -1e-9 and np.max(np.abs(found.x - begin)) < 10
        assert found.fun >= 1 - 2e-5
    steps = 10.0 ** rng.uniform(-5, -1, size=(3000, 1)) * rng.normal(size=(3000, problem.size))
    near = [x for x in problem.start / size + steps if np.min(room(x)) >= 0]
    assert len(near) > 100 and min(problem.cost(x * size) for x in near) >= best * (1 - 1e-6)


@pytest.mark.parametrize(
    "bound, reached",
    [(0.95, 0.2950), *(pytest.param(*v, marks=pytest.mark.slow) for v in ((0.8, 0.3955), (0.5, 0.5338)))],
)
def test_poles_that_meet_on_the_bound(demo, bound, reached):
    """Two pairs and a real pole, or five equal ones, at the bound; the figures come from Schur coordinates alone.

    The tightest bound has two optima, .5312 and .5337; the processor's rounding decides which of them is reached.
    """
    fit = pilfr.fit(pilfr.PILFR(5), demo, stable=bound)
    assert fit.status.converged and fit.train_nrmse[0] < reached
    assert radius_of(fit.parameters["A"]) <= bound


@pytest.mark.slow
def test_a_tight_bound_on_a_model_with_plays(demo):
    fit = pilfr.fit(pilfr.PILFR(5, pilfr.PrandtlIshlinskii(pilfr.Play, 6)), demo, starts=1, stable=0.95)
    assert radius(fit) <= 0.95 and fit.status.converged
    assert fit.train_nrmse[0] < 0.035


@pytest.mark.slow
def test_more_starts_are_never_worse(record):
    errors = [pilfr.fit(pilfr.PILFR(2, PLAYS), record, starts=n, stable=0.5).train_nrmse[0] for n in (1, 3)]
    assert errors[1] <= errors[0] * 1.0001


def test_growing_data_do_not_make_the_model_unstable():
    u = np.random.default_rng(0).standard_normal(800)
    x, y = 0.0, []
    for value in u:
        y.append(x)
        x = 1.001 * x + 0.1 * value
    record = pilfr.Recording(u, np.array(y), dt=0.1, initial="zero")
    free, held = (pilfr.fit(pilfr.PILFR(1), record, stable=s) for s in (False, True))
    assert radius_of(free.parameters["A"]) > 1.0005
    assert 1 - 1e-5 < radius_of(held.parameters["A"]) <= 1
    assert held.limits[0].active and held.limits[0].multiplier > 0


def test_a_double_integrator_is_allowed():
    u = np.random.default_rng(1).standard_normal(500)
    y = np.cumsum(np.cumsum(u)) * 1e-2
    record = pilfr.Recording(u, np.concatenate([[0.0, 0.0], y[:-2]]), dt=0.1, initial="zero")
    fit = pilfr.fit(pilfr.PILFR(2), record)
    assert radius_of(fit.parameters["A"]) <= 1 and fit.train_nrmse[0] < 1e-3


def test_a_limit_shows_the_radius_and_its_bound(record):
    fit = pilfr.fit(pilfr.PILFR(1, PLAYS), record, starts=1, stable=0.75)
    limits = [limit for limit in fit.limits if limit.kind == "constraint"]
    assert max(limit.value for limit in limits) == radius(fit) and all(limit.upper == 0.75 for limit in limits)
    held = next(limit for limit in limits if limit.active)
    assert f"{held.name}: {held.value:.9g}, active, multiplier" in str(fit) and held.value <= 0.75
    # the multiplier is the slope of the objective over the radius
    given = {"stable": 0.751, "solver": FINE}
    fits = [pilfr.fit(fit, record, **{**given, "stable": bound}) for bound in (0.75, 0.751)]
    slope = (fits[0].solution.cost - fits[1].solution.cost) / 0.001
    force = sum(limit.multiplier for limit in fits[0].limits if limit.kind == "constraint")
    assert force == pytest.approx(slope, rel=0.1)


def test_a_bound_with_a_fixed_matrix(record):
    structure = pilfr.PILFR(2, PLAYS, fixed={"A": [[0.5, 0.1], [np.nan, np.nan]]})
    fit = pilfr.fit(structure, record, starts=1, stable=0.7)
    assert radius(fit) <= 0.7 and fit.parameters["A"][0].tolist() == [0.5, 0.1]
    assert fit.status is not Status.INFEASIBLE


def test_the_print_says_that_the_seed_has_no_effect(record):
    quick, short = pilfr.GaussNewton(max_iterations=2), record.slice(0, 300)
    few, more = (pilfr.fit(pilfr.PILFR(1, PLAYS), short, starts=n, solver=quick) for n in (2, 3))
    assert "the seed has no effect" in str(few) and "the seed has no effect" not in str(more)


def test_every_step_of_a_tightened_fit_is_reported(record, monkeypatch):
    unheard, counts = [0], []
    normal = Problem.normal

    def counted(*args):
        unheard[0] += 1
        return normal(*args)

    def heard(stage, *_):
        counts.append((unheard[0], stage))
        unheard[0] = 0

    monkeypatch.setattr(Problem, "normal", counted)
    short = record.slice(0, 400)
    pilfr.fit(pilfr.PILFR(2, PLAYS), short, starts=2, stable=0.6, progress=heard)
    assert sum(count for count, _ in counts) > 200 and max(counts)[0] <= 2


@pytest.mark.slow
@pytest.mark.parametrize(("bound", "looser"), [(0.9, 0.91), (0.6, 0.61)])
def test_a_looser_bound_is_never_worse(bound, looser):
    other = coupled_plays(7)
    first = pilfr.fit(pilfr.PILFR(2, PLAYS), other, starts=2, stable=bound)
    second = pilfr.fit(first, other, stable=looser)
    assert radius(second) <= looser and second.train_nrmse[0] <= first.train_nrmse[0]


def test_a_limit_on_time_holds_for_all_solves_at_a_bound(record, monkeypatch):
    linear, limits = pilfr.fit(pilfr.PILFR(2), record), []
    solve = pilfr.GaussNewton.solve

    def slow(solver, *args, **more):
        limits.append(solver.time_limit)
        time.sleep(0.02)
        return solve(solver, *args, **more)

    monkeypatch.setattr(pilfr.GaussNewton, "solve", slow)
    solver = pilfr.GaussNewton(time_limit=0.1)
    problem = Problem(linear.model, record, constraints=(stable(0.3, exact=True),))
    found = solve_within_radii(problem, None, solver.solve, solver)
    values = problem.model.parameters.unpack(problem.parameters(found.theta))
    assert found.status is Status.TIME_LIMIT and radius_of(values["A"]) <= 0.3
    assert 3 <= len(limits) <= 8 and np.all(np.diff(limits) < 0)


def test_a_linear_model_without_the_bound_is_labelled(record):
    tight, free = (pilfr.fit(pilfr.PILFR(1, PLAYS), record, starts=1, stable=stable) for stable in (0.7, True))
    assert "the linear model alone, without the constraints, to judge" in str(tight)
    assert "the linear model alone, to judge" in str(free)


def resonance(samples=2000):
    """A lightly damped mass on a spring and stops, driven below and about its resonance."""
    rng = np.random.default_rng(0)
    u = pilfr.multisine(samples, f_max=8, fs=100.0, rng=rng) * np.minimum(1, np.arange(samples) / 50)
    r, q, x, v, y = np.linspace(0.005, 0.06, 6), np.zeros(6), 0.0, 0.0, np.zeros(samples)
    for k in range(samples):
        y[k] = x
        for _ in range(5):
            q = np.clip(q, x - r, x + r)
            v += 0.002 * (100 * u[k] - 600 * x - 100 * np.sum(x - q) - v)
            x += 0.002 * v
    return pilfr.Recording(u, y + 2e-3 * np.std(y) * rng.standard_normal(samples), 0.01, initial="zero")


@pytest.mark.slow
def test_an_inactive_bound_near_the_radius_does_not_raise_the_cost():
    record, structure = resonance(), pilfr.PILFR(2, pilfr.PrandtlIshlinskii(pilfr.Stop, 5))
    free = pilfr.fit(structure, record, starts=2)
    for share in (1.0001, 1.001):
        bounded = pilfr.fit(structure, record, starts=2, stable=share * radius(free))
        assert bounded.train_nrmse[0] <= 1.001 * free.train_nrmse[0]


# ---- which matrices are bounded ----


@pytest.mark.parametrize("nx, bounds, least", [(1, (1.5, 2), 1.5), (1, (-3, -1.1), 1.1), (2, (0.6, 2), 1.2)])
def test_bounds_without_any_stable_model_are_refused(record, nx, bounds, least):
    structure = pilfr.PILFR(nx, PLAYS, bounds={"A": bounds})
    with pytest.raises(InputError, match=f"allow no spectral radius below {least}.*at most 1 .*widen the bounds"):
        pilfr.fit(structure, record, starts=1)
    with pytest.raises(InputError, match="allow no spectral radius below"):
        pilfr.fit(structure, record, start={"A": np.full((nx, nx), bounds[1])})


def test_an_unstable_model_over_a_short_record_is_fitted_where_it_may_grow(record):
    structure = pilfr.PILFR(1, PLAYS, bounds={"A": (1.05, 2)})
    fit = pilfr.fit(structure, record.slice(0, 60), starts=1, stable=False)
    assert np.isfinite(fit.train_nrmse[0]) and fit.parameters["A"].item() >= 1.05


@given(seed=st.integers(0, 10_000), n=st.integers(1, 4))
def test_no_matrix_between_bounds_has_a_smaller_radius(seed, n):
    rng = np.random.default_rng(seed)
    low = rng.normal(size=(n, n)) if seed % 2 else np.abs(rng.normal(size=(n, n)))
    high = low + np.abs(rng.normal(size=(n, n)))
    low, high = (low, high) if seed % 3 else (-high, -low)
    least = least_radius(low, high)
    for _ in range(20):
        matrix = rng.uniform(low, high)
        assert np.max(np.abs(np.linalg.eigvals(matrix))) >= least * (1 - 1e-12)


def generalized(values, channels=1):
    """Named numbers of generalized plays with networks, in a first-order loop of gain one."""
    element = pilfr.PrandtlIshlinskii(pilfr.GeneralizedPlay(2), 3, channels)
    one = {"A": [[0.5]], "B_w": [[1.0] * channels], "C_z": [[1.0]] * channels}
    p = pilfr.PILFR(1, element).model(1, 1, {**one, **values}).parameters
    return pilfr.PILFR(1, element), {name: parameter.value for name, parameter in p.items()}


def radius_by_simulation(structure, p, size):
    """Compute the growth per sample of a free motion from `size`, so large that every operator slips."""
    model = structure.model(1, 1, p)
    state, tops = np.zeros(model.n_x + model.n_s), []
    state[0] = size
    for _ in range(60):
        state = np.asarray(model.closed(state, 0.0, model.parameters.start)[0]).ravel()
        tops.append(abs(state[0]))
    return (tops[-1] / tops[-31]) ** (1 / 30)


def test_envelopes_are_bounded_by_their_slope_far_out():
    """Rising motions follow the lower envelope; its slope far out, not its steepest one, decides whether they grow."""
    w = np.full((1, 3), 1 / 3)
    for a0, grows in ((0.52, True), (0.48, False)):
        steep = {
            "w": w,
            "gamma_l_a0": [[a0]],
            "gamma_r_a0": [[0.1]],
            "gamma_l_a": [[1.0, 1.0]],
            "gamma_l_b": [[2.0, 1.0]],
        }
        structure, p = generalized(steep)
        names = [c.name for c in stability_limits(structure, True)]
        assert names[1:] == [
            f"spectral radius with the element's {which} envelope far out <= 1" for which in ("lower", "upper")
        ]
        far = [c.check(p) + c.check.radius for c in stability_limits(structure, True)]
        assert far == pytest.approx([0.5, 0.5 + a0, 0.6])
        assert radius_by_simulation(structure, p, 1e4) == pytest.approx(0.5 + a0, abs=0.01)
        assert (far[1] > 1) == grows
        assert "steepest the spectral radius is" in describe_unbounded(structure, stability_limits(structure, True), p)
    flat, p = generalized({"w": w, "gamma_l_a0": [[0.3]], "gamma_r_a0": [[0.3]]})
    assert describe_unbounded(flat, stability_limits(flat, True), p) == ""
    assert describe_unbounded(flat, (), p) == ""


@given(seed=st.integers(0, 10_000))
def test_the_steepest_slope_of_a_network_is_its_largest(seed):
    rng = np.random.default_rng(seed)
    operator = pilfr.GeneralizedPlay(3)
    shapes = {"c": (2, 1), "a0": (2, 1), "a": (2, 3), "b": (2, 3), "d": (2, 3)}
    p = {
        f"gamma_l_{k}": rng.exponential(size=s) if k in ("a0", "a", "b") else rng.normal(size=s)
        for k, s in shapes.items()
    }
    z = np.linspace(-40, 40, 40_001)
    for i in range(2):
        largest = np.max(np.diff(operator.envelope("l", z, p, i)) / np.diff(z))
        assert operator.steepest("l", p)[i] == pytest.approx(largest, rel=2e-3)


def test_a_fit_of_generalized_plays_in_a_loop_keeps_its_bound():
    record = coupled_plays(5).slice(0, 500)
    fit = pilfr.fit(
        pilfr.PILFR(2, pilfr.PrandtlIshlinskii(pilfr.GeneralizedPlay(2), 2)), record, starts=2, stable=0.985
    )
    p = fit.parameters
    for side in "lr":
        far = p["A"] + p["B_w"] @ np.diag(p["w"].sum(1) * p[f"gamma_{side}_a0"].ravel()) @ p["C_z"]
        assert np.max(np.abs(np.linalg.eigvals(far))) <= 0.985
    assert [limit.met for limit in fit.limits if limit.kind == "constraint"] == [True] * 3


def test_combined_elements_are_bounded_by_the_sum_of_their_parts():
    plays, stops = pilfr.PrandtlIshlinskii(pilfr.Play, 2), pilfr.PrandtlIshlinskii(pilfr.Stop, 2)
    parts = [
        pilfr.Part("a", plays, (0,)),
        pilfr.Part("b", stops, (1,), (0,)),
        pilfr.Part("c", pilfr.Products(2), (0, 1)),
    ]
    structure = pilfr.PILFR(1, pilfr.Combined(parts))
    model = structure.model(1, 1, {"A": [[0.5]], "B_w": [[1.0, 0.0]], "C_z": [[0.2], [0.1]]})
    p = {name: v.value for name, v in model.parameters.items()} | {
        "a_w": np.array([[1.0, 2.0]]),
        "b_w": np.array([[0.5, 0.5]]),
    }
    limits = stability_limits(structure, True)
    assert [c.check(p) + 1 for c in limits] == pytest.approx([0.5, 0.5 + 0.2 * 3.0 + 0.1 * 1.0])
    assert describe_unbounded(structure, limits, p) == ""  # products are bounded
    assert pickle.loads(pickle.dumps(limits))[1].name == "spectral radius with the element's full slope <= 1"


def test_unknown_slopes_are_reported(record):
    own = pilfr.GeneralizedPlay(gamma_l=gamma, gamma_r=gamma)
    structure = pilfr.PILFR(1, pilfr.PrandtlIshlinskii(own, 2))
    start = {
        "A": 0.5,
        "B_u": 0.3,
        "B_w": 0.1,
        "C_y": 1.0,
        "C_z": 1.0,
        "D_yu": 0.0,
        "D_yw": 0.0,
        "D_zu": 1.0,
        "y_0": 0.0,
    }
    fit = pilfr.fit(structure, record, start=start, solver=pilfr.GaussNewton(max_iterations=3))
    assert [c.name for c in stability_limits(structure, True)] == ["spectral radius <= 1"]
    assert "the spectral radius is bounded for the linear part alone, because the slope of the element" in str(fit)
    wiener = pilfr.wiener(1, pilfr.PrandtlIshlinskii(own, 2))
    values = {k: v.value for k, v in wiener.model(1, 1, {"A": [[0.5]], "C_z": [[1.0]]}).parameters.items()}
    assert describe_unbounded(wiener, stability_limits(wiener, True), values) == ""  # nothing is fed back


def gamma(z, p):
    """A user-defined envelope."""
    return 0.5 * z + 0.1 * ca.tanh(z)
