"""Invert a fitted model: compute the input for a wanted output, with a look-ahead.

With `F(x, u) = (f, h)`, a delay of n samples and a look-ahead of d >= n samples, the input u of a sample solves

    y_{k+d}(x_k, u_{k+i} = u + min(i, d - n) (u - u_{k-1})) = wanted_{k+d}:

so the input continues its last change for as long as this still affects the output. The equation is scalar, piecewise
linear and increasing for plays (decreasing where the gain is negative). A fixed number of Newton steps inside a
shrinking bracket solves it. If d = n, the model does not respond before n samples, and the solution is unique, this is
the exact inverse. Sampled machines often have zeros outside the unit circle (Åström, Hagander & Sternby 1984,
Automatica 20), which make the exact inverse unstable. `feedforward` then takes the shortest longer look-ahead for which

    x⁺ = A x + B u,   u = -(g_x x + g_before u_before) / g_u,   g = ∂y_{k+d},

is stable along the whole recording. That inverse is approximate, and the result says so.

**Delay and zeros.** Linearised at a state of the recording, `A, B, C, D`, the output responds to the input after j
samples by the Markov parameter `m_0 = D, m_j = C A^{j-1} B`. A pure delay of n samples is `m_0 = ... = m_{n-1} = 0`. In
a fit these are small instead of zero, so values within four standard errors, or a thousandth of the largest, count as
zero. Standard errors follow from the covariance of the fit's parameters by the delta method. The zeros are the
eigenvalues of `A - B C A^n / m_n` (`A - B C / D` for n = 0), the poles of the exact inverse; n of them are zero and
stand for the delay.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, is_whole, listed, numbers
from ..data import Recording
from ..identify import Fit, covariance, variance
from ..linear import spectral_radius
from ..optimise import Problem
from .estimation import KalmanFilter, ModelSource, Rollout, build_jacobians, observer_function, roll_out

Array = np.ndarray
EXTRA_LOOK_AHEAD = 12  # samples of look-ahead tried beyond the delay; longer ones gain nothing on the benchmarks
LONGEST_LOOK_AHEAD = 1000  # samples: each sample unrolls the model once
STABLE_RADIUS = 0.999  # spectral radius of an accepted inverse: disturbances fade within some thousand samples
SMALL_GAIN = 0.02  # of the largest gain over the look-aheads and along the recording: smaller gains are model error
NEWTON_STEPS = 40  # Newton or bisection steps: bisection alone then reaches 1e-12 of the bracket
RESPONSE_ROUNDING = 1e-9  # of the largest response: an earlier response below this is rounding
GAIN_INPUTS = 31  # inputs between the limits at which the sign of the gain is checked
LINEARISED_STATES = 60  # states along the recording at which the model is linearised
RESPONSE_SAMPLES = 100  # length of the impulse response
COUNTED_ERRORS = 4.0  # standard errors above which a Markov parameter counts
SMALL_MARKOV = 1e-3  # of the largest Markov parameter: smaller ones count as zero
SMALL_MARKOV_NO_ERRORS = 0.02  # the same where the standard errors are unknown


@dataclass(frozen=True, eq=False)
class Feedforward:
    """An inverse of a model.

    Attributes
    ----------
    step : casadi.Function
        `(x, u_before, wanted) -> (x_next, u)`: the input that gives the wanted output `ahead` samples later, and the
        next state of the model. In feedback, x is the observer's state and x_next is not used.
    ahead : int
        Look-ahead (preview): number of samples by which the wanted path must be known in advance.
    limits : tuple of float
        Smallest and largest input; for an unreachable output, u is one of them.
    delay : int
        Number of samples before an input can reach the output.
    zeros : array of complex
        Zeros of the linearised model on or outside the unit circle, which forbid the exact inverse.
    note : str
        Sentence that says whether the inverse is exact, or why it is approximate.
    """

    step: ca.Function
    ahead: int
    limits: tuple[float, float]
    delay: int = 0
    zeros: Array = field(default_factory=lambda: np.zeros(0))
    note: str = ""

    def __str__(self) -> str:
        return self.note

    def inputs(self, wanted: Array, x0: Array | None = None) -> Array:
        """Compute inputs (M, 1) for a wanted path (M,), from the state x0 (default: at rest), without feedback."""
        path = numbers(wanted, "The wanted path")
        if path.size < 1 or path.size != max(path.shape, default=0):
            raise InputError(f"A path of the shape {path.shape} was given; give one output over at least one sample.")
        path = path.ravel()
        n = int(self.step.size1_in(0))
        start = np.zeros(n) if x0 is None else numbers(x0, "The state").ravel()
        if len(start) != n:
            raise InputError(
                f"A state of {len(start)} numbers was given to the compensator; give {n}, memory included."
            )
        preview = np.concatenate([path[self.ahead :], np.full(min(self.ahead, len(path)), path[-1])])
        x, u_before, y_ahead = ca.MX.sym("x", n), ca.MX.sym("u_before"), ca.MX.sym("wanted")
        x_next, u = self.step(x, u_before, y_ahead)
        augmented = ca.Function("augmented", [ca.vertcat(x, u_before), y_ahead], [ca.vertcat(x_next, u), u])
        start = np.append(start, np.clip(0.0, *self.limits))
        return np.asarray(augmented.mapaccum("path", len(path))(start, preview[None, :])[1]).T


def feedforward(
    fit: ModelSource,
    recording: Recording,
    *,
    limits: tuple[float, float] | None = None,
    ahead: int | None = None,
    observer: KalmanFilter | None = None,
) -> Feedforward:
    """Design a compensator that inverts a whole model, dynamics and hysteresis, to follow a wanted output.

    Parameters
    ----------
    fit : Fit, Diagnosis, Simulator or Exported
        A model of one input, held between samples, and one output. A diagnosis stands for its corrected simulator.
    recording : Recording
        A recording of typical operation, usually the training recording; the inverse must be stable along it.
    limits : (low, high), optional
        Smallest and largest input; by default the range of the recording.
    ahead : int, optional
        Look-ahead in samples; by default the shortest with a stable inverse. The inverse is approximate if the
        look-ahead exceeds the delay, if the model responds a little before the delay, or if several inputs give the
        same output; the printed result says so.
    observer : KalmanFilter, optional
        Observer whose state the compensator reads, including disturbances.

    Raises
    ------
    InputError
        If the observer belongs to another model, or the model cannot be inverted: it has several inputs or outputs, the
        input does not reach the output within the look-ahead, or no inverse is stable.
    """
    run = roll_out(fit, recording, "feedforward")
    recording = run.recording
    _check_ports(run, recording)
    ends = _input_limits(limits, recording)
    function = run.model.step if observer is None else observer_function(observer, run.model.step, recording)
    if ahead is not None and not is_whole(ahead, 0, LONGEST_LOOK_AHEAD):
        raise InputError(
            f"A look-ahead of {ahead!r} samples was given; give a whole number from 0 to {LONGEST_LOOK_AHEAD}."
        )
    response = analyse_response(fit, run, recording)
    chosen, why = _choose_look_ahead(run, response, ahead)
    delay = response.delay
    if chosen == delay and _gain_changes_sign(run, response, ends):
        why = (
            "within the limits the output rises with the input in places and falls in others, so that several inputs "
            "give the same output"
        )
    elif chosen == delay and response.early > RESPONSE_ROUNDING:
        why = f"it has {_percent(response.early)} of its largest response before, counted as a model error"
    step = inverse_step(function, chosen, ends, delay)
    return Feedforward(step, chosen, ends, delay, _unstable_zeros(response), _describe_inverse(chosen, delay, why))


def _check_ports(run: Rollout, recording: Recording) -> None:
    """Refuse models of several inputs or outputs, or with interpolated inputs."""
    n_u, n_y = recording.n_u, run.y.shape[1]
    if n_u != 1 or n_y != 1:
        raise InputError(
            f"The model has {n_u} input(s) and {n_y} output(s); the compensator inverts models of one input and one "
            "output, so fit such a model, or use predictive control."
        )
    if len(run.model.inputs) > 1:
        raise InputError(
            "The model's input is interpolated between samples, but the compensator holds its input; give "
            "exported(simulator, dt=..., hold='zero', start=...), for a diagnosis its `corrected` simulator."
        )


def _input_limits(limits: tuple[float, float] | None, recording: Recording) -> tuple[float, float]:
    """Check the limits of the input; the default is the range of the recording."""
    given = (np.min(recording.u), np.max(recording.u)) if limits is None else limits
    low, high = (float(v) for v in numbers(given, "The input limits", (2,)))
    if not low < high:
        why = ", because the recording's input is constant" if limits is None else ""
        raise InputError(f"The input limits are {low:g} and {high:g}{why}; give limits=(low, high), low below high.")
    return low, high


def inverse_step(function: ca.Function, ahead: int, limits: tuple[float, float], delay: int) -> ca.Function:
    """Invert any scalar `F(x, u)` by a step `(x, u_before, wanted) -> (x_next, u)`; see `feedforward`."""
    n, output_ahead = function.size1_in(0), _output_ahead(function, ahead, delay)
    # iterate on the bracket (u, low, high); x, u_before, wanted and the sign of the gain stay constant
    iterate = ca.MX.sym("iterate", n + 6)
    u, low, high, x = iterate[0], iterate[1], iterate[2], iterate[3 : 3 + n]
    u_before, wanted, sign = iterate[3 + n], iterate[4 + n], iterate[5 + n]
    y, _, _, slope = output_ahead(x, u_before, u)
    error = sign * (y - wanted)
    low, high = ca.if_else(error < 0, u, low), ca.if_else(error < 0, high, u)
    newton = u - error / (sign * slope)
    inside = ca.logic_and(newton >= low, newton <= high)  # false for nan
    narrowed = ca.vertcat(ca.if_else(inside, newton, (low + high) / 2), low, high, iterate[3:])
    solve = ca.Function("solve", [iterate], [narrowed]).fold(NEWTON_STEPS)
    x, u_before, wanted = ca.MX.sym("x", n), ca.MX.sym("u_before"), ca.MX.sym("wanted")
    ends = [output_ahead(x, u_before, limit)[0] for limit in limits]
    start = ca.vertcat(ca.fmin(ca.fmax(u_before, limits[0]), limits[1]), *limits)
    u = solve(ca.vertcat(start, x, u_before, wanted, ca.if_else(ends[1] > ends[0], 1.0, -1.0)))[0]
    names = ["x", "u_before", "wanted"], ["x_next", "u"]
    return ca.Function("feedforward", [x, u_before, wanted], [function(x, u)[0], u], *names)


def _output_ahead(function: ca.Function, ahead: int, delay: int) -> ca.Function:
    """Build the output `ahead` samples later with slopes, `(x, u_before, u) -> (y, y_x, y_before, y_u)`."""
    x, u_before, u = ca.SX.sym("x", function.size1_in(0)), ca.SX.sym("u_before"), ca.SX.sym("u")
    state = x
    for i in range(ahead):
        state = function(state, u + min(i, ahead - delay) * (u - u_before))[0]
    y = function(state, u + (ahead - delay) * (u - u_before))[1]
    slopes = [ca.densify(ca.jacobian(y, v)) for v in (x, u_before, u)]
    return ca.Function("output_ahead", [x, u_before, u], [y, *slopes])


def _choose_look_ahead(run: Rollout, response: Response, ahead: int | None) -> tuple[int, str]:
    """Choose the look-ahead given, or the shortest stable one; also say why its inverse is approximate."""
    n = response.delay
    if ahead is not None and ahead < n:
        raise InputError(
            f"The look-ahead is {ahead} samples, but the input reaches the output only after {n} (a delay; the "
            f"response before is within the model's errors, {_percent(response.early)} of its largest response); "
            f"know the wanted path {n} samples ahead and give ahead={n} or more, or leave it out."
        )
    tried = range(n, n + EXTRA_LOOK_AHEAD + 1) if ahead is None else sorted({n, ahead})
    found = {d: _gain_and_radius(run, response, d) for d in tried}
    largest, limit = max(h for _, h, _ in found.values()), _stability_limit(response)
    usable = [d for d, (gain, _, radius) in found.items() if gain > SMALL_GAIN * largest and radius < limit]
    if usable and ahead in (None, usable[-1]):
        taken = usable[0] if ahead is None else int(ahead)
        if taken == n:
            return taken, ""
        if found[n][2] >= limit:
            return taken, f"the exact inverse would be unstable ({_explain_instability(response, found[n][2])})"
        if n in usable:
            return taken, "a longer look-ahead was given"
        return taken, f"by less than {100 * SMALL_GAIN:g} % of the later response"
    which = f"{ahead}" if ahead is not None else f"{n} to {tried[-1]}"
    smallest = min(radius for d, (_, _, radius) in found.items() if ahead in (None, d))
    raise InputError(
        f"The model has no stable inverse with a look-ahead of {which} samples (non-minimum phase: "
        f"{_explain_instability(response, smallest)}); use predictive control."
    )


def _gain_and_radius(run: Rollout, response: Response, d: int) -> tuple[float, float, float]:
    """Compute the median gain of a look-ahead, the gain of a constant input, and the largest spectral radius."""
    n = len(response.linear[0][0])
    output_ahead, gains, radii, constant = _output_ahead(run.model.step, d, response.delay), [], [], []
    for k, (a, b, _, _) in zip(response.at, response.linear, strict=True):
        slopes = output_ahead(run.states[:, k], run.u[max(k - 1, 0)], run.u[k])
        _, g_x, g_before, g_u = (np.asarray(v) for v in slopes)
        gain = float(g_u.item())
        gains.append(abs(gain))
        constant.append(abs(gain + float(g_before.item())))
        if gain:
            feedback = -np.hstack([g_x[:, run.linear], g_before]) / gain
            inverse = np.vstack([np.hstack([a, np.zeros((n, 1))]) + b @ feedback, feedback])
            radii.append((abs(gain), spectral_radius(inverse)))
    # where a play sticks the gain may vanish, as in a dead zone; there the input jumps, within its bracket
    median = float(np.median(gains))
    radius = max((radius for gain, radius in radii if gain > SMALL_GAIN * median), default=0.0)
    return median, float(np.median(constant)), radius


def _gain_changes_sign(run: Rollout, response: Response, ends: tuple[float, float]) -> bool:
    """Tell whether the output rises with the input in places and falls in others."""
    n = response.delay
    output_ahead, u = _output_ahead(run.model.step, n, n), np.linspace(*ends, GAIN_INPUTS)[None, :]
    slopes = [output_ahead(run.states[:, k], run.u[max(k - 1, 0)], u)[3] for k in response.at]
    gains = np.ravel([np.asarray(slope) for slope in slopes])
    small = SMALL_GAIN * float(np.median(np.abs(gains[gains != 0]))) if np.any(gains) else 0.0
    return bool(np.min(gains) < -small and np.max(gains) > small)


def _unstable_zeros(response: Response) -> Array:
    zeros = response.zeros()
    return zeros[np.argsort(-np.abs(zeros))][: int(np.sum(np.abs(zeros) >= _stability_limit(response)))]


def _stability_limit(response: Response) -> float:
    """Return the spectral radius below which an inverse is stable; slow poles raise it, since zeros may cancel them."""
    slowest = max(spectral_radius(a) for a, *_ in response.linear)
    return max(STABLE_RADIUS, 1 - (1 - min(slowest, 1.0)) / 10)


def _explain_instability(response: Response, radius: float) -> str:
    zeros = _unstable_zeros(response)
    zeros = zeros[zeros.imag >= 0]  # one of each conjugate pair
    if len(zeros):
        shown = [f"{z.real:.4g}" + (f" ± {z.imag:.4g}i" if z.imag else "") for z in zeros]
        return f"zeros on or outside the unit circle at {listed(shown, 5)}"
    return (
        f"along the recording its inverse has a pole of magnitude {radius:.4g}, beyond {_stability_limit(response):.4g}"
    )


def _describe_inverse(ahead: int, delay: int, why: str) -> str:
    delayed, known = (f"{n} sample" + "s" * (n != 1) for n in (delay, ahead))
    kind = f", but {why}: an approximate" if why else ": the exact"
    return f"An input reaches the output after {delayed}{kind} inverse, for a path that is known {known} ahead."


def _percent(share: float) -> str:
    return f"{100 * share:.1g} %" if share < 0.1 else f"{100 * share:.0f} %"


@dataclass(frozen=True, eq=False)
class Response:
    """A model linearised at the samples `at` of a recording; Markov parameters are medians of magnitudes."""

    at: Array
    linear: tuple[tuple[Array, ...], ...]  # (A, B, C, D) of the linear states at each point, with constant memory
    markov: Array  # (RESPONSE_SAMPLES,)
    errors: Array  # standard errors of the Markov parameters, nan where unknown
    delay: int  # samples after which the input reaches the output
    early: float  # largest Markov parameter before the delay at any of the points, over the largest median

    def zeros(self) -> Array:
        """Return the zeros at the point of the median gain, including the n zeros of the delay."""
        gains = [_markov_parameters(point, self.delay + 1)[-1] for point in self.linear]
        k = int(np.argmin(np.abs(np.abs(gains) - np.median(np.abs(gains)))))
        (a, b, c, d), n = self.linear[k], self.delay
        if not gains[k]:
            return np.zeros(0)
        inverse = a - b @ c / d if n == 0 else a - b @ c @ np.linalg.matrix_power(a, n) / gains[k]
        return np.asarray(np.linalg.eigvals(inverse))


def analyse_response(given: Any, run: Rollout, recording: Recording) -> Response:
    """Linearise a model of one input and one output along its run; refuse one that does not respond to the input."""
    function, states = run.model.step, run.states
    at = np.unique(np.linspace(min(1, len(recording) - 1), len(recording) - 1, LINEARISED_STATES).astype(int))
    slopes = build_jacobians(function)
    linear = tuple(_linear_blocks(slopes(states[:, k], run.u[k]), run.linear) for k in at)
    each = np.array([_markov_parameters(point, RESPONSE_SAMPLES) for point in linear])
    markov = np.median(np.abs(each), axis=0)
    typical = int(np.argmin(np.sum(np.abs(np.abs(each) - markov), axis=1)))
    point = states[:, at[typical]], run.u[at[typical]]
    errors = (
        _markov_errors(given, run, recording, *point) if isinstance(given, Fit) else np.full(RESPONSE_SAMPLES, np.nan)
    )
    largest = np.max(markov)
    counts = markov > np.where(
        np.isnan(errors), SMALL_MARKOV_NO_ERRORS * largest, np.maximum(COUNTED_ERRORS * errors, SMALL_MARKOV * largest)
    )
    if not (largest > 1e-12 * np.ptp(recording.y) / max(float(np.ptp(recording.u)), 1e-300) and np.any(counts)):
        raise InputError(
            "The input reaches the output nowhere along the recording (no direct feedthrough, no path through the "
            "states), so there is nothing to invert; give a model and a recording with a response to the input."
        )
    delay = int(np.argmax(counts))
    early = float(np.max(np.abs(each[:, :delay]), initial=0.0) / largest)
    return Response(at, linear, markov, errors, delay, early)


def _linear_blocks(blocks: Any, linear: list[int]) -> tuple[Array, ...]:
    a, b, c, d = (np.asarray(v) for v in blocks)
    return a[np.ix_(linear, linear)], b[linear], c[:, linear], d


def _markov_parameters(point: tuple[Array, ...], samples: int) -> Array:
    """Compute `D, C B, C A B, ...` of one linear model."""
    a, b, c, d = point
    out, state = [d.item()], b
    for _ in range(samples - 1):
        out.append((c @ state).item())
        state = a @ state
    return np.array(out)


def _markov_errors(fit: Fit, run: Rollout, recording: Recording, state: Array, drive: Array) -> Array:
    """Compute standard errors of the Markov parameters at a state; nan where the recording does not determine them."""
    model = fit.model
    parameters = model.parameters
    known = recording.with_(initial=fit.initial_state(recording) if model.n_state else "zero", period=None)
    try:
        problem = Problem(model, known, engine=fit.engine)
    except InputError:  # everything is fixed
        return np.full(RESPONSE_SAMPLES, np.nan)
    slopes, derivatives = build_jacobians(run.model.step_with_parameters("one")), []
    for i in np.flatnonzero(parameters.free):
        step = 1e-6 * max(abs(parameters.start[i]), 1e-3 * np.max(np.abs(parameters.start)))
        moved = [parameters.start + sign * step * (np.arange(parameters.size) == i) for sign in (1, -1)]
        up, down = (
            _markov_parameters(_linear_blocks(slopes(state, drive, value), run.linear), RESPONSE_SAMPLES)
            for value in moved
        )
        derivatives.append((up - down) / (2 * step))
    spread = np.diag(variance(covariance(problem, problem.start, fit.structure), np.array(derivatives).T))
    return np.sqrt(np.where(np.isfinite(spread), np.maximum(spread, 0.0), np.nan))
