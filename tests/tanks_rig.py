"""Two tanks in a row, each with an inflow of its own, and a recording of them."""

import numpy as np
from simulated import outputs_of

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Recording, Simulator

DT, M = 0.05, 1200


def tanks(off=1.0, unit=1.0):
    """Two lags in a row, each with an input of its own; the second is measured in another unit."""
    return Simulator(
        lambda x, u, p: {"h1": (u.q1 - x.h1) / p.T1, "h2": (x.h1 + u.q2 - x.h2) / p.T2},
        lambda x: {"upper": x.h1, "lower": unit * x.h2},
        states=("h1", "h2"),
        inputs=("q1", "q2"),
        parameters={"T1": Parameter(0.5 * off, bounds=(0.1, 5)), "T2": Parameter(1.3 * off, bounds=(0.1, 5))},
    )


def recorded():
    """Inputs (M, 2) and noisy outputs (M, 2) of the tanks."""
    rng = np.random.default_rng(0)
    u = np.column_stack([pilfr.multisine(M, f_max=1.5, fs=1 / DT, rng=rng) for _ in range(2)])
    r = Recording(u, np.zeros((M, 2)), DT, ("q1", "q2"), ("upper", "lower"), initial="zero", hold="zero")
    y = outputs_of(tanks(), r)
    return u, y + 2e-3 * rng.standard_normal(y.shape)
