"""Lazy faces of packages: a public name is imported from its module when it is first used.

A face lists its names once, under ``TYPE_CHECKING``; type checkers, editors and this helper read the same list::

    from typing import TYPE_CHECKING

    from .._base.lazy import lazy_face

    if TYPE_CHECKING:
        from .operators import Play as Play
    else:
        __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
"""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any


def lazy_face(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Make `__getattr__`, `__dir__` and `__all__` of a package from its imports under ``TYPE_CHECKING``.

    Parameters
    ----------
    package : str
        The package's `__name__`.
    file : str
        The package's `__file__`.

    Returns
    -------
    tuple
        `__getattr__`, `__dir__` and `__all__` to be bound in the package.
    """
    origins = listed_imports(Path(file).read_text(encoding="utf-8"))

    def load(name: str) -> Any:
        if name not in origins:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        origin = origins[name]
        folder = not origin.strip(".")  # `from . import laws` names a sub-package itself
        module = importlib.import_module(f"{origin}{name}" if folder else origin, package)
        value = module if folder else getattr(module, name)
        vars(sys.modules[package])[name] = value  # found directly from now on
        return value

    names = sorted(origins)
    return load, lambda: sorted({*vars(sys.modules[package]), *names}), names


def listed_imports(source: str) -> dict[str, str]:
    """Map each name that is imported under ``TYPE_CHECKING`` to its relative module."""
    blocks = [
        node.body
        for node in ast.parse(source).body
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
    ]
    imports = [node for body in blocks for node in body if isinstance(node, ast.ImportFrom)]
    return {
        alias.asname or alias.name: "." * node.level + (node.module or "") for node in imports for alias in node.names
    }
