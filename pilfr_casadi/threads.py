"""Threads: one for BLAS, and one at a time for symbolic work.

The matrices here are at most a few thousand rows by a few hundred columns: more BLAS threads do not help one fit, and
where several fits run side by side they fight for the cores. CasADi lets go of the interpreter in each of the many
tiny calls that build an expression, which costs far more than it brings where threads build at the same time.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")
SYMBOLIC = threading.RLock()


@functools.cache
def _controller() -> Any:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def one_at_a_time(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function that builds expressions: threads take turns."""

    @functools.wraps(function)
    def waiting(*args: P.args, **kwargs: P.kwargs) -> R:
        with SYMBOLIC:
            return function(*args, **kwargs)

    return waiting


def one_blas_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function to run with one BLAS thread; the setting from before is restored."""

    @functools.wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with _controller().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited
