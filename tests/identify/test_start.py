"""Start values: the place of the element, units, and thresholds placed anew."""

from dataclasses import replace

import numpy as np
import pytest
from random_models import random_input, random_lfr

from pilfr_casadi._base import InputError
from pilfr_casadi.data import Recording
from pilfr_casadi.engine import make_engine
from pilfr_casadi.identify import fit, grid_start, multistart, network_start, paper_start, regrid, unit_states
from pilfr_casadi.linear import frequency_subspace, robust_bla, time_subspace
from pilfr_casadi.models import NARX, PILFR, Play, PrandtlIshlinskii, hammerstein, network_lfr, ssnn, wiener
from pilfr_casadi.optimise import GaussNewton, Problem, loosen_radii, stability_limits

NX, N = 2, 5
LINEAR = {
    "A": np.array([[0.9, 0.2], [-0.2, 0.9]]),
    "B_u": np.array([[0.1, 0.0], [0.3, -0.2]]),
    "C_y": np.array([[1.0, 0.2], [0.3, -1.0]]),
    "D_yu": np.array([[0.1, 0.0], [0.0, 0.2]]),
    "y_0": np.array([1.0, 2.0]),
}


def started(structure, place, unit=(1.0, 1.0), seed=0):
    u = np.random.default_rng(3).normal(size=(400, 2)) * [1.0, 4.0]
    unit = np.array(unit)
    linear = {**LINEAR, "B_u": LINEAR["B_u"] / unit, "D_yu": LINEAR["D_yu"] / unit}
    blocks, states = unit_states(linear, [u * unit])
    values = grid_start(structure, blocks, [u * unit], states, np.random.default_rng(seed), place)
    return values, u * unit, states[0]


@pytest.mark.parametrize("unit", [1e-3, 1e3])
@pytest.mark.parametrize("place", ["random", "output", "input"])
def test_units_of_the_input_do_not_matter(place, unit):
    structure = PILFR(NX, PrandtlIshlinskii(Play, N, 2))
    one, _, _ = started(structure, place)
    two, _, _ = started(structure, place, unit=np.array([unit, 1.0]))
    for name in ("B_u", "D_yu", "D_zu"):
        two[name] = two[name] * [unit, 1.0]
    for name, value in one.items():
        np.testing.assert_allclose(two[name], value, rtol=1e-9, atol=1e-12, err_msg=name)


def linear_output(values, u, x, gain=1.0):
    """Simulate with an element that passes z on, times `gain`."""
    z = x @ values["C_z"].T + u @ values["D_zu"].T
    return x @ values["C_y"].T + u @ values["D_yu"].T + gain * z @ values["D_yw"].T


def test_half_of_the_output_passes_through_the_element():
    values, u, x = started(PILFR(NX, PrandtlIshlinskii(Play, N, 2)), "output")
    blocks, _ = unit_states(LINEAR, [u])
    np.testing.assert_allclose(linear_output(values, u, x), x @ blocks["C_y"].T + u @ LINEAR["D_yu"].T, atol=1e-12)
    np.testing.assert_allclose(values["C_y"], 0.5 * blocks["C_y"])
    assert "B_w" not in values
    z = x @ values["C_z"].T + u @ values["D_zu"].T
    np.testing.assert_allclose(np.std(z, axis=0), 1.0)


def test_half_of_the_input_passes_through_the_element():
    values, u, _ = started(PILFR(NX, PrandtlIshlinskii(Play, N, 2)), "input")
    blocks, _ = unit_states(LINEAR, [u])
    assert not values["C_z"].any()
    np.testing.assert_allclose(values["B_u"] + values["B_w"] @ values["D_zu"], blocks["B_u"], atol=1e-12)
    np.testing.assert_allclose(values["D_yu"] + values["D_yw"] @ values["D_zu"], LINEAR["D_yu"], atol=1e-12)
    np.testing.assert_allclose(values["B_u"], 0.5 * blocks["B_u"])


def test_channels_share_a_path_and_other_paths_stay_direct():
    values, _, _ = started(PILFR(NX, PrandtlIshlinskii(Play, N, 3)), "input")
    blocks, u, _ = started(PILFR(NX, PrandtlIshlinskii(Play, N, 1)), "output")
    np.testing.assert_allclose(values["B_w"][:, 0], values["B_w"][:, 2])
    scaled, _ = unit_states(LINEAR, [u])
    np.testing.assert_allclose(blocks["C_y"], scaled["C_y"] * [[0.5], [1.0]])


@pytest.mark.parametrize("place", ["output", "input"])
@pytest.mark.parametrize("build", [hammerstein, wiener])
def test_fixed_blocks_stay(build, place):
    structure = build(NX, PrandtlIshlinskii(Play, N, 2))
    values, _, _ = started(structure, place)
    random, _, _ = started(structure, "random")
    for name in ("C_z", "D_zu", "C_y", "D_yu", "D_yw", "B_u", "B_w"):
        if name in structure.fixed and name in values:
            np.testing.assert_array_equal(values[name], np.broadcast_to(structure.fixed[name], values[name].shape))
            np.testing.assert_array_equal(values[name], random[name])


def backlash(u, gap):
    out, q = np.empty_like(u), 0.0
    for k, z in enumerate(u.ravel()):
        q = max(z - gap, min(z + gap, q))
        out[k] = q
    return out


def mass(u):
    """Position of a damped mass on a spring, sampled."""
    out, (p, v) = np.empty_like(u), (0.0, 0.0)
    for k, force in enumerate(u.ravel()):
        out[k] = p
        v += 0.002 * (force - 5 * v - 1000 * p) / 2
        p += 0.002 * v
    return out


@pytest.mark.parametrize(
    ("where", "unit"),
    [
        ("behind", 1e3),
        *(pytest.param("before", v, marks=pytest.mark.slow) for v in (1e-3, 1.0, 1e3)),
        *(pytest.param(*v, marks=pytest.mark.slow) for v in (("behind", 1e-3), ("behind", 1.0))),
    ],
)
def test_backlash_on_either_side_of_a_mass(where, unit):
    rng = np.random.default_rng(7)
    t = np.arange(3000)
    u = sum(np.cos(2 * np.pi * k * t / 3000 + rng.uniform(0, 2 * np.pi)) for k in range(1, 61))[:, None]
    u = 20 * u / u.std()
    y = mass(backlash(u, 4.0)) if where == "before" else backlash(mass(u), 0.005)
    noise = 0.005 * y.std() * rng.normal(size=y.shape)
    found = fit(PILFR(2, PrandtlIshlinskii(Play, 10)), Recording(u * unit, y + noise, 0.002, initial="zero"), starts=2)
    assert found.train_nrmse[0] < 0.0056  # noise alone: 0.0050


def test_thresholds_follow_the_density(monkeypatch):
    """For a known density of weights, each threshold represents an equal share of density^0.4."""
    r, w = np.linspace(0.0, 1.0, 400), 1.0 / 400 * np.linspace(2.0, 0.2, 400)
    monkeypatch.setattr(multistart, "KERNEL_WIDTH", 0.02)
    placed, mass = regrid(r, w, 1.0, extent=1.0)
    assert np.sum(mass) == pytest.approx(w.sum(), rel=0.03)
    share = np.diff((2.0 - 1.8 * np.array([placed[0], *placed[50:-50:50]])) ** 1.4)
    np.testing.assert_allclose(share, share[1], rtol=0.06)
    gaps = np.diff(placed)
    assert 0.55 < gaps[20] / gaps[350] < 0.75  # (0.4 quantiles) proportional to density^-0.4, not to density^-1


def test_the_density_is_extrapolated_beyond_the_visited_range():
    r = np.linspace(0.0, 1.0, 100)
    w = np.exp(-2.0 * r)
    placed, mass = regrid(r, w, 1.0, extent=1.3)
    assert placed[-1] > 1.2 and np.all(np.diff(placed) > 0)
    density = mass[-12:] / np.gradient(placed)[-12:] / 100
    expected = np.exp(-2.0 * placed[-12:])
    np.testing.assert_allclose(density, expected, rtol=0.15)


# ---- the paper's protocol ----


