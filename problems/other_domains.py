"""Small rigs outside mechanics whose simulators lack one law, and complete ones (`python -m problems.other_domains`).

| rig | its simulator | hidden kinds |
| --- | --- | --- |
| battery | linear open-circuit voltage, a resistor, a pair of R and C | a curved open-circuit voltage; hysteresis |
| oven | heater and block, losses in proportion to the temperature | radiation; free convection; a slow thermistor |
| tank | outflow in proportion to the level, linear pump valve | an orifice; an equal-percentage valve |
| coil | constant inductance, over the current | a core that saturates; the dead time of a bridge |
| core | constant inductance, over the flux | hysteresis of the iron |
| clamp | resistors and a capacitor | a diode; a clamp of two diodes |
| heater | a mixed volume of water that flows through, heated | a pipe before the thermometer |

The truths are integrated here, without the catalogue. All values are drawn anew for every seed, and the simulator's are
off by up to a fifth. Each output has white noise of 0.1 to 0.5 % of its deviation. An answer is right if it names the
hidden law alone, at its place; a simulator that lacks nothing has to be called complete.

    python -m problems.other_domains                  3 cases of each kind, and one complete one of each rig
    python -m problems.other_domains --cases 1        one of each
    python -m problems.other_domains radiation diode  some kinds
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pilfr_casadi import Parameter, Port, Recording, Simulator

from .simulated_cases import Flow, case_parser, diagnose_case, numbered, trajectory

Array = np.ndarray
SAMPLES, FINE = 1500, 20  # samples of a recording, steps of the truth in a sample
OFF = 0.2  # largest error of a given value
ROOM = 293.0  # K


@dataclass(frozen=True, eq=False)
class Rig:
    """A simulator, and the truth of it.

    Attributes
    ----------
    flow : callable
        From states and inputs to the states' derivatives.
    outputs : callable
        From all states (M, n_x) and inputs (M, n_u) to the outputs (M, n_y) without noise.
    drive : callable
        Draws the inputs (M, n_u) of a recording.
    start : array, shape (n_x,)
        The known state at the beginning.
    """

    simulator: Simulator
    flow: Flow
    outputs: Callable[[Array, Array], Array]
    drive: Callable[[np.random.Generator], Array]
    dt: float
    start: Array

    def record(self, rng: np.random.Generator) -> Recording:
        """Make a recording with noise."""
        u = self.drive(rng)
        y = self.outputs(trajectory(self.flow, self.start, u, self.dt, FINE), u)
        noise = rng.uniform(1e-3, 5e-3) * np.std(y, axis=0) * rng.standard_normal(y.shape)
        own = self.simulator
        initial = self.start[: len(own.states)]
        return Recording(u, y + noise, self.dt, own.inputs, own.output_names, initial=initial, hold="zero")


def levels(rng: np.random.Generator, low: float, high: float, shortest: int, longest: int) -> Array:
    """Random levels, each held for some samples, (SAMPLES, 1)."""
    out = np.empty(0)
    while len(out) < SAMPLES:
        out = np.append(out, np.full(rng.integers(shortest, longest + 1), rng.uniform(low, high)))
    return out[:SAMPLES, None]


def guesses(rng: np.random.Generator, true: Mapping[str, float], units: Mapping[str, str]) -> dict[str, Parameter]:
    """Parameters of the simulator, off by up to a fifth."""
    given = {name: value * rng.uniform(1 - OFF, 1 + OFF) for name, value in true.items()}
    return {k: Parameter(v, unit=units[k], bounds=(v / 4, 4 * v)) for k, v in given.items()}


def battery(rng: np.random.Generator, kind: str) -> Rig:
    """A cell, half full at first, that is charged and discharged to random depths; its state is the charge moved."""
    capacity, dt = 3600 * rng.uniform(2.0, 4.0), 15.0
    p = {"V_0": 3.6, "k": rng.uniform(0.4, 0.8), "R": 0.03, "R_1": 0.02, "C_1": rng.uniform(2e3, 6e3)}
    knees, thresholds = rng.uniform(0.15, 0.3, 2), np.array([0.02, 0.06, 0.15])
    loops = rng.uniform(0.03, 0.06) * np.array([1.5, 1.0, 0.4]) / thresholds / 3

    def outputs(x: Array, u: Array) -> Array:
        soc = 0.5 + x[:, 0]
        y = p["V_0"] + p["k"] * x[:, 0] + p["R"] * u[:, 0] + x[:, 1]
        if kind == "voltage-curve":
            y = y - knees[0] * np.exp(-soc / 0.06) + knees[1] * np.exp(-(1 - soc) / 0.08)
        if kind == "voltage-loops":
            q, force = np.full(3, soc[0]), np.empty(len(soc))
            for i, z in enumerate(soc):
                q = np.clip(q, z - thresholds, z + thresholds)
                force[i] = loops @ (z - q)
            y = y + force
        return y[:, None]

    def drive(rng: np.random.Generator) -> Array:
        out, soc = np.empty(0), 0.5
        while len(out) < SAMPLES:
            goal, size = rng.uniform(0.03, 0.97), rng.uniform(0.5, 1.5) * capacity / 3600
            n = max(int(abs(goal - soc) * capacity / (size * dt)), 1)
            out = np.concatenate([out, np.full(n, np.sign(goal - soc) * size), np.zeros(rng.integers(2, 15))])
            soc += np.sign(goal - soc) * size * n * dt / capacity
        return out[:SAMPLES, None]

    simulator = Simulator(
        lambda x, u, p: {"charge": u.current / capacity, "v_1": (u.current - x.v_1 / p.R_1) / p.C_1},
        lambda x, u, p: {"voltage": p.V_0 + p.k * x.charge + p.R * u.current + x.v_1},
        states=("charge", "v_1"),
        inputs=("current",),
        parameters=guesses(rng, p, {"V_0": "V", "k": "V", "R": "Ohm", "R_1": "Ohm", "C_1": "F"}),
        ports=(Port("electrode", {"voltage": 1.0}, lambda x: x.charge, unit="V", across_unit="1"),),
        units={"current": "A", "voltage": "V"},
    )

    def flow(x: Array, u: Array) -> Array:
        return np.array([u[0] / capacity, (u[0] - x[1] / p["R_1"]) / p["C_1"]])

    return Rig(simulator, flow, outputs, drive, dt, np.zeros(2))


def oven(rng: np.random.Generator, kind: str) -> Rig:
    """A block with a heater inside, in a room of known temperature; the block's sensor may lag."""
    p = {"C_h": 40.0, "C_b": rng.uniform(80, 160), "G_h": rng.uniform(1.5, 3.0), "G_b": rng.uniform(0.15, 0.3)}
    glow, rise, lag = rng.uniform(0.15, 0.4), rng.uniform(0.05, 0.12), rng.uniform(80.0, 160.0)

    def flow(x: Array, u: Array) -> Array:
        through, loss = p["G_h"] * (x[0] - x[1]), p["G_b"] * x[1]
        if kind == "radiation":
            loss += glow * ((x[1] + ROOM) ** 4 - ROOM**4) / (4 * ROOM**3)
        if kind == "convection":
            loss += rise * np.sign(x[1]) * abs(x[1]) ** 1.25
        return np.array([(u[0] - through) / p["C_h"], (through - loss) / p["C_b"], (x[1] - x[2]) / lag])

    simulator = Simulator(
        lambda x, u, p: {
            "heater": (u.power - p.G_h * (x.heater - x.block)) / p.C_h,
            "block": (p.G_h * (x.heater - x.block) - p.G_b * x.block) / p.C_b,
        },
        lambda x: {"T_heater": x.heater, "T_block": x.block},
        states=("heater", "block"),
        inputs=("power",),
        parameters=guesses(rng, p, {"C_h": "J/K", "C_b": "J/K", "G_h": "W/K", "G_b": "W/K"}),
        ports=(Port("surface", lambda p: {"block": -1 / p.C_b}, lambda x: x.block, unit="W", across_unit="K"),),
        units={"power": "W", "T_heater": "K", "T_block": "K"},
    )
    most = rng.uniform(120, 200)
    seen = [0, 2] if kind == "sensor-lag" else [0, 1]
    return Rig(
        simulator,
        flow,
        lambda x, u: x[:, seen],
        lambda rng: levels(rng, 0.0, most, 20, 150),
        10.0,
        np.zeros(3),
    )


