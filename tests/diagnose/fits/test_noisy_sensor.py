"""A noisy sensor beside a quiet one: fits and comparisons rest on what the quiet one shows."""

import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Recording, Simulator, multisine
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.faults.gates import Checked
from pilfr_casadi.diagnose.fits.evidence import standard_errors
from pilfr_casadi.diagnose.fits.flexible_forces import innovation_share
from pilfr_casadi.diagnose.fits.workbench import THOROUGH
from pilfr_casadi.laws import CoulombFriction

DT, SAMPLES = 5e-3, 2000
QUIET, NOISY = 1e-4, 3e-2  # noise over the deviations of position and speed
FRICTION = {"F_c": 0.1, "v_0": 5e-3}  # 0.3 % of the drive


def mass(k=1100.0, d=12.0, outputs=("position", "speed"), metre=1.0):
    ways = {"position": ("pos", metre), "speed": ("vel", 1.0)}
    return Simulator(
        lambda x, u, p: {"pos": x.vel, "vel": (u.force - p.k * x.pos - p.d * x.vel) / 2.0},
        lambda x: {name: ways[name][1] * getattr(x, ways[name][0]) for name in outputs},
        states=("pos", "vel"),
        inputs=("force",),
        parameters={"k": Parameter(k, bounds=(300, 4000)), "d": Parameter(d, bounds=(1, 100))},
        ports=(Port("ground", lambda p: {"vel": -0.5}, lambda x: x.pos, lambda x: x.vel, "N", "m"),),
    )


@pytest.fixture(scope="module")
def recorded():
    """Record the mass with or without friction, with both sensors or the position alone."""
    u = 30 * multisine(SAMPLES, f_max=8.0, fs=1 / DT, rng=np.random.default_rng(1))

    def record(friction=False, outputs=("position", "speed")):
        true = mass(outputs=outputs)
        true = true.with_element("ground", CoulombFriction(FRICTION)) if friction else true
        r = Recording(u, np.zeros((SAMPLES, len(outputs))), DT, ("force",), outputs, initial="zero", hold="zero")
        y = true.simulate(r)
        noise = np.array([QUIET, NOISY])[: len(outputs)] * np.std(y, axis=0)
        return r.with_(y=y + noise * np.random.default_rng(2).standard_normal(y.shape))

    return record


def checked(simulator, recording):
    bench = Workbench.of(simulator, [recording], "zero", "vm")
    return Checked(bench, bench.fit(simulator, solver=THOROUGH)).weighted()


def test_a_fit_is_as_exact_as_with_the_quiet_sensor_alone(recorded):
    both = checked(mass(1000.0, 10.0), recorded())
    alone = checked(mass(1000.0, 10.0, ("position",)), recorded(outputs=("position",)))
    errors = [float(standard_errors(found.bench, found.fitted)["k"]) for found in (both, alone)]
    assert errors[0] == pytest.approx(errors[1], rel=0.3)
    assert abs(both.fitted.values["k"] - 1100) < 4 * errors[1]
    assert np.sqrt(both.fitted.squares) == pytest.approx([QUIET, NOISY], rel=0.1)
    assert 0.3 < both.fitted.balance[1] / both.fitted.balance[0] / (NOISY / QUIET) ** 2 < 1.1


def test_units_do_not_change_a_weighted_fit(recorded):
    given = recorded()
    one = checked(mass(1000.0, 10.0), given)
    other = checked(mass(1000.0, 10.0, metre=1e3), given.with_(y=given.y * np.array([1e3, 1.0])))
    assert other.fitted.values["k"] == pytest.approx(float(one.fitted.values["k"]), rel=1e-6)


def test_a_fit_from_a_poor_start_weighs_the_outputs_anew(recorded):
    """At the start the outputs are about equally wrong; at the end each leaves its noise."""
    found = checked(mass(1000.0, 10.0), recorded())
    fitted = found.bench.fit(mass(), [{"k": 2500.0, "d": 60.0}], solver=THOROUGH)
    assert np.sqrt(fitted.squares) == pytest.approx([QUIET, NOISY], rel=0.1)


@pytest.mark.parametrize("friction", [True, False])
def test_a_noisy_sensor_does_not_hide_whether_a_force_explains_the_innovations(recorded, friction):
    """These tell slow noise from missing physics."""
    shares = []
    for outputs in (("position", "speed"), ("position",)):
        found = checked(mass(1000.0, 10.0, outputs), recorded(friction, outputs))
        shares.append(innovation_share(found.bench, found.fitted))
    assert shares[0] == pytest.approx(shares[1], abs=0.05) and (shares[0] > 0.5) == friction


def test_a_small_effect_in_the_quiet_sensor_is_named(recorded):
    given = recorded(friction=True).slice(0, 1000)
    found = pilfr.diagnose(mass(1000.0, 10.0), given, laws=[CoulombFriction], effects=1, engine="vm", workers=1)
    assert [(e.port, e.law) for e in found.effects] == [("ground", "coulomb_friction")]
    assert found.effects[0].confidence > 0.9
    assert found.effects[0].parameters["F_c"]["value"] == pytest.approx(0.1, rel=0.05)


def test_nothing_is_missing_beside_the_noise(recorded):
    found = pilfr.diagnose(mass(1000.0, 10.0), recorded(), laws=[CoulombFriction], engine="vm")
    assert found.verdict == "complete" and not found.effects
