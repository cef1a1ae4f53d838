"""Forces of an angle: unbalance, and gravity on an arm whose equations have it for small angles alone or not at all."""

from dataclasses import replace
from functools import partial

import casadi as ca
import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Recording, Simulator, laws

DT, NOISE = 0.01, 2e-3
TONES = ((0.8, 0.13), (0.35, 0.37), (0.25, 0.8), (0.2, 1.3))  # N m, Hz
TRIED = (laws.LinearStiffness, laws.CubicStiffness, laws.QuinticStiffness, laws.PeriodicForce, laws.Gravity)


def arm(gravity, unit="rad"):
    return Simulator(
        lambda x, u, p: {"angle": x.speed, "speed": (u.torque - gravity(x, p) - p.d * x.speed) / p.J},
        lambda x: {"encoder": x.angle},
        states=("angle", "speed"),
        inputs=("torque",),
        parameters={
            "J": Parameter(0.06, bounds=(0.01, 0.3)),
            "d": Parameter(0.05, bounds=(0, 1)),
            "G": Parameter(1.2, bounds=(0, 5)),
        },
        ports=Port(
            "joint",
            lambda p: {"speed": -1 / p.J},
            lambda x: x.angle,
            lambda x: x.speed,
            unit="N m" if unit else "",
            across_unit=unit,
        ),
    )


def recorded(hang, seed):
    """The motion of an arm that hangs at the angle -`hang`, by Runge-Kutta steps of its own."""
    rng, t = np.random.default_rng(seed), DT * np.arange(1500)
    torque = sum(a * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for a, f in TONES)

    def slope(u, x):
        return np.array([x[1], (u - 1.5 * np.sin(x[0] + hang) - 0.08 * x[1]) / 0.05])

    x, angles, h = np.zeros(2), [], DT / 8
    for u in torque:
        angles.append(x[0])
        for f in [partial(slope, u)] * 8:
            a = f(x)
            b = f(x + h / 2 * a)
            c = f(x + h / 2 * b)
            x = x + h / 6 * (a + 2 * b + 2 * c + f(x + h * c))
    y = np.array(angles) + NOISE * rng.standard_normal(len(t))
    return Recording(torque[:, None], y[:, None], DT, ("torque",), ("encoder",), initial="zero", hold="zero")


@pytest.mark.parametrize(
    ("hang", "law", "unit"),
    [
        (0.0, laws.Gravity, "rad"),
        pytest.param(0.4, laws.WholeGravity, "rad", marks=pytest.mark.slow),
        pytest.param(0.0, laws.Gravity, "", marks=pytest.mark.slow),
    ],
)
def test_gravity_is_named_where_small_angles_are_left_and_where_it_was_forgotten(hang, law, unit):
    simulator = arm((lambda x, p: p.G * x.angle) if not hang else (lambda x, p: 0 * p.G), unit)
    train, test = ([recorded(hang, seed) for seed in seeds] for seeds in ((1,), (3,)))
    found = pilfr.diagnose(simulator, train, test=test, laws=[*TRIED, law], effects=1, workers=1)
    (effect,) = found.effects
    assert (effect.law, effect.form) == ("gravity", law.form) and effect.confidence > 0.9
    size = np.hypot(effect.parameters["a"]["value"], effect.parameters.get("b", {"value": 0.0})["value"])
    assert size == pytest.approx(1.5, rel=0.01)
    assert found.errors["test"]["after"] < 0.02 * found.errors["test"]["before"]


@pytest.mark.slow
def test_cogging_is_no_gravity():
    """Of a pitch far below a revolution; gravity itself is in the equations."""
    simulator = arm(lambda x, p: p.G * ca.sin(x.angle))
    cogging = simulator.with_parameters({"J": 0.05, "d": 0.08, "G": 1.5}).with_element(
        "joint", laws.PeriodicForce(values={"a": 0.15, "b": 0.0, "L": 0.5})
    )
    train = []
    for seed in (1, 2):
        r = recorded(0.0, seed).with_(initial="zero")
        y = cogging.simulate(r) + NOISE * np.random.default_rng(seed).standard_normal((len(r), 1))
        train.append(r.with_(y=y))
    found = pilfr.diagnose(simulator, train, laws=[*TRIED, laws.WholeGravity], workers=1)
    assert [e.law for e in found.effects] == ["periodic_force"]
    assert found.effects[0].parameters["L"]["value"] == pytest.approx(0.5, rel=0.01)


@pytest.mark.slow
def test_unbalance_of_a_rotor_is_told_from_a_force_that_only_repeats():
    """The rotor runs up; its centrifugal force shakes the bearing and grows with the square of its speed."""

    def run_up(x, u, p):
        return {"turn": x.speed, "speed": (u.torque - 2e-4 * x.speed) / p.inertia, "y": x.v, "v": -p.k * x.y - 5 * x.v}

    parameters = {"inertia": Parameter(6e-4, bounds=(1e-4, 3e-3)), "k": Parameter(2.5e4, bounds=(5e3, 1e5))}
    bearing = Port("bearing", {"v": -1.0}, lambda x: x.turn, lambda x: x.speed, "N", "rad")
    true = Simulator(
        run_up,
        lambda x: {"speed": x.speed, "y": 1e3 * x.y},
        states=("turn", "speed", "y", "v"),
        inputs=("torque",),
        parameters=parameters,
        ports=bearing,
    )
    rng = np.random.default_rng(4)
    torque = np.interp(np.arange(1500), [0, 900, 1500], [0.01, 0.12, 0.02])[:, None]
    blank = Recording(torque, np.zeros((1500, 2)), 2e-3, "torque", ("speed", "y"), initial="zero", hold="zero")
    y = true.with_element("bearing", laws.Unbalance().at({"a": 0.0, "b": -5e-4, "L": 2 * np.pi})).simulate(blank)
    train = blank.with_(y=y + 5e-3 * np.std(y, axis=0) * rng.standard_normal(y.shape))
    given = true.with_parameters({**parameters, "inertia": replace(parameters["inertia"], value=7e-4)})
    tried = (laws.PeriodicForce, laws.HarmonicForce, laws.WholeGravity, laws.Unbalance)
    (effect,) = pilfr.diagnose(given, train, laws=tried, workers=1).effects
    assert (effect.law, effect.form) == ("periodic_force", "unbalance") and effect.confidence > 0.9
    assert effect.parameters["b"]["value"] == pytest.approx(-5e-4, rel=0.02)
