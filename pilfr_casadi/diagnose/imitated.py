"""Simple laws that a flexible one may stand for, by the force that it makes.

A law that can imitate others, fitted, is a force along its port's own signal. Which simple law makes nearly the same
force is then a regression of one signal on others, with no simulation in it: the simple law may have been hidden from
the screen, which looks at small doses along a run that is far off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..laws import Law, Local, unit_forces
from ..models import map_points
from ..simulators import signals, states_along
from .candidate import Candidate
from .kinship import FLEXIBLE
from .screen import Scored, start_values
from .workbench import Fitted, Workbench

MOST = 3  # simple laws put up against one that can imitate others
NEAR = 1.5  # times the best error, of what has been fitted well enough
SEEN = 4000  # samples that forces are compared on, about
HUGE = 1e60  # signals that a simulation which diverges comes to


def imitated(bench: Workbench, candidates: Sequence[Candidate], scored: Sequence[Scored]) -> list[Scored]:
    """Simple laws at the best candidate's port whose force is most like its, started there; none where it is simple."""
    best = candidates[0]
    if best.law.id not in FLEXIBLE:
        return []
    near = {type(c.law) for c in candidates if c.port == best.port and c.error < NEAR * best.error}
    entries: dict[type[Law], Scored] = {}
    for s in scored:
        if s.port == best.port and s.law.id not in FLEXIBLE and type(s.law) not in near:
            entries.setdefault(type(s.law), s)
    local = felt(bench, best.fitted, best.port)
    if not entries or not np.all(np.abs([local.z, local.dz]) < HUGE):  # nor nan, as of a root below zero
        return []
    values, law = best.own, best.law
    force = unit_forces(law.at(values), local, [_shape(law, values)])[:, 0] @ _strengths(law, values)
    with np.errstate(over="ignore", invalid="ignore"):
        found = [(*_likest(s.law, local, force), s) for s in entries.values()]
    ranked = sorted((f for f in found if f[0] < 1), key=lambda f: f[0])[:MOST]
    return [replace(s, starts=(start, *s.starts)) for _, start, s in ranked]


def felt(bench: Workbench, fitted: Fitted, port: str) -> Local:
    """What a port feels along the fitted runs of all recordings."""
    simulator, model = fitted.simulator, fitted.model
    index = [p.name for p in simulator.all_ports()].index(port)
    own, parts = signals(simulator), []
    for r, state in zip(bench.recordings, fitted.initial, strict=True):
        with np.errstate(over="ignore", invalid="ignore"):
            x = states_along(model, model.drive(r), fitted.vector, state)[:: model.substeps, : len(simulator.states)]
            slope = np.gradient(r.u, r.dt, axis=0) if bench.hold == "linear" and len(r) > 2 else np.zeros_like(r.u)
            z, dz, *_ = map_points(own, x, r.u, slope, r.dt * np.arange(len(r))[:, None], fitted.vector)
        parts.append((z[:, index, 0], dz[:, index, 0]))
    lengths = tuple(len(z) for z, _ in parts)
    z, dz = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    return Local(z, dz, bench.dt, lengths, from_zero=tuple(r.begins == "zero" for r in bench.recordings))


def _shape(law: Law, values: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in values.items() if k not in law.strength}


def _strengths(law: Law, values: dict[str, Any]) -> np.ndarray:
    return np.concatenate([np.ravel(values[k]) for k in law.strength]) if law.strength else np.ones(1)


def _likest(law: Law, local: Local, force: np.ndarray) -> tuple[float, dict[str, Any]]:
    """Share of a force that a law leaves, beside what gains of the signal and its rate follow, and its start values."""
    shapes = list(law.shapes(local))
    every = max(len(force) // SEEN, 1)
    base = np.column_stack([np.ones_like(local.z), local.z, local.dz])[::every]
    q = np.linalg.svd(base / np.maximum(np.linalg.norm(base, axis=0), 1e-300), full_matrices=False)[0]
    target = force[::every] - q @ (q.T @ force[::every])
    total, best, start = float(target @ target), np.inf, dict[str, Any]()
    made = unit_forces(law, local, shapes)[::every]
    for k, shape in enumerate(shapes):
        columns = made[:, k] - q @ (q.T @ made[:, k])
        if not np.all(np.isfinite(columns)):
            continue
        found = np.linalg.lstsq(columns, target, rcond=1e-9)[0]
        if not law.strength and found[0] <= 0:  # the simulator's gain may scale it, not turn it round
            continue
        left = float(np.sum((target - columns @ found) ** 2)) / max(total, 1e-300)
        if left < best:
            best, start = left, start_values(law, shape, found)
    return best, start
