"""The arguments that a user's function takes: `(t, x, u, p)`, or t, x and some inputs and parameters by their names.

`scipy.integrate.solve_ivp` calls a right-hand side as `f(t, y)`, with its `args` as further arguments. Further
arguments that are named as inputs or parameters get the numbers of these, so such a function can be used as it is.
"""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from .._base import InputError, in_words, listed

ARGUMENTS = ("t", "x", "u", "p")
ALL_INPUTS, ALL_PARAMETERS = ARGUMENTS[2:]  # an argument of this name gets the array, or the mapping
VARIADIC = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
BY_NAME = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)


@dataclass(frozen=True)
class Signature:
    """The arguments of a function.

    Attributes
    ----------
    called : str
        Its call in messages, such as "rhs(t, y, k)".
    inputs : tuple of str
        Names of all inputs.
    further : tuple of str or None
        Arguments after t and x that are passed by name; None if u and p are passed by position.
    renamed : tuple of str
        The function's own names of u and p, if they are passed by position.
    """

    called: str
    inputs: tuple[str, ...]
    further: tuple[str, ...] | None
    renamed: tuple[str, ...] = ()

    def call(self, function: Any, t: Any, x: Any, u: Any, p: Any) -> Any:
        """Call the function, or a copy of it, with the inputs u in an array and the parameters p in a mapping."""
        if self.further is None:
            return function(t, x, u, p)
        given = {}
        for name in self.further:
            if name == ALL_INPUTS:
                given[name] = u
            elif name == ALL_PARAMETERS:
                given[name] = p
            else:
                given[name] = u[self.inputs.index(name)] if name in self.inputs else p[name]
        return function(t, x, **given)

    def describe(self) -> str:
        """Describe the call, for messages about a function that fails."""
        of_all = {ALL_INPUTS: "u is the array of the inputs", ALL_PARAMETERS: "p[name] a parameter"}
        arguments = ARGUMENTS if self.further is None else self.further
        said = [words for name, words in of_all.items() if name in arguments]
        why = f", because {in_words(self.renamed)} are no names of inputs or parameters" * (len(self.renamed) > 1)
        return f"it is called as {self.called}{why}" + f"; {in_words(said)}" * bool(said)

    def check_driven(self) -> None:
        """Refuse dynamics that take none of the inputs, so that a recording could not drive them."""
        if self.inputs and self.further is not None and not {*self.inputs, ALL_INPUTS} & set(self.further):
            first = self.inputs[0]
            raise InputError(
                f"{self.called} does not take {listed(self.inputs)}, so a recording cannot drive it; give the input as "
                f"an argument: {self.called[:-1]}, {first})."
            )


def read_signature(function: Any, name: str, inputs: Sequence[str], parameters: Sequence[str]) -> Signature:
    """Find out how a function of this name takes time, states, inputs and parameters.

    Raises
    ------
    InputError
        If it takes neither `(t, x, u, p)` nor, after time and states, only inputs and parameters by their names.
    """
    try:
        signature = inspect.signature(getattr(function, "py_func", function))
    except (TypeError, ValueError):
        raise InputError(
            f"The arguments of {name} cannot be read; give a function of t, x, u and p that calls it."
        ) from None
    own = [a for a in signature.parameters.values() if a.kind not in VARIADIC]
    first = [a.name for a in own if a.kind is not a.KEYWORD_ONLY][:2]
    declared = {*inputs, *parameters} - {ALL_INPUTS, ALL_PARAMETERS}
    further = [a for a in own if a.name not in first]
    by_name = [a.name for a in further if a.name in {*declared, ALL_INPUTS, ALL_PARAMETERS} and a.kind in BY_NAME]
    unknown = [a.name for a in further if a.name not in by_name and a.default is a.empty]
    called = f"{name}({', '.join([*first, *(n.name for n in further if n.name in {*by_name, *unknown})])})"
    if first[1:] == ["t"]:
        raise InputError(f"{called} takes the time after the states; write {name}(t, {first[0]}, ...).")
    open_ended = bool(unknown) or len(own) < len(signature.parameters)
    if not declared & set(by_name) and (open_ended or by_name == [ALL_INPUTS, ALL_PARAMETERS]) and _binds(signature):
        return Signature(f"{name}({', '.join(ARGUMENTS)})", tuple(inputs), None, tuple(unknown))
    if len(first) < 2:
        raise InputError(f"{name} cannot be called as {name}(t, x, u, p); give a function of these four.")
    if unknown:
        raise InputError(
            f"{called} has the argument {unknown[0]!r}, which is neither an input ({listed(inputs) or 'none'}) nor a "
            f"parameter ({listed(list(parameters)) or 'none'}); declare it as one, or write {name}(t, x, u, p)."
        )
    return Signature(called, tuple(inputs), tuple(by_name))


def _binds(signature: inspect.Signature) -> bool:
    """Tell whether a function can be called with four arguments."""
    try:
        signature.bind(*ARGUMENTS)
    except TypeError:
        return False
    return True
