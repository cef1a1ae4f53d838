"""The picture of the README: the demonstration's rig before and after its diagnosis.

    python -m problems.readme_picture        writes docs/diagnosis.png

The simulator has two masses, springs and dampers. The machine also has friction under its second mass, which the
diagnosis finds from one recording; the picture shows another recording.
"""

from __future__ import annotations

from pathlib import Path

import pilfr_casadi as pilfr
from pilfr_casadi.laws import display_name
from pilfr_casadi.plots import new_figure
from pilfr_casadi.simulators import load_simulator

from .demo_rig import FOLDER
from .diagnosed import free_run, rmse

TARGET = Path(__file__).parent.parent / "docs" / "diagnosis.png"
SHOWN = slice(300, 700)  # samples
BLUE, RED, INK = "#0072B2", "#D55E00", "#222222"


def main() -> None:
    """Diagnose the rig and draw its test recording."""
    known = {"inputs": "force", "outputs": "x2", "initial": "zero", "hold": "zero"}
    train, test = (pilfr.read_csv(FOLDER / f"rig_{name}.csv", **known) for name in ("train", "test"))
    diagnosis = pilfr.diagnose(load_simulator(FOLDER / "rig.py"), train, test=test)
    errors = {
        "refitted": free_run(diagnosis.refitted, test, diagnosis.hold)[:, 0],
        "corrected": free_run(diagnosis.corrected, test, diagnosis.hold)[:, 0],
    }
    share = {name: 100 * rmse(e) / float(test.y.std()) for name, e in errors.items()}
    figure = new_figure(9.0, 4.2)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    t, y = test.t[SHOWN], 1e3 * test.y[SHOWN, 0]
    above.plot(t, y, color=INK, linewidth=2.4, alpha=0.35, label="measured, not used for fitting")
    for axes, base in ((above, y), (below, 0 * y)):
        axes.plot(t, base + 1e3 * errors["refitted"][SHOWN], color=RED, linewidth=1.1, label="simulator, refitted")
        axes.plot(t, base + 1e3 * errors["corrected"][SHOWN], color=BLUE, linewidth=1.1, label="with the named law")
        axes.grid(True, color="#DDDDDD", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    effect = diagnosis.effects[0]
    law = display_name(effect.law)
    above.set_title(
        f"{law} is missing at {effect.port} ({100 * effect.confidence:.0f} % sure): "
        f"error on unseen data {share['refitted']:.0f} % → {share['corrected']:.1f} %",
        loc="left",
        fontsize=11,
        pad=22,  # points: room for the legend
    )
    above.set_ylabel("displacement x2 [mm]")
    below.set_ylabel("error [mm]")
    below.set_xlabel("time [s]")
    above.legend(loc="lower left", fontsize=9, ncols=3, frameon=False, bbox_to_anchor=(0.0, 0.99), borderaxespad=0.2)
    figure.savefig(TARGET, dpi=130)
    print(f"{TARGET.name}: {law} at {effect.port}, {share}")


if __name__ == "__main__":
    main()
