"""Long recordings: what the search sees of them, and what is told of everything."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from cart import GROUND, cart
from diagnosis_contract import SCHEMA, problems
from diagnosis_rig import OFF, recordings, rig
from simulated import outputs_of

import pilfr_casadi as pilfr
from pilfr_casadi import InputError, Recording, laws
from pilfr_casadi._base import Interrupt, Stages
from pilfr_casadi.diagnose import Workbench
from pilfr_casadi.diagnose.faults.channels import scale_channels
from pilfr_casadi.diagnose.faults.lost_samples import Jump
from pilfr_casadi.diagnose.faults.offsets import VaryingOffset
from pilfr_casadi.diagnose.fits.floor import noise_floor
from pilfr_casadi.diagnose.search.moves import Search
from pilfr_casadi.diagnose.search.stretches import Everything, Stretch, Stretches, choose_stretches, divide, spread_out
from pilfr_casadi.diagnose.search.trials import Trial

DT, CUBIC = 0.02, 4000.0


def spring(k=90.0, d=1.5, least=20.0, least_damping=0.1):
    """A mass on a linear spring, with a port whose unit is given."""
    ground = replace(GROUND, unit="N")
    return cart(k, d, (least, 400), (least_damping, 20), output="position", ports=(ground,))


def shaken(samples, *bursts, seed=0, initial="zero"):
    """A recording with a small force, large only from each burst on for 300 samples; the spring stiffens."""
    rng = np.random.default_rng(seed)
    size = np.full(samples, 0.5)
    for at in bursts:
        size[at : at + 300] = 12.0
    force = size * np.convolve(rng.standard_normal(samples + 4), np.ones(5) / 5**0.5, mode="valid")
    true = spring(100.0, 2.0).with_element("ground", laws.CubicStiffness().at({"k_3": CUBIC}))
    blank = Recording(force, force, DT, ("force",), ("position",), initial="zero", hold="zero")
    y = outputs_of(true, blank, substeps=4)
    return blank.with_(y=y + 1e-3 * np.std(y) * rng.standard_normal(y.shape), initial=initial)


def test_rows_are_spread_out_over_the_features():
    rng = np.random.default_rng(0)
    features = np.vstack([rng.normal(0, 0.01, (40, 2)), [[5.0, 0.0]], rng.normal(2, 0.01, (20, 2)), [[0.0, 5.0]]])
    chosen = spread_out(features, 4, 0)
    assert chosen[0] == 0 and set(chosen) >= {40, 61} and any(41 <= k < 61 for k in chosen)
    assert sorted(spread_out(features[:3], 10, 1)) == [0, 1, 2]


def test_a_recording_is_divided_without_gaps():
    parts = divide(3, 10_700, 200, 2000)
    assert parts[0].begin == 0 and parts[-1].end == 10_700 and {s.recording for s in parts} == {3}
    assert all(a.end == b.begin for a, b in pairwise(parts))
    assert divide(0, 700, 0, 2000) == [Stretch(0, 0, 700)]


def test_a_stretch_begins_in_an_unknown_state():
    r = shaken(3000).with_(name="week")
    piece = Stretch(0, 1000, 2000).cut([r])
    assert (len(piece), piece.skip, piece.begins, piece.name) == (1000, 0, "estimate", "week from 20 s")
    assert np.array_equal(piece.y, r.y[1000:2000])
    assert Stretch(0, 0, 3000).cut([r]) is r
    assert Stretch(0, 0, 1000).cut([r]).begins == "zero"


def test_the_stretches_where_an_effect_is_visible_are_chosen():
    r = shaken(12_000, 4100, 9300)
    chosen = choose_stretches(spring(), [r], "zero", most=3000)
    assert {s.begin // 500 for s in chosen} >= {8, 18} and len(chosen) == 4
    assert sum(map(len, chosen)) <= 2000
    again = choose_stretches(spring(), [r], "zero", most=3000, workers=2)
    assert again == chosen


def test_a_simulator_that_runs_away_leaves_the_choice_to_the_signals():
    r = shaken(12_000, 4100)
    chosen = choose_stretches(spring(k=-4e3, least=-9e3), [r], "zero", most=3000)
    assert 8 in {s.begin // 500 for s in chosen}


@pytest.fixture(scope="module")
def long_record():
    train = shaken(6000, 4100)
    return train, pilfr.diagnose(spring(), train, laws=[laws.CubicStiffness], effects=1, search_samples=1500)


def test_the_answer_of_a_long_record_is_told_on_everything(long_record):
    train, found = long_record
    assert [(e.port, e.law) for e in found.effects] == [("ground", "cubic_stiffness")]
    assert found.train[0] is train or np.array_equal(found.train[0].y, train.y)
    (note,) = [g for g in found.gates if g.finding == "stretches"]
    assert "2 stretches of 500 samples, chosen from 6000 samples" in note.sentence and note.value == 1000
    table = found.effects[0].parameters
    assert table["k_3"]["value"] == pytest.approx(CUBIC, abs=4 * table["k_3"]["std"])
    assert table["k_3"]["std"] < 0.01 * CUBIC
    # the errors are those of a plain fit to everything
    assert found.errors["train"]["after"] == pytest.approx(found.nrmse(train), rel=1e-6)
    assert found.errors["train"]["after"] < 0.1 * found.errors["train"]["before"]
    whole = pilfr.fit(found.corrected, train)
    assert found.errors["train"]["after"] < 1.001 * whole.nrmse(train)


def test_the_answer_of_a_long_record_is_that_of_a_short_one(long_record):
    _, found = long_record
    short = pilfr.diagnose(spring(), shaken(1200, 500, seed=3), laws=[laws.CubicStiffness], effects=1)
    assert [(e.port, e.law) for e in short.effects] == [(e.port, e.law) for e in found.effects]
    assert not any(g.finding == "stretches" for g in short.gates)
    mine, theirs = (d.effects[0].parameters["k_3"] for d in (found, short))
    assert abs(mine["value"] - theirs["value"]) < 4 * np.hypot(mine["std"], theirs["std"])


@pytest.mark.slow  # draws every figure
def test_the_report_of_a_long_record_shows_the_stretches(long_record, tmp_path):
    _, found = long_record
    found.report(tmp_path)
    written = json.loads((tmp_path / "diagnosis.json").read_text(encoding="utf-8"))
    assert problems(written, SCHEMA) == []
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "2 stretches of 500 samples" in page and "6000 samples" in page


def test_a_fault_of_the_stretches_is_corrected_in_everything():
    a, b = recordings(count=2)
    stretches = Stretches((a, b), (Stretch(1, 500, 1500),))
    bench = Workbench.of(rig(OFF), stretches.cut(), "zero")
    whole = stretches.everything(bench, [scale_channels("y", a.outputs, [0], -1.0)])
    assert [np.array_equal(r.y, -given.y) for r, given in zip(whole.recordings, (a, b), strict=True)] == [True, True]
    assert whole.substeps == bench.substeps and whole.simulator is bench.simulator


def test_offsets_of_the_stretches_are_subtracted_from_their_recordings():
    a, b = recordings(count=2)
    stretches = Stretches((a, b), (Stretch(1, 0, 500), Stretch(1, 500, 1500)))
    bench = Workbench.of(rig(OFF), stretches.cut(), "zero")
    offset = VaryingOffset("x2", "offset", (), port="sensor:x2").at(np.array([1.0, 3.0]))
    first, second = stretches.everything(bench, [offset]).recordings
    assert first is a
    np.testing.assert_allclose(second.y, b.y - 2.0)


def test_whole_short_recordings_are_stretches():
    train = [shaken(400, *([50] if i == 4 else []), seed=i) for i in range(6)]
    chosen = choose_stretches(spring(), train, "zero", most=1500)
    assert len(chosen) == 2 and Stretch(4, 0, 400) in chosen
    assert all(s.cut(train) is train[s.recording] for s in chosen)


@pytest.mark.slow
def test_of_many_recordings_whole_ones_are_searched_and_a_fault_is_corrected_in_all():
    train = [shaken(400, seed=i, initial="estimate") for i in range(4)]
    train = [r.with_(y=-r.y, name=f"day {i + 1}") for i, r in enumerate(train)]
    found = pilfr.diagnose(spring(), train, laws=[], effects=0, search_samples=1500)
    assert ("position", "sign") in {(g.channel, g.finding) for g in found.gates}
    assert len(found.train) == 4 and np.array_equal(found.train[3].y, -train[3].y)
    (note,) = [g for g in found.gates if g.finding == "stretches"]
    assert "2 stretches of 400 samples, chosen from 4 recordings, 1600 samples" in note.sentence


def test_a_gap_in_a_stretch_cuts_the_whole_recording_there():
    a, b = (r.with_(name=name) for r, name in zip(recordings(count=2), "ab", strict=True))
    stretches = Stretches((a, b), (Stretch(0, 0, 1000), Stretch(1, 1000, 2000)))
    bench = Workbench.of(rig(OFF), stretches.cut(), "zero")
    gap = replace(Jump("x2", "gap", None), places=((1, 130),))
    whole = stretches.everything(bench, [gap])
    assert [len(r) for r in whole.recordings] == [2500, 1130, 1370]
    assert [r.begins for r in whole.recordings] == ["zero", "zero", "estimate"]
    assert whole.recordings[2].name == "b from 2.26 s"
    assert whole.scale == pytest.approx(np.std(np.concatenate([a.y, b.y])))


def test_too_few_samples_for_a_search_are_refused():
    with pytest.raises(InputError, match="search_samples"):
        pilfr.diagnose(spring(), shaken(400), search_samples=3)


def test_a_simulation_that_runs_away_over_a_whole_recording_leaves_the_answer_to_the_stretches():
    r = shaken(3000, seed=4)
    stretches = Stretches((r,), (Stretch(0, 0, 300),))
    bench = Workbench.of(spring(k=100.0, d=2.0), stretches.cut(), "zero")
    unstable = bench.run(spring(k=100.0, d=-1.5, least_damping=-3.0), {}, [np.zeros(2)])
    search = Search(bench, unstable, noise_floor(bench.recordings, unstable.residual), (), 1, Stages(lambda *_: None))
    search.keep(Trial((), unstable, unstable.cost, unstable.cost, True))
    search.bench.interrupt.handle()  # values stay as they are
    assert Everything.of(search, stretches, ()) is None
    assert "values and errors are those of the stretches" in stretches.note(False).sentence


def test_after_an_interrupt_everything_has_the_values_of_the_stretches():
    r = shaken(3000, 1500, seed=4)
    stretches = Stretches((r,), (Stretch(0, 0, 500),))
    bench = Workbench.of(spring(), stretches.cut(), "zero")
    fitted = bench.fit(spring())
    search = Search(bench, fitted, noise_floor(bench.recordings, fitted.residual), (), 1, Stages(lambda *_: None))
    search.keep(Trial((), fitted, fitted.cost, fitted.cost, True))
    search.bench.interrupt.handle()
    kept = Everything.of(search, stretches, ()).fit(search, fitted)
    assert kept.values == fitted.values and [len(e) for e in kept.residual] == [3000]
    search.bench = replace(search.bench, interrupt=Interrupt())
    moved = Everything.of(search, stretches, ()).fit(search, fitted)
    assert moved.cost < kept.cost


def test_many_short_recordings_are_searched_as_long_as_few_long_ones():
    u = 10 * np.random.default_rng(0).standard_normal(60 * 250)
    blank = Recording(u, u, 0.05, ("force",), ("pos",), hold="zero")
    record = blank.with_(y=cart(k=50.0).simulate(blank.with_(initial="zero")))
    short = [record.slice(k, k + 250) for k in range(0, len(u), 250)]
    chosen = choose_stretches(cart(), short, "zero", most=6000)
    assert 3000 <= sum(map(len, chosen)) <= 4000


@pytest.mark.slow
def test_wear_over_a_long_record_is_named():
    """The pieces have the same periodic input, and are no repeats; each knows when it was recorded."""
    rng = np.random.default_rng(0)
    u = np.tile(10 * np.ravel(pilfr.multisine(1000, f_max=3.0, fs=20.0, rng=rng)), 15)
    blank = Recording(u, u, 0.05, ("force",), ("pos",), initial="zero", hold="zero")
    worn = laws.scheduled(laws.ViscousDamping, "t")().at({"c_1": 1.0, "c_1_high": 4.0, "low": 0.0, "high": 750.0})
    y = cart().with_element("ground", worn).simulate(blank)
    train = blank.with_(y=y + 2e-3 * np.std(y) * rng.standard_normal(y.shape))
    found = pilfr.diagnose(cart(), train, laws=(laws.ViscousDamping,), search_samples=6000, workers=1)
    (effect,) = found.effects
    assert (effect.port, effect.law, effect.form) == ("ground", "viscous_damping", "scheduled by t")
    assert found.errors["train"]["after"] < 2.5e-3 and found.floor["source"] == "estimated"
