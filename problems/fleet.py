"""A simulated fleet: every machine has Coulomb friction that the simulator lacks, a few have a hidden second fault.

    python -m problems.fleet                       200 machines with six days each, two processes
    python -m problems.fleet --machines 40         fewer machines
    python -m problems.fleet --speed 20            also the time with one process against two, on 20 machines
    python -m problems.fleet --kill                also a run that is killed (SIGKILL) half way and resumed

A mass on a spring. Mass and damper are alike in all machines, the stiffness of the spring and the friction differ from
machine to machine (5 % each). In 3 % of the machines the spring stiffens (a cubic term, or a gap before a bumper); in
10 %, others, the spring wears by 1 % a day. The simulator has neither friction nor anything else of this, and its
values are off by 10 to 25 %. Reported: faulty machines that are found, other machines that are called faulty or
different, wear found, and values within two of their standard errors.
"""

from __future__ import annotations

import argparse
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import pilfr_casadi as pilfr
from pilfr_casadi.diagnose import SURE
from pilfr_casadi.engine import make_engine
from pilfr_casadi.laws import Clearance, CoulombFriction, CubicStiffness
from pilfr_casadi.simulators import discretise
from pilfr_casadi.studies import Fleet

DT, SAMPLES, DAYS, NOISE = 5e-3, 400, 6, 3e-3
FINE = 40  # sub-steps of the truth per sample
PORT, STIFFNESS, DAMPING, FRICTION, KNEE = "ground-mass", 1300.0, 12.0, 5.0, 5e-3
SPREAD, WEAR = 0.05, 0.01  # between machines, and per day
FAULTY, WORN = 0.03, 0.10  # shares of the machines
SHARE_FOR_SPEED = 0.1  # of faulty machines: with one of them alone, its diagnosis would be all that is left to do
LAWS = (CoulombFriction, CubicStiffness, Clearance)


def _dynamics(x: Any, u: Any, p: Any) -> dict[str, Any]:
    return {"pos": x.vel, "vel": (u.force - p.k * x.pos - p.d * x.vel) / p.m}


def rig() -> pilfr.Simulator:
    """The simulator of the design office, without friction."""
    return pilfr.Simulator(
        _dynamics,
        lambda x: {"position": x.pos},
        states=("pos", "vel"),
        inputs=("force",),
        parameters={
            "m": pilfr.Parameter(2.0, unit="kg", fixed=True),
            "k": pilfr.Parameter(1100.0, unit="N/m", bounds=(300, 4000)),
            "d": pilfr.Parameter(15.0, unit="N s/m", bounds=(0, 100)),
        },
        ports=(pilfr.Port(PORT, lambda p: {"vel": -1 / p.m}, lambda x: x.pos, lambda x: x.vel, "N", "m"),),
        hold="zero",
    )


@dataclass(frozen=True)
class Truth:
    """The values of a machine on its first day, its fault ("", "cubic" or "gap") and wear per day."""

    k: float
    friction: float
    fault: str
    wear: float
    strength: float = 1.0

    @property
    def middle(self) -> float:
        """Stiffness in the middle of the days."""
        return self.k * (1 - self.wear * (DAYS - 1) / 2)


