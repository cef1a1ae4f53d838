"""What the evidences of all hypotheses come to: the likeliest, how sure each effect is, and what is not told apart."""

from dataclasses import replace

import numpy as np
import pytest

from pilfr_casadi.diagnose.faults.offsets import Offset
from pilfr_casadi.diagnose.fits.evidence import FORMULA_ERROR, STRAINED_ODDS, HeldOut, formula_tolerance, significance
from pilfr_casadi.diagnose.posterior import explainable_remainder, indistinguishable, posterior, share_left, share_named
from pilfr_casadi.diagnose.verdict import closest_hypothesis, judge
from pilfr_casadi.laws import CoulombFriction, CubicStiffness, Delay, DirectionalFriction, QuadraticDrag

SURE = share_named(0.0)  # of a law that leaves nothing: 0.98
DRY, CUBIC = ("a", CoulombFriction), ("a", CubicStiffness)
DRY_NAME, CUBIC_NAME = ("a", "coulomb_friction"), ("a", "cubic_stiffness")


@pytest.fixture
def trial(hypothesis):
    """Make a hypothesis that leaves a share of the outputs' variance."""
    return lambda *laws, left=1e-6: hypothesis(*laws, error=left**0.5)


@pytest.fixture
def search(hypotheses):
    """Put up hypotheses; those given with a number are brought to one evidence, less so many nats, by a parameter."""

    def put(*given):
        costly = dict(one for one in given if isinstance(one, tuple))
        found = hypotheses(*costly, *(one for one in given if not isinstance(one, tuple)))
        level = min(map(found.evidence, costly), default=0.0)
        for t, behind in costly.items():
            ratio = np.expm1(2 * (found.evidence(t) - level + behind))
            information = np.array([ratio * (t.mean_square + found.tolerance) / found.samples])
            found.memo[t.key] = replace(t, information=information)
        return found

    return put


def sure_of(found):
    """Confidence of each effect by port and law."""
    return {e.name: e.confidence for e in found.effects}


@pytest.mark.parametrize(("behind", "share"), [(0.0, 0.5), (2.0, 0.881), (12.0, 1.0)])
def test_two_laws_that_tie_share_the_confidence(search, trial, behind, share):
    found = posterior(search((trial(DRY), 0.0), (trial(CUBIC), behind)))
    assert found.named == pytest.approx(SURE) and found.nothing < 1e-6
    assert sure_of(found) == {DRY_NAME: pytest.approx(SURE * share, rel=1e-3)}
    assert list(found.effects[0].alike) == ([CUBIC_NAME] if behind < 3 else [])


def test_a_law_that_predicts_other_data_badly_is_hardly_sure(search, trial):
    dry = trial(DRY)
    found = search(dry)
    for elsewhere, least, most in ((1e-6, 0.97, 0.99), (1e-2, 0.6, 0.95), (0.3, 0.0, 0.2)):
        squares = np.full(len(dry.fitted.squares), elsewhere)
        found.findings[dry.key].held_out = HeldOut(elsewhere, elsewhere, squares)
        assert least < posterior(found).named < most
    assert sure_of(posterior(search(trial(DRY)))) == {DRY_NAME: pytest.approx(SURE)}


def test_laws_that_all_diverge_leave_the_simulator_alone(search, trial):
    found = posterior(search(trial(DRY, left=np.inf), trial(CUBIC, left=np.inf)))
    assert found.nothing == 1.0 and not found.effects


@pytest.mark.parametrize(("port", "at_port"), [("a", SURE), ("b", SURE / 3)])
def test_a_port_is_sure_where_only_the_law_is_not(search, trial, port, at_port):
    """Three laws at one port, or at three."""
    tied = (trial(DRY), trial((port, CubicStiffness)), trial(("c" if port == "b" else "a", QuadraticDrag)))
    found = posterior(search(*((t, 0.0) for t in tied)))
    (effect,) = found.effects
    assert effect.confidence == pytest.approx(SURE / 3, rel=1e-3)
    assert effect.at_port == pytest.approx(at_port, rel=1e-3)
    said = judge(search(*((t, 0.0) for t in tied)), found, ()).sentence
    assert ("not certain, only that something acts at a." in said) == (port == "a")


def test_ports_that_are_not_told_apart_count_together(search, trial):
    """Friction at a or at b, or another law at b."""
    tied = (trial(DRY), trial(("b", CoulombFriction)), trial(("b", CubicStiffness)))
    (effect,) = posterior(search(*((t, 0.0) for t in tied))).effects
    assert effect.confidence == pytest.approx(2 / 3 * SURE, rel=1e-3)
    assert effect.at_port == pytest.approx(SURE, rel=1e-3)


