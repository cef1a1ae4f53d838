"""The checked problem of predictive control, which every solver takes: its limits, scales and penalty.

A scale is the deviation that costs one. Scales follow from the options alone, so the cost is the same in every call and
does not depend on the units:

    u_scale   half of the width between the limits of an input; 1 where it has no limits;
    y_scale   the smaller of two values: half of the width between the limits of an output, and half of the range that
              it covers when the lowest or highest inputs drive the model from rest over the horizon. Without output
              limits, a tenth of that range; 1 if neither is known.

A violated limit costs in proportion to y_scale and a deviation with its square, so a small y_scale makes limits that
cannot be kept count less against the reference. Therefore y_scale is larger with limits than without.

The penalty of a violation is exact. A reference that lies `e` scales beyond a limit pulls with at most `2 e` per
sample, so a penalty of 30, or `30 e` for `e > 1`, keeps a limit wherever that is possible.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, numbers, whole
from ..export import Exported
from ..identify import Fit

Array = np.ndarray
NO_LIMIT = 1e20  # stands for infinity in limits of outputs; IPOPT's convention
PENALTY = 30.0  # of a violation by one y_scale; 15 times the steepest pull of a reference one scale beyond the limit
UNLIMITED_SHARE = 0.1  # of an output's range: the scale without limits, so that errors of a few per cent count
PROBED_INPUTS = 2.0  # u_scale from zero: the range of inputs over which an output's range is probed
LARGEST, SMALLEST = 1e15, 1e-300  # limits and ranges beyond these count as unknown


@dataclass(frozen=True, eq=False)
class ControlTask:
    """A checked problem of predictive control; arrays hold one sample after the other: (N n_u,) or (N n_y,)."""

    function: ca.Function
    horizon: int
    low: Array
    high: Array
    low_y: Array
    high_y: Array
    limited: bool
    rate: Array
    move: float
    y_scale: Array
    u_scale: Array

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers of states, inputs and outputs."""
        return self.function.size1_in(0), self.function.size1_in(1), self.function.size1_out(1)

    def violation(self, y: Array) -> Array:
        """Compute how far each output (N n_y,) is outside its limits."""
        return np.maximum(0, np.maximum(self.low_y - y, y - self.high_y))

    def penalty(self, reference: Array) -> float:
        """Compute the penalty of a violated output limit per y_scale, for a reference (N n_y,)."""
        return penalty_weight(self.violation(reference) / self.y_scale)

    def first_rate(self, u_before: Array) -> Array:
        """Compute the largest changes (N n_u,); the first may be as large as needed to return inside the limits."""
        rate, n_u = self.rate.copy(), len(u_before)
        rate[:n_u] = np.maximum(rate[:n_u], np.maximum(self.low[:n_u] - u_before, u_before - self.high[:n_u]))
        return rate

    def clip(self, u: Array, u_before: Array, rate: Array) -> Array:
        """Clip inputs to the limits and the rates, sample by sample, starting from the input `u_before`."""
        n, u = len(u_before), np.clip(u, self.low, self.high)
        if np.any(np.abs(u - np.concatenate([u_before, u[:-n]])) > rate):
            for k in range(0, len(u), n):
                now = slice(k, k + n)
                slow = np.clip(u[now], u_before - rate[now], u_before + rate[now])
                u[now] = u_before = np.clip(slow, self.low[now], self.high[now])
        return u


