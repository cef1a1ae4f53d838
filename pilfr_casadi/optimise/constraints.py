"""Constraints on a model's named parameters: CasADi expressions with limits, the same for every solver.

`stable` bounds the spectral radius. For every matrix norm and every m, `ρ(A) <= ‖A^m‖^(1/m)`, with equality as m grows,
so

    (1/m) log ‖A^m‖_F <= log ρ_max,   m = 2^squarings,

is one smooth inequality that guarantees the bound wherever it holds. Repeated squaring, with a division by the norm
after each step, keeps the numbers in range. Where eigenvalues coincide (a double integrator) the powers grow as
m^(n-1) and the left-hand side exceeds `log ρ(A)` by up to `(n - 1) log(m) / m`, 1.3e-5 (n - 1) here, with slopes of the
size of m. `stable` therefore has a slack, and a violation as small as that slack is no failure of a solver.
`stability_limits` names the matrices of a PI-LFR that a fit bounds: `A`, and `A` with the element moving along its
slope.

An `exact` constraint has neither slack nor tolerance: it is checked on the numbers of the result, a spectral radius by
its eigenvalues. `exact_limits` solves with such constraints.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, filled, numbers, quote_error
from ..linear import spectral_radius
from ..models import (
    PILFR,
    GeneralizedPlay,
    ParameterSet,
    Play,
    PrandtlIshlinskii,
    Stop,
    element_slopes,
    unknown_slope,
    with_port_gain,
)

FEASIBILITY_TOLERANCE = 1e-6  # violation, in units of a constraint, up to which the constraint counts as met
LARGEST_UNIT, SMALLEST_UNIT = 100.0, 1e-6  # a unit is at most 100 limits, at least this share of the change
LOG_RADIUS_UNIT = 100.0  # unit of log ρ: a violation of 1e-4 is tolerated
SLACK = 1e-4  # share by which `stable` lets the radius exceed its limit
LOG_RADIUS_MARGIN = 2e-7  # margin on log ρ of an exact bound, wider than the tolerance of solvers


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
        Name of the constraint in results.
    unit : float, optional
        Unit of violations. By default the largest change of the expression that one variable causes when it changes by
        its own size, so that physical units do not matter, but at most a hundred times the limit, so that a small limit
        is met to 1e-4 of itself.
    exact : bool
        Whether the limits hold on the numbers of the result, not up to a solver's tolerance; for inequalities.
    check : callable, optional
        For an exact constraint: how far named numbers violate the limit, in another measure than the expression (0 or
        less: not at all). `stable` uses the eigenvalues.
    """

    expression: Callable[[Mapping[str, Any]], Any]
    lower: Any = -np.inf
    upper: Any = np.inf
    name: str = "constraint"
    unit: float | None = None
    exact: bool = False
    check: Callable[[Mapping[str, Any]], float] | None = None


def log_norm_of_power(matrix: Any, squarings: int = 20) -> Any:
    """Compute `(1/m) log ‖A^m‖_F` with `m = 2^squarings`: an upper bound of `log ρ(A)`, smooth in A."""
    log_scale, power = 0.0, matrix
    for k in range(squarings + 1):
        if k:
            power = ca.mtimes(power, power)
        norm = ca.sqrt(ca.sumsqr(power) + 1e-300)
        log_scale = log_scale + ca.log(norm) / 2**k
        power = power / norm
    return log_scale


def linear_part(p: Mapping[str, Any]) -> Any:
    """Return the matrix `A`."""
    return p["A"]


@dataclass(frozen=True)
class LogRadius:
    """`log_norm_of_power` of a square matrix of the named parameters; a class, because it has to be pickled."""

    matrix: Callable[[Mapping[str, Any]], Any] = linear_part

    def __call__(self, p: Mapping[str, Any]) -> Any:
        """Return the expression for named parameters p."""
        return log_norm_of_power(self.matrix(p))


@dataclass(frozen=True)
class RadiusExcess:
    """Excess of the largest eigenvalue of a square matrix of named numbers over a radius."""

    radius: float
    matrix: Callable[[Mapping[str, Any]], Any] = linear_part

    def __call__(self, p: Mapping[str, Any]) -> float:
        """Return the excess; 0 or less where the bound holds."""
        return spectral_radius(np.asarray(ca.DM(self.matrix({k: ca.DM(v) for k, v in p.items()})))) - self.radius


