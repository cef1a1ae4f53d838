"""Self-contained HTML pages: the general page, and the one of a fit."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..data import Recording
from ..export import made, write_atomically
from .diagnosis_files import diagnosis_report
from .page import Code, Page, Picture, Section, Table, Text, write_report

if TYPE_CHECKING:
    from ..identify import Fit

__all__ = ["Code", "Page", "Picture", "Section", "Table", "Text", "diagnosis_report", "fit_report", "write_report"]


def fit_report(
    fit: Fit,
    train: Recording | Sequence[Recording],
    tests: Recording | Sequence[Recording],
    folder: str | os.PathLike[str],
) -> Path:
    """Write `report.html` and `model.json` of a fit into a folder.

    Parameters
    ----------
    fit : Fit
        The fitted model.
    train : Recording or sequence of Recording
        What it was fitted to.
    tests : Recording or sequence of Recording
        What it is judged on; may be empty.
    folder : path
        Made where it does not exist.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    InputError
        If a recording does not fit the model, or the folder cannot be written.
    """
    from .fit import fit_page

    page = fit_page(fit, train, tests, model_file="model.json")
    target = made(folder)
    fit.save(target / "model.json")
    return write_atomically(target / "report.html", page.html())
