"""Simulators from NumPy functions, such as the right-hand side that is given to `scipy.integrate.solve_ivp`.

The function is called with symbols (`tracing`), which gives its equations. They are compared with the function itself
at random points. From then on the simulator has equations like any other, with exact derivatives and compiled code, and
the function is not called any more. A function that cannot be followed stays as it is with `symbolic=False`
(`black_box`).
"""

from __future__ import annotations

import inspect
import linecache
import sysconfig
import traceback
import types
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, in_words, listed
from ..models import Named, Parameter, ParameterSet
from .black_box import BlackBox, Numeric, nominal_sizes
from .equations import check_names, check_parameters
from .simulator import Simulator
from .symbols import NotFollowed, expression, symbols
from .tracing import Trace, accept_symbols, follow

COMPARED_POINTS = 40  # at which the equations are compared with the function
SIZE_DECADES = (-3.0, 2.0)  # powers of ten between which the sizes of states and inputs are drawn, in their own units
PARAMETER_CHANGE = 0.1  # relative change of parameters between these points
AGREE = 1e-9  # relative difference that rounding may cause; the order of operations can differ
ARGUMENTS = ("t", "x", "u", "p")


def from_function(
    function: Callable[..., Any],
    outputs: Any,
    *,
    states: Any,
    inputs: Any = (),
    parameters: Mapping[str, Parameter] | None = None,
    ports: Any = (),
    hold: str | None = None,
    discrete: bool = False,
    units: Mapping[str, str] | None = None,
    numeric: Numeric | None = None,
) -> Simulator:
    """Make a simulator from a NumPy function.

    Parameters
    ----------
    function : callable
        `function(t, x, u, p)` returns the derivatives of the states, in the order of `states`, as a list or an array.
        t is the time in s, x and u are arrays in the order of `states` and `inputs`, p is a mapping: `p["k"]`.
    outputs : callable, or names of states
        `outputs(t, x, u, p)` returns `{output: value}`. A name, or a tuple of names, are states that are measured.
    states, inputs : tuple of str
        Names.
    parameters : mapping
        `Parameter` by name.
    ports, hold, discrete, units
        As of `Simulator`; ports use `x.<state>`, `u.<input>`, `p.<parameter>`. With `discrete` the function returns the
        next sample's states.
    numeric : Numeric, optional
        Call the function with numbers at every step, instead of finding its equations: for compiled libraries, maps and
        solvers. It must not have memory or random numbers. A fit then takes as long as its calls do.

    Returns
    -------
    Simulator
        With the function's equations. Its print says how often the function was called to find and check them; with
        `numeric`, how often it has been called.

    Raises
    ------
    InputError
        If the function fails, returns another number of values, writes into its arguments, or uses an operation that
        has no symbolic counterpart; with the line of the function and what to write instead.

    Notes
    -----
    Derivatives of both results of a choice are evaluated. They stay finite for `if h > 0: q = np.sqrt(h)`, and not for
    `np.where(h > 0, np.sqrt(h), 0)` where h is zero or less.

    Examples
    --------
    >>> def rhs(t, x, u, p):
    ...     pos, vel = x
    ...     return [vel, (u[0] - p["k"] * pos - np.sign(vel)) / 2.0]
    >>> simulator = from_function(rhs, "pos", states=("pos", "vel"), inputs="force", parameters={"k": Parameter(9.0)})
    >>> simulator.output_names
    ('pos',)
    """
    own = check_names(states, "states"), check_names(inputs, "inputs"), check_parameters(parameters or {})
    if not own[0]:
        raise InputError("No states were given; give their names, such as ('pos', 'vel').")
    names = _Names(*own)
    dynamics = _made(function, "derivatives", names, names.states, numeric)
    if not callable(outputs):
        measured: Any = _MeasuredStates(_measured(outputs, names.states))
    else:
        measured = _made(outputs, "outputs", names, None, numeric and replace(numeric, jacobian=None))
    for made in (dynamics, measured):
        if isinstance(made, BlackBox) and not (discrete and made is dynamics):
            made.find_equal_states()
    return Simulator(dynamics, measured, *own, ports, hold, discrete, units=units or {})


