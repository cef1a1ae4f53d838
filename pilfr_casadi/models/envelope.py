r"""An envelope: a slow amplitude with memory that schedules a gain.

.. math:: e^+ = \min(e + κ (z^2 - e), c^2), \quad a = \sqrt{e^+}, \quad w = \frac{a}{a + b} \operatorname{clip}(z, ±ρ)

`a` is the root mean square of z over the last 1/κ samples. Through `B_w` and `C_z` of a PI-LFR (Krikelis et al. 2024,
Eq. 15) it makes a stiffness fall (or rise) with the amplitude of vibration and leaves the damping nearly as it is: what
is known of structures whose resonances move with the level (slow dynamics, amplitude-dependent modulus). Play and stop
operators do the same within a period, but then dissipate in proportion.

`ρ` (`reach`) and `c = ρ / 3` bound w: from data they are chosen beyond what z visits, so that they matter to a bound
on the response and to nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from .._base import whole
from .operators import fmax, fmin
from .parameters import Parameter, ParameterSet

CREST = 3.0  # ratio of the largest z to the largest amplitude
SMALL = 1e-6  # a² at rest, as a share of the knee's square: gives the root a slope there


@dataclass(frozen=True)
class Envelope:
    """A gain on each channel that its own amplitude schedules.

    Parameters
    ----------
    channels : int
        Number of signals. Parameters, one a channel: `rate` κ (a sample), `knee` b > 0 (unit of z: the amplitude of
        half the gain), `reach` ρ (unit of z, fixed).

    Raises
    ------
    InputError
        If the number is not whole and above zero.
    """

    channels: int = 1
    kind: str = field(init=False, default="envelope")

    def __post_init__(self) -> None:
        whole(self.channels, "An envelope's number of channels", 1)

    @property
    def memory(self) -> int:
        """One mean square a channel."""
        return self.channels

    def parameters(self) -> ParameterSet:
        """`rate`, `knee` and `reach`, each (channels,)."""
        one = np.ones(self.channels)
        return ParameterSet(
            {
                "rate": Parameter(1e-2 * one, bounds=(1e-6, 1.0)),
                "knee": Parameter(one, bounds=(1e-6, np.inf)),
                "reach": Parameter(1e3 * one, bounds=(0.0, np.inf), fixed=True),
            }
        )

    def step(self, z: Any, s: Any, p: Any) -> tuple[Any, Any]:
        """One step: w (channels, 1) and the next mean squares."""
        w, following = [], []
        for i in range(self.channels):
            rate, knee, reach = p["rate"][i], p["knee"][i], p["reach"][i]
            e = fmin(s[i] + rate * (z[i] ** 2 - s[i]), (reach / CREST) ** 2)
            a = ca.sqrt(e + SMALL * knee**2)
            w.append(fmax(fmin(z[i], reach), -reach) * a / (a + knee))
            following.append(e)
        return ca.vertcat(*w), ca.vertcat(*following)

    def bound(self, p: Mapping[str, Any], size: np.ndarray) -> np.ndarray:
        """Largest |w| of each channel where |z| is at most `size`, (channels,); finite for any z."""
        reach, knee = (np.asarray(p[name], dtype=float) for name in ("reach", "knee"))
        a = np.sqrt(np.minimum(reach / CREST, size) ** 2 + SMALL * knee**2)
        return np.asarray(np.minimum(reach, size) * a / (a + knee))
