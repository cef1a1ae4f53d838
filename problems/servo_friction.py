"""Servo drives with gear friction that the simulator leaves out, up to friction that grows with the transmitted load.

A servo swings a weight on an arm under a position controller. Its gear has one of three frictions: Coulomb, Coulomb
with a Stribeck peak, or Coulomb friction that grows with the load that the gear transmits (Duclusaud, Passault, Padois
& Ly 2024, Extended friction models for the physics simulation of servo actuators). The simulator has the inertia, the
weight and viscous friction, and its port declares the transmitted load. Every second rig carries a light weight only,
so that the load is little more than what moves the inertia.

    python -m problems.servo_friction                60 servos
    python -m problems.servo_friction --cases 6
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from pilfr_casadi import Parameter, Port, Recording, Simulator

from .simulated_cases import Flow, advance, case_parser, diagnose_case, numbered, random_sines

DT, SAMPLES, FINE = 0.005, 2400, 20  # s, samples, steps of the truth in a sample
KNEE = 0.01  # rad/s, within which the friction reverses
NOISE = 3e-4  # rad
KINDS = ("coulomb_friction", "stribeck_friction", "load")


def simulator(values: Mapping[str, float]) -> Simulator:
    """Make the simulator: inertia, weight and viscous friction; the gear transmits the torque less the weight's."""
    joint = Port(
        "gear",
        into=lambda p: {"speed": -1 / p.J},
        across=lambda x: x.angle,
        rate=lambda x: x.speed,
        unit="N m",
        across_unit="rad",
        signals={"load": lambda x, u, p: ca.fabs(u.torque - p.G * ca.sin(x.angle))},
    )
    units = {"J": "kg m^2", "d": "N m s/rad", "G": "N m"}
    bounds = {"J": (0.003, 0.3), "d": (0.0, 2.0), "G": (0.0, 10.0)}
    return Simulator(
        lambda x, u, p: {"angle": x.speed, "speed": (u.torque - p.G * ca.sin(x.angle) - p.d * x.speed) / p.J},
        lambda x: {"encoder": x.angle},
        states=("angle", "speed"),
        inputs=("torque",),
        parameters={k: Parameter(values[k], unit=units[k], bounds=bounds[k]) for k in units},
        ports=(joint,),
        hold="zero",
        units={"torque": "N m", "encoder": "rad"},
    )


def recorded(seed: int, kind: str) -> tuple[Simulator, Recording, Recording]:
    """Draw a servo; return its simulator, with values off by up to a quarter, a training and a test recording."""
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    weighty = seed % 2 == 0
    true = {"J": rng.uniform(0.02, 0.05), "d": rng.uniform(0.02, 0.08), "G": rng.uniform(1.0, 2.0) if weighty else 0.3}
    given = {name: value * rng.uniform(0.8, 1.25) for name, value in true.items()}
    flow = _truth(true, kind, rng)
    train, test = (_run(flow, true, rng) for _ in range(2))
    return simulator(given), train, test


def _truth(p: Mapping[str, float], kind: str, rng: np.random.Generator) -> Flow:
    """Make the true dynamics with one kind of friction."""
    size = rng.uniform(0.08, 0.2)
    peak, fall = rng.uniform(0.6, 1.2) * (kind == "stribeck_friction"), rng.uniform(0.2, 0.5)
    share = rng.uniform(0.15, 0.4) * (kind == "load")

    def flow(x: np.ndarray, torque: float) -> np.ndarray:
        angle, speed = x
        weight = p["G"] * np.sin(angle)
        most = size * (1 + peak * np.exp(-((speed / fall) ** 2))) + share * abs(torque - weight)
        return np.array([speed, (torque - weight - p["d"] * speed - most * np.tanh(speed / KNEE)) / p["J"]])

    return flow


def _run(flow: Flow, p: Mapping[str, float], rng: np.random.Generator) -> Recording:
    """Follow a slow and a fast random reference under a stiff position controller, which is not known."""
    reference = random_sines(rng, DT * np.arange(SAMPLES), (0.1, 2.0), 12, 1.2, roll_off=0.5)
    stiffness, damping = 300 * p["J"], 25 * p["J"]
    x, y, u = np.array([reference[0], 0.0]), np.zeros(SAMPLES), np.zeros(SAMPLES)
    for i in range(SAMPLES):
        y[i] = x[0] + NOISE * rng.standard_normal()
        u[i] = stiffness * (reference[i] - y[i]) - damping * x[1]
        x = advance(flow, x, u[i], DT, FINE)
    return Recording(u, y, DT, ("torque",), ("encoder",), initial="estimate", hold="zero")


def describe(effect: Any) -> str:
    """Name the kind of a friction that was found; the id where it is none of them."""
    return "load" if "load" in effect.form else str(effect.law)


def main(arguments: Sequence[str] | None = None) -> int:
    """Diagnose every servo; print one line each, and the numbers of right, unsure and wrong kinds."""
    options = case_parser(__doc__, 60).parse_args(arguments)
    counts = dict.fromkeys(("right", "unsure", "wrong"), 0)
    for case in numbered(options):
        seed, kind = case // len(KINDS), KINDS[case % len(KINDS)]
        answer = diagnose_case(recorded(seed, kind), options.workers)
        kinds = [describe(e) for e in answer.found.effects]
        right = kinds == [kind] and answer.named[0][0] == "gear"
        judged = "right" if right else "wrong" if kinds and answer.found.sure else "unsure"
        counts[judged] += 1
        answer.show(f"{case:3} {kind:18} {judged:7}")
    print(", ".join(f"{name} {count}" for name, count in counts.items()))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
