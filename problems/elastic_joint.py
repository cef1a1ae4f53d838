"""A motor that drives its link through an elastic gear; the simulator takes the gear for rigid.

The truth is a motor and a link on a spring and a damper, with viscous and dry friction at the motor. The simulator has
one inertia, both frictions and a lag of the actuator, all free, so that a refit may hide the compliance behind damping
and lag. Even seeds record the motor's speed, odd seeds the link's. Every third case is rigid, and complete. Values are
drawn anew for every seed.

    python -m problems.elastic_joint                20 elastic cases, 10 rigid ones
    python -m problems.elastic_joint --cases 4      4 elastic cases, 2 rigid ones
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from pilfr_casadi import Parameter, Port, Recording, Simulator

from .simulated_cases import case_parser, diagnose_case, numbered, random_sines, trajectory

DT, SAMPLES, FINE = 0.004, 2500, 20  # s, samples, steps of the truth in a sample
KNEE = 0.02  # rad/s, within which the dry friction reverses
NOISE = 1e-3  # of the output's deviation
COMPLIANCE = "extra_mode"


def simulator(values: Mapping[str, float], seen: str) -> Simulator:
    """Make the rigid simulator: one inertia with friction behind an actuator with a lag; `seen` is its output."""

    def dynamics(x: Any, u: Any, p: Any) -> dict[str, Any]:
        load = p.d * x.speed + p.F_c * ca.tanh(x.speed / KNEE)
        return {"torque": (u.command - x.torque) / p.T, "angle": x.speed, "speed": (x.torque - load) / p.J}

    joint = Port(
        "joint",
        into=lambda x, p: {"speed": -1 / p.J},
        across=lambda x: x.angle,
        rate=lambda x: x.speed,
        unit="N m",
        across_unit="rad",
    )
    bounds = {"J": (1e-3, 0.5), "d": (0.0, 5.0), "F_c": (0.0, 3.0), "T": (1e-3, 0.05)}
    units = {"J": "kg m^2", "d": "N m s/rad", "F_c": "N m", "T": "s"}
    return Simulator(
        dynamics,
        lambda x: {seen: x.speed},
        states=("torque", "angle", "speed"),
        inputs=("command",),
        parameters={k: Parameter(values[k], unit=units[k], bounds=bounds[k]) for k in units},
        ports=(joint,),
        hold="zero",
        units={"command": "N m", seen: "rad/s"},
    )


def recorded(seed: int, elastic: bool) -> tuple[Simulator, Recording, Recording]:
    """Draw a machine; return its simulator, with values off by up to a quarter, a training and a test recording."""
    rng = np.random.default_rng([seed, elastic])
    true = {"J": rng.uniform(0.02, 0.06), "d": rng.uniform(0.1, 0.4), "F_c": rng.uniform(0.1, 0.4), "T": 0.003}
    share = rng.uniform(0.3, 0.7)  # of the inertia that is the link's
    resonance, damping = 2 * np.pi * rng.uniform(4, 12), rng.uniform(0.02, 0.1)
    reduced = true["J"] * share * (1 - share)
    spring = (resonance**2 * reduced, 2 * damping * resonance * reduced, share) if elastic else None
    given = {name: value * rng.uniform(0.8, 1.25) for name, value in true.items()}
    seen = "motor" if seed % 2 == 0 else "link"
    train, test = (_run(true, spring, seen, rng) for _ in range(2))
    return simulator(given, seen), train, test


def _run(
    p: Mapping[str, float], spring: tuple[float, float, float] | None, seen: str, rng: np.random.Generator
) -> Recording:
    """Drive the machine with a random multisine; `spring` holds stiffness, damping, and the link's share of inertia."""
    u = random_sines(rng, DT * np.arange(SAMPLES), (0.2, 20.0), 30, 4.0)

    def flow(x: np.ndarray, command: float) -> np.ndarray:
        torque, angle, speed, link, link_speed = x
        friction = p["d"] * speed + p["F_c"] * np.tanh(speed / KNEE)
        lag = (command - torque) / p["T"]
        if spring is None:
            faster = (torque - friction) / p["J"]
            return np.array([lag, speed, faster, speed, faster])
        k, c, share = spring
        across = k * (angle - link) + c * (speed - link_speed)
        faster = (torque - friction - across) / (p["J"] * (1 - share))
        return np.array([lag, speed, faster, link_speed, across / (p["J"] * share)])

    y = trajectory(flow, np.zeros(5), u, DT, FINE)[:, 2 if seen == "motor" else 4]
    y += NOISE * np.std(y) * rng.standard_normal(SAMPLES)
    return Recording(u, y, DT, ("command",), (seen,), initial="zero", hold="zero")


def main(arguments: Sequence[str] | None = None) -> int:
    """Diagnose every case; print one line each, and the numbers of right answers and of delays in their place."""
    options = case_parser(__doc__, 20, "elastic cases; half as many rigid ones").parse_args(arguments)
    seeds = numbered(options)
    cases = [(seed, True) for seed in seeds] + [(seed, False) for seed in seeds[::2]]
    right, delays = {True: 0, False: 0}, 0
    for seed, elastic in cases:
        answer = diagnose_case(recorded(seed, elastic), options.workers)
        laws = [law for _, law in answer.named]
        right[elastic] += laws == [COMPLIANCE] if elastic else answer.found.verdict == "complete"
        shifted = any(g.finding == "alignment" for g in answer.found.gates)
        delays += elastic and ("delay" in laws or shifted)
        answer.show(f"{seed:3} {'elastic' if elastic else 'rigid':8}{'shifted ' if shifted else ''}")
    print(
        f"compliance named in {right[True]} of {len(seeds)}, a delay in {delays}; "
        f"complete in {right[False]} of {len(seeds[::2])} rigid cases"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
