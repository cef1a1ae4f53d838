"""Write generated pages and pictures, and leave files alone that have not changed, so that Sphinx reads them once."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

DOCS = Path(__file__).parents[1]


def write(path: str, content: str | bytes) -> None:
    """Write a file under docs/ if its content is new."""
    content = content.encode() if isinstance(content, str) else content
    file = DOCS / path
    if not (file.exists() and file.read_bytes() == content):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)


def write_figure(path: str, figure: Figure) -> None:
    """Write a figure as SVG; the same figure gives the same bytes."""
    stream = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "pilfr", "svg.fonttype": "path"}):
        figure.savefig(stream, format="svg", metadata={"Date": None})
    write(path, stream.getvalue())


def heading(text: str, line: str = "=") -> str:
    """Write a heading of reStructuredText."""
    return f"{text}\n{line * len(text)}\n"


def table(header: tuple[str, ...], rows: Sequence[tuple[str, ...]], widths: str = "auto") -> str:
    """Write a table of reStructuredText."""
    lines = [".. list-table::", "   :header-rows: 1", f"   :widths: {widths}", ""]
    for row in (header, *rows):
        lines += [f"   {'*' if i == 0 else ' '} - {cell}" for i, cell in enumerate(row)]
    return "\n".join(lines) + "\n"
