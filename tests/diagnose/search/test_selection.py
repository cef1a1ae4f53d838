"""Laws that are selected for a fit: by their scores, or because their force is like that of a law that varies."""

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
from pilfr_casadi.diagnose.fits.screen import Scored, screen
from pilfr_casadi.diagnose.search.forms import in_place_of_variation
from pilfr_casadi.diagnose.search.trials import Effort, Trial, Trials, select_pairs
from pilfr_casadi.laws import (
    Backlash,
    CoulombFriction,
    CubicDamping,
    CubicStiffness,
    Delay,
    LinearStiffness,
    PeriodicForce,
    PowerDrag,
    ProgressiveStiffness,
    QuadraticDrag,
    QuadraticStiffness,
    Resonance,
    StribeckFriction,
    scheduled,
    varying,
)

DT, M = 0.02, 1500


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


def varied(bench, refit, law, port="parameter:k"):
    """The hypothesis that a law of given values acts on the tiny machine."""
    fitted = bench.run(bench.simulator.with_element(port, law), {}, refit.begin)
    return Trial.of(fitted, 1)


def test_a_parameter_that_varies_with_its_own_coordinate_is_a_force_at_that_port(tiny):
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


def bench(port, law):
    """The cart recorded with a law that it hides."""
    u = 10 * pilfr.multisine(M, f_max=3.0, fs=1 / DT, rng=np.random.default_rng(2))
    r = Recording(u, np.zeros(M), DT, ("force",), ("pos",), initial="zero", hold="zero")
    return Workbench.of(cart(), [r.with_(y=outputs_of(cart().with_element(port, law), r))], "zero")


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
    law = scheduled(LinearStiffness, "z", "linear")().at({"k_1": 0.0, "k_1_high": 0.05, "low": 0.0, "high": 1.0})
    best = Trials(on, 1).make_trial(on.run(tank.with_element("outlet", law), {}, [np.array([level])]), 1)
    found = in_place_of_variation(on, best, [Scored("outlet", CubicStiffness(), 0.1, ({},), local)])
    assert bool(found) is compared


@pytest.mark.parametrize("n", [1.5, 2.0])
def test_a_drag_of_another_power_is_named_in_this_form_alone(n):
    r = bench("ground", PowerDrag().at({"c_n": 3.0, "n": n})).recordings[0]
    found = pilfr.diagnose(cart(), r, laws=(CubicDamping, QuadraticDrag, PowerDrag), hold="zero", workers=1)
    assert [(e.port, e.law, e.form) for e in found.effects] == [("ground", "quadratic_drag", "power" if n < 2 else "")]


def test_a_fit_starts_from_the_best_values_of_both_runs(tiny):
    """Starts with hardly any force cost little; they took all the places of those that the simulation points to."""
    bench, refit = tiny
    local = port_signals(bench, refit, "a")
    largest = float(np.max(np.abs(local.z)))

    def entry(source, periods, force):
        starts = tuple({"a": force, "b": 0.0, "L": 2 * largest / n} for n in periods)
        return Scored("a", PeriodicForce(), 0.5, starts, local, source=source)

    entries = [entry("simulation", (3.0, 4.0, 5.0), 0.5), entry("observer", (20.0, 21.0, 22.0), 1e-9)]
    first = Trials(bench, 1)._fit_briefly(Trial.of(refit, 0), entries, None)
    periods = [2 * largest / float(start["a.L"]) for start, _ in first.starts_again(False)]
    assert any(n == pytest.approx(3.0) for n in periods[1:])


def test_a_well_damped_resonance_is_screened_as_such():
    """In place of a delay or a lag: it has no peak, and from a sharp one, fits do not come to it."""
    on = bench("actuator:force", Resonance().at({"W": 18.0, "D": 0.5}))
    refit = on.fit(cart())
    scored, _ = screen(on, refit, (Resonance, Delay), np.full(1, 1e-3), 1)
    found = [s for s in scored if s.port == "actuator:force" and isinstance(s.law, Resonance)]
    assert found[0].starts[0]["D"] > 0.1
    best = Trials(on, 1).fit_pairs(Trial.of(refit, 0), [found], Effort(None, 0.0, True), lambda *_: None)[0][0]
    assert best.own["W"] == pytest.approx(18.0, rel=0.05) and best.own["D"] == pytest.approx(0.5, rel=0.1)
