"""Figs. 3, 7, 8, 9, 10 and 11 of Krikelis et al. (2024), drawn from our own records and fits."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pilfr_casadi import plots
from pilfr_casadi.bla import robust_bla
from pilfr_casadi.demo import FLOOR, PUBLISHED, SETS
from pilfr_casadi.fit import Fit

from .masing_data import FS, Benchmark, benchmark

FREQUENCIES = (0.5, 1.5, 3.0, 6.0, 12.0, 24.0)  # Hz, Fig. 7


def _sweep_loops(data: Benchmark) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Spring force over the displacement of mass 1 for the cycle of the sweep around each frequency."""
    motion, loops = data.truth["sweep"], {}
    for f in FREQUENCIES:
        middle, half = int((f - 0.1) / 1.17 * FS), max(int(0.6 * FS / f), 6)
        part = slice(max(middle - half, 0), middle + half)
        loops[f"{f:g} Hz"] = (1e3 * motion.x1[part], motion.k_H[part])
    return loops


def draw(seed: int, fits: Mapping[str, Fit], errors: Mapping[str, np.ndarray], folder: Path) -> Path:
    """Write the figures as PNG into `folder`.

    Parameters
    ----------
    seed : int
        The record.
    fits : mapping
        Row of the table to its fit.
    errors : mapping
        Row of the table to the errors of its starts on the three records, shape (starts, 3).
    folder : Path
        Made where it does not exist.
    """
    folder.mkdir(parents=True, exist_ok=True)
    data = benchmark(seed)
    best = fits["PI-LFR N=20"]
    bla = robust_bla([r.with_(initial="estimate") for r in data.steady])
    figures: dict[str, Any] = {
        "fig03_operators": plots.operators_demo(),
        "fig07_loops": plots.loops(
            _sweep_loops(data), "displacement of mass 1 [mm]", "spring force [N]", title="sweep, truth"
        ).figure,
        "fig08_linear": plots.best_linear_approximation(bla, best.linear, unit="m/N").figure,
        "fig09_multisine": plots.plot_fit(best, data.records["multisine"], steady=data.steady),
        "fig10_sweep": plots.plot_fit(best, data.records["sweep"]),
    }
    rows = [row for row in errors if row != "LTI"]
    if rows:
        groups = {
            name: {r.removeprefix("PI-LFR "): errors[r][:, i].tolist() for r in rows} for i, name in enumerate(SETS)
        }
        published = {name: {r.removeprefix("PI-LFR "): PUBLISHED[r][i] for r in rows} for i, name in enumerate(SETS)}
        figures["fig11_starts"] = plots.compared_spread(
            groups, published=published, floor=FLOOR, source="published 25th percentile", x="operators"
        )
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.png", dpi=110)
    return folder
