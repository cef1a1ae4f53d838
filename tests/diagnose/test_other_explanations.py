"""Answers other than a law at a declared port: a held value, an undeclared port, a machine that changed."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from cart import cart
from diagnosis_example import recorded as example_recorded, rig as mass
from diagnosis_rig import OFF, recordings, rig

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Recording, Simulator, laws
from pilfr_casadi._base import Stages
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.fits.floor import Floor
from pilfr_casadi.diagnose.other_explanations import (
    find_pinned_parameters,
    find_undeclared_port,
    find_untried_laws,
    find_varying_values,
)
from pilfr_casadi.diagnose.posterior import LikelyEffect, Posterior
from pilfr_casadi.diagnose.search.moves import Search
from pilfr_casadi.engine import make_engine
from pilfr_casadi.report.diagnosis_tables import headline
from pilfr_casadi.simulators import Placed, discretise

# on the smallest rigs that have them


def short(*hidden, **options):
    (r,) = recordings(*hidden, count=1, **options)
    return r.slice(0, 1200)


@pytest.mark.parametrize(
    "known",
    [
        pytest.param({"fixed": True}, id="fixed"),
        pytest.param({"value": 1.0, "bounds": (0.3, 5.0)}, id="far", marks=pytest.mark.slow),
    ],
)
def test_a_value_that_cannot_go_where_it_should_is_told(known):
    simulator = mass(430.0, 5.0)  # the slow suite asks the same of two masses
    p = simulator.parameters
    held = simulator.with_parameters({**p, "k": replace(p["k"], **known)})
    measured = example_recorded(mass(), 0, samples=400)
    found = pilfr.diagnose(held, measured, laws=(laws.LinearStiffness,), effects=1, workers=1)
    assert (found.verdict, found.effects, found.freed) == ("complete", (), "k"), str(found)
    assert found.parameters["k"]["refit_with"] == pytest.approx(400, rel=0.03)


@pytest.mark.slow
def test_a_wrong_capacity_is_told_in_place_of_a_curve_of_the_inflow():
    tank = Simulator(
        lambda x, u, p: {"level": (u.inflow - p.a * x.level) / p.area},
        lambda x: {"level": x.level},
        states=("level",),
        inputs=("inflow",),
        parameters={"area": Parameter(1.0, fixed=True), "a": Parameter(0.8, bounds=(0.1, 5))},
    )
    rng = np.random.default_rng(5)
    r = Recording(np.repeat(rng.uniform(0, 2, 40), 15), np.zeros(600), 0.05, ("inflow",), ("level",), hold="zero")
    wide = tank.with_parameters({**tank.parameters, "area": Parameter(1.3, fixed=True)})
    r = r.with_(y=wide.simulate(r) + 0.01 * rng.standard_normal((600, 1)))
    found = pilfr.diagnose(tank, r, laws=(laws.PowerWithGain, laws.Cubic), effects=1, workers=1)
    assert (found.verdict, found.effects, found.freed) == ("complete", (), "area"), str(found)
    assert found.parameters["area"]["refit_with"] == pytest.approx(1.3, rel=0.02)


@pytest.mark.slow
def test_two_wrong_values_are_told_in_place_of_a_gain_of_the_torque_and_a_curve_of_the_angle():
    arm = Simulator(
        lambda x, u, p: {"angle": x.speed, "speed": (u.torque - p.d * x.speed - p.weight * ca.sin(x.angle)) / p.J},
        lambda x: {"angle": x.angle},
        states=("angle", "speed"),
        inputs=("torque",),
        parameters={
            "J": Parameter(0.024, fixed=True),
            "weight": Parameter(1.0, fixed=True),
            "d": Parameter(0.03, bounds=(0, 1)),
        },
    )
    rng = np.random.default_rng(5)
    torque = 0.4 * np.repeat(rng.standard_normal(40), 10)
    r = Recording(torque, np.zeros(400), 0.01, ("torque",), ("angle",), hold="zero", initial="zero")
    true = {"J": Parameter(0.021), "weight": Parameter(0.9), "d": Parameter(0.035)}
    y = arm.with_parameters(true).simulate(r)
    r = r.with_(y=y + 0.003 * np.std(y) * rng.standard_normal(y.shape))
    found = pilfr.diagnose(arm, r, laws=(laws.PowerWithGain, laws.CubicStiffness), effects=2, workers=1)
    assert (found.verdict, found.effects, found.freed) == ("complete", (), "J and weight"), str(found)
    assert found.parameters["J"]["refit_with"] == pytest.approx(0.021, rel=0.02)
    assert "with J and weight let go" in headline(found).replace("\u00a0", " ")


def test_no_value_is_told_in_place_of_a_law_that_explains_nothing():
    right = machine()
    held = right.with_parameters({**right.parameters, "k": Parameter(20.0, fixed=True)})
    search = searched(held, recorded(20.0, 0)[0])
    named = LikelyEffect(Placed("equation:vel", laws.CubicStiffness(), "equation:vel."), 0.9, {}, 0.9)
    assert find_pinned_parameters(search, Posterior(search.root, 1.0, (named,), 0.0)) is None


@pytest.mark.slow
def test_friction_where_no_port_is_declared_is_told_where_it_acts():
    friction = laws.CoulombFriction(values={"F_c": 10.0, "v_0": 0.01})
    full = rig(OFF)
    hidden = short(friction, port="ground-m1")
    found = pilfr.diagnose(
        replace(full, ports=full.ports[1:]), hidden, laws=(laws.CoulombFriction,), effects=1, workers=1
    )
    assert found.verdict == "unexplained"
    assert "hardly at a declared port: coulomb friction in the equation of v1 explains it" in found.sentence
    (note,) = [g for g in found.gates if g.finding == "undeclared"]
    assert (note.channel, note.value, note.corrected) == ("v1", "coulomb friction", False)


# values that are held where a linear law would let them go


@pytest.mark.slow
@pytest.mark.parametrize(("held", "words"), [({"fixed": True}, "held at"), ({"bounds": (1200, 9000)}, "by its bounds")])
def test_a_value_that_is_held_is_told_in_place_of_a_spring(held, words):
    simulator = rig(OFF)
    p = simulator.parameters
    found = pilfr.diagnose(simulator.with_parameters({**p, "k1": replace(p["k1"], **held)}), recordings())
    assert (found.verdict, found.effects) == ("complete", ())
    assert "with k1 = 1" in found.sentence and words in found.sentence
    assert found.freed == "k1" and "% with k1 let go" in headline(found).replace("\u00a0", " ")
    assert found.parameters["k1"]["refit_with"] == pytest.approx(1100, rel=0.02)
    assert found.errors["train"]["after"] < 0.01 < found.errors["train"]["before"]


@pytest.mark.slow
def test_a_value_whose_bounds_are_powers_of_ten_away_is_told_and_no_law_is_named_for_it():
    """As a stiffness in N/mm where the equations take N/m: what is seen cancels the simulator's own outputs."""
    simulator = rig(OFF)
    p = simulator.parameters
    far = replace(p["k1"], value=1.0, bounds=(0.3, 5.0))
    found = pilfr.diagnose(simulator.with_parameters({**p, "k1": far}), recordings())
    assert (found.verdict, found.effects, found.freed) == ("complete", (), "k1"), str(found)
    assert "by its bounds at 5" in found.sentence
    assert found.parameters["k1"]["refit_with"] == pytest.approx(1100, rel=0.02)


