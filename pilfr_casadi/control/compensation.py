"""The input for a wanted output: a fitted model inverted one look-ahead at a time.

With `F(x, u) = (f, h)`, a delay of n samples (`reach`) and a look-ahead of d >= n samples, the input u of a sample
solves

    y_{k+d}(x_k, u_{k+i} = u + min(i, d - n) (u - u_{k-1})) = wanted_{k+d},

the input going on as it went since the sample before, as long as it still reaches the output: a scalar equation that is
piecewise linear and increasing for plays (decreasing where the gain is negative). It is solved by Newton steps inside a
bracket that each step narrows, for a fixed number of steps. Where d = n, nothing comes before n samples and the
equation has one solution, this is the exact inverse. Sampled machines
often have zeros outside the unit circle (Åström, Hagander & Sternby 1984, Automatica 20); then the exact inverse is
unstable, and a longer look-ahead is taken, under which

    x⁺ = A x + B u,   u = -(g_x x + g_before u_before) / g_u,   g = ∂y_{k+d},

is stable wherever the model has been driven. That inverse is an approximate one, and the result says so.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from .._base import InputError, numbers
from ..data import Recording
from .along import Along, Observable, along
from .kalman import KalmanFilter, observed
from .reach import Reach, reach

Array = np.ndarray
FARTHEST = 12  # samples of look-ahead that are tried, from the delay on
LONGEST = 1000  # that may be asked for
STABLE = 0.999  # spectral radius of the inverse that is accepted; more where the model's own is as slow
FAINT = 0.02  # of the largest gain over the look-aheads and along the recording, below which a gain is not used
STEPS = 40  # of Newton or bisection
NOTHING = 1e-9  # of the largest answer, below which an earlier one is none
INPUTS = 31  # between the limits at which the gain's sign is looked at


@dataclass(frozen=True, eq=False)
class Feedforward:
    """An inverse of a model.

    Attributes
    ----------
    step : casadi.Function
        `(x, u_before, wanted) -> (x_next, u)`: the input for which the output is the wanted one `ahead` samples later,
        and the model's state after it. In feedback, x is the observer's state and x_next is not used.
    ahead : int
        Look-ahead, samples: so far ahead the wanted path has to be known (preview).
    limits : tuple of float
        Smallest and largest input; a wanted output out of reach gets one of them.
    delay : int
        Samples after which an input reaches the output at the earliest.
    zeros : array of complex
        Zeros of the linearised model on or outside the unit circle, which forbid the exact inverse.
    note : str
        What the inverse is: exact, or approximate and why.
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
        """Inputs (M, 1) for a whole wanted path (M,), from the state x0 (at rest by default), without feedback."""
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
        shifted = np.concatenate([path[self.ahead :], np.full(min(self.ahead, len(path)), path[-1])])
        x, before, wanted_then = ca.MX.sym("x", len(start)), ca.MX.sym("before"), ca.MX.sym("wanted")
        following, u = self.step(x, before, wanted_then)
        both = ca.Function("both", [ca.vertcat(x, before), wanted_then], [ca.vertcat(following, u), u])
        begin = np.append(start, np.clip(0.0, *self.limits))
        return np.asarray(both.mapaccum("path", len(path))(begin, shifted[None, :])[1]).T


