"""Steps of a functional mock-up unit for co-simulation, by FMPy in a process of its own.

Such units crash, hang and keep hidden memory, and two units that are written in Python would share modules of one name.
A step that fails gives NaN; a step that ends or blocks the process gives NaN and a new process. One call sends many
points to the process.
"""

from __future__ import annotations

import contextlib
import importlib.util
import itertools
import pickle
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from .._base import InputError, quote_error, run_in_worker
from .fmu_instance import unpack

CALL_SECONDS = 60.0  # seconds that a call may take, with a start of the unit
STEP_SECONDS = 0.1  # further seconds for each of its steps


@dataclass(frozen=True)
class Slave:
    """A unit for co-simulation; with `fresh` each step restarts the unit, so that its states can be set."""

    path: Path
    version: str
    token: str
    identifier: str
    fresh: bool = False
    serial: int = field(default_factory=itertools.count().__next__)  # each has an instance of its own

    def __post_init__(self) -> None:
        if importlib.util.find_spec("fmpy") is None:
            raise InputError(f"{self.path} is for co-simulation, which needs FMPy; pip install 'pilfr-casadi[fmu]'.")

    @cached_property
    def _unpacked(self) -> tuple[Path, str]:
        return unpack(self.path)

    def steps(
        self, references: Sequence[int], values: np.ndarray, h: np.ndarray, read: Sequence[int]
    ) -> tuple[np.ndarray, str]:
        """Set variables, do a step and read variables, once for each row.

        Parameters
        ----------
        references : sequence of int
            Variables that are set.
        values : array, (K, len(references))
            Their values. A row that is not finite sets nothing: the unit continues from its present state.
        h : array, (K,)
            Length of the steps, s.
        read : sequence of int
            Variables that are read.

        Returns
        -------
        array, (K, len(read)), NaN where a step failed; and the first failure, empty without one
        """
        folder, key = self._unpacked
        job = self, folder, tuple(references), values, h, tuple(read)
        limit = CALL_SECONDS + STEP_SECONDS * len(h)
        reply = run_in_worker(_SERVE, pickle.dumps(job), limit, key)
        if reply.timed_out or reply.lost:
            what = f"takes more than {limit:g} s" if reply.timed_out else f"ends its process ({reply.lost})"
            return np.full((len(h), len(read)), np.nan), what
        found: tuple[np.ndarray, str] = reply.result
        return found


class _Instance:
    """An instance in the child process."""

    def __init__(self, slave: Slave, folder: Path) -> None:
        from fmpy import fmi2, fmi3

        self.slave, self.time = slave, 0.0
        kind: Any = fmi2.FMU2Slave if slave.version == "2" else fmi3.FMU3Slave
        names = dict(guid=slave.token, modelIdentifier=slave.identifier, instanceName="unit")
        self.unit = kind(unzipDirectory=str(folder), **names)
        self.unit.instantiate()
        number = "Real" if slave.version == "2" else "Float64"
        self.set, self.get = getattr(self.unit, f"set{number}"), getattr(self.unit, f"get{number}")
        self._initialise((), ())

    def _initialise(self, references: tuple[int, ...], values: Sequence[float]) -> None:
        self.time = 0.0
        if self.slave.version == "2":
            self.unit.setupExperiment(startTime=0.0)
        self.unit.enterInitializationMode()
        if references:
            self.set(references, values)
        self.unit.exitInitializationMode()

    def step(self, references: tuple[int, ...], values: np.ndarray, h: float, read: tuple[int, ...]) -> Sequence[float]:
        if references and np.all(np.isfinite(values)):
            if self.slave.fresh:
                self.unit.reset()
                self._initialise(references, values.tolist())
            else:
                self.set(references, values.tolist())
        if h > 0:
            self.unit.doStep(self.time, h)
            self.time += h
        found: Sequence[float] = self.get(read)
        return found

    def close(self) -> None:
        with contextlib.suppress(Exception):
            self.unit.terminate()
        with contextlib.suppress(Exception):
            self.unit.freeInstance()


def _serve(job: tuple[Any, ...]) -> tuple[np.ndarray, str]:
    """Do the steps of a job in the child process; replace an instance whose step fails."""
    slave, folder, references, values, h, read = job
    out, failure = np.full((len(h), len(read)), np.nan), ""
    for k in range(len(h)):
        try:
            if slave not in _instances:
                _instances[slave] = _Instance(slave, folder)
            out[k] = _instances[slave].step(references, values[k], float(h[k]), read)
        except Exception as error:
            failure = failure or quote_error(error, -1)
            if (instance := _instances.pop(slave, None)) is not None:
                instance.close()
            elif not k:
                break  # it does not start at all
    return out, failure


_SERVE = pickle.dumps(_serve)
_instances: dict[Slave, _Instance] = {}
