"""The equations of a NumPy function, found by calling it with symbols in place of numbers.

Where the function branches on a symbol (`if x[1] > 0`, `max`, a boolean index), it is called again for each answer, and
the results are joined: `value = if_else(condition, value if True, value if False)`. Each call records its decisions,
and the next call repeats the first of them. All paths are explored, as in symbolic execution (King 1976, Symbolic
execution and program testing).

The call runs a copy of the function in which `numpy`, `math` and their functions are replaced by variants that accept
symbols: `np.zeros(2)` then makes an array that can hold them. The function itself and its module do not change.
"""

from __future__ import annotations

import functools
import math
import random
import types
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from .symbols import (
    RULES,
    Float,
    NotTraceable,
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

NOT_COPIED = {"numpy", "casadi", "scipy"}  # packages whose functions are not copied
MOST_CALLS = 512  # of a function for all of its branches: nine independent decisions
MOST_DECISIONS = 64  # in one call; a loop whose end depends on a symbol would never end
EQUAL_DEPTH = 20  # levels at which two conditions are compared


class Trace:
    """The decisions of one call: the prescribed answers first, then True for each new condition.

    The joined expressions hold both results of a decision, and a derivative of the unused one must not spoil the other:
    `0 * nan` is nan. So the root of h on the path h > 0 is written as the root of `if_else(h > 0, h, 1)`.
    """

    def __init__(self, prescribed: Sequence[bool], signals: Any) -> None:
        self.prescribed, self.signals = list(prescribed), signals
        self.decisions: list[tuple[Any, bool]] = []
        self.refused: NotTraceable | None = None

    def decide(self, condition: Any) -> bool:
        """Answer a condition; the same condition gets the same answer again."""
        for known, answer in self.decisions:
            if ca.is_equal(known, condition, EQUAL_DEPTH):
                return answer
        if len(self.decisions) == MOST_DECISIONS:
            raise NotTraceable(
                f"decides more than {MOST_DECISIONS} times by values that are not numbers yet",
                "write loops with a fixed number of steps",
            )
        answer = self.prescribed[len(self.decisions)] if len(self.decisions) < len(self.prescribed) else True
        self.decisions.append((condition, answer))
        return answer

    def guard(self, argument: Any, harmless: float) -> Any:
        """Replace an argument that varies by a harmless value on other paths than this one."""
        if not self.decisions or not ca.depends_on(argument, self.signals):
            return argument
        path = [condition if answer else ca.logic_not(condition) for condition, answer in self.decisions]
        return ca.if_else(functools.reduce(ca.logic_and, path), argument, harmless)


def explore_paths(call: Callable[[Trace], Any], signals: Any) -> tuple[Any, int]:
    """Explore all paths of a call; return their expressions, joined by the conditions, and the number of calls.

    Parameters
    ----------
    call : callable
        From a trace, which decides its conditions, to a vector of expressions.
    signals : casadi.SX
        The symbols that vary in time.

    Raises
    ------
    NotTraceable
        If there are too many paths.
    """
    calls = 0

    def explore(prescribed: list[bool]) -> Any:
        nonlocal calls
        calls += 1
        if calls > MOST_CALLS:
            raise NotTraceable(f"has more than {MOST_CALLS} branches", "write np.where, np.maximum or np.sign for them")
        trace = Trace(prescribed, signals)
        try:
            value = call(trace)
        except Exception as error:
            if trace.refused and trace.refused not in (error, error.__cause__):
                raise error from trace.refused  # compiled code may report what its lost error led to
            raise
        answers = [answer for _, answer in trace.decisions]
        for i in reversed(range(len(prescribed), len(answers))):
            value = ca.if_else(trace.decisions[i][0], value, explore([*answers[:i], False]))
        return value

    return ca.cse(explore([])), calls


def _wrap_creator(function: Rule) -> Rule:
    """Let a function that makes arrays accept symbols, and make arrays that can hold them."""

    def create(*args: Any, **options: Any) -> Any:
        args = tuple(float if a is Float else a for a in args)
        options = {k: float if v is Float else v for k, v in options.items()}
        if not has_symbol(args[:1]):
            return writable(function(*to_numbers(args), **options))
        if isinstance(args[0], Symbol | Symbols) and function is not np.array:
            return args[0]
        return array_of(objects(args[0]).copy())

    return create


def _wrap_scalar_function(function: Rule, ufunc: Any) -> Rule:
    """Let a function of `math` accept symbols, to which the ufunc is applied."""

    def apply(*values: Any) -> Any:
        if not has_symbol(values):
            return function(*values)
        if function is math.log and len(values) == 2:
            return np.log(values[0]) / np.log(values[1])
        return ufunc(*values)

    return apply


_CREATORS = ("zeros", "ones", "empty", "full", "eye", "identity", "array", "asarray", "asanyarray")
REPLACED: dict[Any, Rule] = {getattr(np, name): _wrap_creator(getattr(np, name)) for name in _CREATORS}
_RENAMED = {"pow": "power"}
_RENAMED |= {f"a{name}": f"arc{name}" for name in ("sin", "cos", "tan", "tan2", "sinh", "cosh", "tanh")}
_OF_MATH = {ufunc.__name__: ufunc for ufunc in RULES if hasattr(math, ufunc.__name__)}
del _OF_MATH["remainder"]  # math.remainder has another sign
_OF_MATH |= {name: getattr(np, other) for name, other in _RENAMED.items()}
REPLACED |= {getattr(math, name): _wrap_scalar_function(getattr(math, name), ufunc) for name, ufunc in _OF_MATH.items()}


class _SymbolicProxy:
    """A proxy of a module or an object: its functions accept symbols, and attributes are set on the proxy only."""

    def __init__(self, owner: Any, done: dict[int, Any]) -> None:
        self._owner, self._done = owner, done

    def __getattr__(self, name: str) -> Any:
        return _replace(getattr(self._owner, name), self._done)


RANDOM = (np.random.RandomState, np.random.Generator, random.Random)
COPIED = (types.ModuleType, types.FunctionType, types.BuiltinFunctionType, types.MethodType, functools.partial)


def accept_symbols(function: Any) -> Any:
    """Copy a function, and the Python functions that it calls by name, with `numpy` and `math` that accept symbols."""
    is_object = isinstance(type(function).__call__, types.FunctionType)  # of the user's own class
    return _replace(function.__call__ if is_object else function, {})


def _refuse_random(*_: Any, **__: Any) -> Any:
    raise NotTraceable("uses random numbers", "leave them out or make them an input")


def _replace(value: Any, done: dict[int, Any]) -> Any:
    """Return the variant of a value that accepts symbols; `done` holds copied functions by their id."""
    if isinstance(value, (types.ModuleType, *RANDOM)):
        return _SymbolicProxy(value, done)
    if isinstance(value, types.MethodType | types.BuiltinFunctionType) and isinstance(value.__self__, RANDOM):
        return _refuse_random
    if type(value).__module__.startswith("numba."):
        value = getattr(value, "py_func", value)  # the function that it has compiled
    if isinstance(value, types.MethodType) and isinstance(value.__func__, types.FunctionType):  # C needs its own self
        return types.MethodType(_replace(value.__func__, done), _SymbolicProxy(value.__self__, done))
    if isinstance(value, functools.partial):
        return functools.partial(_replace(value.func, done), *value.args, **value.keywords)
    if (table := as_table(value)) is not None:
        return table
    if callable(value) and isinstance(value, Hashable) and value in REPLACED:
        return REPLACED[value]
    if not isinstance(value, types.FunctionType) or (value.__module__ or "").partition(".")[0] in NOT_COPIED:
        return value
    if id(value) in done:
        return done[id(value)]
    names = dict(value.__globals__)
    cells = tuple(map(_copy_cell, value.__closure__ or ()))
    copy = types.FunctionType(value.__code__, names, value.__name__, None, cells or None)
    done[id(value)] = copy
    copy.__defaults__ = tuple(_replace(v, done) for v in value.__defaults__ or ())
    copy.__kwdefaults__ = {k: _replace(v, done) for k, v in (value.__kwdefaults__ or {}).items()}
    used = _collect_names(value.__code__)
    for name in used & set(names):
        names[name] = _replace(names[name], done)
    if "float" in used:
        names.setdefault("float", Float)
    for cell in cells:
        if isinstance(content := _cell_content(cell), COPIED):
            cell.cell_contents = _replace(content, done)
    return copy


def _cell_content(cell: types.CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # not assigned yet
        return None


def _copy_cell(cell: types.CellType) -> types.CellType:
    """Copy a closure's cell that holds a function or a module; share any other, so that counters still count."""
    content = _cell_content(cell)
    return types.CellType(content) if isinstance(content, COPIED) else cell


def _collect_names(code: types.CodeType) -> set[str]:
    """Collect the names that a function and its inner functions look up."""
    inner = (c for c in code.co_consts if isinstance(c, types.CodeType))
    return {*code.co_names, *(name for c in inner for name in _collect_names(c))}
