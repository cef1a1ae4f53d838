"""Estimate the state of a fitted model: simulation along a recording, extended Kalman filter.

With `F(x, u) = (f, h)`, `C = ∂h/∂x` at the prediction and `A = ∂f/∂x` at the corrected state, the filter is

    x̂ = x + K (y - h(x, u)),   x⁺ = f(x̂, u),   P⁺ = A P̂ A' + Q,

with the gain K and the covariance P̂ of `linear.measurement_update`. The derivatives of min and max are taken on the
active branch, so the filter switches with the operators: a play that sticks keeps the variance of its memory, and a
play that slips takes over the variance of the signal that drives it. Memory has process noise; without it the filter
would become certain and stop correcting the memory. Anderson & Moore (1979), Optimal Filtering, Sec. 8.2. An unscented
filter predicts equally well, within three percent, at four times the cost (`python -m problems.observer`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from .._base import LARGEST, InputError, is_number, numbers
from ..data import SAME_STEP, Recording
from ..diagnose import Diagnosis
from ..export import Exported, exported
from ..identify import Fit
from ..linear import measurement_update
from ..models import or_one
from ..simulators import Simulator

Array = np.ndarray
SMALLEST_SPREAD = 1e-6  # of the largest: keeps the covariance regular if a state never moves
DISTURBANCE = 0.1  # of an output's standard deviation: least size of a disturbance, above the error of a usable model
NOISE_SHARES = 10.0 ** np.arange(-4.5, -0.4, 0.5)  # candidates for the process noise per step over the states' spread
CANDIDATE_SAMPLES = 2048  # samples on which these candidates are compared
PROBE_POINTS = 5  # states and inputs at which an observer's model is compared with a fit

ModelSource: TypeAlias = Fit | Diagnosis | Simulator | Exported


@dataclass(frozen=True, eq=False)
class Rollout:
    """A model and its free run along a recording.

    Attributes
    ----------
    model : Exported
        The step; where inputs are interpolated, it also takes the inputs of the next sample.
    recording : Recording
        The recording with the model's channels and units.
    u, y : array, shape (M, n_u), (M, n_y)
        Inputs of the steps, and simulated outputs.
    states : array, shape (n, M + 1)
        States before each sample and after the last.
    linear, clock : list of int
        Entries of x that are neither memory nor time; the entry of the time, if there is one.
    first_scored : int
        First sample of the recording that is scored.
    """

    model: Exported
    recording: Recording
    u: Array
    y: Array
    states: Array
    linear: list[int]
    clock: list[int]
    first_scored: int


def roll_out(source: Any, recording: Recording, verb: str) -> Rollout:
    """Run a fit, a diagnosis, a simulator or an export along a recording; errors name the called `verb`."""
    model, recording = _export_step(source, recording, verb)
    u, start = model.drive(recording), model.x0()
    x_next, y = (np.asarray(v) for v in model.step.mapaccum("rollout", len(u))(start, u.T))
    first = source.scored_from(recording) if isinstance(source, Fit) else recording.skip
    if not (np.all(np.abs(x_next) < LARGEST) and np.all(np.abs(y[:, first:]) < LARGEST)):
        raise InputError(f"The model diverges along the recording, so {verb} cannot use it; give a stable model.")
    memory = {model.states[name] for name in model.memory_names}
    clock = [len(model.states) - 1] if model.timed else []
    linear = [i for i in range(len(model.states)) if i not in memory and i not in clock]
    return Rollout(model, recording, u, y.T, np.column_stack([start, x_next]), linear, clock, first)


def _export_step(source: Any, recording: Recording, verb: str) -> tuple[Exported, Recording]:
    """Export a model with the initial state of the recording; return it and the recording in the model's units."""
    if not isinstance(source, ModelSource):
        raise InputError(
            f"A {type(source).__name__} was given to {verb}; give a Fit, a Diagnosis, a Simulator or an export."
        )
    if not isinstance(recording, Recording) or not len(recording):
        raise InputError(f"A {type(recording).__name__} was given to {verb}; give a Recording of the machine.")
    if isinstance(source, Exported):
        inputs, same_step = source.inputs[: recording.n_u], abs(source.dt / recording.dt - 1) <= SAME_STEP
        if (inputs, source.outputs) != (recording.inputs, recording.outputs) or not same_step:
            raise InputError(
                f"The export steps by {source.dt:g} s from {', '.join(source.inputs)} to {', '.join(source.outputs)}, "
                f"the recording by {recording.dt:g} s from {', '.join(recording.inputs)} to "
                f"{', '.join(recording.outputs)}; give an export with the step and the signals of the recording."
            )
        return source, recording.in_units(source.units)
    options: dict[str, Any] = {"dt": recording.dt, "hold": recording.hold} if isinstance(source, Simulator) else {}
    return exported(source, start=recording, **options), source.matched(recording)


