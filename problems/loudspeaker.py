"""A loudspeaker whose simulator is linear: the force factor and the suspension vary with the excursion.

    u = R_e i + L_e i' + Bl(x) x',    m x'' + R x' + K(x) x = Bl(x) i

with Bl(x) = Bl_0 (1 - a_1 x - a_2 x²) and K(x) = K_0 (1 - b_1 x + b_2 x²), the two dominant nonlinearities of a driver
(Klippel 2006, J. Audio Eng. Soc. 54(10)). Voltage, current and displacement are recorded. Values are drawn anew for
every seed.

    python -m problems.loudspeaker --cases 4
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pilfr_casadi import Parameter, Port, Recording, Simulator

from .simulated_cases import Drawn, case_parser, diagnose_case, numbered, random_sines, trajectory

DT, SAMPLES, FINE = 1 / 4000, 4000, 10  # s, samples, steps of the truth in a sample
RE, LE, MASS, DAMPING, STIFFNESS, FORCE_FACTOR = 6.8, 0.4e-3, 6.5e-3, 1.1, 1150.0, 5.2  # SI units
NOISE = 0.005  # over the deviation of each output


def simulator(seed: int) -> Simulator:
    """Make the linear driver, its values off by up to a tenth."""
    off = np.random.default_rng([seed, 1]).uniform(0.9, 1.1, 5)
    units = {"voltage": "V", "current": "A", "displacement": "m"}
    return Simulator(
        lambda x, u, p: {
            "i": (u.voltage - p.Re * x.i - p.Bl * x.v) / p.Le,
            "x": x.v,
            "v": (p.Bl * x.i - p.R * x.v - p.K * x.x) / p.M,
        },
        lambda x: {"current": x.i, "displacement": x.x},
        states=("i", "x", "v"),
        inputs=("voltage",),
        parameters={
            "Re": Parameter(RE * off[0], unit="Ohm", bounds=(3, 12)),
            "Le": Parameter(LE * off[1], unit="H", bounds=(1e-4, 2e-3)),
            "Bl": Parameter(FORCE_FACTOR * off[2], unit="N/A", bounds=(1, 12)),
            "R": Parameter(DAMPING * off[3], unit="N s/m", bounds=(0.1, 5)),
            "K": Parameter(STIFFNESS * off[4], unit="N/m", bounds=(300, 5000)),
            "M": Parameter(MASS, unit="kg", fixed=True),
        },
        ports=(Port("suspension", lambda p: {"v": -1 / p.M}, lambda x: x.x, lambda x: x.v, unit="N", across_unit="m"),),
        units=units,
    )


def recorded(seed: int) -> Drawn:
    """Return the simulator, a training recording and a test recording, both from rest."""
    rng = np.random.default_rng([seed, 2])
    a_1, b_1 = rng.uniform(-15, 15), rng.uniform(-40, 40)  # 1/m
    a_2, b_2 = rng.uniform(1.5e4, 2.5e4), rng.uniform(4e4, 8e4)  # 1/m²

    def flow(s: np.ndarray, u: float) -> np.ndarray:
        i, x, v = s
        factor = FORCE_FACTOR * (1 - a_1 * x - a_2 * x**2)
        back = STIFFNESS * (1 - b_1 * x + b_2 * x**2) * x
        return np.array([(u - RE * i - factor * v) / LE, v, (factor * i - DAMPING * v - back) / MASS])

    def record() -> Recording:
        u = random_sines(rng, DT * np.arange(SAMPLES), (20.0, 400.0), 200, 18.0)
        y = trajectory(flow, np.zeros(3), u, DT, FINE)[:, :2]
        y += NOISE * np.std(y, axis=0) * rng.standard_normal(y.shape)
        return Recording(u[:, None], y, DT, ("voltage",), ("current", "displacement"), initial="zero", hold="zero")

    return simulator(seed), record(), record()


def main(arguments: Sequence[str] | None = None) -> int:
    """Diagnose every case; print one line each, and the number of right answers."""
    options = case_parser(__doc__, 4).parse_args(arguments)
    right = 0
    for seed in numbered(options):
        answer = diagnose_case(recorded(seed), options.workers)
        stiffness = [("suspension", "cubic_stiffness"), ("parameter:K", "varying_parameter")]  # the same force
        factor = ("parameter:Bl", "varying_parameter")
        right += len(answer.named) == 2 and factor in answer.named and any(s in answer.named for s in stiffness)
        answer.show(f"{seed:3}")
    print(f"{right} of {options.cases} right: the force factor and the suspension")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
