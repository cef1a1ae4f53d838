"""The concealed benchmark: reproducible, simulated right, effects visible behind a refit, answers scored right."""

import json
from concurrent.futures import Future

import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi.data import Recording, read_csv
from pilfr_casadi.engine import make_engine
from pilfr_casadi.laws import CATALOGUE
from pilfr_casadi.optimise import GaussNewton, Problem
from pilfr_casadi.simulators import choose_substeps, discretise
from problems import concealed
from problems.concealed import KINDS, Score, case, export, run_one, score
from problems.concealed_case import _Draw
from problems.concealed_noise import FAULTS, LOUDEST, QUIETEST, draw_fault
from problems.concealed_rigs_more import RIGS, places
from problems.concealed_score import line, summary
from problems.concealed_series import outside

LAWS = {
    "cubic_stiffness", "quadratic_stiffness", "piecewise_stiffness", "clearance", "coulomb_friction",
    "stribeck_friction", "quadratic_drag", "cubic_damping", "hysteresis", "backlash", "saturation", "dead_zone",
    "static_curve", "delay", "creep", "drift", "periodic_force", "extra_mode",
}  # fmt: skip


@pytest.fixture(scope="module")
def cases():
    return [case(seed) for seed in range(30)]


# one of each kind: bodies, a nonlinear one, two inputs, a tank, no state
FEW = ("chain2", "pendulum", "stage", "tanks", "static")


@pytest.mark.parametrize("name", [pytest.param(n, marks=[] if n in FEW else [pytest.mark.slow]) for n in RIGS])
def test_without_effects_the_package_reproduces_the_truth(name):
    rig = RIGS[name]
    draw = _Draw(np.random.default_rng([5, len(name)]), 5, "none", rig)
    item = draw.inputs()[0]
    truth = draw.run(draw.plant, item)
    record = Recording(item[1], truth.y, draw.dt, rig.inputs, rig.outputs, hold=draw.hold, initial="zero")
    simulator = draw.module["simulator"]
    model = discretise(simulator, draw.dt, draw.hold, 2 * choose_substeps(simulator, [record]))
    y = make_engine(model, "vm").simulate(model.drive(record), model.parameters.start, np.zeros(model.n_x))[0]
    assert np.all((y - truth.y).std(axis=0) < 0.2 * QUIETEST * truth.y.std(axis=0))


def test_same_seed_same_case():
    one, two = case(8), case(8)
    assert one.source == two.source and one.accepted == two.accepted
    assert all(np.array_equal(a.y, b.y) for a, b in zip(one.train, two.train, strict=True))


def test_every_law_is_hidden_somewhere():
    assert {law for rig in RIGS.values() for _, law in places(rig)} == LAWS


@pytest.mark.slow
def test_a_case_keeps_its_promises(cases):
    for c in cases:
        assert 0.9 * QUIETEST < c.details["noise"] < 1.1 * LOUDEST
        assert 1 <= len(c.train) <= 3
        for r in (*c.train, c.test):
            assert 2900 <= len(r) <= 8000
            assert r.outputs == c.simulator.output_names and r.inputs == c.simulator.inputs
        known = {p.name for p in c.simulator.all_ports()}
        for t, accepted in zip(c.truth, c.accepted[: len(c.truth)], strict=True):  # an outside effect has no truth
            assert (t["port"], t["law"]) in accepted
            assert {port for port, _ in accepted} <= known and t["law"] in LAWS
        if c.truth:
            assert 3 < c.refit / c.details["noise"] < 100


@pytest.mark.slow
def test_refit_by_the_package_leaves_the_effect_visible(cases):
    """The generator's own linearised refit is no flattery: a full fit leaves at least 2.5 times the floor."""
    seen = 0
    for c in cases:
        if not c.truth or not c.simulator.states:
            continue
        r = c.train[0].with_(hold=c.details["hold"])
        if r.period:
            r = r.with_(initial="estimate", period=None)
        model = discretise(c.simulator, r.dt, r.hold, choose_substeps(c.simulator, [r]))
        problem = Problem(model, r)
        solution = GaussNewton(max_iterations=40).solve(problem)
        left = np.sqrt(2 * solution.cost)
        assert left > 2.5 * c.details["noise"], c.name
        assert left < 130 * c.details["noise"], c.name
        seen += 1
    assert seen >= 12


@pytest.mark.parametrize("kind", FAULTS)
def test_every_fault_can_be_drawn(kind):
    fault = draw_fault(np.random.default_rng(1), ("u",), ("a", "b"), True, True, kind)
    assert fault.kind == kind and fault.channels


def answer(verdict, *pairs, confidence=0.9, gates=(), after=0.01):
    effects = [{"port": p, "law": law, "confidence": confidence} for p, law in pairs]
    return {"verdict": verdict, "effects": effects, "gates": list(gates), "fit": {"test": {"after": after}}}


