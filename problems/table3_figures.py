"""Figs. 13, 14 and 15 of Krikelis et al. (2024), drawn from the recordings and fits of `problems.table3`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pilfr_casadi import plots
from pilfr_casadi.data import Recording
from pilfr_casadi.identify import Fit
from pilfr_casadi.linear import frequency_subspace, robust_bla

from .piezo_platform import Measurement

ORDER = 15  # of the linear model over the wide band
SHOWN = "PI-LFR nx=15 N=20"


def quietened(recordings: tuple[Recording, ...]) -> list[Recording]:
    """Recordings whose single periods are as noisy as the mean over all periods of the given ones."""
    out = []
    for r in recordings:
        assert r.period is not None
        periods = r.y.reshape(-1, r.period, r.n_y)
        mean = periods.mean(axis=0)
        out.append(r.with_(y=(mean + (periods - mean) / np.sqrt(len(periods))).reshape(r.y.shape)))
    return out


def draw(wide: Measurement, data: Measurement, fits: Mapping[str, Fit], folder: Path) -> Path:
    """Write the figures as PNG into `folder`.

    Parameters
    ----------
    wide, data : Measurement
        Recordings of the linear analysis and of the models; the last realization of `data` is the test.
    fits : mapping
        Row of the table to its fit.
    folder : Path
        Made where it does not exist.
    """
    folder.mkdir(parents=True, exist_ok=True)
    bla, test = robust_bla(wide.recordings), data.averaged()[-1].with_(name="test")
    best = replace(fits[SHOWN], linear=fits["LTI nx=8"].model)
    linear = frequency_subspace(bla, ORDER)
    fig14 = plots.new_figure(11.0, 4.2)
    plots.time(best, test, ax=fig14.add_subplot(1, 2, 1))
    plots.spectrum(best, test, steady=quietened(data.recordings[-1:]), ax=fig14.add_subplot(1, 2, 2))
    fig15 = plots.new_figure(9.6, 4.0)
    plots.loop(best, test, ax=fig15.add_subplot(1, 2, 1))
    plots.loop(best, test, bare=True, ax=fig15.add_subplot(1, 2, 2))
    figures: dict[str, Any] = {
        "fig13_linear": plots.best_linear_approximation(bla, linear, unit="µm/V").figure,
        "fig14_test": fig14,
        "fig15_hysteresis": fig15,
    }
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.png", dpi=110)
    return folder
