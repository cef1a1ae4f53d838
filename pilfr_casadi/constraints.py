"""Constraints on a model's named parameters, as CasADi expressions that every solver takes the same way.

`stable` bounds the spectral radius. For every matrix norm and every m, `ρ(A) <= ‖A^m‖^(1/m)`, with equality as m grows,
so

    (1/m) log ‖A^m‖_F <= log ρ_max,   m = 2^squarings,

is one smooth inequality that guarantees the bound exactly, at any point where it holds. Repeated squaring with the norm
taken out after each step keeps the numbers in range.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from .parameters import ParameterSet
from .recording import InputError


@dataclass(frozen=True, eq=False)
class Constraint:
    """`lower <= expression(p) <= upper`, p mapping parameter names to CasADi matrices.

    Parameters
    ----------
    expression : callable
        Takes the mapping of named parameters, returns a CasADi expression (column).
    lower, upper : float or array
        Bounds of the expression; equal for an equation.
    name : str
        How the constraint is called in results.
    """

    expression: Callable[[Mapping[str, Any]], Any]
    lower: Any = -np.inf
    upper: Any = np.inf
    name: str = "constraint"


def log_norm_of_power(matrix: Any, squarings: int = 20) -> Any:
    """`(1/m) log ‖A^m‖_F` with `m = 2^squarings`: an upper bound of `log ρ(A)`, smooth in A."""
    log_scale, power = 0.0, matrix
    for k in range(squarings + 1):
        if k:
            power = ca.mtimes(power, power)
        norm = ca.sqrt(ca.sumsqr(power) + 1e-300)
        log_scale = log_scale + ca.log(norm) / 2**k
        power = power / norm
    return log_scale


def linear_part(p: Mapping[str, Any]) -> Any:
    """The matrix `A`."""
    return p["A"]


@dataclass(frozen=True)
class LogRadius:
    """`log_norm_of_power` of a square matrix picked from the named parameters; a class, so that it can be pickled."""

    matrix: Callable[[Mapping[str, Any]], Any] = linear_part
    squarings: int = 20

    def __call__(self, p: Mapping[str, Any]) -> Any:
        """The expression for named parameters p."""
        return log_norm_of_power(self.matrix(p), self.squarings)


def stable(
    radius: float = 1.0, matrix: Callable[[Mapping[str, Any]], Any] = linear_part, name: str = "spectral radius"
) -> Constraint:
    """Spectral radius of `A` (or of another square expression of the parameters) at most `radius`.

    Raises
    ------
    InputError
        If the radius is not positive.
    """
    if not radius > 0:
        raise InputError(f"The spectral radius was bounded by {radius}; give a positive number.")
    return Constraint(LogRadius(matrix), upper=float(np.log(radius)), name=f"{name} <= {radius:g}")


def compile_constraints(
    constraints: tuple[Constraint, ...], parameters: ParameterSet
) -> tuple[ca.Function, ca.Function, np.ndarray, np.ndarray, tuple[str, ...]]:
    """One Function `p -> g`, its Jacobian, the bounds and a label an entry.

    Raises
    ------
    InputError
        If an expression fails, names an unknown parameter, or its bounds are infeasible.
    """
    vector = ca.MX.sym("p", parameters.size)
    named = parameters.symbols(vector)
    parts, lower, upper, labels = [], [np.zeros(0)], [np.zeros(0)], []
    for c in constraints:
        try:
            g = ca.vec(c.expression(named))
        except KeyError as e:
            raise InputError(
                f"The constraint {c.name!r} reads a parameter {e} that the model lacks; it has {', '.join(parameters)}."
            ) from e
        size = int(g.shape[0])
        try:
            low, high = (np.broadcast_to(np.asarray(b, dtype=float).ravel(), (size,)) for b in (c.lower, c.upper))
        except ValueError:
            raise InputError(
                f"The bounds of the constraint {c.name!r} do not fit its {size} entries; give one or {size} of each."
            ) from None
        if not np.all(low <= high):
            raise InputError(f"The constraint {c.name!r} is infeasible: its lower bound exceeds its upper bound.")
        parts.append(g)
        lower.append(low)
        upper.append(high)
        labels += [c.name if size == 1 else f"{c.name}[{i}]" for i in range(size)]
    g = ca.densify(ca.vertcat(*parts)) if parts else ca.MX(0, 1)
    value = ca.Function("g", [vector], [g], ["p"], ["g"])
    slope = ca.Function("g_slope", [vector], [ca.densify(ca.jacobian(g, vector))], ["p"], ["jac"])
    return value, slope, np.concatenate(lower), np.concatenate(upper), tuple(labels)
