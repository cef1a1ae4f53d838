"""The answer of a diagnosis: its verbs, what it says of a doubtful correction, and the progress on the way to it."""

import json
import re
from dataclasses import replace
from itertools import pairwise
from typing import ClassVar

import numpy as np
import pytest
from cart import cart
from diagnosis_example import example, recorded, rig

import pilfr_casadi as pilfr
from pilfr_casadi import InputError
from pilfr_casadi.data import nrmse
from pilfr_casadi.diagnose import BlindSpot, Effect, Workbench
from pilfr_casadi.diagnose.experiment import next_experiment
from pilfr_casadi.diagnose.faults.offsets import Offset
from pilfr_casadi.diagnose.proof import Started, compare_errors
from pilfr_casadi.engine import make_engine
from pilfr_casadi.identify import run_free
from pilfr_casadi.laws import Backlash, CoulombFriction, CubicDamping, CubicStiffness, StopHysteresis
from pilfr_casadi.models import Parameter
from pilfr_casadi.report import diagnosis_report
from pilfr_casadi.simulators import Simulator

LAWS = (CubicStiffness, CoulombFriction)
HIDDEN = rig().with_element("ground", CubicStiffness().at({"k_3": 2.0e4}))


@pytest.fixture(scope="module")
def diagnosed():
    """A diagnosis of a mass on a stiffening spring, its test recording, and everything that it reported on the way."""
    reports, test = [], recorded(HIDDEN, 2, samples=400)
    found = pilfr.diagnose(
        rig(430.0, 5.0),
        recorded(HIDDEN, 0, samples=400),
        test=test,
        hold="zero",
        laws=LAWS,
        effects=1,
        workers=1,
        progress=lambda *given: reports.append(given),
    )
    return found, test, reports


def test_a_fault_that_leaves_more_than_the_noise_tells_which_law_follows_to_it(diagnosed):
    found, _, _ = diagnosed
    errors = {**found.errors, "train": {**found.errors["train"], "after": 3 * found.floor["nrmse"]}}
    fault = replace(found, verdict="recording-fault", effects=(), errors=errors)
    told = [note for note in fault.warnings() if "times the noise" in note]
    assert len(told) == 1 and "3 times the noise" in told[0] and "cubic stiffness at ground follows to" in told[0], told


def test_the_verbs_tell_what_the_diagnosis_told(diagnosed):
    found, test, _ = diagnosed
    assert [(e.port, e.law) for e in found.effects] == [("ground", "cubic_stiffness")]
    assert found.nrmse(test) == pytest.approx(found.errors["test"]["after"], rel=1e-9)
    y = found.simulate(test)
    assert y.shape == test.y.shape and np.std(y - test.y) < 2e-3 * np.std(test.y)
    figure = found.plot(test)
    assert len(figure.axes) == 2 and {"refitted", "corrected"} <= set(figure.axes[0].get_legend_handles_labels()[1])
    assert found.outcome == "better" and found.sure and found.summary == found.sentence
    with pytest.raises(InputError, match=r"step is 0\.02 s, the training's 0\.01 s"):
        found.simulate(replace(test, dt=0.02))
    step = found.export().step
    assert step.n_in() == 2


@pytest.mark.usefixtures("blank_figures")
def test_further_laws_of_the_corrected_simulator_are_told_beside_the_named_ones(diagnosed, tmp_path):
    found, _, _ = diagnosed
    corrected = found.corrected.with_element("ground", CoulombFriction().at({"F_c": 0.25, "v_0": 2e-3}))
    more = replace(found, corrected=corrected)
    assert [e.law for e in more.effects] == ["cubic_stiffness"]
    told = str(more).split("in the correction, without a sure name: Coulomb friction (smooth) at ground")[1]
    assert "F_c = 0.25" in told and "without a sure name" not in str(found)
    page = diagnosis_report(more, tmp_path).read_text()
    assert "Also in the correction, without a sure name: Coulomb friction (smooth) at ground:" in page
    assert "with cubic stiffness and laws of uncertain name" in page


def test_a_port_with_the_wrong_sign_is_told():
    train = recorded(rig().with_element("ground", CoulombFriction().at({"F_c": 1.5, "v_0": 0.01})), 0, samples=400)
    (port,) = rig().ports
    for sign, told in ((-1.0, False), (1.0, True)):
        given = replace(rig(430.0, 5.0), ports=(replace(port, into={"vel": sign}),))
        found = pilfr.diagnose(given, train, laws="coulomb_friction, cubic_stiffness", workers=1)
        assert [e.law for e in found.effects] == ["coulomb_friction"]
        assert ("check the port's sign" in str(found)) == told