def stable(
    radius: float = 1.0,
    matrix: Callable[[Mapping[str, Any]], Any] = linear_part,
    name: str = "spectral radius",
    exact: bool = False,
) -> Constraint:
    """Bound the spectral radius of `A` (or of another square expression of the parameters) by `radius`.

    The bound is `radius (1 + SLACK)`: without slack no solver could meet a limit of 1 at a double integrator. With
    `exact` it is the radius itself, checked on the eigenvalues of the result, which may stop up to three digits inside.

    Raises
    ------
    InputError
        If the radius is not positive.
    """
    if not radius > 0:
        raise InputError(f"A bound of {radius} on the spectral radius was given; give a number above zero.")
    limit = float(np.log(radius) + (-LOG_RADIUS_MARGIN if exact else np.log1p(SLACK)))
    check = RadiusExcess(radius, matrix) if exact else None
    return Constraint(
        LogRadius(matrix), upper=limit, name=f"{name} <= {radius:.12g}", unit=LOG_RADIUS_UNIT, exact=exact, check=check
    )


def loosen_radii(constraints: Sequence[Constraint], least: float = 0.0) -> tuple[Constraint, ...]:
    """Replace each exact bound on a spectral radius of `least` or more by a bound of at least 1 with a slack."""
    return tuple(
        stable(max(c.check.radius, 1.0), c.check.matrix, c.name.partition(" <=")[0])
        if c.exact and isinstance(c.check, RadiusExcess) and c.check.radius >= least
        else c
        for c in constraints
    )


def closed_loop_matrix(element: Any, slope: str, p: Mapping[str, Any]) -> Any:
    """Return `A + B_w S C_z` for one of an element's slopes S by its name."""
    return p["A"] + p["B_w"] @ element_slopes(element, p)[slope] @ p["C_z"]


def stability_limits(structure: PILFR, bound: bool | float) -> tuple[Constraint, ...]:
    """Bound the spectral radius of A, and of `A + B_w S C_z` for each slope S of the element, as `fit(stable=bound)`.

    For plays the two cases are that no operator slips, or all do (for stops: all stick).
    """
    if bound is False:
        return ()
    if not isinstance(bound, bool | int | float | np.number) or not np.isfinite(bound):
        raise InputError(f"stable = {bound!r} was given; give True, False or the largest spectral radius, above zero.")
    if structure.nx == 0:
        return ()
    limits = [stable(float(bound), exact=True)]
    element = structure.element
    if element is not None:
        symbols = {name: ca.MX.sym(name, *p.shape) for name, p in element.parameters().items()}
        for slope in element_slopes(element, symbols):
            name = f"spectral radius with the element's {slope}"
            matrix = partial(closed_loop_matrix, element, slope)  # unlike a lambda it can be pickled
            limits.append(stable(float(bound), matrix, name, exact=True))
    return tuple(limits)


def describe_unbounded(structure: PILFR | None, constraints: Iterable[Constraint], p: Mapping[str, Any]) -> str:
    """Describe the motions of an element in feedback that the bounds on radii do not cover at the values p, if any."""
    radii = [c.check.radius for c in constraints if isinstance(c.check, RadiusExcess)]
    element = structure.element if structure else None
    if element is None or not radii or not np.any(np.sum(np.abs(p["C_z"]), axis=1) * np.sum(np.abs(p["B_w"]), axis=0)):
        return ""
    if unknown_slope(element, p):
        return (
            "the spectral radius is bounded for the linear part alone, because the slope of the element in feedback is "
            "unknown (as for user-defined envelopes); judge stability by simulations beyond the recorded amplitudes"
        )
    if not isinstance(element, PrandtlIshlinskii) or not isinstance(element.operator, GeneralizedPlay):
        return ""
    worst = 0.0
    for side in "lr":
        slope = np.diag(np.sum(p["w"], axis=1) * element.operator.steepest(side, p))
        worst = max(worst, spectral_radius(p["A"] + p["B_w"] @ slope @ p["C_z"]))
    if worst <= min(radii):
        return ""
    return (
        f"where an envelope is steepest the spectral radius is {worst:.4g}, above its bound of {min(radii):g}, which "
        "holds far out: small motions there may grow until the envelope is flatter"
    )


