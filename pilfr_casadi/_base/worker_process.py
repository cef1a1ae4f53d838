"""A job in a process of its own: killed when its time is up, and its death harms nobody.

An executor's workers call `run_in_worker`. Each of them (a thread, a process, a Dask worker's thread) keeps one child
process and sends it one job after the other: a job that hangs, in Python or in compiled code, or that the system ends
for want of memory takes the child along, and the worker lives on. The child ends when its worker does, however that
happened, because its standard input closes; and after `IDLE_SECONDS` without a job.

Pools of other packages with killable workers (pebble, loky) start them by `multiprocessing`, which Dask's workers,
daemons themselves, may not do, and which imports a user's script again in every child; hence a plain subprocess.
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

IDLE_SECONDS = 60.0  # a child holds some 100 MB
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True)
class Reply:
    """The result of a job; in its place, that its time was up, or how the child process was lost."""

    result: Any = None
    timed_out: bool = False
    lost: str = ""
    begun: bool = True  # whether the job had begun when the child was lost


def run_in_worker(shared: bytes, job: bytes, limit: float | None = None) -> Reply:
    """Call `pickle.loads(shared)(pickle.loads(job))` in the child process of this thread.

    Parameters
    ----------
    shared, job : bytes
        Pickles of a function and of its argument. The child keeps the function from one job to the next.
    limit : float, optional
        Seconds it may take; starting the child does not count.
    """
    child: WorkerProcess | None = getattr(_of_this_thread, "child", None)
    if child is not None and child.process.poll() is None:
        reply = child.run(shared, job, limit)
        if reply.begun:
            return reply  # else it was idle for too long, just now
    if child is not None:
        child.close()
    child = _of_this_thread.child = WorkerProcess()
    return child.run(shared, job, limit)


def close_workers() -> None:
    """End all child processes of this process; their jobs are lost."""
    for child in list(_children):
        child.close()


class WorkerProcess:
    """The child process, seen from the worker."""

    def __init__(self) -> None:
        self.errors = tempfile.TemporaryFile()  # noqa: SIM115
        path = os.pathsep.join(p or os.getcwd() for p in sys.path)
        self.process = subprocess.Popen(
            [sys.executable, "-c", f"from {__name__} import serve; serve()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.errors,
            env={**os.environ, **ONE_THREAD, "PYTHONPATH": path},
            start_new_session=True,  # Ctrl-C is for the process that waits for the results
        )
        self.function: bytes | None = None  # the one that the child has
        _children.add(self)

    def run(self, shared: bytes, job: bytes, limit: float | None) -> Reply:
        """Run one job; see `run_in_worker`."""
        assert self.process.stdin is not None and self.process.stdout is not None
        expired = threading.Event()

        def end() -> None:
            expired.set()
            self.process.kill()

        timer = threading.Timer(limit or 0.0, end)
        timer.daemon = True
        begun = False
        try:
            _write(self.process.stdin, (None if shared == self.function else shared, job))
            self.function = shared
            _read(self.process.stdout)  # it has everything
            begun = True
            if limit is not None:
                timer.start()
            try:
                return Reply(_read(self.process.stdout))
            finally:
                timer.cancel()
        except (OSError, EOFError, ValueError):
            lost = self._how_it_ended()
            self.close()
            return Reply(timed_out=True) if expired.is_set() else Reply(lost=lost, begun=begun)

    def _how_it_ended(self) -> str:
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
        _children.discard(self)


_of_this_thread = threading.local()
_children: set[WorkerProcess] = set()
atexit.register(close_workers)


def serve() -> None:
    """Do jobs in the child process: they come by standard input, results go to standard output."""
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # output of a job must not be taken for a reply
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
            shared, job = inbox.get(timeout=IDLE_SECONDS)
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
    return pickle.loads(pipe.read(int.from_bytes(size, "big")))
