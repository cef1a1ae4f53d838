"""What is asked of a predictive controller, checked: limits, rates and scales over the horizon."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, numbers
from ..export import Exported
from ..identify import Fit
from .mpc_scales import scale_of_inputs, scale_of_outputs

Array = np.ndarray
ENORMOUS = 1e20  # stands for no limit
NEXT = "next"  # what a step of interpolated inputs reads
SOLVERS = ("sqp", "ipopt")


@dataclass(frozen=True, eq=False)
class Asked:
    """Arguments of `PredictiveController`, each spread over the horizon, sample by sample: (N n_u,) or (N n_y,)."""

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


def asked(
    function: Any,
    horizon: Any,
    inputs: Any,
    outputs: Any = None,
    rate: Any = None,
    move: Any = 1e-3,
    y_scale: Any = None,
    u_scale: Any = None,
) -> Asked:
    """Check the arguments of a predictive controller.

    Raises
    ------
    InputError
        That says which is unfit.
    """
    function = planned_with(function)
    n_u, n_y = function.size1_in(1), function.size1_out(1)
    if not count(horizon):
        raise InputError(f"A horizon of {horizon!r} was given; give a number of samples, 1 or more.")
    low, high = _pair(inputs, "inputs", (horizon, n_u))
    limits = (-ENORMOUS, ENORMOUS) if outputs is None else outputs
    low_y, high_y = _pair(limits, "outputs", (horizon, n_y))
    u_size = scale_of_inputs(low, high) if u_scale is None else numbers(u_scale, "u_scale", (horizon, n_u)).ravel()
    if y_scale is None:
        middle = np.clip(0.0, low, high)
        ends = np.maximum(low, middle - 2 * u_size), np.minimum(high, middle + 2 * u_size)
        y_size = scale_of_outputs(function, low_y, high_y, ends)
    else:
        y_size = numbers(y_scale, "y_scale", (horizon, n_y)).ravel()
    scales = y_size, u_size
    rates = numbers(np.inf if rate is None else rate, "rate", (horizon, n_u), infinite=True).ravel()
    weight = float(numbers(move, "move", ()))
    if any(np.any(size <= 0) for size in (*scales, rates)) or weight < 0:
        raise InputError("y_scale, u_scale, rate and move are sizes; give numbers above zero (move may be zero).")
    return Asked(function, int(horizon), low, high, low_y, high_y, outputs is not None, rates, weight, *scales)


def planned_with(given: Any) -> ca.Function:
    """The function `(x, u) -> (x_next, y)` of a model, an observer or an export, or one that is given itself.

    Raises
    ------
    InputError
        If it is none.
    """
    model = given.export() if isinstance(given, Fit) else given
    if isinstance(model, Exported) and NEXT in model.sampled.reads:
        raise InputError(
            f"The inputs of {model.name} are interpolated, so a step takes those of the next sample too, and these "
            'are not free; export it with hold="zero" to plan with it.'
        )
    function = model
    if not isinstance(model, ca.Function):  # of an observer, of an export
        function = getattr(model, "function", getattr(model, "step", model))
    if not isinstance(function, ca.Function):
        raise InputError(
            f"A {type(given).__name__} cannot be planned with; give a Fit, an observer, an export, or a "
            "casadi.Function (x, u) -> (x_next, y)."
        )
    if function.n_in() != 2 or function.n_out() != 2 or function.size1_in(0) != function.size1_out(0):
        raise InputError(
            f"The function {function.name()} has {function.n_in()} inputs and {function.n_out()} outputs, or another "
            "state behind a step than before; give (x, u) -> (x_next, y)."
        )
    return function


def count(value: Any) -> bool:
    """Whether a value is a whole number of 1 or more."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    return whole and bool(value >= 1)


def path(reference: Any, samples: int, n_y: int) -> Array:
    """A reference (samples, n_y) as one vector; one of a single output may be given without its second dimension."""
    found = numbers(reference, "The reference")
    if found.shape == (samples, n_y) or (n_y == 1 and found.size == samples == max(found.shape, default=0)):
        return found.reshape(-1)
    raise InputError(f"The reference has the shape {found.shape}; give {(samples, n_y)}, a row a sample.")


def within(task: Asked, u: Array, before: Array, rate: Array) -> Array:
    """Inputs moved into the limits and the rates, sample by sample; `before` is the input of the sample before."""
    n, u = len(before), np.clip(u, task.low, task.high)
    if np.any(np.abs(u - np.concatenate([before, u[:-n]])) > rate):
        for k in range(0, len(u), n):
            here = slice(k, k + n)
            slow = np.clip(u[here], before - rate[here], before + rate[here])
            u[here] = before = np.clip(slow, task.low[here], task.high[here])
    return u


def _pair(limits: Any, of: str, shape: tuple[int, int]) -> tuple[Array, Array]:
    """Lower and upper limit over the horizon; infinite is none."""
    if not isinstance(limits, tuple | list) or len(limits) != 2:
        raise InputError(f"The limits of the {of} cannot be {str(limits)[:60]}; give (low, high).")
    if any(v is None for v in limits):
        raise InputError(f"A limit of the {of} is None; give (low, high), infinite where there is no limit.")
    ends = zip(limits, ("lower", "upper"), strict=True)
    low, high = (numbers(v, f"The {end} limit of the {of}", shape, infinite=True).ravel() for v, end in ends)
    if np.any(low >= high):
        raise InputError(f"A lower limit of the {of} is not below its upper one; give (low, high) with low below high.")
    return low, high