def tank(rng: np.random.Generator, kind: str) -> Rig:
    """A tank with an outlet, fed through a valve."""
    area, height = rng.uniform(0.05, 0.15), 1.0
    p = {"k_in": rng.uniform(1.5e-3, 3e-3), "k_out": rng.uniform(1e-3, 2e-3), "a": area}
    steep, laminar = np.log(rng.uniform(15, 40)), 0.02

    def flow(x: Array, u: Array) -> Array:
        opening = (np.exp(steep * u[0]) - 1) / (np.exp(steep) - 1) if kind == "valve" else u[0]
        level = x[0] / (x[0] ** 2 + laminar**2) ** 0.25 if kind == "orifice" else x[0]
        return np.array([(p["k_in"] * opening - p["k_out"] * level) / p["a"]])

    simulator = Simulator(
        lambda x, u, p: {"level": (p.k_in * u.opening - p.k_out * x.level) / p.a},
        lambda x: {"level": x.level},
        states=("level",),
        inputs=("opening",),
        parameters={
            **guesses(rng, {"k_in": p["k_in"]}, {"k_in": "m^3/s"}),
            "k_out": Parameter(p["k_out"] * rng.uniform(1 - OFF, 1 + OFF), unit="m^2/s", bounds=(0.0, 0.01)),
            "a": Parameter(area, unit="m^2", fixed=True),
        },
        ports=(Port("outlet", lambda p: {"level": -1 / p.a}, lambda x: x.level, unit="m^3/s", across_unit="m"),),
        units={"opening": "1", "level": "m"},
    )
    most = 0.95 * min(height * p["k_out"] / p["k_in"] * 1.3, 1.0)
    return Rig(
        simulator,
        flow,
        lambda x, u: x,
        lambda rng: levels(rng, 0.0, 1.0 if kind == "valve" else most, 10, 80),
        4.0,
        np.array([0.2]),
    )


