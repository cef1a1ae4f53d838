"""How long an input takes to the output, which zeros forbid the exact inverse, and what the compensator then says."""

import re
from dataclasses import replace

import numpy as np
import pytest
from test_feedback import A, fitted

import pilfr_casadi as pilfr
from pilfr_casadi.control.along import along
from pilfr_casadi.control.reach import reach


def recorded(delay, noise, smooth, seed=0, samples=1500):
    """A machine of two states behind four plays and a delay, and its recording."""
    rng = np.random.default_rng(seed)
    window = np.ones(smooth) / np.sqrt(smooth)
    u = 1.2 * np.convolve(rng.standard_normal(samples + smooth - 1), window, "valid")
    r, s, x, y = np.array([0.1, 0.3, 0.6, 1.0]), np.zeros(4), np.zeros(2), np.zeros(samples)
    for k in range(samples):
        y[k] = x[0] + 0.5 * x[1]
        v = u[k - delay] if k >= delay else 0.0
        s = np.minimum(v + r, np.maximum(v - r, s))
        x = np.array([0.8 * x[0] + 0.2 * (v + 0.3 * s.sum()), 0.7 * x[1] + 0.3 * x[0]])
    y += noise * np.std(y) * rng.standard_normal(samples)
    return pilfr.Recording(u, y, 0.01, initial="zero", hold="zero")


def plain(error):
    text = str(error.value)
    assert "\n" not in text and text.endswith(".") and ".." not in text, text
    return text


@pytest.mark.parametrize("noise", [1e-3, 1e-2])
@pytest.mark.parametrize("smooth", [1, 8])
@pytest.mark.parametrize("delay", [0, 1, 3, 6])
def test_a_fitted_delay_is_found_whatever_the_noise_of_the_fit(delay, noise, smooth):
    record = recorded(delay, noise, smooth, seed=delay)
    fit = pilfr.fit(pilfr.PILFR(2 + delay, pilfr.PrandtlIshlinskii(pilfr.Play, 6)), record, starts=2)
    away = reach(fit, along(fit, record, "reach"), record)
    assert away.delay == delay + 1
    assert np.max(away.markov[: delay + 1]) > 0  # small, but not zero
    made = pilfr.feedforward(fit, record)
    assert (made.delay, made.ahead) == (delay + 1, delay + 1)
    samples = f"{delay + 1} sample" + "s" * (delay > 0)
    early = re.escape(f"{100 * away.early:.1g} %")
    assert re.fullmatch(
        f"An input reaches the output after {samples}, but it has {early} of its largest response before, which counts "
        f"as an error of the model: an approximate inverse, for a path that is known {samples} ahead.",
        str(made),
    )
    if delay:
        with pytest.raises(
            pilfr.InputError, match=f"only after {delay + 1} .* give ahead={delay + 1} or more"
        ) as error:
            pilfr.feedforward(fit, record, ahead=delay)
        assert "stable" not in plain(error) and "phase" not in plain(error)
    wanted = 1.5 * np.sin(np.arange(400) / 25.0)
    u = made.inputs(wanted)
    y = fit.simulate(record.with_(u=u, y=np.zeros((400, 1))))[:, 0]
    late = slice(delay + 30, 400)
    assert np.sqrt(np.mean((y - wanted)[late] ** 2)) < 0.05 * np.std(wanted)


def test_standard_errors_of_the_response_are_those_of_fits_to_other_noise():
    def response(seed):
        record = recorded(1, 1e-2, 4, seed=0)
        noise = 1e-2 * np.std(record.y) * np.random.default_rng(100 + seed).standard_normal(record.y.shape)
        again = record.with_(y=record.y + noise)
        fit = pilfr.fit(pilfr.PILFR(3, pilfr.PrandtlIshlinskii(pilfr.Play, 4)), again, starts=1)
        away = reach(fit, along(fit, again, "reach"), again)
        return away.markov[:3] / away.markov[2], away.errors[:3] / away.markov[2]

    found, errors = (np.array(v) for v in zip(*map(response, range(12)), strict=True))
    said = np.median(errors, axis=0)
    assert np.all(found[:, :2] < 4 * said[:2])
    assert np.all(np.mean(found[:, :2] ** 2, axis=0) ** 0.5 > 0.1 * said[:2])  # and not because they are far too large


def chain(delay, first=(1.0,)):
    """`y_k = Σ first_j u_{k-delay-j}` exactly."""
    n = delay + len(first) - 1
    c = np.zeros((1, n))
    c[0, delay - 1 :] = first
    values = {"A": np.eye(n, k=-1), "B_u": np.eye(n)[:, :1], "C_y": c}
    return fitted(pilfr.PILFR(n, fixed={"D_yu": 0.0}), values, samples=60 * (n + 2))


