"""Memory that a periodic steady state leaves open.

An operator that never slips in a whole period keeps whatever memory it has: its row of `Φ_x`, the slope of the state
behind a period, is that of the identity (`slopes`). Each value in a whole interval is then a steady state, and gives
outputs of another mean. Where periods from rest lead, from zero memory, is what is taken.
"""

from __future__ import annotations

import numpy as np

from ..data import Recording
from ..optimise import Problem

Array = np.ndarray
CHUNK = 512  # samples of a period whose slopes are held at a time
STILL = 1e-12  # difference from the identity that is none


def open_memory(problem: Problem, theta: Array, recording: Recording, state: Array) -> Array:
    """Which memories a period from a steady state leaves alone though outputs see them, indices (k,)."""
    engine, p, n_x = problem.engine, problem.parameters(theta), problem.model.n_x
    rows = CHUNK * problem.model.substeps
    period = problem.model.drive(recording)[: (recording.period or 1) * problem.model.substeps]
    slope, after, seen = np.eye(len(state)), state, np.zeros(len(state))
    for a in range(0, len(period), rows):
        _, jac, after, slope = engine.sensitivity(period[a : a + rows], p, after, slope, np.full(len(p), -1))
        seen = np.maximum(seen, np.max(np.abs(jac / problem.scale[:, None]), axis=(0, 1), initial=0.0))
    still = np.max(np.abs(slope - np.eye(len(state))), axis=1, initial=0.0) <= STILL
    return np.flatnonzero(still[n_x:] & (seen[n_x:] > STILL * np.max(seen, initial=0.0)))


def open_memory_sentence(problem: Problem, theta: Array) -> str:
    """What it means for a result, naming the recordings; empty where every memory is decided."""
    counts = {}
    for k, (r, state) in enumerate(zip(problem.recordings, problem.first_states(theta), strict=True)):
        periodic = r.begins == "periodic"
        if periodic and problem.model.n_s and np.all(np.isfinite(state)):
            counts[r.label if len(problem.recordings) == 1 or r.name else f"recording {k + 1}"] = len(
                open_memory(problem, theta, r, state)
            )
    found = [f"{count} in {label}" for label, count in counts.items() if count]
    if not found:
        return ""
    return (
        f"operators that never slip in a steady period: {', '.join(found)}; the period does not tell their memory, "
        "which shifts the outputs and is taken as periods from rest with zero memory leave it"
    )
