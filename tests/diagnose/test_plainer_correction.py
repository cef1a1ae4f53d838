"""A correction with more laws has to predict clearly better on the held-out blocks."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from pilfr_casadi.diagnose.correction import _choose
from pilfr_casadi.diagnose.fits.evidence import ExpectedError, HeldOut
from pilfr_casadi.diagnose.posterior import indistinguishable

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


def test_blocks_count_by_their_samples() -> None:
    """A short recording has as many blocks as a long one; on a few samples an error is nearly random."""
    long, short = np.full(8, 500), np.full(24, 1)
    few = np.tile([3.0, 0.2, 5.0, 0.4, 1.0, 0.1, 2.0, 0.8], 3)
    steadily = np.array([1.1, 1.08, 1.12, 1.1, 1.09, 1.11, 1.1, 1.07])
    both, sizes = np.append(BLOCKS * steadily, np.tile(BLOCKS, 3) * few), np.append(long, short)
    errors = [HeldOut(0.1, 0.1, np.array([0.1]), each, sizes) for each in (both, np.append(BLOCKS, np.tile(BLOCKS, 3)))]
    assert errors[0].clearly_above(errors[1]) and not errors[1].clearly_above(errors[0])
    alike = [replace(one, sizes=np.ones(1)) for one in errors]
    assert not alike[0].clearly_above(alike[1])


def test_a_law_that_acts_in_few_blocks_decides() -> None:
    """As a stop that is met once or twice: what it explains varies too much for a standard error."""
    without = BLOCKS * np.array([1.0, 80.0, 2.0, 1.0, 1.0, 120.0, 1.0, 1.0])
    assert held_out(without).clearly_above(held_out(BLOCKS))
    assert not held_out(without * np.array([1, 1, 1, 1, 0.8, 1, 1, 1])).clearly_above(held_out(BLOCKS))
    hardly = BLOCKS * np.array([1.0, 1.5, 1.0, 1.0, 1.0, 1.2, 1.0, 1.0])
    assert not held_out(hardly).clearly_above(held_out(BLOCKS))


def test_a_sure_law_stays() -> None:
    """A law that the correction leaves out has no name in the answer either."""
    law = ("wall", "clearance")
    errors = {frozenset(): BLOCKS * np.array([1.1, 20.0, 0.9, 1.05, 0.95, 1.0, 0.9, 1.1]), frozenset({law}): BLOCKS}
    refit, named = (
        (SimpleNamespace(elements=len(names), base=SimpleNamespace(names=names)), ExpectedError(held_out(each), 0.0))
        for names, each in errors.items()
    )
    assert _choose([refit, named]) is refit  # type: ignore[list-item]
    assert _choose([refit, named], frozenset({law})) is named  # type: ignore[list-item]


def test_more_laws_and_a_larger_expected_error_than_the_refit_are_no_correction() -> None:
    """On the held-out blocks it is hardly worse than the best, but on the second halves worse than the refit."""
    uneven = BLOCKS * np.array([1.3, 0.9, 1.5, 0.9, 1.0, 0.9, 1.0, 0.9])
    of = {0: held_out(1.4 * BLOCKS), 1: replace(held_out(uneven), ahead=0.3), 2: held_out(BLOCKS)}
    assert of[0].clearly_above(of[2]) and not of[1].clearly_above(of[2])
    assert of[1].mean_square > of[0].mean_square > of[2].mean_square
    refit, one, two = (
        (SimpleNamespace(elements=n, base=SimpleNamespace(names=frozenset[object]())), ExpectedError(found, 0.0))
        for n, found in of.items()
    )
    assert _choose([refit, one, two]) is two  # type: ignore[list-item]
    better = (one[0], ExpectedError(replace(of[1], ahead=of[1].blocks), 0.0))
    assert _choose([refit, better, two]) is better  # type: ignore[list-item]


def test_without_blocks_the_smallest_error_decides() -> None:
    assert HeldOut(0.2, 0.2, np.array([0.2])).clearly_above(HeldOut(0.1, 0.1, np.array([0.1])))


def test_a_law_is_compared_in_its_likeliest_form() -> None:
    """A correction may have another form, such as one with more values."""
    trials = {
        name: SimpleNamespace(names=frozenset({("wall", law)}), evidence=evidence, mean_square=0.01)
        for name, law, evidence in (("plain", "friction", 17), ("curved", "friction", 13), ("other", "damping", 13))
    }
    bench = SimpleNamespace(simulator=SimpleNamespace(output_names=("y",)))
    search = SimpleNamespace(memo=trials, evidence=lambda t: t.evidence, bench=bench)
    own = SimpleNamespace(name=("wall", "friction"), law=SimpleNamespace(id="friction"))
    assert not indistinguishable(search, trials["curved"], own)  # type: ignore[arg-type]
    trials["other"].evidence = 17
    assert list(indistinguishable(search, trials["curved"], own)) == [("wall", "damping")]  # type: ignore[arg-type]
    trials["nothing"] = SimpleNamespace(names=frozenset(), evidence=10, mean_square=0.0105)
    assert indistinguishable(search, trials["curved"], own)  # type: ignore[arg-type]
    trials["other"].mean_square = 0.0105  # it explains nothing
    assert not indistinguishable(search, trials["curved"], own)  # type: ignore[arg-type]