@pytest.mark.slow
def test_scores(cases):
    one = next(c for c in cases if "one" in c.tags)
    pair = (one.truth[0]["port"], one.truth[0]["law"])
    good = score(one, answer("missing-physics", pair, after=one.floor))
    assert good.verdict_right and good.port and good.law and good.right and good.ratio == pytest.approx(1.0)
    wrong = score(one, answer("missing-physics", (pair[0], "nonsense")))
    assert wrong.port and not wrong.law and not wrong.right
    assert score(one, answer("missing-physics", pair, ("elsewhere", "delay"))).spurious
    crash = score(one, {}, crash="E: no")
    assert not crash.verdict_right and crash.law is False and crash.ratio == np.inf
    two = next(c for c in cases if "two" in c.tags)
    pairs = [(t["port"], t["law"]) for t in two.truth]
    assert score(two, answer("missing-physics", *pairs)).both
    assert not score(two, answer("missing-physics", pairs[0])).both
    none = next(c for c in cases if "none" in c.tags)
    assert score(none, answer("missing-physics", pair)).false_alarm and not score(none, answer("complete")).false_alarm
    outside = next(c for c in cases if "outside" in c.tags)
    assert score(outside, answer("unexplained", pair, confidence=0.9)).sure_outside
    assert not score(outside, answer("unexplained", pair, confidence=0.7)).sure_outside
    fault = next(c for c in cases if "fault" in c.tags)
    gate = {"channel": next(iter(fault.channels)), "finding": "x"}
    assert score(fault, answer("recording-fault", gates=[gate])).channel
    assert not score(fault, answer("recording-fault")).channel
    assert "MISSED" in summary([crash, wrong]) and "Brier" in summary([good])


def test_a_draw_goes_on_where_it_was_ended(tmp_path, monkeypatch, capsys):
    judged = []

    def run_one(seed):
        judged.append(seed)
        unknown = dict.fromkeys(("port", "law", "both", "sure_outside", "channel", "confidence", "ratio"))
        said = {"expected": "complete", "verdict": "complete", "truth": "", "named": ""}
        rest = {"verdict_right": True, "spurious": False, "false_alarm": False, "right": True}
        return Score(seed=seed, name=f"{seed}-rig", kind="none", **said, **unknown, **rest)

    class Here:
        def __init__(self, *_, **__): ...

        def shutdown(self, cancel_futures):
            assert cancel_futures

        def submit(self, run, seed):
            (task := Future()).set_result(run(seed))
            return task

    monkeypatch.setattr(concealed, "run_one", run_one)
    monkeypatch.setattr(concealed, "ProcessPoolExecutor", Here)
    draw = ["--first-seed", "5", "--out", str(tmp_path / "draw.jsonl")]
    concealed.main([*draw, "--cases", "2"])
    with (tmp_path / "draw.jsonl").open("a") as file:
        file.write('{"seed": 7, "na')
    concealed.main([*draw, "--cases", "3"])
    assert judged == [5, 6, 7] and set(concealed.scored(tmp_path / "draw.jsonl")) == {5, 6, 7}
    assert "verdict right" in capsys.readouterr().out
    monkeypatch.setattr(concealed, "code", lambda: "another")
    with pytest.raises(SystemExit, match="other code"):
        concealed.main([*draw, "--cases", "3"])


def test_kinds_are_shares():
    assert sum(KINDS.values()) == pytest.approx(1.0)


@pytest.mark.parametrize(("seed", "own"), [(2972, {"y"})])
def test_a_product_outside_the_catalogue_is_no_square(monkeypatch, seed, own):
    """A product of a coordinate with itself is a quadratic stiffness, which the catalogue has."""
    drawn = []

    def spy(rng, scale, series, other):
        drawn.append(other)
        return outside(rng, scale, series, other)

    monkeypatch.setattr("problems.concealed_draw.outside", spy)
    case(seed)
    assert drawn[-1] not in own


@pytest.mark.slow
def test_exported_files_are_read_back(tmp_path, cases):
    c = cases[1]
    export(c, tmp_path)
    r = read_csv(tmp_path / "train1.csv", inputs=list(c.simulator.inputs), outputs=list(c.simulator.output_names))
    assert np.allclose(r.y, c.train[0].y, rtol=1e-9, atol=1e-9) and r.dt == pytest.approx(c.train[0].dt)
    assert json.loads((tmp_path / "truth.json").read_text())["verdict"] == c.verdict
    compile((tmp_path / "simulator.py").read_text(), "simulator.py", "exec")


@pytest.mark.slow
@pytest.mark.parametrize("first", range(600, 620, 5))
def test_concealed_cases_are_diagnosed(first):
    """Twenty cases, five at a time: four of five entirely right, and no confident wrong name."""
    scores = [run_one(seed) for seed in range(first, first + 5)]
    assert not any(s.crash for s in scores), [s.crash for s in scores]
    right = [s.verdict_right and s.law is not False and s.channel is not False and not s.spurious for s in scores]
    assert sum(right) >= 4, [line(s) for s in scores]
    assert not [line(s) for s in scores if (s.confidence or 0) > 0.9 and not s.right]


@pytest.mark.slow
def test_a_hold_that_a_missing_lag_disguises_is_found_at_last():
    """With one law, interpolated inputs follow a little better; with both laws, held ones follow to the noise."""
    hidden = case(4751)
    tried = [law for law in CATALOGUE if law.id in ("quadratic_stiffness", "creep", "delay")]
    found = pilfr.diagnose(hidden.simulator, hidden.train, laws=tried, workers=1)
    assert found.hold == "zero"
    assert {e.law for e in found.effects} == {"quadratic_stiffness", "creep"}
    assert found.errors["train"]["after"] < 1e-3