@pytest.mark.parametrize(("left", "more"), [(9e-4, False), (2e-3, True)])
def test_what_formulas_may_leave_asks_for_no_further_law(search, trial, left, more):
    """The formula of a law may leave a thousandth of the mismatch; the quiet one of two sensors shows even that."""
    one = trial(DRY, left=left)
    assert search(one).can_improve(one) == more


@pytest.mark.parametrize("error", [1.0, 20.0])
def test_a_simulator_that_runs_away_excuses_no_error(search, trial, hypothesis, error):
    """Whether the refit is off by the outputs' deviation or by twenty times that, a law may leave as much."""
    one = trial(DRY, left=1e-2)
    found = search(one)
    found.memo[frozenset()] = hypothesis(error=error)
    noise2 = found.floor2
    assert found.tolerance == pytest.approx(FORMULA_ERROR * (1 - noise2), rel=1e-6)
    assert share_left(found, one.fitted) == pytest.approx((1e-2 - noise2) / (1 - noise2), rel=1e-6)


def test_each_output_excuses_an_error_up_to_its_own_deviation():
    assert formula_tolerance(np.array([0.5]), np.array([0.1])) == pytest.approx(0.4 * FORMULA_ERROR)
    assert formula_tolerance(np.array([400.0, 0.5]), np.zeros(2)) == pytest.approx(0.75 * FORMULA_ERROR)


def test_an_effect_keeps_its_name_only_in_the_corrected_simulator(search, trial):
    found = posterior(search(trial(DRY, ("b", CubicStiffness)), trial(DRY, left=0.1)))
    assert len(found.effects) == 2
    one = found.within({DRY_NAME, ("b", "backlash")}, learned=0.0)
    assert sure_of(one) == {DRY_NAME: pytest.approx(found.sure)}
    beside = found.within(sure_of(found), learned=0.3)
    assert len(beside.effects) == 2 and beside.sure < 0.5 * found.sure  # a learned force does much of it
    none = found.within({("b", "backlash")}, learned=0.0)
    assert none.effects == () and none.named < 0.5


@pytest.mark.parametrize(("behind", "told_apart"), [(0.1, False), (5.0, True)])
def test_the_same_law_at_two_ports_that_are_not_told_apart_keeps_its_confidence(search, trial, behind, told_apart):
    there = ("b", CoulombFriction)
    found = posterior(search((trial(DRY), 0.0), (trial(there), behind)))
    assert list(found.effects[0].alike) == ([] if told_apart else [("b", "coulomb_friction")])
    assert found.sure == pytest.approx(SURE / (1 + np.exp(-behind)) if told_apart else SURE)


@pytest.mark.parametrize(("left", "alike"), [(0.94, True), (0.99, False)])
def test_a_small_effect_has_look_alikes_that_explain_about_as_much_as_it(search, trial, left, alike):
    """The larger effect leaves 1 %; the smaller one removes 7 % of that, and so does the other law there, or hardly."""
    small, other = ("b", CubicStiffness), ("b", QuadraticDrag)
    best = trial(DRY, small, left=0.0093)
    found = search(trial(DRY, left=0.01), (best, 0.0), (trial(DRY, other, left=0.01 * left), 1.0))
    assert list(indistinguishable(found, best, best.laws[1])) == [("b", "quadratic_drag")] * alike


def test_two_forms_of_a_law_are_one_answer(search, trial):
    other_form = ("a", DirectionalFriction)
    assert DirectionalFriction.id == CoulombFriction.id
    found = posterior(search((trial(DRY), 0.4), (trial(other_form), 0.4), (trial(CUBIC), 0.0)))
    assert sure_of(found) == {DRY_NAME: pytest.approx(SURE * 2 / (2 + np.exp(0.4)), rel=1e-3)}  # together likelier


def test_an_effect_counts_wherever_it_stands_beside_others(search, trial):
    both, drag = trial(DRY, ("b", CubicStiffness)), trial(DRY, ("b", QuadraticDrag))
    found = posterior(search(trial(DRY, left=0.1), (both, 0.0), (drag, 1.0)))
    assert sure_of(found) == {
        DRY_NAME: pytest.approx(SURE),
        ("b", "cubic_stiffness"): pytest.approx(SURE / (1 + np.exp(-1))),
    }
    assert found.sure == min(sure_of(found).values())


def test_an_effect_that_is_likelier_out_than_in_is_not_said(search, trial):
    others = [(trial(DRY, ("b", law)), 0.0) for law in (CubicStiffness, QuadraticDrag, CoulombFriction)]
    found = posterior(search((trial(DRY), 2.0), *others))
    assert sure_of(found) == {DRY_NAME: pytest.approx(SURE)}
    assert found.best.key == trial(DRY).key


