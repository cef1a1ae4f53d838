"""What the diagnoses of real recordings share: a free run judged as the publications do, and the printed answer.

The corrected simulator's parameters are held; its state at the first sample is fitted to the first few samples of the
recording and the rest is simulated without looking at the output again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pilfr_casadi.data import Recording
from pilfr_casadi.diagnose import Diagnosis, Fitted, Workbench
from pilfr_casadi.diagnose.workbench import THOROUGH
from pilfr_casadi.engine import make_engine
from pilfr_casadi.simulators import Simulator


def free_run(simulator: Simulator, recording: Recording, hold: str, first: int = 0) -> np.ndarray:
    """Simulated minus measured outputs (M, n_y), the state at the start as given, or fitted to the `first` samples."""
    held = simulator.with_parameters({k: replace(p, fixed=True) for k, p in simulator.parameters.items()})
    bench = Workbench.of(held, [recording.slice(0, first).with_(skip=0) if first else recording], hold)
    model = bench.model(held)
    state = np.zeros(model.n_state)
    if not isinstance(recording.initial, str):
        state[: len(recording.initial)] = recording.initial
    elif first and len(state):
        fitted = bench.fit(held, solver=THOROUGH)
        return started(fitted, recording, hold, fitted.initial[0])
    engine = make_engine(model)
    return np.asarray(engine.simulate(model.drive(recording), model.parameters.start, state)[0] - recording.y)


def started(fitted: Fitted, recording: Recording, hold: str, state: np.ndarray) -> np.ndarray:
    """Simulated minus measured outputs (M, n_y) of a fitted simulator from a given state with memory."""
    bench = Workbench.of(fitted.simulator, [recording], hold)
    return bench.result(fitted.simulator, fitted.values, [state], fitted.engine, fitted.model).residual[0]


def rmse(error: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(error))))


def answer(diagnosis: Diagnosis) -> list[tuple[str, str, str, float]]:
    """(port, law, form, confidence) of each effect."""
    return [(e.port, e.law, e.form, e.confidence) for e in diagnosis.effects]


def table(title: str, rows: Sequence[tuple[str, Sequence[float | None]]], columns: Sequence[str]) -> str:
    """Aligned rows of figures; a dash where there is none."""
    head = f"{title:<44}" + "".join(f"{c:>18}" for c in columns)
    lines = [head]
    for name, values in rows:
        lines.append(f"{name:<44}" + "".join(f"{'-' if v is None else format(v, '.3g'):>18}" for v in values))
    return "\n".join(lines)
