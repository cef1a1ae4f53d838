"""The page of a diagnosis says what was found, for every verdict, and its files are what the contract asks for."""

import contextlib
import json
import re
import sys
import types
from dataclasses import replace

import numpy as np
import pytest
from browser import in_a_browser, needs_chromium
from cart import cart
from diagnosis_contract import SCHEMA, problems
from diagnosis_example import NOISE, PAIRS, as_it_stands, example, rig
from test_report import EVIL, Reader, own_scripts_alone

from pilfr_casadi import Recording, multisine
from pilfr_casadi._base import InputError
from pilfr_casadi.diagnose import Gate, Workbench, diagnose, learned_force
from pilfr_casadi.diagnose.result_text import Basis
from pilfr_casadi.laws import (
    CoulombFriction,
    LimitedTerm,
    SoftlyLimitedTerm,
    VaryingParameter,
    carried,
    scaled,
    scheduled,
)
from pilfr_casadi.report import corrected_file, diagnosis_report, diagnosis_report as same, usage
from pilfr_casadi.simulators import load_simulator


def test_the_checker_can_fail():
    good = example().to_dict()
    assert problems(good, SCHEMA) == []
    assert problems({**good, "verdict": "perhaps"}, SCHEMA)
    assert problems({**good, "effects": [{**good["effects"][0], "confidence": 1.2}]}, SCHEMA)
    assert problems({k: v for k, v in good.items() if k != "mismatch"}, SCHEMA)
    assert problems({**good, "fit": {**good["fit"], "test": {"nominal": "x"}}}, SCHEMA)


@pytest.mark.parametrize("verdict", ["missing-physics", "complete", "unexplained", "recording-fault"])
def test_every_verdict_has_its_files(verdict, tmp_path, without_drawing):
    d = example(verdict)
    with contextlib.nullcontext() if verdict == "missing-physics" else without_drawing():
        path = diagnosis_report(d, tmp_path / "new" / "folder")
    assert path == tmp_path / "new" / "folder" / "report.html"
    content = json.loads((path.parent / "diagnosis.json").read_text(), parse_constant=pytest.fail)
    assert problems(content, SCHEMA) == [] and content["verdict"] == verdict
    reader = Reader(path.read_text())
    titles = re.findall(r"<h2>(.*?)</h2>", path.read_text())
    assert d.sentence.rstrip(".") in reader.text
    assert "On held-out recordings the error is 40\xa0% as given, 20\xa0% refitted" in path.read_text()
    figures = sorted((path.parent / "figures").iterdir())
    assert len(figures) == len(reader.all("img")) > 8
    assert all(f.read_bytes()[:4] == b"\x89PNG" for f in figures)
    assert all(i["alt"] for i in reader.all("img"))
    words = re.sub(r"<pre.*?</pre>|<(script|style).*?</\1>", "", path.read_text(), flags=re.S)
    assert not re.search(r"[,;:]\.|\.\.|,,", words)
    assert not list(path.parent.rglob("*.tmp"))
    tone = {"missing-physics": "good", "complete": "good", "unexplained": "warning"}.get(verdict, "bad")
    assert f'class="status {tone}"' in path.read_text()
    assert ("The hidden force" in titles) == (verdict in ("missing-physics", "unexplained"))
    if verdict == "missing-physics":
        answer = r"Cubic stiffness at ground, [\d.]+ N, 93 % sure; error on unseen data 40 % as given, "
        assert (
            re.search(answer + r"[\d.]+ % refitted, 0.1 % corrected", reader.text)
            and "energy taken per cycle, mean" in reader.text
        )
        assert titles[0] == "What is missing" and "0.1\xa0% with cubic stiffness put back" in path.read_text()
        assert "cannot tell it apart from: creep at sensor:pos" in reader.text
        assert "3 more" not in reader.text and "6 more, with larger errors" in reader.text
    if verdict == "recording-fault":
        assert titles[0] == "What the recordings" + "&#39; checks found" and "wrong way round" in reader.text
        assert "The recordings are at fault: wrong sign of pos;" in reader.text  # what was not stated is no fault


