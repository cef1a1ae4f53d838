"""Physics lost on one side or in one direction: friction that depends on it, a tank that spills; and the verdict."""

import casadi as ca
import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Recording, Simulator
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.fits.linearise import Probe, locals_of, run
from pilfr_casadi.diagnose.fits.screen import _gain
from pilfr_casadi.laws import (
    BoucWen,
    CubicStiffness,
    DirectionalFriction,
    HertzContact,
    Local,
    PiecewiseStiffness,
    QuinticStiffness,
    Relaxation,
    ViscousDamping,
)
from pilfr_casadi.optimise import GaussNewton

SHARE = 0.6


def tanks():
    """Two tanks, one above the other; what else leaves the upper one falls partly into the lower."""

    def dynamics(x, u, p):
        through = p.k_1 * ca.sqrt(ca.fmax(x.upper, 1e-3))
        return {"upper": 0.05 * u.pump - through, "lower": through - p.k_3 * ca.sqrt(ca.fmax(x.lower, 1e-3))}

    return Simulator(
        dynamics,
        lambda x: {"level": x.lower},
        states=("upper", "lower"),
        inputs=("pump",),
        parameters={
            "k_1": Parameter(0.06, bounds=(1e-3, 1.0)),
            "k_3": Parameter(0.07, bounds=(1e-3, 1.0)),
            "share": Parameter(0.3, bounds=(0.0, 1.0)),
        },
        ports=(
            Port("upper", lambda p: {"upper": -1.0, "lower": p.share}, lambda x: x.upper),
            Port("lower", {"lower": -1.0}, lambda x: x.lower),
        ),
        hold="zero",
    )


