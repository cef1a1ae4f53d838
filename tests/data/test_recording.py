"""The recording: checked once at the door, immutable behind it."""

import pickle

import numpy as np
import pytest
from cart import cart
from hypothesis import given, strategies as st
from scipy.sparse import csc_array

from pilfr_casadi._base import InputError
from pilfr_casadi.data import Recording, as_recordings, check_for_identification, mean_period
from pilfr_casadi.laws import Drift


def recording(m=20, n_u=1, n_y=1, **options):
    rng = np.random.default_rng(0)
    return Recording(rng.normal(size=(m, n_u)), rng.normal(size=(m, n_y)), 0.1, **options)


def test_vectors_become_columns_with_names():
    r = Recording([1, 2, 3], np.zeros((3, 2)), 0.5)
    assert (r.u.shape, r.y.shape, r.u.dtype) == ((3, 1), (3, 2), float)
    assert (r.inputs, r.outputs, r.n_u, r.n_y, len(r)) == (("u",), ("y1", "y2"), 1, 2, 3)
    assert r.t.tolist() == [0.0, 0.5, 1.0]
    assert (r.initial, r.hold, r.period, r.skip, dict(r.units)) == ("estimate", None, None, 0, {})


def test_nothing_can_change():
    u, units = np.arange(4.0), {"u": "N"}
    r = Recording(u, u, 1.0, units=units, initial=[1.0, 2.0])
    u[0], units["u"] = 99.0, "kN"
    assert r.u[0, 0] == 0.0
    assert r.units["u"] == "N"
    for array in (r.u, r.y, r.initial):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
    with pytest.raises(AttributeError):
        r.dt = 2.0
    with pytest.raises(TypeError):
        r.units["u"] = "kN"


def test_pickle_keeps_everything_and_stays_read_only():
    r = recording(
        inputs=("force",), units={"force": "N"}, period=5, skip=3, hold="linear", initial="periodic", name="rig"
    )
    back = pickle.loads(pickle.dumps(r))
    assert repr(back) == repr(r)
    assert np.array_equal(back.u, r.u)
    assert not back.u.flags.writeable


def test_repr_says_what_matters():
    text = repr(recording(inputs=("force",), units={"force": "N"}, hold="zero", name="rig"))
    for part in ("'rig'", "20 samples", "dt 0.1 s", "force [N]", "hold zero", "initial estimate"):
        assert part in text
    assert "period" not in text


def test_with_checks_again():
    r = recording()
    assert r.with_(hold="linear").hold == "linear"
    assert r.hold is None
    with pytest.raises(InputError, match="hold"):
        r.with_(hold="cubic")


def test_inputs_of_the_next_samples_follow_the_period():
    r = Recording(np.arange(6.0), np.arange(6.0) + 10, 0.1)
    assert r.u_next[:, 0].tolist() == [1, 2, 3, 4, 5, 5]
    assert r.with_(period=3).u_next[:, 0].tolist() == [1, 2, 3, 4, 5, 3]
    assert r.with_(period=4).y_next[:, 0].tolist() == [11, 12, 13, 14, 15, 15]  # one and a half periods


