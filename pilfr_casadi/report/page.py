"""Self-contained HTML pages: one file including its pictures, readable offline, on a phone, in dark mode and in print.

A `Page` is a title, a headline, a few figures of merit, and sections of blocks (`Text`, `Table`, `Picture`, `Code`).
The folder `templates/` holds `page.html` for the page, `blocks.html` for its blocks, `report.css` for colours and
layout, `explore.js` for the charts. The templates escape all text. The page allows its own two scripts by their hash,
and neither other scripts nor network access.

Every picture of lines carries its numbers, and the script replaces it by an interactive chart; without the script, and
in print, the reader sees the picture. uPlot (`uplot/`, MIT licence) draws the charts. It was chosen by measurement:
bytes of script in every page, and time to draw 12 charts of 4 lines with 6144 points (Chromium, two busy cores).

    uPlot 1.6.32                           52,938 bytes    0.26 s
    Chart.js 4.6.1, zoom 2.2.0, hammer    246,050 bytes    0.79 s
    plotly.js-basic 4.1.1               1,191,749 bytes    1.49 s
    Bokeh 3.9.2                         1,268,134 bytes    not run: it evaluates text as code, which the policy forbids

The three libraries that run under the policy are equally legible at 420 pixels. uPlot lacks a keyboard legend, values
of loops under the pointer and zoom buttons; `explore.js` adds them in about 250 lines.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import math
import os
import pprint
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from .. import plots
from .._base import InputError, __version__, write_atomically
from ..data import Recording
from ..optimise import Status

TONES = ("plain", "good", "warning", "bad")
DPI = 160  # dots per inch of the pictures: sharp at twice the resolution of an ordinary screen
PALETTE_SIZE = 64  # colours of a picture: a third of the bytes, and lines stay smooth
CHART_BYTES = 1_200_000  # all charts of a page; with its pictures the page stays below 3 MB
# uPlot asks for the number format of the browser's language as it loads; a language that `Intl` does not know, such as
# "en-US@posix" of a Chromium under LANG=C, stops it. The page is in English, and the script writes numbers itself.
ENGLISH = 'Object.defineProperty(navigator, "language", { value: "en" });\n'
MOST_POINTS, FEWEST_POINTS = 16_000, 500  # points of a line in a view of a chart; CHART_BYTES decides


def number_text(value: float, digits: int = 4) -> str:
    """Write a number for people: `−1.7·10⁻⁶` rather than `-1.7e-06`, and 4000 rather than `4e+03`."""
    return typeset_numbers(f"{float(f'{value:.{digits}g}'):.{max(digits, 6)}g}")


def typeset_numbers(text: str) -> str:
    """Replace minus signs and exponents in a text by those of print."""

    def raise_exponent(exponent: re.Match[str]) -> str:
        return "·10" + str(int(exponent[1])).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))

    return re.sub(r"e([+-]\d+)", raise_exponent, text).replace("-", "−")


def uncertain_text(value: float, error: float) -> str:
    """Write `value ± error` to two digits of the error; only the value, or a dash, if error or value is not finite."""
    if not np.isfinite(value):
        return "–"
    if not np.isfinite(error):
        return number_text(value)
    decimals = 1 - int(np.floor(np.log10(error))) if error > 0 else 9
    if decimals < 8 and 1e-3 <= abs(value) < 1e6:
        texts = (f"{value:.{max(decimals, 0)}f}".replace("-", "−"), f"{error:.{max(decimals, 0)}f}")
    else:
        texts = (number_text(value), number_text(error, 2))
    return "\u00a0±\u00a0".join(texts)


def signal_path(inputs: Sequence[str], outputs: Sequence[str]) -> str:
    """Write the signals of a model as "force → position"; the outputs alone if there is no input."""
    return " → ".join(", ".join(names) for names in (inputs, outputs) if names)


def label_recording(recording: Recording, role: str, i: int, count: int) -> str:
    """Return a recording's name; without a name its role and number: "test 2", or "test" for the only one."""
    return recording.name or (role if count == 1 else f"{role} {i + 1}")


