"""A real electronic oscillator, found from a linear second-order circuit (`python -m problems.silverbox`).

    v'' = b u - k v - d v'            (what an engineer writes first)

Recordings: Silverbox, a circuit that realises a Duffing oscillator, 610.35 Hz; Wigren & Schoukens (2013), "Three free
data sets for development and benchmarking in nonlinear system identification", ECC; data not included here. Trained on
the first three quarters of the multisine; judged on its last quarter, on the arrow (noise of growing amplitude, which
leaves the trained amplitudes at its end) and on the arrow's first 32000 samples, which do not. The first 50 samples may
set the initial state. What the input does between samples is not said by the recordings.

Published rms errors in mV (multisine / arrow / arrow without extrapolation): DT-SUBNET 0.36 / 1.4 / 0.32, PNLSS 0.26 on
the arrow (arXiv 2405.10779), GRU 1.49 / 2.80 / 0.95, FIR network 18.9 / 20.2 / 15.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pilfr_casadi.data import Recording, read_csv
from pilfr_casadi.diagnose import Diagnosis, diagnose
from pilfr_casadi.models import Parameter
from pilfr_casadi.simulators import Port, Simulator

from .diagnosed import free_run, given_folder, rmse, show, table

ARROW = (100, 40575)
INSIDE = 32000  # samples of the arrow that stay inside the trained amplitudes
MULTISINE = (40650, 127400)
FIRST = 50  # samples that may set the initial state
PUBLISHED: tuple[tuple[str, tuple[float | None, ...]], ...] = (
    ("DT-SUBNET", (0.36, 1.4, 0.32)),
    ("PNLSS", (None, 0.26, None)),
    ("GRU", (1.49, 2.80, 0.95)),
    ("LSTM", (1.50, 2.68, 0.96)),
    ("FIR network", (18.9, 20.2, 15.3)),
)  # mV


def recordings(folder: Path) -> dict[str, Recording]:
    """`train`, `multisine`, `arrow` and `arrow inside`, all in V."""
    names: dict[str, Any] = {"inputs": "u_V1_V", "outputs": "y_V2_V", "units": {"u_V1_V": "V", "y_V2_V": "V"}}
    whole = read_csv(folder / "silverbox_snls.csv", **names)
    multisine = whole.slice(*MULTISINE)
    train, test = multisine.split(0.75)
    arrow = whole.slice(*ARROW)
    parts = {"train": train, "multisine": test, "arrow": arrow, "arrow inside": arrow.slice(0, INSIDE)}
    return {name: r.with_(name=name) for name, r in parts.items()}


def dynamics(x: Any, u: Any, p: Any) -> dict[str, Any]:
    """An oscillator with a linear restoring force."""
    return {"v": x.rate, "rate": p.b * u.u_V1_V - p.k * x.v - p.d * x.rate}


def outputs(x: Any) -> dict[str, Any]:
    """The circuit's output voltage."""
    return {"y_V2_V": x.v}


def simulator() -> Simulator:
    """The naive simulator; the resonance is guessed at 65 Hz."""
    return Simulator(
        dynamics,
        outputs,
        states=("v", "rate"),
        inputs=("u_V1_V",),
        parameters={
            "b": Parameter(1.6e5, unit="1/s^2", bounds=(1e4, 1e6)),
            "k": Parameter(1.7e5, unit="1/s^2", bounds=(1e4, 1e6)),
            "d": Parameter(30.0, unit="1/s", bounds=(0.0, 1000.0)),
        },
        ports=(Port("feedback", {"rate": -1.0}, lambda x: x.v, lambda x: x.rate, unit="V/s^2", across_unit="V"),),
    )


def judge(folder: Path, diagnosis: Diagnosis) -> dict[str, dict[str, float]]:
    """Rms errors in mV: `before` and `after` -> recording."""
    pairs = (("before", diagnosis.refitted), ("after", diagnosis.corrected))
    tests = {k: r for k, r in recordings(folder).items() if k != "train"}
    hold = diagnosis.hold
    return {
        name: {k: 1e3 * rmse(free_run(one, r, hold, FIRST)[FIRST:]) for k, r in tests.items()} for name, one in pairs
    }


def run(folder: Path, **options: Any) -> tuple[Diagnosis, dict[str, dict[str, float]]]:
    """Diagnose on the training recording, judge on the others."""
    data = recordings(folder)
    tests = [data["multisine"], data["arrow"]]
    diagnosis = diagnose(simulator(), data["train"], test=tests, **options)
    return diagnosis, judge(folder, diagnosis)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print what was found, and the errors beside the published ones."""
    folder = given_folder(__doc__, "silverbox", arguments)
    if folder is None:
        return 1
    diagnosis, errors = run(folder)
    show(diagnosis)
    kinds = ("multisine", "arrow", "arrow inside")
    rows: list[tuple[str, Sequence[float | None]]] = [
        ("linear circuit, refitted", [errors["before"][k] for k in kinds]),
        ("with what was found", [errors["after"][k] for k in kinds]),
        *PUBLISHED,
    ]
    print(table("rms error [mV], free run", rows, kinds))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
