"""Hypotheses that what came out best asks for: special cases, the same at another place, one term more, its shape."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from cart import cart
from simulated import outputs_of

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Recording, Simulator
from pilfr_casadi.diagnose import Workbench, port_signals
from pilfr_casadi.diagnose.fits.force_recovery import forces_of_change
from pilfr_casadi.diagnose.fits.screen import Scored
from pilfr_casadi.diagnose.search.relatives import in_place_of_variation, relatives
from pilfr_casadi.diagnose.search.trials import Trial, Trials, select_pairs
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
    PowerDrag,
    PreslidingFriction,
    PreslidingStribeckFriction,
    ProgressiveStiffness,
    QuadraticDrag,
    QuadraticStiffness,
    Resonance,
    Saturation,
    Settling,
    SoftSaturation,
    StopHysteresis,
    StribeckFriction,
    scheduled,
    varying,
)

DT, M = 0.02, 1500


@pytest.fixture
def asked_for(tiny, hypothesis):
    """Tell what is to be fitted as well beside fitted hypotheses (port, law, error, values), best first."""

    def ask(told, scored):
        trials = [hypothesis((port, law), error=error, **own) for port, law, error, own in told]
        return relatives(tiny[0], trials, scored)

    return ask


@pytest.fixture
def entry(tiny):
    """Make the entry of a port and a law, with its start values, in the list of the screen."""
    local = port_signals(*tiny, "a")
    return lambda port, law, *starts: Scored(port, law(), 0.1, starts or ({},), local)


def test_the_simplest_of_laws_that_explain_about_as_much_is_fitted_first(tiny):
    """A time limit may leave the others out."""
    local = port_signals(*tiny, "a")

    def entry(law, share, **own):
        return Scored("a", law.at(own), share, (own,), local)

    cube, both = (
        entry(CubicStiffness(), 0.90, k_3=1.0),
        entry(StribeckFriction(), 0.91, F_c=1.0, F_e=0.5, v_s=1.0, v_0=0.1),
    )
    assert [found[0].law.id for found in select_pairs([both, cube], few=False)] == [cube.law.id, both.law.id]
    far = replace(cube, share=0.5)
    assert [found[0].law.id for found in select_pairs([both, far], few=False)] == [both.law.id, cube.law.id]


def test_a_special_case_that_was_left_after_a_few_steps_is_fitted_again(asked_for, entry):
    scored = [entry("a", law) for law in (LinearStiffness, CubicStiffness)]
    best = ("a", PiecewiseStiffness, 0.1, {})
    found = asked_for([best, ("a", LinearStiffness, 0.5, {})], scored)
    assert [s.law.id for s in found] == ["linear_stiffness"]
    assert asked_for([best, ("a", LinearStiffness, 0.11, {})], scored) == []


def test_where_a_delay_comes_near_damped_resonances_as_late_are_tried(asked_for, entry):
    late = ("actuator:force", Delay, 0.1, {"T": 0.02})
    scored = [entry(port, Resonance, {"W": 3.0, "D": 0.05}) for port in ("actuator:force", "sensor:pos")]
    (more,) = [s for s in asked_for([late], scored) if s.port == "actuator:force"]
    assert [2 * v["D"] / v["W"] == pytest.approx(0.02) for v in more.starts] == [True, True, False]
    assert asked_for([("b", CubicStiffness, 0.01, {}), late], scored) == []


def test_a_delay_is_tried_at_the_other_end_as_well(asked_for, entry):
    late = ("sensor:pos", Delay, 0.1, {"T": 0.02})
    scored = [entry(port, Delay, {"T": 0.05}) for port in ("sensor:pos", "actuator:force", "a")]
    (more,) = asked_for([late], scored)
    assert more.port == "actuator:force" and [start["T"] for start in more.starts] == [0.02, 0.05]
    assert asked_for([late, ("actuator:force", Delay, 0.11, {"T": 0.02})], scored) == []


def test_a_trend_in_time_is_tried_at_the_other_end_as_well(asked_for, entry):
    """A sensor that warms up looks like a force that dies away, and the screen had fitted that alone."""
    settling = ("actuator:force", Settling, 0.1, {"a": -0.4, "b": 0.0, "T": 4.0})
    scored = [entry(port, Settling, {"T": 1.0}) for port in ("actuator:force", "sensor:pos", "a")]
    (more,) = [s for s in asked_for([settling], scored) if s.port == "sensor:pos"]
    assert [start["T"] for start in more.starts] == [4.0, 1.0]


def varied(bench, refit, law, port="parameter:k"):
    """The hypothesis that a law of given values acts on the tiny machine."""
    fitted = bench.run(bench.simulator.with_element(port, law), {}, refit.begin)
    return Trial.of(fitted, 1)


def test_a_parameter_that_varies_with_its_own_coordinate_is_a_force_at_that_port(tiny, entry):
    """A stiffness that varies with its deflection was named, where a spring that stiffens is the same force."""
    bench, refit = tiny
    law = varying("pos", "bend")().at({"c": -6.0, "c_high": 10.0, "low": -1.0, "high": 1.0})  # k + 8 z + 2 z^2
    z = port_signals(*tiny, "a").z
    forces = forces_of_change(bench, refit, "parameter:k", np.full(len(z), 2.0))
    assert sorted(forces) == ["a", "b", "c"]
    assert all(np.allclose(force, 2.0 * z) for force in forces.values())
    best = varied(bench, refit, law)
    local = port_signals(bench, best.fitted, "a")
    plain = (QuadraticStiffness, ProgressiveStiffness, CubicStiffness, CoulombFriction)
    scored = [Scored("a", kind(), 0.1, ({},), local) for kind in (*plain, scheduled(CubicStiffness, "t"))]
    found = in_place_of_variation(bench, best, scored)
    assert [type(s.law) for s in found][:2] == [ProgressiveStiffness, QuadraticStiffness]
    assert not any(s.law.scheduled_by for s in found)
    assert found[0].starts[0]["k_2"] == pytest.approx(8.0, rel=0.3)
    assert in_place_of_variation(bench, best, [replace(s, port="elsewhere") for s in scored]) == []


def test_dry_friction_is_tried_at_each_port_where_it_is_the_best_law_with_a_single_parameter(tiny):
    """The width within which its force reverses is no parameter of the physics."""
    local = port_signals(*tiny, "a")
    elsewhere = [Scored(f"sensor:{i}", Backlash(), 0.99, ({},), local) for i in range(12)]
    shares = ((StribeckFriction, 0.95), (CoulombFriction, 0.92), (CubicDamping, 0.9))
    here = [Scored("a", kind(), share, ({},), local) for kind, share in shares]
    chosen = {found[0].pair for found in select_pairs([*elsewhere, *here], few=False)}
    assert {kind for port, kind in chosen if port == "a"} == {StribeckFriction, CoulombFriction}


def test_no_force_acts_as_a_parameter_that_an_output_reads(tiny):
    bench, refit = tiny
    simulator = bench.simulator
    read = replace(bench, simulator=replace(simulator, outputs=lambda x, p: {"pos": x.pos * (1 + p.k)}))
    change = np.full(len(bench.recordings[0]), 2.0)
    assert forces_of_change(read, refit, "parameter:k", change) == {}
    accelerometer = replace(bench, simulator=replace(simulator, outputs=lambda dx: {"acc": dx.vel}))
    assert sorted(forces_of_change(accelerometer, refit, "parameter:k", change)) == ["a", "b", "c"]


def test_a_law_that_varies_is_compared_with_laws_of_its_own_port(tiny):
    bench, refit = tiny
    kind = scheduled(LinearStiffness, "z", "linear")
    best = varied(bench, refit, kind().at({"k_1": -4.0, "k_1_high": 4.0, "low": -1.0, "high": 1.0}), "b")
    local = port_signals(bench, best.fitted, "b")
    scored = [Scored(port, QuadraticStiffness(), 0.1, ({},), local) for port in ("a", "b")]
    (found,) = in_place_of_variation(bench, best, scored)
    assert found.port == "b" and found.starts[0]["k_2"] == pytest.approx(4.0)


def test_a_law_with_one_more_term_than_one_that_came_near_is_no_worse_and_so_is_fitted_again(asked_for, entry):
    best = ("c", CubicStiffness, 0.09, {})
    start = {"a": 1.0, "b": 1.0, "a_2": 1.0, "b_2": 1.0, "L": 0.1}
    near = ("a", PeriodicForce, 0.1, {"a": 3.0, "b": -2.0, "L": 0.7})
    lost = ("a", HarmonicForce, 0.5, start)
    scored = [entry(port, law, start) for port in ("a", "b") for law in (PeriodicForce, HarmonicForce)]
    (more,) = [s for s in asked_for([best, near, lost], scored) if isinstance(s.law, HarmonicForce)]
    assert more.port == "a" and more.starts == ({"a": 3.0, "b": -2.0, "a_2": 0.0, "b_2": 0.0, "L": 0.7},)
    assert asked_for([("c", CubicStiffness, 0.05, {}), near, lost], scored) == []
    assert asked_for([best, near, ("a", HarmonicForce, 0.1, start)], scored) == []
    # of the same names, but no line is an exponential
    trend, settling = ("a", Drift, 0.1, {"a": 3.0, "b": -2.0}), ("a", Settling, 0.5, {"a": 1.0, "b": 0.0, "T": 2.0})
    assert asked_for([best, trend, settling], [entry("a", Settling, settling[-1])]) == []


def test_a_form_that_stayed_behind_starts_from_the_shape_of_the_best(asked_for, entry):
    best = ("actuator:force", Saturation, 0.1, {"L": 8.0})
    scored = [entry(port, SoftSaturation, {"L": 2.0}) for port in ("actuator:force", "sensor:pos")]
    (more,) = asked_for([best, ("actuator:force", SoftSaturation, 0.5, {"L": 2.0})], scored)
    assert more.port == "actuator:force" and more.starts == ({"L": 8.0},)
    assert asked_for([best, ("actuator:force", SoftSaturation, 0.11, {"L": 2.0})], scored) == []
    assert asked_for([best], [entry("actuator:force", DeadZone, {"g": 1.0})]) == []  # another law


def test_a_refinement_that_came_near_asks_for_the_law_that_it_refines(asked_for, entry):
    """Stribeck's curve without its rise is plain dry friction."""
    own = {"k_t": 800.0, "k_e": 0.0, "r": 1e-3, "v_s": 0.1}
    best, near = ("b", CubicStiffness, 0.1, {}), ("a", PreslidingStribeckFriction, 0.1, own)
    scored = [entry("a", PreslidingFriction, {"k_t": 1.0, "r": 1.0})]
    (more,) = asked_for([best, near], scored)
    assert more.starts == ({k: own[k] for k in PreslidingFriction.units},)
    assert asked_for([best, near, ("a", PreslidingFriction, 0.1, {"k_t": 1.0, "r": 1.0})], scored) == []


