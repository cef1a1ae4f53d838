"""Errors of a simulated output, Krikelis et al. (2024), Eq. 27."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from pilfr_casadi._base import InputError
from pilfr_casadi.data import nrmse, rmse, rmse_per_output

Y = np.random.default_rng(1).normal(size=(50, 2)) * [1.0, 100.0]
ERROR = np.random.default_rng(2).normal(size=(50, 2))


def test_by_hand():
    y, y_hat = np.array([0.0, 2.0, 0.0, 2.0]), np.array([0.0, 2.0, 0.0, 4.0])
    assert rmse(y, y_hat) == 1.0
    assert nrmse(y, y_hat) == 1.0  # the standard deviation of y is 1
    assert nrmse(y, y) == 0.0


def test_outputs_are_averaged_after_their_own_scale():
    e = rmse_per_output(Y, Y + ERROR)
    assert e.shape == (2,)
    assert np.isclose(e[0], np.sqrt(np.mean(ERROR[:, 0] ** 2)), rtol=1e-12)
    assert np.isclose(nrmse(Y, Y + ERROR), np.mean(e / Y.std(axis=0)), rtol=1e-12)
    assert np.isclose(rmse(Y, Y + ERROR), e.mean(), rtol=1e-12)


def test_the_mean_scores_one():
    assert np.isclose(nrmse(Y, np.broadcast_to(Y.mean(axis=0), Y.shape)), 1.0, rtol=1e-12)


@given(scale=st.floats(1e-6, 1e6), shift=st.floats(-10, 10))
def test_change_of_unit_changes_nothing(scale, shift):
    y, y_hat = scale * (Y + shift), scale * (Y + ERROR + shift)
    assert np.isclose(nrmse(y, y_hat), nrmse(Y, Y + ERROR), rtol=1e-9)


def test_skip_cuts_error_and_scale():
    y, y_hat = Y.copy(), (Y + ERROR).copy()
    y[:5] = 1e6
    assert nrmse(y, y_hat, skip=5) == nrmse(Y[5:], (Y + ERROR)[5:])
    assert rmse(y, y_hat, skip=5) == rmse(Y[5:], (Y + ERROR)[5:])


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200])
def test_a_diverged_simulation_has_an_infinite_error(value):
    y_hat = Y.copy()
    y_hat[7, 1] = value
    assert np.isfinite(rmse_per_output(Y, y_hat)[0])
    assert rmse_per_output(Y, y_hat)[1] == np.inf
    assert nrmse(Y, y_hat) == np.inf


@pytest.mark.parametrize(
    ("y", "y_hat", "skip", "words"),
    [
        (Y, Y[:, :1], 0, r"\(50, 2\) and simulated ones \(50, 1\)"),
        (Y, Y, 50, "at least one sample"),
        (Y, Y, 2.5, "skip is 2.5"),
        (np.where(Y > 150, np.nan, Y), Y, 0, "not finite"),
        (Y * [1.0, 0.0] + 0.1, Y, 0, "output 2 of 2 never changes"),
    ],
)
def test_outputs_without_a_score_are_refused(y, y_hat, skip, words):
    with pytest.raises(InputError, match=words):
        nrmse(y, y_hat, skip)
