"""The search over hypotheses: when it stops, what it keeps, and what an interrupt and a time limit leave."""

import functools
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from diagnosis_rig import OFF, recordings, rig

import pilfr_casadi as pilfr
from pilfr_casadi import laws
from pilfr_casadi._base import Interrupt, Stages
from pilfr_casadi.diagnose import Workbench, correction, preparation
from pilfr_casadi.diagnose.faults.gates import Checked
from pilfr_casadi.diagnose.fits import flexible_forces
from pilfr_casadi.diagnose.fits.flexible_forces import flexible_shares
from pilfr_casadi.diagnose.fits.floor import Floor
from pilfr_casadi.diagnose.posterior import posterior
from pilfr_casadi.diagnose.search import hypotheses
from pilfr_casadi.diagnose.search.moves import Search
from pilfr_casadi.diagnose.search.trials import Trial, Trials
from pilfr_casadi.optimise import GaussNewton

FRICTION = laws.CoulombFriction(values={"F_c": 10.0, "v_0": 0.01})
TRIED = (laws.CoulombFriction, laws.CubicStiffness, laws.ViscousDamping)


@functools.cache
def rubbing():
    """A recording of the rig with friction; half as long, it says as much."""
    return [r.slice(0, 1200) for r in recordings(FRICTION, count=1)]


def searching(train, simulator=None, until=np.inf):
    """A search on recordings, not yet begun."""
    bench = Workbench.of(simulator or rig(OFF), train, "zero")
    floor = Floor(np.full(len(bench.scale), 1e-4), "estimated")
    return Search(bench, bench.fit(bench.simulator), floor, TRIED, 1, Stages(lambda *_: None), until=until)


def test_where_nothing_is_missing_nothing_is_fitted():
    found = searching(recordings(None, count=1)).run(2)
    assert list(found.memo) == [frozenset()] and not found.moves


def test_a_law_is_found_and_no_hypothesis_is_kept_twice():
    found = searching(rubbing()).run(2)
    assert [(e.port, e.law.id) for e in found.best.laws] == [("ground-m1", "coulomb_friction")]
    assert len(found.memo) == len({t.key for t in found.memo.values()}) > 1
    assert found.best.thorough and not found.interrupted
    assert found.evidence(found.best) > found.evidence(found.root) + 10


def test_laws_in_place_of_one_that_varies_are_looked_for_once(monkeypatch):
    """Only beside the hypothesis that it was added to."""
    found, asked = searching(rubbing()), list[int]()
    kind = laws.scheduled(laws.CoulombFriction, "t", "linear")
    fits = [found.without]
    for law in (kind(), laws.CubicStiffness()):
        fits.append(found.bench.fit(found.bench.simulator.with_element("ground-m1", law)))
    root, varied, other = (Trial.of(f, len(f.simulator.elements), thorough=True) for f in fits)
    for trial in (root, varied, other):
        found.keep(trial)
    assert found.best.key == varied.key
    monkeypatch.setattr(
        sys.modules["pilfr_casadi.diagnose.search.forms"], "in_place_of_variation", lambda *_: asked.append(1) or []
    )
    for base, times in ((other, 0), (root, 1), (root, 1)):
        found.replace_variation(base)
        assert len(asked) == times


@pytest.mark.parametrize("source", ["estimated", "repeats"])
def test_an_estimated_noise_is_no_larger_than_what_a_fit_leaves(source):
    found = searching(rubbing())
    refit = found.without
    given = found.floor = Floor(0.9 * refit.cost**0.5 * found.bench.scale, source)
    better = found.bench.fit(found.bench.simulator.with_element("ground-m1", laws.CoulombFriction()))
    assert better.cost < 0.1 * refit.cost
    for fitted, count in ((refit, 0), (better, 1)):
        found.keep(Trial(fitted.last_elements(count), fitted, fitted.cost, fitted.cost, True))
    assert found.floor is given if source == "repeats" else found.floor2 <= 1.0001 * better.cost


def test_an_interrupt_leaves_what_there_is(monkeypatch):
    def interrupted(self, trial):
        raise KeyboardInterrupt

    monkeypatch.setattr(Trials, "converge", interrupted)
    found = searching(rubbing()).run(2)
    assert found.interrupted and len(found.memo) > 1


