"""The stress sets and the bank: each case holds what its set says, and answers are judged as a whole."""

import json

import numpy as np
import pytest

from problems import bank, stress, stress_sets
from problems.concealed_case import Case, Finding, case, kind_of_seed
from problems.concealed_noise import QUIETEST, RARE_FAULTS, draw_fault, noise, spoil, spoil_clean
from problems.concealed_score import brier, log_loss, score, summary, wilson
from problems.stress_sets import POLES, SET_SIZE, seeds, set_of, sets


def seed_of(name, index):
    return SET_SIZE * (1 + list(sets()).index(name)) + index


def test_sets_have_20_cases_or_more():
    assert all(20 <= len(of) <= 45 for of in sets().values())
    assert len(set(seeds())) == len(seeds()) == sum(map(len, sets().values()))
    assert {set_of(seed) for seed in seeds(["weak", "three"])} == {"weak", "three"}


def test_every_fault_is_drawn_three_times_or_more():
    plans = [e.plan for e in sets()["faults"]]
    kinds = [p.fault for p in plans]
    wanted = {*RARE_FAULTS, "sign", "unit", "alignment", "clock", "clipped"}
    assert set(kinds) == wanted and all(kinds.count(k) >= 3 for k in wanted)
    for kind in stress_sets.BOTH_SIDES:
        assert {p.side for p in plans if p.fault == kind} == {"input", "output"}


@pytest.mark.parametrize("pole", POLES)
def test_noise_has_its_pole_and_its_size(pole):
    rng = np.random.default_rng(3)
    e = noise(rng, "white", np.zeros((200_000, 2)), np.array([1.0, 2.0]), pole)
    assert e.std(axis=0) == pytest.approx([1.0, 2.0], rel=0.15)
    found = [np.dot(c[1:], c[:-1]) / np.dot(c, c) for c in e.T]
    assert found == pytest.approx([pole, pole], abs=0.005)
    starts = [noise(rng, "white", np.zeros((2, 1)), np.ones(1), pole)[0, 0] for _ in range(2000)]
    assert np.std(starts) == pytest.approx(1.0, rel=0.1)


SIGNALS = np.random.default_rng(0).standard_normal((2, 400, 2))
TOPS = tuple(np.abs(a).max(axis=0) for a in SIGNALS)


def spoiled(kind, side, record=0):
    fault = draw_fault(np.random.default_rng(4), ("a", "b"), ("c", "d"), True, True, kind, side)
    u, y = spoil(fault, *spoil_clean(fault, *SIGNALS), TOPS, record)
    changed, whole = (u, y) if side == "input" else (y, u)
    before, other = SIGNALS if side == "input" else SIGNALS[::-1]
    return fault, changed, before, whole, other


@pytest.mark.parametrize("side", ["input", "output"])
def test_faults_do_what_they_are_called(side):
    for kind in ("sign", "unit", "zero", "offset", "exchange", "stale", "clipped"):
        fault, changed, before, whole, other = spoiled(kind, side)
        i = fault.column
        assert fault.is_input == (side == "input") and np.array_equal(whole, other)
        assert not np.array_equal(changed[:, i], before[:, i])
        assert kind == "exchange" or np.array_equal(changed[:, 1 - i], before[:, 1 - i])
    fault, changed, before, *_ = spoiled("exchange", side)
    assert np.array_equal(changed, before[:, ::-1]) and len(fault.channels) == 2
    fault, changed, before, *_ = spoiled("zero", side)
    again = spoiled("zero", side, 1)[1]
    assert np.ptp((changed - before)[:, fault.column]) < 1e-12 and np.array_equal(changed, again)
    assert not np.array_equal(spoiled("offset", side)[1], spoiled("offset", side, 1)[1])
    fault, changed, before, *_ = spoiled("stale", side)
    assert np.mean(np.diff(changed[:, fault.column]) == 0) == pytest.approx(fault.size, abs=0.05)
    fault, changed, before, whole, other = spoiled("gap", side)
    lost = len(before) - len(changed)
    assert lost == fault.size and any(
        np.array_equal(np.delete(before, slice(k, k + lost), axis=0), changed) for k in range(400 - lost)
    )
    assert len(spoiled("gap", side, 1)[1]) == len(before)
    fault, changed, before, whole, other = spoiled("alignment", side)
    n = abs(int(fault.size))
    assert np.array_equal(whole, other[n:-n])
    assert np.array_equal(changed[:, fault.column], np.roll(before[:, fault.column], int(fault.size))[n:-n])


def made(kind, *accepted, tags=(), **fields):
    truth = tuple({"port": p, "law": law} for p, law in accepted)
    pairs = tuple(frozenset({pair}) for pair in accepted)
    verdict = "missing-physics" if accepted else "complete"
    usual = {"truth": truth, "accepted": pairs, "verdict": verdict, "channels": frozenset(), "floor": 0.01}
    rest = {"simulator": None, "source": "", "train": (), "test": None, "refit": 0.1, "seed": SET_SIZE}
    return Case(name="made", tags=frozenset({kind, *tags}), **(usual | rest | fields))


