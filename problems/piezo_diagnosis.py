"""A real piezo stack, its hysteresis found from a gain (`python -m problems.piezo_diagnosis`).

    y = g u + y_0            (what an engineer writes first)

Recordings as in `piezo_stack`: trained on the 1 Hz sine, judged on the varying amplitude (rms error in % of its range).
Beside it stands what a layer of twelve operators in place of the hysteresis that was found leaves (`Diagnosis.refine`),
and what twelve plays leave, identified from the same sine with no simulator.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pilfr_casadi.diagnose import Diagnosis, diagnose
from pilfr_casadi.models import Parameter
from pilfr_casadi.simulators import Simulator

from .diagnosed import free_run, given_folder, rmse, show, table
from .piezo_stack import identify, recordings, share_of_range

FIRST = 40  # samples that may set the initial memory


def outputs(u: Any, p: Any) -> dict[str, Any]:
    """The sensor's zero is arbitrary."""
    return {"y_disp_um": p.g * u.u_control_V + p.y_0}


def simulator() -> Simulator:
    """The naive simulator; the gain is the data sheet's."""
    return Simulator(
        lambda: {},
        outputs,
        inputs=("u_control_V",),
        parameters={
            "g": Parameter(12.0, unit="µm/V", bounds=(1.0, 100.0)),
            "y_0": Parameter(-120.0, unit="µm", bounds=(-500.0, 500.0)),
        },
    )


def judge(folder: Path, diagnosis: Diagnosis) -> dict[str, float]:
    """Rms errors on the varying amplitude in % of its range, `before` and `after`."""
    pairs = (("before", diagnosis.refitted), ("after", diagnosis.corrected))
    return {name: error(folder, one, diagnosis.hold) for name, one in pairs}


def error(folder: Path, one: Simulator, hold: str) -> float:
    """Compute the rms error of a simulator on the varying amplitude in % of its range."""
    r = recordings(folder)["varying"]
    return 100 * rmse(free_run(one, r, hold, FIRST)[r.skip :]) / float(np.ptp(r.y[r.skip :]))


def run(folder: Path, **options: Any) -> tuple[Diagnosis, dict[str, float]]:
    """Diagnose on the sine, judge on the varying amplitude."""
    data = recordings(folder)
    diagnosis = diagnose(simulator(), data["sine"], test=data["varying"], **options)
    return diagnosis, judge(folder, diagnosis)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print what was found, and the errors beside that of a model without a simulator."""
    folder = given_folder(__doc__, "piezo_dbo", arguments)
    if folder is None:
        return 1
    diagnosis, errors = run(folder)
    show(diagnosis)
    refined = diagnosis.refine()
    print(refined)
    data = recordings(folder)
    plays = share_of_range(identify(data["sine"], 0, 12), data["varying"], data["varying"])
    rows: list[tuple[str, Sequence[float | None]]] = [
        ("a gain, refitted", [errors["before"]]),
        ("with what was found", [errors["after"]]),
        ("its hysteresis refined", [error(folder, refined.simulator, diagnosis.hold)]),
        ("twelve plays identified", [plays]),
    ]
    print(table("rms error [% of range], sine -> varying", rows, ["test"]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
