"""BLA: exact on noise-free linear data, variances checked by Monte Carlo, several inputs, units, bad input."""

import control
import numpy as np
import pytest
from random_models import frequency_response, simulate_lti

from pilfr_casadi._base import InputError
from pilfr_casadi.data import Recording
from pilfr_casadi.linear import BLA, output_spectra, plain_bla, robust_bla

DT = 0.01


def system(n_u=1, n_y=1, seed=0):
    """A stable fourth-order model with two damped resonances."""
    rng = np.random.default_rng(seed)
    poles = [0.9 * np.exp(0.6j), 0.8 * np.exp(1.9j)]
    A = np.zeros((4, 4))
    for k, p in enumerate(poles):
        A[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [[p.real, p.imag], [-p.imag, p.real]]
    return control.StateSpace(
        A, rng.standard_normal((4, n_u)), rng.standard_normal((n_y, 4)), rng.standard_normal((n_y, n_u)), DT
    )


def multisine(n, lines, rng, amplitude=1.0):
    """One period with unit standard deviation times `amplitude`, random phases, (n,)."""
    U = np.zeros(n // 2 + 1, dtype=complex)
    U[lines] = np.exp(2j * np.pi * rng.random(len(lines)))
    u = np.fft.irfft(U, n)
    return amplitude * u / np.std(u)


def orthogonal_inputs(n, lines, n_u, rng):
    """One realization: n_u experiments, each (n, n_u), unitary across experiments at every line."""
    base = np.stack([multisine(n, lines, rng) for _ in range(n_u)], axis=1)
    spectrum = np.fft.rfft(base, axis=0)
    turn = np.exp(2j * np.pi * np.outer(np.arange(n_u), np.arange(n_u)) / n_u)
    return [np.fft.irfft(spectrum * turn[e], n, axis=0) for e in range(n_u)]


def steady(model, u):
    """Periodic steady-state output of one period of input."""
    f = np.fft.rfftfreq(len(u), DT)
    Y = np.einsum("fij,fj->fi", frequency_response(model, f), np.fft.rfft(u, axis=0))
    return np.fft.irfft(Y, len(u), axis=0)


def periodic(u, y, periods, rng=None, noise=0.0, noise_u=0.0):
    """Repeat a period and add white noise."""
    u, y = np.tile(u, (periods, 1)), np.tile(y, (periods, 1))
    if rng is not None:
        y = y + noise * rng.standard_normal(y.shape)
        u = u + noise_u * rng.standard_normal(u.shape)
    return Recording(u, y, DT, period=len(u) // periods)


@pytest.mark.parametrize("n_u", [1, 2, 3])
def test_robust_bla_is_exact_for_a_noise_free_linear_system(n_u):
    rng, lines, model = np.random.default_rng(n_u), np.arange(1, 40), system(n_u, 2)
    recordings = [periodic(u, steady(model, u), 2) for _ in range(2) for u in orthogonal_inputs(128, lines, n_u, rng)]
    bla = robust_bla(recordings)
    np.testing.assert_allclose(bla.frequency, lines / (128 * DT))
    np.testing.assert_allclose(bla.G, frequency_response(model, bla.frequency), atol=1e-12)
    assert (bla.n_realizations, bla.n_periods, bla.n_u, bla.n_y) == (2, 2, n_u, 2)
    assert np.max(bla.var_noise) < 1e-24
    assert np.max(bla.var_total) < 1e-24


def test_unknown_variances_are_none():
    rng, model = np.random.default_rng(0), system()
    u = [multisine(64, np.arange(1, 20), rng)[:, None] for _ in range(2)]
    one = robust_bla(periodic(u[0], steady(model, u[0]), 1))
    assert one.var_noise is None
    assert one.var_total is None
    assert robust_bla(periodic(u[0], steady(model, u[0]), 3)).var_noise is not None
    many = robust_bla([periodic(x, steady(model, x), 1) for x in u])
    assert many.var_noise is None
    assert many.var_total is not None


@pytest.mark.parametrize(
    ("n_u", "noise_u"),
    [(1, 0.02), (2, 0.0), *(pytest.param(*v, marks=pytest.mark.slow) for v in ((1, 0.0), (3, 0.01)))],
)
def test_noise_variance_matches_monte_carlo(n_u, noise_u):
    """Linear system: noise and total variance agree with the scatter of G over independent noise, to 4 sigma."""
    rng, model, lines, runs = np.random.default_rng(5), system(n_u, 2), np.arange(1, 31), 150
    inputs = [u for _ in range(4) for u in orthogonal_inputs(64, lines, n_u, rng)]
    outputs = [steady(model, u) for u in inputs]
    blas = [
        robust_bla([periodic(u, y, 3, rng, 0.1, noise_u) for u, y in zip(inputs, outputs, strict=True)], lines=lines)
        for _ in range(runs)
    ]
    true = np.mean([np.abs(b.G - frequency_response(model, b.frequency)) ** 2 for b in blas], axis=0)
    for name, dof in (("var_noise", 4 * 2), ("var_total", 3)):
        estimate = np.mean([getattr(b, name) for b in blas], axis=0)
        log_ratio = np.log(estimate / true)
        sigma = np.sqrt(1 / runs + 1 / (runs * dof))  # of each entry: exponential mean over chi-squared mean
        assert np.abs(np.mean(log_ratio)) < 4 * sigma / np.sqrt(len(lines)), name
        assert np.max(np.abs(log_ratio)) < 5 * sigma, name


def cubic(n_periods, rng, noise=1e-3, n=256):
    u = multisine(n, np.arange(1, 60), rng)[:, None]
    return periodic(u, u + 0.1 * u**3, n_periods, rng, noise)


def test_total_variance_of_a_cubic_matches_monte_carlo():
    """Static y = u + 0.1 u³ under F equal lines of unit power: the BLA is 1 + 0.3 (1 - 1 / 2F); distortion rules."""
    rng, runs = np.random.default_rng(7), 150
    blas = [robust_bla([cubic(2, rng) for _ in range(4)]) for _ in range(runs)]
    G = np.array([b.G for b in blas])[..., 0, 0]
    expected = 1 + 0.1 * 3 * (1 - 1 / (2 * 59))
    scatter = np.mean(np.abs(G - expected) ** 2, axis=0)
    assert np.abs(np.mean(G) - expected) < 4 * np.sqrt(np.mean(scatter) / G.size)
    total = np.mean([b.var_total for b in blas], axis=0)[:, 0, 0]
    noise = np.mean([b.var_noise for b in blas], axis=0)[:, 0, 0]
    log_ratio, sigma = np.log(total / scatter), np.sqrt((1 + 1 / 3) / runs)
    assert np.abs(np.mean(log_ratio)) < 4 * sigma / np.sqrt(59)
    assert np.max(np.abs(log_ratio)) < 5 * sigma
    assert np.all(total > 100 * noise)


def test_output_spectra_carry_the_same_levels():
    rng = np.random.default_rng(3)
    recordings = [cubic(4, rng, noise=0.05) for _ in range(30)]
    spectra, bla = output_spectra(recordings), robust_bla(recordings)
    np.testing.assert_allclose(spectra.frequency, bla.frequency)
    U2 = 1 / (4 * 59 / 2) * np.ones(59)  # |U|² of each of 59 equal lines with unit total power
    np.testing.assert_allclose(spectra.var_noise[:, 0], 30 * bla.var_noise[:, 0, 0] * U2, rtol=1e-2)
    np.testing.assert_allclose(spectra.var_total[:, 0], 30 * bla.var_total[:, 0, 0] * U2, rtol=1e-2)
    np.testing.assert_allclose(np.mean(spectra.var_noise), 0.05**2 / (256 * 4), rtol=0.1)
    assert np.all(spectra.power > spectra.var_total)
    alone = output_spectra(recordings[0].slice(0, 256))
    assert alone.var_noise is None
    assert alone.var_total is None


def test_only_excited_lines_are_returned():
    rng, model, odd = np.random.default_rng(1), system(), np.arange(1, 60, 2)
    u = multisine(256, odd, rng)[:, None]
    clean = robust_bla(periodic(u, steady(model, u), 1))
    np.testing.assert_allclose(clean.frequency, odd / (256 * DT))
    noisy = [periodic(u, steady(model, u), 4, rng, 0.01, 0.03) for _ in range(2)]
    np.testing.assert_allclose(robust_bla(noisy).frequency, odd / (256 * DT))
    np.testing.assert_allclose(robust_bla(noisy, lines=odd[:5]).frequency, odd[:5] / (256 * DT))


def test_skip_and_period_argument():
    rng, model = np.random.default_rng(1), system()
    u = multisine(64, np.arange(1, 20), rng)[:, None]
    y = steady(model, u)
    spoilt = np.concatenate([rng.standard_normal((10, 1)), np.tile(y, (2, 1))])
    r = Recording(np.concatenate([u[-10:], np.tile(u, (2, 1))]), spoilt, DT, skip=10)
    bla = robust_bla(r, period=64)
    np.testing.assert_allclose(bla.G, frequency_response(model, bla.frequency), atol=1e-12)


def test_robust_bla_does_not_depend_on_units():
    rng, model = np.random.default_rng(2), system(2, 2)
    inputs = [u for _ in range(2) for u in orthogonal_inputs(64, np.arange(1, 20), 2, rng)]
    recordings = [periodic(u, steady(model, u), 2, rng, 0.1) for u in inputs]
    a, b = np.array([1e-6, 3.0]), np.array([1e4, 1e-9])
    changed = [r.with_(u=r.u * a, y=r.y * b) for r in recordings]
    first, second = robust_bla(recordings), robust_bla(changed)
    units = b[:, None] / a
    np.testing.assert_allclose(second.G, first.G * units, rtol=1e-9)
    np.testing.assert_allclose(second.var_noise, first.var_noise * units**2, rtol=1e-9)
    np.testing.assert_allclose(second.var_total, first.var_total * units**2, rtol=1e-9)


def random_recordings(model, lengths, rng, noise=0.0):
    recordings = []
    for n in lengths:
        u = rng.standard_normal((n, model.ninputs))
        y = simulate_lti(model, u, rng.standard_normal(model.nstates))
        recordings.append(Recording(u, y + noise * rng.standard_normal(y.shape), DT))
    return recordings


@pytest.mark.parametrize(("n_u", "lengths"), [(1, [2000]), (2, [2000]), (1, [1500, 1100, 700]), (3, [2000, 1200])])
def test_plain_bla_removes_leakage(n_u, lengths):
    """Only the bias of quadratics over some ten lines remains, none of the leakage of a ratio of spectra."""
    rng, model = np.random.default_rng(4), system(n_u, 2)
    recordings = random_recordings(model, lengths, rng)
    bla = plain_bla(recordings)
    true = frequency_response(model, bla.frequency)
    assert np.linalg.norm(bla.G - true) < 2e-3 * np.linalg.norm(true)
    assert bla.var_noise is None
    if n_u == 1:
        U, Y = (np.fft.rfft(x, axis=0)[1:-1] for x in (recordings[0].u, recordings[0].y))
        f = np.fft.rfftfreq(len(recordings[0]), DT)[1:-1]
        ratio = np.linalg.norm(Y / U - frequency_response(model, f)[:, :, 0]) / np.linalg.norm(Y / U)
        assert ratio > 10 * np.linalg.norm(bla.G - true) / np.linalg.norm(true)


@pytest.mark.parametrize(("n_u", "n_rec"), [(1, 1), (2, 1), pytest.param(2, 4, marks=pytest.mark.slow)])
def test_plain_bla_variance_matches_the_true_error(n_u, n_rec):
    rng, model = np.random.default_rng(6), system(n_u, 1)
    ratios = []
    for _ in range(20):
        bla = plain_bla(random_recordings(model, [2000] * n_rec, rng, 0.3), n_frequencies=100)
        error = np.abs(bla.G - frequency_response(model, bla.frequency)) ** 2
        ratios.append(np.mean(error) / np.mean(bla.var_total))
    assert np.abs(np.mean(ratios) - 1) < 4 * np.std(ratios) / np.sqrt(20)
    assert np.std(ratios) < 0.5


def test_plain_bla_averages_periods_and_agrees_with_the_robust_one():
    rng, model = np.random.default_rng(8), system()
    u = multisine(512, np.arange(1, 200), rng)[:, None]
    r = periodic(u, steady(model, u), 4, rng, 0.01)
    plain, robust = plain_bla(r), robust_bla(r)
    at = np.isin(robust.frequency, plain.frequency)
    assert at.sum() == len(plain.frequency)
    assert np.linalg.norm(plain.G - robust.G[at]) < 0.02 * np.linalg.norm(plain.G)


def test_plain_bla_trusts_a_recording_by_its_periods():
    """One noisy period and sixteen of them have 1/17 of the variance of one; equal weights would leave a quarter."""
    rng, model, lines = np.random.default_rng(11), system(), np.arange(1, 1000)
    squares = []
    for _ in range(8):
        inputs = [multisine(2048, lines, rng)[:, None] for _ in range(2)]
        few, many = (periodic(u, steady(model, u), p, rng, 0.2) for u, p in zip(inputs, (1, 16), strict=True))
        both, alone = (plain_bla(r, window=20) for r in ([few, many], few))
        squares.append([np.mean(np.abs(b.G - frequency_response(model, b.frequency)) ** 2) for b in (both, alone)])
    both, alone = np.mean(squares, axis=0)
    assert both < 0.1 * alone


def test_plain_bla_returns_few_frequencies_and_only_excited_ones():
    rng, model = np.random.default_rng(9), system()
    u = np.fft.irfft(np.where(np.arange(1001) < 400, np.fft.rfft(rng.standard_normal(2000)), 0), 2000)[:, None]
    r = Recording(u, simulate_lti(model, u), DT)
    bla = plain_bla(r, n_frequencies=50)
    assert 40 <= len(bla.frequency) <= 50
    assert bla.frequency[-1] < 400 / (2000 * DT)


def test_plain_bla_does_not_depend_on_units():
    rng, model = np.random.default_rng(10), system(2, 2)
    (r,) = random_recordings(model, [800], rng, 0.1)
    a, b = np.array([1e-6, 3.0]), np.array([1e4, 1e-9])
    first, second = plain_bla(r), plain_bla(r.with_(u=r.u * a, y=r.y * b))
    np.testing.assert_allclose(second.G, first.G * b[:, None] / a, rtol=1e-8)
    np.testing.assert_allclose(second.var_total, first.var_total * (b[:, None] / a) ** 2, rtol=1e-8)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_plain_bla_warns_of_a_tone_with_leakage(noise):
    """Beside its line a tone is leakage. The residual does not show it: without noise it is almost zero."""
    u = np.sin(2 * np.pi * 7.77 * DT * np.arange(2000))[:, None]
    y = simulate_lti(system(), u) + noise * np.random.default_rng(0).standard_normal(u.shape)
    with pytest.warns(RuntimeWarning, match=r"the input 'u' is mostly leakage .* `period` set\.$") as found:
        bla = plain_bla(Recording(u, y, DT))
    assert len(found) == 1 and found[0].filename == __file__
    true = frequency_response(system(), bla.frequency)
    assert np.median(np.abs(bla.G - true) / np.abs(true)) > 10


def test_plain_bla_warns_of_noise():
    rng = np.random.default_rng(0)
    (r,) = random_recordings(system(n_y=2), [2000], rng, 0.01)
    plain_bla(r)  # warnings are errors
    drowned = r.with_(y=r.y + np.array([0.0, 100.0]) * rng.standard_normal(r.y.shape))
    with pytest.warns(RuntimeWarning, match=r"the output 'y2' deviates by \d+% of its own size"):
        plain_bla(drowned)


def test_the_print_of_a_bla():
    rng = np.random.default_rng(0)
    text = repr(robust_bla([cubic(2, rng) for _ in range(3)]))
    assert "59 frequencies" in text
    assert "3 realization(s) of 2 period(s)" in text
    assert "total" in text


def _recording(n=128, n_u=1, period=64):
    rng = np.random.default_rng(0)
    u = np.tile(rng.standard_normal((period or 64, n_u)), (-(-n // (period or 64)), 1))[:n]
    return Recording(u, u[:, :1] ** 2, DT, period=period)


def _days(count):
    return [_recording(n_u=2).with_(start=float(k)) for k in range(count)]


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: robust_bla(_recording(period=None)), "period of the recording is not known"),
        (lambda: robust_bla(_recording(130)), "130 samples after the skipped ones, which are not whole periods of 64"),
        (lambda: robust_bla(_recording(), period=60), "not whole periods of 60 samples"),
        (lambda: robust_bla(_recording(), period=2), "not whole periods of 2 samples"),
        (lambda: robust_bla(_days(3)), r"3 recording\(s\) do not make whole realizations of 2"),
        (lambda: robust_bla(_days(2)), "2 inputs are linearly dependent"),
        (lambda: robust_bla([_recording(), _recording(192)]), r"the recordings hold \[2, 3\] periods"),
        (lambda: robust_bla(_recording(), lines=[0, 3]), "no usable excited lines among 1 to 31"),
        (lambda: robust_bla(_recording(), lines=[]), "no usable excited lines"),
        (lambda: robust_bla(_recording(), lines=[1, 2.5]), "give `lines`, whole numbers"),
        (lambda: robust_bla(_recording(), lines="odd"), "lines cannot be 'odd'"),
        (lambda: robust_bla([]), "no recording was given"),
        (lambda: plain_bla(_recording(n=24, period=None)), "cannot fill windows"),
        (lambda: plain_bla(_recording(), order=-1), "order is -1"),
        (lambda: plain_bla(_recording(), order=2.5), "order is 2.5"),
        (lambda: plain_bla(_recording(), window="20"), "window is '20'"),
        (lambda: plain_bla(_recording(), n_frequencies=0), "n_frequencies is 0"),
        (lambda: plain_bla(_recording(), floor=-0.1), "floor=-0.1 was given"),
        (lambda: plain_bla(_recording(), window=5), "cannot fill windows of 5 lines"),
        (lambda: plain_bla(_same_inputs()), "inputs u1, u2 move together"),
        (lambda: plain_bla(_one_constant()), "input 'u2' never changes"),
    ],
)
def test_bad_input_gets_a_sentence(call, sentence):
    with pytest.raises(InputError, match=sentence) as caught:
        call()
    assert "\n" not in str(caught.value)


def _same_inputs():
    u = np.random.default_rng(0).standard_normal((500, 1))
    return Recording(np.hstack([u, 2 * u]), u, DT)


def _one_constant():
    u = np.random.default_rng(0).standard_normal((500, 1))
    return Recording(np.hstack([u, 0 * u + 3]), u, DT)


def test_bla_is_immutable():
    bla = BLA(np.ones(1), np.ones((1, 1, 1)), None, None, DT)
    with pytest.raises(AttributeError):
        bla.dt = 2.0
