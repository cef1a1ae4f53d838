"""Evaluations of functional mock-up units for model exchange, in processes of their own.

Units crash and hang, mostly at some values of their parameters. If an evaluation ends the process or does not return,
the next one starts a new process. One message asks for one point, or for a whole run (`run_in_unit`): of a compiled
model that calls the unit, or of a function at many points. A message and its reply take some 20 µs.

Nobody knows how long a run may take, so a process limits each call of its unit instead, by the slowest call until then.
"""

from __future__ import annotations

import os
import pickle
import shutil
import sys
import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from .._base import ChildProcess, abandoned, open_replies, quote_error, read_message, write_message
from .fmu_instance import FmuFile, FmuSignals, UnitError, calls, evaluation, owns_folder

LOADING_SECONDS = 60.0  # seconds that the start of a unit may take
CALL_SECONDS = 2.0  # seconds that another call may take
PACE = 20.0  # further seconds, over those of the slowest call
WATCH_SECONDS = 0.1  # interval at which calls are looked at
HANGS = 124  # exit status of a process whose unit does not return, as of the program `timeout`
MOST_IDLE = 4  # processes that wait for their next job
FOLDER = "PILFR_UNIT_FOLDER"  # environment variable: what to remove if the parent ends without doing so
POINT, CALL = b"p", b"c"  # kinds of jobs, the first byte of a message


class _UnitProcess(ChildProcess):
    """A process that holds one instance of one unit."""

    def __init__(self, file: FmuFile) -> None:
        super().__init__(serve, {FOLDER: str(file.folder) if owns_folder(file.folder) else ""})
        self.file, self.owner, self.used = file, os.getpid(), False
        self.signals: FmuSignals | None = None  # evaluated by POINT

    def ask(self, kind: bytes, body: bytes) -> bytes:
        """Send a job; return the reply."""
        abandoned.end = self.process.kill
        try:
            write_message(self.inbox, kind + body)
            return read_message(self.outbox)
        finally:
            abandoned.end = None

    def describe_end(self) -> str:
        """Describe in words how the process ended."""
        code = self.exit_status()
        if code == HANGS:
            return "takes too long"
        how = f"signal {-code}" if code is not None and code < 0 else f"status {code}"
        return f"ends the process that runs it ({how})"


_idle: list[_UnitProcess] = []
_idle_lock = threading.Lock()


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


def _ask(signals: FmuSignals, kind: bytes, body: bytes) -> tuple[bytes, str]:
    """Send a job to a process of the unit; return the reply, or how the process failed.

    If a process crashes that has done jobs before, a new one tries again, because some units crash after many calls.
    """
    process = _take(signals.file)
    retry = process.used
    reply, failure = _ask_process(process, signals, kind, body)
    if failure and retry and not abandoned.pending and process.exit_status() != HANGS:
        reply, failure = _ask_process(_UnitProcess(signals.file), signals, kind, body)
    return reply, failure


def _ask_process(process: _UnitProcess, signals: FmuSignals, kind: bytes, body: bytes) -> tuple[bytes, str]:
    try:
        if kind == POINT and process.signals != signals:
            process.ask(CALL, pickle.dumps((_select, (signals,))))
            process.signals = signals
        reply = process.ask(kind, body)
    except (OSError, EOFError, ValueError):
        failure = process.describe_end()
        process.close()
        return b"", failure
    except BaseException:
        process.close()  # its reply is still to come
        raise
    process.used = True
    _give_back(process)
    return reply, ""


def run_in_unit(signals: FmuSignals, function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[Any, str]:
    """Call a function of a module in a process of the unit; return its result, or None and the failure."""
    reply, failure = _ask(signals, CALL, pickle.dumps((function, arguments)))
    if failure:
        return None, failure
    result, failure = pickle.loads(reply)
    if isinstance(failure, Exception):
        raise failure
    return result, failure


def evaluate_in_unit(signals: FmuSignals, z: bytes) -> tuple[np.ndarray | None, str]:
    """Evaluate one point in a process of the unit; return its results, or None and the failure."""
    reply, failure = _ask(signals, POINT, z)
    if failure or len(reply) != 8 * signals.results:
        return None, failure or f"fails ({reply.decode()})"
    return np.frombuffer(reply), ""


def has_time_event(signals: FmuSignals) -> bool:
    """Tell whether a unit has announced an event in time."""
    found, _ = run_in_unit(signals, _has_time_event, (signals,))
    return bool(found)


def _has_time_event(signals: FmuSignals) -> bool:
    return evaluation(signals).instance.has_time_event


def serve() -> None:
    """Do jobs in the child process: read them from standard input, write results to standard output."""
    replies = open_replies()
    ended = threading.Event()
    watch = threading.Thread(target=_watch, args=(os.getppid(), ended), daemon=True)
    watch.start()
    while True:
        try:
            job = read_message(sys.stdin.buffer)
        except EOFError:
            ended.set()
            watch.join()
        kind, body = job[:1], job[1:]
        try:
            if kind == POINT:
                found = evaluation(_selected[0]).evaluate(np.frombuffer(body)).tobytes()
            else:
                function, arguments = pickle.loads(body)
                found = pickle.dumps((function(*arguments), ""))
        except (UnitError, OSError, AttributeError) as error:
            found = quote_error(error, -1).encode() if kind == POINT else pickle.dumps((None, quote_error(error, -1)))
        except Exception as error:
            found = quote_error(error, -1).encode() if kind == POINT else pickle.dumps((None, error))
        write_message(replies, found)


_selected: list[FmuSignals] = []  # in the child process: the signals that POINT evaluates


def _select(signals: FmuSignals) -> None:
    _selected[:] = [signals]


def _watch(parent: int, ended: threading.Event) -> None:
    """End this process after its parent, or if the unit does not return from a call.

    Seconds are counted in looks, because a process that is stopped (Ctrl-Z) or starved does nothing.
    """
    seen, seconds, loading, slowest = 0, 0.0, LOADING_SECONDS, 0.0
    while os.getppid() == parent and not ended.wait(WATCH_SECONDS):
        now = int(calls[0])
        if now == seen and now % 2:
            seconds += WATCH_SECONDS
            if seconds > CALL_SECONDS + loading + PACE * slowest:
                os._exit(HANGS)
        elif now != seen:
            if seen < 2 <= now:
                loading = seconds  # a restart may take as long
            elif now > 2:
                slowest = max(slowest, seconds)
            seen, seconds = now, 0.0
    if folder := os.environ.get(FOLDER):
        shutil.rmtree(folder, ignore_errors=True)
    os._exit(0)
