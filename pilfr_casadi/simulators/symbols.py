"""Symbols that NumPy's functions accept: expressions of CasADi that behave like numbers and arrays of numbers.

NumPy lets arguments override its functions (NEP 13, `__array_ufunc__`, and NEP 18, `__array_function__`). `RULES` gives
the expression of each ufunc, and `FUNCTIONS` gives the expressions of functions that are not built from ufuncs. All
other functions run unchanged on arrays of objects.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import casadi as ca
import numpy as np

Rule = Callable[..., Any]


class NotTraceable(Exception):
    """An operation has no symbolic counterpart; the message says what the function does and what to write instead."""

    def __init__(self, does: str, instead: str) -> None:
        super().__init__(f"{does}; {instead}")


class Decides(Protocol):
    """Decide conditions that are symbols; `refused` keeps the first wish for a number, which compiled code may lose."""

    refused: NotTraceable | None

    def decide(self, condition: Any) -> bool:
        """Return the answer to a condition."""

    def guard(self, argument: Any, harmless: float) -> Any:
        """Return the argument of a singular function, or a harmless one on the other paths."""


class Symbol(np.lib.mixins.NDArrayOperatorsMixin):
    """A scalar expression `sx` that NumPy's functions accept."""

    __hash__ = None  # type: ignore[assignment]
    shape, ndim, size = (), 0, 1

    def __init__(self, sx: Any, trace: Decides) -> None:
        self.sx, self.trace = sx, trace

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        return _apply_ufunc(ufunc, method, inputs, options)

    def __array_function__(self, function: Any, _: Any, inputs: Any, options: Any) -> Any:
        return _apply_function(function, inputs, options)

    def __getattr__(self, name: str) -> Any:
        """Return np.<name> as a method, as NumPy's own loops over objects call it."""
        ufunc: Any = None if name.startswith("_") else getattr(np, name, None)
        if ufunc not in RULES:
            raise AttributeError(f"a symbol has no attribute {name!r}")
        return functools.partial(ufunc, self)

    def __bool__(self) -> bool:
        return bool(float(self.sx)) if self.sx.is_constant() else self.trace.decide(self.sx)

    def _number(self, does: str) -> float:
        if self.sx.is_constant():
            return float(self.sx)
        refusal = NotTraceable(
            f"{does} from a value that is a symbol here",
            "leave out int(), use functions of NumPy in place of other modules (np.interp for tables), collect "
            "results by np.array([...]), give numeric=Numeric(...) for solvers",
        )
        self.trace.refused = self.trace.refused or refusal
        raise refusal

    def __float__(self) -> float:
        return self._number("makes a plain number")

    def __int__(self) -> int:
        return int(self._number("makes a whole number"))

    def __index__(self) -> int:
        return int(self._number("makes an index"))

    def __round__(self, digits: int | None = None) -> float:
        return round(self._number("rounds"), digits)

    def __complex__(self) -> complex:
        return complex(self._number("makes a complex number"))

    def item(self) -> Symbol:
        """Return the symbol itself, as NumPy's scalars return their number."""
        return self


class Symbols(np.ndarray):
    """An array of objects: symbols and numbers."""

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        return _apply_ufunc(ufunc, method, inputs, options)

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        return _apply_function(function, args, kwargs)

    def __getitem__(self, key: Any) -> Any:
        return super().__getitem__(_decide_index(key))

    def __setitem__(self, key: Any, value: Any) -> None:
        super().__setitem__(_decide_index(key), value)

    def clip(self, *limits: Any, **named: Any) -> Any:
        """Clip by np.clip; NumPy's own method uses a ufunc that has no public name."""
        return np.clip(self, *limits, **named)

    def astype(self, dtype: Any, *args: Any, **options: Any) -> Any:
        """Return a copy for any type of float, because symbols stand for floats."""
        dtype = float if dtype is Float else dtype
        if np.dtype(dtype).kind == "f" and has_symbol(self):
            return self.copy()
        return super().astype(dtype, *args, **options)


