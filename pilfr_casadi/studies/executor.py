"""Jobs side by side over an executor, in the order in which they end, and again where a worker has died.

Every job runs in a process of its own beside its worker, whatever the executor is made of. The result of a job does not
depend on where, when or how often it ran.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import pickle
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from typing import Any

from .._base import InputError, Reply, close_workers, run_in_worker
from .jobs import LOST, TIMED_OUT, Batch, Outcome, Recordings, RunJob, attempt, unfinished, versions
from .schema import Run

AHEAD = 64  # jobs that an executor is given at a time
SCHEDULER_TIMEOUT = 10.0  # seconds that a Dask scheduler has to answer


def do_side_by_side(
    run: Run, recordings: Recordings, jobs: Sequence[RunJob], executor: Executor | None, ahead: int
) -> Iterator[Batch]:
    """Do jobs by an executor, else in processes, else (one worker without a time limit) in this process."""
    if executor is not None:
        yield from _outcomes(run, recordings, jobs, executor, ahead)
    elif run.workers > 1 or run.time_limit is not None:
        pool = ThreadPoolExecutor(run.workers)
        try:
            yield from _outcomes(run, recordings, jobs, pool, 2 * run.workers)
        finally:
            _end(pool)
    else:
        for job in jobs:
            yield [(job, attempt(run, recordings, job))]


def _end(pool: ThreadPoolExecutor) -> None:
    """End a pool and its worker processes, also those that its threads are about to begin."""
    pool.shutdown(wait=False, cancel_futures=True)
    ending = threading.Thread(target=pool.shutdown, daemon=True)
    ending.start()
    while ending.is_alive():
        close_workers()
        ending.join(0.02)
    close_workers()


def _outcomes(
    run: Run, recordings: Recordings, jobs: Sequence[RunJob], executor: Executor, ahead: int
) -> Iterator[Batch]:
    """Yield outcomes as they arrive; `ahead` jobs are with the executor at a time."""
    shared = _pickled(functools.partial(_attempt_with_versions, run, recordings))
    waiting, running = deque((job, 1) for job in jobs), dict[Future[Reply], tuple[RunJob, int]]()
    try:
        while waiting or running:
            while waiting and len(running) < ahead:
                job, trial = waiting.popleft()
                running[executor.submit(run_in_worker, shared, _pickled(job), run.time_limit)] = job, trial
            batch: Batch = []
            stop: Exception | None = None
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                job, trial = running.pop(future)
                try:
                    outcome = _outcome(future, trial > run.retries, run.time_limit)
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


def _attempt_with_versions(run: Run, recordings: Recordings, job: RunJob) -> tuple[Outcome, dict[str, str]]:
    """Return the outcome of a job, and the versions it was computed with; workers call this."""
    return attempt(run, recordings, job), versions()


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
    """Yield an executor of a Dask cluster, how many jobs it does at a time, and how many to give it at a time."""
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
