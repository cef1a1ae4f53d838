"""Friction: what an answer says of values at which its name says little."""

import pytest

from pilfr_casadi.laws import CoulombFriction, DirectionalFriction, StribeckFriction


@pytest.mark.parametrize(
    ("law", "widest"), [(CoulombFriction, 0.5), (DirectionalFriction, 0.5), (StribeckFriction, 0.3)]
)
def test_a_broad_reversal_is_told(law, widest):
    """The largest speed is 1 m/s, and the limits of the reversal are shares of it."""
    placed = law().at({"v_0": 0.05}, {"v_0": (1e-3, widest)})
    assert "over 20% of the largest speed" in placed.remark({"v_0": 0.2})
    assert placed.remark({"v_0": 0.05}) == ""
    assert law().remark({"v_0": 0.2}) == ""  # nobody knows the speed
