"""Machines with a parameter that varies with a signal, which their simulators take for a constant.

- `winding`: the resistance of a motor's winding grows by 20 to 50 % with a recorded temperature.
- `magnet`: the torque constant of the same motor falls by 10 to 25 % with it, in both equations that it stands in.
- `coil`: the force constant of a loudspeaker falls with the deflection, in both equations.
- `heat`: the resistance of such a motor grows by 30 to 80 % with a temperature that nobody records, which the square of
  its own current drives.
- `tank`: the mass of a carriage with a tank falls by 20 to 50 % in the time of a recording.

Values are drawn anew for every seed. The truth is integrated apart from the package.

    python -m problems.varying_parameters                  20 machines
    python -m problems.varying_parameters --cases 4
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pilfr_casadi import Parameter, Port, Recording, Simulator

from .simulated_cases import Drawn, case_parser, diagnose_case, numbered, random_sines, trajectory

NOISE = 5e-3  # of each output's deviation
SAMPLES, FINE = 1500, 10  # samples, and steps of the truth in a sample
VARIES = {
    "winding": ("R", "temperature"),
    "magnet": ("K", "temperature"),
    "coil": ("K", "x"),
    "heat": ("R", "the heat of i"),
    "tank": ("m", "t"),
}


def free(values: Mapping[str, float], rng: np.random.Generator) -> dict[str, Parameter]:
    """Make free parameters whose values are off by up to a quarter."""
    return {n: Parameter(v * rng.uniform(0.8, 1.25), bounds=(v / 5, 5 * v)) for n, v in values.items()}


def measured(rng: np.random.Generator, x: np.ndarray) -> np.ndarray:
    """Add the sensors' noise."""
    return np.asarray(x + NOISE * x.std(axis=0) * rng.standard_normal(x.shape))


def motor_simulator(
    inputs: tuple[str, ...], parameters: Mapping[str, Parameter], inductance: float, inertia: float
) -> Simulator:
    """Make the simulator of a motor with constant parameters."""
    return Simulator(
        lambda x, u, p: {
            "i": (u.voltage - p.R * x.i - p.K * x.w) / inductance,
            "w": (p.K * x.i - p.c * x.w) / inertia,
        },
        lambda x: {"current": x.i, "speed": x.w},
        states=("i", "w"),
        inputs=inputs,
        parameters=parameters,
        ports=(Port("bearing", {"w": -1 / inertia}, lambda x: x.w, lambda x: x.w, "N m", "rad/s"),),
    )


