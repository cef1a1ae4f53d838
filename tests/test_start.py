"""Start values: where the element is placed, units, and thresholds placed anew."""

import numpy as np
import pytest

from pilfr_casadi.elements import PrandtlIshlinskii
from pilfr_casadi.fit import fit
from pilfr_casadi.lfr import PILFR, hammerstein, wiener
from pilfr_casadi.operators import Play
from pilfr_casadi.recording import Recording
from pilfr_casadi.start import grid_start, regrid, unit_states

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
    """Outputs with the element passing z on, times `gain`."""
    z = x @ values["C_z"].T + u @ values["D_zu"].T
    return x @ values["C_y"].T + u @ values["D_yu"].T + gain * z @ values["D_yw"].T


def test_half_of_the_output_is_read_through_the_element():
    values, u, x = started(PILFR(NX, PrandtlIshlinskii(Play, N, 2)), "output")
    blocks, _ = unit_states(LINEAR, [u])
    np.testing.assert_allclose(linear_output(values, u, x), x @ blocks["C_y"].T + u @ LINEAR["D_yu"].T, atol=1e-12)
    np.testing.assert_allclose(values["C_y"], 0.5 * blocks["C_y"])
    assert "B_w" not in values
    z = x @ values["C_z"].T + u @ values["D_zu"].T
    np.testing.assert_allclose(np.std(z, axis=0), 1.0)


def test_half_of_the_input_comes_through_the_element():
    values, u, _ = started(PILFR(NX, PrandtlIshlinskii(Play, N, 2)), "input")
    blocks, _ = unit_states(LINEAR, [u])
    assert not values["C_z"].any()
    np.testing.assert_allclose(values["B_u"] + values["B_w"] @ values["D_zu"], blocks["B_u"], atol=1e-12)
    np.testing.assert_allclose(values["D_yu"] + values["D_yw"] @ values["D_zu"], LINEAR["D_yu"], atol=1e-12)
    np.testing.assert_allclose(values["B_u"], 0.5 * blocks["B_u"])


def test_more_channels_share_and_fewer_leave_the_rest():
    values, _, _ = started(PILFR(NX, PrandtlIshlinskii(Play, N, 3)), "input")
    blocks, u, _ = started(PILFR(NX, PrandtlIshlinskii(Play, N, 1)), "output")
    np.testing.assert_allclose(values["B_w"][:, 0], values["B_w"][:, 2])
    scaled, _ = unit_states(LINEAR, [u])
    np.testing.assert_allclose(blocks["C_y"], scaled["C_y"] * [[0.5], [1.0]])


@pytest.mark.parametrize("place", ["output", "input"])
@pytest.mark.parametrize("build", [hammerstein, wiener])
def test_what_is_fixed_stays(build, place):
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


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("where", ["before", "behind"])
def test_backlash_on_either_side_of_a_mass(where, unit):
    rng = np.random.default_rng(7)
    t = np.arange(3000)
    u = sum(np.cos(2 * np.pi * k * t / 3000 + rng.uniform(0, 2 * np.pi)) for k in range(1, 61))[:, None]
    u = 20 * u / u.std()
    y = mass(backlash(u, 4.0)) if where == "before" else backlash(mass(u), 0.005)
    noise = 0.005 * y.std() * rng.normal(size=y.shape)
    found = fit(PILFR(2, PrandtlIshlinskii(Play, 10)), Recording(u * unit, y + noise, 0.002, initial="zero"))
    assert found.train_nrmse[0] < 0.0056  # noise alone: 0.0050


def test_thresholds_follow_the_density():
    """Each stands for an equal share of density^0.4, where the weights' density is known."""
    r, w = np.linspace(0.0, 1.0, 400), 1.0 / 400 * np.linspace(2.0, 0.2, 400)
    placed, mass = regrid(r, w, 1.0, beyond=1.0, smooth=0.02)
    assert np.sum(mass) == pytest.approx(w.sum(), rel=0.03)
    share = np.diff((2.0 - 1.8 * np.array([placed[0], *placed[50:-50:50]])) ** 1.4)
    np.testing.assert_allclose(share, share[1], rtol=0.06)
    gaps = np.diff(placed)
    assert 0.55 < gaps[20] / gaps[350] < 0.75  # (0.4 quantiles) proportional to density^-0.4, not to density^-1


def test_the_tail_goes_on_beyond_what_was_visited():
    r = np.linspace(0.0, 1.0, 100)
    w = np.exp(-2.0 * r)
    placed, mass = regrid(r, w, 1.0, beyond=1.3, smooth=1 / 12)
    assert placed[-1] > 1.2 and np.all(np.diff(placed) > 0)
    density = mass[-12:] / np.gradient(placed)[-12:] / 100
    expected = np.exp(-2.0 * placed[-12:])
    np.testing.assert_allclose(density, expected, rtol=0.15)
