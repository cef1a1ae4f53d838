"""Figures of a fleet: map of the machines, their values, their residuals, and values that drift."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from ..data import name_with_unit
from .canvas import (
    BLUE,
    FONT,
    GREEN,
    INK,
    PALE_BLUE,
    VERMILLION,
    WholeLocator,
    choose_scale,
    finish,
    new_figure,
    plain,
)

ERRORS = 2.0  # standard errors that are drawn, about 95 %
MOST_NAMED = 12  # machines whose names are written into a map
COLUMNS = 3  # small pictures side by side

Column = tuple[str, str, np.ndarray, np.ndarray]  # name, unit, values and standard errors of the machines


def machine_map(x: Column, y: Column, names: Sequence[str], differs: np.ndarray) -> Figure:
    """Draw the machines over two of their values, with ellipses of two standard errors.

    Parameters
    ----------
    x, y : (name, unit, values, errors)
        Values and errors are of shape (n,).
    names : sequence of str
        Names of the machines.
    differs : array of bool, shape (n,)
        Machines to draw in another colour, with their names.
    """
    figure = new_figure(7.2, 4.6)
    ax = figure.add_subplot()
    (a, a_error, a_label), (b, b_error, b_label) = map(_scale_column, (x, y))
    around = np.linspace(0, 2 * np.pi, 49)
    for group, colour in ((~differs, BLUE), (differs, VERMILLION)):
        size = ERRORS * np.nan_to_num([a_error, b_error])
        ellipses = [
            np.column_stack([a[k] + size[0, k] * np.cos(around), b[k] + size[1, k] * np.sin(around)])
            for k in np.flatnonzero(group & np.isfinite(a) & np.isfinite(b))
        ]
        if ellipses:
            ax.add_collection(PolyCollection(ellipses, facecolor=colour, edgecolor="none", alpha=0.25))
    for group, colour, label in ((~differs, BLUE, "regular"), (differs, VERMILLION, "differs")):
        if np.any(group):
            ax.plot(a[group], b[group], "o", color=colour, markersize=4, label=label)
    for k in _find_named(differs):
        if np.isfinite(a[k]) and np.isfinite(b[k]):
            ax.annotate(plain(names[k]), (a[k], b[k]), (5, 5), textcoords="offset points", fontsize=FONT - 2, color=INK)
    finish(ax, a_label, b_label)
    return figure


def machine_strips(columns: Sequence[Column], names: Sequence[str], differs: np.ndarray) -> Figure:
    """Draw each value of all machines as a strip, with bars of two standard errors; see `machine_map`."""
    figure = new_figure(7.2, 0.6 + 2.2 * len(columns)) if len(columns) > 1 else new_figure()
    rank = np.arange(1, len(names) + 1)
    for i, column in enumerate(columns):
        ax = figure.add_subplot(len(columns), 1, i + 1)
        value, error, label = _scale_column(column)
        for group, colour, kind in ((~differs, BLUE, "regular"), (differs, VERMILLION, "differs")):
            if np.any(group):
                _draw_values(ax, rank[group], value[group], error[group], colour, kind)
        for k in _find_named(differs):
            if np.isfinite(value[k]):
                place = (rank[k], value[k])
                ax.annotate(plain(names[k]), place, (4, 2), textcoords="offset points", fontsize=FONT - 3, color=INK)
        ax.xaxis.set_major_locator(WholeLocator())
        finish(ax, "machine, by rank" if i == len(columns) - 1 else "", label)
    return figure


def small_multiples(residuals: Sequence[Mapping[str, Any]], titles: Sequence[str]) -> Figure:
    """Draw residuals over time, one small picture each, and the noise as a band of two standard deviations.

    Parameters
    ----------
    residuals : sequence of mapping
        `seconds`, `low` and `high` (smallest and largest value in bins of equal length), and `noise`.
    titles : sequence of str
        Titles of the pictures.
    """
    figure, rows, columns = _make_grid(len(residuals), 1.7)
    largest = max((np.max(np.abs([r["low"], r["high"]])) for r in residuals), default=1.0)
    for k, (r, title) in enumerate(zip(residuals, titles, strict=True)):
        ax = figure.add_subplot(rows, columns, k + 1)
        t = np.linspace(0, r["seconds"], len(r["low"]))
        ax.axhspan(-2 * r["noise"], 2 * r["noise"], color=GREEN, alpha=0.25, linewidth=0, label="noise")
        ax.fill_between(t, r["low"], r["high"], color=VERMILLION, linewidth=0.4)
        ax.plot(t, np.mean([r["low"], r["high"]], axis=0), color=VERMILLION, linewidth=0.8, label="error")
        finish(ax, "time [s]" if k // columns == rows - 1 else "", "error" if k % columns == 0 else "", title)
        ax.set_ylim(-1.05 * largest, 1.05 * largest)
    return figure


def machine_trends(trends: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw values over time with their trend, one small picture each.

    Parameters
    ----------
    trends : sequence of mapping
        `title`; `name` and `unit` of the value; `times`, `values`, `errors`; `slope` and `per`, its unit of time;
        `regular`, the range (low, high) of regular machines.
    """
    figure, rows, columns = _make_grid(len(trends), 1.9)
    for k, r in enumerate(trends):
        ax = figure.add_subplot(rows, columns, k + 1)
        t, v, e = (np.asarray(r[name], dtype=float) for name in ("times", "values", "errors"))
        ax.axhspan(*r["regular"], color=PALE_BLUE, linewidth=0, label="regular machines")
        _draw_values(ax, t, v, e, BLUE, "fitted")
        known = np.isfinite(v) & (np.nan_to_num(e) > 0)
        weight = 1 / e[known] ** 2
        centre = [float(np.sum(weight * a[known]) / np.sum(weight)) for a in (t, v)]
        ax.plot(t, centre[1] + r["slope"] * (t - centre[0]), color=VERMILLION, linewidth=1.2, label="trend")
        time = "recording" if r["per"] == "recording" else "time"
        if time == "recording":
            ax.xaxis.set_major_locator(WholeLocator())
        finish(ax, time if k // columns == rows - 1 else "", name_with_unit(r["name"], r["unit"]), r["title"])
    return figure


def _draw_values(ax: Axes, x: np.ndarray, values: np.ndarray, errors: np.ndarray, colour: str, label: str) -> None:
    """Draw values (n,) over x (n,) as points, with bars of two standard errors where these are known."""
    bars = ERRORS * np.nan_to_num(errors)
    gap = np.full(len(values), np.nan)
    ends = np.column_stack([values - bars, values + bars, gap])
    ax.plot(np.repeat(x, 3), ends.ravel(), color=colour, linewidth=1.0)
    ax.plot(x, values, "o", color=colour, markersize=3, label=label)


def _find_named(differs: np.ndarray) -> np.ndarray:
    """Return the machines whose names are written: all of a few, otherwise the first that differ."""
    return np.arange(len(differs)) if len(differs) <= MOST_NAMED else np.flatnonzero(differs)[:MOST_NAMED]


def _make_grid(count: int, height: float) -> tuple[Figure, int, int]:
    """Make a figure for `count` small pictures; return it with the numbers of rows and columns."""
    rows, columns = max(-(-count // COLUMNS), 1), min(max(count, 1), COLUMNS)
    return (new_figure(7.2, 0.4 + height * rows) if count > 1 else new_figure()), rows, columns


def _scale_column(column: Column) -> tuple[np.ndarray, np.ndarray, str]:
    """Divide values by a power of a thousand of their size; return them, their errors and the label."""
    name, unit, values, errors = column
    size, unit = choose_scale(values[np.isfinite(values)], unit)
    return values / size, errors / size, name_with_unit(name, unit)
