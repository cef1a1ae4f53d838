"""Figures of a fit: its element (loop, loading curve, weights over thresholds), its convergence, and a summary figure.

Krikelis et al. (2024), Eq. 16 and Fig. 15.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .._base import InputError
from ..data import Recording, as_recordings, name_with_unit
from ..models import weight_density
from ..optimise import Iteration
from .canvas import BLUE, GREY, PALE_BLUE, SKY, VERMILLION, WholeLocator, axes_or_new, check_index, finish, new_figure
from .fit_signals import PlottedFit, as_scored, spectrum, time

Records = Recording | Sequence[Recording]
FEWEST_FOR_DENSITY = 4  # operators in use; fewer weights do not sample a density
CURVE_POINTS = 300  # points of a drawn curve


def loop(
    fit: PlottedFit, recording: Recording, *, channel: int = 0, bare: bool = False, ax: Axes | None = None
) -> Axes:
    """Draw the identified hysteresis: the element's output w over its input z along a recording, as Fig. 15.

    `bare` subtracts the line through the origin that fits w best, so that only the hysteresis remains.
    """
    check_index(channel, fit.model.n_w, "channel")
    signals, index = fit.signals(recording), _index(fit, channel)
    first = as_scored(fit, recording).skip
    z, w = (signals[key][first:, channel] for key in "zw")
    name, title = f"w{index}", "loop" if fit.model.n_s else "curve"
    if bare:
        slope = float(z @ w / (z @ z)) if np.any(z) else 0.0
        w, name, title = w - slope * z, f"w{index} − {slope:.3g} z{index}", "loop without its slope"
    ax = axes_or_new(ax)
    order = slice(None) if fit.model.n_s else np.argsort(z)
    ax.plot(z[order], w[order], color=BLUE, linewidth=0.7, rasterized=True)
    across, up = _label(fit, "z", channel), _label(fit, "w", channel, name)
    return finish(ax, across, up, ", ".join(filter(None, (title, recording.name))))


def loading_curve(
    fit: PlottedFit, recordings: Records | None = None, *, channel: int = 0, ax: Axes | None = None
) -> Axes:
    """Draw the element's response to z growing from rest (virgin curve), and shade the range of the recordings."""
    check_index(channel, fit.model.n_w, "channel")
    ax, reach, limit = axes_or_new(ax), _reach(fit, recordings, channel), _range(fit, recordings, channel)
    z = np.linspace(0.0, limit, CURVE_POINTS)
    if reach:
        ax.axvspan(0, reach, color=PALE_BLUE, linewidth=0, label="|z| in the recordings")
    ax.plot(z, virgin_curve(fit, z, channel), color=BLUE, linewidth=1.8, label="fitted")
    ax.margins(x=0)
    return finish(ax, _label(fit, "z", channel), _label(fit, "w", channel), "loading curve")


def virgin_curve(fit: PlottedFit, z: np.ndarray, channel: int = 0) -> np.ndarray:
    """Compute w (G,) while one channel's z runs through the values (G,), from zero memory."""
    model, p = fit.model, fit.model.parameters.start
    memory, out = np.zeros(model.n_s), np.empty(len(z))
    for k, value in enumerate(z):
        w, memory = model.memory(value * np.eye(model.n_w)[channel], memory, p)
        out[k] = w[channel]
    return out


def draw_density(ax: Axes, r: np.ndarray, w: np.ndarray, limit: float) -> Axes | None:
    """Draw the smoothed density of weights w over thresholds r on a right axis; None if there are too few weights."""
    if np.count_nonzero(w) < FEWEST_FOR_DENSITY:
        return None
    right, grid = ax.twinx(), np.linspace(0.0, limit, CURVE_POINTS)
    density = weight_density(r, w, grid, limit / 12)
    right.plot(grid, density, color=VERMILLION, linewidth=1.8, label="smoothed density (right)")
    finish(right, "", "density dw/dr", legend=False).grid(False)
    right.spines["right"].set_visible(True)
    right.set_ylim(bottom=0)
    return right


def weights(fit: PlottedFit, recordings: Records | None = None, *, channel: int = 0, ax: Axes | None = None) -> Axes:
    """Draw the weight over the threshold of every operator, and with four operators or more the density of weights."""
    check_index(channel, fit.model.n_w, "channel")
    values = fit.parameters
    if not {"r", "w"} <= set(values):
        raise InputError(
            "The element has no thresholds r and weights w; only a Prandtl-Ishlinskii element has a density of weights."
        )
    ax = axes_or_new(ax)
    r, w = values["r"][channel], values["w"][channel]
    order, limit = np.argsort(r), _range(fit, recordings, channel)
    r, w = r[order], w[order]
    ax.vlines(r, 0, w, color=SKY, linewidth=1.5)
    errors = fit.errors.get("w")
    spread = None if errors is None else np.nan_to_num(errors[channel][order], posinf=0.0)
    right = draw_density(ax, r, w, limit)
    label = "weights w" if right is None else "weights w (left)"
    ax.errorbar(r, w, yerr=spread, fmt="o", markersize=4, color=BLUE, elinewidth=1, label=label)
    across = _label(fit, "z", channel, f"threshold r{_index(fit, channel)}")
    finish(ax, across, "weight w", "weights over thresholds", 1, twin=right)
    ax.set_ylim(bottom=0)
    ax.set_xlim(-0.02 * limit, limit)
    return ax


