"""The noise floor: measured where something repeats, and what tells noise from a residual that is none."""

import numpy as np
import pytest
from scipy.signal import lfilter

from pilfr_casadi import Recording
from pilfr_casadi.diagnose.fits.floor import (
    Floor,
    acting_samples,
    effective_size,
    measured_floor,
    pool,
    samples_of_mean,
    swells_with,
    third_differences,
    white_part,
)

N, DEVIATION = 200, (0.02, 0.5)


def noisy(count, seed=0, **known):
    """A recording of some periods, with white noise of its own in each of two outputs."""
    rng, t = np.random.default_rng(seed), np.arange(N * count) / N
    y = np.column_stack([np.sin(2 * np.pi * t), np.cos(4 * np.pi * t)]) + rng.standard_normal((len(t), 2)) * DEVIATION
    return Recording(np.sin(2 * np.pi * t)[:, None], y, 0.01, ("u",), ("a", "b"), **known)


def test_periods_show_the_noise_of_each_output():
    found = measured_floor([noisy(8, seed, initial="periodic", period=N) for seed in range(2)])
    assert found.source == "periods"
    assert found.deviation == pytest.approx(DEVIATION, rel=0.05)
    assert found.nrmse(np.array([0.2, 5.0])) == pytest.approx(0.1, rel=0.05)
    assert found.beside(np.array([0.02, 0.0])).deviation == pytest.approx((2**0.5 * 0.02, 0.5), rel=0.05)


def test_free_motions_show_it_only_from_the_same_start():
    free = [r.with_(u=np.empty((4 * N, 0)), inputs=()) for r in (noisy(4, seed, initial="zero") for seed in range(4))]
    assert measured_floor(free).deviation == pytest.approx(DEVIATION, rel=0.1)
    assert measured_floor([r.with_(initial="estimate") for r in free]) is None


@pytest.mark.parametrize("initial", ["zero", "estimate"])
def test_recordings_of_the_same_input_show_it_too(initial):
    found = measured_floor([noisy(4, seed, initial=initial) for seed in range(4)])
    assert found.source == "repeats"
    assert found.deviation == pytest.approx(DEVIATION, rel=0.1)


def test_rounding_repeats_and_is_noise_nevertheless():
    """Periods of a coarse sensor are alike, so they show less than the error of rounding."""
    exact = noisy(8, initial="periodic", period=N)
    quiet = exact.with_(y=np.tile(exact.y[:N], (8, 1)))
    coarse = quiet.with_(y=np.round(quiet.y / 0.1) * 0.1)
    assert max(measured_floor([quiet]).deviation) < 1e-4
    assert measured_floor([coarse]).deviation == pytest.approx((0.1 / 12**0.5,) * 2, rel=1e-3)


@pytest.mark.parametrize("pole", [0.0, 0.98])
@pytest.mark.parametrize("repeats", [2, 8])
def test_an_error_that_repeats_is_told_from_measured_noise(pole, repeats):
    """A residual of noise alone may be noise, one with a sine of the noise's size that repeats may not."""
    wrong = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        noise = lfilter([1], [1, -pole], rng.standard_normal(repeats * 4 * N + 500))[500:, None]
        drive = np.tile(rng.standard_normal(4 * N), repeats)
        blank = Recording(drive, noise, 0.01, ("u",), ("a",), initial="periodic", period=4 * N)
        floor = measured_floor([blank])
        sine = 1.5 * floor.deviation * np.sin(0.5 * np.arange(len(noise)))[:, None]
        alone, both = (np.std(e, axis=0) for e in (noise, noise + sine))
        wrong += not floor.may_be(alone)
        wrong += floor.may_be(both) if repeats > 2 or not pole else 0
    assert floor.repeats == repeats
    assert wrong <= 1  # noise alone passes for something else in one case of a hundred
    assert not Floor(floor.deviation, "estimated").may_be(floor.deviation)


def test_a_noisy_output_hides_nothing_in_a_quiet_one():
    floor = measured_floor([noisy(4, initial="periodic", period=N)])
    assert floor.may_be(floor.deviation)
    assert not floor.may_be(floor.deviation * [1.0, 3.0])


def test_one_period_and_one_recording_show_nothing():
    assert measured_floor([noisy(1, initial="periodic", period=N)]) is None
    other = noisy(4, initial="zero")
    assert measured_floor([other, other.with_(u=2 * other.u)]) is None


