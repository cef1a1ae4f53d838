"""A Dask cluster as an executor; the only place that knows `distributed` (the extra `pilfr-casadi[dask]`)."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from concurrent.futures import Executor

from .._base import InputError
from .executor import AHEAD

PATIENCE = 10.0  # seconds that a scheduler has to answer


@contextlib.contextmanager
def dask_executor(address: str) -> Iterator[tuple[Executor, int, int]]:
    """The workers of a scheduler: an executor, how many jobs it does at a time, and how many to give it at a time.

    Parameters
    ----------
    address : str
        Of the scheduler, such as `tcp://host:8786`.

    Raises
    ------
    InputError
        If `distributed` is not installed, or no scheduler answers.
    """
    try:
        from distributed import Client
    except ImportError:
        raise InputError("--dask needs the package distributed; install pilfr-casadi[dask].") from None
    for name in [n for n in logging.root.manager.loggerDict if n.startswith("distributed")]:
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what matters comes as an error of a job
    try:
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            f"No Dask scheduler can be used at {address} ({reason}); check the address, or start one with "
            "`dask scheduler` and workers with `dask worker`."
        ) from None
    try:
        threads = sum(client.nthreads().values())
        yield client.get_executor(pure=False), threads, max(AHEAD, 2 * threads)
    finally:
        client.close(timeout=2)