@pytest.mark.usefixtures("blank_figures")
def test_the_noise_is_told_relative_to_each_recording(diagnosed, tmp_path):
    found, test, _ = diagnosed
    noise = found.floor["test"]["nrmse"]
    assert noise == pytest.approx(found.evidence.noise[0] / np.std(test.y)) and noise != found.floor["nrmse"]
    quiet = replace(found, floor={**found.floor, "test": {"nrmse": 0.1, "white": 0.1}})
    assert "(estimated), on the test recordings 0.1000 if they are as noisy" in str(quiet)
    page = diagnosis_report(quiet, tmp_path).read_text()
    assert "the noise floor is 10\xa0%." in page and page.count(">10\xa0%<") == 2  # figures of merit, table of errors


def test_a_value_at_its_bound_says_so(diagnosed):
    found, _, _ = diagnosed
    own = found.corrected.parameters
    name = next(k for k, p in own.items() if not p.fixed and k in found.parameters)
    tight = replace(own[name], bounds=(own[name].bounds[0], float(own[name].value)))
    held = replace(found, corrected=found.corrected.with_parameters({**own, name: tight}))
    (line,) = [line for line in str(held).splitlines() if line.startswith(f"  {name} = ")]
    assert line.endswith(", at its bound") and "at its bound" not in str(found)


def test_a_recording_is_corrected_before_it_is_simulated():
    flipped = [recorded(rig(), s, samples=400) for s in (0, 1)]
    flipped = [r.with_(y=-r.y) for r in flipped]
    found = pilfr.diagnose(
        rig(430.0, 5.0), flipped[0], test=flipped[1], laws=LAWS[:1], hold="zero", effects=1, workers=1
    )
    assert found.verdict == "recording-fault"
    assert found.nrmse(flipped[1]) == pytest.approx(found.errors["test"]["after"], rel=1e-9) and found.errors["test"][
        "after"
    ] == pytest.approx(1e-3, rel=0.5)


def test_progress_tells_each_stage_and_the_best_never_rises(diagnosed):
    _, _, reports = diagnosed
    bests = [best for *_, best in reports]
    assert all(b <= a for a, b in pairwise(bests))
    assert bests[-1] < 2e-3 and not np.isnan(bests).any()
    last = {stage: (done, total) for stage, done, total, _ in reports}
    assert all(done == total for done, total in last.values()), last
    assert {"checks and refit", "screen", "flexible", "fits", "choice", "conclusion", "proof"} <= set(last)
    assert reports[0][:2] == ("checks and refit", 0)


def test_a_search_with_the_other_hold_is_named_in_the_progress():
    from pilfr_casadi._base import Stages

    seen = []
    first = Stages(lambda *given: seen.append(given))
    first("fits", 1, 2, 0.3)
    second = first.under("other hold: ")
    second("fits", 1, 2, 0.5)
    second("fits", 2, 2, 0.2)
    first("proof", 0, 1)
    assert seen[1:] == [("other hold: fits", 1, 2, 0.3), ("other hold: fits", 2, 2, 0.2), ("proof", 0, 1, 0.2)]


def with_test_errors(before, after, confidence, **more):
    d = example(**more)
    errors = {**d.errors, "test": {"nominal": before, "before": before, "after": after}}
    return replace(d, errors=errors, effects=tuple(replace(e, confidence=confidence) for e in d.effects))


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize(
    ("confidence", "after", "tone"),
    [pytest.param(0.03, 0.01, "warning", marks=pytest.mark.slow), (0.03, 2.58, "bad")],
)
def test_colour_and_words_follow_confidence_and_the_test_recording(confidence, after, tone, tmp_path):
    d = with_test_errors(0.5, after, confidence)
    page = diagnosis_report(d, tmp_path).read_text()
    assert f'class="status {tone}"' in page
    written = json.loads((tmp_path / "diagnosis.json").read_text())
    assert "put back" not in page and "with cubic stiffness added" in page
    for text in (page, written["sentence"], str(d)):
        assert ("makes the test recordings worse" in text) == (after > 1)
    if after > 1:
        assert "50 % refitted and 258 % with it" in written["sentence"]
        assert "Do not use it as a correction" in str(d).splitlines()[0]
        assert "How to use the corrected simulator" not in page


