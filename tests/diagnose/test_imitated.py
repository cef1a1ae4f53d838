"""Simple laws that a flexible one stands for are found by the force that it makes."""

from dataclasses import replace

import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Recording, Simulator
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.candidate import attempt
from pilfr_casadi.diagnose.imitated import felt, imitated
from pilfr_casadi.diagnose.screen import Scored
from pilfr_casadi.engine import make_engine
from pilfr_casadi.laws import (
    Backlash,
    CoulombFriction,
    CubicDamping,
    CubicStiffness,
    DeadZone,
    PlayHysteresis,
    Saturation,
    StopHysteresis,
)
from pilfr_casadi.simulators import discretise

DT, M = 0.02, 1500


def cart():
    """A mass on a spring and a damper, driven by a force."""
    return Simulator(
        lambda x, u, p: {"pos": x.vel, "vel": u.force - p.k * x.pos - p.d * x.vel},
        lambda x: {"pos": x.pos},
        states=("pos", "vel"),
        inputs=("force",),
        parameters={"k": Parameter(40.0, bounds=(10, 200)), "d": Parameter(1.0, bounds=(0, 5))},
        ports=(Port("ground", {"vel": -1.0}, lambda x: x.pos, lambda x: x.vel),),
    )


def bench(port, law):
    """The cart recorded with a law that it hides."""
    model = discretise(cart().with_element(port, law), DT)
    u = 10 * pilfr.multisine(M, f_max=3.0, fs=1 / DT, rng=np.random.default_rng(2))
    r = Recording(u, np.zeros(M), DT, ("force",), ("pos",), initial="zero", hold="zero")
    y = make_engine(model).simulate(model.drive(r), model.parameters.start, np.zeros(model.n_state))[0]
    return Workbench.of(cart(), [r.with_(y=y)], "zero")


@pytest.mark.parametrize(
    ("port", "hidden", "flexible", "simple"),
    [
        ("actuator:force", Saturation().at({"L": 8.0}), PlayHysteresis, (Backlash, DeadZone, Saturation)),
        ("actuator:force", DeadZone().at({"g": 3.0}), PlayHysteresis, (Backlash, DeadZone, Saturation)),
        ("ground", CoulombFriction().at({"F_c": 3.0, "v_0": 0.01}), StopHysteresis, (CubicDamping, CubicStiffness)),
    ],
)
def test_simple_laws_whose_force_is_alike_are_put_up(port, hidden, flexible, simple):
    on = bench(port, hidden)
    without = on.fit(cart())
    local = felt(on, without, port)
    entries = [Scored(port, kind(), 0.1, ({},), local) for kind in (*simple, type(hidden)) if kind is not flexible]
    entries = list({type(s.law): s for s in entries}.values())[::-1]
    shape = next(iter(flexible().shapes(local)))
    law = flexible().at(
        {**shape, "w": np.append(-0.3 * (port != "ground"), np.full(5, 0.05))}, flexible().bounds(local)
    )
    best = attempt(on, cart().with_element(port, law), [without.values], states=without.begin)
    found = {type(s.law): s.starts[0] for s in imitated(on, [best], entries)}
    start = found[type(hidden)]
    for name, value in hidden.values.items():
        if name not in hidden.strength and name != "v_0":
            assert start[name] == pytest.approx(value, rel=0.5)


def test_a_simple_law_stands_for_itself():
    on = bench("actuator:force", Saturation().at({"L": 8.0}))
    law = Saturation().at({"L": 8.0})
    best = attempt(on, cart().with_element("actuator:force", law), [{}])
    local = felt(on, best.fitted, "actuator:force")
    np.testing.assert_allclose(local.z, on.recordings[0].u[:, 0])
    assert imitated(on, [best], [Scored("actuator:force", DeadZone(), 0.1, ({},), local)]) == []


def test_a_rate_that_is_no_number_is_compared_with_nothing(monkeypatch):
    """As of a root where a tank runs empty."""
    on = bench("actuator:force", DeadZone().at({"g": 3.0}))
    without = on.fit(cart())
    local = felt(on, without, "actuator:force")
    shape = next(iter(PlayHysteresis().shapes(local)))
    law = PlayHysteresis().at({**shape, "w": np.append(-0.3, np.full(5, 0.05))}, PlayHysteresis().bounds(local))
    best = attempt(on, cart().with_element("actuator:force", law), [without.values], states=without.begin)
    entries = [Scored("actuator:force", DeadZone(), 0.1, ({},), local)]
    assert imitated(on, [best], entries)
    nowhere = replace(local, dz=np.where(np.arange(len(local.dz)) == 7, np.nan, local.dz))
    monkeypatch.setitem(imitated.__globals__, "felt", lambda *_: nowhere)
    assert imitated(on, [best], entries) == []