def test_the_papers_start_is_eq_22_to_24():
    """Eq. 22-24: the linear model, states of unit variance, no B_w, D_yw; C_z, D_zu in (-1, 1); w < 1/N, r < 0.1."""
    u = np.random.default_rng(3).normal(size=(400, 2))
    blocks, (x,) = unit_states(LINEAR, [u])
    np.testing.assert_allclose(np.sqrt(np.mean(x**2, axis=0)), 1.0)
    structure = PILFR(NX, PrandtlIshlinskii(Play, N))
    drawn = [paper_start(structure, blocks, [u], [x], np.random.default_rng(k)) for k in range(400)]
    for name, (low, high) in {"C_z": (-1, 1), "D_zu": (-1, 1), "w": (0, 1 / N), "r": (0, 0.1)}.items():
        values = np.array([d[name] for d in drawn])
        assert low <= values.min() < low + 0.01 * (high - low)
        assert high - 0.01 * (high - low) < values.max() <= high
        np.testing.assert_allclose(values.mean(), (low + high) / 2, atol=0.05 * (high - low))
    model = PILFR(NX, PrandtlIshlinskii(Play, N)).model(2, 2, drawn[0])
    for name in ("B_w", "D_yw"):
        assert not model.parameters[name].value.any()
    for name in ("A", "B_u", "C_y", "D_yu"):
        np.testing.assert_array_equal(model.parameters[name].value, blocks[name])


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("form", [hammerstein, wiener])
def test_the_papers_start_with_a_fixed_direction_of_z(form, unit):
    """z then has the units of an input or output; thresholds from U(0, 0.1) must be scaled to it."""
    u, scales = np.random.default_rng(3).normal(size=(400, 2)) * [1.0, 4.0], dict.fromkeys(("C_y", "D_yu"), unit)
    if form is hammerstein:
        u, scales = unit * u, dict.fromkeys(("B_u", "D_yu"), 1 / unit)
    blocks, (x,) = unit_states({k: scales.get(k, 1.0) * v for k, v in LINEAR.items()}, [u])
    structure = form(NX, PrandtlIshlinskii(Play, 200, 2))
    values = paper_start(structure, blocks, [u], [x], np.random.default_rng(0))
    z = x @ values["C_z"].T + u @ values["D_zu"].T
    np.testing.assert_allclose(z, u if form is hammerstein else x @ blocks["C_y"].T + u @ blocks["D_yu"].T)
    np.testing.assert_allclose(np.max(values["r"], axis=1) / np.std(z, axis=0), 0.1, rtol=0.05)


@pytest.mark.parametrize("form", [hammerstein, pytest.param(wiener, marks=pytest.mark.slow)])
def test_starts_of_a_structure_with_a_fixed_place_differ(form):
    record = hysteretic_record()
    result = fit(form(2, PrandtlIshlinskii(Play, 4)), record, starts=4)
    assert [c.drawn for c in result.candidates] == [False, True, True, True]
    starts = [c.model.parameters["r"].value for c in result.candidates]
    assert len(np.unique(np.round(starts, 12), axis=0)) == 4
    np.testing.assert_allclose(starts[0][0], np.arange(4) * starts[0][0, 1])


