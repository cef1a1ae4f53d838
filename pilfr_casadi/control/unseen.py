"""Which memory the outputs cannot tell: the limits of observability along a window of inputs, in words.

The outputs of the window depend on the state at its beginning as `δY = O δx`. What they say about it, with independent
noise of variance R and a state known beforehand to within its usual spread S, is the covariance

    P = (S⁻² + O' R⁻¹ O)⁻¹,

and a memory whose standard deviation `sqrt(P_jj)` stays near `S_j` is not seen. Why, the columns of O tell: a column of
zeros belongs to a memory that is wiped out before it leaves a trace, or that no output depends on; several that stick
throughout act as one, by their weighted sum alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, numbers
from ..export import Exported, exported
from ..identify import Fit
from ..models import PrandtlIshlinskii
from .along import Corrected
from .kalman import KalmanFilter

Array = np.ndarray
UNSEEN = 0.5  # left of the spread, from which on a memory counts as not seen
TRACE = 1e-9  # of the largest column, below which a column leaves no trace


@dataclass(frozen=True, eq=False)
class Visibility:
    """What the outputs of a window say about the state at its beginning.

    Attributes
    ----------
    left : array, shape (n,)
        Standard deviation of each state and memory that is left once the outputs are known, over its usual spread; 0 is
        seen exactly, 1 not at all.
    unseen : tuple of int
        Entries of the state, counted from 0, that are memory and left with half their spread or more.
    sentences : tuple of str
        What that means, a sentence for each kind of reason.
    rank : int
        Directions of the state that the outputs see better than it was known.
    """

    left: Array
    unseen: tuple[int, ...]
    sentences: tuple[str, ...]
    rank: int

    def __str__(self) -> str:
        return "\n".join(self.sentences)


def visibility(fit: Fit | Corrected | Exported, observer: KalmanFilter, x: Array, u: Array) -> Visibility:
    """Which memory the outputs see when the inputs u are applied from the state x on.

    Parameters
    ----------
    fit : Fit, Diagnosis or Exported
        The model.
    observer : KalmanFilter
        Its filter, of which the noise and the usual spread are taken.
    x : array, shape (n,)
        State of the observer at the window's beginning.
    u : array, shape (samples, n_u)
        Inputs of the window, as the observer takes them.

    Returns
    -------
    Visibility
        `print` it for the sentences.

    Raises
    ------
    InputError
        If x or u do not fit the model.
    """
    usable = isinstance(fit, Exported) or (callable(getattr(fit, "export", None)) and not isinstance(fit, type))
    if not usable or not isinstance(observer, KalmanFilter):
        raise InputError(
            f"A {type(fit).__name__} and a {type(observer).__name__} were given; give a Fit and its kalman_filter."
        )
    model, function, n = fit if isinstance(fit, Exported) else exported(fit), observer.function, len(observer.x0)
    if n < len(model.states):
        raise InputError(
            f"The observer has {n} states and the model {len(model.states)}; give the model's own observer."
        )
    x, u = numbers(x, "The state").ravel(), numbers(u, "u")
    u = u[:, None] if u.ndim == 1 else u
    if len(x) != n or u.ndim != 2 or u.shape[1] != len(model.inputs) or not len(u):
        raise InputError(
            f"A state of {len(x)} numbers and inputs {u.shape} were given; give {n} numbers and "
            f"(samples, {len(model.inputs)})."
        )
    state, drive = ca.SX.sym("x", n), ca.SX.sym("u", len(model.inputs))
    following, output = function(state, drive)
    slopes = ca.Function(
        "slopes", [state, drive], [following, ca.jacobian(following, state), ca.jacobian(output, state)]
    )
    root = 1 / np.sqrt(np.diag(observer.R))
    carried, rows, slip = np.eye(n), [], np.full(n, -1)
    for k, value in enumerate(u):
        out: Any = slopes(x, value)
        x, a, c = np.asarray(out[0]).ravel(), np.asarray(out[1]), np.asarray(out[2])
        rows.append(root[:, None] * (c @ carried))
        carried = a @ carried
        slips = np.flatnonzero((slip < 0) & (np.diag(a) == 0))
        slip[slips] = k
    traces = np.vstack(rows) * observer.spread
    information = np.linalg.eigvalsh(traces.T @ traces)
    left = np.sqrt(np.clip(np.diag(np.linalg.inv(np.eye(n) + traces.T @ traces)), 0, 1))
    kind, names = _names(fit, model)
    unseen = [j for j in names if left[j] > UNSEEN]
    sentences = _reasons(kind, names, unseen, np.linalg.norm(traces, axis=0), slip, len(u))
    return Visibility(left, tuple(unseen), tuple(sentences), int(np.sum(information > 1)))


def _reasons(kind: str, names: dict[int, str], unseen: list[int], size: Array, slip: Array, samples: int) -> list[str]:
    """A sentence for each kind of reason."""

    def named(entries: list[int]) -> str:
        return f"{kind} " + ", ".join(names[j] for j in entries)

    n_memory, tiny = len(names), TRACE * np.max(size, initial=0.0)
    if not n_memory:
        return ["The model has no memory to see."]
    wiped = [j for j in unseen if size[j] <= tiny and slip[j] >= 0]
    idle = [j for j in unseen if size[j] <= tiny and slip[j] < 0]
    rest = [j for j in unseen if size[j] > tiny]
    joint, faint = ([j for j in rest if slip[j] < 0], [j for j in rest if slip[j] >= 0])
    out = []
    if not unseen:
        out.append(f"The outputs of {samples} samples see all {n_memory} memories.")
    if wiped:
        out.append(f"{named(wiped)}: wiped out before a trace reaches an output; nothing needs to be known of it.")
    if idle:
        out.append(f"{named(idle)}: no output depends on what has the weight zero.")
    if len(joint) > 1:
        out.append(
            f"{named(joint)}: stick over all {samples} samples, so that the outputs see the weighted sum of what "
            "sticks and not each one; an excursion that makes them slip one after the other tells them apart."
        )
    elif joint:
        out.append(
            f"{named(joint)}: sticks over all {samples} samples, and what it adds to the outputs drowns in noise "
            "or looks like that of others; an excursion that makes it slip settles it."
        )
    if faint:
        verb = "slip" if len(faint) > 1 else "slips"
        out.append(
            f"{named(faint)}: {verb} within the window, and the trace left before drowns in noise or looks like "
            "that of others; from then on the signal that drives the operator tells its memory."
        )
    return out


def _names(fit: Any, model: Exported) -> tuple[str, dict[int, str]]:
    """What memory is called, and where each is in the state with its own name, and its threshold where it has one."""
    places = {model.states[name]: name for name in model.sampled.held}
    element = fit.model.element if isinstance(fit, Fit) else None
    if isinstance(fit, Fit) and not isinstance(element, PrandtlIshlinskii):
        return "Memory", {place: str(k + 1) for k, place in enumerate(places)}
    out = {}
    for k, (place, name) in enumerate(places.items()):
        r, shown = model.thresholds.get(name), name
        if isinstance(element, PrandtlIshlinskii):
            channel, i = divmod(k, element.n)
            shown = f"{i + 1}{f' of channel {channel + 1}' if element.channels > 1 else ''}"
        out[place] = shown if r is None else f"{shown} (r = {r:.3g})"
    kind = element.operator.name.replace("_", " ") if isinstance(element, PrandtlIshlinskii) else "memory"
    return f"{kind[0].upper()}{kind[1:]}", out
