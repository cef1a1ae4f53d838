"""An observer of a fitted model's states and memory: an extended Kalman filter as one CasADi Function.

With `F(x, u) = (f, h)`, `C = ∂h/∂x` at the prediction and `A = ∂f/∂x` at the corrected state,

    S = C P C' + R,   K = P C' S⁻¹,   x̂ = x + K (y - h(x, u)),   P̂ = (I - K C) P (I - K C)' + K R K',
    x⁺ = f(x̂, u),     P⁺ = A P̂ A' + Q.

The Jacobian of min and max is that of the active branch, so the filter switches with the operators: a play that sticks
keeps the variance of its memory, one that slips takes over that of the signal that drives it. Memory has process noise,
without which a filter that has become sure of it would not correct it any more. Anderson & Moore (1979), Optimal
Filtering, Sec. 8.2. An unscented filter predicts as well, within three percent, at four times the work (`python -m
problems.observer`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, numbers
from ..data import Recording
from .along import Observable, along

Array = np.ndarray
TENTH = 0.1
PROBES = 5  # states and inputs at which an observer's model is compared with a fit
SHARES = 10.0 ** np.arange(-4.5, -0.4, 0.5)  # process noise a step, as shares of the states' spread


@dataclass(frozen=True, eq=False)
class KalmanFilter:
    """An observer with its noise levels and where it begins.

    Attributes
    ----------
    function : casadi.Function
        The model `(x, u) -> (x_next, y)` that is observed, with the disturbances of the outputs behind its
        state where they were asked for.
    step : casadi.Function
        `(x, P, u, y) -> (x_next, P_next, y_pred)`: x and y_pred are predicted from the samples before the present one,
        whose u and y they have not seen.
    x0, P0 : array, shape (n,), (n, n)
        State at rest, and the covariance of one that is not known.
    Q, R : array, shape (n, n), (n_y, n_y)
        Covariances of process and measurement noise.
    spread : array, shape (n,)
        Root mean square of each state over the recording that the levels come from.
    """

    function: ca.Function
    step: ca.Function
    x0: Array
    P0: Array
    Q: Array
    R: Array
    spread: Array

    def __str__(self) -> str:
        share = np.sqrt(np.diag(self.Q)[0]) / self.spread[0] if len(self.spread) and self.spread[0] else 0.0
        noise = ", ".join(f"{v:.3g}" for v in np.sqrt(np.diag(self.R)))
        return (
            f"extended Kalman filter of {len(self.x0)} states (memory included), {self.step.size1_in(2)} inputs and "
            f"{self.step.size1_in(3)} outputs\nnoise of the outputs, std: {noise}; process noise a step: {share:.2g} "
            "of each state's size"
        )

    __repr__ = __str__

    def run(self, u: Array, y: Array, x0: Array | None = None, P0: Array | None = None) -> tuple[Array, Array, Array]:
        """Filter a whole recording: states (M + 1, n) before each sample and after the last, predictions (M, n_y), P.

        A start that is known is told by `P0=filter.Q`; by default it is not.

        Raises
        ------
        InputError
            If u, y, x0 or P0 do not fit the model.
        """
        n = len(self.x0)
        u, y = (numbers(v, name) for v, name in ((u, "u"), (y, "y")))
        if not u.size or not y.size or not u.ndim or not y.ndim:
            raise InputError("There are no samples to filter; give at least one.")
        u, y = u.reshape(len(u), -1), y.reshape(len(y), -1)
        P = self.P0 if P0 is None else numbers(P0, "P0")
        if P.shape != (n, n) or not np.allclose(P, P.T) or not _semidefinite(P):
            raise InputError(
                f"P0 of the shape {P.shape} was given; give a covariance, ({n}, {n}), symmetric and with no negative "
                "eigenvalue."
            )
        x = self.x0 if x0 is None else numbers(x0, "The state").ravel()
        n_u, n_y = int(self.step.size1_in(2)), int(self.step.size1_in(3))
        if len(u) != len(y) or u.shape[1] != n_u or y.shape[1] != n_y or len(x) != n:
            raise InputError(
                f"u {u.shape}, y {y.shape} and a state of {len(x)} numbers were given to the filter; give (samples, "
                f"{n_u}), (samples, {n_y}) and {n} numbers."
            )
        steps = self.step.mapaccum("run", len(u), 2)
        xs, ps, predicted = (np.asarray(v) for v in steps(x, P, u.T, y.T))
        return np.vstack([x, xs.T]), predicted.T, ps[:, -n:]


def _semidefinite(P: Array) -> bool:
    """Whether no direction has a negative variance; in units of each state's own, as states differ by decades."""
    size = np.sqrt(np.maximum(np.diag(P), 0.0))
    if np.any(np.diag(P) < 0) or np.any(P[size == 0] != 0):
        return False
    size = np.where(size > 0, size, 1.0)
    return bool(np.min(np.linalg.eigvalsh(P / np.outer(size, size)), initial=0.0) >= -1e-9)


