"""Choosing among laws, and what is looked at again once one is in place."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from test_missing_flows import axis, moved

from pilfr_casadi.data import Recording
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.choice import choose
from pilfr_casadi.diagnose.first_effect import wrongly_held
from pilfr_casadi.diagnose.floor import Floor
from pilfr_casadi.diagnose.gates import Gate, hold_note
from pilfr_casadi.diagnose.passed_over import passed_over
from pilfr_casadi.diagnose.screen import Scored
from pilfr_casadi.diagnose.search import Search
from pilfr_casadi.diagnose.second_effect import only_drifts
from pilfr_casadi.diagnose.timing import timing
from pilfr_casadi.diagnose.verdict import strained
from pilfr_casadi.engine import make_engine
from pilfr_casadi.laws import (
    Creep,
    CubicStiffness,
    Delay,
    Drift,
    HarmonicForce,
    LinearStiffness,
    PeriodicForce,
    Relaxation,
    Resonance,
    Settling,
    TwoStageCreep,
    TwoStageRelaxation,
)
from pilfr_casadi.models import Parameter
from pilfr_casadi.optimise import GaussNewton, Status
from pilfr_casadi.simulators import Port, Simulator


def searching(bench, said=True):
    """A search on a bench, not yet begun."""
    floor = Floor(np.full(len(bench.scale), 1e-5), "estimated")
    return Search(bench, bench.fit(bench.simulator), floor, (), 1, lambda *_: None, said)


@pytest.mark.parametrize(
    ("port", "remains", "drifts"),
    [("sensor:position", 0.3, True), ("sensor:position", 1e-3, False), ("guide", 0.3, False)],
)
def test_behind_a_free_integrator_no_sensor_is_blamed_for_what_is_left(port, remains, drifts):
    """Unless next to nothing is left then: no drift that is followed does that."""
    search = searching(Workbench.of(axis(), [moved(0)], "zero"))
    winner = SimpleNamespace(port=port, law=SimpleNamespace(id="hysteresis"))
    assert only_drifts(search, SimpleNamespace(winner=winner, remains=remains)) is drifts


def test_an_interrupt_that_a_fit_has_kept_to_itself_ends_the_search():
    """A solver returns its best so far then; without a word the search would go on with that."""

    class Interrupted(GaussNewton):
        def solve(self, *given):
            return replace(super().solve(*given), status=Status.INTERRUPTED)

    bench = Workbench.of(axis(), [moved(0)], "zero")
    search = searching(bench)
    assert not search.run(1).interrupted
    bench.fit(bench.simulator, solver=Interrupted())
    search = searching(bench)
    assert search.run(1).interrupted and search.accepted == []


def candidate(port, law, error, size=2, at_bound=False, doubtful=False, form="", knee=""):
    """What the choice reads of a fitted candidate."""
    return SimpleNamespace(
        port=port,
        law=SimpleNamespace(id=law, form=form, units={}),
        error=error,
        full=error,
        size=size,
        at_bound=at_bound,
        doubtful=doubtful,
        name=(port, law),
        knee=knee,
    )


def fitted(port, law, error, **own):
    """The same of a law of the catalogue, with its fitted values."""
    return SimpleNamespace(port=port, law=law, error=error, size=len(own), own=own)


@pytest.mark.parametrize(("left", "named"), [(4.2e-4, "coulomb_friction"), (4.2e-3, "stribeck_friction")])
def test_between_frictions_next_to_nothing_does_not_decide(left, named):
    falls = candidate("guide", "stribeck_friction", 3.5e-4, 4, knee="guide.v_0")
    dry = candidate("guide", "coulomb_friction", left, 2, knee="guide.v_0")
    choice = choose([falls, dry], (0.13, 0.15), 3e-4**2, 500.0)
    assert choice.winner.law.id == named and choice.margin > 1.0
    elsewhere = candidate("belt", "coulomb_friction", left, 2, knee="belt.v_0")
    assert choose([falls, elsewhere], (0.13, 0.15), 3e-4**2, 500.0).winner is falls


def test_of_two_that_do_as_well_the_one_that_no_bound_holds_back_is_taken():
    held, free = candidate("spring", "extra_mode", 0.100, at_bound=True), candidate("sensor:x", "extra_mode", 0.102)
    choice = choose([held, free], (1.0, 1.0), 1e-4, 500.0)
    assert choice.winner is free and choice.alike == (held,)
    worse = candidate("sensor:x", "extra_mode", 0.2)
    assert choose([held, worse], (1.0, 1.0), 1e-4, 500.0).winner is held


@pytest.mark.parametrize(
    ("whole", "at_bound", "form"), [(0.02, False, "progressive"), (0.09, False, ""), (0.02, True, "")]
)
def test_a_form_of_the_named_law_that_follows_everything_far_better_is_taken(whole, at_bound, form):
    """A first part with little in it asks for no second term, and the rest is then foretold as badly without."""
    plain, other = candidate("support", "quadratic_stiffness", 0.1), candidate("support", "clearance", 0.3)
    finer = candidate("support", "quadratic_stiffness", 0.1, size=3, form="progressive", at_bound=at_bound)
    plain.full, finer.full = 0.1**2, whole**2
    assert choose([plain, finer, other], (1.0, 1.0), 1e-6, 200.0).winner.law.form == form


def test_a_rival_that_cannot_follow_everything_is_refuted_by_that():
    """A first part that asks for little leaves laws near each other which the rest tells apart."""
    near, rival = candidate("support", "clearance", 0.10), candidate("support", "saturation", 0.12)
    near.full, rival.full = 0.1**2, 0.12**2
    assert choose([near, rival], (1.0, 1.0), 1e-6, 200.0).margin == pytest.approx(1.2)
    rival.full = 0.5**2
    assert choose([near, rival], (1.0, 1.0), 1e-6, 200.0).margin == pytest.approx(5.0)
    rival.full = np.inf  # not fitted to everything
    assert choose([near, rival], (1.0, 1.0), 1e-6, 200.0).margin == pytest.approx(1.2)


def test_of_forms_the_one_that_speaks_of_a_part_stays_and_steps_do_not_decide():
    parts = candidate("cart", "extra_mode", 0.010, form="mode"), candidate("cart", "extra_mode", 0.013)
    parts[1].law.form, parts[0].full, parts[1].full = "attached mass", 1e-4, 1.69e-4
    assert choose(parts, (1.0, 1.0), 6.4e-5, 500.0).winner is parts[1]
    frictions = [candidate("guide", "coulomb_friction", e, size=n, knee="v") for e, n in ((2e-3, 2), (1.2e-3, 3))]
    frictions[0].full, frictions[1].full = 4e-6, 1.44e-6
    assert choose(frictions, (1.0, 1.0), 1e-8, 500.0).winner is frictions[0]


@pytest.mark.parametrize(
    ("part", "floor", "named"), [(0.0202, 1e-8, 1), (0.028, 1e-4, 1), (0.028, 4e-4, 0), (0.04, 1e-4, 0)]
)
def test_creep_that_may_be_a_parts_as_well_as_a_signals_is_the_parts(part, floor, named):
    creeps = candidate("sensor:x", "creep", 0.02), candidate("equation:vel", "creep", part)
    choice = choose(creeps, (1.0, 1.0), floor, 500.0)
    assert choice.winner is creeps[named]
    assert choice.readings == 1 + named


def test_what_is_hardly_what_its_name_says_gives_way_to_what_is():
    named = dict(port="sensor:x", law="saturation", error=0.1)
    thin, plain = candidate(**named, doubtful=True), candidate("sensor:x", "dead_zone", 0.108)
    assert choose([thin, plain], (1.0, 1.0), 1e-8, 500.0).winner is plain
    assert choose([candidate(**named), plain], (1.0, 1.0), 1e-8, 500.0).winner is not plain
    far, elsewhere = candidate("sensor:x", "dead_zone", 0.13), candidate("guide", "dead_zone", 0.105)
    assert choose([thin, far, elsewhere], (1.0, 1.0), 1e-8, 500.0).winner is thin


def test_a_part_that_is_carried_along_is_named_before_the_pole_and_zero_beside_the_path():
    beside = [candidate(f"{end}:x", "extra_mode", 0.010, size=4, form="mode") for end in ("sensor", "actuator")]
    carried = candidate("cart", "extra_mode", 0.012, size=3, form="attached mass")
    other = candidate("cart", "hysteresis", 0.4)
    choice = choose([*beside, carried, other], (1.0, 1.0), 6.4e-5, 500.0)
    assert choice.winner is carried and {c.port for c in choice.alike} == {"sensor:x", "actuator:x"}
    assert choice.margin > 10
    far = candidate("cart", "extra_mode", 0.016, size=3, form="attached mass")
    assert choose([*beside, far, other], (1.0, 1.0), 6.4e-5, 500.0).winner in beside


def test_what_hysteresis_follows_better_does_not_fall_with_speed():
    falls, dry = candidate("axis", "stribeck_friction", 0.0240, size=4), candidate("axis", "coulomb_friction", 0.0264)
    bent, elsewhere = candidate("axis", "hysteresis", 0.0210, size=4), candidate("other", "hysteresis", 0.5)
    choice = choose([bent, falls, dry, elsewhere], (1.0, 1.0), 1.4e-4, 500.0)
    assert choice.winner is dry and choice.margin > 10
    trifle = candidate("axis", "hysteresis", 0.0239, size=7)
    assert choose([falls, dry, trifle, elsewhere], (1.0, 1.0), 1.4e-4, 500.0).winner is falls
    worse = candidate("axis", "hysteresis", 0.03, size=4)
    assert choose([falls, dry, worse, elsewhere], (1.0, 1.0), 1.4e-4, 500.0).winner is falls
    far = candidate("axis", "coulomb_friction", 0.05)
    near = candidate("axis", "hysteresis", 0.0235, size=4)
    assert choose([near, falls, far, elsewhere], (1.0, 1.0), 1.4e-4, 500.0).winner is falls


def test_a_slow_trend_that_may_be_anywhere_is_the_sensors():
    everywhere = [candidate(port, "drift", 0.1, size=4) for port in ("actuator:u", "guide", "sensor:x")]
    choice = choose(everywhere, (1.0, 1.0), 1e-4, 500.0)
    assert choice.winner is everywhere[2] and {c.port for c in choice.alike} == {"actuator:u", "guide"}
    worse = candidate("sensor:x", "drift", 0.2, size=4)
    assert choose([*everywhere[:2], worse], (1.0, 1.0), 1e-4, 500.0).winner is everywhere[0]


def test_a_special_case_that_was_left_after_a_few_steps_is_fitted_again():
    scored = [Scored("a", law, 0.1, ({},), None) for law in (LinearStiffness(), CubicStiffness())]
    flexible, left = candidate("a", "extra_mode", 0.1), candidate("a", "linear_stiffness", 0.5)
    left.law = LinearStiffness()
    assert "linear_stiffness" in [s.law.id for s in passed_over([flexible, left], scored)]
    left.error = 0.11
    assert "linear_stiffness" not in [s.law.id for s in passed_over([flexible, left], scored)]


def test_where_a_delay_comes_near_damped_resonances_as_late_are_tried():
    late = fitted("a", Delay(), 0.1, T=0.02)
    scored = [Scored(port, Resonance(), 0.1, ({"W": 3.0, "D": 0.05},), None) for port in ("a", "b")]
    (more,) = [s for s in passed_over([late], scored) if s.port == "a"]
    assert [2 * v["D"] / v["W"] == pytest.approx(0.02) for v in more.starts] == [True, True, False]
    best = candidate("b", "cubic_stiffness", 0.01)
    assert passed_over([best, late], scored) == []


def test_a_delay_is_tried_at_the_other_end_as_well():
    late = fitted("sensor:y", Delay(), 0.1, T=0.02)
    ports = ("sensor:y", "actuator:u", "spring")
    scored = [Scored(port, Delay(), 0.1, ({"T": 0.05},), None) for port in ports]
    (more,) = passed_over([late], scored)
    assert more.port == "actuator:u" and [start["T"] for start in more.starts] == [0.02, 0.05]
    there = fitted("actuator:u", Delay(), 0.11, T=0.02)
    assert passed_over([late, there], scored) == []


def test_a_law_with_one_more_term_than_one_that_came_near_is_no_worse_and_so_is_fitted_again_from_there():
    plain, wider = PeriodicForce(), HarmonicForce()
    start = {"a": 1.0, "b": 1.0, "a_2": 1.0, "b_2": 1.0, "L": 0.1}
    near, lost = fitted("a", plain, 0.1, a=3.0, b=-2.0, L=0.7), fitted("a", wider, 0.5, **start)
    best = candidate("c", "cubic_stiffness", 0.09)
    scored = [Scored(port, law, 0.1, (start,), None) for port in ("a", "b") for law in (plain, wider)]
    for others in ([], [best]):
        (more,) = [s for s in passed_over([*others, near, lost], scored) if isinstance(s.law, HarmonicForce)]
        assert more.port == "a" and more.starts == ({"a": 3.0, "b": -2.0, "a_2": 0.0, "b_2": 0.0, "L": 0.7},)
    assert passed_over([candidate("c", "cubic_stiffness", 0.05), near, lost], scored) == []
    assert passed_over([fitted("a", wider, 0.09, **start), near], scored) == []
    # of the same names, but no line is an exponential
    trend = fitted("a", Drift(), 0.1, a=3.0, b=-2.0)
    settling = fitted("a", Settling(), 0.5, a=1.0, b=0.0, T=2.0)
    assert passed_over([trend, settling], [Scored("a", Settling(), 0.1, (settling.own,), None)]) == []


@pytest.mark.parametrize(("one", "two", "name"), [(Relaxation, TwoStageRelaxation, "k"), (Creep, TwoStageCreep, "c")])
def test_creep_in_two_stages_goes_on_from_one(one, two, name):
    own = {next(iter(one.units)): 8.0, "T": 0.5}
    assert two().starts_as(one(), own) == {f"{name}_1": 4.0, f"{name}_2": 4.0, "T_1": 0.25, "T_2": 1.0}
    assert two().starts_as(PeriodicForce(), {"a": 1.0, "b": 0.0, "L": 1.0}) == {}


def test_where_the_best_is_doubtful_what_takes_its_place_is_the_smallest_that_does_as_well():
    doubtful = candidate("overflow", "coulomb_friction", 0.090, size=4, doubtful=True)
    plain, small = candidate("overflow", "viscous_damping", 0.100), candidate("pump", "static_curve", 0.102, size=1)
    assert choose([doubtful, plain, small], (1.0, 1.0), 1e-4, 500.0).winner is small


def spring():
    """A mass on a spring, measured at position and velocity."""
    return Simulator(
        lambda x, u, p: {"pos": x.vel, "vel": u.force - p.k * x.pos - p.d * x.vel},
        lambda x: {"pos": x.pos, "vel": x.vel},
        states=("pos", "vel"),
        inputs=("force",),
        parameters={"k": Parameter(120.0, bounds=(20, 500)), "d": Parameter(1.0, bounds=(0, 20))},
        ports=(Port("ground", {"vel": -1.0}, lambda x: x.pos, lambda x: x.vel),),
    )


def shaken(hold, clock=0.0, m=3000, dt=0.02, law=None, early=0):
    """The spring recorded; `clock`: by how much each of the outputs' samples takes longer, `early`: how many early."""
    rng = np.random.default_rng(3)
    u = np.convolve(rng.standard_normal(m), np.ones(4) / 2, "same")
    true = spring().with_parameters({"k": Parameter(100.0), "d": Parameter(1.4)})
    true = true.with_element("ground", law) if law else true
    blank = Recording(u, rng.standard_normal((m, 2)), dt, ("force",), ("pos", "vel"), initial="zero")
    model = Workbench.of(true, [blank], hold).model(true)
    y = make_engine(model).simulate(model.drive(blank), model.parameters.start, np.zeros(2))[0]
    u, y = u[: m - early], y[early:]
    if clock:
        at = np.arange(m) * (1 + clock)
        u, y = u[at < m - 1], np.stack([np.interp(at[at < m - 1], np.arange(m), c) for c in y.T], axis=1)
    y = y + 1e-4 * y.std(axis=0) * rng.standard_normal(y.shape)
    return Recording(u, y, dt, ("force",), ("pos", "vel"), initial="zero")