def feedforward(
    fit: Observable,
    recording: Recording,
    *,
    limits: tuple[float, float] | None = None,
    ahead: int | None = None,
    observer: KalmanFilter | None = None,
) -> Feedforward:
    """A compensator for a whole model: the input for a wanted output, hysteresis and dynamics inverted.

    Parameters
    ----------
    fit : Fit, Diagnosis, Simulator or Exported
        A model of one input, held between samples, and one output; of a diagnosis its corrected simulator.
    recording : Recording
        Where the model works; the inverse has to be stable along it. Usually the training recording.
    limits : (low, high), optional
        Of the input; by default those of the recording.
    ahead : int, optional
        Look-ahead in samples; by default the shortest under which the inverse is stable. Beyond the delay the inverse
        is approximate, as where the model has a small response before or none but one input for an output; its print
        says so.
    observer : KalmanFilter, optional
        Where the compensator works on an observer's state, the observer, for its disturbances.

    Returns
    -------
    Feedforward

    Raises
    ------
    InputError
        If the observer is none of this model, or the model cannot be inverted: more outputs than inputs or more than
        one, an input that does not reach the output, or not within the look-ahead asked for, or no stable inverse.
    """
    run = along(fit, recording, "feedforward")
    n_u, n_y = recording.n_u, run.y.shape[1]
    if n_y > n_u:
        raise InputError(
            f"The model has {n_y} outputs and {n_u} input(s), which cannot make all of them follow wanted "
            "paths; fit a model of one output, or use predictive control."
        )
    if n_u != 1 or n_y != 1:
        raise InputError(
            f"The model has {n_u} inputs and {n_y} output(s); the compensator inverts models of one input "
            "and one output, so fit such a one, or use predictive control."
        )
    if len(run.names) > 1:
        raise InputError(
            "The model's input is interpolated between samples, so that a step takes two, and the compensator holds "
            "its own; give exported(simulator, dt=..., hold='zero', start=...), of a diagnosis with its `corrected`."
        )
    try:
        low, high = (np.min(recording.u), np.max(recording.u)) if limits is None else map(float, limits)
    except (TypeError, ValueError):
        low = high = np.nan
    if not (low < high and np.isfinite(high - low)):
        given = "none, and the recording's input is constant" if limits is None else repr(limits)
        raise InputError(
            f"Limits of the input of {given[:60]} were given; give (low, high), finite, with low below high."
        )
    planned = run.function if observer is None else observed(run.function, observer, recording)
    away = reach(fit, run, recording)
    found, why = _look_ahead(run, recording, away, ahead)
    delay, ends = away.delay or 0, (float(low), float(high))
    step = inverse_step(planned, found, ends, delay)
    if found == delay and _both_ways(run, recording, away, ends):
        why = "within the limits the output rises with the input in places and falls in others, so that it is not the "
        why += "output of one input alone"
    elif found == delay and away.early > NOTHING:
        why = f"it has {_percent(away.early)} of its largest response before, which counts as an error of the model"
    return Feedforward(step, found, ends, delay, _outside(away), _note(found, delay, why))


def inverse_step(function: ca.Function, ahead: int, limits: tuple[float, float], delay: int = 0) -> ca.Function:
    """`(x, u_before, wanted) -> (x_next, u)` of any scalar `F(x, u)`; see `feedforward`."""
    n, reached = function.size1_in(0), _reached(function, ahead, delay)
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


def _reached(function: ca.Function, ahead: int, delay: int) -> ca.Function:
    """`(x, u_before, u) -> (y, y_x, y_before, y_u)`, y the output after `ahead` samples, the input going on."""
    x, before, u = ca.SX.sym("x", function.size1_in(0)), ca.SX.sym("before"), ca.SX.sym("u")
    state = x
    for i in range(ahead):
        state = function(state, u + min(i, ahead - delay) * (u - before))[0]
    y = function(state, u + (ahead - delay) * (u - before))[1]
    slopes = [ca.densify(ca.jacobian(y, v)) for v in (x, before, u)]
    return ca.Function("reached", [x, before, u], [y, *slopes])


def _look_ahead(run: Along, recording: Recording, away: Reach, asked: int | None) -> tuple[int, str]:
    """The look-ahead that was asked for, or the shortest that is stable, and why it is not the exact one."""
    whole = isinstance(asked, int | np.integer) and not isinstance(asked, bool)
    if asked is not None and not (whole and 0 <= asked <= LONGEST):
        raise InputError(f"A look-ahead of {asked!r} samples was given; give a whole number from 0 to {LONGEST}.")
    n = away.delay
    if n is None:
        raise InputError(
            "The input reaches the output nowhere along the recording (no direct feedthrough, no path through the "
            "states), so there is nothing to invert; give a model and a recording in which it does."
        )
    if asked is not None and asked < n:
        raise InputError(
            f"The look-ahead is {asked} samples, but the input reaches the output only after {n} (a delay; what "
            f"the model has before is no larger than its errors, {_percent(away.early)} of its largest response); "
            f"know the wanted path {n} samples ahead and give ahead={n} or more, or leave it out."
        )
    tried = range(n, n + FARTHEST + 1) if asked is None else sorted({n, asked})
    found = {d: _inverse(run, recording, away, d) for d in tried}
    held, limit = max(h for _, h, _ in found.values()), _stable(away)
    usable = [d for d, (gain, _, radius) in found.items() if gain > FAINT * held and radius < limit]
    if usable and asked in (None, usable[-1]):
        taken, why = usable[0] if asked is None else asked, ""
        if taken == n:
            return int(n), why
        if found[n][2] >= limit:
            why = f"the exact inverse would be unstable ({_reason(away, found[n][2])})"
        elif n in usable:
            why = "a longer look-ahead was asked for"
        else:
            why = f"only by less than {100 * FAINT:g} % of what follows"
        return int(taken), why
    which = f"{asked}" if asked is not None else f"{n} to {tried[-1]}"
    smallest = min(radius for d, (_, _, radius) in found.items() if asked in (None, d))
    raise InputError(
        f"The model has no stable inverse with a look-ahead of {which} samples (non-minimum phase: "
        f"{_reason(away, smallest)}); use predictive control."
    )