def test_that_nothing_is_missing_is_weighed_by_all_samples(search, trial):
    """Where all models are wrong, few samples count: by these the simulator alone would be about as likely."""
    dry = trial(DRY, left=0.8)
    found = search(dry)
    assert abs(found.evidence(dry) - found.evidence(found.root)) < 1
    assert posterior(found).nothing < 1e-4


def test_the_simulator_alone_and_an_offset_are_no_effects(search, trial):
    offset, dry = trial(("actuator:force", Offset), left=0.5), trial(DRY, left=0.52)
    found = search(offset, dry)
    told = posterior(found)
    assert told.best is offset and (told.effects, told.sure, told.named) == ((), 0.0, 0.0)
    odds = np.exp(found.optimistic_evidence(dry) - found.optimistic_evidence(offset))
    assert told.nothing == pytest.approx(1 / (1 + odds)) and odds > 0.01


def test_what_a_flexible_force_would_still_follow_speaks_against_the_name(search, trial):
    one, named, share = trial(DRY, left=0.3), [], []
    for flexible in (0.0, 0.3, 0.9):
        found = search(one)
        found.findings[one.key].flexible = {"a": flexible, "b": 0.0}
        share.append(explainable_remainder(found, one))
        named.append(posterior(found).named)
    assert share == sorted(share) and share[-1] == pytest.approx(0.3 * (0.9 + 0.2 * 0.1), rel=1e-5)
    assert named == sorted(named, reverse=True) and named[-1] < 0.5
    assert explainable_remainder(found, trial(DRY)) < 1e-6


@pytest.mark.parametrize(("left", "sure"), [(1e-6, True), (2e-3, False)])
def test_a_small_effect_is_named_by_what_is_left_of_its_own_mismatch(search, trial, left, sure):
    """After the large effect 1 % is left."""
    small = ("b", CubicStiffness)
    both = trial(DRY, small, left=left)
    found = search(trial(DRY, left=0.01), trial(small, left=0.9), both)
    found.findings[both.key].flexible = {"a": 0.5}
    confidence = sure_of(posterior(found))
    assert confidence[DRY_NAME] > 0.9
    assert (confidence["b", "cubic_stiffness"] > 0.9) == (confidence["b", "cubic_stiffness"] > 0.5) == sure


@pytest.mark.parametrize(("better", "behind", "is_plain"), [(0.97, 0.0, True), (0.97, 10.0, False), (0.5, 0.0, False)])
def test_of_forms_that_follow_alike_the_plainest_is_stated(search, trial, better, behind, is_plain):
    plain, finer = trial(DRY, left=1e-4), trial(("a", DirectionalFriction), left=better * 1e-4)
    told = search((plain, behind), finer) if behind else search(plain, finer)
    assert told.evidence(finer) > told.evidence(told.memo[plain.key])
    assert (posterior(told).best.key == plain.key) is is_plain


def test_the_closest_law_is_the_one_that_corrects_or_promises_most(search, trial):
    """A delay that explains nothing may be the likeliest where hardly any sample counts."""
    cube, delay = trial(CUBIC, left=0.5), trial(("actuator:force", Delay), left=1.0)
    found = search((cube, 4.0), delay)
    assert found.evidence(delay) > found.evidence(found.memo[cube.key])
    assert closest_hypothesis(found).key == cube.key
    assert closest_hypothesis(found, delay) is delay


def test_a_mismatch_below_the_noise_hardly_shows_what_explains_it(search, trial):
    noise2 = search(trial(DRY)).floor2
    second = DRY, ("b", CubicStiffness)
    for before, least, most in ((1e3, 0.95, 1.0), (1.1, 0.1, 0.5)):  # what the second law is left with, in noises
        found = posterior(search(trial(*second, left=noise2), trial(DRY, left=before * noise2)))
        assert sure_of(found)[DRY_NAME] > 0.95
        if len(found.effects) > 1:
            assert least < sure_of(found)["b", "cubic_stiffness"] <= most
        else:
            assert before < 2


def test_a_value_that_the_user_has_excluded_makes_a_law_less_sure(search, trial, tiny):
    bench, _ = tiny
    free = [k for k, p in bench.simulator.parameters.items() if not np.all(p.fixed)]
    for names in (free[:1], free[:2]):
        at_bound = trial(DRY)
        ends = {k: np.array(bench.simulator.parameters[k].bounds[1]) for k in names}
        values = {**at_bound.fitted.values, **ends}
        strained = replace(at_bound, fitted=replace(at_bound.fitted, values=values))
        assert strained.fitted.strained(free) == len(names) and not at_bound.fitted.strained(free)
        odds = STRAINED_ODDS ** len(names)
        assert posterior(search(strained)).named == pytest.approx(share_named(0.0, odds))
    assert 0.75 < share_named(0.0, STRAINED_ODDS) < 0.9


