"""Physics outside the catalogue is followed by a learned element, which predicts, exports and knows its range."""

import json
import sys
import time
import types
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from diagnosis_contract import SCHEMA, problems
from diagnosis_example import LAWS, NOISE, recorded, rig

import pilfr_casadi as pilfr
from pilfr_casadi.diagnose import Effect, Workbench
from pilfr_casadi.diagnose.fits import evidence
from pilfr_casadi.diagnose.fits.evidence import _sum_of_squares, held_out_errors
from pilfr_casadi.diagnose.search.learned import LearnedForce, learn_forces, nearest_laws
from pilfr_casadi.laws import Backlash, CubicStiffness, Law, Local, hysteresis_layer
from pilfr_casadi.models import play
from pilfr_casadi.report import diagnosis_report, usage

OPTIONS = {"hold": "zero", "effects": 1, "workers": 1}


class Nameless(Law):
    """A spring that stiffens on one side, and a stop whose force an input scales."""

    id, equation, units, memory = "nameless", "w = 3 sinh(z / 0.04 + 1) + (3 + 0.2 u) stop(z)", {}, 1

    def step(self, z, s, p, u=None):
        following = play(z, s, 0.02)
        scale = 3 + 0.2 * u.force if u is not None else 3
        return 3 * ca.sinh(z / 0.04 + 1) + scale * (z - following) / 0.02, following


@pytest.fixture(scope="module")
def nameless():
    true = rig().with_element("ground", Nameless())
    test = recorded(true, 2, name="held out")
    return pilfr.diagnose(rig(430.0, 5.0), recorded(true, 0), test=test, laws=(Backlash,), **OPTIONS)


def test_the_correction_halves_the_error_without_a_name(nameless):
    assert (nameless.verdict, nameless.effects) == ("unexplained", ())
    learned = nameless.learned[-1]
    assert learned.port == "ground" and nameless.corrected.elements[-1].law.id == "learned"
    for errors in nameless.errors.values():
        assert errors["after"] < 0.5 * errors["before"]
    assert sum(nameless.shares.values()) == pytest.approx(1) and nameless.shares["left"] < 0.2
    assert learned.share == nameless.shares["learned"] > 0.3
    assert nameless.correction.sentence in str(nameless) and "a learned force" in nameless.correction.sentence
    assert nameless.nrmse(nameless.test[0]) == pytest.approx(nameless.errors["test"]["after"], rel=1e-6)


def test_laws_without_a_sure_name_are_printed_with_their_values(nameless):
    law = CubicStiffness().at({"k_3": 5.0})
    shown = str(replace(nameless, corrected=nameless.corrected.with_element("ground", law)))
    header = "in the correction, without a sure name: cubic stiffness at ground"
    assert f"{header}\n  w = k_3 z^3\n  k_3 = 5 N/m^3\n" in shown
    assert "learned" not in shown.split("without a sure name", 1)[1].split("values, refitted")[0]


def test_a_law_with_many_values_is_printed_with_all_of_them_in_a_line(nameless):
    law = hysteresis_layer("stop", 2, series=False)().at({"w": [3.0, 0.5], "r": [0.1, 0.25]})
    shown = str(replace(nameless, corrected=nameless.corrected.with_element("ground", law)))
    assert f"{law.id} (Prandtl-Ishlinskii) at ground\n  {law.equation}\n  w = 3, 0.5 N/m\n  r = 0.1, 0.25 m\n" in shown
    one = {"value": 3.0, "std": 0.1, "unit": "N/m"}
    values = {"w[0]": one, "w[1]": {**one, "value": 0.5}, "g": {**one, "unit": "m"}}
    effect = Effect("ground", law.id, 0.9, "a sentence", "w = 0", values)
    assert str(effect).splitlines()[-2:] == ["  w = 3, 0.5 N/m", "  g = 3 ± 0.1 m"]


def test_an_export_gives_the_numbers_of_the_simulation(nameless, tmp_path):
    r, step = nameless.test[0], nameless.to_casadi()
    state, y = np.zeros(step.size1_in(0)), []
    for u in r.u:
        state, out = step(state, u)
        y.append(float(out[0]))
    np.testing.assert_allclose(y, nameless.simulate(r)[:, 0], rtol=0, atol=1e-9 * np.std(r.y))
    source, header = nameless.export().to_c(tmp_path)
    assert source.stat().st_size > 1000 and header.exists()


@pytest.mark.usefixtures("blank_figures")
def test_the_file_and_the_page_show_what_is_learned(nameless, tmp_path):
    path = diagnosis_report(nameless, tmp_path)
    content = json.loads((tmp_path / "diagnosis.json").read_text(), parse_constant=pytest.fail)
    assert problems(content, SCHEMA) == []
    assert content["learned"][0]["port"] == "ground" and content["shares"] == pytest.approx(nameless.shares)
    assert len(content["learned"][0]["nearest"]) == 3 and content["learned"][0]["nearest"][0]["error"] < 0.9
    low, high = content["learned"][0]["range"]["z"]
    assert low < 0 < high and content["description"]["elements"][-1]["law"] == "learned"
    page = path.read_text()
    assert "The learned force at ground over its local coordinate" in page and "a learned force" in page


def test_the_code_on_the_page_builds_the_same_simulator(nameless, monkeypatch):
    module = types.ModuleType("your_file")
    module.simulator = rig(430.0, 5.0)
    monkeypatch.setitem(sys.modules, "your_file", module)
    monkeypatch.setattr(pilfr, "read_csv", lambda *_, **__: nameless.test[0])
    space = {}
    exec(usage(nameless), space)
    expected = nameless.simulate(nameless.test[0])
    np.testing.assert_allclose(space["y"], expected, rtol=0, atol=1e-6 * np.std(expected))


