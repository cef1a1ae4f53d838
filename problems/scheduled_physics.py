"""A carriage whose missing friction or damping varies with a temperature, a pressure, the position or the time.

A pneumatic piston drives a carriage against a spring. The simulator has inertia, spring, damper and piston. What it
lacks varies with one signal by a factor of two to five: a recorded temperature, which its equations do not read; the
pressure, which they do; the position along the guide; or the time, as bearings wear. It does so in a line,
exponentially, or in a parabola with its vertex in the middle. Values are drawn anew for every seed. The truth is
integrated apart from the package.

    python -m problems.scheduled_physics                  60 rigs
    python -m problems.scheduled_physics --cases 8
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pilfr_casadi import Parameter, Port, Recording, Simulator

from .simulated_cases import case_parser, diagnose_case, numbered, random_sines, trajectory

DT, SAMPLES, FINE = 0.005, 3000, 20  # s, samples, steps of the truth in a sample
KNEE = 2e-3  # m/s, within which the friction reverses
NOISE = 2e-3  # of the output's deviation
SIGNALS = ("temperature", "pressure", "z", "t")
LAWS = ("coulomb_friction", "viscous_damping")
PROFILES = ("line", "exponential", "parabola")


def simulator(values: Mapping[str, float], thermometer: bool) -> Simulator:
    """Make the simulator: a carriage on a spring and a damper, driven by a piston of known area."""
    units = {"m": "kg", "k": "N/m", "d": "N s/m", "A": "m^2"}
    most = {"k": 1e5, "d": 1e3}  # the others are known
    guide = Port("guide", lambda p: {"v": -1 / p.m}, lambda x: x.s, lambda x: x.v, "N", "m")
    inputs = ("pressure", *(["temperature"] if thermometer else []))
    return Simulator(
        lambda x, u, p: {"s": x.v, "v": (p.A * u.pressure - p.k * x.s - p.d * x.v) / p.m},
        lambda x: {"travel": x.s},
        states=("s", "v"),
        inputs=inputs,
        parameters={
            n: Parameter(values[n], unit, (0.0, most.get(n, np.inf)), fixed=n not in most) for n, unit in units.items()
        },
        ports=(guide,),
        hold="zero",
        units={"pressure": "Pa", "travel": "m"} | ({"temperature": "degC"} if thermometer else {}),
    )


def recorded(seed: int, law: str, signal: str, profile: str) -> tuple[Simulator, Recording, Recording]:
    """Draw a rig; return its simulator, with values off by up to a quarter, a training and a test recording."""
    rng = np.random.default_rng([seed, LAWS.index(law), SIGNALS.index(signal)])
    true = {"m": rng.uniform(3, 8), "A": 3e-4, "k": rng.uniform(1000, 3000), "d": rng.uniform(10, 30)}
    low = rng.uniform(3.0, 8.0) if law == "coulomb_friction" else rng.uniform(10.0, 30.0)
    ends = (low, low * rng.uniform(2.0, 5.0))
    given = {n: v * (rng.uniform(0.8, 1.25) if n in "kd" else 1.0) for n, v in true.items()}
    ends = ends if rng.random() < 0.5 else ends[::-1]
    train, test = (run(true, law, signal, profile, ends, rng) for _ in range(2))
    return simulator(given, signal == "temperature"), train, test


def strength(share: float, profile: str, ends: tuple[float, float]) -> float:
    """Compute what is missing at a share of the signal's range; a parabola has the second value at both ends."""
    share = max(share, -0.2)
    if profile == "exponential":
        return ends[0] * (ends[1] / ends[0]) ** share
    return ends[0] + ((2 * share - 1) ** 2 if profile == "parabola" else share) * (ends[1] - ends[0])


def run(
    p: Mapping[str, float], law: str, signal: str, profile: str, ends: tuple[float, float], rng: np.random.Generator
) -> Recording:
    """Drive a rig with a random pressure; `ends` are the values of what is missing."""
    t = DT * np.arange(SAMPLES)
    pressure = 3e5 + random_sines(rng, t, (0.1, 8.0), 25, 2.4e5, roll_off=0.3)
    temperature = 40 - 20 * np.exp(-t / rng.uniform(3, 8)) + random_sines(rng, t, (0.03, 0.1), 3, 3.0)
    at_rest = p["A"] * 3e5 / p["k"]

    def flow(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        s, v = x
        value, first, last = {
            "temperature": (u[1], 20.0, 45.0),
            "pressure": (u[0], 0.6e5, 5.4e5),
            "z": (s, 0.3 * at_rest, 1.8 * at_rest),
            "t": (u[2], 0.0, t[-1]),
        }[signal]
        size = strength((value - first) / (last - first), profile, ends)
        w = size * (np.tanh(v / KNEE) if law == "coulomb_friction" else v)
        return np.array([v, (p["A"] * u[0] - p["k"] * s - p["d"] * v - w) / p["m"]])

    known = np.column_stack([pressure, temperature, t])
    y = trajectory(flow, np.array([p["A"] * pressure[0] / p["k"], 0.0]), known, DT, FINE)[:, 0]
    y += NOISE * np.std(y) * rng.standard_normal(SAMPLES)
    names = ("pressure", "temperature")[: 1 + (signal == "temperature")]
    return Recording(known[:, : len(names)], y, DT, names, ("travel",), hold="zero")


def main(arguments: Sequence[str] | None = None) -> int:
    """Diagnose every rig; print one line each, and the numbers of right laws and of right signals."""
    options = case_parser(__doc__, 60).parse_args(arguments)
    counts = dict.fromkeys(("law and signal", "law", "unsure", "wrong"), 0)
    for case in numbered(options):
        signal, rest = SIGNALS[case % len(SIGNALS)], case // len(SIGNALS)
        law, seed = LAWS[rest % len(LAWS)], rest // len(LAWS)
        profile = PROFILES[seed % len(PROFILES)]
        answer = diagnose_case(recorded(seed, law, signal, profile), options.workers)
        right = answer.named == [("guide", law)]
        told = right and answer.found.effects[0].form.endswith(f"by {signal}")
        judged = "law and signal" if told else "law" if right else "wrong" if answer.found.sure else "unsure"
        counts[judged] += 1
        answer.show(f"{case:3} {law:16} by {signal:12} {profile:12} {judged:14}")
    print(", ".join(f"{name} {count}" for name, count in counts.items()))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
