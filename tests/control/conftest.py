"""Fits that several tests of controllers share."""

import numpy as np
import pytest
from small_fits import A, fitted, plays

import pilfr_casadi as pilfr
from pilfr_casadi.control import kalman_filter


@pytest.fixture(scope="session")
def small():
    """A fit of two states behind three plays, its recording and its observer."""
    fit, record = fitted(*plays([0.2, 1.0, 50.0], [0.5, 0.3, 0.2]))
    return fit, record, kalman_filter(fit, record, share=1e-3)


@pytest.fixture(scope="session")
def square():
    """A linear fit of two inputs and two outputs, and its recording."""
    return fitted(pilfr.PILFR(2), {"A": A, "B_u": np.eye(2), "C_y": np.eye(2)}, n_u=2, n_y=2)
