"""Calls of functions that CasADi cannot look into: evaluated with numbers, differentiated along directions.

The equations hold a call of `r = f(z)`, and their derivatives call f too. Along a direction s they use the function's
own derivative `J(z) s` if it has one, else a difference

    (f(z + h s) - r) / h,   h = ε / Σ_j |s_j| / max(|z_j|, nominal_j),   ε = square root of the rounding.

So a sensitivity costs one call for each state and free parameter at each stage of the integration. Every result counts
as dependent on every argument. Second derivatives are zero: they matter only if a port has no given rate and its
coordinate is a nonlinear function of the states.

The program f is a Python function or a functional mock-up unit. Generated C cannot hold it and calls it by its name in
`programs`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from .._base import abandoned
from .fmu_instance import FmuSignals

RELATIVE_STEP = float(np.sqrt(np.finfo(float).eps))  # at this step rounding and curvature disturb a difference equally
NOMINAL = 1e-3  # size of an argument that is zero: small compared with values in SI units, far above rounding
ROUNDING = 1e-9  # relative difference that rounding may cause
TINY = 1e-100  # against division by zero along a direction of zeros
programs: dict[str, Program] = {}  # by name; CasADi itself does not keep callbacks alive
units: dict[str, FmuSignals] = {}  # of programs that are functional mock-up units


Expression = Callable[..., Any]


def external(evaluate: Expression, nominal: np.ndarray, results: int, slope: Expression | None = None) -> ca.Function:
    """Make a function that stays a call when symbols are given to it.

    Parameters
    ----------
    evaluate : callable
        From symbols z (n,) to the expression r (m,) that calls a program (`call_external`).
    nominal : array, (n,)
        Sizes of the arguments, which scale the differences if z is smaller.
    results : int
        m.
    slope : callable, optional
        From symbols z and s to `J(z) s`.

    Returns
    -------
    casadi.Function
        `z -> r`, with the reciprocal sizes of z behind r for the derivatives; `call_external` puts it into expressions.
    """
    n, m = len(nominal), results
    z, s, r, row = (ca.SX.sym(k, size) for k, size in (("z", n), ("s", n), ("r", m + n), ("l", m + n)))

    def along(s: Any) -> Any:
        if slope is not None:
            return slope(z, s)
        h = RELATIVE_STEP / (ca.dot(ca.fabs(s), r[m:]) + TINY)
        return (evaluate(z + h * s) - r[:m]) * (1 / h)

    def across(row: Any) -> Any:  # along each argument in turn: CasADi asks for it only if there are few results
        columns = [along(ca.SX(ca.DM(np.eye(n)[:, j]))) for j in range(n)]
        return ca.horzcat(*columns).T @ row[:m]

    none = ca.SX.zeros(n)
    # a slope changes with its direction; its change with z is neglected
    turned, slopes = ca.SX.sym("turned", n), ca.SX.sym("slopes", m + n)
    changes = [z, r, s, slopes, ca.SX.sym("dz", n), ca.SX.sym("dr", m + n), turned]
    cache = {
        "fwd1_fwd1_external": ca.Function("fwd1_fwd1_external", changes, [ca.vertcat(along(turned), none)]),
        "adj1_fwd1_external": ca.Function(
            "adj1_fwd1_external", [z, r, s, slopes, row], [none, ca.SX.zeros(m + n), across(row)]
        ),
    }
    forward = ca.Function("fwd1_external", [z, r, s], [ca.vertcat(along(s), none)], {"cache": cache})
    reverse = ca.Function("adj1_external", [z, r, row], [across(row)])
    # zero, but makes all results depend on all arguments: a program that states too few would lose derivatives
    dependence = ca.fmin(ca.fabs(ca.sum1(z)), 0.0)
    found = ca.vertcat(evaluate(z) + dependence, 1 / ca.fmax(ca.fabs(z), nominal))
    options = {"never_inline": True, "cache": {"fwd1_external": forward, "adj1_external": reverse}}
    return ca.Function("external", [z], [found], ["z"], ["r"], options)


def call_external(function: ca.Function, *arguments: Any) -> Any:
    """Call a function within SX expressions without writing out its formulas; stack its results."""
    return ca.vertcat(*function.call([ca.SX(a) for a in arguments], False, True))


def calls_external(function: ca.Function) -> bool:
    """Tell whether a function of SX expressions calls one that CasADi cannot look into."""
    return any(function.instruction_id(k) == ca.OP_CALL for k in range(function.n_instructions()))


def equal_state(values: np.ndarray, states: np.ndarray, names: Sequence[str]) -> str:
    """Return the name of the state that equals some values at all points, else ""; values (K,), states (K, n)."""
    same = np.all(np.abs(values[:, None] - states) <= ROUNDING * np.abs(states), axis=0) & np.any(states, axis=0)
    return names[int(np.argmax(same))] if np.any(same) else ""


class Program(ca.Callback):
    """Another program as a `casadi.Function`, from vectors of these `sizes` to one of `size` numbers."""

    def __init__(self, name: str, sizes: tuple[int, ...], size: int) -> None:
        ca.Callback.__init__(self)
        self.sizes, self.size = sizes, size
        self.construct(name, {})
        programs[name] = self

    def get_n_in(self) -> int:
        """Return the number of arguments, for CasADi; there is one result."""
        return len(self.sizes)

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Return the shape of an argument."""
        return ca.Sparsity.dense(self.sizes[i], 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Return the shape of the result."""
        return ca.Sparsity.dense(self.size, 1)

    def has_eval_buffer(self) -> bool:
        """Let CasADi pass its memory; matrices would cost more time than many functions do."""
        return True


class PythonFunction(Program):
    """A Python function of arrays as a `casadi.Function`; if it fails, its results are NaN.

    Attributes
    ----------
    calls : int
        How often it was called.
    failure : Exception or None
        Its first error.
    """

    def __init__(self, function: Callable[..., np.ndarray], sizes: tuple[int, ...], size: int) -> None:
        self.function, self.calls = function, 0
        self.failure: Exception | None = None
        super().__init__(f"python{len(programs)}", sizes, size)

    def eval_buffer(self, arguments: Sequence[memoryview], results: Sequence[memoryview]) -> int:
        """Call the function, for CasADi."""
        np.frombuffer(results[0])[:] = self.evaluate([np.frombuffer(a) for a in arguments])
        return 0

    def evaluate(self, arguments: list[np.ndarray]) -> np.ndarray:
        """Call the function; a failed point is a failed trial, not the end. In an abandoned run it is not called."""
        if abandoned.pending:
            return np.full(self.size, np.nan)
        self.calls += 1
        try:
            return self.function(*arguments)
        except Exception as error:
            self.failure = self.failure or error
            return np.full(self.size, np.nan)
