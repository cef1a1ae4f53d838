"""Observability of memory: which operators' memory the outputs of a window show, and why the others stay hidden.

The outputs of a window depend on the state at its beginning as `δY = O δx`. With noise of variance R and a state known
to within its usual spread S, the covariance after the window is

    P = (S⁻² + O' R⁻¹ O)⁻¹,

and a memory is hidden if its standard deviation `sqrt(P_jj)` stays near `S_j`. The columns of O tell why: a zero column
belongs to a memory that is wiped out before it leaves a trace, or that no output depends on; several operators that
stick throughout act as one, by their weighted sum.
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
from .estimation import Diagnosed, KalmanFilter

Array = np.ndarray
HIDDEN = 0.5  # of the spread: a memory counts as hidden if the outputs cannot halve its uncertainty
TRACE = 1e-9  # of the largest column of O: a smaller column is rounding


@dataclass(frozen=True, eq=False)
class Visibility:
    """How well the outputs of a window show the state at its beginning.

    Attributes
    ----------
    left : array, shape (n,)
        Standard deviation of each state and memory once the outputs are known, over its usual spread; 0 is seen
        exactly, 1 not at all.
    unseen : tuple of int
        Entries of the state, counted from 0, that are memory and keep half their spread or more.
    sentences : tuple of str
        One sentence for each kind of reason.
    rank : int
        Number of directions of the state that the outputs show better than it was known.
    """

    left: Array
    unseen: tuple[int, ...]
    sentences: tuple[str, ...]
    rank: int

    def __str__(self) -> str:
        return "\n".join(self.sentences)


def visibility(fit: Fit | Diagnosed | Exported, observer: KalmanFilter, x: Array, u: Array) -> Visibility:
    """Find the memory that the outputs show when the inputs u are applied from the state x on.

    Parameters
    ----------
    fit : Fit, Diagnosis or Exported
        The model.
    observer : KalmanFilter
        Its filter, for the noise and the usual spread.
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
    model, n = fit if isinstance(fit, Exported) else exported(fit), len(observer.x0)
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
    traces, slip = _sensitivities(observer, x, u)
    information = np.linalg.eigvalsh(traces.T @ traces)
    left = np.sqrt(np.clip(np.diag(np.linalg.inv(np.eye(n) + traces.T @ traces)), 0, 1))
    kind, names = _memory_names(fit, model)
    unseen = [j for j in names if left[j] > HIDDEN]
    sentences = _reasons(kind, names, unseen, np.linalg.norm(traces, axis=0), slip, len(u))
    return Visibility(left, tuple(unseen), tuple(sentences), int(np.sum(information > 1)))


def _sensitivities(observer: KalmanFilter, x: Array, u: Array) -> tuple[Array, Array]:
    """Outputs of a window by the state at its beginning, in units of noise and spread; sample of each first slip."""
    n = len(x)
    state, drive = ca.SX.sym("x", n), ca.SX.sym("u", u.shape[1])
    following, output = observer.function(state, drive)
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
        slip[np.flatnonzero((slip < 0) & (np.diag(a) == 0))] = k
    return np.vstack(rows) * observer.spread, slip


def _reasons(kind: str, names: dict[int, str], unseen: list[int], size: Array, slip: Array, samples: int) -> list[str]:
    """A sentence for each reason why memory is hidden."""

    def listed(entries: list[int]) -> str:
        return f"{kind} " + ", ".join(names[j] for j in entries)

    if not names:
        return ["The model has no memory to see."]
    tiny = TRACE * np.max(size, initial=0.0)
    wiped = [j for j in unseen if size[j] <= tiny and slip[j] >= 0]
    idle = [j for j in unseen if size[j] <= tiny and slip[j] < 0]
    rest = [j for j in unseen if size[j] > tiny]
    joint, faint = ([j for j in rest if slip[j] < 0], [j for j in rest if slip[j] >= 0])
    out = []
    if not unseen:
        out.append(f"The outputs of {samples} samples see all {len(names)} memories.")
    if wiped:
        out.append(f"{listed(wiped)}: wiped out before a trace reaches an output; its value does not matter.")
    if idle:
        out.append(f"{listed(idle)}: no output depends on it, because its weight is zero.")
    if len(joint) > 1:
        out.append(
            f"{listed(joint)}: stick over all {samples} samples, so the outputs show only their weighted sum; an "
            "excursion that makes them slip one after the other tells them apart."
        )
    elif joint:
        out.append(
            f"{listed(joint)}: sticks over all {samples} samples, and its effect on the outputs drowns in noise or "
            "looks like that of others; an excursion that makes it slip settles it."
        )
    if faint:
        verb = "slip" if len(faint) > 1 else "slips"
        out.append(
            f"{listed(faint)}: {verb} within the window, and the trace left before drowns in noise or looks like "
            "that of others; from then on the signal that drives the operator determines its memory."
        )
    return out


def _memory_names(fit: Any, model: Exported) -> tuple[str, dict[int, str]]:
    """Kind of the memory, and the name and threshold of each entry of the state that is memory."""
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