def test_at_the_time_limit_the_search_answers_from_what_it_has():
    found = searching(rubbing(), until=0.0).run(2)
    assert found.out_of_time and len(found.moves) == 1  # the first law is fitted in any case
    (r,) = rubbing()
    diagnosis = pilfr.diagnose(rig(OFF), r.slice(0, 800), laws=TRIED, time_limit=1e-3)
    assert diagnosis.evidence.search.bench.deadline == np.inf  # what is fitted later, as by `refine`, has time
    assert "The time limit ended the search" in str(diagnosis)
    assert "none of the laws that were fitted before the time limit (1 of " in diagnosis.sentence
    with pytest.raises(pilfr.InputError, match="time_limit=0 was given"):
        pilfr.diagnose(rig(OFF), r, time_limit=0)


@pytest.mark.parametrize("late", [False, True])
def test_after_the_time_of_the_search_only_the_best_new_fit_is_converged(monkeypatch, late):
    converge, fit_pairs, converged = Trials.converge, Trials.fit_pairs, list[Trial]()

    def fit_until_the_limit(*given):
        trials = fit_pairs(*given)
        found.until = 0.0 if late else np.inf
        return trials

    found = searching(rubbing())
    found.laws = (laws.CubicStiffness, laws.ViscousDamping)  # they follow about alike
    monkeypatch.setattr(Trials, "fit_pairs", fit_until_the_limit)
    monkeypatch.setattr(Trials, "converge", lambda self, trial: converged.append(trial) or converge(self, trial))
    found.run(1)
    assert len(found.memo) > 3
    assert (len(converged) == 1) == late
    assert converged[0].key == max((t for t in found.memo.values() if t.laws), key=found.optimistic_evidence).key


@pytest.mark.parametrize("follows_its_part", [True, False])
def test_a_brief_fit_that_only_follows_its_part_is_converged(follows_its_part):
    """On the rest it may be far off only because it has not converged; this way a richer form lost to its plain one."""
    found = searching(rubbing())
    found.keep(Trial.of(found.without, 0, thorough=True))
    dry, richer = (
        found.bench.simulator.with_element("ground-m1", kind()) for kind in (type(FRICTION), laws.StribeckFriction)
    )
    plain = found.fits.fit(dry, [{"ground-m1.F_c": 9.0, "ground-m1.v_0": 0.01}], 1)
    start = {**plain.fitted.values, "ground-m1.F_c": 4.0, "ground-m1.F_e": 0.0, "ground-m1.v_s": 0.05}
    off = Trial.of(found.bench.run(richer, start, plain.fitted.initial), 1)
    off = replace(off, part_mean_square=plain.part_mean_square) if follows_its_part else off
    assert off.error > 3 * plain.error
    found.keep_all([plain, off])
    assert found.memo[off.key].thorough is follows_its_part
    assert (found.memo[off.key].error < 1.05 * plain.error) is follows_its_part


def test_hypotheses_are_not_compared_by_different_errors_where_time_ran_out(monkeypatch):
    """Held-out errors are larger than fit errors: a law that was judged on them lost to one that was not."""
    found = searching(rubbing()).run(1)
    found.held_out(found.best)
    endless, found.until = found.bench, 0.0
    found.bench = replace(endless, deadline=time.perf_counter())
    monkeypatch.setattr(Search, "_likeliest", lambda self: [self.root, self.best])
    found.cross_validate_likeliest()
    assert found.out_of_time and all(known.held_out is None for known in found.findings.values())
    found.bench = endless

    def just_in_time(bench, fitted, workers):
        found.bench = replace(bench, deadline=0.0)
        return complete(bench, fitted, workers)

    complete = hypotheses.held_out_errors
    monkeypatch.setattr(hypotheses, "held_out_errors", just_in_time)
    assert found.held_out(found.root) is found.findings[found.root.key].held_out  # it was complete
    assert found.held_out(found.best).rms == np.inf and found.findings[found.best.key].held_out is None


