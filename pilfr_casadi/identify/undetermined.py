"""Sentences about what recordings do not determine in a fit: memories, and gains that hold only beyond them.

An operator that never slips in a periodic steady state keeps any memory: its row of the state's slope over a period is
a row of the identity, every value in an interval is a steady state, and the outputs differ by a constant. A fit uses
the memory reached from rest.

The gain of a `dc_gain` constraint applies after an infinite time, to motions so large that every play slips (`slope` 1)
or so small that every play sticks (0). A fit may meet it outside the data, by operators whose thresholds exceed all
motions, or by a slow pole. So the gain is computed a second time, over the samples of the longest recording and without
the operators that never slip (for small motions: with the operators that have no threshold),

    gain_M = C' (Σ_{k<M} A'^k) B' + D',   with the blocks of the constraint at S = diag(Σ_j w_ij), j slipping.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..models import PrandtlIshlinskii, Stop, with_port_gain
from ..optimise import Gain, Problem, undetermined_memory

Array = np.ndarray
APART = 0.05  # difference of gains, relative to the largest wanted gain, that is reported


def describe_open_memory(problem: Problem, theta: Array) -> str:
    """Name the recordings that do not determine some memories; empty if there are none."""
    counts = {}
    for k, (r, state) in enumerate(zip(problem.recordings, problem.first_states(theta), strict=True)):
        if r.begins == "periodic" and problem.model.n_s and np.all(np.isfinite(state)):
            period = problem.model.drive(r)[: (r.period or 1) * problem.model.substeps]
            open_memory = undetermined_memory(
                problem.engine, period, problem.parameters(theta), state, problem.model.n_x, problem.scale
            )
            counts[r.label if len(problem.recordings) == 1 or r.name else f"recording {k + 1}"] = len(open_memory)
    found = [f"{count} in {label}" for label, count in counts.items() if count]
    if not found:
        return ""
    return (
        f"operators that never slip in a steady period: {', '.join(found)}; their memory cannot be determined "
        "from the period; it shifts the outputs, and the value reached from rest was used"
    )


def describe_reached_gain(problem: Problem, theta: Array) -> str:
    """Name the gains that hold only beyond the recordings, and why; empty if there are none."""
    found = []
    values, moved = problem.values(theta), None
    samples = max(len(r) for r in problem.recordings)
    for c, rows in zip(problem.constraints, problem.g_slices, strict=True):
        if not isinstance(c.expression, Gain):
            continue
        if moved is None:
            moved = find_slipping(problem, theta, values)
        low, high = problem.g_lower[rows], problem.g_upper[rows]
        room = APART * float(np.max(np.abs(np.concatenate([low, high])), initial=0.0))
        limits = low - room, high + room
        whole, within, odd = channel_weights(problem.model.element, values, c.expression.slope, moved)
        if _is_outside(gain_over(values, whole, None), *limits):
            continue  # the limits report a gain that is not met at all
        reached = gain_over(values, within, samples)
        if not _is_outside(reached, *limits):
            continue
        by_range = _is_outside(gain_over(values, within, None), *limits)
        by_time = _is_outside(gain_over(values, whole, samples), *limits)
        why = []
        if odd and (by_range or not by_time):
            why.append(odd)
        if by_time or not by_range:
            why.append(f"the response takes more than the {samples} recorded samples to settle")
        shown = ", ".join(f"{g:.3g}" for g in reached)
        found.append(f"{c.name} holds only beyond the recordings: {' and '.join(why)}; within them it is {shown}")
    return "; ".join(found)


def _is_outside(gain: Array, low: Array, high: Array) -> bool:
    """Tell whether an entry of a gain lies outside its limits, or is nan."""
    return bool(np.any(~((low <= gain) & (gain <= high))))


def find_slipping(problem: Problem, theta: Array, values: Mapping[str, Array]) -> Array:
    """Find the operators that slip in some recording, (channels, N); none without an element."""
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


def channel_weights(
    element: object, values: Mapping[str, Array], slope: float, moved: Array
) -> tuple[Array, Array, str]:
    """Sum each channel's weights (n_w,), of all operators and of those active in the recordings; describe the rest."""
    if not isinstance(element, PrandtlIshlinskii):
        return np.zeros(0), np.zeros(0), ""
    w, stops = values["w"], isinstance(element.operator, Stop)
    whole = slope * w.sum(axis=1)
    if slope not in (0.0, 1.0):
        return whole, whole, ""
    if (slope == 1.0) != stops:  # large motions
        odd, reason = ~moved, "never slip in them"
    else:
        odd, reason = values["r"] <= 0, "have no threshold below which they stick"
    odd = odd & (w > 0)
    active = odd if slope == 0.0 else ~odd
    return whole, (w * active).sum(axis=1), f"{int(odd.sum())} of {w.size} operators {reason}" if np.any(odd) else ""


def gain_over(values: Mapping[str, Array], weight: Array, samples: int | None) -> Array:
    """Compute the gain (n_y n_u,), row by row, for Σw of each channel, after `samples`, or in the limit if None."""
    a, b, c, d = (values[k] for k in ("A", "B_u", "C_y", "D_yu"))
    if len(weight):
        a, b, c, d = with_port_gain(values, np.diag(weight))
    n = len(a)
    with np.errstate(over="ignore", invalid="ignore"):
        if samples is None:
            state = np.linalg.lstsq(np.eye(n) - a, b, rcond=None)[0] if n else b
        else:
            step = np.block([[a, b], [np.zeros((b.shape[1], n)), np.eye(b.shape[1])]])
            state = np.linalg.matrix_power(step, samples)[:n, n:]
        return np.asarray(c @ state + d).ravel()