def test_a_long_delay_is_inverted_with_the_preview_it_needs():
    fit, record = chain(20)
    made = pilfr.feedforward(fit, record, limits=(-10, 10))
    assert (made.delay, made.ahead, len(made.zeros)) == (20, 20, 0)
    longer = pilfr.feedforward(fit, record, ahead=22)
    assert str(longer) == (
        "An input reaches the output after 20 samples, but a longer look-ahead was asked for: an approximate inverse, "
        "for a path that is known 22 samples ahead."
    )
    wanted = np.sin(np.arange(100) / 9.0) * np.ptp(record.u) / 3
    np.testing.assert_allclose(made.inputs(wanted)[:60, 0], wanted[20:80], atol=1e-3)
    with pytest.raises(pilfr.InputError, match=r"The look-ahead is 5 samples, but .* only after 20 ") as error:
        pilfr.feedforward(fit, record, ahead=5)
    plain(error)


def test_zeros_outside_the_unit_circle_are_listed_and_said_to_make_the_inverse_approximate():
    fit, record = chain(1, (-0.5, 1.0))  # a zero at 2
    made = pilfr.feedforward(fit, record)
    assert made.delay == 1 and made.ahead > 1
    assert made.zeros == pytest.approx([2.0], rel=1e-2)
    assert re.search(r"would be unstable \(zeros on or outside the unit circle at (2|2\.0\d+|1\.9\d+)\)", str(made))
    assert str(made).endswith(f"an approximate inverse, for a path that is known {made.ahead} samples ahead.")
    asked = pilfr.feedforward(fit, record, ahead=made.ahead)
    assert str(asked) == str(made) and asked.zeros == pytest.approx([2.0], rel=1e-2)
    with pytest.raises(pilfr.InputError, match=r"non-minimum phase: zeros on or outside the unit circle at") as error:
        pilfr.feedforward(fit, record, ahead=1)
    plain(error)


def test_a_pair_of_zeros_is_named_once():
    fit, record = chain(1, (1.0, -2.0, 2.0))  # zeros at 1 ± i
    try:
        text = str(pilfr.feedforward(fit, record))
    except pilfr.InputError as error:
        text = str(error)
    assert re.search(r"at (1|0\.99\d+|1\.00\d+) ± (1|0\.99\d+|1\.00\d+)i[);]", text), text


def test_an_inverse_is_called_exact_where_it_gives_back_the_models_own_output():
    values = {"A": A, "B_u": [[1.0], [0.5]], "C_y": [[1.0, 0.4]]}
    for fixed, word in (({"D_yu": 0.0}, "the exact inverse"), ({}, "an approximate inverse")):
        fit, record = fitted(pilfr.PILFR(2, fixed=fixed), values)
        made = pilfr.feedforward(fit, record, limits=(-50, 50))
        assert (made.delay, made.ahead) == (1, 1) and word in str(made)
        y = fit.simulate(record)[:, 0]
        again = fit.simulate(record.with_(u=made.inputs(y)))[:, 0]
        assert (np.max(np.abs(again - y)) < 1e-10 * np.max(np.abs(y))) == (word == "the exact inverse")


@pytest.mark.parametrize(("direct", "word"), [(0.5, "the exact inverse"), (-0.5, "an approximate inverse")])
def test_an_output_that_more_than_one_input_gives_has_no_exact_inverse(direct, word):
    element = pilfr.PrandtlIshlinskii(pilfr.Play, 2)
    values = {"D_yu": [[direct]], "D_yw": [[1.0]], "D_zu": [[1.0]], "w": [[0.4, 0.6]], "r": [[0.2, 0.6]]}
    made = pilfr.feedforward(*fitted(pilfr.PILFR(0, element), values))
    assert made.delay == made.ahead == 0 and word in str(made)
    assert ("rises with the input in places and falls in others" in str(made)) == (direct < 0)


def test_an_input_that_reaches_nothing_is_said():
    fit, record = fitted(pilfr.PILFR(2), {"A": A, "B_u": [[1.0], [0.5]], "C_y": [[1.0, 0.4]]})
    blocks = {"B_u": {"value": np.zeros((2, 1))}, "D_yu": {"value": np.zeros((1, 1))}}
    deaf = replace(fit, model=fit.model.with_parameters(fit.model.parameters.change(**blocks)))
    with pytest.raises(pilfr.InputError, match="nothing to invert") as error:
        pilfr.feedforward(deaf, record)
    plain(error)


@pytest.mark.parametrize("limits", [(-np.inf, np.inf), (0.0, np.inf), (np.nan, 1.0), (1.0, 1.0)])
def test_limits_that_bound_nothing_are_refused(limits):
    with pytest.raises(pilfr.InputError, match="finite, with low below high") as error:
        pilfr.feedforward(*chain(2), limits=limits)
    plain(error)


@pytest.mark.parametrize("ahead", [True, 1.5, "3", -1, 10**6])
def test_look_aheads_that_are_none_are_refused(ahead):
    with pytest.raises(pilfr.InputError, match="whole number from 0 to 1000") as error:
        pilfr.feedforward(*chain(2), ahead=ahead)
    plain(error)


def test_what_is_no_fit_and_no_recording_is_refused():
    fit, record = chain(2)
    for given in ((fit.to_casadi(), record), (fit, record.u), (None, None)):
        with pytest.raises(pilfr.InputError, match="was given to feedforward") as error:
            pilfr.feedforward(*given)
        plain(error)
