"""Jobs side by side over an executor: in the order in which they end, again where a worker has died.

Every job runs in a process of its own beside its worker, whatever the executor is made of. The result of a job does not
depend on where, when or how often it ran.
"""

from __future__ import annotations

import contextlib
import logging
import pickle
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from typing import Any

from .._base import InputError, Reply, run_in_worker
from .jobs import LOST, TIMED_OUT, Batch, Outcome, RunJob, attempt, unfinished, versions

AHEAD = 64  # jobs that an executor is given at a time
SCHEDULER_TIMEOUT = 10.0  # seconds that a Dask scheduler has to answer


def check_executor(executor: Any) -> None:
    """Refuse an executor without `submit`.

    Raises
    ------
    InputError
        If it has none.
    """
    if executor is not None and not callable(getattr(executor, "submit", None)):
        raise InputError(f"executor = {executor!r} was given; give a concurrent.futures.Executor, or leave it out.")


def side_by_side(
    function: Callable[[RunJob], Outcome],
    jobs: Sequence[RunJob],
    executor: Executor,
    *,
    time_limit: float | None = None,
    retries: int = 2,
    ahead: int = AHEAD,
) -> Iterator[Batch]:
    """Yield outcomes as they arrive.

    Parameters
    ----------
    function : callable
        Called with each job; it is pickled.
    executor : concurrent.futures.Executor
        Threads, processes, or a Dask cluster's.
    time_limit : float, optional
        Seconds a job may take before it is ended.
    retries : int
        How often a job whose worker has died is tried again.
    ahead : int
        Jobs that the executor is given at a time.

    Raises
    ------
    InputError
        If the jobs cannot be sent, the executor stops, its workers cannot begin, or have other versions.
    """
    shared = _pickled(function)
    waiting, running = deque((job, 1) for job in jobs), dict[Future[Reply], tuple[RunJob, int]]()
    try:
        while waiting or running:
            while waiting and len(running) < ahead:
                job, trial = waiting.popleft()
                running[executor.submit(run_in_worker, shared, _pickled(job), time_limit)] = job, trial
            batch: Batch = []
            stop: Exception | None = None
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                job, trial = running.pop(future)
                try:
                    outcome = _outcome(future, trial > retries, time_limit)
                    if outcome is None:
                        waiting.appendleft((job, trial + 1))
                    else:
                        batch.append((job, outcome))
                except (InputError, BrokenExecutor, CancelledError) as error:
                    stop = error
            if batch:
                yield batch  # whatever stops a campaign, what has arrived is kept
            if stop is not None:
                raise stop
    except (BrokenExecutor, CancelledError, RuntimeError, OSError) as error:
        reason = str(error) or type(error).__name__
        raise InputError(
            f"The executor has stopped ({reason}); what is done stays, the same command goes on from there."
        ) from None
    finally:
        for future in running:
            future.cancel()


def _outcome(future: Future[Reply], last: bool, time_limit: float | None) -> Outcome | None:
    """Return the outcome of a job; None where its worker was lost and it was not the last trial."""
    try:
        reply = future.result()
    except (BrokenExecutor, CancelledError):
        raise
    except Exception as error:  # a Dask worker was killed, or has not got the package
        name = type(error).__name__
        reply = Reply(lost=f"{name}: {error}".splitlines()[0], begun=name == "KilledWorker")
    if reply.timed_out:
        return unfinished(TIMED_OUT, f"Failed: ended after its time limit of {time_limit:g} s.", time_limit=time_limit)
    if reply.lost:
        if not last:
            return None
        if not reply.begun:
            raise InputError(f"The workers cannot begin a job ({reply.lost}); see that they run this package.")
        return unfinished(LOST, f"Failed: its worker was lost in every trial, lastly {reply.lost}.")
    outcome, used = reply.result
    for name, version in versions().items():
        if used.get(name) != version:
            raise InputError(
                f"A worker has {name} {used.get(name)} and this process {version}; give both the same, results of "
                "different versions are not mixed."
            )
    return outcome


class Attempt:
    """A function that workers call: do a job of a run, and say with which versions."""

    def __init__(self, run: Any, recordings: Any) -> None:
        self.run, self.recordings = run, recordings

    def __call__(self, job: RunJob) -> tuple[Outcome, dict[str, str]]:
        """Return the outcome of a job, and the versions it was computed with."""
        return attempt(self.run, self.recordings, job), versions()


def _pickled(thing: Any) -> bytes:
    try:
        return pickle.dumps(thing)
    except Exception as error:
        reason = error
    try:  # what a run file in Python defines has no module that workers could import: cloudpickle sends the code
        import cloudpickle

        return bytes(cloudpickle.dumps(thing))
    except Exception:
        raise InputError(
            f"The model or a constraint cannot be sent to other processes ({reason}); install "
            "pilfr-casadi[dask], which can send code, or use workers=1 without a time limit."
        ) from None


@contextlib.contextmanager
def dask_executor(address: str) -> Iterator[tuple[Executor, int, int]]:
    """Yield an executor of a Dask cluster, how many jobs it does at a time, and how many to give it at a time.

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
        client = Client(address, timeout=SCHEDULER_TIMEOUT, set_as_default=False)
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