def _inverse(run: Along, recording: Recording, away: Reach, d: int) -> tuple[float, float, float]:
    """Of a look-ahead: usual gain, that of an input which does not go on, spectral radius along the recording."""
    n = len(away.linear[0][0])
    reached, poles, constant = _reached(run.function, d, away.delay or 0), [], []
    for k, (a, b, _, _) in zip(away.at, away.linear, strict=True):
        slopes = reached(away.before[:, k], recording.u[max(k - 1, 0)], recording.u[k])
        _, g_x, g_before, g_u = (np.asarray(v) for v in slopes)
        gain = float(g_u.item())
        constant.append(abs(gain + float(g_before.item())))
        if gain:
            feedback = -np.hstack([g_x[:, run.linear], g_before]) / gain
            inverse = np.vstack([np.hstack([a, np.zeros((n, 1))]) + b @ feedback, feedback])
            poles.append((abs(gain), float(np.max(np.abs(np.linalg.eigvals(inverse))))))
    # where a play sticks the gain may vanish, as in a dead zone; there the input jumps and stays in its bracket
    usual = float(np.median([g for g, _ in poles] + [0.0] * (len(away.at) - len(poles))))
    radius = max((radius for g, radius in poles if g > FAINT * usual), default=0.0)
    return usual, float(np.median(constant)), radius


def _both_ways(run: Along, recording: Recording, away: Reach, ends: tuple[float, float]) -> bool:
    """Whether the output, once the input reaches it, rises with the input in places and falls in others."""
    n = away.delay or 0
    reached, grid = _reached(run.function, n, n), np.linspace(*ends, INPUTS)
    of = [reached(run.states[:, k], recording.u[max(k - 1, 0)], grid[None, :])[3] for k in away.at]
    gains = np.ravel([np.asarray(gain) for gain in of])
    counted = FAINT * float(np.median(np.abs(gains[gains != 0]))) if np.any(gains) else 0.0
    return bool(np.min(gains) < -counted and np.max(gains) > counted)


def _outside(away: Reach) -> Array:
    zeros = away.zeros()
    return zeros[np.argsort(-np.abs(zeros))][: int(np.sum(np.abs(zeros) >= _stable(away)))]


def _stable(away: Reach) -> float:
    """A fit often has slow poles that zeros beside them nearly cancel; those are no reason to refuse."""
    slowest = max(float(np.max(np.abs(np.linalg.eigvals(a)), initial=0.0)) for a, *_ in away.linear)
    return max(STABLE, 1 - (1 - min(slowest, 1.0)) / 10)


def _reason(away: Reach, radius: float) -> str:
    outside = _outside(away)
    if len(outside):
        return f"zeros on or outside the unit circle at {_listed(outside)}"
    return f"along the recording its inverse has a pole of magnitude {radius:.4g}, beyond {_stable(away):.4g}"


def _listed(zeros: Array) -> str:
    """Zeros in words, one of each conjugate pair, at most five."""
    upper = zeros[zeros.imag >= 0]
    named = [f"{z.real:.4g}" + (f" ± {z.imag:.4g}i" if z.imag else "") for z in upper[:5]]
    return ", ".join(named) + (f" and {len(upper) - 5} more" if len(upper) > 5 else "")


def _note(ahead: int, delay: int, why: str) -> str:
    of_delay, of_look = (f"{n} sample" + "s" * (n != 1) for n in (delay, ahead))
    begin = f"An input reaches the output after {of_delay}"
    if not why:
        return f"{begin}: the exact inverse, for a path that is known {of_look} ahead."
    return f"{begin}, but {why}: an approximate inverse, for a path that is known {of_look} ahead."


def _percent(share: float) -> str:
    return f"{100 * share:.1g} %" if share < 0.1 else f"{100 * share:.0f} %"
