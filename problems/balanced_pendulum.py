"""An inverted pendulum on a cart, balanced by a controller that the simulator does not know.

The truth has friction at the rail that the simulator lacks: Coulomb friction, Coulomb friction with a Stribeck peak, or
none. A linear-quadratic controller feeds back measured, noisy signals; force, position and tilt are recorded. The
simulator is unstable, so the errors are those of one-step predictions. Values are drawn anew for every seed.

    python -m problems.balanced_pendulum                 20 cases with friction, 5 without
    python -m problems.balanced_pendulum --cases 4       4 with friction, 1 without
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import solve_discrete_are

from pilfr_casadi import Parameter, Port, Recording, Simulator

from .simulated_cases import Flow, advance, case_parser, diagnose_case

DT, SAMPLES, FINE = 0.01, 2000, 20  # s, samples, steps of the truth in a sample
GRAVITY = 9.81
NOISE = np.array([2e-4, 5e-4])  # m, rad
FRICTION = ("coulomb_friction", "stribeck_friction")


def simulator(values: Mapping[str, float]) -> Simulator:
    """Make the design office's simulator: cart and pendulum with viscous friction only."""

    def masses(x: Any, p: Any) -> tuple[Any, Any, Any]:
        s, c = ca.sin(x.angle), ca.cos(x.angle)
        return s, c, p.M + p.m * s**2

    def dynamics(x: Any, u: Any, p: Any) -> dict[str, Any]:
        s, c, moved = masses(x, p)
        v = (u.force - p.d * x.v + p.m * p.l * x.w**2 * s - p.m * GRAVITY * s * c) / moved
        return {"pos": x.v, "angle": x.w, "v": v, "w": (GRAVITY * s - c * v) / p.l}

    def rail(x: Any, p: Any) -> dict[str, Any]:
        _, c, moved = masses(x, p)
        return {"v": -1 / moved, "w": c / (p.l * moved)}

    def joint(x: Any, p: Any) -> dict[str, Any]:
        _, c, moved = masses(x, p)
        return {"v": c / (p.l * moved), "w": -(p.M + p.m) / (p.m * p.l**2 * moved)}

    units = {"M": "kg", "m": "kg", "l": "m", "d": "N s/m"}
    bounds = {"M": (0.3, 3.0), "m": (0.05, 0.8), "l": (0.1, 1.5), "d": (0.0, 20.0)}
    return Simulator(
        dynamics,
        lambda x: {"position": x.pos, "tilt": x.angle},
        states=("pos", "angle", "v", "w"),
        inputs=("force",),
        parameters={k: Parameter(values[k], unit=units[k], bounds=bounds[k]) for k in units},
        ports=(
            Port("rail", into=rail, across=lambda x: x.pos, rate=lambda x: x.v, unit="N", across_unit="m"),
            Port("joint", into=joint, across=lambda x: x.angle, rate=lambda x: x.w, unit="N m", across_unit="rad"),
        ),
        hold="zero",
        units={"force": "N", "position": "m", "tilt": "rad"},
    )


def recorded(seed: int, kind: str) -> tuple[Simulator, Recording, Recording]:
    """Draw a machine; return its simulator, with values off by up to a fifth, a training and a test recording."""
    rng = np.random.default_rng(seed)
    spans = {"M": (0.6, 1.5), "m": (0.1, 0.4), "l": (0.25, 0.6), "d": (1.0, 5.0)}
    true = {name: float(rng.uniform(*span)) for name, span in spans.items()}
    flow, gain = _truth(true, kind, rng.uniform(0.5, 2.0)), _controller(true)
    given = {name: value * rng.uniform(0.8, 1.25) for name, value in true.items()}
    train, test = (_run(flow, gain, rng) for _ in range(2))
    return simulator(given), train, test


def _truth(p: Mapping[str, float], kind: str, size: float) -> Flow:
    """Make the true dynamics, with the knee of the friction at 1 mm/s."""
    peak = 0.8 if kind == "stribeck_friction" else 0.0
    size = size if kind in FRICTION else 0.0

    def flow(x: np.ndarray, u: float) -> np.ndarray:
        _, angle, v, w = x
        s, c = np.sin(angle), np.cos(angle)
        friction = size * np.tanh(v / 1e-3) * (1 + peak * np.exp(-((v / 0.05) ** 2)))
        push = u - p["d"] * v - friction + p["m"] * p["l"] * w**2 * s
        faster = (push - p["m"] * GRAVITY * s * c) / (p["M"] + p["m"] * s**2)
        return np.array([v, w, faster, (GRAVITY * s - c * faster) / p["l"]])

    return flow


def _controller(p: Mapping[str, float]) -> np.ndarray:
    """Compute the gains (4,) of a linear-quadratic controller of the pendulum without friction."""
    flow, small = _truth(p, "none", 0.0), 1e-6
    a = np.column_stack([flow(small * unit, 0.0) / small for unit in np.eye(4)])
    b = flow(np.zeros(4), small)[:, None] / small
    step, push = np.eye(4) + DT * a + DT**2 / 2 * a @ a, DT * b + DT**2 / 2 * a @ b
    s = solve_discrete_are(step, push, np.diag([20.0, 50.0, 1.0, 1.0]), np.eye(1))
    return np.asarray(np.linalg.solve(1 + push.T @ s @ push, push.T @ s @ step)[0])


def _run(flow: Flow, gain: np.ndarray, rng: np.random.Generator) -> Recording:
    """Balance the pendulum along a random reference, with a dither on the force."""
    t, lines = DT * np.arange(SAMPLES), rng.uniform(0.05, 0.6, 8)
    reference = np.sum(np.sin(2 * np.pi * np.outer(t, lines) + rng.uniform(0, 6.3, 8)), axis=1) / 8
    dither, noise = rng.normal(0, 1.0, SAMPLES), NOISE * rng.standard_normal((SAMPLES, 2))
    x, last = np.zeros(4), np.zeros(2)
    y, u = np.zeros((SAMPLES, 2)), np.zeros((SAMPLES, 1))
    for k in range(SAMPLES):
        y[k] = x[:2] + noise[k]
        rates = (y[k] - last) / DT if k else np.zeros(2)
        last = y[k]
        seen = np.append(y[k] - [reference[k], 0.0], (rates + x[2:]) / 2)
        u[k] = dither[k] - gain @ seen
        x = advance(flow, x, u[k, 0], DT, FINE)
    return Recording(u, y, DT, ("force",), ("position", "tilt"), initial="estimate", hold="zero")


def main(arguments: Sequence[str] | None = None) -> int:
    """Diagnose every case; print one line each, and the number of right answers."""
    options = case_parser(__doc__, 20, "cases with friction; a quarter as many without").parse_args(arguments)
    kinds = [FRICTION[i % 2] for i in range(options.cases)] + ["none"] * (options.cases // 4)
    right = exact = 0
    for seed, kind in list(enumerate(kinds))[options.first :]:
        answer = diagnose_case(recorded(seed, kind), options.workers)
        same = answer.is_right("rail", kind if kind in FRICTION else "")
        exact += same
        right += same or (kind in FRICTION and any(answer.is_right("rail", law) for law in FRICTION))
        answer.show(f"{seed:3} {kind:17}")
    print(f"{right} of {len(kinds) - options.first} right, {exact} with the very law")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
