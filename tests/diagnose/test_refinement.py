"""Where hysteresis was found, a layer of many operators takes its place if it predicts better, and else says so."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from diagnosis_example import example, recorded, rig

import pilfr_casadi as pilfr
from pilfr_casadi.diagnose.search.moves import Search
from pilfr_casadi.laws import Law, Local, PlayHysteresis, StopHysteresis, hysteresis_layer, unit_forces
from pilfr_casadi.models import play, stop

OPTIONS = {"hold": "zero", "workers": 1, "effects": 1}
R = np.linspace(0.002, 0.06, 30)  # thresholds in m, and a density of two humps that no law of the catalogue has
W = np.exp(-0.5 * ((R - 0.008) / 0.004) ** 2) + 0.6 * np.exp(-0.5 * ((R - 0.045) / 0.005) ** 2)
W *= 300 / np.sum(W)  # N/m


class ManyStops(Law):
    """Thirty stops in parallel."""

    id, equation, memory = "many_stops", "w = sum_i w_i stop_i[z]", len(R)

    def step(self, z, s, p):
        following = [play(z, s[i], r) for i, r in enumerate(R)]
        return sum(w * (z - q) for w, q in zip(W, following, strict=True)), ca.vertcat(*following)


def diagnosed(law, seeds=(0, 1)):
    true = rig().with_element("ground", law)
    train, test = [recorded(true, seed) for seed in seeds], recorded(true, 2, name="test")
    return pilfr.diagnose(rig(430.0, 5.0), train, test=test, laws=(StopHysteresis,), **OPTIONS)


@pytest.fixture(scope="module")
def many():
    return diagnosed(ManyStops())


@pytest.fixture(scope="module")
def refined(many):
    return many.refine(operators=12)


def test_a_layer_of_many_operators_predicts_better(many, refined):
    assert [e.law for e in many.effects] == ["hysteresis"]
    assert refined.improves and refined.port == "ground" and refined.kind in ("stop", "play")
    assert "takes the place of hysteresis" in str(refined)
    test = many.test[0]
    assert refined.nrmse(test) < 0.6 * many.nrmse(test)
    assert refined.nrmse(test) == pytest.approx(refined.errors["test"]["refined"])
    assert refined.expected[refined.kind].mean_square < refined.expected["diagnosed"].mean_square
    assert refined.held_out[refined.kind] is refined.expected[refined.kind].held_out
    assert np.max(np.abs(refined.simulate(test) - test.y)) < 0.01 * np.max(np.abs(test.y))


def test_a_refinement_counts_samples_as_the_search_does(many, refined, monkeypatch):
    monkeypatch.setattr(Search, "count_samples", lambda *_: 1.0)
    found = many.refine(operators=2, kind="stop")
    assert found.expected["diagnosed"].spread > 5 * refined.expected["diagnosed"].spread


def test_weights_and_thresholds_are_bounded_below_by_zero(refined):
    parameters = refined.simulator.parameters
    for name in ("ground.w", "ground.r"):
        assert np.all(np.asarray(parameters[name].bounds[0]) == 0) and np.all(parameters[name].value >= 0)
    assert len(refined.weights) == 12 and np.all(np.diff(refined.thresholds) >= 0)


@pytest.mark.slow
def test_an_interrupted_refinement_does_not_cut_the_next_one_short(many, refined):
    many.evidence.search.bench.interrupt.pressed = True
    test = many.test[0]
    assert many.refine(operators=12).nrmse(test) == refined.nrmse(test)


def test_the_loading_curve_is_recovered(many):
    refined = many.refine(operators=12, kind="stop")
    z, w = refined.loading_curve
    true = np.minimum(z[:, None], R) @ W
    assert z[0] == w[0] == 0
    assert np.max(np.abs(w - true)) < 0.01 * np.max(true)  # 1 % of the largest force
    share = np.sum(refined.weights[refined.thresholds < 0.027]) / np.sum(refined.weights)
    assert share == pytest.approx(np.sum(W[R < 0.027]) / np.sum(W), abs=0.05)  # the weight of the first hump


def test_it_is_exported_and_drawn(many, refined):
    test, step = many.test[0], refined.to_casadi()
    state, y = np.zeros(step.size1_in(0)), []
    for u in test.u[:200]:
        state, out = step(state, u)
        y.append(float(out))
    assert np.allclose(y, refined.simulate(test)[:200, 0], atol=1e-9)
    figure = refined.plot()
    assert [ax.get_xlabel() for ax in figure.axes] == ["z [m]", "z [m]", "threshold r [m]", ""]
    figure.canvas.draw()


@pytest.mark.slow
def test_where_three_operators_suffice_the_diagnosed_law_stays():
    three = StopHysteresis().at({"w": [150.0, 100.0, 60.0, 0, 0, 0], "r": [0.006, 0.02, 0.05, 1, 1, 1]})
    diagnosis = diagnosed(three, seeds=(0,))
    refined = diagnosis.refine(operators=6, kind="stop")
    assert not refined.improves
    assert "which stays" in refined.sentence
    assert refined.simulator is diagnosis.corrected and refined.layer is not diagnosis.corrected
    assert refined.nrmse(diagnosis.test) == diagnosis.nrmse(diagnosis.test)


def test_hysteresis_of_an_actuator():
    r, w = np.linspace(0.05, 0.8, 16), np.linspace(0.12, 0.0, 16)

    def measured(seed):
        rng, t = np.random.default_rng(seed), np.arange(500) * 0.01
        u = sum(np.sin(2 * np.pi * f * t + p) for f, p in zip((0.3, 0.7, 1.1), rng.uniform(0, 6, 3), strict=True)) / 2
        memory, y = np.zeros(16), []
        for value in u:
            memory = play(value, memory, r)
            y.append(2 * (value + w @ memory) + 1e-3 * rng.standard_normal())
        return pilfr.Recording(u[:, None], np.array(y)[:, None], 0.01, ("volt",), ("pos",), initial="zero")

    gain = {"g": pilfr.Parameter(1.5, bounds=(0.1, 10), unit="mm/V")}
    device = pilfr.Simulator(lambda: {}, lambda u, p: {"pos": p.g * u.volt}, inputs=("volt",), parameters=gain)
    diagnosis = pilfr.diagnose(device, measured(0), test=measured(1), laws=(PlayHysteresis,), **OPTIONS)
    refined = diagnosis.refine(6)
    assert refined.port in ("actuator:volt", "sensor:pos")
    assert refined.errors["test"]["refined"] <= 1.05 * refined.errors["test"]["diagnosed"]
    assert "generalized_play" in refined.expected


@pytest.mark.parametrize(
    "arguments, says",
    [
        ({"operators": 0}, "operators is 0; give a whole number, 1 or more"),
        ({"operators": 1000}, "for 1400 training samples; give at most 140"),
        ({"kind": "friction"}, "kind = 'friction' was given; give 'stop', 'play', 'generalized_play'"),
        ({"kind": "generalized_play"}, "act at an actuator or a sensor"),
        ({"port": "roof"}, "port = 'roof' was given; the diagnosis found hysteresis at ground"),
    ],
)
def test_wrong_arguments_are_told(many, arguments, says):
    with pytest.raises(pilfr.InputError, match=says):
        many.refine(**arguments)


def test_without_hysteresis_there_is_nothing_to_refine(many):
    none = replace(many, correction=None, evidence=replace(many.evidence, after=many.evidence.without))
    with pytest.raises(pilfr.InputError, match="nothing to add, and no hysteresis"):
        none.refine()
    with pytest.raises(pilfr.InputError, match="does not hold its search"):
        example().refine()


@pytest.mark.parametrize("series", [False, True])
def test_plays_and_stops_differ_by_a_line(series):
    rng = np.random.default_rng(3)
    z = np.cumsum(rng.standard_normal(400))
    local = Local(z, np.gradient(z), 1.0, (len(z),), from_zero=(True,))
    r, w, k = np.linspace(0.5, 5, 4), np.array([1.0, 0.5, 0.2, 2.0]), 0.3
    forces = {
        kind: unit_forces(hysteresis_layer(kind, 4, series)(), local, [{"r": r}])[:, 0] for kind in ("play", "stop")
    }
    plays, stops = (np.atleast_2d(f) for f in (forces["play"], forces["stop"]))
    total = np.sum(w)
    if series:
        assert np.allclose(plays @ [*w, k], stops @ [*w, k + total])
    else:
        assert np.allclose(plays @ [*w, total], stops @ w)
    memory, expected = np.zeros(4), []
    for value in z:
        expected.append((-1 if series else 1) * w @ stop(value, memory, r))
        memory = play(value, memory, r)
    assert np.allclose(stops[:, :4] @ w, expected)


def test_generalized_plays_of_a_straight_signal_are_plays():
    z = np.sin(np.arange(300) / 20)
    local = Local(z, np.gradient(z), 1.0, (len(z),), from_zero=(True,))
    shape = {"r": np.array([0.1, 0.4])}
    bent = unit_forces(hysteresis_layer("generalized_play", 2, True)(), local, [{**shape, "a_2": 0.0, "a_3": 0.0}])
    assert np.allclose(bent[:, 0, :3], unit_forces(hysteresis_layer("play", 2, True)(), local, [shape])[:, 0])
    assert np.allclose(bent[:, 0, 3], z**2)
