"""Preprocessing of recordings: what each verb does to tones whose fate is known, and to the rest of the recording."""

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from scipy.signal import lsim, lti

import pilfr_casadi as pilfr
from pilfr_casadi import InputError, Recording
from pilfr_casadi.data import interpolate_band_limited, merge, read_csv, read_frame

DT = 1e-3
T = np.arange(4000) * DT
SLOW, FAST = np.sin(2 * np.pi * 5 * T), np.sin(2 * np.pi * 180 * T + 0.4)


@pytest.fixture
def tones():
    return Recording(
        SLOW + FAST, 2 * SLOW + 3, DT, ("force",), ("x",), units={"force": "N"}, initial="zero", hold="zero"
    )


def middle(values):
    """The samples away from the ends, where a filter has settled."""
    return values[len(values) // 10 : -len(values) // 10]


def amplitude(values, frequency, dt):
    t = np.arange(len(values)) * dt
    return 2 * abs(np.mean(values * np.exp(-2j * np.pi * frequency * t)))


def test_cut_counts_seconds(tones):
    piece = tones.cut(0.5, 1.5)
    assert len(piece) == 1000 and piece.begins == "estimate"
    np.testing.assert_array_equal(piece.y, tones.y[500:1500])
    assert tones.cut(0, 2).begins == "zero" and len(tones.cut(3.9)) == 100
    with pytest.raises(InputError, match=r"stop=5 was given; the recording lasts from 0 to 4 s\."):
        tones.cut(0, 5)
    with pytest.raises(InputError, match="fewer than 2"):
        tones.cut(1, 1)


def test_detrend_takes_mean_or_line_from_the_channels_named(tones):
    level = tones.detrend()
    assert abs(level.y.mean()) < 1e-12 and abs(level.u.mean()) < 1e-12 and level.begins == "estimate"
    drifting = tones.with_(y=tones.y + 7 * T[:, None])
    line = drifting.detrend("linear", channels="x")
    np.testing.assert_array_equal(line.u, tones.u)
    assert np.std(line.y) < 1.5 and abs(np.polyfit(T, line.y[:, 0], 1)[0]) < 1e-9
    with pytest.raises(InputError, match=r"no channel 'y'; it has force, x"):
        tones.detrend(channels="y")
    with pytest.raises(InputError, match="give constant, linear"):
        tones.detrend("cubic")


def test_a_filter_has_no_phase_and_half_the_gain_at_its_cutoff(tones):
    low = tones.filter(40.0)
    np.testing.assert_allclose(middle(low.u[:, 0]), middle(SLOW), atol=2e-3)
    assert low.begins == "estimate" and low.hold == "linear"
    edge = tones.with_(u=np.sin(2 * np.pi * 40 * T)).filter(40.0)
    assert amplitude(middle(edge.u[:, 0]), 40, DT) == pytest.approx(0.5, abs=0.01)
    high = tones.filter(40.0, "highpass", channels="force")
    np.testing.assert_allclose(middle(high.u[:, 0]), middle(FAST), atol=5e-3)
    np.testing.assert_array_equal(high.y, tones.y)
    band = tones.filter((100.0, 300.0), "bandpass")
    assert amplitude(middle(band.u[:, 0]), 180, DT) == pytest.approx(1.0, abs=0.02)
    assert tones.filter(40.0, channels="x").hold == "zero"


def test_filtering_inputs_and_outputs_alike_keeps_a_linear_relation(tones):
    y = np.convolve(tones.u[:, 0], [0.2, 0.5, 0.1])[: len(T)]
    filtered = tones.with_(y=y).filter(60.0)
    again = np.convolve(filtered.u[:, 0], [0.2, 0.5, 0.1])[: len(T)]
    np.testing.assert_allclose(middle(filtered.y[:, 0]), middle(again), atol=1e-6)


@pytest.mark.parametrize(
    "cutoff, kind, said",
    [
        (500.0, "lowpass", "cutoff=500 Hz is not below the Nyquist frequency 500 Hz"),
        (-1.0, "lowpass", "cutoff=-1.0 was given; give a frequency in Hz, above zero"),
        ((10.0, 20.0), "lowpass", "give one frequency in Hz"),
        (10.0, "bandpass", "give two frequencies in Hz, the lower one first"),
        ((20.0, 10.0), "bandstop", "the lower one first"),
        ("10", "lowpass", "give one frequency in Hz"),
        (10.0, "median", "give lowpass, highpass, bandpass, bandstop"),
    ],
)
def test_bad_filters_are_refused(tones, cutoff, kind, said):
    with pytest.raises(InputError, match=said):
        tones.filter(cutoff, kind)


def test_too_few_samples_for_a_filter(tones):
    with pytest.raises(InputError, match=r"10 samples are too few for this filter, which needs more than 15\."):
        tones.slice(0, 10).filter(40.0)


@pytest.mark.parametrize("dt", [4e-3, 2.5e-3, np.pi * 1e-3], ids=["whole", "ratio", "irrational"])
def test_resampling_keeps_slow_tones_and_lets_none_fold(tones, dt):
    """180 Hz folds to 70, 180 and 138 Hz at the three steps; the anti-alias filter removes it where it would fold."""
    coarse = tones.with_(skip=400, hold="linear").resample(dt)
    t = np.arange(len(coarse)) * dt
    assert coarse.dt == dt and t[-1] <= T[-1] < t[-1] + 1.01 * dt
    np.testing.assert_allclose(middle(coarse.y[:, 0]), middle(2 * np.sin(2 * np.pi * 5 * t) + 3), atol=0.02)
    assert coarse.skip * dt == pytest.approx(0.4, abs=dt) and coarse.hold == "linear" and coarse.begins == "zero"
    if dt > 1 / 360:
        np.testing.assert_allclose(middle(coarse.u[:, 0]), middle(np.sin(2 * np.pi * 5 * t)), atol=0.03)


@pytest.mark.parametrize("dt", [0.25e-3, 4e-3], ids=["finer", "coarser"])
def test_a_held_input_stays_held_and_moves_a_linear_system_alike(dt):
    """Interpolation would delay the force by half a sample, an error of 1.5 % in this mode of 5 Hz."""
    levels = np.repeat(np.random.default_rng(0).choice([-1.0, 1.0], 174), 23)[:4000]
    rig = lti([1], [(2 * np.pi * 5) ** -2, 0.1 / (2 * np.pi * 5), 1])
    x = lsim(rig, levels, T, interp=False)[1]
    r = Recording(levels, x, DT, ("force",), ("x",), hold="zero")
    other = r.resample(dt)
    again = lsim(rig, other.u[:, 0], other.t, interp=False)[1]
    assert other.hold == "zero" and np.std(again - other.y[:, 0]) < 5e-3 * np.std(x)
    within = np.isclose(np.floor(other.t / 23e-3 + 1e-6), np.floor((other.t + dt) / 23e-3 - 1e-6))
    assert set(other.u[within, 0]) == {-1.0, 1.0} and within.mean() > 0.8
    merged = merge(r, Recording(x, np.empty((len(T), 0)), DT, ("copy",)), dt=dt, inputs="force", outputs="x")
    np.testing.assert_allclose(merged.u[:-1], other.u[: len(merged) - 1], atol=1e-12)
    assert merged.hold == "zero"


def test_resampling_to_a_finer_step_and_to_its_own(tones):
    assert tones.resample(DT) is tones
    fine = tones.with_(hold=None).resample(DT / 2)
    assert len(fine) == 2 * len(T) - 1
    np.testing.assert_allclose(middle(fine.y[::2]), middle(tones.y), atol=0.02)


def test_resampling_keeps_a_period_of_whole_samples():
    r = Recording(np.tile(SLOW[:200], 5), np.tile(SLOW[:200], 5), DT, period=200, initial="periodic")
    assert r.resample(2e-3).period == 100 and r.resample(2e-3).begins == "periodic"
    assert r.resample(3e-3).period is None and r.resample(3e-3).begins == "estimate"
    assert r.with_(period=2, initial="zero").resample(5e-3).period is None  # less than one new sample


@pytest.mark.parametrize("dt, said", [(0.0, "dt=0.0 was given"), (10.0, "leaves 1 sample of"), ("1", "dt='1'")])
def test_bad_steps_are_refused(tones, dt, said):
    with pytest.raises(InputError, match=said):
        tones.resample(dt)


def test_two_loggers_on_one_clock():
    a = Recording(np.sin(2 * np.pi * T), np.cos(2 * np.pi * T), DT, ("force",), ("x",), units={"x": "m"})
    t = np.arange(500) * 4.3e-3
    b = Recording(np.sin(2 * np.pi * 3 * (t + 0.8)), np.zeros((500, 0)), 4.3e-3, ("current",), units={"current": "A"})
    both = merge(a, b, start=0.8, outputs=("x", "current"), inputs="force")
    assert both.dt == 4.3e-3 and both.inputs == ("force",) and both.outputs == ("x", "current")
    at = 0.8 + both.t
    np.testing.assert_allclose(middle(both.y[:, 0]), middle(np.cos(2 * np.pi * at)), atol=2e-3)
    np.testing.assert_allclose(middle(both.y[:, 1]), middle(np.sin(2 * np.pi * 3 * at)), atol=2e-3)
    assert both.begins == "estimate" and both.units["current"] == "A"
    finer = pilfr.merge(a, b, dt=1e-3, start=0.8)
    assert finer.inputs == ("force", "current") and finer.dt == 1e-3
    with pytest.raises(InputError, match=r"both recordings have a channel 'force'"):
        merge(a, a)
    with pytest.raises(InputError, match="fewer than 2 samples"):
        merge(a, b, start=9.0)
    with pytest.raises(InputError, match="no channel 'y'; they have force, x, current"):
        merge(a, b, outputs="y")
    with pytest.raises(InputError, match="no channel 3"):
        merge(a, b, outputs=3)


def test_the_same_clock_is_left_as_it_is(tones):
    more = Recording(SLOW, np.zeros((len(T), 0)), DT, ("current",))
    both = merge(tones, more)
    np.testing.assert_allclose(both.u, np.column_stack([tones.u[:, 0], SLOW]), atol=1e-12)
    assert both.hold == "zero" and both.begins == "zero"


# ---------------------------------------------------------------------------------------------------- uneven time


def test_uneven_times_are_resampled_on_request(tmp_path):
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.5e-3, 1.5e-3, 4000))
    table = np.column_stack([t, np.sin(2 * np.pi * 2 * t), np.cos(2 * np.pi * 2 * t)])
    path = tmp_path / "jitter.csv"
    np.savetxt(path, table, delimiter=",", header="t,force,x", comments="")
    with pytest.raises(InputError, match=r"not uniform.*resample"):
        read_csv(path, "force", "x")
    r = read_csv(path, "force", "x", resample=0.01)
    assert r.dt == 0.01
    np.testing.assert_allclose(middle(r.u[:, 0]), middle(np.sin(2 * np.pi * 2 * (t[0] + r.t))), atol=2e-3)
    with pytest.raises(InputError, match="resample was given with dt"):
        read_csv(path, "force", "x", resample=0.01, dt=0.01)
    gap = np.vstack([table[:1000], table[1300:]])
    np.savetxt(path, gap, delimiter=",", header="t,force,x", comments="")
    with pytest.raises(InputError, match=r"gap of 0\.297 s after 1\.01691 s, where 0\.00099 s is usual; cut"):
        read_csv(path, "force", "x", resample=0.01)


