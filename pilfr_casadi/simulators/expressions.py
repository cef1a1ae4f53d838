"""Functions of a user's own, called with the symbols that they name: `x.<state>`, `u.<input>`, `p.<parameter>`.

What they amount to may have no value at some numbers (`numbers_or_nan`).
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError

Expression = Callable[..., Any]


class Named:
    """Symbols by name: `x.pos`, `p.k` or `p["k"]`."""

    def __init__(self, kind: str, values: Mapping[str, Any]) -> None:
        self.__dict__.update(_kind=kind, _values=dict(values))

    def __getattr__(self, name: str) -> Any:
        try:
            return self._values[name]
        except KeyError:
            if name.startswith("__"):
                raise AttributeError(name) from None
            known = ", ".join(self._values) or "none"
            raise InputError(f"There is no {self._kind} {name!r}; there are {known}.") from None

    __getitem__ = __getattr__

    def __setattr__(self, name: str, value: Any) -> None:
        raise InputError(f"The {self._kind} {name!r} cannot be assigned; return the equations in a dict instead.")

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)


def call(function: Expression, what: str, **available: Any) -> Any:
    """Call a user's function with those of `available` that it names.

    Raises
    ------
    InputError
        If it asks for something else, or fails.
    """
    wanted = [
        name
        for name, p in inspect.signature(function).parameters.items()
        if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY) and p.default is p.empty
    ]
    for name in wanted:
        if name not in available:
            raise InputError(f"The {what} asks for {name!r}; it can have {', '.join(available)}.")
    try:
        return function(**{name: available[name] for name in wanted})
    except InputError as error:
        raise InputError(f"In the {what}: {error}") from None
    except Exception as error:
        if "truth value" in str(error):
            raise InputError(
                f"The {what} decides by the value of a symbol (if, and, or, min, max), which has none yet; "
                "use casadi.if_else, casadi.fmin and casadi.fmax."
            ) from error
        raise InputError(f"The {what} fails: {type(error).__name__}: {error}.") from error


def numbers_or_nan(function: ca.Function, *arguments: Any) -> np.ndarray:
    """The first output of a function, nan where CasADi gives none: its linear solvers raise at a singular matrix."""
    try:
        return np.asarray(function.call(arguments)[0])
    except RuntimeError:
        return np.full(function.size_out(0), np.nan)
