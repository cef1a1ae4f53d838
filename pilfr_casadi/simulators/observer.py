"""The core of every state estimator of the package: Kalman gains, the measurement update, output injection.

With a state of covariance P, outputs `y = C x + noise` of covariance R, and a step `x⁺ = A x`,

    S = C P C' + R,   K = A P C' S⁻¹,   P̂ = (I - K C) P (I - K C)' + K R K'   (A = I).

`A = I` gives the gain of a filter, which corrects the present state; any other A the gain of a one-step predictor. The
extended Kalman filter (`control.kalman_filter`) and the smoother of an unknown force (`report`) call the update in
every sample. With the steady-state gain the predictor is a model itself,

    x⁺ = f(x, u, p) + γ K (y_measured - y),

which can be fitted like any other: γ is a fixed parameter named `observer`, 1 gives the predictor and 0 the simulation.
Fits that start far from the truth are annealed through it. Anderson & Moore (1979), Optimal Filtering, ch. 4-5.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from ..models import Model, Parameter

INJECTION = "observer"  # name of the parameter γ
FADING = 1 - 1e-4  # factor on A that makes an integrator no output sees detectable; 1e-4 a sample is far below any fit


def innovation_gain(S: Any, P: Any, C: Any, A: Any = None) -> Any:
    """Gain `A P C' S⁻¹`, shape (n, n_y), of arrays or CasADi matrices; A is the identity by default."""
    solve = ca.solve if isinstance(P, ca.MX) else np.linalg.solve
    return solve(S, C @ P if A is None else C @ P @ A.T).T


def measurement_update(P: Any, C: Any, R: Any) -> tuple[Any, Any, Any]:
    """Covariance S of the innovation, filter gain, and covariance after a measurement, of arrays or CasADi matrices."""
    S = C @ P @ C.T + R
    gain = innovation_gain(S, P, C)
    left = np.eye(P.shape[0]) - gain @ C
    return S, gain, left @ P @ left.T + gain @ R @ gain.T


def steady_state_gain(a: np.ndarray, c: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
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
    for fading in (1.0, FADING):
        try:
            p = solve_discrete_are(fading * a.T, c.T, q + 1e-12 * max(np.trace(q) / n, 1e-300) * np.eye(n), r)
            gain = innovation_gain(c @ p @ c.T + r, p, c, a)
            radius = np.max(np.abs(np.linalg.eigvals(a - gain @ c)))
        except (np.linalg.LinAlgError, ValueError):
            continue
        if radius < 1 + 1e-6 and np.all(np.isfinite(gain)):
            return np.asarray(gain)
    return np.zeros((n, len(c)))


def with_output_injection(model: Model, gain: np.ndarray) -> Model:
    """Return the model with output injection.

    Parameters
    ----------
    model : Model
        Closed model.
    gain : array, shape (k, n_y)
        Gain of the first k states; memory is not injected into.

    Returns
    -------
    Model
        The same with the parameter `observer` (fixed at 0), reading the measured output as well.
    """
    parameters = model.parameters | {INJECTION: Parameter(0.0, bounds=(0.0, 1.0), fixed=True)}
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