def test_held_steps_stay_held_at_uneven_times():
    t = np.cumsum(np.random.default_rng(0).uniform(0.5e-3, 1.5e-3, 4000))
    levels = np.where(np.arange(4000) % 100 < 50, 1.0, -1.0)
    frame = pd.DataFrame({"t": t, "force": levels, "x": np.sin(20 * t)})
    r = read_frame(frame, "force", "x", resample=1e-3, hold="zero")
    assert np.mean(np.abs(r.u[:, 0]) == 1) > 0.97 and np.max(np.abs(r.u)) == 1
    begin, end = 1000, 3000  # the same impulse
    last, after = np.searchsorted(t, t[0] + r.t[[begin, end]], "right") - 1
    between = np.sum(levels[last:after] * np.diff(t[last : after + 1]))
    between += levels[after] * (t[0] + r.t[end] - t[after]) - levels[last] * (t[0] + r.t[begin] - t[last])
    assert np.sum(r.u[begin:end]) * r.dt == pytest.approx(between, abs=1e-9)


def test_a_command_stays_held_although_the_clock_of_its_logger_jitters():
    rng = np.random.default_rng(0)
    t = np.cumsum(np.where(rng.random(4000) < 0.05, 1e-3, 2e-3))  # whole milliseconds, some samples early
    levels = np.cumsum(rng.standard_normal(4000))
    frame = pd.DataFrame({"t": t, "force": levels, "x": np.sin(20 * t)})
    r = read_frame(frame, "force", "x", resample=2e-3, hold="zero")
    assert r.hold == "zero"
    held = np.append(0.0, np.cumsum(levels[:-1] * np.diff(t)))
    impulse = np.interp(t[0] + r.t, t, held)
    np.testing.assert_allclose(np.cumsum(r.u[:-1, 0]) * r.dt, impulse[1:], atol=1e-9)


