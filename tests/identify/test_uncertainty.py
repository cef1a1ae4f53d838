"""Gauge freedoms: tangents, and standard errors checked by Monte Carlo."""

import casadi as ca
import numpy as np
import pytest
from random_models import OPERATORS, envelope, random_input, random_lfr, reference

from pilfr_casadi.data import Recording
from pilfr_casadi.identify import (
    covariance,
    gauge_tangents,
    generators,
    gradient_covariance,
    standard_errors,
    variance,
)
from pilfr_casadi.models import (
    GeneralizedPlay,
    Parameter,
    ParameterSet,
    Play,
    PrandtlIshlinskii,
    Stop,
    hammerstein,
    open_model,
    wiener,
)
from pilfr_casadi.optimise import Constraint, GaussNewton, Problem


def signals(operator, values, u, state=None):
    """Reference simulation from rest: y, z, w, last state."""
    return reference(operator, values, u, np.zeros(len(values["A"]) + values["w"].size) if state is None else state)


def crossing(values, channel):
    """Whether the envelopes of a generalized play cross somewhere."""
    ends = [[envelope(values, side, channel, z) for z in np.linspace(-60.0, 60.0, 241)] for side in "lr"]
    return np.any(np.subtract(*ends) > 2 * values["r"][channel].min())


def moved(values, operator, rng, mild=1.0):
    """Return the model in a random gauge, with operators and channels in another order, and the map of its state."""
    nx, (n_w, n) = len(values["A"]), values["w"].shape
    general = operator is GeneralizedPlay
    t, _ = np.linalg.qr(rng.normal(size=(nx, nx)))
    t = t * np.exp(mild * rng.uniform(-1, 1, nx)) if nx else t
    inverse = np.linalg.inv(t)
    sign = rng.choice([-1.0, 1.0], n_w)
    if general:  # the mirror image of envelopes that cross is another element
        sign = np.where([crossing(values, i) for i in range(n_w)], 1.0, sign)
    of_z, of_v, of_w = np.exp(rng.uniform(-1, 1, (3, n_w)))
    of_v = of_v if general else of_z
    out = {k: np.array(v) for k, v in values.items()}
    out["A"], out["B_u"], out["C_y"] = inverse @ values["A"] @ t, inverse @ values["B_u"], values["C_y"] @ t
    out["C_z"] = (sign * of_z)[:, None] * (values["C_z"] @ t)
    out["D_zu"] = (sign * of_z)[:, None] * values["D_zu"]
    out["B_w"], out["D_yw"] = (b / (sign * of_v * of_w) for b in (inverse @ values["B_w"], values["D_yw"]))
    out["r"], out["w"] = of_v[:, None] * values["r"], of_w[:, None] * values["w"]
    if general:
        shift = rng.uniform(-0.9, 2.0, (n_w, 1)) * values["r"].min(axis=1, keepdims=True)
        out["r"] += of_v[:, None] * shift
        values = values | {"gamma_l_c": values["gamma_l_c"] + shift, "gamma_r_c": values["gamma_r_c"] - shift}
        for side, other in (("l", "r"), ("r", "l")):
            for name, scale in {"c": of_v, "a0": of_v / of_z, "a": of_v, "b": 1 / of_z, "d": np.ones(n_w)}.items():
                straight, mirror = (values[f"gamma_{s}_{name}"] * scale[:, None] for s in (side, other))
                mirror = -mirror if name in "cd" else mirror
                out[f"gamma_{side}_{name}"] = np.where(sign[:, None] > 0, straight, mirror)
    memory = np.zeros((n_w, n, n_w, n))
    for i in range(n_w):
        order = rng.permutation(n)
        out["r"][i], out["w"][i] = out["r"][i][order], out["w"][i][order]
        memory[i, :, i, :] = sign[i] * of_v[i] * np.eye(n)[order]
    channels = rng.permutation(n_w)
    for name in out:
        if name in ("C_z", "D_zu", "r", "w") or name.startswith("gamma_"):
            out[name] = out[name][channels]
        elif name in ("B_w", "D_yw"):
            out[name] = out[name][:, channels]
    change = np.zeros((nx + n_w * n,) * 2)
    change[:nx, :nx] = inverse
    change[nx:, nx:] = memory[channels].reshape(n_w * n, n_w * n)
    return out, change


