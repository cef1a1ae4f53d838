"""A second effect has to come nearer than the first one's own shape."""

from dataclasses import replace
from typing import ClassVar

import casadi as ca
import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Recording, Simulator
from pilfr_casadi.diagnose.own_shape import own_shape
from pilfr_casadi.engine import make_engine
from pilfr_casadi.laws import Law
from pilfr_casadi.simulators import discretise

DT, M = 0.02, 2000


class Sinh(Law):
    """Damping that no law of the catalogue has the formula of."""

    id = "sinh"
    units: ClassVar = {"c": "w", "v": "z/s"}
    strength = ("c",)

    def force(self, dz, p):
        """Of the rate."""
        return p.c * ca.sinh(dz / p.v)


def cart():
    """A mass on a spring and a damper."""
    return Simulator(
        lambda x, u, p: {"pos": x.vel, "vel": u.force - p.k * x.pos - p.d * x.vel},
        lambda x: {"pos": x.pos},
        states=("pos", "vel"),
        inputs=("force",),
        parameters={"k": Parameter(40.0, bounds=(10, 200)), "d": Parameter(0.4, bounds=(0, 5))},
        ports=(Port("ground", {"vel": -1.0}, lambda x: x.pos, lambda x: x.vel),),
    )


@pytest.fixture(scope="module")
def search():
    """A diagnosis of one effect, a damper whose force is a hyperbolic sine of speed."""
    rng = np.random.default_rng(2)
    model = discretise(cart().with_element("ground", Sinh().at({"c": 1.0, "v": 0.6})), DT)
    u = 12 * pilfr.multisine(M, f_max=3.0, fs=1 / DT, rng=rng)
    r = Recording(u, np.zeros(M), DT, ("force",), ("pos",), initial="zero", hold="zero")
    y = make_engine(model).simulate(model.drive(r), model.parameters.start, np.zeros(model.n_state))[0]
    noisy = r.with_(y=y + 1e-3 * np.std(y) * rng.standard_normal(y.shape))
    found = pilfr.diagnose(cart(), noisy, effects=1)
    assert [(e.port, e.law) for e in found.effects] == [("ground", "cubic_damping")]
    return found.evidence["search"]


@pytest.mark.parametrize(("times", "shape"), [(0.9, True), (0.02, False)])
def test_what_a_curve_of_the_rate_follows_as_well_is_no_second_effect(search, times, shape):
    first = search.passes[0].choice.winner
    elsewhere = replace(first, port="actuator:force", head=times**2 * first.head, tail=times**2 * first.tail)
    assert own_shape(search, elsewhere) is shape


def test_at_the_port_of_the_first_the_curve_says_nothing(search):
    first = search.passes[0].choice.winner
    assert not own_shape(search, replace(first, head=0.5 * first.head))
