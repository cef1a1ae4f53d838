"""The bounds on spectral radii that `stable` stands for, and whether bounds on the entries of A leave room for them.

For matrices between L and U, entry by entry, `ρ(A) >= |trace A| / n`, and `ρ(A) >= ρ(L)` where `L >= 0` (Perron and
Frobenius).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import casadi as ca
import numpy as np

from .constraints import BeyondRadius, Constraint, linear_part, stable
from .elements import PrandtlIshlinskii
from .lfr import PILFR
from .parameters import ParameterSet
from .recording import InputError


def stability(structure: PILFR, radius: float = 1.0, exact: bool = False) -> tuple[Constraint, ...]:
    """Bounds on the spectral radius of A, and of A + B_w diag(Σw) C_z: no operator slips, or all (stops: sticks)."""
    if structure.nx == 0:
        return ()
    limits: tuple[Constraint, ...] = (stable(radius, exact=exact),)
    element = structure.element
    if isinstance(element, PrandtlIshlinskii):
        limits += (stable(radius, _with_element, "spectral radius with the element's full slope", exact=exact),)
    return limits


def _with_element(p: Any) -> Any:
    return p["A"] + p["B_w"] @ ca.diag(ca.sum2(p["w"])) @ p["C_z"]


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
