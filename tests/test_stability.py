"""Bounds on spectral radii: what they are of each element, and bounds on A that leave no room for them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import pilfr_casadi as pilfr
from pilfr_casadi.recording import InputError
from pilfr_casadi.stability import least_radius
from problems.constrained import three_plays

PLAYS = pilfr.PrandtlIshlinskii(pilfr.Play, 3)


@pytest.fixture(scope="module")
def record():
    return three_plays(0, 1200)


@pytest.mark.parametrize("nx, bounds, least", [(1, (1.5, 2), 1.5), (1, (-3, -1.1), 1.1), (2, (0.6, 2), 1.2)])
def test_bounds_that_deny_every_stable_model_are_refused(record, nx, bounds, least):
    structure = pilfr.PILFR(nx, PLAYS, bounds={"A": bounds})
    with pytest.raises(InputError, match=f"allow no spectral radius below {least}.*at most 1 .*widen the bounds"):
        pilfr.fit(structure, record, starts=1)
    with pytest.raises(InputError, match="allow no spectral radius below"):
        pilfr.fit(structure, record, start={"A": np.full((nx, nx), bounds[1])})


def test_an_unstable_model_over_a_short_record_is_fitted_where_it_may_grow(record):
    structure = pilfr.PILFR(1, PLAYS, bounds={"A": (1.05, 2)})
    fit = pilfr.fit(structure, record.slice(0, 60), starts=1, stable=False)
    assert np.isfinite(fit.train_nrmse[0]) and fit.parameters["A"].item() >= 1.05


@given(seed=st.integers(0, 10_000), n=st.integers(1, 4))
def test_no_matrix_between_bounds_has_a_smaller_radius(seed, n):
    rng = np.random.default_rng(seed)
    low = rng.normal(size=(n, n)) if seed % 2 else np.abs(rng.normal(size=(n, n)))
    high = low + np.abs(rng.normal(size=(n, n)))
    low, high = (low, high) if seed % 3 else (-high, -low)
    least = least_radius(low, high)
    for _ in range(20):
        matrix = rng.uniform(low, high)
        assert np.max(np.abs(np.linalg.eigvals(matrix))) >= least * (1 - 1e-12)
