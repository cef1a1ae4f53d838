"""After how many samples an input reaches the output, and what stands against an exact inverse: zeros.

Of the model linearised along a recording, `A, B, C, D` at one of its states, the output after j samples follows the
input by the Markov parameter `m_0 = D, m_j = C A^{j-1} B`. A pure delay of n samples is `m_0 = ... = m_{n-1} = 0`. In a
fit these are small instead of zero: what is within four standard errors, or below a thousandth of the largest, counts
as zero. Standard errors come from the covariance of the fit's parameters (`gauge`) by the delta method. The zeros are
the eigenvalues of

    A - B C A^n / m_n      (A - B C / D where n = 0),

the poles of the exact inverse; n of them are zero, those of the delay.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError
from ..data import Recording
from ..identify import Fit, covariance, variance
from ..optimise import Problem
from .along import Along

Array = np.ndarray
POINTS = 60  # states along the recording
SAMPLES = 100  # over which the output's answer is followed
ERRORS = 4.0  # standard errors of a Markov parameter that counts
SMALL, UNKNOWN = 1e-3, 0.02  # of the largest Markov parameter, below which none counts; where errors are not known


@dataclass(frozen=True, eq=False)
class Reach:
    """A model linearised at states along a recording.

    Attributes
    ----------
    at : array, shape (points,)
        Samples of the recording.
    before : array, shape (n_x + n_s, samples + 1)
        States of the model before each sample and after the last.
    linear : tuple
        `(A, B, C, D)` of the linear states at each point, the memory held.
    markov, errors : array, shape (SAMPLES,)
        Median magnitudes of the Markov parameters over the points, and their standard errors (nan where unknown).
    delay : int or None
        Samples after which the input reaches the output; None where it never does.
    early : float
        Largest Markov parameter before the delay at any of the points, over the largest median.
    """

    at: Array
    before: Array
    linear: tuple[tuple[Array, ...], ...]
    markov: Array
    errors: Array
    delay: int | None
    early: float = 0.0

    def zeros(self) -> Array:
        """Zeros at the point of the usual gain, those of the delay included."""
        if self.delay is None:
            return np.zeros(0)
        gains = [_markov(point, self.delay + 1)[-1] for point in self.linear]
        k = int(np.argmin(np.abs(np.abs(gains) - np.median(np.abs(gains)))))
        (a, b, c, d), n = self.linear[k], self.delay
        if not gains[k]:
            return np.zeros(0)
        inverse = a - b @ c / d if n == 0 else a - b @ c @ np.linalg.matrix_power(a, n) / gains[k]
        return np.asarray(np.linalg.eigvals(inverse))


def reach(given: Any, run: Along, recording: Recording) -> Reach:
    """Linearise a model of one input and one output, `run` its run, along a recording."""
    function, before = run.function, run.states
    at = np.unique(np.linspace(min(1, len(recording) - 1), len(recording) - 1, POINTS).astype(int))
    x, u = ca.SX.sym("x", function.size1_in(0)), ca.SX.sym("u")
    slopes = _slopes("slopes", [x, u], x, u, *function(x, u))
    linear = tuple(_of_states(slopes(before[:, k], recording.u[k]), run.linear) for k in at)
    each = np.array([_markov(point, SAMPLES) for point in linear])
    markov = np.median(np.abs(each), axis=0)
    typical = int(np.argmin(np.sum(np.abs(np.abs(each) - markov), axis=1)))
    point = before[:, at[typical]], recording.u[at[typical]]
    errors = _errors(given, recording, *point) if isinstance(given, Fit) else np.full(SAMPLES, np.nan)
    largest = np.max(markov)
    counts = markov > np.where(np.isnan(errors), UNKNOWN * largest, np.maximum(ERRORS * errors, SMALL * largest))
    reached = largest > 1e-12 * np.ptp(recording.y) / max(float(np.ptp(recording.u)), 1e-300) and np.any(counts)
    delay = int(np.argmax(counts)) if reached else None
    early = float(np.max(np.abs(each[:, :delay]), initial=0.0) / largest) if reached else 0.0
    return Reach(at, before, linear, markov, errors, delay, early)


def _slopes(name: str, arguments: list[ca.SX], x: ca.SX, u: ca.SX, following: ca.SX, y: ca.SX) -> ca.Function:
    blocks = [ca.densify(ca.jacobian(f, v)) for f in (following, y) for v in (x, u)]
    return ca.Function(name, arguments, blocks)


def _of_states(blocks: Any, linear: Array) -> tuple[Array, ...]:
    a, b, c, d = (np.asarray(v) for v in blocks)
    return a[np.ix_(linear, linear)], b[linear], c[:, linear], d


def _markov(point: tuple[Array, ...], samples: int) -> Array:
    """`D, C B, C A B, ...` of one linear model."""
    a, b, c, d = point
    out, carried = [d.item()], b
    for _ in range(samples - 1):
        out.append((c @ carried).item())
        carried = a @ carried
    return np.array(out)


def _errors(fit: Fit, recording: Recording, state: Array, drive: Array) -> Array:
    """Standard errors of the Markov parameters at a state; nan where the recording says nothing about them."""
    model = fit.model
    parameters = model.parameters
    known = recording.with_(initial=fit.initial_state(recording) if model.n_state else "zero", period=None)
    try:
        problem = Problem(model, known, engine=fit.engine)
    except InputError:  # everything is fixed
        return np.full(SAMPLES, np.nan)
    x, u, p = ca.SX.sym("x", model.n_state), ca.SX.sym("u"), ca.SX.sym("p", parameters.size)
    slopes = _slopes("slopes", [x, u, p], x, u, *model.closed(x, u, p))
    derivatives = []
    for i in np.flatnonzero(parameters.free):
        step = 1e-6 * max(abs(parameters.start[i]), 1e-3 * np.max(np.abs(parameters.start)))
        moved = [parameters.start + way * step * (np.arange(parameters.size) == i) for way in (1, -1)]
        up, down = (_markov(_of_states(slopes(state, drive, value), np.arange(model.n_x)), SAMPLES) for value in moved)
        derivatives.append((up - down) / (2 * step))
    spread = np.diag(variance(covariance(problem, problem.start, fit.structure), np.array(derivatives).T))
    return np.sqrt(np.where(np.isfinite(spread), np.maximum(spread, 0.0), np.nan))
