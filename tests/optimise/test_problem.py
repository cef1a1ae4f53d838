"""The simulation-error problem: cost, derivatives, initial states, penalties, constraints."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from random_models import OPERATORS, random_input, random_lfr, reference

import pilfr_casadi as pilfr
from pilfr_casadi._base import InputError
from pilfr_casadi.data import Recording
from pilfr_casadi.engine import make_engine
from pilfr_casadi.models import Parameter, ParameterSet, Play, open_model
from pilfr_casadi.optimise import Constraint, Problem, problem as module, stable
from pilfr_casadi.optimise.penalties import state_precision


def recording(seed=0, length=80, n_u=1, n_y=1, **options):
    u = random_input(seed, length, n_u)
    y = random_input([seed, 1], length, n_y) * np.arange(1, n_y + 1)
    return Recording(u=u, y=y, dt=0.1, **options)


def problem(recordings=None, seed=0, changes=None, options=None, **sizes):
    structure, values = random_lfr(seed, **sizes)
    n_u, n_y = values["B_u"].shape[1], len(values["C_y"])
    model = structure.model(n_u, n_y, values)
    model = model.with_parameters(model.parameters.change(**(changes or {})))
    recordings = recordings or recording(seed, n_u=n_u, n_y=n_y, initial="zero")
    return Problem(model, recordings, engine="vm", **(options or {})), values


def somewhere(p, seed=0, size=1e-3):
    return np.clip(p.start + size * np.random.default_rng(seed).normal(size=p.size), p.lower, p.upper)


def central(f, theta, h=1e-6):
    return np.array([(f(theta + d) - f(theta - d)) / (2 * h) for d in h * np.eye(len(theta))]).T


def states(n, seed=3):
    return np.random.default_rng(seed).normal(size=n)


RECORDINGS = {
    "zero": lambda: recording(0, initial="zero"),
    "given": lambda: recording(0, initial=states(3)),
    "given with memory": lambda: recording(0, initial=states(7)),
    "estimate": lambda: recording(0),
    "periodic": lambda: recording(0, period=40, initial="periodic"),
    "skip": lambda: recording(0, skip=25),
    "several": lambda: [
        recording(0, initial="zero"),
        recording(1, 60),
        recording(2, 50, period=25, initial="periodic", skip=10),
        recording(3, 70, initial=states(7), skip=3),
        recording(4, 40),
    ],
}
every_recording = pytest.mark.parametrize("kind", RECORDINGS)


# ---- the cost is Eq. 20 ----


def test_cost_is_half_the_mean_square_over_all_outputs():
    r = recording(1, 60, n_u=2, n_y=3, initial="zero", skip=7)
    p, values = problem(r, seed=1, n_u=2, n_y=3, n_w=2)
    y = reference(Play, values, r.u, np.zeros(3 + 8))[0]
    e = ((y - r.y) / np.std(r.y[7:], axis=0))[7:]
    assert p.residuals == e.size == 53 * 3
    assert p.cost(p.start) == pytest.approx(0.5 * np.mean(e**2), rel=1e-12)
    np.testing.assert_allclose(p.residual(p.start), e.ravel(), atol=1e-12)
    np.testing.assert_allclose(p.simulate(p.start)[0], y, atol=1e-12)
    nrmse = np.sqrt(np.mean((y - r.y)[7:] ** 2, axis=0)) / np.std(r.y[7:], axis=0)
    assert p.nrmse(p.start) == pytest.approx([np.mean(nrmse)])


def test_recordings_count_by_their_scored_samples():
    a, b = recording(0, 60, initial="zero"), recording(1, 30, initial="zero", skip=10)
    both, _ = problem([a, b])
    alone = [problem(r, options={"scale": both.scale})[0] for r in (a, b)]
    expected = (60 * alone[0].cost(both.start) + 20 * alone[1].cost(both.start)) / 80
    assert both.cost(both.start) == pytest.approx(expected)


@every_recording
def test_initial_states_follow_the_recording(kind):
    recordings = RECORDINGS[kind]()
    p, _ = problem(recordings)
    theta = somewhere(p)
    found = p.initial_states(theta)
    at = int(p.free.sum())
    for r, state, y in zip(p.recordings, found, p.simulate(theta), strict=True):
        assert state.shape == (7,)
        now = p.model.parameters.unpack(p.parameters(theta))
        if isinstance(r.initial, str) and r.initial == "estimate":
            np.testing.assert_array_equal(state, theta[at : at + 7])
            at += 7
        elif isinstance(r.initial, str):
            assert not state.any()
        else:
            np.testing.assert_array_equal(state[: r.initial.size], r.initial)
            assert not state[r.initial.size :].any()
        if isinstance(r.initial, str) and r.initial == "periodic":
            for _ in range(100):
                state = reference(Play, now, r.u[: r.period], state)[3]
        np.testing.assert_allclose(y, reference(Play, now, r.u, state)[0], atol=1e-6 if r.period else 1e-11)
    assert at == p.size
    assert len(p.labels) == p.size


def test_labels_name_the_variables():
    p, _ = problem([recording(0, initial="zero"), recording(1)], changes={"A": {"fixed": True}}, n=2)
    assert p.labels[0] == "B_u[0,0]"
    assert p.labels[-1] == "initial[1].4"
    assert len(p.labels) == p.size


# ---- derivatives ----


@every_recording
def test_gradient_and_jacobian(kind):
    p, _ = problem(RECORDINGS[kind]())
    theta = somewhere(p)
    value, gradient, hessian = p.normal(theta)
    assert value == pytest.approx(p.cost(theta), rel=1e-12)
    jac, e = p.jacobian(theta), p.residual(theta)
    np.testing.assert_allclose(gradient, jac.T @ e / len(e), atol=1e-12)
    np.testing.assert_allclose(hessian, jac.T @ jac / len(e), atol=1e-12 * np.max(np.abs(hessian)))
    np.testing.assert_allclose(gradient, central(p.cost, theta), rtol=1e-4, atol=1e-5 * np.max(np.abs(gradient)))


@pytest.mark.parametrize("operator", OPERATORS)
def test_gradient_of_every_operator(operator):
    p, _ = problem(
        recording(2, n_u=2, n_y=2, skip=5),
        seed=2,
        operator=operator,
        n=2,
        n_u=2,
        n_y=2,
        n_w=2,
        changes={"C_z": {"fixed": True}},
    )
    theta = somewhere(p)
    _, gradient, _ = p.normal(theta)
    np.testing.assert_allclose(gradient, central(p.cost, theta), rtol=1e-4, atol=1e-5 * np.max(np.abs(gradient)))


@every_recording
@pytest.mark.parametrize("numbers", [1, 60, 1000])
def test_stretches_of_any_length_give_the_same(kind, numbers, monkeypatch):
    p, _ = problem(RECORDINGS[kind]())
    theta = somewhere(p)
    whole, jac = p.normal(theta), p.jacobian(theta)
    monkeypatch.setattr(module, "STRETCH_ENTRIES", numbers)
    assert len(list(p.stretches(theta))) > len(p.recordings)
    for a, b in zip(p.normal(theta), whole, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12 * np.max(np.abs(b)))
    np.testing.assert_array_equal(p.jacobian(theta), jac)


def test_skipped_samples_are_simulated_but_do_not_count():
    r = recording(0, skip=30, initial="zero")
    other = r.with_(y=np.concatenate([r.y[:30] + 100.0, r.y[30:]]))
    a, b = problem(r)[0], problem(other)[0]
    np.testing.assert_array_equal(a.residual(a.start), b.residual(b.start))
    np.testing.assert_array_equal(a.normal(a.start)[1], b.normal(b.start)[1])
    whole, _ = problem(r.with_(skip=0), options={"scale": a.scale})
    np.testing.assert_array_equal(whole.residual(a.start)[30:], a.residual(a.start))


def test_unscored_samples_are_simulated_but_do_not_count():
    r = recording(0, skip=5, n_y=2, initial="estimate")
    keep = np.random.default_rng(3).random(len(r)) > 0.4
    whole, _ = problem(r, n_y=2)
    part, _ = problem(r, n_y=2, options={"scored": [keep], "scale": whole.scale})
    theta, rows = somewhere(whole), np.repeat(keep[5:], 2)
    assert part.residuals == rows.sum()
    np.testing.assert_array_equal(part.residual(theta), whole.residual(theta)[rows])
    np.testing.assert_array_equal(part.jacobian(theta), whole.jacobian(theta)[rows])
    np.testing.assert_allclose(part.normal(theta)[1], part.jacobian(theta).T @ part.residual(theta) / part.residuals)


def test_a_prior_of_initial_states_runs_whole_samples():
    structure, values = random_lfr(0)
    engine = make_engine(structure.model(1, 1, values), "vm")
    lengths = []

    class Counting:
        linear = replace(engine.linear, substeps=3)

        def simulate(self, u, p, state):
            lengths.append(len(u))
            return engine.simulate(u, p, state)

    model = engine.linear.sizes
    p = structure.model(1, 1, values).parameters.start
    drive = random_input(1, 3 * 1000, 1)
    assert state_precision(Counting(), drive, p, model["x"], model["s"]) is not None
    assert sum(lengths) == 3000 and all(n % 3 == 0 for n in lengths)


def test_a_diverging_simulation_has_an_infinite_cost():
    p, _ = problem(recording(0, 600, initial="zero"))
    wild = p.start.copy()
    wild[:9] = 30 * np.eye(3).ravel()
    assert p.cost(wild) == np.inf
    assert not np.all(np.isfinite(p.residual(wild)))
    with np.errstate(all="ignore"):
        assert not np.isfinite(p.normal(wild)[0])


# ---- penalties ----


def test_priors_add_their_quadratic_cost():
    """½ Σ ((θ - m)/s)² v/R: the prior acts like one more measurement in units of the noise."""
    changes = {"A": {"prior": (0.5, 0.1)}, "w": {"prior": (np.full((1, 4), 0.2), 0.3)}, "y_0": {"prior": (1.0, 2.0)}}
    plain, _ = problem()
    held, _ = problem(changes=changes, options={"noise": 0.05})
    theta = somewhere(held)
    named = held.model.parameters.unpack(held.parameters(theta))
    expected = sum(np.sum(((named[k] - c["prior"][0]) / c["prior"][1]) ** 2) for k, c in changes.items())
    assert held.cost(theta) - plain.cost(theta) == pytest.approx(0.5 * expected * 0.05**2 / held.residuals)
    _, gradient, hessian = held.normal(theta)
    np.testing.assert_allclose(gradient, central(held.cost, theta), rtol=1e-4, atol=1e-5 * np.max(np.abs(gradient)))
    difference = hessian - plain.normal(theta)[2]
    np.testing.assert_allclose(difference, np.diag(np.diag(difference)), atol=1e-12)
    assert np.count_nonzero(np.abs(np.diag(difference)) > 1e-12) == 9 + 4 + 1


def test_l1_of_bounded_parameters():
    plain, _ = problem()
    pruned, _ = problem(options={"l1": {"w": 0.3}})
    theta = somewhere(pruned)
    w = pruned.model.parameters.unpack(pruned.parameters(theta))["w"]
    assert pruned.cost(theta) - plain.cost(theta) == pytest.approx(0.3 * np.sum(w))
    _, gradient, hessian = pruned.normal(theta)
    np.testing.assert_allclose(
        gradient - plain.normal(theta)[1], 0.3 * np.array([label[0] == "w" for label in pruned.labels]), atol=1e-12
    )
    np.testing.assert_array_equal(hessian, plain.normal(theta)[2])


# ---- constraints ----


def test_constraints_see_named_parameters_and_free_columns():
    mine = Constraint(
        lambda p: ca.vertcat(ca.sum2(p["w"]) - 1, p["D_yu"] * p["A"][0, 0]), [0.0, -1.0], [0.0, 5.0], "mine"
    )
    p, _ = problem(
        [recording(0), recording(1)], changes={"D_yu": {"fixed": True}}, options={"constraints": [mine, stable(1.0)]}
    )
    theta = somewhere(p)
    named = p.model.parameters.unpack(p.parameters(theta))
    expected = [named["w"].sum() - 1, named["D_yu"].item() * named["A"][0, 0]]
    np.testing.assert_allclose(p.constraint(theta)[:2], expected, atol=1e-12)
    assert p.g_labels == ("mine[0]", "mine[1]", "spectral radius <= 1")
    jac = p.constraint_jacobian(theta)
    assert jac.shape == (3, p.size)
    np.testing.assert_allclose(jac, central(p.constraint, theta), rtol=1e-4, atol=1e-6)
    assert not jac[:, -14:].any()  # initial states


def test_without_constraints():
    p, _ = problem()
    assert p.constraint(p.start).size == 0
    assert p.constraint_jacobian(p.start).shape == (0, p.size)


# ---- errors ----


def test_model_and_recordings_must_fit():
    with pytest.raises(InputError, match="2 inputs and 1 outputs"):
        problem(recording(0, n_u=2))
    with pytest.raises(InputError, match="state of 5 numbers was given; expected 3 or 7; the states are x1, x2, x3"):
        problem(recording(0, initial=np.zeros(5)))
    with pytest.raises(InputError, match="L1 penalty on 'A' needs a lower bound"):
        problem(options={"l1": {"A": 1.0}})
    with pytest.raises(InputError, match="no parameter 'B'"):
        problem(options={"l1": {"B": 1.0}})
    with pytest.raises(InputError, match="'gpu' is unknown"):
        structure, values = random_lfr(0)
        Problem(structure.model(1, 1, values), recording(0), engine="gpu")


def test_a_problem_needs_a_free_variable():
    names = ("A", "B_u", "B_w", "C_y", "D_yu", "D_yw", "C_z", "D_zu", "y_0", "w", "r")
    changes = {name: {"fixed": True} for name in names}
    with pytest.raises(InputError, match="free at least one parameter"):
        problem(recording(0, initial="zero"), changes=changes)
    p, _ = problem(recording(0), changes=changes)
    assert p.size == 7
    _, gradient, _ = p.normal(somewhere(p))
    assert gradient.shape == (7,)


def test_a_grey_box_in_physical_units():
    """Parameters of very different sizes: each column is a derivative in the parameter's unit."""
    parameters = ParameterSet(
        {"k": Parameter(2e6, bounds=(0, 1e9)), "m": Parameter(1e-3, fixed=True), "d": Parameter(1.0)}
    )
    h = 1e-6

    def step(x, u, w, p):
        velocity = x[1] + h * (u - p["k"] * x[0] - p["d"] * x[1]) / p["m"]
        return ca.vertcat(x[0] + h * velocity, velocity), x[0]

    model = open_model(step, lambda x, u, p: x[:0], parameters, n_x=2, n_u=1, n_w=0)
    p = Problem(model, recording(0, 300, initial="zero").with_(y=1e-7 * random_input(9, 300)), engine="vm")
    assert p.size == 2
    _, gradient, _ = p.normal(p.start)
    for i, h_i in enumerate((1.0, 1e-5)):
        d = h_i * np.eye(2)[i]
        assert gradient[i] == pytest.approx((p.cost(p.start + d) - p.cost(p.start - d)) / (2 * h_i), rel=1e-5)