# physics that acts where no port is declared


@pytest.mark.slow
def test_a_law_that_no_declared_port_reaches_is_told_where_it_acts():
    friction = laws.CoulombFriction(values={"F_c": 10.0, "v_0": 0.01})
    full = rig(OFF)
    found = pilfr.diagnose(replace(full, ports=full.ports[1:]), recordings(friction, port="ground-m1", count=1))
    assert found.verdict == "unexplained"
    (note,) = [g for g in found.gates if g.finding == "undeclared"]
    assert (note.channel, note.value, note.corrected) == ("v1", "coulomb friction", False)
    assert "No declared port reaches it" in str(found)


# a machine that changed, between recordings or in the time of one


DT, M = 0.05, 1200


def machine():
    """A cart without a port."""
    return cart(k=22.0, d=0.9, k_bounds=(5, 100), ports=())


def recorded(k, seed, state=(0.0, 0.0), initial="zero"):
    """A recording with a spring of stiffness k."""
    rng, model = np.random.default_rng(seed), discretise(machine(), DT)
    u = pilfr.multisine(M, f_max=2.0, fs=1 / DT, rng=rng)
    r = Recording(u, np.zeros(M), DT, ("force",), ("pos",), initial=initial, hold="zero", name=f"run{seed}")
    theta = model.parameters.pack({"k": k, "d": 0.8})
    y, after = make_engine(model).simulate(model.drive(r), theta, np.array(state))
    return r.with_(y=y + 1e-3 * rng.standard_normal(y.shape)), after


def searched(simulator, *recordings, tried=(), effects=0):
    """A search for so many effects."""
    bench = Workbench.of(simulator, recordings, "zero")
    floor = Floor(np.full(1, 1e-3), "estimated")
    return Search(bench, bench.fit(bench.simulator), floor, tried, 1, Stages(lambda *_: None)).run(effects)


def told(*recordings):
    """What is said of them where nothing else is found."""
    return find_varying_values(searched(machine(), *recordings))


def test_recordings_that_disagree_are_told_with_the_value_that_differs():
    (gate,) = told(recorded(20.0, 0)[0], recorded(26.0, 1)[0])
    assert gate.finding == "varying" and gate.channel == "k" and "the recordings (run0 / run1)" in gate.sentence
    assert gate.value == [pytest.approx([20.0, 26.0], rel=0.02)]


