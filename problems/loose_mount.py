"""A mass on a mount whose bolts have play, or whose bracket gives way; the simulator has the mount alone.

The mount is a progressive spring with a damper, which the simulator names as the `term` of its port. In the truth a gap
or a spring stands in line with it, or nothing. Values are drawn anew for every seed. The truth is integrated apart from
the package.

    python -m problems.loose_mount                  20 cases of each kind
    python -m problems.loose_mount --cases 4
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pilfr_casadi import Parameter, Port, Recording, Simulator

from .simulated_cases import case_parser, diagnose_case, numbered, random_sines, trajectory

DT, SAMPLES, FINE = 0.005, 2000, 20  # s, samples, steps of the truth in a sample
NOISE = 2e-3  # of the output's deviation
KINDS = {"gap": "clearance", "bracket": "compliance", "tight": ""}  # the law that is hidden


def simulator(values: Mapping[str, float]) -> Simulator:
    """Make the simulator: a mass on its mount."""

    def mount(z: Any, dz: Any, p: Any) -> Any:
        return p.k * z + p.k_3 * z**3 + p.d * dz

    def dynamics(x: Any, u: Any, p: Any) -> dict[str, Any]:
        return {"position": x.speed, "speed": (u.force - mount(x.position, x.speed, p)) / p.m}

    port = Port("mount", lambda p: {"speed": -1 / p.m}, lambda x: x.position, lambda x: x.speed, "N", "m", term=mount)
    units = {"m": "kg", "k": "N/m", "k_3": "N/m^3", "d": "N s/m"}
    own = {n: Parameter(values[n], unit=unit, bounds=(0.0, 5 * values[n])) for n, unit in units.items()}
    return Simulator(
        dynamics,
        lambda x: {"travel": x.position},
        states=("position", "speed"),
        inputs=("force",),
        parameters={**own, "m": Parameter(values["m"], unit="kg", fixed=True)},
        ports=(port,),
        hold="zero",
        units={"force": "N", "travel": "m"},
    )


def recorded(seed: int, kind: str) -> tuple[Simulator, Recording, Recording]:
    """Draw a machine; return its simulator, with values off by up to a quarter, a training and a test recording."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    true = {"m": 2.0, "k": rng.uniform(800, 1500), "d": rng.uniform(15, 30)}
    true["k_3"] = true["k"] * rng.uniform(500, 1500)
    extra = {"gap": rng.uniform(5e-4, 3e-3), "bracket": true["k"] * rng.uniform(1, 4), "tight": 0.0}[kind]
    given = {n: v * (1.0 if n == "m" else rng.uniform(0.8, 1.25)) for n, v in true.items()}
    train, test = (run(true, kind, extra, rng) for _ in range(2))
    return simulator(given), train, test


def run(p: Mapping[str, float], kind: str, extra: float, rng: np.random.Generator) -> Recording:
    """Drive the machine with a random multisine; `extra` is the gap in m or the stiffness of the bracket in N/m."""
    u = random_sines(rng, DT * np.arange(SAMPLES), (0.3, 15.0), 30, 25.0)

    def flow(x: np.ndarray, force: float) -> np.ndarray:
        z, dz, q = x
        if kind == "bracket":  # the mount's travel q is less than z, and both carry the same load
            load = extra * (z - q)
            return np.array([dz, (force - load) / p["m"], (load - p["k"] * q - p["k_3"] * q**3) / p["d"]])
        gap = extra if kind == "gap" else 0.0
        inner = z - np.clip(z, -gap, gap)
        rate = dz if abs(z) > gap else 0.0
        load = p["k"] * inner + p["k_3"] * inner**3 + p["d"] * rate
        return np.array([dz, (force - load) / p["m"], 0.0])

    y = trajectory(flow, np.zeros(3), u, DT, FINE)[:, 0]
    y += NOISE * np.std(y) * rng.standard_normal(SAMPLES)
    return Recording(u, y, DT, ("force",), ("travel",), initial="zero", hold="zero")


def main(arguments: Sequence[str] | None = None) -> int:
    """Diagnose every case; print one line each, and the number of right answers of each kind."""
    options = case_parser(__doc__, 20, "of each kind").parse_args(arguments)
    right = dict.fromkeys(KINDS, 0)
    for seed in numbered(options):
        for kind, law in KINDS.items():
            answer = diagnose_case(recorded(seed, kind), options.workers)
            right[kind] += answer.is_right("mount", law)
            answer.show(f"{seed:3} {kind:8}")
    print(", ".join(f"{kind}: {right[kind]} of {options.cases}" for kind in KINDS))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