# ---- tangents ----


@pytest.mark.parametrize("operator", OPERATORS)
@pytest.mark.parametrize("n_w", [1, 2])
def test_generators_are_tangents_of_freedoms(operator, n_w):
    """A small step along each leaves the outputs alone, to second order, from any state."""
    structure, values = random_lfr(1, n_u=2, n_w=n_w, n=3, operator=operator)
    if operator is Play:
        values["r"][0, 0] = 0.0  # passes z on
    u = random_input(1, 40, 2)
    state = np.random.default_rng(0).normal(size=3 + 3 * n_w)
    y = signals(operator, values, u, state)[0]
    found = list(generators(structure, values))
    of_a_channel = 5 if operator is GeneralizedPlay else 2
    assert len(found) == 9 + n_w * of_a_channel + (operator is Play)
    h = 1e-6
    for change, move in found:
        ahead, back = (
            signals(operator, {k: v + s * change.get(k, 0.0) for k, v in values.items()}, u, state + s * move(state))[0]
            for s in (h, -h)
        )
        slope = (ahead - back) / (2 * h)
        assert np.max(np.abs(slope)) < 1e-7 * np.max(np.abs(y))


def disturbance(seed, length, n_y=1, colour=0.0):
    """Noise `e(k) = colour e(k-1) + white`, (length, n_y), independent of every input here."""
    e = np.random.default_rng([seed, 1]).normal(size=(length + 50, n_y))
    for k in range(1, len(e)):
        e[k] += colour * e[k - 1]
    return e[50:]


def recorded(structure, values, u, noise=0.0, seed=0, state=None, colour=0.0, **options):
    n = len(values["A"]) + (values["w"].size if "w" in values else 0)
    model = structure.model(u.shape[1], len(values["C_y"]), values)
    y = Problem(model, Recording(u=u, y=np.ones((len(u), model.n_y)), dt=1.0, initial="zero"), engine="vm", scale=[1.0])
    if state is None:
        y = y.simulate(y.start)[0]
    else:
        y = y.engine.simulate(u, model.parameters.start, np.resize(state, n))[0]
    y = y + noise * disturbance(seed, *y.shape, colour)
    return model, Recording(u=u, y=y, dt=1.0, **options)


@pytest.mark.parametrize("operator", OPERATORS)
@pytest.mark.parametrize("initial", ["estimate", "zero", "given"])
def test_the_null_space_of_the_jacobian_is_the_gauge(operator, initial):
    structure, values = random_lfr(5, nx=2, n=2, operator=operator)
    if operator is Play:
        values["r"][0, 0] = 0.0
    u = random_input(5, 400)
    u[:30] *= np.linspace(0.02, 1.0, 30)[:, None]  # so that memories stay for a while, each for a different time
    state = np.array([0.05, -0.05, 0.0, 0.0])
    z = (values["C_z"] @ state[:2] + values["D_zu"] @ u[0]).item()  # the first sample does not move this memory
    state[2:] = z if operator is not GeneralizedPlay else sum(envelope(values, s, 0, z) for s in ("l", "r")) / 2
    model, recording = recorded(structure, values, u, initial=state if initial == "given" else initial)
    problem = Problem(model, recording, engine="vm")
    theta = problem.start.copy()
    if initial == "estimate":
        theta[-4:] = state
    held = theta == problem.lower
    tangents = gauge_tangents(problem, theta, structure, held)
    expected = {Play: 4 + 2 + 1, Stop: 4 + 2, GeneralizedPlay: 4 + 5}[operator]
    if initial == "given":  # a given state leaves only the transformations that keep it
        expected -= 2 + 1
    if initial == "zero" and operator is GeneralizedPlay:
        expected -= 1  # an offset needs another initial state
    assert np.linalg.matrix_rank(tangents) == expected
    jac = problem.jacobian(theta)
    assert np.max(np.abs(jac @ tangents)) < 1e-12 * np.max(np.abs(jac))
    usable = ~held & np.any(jac != 0, axis=0)
    spectrum = np.linalg.svd(jac[:, usable] / np.linalg.norm(jac[:, usable], axis=0), compute_uv=False)
    assert np.sum(spectrum < 1e-10 * spectrum[0]) == expected


