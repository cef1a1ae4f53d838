"""Bounds on spectral radii: what they are of each element, and bounds on A that leave no room for them."""

import pickle

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, strategies as st
from random_models import coupled_plays

import pilfr_casadi as pilfr
from pilfr_casadi._base import InputError
from pilfr_casadi.optimise import unbounded_sentence
from pilfr_casadi.optimise.spectral_radius import least_radius, stability
from problems.constrained import three_plays

PLAYS = pilfr.PrandtlIshlinskii(pilfr.Play, 3)


@pytest.fixture(scope="module")
def record():
    return three_plays(0, 1200)


@pytest.mark.parametrize("nx, bounds, least", [(1, (1.5, 2), 1.5), (1, (-3, -1.1), 1.1), (2, (0.6, 2), 1.2)])
def test_bounds_that_deny_every_stable_model_are_refused(record, nx, bounds, least):
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
    """Growth a sample of a free motion of the closed model, from rest at `size`, so large that every operator slips."""
    model = structure.model(1, 1, p)
    state, tops = np.zeros(model.n_x + model.n_s), []
    state[0] = size
    for _ in range(60):
        state = np.asarray(model.closed(state, 0.0, model.parameters.start)[0]).ravel()
        tops.append(abs(state[0]))
    return (tops[-1] / tops[-31]) ** (1 / 30)


def test_envelopes_are_bounded_where_large_motions_go():
    """Rising motions follow the lower envelope: its slope far out, not where it is steepest, says whether they grow."""
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
        names = [c.name for c in stability(structure, exact=True)]
        assert names[1:] == [
            f"spectral radius with the element's {which} envelope far out <= 1" for which in ("lower", "upper")
        ]
        far = [c.check(p) + c.check.radius for c in stability(structure, exact=True)]
        assert far == pytest.approx([0.5, 0.5 + a0, 0.6])
        assert radius_by_simulation(structure, p, 1e4) == pytest.approx(0.5 + a0, abs=0.01)
        assert (far[1] > 1) == grows
        assert "steepest the spectral radius is" in unbounded_sentence(structure, stability(structure, exact=True), p)
    flat, p = generalized({"w": w, "gamma_l_a0": [[0.3]], "gamma_r_a0": [[0.3]]})
    assert unbounded_sentence(flat, stability(flat, exact=True), p) == ""
    assert unbounded_sentence(flat, (), p) == ""


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
    record = coupled_plays(5)
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
    limits = stability(structure, exact=True)
    assert [c.check(p) + 1 for c in limits] == pytest.approx([0.5, 0.5 + 0.2 * 3.0 + 0.1 * 1.0])
    assert unbounded_sentence(structure, limits, p) == ""  # products are bounded
    assert pickle.loads(pickle.dumps(limits))[1].name == "spectral radius with the element's full slope <= 1"


def test_what_no_slope_is_known_of_is_told(record):
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
    assert [c.name for c in stability(structure)] == ["spectral radius <= 1"]
    assert "the spectral radius is bounded for the linear part alone: how steep the element is" in str(fit)
    wiener = pilfr.wiener(1, pilfr.PrandtlIshlinskii(own, 2))
    values = {k: v.value for k, v in wiener.model(1, 1, {"A": [[0.5]], "C_z": [[1.0]]}).parameters.items()}
    assert unbounded_sentence(wiener, stability(wiener, exact=True), values) == ""  # nothing is fed back


def gamma(z, p):
    """An envelope of one's own."""
    return 0.5 * z + 0.1 * ca.tanh(z)