def test_slow_error_does_not_count_as_white_noise():
    rng, slow = np.random.default_rng(0), np.sin(np.arange(4000) * 0.01)[:, None]
    assert white_part([slow + 0.01 * rng.standard_normal((4000, 1))]) == pytest.approx([0.01], rel=0.1)


def test_samples_at_which_a_machine_stands_do_not_count():
    noise = np.random.default_rng(0).standard_normal((2000, 2))
    scale = np.array([1.0, 1.0])
    assert acting_samples([noise], scale) == pytest.approx(4000, rel=0.05)
    rest = np.zeros((8000, 2))
    assert acting_samples([noise, rest], scale) == pytest.approx(acting_samples([noise], scale), rel=0.05)
    assert acting_samples([np.ones((500, 1))], np.ones(1)) == 500
    burst = np.zeros((4000, 1))
    burst[:20] = 1e3
    quiet = 1e-3 * np.random.default_rng(1).standard_normal((4000, 1))
    assert acting_samples([np.hstack([burst, quiet])], scale) < 100  # an output without mismatch adds nothing


def test_samples_that_are_alike_count_less():
    rng = np.random.default_rng(0)
    white = rng.standard_normal((4000, 1))
    alike = np.apply_along_axis(np.convolve, 0, white, np.ones(20), "same")
    assert effective_size([white]) > 0.6 * 4000 > 5 * effective_size([alike])


