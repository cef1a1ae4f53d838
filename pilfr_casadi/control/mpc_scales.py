"""What counts as one in the cost of a plan where nothing is said, so that a plan does not depend on the units.

    u_scale   half of the width between the limits of an input, 1 where it has none;
    y_scale   half of the width between the limits of an output, or half of what it ranges over where the model is
              driven from rest by the lower and by the upper end of the inputs for the whole horizon, whichever is
              smaller; a tenth of that range where no output limits are given; 1 where nothing is known.

A violated limit costs in proportion to y_scale, a deviation with its square: the smaller y_scale, the less a limit that
cannot be kept counts against the reference. So with limits it is not made as small as without.
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
    """Of limits (N n_y,), 1e20 for none, and of the ends (N n_u,) between which the inputs are varied."""
    n_u, n_y = function.size1_in(1), function.size1_out(1)
    samples = len(low) // n_y
    width = np.min(((high - low) / 2).reshape(samples, n_y), axis=0)
    limited = np.any((np.minimum(-low, high) < LARGEST).reshape(samples, n_y), axis=0)
    run, rest = function.mapaccum("reached", samples), np.zeros(function.size1_in(0))
    with np.errstate(all="ignore"):
        paths = [np.asarray(run(rest, end.reshape(samples, n_u).T)[1]) for end in u]
        reached = np.ptp(np.hstack(paths), axis=1) / 2
    known = [np.where((v > SMALLEST) & (v < LARGEST), v, np.inf) for v in (width, reached)]
    size = np.minimum(*known) * np.where(limited, 1.0, TENTH)
    return np.tile(np.where(np.isfinite(size), size, 1.0), samples)
