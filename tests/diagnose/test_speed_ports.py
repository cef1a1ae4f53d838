"""A drive whose simulator has a speed and no angle: friction opposes the speed, and nothing depends on a position."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from pilfr_casadi import Diagnosis, Parameter, Port, Recording, Simulator, diagnose
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.search.learned import LearnedForce, LearnedForceOfSpeed, linear_starts
from pilfr_casadi.laws import CATALOGUE, Clearance, CoulombFriction, CubicDamping, PowerWithGain, StribeckFriction
from pilfr_casadi.simulators import Named

DT, J, B, K, F_C = 0.01, 2e-3, 1e-3, 0.08, 0.03  # s, kg m², N m s, N m/A, N m
TRIED = (CoulombFriction, StribeckFriction, CubicDamping, PowerWithGain)


def drive(*ports: Port, units: dict[str, str] | None = None) -> Simulator:
    """An inertia with viscous friction, driven by a current."""
    return Simulator(
        lambda x, u, p: {"w": (p.K * u.i - p.b * x.w) / J},
        lambda x: {"speed": x.w},
        states=("w",),
        inputs=("i",),
        parameters={"K": Parameter(0.1, bounds=(0.01, 1)), "b": Parameter(2e-3, bounds=(0, 0.1))},
        ports=ports,
        units=units or {},
    )


def shaft(**options: object) -> Port:
    """A torque at the shaft."""
    return Port("shaft", {"w": -1 / J}, lambda x: x.w, **{"unit": "N m", **options})  # type: ignore[arg-type]


def dry(w: float) -> float:
    """Torque of a dry friction."""
    return F_C * np.tanh(w / 0.3)


def measured(seed: int, torque: Callable[[float], float] = dry) -> Recording:
    """The drive with a torque that its simulator lacks, its speed with noise."""
    rng = np.random.default_rng(seed)
    t, fine = np.arange(700) * DT, 40
    i = sum(
        a * np.sin(2 * np.pi * f * t + s)
        for a, f, s in zip((1.0, 0.8, 0.5), (0.31, 0.83, 2.1), rng.uniform(0, 6, 3), strict=True)
    )
    w, out = 0.0, []
    for now in i:
        out.append(w)
        for _ in range(fine):
            w += DT / fine * (K * now - B * w - torque(w)) / J
    y = np.array(out)
    return Recording(i, y + 0.003 * np.std(y) * rng.standard_normal(len(y)), DT, ("i",), ("speed",))


@pytest.mark.parametrize(
    "port",
    [shaft(), shaft(across_unit="rad/s"), shaft(rate=lambda x: x.w)],
    ids=["without a unit", "with a unit", "stated"],
)
def test_a_coordinate_that_a_force_changes_at_once_is_a_speed(port: Port) -> None:
    """A law of the rate acts on it, and a law of a position cannot be told."""
    found = drive(port).port("shaft")
    assert found.is_speed
    assert found.admits(CoulombFriction)
    assert not found.admits(Clearance)


def test_units_of_a_law_at_a_speed_are_those_of_a_speed() -> None:
    """The knee of friction is a speed in rad/s, not in rad/s²."""
    simulator = drive(shaft(across_unit="rad/s")).with_element("shaft", CoulombFriction())
    assert simulator.readable_parameters()["shaft.v_0"].unit == "rad/s"


def test_a_unit_may_say_that_the_coordinate_is_no_speed() -> None:
    """Without inertia a force moves a position at once; a temperature is none either."""
    spring = Simulator(
        lambda x, u: {"pos": u.f - x.pos},
        lambda x: {"pos": x.pos},
        states=("pos",),
        inputs=("f",),
        ports=(Port("stack", {"pos": -1.0}, lambda x: x.pos, unit="N", across_unit="um"),),
    )
    assert not spring.port("stack").is_speed
    body = drive(units={"speed": "K"}).port("equation:w")
    assert not body.is_speed


def test_where_there_is_a_position_the_coordinate_is_none() -> None:
    """A force changes a position only through its speed."""
    simulator = Simulator(
        lambda x, u: {"pos": x.vel, "vel": u.f - x.vel},
        lambda x: {"pos": x.pos},
        states=("pos", "vel"),
        inputs=("f",),
        ports=(Port("guide", {"vel": -1.0}, lambda x: x.pos, unit="N"),),
    )
    assert not simulator.port("guide").is_speed
    assert not simulator.port("actuator:f").is_speed


@pytest.mark.parametrize(
    "ports", [pytest.param((shaft(),), marks=pytest.mark.slow), ()], ids=["declared", "not declared"]
)
def test_friction_of_a_drive_without_an_angle_is_named(ports: tuple[Port, ...]) -> None:
    """With a port and without, friction is named, and its torque is right."""
    d = diagnose(drive(*ports), measured(1), test=measured(2), laws=TRIED, effects=1, workers=1)
    effect, test = d.effects[0], d.errors["test"]
    assert (d.verdict, effect.law) == ("missing-physics", "coulomb_friction")
    assert effect.confidence > 0.8
    assert test is not None
    assert test["after"] < 0.2 * test["before"]
    assert "v the speed at the port" in str(d)
    torque = effect.parameters["F_c"]["value"] * (1 if ports else J)
    assert torque == pytest.approx(F_C, rel=0.1)


@pytest.mark.parametrize("units", [{}, {"unit": "V", "across_unit": "deg/s"}], ids=["no units", "volts"])
def test_no_law_of_a_position_is_admitted_at_a_speed(units: dict[str, str]) -> None:
    """What reads z is left out, whatever its class and the unit of the force; what reads only the rate stays."""
    port = drive(shaft(**units)).port("shaft")
    assert not any(port.admits(law) for law in CATALOGUE if "z" in law.reads())
    assert {"coulomb_friction", "stribeck_friction", "cubic_damping"} <= {
        law.id for law in CATALOGUE if port.admits(law)
    }


@pytest.fixture(scope="module")
def braked() -> Diagnosis:
    """The diagnosis of a drive with an eddy-current brake, whose torque falls at high speed; no law tried does."""

    def torque(w: float) -> float:
        return 0.1 * (w / 8) / (1 + (w / 8) ** 2)

    train, test = (measured(seed, torque) for seed in (0, 1))
    return diagnose(drive(shaft(across_unit="rad/s")), train, test=test, laws=(CubicDamping,), workers=1)


def test_a_force_of_the_speed_that_no_law_follows_is_learned(braked: Diagnosis) -> None:
    assert [learned.port for learned in braked.learned] == ["shaft"] and braked.verdict == "unexplained"
    errors = braked.errors["test"]
    assert errors["after"] < 0.15 * errors["before"]
    assert "It holds where the local coordinate is from" in braked.learned[0].sentence


def test_a_learned_force_of_the_speed_is_saturated_beyond_the_recordings(braked: Diagnosis) -> None:
    law = braked.corrected.elements[-1].law
    far = [float(law.force(np.array(w), Named("p", law.values))) for w in (-1e6, -1e4, 1e4, 1e6)]
    assert far[0] == pytest.approx(far[1], rel=0.05) and far[2] == pytest.approx(far[3], rel=0.05)


def test_a_force_is_learned_where_no_unit_tells_a_speed_from_another_quantity() -> None:
    """Such a port admits forces of a position as well."""
    plain = drive()
    (port,) = (port for port in plain.all_ports() if not port.series)
    assert port.is_speed and port.admits(LearnedForce) and port.admits(LearnedForceOfSpeed)
    bench = Workbench.of(plain, [measured(0)], "zero")
    starts = linear_starts(bench, bench.fit(plain), [port.name])
    assert {start.law.factor for start in starts} == {"", "i"} and starts[0].share > 0.5