def test_fixed_blocks_leave_fewer_freedoms():
    for build, left in ((hammerstein, 4 + 1), (wiener, 4 + 1)):
        structure = build(2, PrandtlIshlinskii(Play, 3))
        _, values = random_lfr(3, nx=2, n=3)
        model, recording = recorded(structure, values, random_input(3, 300), initial="zero")
        problem = Problem(model, recording, engine="vm")
        tangents = gauge_tangents(problem, problem.start, structure, np.zeros(problem.size, dtype=bool))
        assert np.linalg.matrix_rank(tangents) == left
        assert np.max(np.abs(problem.jacobian(problem.start) @ tangents)) < 1e-11


# ---- standard errors ----


def spring(**changes):
    """A driven oscillator in physical parameters: no gauge freedom."""
    parameters = ParameterSet(
        {"k": Parameter(40.0, bounds=(1.0, 1e3)), "d": Parameter(1.5), "m": Parameter(2.0, fixed=True)}
    )
    h = 0.05

    def step(x, u, w, p):
        force = u - p["k"] * x[0] - p["d"] * x[1]
        velocity = x[1] + h * force / p["m"]
        return ca.vertcat(x[0] + h * velocity, velocity), x[0]

    model = open_model(step, lambda x, u, p: x[:0], parameters, n_x=2, n_u=1, n_w=0)
    return model.with_parameters(model.parameters.change(**changes))


def oscillator(noise, seed, length=400, colour=0.0, initial="zero", model=None):
    model = model or spring()
    u = random_input(0, length)
    clean = Problem(model, Recording(u=u, y=u, dt=0.05, initial="zero"), engine="vm", scale=[1.0])
    y = clean.simulate(clean.start)[0] + noise * disturbance(seed, length, colour=colour)
    return Problem(model, Recording(u=u, y=y, dt=0.05, initial=initial), engine=clean.engine)


def test_a_grey_box_without_gauge_is_the_classical_formula():
    problem = oscillator(2e-3, 1, length=2000)
    solution = GaussNewton().solve(problem)
    jac, e = problem.jacobian(solution.theta), problem.residual(solution.theta)
    expected = np.linalg.inv(jac.T @ jac) * (e @ e) / (len(e) - 2)
    np.testing.assert_allclose(covariance(problem, solution.theta), expected, rtol=1e-9)
    errors = standard_errors(problem, solution.theta)
    assert errors["k"] == pytest.approx(np.sqrt(expected[0, 0]))
    assert errors["k"].shape == ()
    assert np.isnan(errors["m"])


def well_spread(pivots):
    """Whether (estimate - truth) / reported error has zero mean and unit variance, shape (seeds, n)."""
    n = len(pivots)
    return np.all(np.abs(np.mean(pivots, axis=0)) < 4 / np.sqrt(n)) and np.all(
        np.abs(np.mean(np.square(pivots), axis=0) - 1) < 4 * np.sqrt(2 / n)
    )


@pytest.mark.slow
@pytest.mark.parametrize("colour", [0.0, 0.8])
def test_monte_carlo_of_a_grey_box(colour):
    """60 noise seeds; with coloured noise the classical formula would be off by a factor of up to three."""
    pivots, classical = [], []
    for seed in range(60):
        problem = oscillator(2e-3, seed, colour=colour, initial="estimate")
        solution = GaussNewton().solve(problem)
        truth = problem.start  # the parameters that made the data, from rest
        pivots.append((solution.theta - truth) / np.sqrt(np.diag(covariance(problem, solution.theta))))
        jac, e = problem.jacobian(solution.theta), problem.residual(solution.theta)
        deviation = np.sqrt(np.diag(np.linalg.inv(jac.T @ jac)) * (e @ e) / (len(e) - 4))
        classical.append((solution.theta - truth) / deviation)
    assert well_spread(pivots)
    assert well_spread(classical) == (colour == 0)


