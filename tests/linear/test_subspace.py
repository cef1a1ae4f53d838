"""Subspace identification: exact on noise-free data, sane with noise, no dependence on units, bad input."""

import control
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from random_models import frequency_response, simulate_lti

from pilfr_casadi._base import InputError
from pilfr_casadi.data import Recording
from pilfr_casadi.linear import (
    BLA,
    frequency_subspace,
    plain_bla,
    propagate,
    robust_bla,
    select_order,
    subspace_matrices,
    time_subspace,
)

DT = 0.1
SIZES = dict(nx=st.integers(1, 8), n_u=st.integers(1, 3), n_y=st.integers(1, 3), seed=st.integers(0, 10_000))
GRID = np.linspace(0, 5, 101)


def random_system(nx, n_u, n_y, rng, radius=0.95):
    A = rng.standard_normal((nx, nx))
    A *= radius / np.max(np.abs(np.linalg.eigvals(A)))
    B, C, D = rng.standard_normal((nx, n_u)), rng.standard_normal((n_y, nx)), rng.standard_normal((n_y, n_u))
    return control.StateSpace(A, B, C, D, DT)


def response_error(model, true):
    """Compute the largest error of the response on another grid, over the largest response."""
    reference = frequency_response(true, GRID)
    return np.max(np.abs(frequency_response(model, GRID) - reference)) / np.max(np.abs(reference))


def records(model, lengths, rng, noise=0.0, offset=0.0):
    out = []
    for n in lengths:
        u = rng.standard_normal((n, model.ninputs))
        y = simulate_lti(model, u, rng.standard_normal(model.nstates))
        out.append(Recording(u, y + offset + noise * np.std(y, axis=0) * rng.standard_normal(y.shape), DT))
    return out


def exact_bla(model, frequency, **variances):
    G = frequency_response(model, frequency)
    return BLA(frequency, G, variances.get("var_noise"), variances.get("var_total"), model.dt)


def radius(model):
    return np.max(np.abs(np.linalg.eigvals(model.A)))


# --- exact recovery ---------------------------------------------------------------------------------------------------


@given(**SIZES)
@settings(max_examples=15)
def test_frequency_subspace_recovers_a_model_from_its_response(nx, n_u, n_y, seed):
    rng = np.random.default_rng(seed)
    true = random_system(nx, n_u, n_y, rng)
    model = frequency_subspace(exact_bla(true, np.sort(rng.uniform(0, 5, 80))), nx)
    assert isinstance(model, control.StateSpace)
    assert (model.nstates, model.ninputs, model.noutputs, model.dt) == (nx, n_u, n_y, DT)
    assert response_error(model, true) < 1e-8


@given(**SIZES)
@settings(max_examples=10)
def test_time_subspace_recovers_a_model_from_its_records(nx, n_u, n_y, seed):
    rng = np.random.default_rng(seed)
    true = random_system(nx, n_u, n_y, rng)
    model = time_subspace(records(true, [300, 220], rng), nx)
    assert (model.nstates, model.ninputs, model.noutputs, model.dt) == (nx, n_u, n_y, DT)
    assert response_error(model, true) < 1e-8


@pytest.mark.parametrize("band", [(0.0, 1.5), (1.0, 2.5)])
def test_a_narrow_band_is_enough(band):
    """Powers of z would be dependent up to rounding there; orthonormal polynomials are not."""
    rng = np.random.default_rng(3)
    true = random_system(4, 1, 1, rng)
    bla = exact_bla(true, np.linspace(*band, 60))
    model = frequency_subspace(bla, 4)
    error = np.abs(frequency_response(model, bla.frequency) - bla.G)
    assert np.max(error) < 1e-9 * np.max(np.abs(bla.G))


