"""A model that is led back to what was measured: output injection with a steady-state Kalman gain.

    x⁺ = f(x, u, p) + γ K (y_measured - y)

γ (`observer`) is a parameter, fixed until changed: 1 gives the predictor, 0 the simulation. Fits that start far from
the truth are annealed through it.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from .model import Model, portless
from .parameters import Parameter

GAMMA = "observer"


def led(model: Model, gain: np.ndarray) -> Model:
    """The model with output injection.

    Parameters
    ----------
    model : Model
        Closed model without a port of its own (`n_w = 0`).
    gain : array, shape (k, n_y)
        Gain of the first k states.

    Returns
    -------
    Model
        The same with the parameter `observer` (fixed at 0), reading the measured output as well.
    """
    parameters = model.parameters | {GAMMA: Parameter(0.0, bounds=(0.0, 1.0), fixed=True)}
    x, u, p = ca.SX.sym("x", model.n_x), ca.SX.sym("u", model.n_u), ca.SX.sym("p", parameters.size)
    measured, w = ca.SX.sym("y", model.n_y), ca.SX.sym("w", 0)
    following, y = model.step(x, u, w, p[:-1])
    full = np.zeros((model.n_x, model.n_y))
    full[: len(gain)] = gain
    following = following + p[-1] * (ca.DM(full) @ (measured - y))
    return portless(
        x,
        ca.vertcat(u, measured),
        p,
        following,
        y,
        parameters,
        states=model.states,
        inputs=model.inputs,
        outputs=model.outputs,
        reads=(*model.reads, "y"),
        substeps=model.substeps,
    )


def kalman_gain(a: np.ndarray, c: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Steady-state gain of the one-step predictor, shape (n_x, n_y); zero where there is none.

    Parameters
    ----------
    a, c : array
        State and output matrices.
    q, r : array
        Covariances of the process and the measurement noise.
    """
    from scipy.linalg import solve_discrete_are

    n = len(a)
    if not n:
        return np.zeros((0, len(c)))
    for fading in (1.0, 1 - 1e-4):  # an integrator that no output sees is let fade, which makes it detectable
        try:
            p = solve_discrete_are(fading * a.T, c.T, q + 1e-12 * max(np.trace(q) / n, 1e-300) * np.eye(n), r)
            gain = np.linalg.solve(c @ p @ c.T + r, c @ p @ a.T).T
            radius = np.max(np.abs(np.linalg.eigvals(a - gain @ c)))
        except (np.linalg.LinAlgError, ValueError):
            continue
        if radius < 1 + 1e-6 and np.all(np.isfinite(gain)):
            return np.asarray(gain)
    return np.zeros((n, len(c)))
