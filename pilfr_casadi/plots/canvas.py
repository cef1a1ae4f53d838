"""Shared parts of all figures: a canvas without global state, colours, decibels, and thinned lines of long records.

The colours of Okabe & Ito (2008) are distinct for every kind of colour vision. Figures use matplotlib's object
interface without pyplot and without changed settings, so they work in scripts, notebooks and servers.
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.textpath import TextPath
from matplotlib.ticker import MaxNLocator

from .._base import InputError
from ..data import name_with_unit

BLUE, VERMILLION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
SKY, ORANGE, INK, GREY = "#56B4E9", "#E69F00", "#222222", "#7A7A7A"
GRID = "#DDDDDD"
PALE_GREY, PALE_BLUE = "#EEEEEE", "#E8F1F7"  # areas: not scored or not visited; range of the recordings
BOX = "#D6E8F4"  # inside of box plots
MAP_COLOURS, LOOP_COLOURS = "cividis", "viridis"  # colormaps of error maps and loops; also readable in grey
FONT = 10.5  # points
SCREEN_DPI = 90  # dots per inch in a notebook, whose column is about 1000 pixels wide
MOST_POINTS = 3000  # points of a line before it is thinned: more than a page has pixels
LONGEST_TITLE = 46  # letters that fit above a figure of the usual width
DECIBEL_RANGE = 200.0  # dB below the largest value down to which curves are drawn; rounding errors lie deeper
DRAWN_SPANS = 1e3  # spans of the measured signal above which a simulation is not drawn


class ShownFigure(Figure):
    """A figure that a notebook shows at the end of a cell; without pyplot it would show only the text."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", dpi=SCREEN_DPI)
        return buffer.getvalue()


class WholeLocator(MaxNLocator):
    """Ticks at whole numbers only; a chart of these axes has them too."""

    def __init__(self) -> None:
        super().__init__(integer=True)


def new_figure(width: float = 5.2, height: float = 3.5) -> Figure:
    """Make an empty figure of the given size in inches, with a layout that prevents overlap and clipping."""
    return ShownFigure(figsize=(width, height), layout="constrained")


def check_index(index: int, count: int, what: str) -> None:
    """Refuse the number of a signal or channel that is not there."""
    if not 0 <= index < count:
        raise InputError(f"The {what} {index} was given, counted from 0; the number of {what}s is {count}.")


def axes_or_new(ax: Axes | None) -> Axes:
    """Return the given axes, or those of a new figure."""
    return new_figure().add_subplot() if ax is None else ax


def finish(
    ax: Axes, x: str, y: str, title: str = "", columns: int = 2, *, twin: Axes | None = None, legend: bool = True
) -> Axes:
    """Add axis labels and a light grid, and above the axes a title and a legend of the lines here and on `twin`."""
    ax.set_xlabel(plain(x), fontsize=FONT)
    ax.set_ylabel(plain(y), fontsize=FONT)
    title = plain(title if len(title) <= LONGEST_TITLE else title[: LONGEST_TITLE - 1] + "…")
    ax.tick_params(labelsize=FONT - 1)
    ax.grid(True, color=GRID, linewidth=0.6)
    ax.set_axisbelow(True)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    handles = [h for axes in (ax, twin) if axes is not None for h in axes.get_legend_handles_labels()[0]]
    if handles and legend:
        shown = ax.legend(
            handles=handles,
            title=title or None,
            alignment="left",
            loc="lower left",
            bbox_to_anchor=(0.0, 1.0),
            ncols=_choose_columns(ax, [str(h.get_label()) for h in handles], columns),
            fontsize=FONT - 1,
            title_fontsize=FONT + 0.5,
            frameon=False,
            handlelength=1.6,
            columnspacing=1.2,
            borderaxespad=0.2,
            borderpad=0.1,
        )
        for handle in shown.get_lines():
            handle.set_linewidth(max(float(handle.get_linewidth()), 2.0))
    elif title:
        ax.set_title(title, fontsize=FONT + 0.5, loc="left")
    return ax