@pytest.mark.parametrize(("after", "outcome"), [(0.4, "better"), (0.5, "same"), (0.52, "same"), (0.53, "worse")])
def test_the_outcome_compares_the_test_errors(after, outcome):
    assert with_test_errors(0.5, after, 0.9).outcome == outcome


def test_a_correction_that_diverges_on_the_test_recording_is_worse():
    d = with_test_errors(0.5, np.inf, 0.9)
    assert d.outcome == "worse" and "the simulation diverges" in d.summary


@pytest.mark.parametrize(("given", "told"), [(0.3, True), (0.45, False)])
def test_a_simulator_that_is_better_as_given_than_with_any_fit_is_told(given, told):
    d = with_test_errors(0.5, 0.46, 0.9)
    d = replace(d, errors={**d.errors, "test": {**d.errors["test"], "nominal": given}})
    words = "As given, the simulator follows the test recordings better than with any fit here: 30 %."
    assert (words in d.summary) == told and (words in str(d)) == told


def test_an_effect_that_the_test_recordings_do_not_need_is_told():
    d = with_test_errors(0.5, 0.1, 0.9)
    drag = replace(d.effects[0], law="quadratic_drag", form="", test_without=0.09)
    both = replace(d, effects=(replace(d.effects[0], test_without=0.4), drag))
    told = (
        "followed at least as well without quadratic drag at ground; its name rests on the training recordings alone."
    )
    assert told in both.summary and "rests on the training" not in d.summary


@pytest.mark.parametrize(("confidence", "at_port", "told"), [(0.27, 0.9, True), (0.27, 0.4, False), (0.9, 0.95, False)])
def test_a_port_that_is_surer_than_the_law_is_told(confidence, at_port, told):
    effect = Effect("outlet", "static_curve", confidence, "", "", {}, at_port=at_port)
    first = str(effect).splitlines()[0]
    assert first.endswith(f"{confidence:.2f}; confidence {at_port:.2f} that a law acts there") == told
    assert effect.to_dict()["confidence_at_port"] == at_port


def test_a_confidence_that_holds_for_several_ports_says_so():
    alike = (("sensor:level", "drift"), ("outlet", "offset"))
    shown = str(Effect("outlet", "drift", 0.98, "", "", {}, indistinguishable=alike))
    assert shown.startswith("drift at outlet, confidence 0.98 that it acts at outlet or sensor:level\n")
    alone = str(Effect("outlet", "drift", 0.98, "", "", {}, indistinguishable=alike[1:]))
    assert alone.startswith("drift at outlet, confidence 0.98\n")


def test_a_value_at_a_limit_of_its_law_is_told():
    class Narrow(Backlash):
        ranges: ClassVar = {"r": ("half", 0.001, 0.06)}

    u = 20 * pilfr.multisine(600, f_max=1.0, fs=50.0, rng=np.random.default_rng(0))
    blank = pilfr.Recording(u, 0 * u, 0.02, ("force",), ("pos",), initial="zero", hold="zero")
    y = cart().with_element("actuator:force", Backlash().at({"r": 4.0})).simulate(blank)
    for law, limited in ((Narrow, True), (Backlash, False)):
        (effect,) = pilfr.diagnose(cart(), blank.with_(y=y), laws=[law], effects=1, workers=1).effects
        assert effect.parameters["r"]["at_limit"] == limited == (", at the limit of the values tried" in str(effect))


def test_a_correction_that_no_test_recording_tried_says_so():
    d = with_test_errors(0.5, 0.1, 0.9)
    untested = replace(d, errors={**d.errors, "test": None})
    assert untested.summary == f"{d.sentence} This correction is not tested yet: give a recording of another " + (
        "experiment as test."
    )
    assert "not tested" not in d.summary
    assert "not tested" not in replace(untested, effects=(), correction=None).summary


