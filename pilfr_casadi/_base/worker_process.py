"""A job in a process of its own: killed when its time is up, and gone without harm when it dies.

`do` is what an executor's workers are given. Each worker (a thread, a process, a Dask worker's thread) keeps one child
process, its hand, and sends it one job after the other: a job that hangs, in Python or in compiled code, or one that
the system ends for want of memory takes the hand along, and the worker lives on. The hand ends when its worker does,
however that happened, because its standard input closes; and after `IDLE` seconds without a job.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import pickle
import queue
import subprocess
import sys
import tempfile
import threading
from dataclasses import dataclass
from typing import Any, BinaryIO

IDLE = 60.0  # seconds
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True)
class Reply:
    """What became of a job: its `result`, or in place of it that its time was up, or how the hand was lost."""

    result: Any = None
    timed_out: bool = False
    lost: str = ""
    begun: bool = True  # whether the job had begun when the hand was lost


def do(shared: bytes, job: bytes, limit: float | None = None) -> Reply:
    """Call `pickle.loads(shared)(pickle.loads(job))` in this worker's hand.

    Parameters
    ----------
    shared, job : bytes
        Pickles of a function and of its argument. The hand keeps the function from one job to the next.
    limit : float, optional
        Seconds it may take; starting the hand does not count.
    """
    hand: Hand | None = getattr(_mine, "hand", None)
    if hand is not None and hand.process.poll() is None:
        reply = hand.ask(shared, job, limit)
        if reply.begun:
            return reply  # else it was idle for too long, just now
    if hand is not None:
        hand.close()
    hand = _mine.hand = Hand()
    return hand.ask(shared, job, limit)


def close_hands() -> None:
    """End all hands of this process; jobs in them are lost."""
    for hand in list(_hands):
        hand.close()


class Hand:
    """The child process, seen from the worker."""

    def __init__(self) -> None:
        self.errors = tempfile.TemporaryFile()  # noqa: SIM115
        path = os.pathsep.join(p or os.getcwd() for p in sys.path)
        self.process = subprocess.Popen(
            [sys.executable, "-c", "from pilfr_casadi.hand import serve; serve()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.errors,
            env={**os.environ, **ONE_THREAD, "PYTHONPATH": path},
            start_new_session=True,  # Ctrl-C is for the process that waits for the results
        )
        self.has: bytes | None = None
        self.begun = False  # whether the latest job has been
        _hands.add(self)

    def ask(self, shared: bytes, job: bytes, limit: float | None) -> Reply:
        """One job; see `do`."""
        assert self.process.stdin is not None and self.process.stdout is not None
        expired = threading.Event()

        def strike() -> None:
            expired.set()
            self.process.kill()

        timer = threading.Timer(limit or 0.0, strike)
        timer.daemon = True
        self.begun = False
        try:
            _write(self.process.stdin, (None if shared == self.has else shared, job))
            self.has = shared
            _read(self.process.stdout)  # it has everything
            self.begun = True
            if limit is not None:
                timer.start()
            try:
                return Reply(_read(self.process.stdout))
            finally:
                timer.cancel()
        except (OSError, EOFError, ValueError):
            lost = self._end()
            self.close()
            return Reply(timed_out=True) if expired.is_set() else Reply(lost=lost, begun=self.begun)

    def _end(self) -> str:
        """How the process has ended, in words."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(5)
        code = self.process.poll()
        if code is not None and code < 0:
            return f"its process was ended by signal {-code}"
        with contextlib.suppress(OSError, ValueError):
            self.errors.seek(0)
            lines = self.errors.read().decode(errors="replace").strip().splitlines()
            if lines:
                return f"its process ended: {lines[-1]}"
        return f"its process ended with status {code}"

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout, self.errors):
            with contextlib.suppress(OSError, ValueError):
                if pipe is not None:
                    pipe.close()
        _hands.discard(self)


_mine = threading.local()
_hands: set[Hand] = set()
atexit.register(close_hands)


def serve() -> None:
    """The child process: jobs from standard input, results to standard output, one after the other."""
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a job prints is no reply
    inbox: queue.SimpleQueue[tuple[bytes | None, bytes]] = queue.SimpleQueue()

    def listen() -> None:
        while True:
            try:
                inbox.put(_read(sys.stdin.buffer))
            except (OSError, EOFError):
                os._exit(0)  # the worker is gone

    threading.Thread(target=listen, daemon=True).start()
    function: Any = None
    try:
        while True:
            shared, job = inbox.get(timeout=IDLE)
            if shared is not None:
                function = pickle.loads(shared)
            _write(replies, None)
            _write(replies, function(pickle.loads(job)))
    except queue.Empty:
        os._exit(0)
    except BaseException as error:
        os.write(2, f"{type(error).__name__}: {error}".encode())
        os._exit(1)  # without the interpreter's end, which the thread that listens would disturb


def _write(pipe: Any, content: Any) -> None:
    data = pickle.dumps(content)
    pipe.write(len(data).to_bytes(8, "big") + data)
    pipe.flush()


def _read(pipe: BinaryIO | Any) -> Any:
    size = pipe.read(8)
    if len(size) < 8:
        raise EOFError
    data = pipe.read(int.from_bytes(size, "big"))
    return pickle.loads(data)
