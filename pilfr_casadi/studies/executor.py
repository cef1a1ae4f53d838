"""Run jobs side by side on an executor, yield their outcomes as they arrive, and retry jobs whose worker has died.

With any kind of executor, every job runs in a separate process beside its worker. The result of a job does not depend
on where, when or how often it ran.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import pickle
import platform
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .._base import InputError, Reply, __version__, close_workers, quote_error, run_in_worker

AHEAD = 64  # jobs submitted to an executor at a time
PAUSE = 1.0  # seconds without an outcome after which an empty batch lets the caller report the time
SCHEDULER_TIMEOUT = 10.0  # seconds to wait for a Dask scheduler
RETRIES = 2  # further trials of a job whose worker was lost
FAILED, TIMED_OUT, LOST = "FAILED", "TIMED_OUT", "LOST"  # statuses of jobs without a result


@dataclass(frozen=True, eq=False)
class Outcome:
    """The result of a job."""

    entry: dict[str, Any]  # entry in the manifest, with `status` and `sentence`
    seconds: float = 0.0  # computing time
    files: Mapping[str, str | bytes] = field(default_factory=dict)  # by name below the folder of the job
    errors: Mapping[str, float | None] = field(default_factory=dict)  # NRMSE by recording, for a job of a run


Work = Callable[[Any], Outcome]  # executes a job
Batch = list[tuple[Any, Outcome]]  # jobs that finished together


@dataclass(frozen=True)
class Effort:
    """Number of processes if there is no executor, time limit of a job in seconds, and retries of a lost job."""

    workers: int = 1
    time_limit: float | None = None
    retries: int = RETRIES


def versions() -> dict[str, str]:
    """Return the versions that the numbers of a job depend on."""
    import casadi
    import scipy

    return {
        "pilfr_casadi": __version__,
        "casadi": casadi.__version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
    }


def failure(status: str, sentence: str, **more: Any) -> Outcome:
    """Make the outcome of a job without a result."""
    return Outcome({"status": status, "sentence": sentence, **more})


def attempt(work: Work, job: Any) -> Outcome:
    """Execute a job; turn an exception into an outcome."""
    try:
        return work(job)
    except Exception as error:
        if isinstance(error, InputError):
            return failure(FAILED, f"Failed: {error}", refused=True)
        return failure(FAILED, f"Failed: {type(error).__name__}: {error}")


def run_side_by_side(
    work: Work, jobs: Sequence[Any], effort: Effort, executor: Executor | None = None, ahead: int = AHEAD
) -> Iterator[Batch]:
    """Run jobs on an executor, else in processes, or in this process (one worker without a time limit).

    Every process receives `work` once, and its jobs one by one. While other processes work, an empty batch is yielded
    about every second.
    """
    if executor is not None:
        yield from _collect_outcomes(work, jobs, effort, executor, ahead)
    elif effort.workers > 1 or effort.time_limit is not None:
        pool = ThreadPoolExecutor(effort.workers)
        try:
            yield from _collect_outcomes(work, jobs, effort, pool, 2 * effort.workers)
        finally:
            _end_pool(pool)
    else:
        for job in jobs:
            yield [(job, attempt(work, job))]


def _end_pool(pool: ThreadPoolExecutor) -> None:
    """End a pool and its worker processes, also processes that its threads are about to start."""
    pool.shutdown(wait=False, cancel_futures=True)
    ending = threading.Thread(target=pool.shutdown, daemon=True)
    ending.start()
    while ending.is_alive():
        close_workers()
        ending.join(0.02)
    close_workers()


def _collect_outcomes(
    work: Work, jobs: Sequence[Any], effort: Effort, executor: Executor, ahead: int
) -> Iterator[Batch]:
    """Submit jobs, at most `ahead` at a time; yield their outcomes as they arrive."""
    shared = _pickle(functools.partial(_attempt_with_versions, work))
    waiting, running = deque((job, 1) for job in jobs), dict[Future[Reply], tuple[Any, int]]()
    try:
        while waiting or running:
            while waiting and len(running) < ahead:
                job, trial = waiting.popleft()
                running[executor.submit(run_in_worker, shared, _pickle(job), effort.time_limit)] = job, trial
            batch: Batch = []
            stop: Exception | None = None
            for future in wait(running, PAUSE, FIRST_COMPLETED).done:
                job, trial = running.pop(future)
                try:
                    outcome = _read_outcome(future, trial > effort.retries, effort.time_limit)
                    if outcome is None:
                        waiting.appendleft((job, trial + 1))
                    else:
                        batch.append((job, outcome))
                except (InputError, BrokenExecutor, CancelledError) as error:
                    stop = error
            yield batch  # before the error of another job is raised: these results are kept
            if stop is not None:
                raise stop
    except (BrokenExecutor, CancelledError, RuntimeError, OSError) as error:
        reason = str(error) or type(error).__name__
        raise InputError(
            f"The executor has stopped ({reason}); finished jobs are kept, the same command continues from there."
        ) from None
    finally:
        for future in running:
            future.cancel()


def _read_outcome(future: Future[Reply], last: bool, time_limit: float | None) -> Outcome | None:
    """Return the outcome of a job; None if its worker was lost and retries are left."""
    try:
        reply = future.result()
    except (BrokenExecutor, CancelledError):
        raise
    except Exception as error:  # a Dask worker was killed, or lacks the package
        name = type(error).__name__
        reply = Reply(lost=f"{name}: {error}".splitlines()[0], begun=name == "KilledWorker")
    if reply.timed_out:
        sentence = f"Failed: ended after its time limit of {time_limit:g} s; with a longer one it is done again."
        return failure(TIMED_OUT, sentence, time_limit=time_limit)
    if reply.lost:
        if not last:
            return None
        if not reply.begun:
            raise InputError(f"The workers cannot start a job ({reply.lost}); check that they can import this package.")
        return failure(LOST, f"Failed: its worker was lost in every trial; in the last one {reply.lost}.")
    outcome, used = reply.result
    for name, version in versions().items():
        if used.get(name) != version:
            raise InputError(
                f"A worker has {name} {used.get(name)} and this process {version}; install the same version in "
                "both, because results of different versions are not mixed."
            )
    return outcome


def _attempt_with_versions(work: Work, job: Any) -> tuple[Outcome, dict[str, str]]:
    """Execute a job in a worker; return its outcome and the versions there."""
    return attempt(work, job), versions()


def _pickle(thing: Any) -> bytes:
    try:
        data = pickle.dumps(thing)
        if b"__main__" not in data:
            return data
        reason: object = "the main script defines it"  # a worker has another main script
    except Exception as error:
        reason = error
    try:  # workers cannot import code of a run file, a simulator file or a notebook; cloudpickle sends it
        import cloudpickle

        return bytes(cloudpickle.dumps(thing))
    except Exception:
        raise InputError(
            f"The model, the simulator or a constraint cannot be sent to other processes ({reason}); install "
            "pilfr-casadi[dask], which can send code, or use workers=1 without a time limit."
        ) from None


@contextlib.contextmanager
def dask_executor(address: str) -> Iterator[tuple[Executor, int, int]]:
    """Yield an executor on a Dask cluster, its number of threads, and the number of jobs to submit at a time."""
    try:
        from distributed import Client, Security
        from distributed.comm import connect
    except ImportError:
        raise InputError("--dask needs the package distributed; install pilfr-casadi[dask].") from None
    for name in [n for n in logging.root.manager.loggerDict if n.startswith("distributed")]:
        logging.getLogger(name).setLevel(logging.CRITICAL)  # errors that matter arrive as outcomes of jobs

    async def reach_scheduler() -> None:
        given = Security().get_connection_args("client")
        await (await connect(address, timeout=SCHEDULER_TIMEOUT, **given)).close()

    try:
        # a client that fails to connect waits 20 s more and prints a traceback; this thread may run a loop already
        with ThreadPoolExecutor(1) as other:
            other.submit(asyncio.run, reach_scheduler()).result()
        client = Client(address, timeout=SCHEDULER_TIMEOUT, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"No Dask scheduler can be used at {address} ({quote_error(error, 0)}); check the address, or start one "
            "with `dask scheduler` and workers with `dask worker`."
        ) from None
    try:
        threads = sum(client.nthreads().values())
        yield client.get_executor(pure=False), threads, max(AHEAD, 2 * threads)
    finally:
        client.close(timeout=2)