def test_a_refit_worse_than_a_constant_lends_a_law_no_confidence(search, trial):
    """A free run can be off by ten deviations; a law that leaves a tenth of the outputs' variance is still far off."""
    found = search(trial(DRY, left=0.1))
    (law,) = [t for t in found.memo.values() if t.laws]
    before = explainable_remainder(found, law)
    found.memo[found.root.key] = replace(found.root, part_mean_square=100.0, mean_square=100.0)
    assert explainable_remainder(found, law) == pytest.approx(before) and before > 0.01


def test_a_strength_that_may_be_zero_names_nothing(tiny):
    bench, _ = tiny
    fitted = bench.fit(bench.simulator.with_element("a", CubicStiffness().at({"k_3": 900.0})))
    assert significance(bench, fitted, ["a.k_3"]) > 0.999
    idle = replace(fitted, values={**fitted.values, "a.k_3": np.array(0.0)})
    assert significance(bench, idle, ["a.k_3"]) < 0.01


def test_an_effect_that_does_not_act_in_another_fit_of_its_laws_is_not_sure(search, trial, monkeypatch):
    """As a law that was found in predictions and is idle in a free run."""
    two = trial(DRY, ("b", CubicStiffness))
    found = posterior(search(two, trial(DRY, left=0.1)))
    acts = {"a.F_c": 1.0, "b.k_3": 0.2}
    monkeypatch.setitem(posterior.__globals__, "significance", lambda _, __, names: acts[names[0]])
    there = found.acting(search(two), two)
    before = sure_of(found)
    assert sure_of(there) == {name: pytest.approx(c * (1.0 if name == DRY_NAME else 0.2)) for name, c in before.items()}
    assert there.named == pytest.approx(found.named)
    acts["a.F_c"] = 0.1
    assert found.acting(search(two), two).named == pytest.approx(0.2 * found.named)


def test_a_law_that_degenerates_at_its_values_names_nothing_however_well_it_follows(search, trial, monkeypatch):
    two = trial(DRY, ("b", CubicStiffness))
    given = two, trial(DRY, left=0.1)
    assert posterior(search(*given)).sure > 0.9
    monkeypatch.setattr(CubicStiffness, "doubtful", lambda *_: True)
    found = posterior(search(*given))
    assert sure_of(found)[("b", "cubic_stiffness")] < 0.5 < sure_of(found)[DRY_NAME] and found.named > 0.9
    assert posterior(search(trial(CUBIC))).named < 0.5


def test_a_hypothesis_is_no_surer_than_its_surest_law(search, trial):
    """Together two laws leave little, but each of them little less than the other one alone."""
    both, small = trial(DRY, ("b", CubicStiffness), left=1e-4), ("b", CubicStiffness)
    found = search(both, trial(DRY, left=2e-4), trial(small, left=2e-4))
    found.findings[both.key].flexible = {"a": 0.9}
    answer = posterior(found)
    assert share_named(explainable_remainder(found, both)) > 0.9
    assert answer.best is both and answer.named < 0.5


def test_effects_are_said_in_the_form_that_corrects(search, trial):
    plain, other = trial(DRY, left=1e-4), trial(("a", DirectionalFriction), left=1e-4)
    found = posterior(search(plain, other))
    assert [e.element.law.form for e in found.effects] == ["smooth"]
    assert [e.element.law.form for e in found.as_fitted(other.fitted).effects] == ["directional"]


@pytest.mark.parametrize(("port", "sure"), [("a", False), ("b", True)])
def test_a_small_effect_is_not_surer_than_a_large_one_at_its_port(search, trial, monkeypatch, port, sure):
    """Beside a wrong law, it only corrects that."""
    small = (port, CubicStiffness)
    monkeypatch.setattr(CoulombFriction, "doubtful", lambda *_: True)
    found = posterior(search(trial(DRY, small), trial(DRY, left=0.1), trial(small, left=0.9)))
    confidence = sure_of(found)
    assert confidence[DRY_NAME] < 0.5 and (confidence[port, "cubic_stiffness"] > 0.9) == sure


def test_effective_samples_follow_the_hypotheses_and_are_counted_once(search, trial, monkeypatch):
    found, pooled = search(trial(DRY, left=0.5), trial(CUBIC, left=0.2)), []
    whole = type(found)._tolerant
    monkeypatch.setattr(type(found), "_tolerant", lambda self, t: pooled.append(t) or whole(self, t))
    before = [found.samples for _ in range(5)]
    assert len(pooled) <= len(found.memo) and len(set(before)) == 1
    found.keep(trial(DRY, CUBIC, left=0.01))
    assert found.samples > before[0]
