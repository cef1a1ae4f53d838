r"""Guaranteed bound of a fitted model's response, for every input within its limits.

If the element of a PI-LFR (Krikelis et al. 2024, Eq. 15-17) gives bounded forces `|w| <= w_max` for every signal, the
rest is a linear model. With its impulse responses `h`

.. math:: |y_i| <= \sum_j \|h_{ij}^u\|_1 \max|u_j| + \sum_j \|h_{ij}^w\|_1 w_{j,\max} + |y_{0,i}|

whenever the spectral radius of A is below one: no feedback through the element can make it grow. Stops, envelopes and
products are bounded for every signal, plays only if the inputs alone drive them. The memory is zero at the start. The
bound shows that nothing diverges; for lightly damped modes it is far above the actual responses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .._base import InputError, numbers
from ..identify import Fit
from ..linear import spectral_radius
from ..models import element_bound

Array = np.ndarray
LONGEST_RESPONSE = 200_000  # longest impulse response, samples: enough for a pole at 0.9999, within a second
TAIL = 1e-6  # share of the impulse response that is bounded by its decay instead of summed


@dataclass(frozen=True, eq=False)
class ResponseBound:
    """Guaranteed bound of a model's response.

    Attributes
    ----------
    radius : float
        Spectral radius of the linear part.
    forces : array, (n_w,)
        Largest |w| of each channel of the element; infinite where no bound is known.
    outputs : array, (n_y,)
        Largest |y|, in the outputs' units; infinite where there is no guarantee.
    """

    radius: float
    forces: Array
    outputs: Array

    @property
    def guaranteed(self) -> bool:
        """Tell whether every bounded input gives a bounded output."""
        return bool(np.all(np.isfinite(self.outputs)))

    def __str__(self) -> str:
        if self.guaranteed:
            largest = ", ".join(f"{y:.3g}" for y in self.outputs)
            return (
                f"bounded for every input within its limits: spectral radius of the linear part {self.radius:.5f}, "
                f"forces of the element bounded, outputs at most {largest}"
            )
        if self.radius >= 1:
            return f"no guarantee: the spectral radius of the linear part is {self.radius:.5f}"
        unbounded = ", ".join(str(i) for i in np.flatnonzero(~np.isfinite(self.forces)))
        return f"no guarantee: the element's force is unbounded in channel {unbounded}"


def response_bound(fit: Fit, largest_input: Any) -> ResponseBound:
    """Bound the response of a fitted PI-LFR within input limits, starting from rest.

    Parameters
    ----------
    fit : Fit
        Fit of a PI-LFR with any element, or of a linear model.
    largest_input : float or array, (n_u,)
        Largest |u|, in the inputs' units.

    Raises
    ------
    InputError
        If the model is not a PI-LFR or linear, or the limits are not finite numbers of 0 or more.
    """
    if fit.structure is None:
        raise InputError("A bound needs a PI-LFR, which has a linear part and an element; give the fit of a PI-LFR.")
    model, p = fit.model, fit.parameters
    u = numbers(largest_input, "The largest input", (len(model.inputs),))
    if np.any(u < 0):
        raise InputError(f"The largest input is {u.min():g}; give a number of 0 or more.")
    A, element = p["A"], fit.structure.element
    radius = spectral_radius(A)
    forces = np.zeros(0)
    if element is not None:
        fed_back = np.any(p["C_z"] != 0, axis=1)
        forces = element_bound(element, p, np.where(fed_back, np.inf, np.abs(p["D_zu"]) @ u))
    acting = np.any(p["B_w"] != 0, axis=0) | np.any(p["D_yw"] != 0, axis=0)
    forces = np.where(acting, forces, 0.0)
    if radius >= 1 or not np.all(np.isfinite(forces)):
        return ResponseBound(radius, forces, np.full(model.n_y, np.inf))
    B, D = np.hstack([p["B_u"], p["B_w"]]), np.hstack([p["D_yu"], p["D_yw"]])
    outputs = (np.abs(D) + _bound_absolute_sum(A, B, p["C_y"])) @ np.concatenate([u, forces]) + np.abs(p["y_0"])
    return ResponseBound(radius, forces, outputs)


def _bound_absolute_sum(A: Array, B: Array, C: Array) -> Array:
    """Bound `Σ_k |C A^k B|` from above: sum the first terms, and bound the tail in modal coordinates."""
    if not len(A):
        return np.zeros((len(C), B.shape[1]))
    values, V = np.linalg.eig(A)
    left, right = np.abs(C @ V), np.abs(np.linalg.inv(V) @ B)
    size, total, state = np.abs(values), np.zeros((len(C), B.shape[1])), B
    whole_bound = (left / (1 - size)) @ right
    for k in range(1, LONGEST_RESPONSE + 1):
        total += np.abs(C @ state)
        state = A @ state
        tail_bound = (left * (size**k / (1 - size))) @ right
        if np.all(tail_bound <= TAIL * whole_bound):
            break
    return np.asarray(total + tail_bound)
