"""Samples lost within a recording, its time renumbered."""

import json
import tracemalloc
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis_contract import SCHEMA, problems
from diagnosis_rig import OFF, recordings, refitted, rig
from simulated import outputs_of
from spring_rig import shaken, spring

import pilfr_casadi as pilfr
from pilfr_casadi import laws
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.faults import lost_samples
from pilfr_casadi.diagnose.faults.gates import CURED_SHARE, Checked
from pilfr_casadi.diagnose.faults.lost_samples import OutputGap, find_gaps, find_jump, find_output_gaps, settle_jump
from pilfr_casadi.diagnose.preparation import prepare

SOME = (laws.CoulombFriction, laws.CubicStiffness, laws.QuadraticDrag)


def lost(r, *places, count=25):
    """The recording without `count` samples from some places on, as they are numbered afterwards."""
    keep = np.ones(len(r), dtype=bool)
    for i, k in enumerate(sorted(places)):
        keep[k + i * count : k + (i + 1) * count] = False
    return r.with_(u=r.u[keep], y=r.y[keep])


def bench(*train):
    made = Workbench.of(rig(OFF), train, "zero")
    return made, refitted(made).fitted


def looked(*train):
    """Samples of the gaps found, by recording."""
    made, plain = bench(*train)
    found = find_gaps(Checked(made, plain))
    assert (found.bench is made and found.fitted is plain) or (found.cost < 0.3 * plain.cost and found.gates)
    return [len(r) for r in found.bench.recordings], found.gates


@pytest.mark.usefixtures("blank_figures")
def test_a_gap_is_a_fault_of_the_recording(tmp_path):
    (r,) = recordings(count=1)
    found = pilfr.diagnose(rig(OFF), lost(r, 1100).with_(name="run"), test=recordings(seed=5, count=1), laws=SOME)
    (gate,) = [g for g in found.gates if g.finding == "gap"]
    assert found.verdict == "recording-fault"
    assert (gate.corrected, gate.fault, gate.value) == (True, True, [pytest.approx(2.2)])
    assert "just before t = 2.2 s (sample 1100)" in found.sentence
    assert [len(piece) for piece in found.train] == [1100, 1375]
    assert found.errors["train"]["after"] < 0.003 and found.errors["test"]["after"] < 0.003
    found.report(tmp_path)
    written = json.loads((tmp_path / "diagnosis.json").read_text(encoding="utf-8"))
    assert problems(written, SCHEMA) == []
    assert [g["finding"] for g in written["gates"]] == ["gap"]
    assert [r.name for r in found.train] == ["run", "run from 2.2 s"]
    assert "sample 1100" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_several_gaps_are_found_and_the_recordings_told_apart():
    a, b = recordings(count=2)
    lengths, (gate,) = looked(lost(a, 700, 1700).with_(name="a"), b.with_(name="b"))
    assert lengths == [700, 1000, 750, 2500]
    assert "sample 700 of recording 'a'" in gate.sentence and "sample 1700 of recording 'a'" in gate.sentence


@pytest.mark.slow
@pytest.mark.parametrize(
    "force",
    [2.0, pytest.param(3.0, marks=pytest.mark.xfail(reason="a jump is hardly sharper than its neighbours here"))],
)
def test_friction_is_named_beside_a_gap(force):
    train = recordings(laws.CoulombFriction(values={"F_c": force, "v_0": 0.01}))
    found = pilfr.diagnose(rig(OFF), [lost(train[0], 1200), train[1]], laws=SOME, effects=1)
    assert "gap" in [g.finding for g in found.gates]
    assert [(e.port, e.law) for e in found.effects] == [("ground-m1", "coulomb_friction")]


def pushed(push, count=1):
    """Recordings of the rig with a force that is not recorded."""
    out = []
    for r in recordings(count=count):
        y = outputs_of(rig(), r.with_(u=r.u + push), substeps=4)
        out.append(r.with_(y=y + 1e-3 * np.std(y) * np.random.default_rng(1).standard_normal(y.shape)))
    return out


@pytest.mark.parametrize("samples", [pytest.param(1, marks=pytest.mark.slow), 6])
def test_a_shock_is_no_gap(samples):
    push = np.zeros((2500, 1))
    push[1200 : 1200 + samples] = 5000 / samples
    made, plain = bench(*pushed(push))
    jump, pieces = settle_jump(Checked(made, plain))
    assert pieces.cost < 0.1 * plain.cost and not jump.beats(jump.rival, CURED_SHARE)  # cutting would cure it, and yet
    assert not find_gaps(Checked(made, plain)).gates


@pytest.mark.parametrize("kind", ["step", "ramp", "sensor"])
def test_a_step_and_a_drift_are_no_gaps(kind):
    push = np.zeros((2500, 1))
    if kind == "step":
        push[1200:] = 60.0
    if kind == "ramp":
        push[:, 0] = np.linspace(0, 100, 2500)
    (r,) = pushed(push)
    if kind == "sensor":
        y = np.array(r.y)
        y[1200:] += np.std(y)
        r = r.with_(y=y)
    lengths, told = looked(r)
    assert lengths == [2500] and not told


@pytest.mark.parametrize(
    "law",
    [
        laws.PiecewiseStiffness(values={"k_c": 8000.0, "g": 0.04}),
        laws.CoulombFriction(values={"F_c": 15.0, "v_0": 0.01}),
    ],
    ids=lambda law: law.id,
)
def test_a_stop_and_friction_are_no_gaps(law):
    lengths, told = looked(*recordings(law, count=1))
    assert lengths == [2500] and not told


