"""`fit`: refused arguments, reports, the L1 penalty, and workers that cannot begin."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import pilfr_casadi
from pilfr_casadi._base import InputError
from pilfr_casadi.identify import Fit, fit, hold_all_but_element, linear_model, normalise_weights
from pilfr_casadi.linear import select_order
from pilfr_casadi.models import PILFR, Play, PrandtlIshlinskii, hammerstein, wiener
from pilfr_casadi.optimise import Constraint, GaussNewton, Ipopt, Problem
from problems.zoo_case import excitation, noisy, plays, simulate_lfr

FEEDBACK = {
    "A": 0.97 * np.array([[0.9, 0.3], [-0.3, 0.9]]),
    "B_u": np.array([[0.1], [0.3]]),
    "B_w": np.array([[0.0], [-0.15]]),
    "C_y": np.array([[1.0, 0.2]]),
    "D_yu": np.zeros((1, 1)),
    "D_yw": np.zeros((1, 1)),
    "C_z": np.array([[1.0, 0.0]]),
    "D_zu": np.zeros((1, 1)),
}
HAMMERSTEIN = {**FEEDBACK, "B_u": np.zeros((2, 1)), "C_z": np.zeros((1, 2)), "D_zu": np.ones((1, 1))}
STATIC = {
    "A": np.zeros((0, 0)),
    "B_u": np.zeros((0, 1)),
    "B_w": np.zeros((0, 1)),
    "C_y": np.zeros((1, 0)),
    "D_yu": np.zeros((1, 1)),
    "D_yw": np.ones((1, 1)),
    "C_z": np.zeros((1, 0)),
    "D_zu": np.ones((1, 1)),
}
WEIGHTS, THRESHOLDS = np.array([[0.5, 0.3, 0.4]]), np.array([[0.2, 0.6, 1.0]])


def layer(n=10):
    return PrandtlIshlinskii(Play, n)


def recorded(blocks, seed=3, samples=1200):
    rng = np.random.default_rng(seed)
    u = excitation(rng, samples)
    return noisy(u, simulate_lfr(blocks, u, plays(WEIGHTS, THRESHOLDS)), rng, 0.005)


@pytest.fixture(scope="module")
def record():
    return recorded(FEEDBACK)


@pytest.fixture(scope="module")
def linear(record):
    return fit(PILFR(2, offset=False), record)


def test_one_fit_under_every_name():
    assert pilfr_casadi.fit is fit and pilfr_casadi.Fit is Fit


# ---- refused arguments ----


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (lambda r: fit(PILFR(2), r, progress=3), "progress = 3"),
        (lambda r: fit(PILFR(2), r, executor=3), "executor = 3 was given"),
        (lambda r: fit(PILFR(2), r, l1={"w": 1e-4}), "linear model"),
        (lambda r: fit(PILFR(2, layer()), r, l1=["w"]), "by name"),
        (lambda r: fit(PILFR(100, layer()), r), "choose a smaller model"),
        (lambda r: fit(PILFR(2, layer()), r, l1={"v": 1e-4}), "no parameter 'v'"),
        (lambda r: fit(PILFR(2, layer()), r, l1={"w": -1}), "0 or more"),
        (lambda r: fit(PILFR(2, layer()), r, l1={"A": 1.0}), "lower bound of zero"),
        (lambda r: fit(PILFR(2, layer()), r, start="best"), "'best' is unknown"),
        (lambda r: fit(PILFR(2, layer()), r, solver=Ipopt), "give an object"),
        (lambda r: fit(Play, r), "give a PILFR"),
        (lambda r: GaussNewton(qp="foo"), "'foo'"),
        (lambda r: GaussNewton(max_iterations=-1), "max_iterations is -1"),
        (lambda r: GaussNewton(tolerance=np.nan), "tolerance=nan"),
        (lambda r: GaussNewton(time_limit=np.nan), "time_limit=nan"),
        (lambda r: Ipopt(max_iterations="x"), "max_iterations is 'x'"),
        (lambda r: Ipopt(options={"foo": 1}), "'foo' with the value 1"),
        (lambda r: Ipopt(options={"print_level": "loud"}), "'print_level'"),
        (lambda r: Ipopt(options="quiet"), "by name"),
        (lambda r: fit(hammerstein(1, layer()), two_inputs(r)), "channels=2"),
        (lambda r: fit(wiener(1, PrandtlIshlinskii(Play, 3, channels=2)), r), "channels=1"),
    ],
)
def test_wrong_arguments_are_refused_in_one_sentence(wrong, words, record):
    with pytest.raises(InputError, match=words) as caught:
        wrong(record)
    assert "\n" not in str(caught.value) and str(caught.value).endswith(".")


def two_inputs(record):
    return record.with_(u=np.hstack([record.u, record.u[::-1]]), inputs=("a", "b"))


@pytest.mark.parametrize("options", [{"start": "paper"}, {"start": {"A": 0.5}}, {"linear": "bla"}, {"stable": 0.9}])
def test_options_for_a_pilfr_are_refused_for_other_models(options, linear, record):
    with pytest.raises(InputError, match="was given for a Model"):
        fit(linear.model, record, **options)
    if "stable" not in options:  # which bounds the fit of a PI-LFR again
        with pytest.raises(InputError, match="was given for a Fit"):
            fit(linear, record, **options)


@pytest.mark.parametrize("method", ["simulate", "signals", "initial_state"])
def test_only_recordings_are_simulated(method, linear, record):
    with pytest.raises(InputError, match="give a Recording"):
        getattr(linear, method)(record.u)


# ---- reports ----


def test_progress_reports_every_stage(record):
    seen = []
    found = fit(PILFR(2, layer(4)), record, starts=2, progress=lambda *report: seen.append(report), l1={"w": 1e-5})
    stages = list(dict.fromkeys(stage for stage, *_ in seen))
    assert stages == ["subspace", "linear model", "starts", "steps", "polish", "solve", "L1 penalty", "standard errors"]
    assert all(0 <= done <= total for _, done, total, _ in seen)
    assert all(np.isnan(error) or error > 0 for *_, error in seen)
    assert [(done, total) for stage, done, total, _ in seen if stage == "starts"] == [(0, 2), (1, 2), (2, 2)]
    last = [error for stage, *_, error in seen if stage == "linear model"][-1]
    problem, solution = linear_model([record], PILFR(2))[1:]
    assert last == pytest.approx(problem.nrmse(solution.theta)[0], rel=1e-3)
    assert seen[-1][3] == found.train_nrmse[0]  # the error that the result prints
    assert all(np.isnan(error) for stage, *_, error in seen if stage in ("subspace", "steps", "solve", "L1 penalty"))


def test_progress_shows_the_error_that_the_result_prints(record):
    """With two different recordings, weights and a prior the cost differs from the NRMSE."""
    pair = (record, record.with_(y=3 * record.y, name="threefold"))
    model = PILFR(2, offset=False, priors={"D_yu": (0.5, 0.1)})
    values = {name: p.value for name, p in fit(PILFR(2, offset=False), record).model.parameters.items()}
    seen = []
    found = fit(model, pair, start=values, weights=(1.0, 8.0), progress=lambda *report: seen.append(report))
    assert [error for *_, error in seen if np.isfinite(error)] == [np.mean(found.train_nrmse)]


@pytest.mark.parametrize("orders", [range(1, 5), [4]])
def test_the_choice_of_an_order_reports_orders(orders, record):
    seen = []
    select_order(record, orders, progress=lambda *report: seen.append(report))
    assert {stage for stage, *_ in seen} == {"choosing the order"}
    assert [done for _, done, *_ in seen] == sorted(done for _, done, *_ in seen)
    assert seen[-1][1:3] == (len(orders), len(orders))


@pytest.mark.parametrize("flag", [True, False, None])
def test_progress_may_be_a_flag(flag, record, linear):
    found = fit(PILFR(2, offset=False), record, progress=flag)
    np.testing.assert_array_equal(found.solution.theta, linear.solution.theta)


def test_a_linear_model_with_bounds_is_solved_within_them(record, linear):
    bound = 0.9 * np.max(linear.parameters["A"])
    assert np.max(fit(PILFR(2, bounds={"A": (-bound, bound)}, offset=False), record).parameters["A"]) <= bound


# ---- the L1 penalty ----


@pytest.mark.parametrize(
    ("structure", "blocks"),
    [
        pytest.param(PILFR(2, layer(), offset=False), FEEDBACK, marks=pytest.mark.slow),
        pytest.param(hammerstein(2, layer(), offset=False), HAMMERSTEIN, marks=pytest.mark.slow),
        (PILFR(0, layer(), fixed={"D_yu": 0.0}, offset=False), STATIC),
    ],
    ids=["feedback", "hammerstein", "static"],
)
def test_l1_prunes_the_element_without_a_change_of_scale(structure, blocks):
    train = recorded(blocks)
    plain = fit(structure, train, starts=1)
    sparse = fit(structure, train, starts=1, l1={"w": 1e-4})
    harder = fit(structure, train, starts=1, l1={"w": 1e-3})
    weights = [f.parameters["w"] for f in (plain, sparse, harder)]
    idle = [int(np.sum(w == 0)) for w in weights]
    assert idle[0] <= 5 and min(idle[1:]) >= 6  # the truth has three operators of the ten
    # the scale is fixed: the weights begin at a sum of one, and the penalty lowers it a little
    assert 0.9 < weights[2].sum() < weights[1].sum() < 1.0
    assert sparse.train_nrmse[0] < 1.1 * plain.train_nrmse[0] < 0.02
    assert harder.train_nrmse[0] < 0.05
    for name, p in sparse.model.parameters.items():
        np.testing.assert_array_equal(p.fixed, plain.model.parameters[name].fixed)
        if name not in ("w", "r", "B_w", "D_yw"):
            np.testing.assert_allclose(p.value, harder.parameters[name], rtol=1e-9)
    assert f"{idle[1]} of 10 entries of w are exactly zero" in str(sparse)
    assert "prior" not in sparse.note and all(p.prior is None for p in sparse.model.parameters.values())


def test_a_free_scale_evades_the_penalty(record):
    """A penalty on a model with all blocks free: the weights shrink, B_w grows, the output stays."""
    free = fit(PILFR(2, layer(3), offset=False), record, starts=2)
    model = normalise_weights(free.model)
    problem = Problem(model, [record], l1={"w": 1e-3})
    theta = GaussNewton(max_iterations=60).solve(problem).theta
    evaded = problem.parameters(theta)[model.parameters.position("w")]
    assert evaded.sum() < 0.7
    assert problem.nrmse(theta)[0] < 1.5 * free.train_nrmse[0]


def test_unit_weights_change_no_output(record):
    found = fit(PILFR(2, layer(4), offset=False), record, starts=1)
    scaled = normalise_weights(found.model)
    assert scaled.parameters["w"].value.sum() == pytest.approx(1.0, rel=1e-12)
    y = found.simulate(record)
    np.testing.assert_allclose(replace(found, model=scaled).simulate(record), y, atol=1e-9 * np.ptp(y))


@pytest.mark.parametrize(
    "change",
    [
        {"w": {"bounds": (0.0, 5.0)}},
        {"B_w": {"fixed": True}},
        {"D_yw": {"bounds": (-9.0, 9.0)}},
        {"w": {"prior": (1.0, 1.0)}},
    ],
)
def test_bounds_priors_and_fixed_entries_keep_the_scale_of_weights(change, record):
    values = {"B_w": np.ones((2, 1)), "w": np.ones((1, 4))}
    model = PILFR(2, layer(4)).model(1, 1, values)
    model = model.with_parameters(model.parameters.change(**change))
    np.testing.assert_array_equal(normalise_weights(model).parameters["w"].value, 1.0)


def test_only_the_element_is_free():
    model = PILFR(2, layer(4), fixed={"r": 0.5}).model(1, 1)
    held = hold_all_but_element(model, {"w": 1.0})
    assert {name for name, p in held.parameters.items() if not np.all(p.fixed)} == {"w", "y_0"}


def test_l1_on_an_earlier_fit(record):
    found = fit(PILFR(2, layer(6), offset=False), record, starts=1)
    sparse = fit(found, record, l1={"w": 1e-3})
    assert 0.9 < sparse.parameters["w"].sum() < 1.0
    assert "L1 penalty" in sparse.note and sparse.structure is found.structure
    assert np.all(sparse.model.parameters.free == found.model.parameters.free)
    with pytest.raises(InputError, match="linear model"):
        fit(fit(PILFR(2), record), record, l1={"w": 1e-3})


def test_l1_with_ipopt_and_a_constraint(record):
    limit = Constraint(lambda p: p["w"][0, 0], upper=0.02)
    found = fit(PILFR(2, layer(4), offset=False), record, starts=1, l1={"w": 1e-3}, solver=Ipopt(), constraints=limit)
    assert found.parameters["w"][0, 0] <= 0.02 + 1e-6
    assert len(found.solution.multipliers) == len(found.solution.theta) + 3


# ---- workers ----

SCRIPT = """
import multiprocessing, sys
import numpy as np
import pilfr_casadi as pilfr
from pilfr_casadi import InputError

