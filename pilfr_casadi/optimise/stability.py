"""The bounds on spectral radii that `stable` stands for, and whether bounds on the entries of A leave room for them.

For matrices between L and U, entry by entry, `ρ(A) >= |trace A| / n`, and `ρ(A) >= ρ(L)` where `L >= 0` (Perron and
Frobenius).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError
from ..models import PILFR, GeneralizedPlay, ParameterSet, PrandtlIshlinskii, element_slopes, unknown_slope
from .constraints import BeyondRadius, Constraint, linear_part, stable


@dataclass(frozen=True)
class WithElement:
    """`A + B_w S C_z` with one of an element's slopes S; a class, so that it can be sent to other processes."""

    element: Any
    slope: str

    def __call__(self, p: Mapping[str, Any]) -> Any:
        """The expression for named parameters p."""
        return p["A"] + p["B_w"] @ element_slopes(self.element, p)[self.slope] @ p["C_z"]


def stability(structure: PILFR, radius: float = 1.0, exact: bool = False) -> tuple[Constraint, ...]:
    """Bounds on the spectral radius of A, and of A + B_w S C_z with each slope S that the element has (`slopes`).

    With plays no operator slips, or all do (with stops: sticks).
    """
    if structure.nx == 0:
        return ()
    limits: tuple[Constraint, ...] = (stable(radius, exact=exact),)
    element = structure.element
    if element is not None:
        symbols = {name: ca.MX.sym(name, *p.shape) for name, p in element.parameters().items()}
        for slope in element_slopes(element, symbols):
            name = f"spectral radius with the element's {slope}"
            limits += (stable(radius, WithElement(element, slope), name, exact=exact),)
    return limits


def unbounded_sentence(structure: PILFR | None, constraints: Iterable[Constraint], p: Mapping[str, Any]) -> str:
    """What bounds on spectral radii leave open of an element that is fed back, p named numbers; empty where nothing."""
    radii = [c.check.radius for c in constraints if isinstance(c.check, BeyondRadius)]
    element = structure.element if structure else None
    if element is None or not radii or not np.any(np.sum(np.abs(p["C_z"]), axis=1) * np.sum(np.abs(p["B_w"]), axis=0)):
        return ""
    if unknown_slope(element, p):
        return (
            "the spectral radius is bounded for the linear part alone: how steep the element is that is fed back is "
            "not known, as with envelopes of your own, so judge stability by simulations beyond the recorded amplitudes"
        )
    if not isinstance(element, PrandtlIshlinskii) or not isinstance(element.operator, GeneralizedPlay):
        return ""
    worst = 0.0
    for side in "lr":
        slope = np.diag(np.sum(p["w"], axis=1) * element.operator.steepest(side, p))
        worst = max(worst, float(np.max(np.abs(np.linalg.eigvals(p["A"] + p["B_w"] @ slope @ p["C_z"])))))
    if worst <= min(radii):
        return ""
    return (
        f"where an envelope is steepest the spectral radius is {worst:.4g}, above its bound of {min(radii):g}, which "
        "holds far out: small motions there may grow until the envelope is flatter"
    )


def stability_limits(structure: PILFR, bound: bool | float) -> tuple[Constraint, ...]:
    """The limits that `stable` stands for."""
    if bound is False:
        return ()
    if not isinstance(bound, bool | int | float | np.number) or not np.isfinite(bound):
        raise InputError(f"stable = {bound!r} was given; give True, False or the largest spectral radius, above zero.")
    return stability(structure, float(bound), exact=True)


def check_room(parameters: ParameterSet, limits: Iterable[Constraint]) -> None:
    """Refuse bounds on the entries of A under which no A has the spectral radius that is asked for.

    Raises
    ------
    InputError
        With the bounds, the least radius that they allow and the one that was asked for.
    """
    radii = [c.check.radius for c in limits if isinstance(c.check, BeyondRadius) and c.check.matrix is linear_part]
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
    """A spectral radius that no matrix between `low` and `high` (n, n), entry by entry, falls below."""
    low_trace, high_trace = float(np.trace(low)), float(np.trace(high))
    least = max(low_trace, -high_trace, 0.0) / max(len(low), 1)
    for bound, sign in ((low, 1.0), (high, -1.0)):
        if np.all(np.isfinite(bound)) and np.all(sign * bound >= 0):
            least = max(least, float(np.max(np.abs(np.linalg.eigvals(bound)), initial=0.0)))
    return least