def kalman_filter(
    fit: Observable, recording: Recording, *, disturbance: bool = False, share: float | None = None
) -> KalmanFilter:
    """An extended Kalman filter of a model, with noise levels from what the model leaves of a recording.

    The measurement noise has the variance of the residual of the free simulation. The process noise of each state and
    each memory is a share of its root mean square over the recording, by default the one under which the recording's
    one-step predictions are likeliest.

    Parameters
    ----------
    fit : Fit, Diagnosis, Simulator or Exported
        The model: of a diagnosis its corrected simulator; an export with `start=` the recording. Where inputs are
        interpolated, the filter's u are those of a sample and of the next one, as the export's.
    recording : Recording
        Usually the training recording.
    disturbance : bool
        Observe a slow disturbance of each output as well, `y = h(x, u) + d, d⁺ = d`: what the model leaves out is then
        followed, and control is free of offset. Its usual size is that of the residual, or a tenth of the output's
        standard deviation.
    share : float, optional
        Standard deviation of the process noise a step over the root mean square of the state.

    Returns
    -------
    KalmanFilter

    Raises
    ------
    InputError
        If the recording does not fit the model, or the share is not positive.
    """
    if share is not None and not (isinstance(share, int | float | np.number) and 0 < share < np.inf):
        raise InputError(f"The share of process noise is {share!r}; give a number above 0, such as 1e-3.")
    run = along(fit, recording, "kalman_filter")
    function, start = run.function, run.states[:, 0]
    if not len(start) and not disturbance:
        raise InputError("The model has neither states nor memory to observe; ask for disturbance=True.")
    residual = (recording.y - run.y)[run.scored :]
    spread = np.sqrt(np.mean(run.states[:, 1:] ** 2, axis=1))
    spread[run.clock] = 0.0  # the time is known
    spread = np.maximum(spread, 1e-6 * np.max(spread, initial=1e-300))
    spread[run.clock] = 0.0
    level = np.mean(residual**2, axis=0)
    if disturbance:
        function = disturbed(function)
        size = np.maximum(np.sqrt(level), TENTH * np.std(recording.y, axis=0))
        start, spread = np.concatenate([start, np.zeros(len(level))]), np.concatenate([spread, size])
    noise = np.diag(np.maximum(level, 1e-16 * np.mean(recording.y**2, axis=0) + 1e-300))
    made = [_filter(function, spread, noise, s) for s in (SHARES if share is None else [share])]
    return min(made, key=lambda f: _surprise(f, run.u, recording.y, start)) if len(made) > 1 else made[0]


def _filter(function: ca.Function, spread: Array, noise: Array, share: float) -> KalmanFilter:
    process = np.diag((share * spread) ** 2)
    step = ekf_step(function, process, noise)
    return KalmanFilter(function, step, np.zeros(len(spread)), np.diag(spread**2), process, noise, spread)


