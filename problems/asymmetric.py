"""What the generalized play is for: a loop unlike up and down that saturates (`python -m problems.asymmetric`).

Every operator of Krikelis et al. (2024), Sec. 2, in the same PI-LFR on the same records of a shape-memory wire
(`problems.shape_memory`), judged on records that were not fitted: another multisine, and swings that run through nested
loops and leave the range that training has seen. Sums of plays or of stops are odd in shape (the branch down is the
branch up turned by half a turn) whatever their weights; a generalized play has one envelope for each direction.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from pilfr_casadi.data import Recording
from pilfr_casadi.identify import Fit, fit
from pilfr_casadi.models import PILFR, GeneralizedPlay, Play, PrandtlIshlinskii, Stop

from .shape_memory import NOISE, records, temperature

TESTS = ("multisine", "swings")
NEURONS = 4
ROWS: dict[str, PILFR] = {
    "linear": PILFR(1),
    "plays N=20, no dynamics": PILFR(0, PrandtlIshlinskii(Play, 20)),
    **{f"plays N={n}": PILFR(1, PrandtlIshlinskii(Play, n)) for n in (5, 10, 20)},
    **{f"stops N={n}": PILFR(1, PrandtlIshlinskii(Stop, n)) for n in (5, 10, 20)},
    "generalized N=8, no dynamics": PILFR(0, PrandtlIshlinskii(GeneralizedPlay(NEURONS), 8)),
    **{f"generalized N={n}": PILFR(1, PrandtlIshlinskii(GeneralizedPlay(NEURONS), n)) for n in (1, 2, 4, 8)},
}


def identify(
    rows: Mapping[str, PILFR], data: Mapping[str, Sequence[Recording]], *, starts: int = 6, **options: Any
) -> dict[str, Fit]:
    """Row of the table to its fit of the training records."""
    return {name: fit(structure, data["train"], starts=starts, **options) for name, structure in rows.items()}


def errors(result: Fit, data: Mapping[str, Sequence[Recording]]) -> list[float]:
    """NRMSE (Eq. 27) on the training records and on each test."""
    return [result.nrmse(data[name]) for name in ("train", *TESTS)]


def draw(fits: Mapping[str, Fit], data: Mapping[str, Sequence[Recording]], path: Path) -> None:
    """Stroke over the wire's temperature in the swings: measured, and as each of the models has it."""
    from pilfr_casadi import plots

    swings = data["swings"][0]
    at = temperature(swings.u[:, 0])
    figure = plots.new_figure(4.0 * len(fits), 3.6)
    for k, (name, result) in enumerate(fits.items()):
        curves = {"measured": (at, swings.y[:, 0]), "model": (at, result.simulate(swings)[:, 0])}
        ax = figure.add_subplot(1, len(fits), k + 1)
        plots.loops(curves, "temperature above ambient [K]", "stroke [mm]", title=name, ax=ax)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table and draw the loops."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0, help="records (default 0)")
    parser.add_argument("--starts", type=int, default=6)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("runs/asymmetric"), help="folder for the picture")
    options = parser.parse_args(arguments)
    data = records(options.seed)
    fits: dict[str, Fit] = {}
    print(f"shape-memory wire, NRMSE; tests are held out; noise floor {NOISE}")
    print(f"{'':<30}" + "".join(f"{name:>11}" for name in ("train", *TESTS)))
    with ProcessPoolExecutor(options.workers) as pool:
        for name, structure in ROWS.items():
            one = identify({name: structure}, data, starts=options.starts, executor=pool)
            fits |= one
            cells = "".join(f"{e:11.4f}" for e in errors(one[name], data))
            print(f"{name:<30}{cells}   {one[name].seconds:5.1f} s", flush=True)
    shown = {name: fits[name] for name in ("plays N=20", "stops N=20", "generalized N=8")}
    picture = options.out / "loops.png"
    draw(shown, data, picture)
    print(f"picture: {picture}")


if __name__ == "__main__":
    main()
