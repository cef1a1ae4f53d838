"""What the diagnoses of real recordings share: a free run judged as the publications do, and the printed answer.

The corrected simulator's parameters are held; its state at the first sample is fitted to the first few samples of the
recording and the rest is simulated without looking at the output again.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pilfr_casadi.data import Recording
from pilfr_casadi.diagnose import Diagnosis, Fitted, Workbench
from pilfr_casadi.diagnose.fits.workbench import THOROUGH
from pilfr_casadi.engine import make_engine
from pilfr_casadi.simulators import Simulator

from .measured_data import measured


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
    return bench.rerun(fitted, initial=[state]).residual[0]


def rmse(error: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(error))))


def given_folder(description: str | None, name: str, arguments: Sequence[str] | None) -> Path | None:
    """Parse a command without options; return the folder of its recordings, or say where they have to be put."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.parse_args(arguments)
    folder = measured(name)
    if folder is None:
        print(f"The recordings are not here; put them into DATA/{name} and run with PILFR_DATA=DATA.")
    return folder


def show(diagnosis: Diagnosis) -> None:
    """Print a diagnosis, and a line for each effect."""
    print(diagnosis)
    for e in diagnosis.effects:
        print(f"found: {e.law} ({e.form}) at {e.port}, confidence {e.confidence:.2f}")


def table(title: str, rows: Sequence[tuple[str, Sequence[float | None]]], columns: Sequence[str]) -> str:
    """Aligned rows of figures; a dash where there is none."""
    head = f"{title:<44}" + "".join(f"{c:>18}" for c in columns)
    lines = [head]
    for name, values in rows:
        lines.append(f"{name:<44}" + "".join(f"{'-' if v is None else format(v, '.3g'):>18}" for v in values))
    return "\n".join(lines)
