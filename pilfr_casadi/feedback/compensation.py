"""The input for a wanted output: a fitted model inverted one look-ahead at a time.

With `F(x, u) = (f, h)` and a look-ahead of d samples, the input u of a sample solves

    y_{k+d}(x_k, u_{k+i} = u + i (u - u_{k-1})) = wanted_{k+d},

the input going on as it went since the sample before: a scalar equation that is piecewise linear and increasing for
plays (decreasing where the gain is negative). It is solved by Newton steps inside a bracket that each step narrows, for
a fixed number of steps. Where d is the relative degree this is the exact inverse. Sampled machines often
have zeros outside the unit circle (Åström, Hagander & Sternby 1984, Automatica 20); then the exact inverse is unstable,
and a longer look-ahead is taken, under which

    x⁺ = A x + B u,   u = -(g_x x + g_before u_before) / g_u,   g = ∂y_{k+d},

is stable wherever the model has been driven.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from ..checks import numbers
from ..recording import InputError, Recording

if TYPE_CHECKING:
    from ..fit import Fit
    from .kalman import KalmanFilter

Array = np.ndarray
FARTHEST = 12  # samples of look-ahead that are tried
POINTS = 60  # states along the recording at which the inverse has to be stable
STABLE = 0.999  # spectral radius of the inverse that is accepted
FAINT = 0.02  # of the largest gain over the look-aheads and along the recording, below which a gain is not used
STEPS = 40  # of Newton or bisection


@dataclass(frozen=True, eq=False)
class Feedforward:
    """An inverse of a model.

    Attributes
    ----------
    step : casadi.Function
        `(x, u_before, wanted) -> (x_next, u)`: the input for which the output is the wanted one `ahead` samples later,
        and the model's state after it. In feedback, x is the observer's state and x_next is not used.
    ahead : int
        Look-ahead, samples.
    limits : tuple of float
        Smallest and largest input; a wanted output out of reach gets one of them.
    """

    step: ca.Function
    ahead: int
    limits: tuple[float, float]

    def inputs(self, wanted: Array, x0: Array | None = None) -> Array:
        """Inputs (M, 1) for a whole wanted path (M,), from the state x0 (at rest by default), without feedback."""
        path = numbers(wanted, "The wanted path")
        if path.size < 1 or path.size != max(path.shape, default=0):
            raise InputError(f"A path of the shape {path.shape} was given; give one output over at least one sample.")
        path = path.ravel()
        shifted = np.concatenate([path[self.ahead :], np.full(min(self.ahead, len(path)), path[-1])])
        start = np.zeros(self.step.size1_in(0)) if x0 is None else numbers(x0, "The state").ravel()
        x, before, wanted_then = ca.MX.sym("x", len(start)), ca.MX.sym("before"), ca.MX.sym("wanted")
        following, u = self.step(x, before, wanted_then)
        both = ca.Function("both", [ca.vertcat(x, before), wanted_then], [ca.vertcat(following, u), u])
        begin = np.append(start, np.clip(0.0, *self.limits))
        return np.asarray(both.mapaccum("path", len(path))(begin, shifted[None, :])[1]).T


def feedforward(
    fit: Fit,
    recording: Recording,
    *,
    limits: tuple[float, float] | None = None,
    ahead: int | None = None,
    observer: KalmanFilter | None = None,
) -> Feedforward:
    """A compensator for a whole model: the input for a wanted output, hysteresis and dynamics inverted.

    Parameters
    ----------
    fit : Fit
        A model of one input and one output.
    recording : Recording
        Where the model works; the inverse has to be stable along it. Usually the training recording.
    limits : (low, high), optional
        Of the input; by default those of the recording.
    ahead : int, optional
        Look-ahead in samples; by default the shortest under which the inverse is stable.
    observer : KalmanFilter, optional
        Where the compensator works on an observer's state, the observer, for its disturbances.

    Returns
    -------
    Feedforward

    Raises
    ------
    InputError
        If the model cannot be inverted: more outputs than inputs or more than one, an input that reaches no output
        within the look-ahead, or no stable inverse.
    """
    model = fit.model
    if model.n_y > model.n_u:
        raise InputError(
            f"The model has {model.n_y} outputs and {model.n_u} input(s), which cannot make all of them follow wanted "
            "paths; fit a model of one output, or use predictive control."
        )
    if model.n_u != 1 or model.n_y != 1:
        raise InputError(
            f"The model has {model.n_u} inputs and {model.n_y} output(s); the compensator inverts models of one input "
            "and one output, so fit such a one, or use predictive control."
        )
    try:
        low, high = (np.min(recording.u), np.max(recording.u)) if limits is None else map(float, limits)
    except (TypeError, ValueError):
        low = high = np.nan
    if not low < high:
        raise InputError(f"Limits of the input of {limits!r} were given; give (low, high) with low below high.")
    function = fit.to_casadi()
    found = _look_ahead(fit, function, recording, ahead)
    step = inverse_step(function if observer is None else observer.function, found, (float(low), float(high)))
    return Feedforward(step, found, (float(low), float(high)))


def inverse_step(function: ca.Function, ahead: int, limits: tuple[float, float]) -> ca.Function:
    """`(x, u_before, wanted) -> (x_next, u)` of any scalar `F(x, u)`; see `feedforward`."""
    n, reached = function.size1_in(0), _reached(function, ahead)
    # the bracket (u, low, high) moves; x, u_before, wanted and the sign of the gain are passed on beside it
    whole = ca.MX.sym("whole", n + 6)
    u, low, high, x = whole[0], whole[1], whole[2], whole[3 : 3 + n]
    before, wanted, way = whole[3 + n], whole[4 + n], whole[5 + n]
    value, _, _, slope = reached(x, before, u)
    error = way * (value - wanted)
    below, above = ca.if_else(error < 0, u, low), ca.if_else(error < 0, high, u)
    newton = u - error / (way * slope)
    inside = ca.logic_and(newton >= below, newton <= above)  # false for what is no number
    following = ca.vertcat(ca.if_else(inside, newton, (below + above) / 2), below, above, whole[3:])
    narrowed = ca.Function("narrowed", [whole], [following]).fold(STEPS)
    x, before, wanted = ca.MX.sym("x", n), ca.MX.sym("u_before"), ca.MX.sym("wanted")
    ends = [reached(x, before, limit)[0] for limit in limits]
    begin = ca.vertcat(ca.fmin(ca.fmax(before, limits[0]), limits[1]), *limits)
    found = narrowed(ca.vertcat(begin, x, before, wanted, ca.if_else(ends[1] > ends[0], 1.0, -1.0)))[0]
    names = ["x", "u_before", "wanted"], ["x_next", "u"]
    return ca.Function("feedforward", [x, before, wanted], [function(x, found)[0], found], *names)


def _reached(function: ca.Function, ahead: int) -> ca.Function:
    """`(x, u_before, u) -> (y, y_x, y_before, y_u)`, y the output after `ahead` samples of a ramp."""
    x, before, u = ca.SX.sym("x", function.size1_in(0)), ca.SX.sym("before"), ca.SX.sym("u")
    state = x
    for i in range(ahead):
        state = function(state, u + i * (u - before))[0]
    y = function(state, u + ahead * (u - before))[1]
    slopes = [ca.densify(ca.jacobian(y, v)) for v in (x, before, u)]
    return ca.Function("reached", [x, before, u], [y, *slopes])


def _look_ahead(fit: Fit, function: ca.Function, recording: Recording, asked: int | None) -> int:
    """The look-ahead that was asked for, or the shortest that is stable, each at states along the recording."""
    if asked is not None and (not isinstance(asked, int | np.integer) or not 0 <= asked <= 1000):
        raise InputError(f"A look-ahead of {asked!r} samples was given; give a whole number, 0 or more.")
    n, tried = fit.model.n_x, range(FARTHEST + 1) if asked is None else [asked]
    states = np.asarray(function.mapaccum("states", len(recording))(fit.initial_state(recording), recording.u.T)[0])
    at = np.unique(np.linspace(1, len(recording) - 1, POINTS).astype(int))
    x, u = ca.SX.sym("x", function.size1_in(0)), ca.SX.sym("u")
    following = function(x, u)[0]
    moves: Any = ca.Function("moves", [x, u], [ca.jacobian(following, x), ca.jacobian(following, u)])
    linear = [[np.asarray(v) for v in moves(states[:, k - 1], recording.u[k])] for k in at]
    gains, held, radii = [], [], []
    for d in tried:
        reached, poles, constant = _reached(function, d), [], []
        for k, (a, b) in zip(at, linear, strict=True):
            slopes = reached(states[:, k - 1], recording.u[k - 1], recording.u[k])
            _, g_x, g_before, g_u = (np.asarray(v) for v in slopes)
            gain = float(g_u.item())
            constant.append(abs(gain + float(g_before.item())))
            if gain:
                feedback = -np.hstack([g_x[:, :n], g_before]) / gain
                inverse = np.vstack([np.hstack([a[:n, :n], np.zeros((n, 1))]) + b[:n] @ feedback, feedback])
                poles.append((abs(gain), float(np.max(np.abs(np.linalg.eigvals(inverse))))))
        # where a play sticks the gain may vanish, as in a dead zone; there the input jumps and stays in its bracket
        usual = float(np.median([g for g, _ in poles] + [0.0] * (len(at) - len(poles))))
        gains.append(usual)
        held.append(float(np.median(constant)))  # that of an input that does not go on, which does not grow with d
        radii.append(max((radius for g, radius in poles if g > FAINT * usual), default=0.0))
    if max(gains) <= 1e-12 * np.ptp(recording.y) / np.ptp(recording.u):
        raise InputError(
            f"The input reaches the output nowhere within {tried[-1]} samples (no direct feedthrough, no path through "
            "the states that holds along the recording), so there is nothing to invert; give a longer ahead."
        )
    for d, gain, radius in zip(tried, gains, radii, strict=True):
        if gain > FAINT * max(held) and radius < STABLE:
            return int(d)
    which = f"{asked}" if asked is not None else f"0 to {FARTHEST}"
    raise InputError(
        f"The model has no stable inverse with a look-ahead of {which} samples (non-minimum phase: its "
        f"inverse has a pole of magnitude {min(radii):.3f}); use predictive control."
    )