def answer(verdict, *effects, gates=(), sentence="", after=0.012, before=0.1):
    named = [{"port": p, "law": law, "confidence": c} for p, law, c in effects]
    told = [{"channel": c, "finding": f, "sentence": text} for c, f, text in gates]
    errors = {"after": after, "before": before}
    return {"verdict": verdict, "sentence": sentence, "effects": named, "gates": told, "fit": {"test": errors}}


def test_every_effect_counts():
    three = made("three", ("a", "hysteresis"), ("b", "delay"), ("c", "backlash"))
    names = [("a", "hysteresis", 0.9), ("b", "backlash", 0.85), ("c", "backlash", 0.5)]
    s = score(three, answer("missing-physics", *names))
    assert (s.effects, s.found, s.names, s.names_right) == (3, 2, 3, 2)
    assert s.sure_wrong and not s.answer and s.law
    assert [right for _, right in s.certainties] == [1, 0, 1]
    assert s.over_floor == pytest.approx(1.2) and s.over_refit == pytest.approx(0.12)
    right = [("a", "hysteresis", 0.9), ("b", "delay", 0.9), ("c", "backlash", 0.9)]
    assert score(three, answer("missing-physics", *right)).answer
    text = summary([s])
    assert "66.7%" in text and "recall" in text


def test_kind_and_channel_of_a_fault_count():
    clipped = made(
        "fault",
        verdict="recording-fault",
        channels=frozenset({"y"}),
        findings=(Finding(frozenset({"clipping"}), frozenset({"y"})),),
    )
    right = score(clipped, answer("recording-fault", gates=[("y", "clipping", "")]))
    assert right.answer and right.fault_kind and right.finding and right.channel and not right.wrong_fault
    other = score(clipped, answer("recording-fault", gates=[("y", "unit", "")]))
    assert other.channel and not other.fault_kind and other.wrong_fault and not other.answer
    elsewhere = score(clipped, answer("recording-fault", gates=[("u", "clipping", ""), ("y", "hold", "")]))
    assert elsewhere.fault_kind and not elsewhere.finding and not elsewhere.answer
    assert not score(clipped, answer("complete")).answer and score(clipped, answer("complete")).over_floor is None


def test_a_wrong_value_has_to_be_named():
    value = made("value", parameters=frozenset({"k2"}), also=frozenset({"unexplained"}))
    assert score(value, answer("complete", sentence="with k2 = 3.1 N/m, which is held at 4")).answer
    assert score(value, answer("unexplained", gates=[("k2", "bound", "at its bound")])).answer
    assert not score(value, answer("complete", sentence="k21 is fine")).parameter
    surely = score(value, answer("missing-physics", ("a", "hysteresis", 0.95), sentence="k2"))
    assert surely.sure_wrong and not surely.answer


def test_an_undeclared_port_may_be_noted_or_named():
    pairs = (frozenset({("equation:v2", "hysteresis")}),)
    note = Finding(frozenset({"undeclared"}), frozenset({"v2"}))
    undeclared = made(
        "undeclared",
        accepted=pairs,
        verdict="unexplained",
        also=frozenset({"missing-physics"}),
        findings=(note,),
    )
    assert score(undeclared, answer("missing-physics", ("equation:v2", "hysteresis", 0.9))).answer
    assert score(undeclared, answer("unexplained", gates=[("v2", "undeclared", "")])).answer
    silent, wrong = answer("unexplained"), answer("missing-physics", ("a", "backlash", 0.9))
    assert not score(undeclared, silent).answer and not score(undeclared, silent).sure_wrong
    assert score(undeclared, wrong).sure_wrong


def test_a_load_is_an_offset_or_has_a_name():
    load = Finding(frozenset({"offset", "constant_load"}), frozenset({"force", "ground"}))
    alone = made("load", verdict="recording-fault", also=frozenset({"missing-physics"}), findings=(load,))
    assert score(alone, answer("recording-fault", gates=[("force", "offset", "")])).answer
    named = score(alone, answer("missing-physics", ("ground", "constant_load", 0.9)))
    assert named.answer and not named.sure_wrong
    assert not score(alone, answer("missing-physics", ("ground", "hysteresis", 0.9))).answer
    beside = made("one", ("ground", "clearance"), tags=["load"], findings=(load,))
    law = ("ground", "clearance", 0.9)
    assert score(beside, answer("missing-physics", law, gates=[("force", "offset", "")])).answer
    assert not score(beside, answer("missing-physics", law)).answer


