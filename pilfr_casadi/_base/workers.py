"""Threads and worker processes: how many there are, how BLAS and CasADi share them, and how a pool ends.

Matrices here have at most a few thousand rows and a few hundred columns, so more BLAS threads do not speed up one fit,
and fits that run side by side would fight for the cores: each uses one BLAS thread. CasADi releases the interpreter in
each of the many small calls that build an expression, so threads that build expressions at the same time only slow each
other down: they take turns.
"""

from __future__ import annotations

import contextlib
import functools
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Executor, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")
SYMBOLIC = threading.RLock()
MANAGER_END = 2.0  # seconds that a pool's own thread may take to end after its processes are gone
CANCEL_END = 10.0  # seconds that a pool may take to drop the tasks that it has not begun


@functools.cache
def _blas_controller() -> Any:
    import scipy.linalg  # loads a BLAS of its own; only libraries that are loaded by now are limited
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


def side_by_side(function: Callable[[T], R], items: Iterable[T], workers: int) -> list[R]:
    """Apply a function to each item in threads; return the results in order. After a failure, drop what waits."""
    pool = ThreadPoolExecutor(workers)
    try:
        return [task.result() for task in [pool.submit(function, item) for item in items]]
    finally:
        pool.shutdown(cancel_futures=True)


@contextlib.contextmanager
def worker_pool(count: int) -> Iterator[Executor | None]:
    """Yield a pool of `count` processes, or None for one; no process is left behind, however the context ends.

    Ctrl-C reaches every process of the terminal's foreground group. The workers ignore it: the process that waits for
    their results keeps the best so far and ends them.
    """
    if count < 2:
        yield None
        return
    others = set(multiprocessing.active_children())
    masks = hasattr(signal, "pthread_sigmask")
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if masks else set()
    try:
        pool = ProcessPoolExecutor(count, initializer=_ignore_signals)
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
            if manager is not None:  # it closes a pipe that Python would write to at its own end
                manager.join(MANAGER_END)


def _ignore_signals() -> None:
    """Leave Ctrl-C and SIGTERM to the process that waits for the results; called in each worker."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def _shut_down(pool: ProcessPoolExecutor) -> None:
    """Shut a pool down once it has dropped the tasks that it has not begun.

    Before Python 3.12 a pool whose processes die while it holds a cancelled task never ends. It drops tasks in the
    order in which they came, so once a task that was added last is cancelled, all are.
    """
    try:
        last = pool.submit(os.getpid)
    except BrokenProcessPool:
        return
    pool.shutdown(wait=False, cancel_futures=True)
    with contextlib.suppress(CancelledError, TimeoutError, BrokenProcessPool):
        last.result(CANCEL_END)
