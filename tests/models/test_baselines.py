"""Black-box baselines: each recovers a system of its class, and works as any other model."""

import json
import subprocess

import numpy as np
import pytest
from random_models import random_input

import pilfr_casadi as pilfr
from pilfr_casadi._base import InputError, ordered_digest
from pilfr_casadi.engine import make_engine
from pilfr_casadi.identify import gauge_tangents, solve_with_early_stopping, split_validation
from pilfr_casadi.models import read_measured_output
from pilfr_casadi.optimise import Problem

NOISE = 0.01
rng = np.random.default_rng(5)
LINEAR = {"A": [[0.8, 0.2], [-0.2, 0.7]], "B_u": [[0.5], [0.3]], "C_y": [[1.0, 0.4]], "y_0": [0.3]}
STRUCTURES = {
    "ssnn": (pilfr.ssnn(2, 2), {"B_w": rng.normal(size=(2, 4)) / 3, "D_yw": rng.normal(size=(1, 4)) / 3}),
    "network_lfr": (pilfr.network_lfr(2, 3), {"B_w": [[0.6], [-0.5]], "D_yw": [[0.2]]}),
    "NARX": (pilfr.NARX(2, 3).structure(1, 1), {}),
    "wide": (pilfr.NARX(2, 3, input_lags=3).structure(2, 2), {}),
}


def truth(name):
    """A closed model of a class with random numbers, stable by its bounded neurons and a stable A."""
    structure, more = STRUCTURES[name]
    draw, n_io = np.random.default_rng(7), 2 if name == "wide" else 1
    model = structure.model(n_io, n_io)
    values = {}
    for key, p in model.parameters.items():
        value = np.where(p.fixed, p.value, draw.normal(size=p.value.shape))
        scale = {"A": 0.1, "B_u": 0.4, "C_z": 0.8, "B_w": 0.5}.get(key, 1.0)
        values[key] = np.where(p.fixed, value, scale * value)
    if name in ("ssnn", "network_lfr"):
        values |= {k: np.array(v) for k, v in {**LINEAR, **more}.items()}
        values["D_yw"] = np.where(model.parameters["D_yw"].fixed, 0.0, values["D_yw"])
        values["B_w"] = np.where(model.parameters["B_w"].fixed, 0.0, values["B_w"])
    elif name == "NARX":
        values["A"][0] = [1.2, -0.5, 0.1]
    return model.with_parameters(model.parameters.change(**{k: {"value": v} for k, v in values.items()}))


def recordings(model, noise=NOISE, length=1200, process=0.0):
    """A training and a test recording from rest, with white noise on the output, or on the predicted one."""
    found = []
    for seed in (1, 2):
        u = random_input(seed, length, len(model.inputs))
        draw = np.random.default_rng(10 + seed)
        y = make_engine(model, "vm").simulate(u, model.parameters.start, np.zeros(model.n_x))[0]
        size = np.std(y, axis=0)
        if process:
            y = disturbed(model, u, process * size * draw.normal(size=y.shape))
        y = y + noise * size * draw.normal(size=y.shape)
        found.append(pilfr.Recording(u, y, 0.01, initial="zero", hold="zero"))
    return found


def disturbed(model, u, e):
    """Simulate a NARX with an error in each output that enters the following ones."""
    x, p, y = np.zeros(model.n_x), model.parameters.start, np.empty_like(e)
    for k, u_k in enumerate(u):
        y[k] = np.asarray(model.closed(x, u_k, p)[1]).ravel() + e[k]
        x[: e.shape[1]] = y[k] - model.parameters["y_0"].value
        x = np.asarray(model.closed(x, u_k, p)[0]).ravel()
    return y


def floor(recording):
    return NOISE / np.sqrt(1 + NOISE**2)


@pytest.mark.parametrize("name", ["ssnn", "network_lfr"])
def test_a_network_recovers_its_own_class(name):
    train, test = recordings(truth(name))
    fit = pilfr.fit(STRUCTURES[name][0], train, starts=6, seed=0)
    assert fit.status.converged
    assert fit.nrmse(test) < 1.1 * floor(test)
    assert fit.linear_nrmse[0] > 5 * fit.train_nrmse[0]


