"""The PI-LFR structure: shapes (with the paper's slips), fixed blocks, Hammerstein and Wiener as special cases."""

import numpy as np
import pytest
from random_models import random_input, random_lfr, reference

from pilfr_casadi._base import InputError
from pilfr_casadi.engine import make_engine
from pilfr_casadi.models import (
    PILFR,
    Combined,
    Envelope,
    GeneralizedPlay,
    Part,
    Play,
    PrandtlIshlinskii,
    Stop,
    block_shapes,
    hammerstein,
    ssnn,
    wiener,
)


def simulate(structure, values, u, n_y=1):
    model = structure.model(u.shape[1], n_y, values)
    engine = make_engine(model, "vm")
    y, _, z, w = engine.simulate(u, model.parameters.start, np.zeros(model.n_x + model.n_s), True)
    return y, z, w


def layer(operator, values, z):
    """A Prandtl-Ishlinskii layer on its own, from rest."""
    blocks = {
        "A": np.zeros((0, 0)),
        "B_u": np.zeros((0, 1)),
        "B_w": np.zeros((0, 1)),
        "C_y": np.zeros((1, 0)),
        "C_z": np.zeros((1, 0)),
        "D_yu": [[0.0]],
        "D_yw": [[1.0]],
        "D_zu": [[1.0]],
        "y_0": [0.0],
    }
    state = np.zeros(values["w"].size)
    return reference(operator, {**values, **{k: np.array(v) for k, v in blocks.items()}}, z, state)[0]


def linear(values, into, out_of, u):
    """x⁺ = A x + B u, y = C x + D u from rest."""
    x, y = np.zeros(len(values["A"])), []
    b, d = into
    for u_k in u:
        y.append(out_of @ x + d @ u_k)
        x = values["A"] @ x + b @ u_k
    return np.array(y)


# ---- shapes, and slips of the paper ----


def test_eq_15_every_block_has_the_shape_it_needs():
    """D_zu is (n_w, n_u), where the paper prints (n_1, 1)."""
    shapes = block_shapes(nx=5, n_u=3, n_y=2, n_w=1)
    assert shapes["D_zu"] == (1, 3) != (1, 1)
    model = PILFR(5, PrandtlIshlinskii(Play, 4)).model(3, 2)
    for name, shape in shapes.items():
        assert model.parameters[name].value.shape == shape
    printed = {"D_zu": np.ones((3, 1))}  # a column, as in the text, does not multiply u
    with pytest.raises(InputError, match="'D_zu' has the shape"):
        PILFR(5, PrandtlIshlinskii(Play, 4)).model(3, 2, printed)


def test_eq_16_the_sum_is_w_not_the_noise_v():
    structure, values = random_lfr(0)
    u = random_input(0, 80)
    y, z, w = simulate(structure, values, u)
    total = layer(Play, values, z)
    np.testing.assert_allclose(w, total, atol=1e-13)
    as_noise, _, _ = simulate(structure, {**values, "B_w": 0 * values["B_w"], "D_yw": 0 * values["D_yw"]}, u)
    # read as measurement noise v the sum would be added to y and never act on the states
    assert np.max(np.abs(as_noise + total - y)) > 0.1


def test_eq_18_the_sample_index_makes_one_period():
    """2π k n / N_s repeats after N_s samples; 2π k (f_s/N_s) n with k in samples is another signal."""
    from pilfr_casadi.data import multisine

    n_s, f_s = 64, 24.0
    k, lines = np.arange(n_s)[:, None], np.arange(1, 9)
    phases = np.random.default_rng(1).uniform(0, 2 * np.pi, 8)
    made = multisine(n_s, 8 * f_s / n_s, f_s, np.random.default_rng(1), rms=None).ravel()
    right = np.sin(2 * np.pi * k * lines / n_s + phases).sum(axis=1) / np.sqrt(n_s)
    printed = np.sin(2 * np.pi * k * f_s / n_s * lines + phases).sum(axis=1) / np.sqrt(n_s)
    np.testing.assert_allclose(made, right, atol=1e-13)
    assert np.max(np.abs(printed - right)) > 0.1


@pytest.mark.parametrize("nx", [0, 1, 4])
@pytest.mark.parametrize("n_u, n_y", [(1, 1), (2, 3)])
def test_without_an_element_it_is_linear(nx, n_u, n_y):
    structure, values = random_lfr(1, nx=nx, n_u=n_u, n_y=n_y, n_w=0)
    u = random_input(1, 50, n_u)
    y, z, w = simulate(structure, values, u, n_y)
    expected = linear(values, (values["B_u"], values["D_yu"]), values["C_y"], u) + values["y_0"]
    np.testing.assert_allclose(y, expected, atol=1e-12)
    assert z.shape == w.shape == (50, 0)


