"""What the evidences of all hypotheses come to: the likeliest, how sure each effect is, and what is not told apart."""

from types import SimpleNamespace

import numpy as np
import pytest

from pilfr_casadi.diagnose.offsets import Offset
from pilfr_casadi.diagnose.trials import Trial
from pilfr_casadi.diagnose.verdict import explainable_remainder, posterior, share_named
from pilfr_casadi.laws import CoulombFriction, CubicStiffness, DirectionalFriction, QuadraticDrag
from pilfr_casadi.simulators import Placed

NOISE = 1e-6
SURE = share_named(0.0)  # of a law that leaves nothing


def trial(*laws, left=0.0):
    """A hypothesis of (port, law) that leaves a share of the mismatch."""
    whole = NOISE + left * (1 - NOISE)
    return Trial(tuple(Placed(port, law, f"{port}.") for port, law in laws), None, whole, whole, True)


def searched(told, flexible=0.0, full=1.0):
    """A search by its trials and their log evidences; of what each leaves, a flexible force follows a share.

    Where all samples count, log evidences are `full` times as large.
    """
    evidence = {t.key: value for t, value in told}
    return SimpleNamespace(
        memo={t.key: t for t, _ in told},
        root=trial(left=1.0),
        floor2=NOISE,
        bench=SimpleNamespace(simulator=SimpleNamespace(output_names=("x",))),
        evidence=lambda t: evidence[t.key],
        optimistic_evidence=lambda t: full * evidence[t.key],
        flexible=lambda t: {"a": flexible, "b": 0.0},
    )


DRY, CUBIC = ("a", CoulombFriction()), ("a", CubicStiffness())


def test_one_law_far_ahead_is_sure():
    found = posterior(searched([(trial(left=1.0), 0.0), (trial(DRY), 60.0), (trial(CUBIC, left=0.1), 20.0)]))
    assert [e.name for e in found.effects] == [("a", "coulomb_friction")]
    assert found.sure == found.effects[0].confidence == pytest.approx(found.named, abs=1e-6)
    assert found.named == SURE > 0.95
    assert found.nothing < 1e-6 and found.effects[0].alike == {}


@pytest.mark.parametrize(("behind", "share"), [(0.0, 0.5), (2.0, 0.881), (12.0, 1.0)])
def test_two_laws_that_tie_share_the_confidence(behind, share):
    found = posterior(searched([(trial(left=1.0), 0.0), (trial(DRY), 60.0), (trial(CUBIC), 60.0 - behind)]))
    assert found.sure == pytest.approx(SURE * share, rel=1e-3)
    assert list(found.effects[0].alike) == ([("a", "cubic_stiffness")] if behind < 3 else [])


def test_an_effect_keeps_its_name_only_in_the_corrected_simulator():
    both = trial(DRY, ("b", CubicStiffness()))
    found = posterior(searched([(trial(left=1.0), 0.0), (both, 60.0), (trial(DRY), 40.0)]))
    assert len(found.effects) == 2
    one = found.within({("a", "coulomb_friction"), ("b", "backlash")}, learned=0.0)
    assert [e.name for e in one.effects] == [("a", "coulomb_friction")]
    assert one.sure == pytest.approx(found.sure)
    beside = found.within({e.name for e in found.effects}, learned=0.3)
    assert len(beside.effects) == 2 and beside.sure < 0.5 * found.sure  # a learned force does much of it
    none = found.within({("b", "backlash")}, learned=0.0)
    assert none.effects == () and none.named < 0.5


def test_the_same_law_at_two_ports_that_are_not_told_apart_keeps_its_confidence():
    there = trial(("b", CoulombFriction()))
    found = posterior(searched([(trial(left=1.0), 0.0), (trial(DRY), 60.0), (there, 59.9)]))
    assert found.effects[0].alike == {there.name: there} and found.sure == pytest.approx(SURE)
    far = posterior(searched([(trial(left=1.0), 0.0), (trial(DRY), 60.0), (there, 55.0)]))
    assert far.effects[0].alike == {} and found.sure > far.sure > 0.9


def test_two_forms_of_a_law_are_one_answer():
    forms = [(trial(DRY), 60.0), (trial(("a", DirectionalFriction())), 60.0)]
    assert DirectionalFriction.id == CoulombFriction.id
    found = posterior(searched([(trial(left=1.0), 0.0), *forms, (trial(CUBIC), 60.4)]))
    assert [e.name for e in found.effects] == [("a", "coulomb_friction")]  # together they are likelier
    assert found.sure == pytest.approx(SURE * 2 / (2 + np.exp(0.4)), rel=1e-3)