def bench(port, law):
    """The cart recorded with a law that it hides."""
    u = 10 * pilfr.multisine(M, f_max=3.0, fs=1 / DT, rng=np.random.default_rng(2))
    r = Recording(u, np.zeros(M), DT, ("force",), ("pos",), initial="zero", hold="zero")
    return Workbench.of(cart(), [r.with_(y=outputs_of(cart().with_element(port, law), r))], "zero")


def flexible_fit(on, port, kind):
    """A flexible law at a port, fitted beside the cart."""
    without = on.fit(cart())
    local = port_signals(on, without, port)
    shape = next(iter(kind().shapes(local)))
    weights = np.append(-0.3 * (port != "ground"), np.full(5, 0.05))
    law = kind().at({**shape, "w": weights}, kind().bounds(local))
    return Trials(on, 1).fit(cart().with_element(port, law), [without.values], 1, states=without.begin), local


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
    found = {type(s.law): s.starts[0] for s in relatives(on, [best], entries)}
    start = found[type(hidden)]
    for name, value in hidden.values.items():
        if name not in hidden.strength and name != "v_0":
            assert start[name] == pytest.approx(value, rel=0.5)


def test_a_simple_law_stands_for_itself():
    on = bench("actuator:force", Saturation().at({"L": 8.0}))
    best = Trials(on, 1).fit(cart().with_element("actuator:force", Saturation().at({"L": 8.0})), [{}], 1)
    local = port_signals(on, best.fitted, "actuator:force")
    np.testing.assert_allclose(local.z, on.recordings[0].u[:, 0])
    assert relatives(on, [best], [Scored("actuator:force", DeadZone(), 0.1, ({},), local)]) == []