def motor(kind: str, rng: np.random.Generator) -> Drawn:
    """Draw a motor that grows warm in training and cools down in the test."""
    dt, inertia = 5e-3, 2e-3
    p = {"R": rng.uniform(0.8, 2.0), "K": rng.uniform(0.06, 0.1), "c": rng.uniform(3e-3, 8e-3)}
    inductance = p["R"] * rng.uniform(0.02, 0.05)
    name, _ = VARIES[kind]
    change = rng.uniform(0.2, 0.5) if kind == "winding" else -rng.uniform(0.1, 0.25)

    def flow(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        now = p | {name: p[name] * (1 + change * (u[1] - 20) / 60)}
        return np.array(
            [(u[0] - now["R"] * x[0] - now["K"] * x[1]) / inductance, (now["K"] * x[0] - now["c"] * x[1]) / inertia]
        )

    def recorded(begin: float, end: float) -> Recording:
        t = dt * np.arange(SAMPLES)
        warm = end + (begin - end) * np.exp(-t / rng.uniform(2, 4))
        u = np.column_stack([random_sines(rng, t, (0.1, 8.0), 25, 10.0), warm])
        y = measured(rng, trajectory(flow, np.zeros(2), u, dt, FINE))
        return Recording(u, y, dt, ("voltage", "temperature"), ("current", "speed"), initial="zero", hold="zero")

    simulator = motor_simulator(("voltage", "temperature"), free(p, rng), inductance, inertia)
    return simulator, recorded(20, 80), recorded(75, 30)


def warming(_: str, rng: np.random.Generator) -> Drawn:
    """Draw a motor that its own current heats, in bursts; nobody records its temperature."""
    dt, inertia = 5e-3, 2e-3
    p = {"R": rng.uniform(0.8, 2.0), "K": rng.uniform(0.06, 0.1), "c": rng.uniform(3e-3, 8e-3)}
    inductance, slow = p["R"] * rng.uniform(0.02, 0.05), rng.uniform(0.6, 2.0)
    heat = rng.uniform(0.3, 0.8) / (4.0 / p["R"]) ** 2

    def flow(x: np.ndarray, u: float) -> np.ndarray:
        i, w, warm = x
        resistance = p["R"] * (1 + warm)
        return np.array(
            [
                (u - resistance * i - p["K"] * w) / inductance,
                (p["K"] * i - p["c"] * w) / inertia,
                (heat * i**2 - warm) / slow,
            ]
        )

    def recorded() -> Recording:
        t = dt * np.arange(SAMPLES)
        bursts = np.repeat(rng.uniform(0.2, 1.0, SAMPLES // 150), 150)
        u = bursts * random_sines(rng, t, (0.1, 8.0), 25, 14.0)
        y = measured(rng, trajectory(flow, np.zeros(3), u, dt, FINE)[:, :2])
        return Recording(u, y, dt, ("voltage",), ("current", "speed"), initial="zero", hold="zero")

    simulator = motor_simulator(("voltage",), free(p, rng), inductance, inertia)
    return simulator, recorded(), recorded()


def loudspeaker(_: str, rng: np.random.Generator) -> Drawn:
    """Draw a loudspeaker whose coil leaves the magnet's gap."""
    dt, mass = 2.5e-4, rng.uniform(0.008, 0.016)
    p = {"R": rng.uniform(4, 8), "K": rng.uniform(4, 7), "k": rng.uniform(1500, 3000), "d": rng.uniform(0.7, 1.5)}
    inductance, reach, fall = 6e-4, rng.uniform(3e-3, 4e-3), rng.uniform(0.2, 0.4)

    def flow(z: np.ndarray, u: float) -> np.ndarray:
        i, x, v = z
        gain = p["K"] * (1 - fall * (x / reach) ** 2 / (1 + 0.3 * (x / reach) ** 2))
        return np.array([(u - p["R"] * i - gain * v) / inductance, v, (gain * i - p["k"] * x - p["d"] * v) / mass])

    def recorded(peak: float) -> Recording:
        u = random_sines(rng, dt * np.arange(SAMPLES), (8.0, 220.0), 40, peak)
        y = measured(rng, trajectory(flow, np.zeros(3), u, dt, FINE)[:, 1::-1])
        return Recording(u, y, dt, ("voltage",), ("displacement", "current"), initial="zero", hold="zero")

    simulator = Simulator(
        lambda x, u, p: {
            "i": (u.voltage - p.R * x.i - p.K * x.v) / inductance,
            "x": x.v,
            "v": (p.K * x.i - p.k * x.x - p.d * x.v) / mass,
        },
        lambda x: {"displacement": x.x, "current": x.i},
        states=("i", "x", "v"),
        inputs=("voltage",),
        parameters=free(p, rng),
        ports=(
            Port("suspension", {"v": -1 / mass}, lambda x: x.x, lambda x: x.v, "N", "m"),
            Port("coil", {"i": -1 / inductance}, lambda x: x.i, unit="V", across_unit="A"),
        ),
    )
    return simulator, recorded(22.0), recorded(18.0)


def carriage(_: str, rng: np.random.Generator) -> Drawn:
    """Draw a carriage on a spring whose tank runs empty."""
    dt = 0.01
    p = {"m": rng.uniform(3, 8), "k": rng.uniform(800, 2000), "d": rng.uniform(10, 30)}
    lost = rng.uniform(0.2, 0.5) / (SAMPLES * dt)

    def flow(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.array([x[1], (u[0] - p["k"] * x[0] - p["d"] * x[1]) / (p["m"] * (1 - lost * u[1]))])

    def recorded() -> Recording:
        t = dt * np.arange(SAMPLES)
        u = random_sines(rng, t, (0.3, 8.0), 30, 200.0)
        y = measured(rng, trajectory(flow, np.zeros(2), np.column_stack([u, t]), dt, FINE)[:, :1])
        return Recording(u, y, dt, ("force",), ("travel",), initial="zero", hold="zero")

    simulator = Simulator(
        lambda x, u, p: {"s": x.v, "v": (u.force - p.k * x.s - p.d * x.v) / p.m},
        lambda x: {"travel": x.s},
        states=("s", "v"),
        inputs=("force",),
        parameters=free(p, rng),
        ports=(Port("guide", lambda p: {"v": -1 / p.m}, lambda x: x.s, lambda x: x.v, "N", "m"),),
    )
    return simulator, recorded(), recorded()


MACHINES = {"winding": motor, "magnet": motor, "coil": loudspeaker, "heat": warming, "tank": carriage}


def main(arguments: Sequence[str] | None = None) -> int:
    """Diagnose every machine; print one line each, and the numbers of right answers, parameters and wrong names."""
    options = case_parser(__doc__, 20).parse_args(arguments)
    counts = dict.fromkeys(("right", "parameter", "unsure", "wrong"), 0)
    for case in numbered(options):
        kind = list(VARIES)[case % len(VARIES)]
        answer = diagnose_case(MACHINES[kind](kind, np.random.default_rng([29, case])), options.workers)
        name, by = VARIES[kind]
        parameter = answer.named == [(f"parameter:{name}", "varying_parameter")]
        right = parameter and answer.found.effects[0].form == f"scheduled by {by}"
        judged = "right" if right else "parameter" if parameter else "wrong" if answer.found.sure else "unsure"
        counts[judged] += 1
        answer.show(f"{case:3} {kind:8} {judged:10}")
    print(", ".join(f"{name} {count}" for name, count in counts.items()))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