def disturbed(function: ca.Function) -> ca.Function:
    """`F(x, u)` with a constant disturbance of each output, which stands behind the state."""
    n, n_u, n_y = function.size1_in(0), function.size1_in(1), function.size1_out(1)
    x, d, u = (ca.SX.sym(k, m) for k, m in (("x", n), ("d", n_y), ("u", n_u)))
    following, y = function(x, u)
    names = ["x", "u"], ["x_next", "y"]
    return ca.Function("disturbed", [ca.vertcat(x, d), u], [ca.vertcat(following, d), y + d], *names)


def observed(function: ca.Function, observer: Any, recording: Recording) -> ca.Function:
    """The function of an observer, which has to be one of this model, with or without disturbances behind its state.

    Raises
    ------
    InputError
        If it is none.
    """
    if not isinstance(observer, KalmanFilter):
        raise InputError(f"A {type(observer).__name__} was given as the observer; give a kalman_filter of this fit.")
    theirs, n = observer.function, function.size1_in(0)
    extra = theirs.size1_in(0) - n
    same = extra in (0, function.size1_out(1)) and theirs.size1_in(1) == function.size1_in(1)
    rng, size = np.random.default_rng(0), float(np.max(np.abs(recording.u)))
    for _ in range(PROBES if same else 0):
        x, u = size * rng.standard_normal(n), size * rng.standard_normal(function.size1_in(1))
        own, other = function(x, u), theirs(np.append(x, np.zeros(extra)), u)
        pairs = (own[0], other[0][:n]), (own[1], other[1])
        same = same and all(np.allclose(np.asarray(a), np.asarray(b), rtol=1e-9, atol=0.0) for a, b in pairs)
    if not same:
        raise InputError("The observer is one of another model; give a kalman_filter of the same fit.")
    return theirs


def ekf_step(function: ca.Function, Q: Array, R: Array) -> ca.Function:
    """One step `(x, P, u, y) -> (x_next, P_next, y_pred)` of the extended Kalman filter around any `F(x, u)`.

    Parameters
    ----------
    function : casadi.Function
        `(x, u) -> (x_next, y)`.
    Q, R : array, shape (n, n), (n_y, n_y)
        Covariances of process and measurement noise.
    """
    n, n_u, n_y = function.size1_in(0), function.size1_in(1), function.size1_out(1)
    x, u, y, p = (ca.MX.sym(k, *size) for k, size in (("x", (n,)), ("u", (n_u,)), ("y", (n_y,)), ("P", (n, n))))
    symbols = ca.SX.sym("x", n), ca.SX.sym("u", n_u)
    following, output = function(*symbols)
    slopes = ca.Function("slopes", symbols, [ca.jacobian(following, symbols[0]), ca.jacobian(output, symbols[0])])
    _, predicted = function(x, u)
    c = ca.densify(slopes(x, u)[1])
    gain = ca.solve(c @ p @ c.T + R, c @ p).T
    corrected = x + gain @ (y - predicted)
    left = ca.MX.eye(n) - gain @ c
    certain = left @ p @ left.T + gain @ ca.DM(R) @ gain.T
    a = ca.densify(slopes(corrected, u)[0])
    covariance = a @ certain @ a.T + Q
    covariance = (covariance + covariance.T) / 2
    names = ["x", "P", "u", "y"], ["x_next", "P_next", "y_pred"]
    return ca.Function("observer", [x, p, u, y], [function(corrected, u)[0], covariance, predicted], *names)


def _surprise(observer: KalmanFilter, u: Array, y: Array, start: Array) -> float:
    """Minus twice the mean log-likelihood of one-step predictions with errors of their own size, up to a constant."""
    used = slice(None, 2048)
    u, y = u[used], y[used]
    _, predicted, _ = observer.run(u, y, start, observer.Q + 1e-6 * observer.P0)
    error = (y - predicted)[len(y) // 10 :]
    size = np.mean(error**2, axis=0)
    return float(np.sum(np.log(size))) if np.all(np.isfinite(size)) else np.inf
