"""Figures of a diagnosis: the mismatch, the hidden force and the law, learned forces, a refined hysteresis layer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from ..data import name_with_unit
from .canvas import (
    BLUE,
    FONT,
    GREEN,
    GREY,
    INK,
    MAP_COLOURS,
    PALE_GREY,
    SKY,
    VERMILLION,
    choose_scale,
    finish,
    line,
    new_figure,
    noise_band,
    noise_line,
    plain,
    scale_axis,
)
from .fits import draw_density

CLOUD_POINTS = 2500  # more cannot be told apart in a figure
STRENGTH_BINS = 30  # of the signal that varies a strength
LINE_POINTS = 400  # samples along which laws are drawn over a learned force: a few swings


def mismatch_map(found: Mapping[str, Any], unit: str = "") -> Axes:
    """Draw the residual over frequency and amplitude (`diagnose.mismatch`), in % of the outputs' deviation."""
    ax = new_figure().add_subplot()
    data, (size, label) = found["map"], _scale_outputs(found, unit)
    edges, rms = np.asarray(data["edges"]) * size, 100 * np.array(data["rms"], dtype=float)
    top = max(float(np.nanmax(rms, initial=0.0)), 1e-12)
    excited = np.flatnonzero(np.nanmax(np.nan_to_num(rms), axis=1) > 1e-3 * top)  # bands with a residual
    rows = slice(int(excited[0]), int(excited[-1]) + 1) if len(excited) else slice(0, len(rms))
    frequency = _log_edges(data["low"][rows], data["high"][rows])
    rms = np.ma.masked_invalid(np.maximum(rms[rows], 1e-300))
    mesh = ax.pcolormesh(edges, frequency, rms, norm=LogNorm(top / 100, top), cmap=MAP_COLOURS, rasterized=True)
    _draw_colour_bar(ax, mesh, "residual [% of the output's deviation]", extend="min")
    ax.set_yscale("log")
    ax.set_facecolor(PALE_GREY)
    finish(ax, label, "frequency [Hz]", "residual by frequency and amplitude")
    ax.grid(False)
    return ax


def _log_edges(low: Sequence[float], high: Sequence[float]) -> np.ndarray:
    """Return the edges of adjacent frequency bands; a lowest edge of zero is moved up to fit on a logarithmic axis."""
    edges = np.append(np.asarray(low, dtype=float), high[-1])
    edges[0] = edges[0] or edges[1] / np.sqrt(2)
    return edges


def _scale_outputs(found: Mapping[str, Any], unit: str, kind: str = "amplitude") -> tuple[float, str]:
    """Choose factor and label of an axis of amplitudes or rates; a single output keeps its own unit."""
    per = "/s" if kind == "rate" else ""
    if len(found["scale"]) != 1:
        return 1.0, f"{kind} of the outputs [deviations{per}]"
    ((name, scale),) = found["scale"].items()
    factor, label = choose_scale(scale * np.asarray(found[kind]["edges"]), (unit + per) if unit else "")
    return scale / factor, name_with_unit(f"{kind} of {name}", label)


def mismatch_bands(found: Mapping[str, Any]) -> Axes:
    """Draw the residual and the noise floor of each frequency band; fill bands with a tenth or more of the mismatch."""
    ax = new_figure().add_subplot()
    data = found["frequency"]
    edges = _log_edges(data["low"], data["high"])
    rms, floor = (100 * np.sqrt(np.asarray(data[k])) for k in ("power", "floor"))
    bottom = 0.5 * min(floor[floor > 0].min(initial=np.inf), rms[rms > 0].min(initial=np.inf))
    bottom = bottom if np.isfinite(bottom) else 1e-6
    strong = np.asarray(data["share"]) >= 0.1
    ax.bar(edges[:-1][strong], rms[strong] - bottom, np.diff(edges)[strong], bottom, align="edge", color=VERMILLION,
           alpha=0.35, label="a tenth or more of the mismatch")  # fmt: skip
    ax.stairs(rms, edges, color=VERMILLION, linewidth=1.8, label="residual", baseline=None)
    if np.any(floor > 0):
        ax.stairs(floor, edges, color=GREEN, linewidth=1.6, linestyle="--", label="noise floor", baseline=None)
    ax.set_xscale("log")
    ax.set_yscale("log")
    return finish(ax, "frequency [Hz]", "rms per band [% of deviation]", "over frequency")


