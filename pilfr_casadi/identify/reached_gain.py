"""Whether a DC gain that was asked for is reached within what was recorded.

The gain of `known` is that of motions so large that every play slips (`slope` 1), or so small that every one sticks
(0), and of time without end. A fit may meet it beyond the data, which then say nothing against it: by operators whose
thresholds lie beyond all motions, or by a slow pole. So the gain is computed a second time, over the samples of the
longest recording and with the operators that never slip in any left out (for small motions: with those that have no
threshold put in),

    gain_M = C' (Σ_{k<M} A'^k) B' + D',   with the blocks of `known` at S = diag(Σ_j w_ij), j slipping.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..models import PrandtlIshlinskii, Stop
from ..optimise import Gain, Problem

Array = np.ndarray
APART = 0.05  # difference of gains, next to the largest one asked for, that is told


def reached_gain_sentence(problem: Problem, theta: Array) -> str:
    """What it means that a gain is met beyond the recordings alone, one for all; empty where none is."""
    found, at = [], 0
    values, moved = problem.model.parameters.unpack(problem.parameters(theta)), None
    samples = max(len(r) for r in problem.recordings)
    for c, size in zip(problem.constraints, problem.g_sizes, strict=True):
        rows, at = slice(at, at + size), at + size
        if not isinstance(c.expression, Gain):
            continue
        if moved is None:
            moved = slipping(problem, theta, values)
        low, high = problem.g_lower[rows], problem.g_upper[rows]
        room = APART * float(np.max(np.abs(np.concatenate([low, high])), initial=0.0))

        def far(gain: Array, low: Array = low, high: Array = high, room: float = room) -> bool:
            return bool(np.any(~((low - room <= gain) & (gain <= high + room))))

        whole, within, odd = weights(problem.model.element, values, c.expression.slope, moved)
        if far(gain_over(values, whole, None)):
            continue  # not met at all, which is told elsewhere
        reached = gain_over(values, within, samples)
        if not far(reached):
            continue
        range_alone, time_alone = far(gain_over(values, within, None)), far(gain_over(values, whole, samples))
        both = not range_alone and not time_alone
        why = [odd] if (range_alone or both) and odd else []
        why += [f"it settles over more than their {samples} samples"] if time_alone or both else []
        shown = ", ".join(f"{g:.3g}" for g in reached)
        found.append(f"{c.name} holds only beyond the recordings: {' and '.join(why)}; within them it comes to {shown}")
    return "; ".join(found)


def slipping(problem: Problem, theta: Array, values: Mapping[str, Array]) -> Array:
    """Which operators slip in some recording, (channels, N); none without an element."""
    element = problem.model.element
    if not isinstance(element, PrandtlIshlinskii):
        return np.zeros((0, 0), dtype=bool)
    r, n_x, p = values["r"], problem.model.n_x, problem.parameters(theta)
    moved = np.zeros(r.shape, dtype=bool)
    for recording, state in zip(problem.recordings, problem.first_states(theta), strict=True):
        z = problem.engine.simulate(problem.model.drive(recording), p, state, True)[2]
        q = state[n_x:].reshape(r.shape)
        for row in z:
            after = np.clip(q, row[:, None] - r, row[:, None] + r)
            moved |= after != q
            q = after
    return moved


def weights(element: object, values: Mapping[str, Array], slope: float, moved: Array) -> tuple[Array, Array, str]:
    """Σw of each channel (n_w,) as asked for and within the recordings, and how the operators differ in them."""
    if not isinstance(element, PrandtlIshlinskii):
        return np.zeros(0), np.zeros(0), ""
    w, stops = values["w"], isinstance(element.operator, Stop)
    whole = slope * w.sum(axis=1)
    if slope not in (0.0, 1.0):
        return whole, whole, ""
    if (slope == 1.0) != stops:  # large motions
        odd, what = ~moved, "never slip in them"
    else:
        odd, what = values["r"] <= 0, "have no threshold below which they stick"
    odd = odd & (w > 0)
    active = odd if slope == 0.0 else ~odd
    return whole, (w * active).sum(axis=1), f"{int(odd.sum())} of {w.size} operators {what}" if np.any(odd) else ""


def gain_over(values: Mapping[str, Array], weight: Array, samples: int | None) -> Array:
    """Gain (n_y n_u,), row by row, with Σw of each channel, after a number of samples or (None) in the end."""
    a, b, c, d = (values[k] for k in ("A", "B_u", "C_y", "D_yu"))
    if len(weight):
        s = np.diag(weight)
        a, b = a + values["B_w"] @ s @ values["C_z"], b + values["B_w"] @ s @ values["D_zu"]
        c, d = c + values["D_yw"] @ s @ values["C_z"], d + values["D_yw"] @ s @ values["D_zu"]
    n = len(a)
    with np.errstate(over="ignore", invalid="ignore"):
        if samples is None:
            state = np.linalg.lstsq(np.eye(n) - a, b, rcond=None)[0] if n else b
        else:
            step = np.block([[a, b], [np.zeros((b.shape[1], n)), np.eye(b.shape[1])]])
            state = np.linalg.matrix_power(step, samples)[:n, n:]
        return np.asarray(c @ state + d).ravel()
