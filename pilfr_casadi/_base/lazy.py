"""Import a package's public names when they are first used, and functions of later folders when they are called.

A face lists its names once, under ``TYPE_CHECKING``; type checkers, editors and this helper read the same list::

    from typing import TYPE_CHECKING

    from .._base.lazy import lazy_face

    if TYPE_CHECKING:
        from .operators import Play as Play
    else:
        __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)

A folder imports only folders before it. Methods such as `recording.plot()` or `fit.report()`, whose work is done in a
later folder, call `later("plots.plot_recording")(self)`, which imports the folder when a user calls the method.
"""

from __future__ import annotations

import ast
import importlib
import itertools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any


def lazy_face(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Make `__getattr__`, `__dir__` and `__all__` of a package from its imports under ``TYPE_CHECKING``.

    `__all__` lists the names of the first such block; names of further blocks can be imported too.
    """
    blocks = [
        [node for node in block.body if isinstance(node, ast.ImportFrom)]
        for block in ast.parse(Path(file).read_text(encoding="utf-8")).body
        if isinstance(block, ast.If) and isinstance(block.test, ast.Name) and block.test.id == "TYPE_CHECKING"
    ]
    listed = sorted(alias.name for node in blocks[0] for alias in node.names)
    imports = itertools.chain(*blocks)
    origins = {a.name: "." * node.level + (node.module or "") for node in imports for a in node.names}

    def load(name: str) -> Any:
        if name not in origins:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        origin = origins[name]
        folder = not origin.strip(".")  # `from . import laws` names a sub-package itself
        module = importlib.import_module(f"{origin}{name}" if folder else origin, package)
        value = module if folder else getattr(module, name)
        vars(sys.modules[package])[name] = value  # later look-ups find it without this function
        return value

    return load, lambda: sorted({*vars(sys.modules[package]), *origins}), listed


def later(verb: str) -> Callable[..., Any]:
    """Return a function of a later folder's face, by folder and name, such as "report.fit_card"."""
    folder, name = verb.split(".")
    return getattr(importlib.import_module(f"..{folder}", __package__), name)