@pytest.mark.usefixtures("blank_figures")
def test_no_force_is_looked_for_at_a_parameter_that_varies(tmp_path):
    """Of dry friction a damping that varies with the speed explains most; it is the closest law."""
    u = 10 * multisine(100, f_max=3.0, fs=20.0, rng=np.random.default_rng(1))
    blank = Recording(u, u, 0.05, ("force",), ("pos",), initial="zero", hold="zero")
    true = cart().with_element("ground", CoulombFriction().at({"F_c": 3.0, "v_0": 0.01}))
    d = diagnose(cart(), blank.with_(y=true.simulate(blank)), laws=(VaryingParameter,), effects=1, workers=1)
    assert "The closest law, variation of d with vel" in d.sentence
    text = Reader(diagnosis_report(d, tmp_path).read_text()).text
    assert "The points are the force at ground" in text and "the signal at parameter:d" not in text


@pytest.mark.usefixtures("blank_figures")
def test_without_test_recordings_it_says_so(tmp_path):
    text = Reader(diagnosis_report(example(test=False), tmp_path).read_text()).text
    assert "no test was given" in text and "none held out" in text and "test (held out)" not in text


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.slow
def test_reasons_for_less_confidence_are_mentioned(tmp_path):
    d = example()
    assert "far above the training error" not in Reader(diagnosis_report(d, tmp_path).read_text()).text
    worse = {**d.errors, "test": {**d.errors["test"], "after": 100 * d.errors["train"]["after"]}}
    text = Reader(diagnosis_report(replace(d, errors=worse), tmp_path).read_text()).text
    assert "The test error is far above the training error" in text


@pytest.mark.usefixtures("blank_figures")
def test_a_law_without_a_name_is_mentioned_with_the_error(tmp_path):
    d = example()
    assert "laws of uncertain name" not in Reader(diagnosis_report(d, tmp_path).read_text()).text
    more = d.corrected.with_element("ground", CoulombFriction().at({"F_c": 0.25, "v_0": 2e-3}))
    text = Reader(diagnosis_report(replace(d, corrected=more), tmp_path).read_text()).text
    assert "with cubic stiffness and laws of uncertain name put back" in text


def test_it_is_simulated_in_the_steps_of_the_fits():
    d = example()
    bench = Workbench.of(rig(), d.train, "zero")
    fine = {
        "without": as_it_stands(replace(bench, substeps=2), d.refitted),
        "after": as_it_stands(replace(bench, at_least=5), d.corrected),
    }
    assert [f.model.substeps for f in fine.values()] == [2, 5]
    found, known = replace(d, evidence=Basis(**fine)).before_and_after(d.train[0]), d.before_and_after(d.train[0])
    for name, evidence in (("before", "without"), ("after", "after")):
        assert np.allclose(getattr(found, name), fine[evidence].residual[0] + d.train[0].y, rtol=0, atol=1e-12)
        assert not np.array_equal(getattr(found, name), getattr(known, name))


@pytest.mark.usefixtures("blank_figures")
def test_a_test_that_gets_worse_a_refit_that_follows_nothing_and_an_interrupt_are_said(tmp_path):
    d = example()
    worse = {role: {**e, "before": 0.97, "after": 1.4} for role, e in d.errors.items()}
    found = replace(d, errors=worse, interrupted=True)
    notes = " ".join(found.warnings())
    assert "makes the test recordings worse: their error is 97 % refitted and 140 % with it" in found.summary
    assert "hardly better than a constant (error 97" in notes and "The search was interrupted" in notes
    far = {role: {**e, "before": 8.1} for role, e in d.errors.items()}
    shares = "Shares of the mismatch count such an error as the outputs' deviation."
    assert shares in " ".join(replace(d, errors=far).warnings()) and shares not in notes
    written = json.loads((diagnosis_report(found, tmp_path).parent / "diagnosis.json").read_text())
    text = Reader((tmp_path / "report.html").read_text()).text
    assert written["interrupted"] and written["notes"] == found.warnings()
    assert all(note in text and note in str(found) for note in found.warnings())