def test_next_values_stay_means_over_the_longer_step_that_ends_at_each_sample():
    minutes = np.random.default_rng(0).standard_normal(601)
    power = Recording(minutes[:, None], np.zeros((601, 1)), 1.0, ("power",), ("y",), hold="next")
    wanted = minutes[1:].reshape(60, 10).mean(axis=1)
    frame = pd.DataFrame({"t": power.t, "power": minutes, "y": 0.0})
    other = power.with_(inputs=("heat",), outputs=("z",))
    for r in (
        power.resample(10.0),
        read_frame(frame, "power", "y", resample=10.0, hold="next"),
        merge(power, other, dt=10.0),
    ):
        assert r.hold == "next"
        np.testing.assert_allclose(r.u[1:, 0], wanted, rtol=0, atol=1e-9)
    finer = power.resample(0.25)
    np.testing.assert_allclose(finer.u[1:, 0], np.repeat(minutes[1:], 4), rtol=0, atol=1e-9)
    assert merge(power, other.with_(hold="zero"), dt=10.0).hold == "linear"


# ------------------------------------------------------------------------------------------- channels of several rates


def slow_frame(every=5, count=2000):
    """A force at 1 kHz; a position at a slower rate, nan between its samples."""
    t = np.arange(count) * 1e-3
    x = np.where(np.arange(count) % every == 0, np.cos(30 * t), np.nan)
    return pd.DataFrame({"t": t, "force": np.sin(20 * t) + np.sin(2 * np.pi * 230 * t), "x": x})