@dataclass(frozen=True, eq=False)
class KalmanFilter:
    """An observer with its noise levels and its initial state.

    Attributes
    ----------
    function : casadi.Function
        The observed model `(x, u) -> (x_next, y)`; with `disturbance=True` its state ends with the disturbances of the
        outputs.
    step : casadi.Function
        `(x, P, u, y) -> (x_next, P_next, y_pred)`. x and y_pred are predictions from earlier samples only.
    x0, P0 : array, shape (n,), (n, n)
        State at rest, at the time of the recording's first sample, and the covariance of an unknown state.
    Q, R : array, shape (n, n), (n_y, n_y)
        Covariances of process and measurement noise.
    spread : array, shape (n,)
        Root mean square of each state over the recording from which the noise levels come.
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
            f"{self.step.size1_in(3)} outputs\nnoise of the outputs, std: {noise}; process noise per step: {share:.2g} "
            "of each state's rms value"
        )

    __repr__ = __str__

    def run(self, u: Array, y: Array, x0: Array | None = None, P0: Array | None = None) -> tuple[Array, Array, Array]:
        """Filter a whole recording.

        Parameters
        ----------
        u, y : array, shape (M, n_u), (M, n_y)
            Inputs and measured outputs, in the units of the model, as `model.matched(recording)` has them.
        x0, P0 : array, optional
            Initial state and its covariance, by default `self.x0` and `self.P0`. For a known state give `P0=filter.Q`.

        Returns
        -------
        states : array, shape (M + 1, n)
            Before each sample and after the last.
        predictions : array, shape (M, n_y)
        P : array, shape (n, n)
            Covariance after the last sample.

        Raises
        ------
        InputError
            If u, y, x0 or P0 do not fit the model, or the process noise is too small for the arithmetic.
        """
        n = len(self.x0)
        u, y = (numbers(v, name) for v, name in ((u, "u"), (y, "y")))
        if not u.ndim or not y.size or not y.ndim or not len(u):
            raise InputError("There are no samples to filter; give at least one.")
        u, y = u.reshape(len(u), -1), y.reshape(len(y), -1)
        P = self.P0 if P0 is None else numbers(P0, "P0")
        if P.shape != (n, n) or not np.allclose(P, P.T) or not _is_semidefinite(P):
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
        try:
            xs, ps, predicted = (np.asarray(v) for v in steps(x, P, u.T, y.T))
        except RuntimeError as error:  # of the factorisation of the innovation's covariance
            raise InputError(
                "The filter's covariance became singular: its process noise is too small beside the states; give "
                "kalman_filter a larger share, such as 1e-2."
            ) from error
        return np.vstack([x, xs.T]), predicted.T, ps[:, -n:]


def kalman_filter(
    fit: ModelSource, recording: Recording, *, disturbance: bool = False, share: float | None = None
) -> KalmanFilter:
    """Design an extended Kalman filter of a model, with noise levels from a recording.

    The measurement noise has the variance of the residual of the free simulation. The process noise of each state and
    each memory is a share of its root mean square over the recording.

    Parameters
    ----------
    fit : Fit, Diagnosis, Simulator or Exported
        The model. A diagnosis stands for its corrected simulator; an export must be made with `start=` the recording.
        With interpolated inputs, the filter's u holds the inputs of this sample and of the next one, as in the export.
        If recordings hold the next values (`hold="next"`), its u is the input that acts until the next sample.
    recording : Recording
        Usually the training recording.
    disturbance : bool
        Also estimate a slow disturbance of each output, `y = h(x, u) + d, d⁺ = d`. It absorbs model errors and removes
        the steady-state error of a controller. Its initial standard deviation is the rms of the residual, and at least
        a tenth of the output's standard deviation.
    share : float, optional
        Standard deviation of the process noise per step over the root mean square of the state. The default maximises
        the likelihood of the one-step predictions of the recording.

    Raises
    ------
    InputError
        If the recording does not fit the model, or the share is not positive.
    """
    if share is not None and not (is_number(share) and 0 < share < np.inf):
        raise InputError(f"The share of process noise is {share!r}; give a number above 0, such as 1e-3.")
    run = roll_out(fit, recording, "kalman_filter")
    function, start = run.model.step, run.states[:, 0]
    if not len(start) and not disturbance:
        raise InputError("The model has neither states nor memory to observe; give disturbance=True.")
    recording = run.recording
    residual = (recording.y - run.y)[run.first_scored :]
    spread = np.sqrt(np.mean(run.states[:, 1:] ** 2, axis=1))
    spread[run.clock] = 0.0  # the time is known
    spread = np.maximum(spread, SMALLEST_SPREAD * np.max(spread, initial=1e-300))
    spread[run.clock] = 0.0
    level = np.mean(residual**2, axis=0)
    if disturbance:
        function = add_disturbances(function)
        size = np.maximum(np.sqrt(level), DISTURBANCE * np.std(recording.y, axis=0))
        start, spread = np.concatenate([start, np.zeros(len(level))]), np.concatenate([spread, size])
    rest = np.zeros(len(start))
    rest[run.clock] = start[run.clock]
    noise = np.diag(np.maximum(level, 1e-16 * np.mean(recording.y**2, axis=0) + 1e-300))
    if share is not None:
        return _build_filter(function, rest, spread, noise, share)
    filters = [_build_filter(function, rest, spread, noise, s) for s in NOISE_SHARES]
    return min(filters, key=lambda f: _prediction_cost(f, run.u, recording.y, start))


def ekf_step(function: ca.Function, Q: Array, R: Array) -> ca.Function:
    """Build one step `(x, P, u, y) -> (x_next, P_next, y_pred)` of the extended Kalman filter of any `F(x, u)`.

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
    x_next, output = function(*symbols)
    slopes = ca.Function("slopes", symbols, [ca.jacobian(x_next, symbols[0]), ca.jacobian(output, symbols[0])])
    _, predicted = function(x, u)
    _, gain, p_corrected = measurement_update(p, ca.densify(slopes(x, u)[1]), ca.DM(R))
    corrected = x + gain @ (y - predicted)
    a = ca.densify(slopes(corrected, u)[0])
    p_next = a @ p_corrected @ a.T + Q
    p_next = (p_next + p_next.T) / 2
    names = ["x", "P", "u", "y"], ["x_next", "P_next", "y_pred"]
    return ca.Function("observer", [x, p, u, y], [function(corrected, u)[0], p_next, predicted], *names)