def spilling(seed, m=900, dt=4.0):
    """The same by Euler's rule, spilling above a level of 8."""
    rng = np.random.default_rng(seed)
    u = np.clip(np.repeat(rng.uniform(1.0, 5.5, m // 25), 25), 0, None)
    upper, lower, y = 3.0, 3.0, []
    for value in u:
        y.append(lower)
        for _ in range(80):
            through, spill = 0.05 * np.sqrt(max(upper, 0)), 0.2 * max(upper - 8, 0)
            upper, lower = (
                upper + dt / 80 * (0.05 * value - through - spill),
                lower + dt / 80 * (through + SHARE * spill - 0.055 * np.sqrt(max(lower, 0))),
            )
    y = np.array(y) + 0.01 * rng.standard_normal(m)
    return Recording(u, y, dt, ("pump",), ("level",), initial="estimate")


@pytest.mark.slow
def test_a_spill_is_found_with_its_share():
    found = pilfr.diagnose(tanks(), [spilling(0)], test=spilling(1))
    assert [(e.port, e.law) for e in found.effects] == [("upper", "piecewise_stiffness")]
    assert found.parameters["share"]["refit_with"] == pytest.approx(SHARE, abs=0.03)
    assert found.effects[0].parameters["g"]["value"] == pytest.approx(8, abs=0.1)
    assert found.errors["test"]["after"] < 0.2 * found.errors["test"]["before"]


def axis():
    """A mass on a guide, with viscous friction only, that a force moves to and fro."""
    return Simulator(
        lambda x, u, p: {"pos": x.vel, "vel": (u.force - p.d * x.vel) / p.m},
        lambda x: {"position": x.pos},
        states=("pos", "vel"),
        inputs=("force",),
        parameters={"m": Parameter(1.1, bounds=(0.5, 2)), "d": Parameter(1.5, bounds=(0, 20))},
        ports=(Port("guide", lambda p: {"vel": -1 / p.m}, lambda x: x.pos, lambda x: x.vel),),
        hold="zero",
    )


def moved(seed, m=3000, dt=2e-3):
    """Friction of 0.8 + 3 v one way and 0.8 + 1 v the other, under a loose position controller, by Euler's rule."""
    rng = np.random.default_rng(seed)
    t = np.arange(m) * dt
    wanted = sum(0.4 / k * np.sin(2 * np.pi * 0.35 * k * t + rng.uniform(0, 6)) for k in (1, 2, 3, 5))
    x = v = 0.0
    u, y = [], []
    for goal in wanted:
        force = 60 * (goal - x) - 8 * v
        u.append(force)
        y.append(x)
        for _ in range(20):
            friction = 0.8 * np.tanh(v / 2e-3) + 2 * v + abs(v)
            v += dt / 20 * (force - friction)
            x += dt / 20 * v
    y = np.array(y) + 2e-5 * rng.standard_normal(m)
    return Recording(np.array(u), y, dt, ("force",), ("position",), initial="zero")


@pytest.mark.slow
def test_friction_that_depends_on_direction_needs_no_second_effect():
    found = pilfr.diagnose(axis(), [moved(0)], test=moved(1))
    assert [(e.port, e.law, e.form) for e in found.effects] == [("guide", "coulomb_friction", "directional")]
    values = {k: v["value"] for k, v in found.effects[0].parameters.items()}
    assert values["F_c"] == pytest.approx(0.8, rel=0.03)
    assert values["c_0"] == pytest.approx(1.0, rel=0.05)
    assert found.parameters["d"]["refit_with"] == pytest.approx(2.0, rel=0.05)


def test_only_dry_friction_has_to_oppose_motion():
    rng = np.random.default_rng(0)
    phi = rng.standard_normal((500, 3))
    for sign in (1, -1):
        share, found = _gain(phi, phi @ (-sign * np.array([2.0, 0.5, -3.0])), DirectionalFriction(), sign)
        np.testing.assert_allclose(found, -sign * np.array([2.0, 0.5, -3.0]), rtol=1e-6)
        assert share > 0
        wrong = _gain(phi, phi @ (sign * np.array([2.0, 0.5, -3.0])), DirectionalFriction(), sign)[1]
        assert wrong[0] == 0


def test_a_contact_is_no_harder_than_the_steps_can_follow():
    simulator, record = tanks(), spilling(0)
    bench = Workbench.of(simulator, [record], "zero")
    fitted = bench.fit(simulator)
    probe = Probe.of(bench, fitted)
    upper = locals_of(bench, [run(bench, probe, fitted, 0)])[probe.ports.index("upper")]
    assert upper.max_stiffness == pytest.approx(4 * bench.substeps / 4.0)  # 1 / finest step
    assert PiecewiseStiffness().bounds(upper)["k_c"] == (-upper.max_stiffness, upper.max_stiffness)
    low, high = HertzContact().bounds(upper)["k_c"]
    assert high * 1.5 * np.sqrt(0.2 * upper.half) == pytest.approx(upper.max_stiffness)
    assert low == -high


def test_two_odd_powers_need_both_sides():
    z = np.linspace(1.0, 3.0, 50)
    assert QuinticStiffness().why_not(Local(z, z, 0.1, (50,)))
    assert not QuinticStiffness().why_not(Local(z - 2, z, 0.1, (50,)))
    assert not CubicStiffness().why_not(Local(z, z, 0.1, (50,)))


def test_a_fit_goes_on_from_given_states():
    simulator, record = tanks(), spilling(0)
    bench = Workbench.of(simulator, [record], "zero")
    one = bench.fit(simulator)
    held = one.corrected()
    assert bench.fit(held, states=one.initial).cost <= one.cost * (1 + 1e-9)
    glance = GaussNewton(max_iterations=1)
    away = [np.array([80.0, 80.0])]
    assert bench.fit(held, states=away, solver=glance).cost > 2 * bench.fit(held, states=one.begin, solver=glance).cost


def test_a_second_heat_capacity_takes_heat_up_and_an_error_of_the_first_has_either_sign():
    """A coordinate without inertia: what has memory pushes it back, whichever way the port counts its flow."""
    for sign in (-1.0, 1.0):
        wall = Port("wall", {"T": sign}, lambda x: x.T, unit="W", across_unit="K")
        body = Simulator(lambda x, u: {"T": u.q - x.T}, lambda x: {"y": x.T}, ("T",), ("q",), ports=wall)
        q = np.repeat([1.0, 0.0, 2.0], 100)
        r = Recording(q, body.simulate(Recording(q, q, 0.02, ("q",), ("y",), initial="zero")), 0.02, ("q",), ("y",))
        bench = Workbench.of(body, [r], "zero")
        fitted = bench.fit(body)
        along = run(bench, Probe.of(bench, fitted), fitted, 0)
        at = [port.name for port in body.all_ports()].index("wall")
        assert along.sense(Relaxation(), at) == along.sense(BoucWen(), at) == -sign
        assert along.sense(ViscousDamping(), at) == 0
