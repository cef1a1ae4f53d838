"""Two effects looked for together: the score of a pair, and a rig on which each hides the other."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import pilfr_casadi as pilfr
from pilfr_casadi.diagnose.relatives import pair_shares
from pilfr_casadi.diagnose.screen import orthonormal
from problems.concealed import case
from problems.concealed_score import score


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 10**6), widths=st.lists(st.integers(1, 3), min_size=2, max_size=5))
def test_the_share_of_a_pair_is_that_of_least_squares(seed, widths):
    rng = np.random.default_rng(seed)
    parts, left = [orthonormal(rng.standard_normal((60, w))) for w in widths], rng.standard_normal(60)
    found = pair_shares(parts, left)
    for i in range(len(parts)):
        for j in range(len(parts)):
            if i != j:
                both = np.hstack([parts[i], parts[j]])
                rest = left - both @ np.linalg.lstsq(both, left, rcond=None)[0]
                assert found[i, j] == pytest.approx(1 - rest @ rest / (left @ left), rel=2e-3, abs=1e-4)


@pytest.mark.slow
def test_two_effects_are_found_where_the_first_alone_leads_astray():
    """A curve of the pump and an uneven valve between the tanks: alone, hysteresis of the sensor comes nearest."""
    hidden = case(2121)
    found = pilfr.diagnose(hidden.simulator, hidden.train, test=hidden.test)
    assert found.verdict == "missing-physics"
    assert {e.port for e in found.effects} == {t["port"] for t in hidden.truth}
    judged = score(hidden, found.to_dict(), 0.0)
    assert judged.both
    assert judged.ratio < 1.2  # the hidden stiffness is exponential; the law that is named is a polynomial
    assert min(e.confidence for e in found.effects) > 0.8