@pytest.mark.parametrize("build", [pilfr.hammerstein, pytest.param(pilfr.wiener, marks=pytest.mark.slow)])
def test_hysteresis_before_or_behind_a_linear_model_is_recovered(build):
    structure = build(2, pilfr.PrandtlIshlinskii(pilfr.Play, 3))
    values = {"A": LINEAR["A"], "w": [[0.5, 0.4, 0.3]], "r": [[0.1, 0.5, 1.0]]}
    inside = {"B_w": [[0.5], [0.3]], "C_y": [[1.0, 0.4]], "B_u": [[0.5], [0.3]], "C_z": [[1.0, 0.4]]}
    values |= {k: v for k, v in inside.items() if k not in structure.fixed}
    model = structure.model(1, 1, values)
    found = []
    for seed in (1, 2):
        u = random_input(seed, 1200)
        y = make_engine(model, "vm").simulate(u, model.parameters.start, np.zeros(model.n_x + model.n_s))[0]
        y = y + NOISE * np.std(y) * np.random.default_rng(seed).normal(size=y.shape)
        found.append(pilfr.Recording(u, y, 0.01, initial="zero"))
    fit = pilfr.fit(structure, found[0], starts=3)
    assert fit.nrmse(found[1]) < 1.15 * floor(found[1])


def test_a_narx_predicts_to_the_noise_where_the_noise_enters_its_equation():
    model = truth("NARX")
    train, test = recordings(model, noise=0.0, process=0.05)
    fit = pilfr.fit(pilfr.NARX(2, 3), train, starts=4, seed=0)
    e = pilfr.one_step(fit, test) - test.y
    simulated = make_engine(model, "vm").simulate(test.u, model.parameters.start, np.zeros(model.n_x))[0]
    assert np.std(e) < 1.05 * 0.05 * np.std(simulated)
    assert fit.nrmse(test) > 1.5 * np.std(e) / np.std(test.y)  # in free run errors add up


def test_a_noe_simulates_to_the_noise_of_the_output_and_a_narx_does_not():
    train, test = recordings(truth("NARX"), noise=0.1)
    narx = pilfr.fit(pilfr.NARX(2, 3), train, starts=2, seed=0)
    noe = pilfr.fit(pilfr.NOE(2, 3), train, starts=4, seed=0)
    level = 0.1 / np.sqrt(1.01)
    assert noe.nrmse(test) < 1.05 * level < narx.nrmse(test)
    size = np.std(train.y)
    one, other = (np.sqrt(np.mean((pilfr.one_step(f, train) - train.y) ** 2)) / size for f in (narx, noe))
    assert one < other


@pytest.mark.parametrize("share", [None, 1.0, 0.3])
@pytest.mark.parametrize("name", list(STRUCTURES))
def test_derivatives(name, share):
    if share is not None and name not in ("NARX", "wide"):
        return
    model = truth(name)
    train = recordings(model, length=60)[0].with_(initial="estimate")
    if share is not None:
        model = read_measured_output(model, share)
    engines = [Problem(model, train, engine=engine) for engine in ("vm", "auto")]
    theta = engines[0].start + 0.05 * np.random.default_rng(1).normal(size=engines[0].size)
    jac, again = (p.jacobian(theta) for p in engines)
    np.testing.assert_allclose(again, jac, rtol=1e-9, atol=1e-10)
    step = 1e-6
    columns = [
        (engines[0].residual(theta + d) - engines[0].residual(theta - d)) / (2 * step)
        for d in step * np.eye(len(theta))
    ]
    np.testing.assert_allclose(jac, np.array(columns).T, rtol=1e-5, atol=1e-6)


def test_reading_the_output_is_a_regression():
    model = truth("wide")
    train = recordings(model, length=50)[0]
    known = {k: p.value for k, p in model.parameters.items()}
    past = [(train.y - known["y_0"], 0), (train.y - known["y_0"], 1), (train.u, 1), (train.u, 2)]
    states = np.hstack([np.vstack([np.zeros((k, 2)), v[: len(v) - k]]) for v, k in past])
    z = states @ known["C_z"].T + train.u @ known["D_zu"].T
    following = states @ known["A"].T + train.u @ known["B_u"].T
    following += np.tanh(z + known["bias"].ravel()) @ known["B_w"].T
    read = read_measured_output(model)
    y = make_engine(read, "vm").simulate(read.drive(train), read.parameters.start, np.zeros(read.n_x))[0]
    np.testing.assert_allclose(y[1:], following[:-1, :2] + known["y_0"], atol=1e-12)
    free = read_measured_output(model, 0.0)
    one, two = (
        make_engine(m, "vm").simulate(m.drive(train), m.parameters.start, np.zeros(m.n_x))[0] for m in (model, free)
    )
    np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize("name", ["ssnn", "network_lfr"])
