"""A job in a process of its own: it keeps what it was sent, and its end harms nobody."""

import os
import pickle
import time

from pilfr_casadi._base import worker_process as hand


def test_a_hand_keeps_its_function_and_its_end_is_told():
    shared = pickle.dumps(abs)
    assert [hand.do(shared, pickle.dumps(k)).result for k in (-3, -4)] == [3, 4]
    mine = hand._mine.hand.process.pid
    assert hand.do(shared, pickle.dumps(-1)).result == 1 and hand._mine.hand.process.pid == mine
    lost = hand.do(pickle.dumps(os._exit), pickle.dumps(3))
    assert lost.lost == "its process ended with status 3" and lost.result is None
    assert "ValueError" in hand.do(pickle.dumps(int), pickle.dumps("x")).lost
    assert hand.do(pickle.dumps(time.sleep), pickle.dumps(600), 0.2).timed_out
    assert hand.do(shared, pickle.dumps(-5)).result == 5
    hand.close_hands()


def test_an_idle_hand_ends_and_another_takes_over():
    shared = pickle.dumps(abs)
    assert hand.do(shared, pickle.dumps(-1)).result == 1
    first = hand._mine.hand
    first.process.stdin.close()  # as it ends when its worker does
    first.process.wait(10)
    assert hand.do(shared, pickle.dumps(-2)).result == 2 and hand._mine.hand is not first
    hand.close_hands()
    assert hand.do(shared, pickle.dumps(-3)).result == 3
    hand.close_hands()
