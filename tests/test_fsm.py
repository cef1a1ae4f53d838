"""The fine steering mirror: its linear family on made-up data, and the whole of it where the recordings are at hand."""

import numpy as np
import pytest

from pilfr_casadi import load, response_bound
from pilfr_casadi.cli import main
from problems.fsm import COMBINED, HELD, ITERATIONS, LEVELS, PERIOD, PUBLISHED, Mirror, noise_table, run
from problems.fsm_linear import Levels, Spectra, fitted_levels, in_modes, normal, simulated
from problems.fsm_model import combined, envelope_alone, pure
from problems.measured_data import measured

FOLDER = measured("fsm")
needs_mirror = pytest.mark.skipif(FOLDER is None, reason="the mirror's recordings are not beside the repository")


def two_modes():
    rng = np.random.default_rng(0)
    A = np.zeros((4, 4))
    for k, (radius, angle) in enumerate(((0.99, 0.8), (0.985, 1.9))):
        c, s = radius * np.cos(angle), radius * np.sin(angle)
        A[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [[c, s], [-s, c]]
    mask, A, B, C = in_modes(A, rng.normal(size=(4, 3)), rng.normal(size=(3, 4)))
    family = Levels(mask, 3, (0, 1, 2), PERIOD)
    values = {"A": A[mask], "B": B, "C": C, "D": 0.1 * rng.normal(size=(3, 3)), "kappa": np.array([0.7, 0.6, 0.8])}
    values |= {"C_z": 1e-3 * rng.normal(size=(3, 4)), "D_z": 0.02 * rng.normal(size=(3, 3))}
    return family, family.pack(values)


def made_up(family, theta):
    rng = np.random.default_rng(1)
    data = []
    for level in range(3):
        u = (level + 1) * 0.1 * rng.normal(size=(PERIOD, 3, 2))
        bare = Spectra.of(u, np.ones_like(u), np.ones(2))
        y, _ = simulated(family, theta, bare, level, PERIOD)
        data.append(Spectra.of(u, y, np.ones(2)))
    return data


def test_modal_coordinates_change_no_response():
    rng = np.random.default_rng(2)
    A, B, C = 0.3 * rng.normal(size=(5, 5)), rng.normal(size=(5, 2)), rng.normal(size=(3, 5))
    mask, A_m, B_m, C_m = in_modes(A, B, C)
    assert np.all(A_m[~mask] == 0)
    for k in range(4):
        expected = C @ np.linalg.matrix_power(A, k) @ B
        np.testing.assert_allclose(C_m @ np.linalg.matrix_power(A_m, k) @ B_m, expected, atol=1e-9)


def test_slopes_of_the_linear_family():
    family, theta = two_modes()
    data = made_up(family, theta)
    rng = np.random.default_rng(3)
    theta = theta * (1 + 1e-3 * rng.normal(size=len(theta)))
    _, gradient, _ = normal(family, theta, data, 97)
    for _ in range(5):
        d = theta * rng.normal(size=len(theta))
        after, before = (normal(family, theta + h * d, data, 97, jacobian=False)[0] for h in (1e-6, -1e-6))
        assert 2 * gradient @ d == pytest.approx((after - before) / 2e-6, rel=1e-4)


def test_the_linear_family_is_found_again():
    family, theta = two_modes()
    data, v = made_up(family, theta), family.unpack(theta)
    start = {"mask": family.mask, **{k: v[k] for k in "ABCD"}}
    found, reached = fitted_levels(start, data, (0, 1, 2), 3, PERIOD, step=7)
    assert normal(found, reached, data, 7, jacobian=False)[0] < 1e-6


@pytest.mark.parametrize("kind", [pytest.param("pure", marks=pytest.mark.slow), "envelope", "combined"])
def test_hysteretic_models_begin_near_the_linear_family(kind):
    family, theta = two_modes()
    data = made_up(family, theta)
    signals = [simulated(family, theta, data[k], k, PERIOD)[1][:, :, 0] for k in range(3)]
    structure, values = combined(family, theta, signals, data[1].deviation)
    if kind != "combined":
        structure, values = pure(family, theta, signals) if kind == "pure" else envelope_alone(structure, values)
    model = structure.model(3, 3, values)
    assert np.max(np.abs(np.linalg.eigvals(model.parameters["A"].value))) < 1
    for name, value in values.items():
        found = model.parameters[name]
        np.testing.assert_allclose(np.where(found.fixed, value, found.value), value)


@needs_mirror
def test_noisy_realizations_are_found_and_kept():
    mirror = Mirror(FOLDER, 1)
    last = noise_table(mirror.data)[-1]
    assert "100 mV, 2" in last and "100 mV, 3" in last and last.count("mV") == 2
    quiet, noisy = mirror.weights[0][[0, 4]], mirror.weights[0][[1, 2]]
    assert 0 < noisy.max() < 0.8 * quiet.min()


@needs_mirror
@pytest.mark.slow
def test_one_model_for_all_levels_beats_the_published_one(tmp_path, capsys):
    mirror = Mirror(FOLDER, 2)
    result = run(mirror, ITERATIONS, models=[COMBINED])[COMBINED]
    errors = mirror.errors(result)
    assert all(ours < theirs for ours, theirs in zip(errors, PUBLISHED[-1][1], strict=True))
    path, data, out = (tmp_path / name for name in ("mirror.json", "test.npz", "out.npz"))
    result.save(path)
    held = [np.load(FOLDER / f"{x}_{LEVELS[0]}mV_train.npy")[:, :, HELD : HELD + 1] for x in "uy"]
    np.savez(data, u=held[0], y=held[1])
    steady = ["--initial", "periodic", "--period", str(PERIOD), "--dt", "1"]
    assert main(["simulate", str(path), str(data), "--out", str(out), *steady]) == 0
    assert f"mean over 2 records: {errors[0] / 100:.4f}" in capsys.readouterr().out
    assert response_bound(load(path), 2.0).guaranteed
