"""Excitation signals: exact spectra, orthogonality, joins without steps, same numbers from the same seed."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from pilfr_casadi._base import InputError
from pilfr_casadi.data import (
    excited_bins,
    multisine,
    orthogonal_multisine,
    prbs,
    sine_sweep,
    steady_periods,
    tukey_realizations,
)

GRIDS = st.sampled_from(["full", "odd", "odd-random"])


def rng(seed=0):
    return np.random.default_rng(seed)


@given(n=st.integers(16, 400), share=st.floats(0.2, 1.0), grid=GRIDS, seed=st.integers(0, 99))
def test_spectrum_is_exact(n, share, grid, seed):
    fs = 50.0
    f_max = share * fs / 2
    bins = excited_bins(n, f_max, fs, grid=grid, rng=rng(seed))
    u = multisine(n, f_max, fs, rng(seed + 1), grid=bins, rms=None)
    spectrum = np.fft.rfft(u)
    expected = np.zeros(n // 2 + 1)
    expected[bins] = n / 2 / np.sqrt(n)  # a sine of amplitude 1/sqrt(N), Eq. 18
    np.testing.assert_allclose(np.abs(spectrum), expected, atol=1e-11)


def test_the_formula_of_the_paper():
    n, fs = 64, 32.0
    u = multisine(n, 8.0, fs, rng(3), rms=None)
    n_max = round(8.0 / fs * n)  # Eq. 19
    phases = rng(3).uniform(0, 2 * np.pi, n_max)
    k = np.arange(n)[:, None]
    lines = np.arange(1, n_max + 1)
    np.testing.assert_allclose(u, np.sin(2 * np.pi * k * lines / n + phases).sum(axis=1) / np.sqrt(n), atol=1e-13)


def test_bins_of_the_grids():
    assert excited_bins(100, 20.0, 100.0).tolist() == list(range(1, 21))
    assert excited_bins(100, 20.0, 100.0, f_min=5.0, grid="odd").tolist() == list(range(5, 21, 2))
    assert excited_bins(100, 50.0, 100.0)[-1] == 49  # not the one at fs/2
    assert excited_bins(101, 50.0, 100.0)[-1] == 50
    assert excited_bins(100, 20.0, 100.0, grid=np.array([7, 3, 7])).tolist() == [3, 7]


@given(seed=st.integers(0, 999))
def test_odd_random_leaves_one_out_of_every_four(seed):
    odd = excited_bins(400, 97.0, 400.0, grid="odd")
    chosen = excited_bins(400, 97.0, 400.0, grid="odd-random", rng=rng(seed))
    groups = [set(odd[i : i + 4]) for i in range(0, len(odd), 4)]
    assert set(chosen) <= set(odd)
    assert [len(g - set(chosen)) for g in groups] == [1 if len(g) == 4 else 0 for g in groups]


@given(rms=st.floats(1e-3, 1e3), grid=GRIDS)
def test_rms_is_exact(rms, grid):
    u = multisine(128, 30.0, 100.0, rng(), grid=grid, rms=rms, amplitude=lambda f: 1 / (1 + f))
    assert np.isclose(np.sqrt(np.mean(u**2)), rms, rtol=1e-12)
    assert abs(u.mean()) < 1e-12 * rms


def test_amplitude_by_function_and_by_array():
    def shape(f):
        return 1 / (1 + f)

    bins = excited_bins(64, 10.0, 64.0)
    by_function = multisine(64, 10.0, 64.0, rng(), amplitude=shape)
    assert np.array_equal(by_function, multisine(64, 10.0, 64.0, rng(), amplitude=shape(bins * 1.0)))
    spectrum = np.abs(np.fft.rfft(by_function))[bins]
    np.testing.assert_allclose(spectrum / spectrum[0], shape(bins) / shape(1.0), rtol=1e-11)


def test_same_seed_same_numbers_and_periods_repeat():
    for grid in ("full", "odd-random"):
        u = multisine(60, 10.0, 60.0, rng(5), grid=grid, periods=3)
        assert np.array_equal(u[:60], multisine(60, 10.0, 60.0, rng(5), grid=grid))
        assert np.array_equal(u[:60], u[60:120])
        assert u.shape == (180,)
        assert not np.allclose(u[:60], multisine(60, 10.0, 60.0, rng(6), grid=grid))


@pytest.mark.parametrize(
    ("n_u", "matrix"), [(1, "dft"), (2, "dft"), (3, "dft"), (5, "dft"), (2, "hadamard"), (4, "hadamard")]
)
def test_orthogonal_at_every_bin(n_u, matrix):
    n, fs = 96, 96.0
    u = orthogonal_multisine(n_u, n, 20.0, fs, rng(2), grid="odd-random", periods=2, matrix=matrix, rms=0.7)
    assert u.shape == (n_u, 2 * n, n_u)
    bins = excited_bins(n, 20.0, fs, grid="odd-random", rng=rng(2))
    spectra = np.fft.fft(u[:, :n, :], axis=1)  # experiments, bins, inputs
    silent = np.setdiff1d(np.arange(n // 2 + 1), bins)
    assert np.abs(spectra[:, silent]).max() < 1e-10
    for k in bins:
        U = spectra[:, k, :].T  # inputs, experiments
        gram = U @ U.conj().T
        level = abs(gram[0, 0])
        assert level > 1.0
        np.testing.assert_allclose(gram, level * np.eye(n_u), atol=1e-10 * level)
    np.testing.assert_allclose(np.sqrt(np.mean(u**2, axis=1)), 0.7, rtol=1e-12)
    assert np.array_equal(u[:, :n], u[:, n:])


def test_one_input_is_a_multisine():
    one = orthogonal_multisine(1, 64, 10.0, 64.0, rng(4))
    np.testing.assert_allclose(one[0, :, 0], multisine(64, 10.0, 64.0, rng(4)), atol=1e-13)


@given(n_realizations=st.integers(1, 4), half=st.integers(32, 200), seed=st.integers(0, 99))
def test_tukey_realizations(n_realizations, half, seed):
    n = 2 * half
    u = tukey_realizations(n_realizations, n, 20.0, 80.0, rng(seed))
    assert u.shape == (2 * n * n_realizations,)
    assert np.isclose(u.std(), 1.0, rtol=1e-12)
    generator = rng(seed)
    periods = steady_periods(n_realizations, n)
    assert len(periods) == n_realizations
    scales = []
    for i, steady in enumerate(periods):
        period = multisine(n, 20.0, 80.0, generator)
        scales.append(u[steady] @ period / (period @ period))
        np.testing.assert_allclose(u[steady], scales[i] * period, atol=1e-12)
        piece = u[2 * n * i : 2 * n * (i + 1)]
        assert piece[0] == 0.0
        ramp = np.sin(np.pi / 2 * np.arange(half) / half) ** 2
        np.testing.assert_allclose(piece[:half], scales[i] * ramp * period[half:], atol=1e-12)
        np.testing.assert_allclose(piece[-half:], scales[i] * (1 - ramp) * period[:half], atol=1e-12)
    assert np.ptp(scales) < 1e-12


def test_tukey_joins_as_smoothly_as_the_multisine_itself():
    n = 1024
    u = tukey_realizations(3, n, 30.0, 120.0, rng(1))
    inside = max(np.abs(np.diff(u[s])).max() for s in steady_periods(3, n))
    assert np.abs(np.diff(u)).max() <= inside
    joins = [2 * n * i + j for i in (1, 2) for j in (-1, 0)]
    assert np.abs(u[joins]).max() < 1e-4


def test_tukey_normalised_over_the_steady_periods():
    u = tukey_realizations(2, 128, 30.0, 120.0, rng(), normalize="steady")
    for steady in steady_periods(2, 128):
        assert np.isclose(u[steady].std(), 1.0, rtol=1e-12)


@pytest.mark.parametrize(("f0", "f1"), [(0.1, 30.0), (30.0, 0.1)])
def test_sweep_frequency_moves_linearly(f0, f1):
    fs, rate = 2000.0, 1.17
    u = sine_sweep(f0, f1, fs, rate=rate, amplitude=2.0)
    assert len(u) == round(29.9 / rate * fs)
    assert np.array_equal(u, sine_sweep(f0, f1, fs, duration=29.9 / rate, amplitude=2.0))
    assert np.isclose(np.abs(u).max(), 2.0, rtol=1e-3)
    assert u[0] == 0.0
    up = np.flatnonzero((u[:-1] < 0) & (u[1:] >= 0)) / fs
    frequency, middle = 1 / np.diff(up), (up[1:] + up[:-1]) / 2
    slow = frequency < 20  # well resolved
    sign = np.sign(f1 - f0)
    np.testing.assert_allclose(frequency[slow], f0 + sign * rate * middle[slow], rtol=0.02, atol=0.05)


@given(order=st.integers(2, 9), seed=st.integers(0, 99))
def test_prbs_has_maximum_length(order, seed):
    length = 2**order - 1
    u = prbs(2 * length, rng(seed), order=order)
    assert np.array_equal(u[:length], u[length:])
    assert abs(u[:length].sum()) == 1.0  # one more of one sign
    correlation = np.array([u[:length] @ np.roll(u[:length], k) for k in range(1, length)])
    assert np.array_equal(correlation, -np.ones(length - 1))


def test_prbs_holds_and_scales():
    u = prbs(1000, rng(1), hold=7, amplitude=0.5)
    assert u.shape == (1000,)
    assert set(np.unique(u)) == {-0.5, 0.5}
    assert (np.diff(np.flatnonzero(np.diff(u))) % 7 == 0).all()
    assert np.array_equal(u, prbs(1000, rng(1), hold=7, amplitude=0.5))
    assert not np.array_equal(u, prbs(1000, rng(2), hold=7, amplitude=0.5))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: multisine(64, 40.0, 64.0, rng()), "f_max <= fs/2"),
        (lambda: multisine(64, 0.3, 64.0, rng()), "no bin"),
        (lambda: multisine(64, 10.0, 64.0, rng(), grid="even"), "unknown"),
        (lambda: multisine(64, 10.0, 64.0, rng(), grid=np.array([0, 1])), "from 1 to 31"),
        (lambda: multisine(64, 10.0, 64.0, rng(), periods=0), "periods is 0"),
        (lambda: multisine(64, 10.0, 64.0, rng(), rms=-1.0), "rms=-1"),
        (lambda: multisine(64, 10.0, 64.0, rng(), amplitude=np.ones(3)), r"\(3,\) for 10 excited bins"),
        (lambda: multisine(64, 10.0, 64.0, rng(), amplitude=np.zeros(10)), "not all 0"),
        (lambda: excited_bins(64, 10.0, 64.0, grid="odd-random"), "pass rng"),
        (lambda: orthogonal_multisine(3, 64, 10.0, 64.0, rng(), matrix="hadamard"), "powers of two"),
        (lambda: orthogonal_multisine(2, 64, 10.0, 64.0, rng(), matrix="qr"), "unknown"),
        (lambda: tukey_realizations(2, 63, 10.0, 64.0, rng()), "even n_period"),
        (lambda: tukey_realizations(2, 64, 10.0, 64.0, rng(), normalize="all"), "'record' or 'steady'"),
        (lambda: sine_sweep(1.0, 2.0, 10.0), "exactly one"),
        (lambda: sine_sweep(1.0, 2.0, 10.0, rate=1.0, duration=1.0), "exactly one"),
        (lambda: sine_sweep(1.0, 6.0, 10.0, rate=1.0), "fs/2"),
        (lambda: sine_sweep(1.0, 2.0, 10.0, rate=0.0), "above zero"),
        (lambda: sine_sweep(1.0, 2.0, 10.0, rate=-1.0), "above zero"),
        (lambda: sine_sweep(2.0, 2.0, 10.0, rate=1.0), "two frequencies"),
        (lambda: prbs(0, rng()), "n_samples is 0"),
        (lambda: prbs(10, rng(), order=1), "2 to 32"),
        (lambda: prbs(10, rng(), order=3.5), "order of the binary sequence is 3.5"),
        (lambda: multisine(64.0, 10.0, 64.0, rng()), "n_samples is 64.0"),
        (lambda: multisine(64, 10.0, 64.0, rng(), grid=[1.5]), "whole numbers from 1 to 31"),
        (lambda: multisine(64, "10", 64.0, rng()), "f_max='10' was given"),
        (lambda: multisine(64, 10.0, 0.0, rng()), "fs=0.0 was given"),
        (lambda: multisine(64, 10.0, 64.0, 1), "rng=1 was given; give a generator"),
        (lambda: multisine(64, 10.0, 64.0, rng(), amplitude="pink"), "amplitude cannot be 'pink'"),
        (lambda: prbs(10, 1), "rng=1 was given"),
        (lambda: prbs(10, rng(), amplitude="1"), "amplitude cannot be '1'"),
    ],
)
def test_bad_options_are_refused(call, words):
    with pytest.raises(InputError, match=words):
        call()