@pytest.mark.parametrize("channels", [1, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "fixed",
    [
        {"C_y": [[1.0, 0.0]], "D_yw": 0.0},
        pytest.param({"B_u": [[0.0], [1.0]], "D_zu": 0.0}, marks=pytest.mark.slow),
        pytest.param({"D_yw": 0.0}, marks=pytest.mark.slow),
        {"B_w": 0.0},
    ],
)
def test_other_fixed_blocks_do_not_make_a_wiener_or_hammerstein_model(fixed, channels):
    record = hysteretic_record()
    result = fit(PILFR(2, PrandtlIshlinskii(Play, 3, channels), fixed), record, starts=2)
    assert result.train_nrmse[0] < result.linear_nrmse[0]
    structure, u = result.structure, [record.u]
    linear = {k: p.value for k, p in result.linear.parameters.items()}
    scaled, (x,) = unit_states(linear, u)
    for place in ("output", "input"):
        values = grid_start(structure, scaled, u, [x], np.random.default_rng(0), place)
        np.testing.assert_allclose(np.std(x @ values["C_z"].T + u[0] @ values["D_zu"].T, axis=0), 1.0)
        if "B_w" in fixed or len(fixed) == 1:  # a path that is fixed at zero gets no half of the model
            np.testing.assert_array_equal(values["B_u"], scaled["B_u"])
            np.testing.assert_array_equal(values["C_y"], scaled["C_y"])


@pytest.mark.parametrize("yunit", [1e-3, pytest.param(1e3, marks=pytest.mark.slow)])
def test_a_wiener_model_does_not_collapse_from_the_papers_start(yunit):
    """With z of the wrong sign or scale the weights fall to zero, where the model is constant and has no slope."""
    record = hysteretic_record()
    record = record.with_(y=yunit * record.y)
    for seed in range(4):
        result = fit(wiener(2, PrandtlIshlinskii(Play, 4)), record, start="plain", starts=1, seed=seed)
        assert result.train_nrmse[0] < 1.05 * result.linear_nrmse[0] and np.sum(result.parameters["w"]) > 0.1


def test_a_model_that_explains_nothing_is_reported():
    result = fit(
        hammerstein(
            1,
            PrandtlIshlinskii(Play, 2),
        ),
        hysteretic_record(),
        starts=1,
    )
    assert "explains nothing" not in str(result)
    shut = replace(hammerstein(1, PrandtlIshlinskii(Play, 2)), bounds={"w": (0.0, 0.0)})
    constant = fit(shut, hysteretic_record(), starts=1)
    assert constant.status.converged and "explains nothing of the training recordings" in str(constant)


def hysteretic_record():
    u = random_input(1, 500)
    structure, values = random_lfr(2, nx=2, n=3)
    model = structure.model(1, 1, values)
    y = make_engine(model, "vm").simulate(u, model.parameters.start, np.zeros(model.n_x + model.n_s))[0]
    return Recording(u, y, 0.1, initial="zero")


def steady_record(seed):
    u = np.tile(random_input(seed, 100), (4, 1))
    structure, values = random_lfr(2, nx=2, n=3)
    model = structure.model(1, 1, values)
    y = make_engine(model, "vm").simulate(u, model.parameters.start, np.zeros(model.n_x + model.n_s))[0]
    return Recording(u, y, 0.1, initial="zero", period=100, skip=200)


def test_plain_starts_are_solved_once_from_the_given_linear_model():
    record, structure = hysteretic_record(), PILFR(2, PrandtlIshlinskii(Play, 3))
    given = time_subspace([record], 2)
    result = fit(structure, record, start="plain", starts=3, seed=5, linear=given)
    blocks = {
        "A": given.A,
        "B_u": given.B,
        "C_y": given.C,
        "D_yu": given.D,
        "y_0": result.linear.parameters["y_0"].value,
    }
    for name in ("A", "B_u", "C_y", "D_yu"):
        np.testing.assert_array_equal(result.linear.parameters[name].value, blocks[name])
    scaled, states = unit_states(blocks, [record.u])
    sequence = np.random.SeedSequence(5).spawn(3)[1]
    model = structure.model(1, 1, paper_start(structure, scaled, [record.u], states, np.random.default_rng(sequence)))
    problem = Problem(model, record, constraints=loosen_radii(stability_limits(structure, True)))
    alone = GaussNewton(max_iterations=200, tolerance=1e-4).solve(problem)
    np.testing.assert_allclose(result.candidates[1].theta, alone.theta, rtol=1e-5, atol=1e-7)
    best = min(result.candidates, key=lambda c: c.error)
    np.testing.assert_array_equal(result.solution.theta, best.theta)


def test_a_linear_model_of_other_sizes_is_refused():
    record, structure = hysteretic_record(), PILFR(2, PrandtlIshlinskii(Play, 3))
    good = time_subspace([record], 2)
    for model, given, words in (
        (structure, time_subspace([record], 3), "has 3 states"),
        (structure, "linear", "A str was given as linear model"),
        (structure, type(good)(good.A, good.B, good.C, good.D, 0.2), "step is 0.2 s"),
        (structure, type(good)(good.A, good.B, good.C, good.D, 1.0), "step is 1.0 s"),
        (NARX(2), good, "is for a PILFR"),
    ):
        with pytest.raises(InputError, match=words):
            fit(model, record, linear=given)
    with pytest.raises(InputError, match="'grid', 'paper' or 'plain'"):
        fit(structure, record, start="letter")
    one, two = (fit(PILFR(2), record, linear=linear).train_nrmse[0] for linear in (good, None))
    assert one == pytest.approx(two, rel=1e-3)  # without an element the given model is refined


def test_the_best_linear_approximation_by_name():
    records = [steady_record(seed) for seed in range(2)]
    structure = PILFR(2, PrandtlIshlinskii(Play, 3))
    named, given = (
        fit(structure, records, start="plain", starts=1, linear=linear)
        for linear in ("bla", frequency_subspace(robust_bla(records), 2))
    )
    for name in ("A", "B_u", "C_y", "D_yu", "y_0"):
        np.testing.assert_array_equal(named.linear.parameters[name].value, given.linear.parameters[name].value)
    np.testing.assert_array_equal(named.solution.theta, given.solution.theta)
    assert fit(structure, records, start="plain", starts=1).linear_nrmse < named.linear_nrmse  # another linear model
    static = fit(PILFR(0, PrandtlIshlinskii(Play, 3)), records, start="plain", starts=1, linear="bla")
    u, y = ([x - x.mean() for x in (getattr(r, name)[r.skip :, 0] for r in records)] for name in "uy")
    gain = np.ravel(u) @ np.ravel(y) / np.sum(np.square(u))
    assert static.linear.parameters["D_yu"].value[0, 0] == pytest.approx(gain)
    with pytest.raises(InputError, match="the period of recording 'b' is not known"):
        fit(structure, [records[0], records[1].with_(period=None, name="b", initial="zero")], linear="bla")
    with pytest.raises(InputError, match="not whole periods of 90 samples"):
        fit(structure, [r.with_(period=90, initial="zero") for r in records], linear="bla")


@pytest.mark.parametrize("structure", [ssnn(NX, 3), network_lfr(NX, 4)])
def test_a_network_begins_as_the_linear_model(structure):
    u = np.random.default_rng(3).normal(size=(400, 2)) * [1.0, 4.0]
    blocks, states = unit_states(LINEAR, [u])
    values = network_start(structure, blocks, [u], states, np.random.default_rng(0))
    model = structure.model(2, 2, values)
    assert not model.parameters["B_w"].value.any() and not model.parameters["D_yw"].value.any()
    z = states[0] @ values["C_z"].T + u @ values["D_zu"].T
    bent = -values["bias"] / values["slope"]  # where the neurons bend, in deviations of z
    assert np.all(np.abs(bent - z.mean(axis=0)[:, None]) <= 1.5 * z.std(axis=0)[:, None] + 1e-9)
    again = network_start(structure, blocks, [u], states, np.random.default_rng(0))
    np.testing.assert_array_equal(again["bias"], values["bias"])


def test_thresholds_all_beyond_the_visited_range_are_spread_evenly():
    r, w = regrid(np.array([1e6, 2e6, 3e6]), np.array([1.0, 2.0, 3.0]), 1.0)
    assert np.all(np.diff(r) > 0) and r[-1] < 1.3 and np.ptp(np.diff(r)) < 1e-6 and w.sum() == pytest.approx(6.0)


def test_thresholds_are_drawn_if_the_direction_of_z_is_fixed():
    """With the same grid all starts of a Hammerstein model would be equal."""
    m = 200
    u, structure = np.random.default_rng(0).standard_normal((m, 1)), hammerstein(1, PrandtlIshlinskii(Play, 4))
    linear = {"A": [[0.5]], "B_u": [[1.0]], "C_y": [[1.0]], "D_yu": [[0.0]], "y_0": [0.0]}
    linear = {k: np.array(v) for k, v in linear.items()}
    found = [grid_start(structure, linear, [u], [np.zeros((m, 1))], np.random.default_rng(k)) for k in range(3)]
    for values in found:
        r = values["r"][0]
        assert r[0] == 0 and np.all(np.diff(r) > 0) and r[-1] < np.max(np.abs(u))
    assert not np.allclose(found[0]["r"], found[1]["r"]) and not np.allclose(found[1]["r"], found[2]["r"])
    placed = [
        grid_start(structure, linear, [u], [np.zeros((m, 1))], np.random.default_rng(k), "input")["r"] for k in range(2)
    ]
    assert np.array_equal(*placed)
