"""Identify a rig and diagnose a simulator, on recordings that come with the package: `pilfr demo`.

The first recordings are the benchmark of Krikelis et al. (2024), Sec. 6, simulated exactly: a training multisine, a
multisine test and a sine-sweep test, 50 dB signal-to-noise ratio. `python -m problems.masing_data` writes
them. `python -m problems.demo_rig` writes the recordings of the other rig, whose simulator `demo_data/rig.py` lacks
some physics; the package does not state which.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._base import deferred_interrupt, processors, progress_bar, worker_pool
from ..data import Recording, read_csv
from ..identify import Fit, fit
from ..models import PILFR, Play, PrandtlIshlinskii
from ..optimise import Status
from ..simulators import load_simulator
from ..studies import LARGEST_SIZE
from ._common import DONE, INTERRUPTED, NO_RESULT, integer, make_out_folder, option, say, takes_options
from .diagnose import write_diagnosis

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

SETS = ("train", "multisine", "sweep")
FLOOR = 0.0032  # NRMSE of the noise, 50 dB below the signal
# Krikelis et al. (2024), Table 2: NRMSE on training, multisine test and sweep test (25th percentiles of 100 starts)
PUBLISHED: Mapping[str, tuple[float, float, float]] = {
    "LTI": (0.3026, 0.2910, 0.4799),
    "PI-LFR N=5": (0.0275, 0.0441, 0.0331),
    "PI-LFR N=10": (0.0090, 0.0153, 0.0154),
    "PI-LFR N=15": (0.0078, 0.0143, 0.0144),
    "PI-LFR N=20": (0.0073, 0.0134, 0.0153),
}
SHOWN = {"LTI": "linear model", "PI-LFR N=20": "with 20 hysteresis operators"}  # rows, and their names in the table


def demo_recordings() -> dict[str, Recording]:
    """Read the recordings `train`, `multisine` and `sweep`: force u in N, displacement x2 in m, 120 Hz."""
    units = {"u": "N", "x2": "m"}
    return {name: _read_demo(f"{name}.csv", "u", name=name, units=units) for name in SETS}


def rig_recordings() -> dict[str, Recording]:
    """Read the recordings `train` and `test` of the rig to diagnose: force in N, displacement x2 in m, 100 Hz."""
    return {name: _read_demo(f"rig_{name}.csv", "force", name=name) for name in ("train", "test")}


def _read_demo(file: str, force: str, **options: Any) -> Recording:
    with as_file(files(__package__) / "demo_data" / file) as path:
        return read_csv(path, force, "x2", initial="zero", hold="zero", **options)


def structure(n: int) -> PILFR:
    """Describe the paper's model: five states and N plays, or none (n = 0)."""
    return PILFR(5, PrandtlIshlinskii(Play, n) if n else None)


@dataclass(frozen=True, kw_only=True)
class DemoOptions:
    """The options of `pilfr demo`."""

    out: str = option("Folder for the reports (default: runs/demo).", "DIR", "runs/demo")
    workers: int | None = integer("Processes (default: one per processor, at most four).", 1, LARGEST_SIZE["workers"])


@takes_options
def demo_command(options: DemoOptions) -> int:
    """Compares one rig with published results; diagnoses the simulator of another rig."""
    from rich.console import Console

    console = Console(highlight=False)
    folder, workers = make_out_folder(options.out), options.workers or min(4, processors())
    status = identify_rig(folder, workers, console)
    if status == INTERRUPTED:
        return status
    console.print()
    return max(status, diagnose_rig(folder / "diagnosis", workers))


def identify_rig(folder: Path, workers: int, console: Console) -> int:
    """Identify a rig, compare with the published errors, write the report; return the exit status."""
    from ..report import fit_report

    recordings = demo_recordings()
    console.print(
        "A force drives one mass, its displacement is measured; a second mass hangs on a hysteretic spring.",
        soft_wrap=True,
    )
    found = _fit_rows(recordings, workers)
    interrupted = len(found) < len(SHOWN) or any(f.status is Status.INTERRUPTED for f in found)
    console.print(_table(found, recordings))
    best = min(found, key=lambda f: f.train_nrmse[0]) if interrupted else found[-1]
    target = folder / "model.json"
    try:
        with deferred_interrupt():
            best.save(target)
        page = fit_report(best, [recordings["train"]], [recordings["multisine"], recordings["sweep"]], folder)
    except KeyboardInterrupt:
        console.print(f"Interrupted; the model is in {target}, a report was not written.", soft_wrap=True)
        return INTERRUPTED
    console.print("Interrupted; the best model so far was written." if interrupted else best.status.value)
    console.print(f"The model is in {target}; for the pictures open {page} in a browser.", soft_wrap=True)
    if interrupted:
        return INTERRUPTED
    return DONE if best.status.converged else NO_RESULT


def _fit_rows(recordings: Mapping[str, Recording], workers: int) -> list[Fit]:
    """Fit the rows of the table; Ctrl-C ends it with fewer rows."""
    found: list[Fit] = []
    try:
        with worker_pool(workers) as pool:
            for row in SHOWN:
                n = 0 if row == "LTI" else int(row.partition("=")[2])
                with progress_bar() as progress:
                    found.append(fit(structure(n), recordings["train"], executor=pool, progress=progress))
                if found[-1].status is Status.INTERRUPTED:
                    break
    except KeyboardInterrupt:
        if not found:
            raise
    return found


def _table(found: Sequence[Fit], recordings: Mapping[str, Recording]) -> Table:
    from rich.table import Table

    title = "Simulation error (NRMSE); published: Krikelis et al. (2024)"
    table = Table("model", *SETS, "time", title=title)
    for (row, name), result in zip(SHOWN.items(), found, strict=False):
        note = ", interrupted" if result.status is Status.INTERRUPTED else ""
        errors = [f"{result.nrmse(recordings[s]):.4f}" for s in SETS]
        table.add_row(name + note, *errors, f"{result.seconds:.1f} s")
        table.add_row("  (published)", *(f"{p:.4f}" for p in PUBLISHED[row]), "")
    table.add_row("noise floor", *(f"{FLOOR:.4f}" for _ in SETS), "")
    return table


def diagnose_rig(folder: Path, workers: int) -> int:
    """Diagnose the simulator, print and write the result; return the exit status."""
    from ..diagnose import diagnose

    with as_file(files(__package__) / "demo_data" / "rig.py") as path:
        simulator = load_simulator(path)
    recordings = rig_recordings()
    print("Another rig, with a simulator: two masses, linear springs and dampers. What does it leave out?", flush=True)
    try:
        with progress_bar() as progress:
            found = diagnose(
                simulator, recordings["train"], test=recordings["test"], effects=1, workers=workers, progress=progress
            )
    except KeyboardInterrupt:
        return say("Interrupted; the diagnosis was not written.", INTERRUPTED)
    return max(
        write_diagnosis(found, make_out_folder(str(folder)) / "diagnosis.json"), DONE if found.effects else NO_RESULT
    )