def test_gauge_directions_of_networks_change_no_output(name):
    structure, _ = STRUCTURES[name]
    model = truth(name)
    train = recordings(model, length=120)[0].with_(initial="estimate")
    problem = Problem(model, train, engine="vm")
    tangents = gauge_tangents(problem, problem.start, structure, np.zeros(problem.size, dtype=bool))
    assert tangents.shape[1] == {"ssnn": 4, "network_lfr": 6}[name]  # the basis of two states; scales of z and of w
    np.testing.assert_allclose(problem.jacobian(problem.start) @ tangents, 0.0, atol=1e-9)


def fitted(name):
    train, test = recordings(truth(name), length=300)
    models = {"NARX": pilfr.NARX(2, 3), "wide": pilfr.NOE(2, 3, input_lags=3)}
    return pilfr.fit(models.get(name, STRUCTURES[name][0]), train, starts=1), test


@pytest.mark.parametrize("name", list(STRUCTURES))
def test_saved_and_exported(name, tmp_path):
    fit, test = fitted(name)
    fit.save(tmp_path / "model.json")
    again = pilfr.load(tmp_path / "model.json")
    np.testing.assert_array_equal(again.simulate(test), fit.simulate(test))
    assert again.structure.element == fit.structure.element
    step, x, y = again.to_casadi(), np.zeros(again.model.n_x), []
    for u in test.u[:50]:
        x, y_k = step(x, u)
        y.append(np.asarray(y_k).ravel())
    np.testing.assert_allclose(y, fit.simulate(test)[:50], rtol=1e-9, atol=1e-12)
    c_file, _ = again.export(name="rig").to_c(tmp_path)
    assert not subprocess.run(["cc", "-c", str(c_file), "-o", str(tmp_path / "rig.o")]).returncode
    assert fit.plot(test).axes


def test_a_damaged_network_is_refused(tmp_path):
    fit, _ = fitted("network_lfr")
    fit.save(tmp_path / "model.json")
    content = json.loads((tmp_path / "model.json").read_text())
    del content["sha256"]
    for hidden, words in ((3_000_000, "expected"), (0, "whole number|expected"), ("three", "hidden")):
        content["structure"]["element"]["hidden"] = hidden
        text = json.dumps({**content, "sha256": ordered_digest(content)})
        (tmp_path / "model.json").write_text(text)
        with pytest.raises(pilfr.InputError, match=words):
            pilfr.load(tmp_path / "model.json")


def test_the_seed_decides_the_result_and_workers_do_not():
    train = recordings(truth("NARX"), length=300)[0]
    one = pilfr.fit(pilfr.NARX(2, 3), train, starts=2, seed=3)
    two = pilfr.fit(pilfr.NARX(2, 3), train, starts=2, seed=3, workers=2)
    other = pilfr.fit(pilfr.NARX(2, 3), train, starts=2, seed=4)
    np.testing.assert_array_equal(one.solution.theta, two.solution.theta)
    assert not np.array_equal(one.solution.theta, other.solution.theta)


def test_bad_input():
    train = recordings(truth("NARX"), length=300)[0]
    narx = pilfr.fit(pilfr.NARX(1, 1), train, starts=1)
    linear = pilfr.fit(pilfr.PILFR(2), train)
    for wrong, words in (
        (lambda: pilfr.NARX(0), "lags is 0; give a whole number"),
        (lambda: pilfr.NARX(2, 2.5), "hidden is 2.5"),
        (lambda: pilfr.NOE(2, input_lags=-1), "input_lags is -1"),
        (lambda: pilfr.NOE(2, validation=1.0), "validation = 1.0"),
        (lambda: pilfr.ssnn(2, 0), "hidden of a static network is 0; give a whole number"),
        (lambda: pilfr.StaticNetwork(3, True), "channels of a static network is True"),
        (lambda: pilfr.one_step(linear, train), "Only a NARX or NOE"),
        (lambda: pilfr.one_step(narx, train.y), "give a Recording"),
        (lambda: pilfr.fit(pilfr.NOE(2), train, solver=pilfr.Ipopt()), "Early stopping needs"),
        (lambda: pilfr.fit(pilfr.NARX(200, 5), train), "at least"),
        (lambda: pilfr.fit(pilfr.NARX(2, 5), train, l1={"gain": 1e-3}), "An L1 penalty"),
    ):
        with pytest.raises(pilfr.InputError, match=words):
            wrong()


