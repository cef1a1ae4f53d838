"""Fits of small models that begin at the truth, for the tests of observers, inverses and controllers."""

import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi import InputError

A = np.array([[0.7, 0.2], [-0.1, 0.8]])


def fitted(structure, values, samples=400, n_u=1, n_y=1, scale=1.0):
    """A fit of a model with given blocks to its own outputs, and the recording."""
    model = structure.model(n_u, n_y, values)
    rng = np.random.default_rng(3)
    u = scale * np.cumsum(rng.standard_normal((samples, n_u)), axis=0) / 5
    function = model.closed.mapaccum("run", samples)
    y = np.asarray(function(np.zeros(model.n_state), u.T, model.parameters.start)[1]).T
    record = pilfr.Recording(u, y + 1e-4 * rng.standard_normal(y.shape), 0.01, initial="zero")
    return pilfr.fit(model, record), record


def plays(r, w, nx=2, **blocks):
    """Structure and blocks of two states behind plays with thresholds r and weights w."""
    values = {"A": A, "B_u": [[1.0], [0.5]], "B_w": [[0.3], [0.1]], "C_y": [[1.0, 0.4]], "C_z": [[0.5, 0.0]]}
    values |= {"D_zu": [[1.0]], "w": [w], "r": [r], **blocks}
    element = pilfr.PrandtlIshlinskii(pilfr.Play, len(r))
    return pilfr.PILFR(nx, element, {"D_yu": 0.0, "D_yw": 0.0}, {"r": (0, np.inf)}), values


def refused(call, words=None):
    """Check that a call raises one sentence, and return it."""
    with pytest.raises(InputError, match=words) as error:
        call()
    text = str(error.value)
    assert "\n" not in text and text.endswith(".") and len(text) < 400, text
    return text
