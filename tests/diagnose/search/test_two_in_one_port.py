"""Two laws missing at one port: friction and a curve of position are different physics there."""

import pytest
from diagnosis_example import recorded, rig as example_rig
from diagnosis_rig import OFF, recordings, rig

import pilfr_casadi as pilfr
from pilfr_casadi import laws
from pilfr_casadi._base import Stages
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.fits.floor import Floor
from pilfr_casadi.diagnose.fits.linearise import linearise_runs
from pilfr_casadi.diagnose.fits.screen import Remainder
from pilfr_casadi.diagnose.search.moves import Search
from pilfr_casadi.diagnose.search.pairs import choose_pairs, complements
from pilfr_casadi.diagnose.search.trials import Trial

FRICTION = laws.CoulombFriction(values={"F_c": 10.0, "v_0": 0.01})
RIPPLE = laws.PeriodicForce(values={"a": 5.0, "b": 3.0, "L": 0.02})


@pytest.mark.slow
def test_friction_and_ripple_at_one_port_are_both_named():
    train, test = recordings(FRICTION, RIPPLE, noise=2e-3)
    found = pilfr.diagnose(rig(OFF), train, test=test)
    assert {(e.port, e.law) for e in found.effects} == {
        ("ground-m1", "coulomb_friction"),
        ("ground-m1", "periodic_force"),
    }
    assert found.errors["test"]["after"] < 1.2 * found.floor["nrmse"]


def driven_with(kind, values):
    """The diagnosis of a rig whose drive has a dead zone, and behind it a law of a kind; and the values found."""
    true = example_rig().with_element("actuator:force", laws.DeadZone().at({"g": 1.5}))
    true = true.with_element("actuator:force", kind().at(values))
    train, test = recorded(true, 0, samples=500), recorded(true, 1, samples=400)
    tried = (laws.DeadZone, kind)
    found = pilfr.diagnose(example_rig(430.0, 5.0), train, test=test, laws=tried, hold="zero", workers=1)
    return found, {name: p["value"] for e in found.effects for name, p in e.parameters.items()}


def test_a_drive_may_have_a_dead_zone_and_a_limit():
    """Both at one actuator, one after the other, as of a motor's power stage; their order decides what L means."""
    found, values = driven_with(laws.Saturation, {"L": 12.0})
    assert {(e.port, e.law) for e in found.effects} == {
        ("actuator:force", "dead_zone"),
        ("actuator:force", "saturation"),
    }
    limit = next(e for e in found.effects if e.law == "saturation")
    first = "after the dead zone" not in limit.sentence  # then it limits the signal before the dead zone
    assert values == pytest.approx({"g": 1.5, "L": 13.5 if first else 12.0}, rel=0.03)
    assert found.errors["test"]["after"] < 1.3 * found.floor["nrmse"]


def test_two_laws_of_one_drive_are_a_pair_to_try_at_once():
    """Of those at one port, only laws that are different physics there."""
    true = example_rig().with_element("actuator:force", laws.DeadZone().at({"g": 1.5}))
    true = true.with_element("actuator:force", laws.Saturation().at({"L": 12.0}))
    bench = Workbench.of(example_rig(430.0, 5.0), [recorded(true, 0, samples=500)], "zero")
    tried = (laws.DeadZone, laws.Saturation, laws.SoftSaturation)
    rest = Remainder.of(bench, *linearise_runs(bench, bench.fit(bench.simulator)), tried)
    at_drive = [
        {type(block.scored.law) for block in pair}
        for pair in choose_pairs(rest)
        if {block.scored.port for block in pair} == {"actuator:force"}
    ]
    assert at_drive and all(laws.DeadZone in kinds and len(kinds) == 2 for kinds in at_drive)


def test_a_drive_may_have_a_dead_zone_and_a_delay():
    found, values = driven_with(laws.Delay, {"T": 0.013})
    assert {e.law for e in found.effects} == {"dead_zone", "delay"}  # behind the rig the delay looks the same
    at_drive = frozenset(("actuator:force", kind) for kind in (laws.DeadZone, laws.Delay))
    assert at_drive in found.evidence.search.memo
    assert values == pytest.approx({"g": 1.5, "T": 0.013}, rel=0.05)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (laws.Lag().at({"T": 0.02}), laws.Saturation().at({"L": 9.0})),
        (laws.DeadZone().at({"g": 1.0}), laws.Lag().at({"T": 0.15})),
    ],
)
def test_a_curve_behind_a_lag_is_told_from_a_lag_behind_a_curve(first, second):
    true = example_rig().with_element("actuator:force", first).with_element("actuator:force", second)
    train, test = recorded(true, 0, samples=500), recorded(true, 1, samples=400)
    tried = (type(first), type(second))
    found = pilfr.diagnose(example_rig(430.0, 5.0), train, test=test, laws=tried, hold="zero", workers=1)
    assert tuple(type(e.law) for e in found.corrected.elements) == tried
    assert found.errors["test"]["after"] < 1.2 * found.floor["nrmse"]


