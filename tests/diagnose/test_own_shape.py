"""A law that no formula of the catalogue is: no second effect is named for what its own shape leaves."""

from typing import ClassVar

import casadi as ca
import numpy as np
import pytest
from cart import cart
from simulated import outputs_of

import pilfr_casadi as pilfr
from pilfr_casadi import Recording
from pilfr_casadi.laws import Law

DT, M = 0.02, 2000


class Sinh(Law):
    """Damping that no law of the catalogue has the formula of."""

    id = "sinh"
    units: ClassVar = {"c": "w", "v": "z/s"}
    strength = ("c",)

    def force(self, dz, p):
        """Of the rate."""
        return p.c * ca.sinh(dz / p.v)


@pytest.mark.slow
def test_what_a_law_of_another_shape_leaves_is_no_effect_elsewhere():
    """A damper whose force is a hyperbolic sine of speed."""
    rng = np.random.default_rng(2)
    u = 12 * pilfr.multisine(M, f_max=3.0, fs=1 / DT, rng=rng)
    r = Recording(u, np.zeros(M), DT, ("force",), ("pos",), initial="zero", hold="zero")
    y = outputs_of(cart(d=0.4).with_element("ground", Sinh().at({"c": 1.0, "v": 0.6})), r)
    noisy = r.with_(y=y + 1e-3 * np.std(y) * rng.standard_normal(y.shape))
    found = pilfr.diagnose(cart(d=0.4), noisy)
    assert found.verdict in ("missing-physics", "unexplained")
    assert {e.port for e in found.effects} <= {"ground"} and "at ground" in found.sentence, str(found)
