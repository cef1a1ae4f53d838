"""The model of a plan with every max and min rounded (`export.smoothing`), by no more than the outputs may move."""

from __future__ import annotations

import casadi as ca
import numpy as np

from .._base import InputError
from ..export import smoothed
from .asked import Asked


def rounded(task: Asked, share: float) -> ca.Function | None:
    """The model rounded as far as moves the outputs of a run by less than a share of y_scale; None where none can be.

    The run begins at rest and has inputs anywhere between the limits.
    """
    rng = np.random.default_rng(0)
    low, high = np.maximum(task.low, -task.u_scale), np.minimum(task.high, task.u_scale)
    low, high = np.minimum(low, task.high), np.maximum(high, task.low)
    probe = (low + (high - low) * rng.random(len(low))).reshape(task.horizon, -1).T
    rest, own = np.zeros(task.function.size1_in(0)), None
    for eps in (0.0, *10.0 ** np.arange(3, -16, -0.5)):
        try:
            function = smoothed(task.function.expand(), eps) if eps else task.function
        except (InputError, RuntimeError, NotImplementedError):
            return None
        y = np.asarray(function.mapaccum("rounded", task.horizon)(rest, probe)[1]).ravel(order="F")
        own = y if own is None else own
        if eps and np.max(np.abs(y - own) / task.y_scale) < share:
            return function
    return None
