"""Simulators from NumPy functions, such as the right-hand side that is given to `scipy.integrate.solve_ivp`.

The function is called with symbols (`tracing`), which gives its equations. They are compared with the function itself
at random points. The simulator then has equations like any other, with exact derivatives and compiled code, and no
longer calls the function. With `numeric=Numeric()`, a function that cannot be traced is called with numbers instead
(`black_box`).
"""

from __future__ import annotations

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

from .._base import InputError, in_words, listed, one_line
from ..models import Named, Parameter, ParameterSet
from .black_box import BlackBox, Numeric, nominal_sizes
from .equations import stack
from .signature import read_signature
from .simulator import Simulator
from .symbols import NotTraceable, expression, symbols
from .tracing import Trace, accept_symbols, explore_paths
from .user_arguments import check_names, check_parameters

COMPARED_POINTS = 40  # at which the equations are compared with the function
SIZE_DECADES = (-3.0, 2.0)  # range of the powers of ten of states and inputs at these points, in their own units
PARAMETER_CHANGE = 0.1  # relative change of parameters between these points
AGREE = 1e-9  # relative difference that rounding may cause, because the order of operations can differ


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
        t is the time in s, x and u are arrays in the order of `states` and `inputs`, p is a mapping: `p["k"]`. Instead
        of u and p, inputs and parameters may be arguments by their names: `function(t, y, force, k)`.
    outputs : callable, or names of states
        `outputs(t, x, u, p)`, or with arguments by their names, returns `{output: value}`. A name, or a tuple of names,
        are states that are measured.
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
    if numeric is not None and not isinstance(numeric, Numeric):
        raise InputError(f"numeric={numeric!r} was given; give Numeric(), or leave it out.")
    names = _Names(*own)
    dynamics = _make_equations(_UserFunction(function, "derivatives", names), numeric)
    if not callable(outputs):
        measured: Any = _MeasuredStates(_check_measured_states(outputs, names.states))
    else:
        measured = _make_equations(
            _UserFunction(outputs, "outputs", names), numeric and replace(numeric, jacobian=None)
        )
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
        """Draw times, states, inputs and vectors of parameters within their bounds; the first point is rest.

        Every second point has positive states and inputs, such as levels and temperatures.
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
    rows: tuple[str, ...]
    parameters: tuple[str, ...]
    note: str

    def __call__(self, x: Named, u: Named, p: Named, t: Any) -> dict[str, Any]:
        own = Named("parameter", {n: p[n] for n in self.parameters})  # p holds the parameters of laws as well
        return dict(zip(self.rows, ca.vertsplit(self.traced(t, stack(x), stack(u), stack(own))), strict=True))


@dataclass(frozen=True)
class _MeasuredStates:
    states: tuple[str, ...]

    def __call__(self, x: Named) -> dict[str, Any]:
        return {n: x[n] for n in self.states}


class _UserFunction:
    """A user's function of t, x, u and p: the names of its values (`rows`), and the values at random points."""

    def __init__(self, function: Any, kind: str, names: _Names) -> None:
        self.function, self.kind, self.names = function, kind, names
        self.called = getattr(function, "__name__", type(function).__name__)
        self.rows = names.states if kind == "derivatives" else ()
        if not callable(function):
            raise InputError(f"{function!r} was given for the {kind}; give a function of t, x, u and p.")
        self.signature = read_signature(function, self.called, names.inputs, tuple(names.parameters))
        if kind == "derivatives":
            self.signature.check_driven()
        self.values = self._evaluate_at_points()

    def _evaluate_at_points(self) -> list[tuple[Any, np.ndarray]]:
        """Call the function with numbers; a function may fail at points outside its domain."""
        values, failed = [], None
        for point in self.names.points():
            try:
                with np.errstate(all="ignore"), warnings.catch_warnings(action="ignore"):
                    given = _read_only(point, self.names.parameters)
                    row = self.check_result(self.signature.call(self.function, *given))
                values.append((point, np.array(row, dtype=float)))
            except InputError:
                raise
            except Exception as error:
                failed = failed or error
        if failed is not None and (not values or _writes_into_arguments(failed)):
            raise InputError(self.describe_failure(failed)) from failed
        if not any(np.all(np.isfinite(row)) for _, row in values):
            raise InputError(
                f"{self.called} gives no finite numbers at any of {COMPARED_POINTS} points around zero; check its "
                "formulas."
            )
        return values

    def check_result(self, result: Any) -> list[Any]:
        """Return the values of a result in the order of `rows`; the first result of outputs gives their names."""
        called = self.called
        if self.kind == "outputs":
            if not isinstance(result, Mapping) or not result or not all(isinstance(n, str) for n in result):
                raise InputError(
                    f"{called} returned {_describe(result)}; the outputs are {{name: value}}, such as "
                    "{'position': x[0]}."
                )
            self.rows = self.rows or tuple(result)
            if set(self.rows) != set(result):
                raise InputError(
                    f"{called} returned the outputs {listed(list(result))}, and before {listed(self.rows)}."
                )
            result = [result[n] for n in self.rows]
        array = np.asarray(result, dtype=object)
        values = array.ravel().tolist()
        if len(values) != len(self.rows) or (array.ndim > 1 and max(array.shape) != array.size):
            count = f"{len(values)} value{'s' * (len(values) != 1)}" if array.ndim < 2 else _describe(array)
            raise InputError(
                f"{called} returned {count}; return one number for each of the {self.kind} {listed(self.rows)}."
            )
        values = [v.ravel()[0] if isinstance(v, np.ndarray) and v.size == 1 else v for v in values]
        for name, value in zip(self.rows, values, strict=True):
            if value is None or isinstance(value, str | complex | np.complexfloating | Mapping | Sequence | np.ndarray):
                raise InputError(f"{called} returned {_describe(value)} for {name!r}; return a number.")
        return values

    def compare(self, traced: ca.Function) -> None:
        """Refuse equations that differ from the function at a point where the function is finite."""
        for point, row in self.values:
            own = traced(*point).full().ravel()
            largest = np.max(np.abs(row[np.isfinite(row)]), initial=0.0)
            same = np.isclose(own, row, rtol=AGREE, atol=AGREE * 1e-2 * largest) | ~np.isfinite(row)
            if not np.all(same):
                i = int(np.argmin(same))
                t, x, u, _ = point
                raise InputError(
                    f"{self.called} gives {row[i]:.8g} for {self.rows[i]!r} and its equations {own[i]:.8g} (t = "
                    f"{t:.4g}, x = {_format(x)}, u = {_format(u)}); a function with memory, random numbers or a test "
                    "of types cannot be followed: write the equations in CasADi as a Simulator."
                )

    def describe_failure(self, error: BaseException, symbolic: bool = False) -> str:
        """Describe an error of the function with its line; `symbolic` says that symbols were given to it."""
        place = f"{self.called} ({_find_user_line(error)})"
        if isinstance(error.__cause__, NotTraceable):  # compiled code wraps it in an error of its own
            error = error.__cause__
        if isinstance(error, NotTraceable):
            return f"{place} {error}, or write the equations in CasADi as a Simulator."
        if _writes_into_arguments(error):
            return f"{place} writes into its arguments; make a new array, as in y = np.array([...])."
        parameters = self.names.parameters
        if isinstance(error, KeyError) and error.args and error.args[0] not in parameters:
            known = listed(list(parameters)) or "none"
            return f"{place} asks for the parameter {error.args[0]!r}; there are {known}."
        said = one_line(f"{type(error).__name__}: {error}").rstrip(".: ")
        if symbolic:
            return (
                f"{place} fails with symbols in place of numbers, for which every branch is entered ({said}); use "
                "arithmetic and functions of NumPy (np.interp for tables), leave out checks, give numeric=Numeric(...) "
                "for solvers, or write the equations in CasADi as a Simulator."
            )
        return f"{place} fails with numbers ({said}); {self.signature.describe()}."