def check_radius_bounds(parameters: ParameterSet, limits: Iterable[Constraint]) -> None:
    """Refuse bounds on the entries of A between which no A has the required spectral radius."""
    radii = [c.check.radius for c in limits if isinstance(c.check, RadiusExcess) and c.check.matrix is linear_part]
    if not radii or "A" not in parameters or np.all(parameters["A"].fixed):
        return
    a = parameters["A"]
    low, high = (np.where(a.fixed, a.value, bound) for bound in a.bounds)
    least = least_radius(low, high)
    if least > min(radii):
        entries = low[~a.fixed], high[~a.fixed]
        raise InputError(
            f"The bounds of A, {np.min(entries[0]):g} to {np.max(entries[1]):g}, allow no spectral radius below "
            f"{least:g}, and it is to be at most {min(radii):g} so that the model is stable; widen the bounds of A, or "
            "in Python give stable=False for a model that may grow without end."
        )


def least_radius(low: np.ndarray, high: np.ndarray) -> float:
    """Compute a lower bound on the spectral radius of all matrices between `low` and `high` (n, n), entry by entry.

    Uses `ρ(A) >= |trace A| / n` and, where `low >= 0`, `ρ(A) >= ρ(low)` (Perron and Frobenius).
    """
    low_trace, high_trace = float(np.trace(low)), float(np.trace(high))
    least = max(low_trace, -high_trace, 0.0) / max(len(low), 1)
    for bound, sign in ((low, 1.0), (high, -1.0)):
        if np.all(np.isfinite(bound)) and np.all(sign * bound >= 0):
            least = max(least, spectral_radius(bound))
    return least


def _evaluate(function: ca.Function, *arguments: Any) -> np.ndarray:
    """Evaluate the first output of a function; nan if CasADi raises because a matrix is singular."""
    try:
        return np.asarray(function.call(arguments)[0])
    except RuntimeError:
        return np.full(function.size_out(0), np.nan)


class Rows:
    """The constraints of a problem as one Function `p -> g` of the full parameter vector p, shape (n_p,).

    `lower`, `upper` and `units` (nan where none was given) have shape (n_g,). `labels` has one name per entry, `sizes`
    the number of entries of each constraint.
    """

    def __init__(self, constraints: tuple[Constraint, ...], parameters: ParameterSet) -> None:
        vector, p = ca.MX.sym("p", parameters.size), parameters.start
        symbols, values = parameters.symbols(vector), parameters.unpack(p)
        parts, bounds = [ca.MX(0, 1)], [np.zeros((3, 0))]
        self.labels: tuple[str, ...] = ()
        for c in constraints:
            part = _expression(c, symbols)
            size = int(part.shape[0])
            parts.append(part)
            bounds.append(_limits(c, size))
            self.labels += (c.name,) if size == 1 else tuple(f"{c.name}[{i}]" for i in range(size))
        self.sizes = tuple(int(part.shape[0]) for part in parts[1:])
        self.lower, self.upper, self.units = np.hstack(bounds)
        g = ca.densify(ca.vertcat(*parts))
        self.function = ca.Function("g", [vector], [g], ["p"], ["g"])
        self._slope = ca.Function("g_slope", [vector], [ca.densify(ca.jacobian(g, vector))], ["p"], ["jac"])
        satisfied = np.repeat([c.check is not None and c.check(values) <= 0 for c in constraints], self.sizes)
        logs = np.repeat([isinstance(c.expression, LogRadius) for c in constraints], self.sizes)
        self._check_start(p, parameters.free, satisfied.astype(bool), logs.astype(bool))

    def _check_start(self, p: np.ndarray, free: np.ndarray, satisfied: np.ndarray, logs: np.ndarray) -> None:
        """Refuse a constraint that is not finite at the start, or is violated there and depends on no free parameter.

        `satisfied` marks entries that pass their own check, `logs` entries that are logarithms.
        """
        value, slope = self.values(p), self.slope(p)[:, free]
        for i in np.flatnonzero(~np.isfinite(value) | ~np.all(np.isfinite(slope), axis=1)):
            what, shown = ("slope", np.nan) if np.isfinite(value[i]) else ("value", value[i])
            raise InputError(
                f"The constraint {self.labels[i]!r} has no finite {what} at the start values of the parameters (it is "
                f"{shown}); give an expression that is finite there, or other start values."
            )
        reach = np.asarray(ca.DM(self.function.jac_sparsity(0, 0), 1).full(), dtype=bool)[:, free]
        room = FEASIBILITY_TOLERANCE * np.maximum(np.abs(value), 1.0)
        missed = (value < self.lower - room) | (value > self.upper + room)
        for i in np.flatnonzero(missed & ~np.any(reach, axis=1) & ~satisfied):
            found, low, high = (np.exp(v) if logs[i] else v for v in (value[i], self.lower[i], self.upper[i]))
            raise InputError(
                f"The constraint {self.labels[i]!r} is infeasible: all its parameters are fixed and give {found:g}, "
                f"with limits {low:g} and {high:g}; free a parameter or loosen it."
            )

    def units_from(self, change: np.ndarray) -> np.ndarray:
        """Return the given units, else the largest change of each entry (n_g,), at most in proportion to its limits."""
        limits = np.abs([np.where(np.isfinite(b), b, 0.0) for b in (self.lower, self.upper)])
        largest = LARGEST_UNIT * np.max(limits, axis=0, initial=0.0)
        own = np.where(largest > 0, np.clip(largest, SMALLEST_UNIT * change, change), change)
        return np.where(np.isnan(self.units), own, self.units)

    def values(self, p: np.ndarray) -> np.ndarray:
        """Compute the constraints, (n_g,); nan where that fails, such as for a gain where a pole is exactly 1."""
        return _evaluate(self.function, p).ravel()

    def slope(self, p: np.ndarray) -> np.ndarray:
        """Compute the Jacobian of the constraints, (n_g, n_p)."""
        return _evaluate(self._slope, p).reshape(len(self.labels), len(p))


