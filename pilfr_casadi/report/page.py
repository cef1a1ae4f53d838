"""Self-contained HTML pages: one file with its pictures inside, readable offline, on a phone, in the dark and on paper.

A `Page` is a title, a sentence that says how it ended, a few figures of merit, and sections of blocks (`Text`, `Table`,
`Picture`, `Code`). Text of users is escaped by the template, and the page forbids itself scripts and any access to the
network.
"""

from __future__ import annotations

import base64
import io
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from .._base import InputError
from ..export import write_atomically

TONES = ("plain", "good", "warning", "bad")
DPI = 160  # of pictures; twice what a screen shows


def number_text(value: float, digits: int = 4) -> str:
    """A number for people: `−1.7·10⁻⁶` rather than `-1.7e-06`."""
    mantissa, sign, exponent = f"{value:.{digits}g}".partition("e")
    raised = "·10" + str(int(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")) if sign else ""
    return mantissa.replace("-", "−") + raised


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    text: str
    kind: str = field(init=False, default="text")


@dataclass(frozen=True)
class Code:
    """Text to be copied, as it stands."""

    code: str
    caption: str = ""
    kind: str = field(init=False, default="code")


@dataclass(frozen=True)
class Table:
    """A table; the first column names the rows.

    Parameters
    ----------
    columns : sequence of str
        Head of each column.
    rows : sequence of sequences
        Cells: text, or numbers, which are written with `digits` significant digits; None and nan become a dash.
    caption, note : str
        Above and below the table.
    emphasis : sequence of int
        Rows that stand out, counted from 0.
    folded : bool
        Hidden until the reader opens it.
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
                    f"A row of a table has {len(row)} cells and its head {len(self.columns)}; give as many."
                )

    @property
    def cells(self) -> list[list[tuple[str, bool]]]:
        """Text of every cell, and whether it is a number."""
        return [[self._cell(value) for value in row] for row in self.rows]

    def _cell(self, value: Any) -> tuple[str, bool]:
        if isinstance(value, str):
            return value, False
        if value is None or not math.isfinite(value):
            return "∞" if value is not None and value > 0 else "–", True
        if isinstance(value, int):
            return str(value), True
        return number_text(value, self.digits), True


@dataclass(frozen=True)
class Picture:
    """A figure with its caption.

    Parameters
    ----------
    figure : matplotlib Figure or bytes
        The figure, or the bytes of a PNG file.
    caption : str
        What is to be seen in it.
    alt : str
        What a reader who cannot see it needs to know.
    wide : bool
        Across the page; otherwise two pictures stand side by side where there is room.
    """

    figure: Any
    caption: str
    alt: str
    wide: bool = False
    kind: str = field(init=False, default="picture")

    @property
    def png(self) -> bytes:
        """The picture as the bytes of a PNG file."""
        if isinstance(self.figure, bytes):
            return self.figure
        buffer = io.BytesIO()
        self.figure.savefig(buffer, format="png", dpi=DPI)
        return buffer.getvalue()

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
        """The blocks in their order, pictures that may stand side by side together."""
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
    """A report.

    Parameters
    ----------
    title, subtitle : str
        Head of the page.
    sections : sequence of Section
        Its body.
    status : str
        One sentence that says how it ended.
    tone : {"plain", "good", "warning", "bad"}
        How the sentence is shown.
    facts : mapping
        A few figures of merit, from their names to their values, both text.
    footer : str
        Last line.

    Raises
    ------
    InputError
        If the tone is unknown.
    """

    title: str
    sections: Sequence[Section]
    subtitle: str = ""
    status: str = ""
    tone: str = "plain"
    facts: Mapping[str, str] = field(default_factory=dict)
    footer: str = ""

    def __post_init__(self) -> None:
        if self.tone not in TONES:
            raise InputError(f"The tone {self.tone!r} is unknown; use one of {', '.join(TONES)}.")

    def html(self) -> str:
        """The page as one HTML document."""
        from .._base import __version__

        return str(_template().render(page=self, version=__version__))


@cache
def _template() -> Any:
    from importlib.resources import files

    from jinja2 import Environment, StrictUndefined

    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(files(__package__).joinpath("page.html").read_text(encoding="utf-8"))


def write_report(path: str | os.PathLike[str], title: str, sections: Sequence[Section], **more: Any) -> Path:
    """Write a page, atomically.

    Parameters
    ----------
    path : path
        The HTML file.
    title, sections, **more
        See `Page`.

    Returns
    -------
    Path
        Where it is.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    return write_atomically(path, Page(title, sections, **more).html())
