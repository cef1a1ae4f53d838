"""Interrupt long work by Ctrl-C, SIGTERM, SIGHUP or a time limit, and defer interrupts where work must not be split.

All raise KeyboardInterrupt in the main thread: a time limit, SIGTERM, which `timeout` and job schedulers send, and
SIGHUP, which a closed terminal sends, raise the signal of Ctrl-C in this process.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

TERMINATING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))


@contextlib.contextmanager
def deferred_interrupt(again: bool = True) -> Iterator[list[bool]]:
    """Defer Ctrl-C to the end of the context; for imports and short writes.

    Yield a list that receives an entry for each Ctrl-C. Without `again`, Ctrl-C is not raised at the end.
    """
    pressed: list[bool] = []
    if not _in_main_thread() or not callable(signal.getsignal(signal.SIGINT)):
        yield pressed
        return
    with _handler(signal.SIGINT, lambda *_: pressed.append(True)):
        yield pressed
    if pressed and again:
        signal.raise_signal(signal.SIGINT)


@contextlib.contextmanager
def unwrapped_interrupt() -> Iterator[None]:
    """Raise KeyboardInterrupt if an extension module turns Ctrl-C into another error.

    A C function that continues with a pending exception ends in `SystemError: ... returned a result with an exception
    set`, whose cause is the KeyboardInterrupt; casadi's `DM.__array__` is an example. A buffer of casadi raises a
    RuntimeError of that name for one in a callback.
    """
    try:
        yield
    except (SystemError, RuntimeError) as error:
        if not is_interrupt(error):
            raise
        raise KeyboardInterrupt from error


def is_interrupt(error: BaseException | None) -> bool:
    """Tell whether an exception is a KeyboardInterrupt, or an error that one caused in an extension module."""
    if isinstance(error, RuntimeError):
        return str(error) == KeyboardInterrupt.__name__
    while isinstance(error, SystemError):
        error = error.__cause__ or error.__context__
    return isinstance(error, KeyboardInterrupt)


@dataclass(eq=False)
class Interrupt:
    """The first Ctrl-C during some work; what the work has found until then stays.

    A fit that is interrupted returns its best result so far, so it only marks that (`pressed`). The work then ends at
    its next call of `raise_pending`, and the context `UntilInterrupted` around it goes on from there.
    """

    pressed: bool = False
    handled: bool = False

    def handle(self) -> None:
        """Mark that Ctrl-C was pressed, and that the work has ended because of it."""
        self.pressed = self.handled = True

    def mark(self, error: BaseException) -> bool:
        """Tell whether an exception is an interrupt, and mark it then, so that fits in other threads end."""
        caught = is_interrupt(error)
        self.pressed = self.pressed or caught
        return caught

    @contextlib.contextmanager
    def marked(self) -> Iterator[None]:
        """Mark an interrupt as soon as it leaves the context."""
        try:
            yield
        except BaseException as error:
            self.mark(error)
            raise

    def raise_pending(self) -> None:
        """Raise KeyboardInterrupt if Ctrl-C was pressed and the work still goes on."""
        if self.pressed and not self.handled:
            raise KeyboardInterrupt


@dataclass(frozen=True)
class UntilInterrupted:
    """A context that an interrupt ends; it calls `report` then, and the code after it goes on.

    It is a class because type checkers know by the `bool` of `__exit__` that code after the context is reached.
    """

    interrupt: Interrupt
    report: Callable[[], None]

    def __enter__(self) -> None:
        """Do nothing."""

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> bool:
        """Catch an interrupt, and nothing else."""
        caught = is_interrupt(error)
        if caught or self.interrupt.pressed:
            self.interrupt.handle()
        if caught:
            self.report()
        return caught


@contextlib.contextmanager
def handled_interrupt(handle: Callable[[], None]) -> Iterator[None]:
    """Call `handle` on Ctrl-C instead of raising KeyboardInterrupt, which CasADi may swallow.

    Has no effect outside the main thread, or where other code handles Ctrl-C.
    """
    own = _in_main_thread() and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    with _handler(signal.SIGINT, lambda *_: handle()) if own else contextlib.nullcontext():
        yield


class Abandoned(threading.local):
    """A mark for a thread that a run of compiled code was interrupted, which cannot end by itself.

    The Python functions that the run calls then return at once, and KeyboardInterrupt is raised where the run returns.
    `end`, if any, ends a run in another process.
    """

    pending = False
    end: Callable[[], None] | None = None

    def mark(self) -> None:
        """Mark that the run was interrupted."""
        self.pending = True
        if self.end is not None:
            self.end()

    def raise_pending(self) -> None:
        """Raise KeyboardInterrupt if the run that has just returned was abandoned."""
        if self.pending:
            self.pending = False
            raise KeyboardInterrupt


abandoned = Abandoned()


@contextlib.contextmanager
def repeated_interrupt() -> Iterator[Callable[[], None]]:
    """Yield a function that raises KeyboardInterrupt once more if Ctrl-C was pressed since its last call.

    CasADi may swallow a KeyboardInterrupt that is raised inside one of its callbacks.
    """
    pressed: list[bool] = []

    def note() -> None:
        pressed.append(True)
        raise KeyboardInterrupt

    def repeat() -> None:
        if pressed:
            pressed.clear()
            raise KeyboardInterrupt

    with handled_interrupt(note), unwrapped_interrupt():
        yield repeat


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """Make SIGTERM and SIGHUP act like Ctrl-C; `nohup` has SIGHUP ignored, which stays so."""

    def terminate(*_: object) -> None:
        if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # in the background of a script
            raise KeyboardInterrupt
        signal.raise_signal(signal.SIGINT)

    with contextlib.ExitStack() as stack:
        for number in TERMINATING:
            if _in_main_thread() and signal.getsignal(number) is not signal.SIG_IGN:
                stack.enter_context(_handler(number, terminate))
        yield


class Clock:
    """A flag that a time limit has expired."""

    expired = False


@contextlib.contextmanager
def time_limit(seconds: float | None, clock: Clock) -> Iterator[None]:
    """Interrupt the main thread like Ctrl-C and mark the `clock` if the context lasts longer than `seconds`."""
    if seconds is None:
        yield
        return
    lock = threading.Lock()
    ended = False

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
    # a script in the background ignores Ctrl-C, so it would ignore the time limit too
    ignored = _in_main_thread() and signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    with _handler(signal.SIGINT, signal.default_int_handler) if ignored else contextlib.nullcontext():
        timer.start()
        try:
            yield
        finally:
            with deferred_interrupt(), lock:
                ended = True
            timer.cancel()


@contextlib.contextmanager
def _handler(number: signal.Signals, handler: Callable[..., Any]) -> Iterator[None]:
    """Handle a signal by `handler` inside the context."""
    before = signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, before)


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()
