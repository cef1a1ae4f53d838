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

from .constraints import Constraint
from .elements import PrandtlIshlinskii
from .operators import Play, Stop
from .recording import InputError


@dataclass(frozen=True)
class Gain:
    """The steady gain from inputs to outputs (n_y, n_u), the element moving along its slope; see above."""

    slope: float = 1.0

    def __call__(self, p: Mapping[str, Any]) -> Any:
        """The expression for named parameters p."""
        a, b, c, d = p["A"], p["B_u"], p["C_y"], p["D_yu"]
        if "w" in p:
            s = self.slope * ca.diag(ca.sum2(p["w"]))
            a, b = a + p["B_w"] @ s @ p["C_z"], b + p["B_w"] @ s @ p["D_zu"]
            c, d = c + p["D_yw"] @ s @ p["C_z"], d + p["D_yw"] @ s @ p["D_zu"]
        return c @ ca.solve(ca.DM.eye(a.shape[0]) - a, b) + d if a.shape[0] else d


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
        The gain, in units of the outputs over those of the inputs.
    within : float or array
        Largest deviation from it; 0 for an equation.
    slope : float
        How much of the element's slope Σw counts: 1 for large motions of plays (all slip) and small ones of stops, 0
        for the other way round.

    Raises
    ------
    InputError
        If the value is not finite, the deviation negative, or the slope outside 0 ... 1.
    """
    gain, room = np.asarray(value, dtype=float), np.asarray(within, dtype=float)
    if not (np.all(np.isfinite(gain)) and np.all(room >= 0) and 0 <= slope <= 1):
        raise InputError(
            f"A gain of {value} within {within} at a slope of {slope} was asked for; give finite numbers, a deviation "
            "of 0 or more, and a slope from 0 to 1."
        )
    both = np.broadcast_shapes(gain.shape, room.shape)
    flat, room = (np.broadcast_to(a, both).ravel(order="F") for a in (gain, room))
    shown = ", ".join(f"{g:g}" for g in flat) + ("" if not np.any(room) else f" ± {np.max(room):g}")
    return Constraint(Gain(slope), flat - room, flat + room, f"DC gain = {shown}", exact=bool(np.all(room > 0)))


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
    if not 0 <= gap < np.inf:
        raise InputError(f"A gap of {gap} between the entries of {name!r} was asked for; give a number of 0 or more.")
    return Constraint(Steps(name), lower=float(gap), name=f"{name} ascending", exact=True)
