"""Threads: how many, one for BLAS, and one at a time for symbolic work.

The matrices here are at most a few thousand rows by a few hundred columns: more BLAS threads do not help one fit, and
where several fits run side by side they fight for the cores. CasADi lets go of the interpreter in each of the many
tiny calls that build an expression, which costs far more than it brings where threads build at the same time.
"""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")
SYMBOLIC = threading.RLock()


@functools.cache
def _controller() -> Any:
    import scipy.linalg  # brings a BLAS of its own, and only those that are there by now are limited
    from threadpoolctl import ThreadpoolController

    assert scipy.linalg
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


def processors() -> int:
    """Processors that this process may run on."""
    allowed = getattr(os, "sched_getaffinity", None)
    return len(allowed(0)) if allowed else os.cpu_count() or 1


def side_by_side(function: Callable[[T], R], items: Iterable[T], workers: int) -> list[R]:
    """Results of a function for each item, in their order; where one fails, what has not begun is dropped."""
    pool = ThreadPoolExecutor(workers)
    try:
        return [task.result() for task in [pool.submit(function, item) for item in items]]
    finally:
        pool.shutdown(cancel_futures=True)
