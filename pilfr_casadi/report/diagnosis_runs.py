"""Simulations before and after, for the page of a diagnosis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .._base import InputError
from ..data import Recording
from ..diagnose import Diagnosis, Fitted, Workbench
from ..engine import make_engine
from ..optimise import GaussNewton
from ..simulators import Simulator, discretise


def steps(diagnosis: Diagnosis, name: str) -> int | None:
    """Steps a sample in which the simulator "without" or "after" was fitted, where that is known."""
    fitted = diagnosis.evidence.get(name)
    return None if fitted is None else int(fitted.model.substeps)


def replay(bench: Workbench, simulator: Simulator, substeps: int | None = None) -> Fitted | None:
    """Run a simulator at its own values, initial states fitted; None where it diverges."""
    held = simulator.with_parameters({k: replace(p, fixed=True) for k, p in simulator.parameters.items()})
    try:
        model = bench.model(held) if substeps is None else discretise(held, bench.dt, bench.hold, substeps)
        if model.n_state and any(r.begins == "estimate" for r in bench.recordings):
            return bench.fit(held, solver=GaussNewton(max_iterations=20), model=model)
        engine = make_engine(model, bench.engine)
        freed = model.with_parameters(model.parameters.change(**{k: {"fixed": False} for k in model.parameters}))
        problem = bench.problem(freed, engine)
        values = {k: p.value for k, p in model.parameters.items()}
        found = bench.result(held, values, problem.first_states(problem.start), engine, model)
    except (InputError, ValueError, np.linalg.LinAlgError):
        return None
    return found if np.isfinite(found.cost) else None


@dataclass(frozen=True, eq=False)
class Comparison:
    """A recording with its outputs simulated before (refitted) and after (effects put back, or a value let go).

    None where it diverges.
    """

    recording: Recording
    role: str
    before: np.ndarray | None
    after: np.ndarray | None


def comparisons(bench: Workbench, recordings: Sequence[Recording], diagnosis: Diagnosis, role: str) -> list[Comparison]:
    """Simulate recordings before and after; what gates put right in the training recordings is put right here too."""
    for change in (getattr(g, "change", None) for g in diagnosis.gates if role == "test"):
        recordings = [change(r) for r in recordings] if change is not None else recordings
    part = bench.on(recordings)
    before = replay(part, diagnosis.refitted, steps(diagnosis, "without"))
    other = diagnosis.corrected.elements or diagnosis.let_go
    after = replay(part, diagnosis.corrected, steps(diagnosis, "after")) if other else None
    out = []
    for i, r in enumerate(part.recordings):
        named = r.with_(name=r.name or (role if len(part.recordings) == 1 else f"{role} {i + 1}"))
        out.append(Comparison(named, role, *(None if f is None else f.residual[i] + r.y for f in (before, after))))
    return out