def coil(rng: np.random.Generator, kind: str) -> Rig:
    """A coil at a voltage; its core may saturate, or the bridge that feeds it drop a voltage against the current."""
    p = {"R": rng.uniform(0.5, 2.0), "L": rng.uniform(0.02, 0.08)}
    most, air = rng.uniform(8, 14) * p["R"], rng.uniform(0.1, 0.3) * p["L"]
    knee = rng.uniform(3.0, 5.0)  # A
    drop, sharp = (rng.uniform(0.05, 0.15) * most, rng.uniform(0.05, 0.3)) if kind == "dead-time" else (0.0, 1.0)

    def flow(x: Array, u: Array) -> Array:
        inductance = air + (p["L"] - air) / (1 + (x[0] / knee) ** 2) if kind == "saturating-core" else p["L"]
        return np.array([(u[0] - p["R"] * x[0] - drop * np.tanh(x[0] / sharp)) / inductance])

    simulator = Simulator(
        lambda x, u, p: {"current": (u.voltage - p.R * x.current) / p.L},
        lambda x: {"current": x.current},
        states=("current",),
        inputs=("voltage",),
        parameters=guesses(rng, p, {"R": "Ohm", "L": "H"}),
        ports=(Port("core", lambda p: {"current": -1 / p.L}, lambda x: x.current, unit="V", across_unit="A"),),
        units={"voltage": "V", "current": "A"},
    )
    dt = 0.1 * p["L"] / p["R"]
    return Rig(simulator, flow, lambda x, u: x, lambda rng: levels(rng, -most, most, 5, 40), dt, np.zeros(1))