@pytest.mark.parametrize(
    "make",
    [
        lambda: pilfr.PrandtlIshlinskii(pilfr.Play, 999_999_999),
        lambda: pilfr.PrandtlIshlinskii(pilfr.Play, 10, 10**30),
        lambda: pilfr.PILFR(10**20),
        lambda: pilfr.GeneralizedPlay(10**9),
        lambda: pilfr.NARX(10**9),
        lambda: pilfr.NOE(2, 10**12),
    ],
)
def test_a_size_that_no_fit_could_handle_is_refused_at_once(make):
    with pytest.raises(
        InputError, match=r"has at least .* parameters, and .* takes .* GB of memory; give at most 20000"
    ):
        make()


def test_a_delay_has_one_unknown_for_each_sample_before_the_recording():
    """However many sub-steps a sample has; the derivatives are those of this problem."""
    law = pilfr.laws.Delay(values={"T": 0.35}).at({"T": 0.35}, {"T": (0.0, 0.4)})
    machine = pilfr.Simulator(
        lambda x, u, p: {"v": p.b * u.u - p.a * x.v},
        lambda x: {"v": x.v},
        states=("v",),
        inputs=("u",),
        parameters={"a": pilfr.Parameter(2.0), "b": pilfr.Parameter(1.0)},
    ).with_element("actuator:u", law)
    model = pilfr.simulators.discretise(machine, 0.1, "zero", substeps=8)
    rng = np.random.default_rng(0)
    r = Recording(u=rng.standard_normal((30, 1)), y=rng.standard_normal((30, 1)), dt=0.1, initial="estimate")
    p = Problem(model, r)
    assert model.n_state == 1 + 4 * 8 and p.size == 3 + 1 + 4
    theta = p.start + 0.1 * rng.standard_normal(p.size)
    assert p.initial_states(theta)[0][1:].reshape(4, 8) == pytest.approx(np.tile(theta[4:, None], (1, 8)))
    assert p.jacobian(theta) == pytest.approx(central(p.residual, theta), abs=1e-6)
    assert model.initial_unknowns(p.initial_states(theta)[0]) == pytest.approx(theta[3:])
