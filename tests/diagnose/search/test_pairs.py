"""Two effects looked for together: the score of a pair, and a rig on which each hides the other."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import pilfr_casadi as pilfr
from pilfr_casadi.diagnose.fits.screen import orthonormal
from pilfr_casadi.diagnose.search.pairs import pair_shares
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


@pytest.mark.slow
def test_a_pumps_dead_zone_is_found_beside_a_square_root_outflow():
    """One by one, a polynomial of the pump and dampings that vary with it seem to come near."""
    tank = pilfr.Simulator(
        lambda x, u, p: {"level": (p.k * u.pump - p.a * x.level) / 0.05},
        lambda x: {"level": x.level},
        states=("level",),
        inputs=("pump",),
        parameters={"k": pilfr.Parameter(3e-5, bounds=(5e-6, 2e-4)), "a": pilfr.Parameter(2e-4, bounds=(0, 2e-3))},
        ports=pilfr.Port("outlet", {"level": -1 / 0.05}, lambda x: x.level, unit="m^3/s", across_unit="m"),
    )
    rng = np.random.default_rng(5)
    u, level, y = np.repeat(rng.uniform(0, 10, 40), 40), 0.3, []
    for volt in u:
        y.append(level + 1e-3 * rng.standard_normal())
        for _ in range(20):
            level += (4e-5 * max(volt - 1.5, 0) - 1.6e-4 * max(level, 0) ** 0.5) / 0.05 / 20
    found = pilfr.diagnose(tank, pilfr.Recording(u, np.array(y), 1.0, ("pump",), ("level",), hold="zero"))
    assert {(e.port, e.law) for e in found.effects} == {("actuator:pump", "dead_zone"), ("outlet", "static_curve")}
    (gap,) = [e.parameters["g"]["value"] for e in found.effects if e.law == "dead_zone"]
    assert gap == pytest.approx(1.5, rel=0.02)


@pytest.mark.slow
def test_cogging_is_found_along_an_observer_where_the_simulation_has_wandered_off():
    hidden = case(4856)
    found = pilfr.diagnose(hidden.simulator, hidden.train)
    assert [(e.port, e.law) for e in found.effects] == [("guide", "periodic_force")]