def test_the_linear_structure_of_a_pi_lfr():
    structure = PILFR(4, PrandtlIshlinskii(Play, 3), fixed={"D_yu": 0.0}, offset=False)
    assert structure.linear() == PILFR(4, offset=False)
    assert structure.linear().n_w == 0


# ---- Hammerstein and Wiener ----


@pytest.mark.parametrize("operator", [Play, Stop])
def test_hammerstein_is_the_layer_before_the_dynamics(operator):
    structure = hammerstein(3, PrandtlIshlinskii(operator, 4))
    _, values = random_lfr(2)
    u = random_input(2, 100)
    y, z, _ = simulate(structure, values, u)
    np.testing.assert_array_equal(z, u)
    w = layer(operator, values, u)
    expected = linear(values, (values["B_w"], values["D_yw"]), values["C_y"], w) + values["y_0"]
    np.testing.assert_allclose(y, expected, atol=1e-12)


@pytest.mark.parametrize("operator", [Play, Stop])
def test_wiener_is_the_layer_after_the_dynamics(operator):
    structure = wiener(3, PrandtlIshlinskii(operator, 4))
    _, values = random_lfr(3)
    u = random_input(3, 100)
    y, _, _ = simulate(structure, values, u)
    z = linear(values, (values["B_u"], values["D_zu"]), values["C_z"], u)
    np.testing.assert_allclose(y, layer(operator, values, z) + values["y_0"], atol=1e-12)


@pytest.mark.parametrize("build", [hammerstein, wiener])
def test_special_cases_fix_blocks_and_take_or_leave_the_offset(build):
    with_offset, without = (build(2, PrandtlIshlinskii(Play, 3), offset=o).model(1, 1) for o in (True, False))
    assert with_offset.parameters.free.sum() == without.parameters.free.sum() + 1
    assert without.parameters["y_0"].fixed.all()
    fixed = build(2, PrandtlIshlinskii(Play, 3)).fixed
    for name in fixed:
        assert with_offset.parameters[name].fixed.all()
    assert not with_offset.parameters["A"].fixed.any()


def test_several_channels_in_a_hammerstein_model():
    structure = hammerstein(2, PrandtlIshlinskii(Play, 3, channels=2))
    assert structure.model(2, 1).parameters["D_zu"].value.tolist() == [[1, 0], [0, 1]]
    with pytest.raises(InputError, match="give channels=3"):
        structure.model(3, 1)


# ---- values, bounds, priors ----


def test_values_are_clipped_to_bounds_and_fixed_values_stay():
    structure = PILFR(
        2, PrandtlIshlinskii(Play, 3), fixed={"D_yu": 0.5}, bounds={"w": (0.0, 0.2)}, priors={"A": (0.0, 1.0)}
    )
    model = structure.model(1, 1, {"w": [[0.1, 0.5, 0.0]], "D_yu": 3.0, "B_u": 2.0})
    p = model.parameters
    assert p["w"].value.tolist() == [[0.1, 0.2, 0.0]]
    assert p["D_yu"].value.tolist() == [[0.5]]
    assert p["D_yu"].fixed.all()
    assert p["B_u"].value.tolist() == [[2.0], [2.0]]
    assert p["A"].prior == (0.0, 1.0)
    assert (p["r"].bounds[0] == 0).all()


def test_infinite_bounds_keep_the_elements_bounds():
    w = PILFR(1, PrandtlIshlinskii(Play, 2), bounds={"w": (-np.inf, 3.0)}).model(1, 1).parameters["w"]
    assert (w.bounds[0] == 0).all() and (w.bounds[1] == 3).all()
    with pytest.raises(InputError, match="'envelope_rate' is 2, but the element's envelope_rate is at least 1e-06 and"):
        PILFR(1, Combined((Part("envelope", Envelope(1), (0,)),)), bounds={"envelope_rate": (0.1, 2.0)})


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: PILFR(-1), "number of states is -1"),
        (lambda: PILFR(2.5), "number of states is 2.5"),
        (lambda: PILFR(2, fixed={"w": 0.0}), "no parameter 'w'"),
        (lambda: PILFR(2, PrandtlIshlinskii(Play, 2), bounds={"v": (0, 1)}), "no parameter 'v'"),
        (lambda: PILFR(2, priors={"E": (0, 1)}), "no parameter 'E'"),
        (lambda: PILFR(2, bounds={"A": (1.0, -1.0)}).model(1, 1), "infeasible"),
        (lambda: PILFR(2, bounds={"A": (np.zeros(3), 1.0)}).model(1, 1), "'A' has the shape"),
        (lambda: PILFR(2, fixed={"C_y": "x"}).model(1, 1), "'C_y'"),
        (lambda: PILFR(2).model(1, 1, {"A": np.eye(3)}), "'A' has the shape"),
    ],
)
def test_invalid_structures_are_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()