def test_calibration_and_intervals():
    low, high = wilson(0.98, 200)
    assert (low, high) == pytest.approx((0.950, 0.992), abs=0.001)  # 196 of 200, as tables have it
    assert wilson(1.0, 50)[0] == pytest.approx(0.929, abs=0.001)
    c, r = np.array([0.9, 0.6, 1.0]), np.array([1.0, 0.0, 1.0])
    assert brier(c, r) == pytest.approx((0.01 + 0.36) / 3)
    assert log_loss(c, r) == pytest.approx(-(np.log(0.9) + np.log(0.4) + np.log(0.999)) / 3)
    assert np.isfinite(log_loss(np.array([1.0]), np.array([0.0])))


def test_report_has_every_set(monkeypatch, tmp_path, capsys):
    drawn = {}

    def run_one(seed):
        drawn[seed] = score(made("none", seed=seed, tags=["pole=0.9"]), answer("complete"))
        return drawn[seed]

    monkeypatch.setattr(stress, "answered", lambda wanted, run, out, workers: [run(s) for s in wanted])
    monkeypatch.setattr(stress, "run_one", run_one)
    stress.main(["slow-noise", "weak"])
    text = capsys.readouterr().out
    assert len(drawn) == 49 and "slow-noise (25 cases)" in text and "weak (24 cases)" in text
    assert "25 of 25 answers right" in text and "whole answer right" in text


def test_the_bank_is_burnt_and_balanced():
    assert len(bank.SEEDS) == len(set(bank.SEEDS)) == 400
    assert all(bank.FIRST <= seed <= bank.LAST for seed in bank.SEEDS) and bank.LAST < 4730
    for kind, of in bank.KINDS.items():
        assert len(of) >= 36 and all(kind_of_seed(seed) == kind for seed in of)
    for seed, row in bank.rows().items():
        assert seed in bank.SEEDS and str(seed) == row["name"].split("-")[0]
    json.dumps(bank.rows())
    assert "400 cases" in bank.balance()


def kept(c):
    """What a case's set promises."""
    name, left = set_of(c.seed), c.refit / c.details["noise"]
    ports = {p.name for p in c.simulator.all_ports()}
    declared = {p.name for p in c.simulator.ports}
    hidden = c.details["hidden"]
    if name == "slow-noise":
        assert any(tag.startswith("pole=") for tag in c.tags)
        assert c.verdict == ("missing-physics" if hidden else "complete")
    if name == "weak":
        assert 1 <= left <= 3 and len(hidden) == 1
    if name == "three":
        assert len(c.truth) == len(c.accepted) == len({t["port"] for t in c.truth}) == 3 and left > 3
    if name in ("wrong-fixed", "outside-bounds"):
        wrong = next(tag.split(":")[1] for tag in c.tags if tag.startswith("value:"))
        p, value = c.simulator.parameters[wrong], c.details["true"][wrong]
        assert wrong in c.parameters and not hidden and left > 3
        if name == "wrong-fixed":
            assert p.fixed and 0.09 < abs(p.value / value - 1) < 0.41
        else:
            assert not p.fixed and not p.bounds[0] <= value <= p.bounds[1] and p.bounds[0] < p.value < p.bounds[1]
    if name == "undeclared":
        assert hidden[0].port not in declared and declared and not c.truth
        assert any(port.startswith("equation:") for port, _ in c.accepted[0])
    if name == "faults":
        assert c.channels and c.findings and left > 3 and not hidden
        if c.details["fault"].kind == "hold":
            assert {r.hold for r in (*c.train, c.test)} == {"zero", "linear"} - {c.details["hold"]}
    if name == "one-sided":
        assert left > 3 and c.findings
    if name == "in-place":
        assert left > 3
        if hidden[0].variant == "in-place-of-spring":
            assert any(not np.all(p.fixed) and p.bounds[0] == 0 for p in c.simulator.parameters.values())
        else:
            assert hidden[0].port == hidden[1].port
    if name not in ("undeclared", "faults"):
        assert {t["port"] for t in c.truth} <= ports
    assert c.floor > 0.5 * QUIETEST and c.name.startswith(name)


def test_a_stress_case_is_the_same_again():
    one, two = (stress.case(seed_of("slow-noise", 0)) for _ in range(2))
    assert one.source == two.source and np.array_equal(one.test.y, two.test.y)
    kept(one)


@pytest.mark.parametrize(("name", "index"), [pytest.param("wrong-fixed", 0, marks=pytest.mark.slow), ("faults", 39)])
def test_a_case_holds_what_its_set_says(name, index):
    kept(stress.case(seed_of(name, index)))


@pytest.mark.slow
@pytest.mark.parametrize("name", list(sets()))
def test_every_case_holds_what_its_set_says(name):
    for seed in seeds([name]):
        kept(stress.case(seed))


@pytest.mark.slow
@pytest.mark.parametrize("seed", bank.SEEDS[::40])
def test_the_bank_has_the_tags_of_its_cases(seed):
    drawn = case(seed)
    assert seed not in bank.rows() or bank.rows()[seed]["tags"] == sorted(drawn.tags)