def core(rng: np.random.Generator, kind: str) -> Rig:
    """The flux of a transformer at no load; its iron may have hysteresis (Bouc-Wen)."""
    p = {"R": rng.uniform(0.5, 2.0), "L": rng.uniform(0.02, 0.08)}
    most, dt = rng.uniform(5, 10) * p["R"], 0.1 * p["L"] / p["R"]
    turn = rng.uniform(0.03, 0.1) * most * p["L"] / p["R"]  # V s
    wide = rng.uniform(0.5, 1.0) / p["L"] if kind == "iron-loops" else 0.0

    def flow(x: Array, u: Array) -> Array:
        induced = u[0] - p["R"] * (x[0] / p["L"] + wide * x[1])
        falling = (0.5 + 0.5 * np.sign(x[1] * induced)) * abs(x[1]) / turn
        return np.array([induced, induced * (1 - falling)])

    simulator = Simulator(
        lambda x, u, p: {"flux": u.voltage - p.R * x.flux / p.L},
        lambda x, p: {"current": x.flux / p.L},
        states=("flux",),
        inputs=("voltage",),
        parameters=guesses(rng, p, {"R": "Ohm", "L": "H"}),
        ports=(Port("core", lambda p: {"flux": -p.R, "current": 1.0}, lambda x: x.flux, unit="A", across_unit="V s"),),
        units={"voltage": "V", "current": "A"},
    )
    return Rig(
        simulator,
        flow,
        lambda x, u: x[:, :1] / p["L"] + wide * x[:, 1:],
        lambda rng: levels(rng, -most, most, 5, 40),
        dt,
        np.zeros(2),
    )


def clamp(rng: np.random.Generator, kind: str) -> Rig:
    """A capacitor that is charged through a resistor, beside a load; diodes may hold its voltage."""
    p = {"R": rng.uniform(0.5e3, 2e3), "R_load": rng.uniform(2e3, 6e3), "C": rng.uniform(0.5e-6, 2e-6)}
    thermal, saturation = rng.uniform(0.04, 0.05), 10 ** rng.uniform(-9.5, -8)  # V, A
    most, dt = rng.uniform(2.0, 4.0), 0.1 * p["R"] * p["C"]

    def flow(x: Array, u: Array) -> Array:
        v = float(x[0])
        through = (u[0] - v) / p["R"] - v / p["R_load"]
        if kind in ("diode", "diode-pair"):
            through -= saturation * (np.exp(min(v / thermal, 40.0)) - 1)
        if kind == "diode-pair":
            through += saturation * (np.exp(min(-v / thermal, 40.0)) - 1)
        return np.array([through / p["C"]])

    simulator = Simulator(
        lambda x, u, p: {"v": ((u.source - x.v) / p.R - x.v / p.R_load) / p.C},
        lambda x: {"voltage": x.v},
        states=("v",),
        inputs=("source",),
        parameters=guesses(rng, p, {"R": "Ohm", "R_load": "Ohm", "C": "F"}),
        ports=(Port("load", lambda p: {"v": -1 / p.C}, lambda x: x.v, unit="A", across_unit="V"),),
        units={"source": "V", "voltage": "V"},
    )
    return Rig(simulator, flow, lambda x, u: x, lambda rng: levels(rng, -most, most, 5, 40), dt, np.zeros(1))


def heater(rng: np.random.Generator, kind: str) -> Rig:
    """A flow heater; a pipe of some length may lead from it to the thermometer."""
    heat, dt = 4180.0, 1.0  # J/(kg K), s
    p = {"mass": rng.uniform(0.5, 2.0), "loss": rng.uniform(2.0, 10.0)}
    held = rng.uniform(0.5, 2.0)  # kg in the pipe

    def flow(x: Array, u: Array) -> Array:
        gain = u[1] - p["loss"] * (x[0] - 20.0) + heat * u[0] * (u[2] - x[0])
        return np.array([gain / (heat * p["mass"])])

    def outputs(x: Array, u: Array) -> Array:
        passed = dt * np.concatenate([[0.0], np.cumsum(u[:-1, 0])])
        return np.interp(passed - (held if kind == "pipe" else 0.0), passed, x[:, 0])[:, None]

    def drive(rng: np.random.Generator) -> Array:
        mass, power, inlet = ((0.02, 0.2), (0.0, 8e3), (10.0, 20.0))
        return np.hstack([levels(rng, *mass, 40, 120), levels(rng, *power, 20, 80), levels(rng, *inlet, 60, 200)])

    simulator = Simulator(
        lambda x, u, p: {"T": (u.power - p.loss * (x.T - 20) + heat * u.flow * (u.inlet - x.T)) / (heat * p.mass)},
        lambda x: {"outlet": x.T},
        states=("T",),
        inputs=("flow", "power", "inlet"),
        parameters=guesses(rng, p, {"mass": "kg", "loss": "W/K"}),
        ports=(Port("wall", lambda p: {"T": -1 / (heat * p.mass)}, lambda x: x.T - 20, unit="W", across_unit="K"),),
        units={"flow": "kg/s", "power": "W", "inlet": "degC", "outlet": "degC"},
    )
    return Rig(simulator, flow, outputs, drive, dt, np.array([20.0]))