# ---- early stopping ----


def test_early_stopping_returns_the_best_point_on_validation_data():
    train, _ = recordings(truth("network_lfr"), noise=0.3, length=160)
    structure = pilfr.network_lfr(2, 6)
    model = pilfr.fit(structure, train, starts=1, start="plain", solver=pilfr.GaussNewton(max_iterations=1)).model
    (kept,), (held,), _ = split_validation([train], 0.4)
    problem, judged = Problem(model, kept, engine="vm"), Problem(model, held, engine="vm")
    seen = []
    free = pilfr.GaussNewton().solve(problem, watch=lambda theta: seen.append(judged.cost(theta)) or False)
    found = solve_with_early_stopping(pilfr.GaussNewton(), problem, judged, problem.start)
    assert judged.cost(found.theta) <= min(seen) * (1 + 1e-12)
    assert judged.cost(found.theta) < judged.cost(free.theta)
    assert found.status is pilfr.Status.STOPPED_EARLY and found.status.converged
    assert found.cost == pytest.approx(problem.cost(found.theta))


def test_split_of_training_and_validation_data():
    one = pilfr.Recording(np.arange(100.0), np.arange(100.0), 0.1, initial="zero", skip=20)
    (kept,), (held,), told = split_validation([one], 0.25)
    assert (len(kept), len(held), held.skip) == (80, 100, 80)
    periodic = one.with_(initial="periodic", period=30, skip=0)
    for given, period in ((periodic, 30), (periodic.with_(period=60), 60), (periodic.slice(0, 60), 30)):
        (kept,), (held,), told = split_validation(
            [given], 0.2
        )  # the mean period is cut: whole ones have the same input
        cut = round(0.8 * period)
        assert (len(kept), held.skip, len(held)) == (cut, period + cut, 2 * period) and "mean period" in told
        assert kept.initial == "estimate" and held.initial == "zero"
        assert np.array_equal(held.y[period : period + cut], kept.y)
    for period in (30, 60):  # known, but the start is no steady state: what is held back need not be whole periods
        (kept,), (held,), told = split_validation([one.with_(initial="estimate", period=period)], 0.25)
        assert (len(kept), held.skip, held.period) == (80, 80, None) and len(held) == 100
    several = [one.with_(name=str(k), initial="estimate") for k in range(4)]
    several = [r.with_(u=np.random.default_rng(k).normal(size=100)) for k, r in enumerate(several)]
    kept, held, told = split_validation(several, 0.25)
    assert [r.name for r in kept] == ["0", "1", "2"] and [r.name for r in held] == ["3"]
    assert held[0].initial == "zero" and held[0].skip == 20 and not told
    assert split_validation([r.with_(period=80) for r in several], 0.25)[1][0].skip == 20
    again = [several[k].with_(name=name) for k, name in ((0, "a"), (1, "b"), (0, "c"), (1, "d"))]
    kept, held, _ = split_validation(again, 0.25)  # what is held back has an input of its own
    assert [r.name for r in kept] == ["a", "c"] and [r.name for r in held] == ["b", "d"]
    kept, held, told = split_validation([again[0], again[2]], 0.25)  # one input: each is cut in time
    assert [len(r) for r in kept] == [80, 80] and [r.skip for r in held] == [80, 80] and not told
    sine = one.with_(u=np.sin(2 * np.pi * np.arange(100) / 20), initial="estimate")
    assert "proves little" in split_validation([sine], 0.25)[2]


def test_a_noe_of_recordings_whose_inputs_repeat():
    train, _ = recordings(truth("NARX"), length=240)
    quick, steady = pilfr.GaussNewton(max_iterations=10), train.slice(120).with_(initial="periodic", period=120)
    fit = pilfr.fit(pilfr.NOE(2, 3), steady, starts=1, solver=quick)
    assert "mean period" in fit.note and "mean period" in str(fit)
    first, second = (train.slice(k, k + 120).with_(initial="estimate") for k in (0, 120))
    several = [first, second, first.with_(y=1.01 * first.y), second.with_(y=1.01 * second.y)]
    fit = pilfr.fit(pilfr.NOE(2, 3), several, starts=1, solver=quick)
    assert len(fit.train_nrmse) == 4 and max(fit.train_nrmse) < 0.5 and not fit.note