def test_channels_of_several_rates_are_brought_to_one_step(tmp_path):
    frame, path = slow_frame(), tmp_path / "rig.csv"
    frame.to_csv(path, index=False)
    for read in (lambda **k: read_frame(frame, "force", "x", **k), lambda **k: read_csv(path, "force", "x", **k)):
        with pytest.raises(InputError, match=r"'x' has numbers in 400 of 2000 rows.* one step with resample=STEP\.$"):
            read()
        slow, fast = read(resample=5e-3), read(resample=1e-3)
        np.testing.assert_allclose(slow.y[:, 0], np.cos(30 * slow.t), atol=1e-9)
        np.testing.assert_allclose(middle(slow.u[:, 0]), middle(np.sin(20 * slow.t)), atol=5e-3)  # 230 Hz is filtered
        np.testing.assert_allclose(middle(fast.y[:, 0]), middle(np.cos(30 * fast.t)), atol=1e-4)
        np.testing.assert_allclose(fast.u[:, 0], frame.force[: len(fast)], atol=1e-9)
        assert slow.dt == 5e-3 and len(slow) == 400 and len(fast) == 1996  # up to the last position


def test_a_slow_held_input_stays_held():
    frame = slow_frame().rename(columns={"force": "x", "x": "force"})
    r = read_frame(frame, "force", "x", resample=1e-3, hold="zero")
    np.testing.assert_array_equal(r.u[:-1, 0], frame.force.ffill()[: len(r) - 1])
    assert r.hold == "zero"


