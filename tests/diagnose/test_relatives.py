"""Hypotheses that what came out best asks for: special cases, the same at another place, one term more, its shape."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from cart import cart

import pilfr_casadi as pilfr
from pilfr_casadi import Recording
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.relatives import _matching_forces, port_signals, relatives
from pilfr_casadi.diagnose.screen import Scored
from pilfr_casadi.diagnose.trials import Trials
from pilfr_casadi.engine import make_engine
from pilfr_casadi.laws import (
    Backlash,
    CoulombFriction,
    CubicDamping,
    CubicStiffness,
    DeadZone,
    Delay,
    Drift,
    HarmonicForce,
    LinearStiffness,
    PeriodicForce,
    PiecewiseStiffness,
    PlayHysteresis,
    PreslidingFriction,
    PreslidingStribeckFriction,
    Resonance,
    Saturation,
    Settling,
    StopHysteresis,
)
from pilfr_casadi.simulators import discretise

DT, M = 0.02, 1500


def fitted(port, law, error, **own):
    """What is read of a fitted law of the catalogue."""
    return SimpleNamespace(port=port, law=law, pair=(port, type(law)), error=error, own=own)


def asked_for(trials, scored):
    """What is to be fitted as well, where no flexible law came out best."""
    return relatives(None, trials, scored)


def test_a_special_case_that_was_left_after_a_few_steps_is_fitted_again():
    scored = [Scored("a", law, 0.1, ({},), None) for law in (LinearStiffness(), CubicStiffness())]
    best, left = fitted("a", PiecewiseStiffness(), 0.1), fitted("a", LinearStiffness(), 0.5)
    assert [s.law.id for s in asked_for([best, left], scored)] == ["linear_stiffness"]
    left.error = 0.11
    assert asked_for([best, left], scored) == []


def test_where_a_delay_comes_near_damped_resonances_as_late_are_tried():
    late = fitted("a", Delay(), 0.1, T=0.02)
    scored = [Scored(port, Resonance(), 0.1, ({"W": 3.0, "D": 0.05},), None) for port in ("a", "b")]
    (more,) = [s for s in asked_for([late], scored) if s.port == "a"]
    assert [2 * v["D"] / v["W"] == pytest.approx(0.02) for v in more.starts] == [True, True, False]
    assert asked_for([fitted("b", CubicStiffness(), 0.01), late], scored) == []


def test_a_delay_is_tried_at_the_other_end_as_well():
    late = fitted("sensor:y", Delay(), 0.1, T=0.02)
    scored = [Scored(port, Delay(), 0.1, ({"T": 0.05},), None) for port in ("sensor:y", "actuator:u", "spring")]
    (more,) = asked_for([late], scored)
    assert more.port == "actuator:u" and [start["T"] for start in more.starts] == [0.02, 0.05]
    assert asked_for([late, fitted("actuator:u", Delay(), 0.11, T=0.02)], scored) == []


def test_a_law_with_one_more_term_than_one_that_came_near_is_no_worse_and_so_is_fitted_again_from_there():
    plain, wider, best = PeriodicForce(), HarmonicForce(), fitted("c", CubicStiffness(), 0.09)
    start = {"a": 1.0, "b": 1.0, "a_2": 1.0, "b_2": 1.0, "L": 0.1}
    near, lost = fitted("a", plain, 0.1, a=3.0, b=-2.0, L=0.7), fitted("a", wider, 0.5, **start)
    scored = [Scored(port, law, 0.1, (start,), None) for port in ("a", "b") for law in (plain, wider)]
    (more,) = [s for s in asked_for([best, near, lost], scored) if isinstance(s.law, HarmonicForce)]
    assert more.port == "a" and more.starts == ({"a": 3.0, "b": -2.0, "a_2": 0.0, "b_2": 0.0, "L": 0.7},)
    assert asked_for([fitted("c", CubicStiffness(), 0.05), near, lost], scored) == []
    # of the same names, but no line is an exponential
    trend, settling = fitted("a", Drift(), 0.1, a=3.0, b=-2.0), fitted("a", Settling(), 0.5, a=1.0, b=0.0, T=2.0)
    entries = [Scored("a", Settling(), 0.1, (settling.own,), None)]
    assert asked_for([best, trend, settling], entries) == []


def test_a_refinement_that_came_near_asks_for_the_law_that_it_refines():
    """Stribeck's curve without its rise is plain dry friction."""
    own = {"k_t": 800.0, "k_e": 0.0, "r": 1e-3, "v_s": 0.1}
    best, near = fitted("b", CubicStiffness(), 0.1), fitted("guide", PreslidingStribeckFriction(), 0.1, **own)
    scored = [Scored("guide", PreslidingFriction(), 0.1, ({"k_t": 1.0, "r": 1.0},), None)]
    (more,) = asked_for([best, near], scored)
    assert more.starts == ({k: own[k] for k in PreslidingFriction.units},)
    assert asked_for([best, near, fitted("guide", PreslidingFriction(), 0.1, k_t=1.0, r=1.0)], scored) == []