@pytest.mark.parametrize(("level", "compared"), [(0.5, True), (0.0, False)])
def test_a_rate_that_is_no_number_is_compared_with_nothing(level, compared):
    """As of a root where a tank is empty."""
    rate = lambda x, u, p: (u.q - p.a * x.h) / (2 * ca.sqrt(x.h))  # noqa: E731
    port = Port("outlet", {"h": -1.0}, lambda x: ca.sqrt(x.h), rate)
    leak = {"a": Parameter(0.1)}
    tank = Simulator(lambda x, u, p: {"h": u.q - p.a * x.h}, lambda x: {"h": x.h}, ("h",), ("q",), leak, port)
    u = np.random.default_rng(0).uniform(0.1, 1.0, (200, 1))
    r = Recording(u, u, 0.1, ("q",), ("h",), initial=[level], hold="zero")
    on = Workbench.of(tank, [r.with_(y=tank.simulate(r))], "zero", "vm")
    local = port_signals(on, on.fit(tank), "outlet")
    assert bool(np.all(np.isfinite(local.dz))) is compared
    loop = StopHysteresis().at({**next(iter(StopHysteresis().shapes(local))), "w": 0.05})
    best = Trials(on, 1).make_trial(on.run(tank.with_element("outlet", loop), {}, [np.array([level])]), 1)
    found = relatives(on, [best], [Scored("outlet", CubicStiffness(), 0.1, ({},), local)])
    assert bool(found) is compared