def test_columns_of_a_frame_may_have_numbers_as_names():
    frame = slow_frame(1)
    numbered = frame.rename(columns={"t": 0, "force": 1, "x": 2})
    r = read_frame(numbered, "force", "x", columns={"t": 0, "force": 1, "x": 2}, resample=1e-3)
    np.testing.assert_array_equal(r.u, read_frame(frame, "force", "x", resample=1e-3).u)


def test_missing_samples_of_one_rate_are_no_other_rate():
    frame = slow_frame(1)
    frame.loc[[500, 501], "x"] = np.nan
    with pytest.raises(InputError, match="'x', sample 500 is nan"):
        read_frame(frame, "force", "x")
    r = read_frame(frame, "force", "x", resample=1e-3)
    np.testing.assert_allclose(r.y[:, 0], np.cos(30 * r.t), atol=1e-3)
    frame.loc[500:600, "x"] = np.nan
    with pytest.raises(InputError, match=r"'x' has a gap of 0\.102 s after 0\.499 s"):
        read_frame(frame, "force", "x", resample=1e-3)


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda f: f.assign(x=np.nan), r"'x' has 0 number\(s\); at least 2"),
        (lambda f: f.assign(x=np.inf), "'x', sample 0 is inf"),
        (lambda f: f.assign(t=f.t.where(f.t != 0.5)), "'t', sample 500 is nan"),
        (lambda f: f.assign(x=f.x[:1000], force=f.force[1000:]), "begin by 1 s and end from 0.995 s on"),
    ],
)
def test_channels_that_cannot_be_brought_to_one_step(change, said):
    with pytest.raises(InputError, match=said):
        read_frame(change(slow_frame()), "force", "x", resample=5e-3)


# --------------------------------------------------------------------------------------------------------- frames


def test_a_recording_goes_into_a_frame_and_comes_back(tones):
    frame = tones.to_frame()
    assert list(frame.columns) == ["force", "x"] and frame.index.name == "t"
    back = read_frame(frame, "force", "x", initial="zero", hold="zero")
    np.testing.assert_array_equal(back.u, tones.u)
    assert back.dt == pytest.approx(DT) and back.name == ""
    for named in (frame.reset_index(), frame.reset_index(drop=True)):
        other = pilfr.read_frame(named, "force", "x", dt=DT, units={"force": "N"}, name="rig")
        np.testing.assert_array_equal(other.y, tones.y)
        assert other.name == "rig"


def test_dates_and_durations_are_times():
    start = pd.Timestamp("2024-05-01 12:00")
    index = start + pd.to_timedelta(np.arange(100) * 10, unit="ms")
    frame = pd.DataFrame({"force": np.arange(100.0), "x": np.arange(100), "remark": "text"}, index=index)
    assert read_frame(frame, "force", "x").dt == pytest.approx(0.01)
    assert read_frame(frame.reset_index(names="time"), "force", "x").dt == pytest.approx(0.01)


def test_dates_in_a_time_zone_are_times():
    index = pd.date_range("2024-03-31 01:30", periods=100, freq="1min", tz="Europe/Berlin")  # 2:00 to 3:00 is left out
    frame = pd.DataFrame({"force": np.arange(100.0), "x": np.arange(100)}, index=index)
    dates = pd.Series(index.to_pydatetime(), dtype=object).array
    for changed in (frame, frame.reset_index(names="t"), frame.assign(t=dates)):
        assert read_frame(changed, "force", "x").dt == 60
    frame["t"] = [*index[:-1], pd.NaT]
    with pytest.raises(InputError, match="'t', sample 99 is nan"):
        read_frame(frame, "force", "x")
    frame["t"] = [*index[:-1], index[-1].tz_localize(None)]
    with pytest.raises(InputError, match="'t' holds a cell array or objects"):
        read_frame(frame, "force", "x")