@pytest.mark.parametrize("kind", ["gain", "noise"])
def test_an_error_that_a_varying_gain_leaves_is_no_noise(kind):
    """Over blocks the power of a steady input hardly varies."""
    rng = np.random.default_rng(0)
    signal = np.sin(2 * np.pi * np.arange(6000) / 50 + 0.1 * np.cumsum(rng.standard_normal(6000)))
    noise = np.convolve(rng.standard_normal(6000), np.ones(50) / 8, "same")
    gain = np.where(np.arange(6000) // 1000 % 2, 1.0, -1.0)
    error = gain * signal + 0.3 * noise if kind == "gain" else noise
    assert swells_with([error[:, None]], [signal[:, None]]) is (kind == "gain")


@pytest.mark.parametrize("kind", ["swells", "steady", "short", "still"])
def test_an_error_that_swells_with_a_signal_is_no_noise(kind):
    rng = np.random.default_rng(0)
    m = 40 if kind == "short" else 4000
    loud = 0.1 + np.sin(np.arange(m) * 2 * np.pi / m) ** 2
    signal = np.zeros(m) if kind == "still" else loud * rng.standard_normal(m)
    error = rng.standard_normal(m) * (1.0 if kind == "steady" else loud)
    signals = np.column_stack([rng.standard_normal(m), signal])
    assert swells_with([error[:, None]], [signals]) is (kind == "swells")


@pytest.mark.parametrize("last", [0, 100])
def test_where_the_input_rests_other_initial_states_are_no_repeats(last):
    """Free decays from two heights, or after one step, differ by more than noise."""
    t, u = np.arange(2000), np.zeros((2000, 1))
    u[:last] = 1.0
    decays = [Recording(u, (a * np.exp(-t / 4000.0))[:, None], 0.01) for a in (1.0, 0.5)]
    assert measured_floor(decays) is None


def test_a_recording_of_few_samples_says_nothing_about_noise():
    rng = np.random.default_rng(0)
    long, short = rng.standard_normal((1000, 1)), np.zeros((2, 1))
    assert white_part([long, short]) == pytest.approx(white_part([long]))
    assert effective_size([long, short]) == pytest.approx(effective_size([long]), abs=2.0)


@pytest.mark.parametrize("wear", [False, True])
@pytest.mark.parametrize("noise", ["white", "slow"])
@pytest.mark.parametrize(("samples", "pole", "worn"), [(4000, 0.9, 0.92), (30000, 0.9, 0.92), (6000, 0.999, 0.9985)])
def test_a_machine_that_changes_from_run_to_run_repeats_nothing(wear, noise, samples, pole, worn):
    """The input drives the difference between a new and a worn machine; it does not drive noise of any colour."""
    rng = np.random.default_rng(3)
    u = rng.standard_normal((samples, 1))
    errors = 1e-3 * rng.standard_normal((2, samples, 1))
    errors = errors if noise == "white" else lfilter([0.1], [1.0, -0.99], errors, axis=1)
    poles = pole, worn if wear else pole
    runs = [
        Recording(u, lfilter([1.0], [1.0, -p], u, axis=0) + e, 0.01, initial="zero")
        for p, e in zip(poles, errors, strict=True)
    ]
    found = measured_floor(runs)
    assert (found is None) == wear


def test_a_sine_cannot_tell_a_changed_machine_from_noise_of_its_frequency():
    """Then the differences count as noise, as do those of very short repeats."""
    rng, t = np.random.default_rng(0), np.arange(1000)
    u, hum = np.sin(0.3 * t)[:, None], 0.1 * np.sin(0.3 * t + 1.0)[:, None]
    runs = [Recording(u, u + a * hum + 1e-3 * rng.standard_normal((1000, 1)), 0.01, initial="zero") for a in (1, -1)]
    assert measured_floor(runs).source == "repeats"
    assert measured_floor([r.slice(0, 7) for r in runs]).source == "repeats"


def test_inputs_before_the_compared_half_count():
    """Repeats that begin in unknown states are compared from their middle on."""
    rng = np.random.default_rng(1)
    u = rng.standard_normal((4000, 2))
    runs = [
        Recording(u, lfilter([1.0], [1.0, -p], u[:, :1], axis=0) + 1e-3 * rng.standard_normal((4000, 1)), 0.01)
        for p in (0.9, 0.93)
    ]
    assert measured_floor(runs) is None


QUIET, NOISY = 1e-8, 1e-3


@pytest.mark.parametrize("noise2", [None, (1e-4, 1e-4)])
def test_outputs_alike_in_noise_are_pooled_by_their_mean(noise2):
    pooled, balance = pool(np.array([0.5, 1e-6]), None if noise2 is None else np.array(noise2))
    assert pooled == 0.5 * (0.5 + 1e-6)
    assert balance.tolist() == [1.0, 1.0]


@pytest.mark.parametrize("quiet", [1e-8, 1e-6, 1e-4])
def test_a_noisy_output_does_not_hide_what_a_quiet_one_shows(quiet):
    """An error in the quiet output alone counts as if the noisy one were not there, for one half of the samples."""
    noise2 = np.array([QUIET, NOISY])
    before, after = (pool(np.array([v, NOISY]), noise2)[0] for v in (quiet, QUIET))
    assert before / after == pytest.approx((quiet / QUIET) ** 0.5, rel=0.1)


def test_a_wrong_model_weighs_the_outputs_alike_and_noise_as_the_outputs_have_it():
    noise2 = np.array([QUIET, NOISY])
    assert pool(np.array([0.1, 0.1]), noise2)[1] == pytest.approx([1, 1], rel=0.02)
    pooled, balance = pool(3 * noise2, noise2)
    assert balance == pytest.approx(noise2 / (QUIET * NOISY) ** 0.5)
    assert pooled == pytest.approx(3 * (QUIET * NOISY) ** 0.5)


def test_no_error_and_no_finite_error_are_pooled_as_they_are():
    noise2 = np.array([QUIET, NOISY])
    assert pool(np.zeros(2), noise2)[0] == 0
    assert pool(np.array([np.inf, 1.0]), noise2)[0] == np.inf
    assert pool(np.array([1e-6, 1e-6]), np.zeros(2))[0] == pytest.approx(1e-6)


def test_a_mode_near_half_the_sampling_rate_is_no_white_noise():
    rng, t = np.random.default_rng(0), np.arange(1400)
    noise = 0.05 * rng.standard_normal((1400, 1))
    mode = (np.exp(-t / 400) * np.sin(2 * np.pi * 0.452 * t))[:, None]
    assert white_part([noise]) == pytest.approx(np.sqrt(np.mean(third_differences(noise) ** 2)), rel=1e-12)
    assert 0.045 < white_part([noise + mode])[0] < 0.1
    assert np.sqrt(np.mean(third_differences(noise + mode) ** 2)) > np.std(noise + mode)


def test_a_slow_residual_hides_a_mean_and_a_fast_oscillation_does_not():
    rng, t = np.random.default_rng(0), np.arange(4000)
    white = rng.standard_normal((4000, 1))
    slow = lfilter([1.0], [1.0, -0.95], rng.standard_normal((4000, 1)), axis=0)
    ringing = np.sin(2 * np.pi * 0.17 * t)[:, None]
    assert 3000 < samples_of_mean([white]) <= 4000
    assert samples_of_mean([slow]) == pytest.approx(4000 * 0.05 / 1.95, rel=0.4)
    assert samples_of_mean([white + 5 * ringing]) == 4000 > 30 * effective_size([white + 5 * ringing])
    assert samples_of_mean([slow, slow]) == pytest.approx(2 * samples_of_mean([slow]))