def test_a_law_with_a_further_term_starts_as_the_fitted_one_with_the_shapes_of_the_screen(asked_for, entry):
    """At no strength of the further term it is the fitted law; how fast that falls, the screen has tried."""
    scored = [
        entry("a", CoulombFriction),
        entry("a", StribeckFriction, *({"v_s": v, "v_0": 0.1 * v} for v in (2.0, 5.0))),
    ]
    own = {"F_c": 3.0, "v_0": 0.01}
    found = [s for s in asked_for([("a", CoulombFriction, 0.1, own)], scored) if s.pair == ("a", StribeckFriction)]
    assert [dict(start) for start in found[0].starts] == [
        {"F_c": 3.0, "F_e": 0.0, "v_s": v, "v_0": 0.01} for v in (2.0, 5.0)
    ]
    assert found[0].beside["a.F_c"] == 3.0  # all parameters begin where that fit has them


@pytest.mark.parametrize("n", [1.5, 2.0])
def test_a_drag_of_another_power_is_named_in_this_form_alone(n):
    r = bench("ground", PowerDrag().at({"c_n": 3.0, "n": n})).recordings[0]
    found = pilfr.diagnose(cart(), r, laws=(CubicDamping, QuadraticDrag, PowerDrag), hold="zero", workers=1)
    assert [(e.port, e.law, e.form) for e in found.effects] == [("ground", "quadratic_drag", "power" if n < 2 else "")]