@pytest.mark.usefixtures("blank_figures")
def test_faults_that_were_corrected_stand_right_after_the_verdict_and_in_the_corrected_simulator(tmp_path):
    fault = Gate("pos", "exchanged", "vel", "In the recordings pos and vel are exchanged;\nexec('1/0')", fault=True)
    d = replace(example(), gates=(fault, Gate("force", "hold", "linear", "Interpolated fits better.")))
    told = f"The recordings were corrected: {fault.sentence}"
    assert str(d).startswith(f"{d.sentence}\n{told}\n") and str(d).count(fault.sentence) == 1
    assert f"{d.sentence} {told}. On held-out" in diagnosis_report(d, tmp_path).read_text().replace("&#39;", "'")
    source = corrected_file(d, "rig.py")
    lines = source.splitlines()
    at = lines.index("# In the recordings pos and vel are exchanged;")
    assert "corrected" in lines[at - 1] and lines[at + 1] == "#   exec('1/0')" and "Interpolated" not in source
    assert "belongs to" not in corrected_file(example(), "rig.py")
    compile(source, "corrected.py", "exec")


@pytest.mark.parametrize(
    ("port", "law"),
    [
        ("ground", scheduled(scaled(CoulombFriction, "force"), "t")),
        ("ground", scaled(scheduled(CoulombFriction, "force", "quadratic"), "force")),
        ("actuator:force", carried("force")),
        ("ground", learned_force("force")),
        ("ground", learned_force(of_speed=True)),
        ("ground", learned_force("force", of_speed=True)),
        ("force", LimitedTerm),
        ("force", SoftlyLimitedTerm),
    ],
)
def test_the_corrected_file_makes_composed_laws_and_limits_again(port, law, tmp_path):
    d, values = example(), {name: 0.5 for name in law.units}
    if "low" in values:
        values |= {"low": -1.0, "high": 1.0}
    given = tmp_path / "rig.py"
    given.write_text("from diagnosis_example import driven_rig\n\nsimulator = driven_rig(430.0, 5.0)\n")
    own = load_simulator(given)
    simulator = own.with_element(port, law().at(values))
    (tmp_path / "corrected.py").write_text(corrected_file(replace(d, refitted=own, corrected=simulator), "rig.py"))
    loaded = load_simulator(tmp_path / "corrected.py")
    assert [type(e.law) for e in loaded.elements] == [law]
    wanted = replace(simulator, hold=d.hold).simulate(d.train[0])
    assert np.array_equal(loaded.simulate(d.train[0]), wanted)


def test_the_corrected_file_keeps_values_for_which_the_search_widened_the_bounds(tmp_path):
    d = example()
    law = CoulombFriction().at({"F_c": 1.0, "v_0": 2e-3}, {"v_0": (1e-3, 0.1)})
    simulator = d.refitted.with_element("ground", law)
    own = simulator.parameters
    sharper = replace(own["ground.v_0"], value=2e-4, bounds=(1e-4, 0.1))
    freed = replace(own["k"], value=30.0, bounds=(0.0, np.inf))  # below the bounds of the diagnosed simulator
    simulator = simulator.with_parameters({"ground.v_0": sharper, "k": freed})
    (tmp_path / "rig.py").write_text("from diagnosis_example import rig\n\nsimulator = rig(430.0, 5.0)\n")
    (tmp_path / "corrected.py").write_text(corrected_file(replace(d, corrected=simulator), "rig.py"))
    loaded = load_simulator(tmp_path / "corrected.py")
    for name, p in simulator.parameters.items():
        assert loaded.parameters[name].value == p.value
        assert np.array_equal(loaded.parameters[name].bounds, p.bounds)
    wanted = replace(simulator, hold=d.hold).simulate(d.train[0])
    assert np.array_equal(loaded.simulate(d.train[0]), wanted)


@pytest.mark.usefixtures("blank_figures")
def test_old_figures_go_and_other_files_stay(tmp_path):
    (tmp_path / "figures").mkdir()
    old, mine = (tmp_path / "figures" / name for name in ("diagnosis-99-old.png", "mine.png"))
    old.touch(), mine.touch()
    same(example("complete"), tmp_path)
    assert not old.exists() and mine.exists()
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be made"):
        diagnosis_report(example("complete"), tmp_path / "file" / "folder")