def bench(port, law):
    """The cart recorded with a law that it hides."""
    model = discretise(cart().with_element(port, law), DT)
    u = 10 * pilfr.multisine(M, f_max=3.0, fs=1 / DT, rng=np.random.default_rng(2))
    r = Recording(u, np.zeros(M), DT, ("force",), ("pos",), initial="zero", hold="zero")
    y = make_engine(model).simulate(model.drive(r), model.parameters.start, np.zeros(model.n_state))[0]
    return Workbench.of(cart(), [r.with_(y=y)], "zero")


def flexible_fit(on, port, kind):
    """A flexible law at a port, fitted beside the cart."""
    without = on.fit(cart())
    local = port_signals(on, without, port)
    shape = next(iter(kind().shapes(local)))
    weights = np.append(-0.3 * (port != "ground"), np.full(5, 0.05))
    law = kind().at({**shape, "w": weights}, kind().bounds(local))
    return Trials(on, 1).fitted(cart().with_element(port, law), [without.values], 1, states=without.begin), local


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
    best, local = flexible_fit(on, port, flexible)
    kinds = dict.fromkeys((*simple, type(hidden)))
    entries = [Scored(port, kind(), 0.1, ({},), local) for kind in kinds][::-1]
    found = {type(s.law): s.starts[0] for s in _matching_forces(on, [best], entries)}
    start = found[type(hidden)]
    for name, value in hidden.values.items():
        if name not in hidden.strength and name != "v_0":
            assert start[name] == pytest.approx(value, rel=0.5)


def test_a_simple_law_stands_for_itself():
    on = bench("actuator:force", Saturation().at({"L": 8.0}))
    best = Trials(on, 1).fitted(cart().with_element("actuator:force", Saturation().at({"L": 8.0})), [{}], 1)
    local = port_signals(on, best.fitted, "actuator:force")
    np.testing.assert_allclose(local.z, on.recordings[0].u[:, 0])
    assert _matching_forces(on, [best], [Scored("actuator:force", DeadZone(), 0.1, ({},), local)]) == []


def test_a_rate_that_is_no_number_is_compared_with_nothing(monkeypatch):
    """As of a root where a tank runs empty."""
    on = bench("actuator:force", DeadZone().at({"g": 3.0}))
    best, local = flexible_fit(on, "actuator:force", PlayHysteresis)
    entries = [Scored("actuator:force", DeadZone(), 0.1, ({},), local)]
    assert _matching_forces(on, [best], entries)
    nowhere = replace(local, dz=np.where(np.arange(len(local.dz)) == 7, np.nan, local.dz))
    monkeypatch.setitem(_matching_forces.__globals__, "port_signals", lambda *_: nowhere)
    assert _matching_forces(on, [best], entries) == []
