"""Run work in threads and worker processes, which share BLAS and CasADi and end in every case.

Matrices here have at most a few thousand rows and a few hundred columns, so more BLAS threads do not speed up one fit,
and would compete for the cores if fits run side by side. Each fit uses one BLAS thread. CasADi releases the interpreter
in each of the many small calls that build an expression, so threads that build expressions at the same time slow each
other down. They take turns.

`worker_pool` is for tasks that end by themselves. `run_in_worker` runs a job in a child process, which can be killed
when the time is up and may die without harm. An executor's worker (a thread, a process, a Dask worker's thread) keeps
one child and sends it one job after the other. If a job hangs, in Python or in compiled code, or runs out of memory,
only the child dies. The child ends when its worker ends, in whatever way, because its standard input closes; it also
ends after `IDLE_SECONDS` without a job. Pools with killable workers in other packages (pebble, loky) use
`multiprocessing`, which Dask's workers may not use, because they are daemons, and which imports a user's script again
in every child; hence a plain subprocess.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import math
import multiprocessing
import os
import pickle
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import CancelledError, Executor, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any, ParamSpec, TypeVar

from .errors import InputError
from .interrupts import TERMINATING, Interrupt

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")
SYMBOLIC = threading.RLock()
MANAGER_TIMEOUT = 2.0  # seconds for a pool's own thread to end after its processes have ended
CANCEL_TIMEOUT = 10.0  # seconds for a pool to drop tasks that have not begun
IDLE_SECONDS = 60.0  # after which a child, about 100 MB, ends
WATCH_SECONDS = 0.1  # interval at which time limits are checked
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@functools.cache
def _blas_controller() -> Any:
    import scipy.linalg  # loads its own BLAS, which has to be loaded to be limited
    from threadpoolctl import ThreadpoolController

    assert scipy.linalg
    return ThreadpoolController()


def one_at_a_time(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function that builds CasADi expressions, so that threads take turns."""

    @functools.wraps(function)
    def locked(*args: P.args, **kwargs: P.kwargs) -> R:
        with SYMBOLIC:
            return function(*args, **kwargs)

    return locked


def one_blas_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function to run with one BLAS thread; the previous setting is restored afterwards."""

    @functools.wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with _blas_controller().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited


def processors() -> int:
    """Count the processors that this process may run on."""
    allowed = getattr(os, "sched_getaffinity", None)
    return len(allowed(0)) if allowed else os.cpu_count() or 1


def side_by_side(
    function: Callable[[T], R], items: Iterable[T], workers: int, interrupt: Interrupt | None = None
) -> list[R]:
    """Apply a function to each item in threads; return the results in order. A failure cancels waiting items.

    An interrupt is marked before the threads that still run are waited for.
    """
    with ThreadPoolExecutor(workers) as pool, (interrupt or Interrupt()).marked():
        return list(pool.map(function, items))


@contextlib.contextmanager
def worker_pool(count: int) -> Iterator[Executor | None]:
    """Yield a pool of `count` processes, or None for one; all processes end with the context.

    Ctrl-C reaches every process of the terminal's foreground group. The workers ignore it; the process that waits for
    their results keeps the best result so far and ends them.
    """
    if count < 2:
        yield None
        return
    others = set(multiprocessing.active_children())
    masks = hasattr(signal, "pthread_sigmask")
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if masks else set()
    try:
        pool = ProcessPoolExecutor(count, initializer=_prepare_worker)
        for _ in range(count):  # a pool starts its processes with its first tasks: start all while Ctrl-C is blocked
            pool.submit(os.getpid)
    finally:
        if masks:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        yield pool
    finally:
        manager = getattr(pool, "_executor_manager_thread", None)
        try:
            _shut_down(pool)
        finally:
            for worker in set(multiprocessing.active_children()) - others:
                worker.kill()
            if manager is not None:  # it closes a pipe to which Python would write at exit
                manager.join(MANAGER_TIMEOUT)


def _prepare_worker() -> None:
    """Leave signals to the process that waits for the results, and end with it, even if it is killed."""
    for number in (signal.SIGINT, *TERMINATING):
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _shut_down(pool: ProcessPoolExecutor) -> None:
    """Shut a pool down after it has dropped the tasks that have not begun.

    Before Python 3.12, a pool whose processes die while it holds a cancelled task never ends. A pool drops tasks in
    order, so once the last task is cancelled, all are.
    """
    try:
        last = pool.submit(os.getpid)
    except BrokenProcessPool:
        return
    pool.shutdown(wait=False, cancel_futures=True)
    with contextlib.suppress(CancelledError, TimeoutError, BrokenProcessPool):
        last.result(CANCEL_TIMEOUT)


@dataclass(frozen=True)
class Reply:
    """The result of a job, or its time-out, or how the child was lost and whether the job had begun."""

    result: Any = None
    timed_out: bool = False
    lost: str = ""
    begun: bool = True


def run_in_worker(shared: bytes, job: bytes, limit: float | None = None, name: str = "") -> Reply:
    """Call `pickle.loads(shared)(pickle.loads(job))` in a child process of this thread, identified by `name`.

    The child keeps the function for the next job. Its start does not count towards the `limit` in seconds.
    """
    children: dict[str, WorkerProcess] = _of_this_thread.__dict__.setdefault("children", {})
    child = children.get(name)
    if child is not None and child.process.poll() is None:
        reply = child.run(shared, job, limit)
        if reply.begun:
            return reply  # else the child had just ended because it was idle
    if child is not None:
        child.close()
    child = children[name] = WorkerProcess()
    return child.run(shared, job, limit)


def close_workers() -> None:
    """Kill all child processes of this process; their jobs are lost."""
    for child in list(_children):
        child.close()


class ChildProcess:
    """A Python process that runs `serve` of some file: it reads jobs from its input and writes replies to its output.

    It is killed if it has not replied at the `deadline`, a time of the monotonic clock; it has then `expired`.
    """

    def __init__(self, serve: Callable[[], None], environment: Mapping[str, str] | None = None) -> None:
        self.deadline, self.expired = math.inf, False
        self.errors = tempfile.TemporaryFile()  # noqa: SIM115
        path = os.pathsep.join(p or os.getcwd() for p in sys.path)
        self.process = subprocess.Popen(
            [sys.executable, "-c", f"from {serve.__module__} import {serve.__name__} as serve; serve()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.errors,
            env={**os.environ, **(environment or {}), "PYTHONPATH": path},
            start_new_session=True,  # Ctrl-C is for the process that waits for the results
        )
        self.inbox: Any = self.process.stdin
        self.outbox: Any = self.process.stdout
        threading.Thread(target=self._watch, daemon=True).start()

    def _watch(self) -> None:
        while self.process.poll() is None:
            if time.monotonic() > self.deadline:
                self.expired = True
                self.process.kill()
            time.sleep(WATCH_SECONDS)

    def exit_status(self) -> int | None:
        """Return the exit status of a process that no longer answers, or minus the signal that ended it."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(5)
        return self.process.poll()

    def close(self) -> None:
        """Kill the process and close its pipes."""
        self.process.kill()
        self.process.wait()
        for pipe in (self.inbox, self.outbox, self.errors):
            with contextlib.suppress(OSError, ValueError):
                pipe.close()


