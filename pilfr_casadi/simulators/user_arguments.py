"""Check what a user gives to a simulator: functions, names, parameters and ports.

A function gets the symbols that its arguments name. A fault is one sentence.
"""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import casadi as ca

from .._base import InputError, listed
from ..data import as_tuple
from ..models import Parameter, ParameterSet
from .ports import BUILT_IN, Expression, Port, kind_of


def call(function: Expression, name: str, **available: Any) -> Any:
    """Call a user's function with the available symbols that its arguments name; messages call it `name`."""
    try:
        arguments = inspect.signature(function).parameters.items()
    except (TypeError, ValueError):
        raise InputError(f"The {name} is {function!r}; give a function of {', '.join(available)} by name.") from None
    wanted = [
        key for key, p in arguments if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY) and p.default is p.empty
    ]
    for key in wanted:
        if key not in available:
            raise InputError(f"The {name} asks for {key!r}; it can have {', '.join(available)}.")
    try:
        with _quiet_numpy():
            return function(**{key: available[key] for key in wanted})
    except InputError as error:
        raise InputError(f"In the {name}: {error}") from None
    except Exception as error:
        if "truth value" in str(error):
            raise InputError(
                f"The {name} decides by the value of a symbol (if, and, or, min, max), which has none yet; "
                "use casadi.if_else, casadi.fmin and casadi.fmax."
            ) from error
        raise InputError(f"The {name} fails: {type(error).__name__}: {error}.") from error


@contextlib.contextmanager
def _quiet_numpy() -> Iterator[None]:
    """Let NumPy's functions give expressions of symbols without CasADi's notice that they may change one day."""
    noisy = ca.GlobalOptions.getNumpyMode() == 0
    if noisy:
        ca.GlobalOptions.setNumpyMode(-1)
    try:
        yield
    finally:
        if noisy:
            ca.GlobalOptions.setNumpyMode(0)


def as_scalar(value: Any, name: str) -> Any:
    """Return a number or an expression as a scalar expression; refuse anything else."""
    try:
        value = ca.SX(value)
    except Exception:
        raise InputError(f"The {name} gave {value!r}; give a number or a CasADi expression.") from None
    if value.shape != (1, 1):
        raise InputError(f"The {name} has the shape {value.shape}; give one number or expression.")
    return value


def as_scalars(found: Mapping[str, Any], where: str, kind: str) -> dict[str, Any]:
    """Return numbers or expressions by name as scalar expressions; messages call each `kind of name in the where`."""
    return {name: as_scalar(value, f"{kind} of {name!r} in the {where}") for name, value in found.items()}


def check_expressions(found: Mapping[str, Any], known: Any) -> None:
    """Refuse foreign symbols, and the NaN that `math.sin(symbol)` gives without an error."""
    names, expressions = list(found), list(found.values())
    f = ca.Function("equations", [known], expressions, {"allow_free": True})
    if f.has_free():
        raise InputError(f"The simulator's equations hold a symbol {f.get_free()[0]!r}; use x, u, p and t alone.")
    k = range(f.n_instructions())
    if any(f.instruction_id(i) == ca.OP_CONST and f.instruction_constant(i) != f.instruction_constant(i) for i in k):
        for name in names if len(names) > 1 else ():  # find the one
            check_expressions({name: found[name]}, known)
        raise InputError(
            f"The equation of {names[0]!r} holds NaN; use CasADi's functions on symbols, as in ca.sin(x.pos) rather "
            "than math.sin(x.pos), and check constants."
        )


def check_parameters(given: Any) -> ParameterSet:
    """Check a mapping of parameters by name and lay out their vector."""
    if not isinstance(given, Mapping):
        raise InputError(f"The simulator's parameters are {given!r}; give {{name: Parameter(value, ...)}}.")
    for name, value in given.items():
        if not isinstance(value, Parameter):
            raise InputError(f"The simulator's parameter {name!r} is {value!r}; give Parameter(value, ...).")
    return ParameterSet(dict(given))


def choose_parameters(
    given: Sequence[str] | Mapping[str, Parameter],
    bounds: Mapping[str, tuple[float, float]],
    make: Callable[[str, tuple[float, float] | None], Parameter],
) -> dict[str, Parameter]:
    """Return the parameters of an imported model: those given, and those with bounds, which are free.

    `make` makes a parameter of which no more than the name and perhaps bounds were given.
    """
    own = check_parameters(given if isinstance(given, Mapping) else {})
    made = {n: make(n, bounds.get(n)) for n in dict.fromkeys((*given, *bounds)) if n not in own}
    return {**own.free_within({n: ends for n, ends in bounds.items() if n in own}), **made}


def as_names(given: Any) -> Any:
    """Return a single name as a tuple, anything else unchanged."""
    return (given,) if isinstance(given, str) else given


def check_names(given: Any, kind: str) -> tuple[str, ...]:
    """Return one name or several as a tuple; refuse anything else, and repeated names."""
    names = as_tuple(given)
    if not all(isinstance(name, str) and name for name in names):
        raise InputError(f"The simulator's {kind} are {given!r}; give their names, such as ('pos', 'vel').")
    if len(set(names)) != len(names):
        raise InputError(f"The simulator's {kind} {', '.join(names)} are not unique; name each once.")
    return names


def check_ports(given: Any) -> tuple[Port, ...]:
    """Return one port or several as a tuple; refuse anything else, repeated names, and names of built-in ports."""
    ports = as_tuple(given)
    if not all(isinstance(port, Port) for port in ports):
        raise InputError(f"The simulator's ports are {given!r}; give Port(name, into, across) or a tuple of several.")
    names = [port.name for port in ports]
    if len(set(names)) != len(names):
        raise InputError(f"The port names {listed(names)} are not unique; name each port once.")
    for name in names:
        if kind_of(name):
            raise InputError(
                f"The port {name!r} is declared with a name that begins like those of the built-in ports "
                f"({', '.join(f'{kind}:' for kind in BUILT_IN)}), which need no declaration; call it something else."
            )
    return ports
