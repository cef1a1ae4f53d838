"""Two real cascaded tanks that overflow, found from simulators without overflow (`python -m problems.tanks`).

    h_1' = k_4 (u - u_0) - k_1 f(h_1),    h_2' = k_1 f(h_1) - k_3 f(h_2),    y = y_0 + h_2^m,    f(h) = h  or  sqrt(h)

The sensor is not calibrated: its zero y_0 and the bend m of its curve are parameters, and so is the voltage u_0 that
the pump needs before it delivers. Water may leave a tank in ways the equations do not have (a leak, a spill), and part
of what leaves the upper tank may fall into the lower one: `share`, which matters once a law stands in the port.
Recordings: 1024 samples each, 4 s apart; Schoukens, Mattsson, Wigren & Noel (2016), "Cascaded tanks benchmark combining
soft and hard nonlinearities"; data not included here. The initial levels are unknown and the same in both recordings,
so the test starts from those estimated on the training recording.

Published rms errors of the test simulation in V: grey-box model with overflow 0.18 and 0.19, CT-SUBNET 0.31, TSEM 0.33,
NLSS2 0.34, PNLSS 0.45, Volterra 0.54, linear 0.75.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from pilfr_casadi.data import Recording, read_csv
from pilfr_casadi.diagnose import Diagnosis, diagnose
from pilfr_casadi.models import Parameter
from pilfr_casadi.simulators import Port, Simulator

from .diagnosed import given_folder, rmse, show, started, table

EMPTY = 1e-3  # level below which powers of it are not followed to zero
PUBLISHED = (
    ("grey-box with overflow", 0.18),
    ("grey-box (Worden 2018)", 0.191),
    ("CT-SUBNET", 0.306),
    ("TSEM", 0.33),
    ("NLSS2", 0.34),
    ("PNLSS", 0.45),
    ("Volterra", 0.54),
    ("linear", 0.75),
)  # V


def recordings(folder: Path) -> dict[str, Recording]:
    """`train` and `test`: pump voltage and level in V."""
    names: dict[str, Any] = {"inputs": "u_pump_V", "outputs": "y_level_V", "hold": "zero"}
    names["units"] = {"u_pump_V": "V", "y_level_V": "V"}
    return {
        "train": read_csv(folder / "tanks_est.csv", name="train", **names),
        "test": read_csv(folder / "tanks_val.csv", name="test", **names),
    }


def outflow(h: Any, root: bool) -> Any:
    """Torricelli's law, or a linear one."""
    return ca.sqrt(ca.fmax(h, EMPTY)) if root else h


def simulator(root: bool) -> Simulator:
    """The naive simulator with linear or square-root outflow; coefficients are guesses."""

    def dynamics(x: Any, u: Any, p: Any) -> dict[str, Any]:
        through = p.k_1 * outflow(x.upper, root)
        pumped = p.k_4 * (u.u_pump_V - p.u_0)
        return {"upper": pumped - through, "lower": through - p.k_3 * outflow(x.lower, root)}

    def outputs(x: Any, p: Any) -> dict[str, Any]:
        return {"y_level_V": p.y_0 + ca.fmax(x.lower, EMPTY) ** p.m}

    unit = "level^0.5/s" if root else "1/s"
    bounds = (1e-4, 1.0)
    return Simulator(
        dynamics,
        outputs,
        states=("upper", "lower"),
        inputs=("u_pump_V",),
        parameters={
            "k_1": Parameter(0.03, unit=unit, bounds=bounds),
            "k_3": Parameter(0.03, unit=unit, bounds=bounds),
            "k_4": Parameter(0.03, unit="level/(V s)", bounds=bounds),
            "u_0": Parameter(0.0, unit="V", bounds=(0.0, 1.0)),
            "y_0": Parameter(0.0, unit="V", bounds=(-3.0, 3.0)),
            "m": Parameter(1.0, bounds=(0.5, 2.0)),
            "share": Parameter(0.5, bounds=(0.0, 1.0)),
        },
        ports=(
            Port(
                "upper-tank",
                lambda p: {"upper": -1.0, "lower": p.share},
                lambda x: x.upper,
                unit="level/s",
                across_unit="level",
            ),
            Port("lower-tank", {"lower": -1.0}, lambda x: x.lower, unit="level/s", across_unit="level"),
        ),
    )


def judge(folder: Path, diagnosis: Diagnosis) -> dict[str, dict[str, float]]:
    """Rms errors in V: `before` and `after` -> `train`, `test`."""
    data = recordings(folder)
    out = {}
    for name, key in (("before", "without"), ("after", "after")):
        fitted = getattr(diagnosis.evidence, key)
        out[name] = {
            k: rmse(started(fitted, r, diagnosis.hold, np.asarray(fitted.initial[0]))) for k, r in data.items()
        }
    return out


def run(folder: Path, root: bool, **options: Any) -> tuple[Diagnosis, dict[str, dict[str, float]]]:
    """Diagnose on the training recording, judge on the test."""
    data = recordings(folder)
    diagnosis = diagnose(simulator(root), data["train"], test=data["test"], **options)
    return diagnosis, judge(folder, diagnosis)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print what was found, and the errors beside the published ones."""
    folder = given_folder(__doc__, "cascaded_tanks", arguments)
    if folder is None:
        return 1
    kinds = ("train", "test")
    rows: list[tuple[str, Sequence[float | None]]] = []
    for root, name in ((False, "linear outflow"), (True, "square-root outflow")):
        diagnosis, errors = run(folder, root)
        print(name)
        show(diagnosis)
        rows.append((f"{name}, refitted", [errors["before"][k] for k in kinds]))
        rows.append((f"{name}, with what was found", [errors["after"][k] for k in kinds]))
    rows += [(name, [None, value]) for name, value in PUBLISHED]
    print(table("rms error [V], free run", rows, kinds))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