@dataclass(frozen=True)
class _Names:
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    parameters: ParameterSet

    def points(self) -> list[tuple[float, np.ndarray, np.ndarray, np.ndarray]]:
        """Draw times, states, inputs and vectors of parameters within their bounds; the first is rest.

        Every second one has positive states and inputs, as levels and temperatures have.
        """
        own, rng = self.parameters, np.random.default_rng(0)
        sizes, drawn = (len(self.states), len(self.inputs)), []
        for i in range(1, COMPARED_POINTS):
            x, u = (10 ** rng.uniform(*SIZE_DECADES) * rng.standard_normal(n) for n in sizes)
            change = PARAMETER_CHANGE * np.where(own.start == 0, 1.0, own.start) * rng.uniform(-1, 1, own.size)
            p = np.clip(own.start + change, own.lower, own.upper)
            drawn.append((float(rng.uniform(0, 10)), *((np.abs(x), np.abs(u)) if i % 2 else (x, u)), p))
        return [(0.0, np.zeros(sizes[0]), np.zeros(sizes[1]), own.start), *drawn]


@dataclass(frozen=True, eq=False)
class _Equations:
    """The equations of a function, called as the dynamics or outputs of a `Simulator`."""

    traced: ca.Function
    found: tuple[str, ...]
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    parameters: tuple[str, ...]
    note: str

    def __call__(self, x: Named, u: Named, p: Named, t: Any) -> dict[str, Any]:
        values = [x[n] for n in self.states], [u[n] for n in self.inputs], [ca.vec(p[n]) for n in self.parameters]
        stack = (ca.vertcat(ca.SX(0, 1), *each) for each in values)
        return dict(zip(self.found, ca.vertsplit(self.traced(t, *stack)), strict=True))


@dataclass(frozen=True)
class _MeasuredStates:
    states: tuple[str, ...]

    def __call__(self, x: Named) -> dict[str, Any]:
        return {n: x[n] for n in self.states}


def _made(
    function: Any, kind: str, names: _Names, found: tuple[str, ...] | None, numeric: Numeric | None
) -> _Equations | BlackBox:
    """Find the equations of a function, or make one that is called with numbers."""
    if numeric is None:
        return _equations(function, kind, names, found)
    called = getattr(function, "__name__", type(function).__name__)
    _check_arguments(function, called, kind)
    rows, values = _evaluate(function, called, kind, names, found)
    every = (*names.states, *names.inputs, *names.parameters)
    counts = [*(1 for _ in (*names.states, *names.inputs)), *(p.size for p in names.parameters.values())]
    sizes = nominal_sizes(numeric.nominal, every, counts)
    at = np.cumsum([1, len(names.states), len(names.inputs)])

    latest: list[Any] = [b"", None]  # parameters change once in a run

    def arguments(z: np.ndarray) -> tuple[Any, ...]:
        if (key := z[at[2] :].tobytes()) != latest[0] or latest[1] is None:
            latest[:] = key, _numbers((0.0, z[:0], z[:0], z[at[2] :]), names.parameters)[3]
        return float(z[0]), z[1 : at[1]].copy(), z[at[1] : at[2]].copy(), latest[1]

    def evaluate(z: np.ndarray) -> np.ndarray:
        result = function(*arguments(z))
        result = [result[n] for n in rows] if kind == "outputs" else result
        return np.array(result, dtype=float).reshape(len(rows))

    by, own = numeric.jacobian, (names.states, names.inputs, tuple(names.parameters))
    made = BlackBox(evaluate, called, rows, own, None if by is None else (lambda z: by(*arguments(z))), sizes)
    made.points = [(np.hstack(point), row) for point, row in values if np.all(np.isfinite(row))]
    return made