@pytest.mark.parametrize(
    ("used", "said", "wrong"), [("zero", False, True), ("zero", True, False), ("linear", False, False)]
)
def test_how_inputs_are_held_is_asked_again_with_an_effect_in_place(used, said, wrong):
    search = searching(Workbench.of(spring(), [shaken("linear")], used), said)
    search.base = search.without
    assert wrongly_held(search) is wrong
    assert (search.misheld > 2) is wrong


def test_a_clock_between_the_rates_looked_at_is_found_and_is_that_of_both_outputs():
    bench = Workbench.of(spring(), [shaken("zero", 3.36e-3)], "zero")
    _, found, gates = timing(bench, bench.fit(bench.simulator), 1e-8)
    assert [(g.channel, g.finding) for g in gates] == [("pos, vel", "clock")] and isinstance(gates[0], Gate)
    assert gates[0].value == pytest.approx(-3.36e-3, rel=0.02)
    assert found.cost**0.5 < 0.02


@pytest.mark.parametrize("stiffening", [0.0, 1e4])
def test_what_seems_early_while_more_is_wrong_may_be_no_fault(stiffening):
    law = CubicStiffness(values={"k_3": stiffening})
    bench = Workbench.of(spring(), [shaken("zero", law=law, early=6)], "zero")
    plain = bench.fit(spring())
    for early in (True, False):
        gates = timing(bench, plain, 1e-8, early=early)[2]
        assert [g.finding for g in gates] == (["alignment"] if early or not stiffening else [])


@pytest.mark.parametrize(("ratio", "why"), [(1.3, "fits better"), (1.0, "gives the surer answer")])
def test_why_a_hold_was_chosen_is_said(ratio, why):
    assert why in hold_note(spring(), "linear", ratio).sentence


@pytest.mark.parametrize(("bounds", "halved"), [((20, 500), False), ((101.0, 500), True)])
def test_a_name_that_takes_a_parameter_at_its_bound_is_less_sure(bounds, halved):
    simulator = spring().with_parameters({"k": Parameter(120.0, bounds=bounds), "d": Parameter(0.0, bounds=(0, 20))})
    bench = Workbench.of(simulator, [shaken("zero")], "zero")
    assert strained(bench.fit(simulator)) is halved
    simulator = spring().with_parameters({"k": Parameter(100.0), "d": Parameter(0.0, bounds=(-1.0, 0.0))})
    assert not strained(bench.fit(simulator)), "a damper that is none"