@pytest.mark.slow
def test_forty_states_and_four_thousand_frequencies():
    """Twenty lightly damped modes between three inputs and outputs, with a trace of noise."""
    rng = np.random.default_rng(1)
    A = np.zeros((40, 40))
    for k, angle in enumerate(np.linspace(0.05, 2.9, 20)):
        c, s = 0.99 * np.cos(angle), 0.99 * np.sin(angle)
        A[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [[c, s], [-s, c]]
    true = control.StateSpace(A, rng.standard_normal((40, 3)), rng.standard_normal((3, 40)), np.zeros((3, 3)), DT)
    bla = exact_bla(true, np.linspace(0.001, 4.999, 4000))
    noise = rng.standard_normal((2, *bla.G.shape)) * 1e-4 * np.sqrt(np.mean(np.abs(bla.G) ** 2))
    noisy = BLA(bla.frequency, bla.G + noise[0] + 1j * noise[1], None, None, DT)
    error = np.linalg.norm(frequency_response(frequency_subspace(noisy, 40), bla.frequency) - bla.G)
    assert error < 2e-5 * np.linalg.norm(bla.G)


def test_skipped_samples_are_not_used():
    rng = np.random.default_rng(2)
    true = random_system(3, 1, 1, rng)
    (r,) = records(true, [300], rng)
    spoilt = r.y.copy()
    spoilt[:50] = 100.0
    assert response_error(time_subspace(r.with_(y=spoilt, skip=50), 3), true) < 1e-8


def test_an_offset_of_each_recording_is_left_out():
    rng = np.random.default_rng(4)
    true = random_system(3, 2, 2, rng)
    recordings = records(true, [300], rng, offset=5.0) + records(true, [250], rng, offset=-70.0)
    assert response_error(time_subspace(recordings, 3, offset=True), true) < 1e-8
    assert response_error(time_subspace(recordings, 3), true) > 1e-2


def test_subspace_matrices_equal_the_model():
    rng = np.random.default_rng(5)
    recordings = records(random_system(3, 2, 1, rng), [300], rng, noise=0.1)
    model = time_subspace(recordings, 3)
    for matrix, name in zip(subspace_matrices(recordings, 3), "ABCD", strict=True):
        np.testing.assert_array_equal(matrix, getattr(model, name))


# --- noise, stability, weights, units ---------------------------------------------------------------------------------


def test_noisy_record_is_explained_to_its_noise():
    """Thirty thousand samples, five states, 10 % noise: the error is below a hundredth of the response."""
    rng = np.random.default_rng(6)
    true = random_system(5, 1, 1, rng)
    (r,) = records(true, [30_000], rng, noise=0.1)
    assert response_error(time_subspace(r, 5), true) < 0.01


def test_unstable_data_give_a_stable_model():
    rng = np.random.default_rng(7)
    true = random_system(4, 1, 2, rng, radius=1.02)
    assert radius(frequency_subspace(exact_bla(true, np.linspace(0.01, 4.99, 100)), 4)) < 1
    u = rng.standard_normal((200, 1))
    assert radius(time_subspace(Recording(u, simulate_lti(true, u), DT), 4)) < 1


def test_reflection_keeps_the_gain_of_an_unstable_pole():
    """One pole at 1.25 becomes 0.8, its reciprocal: |1 / (z - 1.25)| is |0.8 / (z - 0.8)| on the unit circle."""
    unstable = control.StateSpace([[1.25]], [[1.0]], [[1.0]], [[0.0]], DT)
    model = frequency_subspace(exact_bla(unstable, np.linspace(0.01, 4.99, 200)), 1)
    np.testing.assert_allclose(model.A, [[0.8]], rtol=1e-9)


def test_weights_favour_certain_frequencies():
    rng = np.random.default_rng(8)
    true = random_system(4, 2, 2, rng)
    frequency = np.linspace(0.01, 4.99, 300)
    G = frequency_response(true, frequency)
    std = np.where(frequency < 2.5, 1e-3, 1.0)[:, None, None] * np.ones(G.shape)
    noise = std * (rng.standard_normal(G.shape) + 1j * rng.standard_normal(G.shape)) / np.sqrt(2)
    bla = BLA(frequency, G + noise, None, std**2, DT)
    weighted, plain = (frequency_subspace(bla, 4, weight=w) for w in (True, False))
    low = frequency < 2.5
    error = [np.linalg.norm((frequency_response(m, frequency) - G)[low]) for m in (weighted, plain)]
    assert error[0] < 0.05 * error[1]
    assert error[0] < 1e-3 * np.sqrt(low.sum() * 4)  # below the noise that was averaged


def test_a_noisy_output_does_not_spoil_a_clean_one():
    """The noise of the other output hardly affects the response of the clean one."""
    rng = np.random.default_rng(17)
    true = random_system(4, 2, 2, rng)
    frequency = np.linspace(0.01, 4.99, 300)
    G = frequency_response(true, frequency)
    std = np.array([[1e-3], [3.0]]) * np.ones(G.shape)
    noise = std * (rng.standard_normal(G.shape) + 1j * rng.standard_normal(G.shape)) / np.sqrt(2)
    model = frequency_subspace(BLA(frequency, G + noise, None, std**2, DT), 4, block_rows=9)
    error = np.abs(frequency_response(model, frequency) - G)
    assert np.sqrt(np.mean(error[:, 0] ** 2)) < 1e-3 / 3
    assert np.sqrt(np.mean(error[:, 1] ** 2)) < 3.0 / 3


def test_models_do_not_depend_on_units():
    rng = np.random.default_rng(9)
    true = random_system(4, 2, 2, rng)
    a, b = np.array([1e-6, 300.0]), np.array([1e5, 1e-9])
    units = b[:, None] / a
    recordings = records(true, [400, 300], rng, noise=0.1)
    changed = [r.with_(u=r.u * a, y=r.y * b) for r in recordings]
    first, second = (frequency_response(time_subspace(x, 4), GRID) for x in (recordings, changed))
    np.testing.assert_allclose(second / units, first, atol=1e-8 * np.max(np.abs(first)))
    blas = plain_bla(recordings), plain_bla(changed)
    for weight in (True, False):
        first, second = (frequency_response(frequency_subspace(x, 4, weight), GRID) for x in blas)
        np.testing.assert_allclose(second / units, first, atol=1e-8 * np.max(np.abs(first)))


def test_from_recording_to_model_through_the_bla():
    rng = np.random.default_rng(10)
    true = random_system(4, 1, 1, rng)
    periods = []
    for _ in range(4):
        u = np.fft.irfft(np.exp(2j * np.pi * rng.random(129)) * (np.arange(129) > 0), 256)
        u = np.tile(u / np.std(u), 5)[:, None]
        y = simulate_lti(true, u)
        y = y + 0.05 * np.std(y) * rng.standard_normal(y.shape)
        periods.append(Recording(u, y, DT, period=256, skip=512))
    assert response_error(frequency_subspace(robust_bla(periods), 4), true) < 0.02


# --- order ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_records", [1, 3])
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_select_order_finds_the_order(n_records, noise):
    rng = np.random.default_rng(12)
    A = np.diag([0.9, -0.7, 0.5])
    true = control.StateSpace(A, np.ones((3, 1)), np.array([[1.0, 2.0, -3.0]]), [[0.0]], DT)
    recordings = records(true, [1500] * n_records, rng, noise=noise)
    choice = select_order(recordings if n_records > 1 else recordings[0], range(1, 7))
    assert choice.recommended == 3
    assert choice.orders == (1, 2, 3, 4, 5, 6)
    assert len(choice.train) == len(choice.validation) == 6
    if noise:
        np.testing.assert_allclose(choice.validation[2:], noise / np.sqrt(1 + noise**2), rtol=0.1)
    text = repr(choice).splitlines()
    assert text[3].endswith("<- recommended")
    assert "smallest order within 5 %" in text[-1]


def test_select_order_on_a_bla_holds_out_every_second_line():
    rng = np.random.default_rng(13)
    true = control.StateSpace(np.diag([0.9, -0.7, 0.5]), np.ones((3, 1)), [[1.0, 2.0, -3.0]], [[0.0]], DT)
    bla = plain_bla(records(true, [20_000], rng, noise=0.02))
    assert select_order(bla, range(1, 7)).recommended == 3
    assert select_order(bla, 3).orders == (3,)
    assert select_order(exact_bla(true, np.linspace(0.01, 4.9, 60)), [5, 3, 1]).recommended == 3


def test_orders_too_high_for_the_data_are_left_out():
    rng = np.random.default_rng(14)
    recordings = records(random_system(2, 1, 1, rng), [60], rng)
    assert max(select_order(recordings, range(1, 40)).orders) < 10


# --- small helpers ----------------------------------------------------------------------------------------------------


@given(**SIZES, M=st.integers(1, 70))
@settings(max_examples=30)
def test_propagation_equals_the_plain_loop(nx, n_u, n_y, seed, M):
    rng = np.random.default_rng(seed)
    model = random_system(nx, n_u, n_y, rng)
    u, x = rng.standard_normal((M, n_u)), rng.standard_normal(nx)
    states, last = propagate(model.A.T, (u @ model.B.T)[None], x[None])
    for k in range(M):
        np.testing.assert_allclose(states[0, k], x, atol=1e-10)
        x = model.A @ x + model.B @ u[k]
    np.testing.assert_allclose(last[0], x, atol=1e-10)


def test_frequency_response_is_that_of_control():
    model = random_system(5, 2, 3, np.random.default_rng(15))
    expected = np.stack([model(np.exp(2j * np.pi * f * DT)) for f in GRID])
    np.testing.assert_allclose(frequency_response(model, GRID), expected, atol=1e-12)
    integrator = control.StateSpace([[1.0]], [[1.0]], [[1.0]], [[0.0]], DT)
    assert not np.any(np.isfinite(frequency_response(integrator, np.array([0.0]))))


# --- bad input --------------------------------------------------------------------------------------------------------


def _short(n=30, n_u=1):
    rng = np.random.default_rng(0)
    return Recording(rng.standard_normal((n, n_u)), rng.standard_normal((n, 1)), DT)


def _bla(n=10, f_max=4.0, value=1.0):
    return BLA(np.linspace(0.1, f_max, n), np.full((n, 1, 1), value, dtype=complex), None, None, DT)


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: time_subspace(_short(), 0), "order nx is 0; give a whole number, 1 or more"),
        (lambda: time_subspace(_short(), -3), "order nx is -3"),
        (lambda: frequency_subspace(_bla(), 2.5), "order nx is 2.5"),
        (lambda: frequency_subspace(_bla(), True), "order nx is True"),
        (lambda: time_subspace(_short(), 20), r"30 samples in 1 recording\(s\) are too few for order 20"),
        (
            lambda: time_subspace([_short(8), _short(8).with_(start=1.0)], 5),
            r"16 samples in 2 recording\(s\) are too few for order 5",
        ),
        (lambda: frequency_subspace(_bla(), 15), "10 frequencies are too few for order 15"),
        (lambda: frequency_subspace(_bla(1), 1), "1 frequencies are too few for order 1"),
        (lambda: frequency_subspace(_bla(f_max=40.0), 2), "outside 0 to 5 Hz"),
        (lambda: frequency_subspace(_bla(value=np.nan), 2), "must be finite"),
        (lambda: time_subspace(_short(), 2, block_rows=1), "block_rows is 1; for order 2 and these data give 3 to"),
        (lambda: time_subspace(_short(), 1, block_rows=50), "block_rows is 50"),
        (lambda: time_subspace([], 2), "no recording was given"),
        (lambda: select_order(_short(), []), "at least one order"),
        (lambda: select_order(_short(), [0, 1]), "order nx is 0"),
        (lambda: select_order(_short(), [1], margin=-1), "margin of -1"),
        (lambda: select_order(_short(), [1], margin=np.nan), "margin of nan"),
        (lambda: select_order(_short(), [50]), "too few for order 50"),
    ],
)
def test_bad_input_gets_a_sentence(call, sentence):
    with pytest.raises(InputError, match=sentence) as caught:
        call()
    assert "\n" not in str(caught.value)
