"""An axes as data, so that a page can draw it again and the reader can zoom into it.

Lines, points, steps, bars and bands are read; maps of colours, a second axis and several axes in one figure are not,
and such a figure stays a picture. Lines keep all their samples (`SampledLine`), so that a picture of a few swings
becomes a chart of the whole recording that opens at these swings.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from matplotlib.patches import Polygon, Rectangle, StepPatch
from matplotlib.text import Annotation

from .canvas import SampledLine, thin

ENDLESS = 3e38  # end of a band that crosses the whole axes; the largest number of single precision
Shape = tuple[dict[str, Any], np.ndarray, np.ndarray]  # style, x, y
MARKERS = {"o": "ring", "x": "cross", ".": "dot", "D": "dot"}


def chart(axes: Axes, views: Mapping[str, Axes], most: int) -> dict[str, Any] | None:
    """Read an axes as numbers and text that JSON can hold; None if it has parts that cannot be read.

    Parameters
    ----------
    axes : Axes
        Its limits are those at which the chart opens.
    views : mapping
        Further axes of the same lines by name, whose limits the reader may choose.
    most : int
        Points of a line that are kept, in each view and outside of all: the smallest and largest of each stretch.
    """
    if len(axes.figure.axes) > 1:
        return None
    try:
        shapes = [*map(_area, [*axes.patches, *axes.collections]), *map(_line, axes.lines)]
    except TypeError:
        return None
    ranges = {name: [list(v.get_xlim()), list(v.get_ylim())] for name, v in {"": axes, **views}.items()}
    windows = sorted({x for limits, _ in ranges.values() for x in limits})
    legend = axes.get_legend()
    title = legend.get_title().get_text() if legend else axes.get_title(loc="left")
    return {
        "title": _text(title),
        "x": {"label": _text(axes.get_xlabel()), "log": axes.get_xscale() == "log"},
        "y": {"label": _text(axes.get_ylabel()), "log": axes.get_yscale() == "log"},
        "equal": axes.get_aspect() == 1.0,
        "views": ranges,
        "notes": [_note(a) for a in axes.texts if isinstance(a, Annotation) and a.xycoords == "data"],
        "lines": [_packed_shape(shape, windows, most) for shape in shapes],
    }


def _note(note: Any) -> dict[str, Any]:
    (x, y), (right, up) = note.xy, note.xyann
    place = {"x": float(x), "y": float(y), "right": float(right), "up": float(up), "align": note.get_ha()}
    return {**place, "text": _text(note.get_text()), "colour": to_hex(note.get_color())}


def _text(text: str) -> str:
    """Undo the escape of `plain`."""
    return text.replace(r"\$", "$")


def _named(artist: Any, colour: Any) -> dict[str, Any]:
    label, alpha = artist.get_label(), artist.get_alpha()
    named = {} if not label or label.startswith("_") else {"label": _text(label)}
    return {**named, "colour": to_hex(colour), "alpha": 1.0 if alpha is None else alpha}


def _line(line: Any) -> Shape:
    style = {**_named(line, line.get_color()), "width": line.get_linewidth()}
    if line.get_linestyle() == "None":
        style["width"] = 0
    if (marker := str(line.get_marker())) in MARKERS:
        style |= {"mark": MARKERS[marker], "size": line.get_markersize()}
    if line.get_linestyle() in ("--", ":"):
        style["dash"] = [6, 4] if line.get_linestyle() == "--" else [2, 3]
    samples = line.samples if isinstance(line, SampledLine) else line.get_data(orig=False)
    x, y = (np.asarray(v, dtype=float) for v in samples)
    if line.get_transform() != line.axes.transData:  # a level across the axes, as `axhline` and `axvline` draw it
        x, y = (np.array([-ENDLESS, ENDLESS]) if np.array_equal(v, [0, 1]) else v for v in (x, y))
        style["level"] = True
    return style, x, y


def _area(patch: Any) -> Shape:
    """Read a filled shape, or a line of steps; raise a `TypeError` for any other."""
    shape: Any = patch
    if isinstance(patch, StepPatch):
        values, edges, _ = shape.get_data()
        style = {**_named(shape, shape.get_edgecolor()), "width": shape.get_linewidth()}
        if shape.get_linestyle() in ("--", "dashed"):
            style["dash"] = [6, 4]
        return style, np.repeat(edges, 2)[1:-1], np.repeat(values, 2)
    if isinstance(patch, PolyCollection):
        corners, colour = shape.get_paths()[0].vertices, shape.get_facecolor()[0]
    elif isinstance(patch, Rectangle | Polygon):
        corners, colour = shape.get_path().transformed(shape.get_patch_transform()).vertices, shape.get_facecolor()
    else:
        raise TypeError(f"{type(shape).__name__} has no counterpart in a chart.")
    x, y = np.array(corners, dtype=float).T
    style = {**_named(shape, colour[:3]), "area": True, "width": 0}
    if isinstance(patch, Rectangle) and shape.get_transform() != shape.get_patch_transform() + shape.axes.transData:
        y, style["level"] = np.where(y > 0.5, ENDLESS, -ENDLESS), True  # `axvspan`
    return style, x, y


def _packed_shape(shape: Shape, windows: list[float], most: int) -> dict[str, Any]:
    style, x, y = shape
    if not style.get("area"):
        x, y = _thinned(x, y, windows, most)
    return {**style, "x": _packed(x), "y": _packed(y)}


def _thinned(x: np.ndarray, y: np.ndarray, windows: list[float], most: int) -> tuple[np.ndarray, np.ndarray]:
    """Thin a line by itself between the ends of windows; a curve that turns back has no windows."""
    if len(x) <= most or np.any(np.diff(x) < 0):
        return thin(x, y, most)
    cuts = np.unique([0, *np.searchsorted(x, windows), len(x)])
    parts = [thin(x[a:b], y[a:b], most) for a, b in pairwise(cuts)]
    return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])


def _packed(values: np.ndarray) -> Any:
    """Write numbers as base64 of single precision, or as first value, step and count where they are uniform."""
    steps = np.diff(values)
    if len(values) > 2 and np.ptp(steps) <= 1e-6 * abs(steps[0]):
        return [float(values[0]), float((values[-1] - values[0]) / (len(values) - 1)), len(values)]
    held = np.where(np.abs(values) <= ENDLESS, values, np.nan)
    return base64.b64encode(held.astype("<f4").tobytes()).decode()
