"""A real piezo stack, voltage to displacement: nested hysteresis loops (`python -m problems.piezo_stack`).

Recordings: PICMA P-885.91 driven by a 1 Hz sine, and by 1 Hz with growing and shrinking amplitude, 200 Hz; Aye & Ang
(2018), MIT licence, data not included here.

A record at one frequency cannot tell a lag from hysteresis, so the model trained on the sine is static (nx = 0); the
varying amplitude can carry a state. The first 20 samples of both records are a start transient and are not scored.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pilfr_casadi.data import Recording, read_csv
from pilfr_casadi.identify import Fit, fit
from pilfr_casadi.models import PILFR, Play, PrandtlIshlinskii

from .measured_data import measured

TRANSIENT = 20  # samples


def recordings(folder: Path) -> dict[str, Recording]:
    """`sine`, `varying` and the two halves of it: u in V, y in µm."""
    names: dict[str, Any] = {"inputs": "u_control_V", "outputs": "y_disp_um", "skip": TRANSIENT}
    units = {"u_control_V": "V", "y_disp_um": "µm"}
    sine = read_csv(folder / "piezo_model_1Hz_sine.csv", units=units, name="sine", **names)
    varying = read_csv(folder / "piezo_test_varying_amplitude.csv", units=units, name="varying amplitude", **names)
    first, second = varying.split(0.5)
    return {"sine": sine, "varying": varying, "first half": first, "second half": second}


def share_of_range(result: Fit, recording: Recording, whole: Recording) -> float:
    """Rms simulation error in % of the range that the output of `whole` covers."""
    error = (result.simulate(recording) - recording.y)[recording.skip :]
    return 100.0 * float(np.sqrt(np.mean(error**2)) / np.ptp(whole.y[whole.skip :]))


def identify(train: Recording, nx: int, n: int) -> Fit:
    """A model with n plays, or with none."""
    return fit(PILFR(nx, PrandtlIshlinskii(Play, n) if n else None), train, starts=4)


def run(folder: Path) -> list[tuple[str, str, float, Fit]]:
    """Rows (model, trained on -> judged on, error in % of range, fit)."""
    data = recordings(folder)
    rows = []
    for train, test in (("sine", "varying"), ("first half", "second half")):
        for nx, n in ((0, 0), (0, 12), (0, 20), (1, 20)):
            if nx and train == "sine":
                continue
            result = identify(data[train], nx, n)
            name = f"{n} plays, nx = {nx}" if n else "linear gain"
            rows.append((name, f"{train} -> {test}", share_of_range(result, data[test], data["varying"]), result))
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table and draw the nested loops."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/piezo_stack"), help="folder for the picture")
    options = parser.parse_args(arguments)
    folder = measured("piezo_dbo")
    if folder is None:
        print(
            "The piezo recordings are not here; put them into a folder DATA/piezo_dbo and run with PILFR_DATA=DATA, "
            "or put them into shared/data/piezo_dbo beside the repository."
        )
        return 1
    print(f"{'model':<20} {'trained on -> judged on':<28} rms error [% of range]")
    rows = run(folder)
    for name, where, error, _ in rows:
        print(f"{name:<20} {where:<28} {error:.2f}")
    from pilfr_casadi import plots

    options.out.mkdir(parents=True, exist_ok=True)
    best = next(result for name, where, _, result in rows if where.startswith("sine") and name.startswith("20"))
    picture = options.out / "nested_loops.png"
    figure: Any = plots.output_over_input(best, recordings(folder)["varying"]).figure
    figure.savefig(picture, dpi=130)
    print(f"picture: {picture}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
