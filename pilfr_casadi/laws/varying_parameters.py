"""Parameters of the equations that vary: with a signal, or with a slow state that a signal heats.

The law stands in the port `parameter:<name>`, and adds a change to the parameter.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from typing import Any

import casadi as ca
import numpy as np

from .base import Law, Local, check_signal, rename_class
from .scheduling import check_profile, make_scheduled, strengths_over

CURVE_NODES = {"": 0.0, "_25": 0.25, "_75": 0.75, "_high": 1.0}  # shares of the range at which a curve has its values
VARIATIONS = ("tilt", "bend", "curve")  # profiles of a parameter


class VaryingParameter(Law):
    """A change that is added to a parameter of the equations, at the port `parameter:<name>`; see `varying`."""

    id = "varying_parameter"
    flexible = True
    equation = "w = c"
    source = "Toth (2010), Modeling and Identification of Linear Parameter-Varying Systems, sec. 2.1"
    sentence = "a parameter that varies with {by}: a change is added to its value, within its bounds"
    units = {"c": "w"}
    places = ("parameter",)

    def force(self, p: Any) -> Any:
        return p.c

    def varied(self, value: Any, change: Any, lower: float) -> Any:
        """Evaluate a parameter of a value and a lower bound with its change."""
        return value + change

    def starts_as(self, plain: Law, own: Mapping[str, Any]) -> dict[str, Any]:
        """Start values at which a curve equals another variation with the same signal, fitted to `own`."""
        ends = {name: own[name] for name in ("low", "high")}
        shares = np.array([CURVE_NODES[name.removeprefix("c")] for name in self.strength])
        levels = strengths_over(plain, own, ends["low"] + shares * (ends["high"] - ends["low"]))["c"]
        return ends | dict(zip(self.strength, levels.tolist(), strict=True))


def varying(by: str, profile: str = "tilt") -> type[Law]:
    """Make the law by which a parameter varies with a signal, such as a force constant with the position.

    It stands in the port `parameter:<name>`. The parameter has its own value in the middle of the signal's range in the
    recordings, and stays within its bounds.

    Parameters
    ----------
    by : str
        A state or an input of the simulator, or "t", the time.
    profile : {"tilt", "bend", "curve"}
        How it varies: in a line that adds `c` at the upper end and takes it away at the lower one; in a parabola that
        adds `c` at the lower end and `c_high` at the upper one; or in a curve of fourth degree through four such
        values. Outside the range it continues along its tangents.

    Raises
    ------
    InputError
        If `by` is no name, or there is no such profile.
    """
    check_signal(by)
    return make_scheduled(VaryingParameter, by, check_profile(profile, VARIATIONS))


def heated(by: str) -> type[Law]:
    """Make the law by which a parameter varies with a slow state that the square of a signal drives.

    For example, a winding's resistance follows the heat of its current: `change = c q`, `dq/dt = (s^2 / s_2 - q) / T`,
    with the mean square s_2 of the signal s in the recordings. The law stands in the port `parameter:<name>`. A
    parameter that cannot be negative falls exponentially, with the same slope at first, as the viscosity of oil does.

    Parameters
    ----------
    by : str
        A state or an input of the simulator.

    Raises
    ------
    InputError
        If `by` is no name.
    """
    check_signal(by)
    return _heated(by)


@functools.cache
def _heated(by: str) -> Any:
    class Heated(VaryingParameter):
        form = f"scheduled by the heat of {by}"
        equation = f"change = c q, or p (exp(c q / p) - 1) if p >= 0 and it falls,  dq/dt = ({by}^2 / s_2 - q) / T"
        source = (
            "Incropera et al. (2007), Fundamentals of Heat and Mass Transfer, sec. 5.1 (lumped capacitance); "
            "Stachowiak & Batchelor (2013), Engineering Tribology, sec. 2.3 (Reynolds' viscosity)"
        )
        sentence = f"a parameter that varies with a slow state which the square of {by} drives, as by self-heating"
        units = {"c": "w", "T": "s", "s_2": f"[{by}]^2"}
        order, signal = 1, by
        constants = ("s_2",)
        starts = {"T": ("duration", 0.03, 0.1, 0.3)}
        ranges = {"T": ("duration", 0.01, 2.0)}

        def force(self, q: Any, p: Any) -> Any:  # type: ignore[override]
            return p.c * q[0]

        def flow(self, z: Any, q: Any, p: Any) -> Any:
            return (z**2 / p.s_2 - q[0]) / p.T

        def varied(self, value: Any, change: Any, lower: float) -> Any:
            """Let a parameter that cannot be negative fall exponentially, as viscosity does; a resistance rises."""
            if lower < 0:
                return value + change
            falling = ca.fmin(change, 0.0)
            least = 1e-150 - falling / 700  # keeps the derivatives finite where the value is zero
            return ca.fmax(change, 0.0) + value * ca.exp(falling / ca.fmax(value, least))

        def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
            """Time constants, with the mean square of the signal."""
            for own in super().shapes(local):
                yield {**own, "s_2": float(np.mean(local.z**2))}

        def why_not(self, local: Local) -> str:
            return "" if np.ptp(local.z) > 0 else f"{by} is constant"

    return rename_class(Heated, f"Heated_{by}", f"{VaryingParameter.__doc__}")
