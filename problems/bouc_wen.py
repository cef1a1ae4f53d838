"""An oscillator with a Bouc-Wen hysteresis that the simulator lacks: loops that stiffen, and loops that soften.

    m y'' + c y' + k y + z = u,    z' = α y' - β (γ |y'| z + δ y' |z|)

Case 0 has the values of the benchmark of Noël & Schoukens (2016), Hysteretic benchmark with a dynamic nonlinearity,
Workshop on Nonlinear System Identification Benchmarks; it stiffens, because γ + δ < 0. The others are drawn, every
other one so that it softens. Identified on a multisine of 5 to 150 Hz, and judged on a sweep from 20 to 50 Hz.

    python -m problems.bouc_wen --cases 6
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pilfr_casadi import Parameter, Port, Recording, Simulator

from .simulated_cases import Drawn, case_parser, diagnose_case, numbered, random_sines, trajectory

DT, SAMPLES, FINE = 1 / 750, 8192, 20  # s, samples, steps of the truth in a sample
MASS, DAMPING, STIFFNESS, ALPHA, BETA = 2.0, 10.0, 5e4, 5e4, 1e3  # kg, N s/m, N/m, N/m, 1/m
GAMMA, DELTA = 0.8, -1.1
NOISE = 8e-6  # m


def shape(seed: int) -> tuple[float, float]:
    """Draw γ and δ: those of the benchmark, or loops that stiffen (odd seeds) or soften."""
    rng = np.random.default_rng(seed)
    gamma = rng.uniform(0.5, 1.2)
    if not seed:
        return GAMMA, DELTA
    return gamma, gamma * (rng.uniform(-1.6, -1.2) if seed % 2 else rng.uniform(-0.3, 0.6))


def simulator(seed: int) -> Simulator:
    """Make the linear oscillator, its damping and stiffness off by up to a quarter."""
    off = np.random.default_rng([seed, 1]).uniform(0.8, 1.25, 2)
    return Simulator(
        lambda x, u, p: {"y": x.v, "v": (u.force - p.c * x.v - p.k * x.y) / p.m},
        lambda x: {"position": x.y},
        states=("y", "v"),
        inputs=("force",),
        parameters={
            "m": Parameter(MASS, unit="kg", fixed=True),
            "c": Parameter(DAMPING * off[0], unit="N s/m", bounds=(0, 500)),
            "k": Parameter(STIFFNESS * off[1], unit="N/m", bounds=(1e4, 3e5)),
        },
        ports=(Port("mount", lambda p: {"v": -1 / p.m}, lambda x: x.y, lambda x: x.v, unit="N", across_unit="m"),),
        units={"force": "N", "position": "m"},
    )


def recorded(seed: int) -> Drawn:
    """Return the simulator, a training recording and a test recording, both from rest."""
    rng, (gamma, delta) = np.random.default_rng([seed, 2]), shape(seed)
    t = DT * np.arange(SAMPLES)
    sines = random_sines(rng, t, (5.0, 150.0), 300, 1.0)
    sweep = 40 * np.sin(2 * np.pi * (20 * t + 15 * t**2 / t[-1]))

    def flow(x: np.ndarray, u: float) -> np.ndarray:
        y, v, z = x
        loop = ALPHA * v - BETA * (gamma * abs(v) * z + delta * v * abs(z))
        return np.array([v, (u - DAMPING * v - STIFFNESS * y - z) / MASS, loop])

    def record(u: np.ndarray) -> Recording:
        y = trajectory(flow, np.zeros(3), u, DT, FINE)[:, :1] + NOISE * rng.standard_normal((SAMPLES, 1))
        return Recording(u[:, None], y, DT, ("force",), ("position",), initial="zero", hold="zero")

    return simulator(seed), record(50 * sines / np.std(sines)), record(sweep)


def main(arguments: Sequence[str] | None = None) -> int:
    """Diagnose every case; print one line each, and the number of right answers."""
    options = case_parser(__doc__, 6).parse_args(arguments)
    right = 0
    for seed in numbered(options):
        answer, (gamma, delta) = diagnose_case(recorded(seed), options.workers), shape(seed)
        stiffens = gamma + delta < 0
        forms = {e.form for e in answer.found.effects}
        right += answer.is_right("mount", "hysteresis") and ("bouc_wen_stiffening" in forms) == stiffens
        answer.show(f"{seed:3} γ = {gamma:.2f}, δ = {delta:+.2f}, {'stiffens' if stiffens else 'softens'}:")
    print(f"{right} of {options.cases} right, with the form of the loops")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