class _FloatType(type):
    def __call__(cls, value: Any = 0.0) -> Any:
        return value if isinstance(value, Symbol) else float(value)

    def __instancecheck__(cls, value: Any) -> bool:
        return isinstance(value, float | Symbol)


class Float(metaclass=_FloatType):
    """The type `float`, extended so that symbols are instances too, as NumPy's scalars are."""


def symbols(expression: Any, shape: tuple[int, ...], trace: Decides) -> Any:
    """Make a read-only array of symbols from a matrix of expressions; one symbol for the shape ()."""
    if not shape:
        return Symbol(expression, trace)
    out = np.empty(shape, dtype=object)
    for i in np.ndindex(shape):
        out[i] = Symbol(expression[i], trace)
    out.flags.writeable = False
    return out.view(Symbols)


def expression(value: Any) -> Any:
    """Return the expression of a symbol or a number."""
    return value.sx if isinstance(value, Symbol) else ca.SX(float(value))


def _decide_index(key: Any) -> Any:
    """Decide the conditions of a boolean index."""
    if isinstance(key, tuple):
        return tuple(map(_decide_index, key))
    if isinstance(key, Symbols):
        return np.array([bool(c) for c in key.ravel()], dtype=bool).reshape(key.shape)
    return key


def has_symbol(value: Any) -> bool:
    """Tell whether a value, an array or a nested list holds a symbol."""
    if isinstance(value, Symbol):
        return True
    if isinstance(value, np.ndarray):
        return value.dtype == object and any(isinstance(e, Symbol) for e in value.flat)
    return isinstance(value, list | tuple) and any(map(has_symbol, value))


def _find_trace(values: Sequence[Any]) -> Decides:
    return next(v.trace for v in values if isinstance(v, Symbol))


def objects(value: Any) -> np.ndarray:
    """Make a plain array of objects."""
    if isinstance(value, Symbol):
        out = np.empty((), dtype=object)
        out[()] = value
        return out
    return np.asarray(value, dtype=object).view(np.ndarray)


def array_of(array: np.ndarray) -> Any:
    """View an array of objects as one of symbols; return the element of an array without dimensions."""
    return array.view(Symbols) if array.ndim else array[()]


def _map(rule: Rule, *values: Any) -> Any:
    """Apply a rule to each element of some values, broadcast together."""
    found = np.frompyfunc(rule, len(values), 1)(*map(objects, values))
    return found.view(Symbols) if isinstance(found, np.ndarray) else found


def to_numbers(value: Any) -> Any:
    """Convert arrays of objects without a symbol to arrays of numbers."""
    if isinstance(value, Symbols):
        return np.array(value.tolist())
    return type(value)(map(to_numbers, value)) if type(value) in (list, tuple) else value


def _wrap_scalars(value: Any) -> Any:
    """Convert single symbols to arrays, which NumPy's own functions work on."""
    if isinstance(value, Symbol):
        return objects(value).view(Symbols)
    return type(value)(map(_wrap_scalars, value)) if type(value) in (list, tuple) else value


def _elementwise(ufunc: Any, *inputs: Any) -> Any:
    """Apply a rule, or the ufunc itself to elements that are all numbers."""
    rule = RULES.get(ufunc)
    singular, harmless = SINGULAR.get(ufunc, (None, 0.0))

    def apply(*values: Any) -> Any:
        if not has_symbol(values):
            return ufunc(*values)
        if rule is None:
            raise NotTraceable(f"uses np.{ufunc.__name__}, which has no symbolic counterpart", INSTEAD)
        own = [v.sx if isinstance(v, Symbol) else float(v) for v in values]
        trace = _find_trace(values)
        if singular is not None and isinstance(values[singular], Symbol):
            own[singular] = trace.guard(own[singular], harmless)
        return Symbol(rule(*own), trace)

    return _map(apply, *inputs)