def test_a_noe_of_a_periodic_recording_whose_start_is_estimated():
    train = recordings(truth("NARX"), length=400)[0].with_(initial="estimate", period=150)
    quick = pilfr.GaussNewton(max_iterations=30)
    assert pilfr.fit(pilfr.NOE(2, 3), train, starts=1, solver=quick).train_nrmse[0] < 0.3


@pytest.mark.parametrize("wanted", [pilfr.NARX(2, 3), pilfr.NOE(2, 3, validation=0.0), pilfr.ssnn(2, 2)])
def test_a_fit_that_ends_at_a_limit_gives_advice(wanted):
    train = recordings(truth("NARX"), length=400)[0]
    fit = pilfr.fit(wanted, train, starts=1, solver=pilfr.GaussNewton(max_iterations=2))
    assert fit.status is pilfr.Status.MAX_ITERATIONS
    assert str(fit).splitlines()[1] == fit.status.advice and "max_iterations=1000" in fit.status.advice
    assert not pilfr.Status.CONVERGED.advice


def test_a_noe_of_several_recordings_has_a_state_for_each(tmp_path):
    records = [r.slice(100, 400) for r in recordings(truth("NARX"))]
    fit = pilfr.fit(pilfr.NOE(2, 3), records, starts=1)
    assert len(fit.initial) == 2 and len(fit.solution.theta) == len(fit.labels)
    assert fit.train_nrmse[0] < 0.05 and fit.train_nrmse[1] < 0.5
    fit.save(tmp_path / "model.json")
    again = pilfr.load(tmp_path / "model.json")
    np.testing.assert_array_equal(again.simulate(records[1]), fit.simulate(records[1]))


@pytest.mark.parametrize("kind", [pilfr.NARX, pilfr.NOE])
@pytest.mark.parametrize(
    "options, says", [({"stable": 0.9}, "stable = 0.9"), ({"start": "paper"}, "'paper'"), ({"start": "plain"}, "plain")]
)
def test_options_that_a_lagged_model_ignores_are_refused(kind, options, says):
    train, _ = recordings(truth("NARX"))
    with pytest.raises(InputError, match=f"{says}.*was given for a {kind.__name__}"):
        pilfr.fit(kind(2, 3), train, **options)


@pytest.mark.parametrize("linear", [True, False])
@pytest.mark.parametrize("lags, input_lags", [(2, None), (3, 1), (1, 4)])
def test_the_unknowns_of_a_lagged_model_are_its_free_parameters(linear, lags, input_lags):
    model = pilfr.NARX(lags, 3, input_lags, linear=linear)
    assert model.unknowns(2, 3) == int(model.model(2, 3).parameters.free.sum())


def test_too_many_lags_are_refused_before_the_model_is_built(monkeypatch):
    train, _ = recordings(truth("NARX"))
    monkeypatch.setattr(pilfr.NARX, "structure", lambda *_: pytest.fail("built"))
    with pytest.raises(InputError, match="give at most 20000 parameters"):
        pilfr.fit(pilfr.NARX(2000), train)


@pytest.mark.parametrize(
    "wanted, stages", [(pilfr.NARX(2, 2), 1), (pilfr.NOE(2, 2), 4), (pilfr.NOE(2, 2, validation=0.0), 4)]
)
def test_every_step_of_a_start_is_reported(wanted, stages):
    model = truth("NARX")
    record = recordings(model, length=300)[0]
    seen, told = [], []
    fit = pilfr.fit(wanted, record, starts=2, progress=lambda *report: seen.append(report))
    steps = [done for stage, done, *_ in seen if stage == "steps"]
    assert steps.count(0) >= 2 * stages and len(steps) > 4 * stages
    assert [done for stage, done, *_ in seen if stage == "starts"] == [0, 1, 2]
    assert fit.errors == {}  # they would be those of a minimum of the simulation error
    if not wanted.validation:
        pilfr.fit(wanted, record, starts=1, solver=Own(), progress=lambda *report: told.append(report))
        assert told[-1][0] == "standard errors"


class Own:
    """A user-defined solver without progress reports."""

    def solve(self, problem, start=None):
        """As the package's own."""
        return pilfr.GaussNewton(max_iterations=2).solve(problem, start)