@pytest.mark.parametrize("colour", [pytest.param(0.0, marks=pytest.mark.slow), 0.7])
def test_monte_carlo_of_a_pi_lfr(colour):
    """Gauge-invariant functions by the delta method, 30 noise seeds."""
    structure, values = random_lfr(21, nx=2, n=2, gain=0.5)
    u = random_input(21, 1000)
    values["r"][0] = np.std(signals(Play, values, u)[1]) * np.array([0.3, 1.0])
    pivots, engine = [], "auto"
    for seed in range(30):
        model, recording = recorded(structure, values, u, noise=0.01, seed=seed, colour=colour, initial="zero")
        problem = Problem(model, recording, engine=engine)
        engine = problem.engine  # of the same model for every seed
        truth = invariant(structure, problem, problem.start)
        theta = GaussNewton(tolerance=1e-9).solve(problem).theta
        matrix = variance(covariance(problem, theta, structure), slopes(structure, problem, theta))
        pivots.append((invariant(structure, problem, theta) - truth) / np.sqrt(np.diag(matrix)))
    assert well_spread(pivots)


def test_white_noise_is_not_mistaken_for_coloured():
    """Forty parameters in a narrow band leave a notch in the residual that is not in the noise."""
    structure, values = random_lfr(18, nx=8, n=4)
    u = random_input(18, 600)
    u = np.cumsum(np.cumsum(u, axis=0), axis=0)
    u = (u - u.mean()) / u.std()
    model, recording = recorded(structure, values, u, noise=0.05, initial="zero")
    problem = Problem(model, recording, engine="vm")
    theta = GaussNewton(max_iterations=30).solve(problem).theta
    _, _, hessian = problem.normal(theta)
    size, vectors = np.linalg.eigh(hessian)
    seen = size > 1e-9 * size[-1]
    weights = vectors[:, seen] / np.sqrt(size[seen])
    e = problem.residual(theta)
    white = np.eye(seen.sum()) * (e @ e) / (len(e) - seen.sum()) / len(e)
    np.testing.assert_allclose(gradient_covariance(problem, theta, weights), white, rtol=0.02, atol=0.02 * white[0, 0])


def invariant(structure, problem, theta):
    """Trace and determinant of A, static gain of the linear part, a ratio of thresholds, and the offset."""
    p = problem.model.parameters.unpack(problem.parameters(theta))
    gain = p["C_y"] @ np.linalg.solve(np.eye(structure.nx) - p["A"], p["B_u"]) + p["D_yu"]
    return np.array(
        [np.trace(p["A"]), np.linalg.det(p["A"]), gain.item(), p["r"].min() / p["r"].max(), p["y_0"].item()]
    )


def slopes(structure, problem, theta, h=1e-6):
    ends = [
        (invariant(structure, problem, theta + d), invariant(structure, problem, theta - d))
        for d in h * np.eye(len(theta))
    ]
    return np.array([(a - b) / (2 * h) for a, b in ends]).T


def test_variance_of_functions():
    matrix = np.array([[4.0, 1.0, 0.0], [1.0, 9.0, 0.0], [0.0, 0.0, np.inf]])
    assert variance(matrix, [1.0, 1.0, 0.0]) == 15.0
    assert variance(matrix, [0.0, 0.0, 1e-9]) == np.inf
    found = variance(matrix, [[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 1.0, 1.0]])
    assert found[:2, :2].tolist() == [[4.0, 2.0], [2.0, 36.0]]
    assert np.isinf(found[2, 2])


def test_errors_of_invariants_do_not_depend_on_the_gauge():
    structure, values = random_lfr(12, nx=2, n=3)
    u = random_input(12, 500)
    _, recording = recorded(structure, values, u, noise=0.02, initial="zero")
    other, _ = moved(values, Play, np.random.default_rng(0))
    found = []
    for v in (values, other):
        problem = Problem(structure.model(1, 1, v), recording, engine="vm")
        matrix = covariance(problem, problem.start, structure)
        found.append(variance(matrix, slopes(structure, problem, problem.start)))
    np.testing.assert_allclose(found[0], found[1], rtol=1e-4)