def _make_equations(own: _UserFunction, numeric: Numeric | None) -> _Equations | BlackBox:
    """Find the equations of a function, or make equations that call it with numbers."""
    return _trace(own) if numeric is None else _make_black_box(own, numeric)


def _trace(own: _UserFunction) -> _Equations:
    """Find the equations of a function, check them, and note how often it was called."""
    names, kind = own.names, own.kind
    t, x, u = ca.SX.sym("t"), ca.SX.sym("x", len(names.states)), ca.SX.sym("u", len(names.inputs))
    p = ca.SX.sym("p", names.parameters.size)
    accepting = accept_symbols(own.function)

    def call(trace: Trace) -> Any:
        parameters = {
            n: symbols(v, names.parameters[n].value.shape, trace) for n, v in names.parameters.symbols(p).items()
        }
        arrays = symbols(x, x.shape[:1], trace), symbols(u, u.shape[:1], trace)
        given = symbols(t, (), trace), *arrays, types.MappingProxyType(parameters)
        result = own.signature.call(accepting, *given)
        return ca.vertcat(ca.SX(0, 1), *map(expression, own.check_result(result)))

    try:
        equations, calls = explore_paths(call, ca.vertcat(t, x, u))
    except InputError:
        raise
    except Exception as error:
        raise InputError(own.describe_failure(error, symbolic=True)) from error
    traced = ca.Function(kind, [t, x, u, p], [equations], ["t", "x", "u", "p"], [kind])
    own.compare(traced)
    times = f"{calls + COMPARED_POINTS} times ({calls} for its branches, {COMPARED_POINTS} as a check)"
    return _Equations(traced, own.rows, tuple(names.parameters), f"{kind}: equations of {own.called}; called {times}")