def _equations(function: Any, kind: str, names: _Names, found: tuple[str, ...] | None) -> _Equations:
    """Find the equations of a function, check them, and say how often it was called."""
    called = getattr(function, "__name__", type(function).__name__)
    _check_arguments(function, called, kind)
    found, values = _evaluate(function, called, kind, names, found)
    t, x, u = ca.SX.sym("t"), ca.SX.sym("x", len(names.states)), ca.SX.sym("u", len(names.inputs))
    p = ca.SX.sym("p", names.parameters.size)
    accepting = accept_symbols(function)

    def call(trace: Trace) -> Any:
        own = {n: symbols(v, names.parameters[n].value.shape, trace) for n, v in names.parameters.symbols(p).items()}
        arrays = symbols(x, x.shape[:1], trace), symbols(u, u.shape[:1], trace)
        result = accepting(symbols(t, (), trace), *arrays, types.MappingProxyType(own))
        return ca.vertcat(ca.SX(0, 1), *map(expression, _row(result, found, called, kind)[1]))

    try:
        equations, calls = follow(call, ca.vertcat(t, x, u))
    except InputError:
        raise
    except Exception as error:
        raise InputError(_failure(called, error, names, followed=True)) from error
    traced = ca.Function(kind, [t, x, u, p], [equations], [*ARGUMENTS], [kind])
    for point, row in values:
        _compare(traced, point, row, found, called)
    times = f"{calls + COMPARED_POINTS} times ({calls} for its branches, {COMPARED_POINTS} as a check)"
    note = f"{kind}: equations of {called}; called {times}"
    return _Equations(traced, found, names.states, names.inputs, tuple(names.parameters), note)


def _evaluate(
    function: Any, called: str, kind: str, names: _Names, found: tuple[str, ...] | None
) -> tuple[tuple[str, ...], list[tuple[Any, np.ndarray]]]:
    """Call the function with numbers; return the names of its values, and the points with the values there."""
    values, failed = [], None
    for point in names.points():  # outside of its domain a function may fail
        try:
            with np.errstate(all="ignore"), warnings.catch_warnings(action="ignore"):
                found, row = _row(function(*_numbers(point, names.parameters)), found, called, kind)
            values.append((point, np.array(row, dtype=float)))
        except InputError:
            raise
        except Exception as error:
            failed = failed or error
    if failed is not None and (not values or _writes(failed)):
        raise InputError(_failure(called, failed, names)) from failed
    if found is None or not any(np.all(np.isfinite(row)) for _, row in values):
        raise InputError(
            f"{called} gives no finite numbers at any of {COMPARED_POINTS} points around zero; check its formulas."
        )
    return found, values


def _numbers(point: tuple[float, np.ndarray, np.ndarray, np.ndarray], parameters: ParameterSet) -> tuple[Any, ...]:
    t, x, u, p = point
    x, u = x.copy(), u.copy()
    own: dict[str, Any] = {}
    for name, value in parameters.unpack(p).items():
        value.flags.writeable = False
        own[name] = value if value.ndim else float(value)
    for array in (x, u):
        array.flags.writeable = False
    return t, x, u, types.MappingProxyType(own)


def _row(result: Any, found: tuple[str, ...] | None, called: str, kind: str) -> tuple[tuple[str, ...], list[Any]]:
    """Return the names and values of a result."""
    if kind == "outputs":
        if not isinstance(result, Mapping) or not result or not all(isinstance(n, str) for n in result):
            raise InputError(
                f"{called} returned {_what(result)}; the outputs are {{name: value}}, such as {{'position': x[0]}}."
            )
        if found is not None and set(found) != set(result):
            raise InputError(f"{called} returned the outputs {listed(list(result))}, and before {listed(found)}.")
        found = found or tuple(result)
        result = [result[n] for n in found]
    assert found is not None
    array = np.asarray(result, dtype=object)
    values = array.ravel().tolist()
    if len(values) != len(found) or (array.ndim > 1 and max(array.shape) != array.size):
        count = f"{len(values)} value{'s' * (len(values) != 1)}" if array.ndim < 2 else _what(array)
        raise InputError(f"{called} returned {count}; return one number for each of the {kind} {listed(found)}.")
    for name, value in zip(found, values, strict=True):
        if isinstance(value, np.ndarray) and value.size == 1:
            value = value.ravel()[0]
        if value is None or isinstance(value, str | complex | np.complexfloating | Mapping | Sequence | np.ndarray):
            raise InputError(f"{called} returned {_what(value)} for {name!r}; return a number.")
    return found, [v.ravel()[0] if isinstance(v, np.ndarray) else v for v in values]