class Table:
    """A frame as polars has them: columns by name, no index."""

    def __init__(self, **columns):
        self.held, self.columns = columns, list(columns)

    def __getitem__(self, name):
        return self.held[name]


def test_any_table_of_named_columns_is_a_frame():
    r = read_frame(Table(t=[0.0, 0.1, 0.2], u=[1, 2, 3], y=[4.0, 5.0, 6.0]), "u", "y")
    np.testing.assert_array_equal(r.y[:, 0], [4, 5, 6])


@pytest.mark.parametrize(
    "frame, said",
    [
        ({"u": [1.0]}, "a dict was given; give a data frame of pandas or polars"),
        (pd.DataFrame({"t": [0.0, 1.0], "u": [1.0, 2.0]}), "the frame has no column 'y'; it has t, u"),
        (pd.DataFrame({"u": [1.0, 2.0], "y": [1.0, 2.0]}), "the frame has no time column"),
        (pd.DataFrame({"t": [0.0, 1.0], "u": [1.0, np.nan], "y": [1.0, 2.0]}), "'u', sample 1 is nan"),
        (pd.DataFrame({"t": [0.0, 1.0], "u": ["a", "b"], "y": [1.0, 2.0]}), "'u' holds"),
        (Table(t=np.arange(3), u=np.ma.masked_equal(np.arange(3), 2), y=np.ones(3)), "'u', sample 2 is nan"),
        (Table(t=np.ma.masked_equal(np.arange(3), 2), u=np.ones(3), y=np.ones(3)), "'t', sample 2 is nan"),
        (pa.table({"t": [0.0, 1.0], "u": [1.0, 2.0], "y": [1.0, 2.0]}), "a Table was given; give a data frame"),
        (pd.DataFrame([[0.0, 1, 2], [1, 2, 3]], columns=["t", "u", "u"]), "2 columns named 'u'"),
    ],
)
def test_frames_that_cannot_be_used(frame, said):
    with pytest.raises(InputError, match=said):
        read_frame(frame, "u", "y")