def _make_black_box(own: _UserFunction, numeric: Numeric) -> BlackBox:
    """Make equations that call a function with numbers."""
    function, signature, kind, names, rows = own.function, own.signature, own.kind, own.names, own.rows
    every = (*names.states, *names.inputs, *names.parameters)
    counts = [*(1 for _ in (*names.states, *names.inputs)), *(p.size for p in names.parameters.values())]
    sizes = nominal_sizes(numeric.nominal, every, counts)
    at = np.cumsum([1, len(names.states), len(names.inputs)])
    latest: list[Any] = [b"", None]  # parameters change once in a run

    def arguments(z: np.ndarray) -> tuple[Any, ...]:
        if (key := z[at[2] :].tobytes()) != latest[0] or latest[1] is None:
            latest[:] = key, _read_only((0.0, z[:0], z[:0], z[at[2] :]), names.parameters)[3]
        return float(z[0]), z[1 : at[1]].copy(), z[at[1] : at[2]].copy(), latest[1]

    def evaluate(z: np.ndarray) -> np.ndarray:
        result = signature.call(function, *arguments(z))
        result = [result[n] for n in rows] if kind == "outputs" else result
        return np.array(result, dtype=float).reshape(len(rows))

    jacobian = numeric.jacobian
    its_own = None if jacobian is None else read_signature(jacobian, "jacobian", names.inputs, tuple(names.parameters))
    slope = None if its_own is None else (lambda z: its_own.call(jacobian, *arguments(z)))
    made = BlackBox(evaluate, own.called, rows, (names.states, names.inputs, tuple(names.parameters)), slope, sizes)
    made.points = [(np.hstack(point), row) for point, row in own.values if np.all(np.isfinite(row))]
    return made


def _read_only(point: tuple[float, np.ndarray, np.ndarray, np.ndarray], parameters: ParameterSet) -> tuple[Any, ...]:
    """Make the arguments t, x, u and p of a function, which it cannot write into."""
    t, x, u, p = point
    x, u = x.copy(), u.copy()
    values = parameters.unpack(p)
    for array in (x, u, *values.values()):
        array.flags.writeable = False
    own = {name: value if value.ndim else float(value) for name, value in values.items()}
    return t, x, u, types.MappingProxyType(own)


def _describe(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    return "None" if value is None else f"a {type(value).__name__}"


def _format(values: np.ndarray) -> str:
    return np.array2string(values, precision=4, threshold=6, separator=", ").replace("\n", "")


def _writes_into_arguments(error: BaseException) -> bool:
    return "read-only" in str(error) or "does not support item assignment" in str(error)


def _find_user_line(error: BaseException) -> str:
    """Return the deepest line of the user's code in the traceback of an error."""
    ours = (str(Path(__file__).resolve().parents[1]), sysconfig.get_path("purelib"), sysconfig.get_path("stdlib"))
    steps = [(f.f_code.co_filename, n) for f, n in traceback.walk_tb(error.__traceback__)]
    own = [(file, n) for file, n in steps if not file.startswith((*ours, "<__array")) and "site-packages" not in file]
    if not own:
        return "in code that is not Python"
    file, line = own[-1]
    source = linecache.getline(file, line).strip()
    return f"{Path(file).name}, line {line}" + (f": `{source[:80]}`" if source else "")


def _check_measured_states(given: Any, states: tuple[str, ...]) -> tuple[str, ...]:
    names = (given,) if isinstance(given, str) else given
    if not isinstance(names, list | tuple) or not names or not all(n in states for n in names):
        raise InputError(
            f"The outputs are {given!r}; give a function of t, x, u and p that returns {{output: value}}, or names of "
            f"the states {in_words(states)}."
        )
    return tuple(names)
