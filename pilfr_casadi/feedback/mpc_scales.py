"""What counts as one in the cost of a plan where nothing is said, so that a plan does not depend on the units.

    u_scale   half of the width between the limits of an input, 1 where it has none;
    y_scale   a tenth of what an output can do: half of the width between its limits, or half of what it ranges over
              where the model is driven from rest by the lower and by the upper end of u_scale for the whole horizon,
              whichever is smaller; 1 where neither is known.

Both follow from the arguments of the controller alone, so the cost is the same in each call.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

Array = np.ndarray
TENTH = 0.1
LARGEST, SMALLEST = 1e15, 1e-300  # limits and ranges beyond are none


def scale_of_inputs(low: Array, high: Array) -> Array:
    """Of limits (N n_u,)."""
    width = (np.clip(high, -LARGEST, LARGEST) - np.clip(low, -LARGEST, LARGEST)) / 2
    return np.where(width < LARGEST / 4, width, 1.0)


def scale_of_outputs(function: ca.Function, low: Array, high: Array, u: tuple[Array, Array]) -> Array:
    """Of limits (N n_y,) and of the ends (N n_u,) between which the inputs are varied."""
    n_u, n_y = function.size1_in(1), function.size1_out(1)
    samples = len(low) // n_y
    width = np.min(((high - low) / 2).reshape(samples, n_y), axis=0)
    run, rest = function.mapaccum("reached", samples), np.zeros(function.size1_in(0))
    with np.errstate(all="ignore"):
        paths = [np.asarray(run(rest, end.reshape(samples, n_u).T)[1]) for end in u]
        reached = np.ptp(np.hstack(paths), axis=1) / 2
    can = np.min([np.where((v > SMALLEST) & (v < LARGEST), v, np.inf) for v in (width, reached)], axis=0)
    return np.tile(np.where(np.isfinite(can), TENTH * can, 1.0), samples)