def test_a_value_that_changes_within_a_recording_is_told_by_its_halves():
    first, after = recorded(20.0, 0)
    second, _ = recorded(26.0, 1, after)
    whole = first.with_(u=np.vstack([first.u, second.u]), y=np.vstack([first.y, second.y]))
    (gate,) = told(whole)
    assert gate.channel == "k" and "the halves (first / second)" in gate.sentence
    assert gate.value == [pytest.approx([20.0, 26.0], rel=0.02)]


def test_recordings_that_agree_are_not():
    assert told(recorded(20.0, 0)[0], recorded(20.0, 1)[0]) == ()


@pytest.mark.parametrize(("tried", "names"), [(laws.Radiation, ["equation:vel"]), (laws.Cubic, [])])
def test_laws_that_need_a_known_domain_are_told_where_it_is_unknown(tried, names):
    found = find_untried_laws(searched(machine(), recorded(20.0, 0)[0], tried=(tried,)))
    assert [gate.channel for gate in found] == names
    assert all("thermal alone were not tried" in gate.sentence for gate in found)


def test_a_law_in_an_equation_without_a_port_is_told_there():
    blank, _ = recorded(20.0, 0)
    rubbing = machine().with_element("equation:vel", laws.CoulombFriction().at({"F_c": 0.2, "v_0": 0.02}))
    y = rubbing.simulate(blank) + 1e-3 * np.random.default_rng(1).standard_normal(blank.y.shape)
    driven = replace(machine(), ports=(pilfr.Port("drive", {"vel": 1.0}, lambda u: u.force),))
    search = searched(driven, blank.with_(y=y), tried=(laws.CoulombFriction,))
    (note,), odds = find_undeclared_port(search)
    assert (note.channel, note.finding, note.value) == ("vel", "undeclared", "coulomb friction") and odds > 1
    assert note.sentence.startswith("No declared port reaches it: in the equation of vel, ") and not note.corrected


def test_laws_of_another_search_that_no_step_screens_are_exchanged():
    blank, _ = recorded(20.0, 0)
    least = 0.5 * np.max(blank.u)
    late = np.roll(machine().simulate(blank.with_(u=np.clip(blank.u, -least, least))), 4, axis=0)
    late[:4] = 0.0
    y = late + 1e-3 * np.random.default_rng(1).standard_normal(late.shape)
    driven = replace(machine(), ports=(pilfr.Port("drive", {"vel": 1.0}, lambda u: u.force),))
    found = searched(driven, blank.with_(y=y), tried=(laws.Saturation, laws.Delay), effects=2)
    assert {e.port for e in found.best.laws} == {"actuator:force", "sensor:pos"}
    rubs = Search(found.bench, found.without, found.floor, (laws.CoulombFriction,), 1, found.say)
    rubs.memo |= found.memo
    rubs.exchange()
    assert rubs.best.key == found.best.key


def positioner():
    """A valve's stem on a spring behind a pneumatic chamber, which has the only declared port."""
    return Simulator(
        lambda x, u, p: {
            "pressure": (u.command - x.pressure) / p.tau,
            "stem": x.speed,
            "speed": (2000 * x.pressure - p.k * x.stem - p.d * x.speed) / 20,
        },
        lambda x: {"stem": x.stem},
        states=("pressure", "stem", "speed"),
        inputs=("command",),
        parameters={
            "tau": Parameter(0.3, bounds=(0.02, 2)),
            "k": Parameter(1.1e4, bounds=(3e3, 3e4)),
            "d": Parameter(600.0, bounds=(0, 5e3)),
        },
        ports=(pilfr.Port("chamber", lambda p: {"pressure": -1 / p.tau}, lambda x: x.pressure),),
        hold="zero",
    )


@pytest.mark.slow
def test_a_law_at_the_sensor_is_weighed_against_friction_where_no_port_is_declared():
    assert positioner().unreached == {"speed"}
    assert [port.name for port in positioner().undeclared] == ["equation:speed"]
    rubbing = replace(positioner(), ports=()).with_parameters({"tau": 0.25, "k": 1e4})
    rubbing = rubbing.with_element("equation:speed", laws.PreslidingFriction().at({"k_t": 2e4, "r": 3.75e-4}))
    rng = np.random.default_rng(2)
    command = np.repeat(rng.uniform(0, 1, 16), 50)
    r = Recording(command, np.zeros(800), 0.02, ("command",), ("stem",), initial="zero", hold="zero")
    y = rubbing.simulate(r)
    r = r.with_(y=y + 0.005 * np.std(y) * rng.standard_normal(y.shape))
    found = pilfr.diagnose(positioner(), r, laws=(laws.PlayHysteresis, laws.PreslidingFriction), effects=1, workers=1)
    (note,) = [g for g in found.gates if g.finding == "undeclared"]
    assert (note.channel, note.value, note.corrected) == ("speed", "coulomb friction", False), str(found)
    assert found.verdict == "unexplained"
    assert "hardly at a declared port: coulomb friction in the equation of speed explains it" in found.sentence
    assert found.errors["train"]["after"] < found.errors["train"]["before"]