def _choose_columns(ax: Axes, labels: list[str], most: int) -> int:
    """Choose the number of columns of a legend so that it is no wider than its axes."""
    em = (FONT - 1) / 72
    room = 1.1 * ax.get_position().width * ax.figure.bbox.width / ax.figure.dpi
    widths = [TextPath((0, 0), label, size=FONT - 1).get_extents().width / 72 + 2.4 * em for label in labels]
    for columns in range(min(most, len(labels)), 1, -1):
        length = -(-len(labels) // columns)
        if sum(max(widths[k : k + length]) for k in range(0, len(labels), length)) + 1.2 * em * (columns - 1) <= room:
            return columns
    return 1


def plain(text: str) -> str:
    """Escape dollar signs, which would begin a formula."""
    return str(text).replace("$", r"\$")


def choose_scale(values: np.ndarray, unit: str = "") -> tuple[float, str]:
    """Choose a power of a thousand that scales the values to about one; return it and the unit: (1e-3, "10⁻³ m")."""
    size = float(np.max(np.abs(values), initial=0.0))
    if not np.isfinite(size) or size == 0 or 0.02 <= size < 5000:
        return 1.0, unit
    exponent = 3 * int(np.floor(np.log10(size / 0.5) / 3))
    power = "10" + str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return 10.0**exponent, f"{power} {unit}".strip()


def scale_axis(name: str, values: np.ndarray, unit: str = "") -> tuple[float, str]:
    """Choose the power of a thousand by which to divide the values of an axis; return it and the axis label."""
    size, unit = choose_scale(values, unit)
    return size, name_with_unit(name, unit)


def thin(x: np.ndarray, y: np.ndarray, most: int = MOST_POINTS) -> tuple[np.ndarray, np.ndarray]:
    """Keep about `most` points that draw the same picture: the smallest and largest of each stretch, in their order.

    If x turns back, as in a loop, the extremes of both x and y are kept. Shorter lines stay unchanged, and a stretch of
    gaps (nan) stays a gap.
    """
    if len(y) <= most:
        return x, y
    columns = (x, y) if np.any(np.diff(x) < 0) else (y,)
    length = -(-2 * len(columns) * len(y) // most)
    rows = -(-len(y) // length)
    index = [np.array([0, len(y) - 1])]
    for column in columns:
        padded = np.concatenate([column, np.full(rows * length - len(y), column[-1])]).reshape(rows, length)
        ends = (np.argmin(np.where(np.isnan(padded), np.inf, padded), axis=1),
                np.argmax(np.where(np.isnan(padded), -np.inf, padded), axis=1))  # fmt: skip
        index += [end + length * np.arange(rows) for end in ends]
    kept = np.unique(np.minimum(np.concatenate(index), len(y) - 1))
    return x[kept], y[kept]


def mask_divergence(values: np.ndarray, span: float) -> np.ndarray:
    """Replace values far beyond the span of the measured signal by nan, so that lines have gaps there."""
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(values) <= DRAWN_SPANS * span, values, np.nan)


class SampledLine(Line2D):
    """A line that is drawn thinned, or in part, and keeps its samples (x, y), (M,) each."""

    samples: tuple[np.ndarray, np.ndarray]


def line(
    ax: Axes, x: np.ndarray, y: np.ndarray, label: str, colour: str, *, part: slice | None = None, **style: Any
) -> None:
    """Draw a line, or a part of it, thinned where it is dense; the legend notes a line without finite values."""
    x, y, part = np.asarray(x), np.asarray(y), part or slice(None)
    if not np.any(np.isfinite(y[part])):
        label = f"{label}: nothing to draw"
    shown = SampledLine(*thin(x[part], y[part]), label=plain(label), color=colour, **{"linewidth": 1.2, **style})
    shown.samples = x, y
    ax.add_line(shown)
    ax.autoscale_view()


def decibel(power: np.ndarray) -> np.ndarray:
    """Return `10 log10` of a power of any shape, with nan (a gap in the line) for zero and non-finite values."""
    power = np.asarray(power, dtype=float)
    usable = np.isfinite(power) & (power > 0)
    return np.where(usable, 10 * np.log10(np.where(usable, power, 1.0)), np.nan)


def limit_depth(ax: Axes, *curves: np.ndarray) -> None:
    """Limit an axis in decibels, so that rounding errors hundreds of decibels down do not stretch it."""
    values = np.concatenate([c[np.isfinite(c)] for c in curves] or [np.zeros(0)])
    if len(values) and np.min(values) < np.max(values) - DECIBEL_RANGE:
        ax.set_ylim(np.max(values) - DECIBEL_RANGE, np.max(values) + 0.05 * DECIBEL_RANGE)


def noise_band(ax: Axes, deviation: float, label: str) -> None:
    """Draw dashed lines at ± a deviation, if it is known."""
    for side in (deviation, -deviation) if deviation > 0 else ():
        ax.axhline(side, color=GREEN, linestyle="--", linewidth=1.3, label=label if side > 0 else None)


def noise_line(ax: Axes, level: float) -> None:
    """Draw a dashed line at the noise level, if it is known."""
    if level > 0:
        ax.axhline(level, color=GREEN, linestyle="--", linewidth=1.4, label="noise floor")
