"""Ctrl-C, SIGTERM and time limits: how long work is stopped, and what must not be torn apart.

All three raise KeyboardInterrupt in the main thread: a time limit sends the signal of Ctrl-C to this process, and so
does SIGTERM, which `timeout` and job schedulers send.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def deferred_interrupt() -> Iterator[None]:
    """Defer Ctrl-C to the end of the context: for imports and short writes."""
    before = signal.getsignal(signal.SIGINT)
    if not _in_main_thread() or not callable(before):
        yield
        return
    pressed = False

    def note(*_: object) -> None:
        nonlocal pressed
        pressed = True

    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if pressed:
        signal.raise_signal(signal.SIGINT)


@contextlib.contextmanager
def repeated_interrupt() -> Iterator[Callable[[], None]]:
    """Yield a function that raises the KeyboardInterrupt of Ctrl-C again, once, if one was raised since its last call.

    CasADi may swallow a KeyboardInterrupt that is raised inside one of its callbacks.
    """
    before = signal.getsignal(signal.SIGINT)
    if not _in_main_thread() or before is not signal.default_int_handler:
        yield lambda: None
        return
    pressed = False

    def note(number: int, frame: object) -> None:
        nonlocal pressed
        pressed = True
        raise KeyboardInterrupt

    def repeat() -> None:
        nonlocal pressed
        if pressed:
            pressed = False
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, note)
    try:
        yield repeat
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """Let SIGTERM do what Ctrl-C does."""
    if not _in_main_thread():
        yield
        return

    def terminate(*_: object) -> None:
        if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in the background of a script
            raise KeyboardInterrupt
        signal.raise_signal(signal.SIGINT)

    before = signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


class Clock:
    """Tells whether a time limit has been reached."""

    expired = False


@contextlib.contextmanager
def time_limit(seconds: float | None, clock: Clock) -> Iterator[None]:
    """Interrupt the main thread, as Ctrl-C does, if the context lasts longer than `seconds`; mark the `clock` then."""
    if seconds is None:
        yield
        return
    lock = threading.Lock()
    ended = False
    # in the background of a script Ctrl-C is ignored, and the interrupt of the clock would be too
    ignored = _in_main_thread() and signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    if ignored:
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def interrupt() -> None:
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

    timer = threading.Timer(seconds, interrupt)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        with deferred_interrupt(), lock:
            ended = True
        timer.cancel()
        if ignored:
            signal.signal(signal.SIGINT, signal.SIG_IGN)


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()
