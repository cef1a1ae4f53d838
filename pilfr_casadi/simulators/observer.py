"""A model that is led back to what was measured: output injection with a steady-state Kalman gain.

    x⁺ = f(x, u, p) + γ K (y_measured - y)

γ (`observer`) is a parameter, fixed until changed: 1 gives the predictor, 0 the simulation. Fits that start far from
the truth are annealed through it.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from ..models import Model, Parameter

GAMMA = "observer"


def led(model: Model, gain: np.ndarray) -> Model:
    """The model with output injection.

    Parameters
    ----------
    model : Model
        Closed model.
    gain : array, shape (k, n_y)
        Gain of the first k states; memory is not led.

    Returns
    -------
    Model
        The same with the parameter `observer` (fixed at 0), reading the measured output as well.
    """
    parameters = model.parameters | {GAMMA: Parameter(0.0, bounds=(0.0, 1.0), fixed=True)}
    sizes = (("x", model.n_x), ("u", model.n_u), ("w", model.n_w), ("p", parameters.size), ("y", model.n_y))
    x, u, w, p, measured = (ca.SX.sym(name, n) for name, n in sizes)
    z, s, read = ca.SX.sym("z", model.n_w), ca.SX.sym("s", model.n_s), ca.vertcat(u, measured)
    following, y = model.step(x, u, w, p[:-1])
    full = np.zeros((model.n_x, model.n_y))
    full[: len(gain)] = gain[: model.n_x]
    pushed = p[-1] * (ca.DM(full) @ (measured - y))
    stages = model.stages
    if stages is not None:
        c = ca.SX.sym("c", stages.size1_in(4))
        values, by_c, end = stages(x, u, w, p[:-1], c)
        stages = ca.Function("stages", [x, read, w, p, c], [values, by_c, end + pushed])
    return replace(
        model,
        step=ca.Function("step", [x, read, w, p], [following + pushed, y], ["x", "u", "w", "p"], ["x_next", "y"]),
        port=ca.Function("port", [x, read, p], [model.port(x, u, p[:-1])], ["x", "u", "p"], ["z"]),
        memory=ca.Function("memory", [z, s, p], list(model.memory(z, s, p[:-1])), ["z", "s", "p"], ["w", "s_next"]),
        parameters=parameters,
        reads=(*model.reads, "y"),
        stages=stages,
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
