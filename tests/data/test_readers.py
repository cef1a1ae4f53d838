"""Reading recordings: files that are accepted, and one sentence with file, column and line for all others."""

import io
import os
import pickle
import sys
import time
import zipfile

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.sparse import csc_array

from pilfr_casadi import InputError, read, read_csv, read_mat, read_npz
from pilfr_casadi.data import column_names, step_of, written_times

GOOD = "t,force,x2\n0,1,10\n0.1,2,20\n0.2,3,30\n0.3,4,40\n"
MATRIX = np.array([[0.0, 1, 10], [0.1, 2, 20], [0.2, 3, 30], [0.3, 4, 40]])


@pytest.fixture
def write(tmp_path):
    def write(content, name="rig.csv"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


def sentence(caught):
    text = str(caught.value)
    assert "\n" not in text
    assert text.endswith(".")
    return text


# ---------------------------------------------------------------------------------------------- CSV that is accepted


@pytest.mark.parametrize(
    "content",
    [
        GOOD,
        GOOD.replace("t,", "t_s,"),
        GOOD.replace("t,", "time,"),
        GOOD.encode("utf-8-sig"),
        GOOD.replace("\n", "\r\n"),
        GOOD.replace("\n", "\r"),
        GOOD.replace(",", ";"),
        GOOD.replace(",", "\t"),
        GOOD.replace(",", " , "),
        GOOD.rstrip("\n"),
        "\n" + GOOD + "\n\n",
        GOOD.replace("\n0.2", "\n\n0.2"),
        GOOD.replace("t,force,x2", '"t","force","x2"').replace("0.2,3", '"0.2",3'),
        GOOD.replace("0.1,2,20", "1e-1,+2.0,2E1"),
        "x2,label,t,force\n10,a,0,1\n20,b,0.1,2\n30,,0.2,3\n40,nan,0.3,4\n",
        "x2,x,t,x,force\n10,a,0,1,1\n20,b,0.1,1,2\n30,,0.2,1,3\n40,nan,0.3,1,4\n",
        "# " + GOOD,
        "Recorder 7, serial 12\nforce and travel;2024\n\n" + GOOD,
        GOOD.replace("x2\n", "x2\n[s],[N],[mm]\n"),
        "% " + GOOD.replace("x2\n", "x2\n% s,N,counts\n"),
        GOOD.replace("force,x2", "force [N],x2 [mm]").replace("[mm]\n", "[mm]\ns,N,mm\n"),
        "#\tt\tforce\tx2\n" + "\n".join(f"{i},{line}" for i, line in enumerate(GOOD.split()[1:])).replace(",", "\t"),
        "time,2024\n" + GOOD,
        GOOD.replace("0,1,10", "2024-05-01 23:59:59.9,1,10")
        .replace("0.1,", "2024-05-02,")
        .replace("0.2,", "2024-05-02 00:00:00.1,")
        .replace("0.3,", "2024-05-02 00:00:00.2,"),
        GOOD.replace(",", ";").replace(".", ","),
        GOOD.replace(",", "\t").replace(".", ",").replace("1\t10", '"1,0"\t1,0e1'),
        "t;force;x2;note\n0;1;10;2,5 or 3.5\n0,1;2,0;20;v1.2\n0,2;3;30;\n0,3;4;40;\n",
        "temp °C,t,force,x2\n1,0,1,10\n1,0.1,2,20\n1,0.2,3,30\n1,0.3,4,40\n".encode("latin-1"),
    ],
)
def test_accepted(write, content):
    r = read_csv(write(content), inputs=["force"], outputs=["x2"])
    assert np.array_equal(r.u, MATRIX[:, 1:2])
    assert np.array_equal(r.y, MATRIX[:, 2:])
    assert (r.dt, r.inputs, r.outputs, r.name) == (0.1, ("force",), ("x2",), "rig")


def test_options_reach_the_recording(write):
    r = read_csv(write(GOOD), "force", "x2", hold="linear", initial="zero", skip=1, name="a", units={"force": "N"})
    assert (r.hold, r.initial, r.skip, r.name, r.units["force"]) == ("linear", "zero", 1, "a", "N")
    with pytest.raises(InputError, match=r"rig\.csv: hold"):
        read_csv(write(GOOD), "force", "x2", hold="cubic")


def test_columns_are_mapped(write):
    path = write(GOOD.replace("t,force", "clock,u_vir_V"))
    r = read_csv(path, "force", "x2", columns={"force": "u_vir_V", "t": "clock"})
    assert r.inputs == ("force",)
    assert np.array_equal(r.u, MATRIX[:, 1:2])
    both = read_csv(path, ["a", "b"], "x2", columns={"a": "u_vir_V", "b": "u_vir_V", "time": "clock"})
    assert np.array_equal(both.u[:, 0], both.u[:, 1])


def test_many_columns_are_found_at_once(write):
    names = [f"c{i}" for i in range(5000)]
    rows = [",".join(f"{k + i / 7:.12f}" for i in range(5000)) + f",{k}" for k in range(20)]
    path = write("\n".join([",".join(names) + ",t", *rows]))
    start = time.perf_counter()
    r = read_csv(path, names[:100], names[100:400])
    assert (r.n_u, r.n_y, r.dt) == (100, 300, 1.0) and time.perf_counter() - start < 5
    assert len(column_names(path)) == 5001


def test_words_in_brackets_are_no_units(write):
    r = read_csv(write(GOOD.replace("x2\n", "x (left)\ns,N,mm\n")), "force", "x (left)")
    assert r.units == {"force": "N", "x (left)": "mm"}


def test_a_name_may_begin_with_a_mark(write):
    path = write(GOOD.replace("t,force", "#t,% open"))
    assert read_csv(path, "% open", "x2", columns={"t": "#t"}).dt == 0.1
    first = write(GOOD.replace("t,force", "# turns,t").replace("\n0,1,", "\n1,0,"))
    assert read_csv(first, "# turns", "x2", columns={"t": "t"}, time_tolerance=9).inputs == ("# turns",)


def test_names_and_times_are_found_below_a_title(write):
    path = write("Recorder 7, serial 12\n" + GOOD.replace("t,force", "time,force").replace("\n0", "\n10"))
    assert column_names(path) == ("time", "force", "x2")
    assert written_times(path, wanted=["force"]) == written_times(path) == ["10", "10.1", "10.2", "10.3"]


@pytest.mark.parametrize(
    ("header", "likely"),
    [
        ("Zeit [s],force,travel", "Zeit [s]"),
        ("top,force,temps", "temps"),
        ("count,force,travel", "count"),
        ("travel,count,force", "count"),
        ("travel,force,track", "COLUMN"),
    ],
)
def test_the_likeliest_time_column_is_suggested(write, header, likely):
    columns = {"count": [0.0, 0.1, 0.2, 0.3], "force": [1, 3, 2, 4], "travel": [5, 8, 6, 7]}
    rows = zip(*(columns.get(name, [1, 1, 2, 1]) for name in header.split(",")), strict=True)
    path = write("\n".join([header, *(",".join(map(str, row)) for row in rows)]))
    with pytest.raises(InputError, match="no time column") as caught:
        read_csv(path, "force", ())
    assert f"columns={{'t': '{likely}'}}" in sentence(caught)


def test_a_row_of_units_states_the_units(write):
    path = write("Zeit;Kraft;Weg\ns;N;mm\n" + GOOD.split("\n", 1)[1].replace(",", ";"))
    r = read_csv(path, "Kraft", "Weg", columns={"t": "Zeit"})
    assert (r.dt, r.units) == (0.1, {"Kraft": "N", "Weg": "mm"})
    with pytest.raises(InputError, match=r"column 'Zeit \[ms\]' is named as time in ms"):
        read_csv(write(path.read_text().replace("s;N", "ms;N")), "Kraft", "Weg", columns={"t": "Zeit"})


def test_dt_instead_of_time(write):
    path = write(GOOD.replace("t,force", "t_ms,force"))
    assert read_csv(path, "force", "x2", dt=0.02).dt == 0.02
    assert read_csv(write(GOOD), "force", "x2", dt=0.10005).dt == 0.10005  # agrees within 0.1 %


@pytest.mark.parametrize("name", ["time", "time [s]", "Time (s)", "t [sec]"])
def test_the_time_may_state_its_unit(write, name):
    assert read_csv(write(GOOD.replace("t,force", f"{name},force")), "force", "x2").dt == pytest.approx(0.1)


def test_several_files_give_a_tuple(write):
    paths = [write(GOOD, "a.csv"), str(write(GOOD, "b.csv"))]
    a, b = read_csv(paths, "force", "x2")
    assert (a.name, b.name) == ("a", "b")
    assert isinstance(read_csv(paths[:1], "force", "x2"), tuple)


@pytest.mark.parametrize("fmt", ["%.17g", "%.9g", "%.7g", "%.6f", "%.4f"])
@given(rate=st.floats(20, 2000), m=st.integers(3, 400), start=st.sampled_from([0.0, 3.0, 120.0]))
def test_rounding_of_the_written_times_is_no_fault(fmt, rate, m, start):
    t = start + np.arange(m) / rate
    written = np.array([float(fmt % value) for value in t])
    coarse = 10.0 ** -int(fmt[2]) if fmt.endswith("f") else 10.0 ** (np.ceil(np.log10(t[-1] + 1)) - int(fmt[2:-1]))
    if coarse * rate > 0.05:  # coarser than a twentieth of a step is another story
        return
    step = step_of(written, "t", str)
    assert abs(step * rate - 1) <= 2 * coarse * rate / (m - 1) + 1e-11


def test_many_rows_are_read_at_once(tmp_path):
    m = 200_000
    rows = np.column_stack([np.arange(m) * 1e-3, np.sin(np.arange(m)), np.cos(np.arange(m))])
    path = tmp_path / "long.csv"
    block = "".join(f"{t:.3f},{u:.6f},{y:.6f}\n" for t, u, y in rows[:1000])
    with path.open("w") as file:  # the same thousand values again and again, with their own times
        file.write("t,u,y\n")
        values = [line.split(",", 1)[1] for line in block.splitlines(keepends=True)]
        file.writelines(f"{k / 1000:.3f},{values[k % 1000]}" for k in range(m))
    start = time.perf_counter()
    r = read_csv(path, "u", "y")
    assert time.perf_counter() - start < 3
    assert (len(r), r.dt) == (m, 0.001)
    np.testing.assert_allclose(r.y[:1000, 0], rows[:1000, 2], atol=1e-6)


def test_an_unknown_option_is_refused(write):
    with pytest.raises(InputError, match="'bogus' is not an option of a reader; the options are units, period"):
        read_csv(write(GOOD), inputs="force", outputs="x2", bogus=1)


# ---------------------------------------------------------------------------------------------- CSV that is refused

BAD_FILES = {
    "empty": ("", "rig.csv is empty"),
    "blank": ("\n \n", "rig.csv is empty"),
    "no data": ("t,force,x2\n\n", "header but no data"),
    "one row": ("t,force,x2\n0,1,2\n", "only one sample"),
    "no header": (GOOD.split("\n", 1)[1], "no header row: line 1 reads '0,1,10'"),
    "missing column": (GOOD.replace("force", "forc"), "no column 'force'; it has t, forc, x2"),
    "blanks between": (GOOD.replace(",", " "), "separate columns by commas"),
    "duplicate input": (
        GOOD.replace("x2", "force").replace("t,", "t,x2,").replace("\n0", "\n0,1"),
        "2 columns named 'force'",
    ),
    "duplicate time": (GOOD.replace("x2", "x2,t").replace("0\n", "0,0\n"), "2 columns named 't'"),
    "two times": (GOOD.replace("x2", "x2,time").replace("0\n", "0,0\n"), r"several time columns \(t, time\)"),
    "no time": (GOOD.replace("t,", "clock,"), "no time column; it has clock, force, x2"),
    "milliseconds": (GOOD.replace("t,", "t_ms,"), "'t_ms' is named as time in ms"),
    "unit in brackets": (GOOD.replace("t,", "Time [us],"), r"'Time \[us\]' is named as time in us"),
    "word": (GOOD.replace("0.2,3", "0.2,high"), "column 'force', line 4 reads 'high', which is not a number"),
    "underscore": (GOOD.replace("0.2,3,30", "0.2,3,3_0"), "column 'x2', line 4 reads '3_0'"),
    "decimal comma": (GOOD.replace(",", ";").replace("0.2;3", "0.2;3,5"), "line 4 reads '3,5'.* with a point"),
    "thousands": (GOOD.replace(",", ";").replace(".", ",").replace("40", "1,234,567"), "line 5 reads '1,234,567'"),
    "thousands and a point": (GOOD.replace(",", ";").replace("0;1;10", "0;1;1,234.5"), "line 2 reads '1,234.5'"),
    "decimal commas between commas": ("t,force,x2\n0,1,5,10\n0,1,2,20\n", "line 2 has 4 cell.*with points"),
    "units in milliseconds": (GOOD.replace("x2\n", "x2\nms,N,m\n"), r"'t \[ms\]' is named as time in ms"),
    "second row of names": (GOOD.replace("x2\n", "x2\ntime,in,out\n"), "column 'force', line 2 reads 'in'"),
    "row of words": (GOOD.replace("x2\n", "x2\nfirst,second,third\n"), "column 'force', line 2 reads 'second'"),
    "title, then a misspelt name": ("Recorder 7\n" + GOOD.replace("x2", "x3"), "no column 'x2'; it has t, force, x3"),
    "dates, then seconds": ("t,force,x2\n2024-05-01 10:00:00,1,2\n0.1,1,2\n", "line 3 reads '0.1', but .* begins"),
    "dates with and without zone": (
        "t,force,x2\n2024-05-01T10:00:00Z,1,2\n2024-05-01T10:00:01,1,2\n",
        "line 3 reads '2024-05-01T10:00:01', but",
    ),
    "date in an output": (GOOD.replace("0.2,3,30", "0.2,3,2024-05-01"), "line 4 reads '2024-05-01'"),
    "dates in a short row": ("t,force,x2\n2024-05-01,1\n", "line 2 has 2 cell.* names 3"),
    "pause": (GOOD + "9.0,1,1\n9.1,1,1\n", "line 6 comes 8.7 s after.*cut the record at such gaps"),
    "gap": (GOOD.replace("0.2,3,", "0.2,,"), "column 'force', line 4 is empty"),
    "nan": (GOOD.replace("30", "NaN"), "column 'x2', line 4 is NaN"),
    "inf": (GOOD.replace("30", "-inf"), "column 'x2', line 4 is -inf"),
    "nan time": (GOOD.replace("0.2,", "nan,"), "column 't', line 4 is nan"),
    "line after blank": (GOOD.replace("\n0.1", "\n\n\n0.1").replace("40", "x"), "column 'x2', line 7 reads 'x'"),
    "short row": (GOOD.replace("0.2,3,30", "0.2,3"), "line 4 has 2 cell.* names 3"),
    "long row": (GOOD.replace("0.2,3,30", "0.2,3,30,1"), "line 4 has 4 cell.* names 3"),
    "half written": (GOOD[:-6], "line 5 has 1 cell"),
    "backwards": (GOOD.replace("0.2,", "0.05,"), "line 4 is 0.05 s, after 0.1 s; time must increase"),
    "backwards after blank": (GOOD.replace("\n0.1", "\n\n\n0.1").replace("0.2,", "0.05,"), "line 6 is 0.05 s"),
    "standing": (GOOD.replace("0.2,", "0.1,"), "line 4 is 0.1 s, after 0.1 s"),
    "missing row": (GOOD.replace("0.1,2,20\n", ""), "not uniform: line 3 comes 0.2 s after"),
    "jitter": (GOOD.replace("0.2,", "0.203,"), "not uniform: line 4"),
    "binary": (bytes(range(256)) * 40, "not text"),
    "utf-16": (GOOD.encode("utf-16"), "UTF-16"),
    "json": ('{"t": [' + "1," * 200000 + "]}\n2", "rig.csv"),
}


@pytest.mark.parametrize("fault", BAD_FILES)
def test_refused(write, fault):
    content, words = BAD_FILES[fault]
    path = write(content)
    with pytest.raises(InputError, match=words) as caught:
        read_csv(path, inputs=["force"], outputs=["x2"])
    text = sentence(caught)
    assert str(path) in text
    assert len(text) < 400 + len(str(path)) or fault == "json"


def test_no_such_file_and_directory(tmp_path):
    for reader in (read_csv, read_mat, read_npz):
        with pytest.raises(InputError, match=r"no file .*gone\.csv"):
            reader(tmp_path / "gone.csv", "u", "y")
        with pytest.raises(InputError, match="is a directory"):
            reader(tmp_path, "u", "y")


@pytest.mark.parametrize("factor", [1e3, 1e6, 1 / 60])
def test_a_stated_step_finds_times_in_another_unit(write, factor):
    text = "t,u,y\n" + "".join(f"{k * 0.01 * factor!r},{k % 3},{k % 4}\n" for k in range(10))
    with pytest.raises(InputError, match="must be in seconds") as caught:
        read_csv(write(text), "u", "y", dt=0.01)
    assert f"a ratio of {factor:.4g}" in sentence(caught)


def test_a_file_may_have_no_input_and_no_output(write):
    decay = read_csv(write("t,angle [rad]\n0,1\n0.1,0.5\n0.2,0.2\n"), inputs=(), outputs="angle")
    assert (decay.inputs, decay.n_u, decay.units["angle"]) == ((), 0, "rad")
    times = ("t\n0\n0.5\n1\n", "t\n2024-05-01T10:00:00\n2024-05-01T10:00:00.5\n2024-05-01T10:00:01\n")
    for text in times:
        r = read_csv(write(text), inputs=(), outputs=())
        assert (len(r), r.dt, r.n_u, r.n_y) == (3, 0.5, 0, 0)
    with pytest.raises(InputError, match="for its times alone; name a time column"):
        read_csv(write("a,b\n1,2\n2,3\n"), inputs=(), outputs=(), dt=0.1)


def test_bad_columns_and_options_are_refused(write):
    path = write(GOOD)
    for options, words in [
        (dict(columns={"forc": "u"}), "none of the inputs force"),
        (dict(columns={"t": "clock"}), "no column 'clock' for the time"),
        (dict(columns={"x2": "y"}), "without such a sensor, remove it from the outputs, also from the simulator's"),
        (dict(columns={"force": "u"}), "no column 'u'; .*as in columns={'force': 'COLUMN'}"),
        (dict(dt=0.0), "above zero"),
        (dict(dt=float("nan")), "above zero"),
        (dict(inputs=(), outputs=(), resample=0.2), "for its times alone; name a time column"),
        (dict(inputs=[1]), "give the names of the columns"),
        (dict(columns=["force"]), "give columns={'NAME': 'COLUMN'}"),
        (dict(outputs="t"), "column 't' holds the time"),
        (dict(outputs="time", columns={"time": "t"}), "column 't' holds the time"),
        (dict(time_tolerance=float("nan")), "time_tolerance=nan was given"),
        (dict(time_tolerance=float("inf")), "time_tolerance=inf was given"),
        (dict(time_tolerance=-1e-3), "time_tolerance=-0.001 was given"),
    ]:
        with pytest.raises(InputError, match=words):
            read_csv(path, **(dict(inputs="force", outputs="x2") | options))
    with pytest.raises(InputError, match="give its path as text"):
        read_csv(3, "force", "x2")
    path = write(GOOD.replace("t,", "t_ms,"))
    with pytest.raises(InputError, match="time in ms"):
        read_csv(path, "force", "x2", columns={"t": "t_ms"})


def test_time_tolerance_is_stated():
    t = np.arange(100) * 0.01
    t[50] += 2e-5
    with pytest.raises(InputError, match=r"k50 .*0\.002 steps"):
        step_of(t, "t", lambda k: f"k{k}")
    assert step_of(t, "t", str, tolerance=0.01) == 0.01


@pytest.mark.parametrize(
    ("dt", "m", "begin"), [(0.01, 600, 0.0), (1e-3, 50000, 0.0), (1 / 120, 50000, 0.0), (0.02, 400, 2e4)]
)
def test_times_in_single_precision_are_uniform(tmp_path, dt, m, begin):
    t = (begin + dt * np.arange(m)).astype(np.float32)
    u = np.random.default_rng(0).standard_normal(m).astype(np.float32)
    np.savez(tmp_path / "single.npz", t=t, u=u, y=u)
    found = read(tmp_path / "single.npz", "u", "y")
    assert found.dt == pytest.approx(dt, rel=1e-4) and found.u.dtype == float
    with pytest.raises(InputError, match="not uniform"):
        step_of(np.delete(t, m // 2).astype(float), "t", str)


@pytest.mark.parametrize(("dt", "begin"), [(1e-3, 1e5), (1e-3, 2e4), (0.01, 2e6)])
def test_times_too_coarse_for_their_step_are_called_so(dt, begin):
    t = (begin + dt * np.arange(1000)).astype(np.float32).astype(float)
    with pytest.raises(InputError, match="too coarse for their step; give them as float64, or count them from the"):
        step_of(t, "t", str)


@given(m=st.integers(20, 200), share=st.floats(0.001, 0.5), seed=st.integers(0, 99))
def test_one_sample_off_is_always_found(m, share, seed):
    k = int(np.random.default_rng(seed).integers(1, m - 1))
    t = np.arange(m) * 0.0123456789012
    t[k] += share * 0.0123456789012
    with pytest.raises(InputError, match=f"not uniform: k{k} "):
        step_of(t, "t", lambda i: f"k{i}")


@given(m=st.integers(10, 300), step=st.sampled_from([0.1, 1.0, 4.0, 0.001, 1 / 120]), data=st.data())
def test_a_missing_sample_is_always_found(m, step, data):
    k = data.draw(st.integers(1, m - 2))
    t = np.round(np.arange(m) * step, 4)
    with pytest.raises(InputError, match=f"not uniform: k{k} "):
        step_of(np.delete(t, k), "t", lambda i: f"k{i}")


# ---------------------------------------------------------------------------------------------- .mat and .npz

T, U, Y = MATRIX.T


def save(path, **arrays):
    if path.suffix == ".mat":
        from scipy.io import savemat

        savemat(path, arrays)
    else:
        np.savez(path, **arrays)
    return path


KINDS = pytest.mark.parametrize(("suffix", "reader"), [(".mat", read_mat), (".npz", read_npz)])


@KINDS
def test_arrays(tmp_path, suffix, reader):
    path = save(tmp_path / f"rig{suffix}", t=T, force=U, x2=Y, note="any")
    for r in (reader(path, "force", "x2"), read(path, ["force"], ["x2"], dt=0.1)):
        assert np.array_equal(r.u, MATRIX[:, 1:2])
        assert np.array_equal(r.y, MATRIX[:, 2:])
        assert (r.dt, r.name) == (0.1, "rig")
    path = save(tmp_path / f"rows{suffix}", u=np.column_stack([U, Y]), y=Y[None, :])
    r = reader(path, "u", "y", dt=0.5, hold="zero")
    assert (r.inputs, r.outputs, r.u.shape, r.dt, r.hold) == (("u1", "u2"), ("y",), (4, 2), 0.5, "zero")
    assert len(reader([path, path], "u", "y", dt=0.5)) == 2


@KINDS
@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        (dict(t=T, force=U), "no column 'x2'"),
        (dict(force=U, x2=Y), "no time column"),
        (dict(time_ms=T, force=U, x2=Y), "time in ms"),
        (dict(t=T, force=U[:3], x2=Y), r"different lengths \(force 3, x2 4, t 4 samples\)"),
        (dict(t=T, force=U * [1, np.nan, 1, 1], x2=Y), "'force', sample 1 is nan"),
        (dict(t=T, force=U, x2=Y * 1j), "'x2' holds complex numbers"),
        (dict(t=T, force=np.zeros((4, 2, 2)), x2=Y), "'force' holds"),
        (dict(t=T**2, force=U, x2=Y), "not uniform: sample 1 "),
        (dict(t=-T, force=U, x2=Y), "must increase"),
    ],
)
def test_arrays_refused(tmp_path, suffix, reader, arrays, words):
    path = save(tmp_path / f"rig{suffix}", **arrays)
    with pytest.raises(InputError, match=words) as caught:
        reader(path, "force", "x2")
    assert str(path) in sentence(caught)


@KINDS
def test_damaged_files(tmp_path, write, suffix, reader):
    whole = save(tmp_path / f"whole{suffix}", t=T, force=U, x2=Y).read_bytes()
    for content in (b"", b"t,u,y\n0,1,2\n", bytes(range(256)), whole[: len(whole) // 2], whole[:200]):
        path = write(content, f"bad{suffix}")
        with pytest.raises(InputError) as caught:
            reader(path, "force", "x2")
        assert str(path) in sentence(caught)


def zipped(**members):
    """An .npz archive with members as bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy" if name != "plain" else "x2", content)
    return buffer.getvalue()


def npy(array, **options):
    buffer = io.BytesIO()
    np.save(buffer, array, **options)
    return buffer.getvalue()


def flagged(archive, local, central, value):
    """The archive with bytes of the zip headers of each member changed."""
    content = bytearray(archive)
    for head, offset in ((b"PK\3\4", local), (b"PK\1\2", central)):
        at = -1
        while (at := content.find(head, at + 1)) >= 0:
            content[at + offset] = value
    return bytes(content)


LONG = np.random.default_rng(0).normal(size=4)
WHOLE = zipped(t=npy(T), force=npy(U), x2=npy(LONG))
HUGE = npy(np.zeros(4)).replace(b"(4,), }", b"(999999999999999,), }")
OBJECTS = npy(np.array([{}] * 4, dtype=object), allow_pickle=True)
ODD_ARCHIVES = {
    "encrypted": (flagged(WHOLE, 6, 8, 1), "'force' cannot be read .*encrypted"),
    "unknown compression": (flagged(WHOLE, 8, 10, 99), "'force' cannot be read .*compression"),
    "later version": (flagged(WHOLE, 4, 6, 99), "cannot be read as a NumPy archive .*version"),
    "damaged member": (WHOLE[:60] + bytes(20) + WHOLE[80:], "'t' cannot be read"),
    "objects": (zipped(t=npy(T), force=npy(U), x2=OBJECTS), "'x2' cannot be read .*Python objects"),
    "no array": (zipped(t=npy(T), force=npy(U), plain=b"text"), "'x2' is not an array"),
    "larger than memory": (zipped(t=npy(T), force=npy(U), x2=HUGE), "'x2' cannot be read"),
    "half an array": (zipped(t=npy(T), force=npy(U), x2=npy(Y)[:-8]), "'x2' cannot be read"),
    "three axes": (zipped(t=npy(T), force=npy(U), x2=npy(np.ones((4, 2, 2)))), r"shape \(4, 2, 2\)"),
    "text": (zipped(t=npy(T), force=npy(U), x2=npy(np.array(["a"] * 4))), "'x2' holds text"),
    "single array": (npy(T), "it holds a single array"),
    "pickle": (pickle.dumps({"t": T}), "NumPy archive .*Python objects"),
}


@pytest.mark.parametrize("fault", ODD_ARCHIVES)
def test_odd_archives_are_refused_in_one_sentence(write, fault):
    content, words = ODD_ARCHIVES[fault]
    with pytest.raises(InputError, match=words) as caught:
        read_npz(write(content, "odd.npz"), "force", "x2")
    assert "odd.npz" in sentence(caught)


def test_an_odd_member_that_is_not_used_does_no_harm(write):
    path = write(zipped(t=npy(T), force=npy(U), x2=npy(Y), notes=OBJECTS), "rig.npz")
    assert np.array_equal(read_npz(path, "force", "x2").y, MATRIX[:, 2:])


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (csc_array(Y[:, None]), "'x2' is a sparse matrix"),
        ({"a": 1.0}, "'x2' holds a struct"),
        (np.array([Y, U[:2]], dtype=object), "'x2' holds a cell array"),
        ("text", "'x2' holds text"),
    ],
)
def test_odd_matlab_variables_are_refused_in_one_sentence(tmp_path, value, words):
    path = save(tmp_path / "odd.mat", t=T, force=U, x2=value)
    with pytest.raises(InputError, match=words) as caught:
        read_mat(path, "force", "x2")
    assert "odd.mat" in sentence(caught)


@pytest.mark.parametrize("suffix", [".csv", ".mat", ".npz"])
def test_pipes_and_links_to_nowhere_are_refused(tmp_path, suffix):
    pipe, loop = tmp_path / f"pipe{suffix}", tmp_path / f"loop{suffix}"
    os.mkfifo(pipe)
    loop.symlink_to(loop)
    with pytest.raises(InputError, match="is a pipe or a device"):
        read(pipe, "force", "x2")
    with pytest.raises(InputError, match="a link that leads nowhere"):
        read(loop, "force", "x2")


def test_matlab_7_3(write):
    head = b"MATLAB 7.3 MAT-file".ljust(116) + b"\0" * 8 + b"\0\2IM" + b"\x89HDF\r\n\x1a\n" + b"\0" * 600
    with pytest.raises(InputError, match=r"version 7\.3"):
        read_mat(write(head, "new.mat"), "u", "y")


def test_read_by_suffix(write, tmp_path):
    npz = save(tmp_path / "b.npz", t=T, force=U, x2=Y)
    a, b = read([write(GOOD, "a.TXT"), npz], "force", "x2")
    assert np.array_equal(a.u, b.u)
    with pytest.raises(InputError, match=r"suffix '\.xlsx'; give a file with one of \.csv"):
        read(write(GOOD, "a.xlsx"), "force", "x2")
    with pytest.raises(InputError, match="no file"):
        read(tmp_path / "gone.xlsx", "force", "x2")


@pytest.mark.parametrize("suffix", [".csv", ".mat", ".npz"])
def test_outputs_may_be_left_out(tmp_path, write, suffix):
    path = write(GOOD) if suffix == ".csv" else save(tmp_path / f"rig{suffix}", t=T, force=U, x2=Y)
    r = read(path, "force", ())
    assert (r.inputs, r.outputs, r.u.shape, r.y.shape) == (("force",), (), (4, 1), (4, 0))
    assert set(column_names(path)) >= {"t", "force", "x2"}


def test_one_column_is_not_input_and_output(write):
    with pytest.raises(InputError, match=r"rig\.csv: column 'x2' is given both for an input and"):
        read_csv(write(GOOD), "force", "x2", columns={"force": "x2"})


def test_times_as_written(tmp_path, write):
    text = GOOD.replace("0.1,", "1.00e-1,").replace("\n0.2", "\n\n0.20")
    assert written_times(write(text)) == ["0", "1.00e-1", "0.20", "0.3"]
    assert written_times(write(GOOD.replace("t,", "clock,")), {"t": "clock"})[1] == "0.1"
    assert written_times(write(GOOD.replace("t,", "clock,"))) is None
    assert written_times(save(tmp_path / "a.npz", t=T, force=U)) == ["0.0", "0.1", "0.2", "0.3"]
    with pytest.raises(InputError, match="suffix"):
        written_times(write(GOOD, "a.xlsx"))


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_numbers_too_large_to_square_are_refused(tmp_path, write, suffix):
    path = (
        write(GOOD.replace("30", "1e308")) if suffix == ".csv" else save(tmp_path / "a.npz", t=T, force=U, x2=Y * 1e200)
    )
    with pytest.raises(InputError, match=r"x2.*up to 1e\+100") as caught:
        read(path, "force", "x2")
    sentence(caught)


def test_a_column_may_say_its_unit_in_brackets(tmp_path):
    path = tmp_path / "rig.csv"
    path.write_text("time,road [m],speed (m/s),speed_ref\n0,1,2,3\n0.1,4,5,6\n0.2,7,8,9\n")
    r = read_csv(path, inputs="road", outputs="speed", units={"road": "mm"})
    assert np.array_equal(r.y[:, 0], [2, 5, 8]) and dict(r.units) == {"road": "mm", "speed": "m/s"}
    with pytest.raises(InputError, match=r"columns=\{'spee': 'speed"):
        read_csv(path, inputs="road", outputs="spee")


def test_numbers_that_may_have_thousands_separators_are_refused(write):
    with pytest.raises(InputError, match="line 3 reads '1,001'"):
        read_csv(write("u;y\n999;1\n1,001;2\n"), inputs="u", outputs="y", dt=1.0)


def test_commas_in_a_text_tell_nothing_of_the_numbers(write):
    rows = ["t;u;y;remark", *(f"{i};{i},5;1,{i:03d};ok, it moves" for i in range(3))]
    assert list(read_csv(write("\n".join(rows)), "u", "y").u[:, 0]) == [0.5, 1.5, 2.5]
    with pytest.raises(InputError, match="line 2 reads '1,000'"):
        read_csv(write("\n".join(rows).replace(",5", "")), "u", "y")


def test_units_are_given_by_name(write):
    with pytest.raises(InputError, match="units='mm' was given; give units="):
        read_csv(write(GOOD), "force", "x2", units="mm")


def test_a_step_that_makes_too_many_samples_is_refused(write):
    path = write(GOOD)
    for resample in (
        lambda: read_csv(path, "force", "x2", resample=1e-12),
        lambda: read_csv(path, "force", "x2").resample(1e-12),
    ):
        with pytest.raises(InputError, match=r"a step of 1e-12 s makes more than 1e\+08 samples"):
            resample()


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are bytes there")
def test_a_name_on_disk_that_is_no_text_becomes_one(tmp_path):
    path = os.fsdecode(os.fsencode(tmp_path / "f") + b"\xff.csv")
    with open(path, "w") as file:
        file.write(GOOD)
    assert read_csv(path, "force", "x2").name == "f?"
