"""Write the lists of public names from which autosummary makes the reference, one page for each folder."""

from __future__ import annotations

import importlib
import inspect
from typing import Any

from common import DOCS, heading, write

import pilfr_casadi as pilfr

# folder -> its title; the names of these folders are the package's own and those that it reaches through them
FOLDERS = {
    "diagnose": "Find missing physics",
    "simulators": "Simulators",
    "data": "Recordings",
    "models": "Models and operators",
    "identify": "Fit",
    "optimise": "Problem, constraints, solvers",
    "linear": "Linear models",
    "export": "Export",
    "control": "Control",
    "laws": "Laws",
    "studies": "Run files, campaigns and fleets",
    "report": "Reports",
    "plots": "Figures",
    "_base": "Errors",
}
WHOLE = ("control", "plots", "laws")  # folders whose face is public as a whole


def origin(name: str) -> str:
    """Folder that a public name of the package comes from."""
    return getattr(pilfr, name).__module__.split(".")[1]


def entries(folder: str) -> tuple[list[str], list[str]]:
    """Names of the package that live in a folder, and names that are reached through the folder."""
    own = [n for n in vars(pilfr)["__all__"] if not inspect.ismodule(getattr(pilfr, n)) and n != "__version__"]
    own = sorted((n for n in own if origin(n) == folder), key=str.lower)
    face = importlib.import_module(f"pilfr_casadi.{folder}")
    more = [n for n in face.__all__ if n not in own and documented(getattr(face, n), folder, n)]
    return own, sorted(more, key=str.lower)


def documented(thing: Any, folder: str, name: str) -> bool:
    """Tell whether a name of a face belongs into the reference; laws have the catalogue."""
    law = inspect.isclass(thing) and issubclass(thing, pilfr.Law)
    callable_here = (inspect.isclass(thing) or inspect.isfunction(thing)) and f".{folder}." in thing.__module__
    return callable_here and (folder in WHOLE or hasattr(pilfr, name)) and not law


def summary(module: str, names: list[str]) -> str:
    """Write a table of names, each with a page of its own."""
    rows = "".join(f"   {name}\n" for name in names)
    return f".. currentmodule:: {module}\n\n.. autosummary::\n   :toctree: api\n   :nosignatures:\n\n{rows}"


def build() -> None:
    """Write the index and a page for each folder."""
    index = [heading("Reference"), "Every public name, from its docstring. ``import pilfr_casadi as pilfr``.\n"]
    listed: set[str] = set()
    for folder, title in FOLDERS.items():
        own, more = entries(folder)
        text = [heading(title)]
        if own:
            text.append(summary("pilfr_casadi", own))
        if more:
            text += [f"Reached as ``pilfr.{folder}.…``:\n", summary(f"pilfr_casadi.{folder}", more)]
        if folder == "laws":
            text.append("The laws themselves are in :doc:`the catalogue </laws/index>`.\n")
        write(f"reference/{folder.strip('_')}.rst", "\n".join(text))
        shown = " · ".join([*(f":obj:`~pilfr_casadi.{n}`" for n in own)]) or f"``pilfr.{folder}.…``"
        listed |= {*(f"pilfr_casadi.{n}" for n in own), *(f"pilfr_casadi.{folder}.{n}" for n in more)}
        index.append(f":doc:`{title} <{folder.strip('_')}>`\n    {shown}\n")
    pages = "".join(f"   {folder.strip('_')}\n" for folder in FOLDERS)
    write("reference/index.rst", "\n".join([*index, f".. toctree::\n   :hidden:\n\n{pages}"]))
    for page in (DOCS / "reference" / "api").glob("*.rst"):  # of names that have gone
        if page.stem not in listed:
            page.unlink()
