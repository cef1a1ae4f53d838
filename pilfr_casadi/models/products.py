r"""Static products of several signals: a polynomial element without memory.

.. math:: w_i = \sum_m g_{im} φ_m(\operatorname{clip}(z, ±ρ)), \qquad φ_m = z_j z_k \dots

with every product of the channels of the given degrees, squares and cubes included. With the linear part outside
(Krikelis et al. 2024, Eq. 15) this is the polynomial feedback of a nonlinear LFR. `ρ` (`reach`) makes w bounded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations_with_replacement
from math import prod
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, whole
from .operators import fmax, fmin
from .parameters import Parameter, ParameterSet


@dataclass(frozen=True)
class Products:
    """All products of the channels of the given degrees, mixed into as many channels by `gain`.

    Parameters
    ----------
    channels : int
        Number of signals in and out.
    degrees : tuple of int
        Degrees of the products, such as (2, 3). Parameters: `gain` (channels, terms), terms in the order of `terms`,
        and `reach` ρ (channels,), fixed, in units of z.

    Raises
    ------
    InputError
        If a number is not whole, or there is no degree.
    """

    channels: int = 1
    degrees: tuple[int, ...] = (2, 3)
    kind: str = field(init=False, default="products")

    def __post_init__(self) -> None:
        whole(self.channels, "The number of channels of products", 1)
        if not isinstance(self.degrees, tuple | list) or not self.degrees:
            raise InputError(f"The degrees of products are {self.degrees!r}; give whole numbers, such as (2, 3).")
        for degree in self.degrees:
            whole(degree, "A degree of products", 2)
        object.__setattr__(self, "degrees", tuple(sorted({int(d) for d in self.degrees})))

    @property
    def memory(self) -> int:
        """None."""
        return 0

    @property
    def terms(self) -> tuple[tuple[int, ...], ...]:
        """Channels that each product multiplies."""
        return tuple(t for d in self.degrees for t in combinations_with_replacement(range(self.channels), d))

    def parameters(self) -> ParameterSet:
        """`gain` (channels, terms), zero, and `reach` (channels,)."""
        return ParameterSet(
            {
                "gain": Parameter(np.zeros((self.channels, len(self.terms)))),
                "reach": Parameter(np.full(self.channels, 1e3), bounds=(0.0, np.inf), fixed=True),
            }
        )

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """One step: w (channels, 1), and no memory."""
        inside = [fmax(fmin(z[i], p["reach"][i]), -p["reach"][i]) for i in range(self.channels)]
        products = [prod(inside[i] for i in term) for term in self.terms]
        w = [sum(p["gain"][i, m] * value for m, value in enumerate(products)) for i in range(self.channels)]
        return ca.vertcat(*w), s

    def bound(self, p: Mapping[str, Any], size: np.ndarray) -> np.ndarray:
        """Largest |w| of each channel where |z| is at most `size`, (channels,); finite for any z."""
        reach = np.minimum(np.asarray(p["reach"], dtype=float), size)
        largest = np.array([prod(reach[i] for i in term) for term in self.terms])
        return np.asarray(np.abs(np.asarray(p["gain"], dtype=float)) @ largest)
