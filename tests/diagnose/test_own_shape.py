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


class Bare(Law):
    """A law without a force."""

    id = "bare"
    units: ClassVar = {"c": "w"}


class Deciding(Bare):
    """Python decides by a symbol."""

    def force(self, z, p):
        """Of the side."""
        return p.c if z > 0 else -p.c


class Asking(Bare):
    """It asks for a signal that no diagnosis has."""

    def force(self, z, pressure, p):
        """Of another signal."""
        return p.c * z * pressure


@pytest.mark.parametrize(
    ("law", "words"),
    [(Bare, "'bare' has no `force`; write one"), (Deciding, "casadi.if_else"), (Asking, "asks for 'pressure'")],
)
def test_a_faulty_law_is_told_in_a_sentence(law, words):
    u = 12 * pilfr.multisine(400, f_max=3.0, fs=1 / DT, rng=np.random.default_rng(2))
    r = Recording(u, np.zeros(400), DT, ("force",), ("pos",), initial="zero", hold="zero")
    with pytest.raises(pilfr.InputError, match=words):
        pilfr.diagnose(cart(d=0.4), r.with_(y=1.2 * outputs_of(cart(d=0.6), r)), laws=[law])
