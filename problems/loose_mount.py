"""A mass on a mount whose bolts have play, or whose bracket gives way; the simulator has the mount alone.

The mount is a progressive spring with a damper, which the simulator names as the `term` of its port. In the truth a gap
or a spring stands in line with it, or nothing. Values are drawn anew for every seed. The truth is integrated apart from
the package.

    python -m problems.loose_mount                  20 cases of each kind
    python -m problems.loose_mount --cases 4
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pilfr_casadi import Parameter, Port, Recording, Simulator, diagnose

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
    t, lines = DT * np.arange(SAMPLES), np.exp(rng.uniform(np.log(0.3), np.log(15), 30))
    u = np.sum(np.sin(2 * np.pi * np.outer(t, lines) + rng.uniform(0, 2 * np.pi, 30)), axis=1)
    u *= 25.0 / np.max(np.abs(u))

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

    x, h, y = np.zeros(3), DT / FINE, np.zeros(SAMPLES)
    for i in range(SAMPLES):
        y[i] = x[0]
        for _ in range(FINE):
            k1 = flow(x, u[i])
            k2 = flow(x + h / 2 * k1, u[i])
            k3 = flow(x + h / 2 * k2, u[i])
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + flow(x + h * k3, u[i]))
    y += NOISE * np.std(y) * rng.standard_normal(SAMPLES)
    return Recording(u, y, DT, ("force",), ("travel",), initial="zero", hold="zero")


def main(arguments: Sequence[str] | None = None) -> int:
    """Diagnose every case; print one line each, and the number of right answers of each kind."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=20, help="of each kind")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args(arguments)
    right = dict.fromkeys(KINDS, 0)
    for seed in range(options.first, options.first + options.cases):
        for kind, law in KINDS.items():
            rig, train, test = recorded(seed, kind)
            began = time.perf_counter()
            found = diagnose(rig, train, test=test, workers=options.workers)
            seconds = time.perf_counter() - began
            named = [(e.port, e.law) for e in found.effects]
            right[kind] += named == [("mount", law)] if law else found.verdict == "complete"
            told = [f"{e.law} ({e.form or 'plain'}) at {e.port} {e.confidence:.2f}" for e in found.effects]
            errors = found.errors["test"]
            assert errors is not None
            print(
                f"{seed:3} {kind:8} {', '.join(told) or found.verdict:55} "
                f"test {errors['before']:.4f} -> {errors['after']:.4f}, {seconds:.0f} s",
                flush=True,
            )
    print(", ".join(f"{kind}: {right[kind]} of {options.cases}" for kind in KINDS))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