def work():
    rng = np.random.default_rng(0)
    u = np.cumsum(rng.standard_normal((200, 1)), axis=0)
    train = pilfr.Recording(u=u, y=0.5 * u + 0.1 * rng.standard_normal((200, 1)), dt=0.1)
    model = pilfr.PILFR(0, pilfr.PrandtlIshlinskii(pilfr.Play, 2))
    try:
        print(pilfr.fit(model, train, starts=2, workers=2, engine="vm").train_nrmse)
    except InputError as error:
        print("InputError:", error)

"""
CALLS = {
    "bare": "multiprocessing.set_start_method('spawn', force=True)\nwork()\n",
    "guarded": "if __name__ == '__main__':\n    multiprocessing.set_start_method('spawn')\n    work()\n",
}


@pytest.mark.parametrize("call", CALLS)
def test_spawned_workers(call, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT + CALLS[call])
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr, done.stderr
    lines = done.stdout.strip().splitlines()
    assert len(lines) == 1
    if call == "bare":
        assert lines[0].startswith("InputError:") and '`if __name__ == "__main__":`' in lines[0]
    else:
        assert float(lines[0].strip("(),")) < 1


def test_start_values_are_not_broadcast():
    recording = pilfr_casadi.Recording(np.sin(np.arange(80.0)), np.cos(np.arange(80.0)), 0.1)
    structure = pilfr_casadi.PILFR(2, pilfr_casadi.PrandtlIshlinskii(pilfr_casadi.Play, 3))
    with pytest.raises(
        pilfr_casadi.InputError, match=r"The start of 'A' has the shape \(1, 2\); give a number or an array"
    ):
        pilfr_casadi.fit(structure, recording, start={"A": [[0.9, 0.1]]})


def delayed_recording():
    """A lag behind a delay of its sensor, recorded from the middle of its motion; and the simulator with the delay."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.standard_normal((90, 1)), 10, axis=0)
    machine = pilfr_casadi.Simulator(
        lambda x, u, p: {"v": -x.v / p.tau + u.f},
        lambda x: {"v": x.v},
        states=("v",),
        inputs=("f",),
        parameters={"tau": pilfr_casadi.Parameter(0.5, bounds=(0.05, 5))},
    ).with_element("sensor:v", pilfr_casadi.laws.Delay().at({"T": 0.2}, {"T": (0.01, 0.4)}))
    true = machine.with_parameters({"tau": 0.3})
    whole = pilfr_casadi.Recording(u, np.zeros((len(u), 0)), 0.02, inputs=("f",), initial="zero", hold="zero")
    y = true.simulate(whole) + 1e-3 * rng.standard_normal((len(u), 1))
    cut = [slice(100, 500), slice(500, 900)]
    return machine, *(pilfr_casadi.Recording(u[k], y[k], 0.02, inputs=("f",), outputs=("v",), hold="zero") for k in cut)


def test_a_simulator_with_a_long_delay_is_fitted_again_tested_and_loaded(tmp_path):
    """Its unknown start counts by the samples before the recording, not by the steps of its integration."""
    machine, train, test = delayed_recording()
    fitted = pilfr_casadi.fit(machine, train)
    again = pilfr_casadi.fit(fitted, train)
    assert again.train_nrmse == pytest.approx(fitted.train_nrmse, rel=1e-2)
    assert fitted.nrmse(test) < 0.02
    with pytest.warns(UserWarning, match="not the simulator.s equations"):
        fitted.save(tmp_path / "model.json")
    loaded = pilfr_casadi.load(tmp_path / "model.json", model=fitted.model)
    assert loaded.nrmse(test) == pytest.approx(fitted.nrmse(test), rel=1e-6)
