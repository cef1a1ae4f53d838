"""A valve that only opens: dead zones seen from one side, offsets that are none, inputs that the recorder clipped."""

from dataclasses import replace

import numpy as np
import pytest

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Recording, Simulator
from pilfr_casadi.diagnose.faults.samples import find_clipped_input, find_clipping
from pilfr_casadi.diagnose.pipeline import _conclude_without_a_law, _Judgement
from pilfr_casadi.diagnose.posterior import posterior
from pilfr_casadi.diagnose.preparation import prepare
from pilfr_casadi.laws import CubicStiffness

DT = 0.02


def stage():
    """A mass on a spring, moved by a drive."""
    return Simulator(
        lambda x, u, p: {"pos": x.vel, "vel": (u.drive - p.k * x.pos - p.d * x.vel) / p.m},
        lambda x: {"place": x.pos},
        states=("pos", "vel"),
        inputs=("drive",),
        parameters={
            "m": Parameter(1.0, fixed=True),
            "k": Parameter(55.0, bounds=(10, 200)),
            "d": Parameter(2.4, bounds=(0.1, 20)),
        },
        hold="zero",
    )


def moved(u, k=50.0, d=2.0, steps=20):
    """Place over the samples, by Euler's rule with small steps."""
    pos = vel = 0.0
    out, h = [], DT / steps
    for force in u:
        out.append(pos)
        for _ in range(steps):
            vel += h * (force - k * pos - d * vel)
            pos += h * vel
    return np.array(out)


def levels(seed, m=900):
    """Levels of a valve between 0 and 10, never negative, half a second each."""
    return np.repeat(np.random.default_rng(seed).uniform(0, 10, m // 25), 25)


def recorded(u, y, seed, noise=0.002):
    rng = np.random.default_rng(seed)
    y = y + noise * np.std(y) * rng.standard_normal(len(y))
    return Recording(u[:, None], y[:, None], DT, inputs=("drive",), outputs=("place",), initial="zero")


@pytest.fixture(scope="module")
def opened():
    """What a dead zone of 3 that only one side shows is taken for."""
    records = [recorded(u, moved(np.maximum(u - 3, 0)), seed) for seed in (1, 2) for u in (levels(seed),)]
    return pilfr.diagnose(stage(), records[0], test=records[1])


@pytest.mark.slow
def test_a_dead_zone_is_found_from_one_side(opened):
    assert [(e.port, e.law) for e in opened.effects] == [("actuator:drive", "dead_zone")]
    assert opened.effects[0].parameters["g"]["value"] == pytest.approx(3, rel=0.01)
    assert opened.errors["test"]["after"] < 0.01


@pytest.mark.slow
def test_what_the_dead_zone_made_look_like_an_offset_is_none(opened):
    assert not [g for g in opened.gates if g.finding == "offset"]


@pytest.mark.slow
def test_a_clipped_input_is_a_fault_of_the_recording():
    rng = np.random.default_rng(5)
    t, f = np.arange(1200) * DT, rng.uniform(0.2, 3, 25)
    u = 6 * np.sum(np.sin(2 * np.pi * f[:, None] * t + rng.uniform(0, 6, 25)[:, None]), axis=0) / 3.5
    d = pilfr.diagnose(stage(), recorded(np.clip(u, -9, 9), moved(u), 6))
    assert d.verdict == "recording-fault", d.sentence
    assert [(g.channel, g.finding, g.corrected) for g in d.gates] == [("drive", "clipping", False)]


def swinging(m=1200):
    t = np.arange(m) * DT
    return 12 * np.sin(2 * np.pi * 0.21 * t) * np.cos(2 * np.pi * 0.043 * t)


def test_an_input_at_its_limits_is_no_fault_where_a_law_without_a_name_leaves_less():
    """As where the time ends before the law is sure: a drive's limit is the true input."""
    d = pilfr.diagnose(
        stage(), recorded(np.clip(swinging(), -9, 9), moved(swinging()), 6), laws=(CubicStiffness,), workers=1
    )
    assert d.verdict == "recording-fault"
    search = d.evidence.search
    judged = _Judgement.of(search, replace(posterior(search), effects=()), ())
    assert judged.kind == "unexplained" and _conclude_without_a_law(search, judged).verdict.kind == "recording-fault"
    law = next(t for t in search.memo.values() if t.laws)
    search.memo[law.key] = replace(law, mean_square=1e-3 * law.mean_square)
    assert _conclude_without_a_law(search, judged) is None


def test_a_command_that_stops_at_its_limits_is_no_fault_beside_a_missing_law():
    u = np.clip(swinging(), -9, 9)
    bench, ready = _prepared(u, moved(np.sign(u) * np.abs(u) ** 0.6))
    assert [(c.channel, c.value) for c in find_clipping(bench.recordings, "u")] == [("drive", [-9.0, 9.0])]
    assert find_clipped_input(bench, ready, 1.0) is None


def test_what_lies_beyond_a_limit_is_told_from_what_is_felt():
    bench, ready = _prepared(np.clip(swinging(), -9, 9), moved(swinging()))
    gate = find_clipped_input(bench, ready, 1.0)
    assert gate is not None and gate.channel == "drive" and "explains 9" in gate.sentence
    assert find_clipped_input(bench, ready, 0.001) is None  # a law leaves less


def _prepared(u, y):
    ready = prepare(stage(), [recorded(u, y, 9)], None, "auto")
    return ready.bench, ready.without


def test_a_parameter_at_its_bound_is_said():
    tight = stage()
    bound = {**tight.parameters, "k": Parameter(55.0, bounds=(54, 200))}
    u = levels(3, 400)
    d = pilfr.diagnose(tight.with_parameters(bound), recorded(u, moved(u), 4), laws=(), effects=0, workers=1)
    assert "k (54) came out at its bound" in str(d)