NAN = np.array([[1.0, 2.0], [3.0, np.nan], [5.0, 6.0]])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (dict(u=np.arange(19.0)), "19 samples of u but 20 of y"),
        (dict(u=[1.0], y=[1.0]), "at least 2"),
        (dict(u={"force": np.zeros(20), "volt": np.zeros(20)}), "u of .* is a dict with the keys force, volt"),
        (dict(u=csc_array(np.eye(20))), "u of .* is a sparse matrix; give a full array"),
        (dict(y=None), "lacks y; give Recording"),
        (dict(u=np.zeros((20, 2, 3))), r"shape \(20, 2, 3\).*a recording for each experiment"),
        (dict(u=np.zeros((20, 1, 1))), r"shape \(20, 1, 1\)"),
        (dict(u=np.zeros((20, 0)), inputs=("f",)), "0 input column.* 1 name"),
        (dict(u=["a"] * 20), "real numbers"),
        (dict(u=np.full(20, 1j)), "real numbers"),
        (dict(u=[[1.0], [1.0, 2.0]]), "real numbers"),
        (dict(u=NAN, y=np.zeros(3), inputs=("force", "volt")), "sample 1 of input 'volt' in recording 'rig' is nan"),
        (dict(y=np.full(20, np.inf)), "sample 0 of output 'y'.* is inf"),
        (dict(u=np.ma.masked_equal(np.arange(20), 3)), "sample 3 of input 'u' in recording 'rig' is nan"),
        (dict(u=np.r_[np.ones(19), 1e308]), "sample 19 of input 'u' .* up to 1e.100"),
        (dict(u=[10**400] * 20), "real numbers"),
        (dict(dt=0.0), "above zero"),
        (dict(dt=np.nan), "above zero"),
        (dict(dt="fast"), "above zero"),
        (dict(dt=np.full(20, 0.1)), r"dt=array.{,60} was given; give the seconds from one sample to the next"),
        (dict(dt=1e-300), "dt=1e-300; give seconds from 1e-30 to 1e"),
        (dict(dt=np.timedelta64(10, "ms")), "above zero"),
        (dict(dt=None), "dt=None was given"),
        (dict(inputs=3), "texts, distinct"),
        (dict(u=np.zeros((20, 2)), inputs=("a", 3)), "texts, distinct"),
        (dict(units=["u"]), "a mapping from column to unit"),
        (dict(units={"u": 5}), "a mapping from column to unit"),
        (dict(inputs=("a", "b")), "1 input column.* 2 name"),
        (dict(u=np.zeros((20, 2)), inputs=("a", "a")), "distinct"),
        (dict(inputs=("",)), "distinct and not empty"),
        (dict(inputs=("x",), outputs=("x",)), "both as an input and as an output"),
        (dict(units={"forc": "N"}), "'forc'; its columns are u, y"),
        (dict(hold="cubic"), "'zero', 'linear', 'band-limited' or 'next', or None"),
        (dict(initial="steady"), "zero, estimate, periodic"),
        (dict(initial=[1.0, np.nan]), "finite numbers"),
        (dict(initial=np.zeros((2, 2))), "vector"),
        (dict(initial="periodic"), "set period"),
        (dict(period=1), "from 2 to 20"),
        (dict(period=4.0), "from 2 to 20"),
        (dict(period=16, skip=5), "from 2 to 15"),
        (dict(skip=20), "from 0 to 19"),
        (dict(skip=-1), "from 0 to 19"),
    ],
)
def test_each_fault_has_its_sentence(change, words):
    rng = np.random.default_rng(0)
    fields = dict(u=rng.normal(size=20), y=rng.normal(size=20), dt=0.1, name="rig") | change
    with pytest.raises(InputError, match=words) as caught:
        Recording(**fields)
    assert "\n" not in str(caught.value)
    assert "'rig'" in str(caught.value)


def test_a_dict_alone_is_refused():
    with pytest.raises(InputError, match="is a dict with the keys u, y; give one array"):
        Recording({"u": np.zeros(20), "y": np.zeros(20)})


@given(start=st.integers(-25, 25), stop=st.none() | st.integers(-25, 25), skip=st.integers(0, 10))
def test_slice_is_the_python_slice(start, stop, skip):
    r = recording(skip=skip, initial="zero")
    expected = r.u[start:stop]
    if len(expected) < 2:
        with pytest.raises(InputError, match="fewer than 2"):
            r.slice(start, stop)
        return
    piece = r.slice(start, stop)
    assert np.array_equal(piece.u, expected)
    assert np.array_equal(piece.y, r.y[start:stop])
    first = range(20)[start:stop][0]
    assert piece.initial == ("zero" if first == 0 else "estimate")
    if skip < first + len(piece):
        assert piece.skip == max(0, skip - first)


def test_slice_takes_numbers_of_samples():
    with pytest.raises(InputError, match=r"stop=2.5 was given; .* use cut for seconds"):
        recording().slice(None, 2.5)


def test_slice_keeps_a_period_only_while_there_is_one():
    r = recording(period=5, initial="periodic", skip=2)
    assert (r.slice(5).period, r.slice(5).initial, r.slice(5).skip) == (5, "periodic", 0)
    short = r.slice(0, 4)
    assert (short.period, short.initial, short.skip) == (None, "estimate", 2)


@given(st.floats(0.1, 0.9))
def test_split_loses_nothing(fraction):
    r = recording(initial=np.ones(3))
    first, second = r.split(fraction)
    assert np.array_equal(np.vstack([first.u, second.u]), r.u)
    assert np.array_equal(first.initial, np.ones(3))
    assert second.initial == "estimate"
    assert len(first) == round(20 * fraction)


@pytest.mark.parametrize("fraction", [0.0, 1.0, -1.0, float("nan"), "half"])
def test_split_outside(fraction):
    with pytest.raises(InputError, match="between 0 and 1"):
        recording().split(fraction)


def test_as_recordings():
    r = recording()
    assert as_recordings(r) == (r,)
    assert as_recordings(iter([r, r])) == (r, r)
    arrays = {"u": np.zeros(20), "y": np.zeros(20)}
    for wrong, words in [
        ([], "no recording"),
        ([r, "x"], "not str"),
        (3, "not int"),
        (arrays, "not dict; Recording"),
        (r.u, "not ndarray; Recording"),
    ]:
        with pytest.raises(InputError, match=words):
            as_recordings(wrong)