def test_a_search_that_was_cut_short_says_so_first():
    d = with_test_errors(0.5, 0.1, 0.9)
    for how, by in (("interrupted", "Ctrl-C"), ("out_of_time", "the time limit")):
        cut_short = replace(d, **{how: True})
        first = str(cut_short).splitlines()[0]
        assert f"was cut short by {by}, so that a further effect may not have been tried" in first
        assert cut_short.to_dict()[how] is True
    assert "cut short" not in str(d).splitlines()[0]


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize(("without", "advised"), [(0.2, True), pytest.param(0.6, False, marks=pytest.mark.slow)])
def test_the_effect_that_harms_the_test_recording_is_told(without, advised, tmp_path):
    d = with_test_errors(0.5, 1.24, 0.9)
    drag = replace(d.effects[0], law="quadratic_drag", form="", test_without=without)
    d = replace(d, effects=(replace(d.effects[0], test_without=0.7), drag))
    page = diagnosis_report(d, tmp_path).read_text()
    assert ("Without quadratic drag at ground it is 20 %" in d.summary) == advised
    worth = f"rror on the test recordings: 124 % with it, {100 * without:.0f} % without it (the rest refitted)"
    assert worth in str(d) and worth in page
    assert json.loads((tmp_path / "diagnosis.json").read_text())["effects"][1]["test_without"] == without


def test_a_law_that_spoils_the_test_is_told_where_all_together_make_no_difference():
    d = example()
    drag = replace(d.effects[0], law="quadratic_drag", form="", test_without=0.86)
    errors = {role: {**e, "nominal": 4.0, "before": 2.12, "after": 2.16} for role, e in d.errors.items()}
    d = replace(d, effects=(replace(d.effects[0], test_without=2.2), drag), errors=errors)
    assert d.outcome == "same"
    assert "makes no difference: 212 % before, 216 % after. A constant would follow them better." in d.summary
    assert "Without quadratic drag at ground it is 86 %." in d.summary


@pytest.mark.usefixtures("blank_figures")
def test_the_gravest_blind_spots_stand_right_after_the_verdict(tmp_path):
    spots = tuple(BlindSpot("flat", (name,), f"These recordings say nothing about {name}.") for name in "abc")
    d = replace(example(), blind_spots=spots)
    lines = str(d).splitlines()
    assert [line.partition(": ")[2] for line in lines[1:3]] == [b.sentence for b in spots[:2]]
    assert f"  {spots[2].sentence}" in lines[4:]
    page = d.report(tmp_path).read_text()
    assert page.index(spots[0].sentence) < page.index(spots[1].sentence) < page.index("Confidence")
    assert spots[2].sentence not in page
    assert "blind spot" not in str(example()).lower()


@pytest.mark.usefixtures("blank_figures")
def test_a_free_vector_parameter_is_diagnosed_to_the_end(tmp_path):
    """A simulator whose stiffness and damping are the two entries of one parameter."""
    simulator = Simulator(
        lambda x, u, p: dict(pos=x.vel, vel=u.force - p.c[0] * x.pos - p.c[1] * x.vel),
        lambda x: {"pos": x.pos},
        states=("pos", "vel"),
        inputs=("force",),
        parameters={"c": Parameter(np.array([430.0, 5.0]), bounds=(np.array([50.0, 4.2]), np.array([2000.0, 50.0])))},
    )
    noisy = recorded(rig(), 0, samples=400, noise=0.02)  # noise hides that the bound is too high
    found = pilfr.diagnose(simulator, noisy, laws=LAWS[:1], hold="zero", effects=1, workers=1)
    assert any("c[1] (4.2) came out at its bound" in note for note in found.warnings())
    page = found.report(tmp_path)
    assert "c[1]" in page.read_text() and json.loads((tmp_path / "diagnosis.json").read_text())["parameters"]["c"]


def test_the_next_experiment_has_a_unit_that_the_simulator_knows():
    """Recordings without units are in those of the simulator."""
    r = recorded(HIDDEN, 0, samples=200)
    known = replace(rig(), units={"force": "N"})
    bench = Workbench.of(known, [r.with_(units={})], "zero")
    stiffening = known.with_element("ground", CubicStiffness().at({"k_3": 2.0e4}))
    both = [bench.run(s, {k: p.value for k, p in s.parameters.items()}, [np.zeros(2)]) for s in (known, stiffening)]
    found = next_experiment(bench, both, noise=1e-3 * bench.scale)
    assert " N at force separates the two best" in found["sentence"]


