"""The equations of a NumPy function, found by calling it with symbols in place of numbers.

Where the function decides by a symbol (`if x[1] > 0`, `max`, a boolean index), it is called again for each answer, and
the results are joined: `value = if_else(condition, value if True, value if False)`. Each call records its decisions,
and the next one is told how to begin. All paths are walked, as in symbolic execution (King 1976, Symbolic execution and
program testing).

For a call, the names of the function that mean `numpy`, `math` or a function of theirs mean a variant that accepts
symbols: `np.zeros(2)` then makes an array that can hold them. The function itself and its module stay as they are.
"""

from __future__ import annotations

import functools
import math
import types
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from .symbols import (
    RULES,
    Float,
    NotFollowed,
    Rule,
    Symbol,
    Symbols,
    array_of,
    as_table,
    has_symbol,
    objects,
    to_numbers,
    writable,
)

LEFT_AS_THEY_ARE = {"numpy", "casadi", "scipy"}  # packages whose functions are not copied
MOST_CALLS = 512  # of a function for all of its branches; nine decisions that are all independent
MOST_DECISIONS = 64  # in one call: a loop that ends by a symbol never would
DEPTH = 20  # levels of two expressions that are compared to tell that a decision has been made before


class Trace:
    """The decisions of one call: those it was told first, then True for each new one.

    Both results of a decision are part of the expressions, and a derivative of the one that is not taken must not
    spoil the other: `0 * nan` is nan. So a root of h that is taken where h > 0 is that of `if_else(h > 0, h, 1)`.
    """

    def __init__(self, told: Sequence[bool], signals: Any) -> None:
        self.told, self.signals = list(told), signals
        self.taken: list[tuple[Any, bool]] = []

    def decide(self, condition: Any) -> bool:
        """Answer a condition, the same way each time it is asked."""
        for known, answer in self.taken:
            if ca.is_equal(known, condition, DEPTH):
                return answer
        if len(self.taken) == MOST_DECISIONS:
            raise NotFollowed(
                f"decides more than {MOST_DECISIONS} times by values that are not numbers yet",
                "let no loop end by a value; write a fixed number of steps",
            )
        answer = self.told[len(self.taken)] if len(self.taken) < len(self.told) else True
        self.taken.append((condition, answer))
        return answer

    def guard(self, argument: Any, harmless: float) -> Any:
        """Replace an argument that varies by a harmless value where the decisions are others than so far."""
        if not self.taken or not ca.depends_on(argument, self.signals):
            return argument
        so = [condition if answer else ca.logic_not(condition) for condition, answer in self.taken]
        return ca.if_else(functools.reduce(ca.logic_and, so), argument, harmless)


def follow(call: Callable[[Trace], Any], signals: Any) -> tuple[Any, int]:
    """Return the expressions of all paths of a call, joined by their conditions, and the number of calls.

    Parameters
    ----------
    call : callable
        From a trace, whose symbols it uses, to a vector of expressions.
    signals : casadi.SX
        The symbols that vary in time.

    Raises
    ------
    NotFollowed
        If there are too many paths.
    """
    calls = 0

    def explore(told: list[bool]) -> Any:
        nonlocal calls
        calls += 1
        if calls > MOST_CALLS:
            raise NotFollowed(f"has more than {MOST_CALLS} branches", "write np.where, np.maximum or np.sign for them")
        trace = Trace(told, signals)
        value = call(trace)
        answers = [answer for _, answer in trace.taken]
        for i in reversed(range(len(told), len(answers))):
            value = ca.if_else(trace.taken[i][0], value, explore([*answers[:i], False]))
        return value

    return ca.cse(explore([])), calls


def _creator(function: Rule) -> Rule:
    def create(*args: Any, **options: Any) -> Any:
        args = tuple(float if a is Float else a for a in args)
        options = {k: float if v is Float else v for k, v in options.items()}
        if not has_symbol(args[:1]):
            return writable(function(*to_numbers(args), **options))
        if isinstance(args[0], Symbol | Symbols) and function is not np.array:
            return args[0]
        return array_of(objects(args[0]).copy())

    return create


