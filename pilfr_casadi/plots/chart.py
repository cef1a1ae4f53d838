"""Convert axes to data, so that a page can draw them again and the reader can zoom.

Lines, points, steps, bars and bands are converted. A figure with a colour map, a second axis or several axes stays a
picture. Lines keep all their samples (`SampledLine`), so a picture of a few swings becomes a chart of the whole
recording that opens at these swings.
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
from matplotlib.container import BarContainer
from matplotlib.patches import Polygon, Rectangle, StepPatch
from matplotlib.text import Annotation

from .canvas import SampledLine, WholeLocator, thin

ENDLESS = 3e38  # end of a band across the whole axes: about the largest number of single precision
Shape = tuple[dict[str, Any], np.ndarray, np.ndarray]  # style, x, y
MARKERS = {"o": "ring", "x": "cross", ".": "dot", "D": "dot"}


def chart(axes: Axes, views: Mapping[str, Axes], most: int) -> dict[str, Any] | None:
    """Convert axes to numbers and text for JSON; return None if some part cannot be converted.

    Parameters
    ----------
    axes : Axes
        The chart opens at the limits of these axes.
    views : mapping
        Further axes with the same lines, by name; the reader may choose their limits.
    most : int
        Largest number of points of a line in each view, and outside all views.
    """
    if len(axes.figure.axes) > 1:
        return None
    try:
        shapes = [*map(_read_area, [*axes.patches, *axes.collections]), *map(_read_line, axes.lines)]
    except TypeError:
        return None
    groups = [c for c in axes.containers if isinstance(c, BarContainer)]
    bars: dict[Any, str] = {patch: str(group.get_label()) for group in groups for patch in group.patches}
    for patch, (style, _, _) in zip(axes.patches, shapes, strict=False):  # bars have no label of their own
        if not bars.get(patch, "_").startswith("_"):
            style["label"] = _unescape(bars[patch])
    ranges = {name: [list(v.get_xlim()), list(v.get_ylim())] for name, v in {"": axes, **views}.items()}
    windows = sorted({x for limits, _ in ranges.values() for x in limits})
    legend = axes.get_legend()
    title = legend.get_title().get_text() if legend else axes.get_title(loc="left")
    return {
        "title": _unescape(title),
        "x": {
            "label": _unescape(axes.get_xlabel()),
            "log": axes.get_xscale() == "log",
            "whole": isinstance(axes.xaxis.get_major_locator(), WholeLocator),
        },
        "y": {"label": _unescape(axes.get_ylabel()), "log": axes.get_yscale() == "log"},
        "equal": axes.get_aspect() == 1.0,
        "views": ranges,
        "notes": [_read_note(a) for a in axes.texts if isinstance(a, Annotation) and a.xycoords == "data"],
        "lines": [_pack_shape(shape, windows, most) for shape in shapes],
    }


def _read_note(note: Any) -> dict[str, Any]:
    (x, y), (right, up) = note.xy, note.xyann
    place = {"x": float(x), "y": float(y), "right": float(right), "up": float(up), "align": note.get_ha()}
    return {**place, "text": _unescape(note.get_text()), "colour": to_hex(note.get_color())}


def _unescape(text: str) -> str:
    """Undo the escape of `plain`."""
    return text.replace(r"\$", "$")


def _read_label_and_colour(artist: Any, colour: Any) -> dict[str, Any]:
    label, alpha = artist.get_label(), artist.get_alpha()
    style = {} if not label or label.startswith("_") else {"label": _unescape(label)}
    return {**style, "colour": to_hex(colour), "alpha": 1.0 if alpha is None else alpha}


def _read_line(line: Any) -> Shape:
    style = {**_read_label_and_colour(line, line.get_color()), "width": line.get_linewidth()}
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


def _read_area(patch: Any) -> Shape:
    """Read a filled shape or a line of steps; raise a `TypeError` for any other shape."""
    shape: Any = patch
    if isinstance(patch, StepPatch):
        values, edges, _ = shape.get_data()
        style = {**_read_label_and_colour(shape, shape.get_edgecolor()), "width": shape.get_linewidth()}
        if shape.get_linestyle() in ("--", "dashed"):
            style["dash"] = [6, 4]
        return style, np.repeat(edges, 2)[1:-1], np.repeat(values, 2)
    if isinstance(patch, PolyCollection):
        gap = np.full((1, 2), np.nan)
        parts = [np.concatenate([path.vertices, gap]) for path in shape.get_paths()]
        corners, colour = np.concatenate(parts)[:-1], shape.get_facecolor()[0]
    elif isinstance(patch, Rectangle | Polygon):
        corners, colour = shape.get_path().transformed(shape.get_patch_transform()).vertices, shape.get_facecolor()
    else:
        raise TypeError(f"{type(shape).__name__} has no counterpart in a chart.")
    x, y = np.array(corners, dtype=float).T
    style = {**_read_label_and_colour(shape, colour[:3]), "area": True, "width": 0}
    in_x, in_y = shape.get_transform().contains_branch_seperately(shape.axes.transData)
    if not in_x:
        x, style["level"] = np.where(x > 0.5, ENDLESS, -ENDLESS), True  # `axhspan`
    if not in_y:
        y, style["level"] = np.where(y > 0.5, ENDLESS, -ENDLESS), True  # `axvspan`
    return style, x, y


def _pack_shape(shape: Shape, windows: list[float], most: int) -> dict[str, Any]:
    style, x, y = shape
    if not style.get("area"):
        x, y = _thin_in_windows(x, y, windows, most)
    return {**style, "x": _pack_numbers(x), "y": _pack_numbers(y)}


def _thin_in_windows(x: np.ndarray, y: np.ndarray, windows: list[float], most: int) -> tuple[np.ndarray, np.ndarray]:
    """Thin a line separately between the ends of windows; a curve that turns back is thinned as a whole."""
    if len(x) <= most or np.any(np.diff(x) < 0):
        return thin(x, y, most)
    cuts = np.unique([0, *np.searchsorted(x, windows), len(x)])
    parts = [thin(x[a:b], y[a:b], most) for a, b in pairwise(cuts)]
    return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])


def _pack_numbers(values: np.ndarray) -> Any:
    """Write numbers as base64 of single precision; write equidistant numbers as first value, step and count."""
    finite = np.where(np.abs(values) <= ENDLESS, values, np.nan)
    steps = np.diff(finite)
    if len(values) > 2 and np.ptp(steps) <= 1e-6 * abs(steps[0]):
        return [float(values[0]), float((values[-1] - values[0]) / (len(values) - 1)), len(values)]
    return base64.b64encode(finite.astype("<f4").tobytes()).decode()
