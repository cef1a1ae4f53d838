"""Run a command that calls an FMU in a child process, so that an FMU that crashes does not end it without a word.

The child evaluates single points of the FMU itself, which is fast (`simulators.fmu_process`). If it crashes there, the
command runs once more with every point evaluated in the FMU's own process.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence

from .._base import end_with_parent, units_are_isolated
from ._common import NO_RESULT, say

CRASHES = {
    int(getattr(signal, name)): name
    for name in ("SIGABRT", "SIGSEGV", "SIGBUS", "SIGILL", "SIGFPE")
    if hasattr(signal, name)
}


def run_beside_units(command: Callable[[], int], arguments: Sequence[str]) -> int:
    """Run a command; where one of its arguments is an FMU, in a child process first. Return the exit status."""
    has_unit = any(argument.lower().endswith(".fmu") and os.path.isfile(argument) for argument in arguments)
    if not has_unit or not hasattr(os, "fork") or units_are_isolated():
        return command()
    ended = _run_in_child(command)
    if not os.WIFSIGNALED(ended):
        return os.waitstatus_to_exitcode(ended)
    number = os.WTERMSIG(ended)
    if number not in CRASHES:
        return say(f"The command was ended by signal {number}.", 128 + number)
    say(
        f"The FMU crashed ({CRASHES[number]}). The command starts again with every evaluation of it in a "
        "process of its own, which takes about three times as long.",
        NO_RESULT,
    )
    os.environ["PILFR_ISOLATED"] = "1"
    return command()


def _run_in_child(command: Callable[[], int]) -> int:
    """Run a command in a child process and pass signals on to it; return its status of `os.waitpid`."""
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if not child:
        os.setsid()  # Ctrl-C reaches the parent alone, which passes it on
        threading.Thread(target=end_with_parent, args=(os.getppid(),), daemon=True).start()
        status = NO_RESULT
        try:
            status = command()
        finally:
            with contextlib.suppress(OSError, ValueError):  # nobody reads the output any more
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(status)
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda got, _: os.kill(child, got)) for number in numbers]
    try:
        return os.waitpid(child, 0)[1]
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
