"""A signal that a flow carries along, so that it arrives the later the slower it flows."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from .base import Law, Local, check_signal, rename_class

ORDER = 6  # of the approximant, and states of the law; more follow sharper steps
RATE = 8.0  # the size of its poles; it scales the states to about the size of the signal


def _pade(least: int, most: int) -> tuple[list[float], list[float]]:
    """Compute the coefficients of numerator and denominator, from s^0 on, of an approximant of exp(-s)."""

    def coefficients(degree: int, sign: int) -> list[float]:
        over = [math.factorial(k) * math.factorial(degree - k) for k in range(degree + 1)]
        scale = math.factorial(degree) / math.factorial(least + most)
        return [sign**k * scale * math.factorial(least + most - k) / n for k, n in enumerate(over)]

    return coefficients(least, -1), coefficients(most, 1)


NUMERATOR, DENOMINATOR = _pade(ORDER - 1, ORDER)


class _Carried(Law):
    """The common part of delays by which a flow carries a signal along."""

    id = "delay"
    source = (
        "Levenspiel (1999), Chemical Reaction Engineering, ch. 5 (plug flow); Golub & Van Loan (2013), Matrix "
        "Computations, sec. 9.3 (Padé approximant)"
    )
    places = ("series",)
    domains = ("thermal", "fluid")
    order, follows = ORDER, 1
    substeps = 4  # the delay may be as short as two samples

    def force(self, z: Any, q: Any, p: Any) -> Any:
        return sum(c * RATE**k * q[k] for k, c in enumerate(NUMERATOR)) - z

    def flow(self, z: Any, q: Any, p: Any, u: Any) -> Any:
        """Derivatives of the signal behind the pipe with respect to the volume, in units of V / RATE."""
        *lower, highest = DENOMINATOR
        rest = z - sum(c * RATE**k * q[k] for k, c in enumerate(lower))
        along = ca.vertcat(*(q[k] for k in range(1, self.order)), rest / (highest * RATE**self.order))
        return RATE * ca.fmax(u[self.carried_by], 0.0) / p.V * along

    def forces_along(self, local: Local, shapes: Sequence[Mapping[str, Any]]) -> np.ndarray:
        """Compute the change of the signal for each shape, (M, len(shapes), 1), by the volume that has passed."""
        ends, found = np.cumsum([0, *local.lengths]), list[np.ndarray]()
        for begin, end in itertools.pairwise(ends):
            z, rates = local.z[begin:end], np.maximum(local.inputs[self.carried_by][begin:end], 0.0)
            passed = np.concatenate([[0.0], np.cumsum(rates[:-1]) * local.dt])
            at_zero = any(local.from_zero[len(found) : len(found) + 1])
            behind = (np.interp(passed - shape["V"], passed, z, left=0.0 if at_zero else z[0]) for shape in shapes)
            found.append(np.column_stack([now - z for now in behind]))
        return np.concatenate(found)[:, :, None]

    def shapes(self, local: Local) -> Any:
        """Volumes for delays from two samples to a tenth of the recordings at the mean rate of flow."""
        mean = float(np.mean(local.inputs[self.carried_by]))
        for delay in np.geomspace(2 * local.dt, local.duration / 10, 8):
            yield {"V": mean * float(delay)}

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        """Limit the volume to delays of two samples at the largest rate, and of a quarter of the recordings."""
        rates = local.inputs[self.carried_by]
        least = 2 * local.dt * float(np.max(rates))
        return {"V": (least, max(float(np.mean(rates)) * local.duration / 4, 2 * least))}

    def why_not(self, local: Local) -> str:
        by = self.carried_by
        if by not in local.inputs:
            return f"the port has no signal {by}"
        low, high = float(np.min(local.inputs[by])), float(np.max(local.inputs[by]))
        return f"{by} changes its sign or is constant" if low < 0 or low == high else super().why_not(local)


def carried(by: str) -> type[Law]:
    """Make the law of a signal that a flow carries along: it arrives when the volume V has passed.

    For example, the temperature at the end of a pipe follows that at its beginning, the later the slower the water
    flows: `y(t) = u(s)`, where the flow from s to t is V. The delay is an approximant of sixth order in the volume,
    without dispersion. The law stands at an actuator or a sensor.

    Parameters
    ----------
    by : str
        An input of the simulator, the rate of flow; where it is negative, nothing flows.

    Raises
    ------
    InputError
        If `by` is no name.
    """
    check_signal(by)
    return _carried(by)


@functools.cache
def _carried(by: str) -> Any:
    class Carried(_Carried):
        form = f"carried by {by}"
        equation = f"w = u(s) - u(t),  where the integral of {by} from s to t is V"
        sentence = f"a transport delay: {by} carries the signal along, which arrives the later the slower it flows"
        units = {"V": f"[{by}]*s"}
        carried_by = by

    return rename_class(Carried, f"CarriedBy_{by}", carried.__doc__ or "")