def test_an_effect_counts_wherever_it_stands_beside_others():
    both, drag = trial(DRY, ("b", CubicStiffness())), trial(DRY, ("b", QuadraticDrag()))
    found = posterior(searched([(trial(left=1.0), 0.0), (trial(DRY, left=0.1), 30.0), (both, 60.0), (drag, 59.0)]))
    sure = {e.name: e.confidence for e in found.effects}
    assert sure[("a", "coulomb_friction")] == pytest.approx(SURE)
    assert min(sure.values()) == pytest.approx(SURE / (1 + np.exp(-1)))
    assert found.sure == min(sure.values())


def test_an_effect_that_is_likelier_out_than_in_is_not_said():
    others = [(trial(DRY, ("b", law())), 60.0) for law in (CubicStiffness, QuadraticDrag, CoulombFriction)]
    found = posterior(searched([(trial(left=1.0), 0.0), (trial(DRY), 58.0), *others]))
    assert [e.name for e in found.effects] == [("a", "coulomb_friction")]
    assert found.best.key == trial(DRY).key and found.sure == pytest.approx(SURE)


def test_that_nothing_is_missing_is_weighed_by_all_samples():
    told = [(trial(left=1.0), 0.0), (trial(DRY), 1.0)]
    assert posterior(searched(told)).nothing == pytest.approx(1 / (1 + np.e))
    found = posterior(searched(told, full=20.0))
    assert found.nothing < 1e-8 and found.sure == pytest.approx(SURE)


def test_the_simulator_alone_and_an_offset_are_no_effects():
    offset = trial(("actuator:u", Offset()))
    found = posterior(searched([(trial(left=1.0), 0.0), (offset, 5.0), (trial(DRY), 1.0)]))
    assert found.best is offset and (found.effects, found.sure, found.named) == ((), 0.0, 0.0)
    assert found.nothing == pytest.approx((1 + np.exp(5)) / (1 + np.exp(5) + np.exp(1)))


def test_what_a_flexible_force_would_still_follow_speaks_against_the_name():
    hypothesis, named, share = trial(DRY, left=0.3), [], []
    for flexible in (0.0, 0.3, 0.9):
        search = searched([(trial(left=1.0), 0.0), (hypothesis, 60.0)], flexible)
        share.append(explainable_remainder(search, hypothesis))
        named.append(posterior(search).named)
    assert share == sorted(share) and share[-1] == pytest.approx(0.3 * (0.9 + 0.2 * 0.1))
    assert named == sorted(named, reverse=True) and named[-1] < 0.5
    assert explainable_remainder(search, trial(DRY)) == 0.0


def test_a_small_effect_is_named_by_what_is_left_of_its_own_mismatch():
    small = ("b", CubicStiffness())
    for left, sure in ((1e-6, True), (2e-3, False)):  # after the large effect 1 % is left
        both = trial(DRY, small, left=left)
        told = [(trial(left=1.0), 0.0), (trial(DRY, left=0.01), 40.0), (trial(small, left=0.9), 5.0), (both, 80.0)]
        found = posterior(searched(told, flexible=0.5))
        named = {e.name: e.confidence for e in found.effects}
        assert named["a", "coulomb_friction"] > 0.9
        assert (named["b", "cubic_stiffness"] > 0.9) == sure and (named["b", "cubic_stiffness"] > 0.5) == sure


def test_a_law_that_leaves_nothing_is_the_physics_and_one_that_leaves_all_is_none():
    shares = [share_named(s) for s in np.linspace(0, 1, 200)]
    assert all(0 <= s <= 1 for s in shares) and np.all(np.diff(shares) <= 1e-12)
    assert shares[0] == SURE and shares[-1] < 0.1


def test_of_forms_that_follow_alike_the_plainest_is_stated():
    plain, finer = trial(DRY, left=1e-4), trial(("a", DirectionalFriction()), left=0.97e-4)
    told = [(trial(left=1.0), 0.0), (plain, 59.0), (finer, 60.0)]
    assert posterior(searched(told)).best is plain
    assert posterior(searched([*told[:2], (finer, 70.0)])).best is finer
    better = trial(("a", DirectionalFriction()), left=0.5e-4)
    assert posterior(searched([*told[:2], (better, 60.0)])).best is better
