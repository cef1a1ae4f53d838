"""Models: one step with a port, closing the loop, and properties of all models."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from random_models import OPERATORS, random_input, random_lfr, reference

from pilfr_casadi._base import InputError
from pilfr_casadi.data import Recording
from pilfr_casadi.models import (
    PILFR,
    GeneralizedPlay,
    Parameter,
    ParameterSet,
    Play,
    PrandtlIshlinskii,
    Stop,
    close_loop,
    hammerstein,
    open_model,
    to_plays,
    to_stops,
    wiener,
)
from pilfr_casadi.models.conversion import complement


def run(model, u, state, p=None):
    """Outputs (M, n_y) and last state of a closed model, one `closed` call a sample."""
    p = model.parameters.start if p is None else p
    y = []
    for u_k in u:
        state, y_k = model.closed(state, u_k, p)
        y.append(np.asarray(y_k).ravel())
    return np.array(y), np.asarray(state).ravel()


def mixed(operator, seed=0, **sizes):
    structure, values = random_lfr(seed, operator=operator, **sizes)
    n_u, n_y = values["B_u"].shape[1], len(values["C_y"])
    model = structure.model(n_u, n_y, values)
    u = random_input(seed, 60, n_u)
    state = np.random.default_rng(seed).normal(size=model.n_x + model.n_s)
    return structure, values, model, u, state


@pytest.mark.parametrize("operator", OPERATORS)
@pytest.mark.parametrize("n_u, n_y, n_w", [(1, 1, 1), (2, 1, 3), (3, 2, 2), (1, 3, 1)])
def test_a_closed_model_is_the_papers_equations(operator, n_u, n_y, n_w):
    _, values, model, u, state = mixed(operator, n_u=n_u, n_y=n_y, n_w=n_w)
    y, last = run(model, u, state)
    expected, _, _, expected_last = reference(operator, values, u, state)
    np.testing.assert_allclose(y, expected, rtol=0, atol=1e-12 * np.max(np.abs(expected)))
    np.testing.assert_allclose(last, expected_last, atol=1e-12 * np.max(np.abs(expected_last)))


def test_sizes_and_names():
    model = random_lfr(0, nx=3, n_u=2, n_y=1, n_w=2, n=4)[0].model(2, 1)
    assert (model.n_x, model.n_u, model.n_w, model.n_y, model.n_s) == (3, 2, 2, 1, 8)
    assert model.states == ("x1", "x2", "x3")
    assert model.inputs == ("u1", "u2")
    assert model.outputs == ("y",)
    assert model.closed.name_in() == ["x", "u", "p"]
    assert model.closed.name_out() == ["x_next", "y"]


def test_functions_have_named_inputs_and_outputs():
    model = random_lfr(0)[0].model(1, 1)
    assert model.step.name_in() == ["x", "u", "w", "p"]
    assert model.port.name_out() == ["z"]
    assert model.memory.name_out() == ["w", "s_next"]


def test_no_states_at_all():
    structure, values = random_lfr(2, nx=0, n_w=1)
    u = random_input(0, 40)
    model = structure.model(1, 1, values)
    state = np.zeros(model.n_s)
    np.testing.assert_allclose(run(model, u, state)[0], reference(Play, values, u, state)[0], atol=1e-13)


def test_an_open_port_carries_zero():
    parameters = ParameterSet({"a": Parameter(0.5)})
    model = open_model(lambda x, u, w, p: (p["a"] * x + u + w, x), lambda x, u, p: x, parameters, n_x=1, n_u=1, n_w=1)
    y, _ = run(model, np.ones((4, 1)), [0.0])
    np.testing.assert_allclose(y.ravel(), [0.0, 1.0, 1.5, 1.75])


@pytest.mark.parametrize("operator, slips", [(Play, 1.0), (Stop, 0.0)])
def test_closing_a_loop_by_hand(operator, slips):
    """x⁺ = u, z = x, y = w with one operator of weight 2, far beyond its threshold."""
    parameters = ParameterSet({"gain": Parameter(1.0)})
    model = open_model(
        lambda x, u, w, p: (p["gain"] * u, w), lambda x, u, p: x, parameters, n_x=1, n_u=1, n_w=1, outputs=("force",)
    )
    closed = close_loop(model, PrandtlIshlinskii(operator, 1))
    assert tuple(closed.parameters) == ("gain", "w", "r")
    p = closed.parameters.pack({"w": [[2.0]], "r": [[0.5]]})
    y, _ = run(closed, np.array([[3.0], [3.0]]), [0.0, 0.0], p)
    assert y.ravel().tolist() == [0.0, 2.0 * (2.5 * slips + 0.5 * (1 - slips))]


# ---- errors ----


def simple(n_w=1, **options):
    parameters = ParameterSet({"a": Parameter(0.5)})
    return open_model(
        lambda x, u, w, p: (p["a"] * x + u, x), lambda x, u, p: x, parameters, n_x=1, n_u=1, n_w=n_w, **options
    )


def test_a_port_cannot_be_closed_twice():
    closed = close_loop(simple(), PrandtlIshlinskii(Play, 2))
    with pytest.raises(InputError, match="closed already"):
        close_loop(closed, PrandtlIshlinskii(Play, 2))


def test_an_element_needs_the_channels_of_the_port():
    with pytest.raises(InputError, match="2 channels, the model's port has 1"):
        close_loop(simple(), PrandtlIshlinskii(Play, 2, channels=2))


def test_something_else_than_an_element_is_refused():
    with pytest.raises(InputError, match="'play' was given to close_loop"):
        close_loop(simple(), "play")


def test_parameters_of_element_and_model_need_different_names():
    parameters = ParameterSet({"w": Parameter(0.5)})
    model = open_model(lambda x, u, w, p: (p["w"] * x, x), lambda x, u, p: x, parameters, n_x=1, n_u=1, n_w=1)
    with pytest.raises(InputError, match="'w' is used twice"):
        close_loop(model, PrandtlIshlinskii(Play, 2))


def test_every_signal_needs_a_name():
    with pytest.raises(InputError, match="2 names were given for 1 signals"):
        simple(inputs=("force", "current"))


def test_expressions_of_other_sizes_are_refused():
    nothing = ParameterSet()
    with pytest.raises(InputError, match=r"next state has the shape \(1, 1\); expected \(2, 1\)"):
        open_model(lambda x, u, w, p: (x[0], x), lambda x, u, p: x, nothing, n_x=2, n_u=1, n_w=0)
    with pytest.raises(InputError, match="port's signal z has the shape"):
        open_model(lambda x, u, w, p: (x, x), lambda x, u, p: ca.vertcat(x, u), nothing, n_x=1, n_u=1, n_w=1)


def test_other_parameters_are_refused():
    model = simple()
    with pytest.raises(InputError, match="do not match"):
        model.with_parameters(ParameterSet({"b": Parameter(1.0)}))
    assert model.with_parameters(model.parameters.change(a={"value": 0.1})).parameters["a"].value == 0.1
    assert model.parameters["a"].value == 0.5


# ---- plays and stops ----


@pytest.mark.parametrize("operator", [Play, Stop])
@pytest.mark.parametrize("n_u, n_y, n_w, nx", [(1, 1, 1, 3), (2, 3, 2, 2), (1, 1, 1, 0)])
def test_plays_and_stops_are_the_same_model(operator, n_u, n_y, n_w, nx):
    """The equivalence of Sec. 4.1, for a whole model with any initial memory, at every sample."""
    other = Stop if operator is Play else Play
    structure, values, model, u, state = mixed(operator, n_u=n_u, n_y=n_y, n_w=n_w, nx=nx)
    convert = to_stops if operator is Play else to_plays
    converted, new = convert(structure, values)
    assert type(converted.element.operator) is other
    y, last = run(model, u, state)
    again, last_again = run(converted.model(n_u, n_y, new), u, state)
    np.testing.assert_allclose(again, y, rtol=0, atol=1e-10 * np.max(np.abs(y)))
    np.testing.assert_allclose(last_again, last, atol=1e-10 * np.max(np.abs(last)))
    np.testing.assert_allclose(reference(other, new, u, state)[0], y, atol=1e-10 * np.max(np.abs(y)))
    for name, value in complement(new).items():  # an involution
        np.testing.assert_allclose(value, values[name], atol=1e-14)


def test_conversion_to_the_same_operator_changes_nothing():
    structure, values = random_lfr(0, operator=Stop)
    same, out = to_stops(structure, values)
    assert same is structure
    assert all(np.array_equal(out[k], values[k]) for k in values)


@pytest.mark.parametrize("build, freed", [(hammerstein, {"B_u", "D_yu"}), (wiener, {"C_y", "D_yu"})])
def test_conversion_frees_the_blocks_that_take_up_the_slope(build, freed):
    structure = build(2, PrandtlIshlinskii(Play, 3))
    values = {k: np.array(p.value) for k, p in structure.model(1, 1).parameters.items()}
    rng = np.random.default_rng(0)
    for name in values:
        if name not in structure.fixed:
            values[name] = rng.uniform(0.1, 0.5, values[name].shape)
    converted, new = to_stops(structure, values)
    assert set(structure.fixed) - set(converted.fixed) == freed
    np.testing.assert_allclose(converted.fixed.get("D_yw", -1.0), -1.0)
    u = random_input(1, 50)
    state = np.zeros(5)
    np.testing.assert_allclose(
        run(converted.model(1, 1, new), u, state)[0], run(structure.model(1, 1, values), u, state)[0], atol=1e-12
    )


def test_a_converted_structure_keeps_untouched_bounds_and_priors():
    structure, values = random_lfr(
        1, bounds={"B_w": (-1.0, 2.0), "A": (-5, 5), "w": (0, 3)}, priors={"D_yw": (0.5, 0.1)}, fixed={"y_0": 0.25}
    )
    converted, new = to_stops(structure, values)
    stops = converted.model(1, 1, new)
    assert stops.parameters["w"].bounds[1][0, 0] == 3
    assert (stops.parameters["B_w"].bounds[0].min(), stops.parameters["B_w"].bounds[1].max()) == (-2.0, 1.0)
    assert stops.parameters["D_yw"].prior[0] == -0.5
    assert "A" not in converted.bounds
    assert np.isinf(stops.parameters["A"].bounds[0]).all()
    assert stops.parameters["y_0"].fixed.all()


def test_rounded_operators_convert_exactly():
    element = PrandtlIshlinskii(Play, 4, rounded=True)
    structure, values = random_lfr(3)
    structure = PILFR(3, element)
    values["eps"] = np.array(0.4)
    u, state = random_input(3, 60), np.zeros(7)
    converted, new = to_stops(structure, values)
    y = run(structure.model(1, 1, values), u, state)[0]
    np.testing.assert_allclose(run(converted.model(1, 1, new), u, state)[0], y, atol=1e-12 * np.max(np.abs(y)))


@pytest.mark.parametrize("element", [None, PrandtlIshlinskii(GeneralizedPlay, 2)])
def test_only_plays_and_stops_have_a_complement(element):
    with pytest.raises(InputError, match="give a Prandtl-Ishlinskii element of plays or stops"):
        to_stops(PILFR(1, element), {})


# ---- gauge freedoms leave the output alone ----


@settings(max_examples=20)
@given(st.integers(0, 1000), st.sampled_from([Play, Stop]), st.integers(1, 3))
def test_gauge_freedoms_change_no_output(seed, operator, n_w):
    rng = np.random.default_rng(seed)
    structure, values = random_lfr(seed, n_w=n_w, n_u=2, operator=operator)
    t = rng.normal(size=(3, 3)) + 3 * np.eye(3)
    alpha, beta = rng.uniform(0.2, 5, (2, n_w))
    alpha *= rng.choice([-1, 1], n_w)
    other = dict(values)
    other["A"], other["B_u"] = np.linalg.solve(t, values["A"] @ t), np.linalg.solve(t, values["B_u"])
    other["C_y"] = values["C_y"] @ t
    other["C_z"], other["D_zu"] = alpha[:, None] * (values["C_z"] @ t), alpha[:, None] * values["D_zu"]
    other["B_w"], other["D_yw"] = np.linalg.solve(t, values["B_w"]) / alpha / beta, values["D_yw"] / alpha / beta
    other["r"], other["w"] = np.abs(alpha)[:, None] * values["r"], beta[:, None] * values["w"]
    x, q = rng.normal(size=3), rng.normal(size=(n_w, 4))
    u = random_input(seed, 80, 2)
    y, _ = run(structure.model(2, 1, values), u, np.concatenate([x, q.ravel()]))
    state = np.concatenate([np.linalg.solve(t, x), (alpha[:, None] * q).ravel()])
    again, _ = run(structure.model(2, 1, other), u, state)
    np.testing.assert_allclose(again, y, rtol=0, atol=1e-11 * np.max(np.abs(y)))


@pytest.mark.parametrize("hold", ["zero", "linear", "next"])
def test_a_step_that_reads_the_next_inputs_gets_them(hold):
    plant = open_model(lambda x, u, w, p: (u[0] + u[1], x), lambda x, u, p: x, ParameterSet({}), n_x=1, n_u=2, n_w=0)
    model = replace(plant, reads=("u", "next"), hold=hold)
    assert model.drive(Recording(np.arange(3.0), np.zeros(3), 0.1)).tolist() == [[0, 1], [1, 2], [2, 2]]