def _index(fit: PlottedFit, channel: int) -> str:
    return str(channel + 1) if fit.model.n_w > 1 else ""


def _label(fit: PlottedFit, signal: str, channel: int, name: str = "") -> str:
    """Label an axis of an element's signal, with a unit if the signal is an input or output."""
    index = _index(fit, channel)
    reads, writes = (("C_z", "D_zu"), fit.model.inputs), (("C_y", "D_yu", "D_yw"), fit.model.outputs)
    blocks, names = reads if signal == "z" else writes
    parameters, name = fit.model.parameters, name or f"{signal}{index}"
    if set(blocks) <= set(parameters) and (signal == "z" or len(names) == fit.model.n_w):
        rows = [parameters[block].value[channel] for block in blocks]
        fixed = all(np.all(np.broadcast_to(parameters[b].fixed, parameters[b].value.shape)[channel]) for b in blocks)
        *others, last = rows
        i = int(np.argmax(last))
        passed_through = np.count_nonzero(last) == 1 and last[i] == 1.0 and not any(np.any(row) for row in others)
        if fixed and passed_through and (signal == "z" or i == channel):
            return name_with_unit(name, fit.units.get(names[i], ""))
    return f"{name} (model scale)"


def _reach(fit: PlottedFit, recordings: Records | None, channel: int) -> float:
    records = () if recordings is None else as_recordings(recordings)
    return max((float(np.nanmax(np.abs(fit.signals(r)["z"][:, channel]))) for r in records), default=0.0)


def _range(fit: PlottedFit, recordings: Records | None, channel: int) -> float:
    """Choose the range in which to draw an element: the visited range, and thresholds not far beyond."""
    reach, r = _reach(fit, recordings, channel), fit.parameters.get("r")
    largest = 0.0 if r is None else float(np.max(r[channel]))
    limit = 1.05 * (max(reach, min(largest, 1.5 * reach)) if reach else largest)
    return limit if limit > 0 and np.isfinite(limit) else 1.0


def plot_fit(fit: PlottedFit, recordings: Records, *, steady: Sequence[Recording] | None = None) -> Figure:
    """Draw a fit in one figure: time and spectrum of every output, loop, loading curve and weights of every channel.

    For a model without hysteresis, the convergence replaces the channels, with the curve of a one-channel element.
    Noise and distortion levels are estimated from `steady`; see `spectrum`.
    """
    records = as_recordings(recordings)
    rows = [(r, i) for r in records for i in range(r.n_y)]
    channels, curve = fit.model.n_w if fit.model.n_s else 0, fit.model.n_w == 1 and not fit.model.n_s
    figure = new_figure(11.0, 3.4 * (len(rows) + channels + (not channels)))
    grid = figure.add_gridspec(len(rows) + max(channels, 1), 6)
    for k, (r, i) in enumerate(rows):
        time(fit, r, output=i, ax=figure.add_subplot(grid[k, :3]))
        spectrum(fit, r, output=i, steady=steady, ax=figure.add_subplot(grid[k, 3:]))
    for c in range(channels):
        row = len(rows) + c
        loop(fit, records[0], channel=c, ax=figure.add_subplot(grid[row, :2]))
        loading_curve(fit, records, channel=c, ax=figure.add_subplot(grid[row, 2:4]))
        if {"w", "r"} <= set(fit.parameters):
            weights(fit, records, channel=c, ax=figure.add_subplot(grid[row, 4:]))
    if not channels:
        convergence(fit, ax=figure.add_subplot(grid[len(rows), 2 * curve :]))
    if curve:
        loop(fit, records[0], ax=figure.add_subplot(grid[len(rows), :2]))
    return figure


def convergence(fit: PlottedFit, *, ax: Axes | None = None) -> Axes:
    """Draw the training error over the iterations of every start and of the final solve."""
    ax = axes_or_new(ax)

    def draw(history: Sequence[Iteration], label: str | None, **style: Any) -> None:
        error = np.sqrt(2 * np.maximum([h.cost for h in history], 0.0))
        ax.plot([h.number for h in history], error, label=label, **style)

    starts = [c.solution.history for c in fit.candidates if c.solution.history]
    for k, history in enumerate(starts):
        draw(history, "starts" if k == 0 else None, color=GREY, linewidth=0.9, alpha=0.7)
    if fit.solution.history:
        draw(fit.solution.history, "last solve of the best", color=VERMILLION, linewidth=2.0)
    ax.set_yscale("log")
    ax.xaxis.set_major_locator(WholeLocator())
    return finish(ax, "iteration", "training error √(2 · cost)", "convergence")