def mismatch_growth(found: Mapping[str, Any], unit: str = "", kind: str = "amplitude") -> Axes:
    """Draw the residual over the `amplitude` or the `rate` of the output, and a proportional error to compare with."""
    ax = new_figure().add_subplot()
    data, (size, label) = found[kind], _scale_outputs(found, unit, kind)
    edges = np.asarray(data["edges"])
    middle = (edges[1:] + edges[:-1]) / 2
    rms = 100 * np.array(data["rms"], dtype=float)
    ax.plot(middle * size, rms, "o-", color=VERMILLION, linewidth=1.8, label="residual")
    known = np.flatnonzero(np.isfinite(rms) & (rms > 0))
    if len(known):
        k = int(known[len(known) // 2])
        ax.plot(middle * size, rms[k] * middle / middle[k], ":", color=GREY, linewidth=1.4, label="in proportion")
    noise_line(ax, 100 * found["floor"])
    ax.set_xlim(left=0)
    _use_log_scale(ax)
    return finish(ax, label, "residual [% of deviation]", f"over {kind}", 3)


def mismatch_level(found: Mapping[str, Any], unit: str = "") -> Axes:
    """Draw the residual over the value of the output that shows most of it, to reveal an asymmetry."""
    ax = new_figure().add_subplot()
    data = found["level"]
    edges = found["scale"][data["output"]] * np.asarray(data["edges"])
    size, across = scale_axis(data["output"], edges, unit)
    rms = 100 * np.array(data["rms"], dtype=float)
    ax.stairs(rms, edges / size, color=VERMILLION, linewidth=1.8, label="residual", baseline=None)
    noise_line(ax, 100 * found["floor"])
    return finish(ax, across, "residual [% of deviation]", "over level")


def mismatch_time(found: Mapping[str, Any]) -> Axes:
    """Draw residual and motion over time, one recording after the other."""
    ax = new_figure().add_subplot()
    at = 0.0
    for k, part in enumerate(found["time"]):
        t = np.asarray(part["t"])
        step = t[1] - t[0] if len(t) > 1 else 1.0
        edges = at + np.append(t - step / 2, t[-1] + step / 2)
        motion, residual = (100 * np.asarray(part[key]) for key in ("output", "rms"))
        labels = (None, None) if k else ("motion of the output", "residual")
        ax.stairs(motion, edges, color=BLUE, linewidth=1.4, baseline=None, label=labels[0])
        ax.stairs(residual, edges, color=VERMILLION, linewidth=1.8, baseline=None, label=labels[1])
        if k:
            ax.axvline(at, color=GREY, linewidth=0.8)
        if len(found["time"]) > 1 and part["name"]:
            ax.annotate(plain(part["name"][:24]), (edges[0], 1), (4, -4), xycoords=("data", "axes fraction"),
                        textcoords="offset points", va="top", fontsize=FONT - 2, color=INK)  # fmt: skip
        at = edges[-1]
    noise_line(ax, 100 * found["floor"])
    _use_log_scale(ax)
    ax.margins(x=0.01)
    return finish(ax, "time [s]", "rms [% of deviation]", "over time", 3)


def _draw_colour_bar(ax: Axes, mesh: Any, label: str, **style: Any) -> None:
    bar = ax.figure.colorbar(mesh, ax=ax, pad=0.02, **style)
    bar.set_label(label, fontsize=FONT - 1)
    _label_log_axis(bar.ax.yaxis, mesh.norm.vmin, mesh.norm.vmax)
    bar.ax.tick_params(labelsize=FONT - 1)


def _use_log_scale(ax: Axes) -> None:
    """Make the vertical axis logarithmic, with a few plain numbers."""
    ax.set_yscale("log")
    _label_log_axis(ax.yaxis, *ax.get_ylim())


def _label_log_axis(axis: Any, low: float, high: float) -> None:
    """Label a logarithmic axis with a few plain numbers."""
    subs = (1.0,) if high > 300 * low else (1.0, 2.0, 5.0) if high > 3 * low else tuple(np.arange(1.0, 10.0))
    axis.set_major_locator(LogLocator(10, subs))
    axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}" if 1e-4 < v < 1e5 else f"{v:.0e}"))
    axis.set_minor_formatter(NullFormatter())


@dataclass(frozen=True)
class Signal:
    """Values (K,) with name and unit for their axis."""

    name: str
    values: np.ndarray
    unit: str = ""

    def scale_axis(self) -> tuple[float, str]:
        """Choose the power of a thousand by which to divide the values; return it and the axis label."""
        return scale_axis(self.name, self.values, self.unit)


def force_cloud(
    x: Signal, force: Signal, law_x: np.ndarray, law: np.ndarray, *, title: str = "", name: str = "fitted law"
) -> Axes:
    """Draw a recovered force over a local signal as points, and the named law along the simulation as a line.

    A law that is a curve of the signal is drawn from left to right; drawn in time order, its samples would be joined by
    chords.
    """
    ax = new_figure().add_subplot()
    sx, sy, across, up = _draw_cloud(ax, x, force, alpha=0.55, label="recovered from the recording")
    order = np.argsort(law_x, kind="stable")
    if np.sum(np.abs(np.diff(law[order]))) <= np.sum(np.abs(np.diff(law))):
        law_x, law = law_x[order], law[order]
    if len(law):
        ax.plot(law_x / sx, law / sy, color=VERMILLION, linewidth=0.9, alpha=0.9, label=plain(name), rasterized=True)
    ax.set_ylim(*_robust_limits(force.values / sy, law / sy))
    return finish(ax, across, up, title)


def _draw_cloud(ax: Axes, x: Signal, y: Signal, **style: Any) -> tuple[float, float, str, str]:
    """Draw points; return the scales and the labels of both axes."""
    (sx, across), (sy, up) = x.scale_axis(), y.scale_axis()
    every = max(len(x.values) // CLOUD_POINTS, 1)
    ax.plot(x.values[::every] / sx, y.values[::every] / sy, ".", color=BLUE, markersize=2.6, rasterized=True, **style)
    return sx, sy, across, up


def learned_force(x: Signal, force: Signal, laws: Sequence[tuple[str, np.ndarray]], *, title: str = "") -> Axes:
    """Draw a learned force over a local signal as points, and named laws along the stretch of its largest swings.

    Parameters
    ----------
    laws : sequence of (name, force)
        Forces (K,) along the same signal; non-finite samples are left out.
    """
    ax = new_figure().add_subplot()
    sx, sy, across, up = _draw_cloud(ax, x, force, alpha=0.35, label="learned force")
    known = np.flatnonzero(np.all([np.isfinite(f) for _, f in laws], axis=0)) if laws else np.zeros(0, dtype=int)
    if len(known):
        energy = np.cumsum(np.append(0.0, (force.values[known] - np.mean(force.values[known])) ** 2))
        width = min(LINE_POINTS, len(known))
        begin = int(np.argmax(energy[width:] - energy[:-width]))
        part = known[begin : begin + width]
        for (name, values), colour, style in zip(laws, (VERMILLION, GREEN, INK), ("-", "--", ":"), strict=False):
            ax.plot(x.values[part] / sx, values[part] / sy, style, color=colour, linewidth=1.2, label=plain(name))
    ax.set_ylim(*_robust_limits(force.values / sy, np.concatenate([f[known] for _, f in laws]) / sy if laws else None))
    return finish(ax, across, up, title)


def strength_over_signal(signal: Signal, strength: Signal, seen: np.ndarray, *, title: str = "") -> Axes:
    """Draw the strength (G,) of a law over the signal (G,) that varies it, and the values `seen` in recordings (M,)."""
    ax = new_figure().add_subplot()
    (sx, across), (sy, up) = signal.scale_axis(), strength.scale_axis()
    ax.plot(signal.values / sx, strength.values / sy, color=VERMILLION, linewidth=1.6, label="fitted strength")
    share, edges = np.histogram(seen, STRENGTH_BINS, (float(signal.values[0]), float(signal.values[-1])))
    top = float(np.max(strength.values)) / sy
    height = 0.3 * top * share / max(int(share.max()), 1)
    label = "how often the recordings have the value"
    ax.bar(edges[:-1] / sx, height, np.diff(edges) / sx, align="edge", color=BLUE, alpha=0.25, label=label)
    ax.set_ylim(min(0.0, 1.1 * float(np.min(strength.values)) / sy), 1.15 * top)
    return finish(ax, across, up, title)


def refined_hysteresis(
    z: Signal,
    w: Signal,
    before: tuple[np.ndarray, np.ndarray],
    curve: tuple[np.ndarray, np.ndarray],
    layer: tuple[np.ndarray, np.ndarray],
    *,
    names: tuple[str, str] = ("layer", "diagnosed law"),
) -> Figure:
    """Draw a Prandtl-Ishlinskii layer: its loops with those of a law, its loading curve, its weights over thresholds.

    Parameters
    ----------
    z, w : Signal
        Signals of the layer along recordings, (M,).
    before : (z, w)
        Signals of the law that the layer replaces, (M,) each.
    curve : (z, w)
        Initial loading curve, (G,) each.
    layer : (thresholds, weights)
        Thresholds in the unit of z, and weights, (n,) each.
    names : (str, str)
        Names of the layer and of the law.
    """
    figure = new_figure(12.5, 3.9)
    loops, loading, weights = (figure.add_subplot(1, 3, k) for k in (1, 2, 3))
    (sx, across), (sy, up) = z.scale_axis(), w.scale_axis()
    style: dict[str, Any] = {"linewidth": 0.8, "rasterized": True}
    loops.plot(before[0] / sx, before[1] / sy, color=VERMILLION, alpha=0.55, label=plain(names[1]), **style)
    loops.plot(z.values / sx, w.values / sy, color=BLUE, label=plain(names[0]), **style)
    finish(loops, across, up, "loops in the training recordings", 1)
    loading.plot(curve[0] / sx, curve[1] / sy, color=BLUE, linewidth=1.8)
    loading.margins(x=0)
    finish(loading, across, up, "initial loading curve")
    r, used = layer[0] / sx, layer[1] > 1e-3 * np.max(layer[1])
    limit = 1.3 * float(np.max(r[used], initial=0.0)) or 1.0
    weights.vlines(r[used], 0, layer[1][used], color=SKY, linewidth=1.5)
    weights.plot(r, layer[1], "o", color=BLUE, markersize=4, label="weights w (left)")
    right = draw_density(weights, r, np.where(used, layer[1], 0.0), limit)
    finish(weights, across.replace(z.name, "threshold r", 1), "weight w", "weights over thresholds", 1, twin=right)
    weights.set_ylim(bottom=0)
    weights.set_xlim(-0.02 * limit, limit)
    for ax in (loops, loading, weights):
        ax.locator_params(axis="x", nbins=6)
    return figure


def force_time(t: np.ndarray, recovered: Signal, std: np.ndarray, law: np.ndarray, name: str = "law") -> Axes:
    """Draw a recovered force over time with its uncertainty, around its largest value, and the law's force."""
    ax, force = new_figure().add_subplot(), recovered.values
    size, up = recovered.scale_axis()
    window = max(min(len(force), 400), len(force) // 12)
    peak = int(np.argmax(np.abs(force)))
    begin = int(np.clip(peak - window // 2, 0, len(force) - window))
    part = slice(begin, begin + window)
    low, high = (force - std)[part] / size, (force + std)[part] / size
    ax.fill_between(t[part], low, high, color=BLUE, alpha=0.25, linewidth=0, label="± one standard deviation")
    line(ax, t, force / size, "recovered from the recording", BLUE, part=part, linewidth=1.6)
    if len(law):
        line(ax, t, law[: len(t)] / size, name, VERMILLION, part=part, linewidth=1.3)
    ax.set_ylim(*_robust_limits(force[part] / size, law[: len(t)][part] / size))
    ax.margins(x=0.01)
    return finish(ax, "time [s]", up, "", 3)


def force_remainder(x: Signal, left: Signal, std: np.ndarray) -> Axes:
    """Draw a recovered force minus the law over the local coordinate as points, with the mean."""
    ax = new_figure().add_subplot()
    sx, sy, across, up = _draw_cloud(ax, x, left, alpha=0.4)
    edges = np.quantile(x.values, np.linspace(0, 1, 21))
    index = np.clip(np.searchsorted(edges, x.values, side="right") - 1, 0, 19)
    count = np.bincount(index, minlength=20)
    known = count > 0
    mean = np.bincount(index, left.values, minlength=20)[known] / count[known]
    middle = np.bincount(index, x.values, minlength=20)[known] / count[known]
    ax.plot(middle / sx, mean / sy, "o-", color=INK, linewidth=1.6, markersize=3.5, label="mean")
    noise_band(ax, float(np.median(std)) / sy, "± one standard deviation")
    ax.set_ylim(*_robust_limits(left.values / sy))
    return finish(ax, across, up, "recovered − law")


def _robust_limits(values: np.ndarray, law: np.ndarray | None = None) -> tuple[float, float]:
    """Choose axis limits that ignore a few outliers and show the whole law."""
    low, high = np.quantile(values[np.isfinite(values)], [0.001, 0.999])
    if law is not None and np.any(np.isfinite(law)):
        low, high = min(low, np.nanmin(law)), max(high, np.nanmax(law))
    room = 0.08 * (high - low) or 1.0
    return float(low - room), float(high + room)