def _apply_ufunc(ufunc: Any, method: str, inputs: Sequence[Any], options: dict[str, Any]) -> Any:
    into = options.pop("out", (None,))[0]
    if options.pop("where", True) is not True:
        raise NotTraceable(f"uses the option where= of np.{ufunc.__name__}", "write np.where(condition, a, b)")
    if method == "__call__" and ufunc.signature is None:
        result = _elementwise(ufunc, *inputs)
    elif method == "reduce" and ufunc in RULES:
        result = _reduce(ufunc, inputs[0], **options)
    else:  # products of arrays, sums over pieces
        result = array_of(objects(getattr(ufunc, method)(*map(objects, inputs), **options)))
    if into is None or isinstance(into, Symbol):
        return result
    if into.dtype != object:
        raise NotTraceable("writes symbols into an array of numbers", "write y = y + ... in place of y += ...")
    into[...] = result
    return into


def _reduce(ufunc: Any, array: Any, axis: Any = 0, keepdims: bool = False, initial: Any = None, **_: Any) -> Any:
    values = objects(array)
    axes = tuple(range(values.ndim)) if axis is None else axis if isinstance(axis, tuple) else (axis,)
    rows = np.moveaxis(values, axes, range(len(axes))) if values.ndim else values[None]
    rows = rows.reshape(-1, *rows.shape[len(axes) :]) if values.ndim else rows
    first = ufunc.identity if initial is None else initial
    start = [first] if first is not None and (not len(rows) or initial is not None) else []
    total = functools.reduce(functools.partial(_elementwise, ufunc), [*start, *rows])
    return np.expand_dims(objects(total), axes).view(Symbols) if keepdims else array_of(objects(total))


def _apply_function(function: Any, inputs: Sequence[Any], options: dict[str, Any]) -> Any:
    if not has_symbol([*inputs, *options.values()]) and function not in WRITING:
        result = function(*to_numbers(tuple(inputs)), **{k: to_numbers(v) for k, v in options.items()})
        return writable(result)
    if function in FUNCTIONS:
        return FUNCTIONS[function](*inputs, **options)
    inputs, options = _wrap_scalars(tuple(inputs)), {k: _wrap_scalars(v) for k, v in options.items()}
    result = np.ndarray.__array_function__(objects([]).view(Symbols), function, (Symbols,), inputs, options)
    return array_of(objects(result)) if isinstance(result, np.ndarray) and result.dtype == object else result


def _if_else(condition: Any, a: Any, b: Any) -> Any:
    """Choose elements as np.where does."""

    def choose(c: Any, yes: Any, no: Any) -> Any:
        if isinstance(c, Symbol):
            return Symbol(ca.if_else(c.sx, expression(yes), expression(no)), c.trace)
        return yes if c else no

    return _map(choose, condition, a, b)


def _where(condition: Any, *choices: Any) -> Any:
    if len(choices) != 2:
        raise NotTraceable("uses np.where with one argument", "write np.where(condition, a, b)")
    return _if_else(condition, *choices)


def _clip(a: Any, a_min: Any = None, a_max: Any = None, **named: Any) -> Any:
    low, high = named.get("min", a_min), named.get("max", a_max)
    a = a if low is None else np.maximum(a, low)
    return a if high is None else np.minimum(a, high)


def _select(conditions: Any, choices: Any, default: Any = 0) -> Any:
    for condition, choice in reversed(list(zip(conditions, choices, strict=True))):
        default = _if_else(condition, choice, default)
    return default


def _interp(x: Any, xp: Any, fp: Any, left: Any = None, right: Any = None, period: Any = None) -> Any:
    """Interpolate linearly in a table of numbers, with the end values beyond its ends."""
    if has_symbol([xp, fp]) or not (left is right is period is None):
        raise NotTraceable("uses np.interp with more than x and a table of numbers", "write np.interp(x, xp, fp)")
    at, values = (np.asarray(to_numbers(v), dtype=float).ravel() for v in (xp, fp))
    if len(at) < 2 or len(at) != len(values) or np.any(np.diff(at) <= 0):
        raise NotTraceable("uses np.interp with a table whose x does not increase", "give one that increases")
    return _each(x, lambda e: _piecewise(ca.fmin(ca.fmax(e, at[0]), at[-1]), at, _chords(at, values)))


def _each(x: Any, rule: Rule) -> Any:
    """Apply a rule for expressions to each element of an array that holds a symbol."""
    trace = _find_trace(objects(x).ravel().tolist())
    return _map(lambda element: Symbol(rule(expression(element)), trace), x)