def test_where_states_cannot_tell_and_in_periodic_recordings_nothing_is_looked_for():
    (r,) = recordings(count=1)
    made, plain = bench(lost(r, 1100))
    plain_states = replace(made.simulator, dynamics=_hidden(made.simulator.dynamics))
    assert find_jump(replace(made, simulator=plain_states), plain) is None
    tail = lost(r, 1100).slice(0, 2400).with_(initial="periodic", period=1200)
    assert not [g for g in prepare(rig(OFF), [tail], "zero", "auto").gates if g.finding == "gap"]


def _hidden(dynamics):
    """The same equations, no state of which is plainly the integral of another."""
    return lambda x, u, p: {name: 1.0000001 * d for name, d in dynamics(x, u, p).items()}


def behind(r, columns, k, count):
    """A recording of which some outputs (the others, if `count` is negative) have lost samples from k on."""
    mine, others = (count, 0) if count > 0 else (0, -count)
    rest = len(r) - k - abs(count)
    u, y = (np.concatenate([v[:k], v[k + others : k + others + rest]]) for v in (r.u, r.y))
    y[k:, columns] = r.y[k + mine : k + mine + rest, columns]
    return r.with_(u=u, y=y)


def looked_at_outputs(r):
    made = Workbench.of(spring(), [r], "zero")
    return find_output_gaps(refitted(made))


@pytest.mark.parametrize(
    ("columns", "count", "name", "word"),
    [([1], 12, "vel", "early"), ([0], -7, "pos", "late"), ([0, 1], -9, "pos, vel", "late")],
)
def test_samples_that_some_outputs_lost_are_found(columns, count, name, word):
    found = looked_at_outputs(behind(shaken("zero"), columns, 1300, count))
    (gate,) = found.gates
    assert (gate.finding, gate.channel, gate.fault) == ("gap", name, True)
    value = gate.to_dict()["value"]
    assert value == {"recording": 0, "sample": pytest.approx(1300, abs=1), "lost": count}
    assert f"recorded {abs(count)} samples" in gate.sentence
    assert f"too {word}" in gate.sentence
    assert found.cost**0.5 < 2e-4  # the noise is 1e-4
    (first, second) = map(len, found.bench.recordings)
    assert first == value["sample"] and first + second == 3000 - 2 * abs(count)


def test_a_shift_of_the_whole_recording_and_missing_physics_are_no_gap_of_an_output():
    whole = shaken("zero")
    late = whole.with_(u=whole.u[:-9], y=np.column_stack([whole.y[9:, 0], whole.y[:-9, 1]]))
    stiff = shaken("zero", law=laws.CubicStiffness().at({"k_3": 2e4}))
    play = shaken("zero", law=laws.Clearance().at({"k_g": 300.0, "g": 0.02}))
    slow = shaken("zero", clock=2e-3)
    slow = slow.with_(y=np.column_stack([slow.y[:, 0], shaken("zero").y[: len(slow), 1]]))
    for r in (whole, late, stiff, play, slow):
        assert not looked_at_outputs(r).gates


def test_in_a_stretch_the_whole_recording_is_cut():
    given = behind(shaken("zero"), [1], 1300, 12)
    gap = OutputGap("vel", "gap", (0, 300, 12), columns=(1,))
    before, after = gap.apply_to_whole([given], [(0, 1000)])
    assert len(before) == 1300 and len(after) == len(given) - 1312
    assert np.array_equal(after.y, shaken("zero").y[1312 : 1312 + len(after)])


def test_a_shock_that_no_input_explains_is_no_gap_of_an_output():
    """Without the samples of the shock, the ringing that follows has an initial state; nothing has to be moved."""

    def rings(kick):
        return pilfr.Simulator(
            lambda x, u, p: {"speed": u.torque - 2 * x.speed, "y": x.v, "v": kick(u) - p.k * x.y - 5 * x.v},
            lambda x: {"speed": x.speed, "y": 1e3 * x.y},
            states=("speed", "y", "v"),
            inputs=("torque", "kick"),
            parameters={"k": pilfr.Parameter(2.5e4, bounds=(5e3, 1e5))},
        )

    u = np.column_stack([np.sin(0.012 * np.arange(1500)), np.zeros(1500)])
    u[300:310, 1] = 30.0
    names = ("torque", "kick"), ("speed", "y")
    r = pilfr.Recording(u, np.zeros((1500, 2)), 2e-3, *names, initial="zero", hold="zero")
    y = rings(lambda u: u.kick).simulate(r)
    noise = 5e-3 * np.std(y, axis=0) * np.random.default_rng(4).standard_normal(y.shape)
    made = Workbench.of(rings(lambda u: 0 * u.kick), [r.with_(y=y + noise)], "zero")
    assert not find_output_gaps(refitted(made)).gates


def test_jumps_are_tried_with_the_matrices_of_a_few_samples_at_a_time(monkeypatch):
    """With those of all samples, a long recording of many states took gigabytes."""
    rng, m, n, found = np.random.default_rng(0), 1500, 12, []
    shapes = {"a": (m, n, n), "b": (m, n, 7), "c": (m, 2, n), "d": (m, 2, 7)}
    run = SimpleNamespace(n_free=3, **{name: 0.05 * rng.standard_normal(shape) for name, shape in shapes.items()})
    read = rng.standard_normal((m - 50, 2, 6))
    for samples in (m, 50):
        monkeypatch.setattr(lost_samples, "BLOCK", samples)
        tracemalloc.start()
        found.append(lost_samples._jump_shares(run, np.ones(2), read, 50, 8, [1, 3]))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < 0.5 * run.a.nbytes
    assert all(np.array_equal(one, other) for one, other in zip(*found, strict=True))
