"""Worker processes keep the function they were sent and may end without harm; fits run with one BLAS thread."""

import json
import os
import pickle
import subprocess
import sys
import time

from pilfr_casadi._base import close_workers, run_in_worker, workers

SCRIPT = """
import json
from pilfr_casadi._base import one_blas_thread

@one_blas_thread
def limited():
    import scipy.linalg  # late: with a BLAS of its own
    from threadpoolctl import threadpool_info
    return [found["num_threads"] for found in threadpool_info() if found["user_api"] == "blas"]

print(json.dumps(limited()))
"""


def test_every_blas_is_limited_to_one_thread_whenever_it_is_loaded():
    free = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True, env=free)
    counts = json.loads(done.stdout)
    assert counts and set(counts) == {1}


def test_a_child_keeps_its_function_and_reports_its_end():
    shared = pickle.dumps(abs)
    assert [run_in_worker(shared, pickle.dumps(k)).result for k in (-3, -4)] == [3, 4]
    mine = workers._of_this_thread.children[""].process.pid
    assert (
        run_in_worker(shared, pickle.dumps(-1)).result == 1 and workers._of_this_thread.children[""].process.pid == mine
    )
    lost = run_in_worker(pickle.dumps(os._exit), pickle.dumps(3))
    assert lost.lost == "its process ended with status 3" and lost.result is None
    assert "ValueError" in run_in_worker(pickle.dumps(int), pickle.dumps("x")).lost
    assert run_in_worker(pickle.dumps(time.sleep), pickle.dumps(600), 0.2).timed_out
    assert run_in_worker(shared, pickle.dumps(-5)).result == 5
    close_workers()


def test_an_idle_child_ends_and_is_replaced():
    shared = pickle.dumps(abs)
    assert run_in_worker(shared, pickle.dumps(-1)).result == 1
    first = workers._of_this_thread.children[""]
    first.process.stdin.close()  # as it ends when its worker does
    first.process.wait(10)
    assert run_in_worker(shared, pickle.dumps(-2)).result == 2 and workers._of_this_thread.children[""] is not first
    close_workers()
    assert run_in_worker(shared, pickle.dumps(-3)).result == 3
    close_workers()
