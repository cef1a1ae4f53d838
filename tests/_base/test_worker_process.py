"""A child process keeps the function it was sent, and may end without harm."""

import os
import pickle
import time

from pilfr_casadi._base import close_workers, run_in_worker, workers


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