def test_where_the_time_ends_before_laws_are_compared_their_spread_counts(monkeypatch):
    """After the search, the comparison has half of the time that is left; a spread takes two derivatives."""
    found, clock = searching(rubbing()).run(1), [0.0]

    def slowly(search, trial):
        clock[0] += 60.0

    monkeypatch.setattr(hypotheses.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(Search, "_all_wrong", property(lambda self: True))
    monkeypatch.setattr(Search, "held_out", slowly)
    monkeypatch.setattr(Search, "spread", lambda self, fitted: 1e6 if fitted is friction.fitted else 1e-9)
    friction = found.best
    assert friction.law.id == "coulomb_friction"
    found.until, found.bench = -1.0, replace(found.bench, deadline=100.0)
    found.cross_validate_likeliest()
    assert clock[0] == 60.0 and found.out_of_time
    assert found.findings[friction.key].spread == 1e6
    assert max(found.memo.values(), key=found.evidence) is not friction


def test_a_law_found_only_beside_another_one_may_do_without_it():
    """Its own first fit was in a wrong minimum, and after the time limit the useless other law was sure."""
    found = searching(rubbing(), until=0.0).run(0)
    for kinds in ((FRICTION.at({"F_c": 0.1}),), (FRICTION, laws.CubicStiffness().at({"k_3": 1.0}))):
        placed = rig(OFF)
        for law in kinds:
            placed = placed.with_element("ground-m1", law)
        both = len(kinds) > 1
        fitted = found.bench.fit(placed) if both else found.bench.run(placed, {}, found.without.begin)
        found.keep(found.fits.make_trial(fitted, len(kinds)))
    (single,) = [t for t in found.memo.values() if len(t.laws) == 1]
    assert len(found.best.laws) == 2
    found.exchange()
    assert found.best.key == single.key and found.best.mean_square < 0.1 * single.mean_square


def test_an_effect_that_a_later_one_has_made_idle_is_left_out():
    found = searching(rubbing(), until=0.0).run(0)
    placed = rig(OFF)
    for law in (laws.CubicStiffness().at({"k_3": 1.0}), FRICTION):
        placed = placed.with_element("ground-m1", law)
    found.keep(found.fits.make_trial(found.bench.fit(placed), 2))
    assert len(found.best.laws) == 2
    found.run(0)
    assert [e.law.id for e in found.best.laws] == ["coulomb_friction"]


def test_after_the_deadline_and_ctrl_c_the_correction_fits_nothing_more(monkeypatch):
    found = searching(rubbing()).run(1)
    found.memo = {key: replace(t, thorough=False) for key, t in found.memo.items()}
    fitted, converge = [], Trials.converge

    def refit(bench, found):
        fitted.append(found)
        raise pilfr.InputError("It diverges.")

    monkeypatch.setattr(Trials, "converge", lambda self, trial: fitted.append(trial) or converge(self, trial))
    monkeypatch.setattr(correction, "refit_learned", refit)
    found.bench, answer = replace(found.bench, deadline=0.0), posterior(found)
    correction.find_unnamed_correction(found)
    unsure = replace(answer, effects=tuple(replace(e, confidence=0.4) for e in answer.effects))
    assert correction.find_named_correction(found, unsure)[0].elements  # no comparison has refuted the name
    assert not fitted
    found.bench = replace(found.bench, deadline=np.inf, interrupt=Interrupt(True, True))
    with monkeypatch.context() as patch:  # after Ctrl-C not even the parts that a comparison needs
        for module in (hypotheses, correction):
            patch.setattr(module, "held_out_errors", lambda *_: pytest.fail("a comparison after Ctrl-C"))
        assert correction.find_named_correction(found, unsure)[0].elements
    found.bench = replace(found.bench, interrupt=Interrupt())
    correction.find_unnamed_correction(found)
    assert fitted


def test_an_answer_that_rests_on_an_interrupted_fit_is_concluded():
    search = searching(rubbing()).run(1)
    search.bench.interrupt.pressed = True
    with pytest.raises(KeyboardInterrupt), search.stage("fits"):
        pass
    search.bench.interrupt.handle()
    with search.stage("conclusion"):
        assert posterior(search).effects


def test_a_hypothesis_fitted_to_a_part_is_judged_on_everything(monkeypatch):
    monkeypatch.setitem(vars(sys.modules[Trials.__module__]), "COMPARED_SAMPLES", 300)
    search = searching(rubbing())
    placed = rig(OFF).with_element("ground-m1", FRICTION)
    trial = search.fits.fit(placed, [{}], 1)
    (whole,) = search.bench.recordings
    assert [len(e) for e in trial.fitted.residual] == [len(whole)]
    assert trial.mean_square == trial.fitted.cost != trial.part_mean_square


def at_rest_first(samples):
    """The recording with friction, with so many samples at rest before it."""
    (r,) = rubbing()
    still = np.zeros((samples, 1))
    return r.with_(u=np.vstack([still, r.u]), y=np.vstack([still + r.y[0], r.y]))


def test_brief_fits_see_more_than_a_long_rest_before_the_motion(monkeypatch):
    """They used the head of a recording, where no friction slips."""
    monkeypatch.setitem(vars(sys.modules[Trials.__module__]), "COMPARED_SAMPLES", 600)
    search = searching([at_rest_first(600)])
    placed, begin = rig(OFF).with_element("ground-m1", FRICTION.at({"F_c": 5.0})), search.without.begin
    trial = search.fits.fit(placed, [search.without.values], 1, states=begin)
    assert trial.mean_square < 1e-3 * search.without.cost
    assert 800 < len(search.fits.part.recordings[0]) < 1200
    assert len(searching(rubbing()).fits.part.recordings[0]) < 800  # the head says as much as the rest


def test_a_flexible_force_is_looked_for_where_the_error_is(monkeypatch):
    """With many states a part of a long recording has to do."""
    monkeypatch.setattr(flexible_forces, "MOST_WORK", 0)
    monkeypatch.setattr(flexible_forces, "LEAST_SAMPLES", 400)
    search = searching([at_rest_first(600)])
    assert max(flexible_shares(search.bench, search.without).values()) > 0.9


def test_a_law_that_only_led_the_simulator_out_of_a_dead_end_is_no_physics():
    train = [r.slice(0, 1200) for r in recordings(None, count=1)]
    search = searching(train, rig((3.0, 1.0, 1.0, 1.0)))
    stuck = search.bench.fit(search.bench.simulator, solver=GaussNewton(max_iterations=1))
    search.without = stuck
    found = search.run(1)
    assert found.best is found.root
    assert found.root.mean_square < 1e-3 * stuck.cost


@pytest.fixture
def stuck_refit(monkeypatch):
    """Recordings that lack nothing, of a simulator whose refit stays in a local minimum."""

    def stuck(bench, gates=()):
        return Checked(bench, bench.fit(bench.simulator, solver=GaussNewton(max_iterations=1)), gates)

    monkeypatch.setattr(preparation, "first_refit", stuck)
    return recordings(None, count=1)


@pytest.mark.slow
def test_a_shift_that_only_led_out_of_a_dead_end_is_no_fault(stuck_refit):
    found = pilfr.diagnose(rig((1.4, 0.8, 0.8, 1.2)), stuck_refit)
    assert (found.verdict, found.gates) == ("complete", ()), str(found)


def test_samples_that_a_delay_follows_by_its_unknown_beginning_do_not_count_for_it():
    """Known beginnings follow nothing."""
    given = recordings(None, count=1)[0].slice(0, 60)
    late = {"T": 20 * given.dt}
    evidences = []
    for initial in ("estimate", "zero"):
        found = searching([given.with_(initial=initial)])
        placed = found.bench.simulator.with_element(
            "actuator:force", laws.Delay().at(late, {"T": (0.0, 2 * late["T"])})
        )
        delayed = Trial.of(found.bench.run(placed, found.without.values, found.without.begin), 1)
        alike = replace(delayed, fitted=replace(delayed.fitted, squares=found.without.squares))
        found.keep(Trial.of(found.without, 0, thorough=True))
        evidences.append(found.optimistic_evidence(alike) - found.optimistic_evidence(found.root))
    assert evidences[0] < evidences[1] - 1