def _scalar_function(function: Rule, ufunc: Any) -> Rule:
    """Make a function of `math` one that accepts symbols."""

    def apply(*values: Any) -> Any:
        if not has_symbol(values):
            return function(*values)
        if function is math.log and len(values) == 2:
            return np.log(values[0]) / np.log(values[1])
        return ufunc(*values)

    return apply


_CREATORS = ("zeros", "ones", "empty", "full", "eye", "identity", "array", "asarray", "asanyarray")
REPLACED: dict[Any, Rule] = {getattr(np, name): _creator(getattr(np, name)) for name in _CREATORS}
_RENAMED = {"pow": "power"}
_RENAMED |= {f"a{name}": f"arc{name}" for name in ("sin", "cos", "tan", "tan2", "sinh", "cosh", "tanh")}
_OF_MATH = {ufunc.__name__: ufunc for ufunc in RULES if hasattr(math, ufunc.__name__)}
del _OF_MATH["remainder"]  # that of math has another sign
_OF_MATH |= {name: getattr(np, other) for name, other in _RENAMED.items()}
REPLACED |= {getattr(math, name): _scalar_function(getattr(math, name), ufunc) for name, ufunc in _OF_MATH.items()}


class _Accepting:
    """A module or an object whose functions accept symbols; it keeps what they write into it to itself."""

    def __init__(self, owner: Any, done: dict[int, Any]) -> None:
        self._owner, self._done = owner, done

    def __getattr__(self, name: str) -> Any:
        return _accepting(getattr(self._owner, name), self._done)


COPIED = (types.ModuleType, types.FunctionType, types.BuiltinFunctionType, types.MethodType, functools.partial)


def accept_symbols(function: Any) -> Any:
    """Copy a function, and those of Python that it calls by name, with `numpy` and `math` that accept symbols."""
    written = isinstance(type(function).__call__, types.FunctionType)  # an object of the user's own class
    return _accepting(function.__call__ if written else function, {})


def _accepting(value: Any, done: dict[int, Any]) -> Any:
    if isinstance(value, types.ModuleType):
        return _Accepting(value, done)
    if type(value).__module__.startswith("numba."):
        value = getattr(value, "py_func", value)  # the function that it has compiled
    if isinstance(value, types.MethodType):
        return types.MethodType(_accepting(value.__func__, done), _Accepting(value.__self__, done))
    if isinstance(value, functools.partial):
        return functools.partial(_accepting(value.func, done), *value.args, **value.keywords)
    if (table := as_table(value)) is not None:
        return table
    if callable(value) and isinstance(value, Hashable) and value in REPLACED:
        return REPLACED[value]
    if not isinstance(value, types.FunctionType) or (value.__module__ or "").partition(".")[0] in LEFT_AS_THEY_ARE:
        return value
    if id(value) in done:
        return done[id(value)]
    names = dict(value.__globals__)
    cells = tuple(map(_copy_cell, value.__closure__ or ()))
    copy = types.FunctionType(value.__code__, names, value.__name__, None, cells or None)
    done[id(value)] = copy
    copy.__defaults__ = tuple(_accepting(v, done) for v in value.__defaults__ or ())
    copy.__kwdefaults__ = {k: _accepting(v, done) for k, v in (value.__kwdefaults__ or {}).items()}
    used = _names_of(value.__code__)
    for name in used & set(names):
        names[name] = _accepting(names[name], done)
    if "float" in used:
        names.setdefault("float", Float)
    for cell in cells:
        if isinstance(content := _content(cell), COPIED):
            cell.cell_contents = _accepting(content, done)
    return copy


def _content(cell: types.CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # not assigned yet
        return None


def _copy_cell(cell: types.CellType) -> types.CellType:
    """Copy a cell of a closure that holds a function or a module; others are shared, so that counters count."""
    content = _content(cell)
    return types.CellType(content) if isinstance(content, COPIED) else cell


def _names_of(code: types.CodeType) -> set[str]:
    """Return the names that a function and those defined inside it look up."""
    inner = (c for c in code.co_consts if isinstance(c, types.CodeType))
    return {*code.co_names, *(name for c in inner for name in _names_of(c))}
