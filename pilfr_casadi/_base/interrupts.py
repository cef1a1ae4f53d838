"""Ctrl-C, time limits and worker processes: what the command line does so that a run ends soon, and ends clean.

Ctrl-C reaches every process of the terminal's foreground group. The workers are deaf to it; the first process stops
waiting for them, keeps the best so far and ends them. A time limit is a Ctrl-C that a clock gives, and so is SIGTERM,
which `timeout` and job schedulers send.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool

ENDS = 2.0  # seconds that the thread behind a pool may take when its processes are gone
Progress = Callable[[str, int, int, float], None]


@contextlib.contextmanager
def deferred_interrupt() -> Iterator[None]:
    """Ctrl-C takes effect when the context ends: for imports and short writes, which are not to be torn apart."""
    ours = threading.current_thread() is threading.main_thread()
    if not ours or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    struck = False

    def later(*_: object) -> None:
        nonlocal struck
        struck = True

    signal.signal(signal.SIGINT, later)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if struck:
        raise KeyboardInterrupt


@contextlib.contextmanager
def insistent(progress: Progress) -> Iterator[Progress]:
    """A progress function that raises KeyboardInterrupt where Ctrl-C was pressed and lost.

    CasADi may swallow a KeyboardInterrupt. The signal itself is noted below Python, by its wake-up descriptor.
    """
    if threading.current_thread() is not threading.main_thread():
        yield progress
        return
    ear, mouth = socket.socketpair()
    ear.setblocking(False)
    mouth.setblocking(False)
    before = signal.set_wakeup_fd(mouth.fileno(), warn_on_full_buffer=False)

    def report(stage: str, done: int, total: int, best: float) -> None:
        progress(stage, done, total, best)
        with contextlib.suppress(BlockingIOError):
            if signal.SIGINT in ear.recv(4096):
                raise KeyboardInterrupt

    try:
        yield report
    finally:
        signal.set_wakeup_fd(before)
        ear.close()
        mouth.close()


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """SIGTERM does what Ctrl-C does."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def ended(*_: object) -> None:
        if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in the background of a script
            raise KeyboardInterrupt
        signal.raise_signal(signal.SIGINT)

    before = signal.signal(signal.SIGTERM, ended)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _deaf() -> None:
    """In a worker: what ends a run is for the process that waits for the results."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


@contextlib.contextmanager
def worker_pool(count: int) -> Iterator[Executor | None]:
    """A pool of `count` processes, None for one; however the context is left, no process is left behind."""
    if count < 2:
        yield None
        return
    others = set(multiprocessing.active_children())
    masks = hasattr(signal, "pthread_sigmask")
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if masks else set()
    try:
        pool = ProcessPoolExecutor(count, initializer=_deaf)
        for _ in range(count):  # processes begin at the first tasks: here, where Ctrl-C waits until they are deaf
            pool.submit(os.getpid)
    finally:
        if masks:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        yield pool
    finally:
        manager = getattr(pool, "_executor_manager_thread", None)
        try:
            _forget(pool)
        finally:
            for worker in set(multiprocessing.active_children()) - others:
                worker.kill()
            if manager is not None:  # at its end it closes a pipe that Python, at its own, would write to
                manager.join(ENDS)


def _forget(pool: ProcessPoolExecutor) -> None:
    """Shut a pool when it has dropped what it has not begun.

    A pool that loses its processes while it holds a cancelled task does not end (before Python 3.12). It drops tasks in
    the order in which they came: when one that comes last is cancelled, the others are.
    """
    try:
        last = pool.submit(os.getpid)
    except BrokenProcessPool:
        return
    pool.shutdown(wait=False, cancel_futures=True)
    with contextlib.suppress(CancelledError, TimeoutError, BrokenProcessPool):
        last.result(10)


class Clock:
    """Whether a time limit has struck."""

    expired = False


@contextlib.contextmanager
def time_limit(seconds: float | None, clock: Clock) -> Iterator[None]:
    """Interrupt the main thread, as Ctrl-C does, when `seconds` have passed before the context ends; `clock` tells."""
    lock = threading.Lock()
    if seconds is None:
        yield
        return
    ended = False
    # in the background of a script Ctrl-C is ignored, and a clock would be too
    ours = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    if ours:
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def strike() -> None:
        with lock:
            if ended:
                return
            clock.expired = True
            if hasattr(signal, "pthread_kill"):
                main = threading.main_thread().ident
                assert main is not None
                signal.pthread_kill(main, signal.SIGINT)
            else:
                signal.raise_signal(signal.SIGINT)

    timer = threading.Timer(seconds, strike)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        with deferred_interrupt(), lock:
            ended = True
        timer.cancel()
        if ours:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
