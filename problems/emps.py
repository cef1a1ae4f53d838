"""A real positioning axis, its friction found from a simulator with viscous friction only (`python -m problems.emps`).

    M q'' = g_tau vir - F_v q'            (what an engineer writes first)

Recordings: electro-mechanical positioning system, 24.8 s at 1 kHz; Janot, Gautier & Brunot (2019), "Data set and
reference models of EMPS"; data not included here. Train on DATA_EMPS, judge on DATA_EMPS_PULSES, where unknown force
pulses are added; the first 20 samples may set the initial state. The axis is a free integrator, so an open-loop run
drifts away by whatever little force is wrong; it is used in closed loop, which is simulated from the reference as well:

    vir = k_v (k_p (q_g - q) - q') + pulses        (the recorded voltage shows that they are volts)

Published rms errors of the open-loop test run: dynoNet 2.64 mm, CT-SUBNET 4.61 mm (arXiv 2405.10779), recurrent
networks 74 to 220 mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pilfr_casadi.data import Recording, read_csv
from pilfr_casadi.diagnose import Diagnosis, diagnose
from pilfr_casadi.models import Parameter
from pilfr_casadi.simulators import Port, Simulator

from .diagnosed import free_run, given_folder, rmse, show, table

GAIN = 35.15065  # N/V, from the drive's voltage to the force
K_P, K_V = 160.18, 243.45  # 1/s, V s/m
FIRST = 20  # samples that may set the initial state
PUBLISHED = (("dynoNet", 2.64), ("CT-SUBNET", 4.61), ("LSTM", 74.1), ("RNN", 89.2), ("GRU", 220.3))  # mm


def recordings(folder: Path) -> dict[str, Recording]:
    """`train` and `test`: u in V, q in m, sampled each millisecond."""
    names: dict[str, Any] = {"inputs": "u_vir_V", "outputs": "y_qm_m", "hold": "zero"}
    names["units"] = {"u_vir_V": "V", "y_qm_m": "m"}
    train = read_csv(folder / "emps_train.csv", name="train", **names)
    test = read_csv(folder / "emps_test_pulses.csv", name="pulses", **names)
    return {"train": started_as_measured(train), "test": started_as_measured(test)}


def started_as_measured(r: Recording) -> Recording:
    """The recording with position and velocity at its first sample, from a parabola through the first few.

    Left free, the initial state of an integrator takes up drift that comes later.
    """
    velocity = np.polynomial.Polynomial.fit(r.t[:FIRST], r.y[:FIRST, 0], 2).deriv()(0.0)
    return r.with_(initial=np.array([r.y[0, 0], velocity]))


def references(folder: Path) -> Recording:
    """The test with reference and pulses in the place of the voltage, for the closed loop."""
    columns = ["qg_reference_m", "pulses_N_label"]
    return read_csv(folder / "emps_test_pulses.csv", inputs=columns, outputs="y_qm_m", name="closed loop")


def dynamics(x: Any, u: Any, p: Any) -> dict[str, Any]:
    """A mass with viscous friction, pushed by the drive."""
    return {"pos": x.vel, "vel": (GAIN * u.u_vir_V - p.F_v * x.vel) / p.M}


def outputs(x: Any) -> dict[str, Any]:
    """The encoder."""
    return {"y_qm_m": x.pos}


def simulator() -> Simulator:
    """The naive simulator; mass and friction are guesses from the drawing, 10 to 20 % off."""
    return Simulator(
        dynamics,
        outputs,
        states=("pos", "vel"),
        inputs=("u_vir_V",),
        parameters={
            "M": Parameter(105.0, unit="kg", bounds=(50.0, 200.0)),
            "F_v": Parameter(240.0, unit="N s/m", bounds=(0.0, 1000.0)),
        },
        ports=(Port("axis", lambda p: {"vel": -1 / p.M}, lambda x: x.pos, lambda x: x.vel, unit="N", across_unit="m"),),
    )


def in_closed_loop(axis: Simulator) -> Simulator | None:
    """The axis under its position controller, driven by the reference; None where it needs the recorded voltage.

    An offset at the drive acts in the loop as well; other elements there, and forces that the voltage scales, do not.
    A drift at the encoder is that of a free run, which the controller takes away.
    """
    inside = tuple(
        e for e in axis.elements if e.port == "axis" and not e.law.scaled_by and not getattr(e.law, "factor", "")
    )
    biases = [f"{e.prefix}w_0" for e in axis.elements if e.port == "actuator:u_vir_V" and e.law.id == "offset"]
    drifts = [e for e in axis.elements if e.port == "sensor:y_qm_m" and e.law.id == "drift"]
    if len(inside) + len(biases) + len(drifts) < len(axis.elements):
        return None

    def driven(x: Any, u: Any, p: Any) -> dict[str, Any]:
        voltage = K_V * (K_P * (u.qg_reference_m - x.pos) - x.vel) + u.pulses_N_label + sum(p[name] for name in biases)
        return {"pos": x.vel, "vel": (GAIN * voltage - p.F_v * x.vel) / p.M}

    return replace(axis, dynamics=driven, inputs=("qg_reference_m", "pulses_N_label"), elements=inside)


def judge(folder: Path, diagnosis: Diagnosis) -> dict[str, dict[str, float]]:
    """Rms errors in mm: `before` and `after` -> `train`, `test`, `closed loop`."""
    data = recordings(folder)
    loop = references(folder)
    loop = loop.with_(initial=data["test"].initial)
    out = {}
    for name, axis in (("before", diagnosis.refitted), ("after", diagnosis.corrected)):
        out[name] = {kind: 1e3 * rmse(free_run(axis, r, diagnosis.hold)) for kind, r in data.items()}
        closed = in_closed_loop(axis)
        out[name]["closed loop"] = 1e3 * rmse(free_run(closed, loop, "linear")) if closed else np.nan
    return out


def run(folder: Path, **options: Any) -> tuple[Diagnosis, dict[str, dict[str, float]]]:
    """Diagnose on the training recording, judge on the test."""
    data = recordings(folder)
    diagnosis = diagnose(simulator(), data["train"], test=data["test"], **options)
    return diagnosis, judge(folder, diagnosis)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print what was found, and the errors beside the published ones."""
    folder = given_folder(__doc__, "emps", arguments)
    if folder is None:
        return 1
    diagnosis, errors = run(folder)
    show(diagnosis)
    kinds = ("train", "test", "closed loop")
    rows: list[tuple[str, Sequence[float | None]]] = [
        ("viscous friction only, refitted", [errors["before"][k] for k in kinds]),
        ("with what was found", [errors["after"][k] for k in kinds]),
        *((name, [None, value, None]) for name, value in PUBLISHED),
    ]
    print(table("rms error [mm], free run", rows, kinds))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