def test_scale_invariance():
    """The error of a parameter follows its unit."""
    structure, values = random_lfr(13, nx=2, n=2)
    u = random_input(13, 300)
    model, recording = recorded(structure, values, u, noise=0.05, initial="zero")
    big = recording.with_(u=1000 * recording.u)
    changed = {**values, **{k: values[k] / 1000 for k in ("B_u", "D_yu", "D_zu")}}
    a = Problem(model, recording, engine="vm")
    b = Problem(structure.model(1, 1, changed), big, engine="vm")
    errors_a, errors_b = standard_errors(a, a.start, structure), standard_errors(b, b.start, structure)
    for name in errors_a:
        factor = 1000 if name in ("B_u", "D_yu", "D_zu") else 1
        np.testing.assert_allclose(errors_b[name] * factor, errors_a[name], rtol=1e-6)


def test_bounds_and_fixed_entries_have_no_error():
    problem = oscillator(2e-3, 0, model=spring(k={"value": 45.0, "bounds": (45.0, 100.0)}, m={"fixed": False}))
    theta = problem.start.copy()
    errors = standard_errors(problem, theta)
    assert np.isnan(errors["k"])
    free = oscillator(2e-3, 0, model=spring(k={"value": 45.0, "fixed": True}, m={"fixed": False}))
    for name in ("d", "m"):  # the others as if it were fixed
        np.testing.assert_allclose(errors[name], standard_errors(free, free.start)[name], rtol=1e-9)
    theta[0] += 1e-14  # within rounding of the bound
    assert np.isnan(standard_errors(problem, theta)["k"])
    assert np.all(covariance(problem, theta)[0] == 0)


def test_a_variable_that_matters_at_its_bound_is_not_moved_there():
    """The slope of a saturated neuron has almost no effect at its value, but has one at its bound."""
    parameters = ParameterSet(
        {
            "gain": Parameter(1e-12, bounds=(0, 9)),
            "slope": Parameter(16.0, bounds=(0, np.inf)),
            "offset": Parameter(3.0),
        }
    )

    def step(x, u, w, p):
        return x, p["gain"] * u + ca.tanh(p["slope"] * u) + p["offset"]

    model = open_model(step, lambda x, u, p: x, parameters, n_x=0, n_u=1, n_w=0)
    u = np.random.default_rng(0).uniform(1.0, 1.2, (100, 1))
    y = 4 + 0.01 * np.random.default_rng(1).standard_normal(u.shape)
    problem = Problem(model, Recording(u=u, y=y, dt=1.0, initial="zero"), engine="vm")
    errors = standard_errors(problem, problem.start)
    assert np.isnan(errors["gain"])  # within rounding of its bound
    assert errors["slope"] > 1e6
    assert 0 < errors["offset"] < 0.1


def test_an_active_constraint_is_projected_out():
    model = spring(m={"fixed": False})
    problem = oscillator(2e-3, 0, model=model)
    tied = Problem(
        model,
        problem.recordings,
        engine=problem.engine,
        constraints=[Constraint(lambda p: p["k"] - 20 * p["m"], 0.0, 0.0)],
    )
    matrix = covariance(tied, tied.start)
    np.testing.assert_allclose(np.array([1.0, 0.0, -20.0]) @ matrix, 0.0, atol=1e-12)
    loose = Problem(
        model, problem.recordings, engine=problem.engine, constraints=[Constraint(lambda p: p["k"], upper=60.0)]
    )
    np.testing.assert_allclose(covariance(loose, loose.start), covariance(problem, problem.start), rtol=1e-12)
    assert matrix[0, 0] < covariance(problem, problem.start)[0, 0]


def test_a_constraint_that_only_fixes_the_gauge_changes_no_invariant():
    structure, values = random_lfr(21, nx=2, n=2, gain=0.5)
    u = random_input(21, 500)
    model, recording = recorded(structure, values, u, noise=0.01, initial="zero")
    free = Problem(model, recording, engine="vm")
    total = float(values["w"].sum())
    limits = [
        Constraint(lambda p: ca.sum2(p["w"]), total, total),
        Constraint(lambda p: p["A"][0, 1] - p["A"][1, 0], *[float(values["A"][0, 1] - values["A"][1, 0])] * 2),
    ]
    tied = Problem(model, recording, engine="vm", constraints=limits)
    slope = slopes(structure, free, free.start)
    found = [variance(covariance(p, p.start, structure), slope) for p in (free, tied)]
    np.testing.assert_allclose(found[1], found[0], rtol=1e-6, atol=1e-9 * np.max(np.abs(found[0])))
    matrix = covariance(tied, tied.start, structure)
    np.testing.assert_allclose(tied.constraint_jacobian(tied.start) @ matrix, 0.0, atol=1e-12)


