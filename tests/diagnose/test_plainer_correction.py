"""A correction with more laws has to predict clearly better on the held-out blocks."""

from __future__ import annotations

import numpy as np

from pilfr_casadi.diagnose.fits.evidence import HeldOut

BLOCKS = np.array([0.11, 0.26, 0.06, 0.19, 0.05, 0.12, 0.06, 0.18])


def held_out(each: np.ndarray) -> HeldOut:
    mean = float(np.mean(each))
    return HeldOut(mean, mean, np.array([mean]), each)


def test_one_block_does_not_decide() -> None:
    one_worse = BLOCKS * np.array([1.1, 20.0, 0.9, 1.05, 0.95, 1.0, 0.9, 1.1])
    assert held_out(one_worse).mean_square > 2 * held_out(BLOCKS).mean_square
    assert not held_out(one_worse).clearly_above(held_out(BLOCKS))


def test_a_small_but_steady_difference_decides() -> None:
    steadily = BLOCKS * np.array([1.1, 1.08, 1.12, 1.1, 1.09, 1.11, 1.1, 1.07])
    assert held_out(steadily).clearly_above(held_out(BLOCKS))
    assert not held_out(BLOCKS).clearly_above(held_out(steadily))


def test_without_blocks_the_smallest_error_decides() -> None:
    assert HeldOut(0.2, 0.2, np.array([0.2])).clearly_above(HeldOut(0.1, 0.1, np.array([0.1])))
