"""Friction that turns round at once, and offsets that it had looked like."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis_rig import DT
from simulated import outputs_of

import pilfr_casadi as pilfr
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.fits.step_refinement import refine_steps
from pilfr_casadi.diagnose.fits.workbench import FINER_STEPS, THOROUGH
from pilfr_casadi.laws import CoulombFriction, Delay, Polynomial
from pilfr_casadi.simulators import Simulator

F_C = 6.0


def carriage(friction=None, mass=1.5, drag=6.0, **more):
    """A carriage on a guide, by itself or with friction(velocity, parameters) in its equations."""

    def dynamics(x, u, p):
        return dict(pos=x.vel, vel=(u.force - p.d * x.vel - (friction(x.vel, p) if friction else 0)) / p.m)

    return Simulator(
        dynamics,
        lambda x: dict(position=x.pos),
        ("pos", "vel"),
        ("force",),
        dict(
            m=pilfr.Parameter(mass, unit="kg", bounds=(0.3, 6)),
            d=pilfr.Parameter(drag, unit="N s/m", bounds=(0, 60)),
            **more,
        ),
        (pilfr.Port("guide", lambda p: dict(vel=-1 / p.m), lambda x: x.pos, lambda x: x.vel, "N", "m"),),
    )


def ran(seed, v_0):
    """A record of the carriage whose friction turns round within v_0, m/s; 40 steps a sample, from rest."""
    import casadi as ca

    rng, m = np.random.default_rng(seed), 1500
    force = 25 * pilfr.multisine(m, f_max=15.0, fs=1 / DT, rng=rng)
    blank = pilfr.Recording(force, force, DT, ("force",), ("position",), initial="zero", hold="zero")
    y = outputs_of(carriage(lambda v, p: F_C * ca.tanh(v / v_0)), blank, substeps=40)
    return blank.with_(y=y + 5e-4 * np.std(y) * rng.standard_normal(y.shape))


@pytest.mark.slow
@pytest.mark.parametrize("v_0", [5e-4, 1e-4])
def test_friction_that_turns_round_at_once_is_named_as_what_it_is(v_0):
    train, test = ran(0, v_0), ran(1, v_0)
    found = pilfr.diagnose(carriage(mass=1.7, drag=5.0), train, test=test)
    (effect,) = found.effects
    assert (effect.port, effect.law, effect.form) == ("guide", "coulomb_friction", "smooth"), str(found)
    assert effect.confidence > 0.9
    assert effect.parameters["F_c"]["value"] == pytest.approx(F_C, rel=2e-3)
    assert found.errors["test"]["after"] < 2 * found.floor["nrmse"]
    assert effect.parameters["v_0"]["value"] < 3 * v_0  # as sharp as the steps can follow
    assert not [g for g in found.gates if g.finding == "offset"]


def sharp(friction=F_C, **own):
    """The carriage with dry friction that turns round at once in its own equations."""
    import casadi as ca

    free = pilfr.Parameter(friction, unit="N", bounds=(0, 40))
    return carriage(lambda v, p: p.F * ca.sign(v), F=free, **own)


def test_friction_that_is_in_the_simulator_already_gets_the_steps_that_it_asks_for():
    found = pilfr.diagnose(sharp(5.0, mass=1.7, drag=5.0), ran(0, 1e-4), test=ran(1, 1e-4), laws=(CoulombFriction,))
    assert (found.verdict, found.effects) == ("complete", ()), str(found)
    assert found.substeps >= FINER_STEPS
    assert found.errors["test"]["after"] < 2 * found.floor["nrmse"]
    assert found.corrected.parameters["F"].value == pytest.approx(F_C, rel=2e-3)


def bent(r):
    """A record by a sensor that is not straight."""
    return r.with_(y=r.y + 1.3 * r.y**3)


def test_finer_steps_only_where_the_run_depends_on_them_whatever_else_is_missing():
    plain = Workbench.of(carriage(), [ran(0, 1e-4)], "zero")
    fitted = plain.fit(carriage())
    assert refine_steps(plain, fitted) == (plain, fitted)  # far off, but not for its steps
    for records in (plain.recordings, [bent(r) for r in plain.recordings]):
        bench = Workbench.of(sharp(), records, "zero")
        coarse = bench.fit(sharp(), solver=THOROUGH)
        finer, found = refine_steps(bench, coarse)
        assert finer.substeps == found.model.substeps >= FINER_STEPS * bench.substeps
        law = CoulombFriction(values={"F_c": F_C, "v_0": 1e-6})  # counted from the steps that were chosen first
        assert finer.model(sharp().with_element("guide", law)).substeps == finer.substeps


@pytest.mark.slow
def test_what_is_missing_beside_friction_that_turns_round_is_named():
    def late(r, samples):
        return r.with_(y=np.vstack([np.zeros((samples, 1)), r.y[:-samples]]))

    found = pilfr.diagnose(sharp(5.0, mass=1.7, drag=5.0), late(ran(0, 1e-4), 8), laws=(CoulombFriction, Delay))
    assert found.verdict == "recording-fault", str(found)
    assert [(g.channel, g.finding) for g in found.gates] == [("position", "alignment")]
    records = [bent(ran(seed, 1e-4)) for seed in (0, 1)]
    laws = (CoulombFriction, Polynomial)
    found = pilfr.diagnose(sharp(5.0, mass=1.7, drag=5.0), records[0], test=records[1], laws=laws)
    assert [(e.port, e.law) for e in found.effects] == [("sensor:position", "static_curve")], str(found)
    assert found.errors["test"]["after"] < 2 * found.floor["nrmse"]


@pytest.mark.slow
def test_what_takes_the_place_of_the_simulators_own_is_told():
    found = pilfr.diagnose(carriage(mass=1.7, drag=5.0), ran(0, 1e-3), laws=(CoulombFriction,))
    assert found.sentence == "The simulator leaves out Coulomb friction at guide."
    damped = carriage(lambda v, p: 6.2 * v + p.c * v, mass=1.7, c=pilfr.Parameter(2.0, unit="N s/m", bounds=(0, 9)))
    held = {**damped.parameters, "d": replace(damped.parameters["d"], value=0.0, fixed=True)}
    found = pilfr.diagnose(damped.with_parameters(held), ran(0, 1e-3), laws=(CoulombFriction,))
    assert found.sentence.endswith(" The simulator's own c comes out as zero: it is replaced."), str(found)


def test_a_sharp_knee_gets_finer_steps_whatever_its_sharpness():
    record = ran(0, 1e-3).slice(0, 300)
    bench = Workbench.of(carriage(), [record], "zero")
    for v_0 in (1e-2, 1e-3, 1e-4, 1e-6):
        law = CoulombFriction(values={"F_c": F_C, "v_0": v_0})
        counts = bench.model(bench.simulator.with_element("guide", law)).substeps
        assert counts == FINER_STEPS * bench.substeps or v_0 > 1e-3