@pytest.mark.parametrize(
    ("added", "order"),
    [(0, None), (1, (laws.Saturation, laws.Lag, laws.DeadZone)), (2, (laws.DeadZone, laws.Lag, laws.Saturation))],
)
def test_the_law_that_was_added_is_tried_before_the_others_of_its_signal(added, order):
    simulator = example_rig()
    for law in (laws.Lag().at({"T": 0.02}), laws.Saturation().at({"L": 9.0}), laws.DeadZone().at({"g": 1.0})):
        simulator = simulator.with_element("actuator:force", law)
    bench = Workbench.of(example_rig(), [recorded(simulator, 0, samples=200)], "zero")
    search = Search(
        bench, bench.fit(bench.simulator), Floor(1e-3 * bench.scale, "repeats"), (), 1, Stages(lambda *_: None)
    )
    search.keep(Trial.of(search.without, 0))
    trial = Trial.of(bench.run(simulator, {}, bench.fit(bench.simulator).begin), 3)
    found = search._reorder(trial.with_added(trial.laws[added].pair))
    assert order == (found and tuple(type(e.law) for e in found.laws))


def test_a_finer_form_takes_the_place_of_its_law_in_series():
    """Behind the lag, which was found first, plays could not follow; the finer form was fitted there alone."""
    plays = laws.PlayHysteresis().at({"w": [-0.4, *[0.1] * 5], "r": [0.0, 1.2, 2.4, 3.6, 4.8, 6.0]})
    true = example_rig().with_element("actuator:force", plays).with_element("actuator:force", laws.Lag().at({"T": 0.1}))
    train, tried = recorded(true, 0, samples=500), (laws.PlayHysteresis, laws.Lag)
    found = pilfr.diagnose(example_rig(430.0, 5.0), train, laws=tried, hold="zero", workers=1)
    finer, plain = (
        found.evidence.search.memo[frozenset(("actuator:force", kind) for kind in (first, laws.Lag))]
        for first in (*laws.FINER[laws.PlayHysteresis], laws.PlayHysteresis)
    )
    assert [type(e.law) for e in plain.laws] == [laws.PlayHysteresis, laws.Lag]
    assert finer.laws[0].law.n > plain.laws[0].law.n and finer.error < plain.error


@pytest.mark.parametrize(
    ("one", "other", "apart"),
    [
        (laws.CoulombFriction, laws.CubicStiffness, True),
        (laws.PiecewiseStiffness, laws.PreslidingFriction, True),
        (laws.CoulombFriction, laws.ViscousDamping, True),  # dry, and growing with speed
        (laws.StribeckFriction, laws.QuadraticDrag, True),
        (laws.CoulombFriction, laws.StribeckFriction, False),  # both dry
        (laws.ViscousDamping, laws.QuadraticDrag, False),  # both grow with speed
        (laws.CubicStiffness, laws.PiecewiseStiffness, False),  # both of position
        (laws.Relaxation, laws.CubicStiffness, False),  # it is a spring itself
        (laws.CoulombFriction, laws.Drift, False),  # neither of position
        (laws.CoulombFriction, laws.ElasticDrive, True),  # a mass on a spring has friction as well
        (laws.CubicStiffness, laws.Attached, True),
        (laws.Attached, laws.ElasticDrive, False),  # both masses on springs
        (laws.Relaxation, laws.Attached, False),  # both may follow anything slow
        (laws.CubicStiffness, laws.scaled(laws.LinearStiffness, "pressure"), True),  # a signal varies one of them
        (laws.DeadZone, laws.SoftSaturation, True),  # of small and of large signals
        (laws.DeadZone, laws.AsymmetricDeadZone, False),
        (laws.CubicStiffness, laws.scheduled(laws.LinearStiffness, "z"), False),
        (laws.Delay, laws.Backlash, True),  # the path of a signal
        (laws.Delay, laws.Lag, True),
        (laws.Resonance, laws.DeadZone, True),
        (laws.Delay, laws.Delay, False),
        (laws.Lag, laws.Resonance, False),
        (laws.Lag, laws.Creep, False),
    ],
)
def test_only_different_physics_stands_beside_a_law(one, other, apart):
    assert complements(one(), other()) is apart
    assert complements(other(), one()) is apart
