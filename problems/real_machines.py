"""Diagnose the recordings of real machines and print one table (`python -m problems.real_machines`).

Each machine is a naive simulator with recordings: it is trained on some and judged in free run on others, which are
never used to fit or to choose. Figures are NRMSE, averaged over outputs and test recordings. `best` is the best
published or hand-made model, where it is known.

    python -m problems.real_machines                     all machines
    python -m problems.real_machines ced seal --print    two of them, with what the diagnosis prints
    python -m problems.real_machines --time-limit 20     answers within 20 s each
    python -m problems.real_machines --out m.jsonl       a line per machine goes there as well
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pilfr_casadi.data import Recording, read_csv
from pilfr_casadi.diagnose import Diagnosis, diagnose
from pilfr_casadi.simulators import Simulator, load_simulator

from . import emps, masing_diagnosis, piezo_diagnosis, silverbox, tanks
from .masing_data import benchmark
from .measured_data import measured


@dataclass(frozen=True, eq=False)
class Machine:
    """A naive simulator with its training and test recordings."""

    simulator: Simulator
    train: Sequence[Recording]
    test: Sequence[Recording]

    def diagnose(self, **options: Any) -> Diagnosis:
        """Diagnose the simulator."""
        return diagnose(self.simulator, list(self.train), test=list(self.test), **options)


def from_files(folder: Path) -> Machine:
    """Read a folder with simulator.py, train_*.csv and test.csv, as `pilfr diagnose` does."""
    simulator = load_simulator(folder / "simulator.py")
    names: dict[str, Any] = {"inputs": simulator.inputs, "outputs": simulator.output_names}
    train = [read_csv(path, **names) for path in sorted(folder.glob("train_*.csv"))]
    return Machine(simulator, train, [read_csv(folder / "test.csv", **names)])


def _emps(folder: Path) -> Machine:
    data = emps.recordings(folder)
    return Machine(emps.simulator(), [data["train"]], [data["test"]])


def _silverbox(folder: Path) -> Machine:
    data = silverbox.recordings(folder)
    return Machine(silverbox.simulator(), [data["train"]], [data["multisine"], data["arrow"]])


def _tanks(root: bool) -> Callable[[Path], Machine]:
    def read(folder: Path) -> Machine:
        data = tanks.recordings(folder)
        return Machine(tanks.simulator(root), [data["train"]], [data["test"]])

    return read


def _piezo(folder: Path) -> Machine:
    data = piezo_diagnosis.recordings(folder)
    return Machine(piezo_diagnosis.simulator(), [data["sine"]], [data["varying"]])


# name -> folder of the recordings, how they are read, and the NRMSE of the best model known, None where there is none
MACHINES: dict[str, tuple[str, Callable[[Path], Machine], float | None]] = {
    "emps": ("emps", _emps, 0.0319),  # 2.64 mm (dynoNet) over the deviation of the test, 82.7 mm
    "silverbox": ("silverbox", _silverbox, 0.0058),  # .36 mV (DT-SUBNET), .26 mV (PNLSS) over 54.3 and 53.4 mV
    "tanks-linear": ("cascaded_tanks", _tanks(False), 0.0857),  # .18 V (grey box with overflow) over 2.10 V
    "tanks-root": ("cascaded_tanks", _tanks(True), 0.0857),
    "piezo": ("piezo_dbo", _piezo, None),
    "ced": ("ced", from_files, 0.199),
    "mr_damper": ("mr_damper", from_files, 0.211),
    "pendulum": ("dfki_pendulum", from_files, 0.0084),
    "seal": ("pneumatic_seal", from_files, 0.106),
}
NAMES = (*MACHINES, "masing")


def machine(name: str) -> Machine | None:
    """Read a machine; None where its recordings are not here. `masing` is the paper's rig, which is simulated."""
    if name == "masing":
        data = benchmark(0).records
        return Machine(masing_diagnosis.simulator(), [data["train"]], [data["multisine"], data["sweep"]])
    folder = measured(MACHINES[name][0])
    return None if folder is None else MACHINES[name][1](folder)


def row(name: str, diagnosis: Diagnosis, seconds: float) -> dict[str, Any]:
    """Figures and words of one machine."""
    found = diagnosis.to_dict()
    test = found["fit"]["test"]
    return {
        "machine": name,
        "verdict": found["verdict"],
        "naive": test["nominal"],
        "refitted": test["before"],
        "corrected": test["after"],
        "train": found["fit"]["train"]["after"],
        "best": MACHINES[name][2] if name in MACHINES else None,
        "noise": found["fit"]["noise_floor"]["nrmse"],
        "named": [f"{e['law']} at {e['port']} ({e['confidence']:.2f})" for e in found["effects"]],
        "correction": diagnosis.correction.words if diagnosis.correction else "",
        "shares": found["shares"],
        "seconds": round(seconds, 1),
    }


def line(r: Mapping[str, Any]) -> str:
    """One line of the table."""
    figures = [r[k] for k in ("naive", "refitted", "corrected", "best", "noise")]
    words = "; ".join(r["named"]) or f"no sure name; {r['correction']}"
    numbers = "".join(f"{'-' if v is None else format(v, '.3g'):>11}" for v in figures)
    return f"{r['machine']:14}{numbers}{r['seconds']:8.0f} s  {r['verdict']:16} {words}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; exit status 1 where no recordings are here."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", choices=[*NAMES, []], help="machines; all by default")
    parser.add_argument("--print", action="store_true", help="print each diagnosis as well")
    parser.add_argument("--time-limit", type=float, default=600.0, metavar="SECONDS", help="of each diagnosis")
    parser.add_argument("--workers", type=int, default=None)
    parser.add_argument("--out", type=Path, help="a JSON line for each machine goes there as well")
    options = parser.parse_args(arguments)
    print(f"{'machine':14}" + "".join(f"{k:>11}" for k in ("naive", "refitted", "corrected", "best", "noise")))
    missing = 0
    for name in options.names or NAMES:
        found = machine(name)
        if found is None:
            missing += 1
            print(f"{name:14} its recordings are not here; put them below $PILFR_DATA")
            continue
        began = time.perf_counter()
        diagnosis = found.diagnose(workers=options.workers, time_limit=options.time_limit)
        result = row(name, diagnosis, time.perf_counter() - began)
        print(line(result), flush=True)
        if options.print:
            print(diagnosis, flush=True)
        if options.out:
            with options.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(result) + "\n")
    return int(missing == len(options.names or NAMES))


if __name__ == "__main__":
    raise SystemExit(main())