def status_tone(status: Status) -> str:
    """Choose the colour of the headline of a fit."""
    return "good" if status.converged else "bad" if status.value.startswith("Failed") else "warning"


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    text: str
    kind: str = field(init=False, default="text")


@dataclass(frozen=True)
class Code:
    """Text for the reader to copy, shown verbatim."""

    code: str
    kind: str = field(init=False, default="code")


class Link(str):
    """Text of a table cell with a link to another page; the address is relative to this page."""

    address: str

    def __new__(cls, text: str, address: str) -> Link:
        """Make a link of its text and address."""
        link = super().__new__(cls, text)
        link.address = address
        return link


class Bar(str):
    """Text of a table cell above a bar; `length`, and `reach`, the end of a thin line, are shares of the full bar."""

    length: float
    reach: float

    def __new__(cls, text: str, length: float, reach: float) -> Bar:
        """Make a bar of its text and the two shares, clipped to 0 ... 1."""
        bar = super().__new__(cls, text)
        bar.length, bar.reach = (float(np.clip(share, 0.0, 1.0)) for share in (length, reach))
        return bar


@dataclass(frozen=True)
class Table:
    """A table; the first column names the rows.

    A cell is text, a `Link`, a `Bar`, or a number, written with `digits` significant digits; None and nan become a
    dash. Rows whose index is in `emphasis` are bold. `caption` is above the table, `note` below; a `folded` table is
    closed until the reader opens it. A row needs one cell per column, otherwise an `InputError` is raised.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    caption: str = ""
    note: str = ""
    emphasis: Sequence[int] = ()
    folded: bool = False
    digits: int = 4
    kind: str = field(init=False, default="table")

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise InputError(
                    f"A row has {len(row)} cells and its table {len(self.columns)} columns; give one cell per column."
                )

    @property
    def cells(self) -> list[list[tuple[str, bool]]]:
        """The text of every cell, and whether it is a number."""
        return [[self._cell(value) for value in row] for row in self.rows]

    def _cell(self, value: Any) -> tuple[str, bool]:
        if isinstance(value, str):
            return value, False
        if value is None or not math.isfinite(value):
            return "∞" if value is not None and value > 0 else "–", True
        if isinstance(value, int):
            return str(value), True
        return number_text(value, self.digits), True


@dataclass(frozen=True, eq=False)
class Picture:
    """A matplotlib figure, its axes, or the bytes of a PNG file, with a caption.

    `alt` describes it to readers who cannot see it. A `wide` picture fills the width of the page; others stand side by
    side if there is room. Axes become an interactive chart if `plots.chart` can convert them; `views` names further
    axes of the same lines, whose limits the reader may choose. A `replaced` picture is hidden if the chart of another
    picture shows all of it.
    """

    figure: Any
    caption: str
    alt: str
    wide: bool = False
    views: Mapping[str, Any] = field(default_factory=dict)
    replaced: bool = False
    kind: str = field(init=False, default="picture")

    @cached_property
    def png(self) -> bytes:
        """The picture as the bytes of a PNG file."""
        if isinstance(self.figure, bytes):
            return self.figure
        buffer = io.BytesIO()
        figure = self.figure if hasattr(self.figure, "savefig") else self.figure.figure
        figure.savefig(buffer, format="png", dpi=DPI)
        small = io.BytesIO()
        Image.open(buffer).convert("RGB").quantize(PALETTE_SIZE).save(small, format="png", optimize=True)
        return small.getvalue()

    def chart(self, most: int) -> str:
        """Return the chart as JSON with at most `most` points of a line in each view; empty if there is no chart."""
        content = plots.chart(self.figure, self.views, most) if hasattr(self.figure, "get_xlim") else None
        return json.dumps(content) if content and not self.replaced else ""

    @property
    def embedded(self) -> tuple[str, int, int]:
        """The picture as a data address, and its width and height in pixels."""
        png = self.png
        if png[:8] != b"\x89PNG\r\n\x1a\n" or len(png) < 24:
            raise InputError("A picture is not a PNG file; give a matplotlib figure or the bytes of a PNG file.")
        width, height = (int.from_bytes(png[i : i + 4], "big") for i in (16, 20))
        return "data:image/png;base64," + base64.b64encode(png).decode(), width, height


Block = Text | Code | Table | Picture


@dataclass(frozen=True)
class Section:
    """A part of a page under its own heading."""

    title: str
    blocks: Sequence[Block]

    @property
    def groups(self) -> list[list[Block]]:
        """The blocks in order; adjacent narrow pictures form one group."""
        out: list[list[Block]] = []
        for block in self.blocks:
            narrow = isinstance(block, Picture) and not block.wide
            last = out[-1][-1] if out else None
            if narrow and isinstance(last, Picture) and not last.wide:
                out[-1].append(block)
            else:
                out.append([block])
        return out


@dataclass(frozen=True)
class Page:
    """A report: its headline `answer` gives the result in a few words, `status` in sentences.

    `tone`, one of `TONES`, is the colour of the headline. `facts` are a few figures of merit by name.
    """

    title: str
    sections: Sequence[Section]
    subtitle: str = ""
    answer: str = ""
    status: str = ""
    tone: str = "plain"
    facts: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.tone not in TONES:
            raise InputError(f"The tone {self.tone!r} is unknown; use one of {', '.join(TONES)}.")

    def html(self) -> str:
        """The page as one HTML document."""
        charts, most = self._charts(MOST_POINTS), MOST_POINTS
        while sum(map(len, charts.values())) > CHART_BYTES and most > FEWEST_POINTS:
            most //= 2
            charts = self._charts(most)
        scripts, style = [], read_asset("templates/report.css")
        if any(charts.values()):
            scripts = [ENGLISH + read_asset("uplot/uPlot.iife.min.js"), read_asset("templates/explore.js")]
            style += read_asset("uplot/uPlot.min.css")
        licence = read_asset("uplot/LICENSE")
        return render(
            "page.html", page=self, version=__version__, charts=charts, scripts=scripts, style=style, licence=licence
        )

    def _charts(self, most: int) -> dict[Block, str]:
        pictures = [b for s in self.sections for b in s.blocks if isinstance(b, Picture)]
        return {picture: picture.chart(most) for picture in pictures}


def render(template: str, **values: Any) -> str:
    """Fill a template of the folder `templates`; only HTML templates escape text."""
    return str(_templates().get_template(template).render(**values)).rstrip("\n")


@cache
def read_asset(name: str) -> str:
    """Read a file of this folder."""
    return (Path(__file__).parent / name).read_text(encoding="utf-8")


def script_hash(script: str) -> str:
    """Return the expression that allows one script in a content security policy."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"


@cache
def _templates() -> Any:
    from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

    environment = Environment(
        loader=PackageLoader(__package__, "templates"),
        autoescape=select_autoescape(["html"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"literal": python_literal, "script_hash": script_hash}
    return environment


def python_literal(value: Any, width: int = 80) -> str:
    """Write a value as Python code, with `np.inf` for infinity, but not in texts."""
    text = pprint.pformat(value, width=width, sort_dicts=False, compact=True)
    return re.sub(r"""('(?:\\.|[^'\\])*'|"(?:\\.|[^"\\])*")|\binf\b""", lambda found: found[1] or "np.inf", text)


def write_report(path: str | os.PathLike[str], title: str, sections: Sequence[Section], **more: Any) -> Path:
    """Write a `Page` to an HTML file, atomically; return its path."""
    return write_atomically(path, Page(title, sections, **more).html())
