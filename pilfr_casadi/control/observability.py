"""Observability of memory: what the outputs of a window show of the state at its beginning.

The outputs depend on that state as `δY = O δx`. With noise of variance R and a prior standard deviation S of the state,
the covariance after the window is

    P = (S⁻² + O' R⁻¹ O)⁻¹,

and a memory is hidden if its standard deviation `sqrt(P_jj)` stays near `S_j`. The columns of O show the reason. A zero
column means that the memory is wiped out before it affects an output, or that no output depends on it. Several
operators that stick throughout act as one, by their weighted sum.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .._base import InputError, capitalise, numbers
from ..diagnose import Diagnosis
from ..export import Exported, exported
from ..identify import Fit
from ..models import PrandtlIshlinskii
from .estimation import KalmanFilter, build_jacobians

Array = np.ndarray
HIDDEN_SHARE = 0.5  # of the spread: a memory counts as hidden if the outputs cannot halve its uncertainty
ZERO_COLUMN = 1e-9  # of the largest column of O: smaller columns are rounding errors


@dataclass(frozen=True, eq=False)
class Visibility:
    """How well the outputs of a window show the state at its beginning.

    Attributes
    ----------
    left : array, shape (n,)
        Standard deviation of each state and memory once the outputs are known, over its prior standard deviation: 0 if
        the outputs determine it exactly, 1 if they do not show it.
    unseen : tuple of int
        Entries of the state, counted from 0, that are memory and keep at least half of that deviation.
    sentences : tuple of str
        One sentence per reason.
    rank : int
        Number of directions in the state space that the outputs determine.
    """

    left: Array
    unseen: tuple[int, ...]
    sentences: tuple[str, ...]
    rank: int

    def __str__(self) -> str:
        return "\n".join(self.sentences)


def visibility(fit: Fit | Diagnosis | Exported, observer: KalmanFilter, x: Array, u: Array) -> Visibility:
    """Find which memory the outputs show when the inputs u are applied from the state x on.

    Parameters
    ----------
    fit : Fit, Diagnosis or Exported
        The model.
    observer : KalmanFilter
        The filter of the model; it gives the noise and the prior standard deviations.
    x : array, shape (n,)
        State of the observer at the start of the window.
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
    if not isinstance(fit, Fit | Diagnosis | Exported) or not isinstance(observer, KalmanFilter):
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
    sensitivity, first_slip = _differentiate_outputs(observer, x, u)
    information = sensitivity.T @ sensitivity
    left = np.sqrt(np.clip(np.diag(np.linalg.inv(np.eye(n) + information)), 0, 1))
    kind, names = _name_memory(fit, model)
    unseen = [j for j in names if left[j] > HIDDEN_SHARE]
    norms = np.linalg.norm(sensitivity, axis=0)
    sentences = _explain_hidden_memory(kind, names, unseen, norms, first_slip, len(u))
    return Visibility(left, tuple(unseen), tuple(sentences), int(np.sum(np.linalg.eigvalsh(information) > 1)))


def _differentiate_outputs(observer: KalmanFilter, x: Array, u: Array) -> tuple[Array, Array]:
    """Compute `R^-½ O S` and the sample at which each memory first slips, -1 if it never does."""
    n, slopes = len(x), build_jacobians(observer.function)
    weight = 1 / np.sqrt(np.diag(observer.R))
    transition, rows, first_slip = np.eye(n), [], np.full(n, -1)
    for k, value in enumerate(u):
        a, _, c, _ = (np.asarray(block) for block in slopes(x, value))
        x = np.asarray(observer.function(x, value)[0]).ravel()
        rows.append(weight[:, None] * (c @ transition))
        transition = a @ transition
        first_slip[(first_slip < 0) & (np.diag(a) == 0)] = k
    return np.vstack(rows) * observer.spread, first_slip


def _explain_hidden_memory(
    kind: str, names: dict[int, str], unseen: list[int], column_norm: Array, first_slip: Array, samples: int
) -> list[str]:
    """Write a sentence for each reason why memory is hidden."""
    if not names:
        return ["The model has no memory to observe."]
    if not unseen:
        return [f"The outputs of {samples} samples show all {len(names)} memories."]
    slips, zero = first_slip >= 0, column_norm <= ZERO_COLUMN * np.max(column_norm, initial=0.0)
    wiped_out = [j for j in unseen if zero[j] and slips[j]]
    weightless = [j for j in unseen if zero[j] and not slips[j]]
    sticking = [j for j in unseen if not zero[j] and not slips[j]]
    slipping = [j for j in unseen if not zero[j] and slips[j]]
    sticks = (
        f"sticks over all {samples} samples, and its effect on the outputs drowns in noise or looks like the effect "
        "of others; an excursion that makes it slip determines it"
    )
    if len(sticking) > 1:
        sticks = (
            f"stick over all {samples} samples, so the outputs show only their weighted sum; an excursion that makes "
            "them slip one after the other tells them apart"
        )
    slip = (
        f"{'slip' if len(slipping) > 1 else 'slips'} within the window, and the earlier effect on the outputs drowns "
        "in noise or looks like the effect of others; after the slip the signal that drives the operator determines "
        "its memory"
    )
    reasons = {
        "wiped out before a trace reaches an output; its value does not matter": wiped_out,
        "no output depends on it, because its weight is zero": weightless,
        sticks: sticking,
        slip: slipping,
    }
    return [f"{kind} {', '.join(names[j] for j in entries)}: {why}." for why, entries in reasons.items() if entries]


def _name_memory(fit: Any, model: Exported) -> tuple[str, dict[int, str]]:
    """Return the kind of the memory, and the name and threshold of each entry of the state that is memory."""
    places = {model.states[name]: name for name in model.memory_names}
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
    return capitalise(kind), out