# kind -> rig, and the place and law to be named; no law where nothing is missing
KINDS: dict[str, tuple[Callable[[np.random.Generator, str], Rig], str, str]] = {
    "voltage-curve": (battery, "electrode", "static_curve"),
    "voltage-loops": (battery, "electrode", "hysteresis"),
    "radiation": (oven, "surface", "radiation"),
    "convection": (oven, "surface", "convection"),
    "sensor-lag": (oven, "sensor:T_block", "extra_mode"),
    "orifice": (tank, "outlet", "static_curve"),
    "valve": (tank, "actuator:opening", "static_curve"),
    "saturating-core": (coil, "core", "saturating_inductance"),
    "dead-time": (coil, "core", "static_curve"),
    "iron-loops": (core, "core", "hysteresis"),
    "diode": (clamp, "load", "static_curve"),
    "diode-pair": (clamp, "load", "static_curve"),
    "pipe": (heater, "sensor:outlet", "delay"),
}
COMPLETE = {f"complete {rig.__name__}": rig for rig in (battery, oven, tank, coil, core, clamp, heater)}


def recorded(kind: str, number: int) -> tuple[Simulator, Recording, Recording]:
    """Draw a rig; return its simulator, a training and a test recording."""
    seed = [sum(map(ord, kind)), number]
    rng = np.random.default_rng(seed)
    rig = KINDS[kind][0](rng, kind) if kind in KINDS else COMPLETE[kind](rng, kind)
    return rig.simulator, rig.record(rng), rig.record(rng)


def judge(kind: str, verdict: str, named: Sequence[tuple[str, str]]) -> str:
    """Judge an answer: right, unexplained or wrong."""
    if kind in COMPLETE:
        return "right" if verdict == "complete" else "wrong"
    if verdict == "unexplained":
        return "unexplained"
    return "right" if list(named) == [KINDS[kind][1:]] else "wrong"


def main(arguments: Sequence[str] | None = None) -> int:
    """Diagnose every case; print one line each, and a table by kind."""
    parser, names = case_parser(__doc__, 3, "of each kind that lacks something"), (*KINDS, *COMPLETE)
    parser.add_argument("kinds", nargs="*", choices=[*names, []], help="kinds; all by default")
    options = parser.parse_args(arguments)
    answers: dict[str, Counter[str]] = defaultdict(Counter)
    errors: dict[str, list[Array]] = defaultdict(list)
    for kind in options.kinds or names:
        for number in numbered(options) if kind in KINDS else [options.first]:
            answer = diagnose_case(recorded(kind, number), options.workers)
            judged = judge(kind, answer.found.verdict, answer.named)
            answers[kind][judged] += 1
            errors[kind].append(np.array(answer.errors))
            answer.show(f"{kind:16} {number:2} {judged:12}")
    print("\n" + table(answers, errors))
    return 0


def table(answers: Mapping[str, Counter[str]], errors: Mapping[str, Sequence[Array]]) -> str:
    """Answers by kind, with the median test errors before and after, and the noise."""
    lines = [f"{'kind':18}{'right':>7}{'unexplained':>13}{'wrong':>7}{'before':>10}{'after':>10}{'noise':>10}"]
    for kind, of in answers.items():
        figures = "".join(f"{v:10.4f}" for v in np.median(errors[kind], axis=0))
        lines.append(f"{kind:18}{of['right']:7d}{of['unexplained']:13d}{of['wrong']:7d}{figures}")
    total = sum((Counter(of) for of in answers.values()), Counter[str]())
    lines.append(f"{total['right']} of {total.total()} right, {total['wrong']} wrong")
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(main())
