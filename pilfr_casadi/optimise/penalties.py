"""Priors and L1 penalties of a problem: a quadratic and a linear term in θ.

    1/2 Σ ((θ_i - m_i) / s_i)² v/R + l1 Σ |w|

with the noise variance v and R residuals (`problem`). Weights under an L1 penalty are bounded by zero, so |w| is w.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .._base import InputError
from ..models import ParameterSet


class Penalties:
    """What is added to the simulation error.

    Parameters
    ----------
    parameters : ParameterSet
        With their priors.
    l1 : mapping
        Weight of an L1 penalty by name.
    noise : float
        Standard deviation of the noise relative to the output's.
    residuals, size : int
        Number of residuals, and of variables: the free parameters come first, no others are penalised.

    Raises
    ------
    InputError
        If what an L1 penalty is on may be negative.
    """

    def __init__(
        self, parameters: ParameterSet, l1: Mapping[str, float], noise: float, residuals: int, size: int
    ) -> None:
        weight, mean, slope = (np.zeros(parameters.size) for _ in range(3))
        for name, strength in l1.items():
            where = parameters.position(name)
            if np.any(parameters.lower[where] < 0):
                raise InputError(
                    f"An L1 penalty on {name!r} needs a lower bound of zero or more; bound it or use a prior."
                )
            slope[where] = strength
        for name, p in parameters.items():
            if p.prior is not None:
                where = parameters.position(name)
                mean[where] = np.broadcast_to(np.asarray(p.prior[0], dtype=float), p.value.shape).ravel(order="F")
                std = np.broadcast_to(np.asarray(p.prior[1], dtype=float), p.value.shape).ravel(order="F")
                weight[where] = noise**2 / std**2 / residuals
        pad = np.zeros(size - int(parameters.free.sum()))
        self.weight, self.mean, self.slope = (np.concatenate([a[parameters.free], pad]) for a in (weight, mean, slope))

    def value(self, theta: np.ndarray) -> float:
        """Both terms."""
        return float(0.5 * self.weight @ (theta - self.mean) ** 2 + self.slope @ theta)

    def gradient(self, theta: np.ndarray) -> np.ndarray:
        """Their gradient, shape (n,); the Hessian is diagonal, `weight`."""
        return np.asarray(self.weight * (theta - self.mean) + self.slope)
