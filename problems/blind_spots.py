"""Twenty small rigs with known blind spots, and five without: what is blind, what `check` says, and its processor time.

python -m problems.blind_spots
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from pilfr_casadi import Check, Parameter, Port, Recording, Simulator, check, multisine

DT, SAMPLES = 0.01, 1500
NOISE = 2e-3  # over the outputs' deviation
Told = Callable[[Check], bool]


@dataclass(frozen=True)
class Rig:
    """A simulator with recordings, what they cannot tell, and whether a check says so."""

    name: str
    blind: str
    simulator: Simulator
    train: tuple[Recording, ...]
    told: Told


def spot(kind: str, *names: str, says: str = "") -> Told:
    """Whether a blind spot of a kind concerns these names, and says a word."""

    def told(found: Check) -> bool:
        return any(b.kind == kind and set(names) <= set(b.names) and says in b.sentence for b in found.blind_spots)

    return told


def tied(*names: str, only_as: Sequence[str] = ()) -> Told:
    """Whether these parameters are identifiable only as some expressions."""
    return lambda found: any(set(t.names) == set(names) and set(t.only_as) == set(only_as) for t in found.ties)


def alike(*names: tuple[str, str]) -> Told:
    """Whether laws at ports are in one class."""
    return lambda found: any(set(names) <= set(group) for group in found.classes)


def nothing(found: Check) -> bool:
    """Whether no blind spot is found."""
    return not found.blind_spots


def noise_like(seed: int, amplitude: float = 1.0, f_max: float = 8.0, f_min: float = 0.0) -> np.ndarray:
    """A random-phase multisine, rms `amplitude`."""
    rng = np.random.default_rng(seed)
    return amplitude * multisine(SAMPLES, f_max=f_max, fs=1 / DT, rng=rng, f_min=f_min)


def triangle(amplitude: float, seconds: float) -> np.ndarray:
    """A triangle from zero."""
    return amplitude * 2 / np.pi * np.arcsin(np.sin(2 * np.pi * np.arange(SAMPLES) * DT / seconds))


def record(simulator: Simulator, drive: Any, seed: int = 0, initial: Any = "zero", **more: Any) -> Recording:
    """Run a simulator from zero, or from the numbers `begin`, and measure it with noise."""
    rng, u = np.random.default_rng(seed), np.atleast_2d(np.asarray(drive, dtype=float).T).T
    begin = more.pop("begin", "zero")
    blank = Recording(u, np.zeros((len(u), 0)), DT, simulator.inputs, hold="zero", initial=begin)
    y = simulator.simulate(blank)
    y = y + NOISE * np.std(y, axis=0) * rng.standard_normal(y.shape)
    return blank.with_(y=y, outputs=simulator.output_names, initial=initial, **more)


def oscillator(
    force: Callable[[Any, Any, Any], Any],
    parameters: Mapping[str, Parameter],
    ports: Sequence[Port] = (),
    outputs: Callable[..., Any] = lambda x: {"position": x.pos},
    inputs: tuple[str, ...] = ("force",),
    **more: Any,
) -> Simulator:
    """A mass whose acceleration is given; `more` gives further states and their derivatives."""
    return Simulator(
        lambda x, u, p: {"pos": x.vel, "vel": force(x, u, p), **{n: f(x, u, p) for n, f in more.items()}},
        outputs,
        states=("pos", "vel", *more),
        inputs=inputs,
        parameters=dict(parameters),
        ports=tuple(ports),
    )


def mount(name: str = "mount", state: str = "vel") -> Port:
    """A port between mass and ground."""
    return Port(name, {state: -1.0}, lambda x: x.pos, lambda x: x.vel, unit="m/s^2", across_unit="m")


K, D = Parameter(100.0, "1/s^2", bounds=(20, 500)), Parameter(2.0, "1/s", bounds=(0.2, 20))


def plain(ports: Sequence[Port] = (mount(),), **more: Any) -> Simulator:
    """A mass, a spring and a damper."""
    return oscillator(lambda x, u, p: u.force - p.k * x.pos - p.d * x.vel, {"k": K, "d": D}, ports, **more)


def lag(gain: Parameter, more: Mapping[str, Parameter], output: Callable[..., Any], **options: Any) -> Simulator:
    """A first-order lag."""
    return Simulator(
        options.pop("dynamics", lambda x, u, p: {"x": (p.gain * u.u - x.x) / p.T}),
        output,
        states=("x",),
        parameters={"gain": gain, "T": Parameter(0.2, "s", bounds=(0.02, 2)), **more},
        **{"inputs": ("u",), **options},
    )


def parameter_rigs() -> list[Rig]:
    """Parameters that are dead, flat or traded off."""
    scale = oscillator(
        lambda x, u, p: (-p.k * x.pos - p.d * x.vel) / p.m - u.acceleration,
        {
            "m": Parameter(2.0, "kg", bounds=(0.5, 8)),
            "k": Parameter(200.0, "N/m", bounds=(40, 1000)),
            "d": Parameter(4.0, bounds=(0.4, 40)),
        },
        [mount()],
        inputs=("acceleration",),
    )
    gains = lag(
        Parameter(3.0, bounds=(1, 9)),
        {"k_sensor": Parameter(0.5, bounds=(0.1, 2))},
        lambda x, p: {"y": p.k_sensor * x.x},
    )
    warm = oscillator(
        lambda x, u, p: u.force - p.k * x.pos - p.d * x.vel,
        {"k": K, "d": D, "warming": Parameter(0.3, bounds=(0.1, 1))},
        [mount()],
        temperature=lambda x, u, p: p.warming * x.vel**2 - 0.1 * x.temperature,
    )
    stop = oscillator(
        lambda x, u, p: u.force - p.k * x.pos - p.d * x.vel - p.k_stop * ca.fmax(x.pos - 10.0, 0.0),
        {"k": K, "d": D, "k_stop": Parameter(1e4, bounds=(1e3, 1e5))},
        [mount()],
    )
    soft = oscillator(
        lambda x, u, p: u.force - p.k * x.pos - p.d * x.vel,
        {"k": Parameter(1.0, bounds=(0.8, 1.25)), "d": D},
        [mount()],
    )
    soft_run = record(soft, np.tile(noise_like(5, 1.0, 20.0, f_min=8.0), 2)).slice(SAMPLES, 2 * SAMPLES)
    soft_run = soft_run.with_(initial="estimate")
    two = {"k1": Parameter(60.0, bounds=(10, 200)), "k2": Parameter(40.0, bounds=(10, 200)), "d": D}
    parallel = oscillator(lambda x, u, p: u.force - (p.k1 + p.k2) * x.pos - p.d * x.vel, two, [mount()])
    series = oscillator(
        lambda x, u, p: u.force - p.k1 * p.k2 / (p.k1 + p.k2) * x.pos - p.d * x.vel,
        {"k1": Parameter(170.0, bounds=(50, 600)), "k2": Parameter(300.0, bounds=(50, 900)), "d": D},
        [mount()],
    )
    slow = oscillator(
        lambda x, u, p: u.force - p.k * x.pos - p.d * x.vel,
        {"k": Parameter(4e4, bounds=(1e4, 1e5)), "d": Parameter(50.0, bounds=(48, 52))},
        [mount()],
    )
    heat = lag(
        Parameter(1.0, bounds=(0.2, 3)),
        {"drift": Parameter(0.02, bounds=(0.005, 0.1))},
        lambda x, u, p: {"y": x.x},
        dynamics=lambda x, u, p: {"x": ((p.gain + p.drift * u.temperature) * u.u - x.x) / p.T},
        inputs=("u", "temperature"),
    )
    adrift = Simulator(
        lambda x, u, p: {"angle": p.gain * u.speed},
        lambda x, p: {"encoder": x.angle + p.offset},
        states=("angle",),
        inputs=("speed",),
        parameters={"gain": Parameter(1.0, bounds=(0.5, 2)), "offset": Parameter(0.1, bounds=(-1, 1))},
    )
    frozen = oscillator(
        lambda x, u, p: u.force - p.k * x.pos - p.d * x.vel,
        {"k": Parameter(100.0, fixed=True), "d": Parameter(2.0, fixed=True)},
        [mount()],
    )
    warmed = np.column_stack([noise_like(13), np.full(SAMPLES, 20.0)])
    swing = noise_like(8, 10.0, f_max=0.15) * np.sin(np.minimum(np.arange(SAMPLES) * DT / 3, np.pi / 2)) ** 2
    return [
        Rig(
            "free scale",
            "m, k and d only as ratios",
            scale,
            (record(scale, noise_like(1)),),
            tied("m", "k", "d", only_as=("k/m", "d/m")),
        ),
        Rig(
            "two gains",
            "gain and k_sensor only as product",
            gains,
            (record(gains, noise_like(2), initial="estimate"),),
            tied("gain", "k_sensor", only_as=("gain*k_sensor",)),
        ),
        Rig(
            "no thermometer",
            "warming: no output reacts",
            warm,
            (record(warm, noise_like(3, 10)),),
            spot("dead", "warming"),
        ),
        Rig(
            "contact not reached",
            "k_stop: no output reacts",
            stop,
            (record(stop, noise_like(4)),),
            spot("dead", "k_stop"),
        ),
        Rig(
            "above the resonance",
            "k: flat within its bounds",
            soft,
            (soft_run,),
            spot("flat", "k"),
        ),
        Rig(
            "parallel springs",
            "k1 and k2 only as sum",
            parallel,
            (record(parallel, noise_like(6)),),
            tied("k1", "k2", only_as=("k1 + k2",)),
        ),
        Rig("springs in series", "k1 and k2 only together", series, (record(series, noise_like(7)),), tied("k1", "k2")),
        Rig("slow motion", "d: quasi-static, no speed sensor", slow, (record(slow, swing),), spot("flat", "d")),
        Rig(
            "one temperature",
            "temperature is constant",
            heat,
            (record(heat, warmed),),
            lambda c: spot("constant-input", "temperature")(c) and tied("gain", "drift")(c),
        ),
        Rig(
            "offset of an integrator",
            "offset and unknown start",
            adrift,
            (record(adrift, noise_like(15), initial="estimate"),),
            spot("start", "offset"),
        ),
        Rig("all fixed", "no free parameter", frozen, (record(frozen, noise_like(20)),), spot("no-free-parameter")),
    ]


def motion_rigs() -> list[Rig]:
    """Motion that does not show a law, and laws and ports that look the same."""
    steady = plain()
    sine = 20 * np.sin(2 * np.pi * 1.0 * np.arange(SAMPLES) * DT)
    settled = record(steady, np.tile(sine, 2)).slice(SAMPLES, 2 * SAMPLES).with_(initial="estimate")
    push = 50 * np.clip(np.arange(SAMPLES) * DT / 12, 0, 1)
    pair = plain((mount("bearing"), mount("guide")))
    seal = Simulator(
        lambda u: {"stroke": u.velocity},
        lambda x, u, p: {"force": p.k * x.stroke + p.c * u.velocity},
        states=("stroke",),
        inputs=("velocity",),
        parameters={"k": Parameter(50.0, bounds=(10, 200)), "c": Parameter(5.0, bounds=(1, 50))},
        ports=(Port("seal", {"force": 1.0}, lambda x: x.stroke, lambda u: u.velocity, unit="N", across_unit="m"),),
    )
    to_and_fro = np.where(np.arange(SAMPLES) // 50 % 2 == 0, 0.02, -0.02)
    level = lag(Parameter(2.0, bounds=(0.5, 5)), {}, lambda x: {"y": x.x})
    static = Simulator(
        lambda: {},
        lambda u, p: {"y": p.gain * u.u},
        inputs=("u",),
        parameters={"gain": Parameter(2.0, bounds=(0.5, 5))},
    )
    linear = plain()
    tanks = Simulator(
        lambda x, u, p: {"upper": p.pump * u.u - p.a * x.upper, "lower": p.a * x.upper - p.b * x.lower},
        lambda x: {"level": x.upper},
        states=("upper", "lower"),
        inputs=("u",),
        parameters={
            "pump": Parameter(1.0, bounds=(0.2, 5)),
            "a": Parameter(0.8, bounds=(0.1, 5)),
            "b": Parameter(0.5, fixed=True),
        },
        ports=(Port("drain", {"lower": -1.0}, lambda x: x.lower), Port("orifice", {"upper": -1.0}, lambda x: x.upper)),
    )
    clutch = Simulator(
        lambda x, u, p: {
            "pos": x.vel,
            "vel": u.force - p.k * x.pos - p.d * x.vel,
            "arm": x.turn,
            "turn": u.torque - 50 * x.arm - x.turn,
        },
        lambda x: {"position": x.pos, "angle": x.arm + 0.1 * x.pos},
        states=("pos", "vel", "arm", "turn"),
        inputs=("force", "torque"),
        parameters={"k": K, "d": D},
        ports=(mount(), Port("clutch", {"turn": -1.0}, lambda x: x.arm, lambda x: x.turn)),
    )
    still = np.column_stack([noise_like(19), np.zeros(SAMPLES)])
    ends = ("actuator:u", "sensor:y")
    return [
        Rig("one amplitude", "a single amplitude", steady, (settled,), spot("one-amplitude", "mount")),
        Rig(
            "one push",
            "no reversal",
            steady,
            (record(steady, push, initial="estimate"),),
            spot("no-reversal", "actuator:force"),
        ),
        Rig(
            "two ports at one joint",
            "bearing and guide are one",
            pair,
            (record(pair, noise_like(11)),),
            spot("alike-ports", "bearing", "guide"),
        ),
        Rig(
            "one speed",
            "friction is taken for another c",
            seal,
            (record(seal, to_and_fro),),
            spot("followed", "seal", "coulomb_friction", says="a change of c"),
        ),
        Rig(
            "constant input", "u never changes", level, (record(level, np.ones(SAMPLES)),), spot("constant-input", "u")
        ),
        Rig(
            "static device",
            "actuator and sensor are one",
            static,
            (record(static, noise_like(16)),),
            spot("alike-ports", *ends),
        ),
        Rig(
            "delay of a linear plant",
            "before or after it",
            linear,
            (record(linear, noise_like(17)),),
            alike(("actuator:force", "delay"), ("sensor:position", "delay")),
        ),
        Rig(
            "sensor upstream",
            "nothing at drain is detectable",
            tanks,
            (record(tanks, 1 + noise_like(18, 0.3, 1.0)),),
            spot("hidden-port", "drain"),
        ),
        Rig("idle clutch", "nothing moves at clutch", clutch, (record(clutch, still),), spot("no-motion", "clutch")),
    ]


def controls() -> list[Rig]:
    """Rigs that are well excited and observed."""
    mass = plain()
    masses = Simulator(
        lambda x, u, p: {
            "x1": x.v1,
            "v1": -p.k1 * x.x1 - p.d1 * x.v1 + p.k2 * (x.x2 - x.x1) + p.d2 * (x.v2 - x.v1),
            "x2": x.v2,
            "v2": u.force - p.k2 * (x.x2 - x.x1) - p.d2 * (x.v2 - x.v1),
        },
        lambda x: {"x1": x.x1, "x2": x.x2},
        states=("x1", "v1", "x2", "v2"),
        inputs=("force",),
        parameters={"k1": K, "d1": D, "k2": Parameter(150.0, bounds=(20, 500)), "d2": D},
        ports=(
            Port("ground", {"v1": -1.0}, lambda x: x.x1, lambda x: x.v1),
            Port("coupling", {"v1": 1.0, "v2": -1.0}, lambda x: x.x2 - x.x1, lambda x: x.v2 - x.v1),
        ),
    )
    piston = Simulator(
        lambda u: {"stroke": u.velocity},
        lambda x, u, p: {"force": p.k * x.stroke + p.c * u.velocity + p.offset},
        states=("stroke",),
        inputs=("velocity",),
        parameters={"k": K, "c": D, "offset": Parameter(1.0, bounds=(-10, 10))},
        ports=(Port("piston", {"force": 1.0}, lambda x: x.stroke, lambda u: u.velocity),),
    )
    pendulum = oscillator(
        lambda x, u, p: u.force - p.k * ca.sin(x.pos) - p.d * x.vel, {"k": K, "d": D}, [mount("joint")]
    )
    motor = lag(Parameter(3.0, bounds=(1, 9)), {}, lambda x: {"speed": x.x})
    return [
        Rig("mass", "", mass, (record(mass, noise_like(31)),), nothing),
        Rig("two masses, two sensors", "", masses, (record(masses, noise_like(32)),), nothing),
        Rig("damper from rest", "", piston, (record(piston, noise_like(33)),), nothing),
        Rig(
            "pendulum, two records",
            "",
            pendulum,
            (record(pendulum, noise_like(34, 20)), record(pendulum, noise_like(35, 40))),
            nothing,
        ),
        Rig(
            "motor, unknown start",
            "",
            motor,
            (record(motor, noise_like(36), initial="estimate", begin=[0.5]),),
            nothing,
        ),
    ]


def rigs() -> list[Rig]:
    """The twenty."""
    return [*parameter_rigs(), *motion_rigs()]


def main() -> None:
    """Print the table."""
    print(f"{'rig':<26}{'blind':<34}{'told':<6}{'s':>5}  sentences")
    right = []
    for rig in [*rigs(), *controls()]:
        began = time.process_time()
        found = check(rig.simulator, rig.train)
        seconds = time.process_time() - began
        right.append(rig.told(found))
        told = [b.sentence for b in found.blind_spots]
        said = " | ".join(told) or f"{len(found.classes)} groups of laws look the same" * bool(found.classes) or "-"
        print(f"{rig.name:<26}{rig.blind or '(control)':<34}{'yes' if right[-1] else 'NO':<6}{seconds:5.1f}  {said}")
    print(f"{sum(right[:20])} of 20 blind spots found, {sum(right[20:])} of {len(right) - 20} controls clear")


if __name__ == "__main__":
    main()