def add_disturbances(function: ca.Function) -> ca.Function:
    """Append a constant disturbance of each output to the state of `F(x, u)`."""
    n, n_u, n_y = function.size1_in(0), function.size1_in(1), function.size1_out(1)
    x, d, u = (ca.SX.sym(k, m) for k, m in (("x", n), ("d", n_y), ("u", n_u)))
    x_next, y = function(x, u)
    names = ["x", "u"], ["x_next", "y"]
    return ca.Function("disturbed", [ca.vertcat(x, d), u], [ca.vertcat(x_next, d), y + d], *names)


def build_jacobians(function: ca.Function) -> ca.Function:
    """Build the Jacobians `(x, u, ...) -> (A, B, C, D)` of any `F(x, u, ...)`."""
    symbols = [ca.SX.sym(name, function.size1_in(name)) for name in function.name_in()]
    blocks = [ca.densify(ca.jacobian(f, v)) for f in function(*symbols) for v in symbols[:2]]
    return ca.Function("slopes", symbols, blocks)


def observer_function(observer: Any, function: ca.Function, recording: Recording) -> ca.Function:
    """Return the function of an observer; refuse an observer of another model (disturbances are allowed)."""
    if not isinstance(observer, KalmanFilter):
        raise InputError(f"A {type(observer).__name__} was given as the observer; give a kalman_filter of this fit.")
    observed, n = observer.function, function.size1_in(0)
    extra = observed.size1_in(0) - n
    same = extra in (0, function.size1_out(1)) and observed.size1_in(1) == function.size1_in(1)
    rng, size = np.random.default_rng(0), float(np.max(np.abs(recording.u)))
    for _ in range(PROBE_POINTS if same else 0):
        x, u = size * rng.standard_normal(n), size * rng.standard_normal(function.size1_in(1))
        expected, found = function(x, u), observed(np.append(x, np.zeros(extra)), u)
        pairs = (expected[0], found[0][:n]), (expected[1], found[1])
        same = same and all(np.allclose(np.asarray(a), np.asarray(b), rtol=1e-9, atol=0.0) for a, b in pairs)
    if not same:
        raise InputError("The observer belongs to another model; give a kalman_filter of the same fit.")
    return observed


def _build_filter(function: ca.Function, rest: Array, spread: Array, noise: Array, share: float) -> KalmanFilter:
    process = np.diag((share * spread) ** 2)
    step = ekf_step(function, process, noise)
    return KalmanFilter(function, step, rest, np.diag(spread**2), process, noise, spread)


def _prediction_cost(observer: KalmanFilter, u: Array, y: Array, start: Array) -> float:
    """Compute minus twice the mean log-likelihood of one-step predictions, with the variance of their errors.

    It is infinite if the filter cannot be computed with its noise, as with little beside a model without any error.
    """
    u, y = u[:CANDIDATE_SAMPLES], y[:CANDIDATE_SAMPLES]
    try:
        _, predicted, _ = observer.run(u, y, start, observer.Q + 1e-6 * observer.P0)
    except InputError:
        return np.inf
    error = (y - predicted)[len(y) // 10 :]
    size = np.mean(error**2, axis=0)
    return float(np.sum(np.log(size))) if np.all(np.isfinite(size)) else np.inf


def _is_semidefinite(P: Array) -> bool:
    """Tell whether P is positive semidefinite, after scaling, because the states differ by decades."""
    size = np.sqrt(np.maximum(np.diag(P), 0.0))
    if np.any(np.diag(P) < 0) or np.any(P[size == 0] != 0):
        return False
    size = or_one(size)
    return bool(np.min(np.linalg.eigvalsh(P / np.outer(size, size)), initial=0.0) >= -1e-9)