@pytest.mark.parametrize("drawn", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_users_text_is_text(drawn, tmp_path, without_drawing):
    evil = EVIL.replace("\\", "")
    d = example(port=evil)
    d = replace(
        d,
        sentence=EVIL,
        effects=(replace(d.effects[0], sentence=EVIL, equation=EVIL, form=EVIL),),
        gates=(Gate(EVIL, EVIL, 1, EVIL, False),),
        next_experiment={"sentence": EVIL, "amplitude": 3.0, EVIL: EVIL},
        test=tuple(r.with_(name=EVIL) for r in d.test),
    )
    with contextlib.nullcontext() if drawn else without_drawing():
        html = diagnosis_report(d, tmp_path).read_text()
    reader = Reader(html)
    assert own_scripts_alone(html) and not any("onload" in attrs for _, attrs in reader.tags)
    assert reader.text.count("alert(1)") > 10
    assert all("<" not in f.name and "/" not in f.name for f in (tmp_path / "figures").iterdir())


@pytest.mark.parametrize(
    ("port", "law", "hold"),
    [
        *((*pair, "zero") for pair in PAIRS),
        *(("ground", "ground", hold) for hold in ("linear", "band-limited", "next")),
    ],
)
def test_the_lines_of_code_run(port, law, hold, tmp_path, monkeypatch):
    d = replace(example(port=port, law=law), hold=hold)
    module = types.ModuleType("your_file")
    module.simulator = replace(rig(380.0, 4.4), units={"force": "N", "pos": "m"})
    monkeypatch.setitem(sys.modules, "your_file", module)
    monkeypatch.chdir(tmp_path)
    r = d.train[0].with_(hold=hold)
    step_hold = "linear" if hold == "band-limited" else hold  # a step does not know the inputs around it
    r = r.with_(y=d.corrected.simulate(r.with_(hold=step_hold)))
    rows = np.column_stack([r.t, r.u / 1000, r.y * 1000])[20:]  # in other units, and not from rest
    np.savetxt("new.csv", rows, delimiter=",", header="t,force [kN],pos [mm]", comments="", fmt="%.12g")
    space = {}
    exec(usage(d), space)
    assert np.sqrt(np.mean((space["y"] - r.y[20:]) ** 2)) / np.std(r.y) < 3 * NOISE
    assert space["step"].n_in() == 2


@needs_chromium
@pytest.mark.slow
@pytest.mark.parametrize("verdict", ["missing-physics", "unexplained", "recording-fault", "complete"])
def test_in_a_browser(verdict, tmp_path):
    d = example(
        verdict,
        outputs=("pos", "vel"),
        law="hysteresis",
        port="a_port_with_a_name_that_goes_on_and_on_without_a_blank",
    )
    long_name = "a_recording_with_a_name_that_goes_on_and_on_without_a_single_blank_in_it"
    d = replace(d, test=tuple(r.with_(name=long_name) for r in d.test))
    diagnosis_report(d, tmp_path)
    for seen in in_a_browser(tmp_path / "report.html"):
        assert seen["title"] == "Diagnosis of a simulator: force → pos, vel"
        assert seen["pictures"] > 10


def test_a_free_run_says_of_which_recordings_it_is():
    d = example()
    free = dict.fromkeys(("nominal", "before", "after"), 2.0)
    tested = replace(d, errors={**d.errors, "free_run": free})
    assert "\n  test free " in str(tested) and "free run of the test recordings" in str(tested)
    alone = replace(d, errors={**d.errors, "test": None, "free_run": free})
    assert "\n  train free " in str(alone)


def test_an_effect_is_told_in_plain_terms():
    effect = example().effects[0]
    value = {"value": 0.7, "std": 0.98, "unit": "N", "at_limit": False}
    told = str(replace(effect, parameters={"F_0": value}))
    assert "F_0 = 0.7 ± 0.98 N, zero within its standard error: this term may be superfluous" in told
    at_state = str(replace(effect, port="equation:h1"))
    assert "subtracted from the derivative of h1" in at_state and "a flow that leaves" in at_state
    assert replace(effect, port="sensor:x", law="extra_mode", form="lag").name == "lag at sensor:x"