def _what(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    return "None" if value is None else f"a {type(value).__name__}"


def _compare(traced: ca.Function, point: Any, row: np.ndarray, found: tuple[str, ...], called: str) -> None:
    own = traced(*point).full().ravel()
    largest = np.max(np.abs(row[np.isfinite(row)]), initial=0.0)
    for name, value, other in zip(found, row, own, strict=True):
        same = np.isclose(other, value, rtol=AGREE, atol=AGREE * 1e-2 * largest, equal_nan=True)
        if not same and np.isfinite(value):  # where it is not, the function is outside of its domain
            raise InputError(
                f"{called} gives {value:.8g} for {name!r} and its equations {other:.8g} (t = {point[0]:.4g}, "
                f"x = {_short(point[1])}, u = {_short(point[2])}); a function with memory, random numbers or a test of "
                "types cannot be followed: write the equations in CasADi as a Simulator."
            )


def _short(values: np.ndarray) -> str:
    return np.array2string(values, precision=4, threshold=6, separator=", ").replace("\n", "")


def _writes(error: BaseException) -> bool:
    return "read-only" in str(error) or "does not support item assignment" in str(error)


def _failure(called: str, error: BaseException | None, names: _Names, followed: bool = False) -> str:
    """Describe an error of the user's function with its line."""
    assert error is not None
    place = f"{called} ({_place(error)})"
    if isinstance(error, NotFollowed):
        return f"{place} {error}, or write the equations in CasADi as a Simulator."
    if _writes(error):
        return f"{place} writes into its arguments; make a new array, as in y = np.array([...])."
    if isinstance(error, KeyError) and error.args and error.args[0] not in names.parameters:
        known = listed(list(names.parameters)) or "none"
        return f"{place} asks for the parameter {error.args[0]!r}; there are {known}."
    said = f"{type(error).__name__}: {' '.join(str(error).split())[:160]}".rstrip(".: ")
    if followed:
        return (
            f"{place} fails with symbols in place of numbers, for which every branch is entered ({said}); use "
            "arithmetic and functions of NumPy (np.interp for tables), leave out checks, or write the equations in "
            "CasADi as a Simulator."
        )
    return f"{place} fails with numbers ({said}); it is called as {called}(t, x, u, p) with p[name]."


def _place(error: BaseException) -> str:
    """Return the deepest line of the user's code in the traceback of an error."""
    ours = (str(Path(__file__).resolve().parents[1]), sysconfig.get_path("purelib"), sysconfig.get_path("stdlib"))
    steps = [(f.f_code.co_filename, n) for f, n in traceback.walk_tb(error.__traceback__)]
    own = [(file, n) for file, n in steps if not file.startswith((*ours, "<__array")) and "site-packages" not in file]
    if not own:
        return "in code that is not Python"
    file, line = own[-1]
    source = linecache.getline(file, line).strip()
    return f"{Path(file).name}, line {line}" + (f": `{source[:80]}`" if source else "")


def _check_arguments(function: Any, called: str, kind: str) -> None:
    if not callable(function):
        raise InputError(f"{function!r} was given for the {kind}; give a function of t, x, u and p.")
    try:
        inspect.signature(getattr(function, "py_func", function)).bind(*ARGUMENTS)
    except (TypeError, ValueError):
        raise InputError(f"{called} cannot be called as {called}(t, x, u, p); give a function of these four.") from None


def _measured(given: Any, states: tuple[str, ...]) -> tuple[str, ...]:
    names = (given,) if isinstance(given, str) else given
    if not isinstance(names, list | tuple) or not names or not all(n in states for n in names):
        raise InputError(
            f"The outputs are {given!r}; give a function of t, x, u and p that returns {{output: value}}, or names of "
            f"the states {in_words(states)}."
        )
    return tuple(names)
