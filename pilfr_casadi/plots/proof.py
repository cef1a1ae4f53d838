"""Figures that prove a diagnosis: the hidden force with the law on top, and recordings before and after."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ..data import Recording
from .canvas import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    VERMILLION,
    axes_or_new,
    decibel,
    drawable,
    finish,
    limit_depth,
    line,
    plain,
    scaled,
    with_unit,
)
from .signals import amplitude_density, busiest

CLOUD_POINTS = 2500  # as many as can be told apart in a figure


def force_cloud(
    x: np.ndarray,
    force: np.ndarray,
    law_x: np.ndarray,
    law: np.ndarray,
    *,
    across: str,
    label: str,
    title: str = "",
    unit: str = "",
    across_unit: str = "",
    name: str = "fitted law",
    ax: Axes | None = None,
) -> Axes:
    """Draw a recovered force over a local signal as points, and the law along the simulation as a line.

    Parameters
    ----------
    x, force : array, (K,)
        Local signal and recovered force.
    law_x, law : array, (M,)
        Local signal and force of the law; may be empty.
    across, label, title, name : str
        Names of the local signal, the force, the figure and the law; units in `across_unit` and `unit`.
    """
    ax = axes_or_new(ax)
    (sx, ux), (sy, uy) = scaled(x, across_unit), scaled(force, unit)
    every = max(len(x) // CLOUD_POINTS, 1)
    ax.plot(x[::every] / sx, force[::every] / sy, ".", color=BLUE, markersize=2.6, alpha=0.55,
            label="recovered from the recording", rasterized=True)  # fmt: skip
    if len(law):
        ax.plot(law_x / sx, law / sy, color=VERMILLION, linewidth=0.9, alpha=0.9, label=plain(name), rasterized=True)
    ax.set_ylim(*_span(force / sy, law / sy))
    return finish(ax, with_unit(across, ux), with_unit(label, uy), title)


def force_time(
    t: np.ndarray, force: np.ndarray, std: np.ndarray, law: np.ndarray, *, label: str, unit: str = "", name: str = "law"
) -> Axes:
    """Draw a recovered force over time with its uncertainty, around its largest value, and the law's force."""
    ax = axes_or_new(None)
    size, unit = scaled(force, unit)
    window = max(min(len(force), 400), len(force) // 12)
    peak = int(np.argmax(np.abs(force)))
    begin = int(np.clip(peak - window // 2, 0, len(force) - window))
    part = slice(begin, begin + window)
    low, high = (force - std)[part] / size, (force + std)[part] / size
    ax.fill_between(t[part], low, high, color=BLUE, alpha=0.25, linewidth=0, label="± one standard deviation")
    line(ax, t[part], force[part] / size, "recovered from the recording", BLUE, linewidth=1.6)
    if len(law):
        line(ax, t[part], law[: len(t)][part] / size, name, VERMILLION, linewidth=1.3)
    ax.set_ylim(*_span(force[part] / size, law[: len(t)][part] / size))
    ax.margins(x=0.01)
    return finish(ax, "time [s]", with_unit(label, unit), "", 3)


def force_left(
    x: np.ndarray, left: np.ndarray, std: np.ndarray, *, across: str, label: str, unit: str = "", across_unit: str = ""
) -> Axes:
    """Draw the part of a recovered force that a law leaves, as points over the local coordinate, with the mean."""
    ax = axes_or_new(None)
    (sx, ux), (sy, uy) = scaled(x, across_unit), scaled(left, unit)
    every = max(len(x) // CLOUD_POINTS, 1)
    ax.plot(x[::every] / sx, left[::every] / sy, ".", color=BLUE, markersize=2.6, alpha=0.4, rasterized=True)
    edges = np.quantile(x, np.linspace(0, 1, 21))
    index = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, 19)
    count = np.bincount(index, minlength=20)
    known = count > 0
    mean = np.bincount(index, left, minlength=20)[known] / count[known]
    middle = np.bincount(index, x, minlength=20)[known] / count[known]
    ax.plot(middle / sx, mean / sy, "o-", color=INK, linewidth=1.6, markersize=3.5, label="mean")
    for side in (1, -1):
        ax.axhline(side * float(np.median(std)) / sy, color=GREEN, linestyle="--", linewidth=1.3,
                   label="± one standard deviation" if side > 0 else None)  # fmt: skip
    ax.set_ylim(*_span(left / sy))
    return finish(ax, with_unit(across, ux), with_unit(label, uy), "recovered − law")


def _span(values: np.ndarray, law: np.ndarray | None = None) -> tuple[float, float]:
    """Choose limits that a few stray points do not stretch, and that show the law whole."""
    low, high = np.quantile(values[np.isfinite(values)], [0.001, 0.999])
    if law is not None and np.any(np.isfinite(law)):
        low, high = min(low, np.nanmin(law)), max(high, np.nanmax(law))
    room = 0.08 * (high - low) or 1.0
    return float(low - room), float(high + room)


Simulated = list[tuple[str, np.ndarray | None]]  # (label, outputs (M, n_y)), before first, after last
COLOURS = (ORANGE, INK)


def compared_traces(
    r: Recording, simulated: Simulated, output: int = 0, unit: str = "", *, quiet: bool = False, ax: Axes | None = None
) -> Axes:
    """Draw measured output and simulations, a few swings around the largest one, or in a `quiet` stretch."""
    ax = axes_or_new(ax)
    y = r.y[:, output]
    begin, end = busiest(y - np.mean(y), r)
    first = round(begin / r.dt)
    part = slice(first, max(round(end / r.dt), first + 2))
    part = _quiet(y, part.stop - part.start, r.skip) if quiet else part
    size, unit = scaled(y[part], unit)
    line(ax, r.t[part], y[part] / size, "measured", BLUE, linewidth=4.0, alpha=0.45)
    for (label, values), colour in zip(simulated, COLOURS, strict=False):
        if values is not None:
            line(ax, r.t[part], drawable(values[part, output], np.ptp(y)) / size, label, colour, linewidth=1.4)
    ax.margins(x=0.01)
    return finish(ax, "time [s]", with_unit(r.outputs[output], unit), r.name, 3)


def _quiet(y: np.ndarray, length: int, skip: int) -> slice:
    """Select a stretch with less motion than three quarters of all."""
    length = min(length, max((len(y) - skip) // 6, 2))
    starts = np.arange(skip, len(y) - length + 1, max(length // 4, 1))
    motion = np.array([np.std(y[a : a + length]) for a in starts])
    a = int(starts[np.argsort(motion)[len(starts) // 4]])
    return slice(a, a + length)


def compared_residuals(
    r: Recording, simulated: Simulated, output: int, unit: str, floor: float, ax: Axes | None = None
) -> Axes:
    """Draw the residuals of simulations over the whole recording; `floor` is the deviation of the noise."""
    ax = axes_or_new(ax)
    y = r.y[:, output]
    kept: list[tuple[str, np.ndarray, Any]] = [
        (label, drawable(v[:, output] - y, np.ptp(y)), colour)
        for (label, v), colour in zip(simulated, COLOURS, strict=False)
        if v is not None
    ]
    size, unit = scaled(np.nan_to_num(kept[0][1]) if kept else y, unit)
    for label, e, colour in kept:
        line(ax, r.t, e / size, label, colour, linewidth=0.8)
    if floor > 0:
        for side in (2 * floor, -2 * floor):
            ax.axhline(side / size, color=GREEN, linewidth=1.2, linestyle="--", label="± 2 noise" if side > 0 else None)
    ax.margins(x=0.01)
    return finish(ax, "time [s]", with_unit(f"simulated − measured {r.outputs[output]}", unit), r.name, 3)


def compared_spectra(r: Recording, simulated: Simulated, output: int, unit: str, floor: float) -> Axes:
    """Draw amplitude densities of the output, of each residual, and of white noise of deviation `floor`."""
    ax = axes_or_new(None)
    y, curves = r.y[:, output], []
    signals = [("measured", y, BLUE)]
    for (label, v), colour in zip(simulated, COLOURS, strict=False):
        if v is not None:
            signals.append((f"left {label}", v[:, output] - y, colour))
    f = np.array([0.1, 1.0])
    for label, signal, colour in signals:
        f, power = amplitude_density(signal, r)
        curves.append(decibel(power))
        line(ax, f, curves[-1], label, colour, linewidth=1.2)
    if floor > 0:
        level = np.full(2, 10 * np.log10(2 * r.dt * floor**2))
        curves.append(level)
        line(ax, f[[0, -1]], level, "noise floor (white)", GREEN, linestyle="--", linewidth=1.5)
    ax.set_xscale("log")
    limit_depth(ax, *curves)
    return finish(ax, "frequency [Hz]", f"{r.outputs[output]} [dB re {unit or '1'}/√Hz]", r.name)