def test_the_next_experiment_says_where_the_machine_would_leave_its_recorded_range():
    """A mass without a spring goes far with a slow sine."""
    free = replace(rig(), parameters={"k": Parameter(0.0, fixed=True), "d": Parameter(4.0)})
    r = recorded(HIDDEN, 0, samples=200)
    bench = Workbench.of(free, [r.with_(units={"pos": "mm"})], "zero")
    dragged = free.with_element("ground", CubicDamping().at({"c_3": 1.0}))
    both = [bench.run(s, {k: p.value for k, p in s.parameters.items()}, [np.zeros(2)]) for s in (free, dragged)]
    said = next_experiment(bench, both, noise=1e-3 * bench.scale)["sentence"]
    assert re.search(
        r"By the simulation pos would vary over [^ ]+ mm; in these recordings it varies over [^ ]+ mm\.$", said
    )


def test_the_next_experiment_stays_within_the_recorded_range():
    """An input of one sign, such as a heater's, may not be able to have the other."""
    r = recorded(HIDDEN, 0, samples=200)
    pushed = r.with_(u=(r.u - np.min(r.u)) ** 4 / np.ptp(r.u) ** 3)  # most of the time near zero
    bench = Workbench.of(rig(), [pushed], "zero")
    stiffening = rig().with_element("ground", CubicStiffness().at({"k_3": 2.0e4}))
    both = [bench.run(s, {k: p.value for k, p in s.parameters.items()}, [np.zeros(2)]) for s in (rig(), stiffening)]
    found = next_experiment(bench, both, noise=1e-3 * bench.scale)
    assert found["level"] - found["amplitude"] > -1e-9 * np.ptp(pushed.u)
    assert found["level"] + found["amplitude"] < np.max(pushed.u) * (1 + 1e-9)
    assert f"about {found['level']:.3g}" in found["sentence"]


def test_simulators_are_compared_on_the_same_samples():
    """A law with memory takes longer to start; the simulator without it is scored from there on as well."""
    r = recorded(HIDDEN, 0).with_(initial="estimate")
    bench = Workbench.of(rig(), [r], "zero")
    plain, rich = (bench.model(s) for s in (rig(), rig().with_element("ground", StopHysteresis())))
    (alone, sooner), (_, first) = (run_free(m, make_engine(m), r) for m in (plain, rich))
    assert first > sooner
    errors = compare_errors(bench, {"plain": Started(plain), "rich": Started(rich)}).errors
    assert errors["plain"] == pytest.approx(nrmse(r.y, alone, skip=first))


def test_a_test_recording_that_rests_after_its_start_is_told():
    """Its initial state is estimated from the swing, which is not scored."""
    swing, rest = recorded(rig(), 0), recorded(rig(), 1)
    push = np.where(np.arange(700) < 40, 20.0, 0.0)[:, None]
    fading = swing.with_(u=push, y=rig().simulate(swing.with_(u=push)), initial="estimate", name="push")

    def resting(*tests):
        bench = Workbench.of(rig(), tests, "zero")
        return [name for name, _ in compare_errors(bench, {"": Started(bench.model(rig()))}).find_resting()]

    assert resting(fading, rest) == ["push"]
    assert not resting(fading.with_(initial="zero"))


def test_an_offset_beyond_the_range_of_its_signal_is_doubted():
    d = example()
    for value, doubted in ((1e3, True), (1.0, False)):
        shifted = d.corrected.with_element("actuator:force", Offset(values={"w_0": value}))
        told = [w for w in replace(d, corrected=shifted).warnings() if "is larger than force ever was" in w]
        assert bool(told) == doubted


def test_parts_of_a_diagnosis_print_briefly():
    """Their fits hold recordings and models, which nobody wants to read."""
    d = example()
    for part in (d.correction, d.effects, d.evidence):
        assert len(repr(part)) < 1500


def test_a_recording_in_which_the_machine_rests_is_scored_by_the_others(diagnosed):
    found, test, _ = diagnosed
    still = replace(test, u=0 * test.u, y=0 * test.y, initial="zero")
    assert found.nrmse(still) == pytest.approx(0.0, abs=1e-9)
    bench = Workbench.of(rig(), [test, still], "zero")
    errors = compare_errors(bench, {"": Started(bench.model(HIDDEN))}).errors[""]
    assert 0 < errors < 0.01


def test_a_range_of_noise_says_what_its_ends_are():
    d = replace(example(), floor={"nrmse": 0.03, "white": 0.002, "source": "estimated"})
    words = "0.0020 (its white part) to 0.0300 (with the slow part)"
    assert f"noise floor {words} (estimated)" in str(d)
    assert "the noise floor is 0.2\xa0% (its white part) to 3\xa0% (with the slow part)" in d._repr_html_()