ONE = PrandtlIshlinskii(Play, 3)
NAN = float("nan")


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (
            {"fixed": {"A": [[0.9, 0.1]]}},
            r"The fixed value of .A. has the shape \(1, 2\); give .* shape \(2, 2\)",
        ),
        ({"fixed": {"A": [[0.9], [0.1]]}}, r"The fixed value of 'A' has the shape \(2, 1\)"),
        ({"fixed": {"A": [0.9, 0.1]}}, r"The fixed value of 'A' has the shape \(2,\)"),
        ({"fixed": {"A": [[0.9, 0.1], [1.0]]}}, r"The fixed value of 'A' is \[\[0.9, 0.1\], \[1.0\]\]; give a number"),
        ({"fixed": {"A": None}}, "The fixed value of 'A' is None; give a number"),
        ({"fixed": {"A": "0.9"}}, "The fixed value of 'A' is 0.9; give a number"),
        ({"fixed": {"A": np.inf}}, "The fixed value of 'A' holds a value that is not finite"),
        ({"fixed": {"B_w": np.array([1.0])}}, r"The fixed value of 'B_w' has the shape \(1,\)"),
        ({"fixed": {"B_u": [[1.0, 0.0]]}}, r"shape \(1, 2\); give a number or an array of shape \(2, n_u\)"),
        ({"fixed": {"r": [0.1, 0.2]}}, r"The fixed value of 'r' has the shape \(2,\); give a number .* shape \(1, 3\)"),
        ({"bounds": {"w": ([[0.0, 0.0]], 1.0)}}, r"The lower bound of 'w' has the shape \(1, 2\)"),
        ({"bounds": {"A": (-1.0, [1.0, 1.0])}}, r"The upper bound of 'A' has the shape \(2,\)"),
        ({"bounds": {"A": ([[0, 1], [2]], 1.0)}}, "bounds of 'A'; give a pair"),
        (
            {"bounds": {"r": (-1.0, 2.0)}},
            "A bound of 'r' is -1, but the element's r is at least 0; give",
        ),
        ({"bounds": {"w": (-np.inf, [[-0.5, 1.0, 1.0]])}}, "A bound of 'w' is -0.5, but"),
        ({"fixed": {"w": [[NAN, 0.3, -0.2]]}}, "The fixed value of 'w' is -0.2, but the element's w is at least 0"),
        ({"priors": {"A": ([[0.9, 0.1]], 1.0)}}, r"The mean of the prior of 'A' has the shape \(1, 2\)"),
        ({"priors": {"A": (np.inf, 1.0)}}, "The mean of the prior of 'A' holds a value that is not finite"),
        ({"priors": {"w": (0.0, [1.0, 1.0])}}, r"The standard deviation of the prior of 'w' has the shape \(2,\)"),
        ({"priors": {"w": (0.0, None)}}, "prior of 'w'; give a pair"),
    ],
)
def test_values_of_another_shape_are_refused(given, says):
    with pytest.raises(InputError, match=says) as caught:
        PILFR(2, ONE, **given)
    assert str(caught.value).count(". ") == 0


def test_shapes_that_depend_on_data_are_checked_with_the_data():
    structure = PILFR(2, ONE, fixed={"B_u": [[1.0], [0.0]], "A": [[0.9, NAN], [0.0, NAN]]})
    p = structure.model(1, 1).parameters
    assert p["A"].fixed.tolist() == [[True, False], [True, False]] and p["B_u"].fixed.all()
    with pytest.raises(InputError, match=r"The fixed value of 'B_u' has the shape \(2, 1\); give .* shape \(2, 2\)"):
        structure.model(2, 1)
    with pytest.raises(InputError, match=r"The value of 'A' has the shape \(1, 2\)"):
        structure.model(1, 1, {"A": [[0.9, 0.1]]})


@pytest.mark.parametrize(
    "structure",
    [
        PILFR(0),
        PILFR(3, ONE, offset=False),
        PILFR(2, ONE, fixed={"A": [[0.9, NAN], [0.0, NAN]], "D_yu": 0.0, "r": [[0.1, NAN, 0.3]]}),
        PILFR(2, PrandtlIshlinskii(Stop, 4, channels=2), fixed={"B_w": np.array([0.0, NAN]), "w": 1.0}),
        hammerstein(2, PrandtlIshlinskii(Play, 3, channels=2)),
        wiener(1, PrandtlIshlinskii(GeneralizedPlay(neurons=2), 2, channels=3)),
        ssnn(3, 4),
    ],
    ids=str,
)
def test_the_count_equals_the_models_free_parameters(structure):
    assert structure.count(2, 3) == int(structure.model(2, 3).parameters.free.sum())