def _limits(c: Constraint, size: int) -> np.ndarray:
    """Check a constraint's limits and unit; return them for each entry, (3, size), the unit nan if none is given."""
    try:
        low, high = (np.broadcast_to(np.asarray(b, dtype=float).ravel(), (size,)) for b in (c.lower, c.upper))
    except ValueError:
        raise InputError(
            f"The bounds of the constraint {c.name!r} do not fit its {size} entries; give one or {size} of each."
        ) from None
    if not np.all(low <= high):
        raise InputError(f"The constraint {c.name!r} is infeasible: its lower bound exceeds its upper bound.")
    if c.exact and np.any(low == high):
        raise InputError(
            f"The constraint {c.name!r} is an equation with exact=True, which rounding does not allow; "
            "leave exact out, or give a lower and an upper limit."
        )
    if c.unit is not None and not 0 < c.unit < np.inf:
        raise InputError(f"The unit of the constraint {c.name!r} is {c.unit!r}; give a positive number, or none.")
    return np.array([low, high, np.full(size, np.nan if c.unit is None else float(c.unit))])


def _expression(c: Constraint, symbols: Mapping[str, Any]) -> Any:
    """Evaluate a constraint's expression as a column."""
    try:
        g = ca.vec(c.expression(symbols))
        return g if isinstance(g, ca.MX) else ca.MX(ca.DM(g))
    except InputError:
        raise
    except KeyError as e:
        raise InputError(
            f"The constraint {c.name!r} reads a parameter {e} that the model lacks; it has {', '.join(symbols)}."
        ) from e
    except Exception as e:
        why = quote_error(e, -1)
        if "__bool__" in str(e) or "truth value" in str(e).lower():
            why = "Python's `if`, `and`, `min` and `max` cannot be used on symbols"
        raise InputError(
            f"The expression of the constraint {c.name!r} cannot be formed ({why}); use CasADi functions of the named "
            "parameters, such as casadi.if_else, fmin and fmax."
        ) from e