def test_a_complete_simulator_is_handed_back_refitted():
    found = pilfr.diagnose(rig(430.0, 5.0), recorded(rig(), 0, samples=400), laws=(CubicStiffness,), **OPTIONS)
    assert (found.verdict, found.learned, found.corrected.elements) == ("complete", (), ())
    assert found.shares["named"] == found.shares["learned"] == 0


def test_a_sure_name_that_leaves_nothing_needs_no_learned_force():
    true = rig().with_element("ground", LAWS["ground"])
    found = pilfr.diagnose(rig(430.0, 5.0), recorded(true, 0, samples=400), laws=(CubicStiffness,), **OPTIONS)
    assert [e.law for e in found.effects] == ["cubic_stiffness"] and found.learned == ()
    assert found.shares["named"] > 0.99 and problems(found.to_dict(), SCHEMA) == []


def test_beyond_the_range_seen_the_force_stays_bounded():
    t = np.linspace(0, 20, 2000)
    local = Local(np.sin(t), np.cos(t), t[1], (2000,))
    law = LearnedForce({**next(LearnedForce().shapes(local)), "c": 1.0})
    z, dz = ca.SX.sym("z"), ca.SX.sym("dz")
    w = law.step(z, ca.SX.zeros(law.memory), {k: ca.DM(p.value) for k, p in law.parameters().items()}, dz)[0]
    force, slope = ca.Function("w", [z, dz], [w]), ca.Function("s", [z, dz], [ca.gradient(w, z)])
    assert abs(float(force(1e6, 1e6)) - float(force(1e4, 1e4))) < 0.05 * abs(float(force(1e4, 1e4)))
    assert float(slope(30.0, 0.0)) != 0  # an initial state can be estimated from there


def test_held_out_blocks_tell_a_better_simulator():
    true = rig().with_element("ground", Nameless())
    bench = Workbench.of(rig(430.0, 5.0), [recorded(true, 0)], "zero")
    refit = bench.fit(bench.simulator)
    (learned, *_) = learn_forces(bench, refit, ["ground"])
    before, after = held_out_errors(bench, refit), held_out_errors(bench, learned)
    assert after.blocks < 0.3 * before.blocks and after.ahead < 0.3 * before.ahead
    assert after.mean_square == max(after.blocks, after.ahead)
    assert NOISE**2 < after.mean_square < 0.25 * before.mean_square
    exact = Workbench.of(true, bench.recordings, "zero")
    assert held_out_errors(exact, exact.fit(true)).mean_square ** 0.5 == pytest.approx(NOISE, rel=0.1)


def test_recordings_of_one_course_lose_different_blocks_unless_their_inputs_are_the_same(monkeypatch):
    """Two discharges would lose the same charges, so that any curve of the charge would extrapolate."""
    left = []

    def note(bench, fitted, masks):
        left.append(masks)
        return _sum_of_squares(bench, fitted, masks)

    monkeypatch.setattr(evidence, "_sum_of_squares", note)
    first, second = recorded(rig(), 0, samples=400), recorded(rig(), 1, samples=400)
    for recordings, together in (([first, second], False), ([first, first], True)):
        left.clear()
        bench = Workbench.of(rig(), recordings, "zero")
        held_out_errors(bench, bench.fit(rig()))
        assert all(np.array_equal(*masks) == together for masks in left)
        assert not np.any([a & b for a, b in left[:4]]) or together
        assert np.all(np.sum(left[:4], axis=0) == 1) and len(left) == (5 if together else 6)
        assert np.array_equal(np.sum(left[4:], axis=0)[0], np.arange(400) >= 200)


@pytest.mark.parametrize("seconds", [-1.0, 1e-3])
def test_a_refit_that_is_cut_short_predicts_nothing(nameless, seconds):
    """It begins at a fit to all samples, so that it would seem to predict those left out."""
    bench, fitted = nameless.evidence.search.bench, nameless.evidence.after
    assert np.isfinite(held_out_errors(bench, fitted).rms)
    assert held_out_errors(replace(bench, deadline=time.perf_counter() + seconds), fitted).rms == np.inf


def test_held_out_samples_have_no_say_in_what_predicts_them(nameless):
    """The weights that a refit starts from do not matter, because what is held out has shaped them."""
    bench, fitted = nameless.evidence.search.bench, nameless.evidence.after
    name = f"{fitted.simulator.elements[-1].prefix}c"
    elsewhere = replace(fitted, values={**fitted.values, name: 2 * fitted.values[name]})
    there, here = (held_out_errors(bench, f) for f in (elsewhere, fitted))
    assert (there.blocks, there.ahead) == (here.blocks, here.ahead)
    assert here.mean_square > fitted.cost


def test_laws_are_compared_with_a_force_where_it_acts():
    """Not in the first samples alone, where a machine may be at rest."""
    t = 0.01 * np.arange(9000)
    z = np.append(np.zeros(9000), 0.1 * np.sin(t))
    local = Local(z, np.gradient(z, 0.01), 0.01, (len(z),), inputs={"t": 0.01 * np.arange(len(z))})
    nearest = nearest_laws(local, 2e3 * z**3, [CubicStiffness])
    assert [near.law for near in nearest] == ["cubic_stiffness"] and nearest[0].error < 1e-6
    assert nearest[0].start["k_3"] == pytest.approx(2e3)
