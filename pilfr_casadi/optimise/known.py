"""Constraints on a PI-LFR for what is known of a machine beforehand: its gain, the order of its thresholds.

With `s` the slope of the element (between 0, every play sticks, and 1, every play slips, times Σw; stops the other way
round), constant inputs and outputs of the model of Krikelis et al. (2024), Eq. 15-17, are tied by

    A' = A + B_w S C_z,   B' = B_u + B_w S D_zu,   C' = C_y + D_yw S C_z,   D' = D_yu + D_yw S D_zu,
    gain = C' (I - A')⁻¹ B' + D',   S = s diag(Σ_j w_ij).

All are classes, so that they can be sent to other processes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, filled, numbers
from ..models import Play, PrandtlIshlinskii, Stop
from .constraints import Constraint


@dataclass(frozen=True)
class Gain:
    """The steady gain from inputs to outputs, the element moving along its slope; see above.

    What it gives is transposed, (n_u, n_y), so that its entries follow each other row by row of the gain. `shape` is
    that of the values it is compared with, none where one number stands for all.
    """

    slope: float = 1.0
    shape: tuple[int, ...] = ()

    def __call__(self, p: Mapping[str, Any]) -> Any:
        """The expression for named parameters p."""
        a, b, c, d = p["A"], p["B_u"], p["C_y"], p["D_yu"]
        if "w" in p:
            s = self.slope * ca.diag(ca.sum2(p["w"]))
            a, b = a + p["B_w"] @ s @ p["C_z"], b + p["B_w"] @ s @ p["D_zu"]
            c, d = c + p["D_yw"] @ s @ p["C_z"], d + p["D_yw"] @ s @ p["D_zu"]
        wanted = tuple(d.shape)
        if self.shape not in ((), wanted, *([(max(wanted),)] if min(wanted) == 1 else [])):
            raise InputError(
                f"The values of dc_gain have the shape {self.shape}; give one number, or one for each output (row) and "
                f"input (column), of shape {wanted}."
            )
        return (c @ ca.solve(ca.DM.eye(a.shape[0]) - a, b) + d if a.shape[0] else d).T


@dataclass(frozen=True)
class Steps:
    """Differences of neighbouring entries along each row of a parameter."""

    name: str = "r"

    def __call__(self, p: Mapping[str, Any]) -> Any:
        """The expression for named parameters p."""
        rows = p[self.name] if p[self.name].shape[1] > 1 else p[self.name].T
        return ca.vec((rows[:, 1:] - rows[:, :-1]).T)


def dc_gain(value: Any, *, within: Any = 0.0, slope: float = 1.0) -> Constraint:
    """A known steady gain of a linear model or a PI-LFR of plays or stops, from every input to every output.

    Other elements, such as generalized plays and networks, have no slope `Σw`: with them it is refused.

    Parameters
    ----------
    value : float or array, (n_y, n_u)
        The gain, in units of the outputs over those of the inputs; a plain list will do for one output or one input.
    within : float or array, as the value
        Largest deviation from it; 0 for an equation.
    slope : float
        How much of the element's slope Σw counts: 1 for large motions of plays (all slip) and small ones of stops, 0
        for the other way round.

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
            f"A gain of {value} within {within} at a slope of {slope} was asked for; give finite numbers, a deviation "
            "of 0 or more, and a slope from 0 to 1."
        )
    rows = [", ".join(f"{g:g}" for g in row) for row in np.atleast_2d(gain)]
    shown = "; ".join(rows) + ("" if not np.any(room) else f" ± {np.max(room):g}")
    low, high = (gain - room).ravel(), (gain + room).ravel()
    return Constraint(Gain(share, gain.shape), low, high, f"DC gain = {shown}", exact=bool(np.all(room > 0)))


def check_gain(constraints: Iterable[Constraint], element: Any) -> None:
    """Refuse a DC gain for an element whose gain is not the one of `Gain`.

    Raises
    ------
    InputError
        If the element is neither none nor a Prandtl-Ishlinskii one of plays or stops.
    """
    if element is None or (isinstance(element, PrandtlIshlinskii) and isinstance(element.operator, Play | Stop)):
        return
    if any(isinstance(c.expression, Gain) for c in constraints):
        kind = getattr(element, "operator", element)
        raise InputError(
            f"dc_gain is for linear models and for plays and stops, and the model has a {type(kind).__name__}, whose "
            "gain is another; leave it out, or give a Constraint of your own."
        )


def ordered(name: str = "r", gap: float = 0.0) -> Constraint:
    """The entries of a parameter ascend along each row, by `gap` at least: by default the thresholds of each channel.

    Raises
    ------
    InputError
        If the gap is negative or not finite.
    """
    gap = float(filled(gap, f"The gap between the entries of {name!r}", (), infinite=True))
    if not 0 <= gap < np.inf:
        raise InputError(f"A gap of {gap} between the entries of {name!r} was asked for; give a number of 0 or more.")
    return Constraint(Steps(name), lower=float(gap), name=f"{name} ascending", exact=True)