def _chords(at: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Compute the coefficients of a piecewise linear function for `_piecewise`."""
    return np.array([np.diff(values) / np.diff(at), values[:-1]])


def _piecewise(x: Any, at: np.ndarray, coefficients: np.ndarray) -> Any:
    """Evaluate piecewise polynomials of x - at[j], highest power first, shape (order, pieces); the outer ones go on."""
    found = None
    for start, end, row in reversed(list(zip(at[:-1], at[1:], coefficients.T, strict=True))):
        value = functools.reduce(lambda total, c, start=start: total * (x - start) + c, row, ca.SX(0))  # type: ignore[misc]
        found = value if found is None else ca.if_else(x < end, value, found)
    return found


def as_table(value: Any) -> Rule | None:
    """Wrap a SciPy interpolator in one variable, linear or a spline, to accept symbols; None for anything else."""
    if not type(value).__module__.startswith("scipy.interpolate"):
        return None
    from scipy.interpolate import BSpline, PPoly, interp1d

    own: Any = value
    beyond: Any  # rule beyond the ends: True for the outer pieces, numbers, or "periodic"
    if isinstance(value, BSpline) and own.c.ndim == 1:
        pieces = PPoly.from_spline(own)
        keep = np.diff(pieces.x) > 0  # a spline's knots are repeated at its ends
        at, coefficients, beyond = np.append(pieces.x[:-1][keep], pieces.x[-1]), pieces.c[:, keep], own.extrapolate
    elif isinstance(value, PPoly) and own.c.ndim == 2:
        at, coefficients, beyond = own.x, own.c, own.extrapolate
    elif isinstance(value, interp1d) and own._kind == "linear" and np.ndim(own.y) == 1:
        at, coefficients = np.asarray(own.x, dtype=float), _chords(own.x, own.y)
        beyond = True if isinstance(own.fill_value, str) else own.fill_value
    else:
        return None

    def evaluate(x: Any, *order: Any, **options: Any) -> Any:
        if not has_symbol(x):
            return value(x, *order, **options)
        if order or options:
            raise NotTraceable("asks a table for more than its value", "make a table of the derivative")
        return _each(x, at_one)

    def at_one(x: Any) -> Any:
        if isinstance(beyond, str):  # "periodic"
            x = at[0] + _floored_remainder(x - at[0], at[-1] - at[0])
        found = _piecewise(x, at, coefficients)
        if isinstance(beyond, str | bool | np.bool):
            return found
        low, high = np.broadcast_to(np.asarray(beyond, dtype=float), 2)
        return ca.if_else(x < at[0], low, ca.if_else(x > at[-1], high, found)) if np.isfinite(low + high) else found

    return evaluate


def _like(function: Rule) -> Rule:
    """Convert a function of a shape, as np.zeros, to a function of an array, as np.zeros_like."""
    return lambda a, *values, **_: array_of(objects(function(np.shape(a), *values[: function is np.full])))


def _matrix(rule: Rule) -> Rule:
    """Convert a function of matrices of expressions to a function of arrays of symbols."""

    def apply(*arrays: Any) -> Any:
        own = [objects(a) for a in arrays]
        dense = [ca.vertcat(*(ca.horzcat(*map(expression, row)) for row in a.reshape(len(a), -1))) for a in own]
        found = ca.densify(rule(*map(ca.sparsify, dense)))  # zeros spare most of the work
        trace, out = _find_trace([e for a in own for e in a.flat]), np.empty(found.shape, dtype=object)
        for i in np.ndindex(out.shape):
            out[i] = Symbol(found[i], trace)
        return out[0, 0] if rule is ca.det else array_of(out.reshape(own[-1].shape))

    return apply


def _floored_remainder(a: Any, b: Any) -> Any:
    return a - b * ca.floor(a / b)


INSTEAD = "write it with arithmetic, np.where, or the functions of math and NumPy that have a formula"
SAME_NAMES = (  # in NumPy and in CasADi
    *("sign", "copysign", "fabs", "sqrt", "exp", "expm1", "log", "log1p", "hypot"),
    *("fmod", "floor", "ceil", "fmax", "fmin", "sin", "cos", "tan", "sinh", "cosh", "tanh"),
    *("arcsin", "arccos", "arctan", "arctan2", "arcsinh", "arccosh", "arctanh"),
)
RULES: dict[Any, Rule] = {
    **{getattr(np, name): getattr(ca, name) for name in SAME_NAMES},
    np.add: lambda a, b: a + b,
    np.subtract: lambda a, b: a - b,
    np.multiply: lambda a, b: a * b,
    np.divide: lambda a, b: a / b,
    np.floor_divide: lambda a, b: ca.floor(a / b),
    np.remainder: _floored_remainder,
    **dict.fromkeys((np.power, np.float_power), lambda a, b: a**b),
    np.negative: lambda a: -a,
    **dict.fromkeys((np.positive, np.conjugate), lambda a: a),  # np.var uses the second
    np.absolute: ca.fabs,
    np.heaviside: lambda a, b: ca.if_else(ca.SX(a) == 0, b, ca.SX(a) > 0),
    np.square: lambda a: a * a,
    np.cbrt: lambda a: ca.sign(a) * ca.fabs(a) ** (1 / 3),
    np.reciprocal: lambda a: 1 / a,
    np.exp2: lambda a: 2.0**a,
    np.log2: lambda a: ca.log(a) / math.log(2),
    np.log10: lambda a: ca.log(a) / math.log(10),
    np.maximum: ca.fmax,
    np.minimum: ca.fmin,
    np.trunc: lambda a: ca.sign(a) * ca.floor(ca.fabs(a)),
    **dict.fromkeys((np.deg2rad, np.radians), lambda a: a * (math.pi / 180)),
    **dict.fromkeys((np.rad2deg, np.degrees), lambda a: a * (180 / math.pi)),
    np.less: lambda a, b: a < b,
    np.less_equal: lambda a, b: a <= b,
    np.greater: lambda a, b: a > b,
    np.greater_equal: lambda a, b: a >= b,
    np.equal: lambda a, b: a == b,
    np.not_equal: lambda a, b: a != b,
    **dict.fromkeys((np.logical_and, np.bitwise_and), ca.logic_and),  # bitwise: `&`, `|` and `~` of conditions
    **dict.fromkeys((np.logical_or, np.bitwise_or), ca.logic_or),
    **dict.fromkeys((np.logical_not, np.invert), ca.logic_not),
    np.isfinite: lambda a: ca.SX(1),  # equations need no such guard
    np.isnan: lambda a: ca.SX(0),
    np.isinf: lambda a: ca.SX(0),
}
# functions that are singular or undefined somewhere: the number of the argument, and a harmless value of it
SINGULAR: dict[Any, tuple[int, float]] = {
    np.divide: (1, 1.0),
    **dict.fromkeys((np.reciprocal, np.power, np.float_power, np.sqrt, np.cbrt), (0, 1.0)),
    **dict.fromkeys((np.log, np.log2, np.log10, np.log1p), (0, 1.0)),
    **dict.fromkeys((np.arcsin, np.arccos, np.arctanh), (0, 0.0)),
    np.arccosh: (0, 2.0),
}
FUNCTIONS: dict[Any, Rule] = {
    np.where: _where,
    np.clip: _clip,
    np.select: _select,
    np.interp: _interp,
    np.linalg.solve: _matrix(ca.solve),
    np.linalg.inv: _matrix(ca.inv),
    np.linalg.det: _matrix(ca.det),
}


WRITING = {np.copyto, np.put, np.place, np.putmask, np.fill_diagonal}  # functions that write into an array
for _name in ("zeros", "ones", "empty", "full"):
    FUNCTIONS[getattr(np, f"{_name}_like")] = _like(getattr(np, _name))


def writable(made: Any) -> Any:
    """Convert an array of floats to one that can hold symbols."""
    return array_of(made.astype(object)) if isinstance(made, np.ndarray) and made.dtype.kind == "f" else made