def simulated_fleet(
    count: int, seed: int = 0, share: float = FAULTY, strength: float = 1.0
) -> tuple[dict[str, list[pilfr.Recording]], dict[str, Truth]]:
    """Draw a fleet with a share of faulty machines, whose faults have a strength: recordings and truth by machine."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(count)
    faulty, worn = max(round(share * count), 1), max(round(WORN * count), 1)
    truths, recordings = {}, {}
    for i in range(count):
        place = int(order[i])
        fault = ("cubic", "gap")[place % 2] if place < faulty else ""
        wear = WEAR if faulty <= place < faulty + worn else 0.0
        k, friction = (mean * (1 + SPREAD * rng.standard_normal()) for mean in (STIFFNESS, FRICTION))
        name = f"m{i:03d}"
        truths[name] = Truth(k, friction, fault, wear, strength)
        recordings[name] = [_day(truths[name], day, rng) for day in range(DAYS)]
    return recordings, truths


def _day(truth: Truth, day: int, rng: np.random.Generator) -> pilfr.Recording:
    """Record a machine on a day, driven by a multisine that swells and ebbs."""
    true = rig().with_element(PORT, CoulombFriction({"F_c": truth.friction, "v_0": KNEE}))
    if truth.fault == "cubic":
        true = true.with_element(PORT, CubicStiffness({"k_3": truth.strength * 4e4}))
    elif truth.fault == "gap":
        true = true.with_element(PORT, Clearance({"k_g": truth.strength * 600.0, "g": 0.03}))
    t, f = np.arange(SAMPLES) * DT, np.linspace(0.5, 8, 20)
    v = np.sum(np.cos(2 * np.pi * f[:, None] * t + rng.uniform(0, 2 * np.pi, (20, 1))), axis=0)
    u = (30 * v / np.std(v) * (0.4 + 0.6 * np.sin(np.pi * t / t[-1])))[:, None]
    blank = pilfr.Recording(u, u, DT, inputs=("force",), outputs=("position",), initial="zero", name=f"day {day}")
    model = discretise(true, DT, "zero", FINE)
    p = model.parameters
    nominal = {name: entry.value for name, entry in p.items()}
    values = p.pack({**nominal, "k": truth.k * (1 - truth.wear * day), "d": DAMPING})
    y = make_engine(model).simulate(model.drive(blank), values, np.zeros(model.n_state))[0]
    return blank.with_(y=y + NOISE * np.std(y) * rng.standard_normal(y.shape))


@dataclass(frozen=True)
class Score:
    """How often a fleet was judged right, as counts (right, of)."""

    found: tuple[int, int]
    false_alarms: tuple[int, int]
    wear_found: tuple[int, int]
    false_wear: tuple[int, int]
    within: tuple[int, int]

    def __str__(self) -> str:
        names = {
            "faulty machines found": self.found,
            "other machines called faulty or different": self.false_alarms,
            "wear found": self.wear_found,
            "wear where there is none": self.false_wear,
            "values within two standard errors": self.within,
        }
        return "\n".join(f"{name}: {a} of {b} ({100 * a / max(b, 1):.1f} %)" for name, (a, b) in names.items())


def score(fleet: Fleet, truths: dict[str, Truth]) -> Score:
    """Compare a fleet with the truth. Values of faulty machines do not count: no right model was fitted to them."""
    faulty = [m for m in fleet.machines if truths[m.name].fault]
    sound = [m for m in fleet.machines if not truths[m.name].fault]
    worn = [m for m in sound if truths[m.name].wear]
    new = [m for m in sound if not truths[m.name].wear]
    drifting = {m.name for m in fleet.drifting}
    differing = {m.name for m in fleet.differing}
    inside, count = 0, 0
    for m in sound:
        truth = truths[m.name]
        true = {"k": truth.middle, "d": DAMPING, f"{PORT}.F_c": truth.friction}
        for name, value in true.items():
            if name in m.values and np.isfinite(m.errors[name]):
                inside, count = inside + (abs(m.values[name] - value) < 2 * m.errors[name]), count + 1
    return Score(
        (sum(m.beyond > SURE for m in faulty), len(faulty)),
        (sum(m.name in differing for m in sound), len(sound)),
        (sum(m.name in drifting for m in worn), len(worn)),
        (sum(m.name in drifting for m in new), len(new)),
        (int(inside), count),
    )


def run(recordings: dict[str, list[pilfr.Recording]], out: Path | None, workers: int) -> tuple[Fleet, float]:
    """Compute the fleet; return it with its wall time."""
    began = time.perf_counter()
    fleet = pilfr.studies.fleet(rig(), recordings, laws=LAWS, effects=1, workers=workers, out=out)
    return fleet, time.perf_counter() - began


def contents(folder: Path) -> dict[str, bytes]:
    """Read all files of a folder but the times."""
    files = (p for p in folder.rglob("*") if p.is_file() and p.name not in ("times.json", ".lock"))
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in files}


def killed_and_resumed(folder: Path, machines: int, seed: int) -> bool:
    """Kill a run when half of its jobs are recorded, resume it, and compare the files with those of one that ran on."""
    one, other = folder / "whole", folder / "killed"
    command = [sys.executable, "-m", __spec__.name, "--machines", str(machines), "--seed", str(seed), "--out"]
    subprocess.run([*command, str(one)], check=True, stdout=subprocess.DEVNULL)
    half = len(list((one / "jobs").iterdir())) // 2
    first = subprocess.Popen([*command, str(other)], stdout=subprocess.DEVNULL)
    while len(list((other / "jobs").glob("*"))) < half and first.poll() is None:
        time.sleep(0.2)
    first.send_signal(signal.SIGKILL)
    first.wait()
    subprocess.run([*command, str(other)], check=True, stdout=subprocess.DEVNULL)
    return contents(one) == contents(other)


def main() -> None:
    """Print how a fleet is judged."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machines", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--faulty", type=float, default=FAULTY, help="share of the machines with a second fault")
    parser.add_argument("--strength", type=float, default=1.0, help="of the second faults")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--speed", type=int, default=0, help="machines on which one and two processes are compared")
    parser.add_argument("--kill", action="store_true", help="also kill and resume a run of at most 20 machines")
    parser.add_argument("--out", type=Path, help="folder of the results; a run that was ended is continued")
    options = parser.parse_args()
    recordings, truths = simulated_fleet(options.machines, options.seed, options.faulty, options.strength)
    fleet, seconds = run(recordings, options.out, options.workers)
    print(fleet)
    print(f"\n{score(fleet, truths)}\n{options.machines} machines of {DAYS} days in {seconds:.0f} s")
    if options.speed:
        few = simulated_fleet(options.speed, options.seed, SHARE_FOR_SPEED)[0]
        one, two = (run(few, None, workers)[1] for workers in (1, 2))
        print(f"{options.speed} machines: one process {one:.0f} s, two {two:.0f} s, {one / two:.2f} times as fast")
    if options.kill:
        folder = Path("runs/fleet")
        shutil.rmtree(folder, ignore_errors=True)
        same = killed_and_resumed(folder, min(options.machines, 20), options.seed)
        print(f"killed half way and resumed: {'the same bytes' if same else 'OTHER bytes'}")


if __name__ == "__main__":
    main()
