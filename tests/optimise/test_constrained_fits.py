"""Constrained and regularized fits: exact limits, multipliers, and sparse results."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from random_models import coupled_plays

import pilfr_casadi as pilfr
from pilfr_casadi._base import InputError
from pilfr_casadi.identify import SPREADINGS, change_basis, find_nearest_basis, thin_operators
from pilfr_casadi.optimise import (
    Constraint,
    Gain,
    Problem,
    Status,
    dc_gain,
    limits_of,
    move_inside_exact,
    ordered,
    stability_limits,
    stable,
    violated_exact,
)
from pilfr_casadi.optimise.constraints import RadiusExcess
from pilfr_casadi.optimise.exact_limits import point_as_solution
from problems.constrained import infeasible_sentences, radius, slowest_pole, sparse_plays, stability_table, three_plays

PLAYS = pilfr.PrandtlIshlinskii(pilfr.Play, 3)


@pytest.fixture(scope="module")
def full(record):
    return pilfr.fit(pilfr.hammerstein(1, pilfr.PrandtlIshlinskii(pilfr.Play, 6)), record, starts=2)


@pytest.mark.parametrize("bound", [0.9, 0.6, *(pytest.param(b, marks=pytest.mark.slow) for b in (0.8, 0.79, 0.3))])
def test_a_bound_on_the_radius_holds_to_the_last_digit(record, bound):
    fit = pilfr.fit(pilfr.PILFR(2, PLAYS), record, starts=1, stable=bound)
    assert radius(fit) <= bound
    assert fit.status is not Status.INFEASIBLE


def test_the_bound_holds_after_saving_and_loading(record, tmp_path):
    fit = pilfr.fit(pilfr.hammerstein(1, PLAYS), record, starts=1, stable=0.78)
    fit.save(tmp_path / "m.json")
    loaded = pilfr.load(tmp_path / "m.json")
    assert radius(loaded) <= 0.78 and loaded.limits == fit.limits
    assert any(limit.active and limit.multiplier > 0 for limit in fit.limits if limit.kind == "constraint")


@pytest.mark.parametrize("bound", [0.79, 0.5])
def test_a_linear_model_is_bounded_exactly_too(record, bound):
    fit = pilfr.fit(pilfr.PILFR(2), record, stable=bound)
    assert max(abs(np.linalg.eigvals(fit.parameters["A"]))) <= bound and fit.status is not Status.INFEASIBLE


@pytest.mark.parametrize("solver", [pilfr.GaussNewton(), pilfr.Ipopt()])
def test_every_solver_ends_inside(record, solver):
    fit = pilfr.fit(pilfr.PILFR(1, PLAYS), record, starts=1, stable=0.75, solver=solver)
    assert radius(fit) <= 0.75


def test_a_result_outside_is_moved_inside_by_a_small_step(record, full):
    limit = stable(float(full.parameters["A"].item()) * (1 - 1e-5), exact=True)
    held = full.model.with_parameters(full.model.parameters.change(r={"fixed": True}))
    problem = Problem(held, record, constraints=(limit, dc_gain(float(_gain(full)))))
    before = pilfr.GaussNewton(max_iterations=0).solve(problem)
    assert violated_exact(problem, before.theta) == [limit.name]
    after = move_inside_exact(problem, before)
    assert not violated_exact(problem, after.theta) and after.cost <= before.cost * (1 + 1e-3)
    assert abs(float(problem.constraint(after.theta)[1]) - _gain(full)) < 1e-6  # the other constraint is still met
    values = problem.model.parameters.unpack(problem.parameters(after.theta))
    assert np.array_equal(values["r"], full.parameters["r"])  # fixed parameters stay


def test_a_result_that_no_small_step_moves_inside_is_infeasible(record, full):
    held = full.model.with_parameters(full.model.parameters.change(A={"bounds": (0.75, 1.0)}))
    problem = Problem(held, record, constraints=(stable(0.5, exact=True),))
    solution = pilfr.GaussNewton(max_iterations=30).solve(problem)
    assert move_inside_exact(problem, solution).status is Status.INFEASIBLE


def _gain(fit):
    return float(Gain()({k: ca.DM(v) for k, v in fit.parameters.items()}))


@pytest.mark.parametrize("operator, slope", [(pilfr.Play, 1.0), (pilfr.Play, 0.0), (pilfr.Stop, 0.0)])
def test_the_gain_is_the_one_of_a_simulation(operator, slope):
    """A ramp to a constant: plays slip all the way (slope 1); below the thresholds they stick (slope 0)."""
    rng = np.random.default_rng(3)
    structure = pilfr.PILFR(2, pilfr.PrandtlIshlinskii(operator, 2))
    blocks = {
        k: rng.normal(size=s) * 0.3 for k, s in (("B_u", (2, 1)), ("B_w", (2, 1)), ("C_y", (1, 2)), ("C_z", (1, 2)))
    }
    blocks |= {"A": [[0.5, 0.1], [0.0, 0.3]], "D_zu": [[0.7]], "D_yu": [[0.2]], "D_yw": [[-0.4]]}
    small = (slope == 0.0) == (operator is pilfr.Play)
    model = structure.model(1, 1, {**blocks, "w": [[0.3, 0.4]], "r": [[1e-3, 2e-3]] if not small else [[1e3, 2e3]]})
    u = np.linspace(0, 50, 4000).reshape(-1, 1)
    p = {k: v.value for k, v in model.parameters.items()}
    two = []
    for top in (50.0, 60.0):
        state = np.zeros(4)
        for value in [*np.linspace(0, top, 200), *np.full(200, top)]:
            state, y = (np.asarray(v).ravel() for v in model.closed(state, value, model.parameters.start))
        two.append(y[0])
    assert len(u) and (two[1] - two[0]) / 10.0 == pytest.approx(float(Gain(slope)({k: ca.DM(v) for k, v in p.items()})))


def test_a_known_gain_and_its_multiplier(record):
    free = pilfr.fit(pilfr.hammerstein(1, PLAYS), record, starts=1)
    wanted = 1.02 * _gain(free)
    fine = {"solver": pilfr.GaussNewton(tolerance=1e-9, max_iterations=500)}
    begin = pilfr.fit(free, record, constraints=dc_gain(wanted), **fine)
    fits = [pilfr.fit(begin, record, constraints=dc_gain(g), **fine) for g in (wanted, 1.001 * wanted)]
    assert _gain(fits[0]) == pytest.approx(wanted, rel=1e-8)
    limit = next(v for v in fits[0].limits if v.name.startswith("DC gain"))
    assert limit.active and limit.met and "DC gain" in str(fits[0]) and "multiplier" in str(fits[0])
    # the multiplier is the slope of the objective over the limit
    slope = (fits[1].solution.cost - fits[0].solution.cost) / (0.001 * wanted)
    assert limit.multiplier == pytest.approx(slope, rel=0.1)


@pytest.mark.usefixtures("blank_figures")
def test_multipliers_at_a_kink_are_unknown(record, tmp_path):
    """The multipliers of the last step come from its damping, so no print, file or report shows them."""
    fit = pilfr.fit(pilfr.hammerstein(1, PLAYS), record, starts=1, constraints=dc_gain(1.1))
    assert fit.status is Status.CONVERGED and "not known" not in str(fit)
    problem = Problem(fit.model, record, constraints=(dc_gain(1.1),))
    ended = replace(fit.solution, status=Status.SMALL_STEP, multipliers=np.full(problem.size + 1, np.nan))
    limits = limits_of(problem, ended)
    assert all(np.isnan(limit.multiplier) for limit in limits if limit.active)
    stuck = replace(fit, solution=ended, limits=limits)
    assert "multipliers are not known (DC gain = 1.1)" in str(stuck)
    stuck.save(tmp_path / "m.json")
    assert np.isnan(pilfr.load(tmp_path / "m.json").limits[0].multiplier)
    page = pilfr.fit_report(stuck, record, (), tmp_path / "report").read_text()
    assert "Multipliers are not known (DC gain = 1.1)" in page


def test_multipliers_are_unknown_where_no_solver_has_stepped(record):
    fit = pilfr.fit(pilfr.hammerstein(1, PLAYS), record, starts=1, stable=0.7)
    problem = Problem(fit.model, record, constraints=stability_limits(fit.structure, 0.7))
    scaled = point_as_solution(problem, fit.solution.theta, Status.RESTORED)
    limits = limits_of(problem, scaled)
    held = [limit for limit in limits if limit.kind == "constraint" and limit.active]
    assert held and all(np.isnan(limit.multiplier) for limit in held)
    shown = str(replace(fit, solution=scaled, limits=limits))
    assert "multipliers are not known (spectral radius <= 0.7" in shown and "multiplier 0" not in shown
    assert "kink" not in shown


def test_a_model_that_diverges_has_not_converged(record):
    wild = pilfr.PILFR(2, PLAYS, fixed={"A": [[1.1, 0.0], [0.0, 0.9]]})
    fit = pilfr.fit(wild, record, starts=1, stable=False)
    assert fit.status is Status.DIVERGES and not fit.status.converged
    assert str(fit).startswith("Failed: the model diverges on the training recordings")
    assert all(len(line) < 300 for line in str(fit).splitlines())
    offset = record.with_(y=record.y + 1e5 * np.std(record.y))  # a large error without growth of the model
    assert pilfr.fit(pilfr.PILFR(1), offset).status is not Status.DIVERGES


@pytest.mark.slow
def test_a_second_fit_under_the_same_constraint_is_never_worse():
    record, gain = coupled_plays(5), [dc_gain(1.0)]
    first = pilfr.fit(pilfr.PILFR(2, PLAYS), record, starts=2, constraints=gain)
    second = pilfr.fit(first, record, constraints=gain)
    assert first.status.converged and second.status.converged
    assert second.train_nrmse[0] <= first.train_nrmse[0]
    assert second.solution.violation <= 1e-6


def test_a_gain_within_limits_is_exact(record):
    fit = pilfr.fit(pilfr.hammerstein(1, PLAYS), record, starts=1, constraints=dc_gain(1.1, within=0.01))
    assert 1.09 <= _gain(fit) <= 1.11


def test_ordered_thresholds_are_ordered_exactly(record):
    for gap in (0.0, 0.2):
        fit = pilfr.fit(
            pilfr.hammerstein(1, pilfr.PrandtlIshlinskii(pilfr.Play, 5)), record, starts=2, constraints=ordered(gap=gap)
        )
        assert np.all(np.diff(fit.parameters["r"][0]) >= gap - 1e-15)
        assert fit.status is not Status.INFEASIBLE


def test_missed_limits_are_reported(record, full):
    problem = Problem(full.model, record, constraints=(Constraint(lambda p: p["A"], upper=0.1, name="pole"),))
    limit = limits_of(problem, pilfr.GaussNewton(max_iterations=0).solve(problem))[0]
    assert not limit.met and "NOT MET, off by" in str(limit)


@pytest.mark.usefixtures("blank_figures")
def test_the_report_has_the_limits(record, tmp_path):
    fit = pilfr.fit(pilfr.hammerstein(1, PLAYS), record, starts=1, constraints=dc_gain(1.1))
    page = pilfr.fit_report(fit, record, (), tmp_path).read_text()
    assert "Constraints and active bounds" in page and "DC gain = 1.1" in page and "multiplier" in page


def test_known_entries_stay_and_the_others_are_estimated():
    rng = np.random.default_rng(0)
    u = pilfr.multisine(1500, f_max=10.0, fs=100.0, rng=rng)
    amplifier, q, stage, y = 0.0, 0.0, 0.0, np.zeros_like(u)
    for k, value in enumerate(u):
        y[k] = stage
        q = pilfr.play(amplifier, q, 0.2)
        amplifier, stage = 0.7 * amplifier + 0.3 * value, 0.9 * stage + 0.05 * amplifier + 0.15 * q
    record = pilfr.Recording(u, y, dt=0.01, initial="zero")
    fixed = {"A": [[0.7, 0.0], [np.nan, np.nan]], "B_u": [[0.3], [0.0]], "C_y": [[0.0, 1.0]]}
    fit = pilfr.fit(pilfr.PILFR(2, PLAYS, fixed=fixed, offset=False), record, starts=3)
    p = fit.parameters
    assert (
        p["A"][0].tolist() == [0.7, 0.0] and p["B_u"].tolist() == [[0.3], [0.0]] and p["C_y"].tolist() == [[0.0, 1.0]]
    )
    assert fit.train_nrmse[0] < 0.01
    assert not np.any(np.isnan(p["A"]))


def test_a_linear_model_with_known_entries(tmp_path):
    a, b, c = np.array([[0.7, 0.2], [0.0, 0.9]]), np.array([[0.0], [0.3]]), np.array([[1.0, 0.0]])
    x, u, y = np.zeros((2, 1)), np.random.default_rng(0).standard_normal(600), []
    for value in u:
        y.append(float((c @ x).item()))
        x = a @ x + b * value
    record = pilfr.Recording(u, np.array(y), dt=0.1, initial="zero")
    fixed = {"A": [[0.7, np.nan], [0.0, np.nan]], "B_u": [[0.0], [0.3]], "C_y": [[1.0, 0.0]], "D_yu": 0.0}
    fit = pilfr.fit(pilfr.PILFR(2, fixed=fixed, offset=False), record)
    assert np.allclose(fit.parameters["A"], a, atol=1e-6)
    fit.save(tmp_path / "m.json")
    loaded = pilfr.load(tmp_path / "m.json")
    assert np.array_equal(loaded.simulate(record), fit.simulate(record))
    assert np.array_equal(loaded.model.parameters["A"].fixed, [[True, False], [True, False]])


def test_the_basis_of_known_entries_is_found():
    rng = np.random.default_rng(1)
    blocks = {"A": np.diag([0.9, 0.5, -0.2]), "B_u": rng.normal(size=(3, 1)), "C_y": rng.normal(size=(1, 3))}
    known = change_basis(blocks, rng.normal(size=(3, 3)))
    wanted = {"A": np.where(rng.random((3, 3)) < 0.5, known["A"], np.nan), "B_u": known["B_u"], "C_y": known["C_y"]}
    found = find_nearest_basis(blocks, wanted)
    for name, value in wanted.items():
        np.testing.assert_allclose(found[name][~np.isnan(value)], value[~np.isnan(value)], atol=1e-6)
    assert np.allclose(np.sort(np.linalg.eigvals(found["A"]).real), [-0.2, 0.5, 0.9])


def test_pruning_keeps_the_outputs(record, full):
    penalised = pilfr.fit(full, record, l1={"w": 1e-4})
    small = pilfr.prune(penalised, record)
    n = small.structure.element.n
    assert n == max(1, int(np.sum(penalised.parameters["w"] > 0))) <= 4
    assert small.parameters["w"].shape == (1, n) and np.all(small.parameters["w"] >= 0)
    assert small.nrmse(record) < 1.05 * full.nrmse(record)
    with pytest.raises(InputError, match="operators to remove"):
        pilfr.prune(pilfr.fit(pilfr.PILFR(1), record), record)


def test_pruning_keeps_an_estimated_initial_state(record):
    there = record.slice(200, 1200).with_(initial="estimate")
    full = pilfr.fit(pilfr.hammerstein(1, pilfr.PrandtlIshlinskii(pilfr.Play, 6)), there, starts=1)
    small = pilfr.prune(pilfr.fit(full, there, l1={"w": 1e-4}), there)
    assert len(small.initial_state(there)) == 1 + small.structure.element.n
    assert small.nrmse(there) < 1.1 * full.nrmse(there)


@pytest.mark.slow
def test_operators_are_spread_over_the_density(record, full):
    fits = thin_operators(full, record, 3)
    assert len(fits) == len(SPREADINGS) and all(f.structure.element.n == 3 for f in fits)
    assert len({tuple(f.parameters["r"][0]) for f in fits}) > 1
    assert min(f.nrmse(record) for f in fits) < 2 * full.nrmse(record)
    assert all(p.prior is None for f in fits for p in f.model.parameters.values())
    element = pilfr.PrandtlIshlinskii(pilfr.Play, 4)
    bounded = pilfr.fit(pilfr.PILFR(1, element, bounds={"r": (0.0, 1.0)}), record, starts=1)
    assert thin_operators(bounded, record, 2) == ()


@pytest.mark.slow
def test_a_path_is_chosen_by_validation_alone(record, full):
    held = three_plays(7, 1200)
    path = pilfr.regularization_path(full, record, held)
    best = min(path.validation)
    assert path.validation[path.recommended] <= 1.05 * best
    assert all(v > 1.05 * best for v in path.validation[path.recommended + 1 :])
    assert path.strengths[0] == 0 and path.fits[0] is full and list(path.strengths) == sorted(path.strengths)
    assert path.fit is path.fits[path.recommended] and "<- recommended" in repr(path)
    assert path.operators[path.recommended] <= 3


def test_a_path_over_priors(record, full):
    priors = {"A": (0.75, 0.01)}
    path = pilfr.regularization_path(full, record, three_plays(7, 1200), priors=priors, strengths=(1e-3, 1e7))
    poles = [f.parameters["A"].item() for f in path.fits]
    assert abs(poles[2] - 0.75) < 0.1 * abs(poles[1] - 0.75)
    assert path.recommended < 2  # the truth is 0.8


@pytest.mark.parametrize(
    "options, says",
    [
        ({"strengths": (0.0,)}, "all above zero"),
        ({"strengths": ()}, "give one strength or more"),
        ({"margin": -1.0}, "margin of zero or more"),
        ({"margin": "a"}, "margin = 'a' were given"),
        ({"margin": None}, "margin = None were given"),
        ({"strengths": 5}, "strengths = 5 and"),
        ({"strengths": ("a",)}, r"strengths = \('a',\) and"),
        ({"strengths": (True,)}, r"strengths = \(True,\) and"),
        ({"priors": {"w": 3}}, r"3 was given as prior of 'w'; give a pair of numbers"),
    ],
)
def test_invalid_paths_are_refused(record, full, options, says):
    with pytest.raises(InputError, match=says):
        pilfr.regularization_path(full, record, three_plays(7, 1200), **options)


def test_a_path_needs_a_fit(record):
    with pytest.raises(InputError, match=r"A str was given .* give a Fit"):
        pilfr.regularization_path("f", record, three_plays(7, 1200))
    with pytest.raises(InputError, match="give a fit of one"):
        pilfr.prune("f", record)


def test_a_radius_of_fixed_parameters_is_reported_without_the_logarithm(record):
    with pytest.raises(InputError, match=r"'spectral radius <= 1' is infeasible: .* give 2, with limits 0 and 1;"):
        pilfr.fit(pilfr.PILFR(1, PLAYS, fixed={"A": 2.0}), record, starts=1)


def test_training_recordings_are_refused_for_validation(record, full):
    with pytest.raises(InputError, match="also a training recording"):
        pilfr.regularization_path(full, record, [record])


@pytest.mark.parametrize(
    "make, says",
    [
        (lambda: dc_gain(np.inf), "finite"),
        (lambda: dc_gain(1.0, within=-1.0), "of 0 or more"),
        (lambda: dc_gain(1.0, slope=2.0), "from 0 to 1"),
        (lambda: ordered(gap=-1.0), "gap"),
        (lambda: ordered("r", "a"), "The gap between the entries of 'r' is a; give a number"),
        (lambda: ordered("r", [0.1, 0.2]), r"The gap .* has the shape \(2,\); give a number"),
        (lambda: dc_gain("a"), "The value of a dc_gain cannot be 'a'; give numbers"),
        (lambda: dc_gain(None), "The value of a dc_gain"),
        (lambda: dc_gain([[1, 2], [3]]), "The value of a dc_gain"),
        (lambda: dc_gain(1, within="a"), "within of a dc_gain is a; give a number"),
        (lambda: dc_gain([1, 2], within=[1, 2, 3]), r"within of a dc_gain has the shape \(3,\)"),
        (lambda: dc_gain(1, slope="a"), "slope of a dc_gain is a; give a number"),
    ],
)
def test_invalid_known_gains_are_refused(make, says):
    with pytest.raises(InputError, match=says):
        make()


def test_an_exact_equation_is_refused(record, full):
    with pytest.raises(InputError, match="rounding does not allow"):
        Problem(full.model, record, constraints=(Constraint(lambda p: p["A"], 0.8, 0.8, exact=True),))


def test_the_check_of_a_radius_is_on_eigenvalues():
    check = RadiusExcess(0.5)
    assert check({"A": np.diag([0.5, -0.2])}) <= 0 < check({"A": np.diag([np.nextafter(0.5, 1), 0.0])})


def test_infeasible_constraints_get_one_sentence():
    for sentence in infeasible_sentences():
        assert "infeasible" in sentence or ("cannot be met" in sentence and "off by" in sentence)
        assert "\n" not in sentence


@pytest.mark.slow
def test_the_table_on_a_small_rig():
    _, rows = stability_table(100, 5, 1, radii=(0.995, 0.99))
    assert 0.98 < slowest_pole() < 1
    for row in rows:
        assert row.radius <= row.bound and row.cost <= 0.05


@pytest.mark.slow
def test_a_sparse_fit_halves_the_operators():
    case = sparse_plays(0, starts=2)
    assert case.operators[1] <= case.operators[0] / 2 and case.share <= 0.1


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"stable": "a"}, "stable = 'a'"),
        ({"stable": np.inf}, "stable = inf"),
        ({"constraints": [3]}, "a Constraint"),
        ({"constraints": 3}, "a Constraint"),
    ],
)
def test_invalid_bounds_on_the_radius_are_refused(record, given, says):
    with pytest.raises(InputError, match=says):
        pilfr.fit(pilfr.PILFR(2, PLAYS), record, starts=1, **given)


@pytest.mark.parametrize(
    "model, kind",
    [
        (pilfr.NARX(1, 2), "StaticNetwork"),
        (pilfr.NOE(1, 2), "StaticNetwork"),
        (pilfr.ssnn(1, 2), "StaticNetwork"),
        (pilfr.network_lfr(1, 2), "StaticNetwork"),
        (pilfr.PILFR(1, pilfr.PrandtlIshlinskii(pilfr.GeneralizedPlay, 2)), "GeneralizedPlay"),
        (pilfr.PILFR(1, pilfr.Combined([pilfr.Part("a", PLAYS, (0,))])).model(1, 1), "Combined"),
    ],
)
def test_a_gain_is_refused_where_its_formula_does_not_hold(record, model, kind):
    with pytest.raises(InputError, match=f"plays or stops; the model has a {kind}"):
        pilfr.fit(model, record, starts=1, constraints=dc_gain(2.0))


@pytest.fixture(scope="module")
def bounded(record):
    """Make a fit with an active bound and constraint, and the fit without them."""
    model = pilfr.hammerstein(1, pilfr.PrandtlIshlinskii(pilfr.Play, 6))
    return pilfr.fit(model, record, starts=1, stable=0.78, constraints=[ordered(gap=0.05)])


def holds(fit):
    return radius(fit) <= 0.78 and np.all(np.diff(fit.parameters["r"]) >= 0.05)


@pytest.mark.slow
def test_fits_made_from_a_fit_keep_its_bound_and_constraints(record, bounded):
    assert holds(bounded)
    for fit in (pilfr.fit(bounded, record), pilfr.prune(bounded, record), *thin_operators(bounded, record, 3)):
        assert holds(fit) and fit.options.stable == 0.78
    path = pilfr.regularization_path(bounded, record, three_plays(1, 600), strengths=(1e-5, 1e-3))
    assert all(holds(fit) for fit in path.fits)
    assert all(any(limit.name == "spectral radius <= 0.78" for limit in fit.limits) for fit in path.fits)
    priors = {"w": (0.0, 1.0)}
    assert all(
        holds(f)
        for f in pilfr.regularization_path(bounded, record, three_plays(1, 600), priors=priors, strengths=(1.0,)).fits
    )


def test_new_options_replace_the_options_of_a_fit(record, bounded):
    again = pilfr.prune(bounded, record, stable=0.7)
    assert radius(again) <= 0.7 and np.all(np.diff(again.parameters["r"]) >= 0.05)
    free = pilfr.fit(bounded, record, stable=True, constraints=())
    assert radius(free) > 0.78 and not free.options.constraints
    assert next(limit.name for limit in free.limits if limit.kind == "constraint") == "spectral radius <= 1"


def test_a_loaded_fit_keeps_its_bound_and_needs_its_constraints(record, bounded, tmp_path):
    bounded.save(tmp_path / "m.json")
    loaded = pilfr.load(tmp_path / "m.json")
    assert loaded.options.stable == 0.78
    for again in (pilfr.fit, pilfr.prune):
        with pytest.raises(InputError, match=r"cannot store \(r ascending\); give them again"):
            again(loaded, record)
    assert holds(pilfr.prune(loaded, record, constraints=[ordered(gap=0.05)]))
    assert radius(pilfr.fit(loaded, record, constraints=())) <= 0.78
    pilfr.fit(pilfr.hammerstein(1, PLAYS), record, starts=1, stable=False).save(tmp_path / "free.json")
    assert pilfr.load(tmp_path / "free.json").options.stable is False


def test_a_linear_model_without_a_bound_meets_its_constraints(record):
    gain = float(Gain()({k: ca.DM(v) for k, v in pilfr.fit(pilfr.PILFR(2), record).parameters.items()}))
    fit = pilfr.fit(pilfr.PILFR(2), record, stable=False, constraints=[dc_gain(1.2 * gain)])
    assert float(Gain()({k: ca.DM(v) for k, v in fit.parameters.items()})) == pytest.approx(1.2 * gain, rel=1e-5)