def test_an_input_that_is_faster_than_the_new_step_is_filtered_as_the_outputs_are():
    u = np.random.default_rng(0).standard_normal(2000)  # a level for each sample
    r = Recording(u, u, 1e-3, ("u",), ("y",), hold="zero")
    slow = r.resample(1e-2)
    assert slow.hold == "linear" and np.allclose(slow.u, slow.y)
    assert r.with_(u=u[np.arange(2000) // 20 * 20]).resample(1e-2).hold == "zero"


def test_an_input_of_unknown_hold_keeps_its_levels_between_uneven_samples(tmp_path):
    rng = np.random.default_rng(0)
    t = 0.01 * (np.arange(400) + 0.2 * rng.uniform(-1, 1, 400))
    u = np.sign(rng.standard_normal(400))
    path = tmp_path / "run.csv"
    np.savetxt(path, np.column_stack([t, u, np.cumsum(u)]), delimiter=",", header="t,u,y", comments="")
    assert np.max(np.abs(read_csv(path, inputs="u", outputs="y", resample=0.009).u)) <= 1.0


def test_a_held_input_that_is_written_when_it_changes_lasts_to_the_end(tmp_path):
    rows = [f"{0.01 * k:.2f},{k // 50 if k in (0, 50) else ''},{np.sin(k)}" for k in range(100)]
    path = tmp_path / "events.csv"
    path.write_text("\n".join(["t,u,y", *rows]), encoding="utf-8")
    r = read_csv(path, inputs="u", outputs="y", resample=0.01, hold="zero")
    assert len(r) == 100 and r.hold == "zero" and np.array_equal(r.u[:, 0], np.arange(100) // 50)


def test_a_stated_start_that_would_move_is_refused(tmp_path):
    rows = [f"{0.01 * k:.2f},{np.cos(k)},{np.sin(k) if k % 4 == 3 else ''}" for k in range(100)]
    path = tmp_path / "late.csv"
    path.write_text("\n".join(["t,u,y", *rows]), encoding="utf-8")
    with pytest.raises(InputError, match=r"from 0\.03 s on, but initial was stated for 0 s"):
        read_csv(path, inputs="u", outputs="y", resample=0.01, initial=[1.0])
    assert read_csv(path, inputs="u", outputs="y", resample=0.01).begins == "estimate"


def test_a_merged_input_is_linear_where_one_of_the_records_is():
    u = np.random.default_rng(0).standard_normal((500, 2))
    held = Recording(u[np.arange(500) // 50 * 50, :1], np.empty((500, 0)), 0.01, ("a",), (), hold="zero")
    smooth = Recording(u[:, 1:], u[:, 1:], 0.02, ("b",), ("y",), hold="linear")
    assert pilfr.merge(held, smooth).hold == "linear"
    assert pilfr.merge(held, smooth, inputs="a", outputs="y").hold == "zero"


def test_the_hold_of_a_merger_is_that_of_its_inputs():
    u = np.random.default_rng(0).standard_normal((500, 2))
    force = Recording(u[:, :1], np.empty((500, 0)), 0.01, ("a",), (), hold="zero")
    sensor = Recording(u[:, 1:], np.empty((500, 0)), 0.01, ("y",), ())
    for pair in ((force, sensor), (sensor, force)):
        assert merge(*pair, inputs="a", outputs="y").hold == "zero"
    assert merge(force, sensor.with_(hold="linear"), inputs="a", outputs="y").hold == "zero"
    assert merge(force, sensor.with_(hold="linear")).hold == "linear"


def test_a_merged_input_stays_held_where_no_input_is_resampled():
    """The second logger begins whole samples away, or between two samples, before or after the first one."""
    u = np.random.default_rng(0).standard_normal((500, 2))
    a = Recording(u[:, :1], u[:, 1:], 0.01, ("a",), ("y",), hold="zero")
    b = Recording(u[:, 1:], np.empty((500, 0)), 0.01, ("b",), ())
    assert [merge(a, b, start=start).hold for start in (-0.03, 0.0, 0.03)] == ["zero"] * 3
    assert [merge(a, b, start=start).hold for start in (-0.015, 0.015)] == ["linear"] * 2
    assert merge(a, b, start=0.015, inputs="a", outputs="y").hold == "zero"  # by the means over each step


@pytest.mark.parametrize("period", [200, 20, None])
@pytest.mark.parametrize("level", [0.0, 1e5])
def test_a_band_limited_signal_is_interpolated_through_its_samples(period, level):
    def signal(k):
        return level + np.stack([np.sin(2 * np.pi * 0.3 * k), 2 + np.cos(2 * np.pi * 0.05 * k + 1)], axis=-1)

    k = np.arange(205 if period == 20 else 200)
    fine = interpolate_band_limited(signal(k), 5, period)
    assert fine.shape == (5 * len(k) + 1, 2) and np.array_equal(fine[:-1:5], signal(k))
    inside = slice(0, None) if period else slice(150, -150)
    assert np.max(np.abs(fine - signal(np.arange(len(fine)) / 5))[inside]) < 2e-3
    assert interpolate_band_limited(signal(k), 1, period).shape == (len(k) + 1, 2)


@pytest.mark.parametrize("count", [1, 2, 3, 12])
def test_a_constant_is_band_limited(count):
    assert interpolate_band_limited(np.full((count, 1), 1e5), 4) == pytest.approx(1e5, rel=1e-12)


def test_a_band_limited_input_stays_that():
    u = np.random.default_rng(0).standard_normal((500, 1))
    r = Recording(u, u, 0.01, hold="band-limited")
    assert {r.resample(0.005).hold, r.resample(0.03).hold, r.detrend().hold} == {"band-limited"}
