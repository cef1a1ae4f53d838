"""Estimated initial states and memories: no worse than known ones if the machine began at rest."""

import numpy as np
import pytest
from random_models import random_input, random_lfr, reference

from pilfr_casadi.data import Recording
from pilfr_casadi.identify import fit
from pilfr_casadi.models import PILFR, Play, PrandtlIshlinskii
from problems.initial_state import TARGET, compare


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 6])
def test_the_default_is_no_worse_than_a_known_beginning_at_rest(seed):
    found = compare(seed, starts=1)
    for name, known in found["zero"].items():
        assert found["estimate"][name] <= TARGET * known


def recording(seed, samples, state):
    _, values = random_lfr(3, nx=2, n=4)
    u = random_input(seed, samples)
    y = reference(Play, values, u, state)[0]
    return Recording(u, y + 0.01 * y.std() * np.random.default_rng(seed).normal(size=y.shape), 0.01)


def test_a_beginning_at_rest_is_found():
    train = recording(1, 800, np.zeros(6))
    structure = PILFR(2, PrandtlIshlinskii(Play, 3))
    unknown, known = (fit(structure, train.with_(initial=how), starts=1) for how in ("estimate", "zero"))
    assert unknown.train_nrmse == known.train_nrmse
    assert not unknown.initial_state(train.with_(initial="estimate")).any()
    test = recording(4, 600, np.zeros(6))
    scored = test.with_(skip=unknown.scored_from(test), initial="zero")
    assert unknown.nrmse(test) <= TARGET * known.nrmse(scored)


def test_a_beginning_in_motion_is_found():
    state = np.array([3.0, -3.0, 0.0, 0.0, 0.0, 0.0])
    train = recording(2, 800, state)
    structure = PILFR(2, PrandtlIshlinskii(Play, 3))
    fitted = fit(structure, train, starts=1)
    assert fitted.initial_state(train).any()
    assert fitted.train_nrmse[0] < 0.5 * fit(structure, train.with_(initial="zero"), starts=1).train_nrmse[0]
