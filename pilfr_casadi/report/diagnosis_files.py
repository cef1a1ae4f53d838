"""The files of a diagnosis: `report.html`, `diagnosis.json`, and its figures."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..export import made, write_atomically
from .page import Block, Page, Picture, Section

if TYPE_CHECKING:
    from ..diagnose import Diagnosis


def diagnosis_report(diagnosis: Diagnosis, folder: str | os.PathLike[str]) -> Path:
    """Write `report.html`, `diagnosis.json` and `figures/*.png` of a diagnosis into a folder.

    Each file is there whole or not at all; the page comes last. Figures of an earlier diagnosis are removed.

    Parameters
    ----------
    diagnosis : Diagnosis
    folder : path
        Made where it does not exist.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    from .diagnosis_page import diagnosis_page

    page, figures = _rendered(diagnosis_page(diagnosis))
    html = page.html()
    content = json.dumps(diagnosis.to_dict(), indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    target = made(Path(folder) / "figures").parent
    for name, png in figures.items():
        write_atomically(target / "figures" / name, png)
    write_atomically(target / "diagnosis.json", content)
    path = write_atomically(target / "report.html", html)
    for old in (target / "figures").glob("diagnosis-[0-9][0-9]-*.png"):
        if old.name not in figures:
            with contextlib.suppress(OSError):
                old.unlink()
    return path


def _rendered(page: Page) -> tuple[Page, dict[str, bytes]]:
    """The page with its pictures drawn once, and the same pictures by file name."""
    files: dict[str, bytes] = {}

    def drawn(blocks: Sequence[Block]) -> list[Block]:
        out: list[Block] = []
        for b in blocks:
            if isinstance(b, Picture):
                png = b.png
                short = "".join(c if c.isascii() and c.isalnum() else "-" for c in b.alt.lower())[:50].strip("-")
                files[f"diagnosis-{len(files) + 1:02d}-{short}.png"] = png
                b = Picture(png, b.caption, b.alt, b.wide)
            out.append(b)
        return out

    return replace(page, sections=[Section(s.title, drawn(s.blocks)) for s in page.sections]), files