def check_task(
    function: Any, horizon: Any, inputs: Any, outputs: Any, rate: Any, move: Any, y_scale: Any, u_scale: Any
) -> ControlTask:
    """Check the options of a predictive controller and spread them over the horizon."""
    function = as_step_function(function)
    n_u, n_y = function.size1_in(1), function.size1_out(1)
    horizon = whole(horizon, "The horizon", 1)
    low, high = _limits(inputs, "inputs", (horizon, n_u))
    low_y, high_y = _limits((-NO_LIMIT, NO_LIMIT) if outputs is None else outputs, "outputs", (horizon, n_y))
    width = (np.clip(high, -LARGEST, LARGEST) - np.clip(low, -LARGEST, LARGEST)) / 2
    u_size = np.where(width < LARGEST / 4, width, 1.0)
    if u_scale is not None:
        u_size = numbers(u_scale, "u_scale", (horizon, n_u)).ravel()
    if y_scale is None:
        rest = np.clip(0.0, low, high)
        ends = np.maximum(low, rest - PROBED_INPUTS * u_size), np.minimum(high, rest + PROBED_INPUTS * u_size)
        y_size = _output_scale(function, low_y, high_y, ends)
    else:
        y_size = numbers(y_scale, "y_scale", (horizon, n_y)).ravel()
    rates = numbers(np.inf if rate is None else rate, "rate", (horizon, n_u), infinite=True).ravel()
    weight = float(numbers(move, "move", ()))
    if any(np.any(size <= 0) for size in (y_size, u_size, rates)) or weight < 0:
        raise InputError("y_scale, u_scale, rate and move are sizes; give numbers above zero (move may be zero).")
    limited = outputs is not None
    return ControlTask(function, horizon, low, high, low_y, high_y, limited, rates, weight, y_size, u_size)


def as_step_function(given: Any) -> ca.Function:
    """Return the step `(x, u) -> (x_next, y)` of a fit, an observer or an export, or the function itself."""
    model = given.export() if isinstance(given, Fit) else given
    if isinstance(model, Exported) and model.interpolated:
        raise InputError(
            f"The inputs of {model.name} are interpolated, so a step also takes the inputs of the next sample, "
            'which are not free; export it with hold="zero" to plan with it.'
        )
    function = model
    if not isinstance(model, ca.Function):  # an observer has a function, an export a step
        function = getattr(model, "function", getattr(model, "step", model))
    if not isinstance(function, ca.Function):
        raise InputError(
            f"A {type(given).__name__} cannot be used for planning; give a Fit, an observer, an export, or a "
            "casadi.Function (x, u) -> (x_next, y)."
        )
    if function.n_in() != 2 or function.n_out() != 2 or function.size1_in(0) != function.size1_out(0):
        raise InputError(
            f"The function {function.name()} has {function.n_in()} inputs and {function.n_out()} outputs, or its "
            "state changes size in a step; give (x, u) -> (x_next, y)."
        )
    return function


def penalty_weight(violation: Array) -> float:
    """Compute the penalty per y_scale for a reference that itself violates the limits by `violation`, in y_scale."""
    return PENALTY * max(1.0, float(np.max(violation, initial=0.0)))


def _limits(limits: Any, of: str, shape: tuple[int, int]) -> tuple[Array, Array]:
    """Spread lower and upper limits over the horizon; infinite means no limit."""
    if not isinstance(limits, tuple | list) or len(limits) != 2:
        raise InputError(f"The limits of the {of} cannot be {str(limits)[:60]}; give (low, high).")
    if any(v is None for v in limits):
        raise InputError(f"A limit of the {of} is None; give (low, high), infinite where there is no limit.")
    ends = zip(limits, ("lower", "upper"), strict=True)
    low, high = (numbers(v, f"The {end} limit of the {of}", shape, infinite=True).ravel() for v, end in ends)
    if np.any(low >= high):
        raise InputError(f"A lower limit of the {of} is not below its upper one; give (low, high) with low below high.")
    return low, high


def _output_scale(function: ca.Function, low: Array, high: Array, ends: tuple[Array, Array]) -> Array:
    """Choose the scale of the outputs from their limits (N n_y,) and from runs at the limits of the inputs (N n_u,)."""
    n_u, n_y = function.size1_in(1), function.size1_out(1)
    samples = len(low) // n_y
    width = np.min(((high - low) / 2).reshape(samples, n_y), axis=0)
    limited = np.any((np.minimum(-low, high) < LARGEST).reshape(samples, n_y), axis=0)
    run, rest = function.mapaccum("output_range", samples), np.zeros(function.size1_in(0))
    with np.errstate(all="ignore"):
        paths = [np.asarray(run(rest, end.reshape(samples, n_u).T)[1]) for end in ends]
        covered = np.ptp(np.hstack(paths), axis=1) / 2
    known = [np.where((v > SMALLEST) & (v < LARGEST), v, np.inf) for v in (width, covered)]
    size = np.minimum(*known) * np.where(limited, 1.0, UNLIMITED_SHARE)
    return np.tile(np.where(np.isfinite(size), size, 1.0), samples)