@dataclass(frozen=True)
class Gain:
    """The steady gain from inputs to outputs, with the element replaced by its slope `S = slope diag(Σ_j w_ij)`.

        (C_y + D_yw S C_z) (I - A - B_w S C_z)^-1 (B_u + B_w S D_zu) + D_yu + D_yw S D_zu

    The expression is the transpose, (n_u, n_y), so that its entries follow the gain row by row. `shape` is the shape of
    the wanted values, `()` where one number stands for all.
    """

    slope: float = 1.0
    shape: tuple[int, ...] = ()

    def __call__(self, p: Mapping[str, Any]) -> Any:
        """Return the expression for named parameters p."""
        a, b, c, d = p["A"], p["B_u"], p["C_y"], p["D_yu"]
        if "w" in p:
            a, b, c, d = with_port_gain(p, self.slope * ca.diag(ca.sum2(p["w"])))
        wanted = tuple(d.shape)
        if self.shape not in ((), wanted, *([(max(wanted),)] if min(wanted) == 1 else [])):
            raise InputError(
                f"The values of dc_gain have the shape {self.shape}; give one number, or one for each output (row) and "
                f"input (column), of shape {wanted}."
            )
        return (c @ ca.solve(ca.DM.eye(a.shape[0]) - a, b) + d if a.shape[0] else d).T


def row_differences(name: str, p: Mapping[str, Any]) -> Any:
    """Return the differences of neighbouring entries along each row of a parameter, or along a vector."""
    rows = p[name] if p[name].shape[1] > 1 else p[name].T
    return ca.vec((rows[:, 1:] - rows[:, :-1]).T)


def dc_gain(value: Any, *, within: Any = 0.0, slope: float = 1.0) -> Constraint:
    """Constrain the steady gain of a linear model or a PI-LFR of plays or stops, from every input to every output.

    Other elements, such as generalized plays and networks, are refused, because their slope is not `Σw`.

    Parameters
    ----------
    value : float or array, (n_y, n_u)
        The gain, in output units per input unit; a plain list is enough for one output or one input.
    within : float or array, as the value
        Largest deviation from it; 0 for an equation.
    slope : float
        Share of the element's slope Σw that counts: 1 for large motions of plays (all slip) and small ones of stops, 0
        for small motions of plays and large ones of stops.

    Raises
    ------
    InputError
        If the value is not finite, the deviation negative or of another shape, or the slope outside 0 ... 1; with a
        model, if it has other numbers of outputs and inputs.
    """
    gain = numbers(value, "The value of a dc_gain")
    room = filled(within, "within of a dc_gain", gain.shape, infinite=True)
    share = float(filled(slope, "slope of a dc_gain", ()))
    if not (np.all(room >= 0) and 0 <= share <= 1):
        raise InputError(
            f"A gain of {value} within {within} at a slope of {slope} was given; give finite numbers, a deviation "
            "of 0 or more, and a slope from 0 to 1."
        )
    rows = [", ".join(f"{g:g}" for g in row) for row in np.atleast_2d(gain)]
    shown = "; ".join(rows) + ("" if not np.any(room) else f" ± {np.max(room):g}")
    low, high = (gain - room).ravel(), (gain + room).ravel()
    return Constraint(Gain(share, gain.shape), low, high, f"DC gain = {shown}", exact=bool(np.all(room > 0)))


def check_gain(constraints: Iterable[Constraint], element: Any) -> None:
    """Refuse a DC gain for an element to which the formula of `Gain` does not apply."""
    if element is None or (isinstance(element, PrandtlIshlinskii) and isinstance(element.operator, Play | Stop)):
        return
    if any(isinstance(c.expression, Gain) for c in constraints):
        kind = getattr(element, "operator", element)
        raise InputError(
            f"dc_gain applies to linear models and to elements of plays or stops; the model has a "
            f"{type(kind).__name__}, whose gain is not Σw. Leave dc_gain out, or give a Constraint of your own."
        )


def ordered(name: str = "r", gap: float = 0.0) -> Constraint:
    """Constrain the entries of a parameter (by default the thresholds) to ascend along each row by at least `gap`.

    Raises
    ------
    InputError
        If the gap is negative or not finite.
    """
    gap = float(filled(gap, f"The gap between the entries of {name!r}", (), infinite=True))
    if not 0 <= gap < np.inf:
        raise InputError(f"A gap of {gap} between the entries of {name!r} was given; give a number of 0 or more.")
    return Constraint(partial(row_differences, name), lower=float(gap), name=f"{name} ascending", exact=True)
