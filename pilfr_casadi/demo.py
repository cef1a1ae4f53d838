"""The demonstration: identify a two-mass rig with a hysteretic spring from recordings that come with the package.

The recordings are the benchmark of Krikelis et al. (2024), Sec. 6, simulated exactly: a training multisine, a multisine
test and a sine-sweep test, 50 dB signal-to-noise ratio. `python -m problems.masing_rig --write-demo` writes them.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import as_file, files
from pathlib import Path

from .elements import PrandtlIshlinskii
from .fit import Fit, fit
from .lfr import PILFR
from .operators import Play
from .progress import progress_bar
from .readers import read_csv
from .recording import Recording
from .solution import Status

SETS = ("train", "multisine", "sweep")
FLOOR = 0.0032
# Krikelis et al. (2024), Table 2: NRMSE on training, multisine test and sweep test (25th percentiles of 100 starts)
PUBLISHED: Mapping[str, tuple[float, float, float]] = {
    "LTI": (0.3026, 0.2910, 0.4799),
    "PI-LFR N=5": (0.0275, 0.0441, 0.0331),
    "PI-LFR N=10": (0.0090, 0.0153, 0.0154),
    "PI-LFR N=15": (0.0078, 0.0143, 0.0144),
    "PI-LFR N=20": (0.0073, 0.0134, 0.0153),
}


def demo_recordings() -> dict[str, Recording]:
    """The recordings `train`, `multisine` and `sweep`: force u in N, displacement x2 in m, 120 Hz."""
    out = {}
    for name in SETS:
        with as_file(files(__package__) / "demo_data" / f"{name}.csv") as path:
            out[name] = read_csv(path, "u", "x2", units={"u": "N", "x2": "m"}, initial="zero", hold="zero", name=name)
    return out


def structure(n: int) -> PILFR:
    """The paper's model: five states and N plays, or none (n = 0)."""
    return PILFR(5, PrandtlIshlinskii(Play, n) if n else None)


def run_demo(folder: Path, workers: int) -> int:
    """Identify, print the table beside the published one, write the report; returns the exit status."""
    from rich.console import Console
    from rich.table import Table

    from .report import fit_report

    recordings = demo_recordings()
    console = Console()
    console.print("A force drives one mass, its displacement is measured; a second mass hangs on a hysteretic spring.")
    table = Table("model", *SETS, "time", title="NRMSE in simulation, in brackets Krikelis et al. (2024), Table 2")
    best: Fit | None = None
    for row, published in PUBLISHED.items():
        n = 0 if row == "LTI" else int(row.partition("=")[2])
        with progress_bar() as progress:
            result = fit(structure(n), recordings["train"], workers=workers, progress=progress)
        if result.status is Status.INTERRUPTED:
            console.print("Interrupted; nothing was written.")
            return 130
        errors = [result.nrmse(recordings[s]) for s in SETS]
        cells = [f"{e:.4f} ({p:.4f})" for e, p in zip(errors, published, strict=True)]
        table.add_row(row, *cells, f"{result.seconds:.1f} s")
        best = result
    table.add_row("noise floor", *(f"{FLOOR:.4f}" for _ in SETS), "")
    console.print(table)
    assert best is not None
    best.save(folder / "model.json")
    page = fit_report(best, [recordings["train"]], [recordings["multisine"], recordings["sweep"]], folder)
    console.print(best.status.value)
    console.print(
        f"The model is in {folder / 'model.json'}; for the pictures open {page} in a browser.", soft_wrap=True
    )
    return 0 if best.status.converged else 1