class WorkerProcess(ChildProcess):
    """A child process of a worker, for `run_in_worker`."""

    def __init__(self) -> None:
        super().__init__(serve, ONE_THREAD)
        self.function: bytes | None = None  # the pickled function that the child has
        _children.add(self)

    def run(self, shared: bytes, job: bytes, limit: float | None) -> Reply:
        """Run one job; see `run_in_worker`."""
        begun = False
        try:
            _write(self.inbox, (None if shared == self.function else shared, job))
            self.function = shared
            _read(self.outbox)  # the child has received everything
            begun = True
            if limit is not None:
                self.deadline = time.monotonic() + limit
            reply = Reply(_read(self.outbox))
            self.deadline = math.inf
            return reply
        except (OSError, EOFError, ValueError):
            lost = self._describe_end()
            self.close()
            return Reply(timed_out=True) if begun and self.expired else Reply(lost=lost, begun=begun)

    def _describe_end(self) -> str:
        code = self.exit_status()
        if code is not None and code < 0:
            return f"its process was ended by signal {-code}"
        self.errors.seek(0)
        lines = self.errors.read().decode(errors="replace").strip().splitlines()
        return f"its process ended: {lines[-1]}" if lines else f"its process ended with status {code}"

    def close(self) -> None:
        """Kill the process and close its pipes."""
        super().close()
        _children.discard(self)


_of_this_thread = threading.local()
_children: set[WorkerProcess] = set()
atexit.register(close_workers)


def serve() -> None:
    """Run jobs in the child process: read them from standard input, write results to standard output."""
    replies = open_replies()
    inbox: queue.SimpleQueue[tuple[bytes | None, bytes]] = queue.SimpleQueue()

    def listen() -> None:
        while True:
            try:
                inbox.put(_read(sys.stdin.buffer))
            except (OSError, EOFError):
                os._exit(0)  # the worker has ended

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
        os._exit(1)  # skip the interpreter's shutdown, which the listening thread would disturb


def open_replies() -> Any:
    """Open the pipe of the replies in a child process, in which nothing that a job prints may appear."""
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    return replies


def write_message(pipe: Any, message: bytes) -> None:
    """Write a message with its length before it."""
    pipe.write(len(message).to_bytes(8, "big") + message)
    pipe.flush()


def read_message(pipe: Any) -> bytes:
    """Read a message; EOFError is raised if the pipe ends before it does."""
    head = pipe.read(8)
    size = int.from_bytes(head, "big")
    message: bytes = pipe.read(size) if len(head) == 8 else b""
    if len(head) < 8 or len(message) < size:
        raise EOFError
    return message


def _write(pipe: Any, content: Any) -> None:
    write_message(pipe, pickle.dumps(content))


def _read(pipe: Any) -> Any:
    return pickle.loads(read_message(pipe))


def check_executor(executor: Any) -> None:
    """Refuse an object that cannot run tasks; None stands for the package's own processes."""
    if executor is not None and not callable(getattr(executor, "submit", None)):
        raise InputError(f"executor = {executor!r} was given; give a concurrent.futures.Executor, or leave it out.")