def test_one_varying_input_is_enough_to_identify():
    still = recording().with_(u=np.full(20, 3.0))
    both = check_for_identification([still, recording()], n_min=40)
    assert len(both) == 2


@pytest.mark.parametrize(
    ("others", "n_min", "words"),
    [
        ([recording(inputs=("f",), name="b")], 2, "'b' has the inputs f and the recording has u"),
        ([recording().with_(dt=0.101, name="b")], 2, "resample"),
        ([recording(skip=10)], 31, "30 scored samples"),
        ([recording(name="b")], 2, "recording 'b' holds the same samples as the recording; leave one"),
        ([recording()], 2, "recording 2 holds the same samples as recording 1"),
    ],
)
def test_recordings_that_do_not_fit_together(others, n_min, words):
    with pytest.raises(InputError, match=words):
        check_for_identification([recording(), *others], n_min)


def test_a_recording_may_lack_outputs_but_cannot_be_fitted():
    r = Recording(np.arange(9.0), np.empty((9, 0)), 0.1, name="drive")
    assert (r.n_y, r.outputs, r.y.shape, r.slice(2).y.shape) == (0, (), (9, 0), (7, 0))
    assert "outputs none" in repr(r)
    assert pickle.loads(pickle.dumps(r)).n_y == 0
    with pytest.raises(InputError, match="'drive' has no outputs"):
        check_for_identification(r)
    with pytest.raises(InputError, match="1 name"):
        r.with_(outputs=("y",))


def test_a_recording_may_lack_inputs():
    y = np.exp(-0.1 * np.arange(30.0))
    r = Recording(np.empty((30, 0)), y, 0.1, outputs=("T",), units={"T": "K"}, name="cooling", hold="zero")
    assert (r.n_u, r.inputs, r.slice(2).u.shape) == (0, (), (28, 0)) and "inputs none, outputs T [K]" in repr(r)
    assert r.with_(y=r.u, outputs=(), units={}).resample(0.2).u.shape == (15, 0)
    coarse = r.resample(0.2)
    assert coarse.u.shape == (15, 0) and coarse.dt == 0.2 and coarse.hold == "zero"
    assert pickle.loads(pickle.dumps(r)).n_u == 0 and mean_period(r.with_(period=10)).u.shape == (10, 0)
    assert check_for_identification(r, excited=False) == (r,)
    with pytest.raises(InputError, match="there is no input in recording 'cooling'; a model from input to output"):
        check_for_identification(r)


def test_a_channel_without_a_unit_is_shown_by_its_name():
    assert "inputs u, outputs y [m]" in repr(recording().with_(units={"u": "", "y": "m"}))


def test_nothing_to_identify():
    r = recording(n_u=2, n_y=2)
    with pytest.raises(InputError, match="inputs u1, u2 never change in"):
        check_for_identification(r.with_(u=np.full((20, 2), [1.0, 0.1])))
    with pytest.raises(InputError, match="output 'y2' never changes"):
        check_for_identification(r.with_(y=r.y * [1.0, 0.0]))
    assert check_for_identification(r.with_(u=r.u * [0.0, 1.0]))


def test_a_piece_keeps_the_time_of_its_recording():
    """What drifts over a day goes on drifting in the afternoon."""
    drifting = cart().with_element("sensor:pos", Drift(values={"a": 0.3, "b": 0.02}))
    whole = Recording(np.ones(400), np.zeros(400), 0.1, ("force",), ("pos",), initial="zero", hold="zero")
    late = whole.slice(100).slice(50, 200).with_(initial="zero")
    assert late.start == pytest.approx(15.0) and late.t[0] == 0.0 and late.clock[0] == pytest.approx(15.0)
    alone = cart().simulate(late)
    np.testing.assert_allclose(drifting.simulate(late)[:, 0] - alone[:, 0], 0.3 * late.clock + 0.02 * late.clock**2)


@pytest.mark.parametrize("start", [np.nan, "noon", None])
def test_the_start_is_a_time(start):
    with pytest.raises(InputError, match=r"start of the recording is .*; give the time of its first sample in seconds"):
        Recording(np.ones(4), np.zeros(4), 0.1, start=start)


def test_recordings_of_one_name_are_numbered_in_messages():
    slow = recording().with_(dt=recording().dt * 2)
    for name, first, second in (
        ("", "recording 1", "recording 2"),
        ("day", r"recording 1 \('day'\)", "recording 2 .*"),
    ):
        with pytest.raises(InputError, match=rf"^{second} has a step of .* and {first} one of .*; resample"):
            check_for_identification([recording().with_(name=name), slow.with_(name=name)])
