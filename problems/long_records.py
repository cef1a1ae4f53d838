"""Long records in one diagnosis: 10^6 samples in one recording, and 200 recordings of 2,000 samples.

Two masses with three ports (ground spring, coupling, guide). The force is small, save for a few short bursts. There the
coupling's spring stiffens with the cube of its stretch, which the simulator leaves out. Elsewhere this is not visible.

    python -m problems.long_records                 every case, each in a process of its own
    python -m problems.long_records one --samples 1000000
    python -m problems.long_records many --recordings 200
    python -m problems.long_records open            the same recordings, with unknown initial states
    python -m problems.long_records cut             the same equations on 20,000 samples

Each row has the answer, the seconds, the processors' seconds, and the peak memory of the process. A time is told on an
idle machine only; the processors' seconds hardly depend on other jobs.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from collections.abc import Sequence

import casadi as ca
import numpy as np

import pilfr_casadi as pilfr
from pilfr_casadi.data import Recording

DT, NOISE, FINE = 0.01, 2e-4, 4
M1, M2, K1, K2, D1, D2, D3, K3 = 1.2, 0.8, 420.0, 900.0, 2.0, 1.5, 1.0, 4e5
QUIET, LOUD, BURST = 0.6, 9.0, 1500  # rms force outside and inside bursts, N; samples of a burst
BLOCK = 1000


def plant() -> ca.Function:
    """One block of samples of the true equations, by Runge-Kutta steps."""
    x, u = ca.SX.sym("x", 4), ca.SX.sym("u")

    def rates(s: ca.SX) -> ca.SX:
        stretch = s[0] - s[2]
        inner = K2 * stretch + D2 * (s[1] - s[3]) + K3 * stretch**3
        return ca.vertcat(s[1], (u - K1 * s[0] - D1 * s[1] - inner) / M1, s[3], (inner - D3 * s[3]) / M2)

    s, h = x, DT / FINE
    for _ in range(FINE):
        a = rates(s)
        b = rates(s + h / 2 * a)
        c = rates(s + h / 2 * b)
        s = s + h / 6 * (a + 2 * b + 2 * c + rates(s + h * c))
    return ca.Function("step", [x, u], [s, x[[0, 2]]]).mapaccum(BLOCK)


def record(samples: int, bursts: int, seed: int, name: str = "", initial: str = "zero") -> Recording:
    """One experiment from rest, which `initial` may conceal: coloured force with bursts, two displacements."""
    rng = np.random.default_rng(seed)
    size = np.full(samples, QUIET)
    for at in rng.integers(0, max(samples - BURST, 1), bursts):
        size[at : at + BURST] = LOUD
    white = rng.standard_normal(samples + 8)
    force = size * np.convolve(white, np.hanning(10)[1:-1] / 1.7, mode="valid")[:samples]
    run, state, y = plant(), np.zeros(4), np.zeros((samples, 2))
    for begin in range(0, samples, BLOCK):
        piece = np.zeros(BLOCK)
        now = force[begin : begin + BLOCK]
        piece[: len(now)] = now
        states, outputs = run(state, piece)
        state = np.asarray(states)[:, -1]
        y[begin : begin + BLOCK] = np.asarray(outputs).T[: len(now)]
    y += NOISE * rng.standard_normal(y.shape)
    return Recording(force, y, DT, ("force",), ("x1", "x2"), initial=initial, hold="zero", name=name)


def simulator() -> pilfr.Simulator:
    """The simulator handed over: linear, three ports, parameters off by up to 15 %."""
    free = {name: pilfr.Parameter(v * by, bounds=(v / 5, v * 5)) for name, v, by in FREE}

    def dynamics(x, u, p):  # type: ignore[no-untyped-def]
        inner = p.k2 * (x.x1 - x.x2) + p.d2 * (x.v1 - x.v2)
        first = (u.force - p.k1 * x.x1 - p.d1 * x.v1 - inner) / M1
        return dict(x1=x.v1, v1=first, x2=x.v2, v2=(inner - p.d3 * x.v2) / M2)

    ports = (
        pilfr.Port("ground", into={"v1": -1 / M1}, across=lambda x: x.x1, rate=lambda x: x.v1, unit="N"),
        pilfr.Port(
            "coupling",
            into={"v1": -1 / M1, "v2": 1 / M2},
            across=lambda x: x.x1 - x.x2,
            rate=lambda x: x.v1 - x.v2,
            unit="N",
        ),
        pilfr.Port("guide", into={"v2": -1 / M2}, across=lambda x: x.x2, rate=lambda x: x.v2, unit="N"),
    )
    return pilfr.Simulator(
        dynamics,
        lambda x: dict(x1=x.x1, x2=x.x2),
        states=("x1", "v1", "x2", "v2"),
        inputs=("force",),
        parameters=free,
        ports=ports,
    )


FREE = (("k1", K1, 1.1), ("k2", K2, 0.9), ("d1", D1, 1.15), ("d2", D2, 0.9), ("d3", D3, 1.1))
CASES = ("cut", "one", "many", "open")


def recordings(case: str, samples: int, count: int) -> list[Recording]:
    """Training recordings of a case."""
    if case == "one":
        return [record(samples, 6, 1)]
    if case == "cut":
        return [record(20_000, 3, 2)]
    initial = "estimate" if case == "open" else "zero"
    return [record(2000, int(i % 40 == 7), 100 + i, f"day {i + 1}", initial) for i in range(count)]


def run(case: str, samples: int, count: int) -> str:
    """Diagnose a case; return its row."""
    train = recordings(case, samples, count)
    test = record(6000, 1, 9, "test")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    began, busy = time.perf_counter(), time.process_time()
    found = pilfr.diagnose(simulator(), train, test=test)
    seconds, busy = time.perf_counter() - began, time.process_time() - busy
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    size = f"{len(train)} x {len(train[0])}"
    effects = "; ".join(f"{e.law} at {e.port} ({e.confidence:.2f})" for e in found.effects) or "-"
    parameters = [pair for e in found.effects for pair in e.parameters.items()]
    values = "; ".join(f"{k} = {p['value']:.4g} ± {p['std'] or np.nan:.2g}" for k, p in parameters)
    errors = found.errors["test"] or {}
    after = " -> ".join(f"{errors[k]:.4f}" for k in ("before", "after") if k in errors)
    stages = ", ".join(f"{k} {v:.0f}" for k, v in found.times.items() if v > 1)
    return (
        f"{case:5}{size:>14}  {found.verdict:16} {effects:36} {values}  "
        f"test {after}  {seconds:6.1f} s (processors {busy:.0f} s)  "
        f"{peak:.2f} GB (before {before / 1e6:.2f})\n      {stages}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a case, or all of them in processes of their own."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", nargs="?", choices=CASES)
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--recordings", type=int, default=200)
    options = parser.parse_args(arguments)
    if options.case:
        print(run(options.case, options.samples, options.recordings), flush=True)
        return
    for case in CASES:
        more = [f"--samples={options.samples}", f"--recordings={options.recordings}"]
        subprocess.run([sys.executable, "-m", "problems.long_records", case, *more], check=True)


if __name__ == "__main__":
    main()
