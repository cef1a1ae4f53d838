"""Evaluations of functional mock-up units for model exchange, in processes of their own.

Units crash and hang, mostly at some values of their parameters. An evaluation that ends or blocks the process gives
NaN, and the next one starts a new process. One message asks for one point, or for a whole run of a compiled model that
calls the unit (`run_in_unit`). A message and its reply take some 15 µs: nothing beside a run, and ten times as long as
a small unit itself needs for one point. So single points are evaluated in the user's process once the unit's own
process has answered with the same parameters. A unit that crashes at some states then ends the user's process as well,
unless the environment variable PILFR_ISOLATED is set.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import math
import os
import pickle
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from .._base import (
    ChildProcess,
    abandoned,
    end_with_parent,
    open_replies,
    read_message,
    units_are_isolated,
    write_message,
)
from .external import Leaf
from .fmu_description import tidy
from .fmu_instance import FmuEvaluation, FmuFile, FmuSignals, UnitError, evaluation

LOADING_SECONDS = 60.0  # further seconds that the first job of a unit may take
CALL_SECONDS = 5.0  # seconds that another job may take
PACE = 20.0  # further seconds, over those of the slowest job of its kind and length
MOST_IDLE = 4  # processes that wait for their next job
MOST_LOSSES = 3  # processes that a point's parameters may end before they count as failed
POINT, CALL = b"p", b"c"  # kinds of jobs, the first byte of a message


class _UnitProcess(ChildProcess):
    """A process that holds one instance of one unit."""

    def __init__(self, file: FmuFile) -> None:
        super().__init__(serve)
        self.file, self.owner, self.jobs = file, os.getpid(), 0
        self.signals: FmuSignals | None = None  # evaluated by POINT

    def ask(self, kind: bytes, body: bytes, limit: float) -> bytes:
        """Send a job; return the reply."""
        begin = time.monotonic()
        self.deadline = begin + limit + (0.0 if self.jobs else _loading.get(self.file, LOADING_SECONDS))
        write_message(self.inbox, kind + body)
        reply = read_message(self.outbox)
        self.deadline = math.inf
        if not self.jobs:
            _loading.setdefault(self.file, CALL_SECONDS + time.monotonic() - begin)
        self.jobs += 1
        return reply

    def describe_end(self) -> str:
        """Describe in words how the process ended."""
        code = self.exit_status()
        if self.expired:
            return "takes too long"
        how = f"signal {-code}" if code is not None and code < 0 else f"status {code}"
        return f"ends the process that runs it ({how})"


_loading: dict[FmuFile, float] = {}  # further seconds for the first job of another process of a unit
_idle: list[_UnitProcess] = []
_idle_lock = threading.Lock()
_evaluation_lock = threading.Lock()  # the unit has one instance in this process


def _take(file: FmuFile) -> _UnitProcess:
    """Take an idle process of a unit, or a new one; a forked process leaves those of its parent alone."""
    with _idle_lock:
        for process in _idle:
            if process.file == file and process.owner == os.getpid():
                _idle.remove(process)
                return process
    return _UnitProcess(file)


def _give_back(process: _UnitProcess) -> None:
    with _idle_lock:
        _idle.append(process)
        excess = _idle.pop(0) if len(_idle) > MOST_IDLE else None
    if excess is not None and excess.owner == os.getpid():
        excess.close()


def _ask(signals: FmuSignals, kind: bytes, body: bytes, limit: float) -> tuple[bytes, str]:
    """Send a job to a process of the unit; return the reply, or how the process failed."""
    process = _take(signals.file)
    try:
        if kind == POINT and process.signals != signals:
            process.ask(CALL, pickle.dumps((_select, (signals,))), limit)
            process.signals = signals
        reply = process.ask(kind, body, limit)
    except (OSError, EOFError, ValueError):
        failure = process.describe_end()
        process.close()
        return b"", failure
    except BaseException:
        process.close()  # its reply is still to come
        raise
    _give_back(process)
    return reply, ""


def run_in_unit(
    signals: FmuSignals, function: Callable[..., Any], arguments: tuple[Any, ...], size: int
) -> tuple[Any, str]:
    """Call a function of a module in a process of the unit; return its result, or None and the failure.

    `size` is the length of the job, such as its number of samples, by which earlier jobs of the same function limit its
    time.
    """
    key = signals, function
    limit = LOADING_SECONDS if key not in _pace else CALL_SECONDS + PACE * size * _pace[key]
    begin = time.monotonic()
    reply, failure = _ask(signals, CALL, pickle.dumps((function, arguments)), limit)
    if failure:
        return None, failure
    _pace[key] = max(_pace.get(key, 0.0), (time.monotonic() - begin) / max(size, 1))
    result, failure = pickle.loads(reply)
    if isinstance(failure, Exception):
        raise failure
    return result, failure


_pace: dict[Any, float] = {}  # most seconds by length, by unit and function


class FmuFunction(Leaf):
    """A unit as a `casadi.Function` `(t, x, u, p) -> (derivatives, outputs)`; if it fails, its results are NaN.

    Attributes
    ----------
    failure : str
        How its process failed first.
    """

    def __init__(self, name: str, signals: FmuSignals) -> None:
        self.signals, self.failure = signals, ""
        self._losses: dict[bytes, int] = {}  # lost processes by parameter values
        self._answered: set[bytes] = set()  # parameter values at which a process has answered
        super().__init__(name, signals.sizes, signals.results)

    def eval_buffer(self, arguments: list[memoryview], results: list[memoryview]) -> int:
        """Evaluate one point, for CasADi."""
        z = b"".join(bytes(a) for a in arguments)
        np.frombuffer(results[0])[:] = self.evaluate(z)
        return 0

    def evaluate(self, z: bytes) -> np.ndarray:
        """Evaluate one point, in a process of the unit until it has answered with these parameters, or always.

        The unit is not called in an abandoned run or by a diverged simulation, nor again with parameters at which it
        has ended `MOST_LOSSES` processes.
        """
        point, none = np.frombuffer(z), np.full(self.signals.results, np.nan)
        if abandoned.pending or not math.isfinite(point.sum()):
            return none
        parameters = point[len(point) - self.signals.sizes[3] :].astype(np.float32).tobytes()
        isolated = units_are_isolated() or parameters not in self._answered
        if not isolated and (here := _evaluation_here(self.signals)) is not None:
            with _evaluation_lock:
                if not here.instance.failed[0]:  # a restart may end the process
                    return np.array(here.evaluate(point))
        if self._losses.get(parameters, 0) >= MOST_LOSSES:
            return none
        reply, failure = _ask(self.signals, POINT, z, CALL_SECONDS)
        if not failure and len(reply) == 8 * self.signals.results:
            self._answered.add(parameters)
            return np.frombuffer(reply)
        if failure:
            self._losses[parameters] = self._losses.get(parameters, 0) + 1
        self.failure = self.failure or failure or f"fails ({reply.decode()})"
        return none


@functools.cache
def _evaluation_here(signals: FmuSignals) -> FmuEvaluation | None:
    """Return the evaluations of a unit in this process; None if it cannot be loaded here, or is often restarted."""
    if signals.file.restarts:
        return None
    with contextlib.suppress(UnitError, OSError, AttributeError):
        return evaluation(signals)
    return None


def has_time_event(signals: FmuSignals) -> bool:
    """Tell whether a unit has announced an event in time."""
    found, _ = run_in_unit(signals, _has_time_event, (signals,), 1)
    return bool(found)


def _has_time_event(signals: FmuSignals) -> bool:
    return evaluation(signals).instance.has_time_event


def serve() -> None:
    """Do jobs in the child process: read them from standard input, write results to standard output."""
    replies = open_replies()
    threading.Thread(target=end_with_parent, args=(os.getppid(),), daemon=True).start()
    while True:
        try:
            job = read_message(sys.stdin.buffer)
        except EOFError:
            os._exit(0)
        kind, body = job[:1], job[1:]
        try:
            if kind == POINT:
                found = evaluation(_selected[0]).evaluate(np.frombuffer(body)).tobytes()
            else:
                function, arguments = pickle.loads(body)
                found = pickle.dumps((function(*arguments), ""))
        except (UnitError, OSError, AttributeError) as error:
            found = tidy(error).encode() if kind == POINT else pickle.dumps((None, tidy(error)))
        except Exception as error:
            found = pickle.dumps((None, error))
        write_message(replies, found)


_selected: list[FmuSignals] = []  # in the child process: the signals that POINT evaluates


def _select(signals: FmuSignals) -> None:
    _selected[:] = [signals]


@atexit.register
def _close_idle() -> None:
    for process in _idle:
        if process.owner == os.getpid():
            process.close()
