"""Modal coordinates: the same models with fewer numbers."""

import numpy as np
import pytest

from pilfr_casadi import InputError, PrandtlIshlinskii, Recording, fit, hammerstein, load, modal, multisine, play
from pilfr_casadi.linear import in_modal_coordinates, is_modal
from pilfr_casadi.models import PILFR, Play


def system(poles, seed=0):
    """Linear blocks with given poles (conjugates are added) in a random basis."""
    rng, a = np.random.default_rng(seed), []
    for p in poles:
        a.append([[p.real, p.imag], [-p.imag, p.real]] if p.imag else [[p.real]])
    n = sum(len(b) for b in a)
    block, k = np.zeros((n, n)), 0
    for b in a:
        block[k : k + len(b), k : k + len(b)] = b
        k += len(b)
    t = rng.standard_normal((n, n))
    return {
        "A": t @ block @ np.linalg.inv(t),
        "B_u": rng.standard_normal((n, 1)),
        "C_y": rng.standard_normal((1, n)),
    }


def impulse(blocks, n=30):
    out, x = [], blocks["B_u"]
    for _ in range(n):
        out.append(float((blocks["C_y"] @ x)[0, 0]))
        x = blocks["A"] @ x
    return np.array(out)


@pytest.mark.parametrize(
    "poles",
    [
        (0.9 + 0.2j, 0.5 + 0.6j),
        (0.9 + 0.2j, 0.7 + 0j),
        (0.9 + 0j, 0.5 + 0j),
        (0.9 + 0j, -0.4 + 0j, 0.3 + 0j),
        (0.5j, 0.2j),
    ],
)
def test_modal_coordinates_have_blocks_and_change_no_answer(poles):
    blocks = system([complex(p) for p in poles])
    u = np.random.default_rng(1).standard_normal((500, 1))
    found = in_modal_coordinates(blocks, (Recording(u, u, 1.0),))
    n = len(found["A"])
    assert np.all(found["A"][~np.isnan(modal(n))] == 0)
    np.testing.assert_allclose(impulse(found), impulse(blocks), rtol=1e-8, atol=1e-8 * np.max(np.abs(impulse(blocks))))
    x, states = np.zeros((n, 1)), []
    for k in range(500):
        states.append(x[:, 0])
        x = found["A"] @ x + found["B_u"] * u[k]
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(states), axis=0)), 1.0)


def test_the_pattern():
    np.testing.assert_array_equal(np.isnan(modal(3)), [[1, 1, 0], [1, 1, 0], [0, 0, 1]])
    assert is_modal({"A": modal(4)}, 4)
    assert not is_modal({"A": np.zeros((4, 4))}, 4)
    assert not is_modal({}, 4)
    assert not is_modal({"A": modal(3)}, 4)


@pytest.mark.parametrize("nx", [0, -1, 2.5, True, "3"])
def test_invalid_orders_are_refused(nx):
    with pytest.raises(InputError, match=r"the number of states nx is .*; give a whole number, 1 or more"):
        modal(nx)


def test_equal_poles_are_refused():
    with pytest.raises(InputError, match="equal poles"):
        in_modal_coordinates({"A": np.array([[0.5, 1.0], [0.0, 0.5]])}, ())


def records():
    """A resonance behind a backlash, with some noise."""
    rng, out = np.random.default_rng(2), []
    for _ in range(2):
        u = 2.0 * multisine(600, f_max=0.2, fs=1.0, rng=rng)
        y, x, q = np.zeros(1200), np.zeros(3), 0.0
        a = np.array([[0.8, 0.5, 0.0], [-0.5, 0.8, 0.0], [0.0, 0.0, 0.6]])
        for k in range(1200):
            y[k] = x[0] + 0.5 * x[2]
            q = play(u[k % 600], q, 0.5)
            x = a @ x + np.array([0.2, 0.1, 0.4]) * (u[k % 600] + q)
        out.append(Recording(u, y[600:] + 0.01 * rng.standard_normal(600), 1.0, period=600, initial="periodic"))
    return out


@pytest.mark.slow
@pytest.mark.parametrize("build", [lambda n: PILFR(n, PrandtlIshlinskii(Play, 3)), lambda n: PILFR(n), "hammerstein"])
def test_fits_are_as_good_as_with_a_free_matrix(build):
    full = hammerstein(3, PrandtlIshlinskii(Play, 3)) if build == "hammerstein" else build(3)
    train, test = records()
    one = fit(full, train, starts=1)
    two = fit(PILFR(3, full.element, {**full.fixed, "A": modal(3)}), train, starts=1)
    assert np.all(two.parameters["A"][~np.isnan(modal(3))] == 0)
    assert two.nrmse(test) < 1.02 * one.nrmse(test)
    assert two.model.parameters.free.sum() < one.model.parameters.free.sum()


def test_a_model_in_modal_coordinates_survives_its_file(tmp_path):
    train, test = records()
    one = fit(PILFR(3, None, {"A": modal(3)}), train)
    one.save(tmp_path / "model.json")
    again = load(tmp_path / "model.json")
    assert again.nrmse(test) == pytest.approx(one.nrmse(test), rel=1e-9)
    assert is_modal(again.structure.fixed, 3)
