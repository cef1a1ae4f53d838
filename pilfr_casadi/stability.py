"""The bounds on spectral radii that `stable` stands for."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from .constraints import Constraint, stable
from .elements import PrandtlIshlinskii
from .lfr import PILFR
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
