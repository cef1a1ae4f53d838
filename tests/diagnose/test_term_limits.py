"""A limit of what the equations have already: the torque of a drive with limited current, a force with limited grip."""

from dataclasses import replace

import numpy as np
import pytest

from pilfr_casadi import Parameter, Port, Recording, Simulator, diagnose
from pilfr_casadi.diagnose.search.pairs import complements
from pilfr_casadi.laws import (
    CATALOGUE,
    CoulombFriction,
    ElasticDrive,
    Law,
    LimitedTerm,
    Local,
    QuadraticDrag,
    SoftlyLimitedTerm,
    TermLimit,
)

DT, LAG, GAIN, DRAG = 0.01, 0.1, 10.0, 0.05
LOW, HIGH = -2.0, 5.0  # of the torque over the drive's damping: it brakes less than it accelerates
NOISE = 0.01


def drive(**more):
    """A motor as a lag of first order, whose torque over its damping is `gain * voltage - speed`."""
    return Simulator(
        lambda x, u, p: {"speed": (p.gain * u.voltage - x.speed) / p.lag},
        lambda x: {"speed": x.speed},
        states=("speed",),
        inputs=("voltage",),
        parameters={"gain": Parameter(GAIN, bounds=(2, 50)), "lag": Parameter(LAG, bounds=(0.01, 1))},
        **more,
    )


def recorded(seed, limited=True, samples=600):
    rng = np.random.default_rng(seed)
    u, speed, y = np.repeat(rng.uniform(0, 1, samples // 20), 20), 0.0, []
    for one in u:
        y.append(speed)
        for _ in range(20):
            torque = GAIN * one - speed
            torque = np.clip(torque, LOW, HIGH) if limited else torque
            speed += DT / 20 * (torque - DRAG * speed**2) / LAG
    y = np.array(y) + NOISE * rng.standard_normal(samples)
    return Recording(u[:, None], y[:, None], DT, inputs=("voltage",), outputs=("speed",), initial=[0.0], hold="zero")


def test_the_balance_of_a_driven_lag_is_the_term_of_its_port():
    port = drive().port("equation:speed")
    assert port.found == "balance" and port.admits(LimitedTerm) and not port.admits(ElasticDrive)
    declared = Port("rotor", lambda p: {"speed": -1 / p.lag}, lambda x: x.speed)
    assert drive(ports=(declared,)).port("rotor").found == "balance"
    # what no input drives, and a force on something else, are no term
    coasting = Simulator(lambda x: {"speed": -x.speed}, lambda x: {"y": x.speed}, states=("speed",))
    assert not coasting.port("equation:speed").found
    elsewhere = replace(declared, across=lambda x: 2 * x.speed)
    assert not drive(ports=(elsewhere,)).port("rotor").found


@pytest.mark.parametrize("into", [lambda u: {"speed": -u.voltage}, lambda x, p: {"speed": -x.speed / p.lag}])
def test_a_balance_is_not_divided_by_a_factor_that_may_pass_through_zero(into):
    declared = Port("rotor", into, lambda x: x.speed)
    assert not drive(ports=(declared,)).port("rotor").found


@pytest.mark.parametrize("law", [LimitedTerm, SoftlyLimitedTerm])
def test_a_term_over_a_parameter_that_is_zero_has_no_limits(law):
    z = np.sin(np.arange(50.0))
    for term in (lambda z, dz: z / 0.0, lambda z, dz: np.where(z > 0, z, np.inf)):
        with np.errstate(all="ignore"):
            assert law().why_not(Local(z, np.gradient(z), 0.1, (50,), term=term)) == "the term is not finite"
    assert not law().why_not(Local(z, np.gradient(z), 0.1, (50,), term=lambda z, dz: 2 * z))


def test_a_limited_balance_follows_a_drive_with_limited_torque():
    limited = LimitedTerm({"low": -HIGH / LAG, "high": -LOW / LAG})  # w is subtracted from the derivative
    drag = QuadraticDrag({"c_2": DRAG / LAG})
    law = drive().with_element("equation:speed", limited).with_element("equation:speed", drag)
    assert law.nrmse(recorded(1)) < 2 * NOISE
    assert drive().with_element("equation:speed", drag).nrmse(recorded(1)) > 8 * NOISE


def test_a_law_with_the_old_spelling_of_its_implied_term_stands_at_a_drive():
    class Slack(Law):
        id, units, in_line, driven = "slack", {"g": "w"}, True, True

    axis = Simulator(lambda x, u: {"x": x.v, "v": u.f}, lambda x: {"x": x.x}, states=("x", "v"), inputs=("f",))
    assert axis.port("equation:v").admits(Slack) and axis.port("equation:v").found == "drive"


def test_a_limit_stands_beside_any_other_law_of_its_port():
    assert issubclass(LimitedTerm, TermLimit) and {LimitedTerm, SoftlyLimitedTerm} < set(CATALOGUE)
    assert complements(LimitedTerm(), QuadraticDrag()) and complements(CoulombFriction(), SoftlyLimitedTerm())
    assert not complements(LimitedTerm(), SoftlyLimitedTerm())


@pytest.mark.slow
def test_the_limited_torque_of_a_drive_is_named_beside_its_drag():
    found = diagnose(drive(), [recorded(1), recorded(2)], test=recorded(3))
    assert ("equation:speed", "saturation") in {(e.port, e.law) for e in found.effects}
    assert found.errors["test"]["after"] < 0.25 * found.errors["test"]["before"]


@pytest.mark.slow
def test_no_limit_is_named_where_the_torque_has_none():
    found = diagnose(drive(), [recorded(1, False), recorded(2, False)], test=recorded(3, False))
    assert found.effects and all(e.law != "saturation" for e in found.effects)  # the drag, or a curve of the speed


@pytest.mark.parametrize("kind", [LimitedTerm, SoftlyLimitedTerm])
def test_a_term_that_hardly_acts_has_no_limit(kind):
    z = np.linspace(-1.0, 1.0, 500)
    local = Local(z, np.ones(500), DT, (500,))
    acting = replace(local, term=lambda z, dz: 3 * z)
    assert kind().why_not(acting) == ""
    for term in (lambda z, dz: 2 + 0 * z, lambda z, dz: 0 * z, lambda z, dz: (np.arange(500) < 2) * 5.0):
        assert "constant, or zero nearly always" in kind().why_not(replace(local, term=term))