def test_undetermined_parameters_have_infinite_errors():
    structure, values = random_lfr(14, nx=2, n=3)
    values["r"][0] = [0.2, 50.0, 0.7]  # the second play never moves
    values["r"][0, 2] = 0.7
    u = random_input(14, 300)
    model, recording = recorded(structure, values, u, noise=0.01, initial="zero")
    problem = Problem(model, recording, engine="vm")
    errors = standard_errors(problem, problem.start, structure)
    assert np.isinf(errors["w"][0, 1])
    assert np.isinf(errors["r"][0, 1])
    assert np.isfinite(errors["w"][0, [0, 2]]).all()
    assert np.isfinite(errors["A"]).all()


def test_two_equal_operators_have_infinite_errors():
    structure, values = random_lfr(15, nx=2, n=3)
    values["r"][0], values["w"][0] = [0.5, 0.5, 1.0], [0.3, 0.3, 0.4]
    u = random_input(15, 300)
    model, recording = recorded(structure, values, u, noise=0.01, initial="zero")
    problem = Problem(model, recording, engine="vm")
    errors = standard_errors(problem, problem.start, structure)
    assert np.isinf(errors["w"][0, :2]).all()
    assert np.isinf(errors["r"][0, :2]).all()
    assert np.isfinite(errors["w"][0, 2])
    assert np.isfinite(errors["C_y"]).all()


def test_a_gauge_without_generators_gives_infinite_errors():
    structure, values = random_lfr(16, nx=2, n=2)
    u = random_input(16, 300)
    model, recording = recorded(structure, values, u, noise=0.01, initial="zero")
    problem = Problem(model, recording, engine="vm")
    without = standard_errors(problem, problem.start)
    assert np.isinf(without["A"]).all()
    assert np.isfinite(without["D_yu"]).all()
    assert np.isfinite(without["y_0"]).all()
    np.testing.assert_allclose(without["D_yu"], standard_errors(problem, problem.start, structure)["D_yu"], rtol=1e-6)


def test_fewer_samples_than_parameters_give_infinite_errors():
    problem = oscillator(2e-3, 0, length=3, initial="estimate", model=spring(m={"fixed": False}))
    errors = standard_errors(problem, problem.start)
    assert all(np.all(np.isnan(e) | np.isinf(e)) for e in errors.values())


def test_a_prior_counts_with_its_weight_in_the_problem():
    plain, held = oscillator(2e-3, 0), oscillator(2e-3, 0, model=spring(k={"prior": (40.0, 1e-3)}))
    loose = Problem(
        held.model, held.recordings, engine=held.engine, noise=float(np.sqrt(np.mean(held.residual(held.start) ** 2)))
    )
    errors = standard_errors(loose, loose.start)
    assert errors["k"] == pytest.approx(1e-3, rel=0.01)
    assert standard_errors(plain, plain.start)["k"] > 10 * errors["k"]


def test_outputs_may_have_different_noise():
    """Two outputs without common parameters have the same errors as each alone."""
    structure, values = random_lfr(17, nx=0, n_u=1, n_y=2, n_w=0)
    u = random_input(17, 500)
    model = structure.model(1, 2, values)
    rng = np.random.default_rng(0)
    y = u @ values["D_yu"].T + values["y_0"] + rng.normal(size=(500, 2)) * [0.01, 0.5]
    problem = Problem(model, Recording(u=u, y=y, dt=1.0, initial="zero"), engine="vm")
    theta = GaussNewton().solve(problem).theta
    errors = standard_errors(problem, theta, structure)
    design = np.column_stack([u[:, 0], np.ones(500)])
    for i in range(2):
        _, rest, _, _ = np.linalg.lstsq(design, y[:, i], rcond=None)
        alone = np.sqrt(np.diag(np.linalg.inv(design.T @ design)) * rest / (500 - 2))
        np.testing.assert_allclose([errors["D_yu"][i, 0], errors["y_0"][i]], alone, rtol=5e-3)
