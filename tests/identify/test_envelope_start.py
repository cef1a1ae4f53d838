"""Generalized plays start from the envelopes in the recordings, and fit loops that plays and stops cannot."""

import numpy as np
import pytest

from pilfr_casadi.data import Recording, multisine
from pilfr_casadi.identify import (
    deconvolve_inputs,
    envelope_start,
    fit,
    fit_envelope,
    grid_start,
    loop_outline,
    threshold_range,
    unit_states,
)
from pilfr_casadi.models import (
    PILFR,
    GeneralizedPlay,
    Play,
    PrandtlIshlinskii,
    Stop,
    generalized_play,
    hammerstein,
    wiener,
)
from problems import shape_memory

PERIOD = 1000
LINEAR = {
    "A": np.array([[0.8, 0.1], [-0.1, 0.8]]),
    "B_u": np.array([[0.2], [0.1]]),
    "C_y": np.array([[1.0, -0.5]]),
    "D_yu": np.array([[0.3]]),
    "y_0": np.array([0.5]),
}


def lower(z):
    return np.tanh(1.5 * z - 0.6)


def upper(z):
    return 0.9 * np.tanh(0.7 * z + 0.8) + 0.2


def loop(z):
    """A generalized play between `lower` and `upper`, in periodic steady state."""
    q, out = 0.0, np.empty(len(z))
    for _ in range(2):
        for k, value in enumerate(z):
            out[k] = q = generalized_play(value, q, 0.0, lower, upper)
    return out


def drive(seed=0):
    return multisine(PERIOD, f_max=0.02, fs=1.0, rng=np.random.default_rng(seed))


def filtered(u):
    """Steady-state answer of a first-order lag."""
    return np.fft.irfft(np.fft.rfft(u) * 0.3 / (1 - 0.7 * np.exp(-2j * np.pi * np.arange(PERIOD // 2 + 1) / PERIOD)))


def test_the_outline_of_a_loop_is_its_envelopes():
    z = np.tile(drive(), 4)
    v = loop(z)
    at, low, high = loop_outline(z, v)
    for found, curve in ((low, np.maximum(lower(at), v.min())), (high, np.clip(upper(at), lower(at), v.max()))):
        assert np.max(np.abs(found - curve)) < 0.1
        assert np.sqrt(np.mean((found - curve) ** 2)) < 0.03
    assert np.all(np.diff(low) >= 0) and np.all(np.diff(high) >= 0)


def test_a_loop_in_the_other_direction_has_no_width():
    z = drive()
    _, low, high = loop_outline(z[::-1], loop(z)[::-1])
    np.testing.assert_array_equal(low, high)


@pytest.mark.parametrize("neurons", [0, 1, 4])
def test_networks_follow_a_curve_and_rise(neurons):
    z = np.linspace(-2.0, 3.0, 60)
    p = fit_envelope(z, upper(z), neurons)
    named = {f"gamma_l_{k}": v[None] for k, v in p.items()}
    error = GeneralizedPlay(neurons).envelope("l", z, named) - upper(z)
    assert np.sqrt(np.mean(error**2)) < (0.02 if neurons == 4 else 0.2)
    assert all(np.all(p[k] >= 0) for k in ("a0", "a", "b")) and np.all(p["a"] > 0)


def test_the_input_behind_the_linear_model_is_found():
    rng, z = np.random.default_rng(1), np.exp(2j * np.pi * np.arange(PERIOD // 2 + 1) / PERIOD)
    u, want = drive(), drive(seed=5)
    g = np.array([(LINEAR["C_y"] @ np.linalg.solve(s * np.eye(2) - LINEAR["A"], LINEAR["B_u"]))[0, 0] + 0.3 for s in z])
    y = np.fft.irfft(g * np.fft.rfft(want)) + 0.5 + 1e-3 * rng.standard_normal(PERIOD)
    record = Recording(u, y, 1.0, period=PERIOD, initial="periodic")
    states = unit_states(LINEAR, [np.tile(u, 3)[:, None]], free=False)[1][0][-PERIOD:]
    found = deconvolve_inputs(LINEAR, record, states)[:, 0]
    assert np.sqrt(np.mean((found - want) ** 2)) < 0.02


def test_a_falling_signal_changes_its_sign():
    structure = PILFR(2, PrandtlIshlinskii(GeneralizedPlay(3), 4))
    u = drive()[:, None]
    blocks, states = unit_states(LINEAR, [u])
    record = Recording(u, states[0] @ blocks["C_y"].T, 1.0)
    values = grid_start(structure, blocks, [u], states, np.random.default_rng(0), "output")
    turned = {**values, "C_z": -values["C_z"], "D_zu": -values["D_zu"]}
    one, two = (envelope_start(structure, blocks, v, [record], states, "output") for v in (values, turned))
    for name, value in one.items():
        np.testing.assert_allclose(two[name], value, err_msg=name)
    assert np.all(one["C_y"] == 0) and np.all(one["r"] >= 0)


def test_reach_of_plays_and_of_envelopes():
    z = np.array([-3.0, 2.0])
    assert threshold_range(PILFR(1, PrandtlIshlinskii(Play, 3)), {}, z, 0) == 3.0
    structure = PILFR(1, PrandtlIshlinskii(GeneralizedPlay(0), 3))
    straight = {f"gamma_{s}_{k}": np.full((1, 1), v) for s in "lr" for k, v in (("c", 0.5), ("a0", 2.0))}
    empty = {f"gamma_{s}_{k}": np.zeros((1, 0)) for s in "lr" for k in "abd"}
    assert threshold_range(structure, straight | empty, z, 0) == pytest.approx(5.0)


def record_of(y, noise, seed):
    y = y + noise * np.std(y) * np.random.default_rng(seed).standard_normal(PERIOD)
    return Recording(drive(seed), y, 1.0, period=PERIOD, initial="periodic")


@pytest.mark.parametrize(
    ("structure", "truth"),
    [(hammerstein, lambda u: filtered(loop(u))), (wiener, lambda u: loop(filtered(u)))],
    ids=["hammerstein", "wiener"],
)
def test_structures_with_fixed_blocks_find_their_envelopes(structure, truth):
    noise = 0.01
    train, test = (record_of(truth(drive(seed)), noise, seed) for seed in (1, 2))
    result = fit(structure(1, PrandtlIshlinskii(GeneralizedPlay(4), 1)), train, starts=1)
    assert result.nrmse(test) < 2.5 * noise


@pytest.mark.slow
def test_only_generalized_plays_follow_a_shape_memory_wire():
    data = shape_memory.records()
    errors = {}
    for operator in (Play, Stop, GeneralizedPlay(4)):
        starts = 3 if isinstance(operator, GeneralizedPlay) else 2
        result = fit(PILFR(1, PrandtlIshlinskii(operator, 4)), data["train"][:1], starts=starts)
        errors[result.structure.element.operator.name] = [result.nrmse(data[k]) for k in ("multisine", "swings")]
    assert max(errors["generalized_play"]) < 0.1
    assert min(errors["play"] + errors["stop"]) > 0.2
