"""Recordings in Parquet and MDF files, and one sentence for what cannot be used there."""

import gc
import sys
import warnings

import numpy as np
import pytest

from pilfr_casadi import InputError, read, read_csv
from pilfr_casadi.data import column_names

T, FORCE, X2 = 0.1 * np.arange(5), np.array([1.0, 2, 3, 4, 5]), np.array([10.0, 20, 30, 40, 50])


@pytest.fixture
def parquet(tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    def write(**columns):
        path = tmp_path / "rig.parquet"
        parquet.write_table(pyarrow.table(columns), path)
        return path

    return write


@pytest.fixture
def mdf(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        asammdf = pytest.importorskip("asammdf")

    def write(*groups, name="rig.mf4"):
        with asammdf.MDF(version="4.10") as file:
            for t, channels in groups:
                signals = [(k, *((v, "") if isinstance(v, np.ndarray) else v)) for k, v in channels.items()]
                file.append([asammdf.Signal(samples=v, timestamps=t, name=k, unit=unit) for k, v, unit in signals])
            path = tmp_path / name
            file.save(path, overwrite=True)
        return path

    return write


def refused(path, says, inputs="force", outputs="x2"):
    with pytest.raises(InputError) as caught:
        read(path, inputs, outputs)
    text = str(caught.value)
    assert "\n" not in text and text.endswith(".") and str(path) in text
    assert says in text, text


def same(r):
    assert r.dt == pytest.approx(0.1) and (r.inputs, r.outputs, r.name) == (("force",), ("x2",), "rig")
    assert np.array_equal(r.u[:, 0], FORCE) and np.array_equal(r.y[:, 0], X2)


def test_a_parquet_file_is_read(parquet):
    path = parquet(t=T, force=FORCE.astype(int), x2=X2, note=list("abcde"))
    same(read(path, "force", "x2"))
    assert column_names(path) == ("t", "force", "x2", "note")
    named = read(parquet(**{"time": T, "force": FORCE, "x.2": X2}), "force", "x.2")
    assert np.array_equal(named.y[:, 0], X2)


def test_unusable_parquet_files_are_refused(parquet, tmp_path):
    refused(parquet(t=T, force=FORCE), "has no column 'x2'")
    refused(parquet(t=T, force=FORCE, x2=list("abcde")), "'x2' holds")
    refused(parquet(t=T, force=[1.0, None, 3.0, 4.0, 5.0], x2=X2), "'force', sample 1 is nan")
    damaged = tmp_path / "damaged.parquet"
    damaged.write_bytes(b"PAR1 and no more")
    refused(damaged, "cannot be read as a Parquet file")


def test_an_mdf_file_is_read(mdf):
    path = mdf((T, {"force": FORCE, "x2": X2}), (T[::2], {"slow": FORCE[::2]}))
    same(read(path, "force", "x2"))
    assert set(column_names(path)) == {"t", "force", "x2", "slow"}
    assert read(path, "force", "x2").units == {}


def test_an_mdf_file_states_units(mdf):
    r = read(mdf((T, {"force": (FORCE, "N"), "x2 [m]": (X2, "mm")})), "force", "x2 [m]")
    assert r.units == {"force": "N", "x2 [m]": "mm"}


def test_mdf_channels_of_several_rates_are_brought_to_one_step(mdf):
    fast, slow = np.arange(2000) * 1e-3, 0.0123 + np.arange(390) * 5e-3
    path = mdf((fast, {"force": np.sin(20 * fast)}), (slow, {"x2": np.cos(20 * slow)}))
    r = read(path, "force", "x2", resample=2e-3)
    t = slow[0] + r.t
    assert r.dt == 2e-3 and slow[-1] - t[-1] < 2e-3
    np.testing.assert_allclose(r.u[20:-20, 0], np.sin(20 * t[20:-20]), atol=1e-3)
    np.testing.assert_allclose(r.y[20:-20, 0], np.cos(20 * t[20:-20]), atol=1e-3)


def test_unusable_mdf_files_are_refused(mdf, tmp_path):
    path = mdf((T, {"force": FORCE}), (T[::2], {"slow": FORCE[::2]}))
    refused(path, "has no column 'x2'")
    refused(
        path,
        "'force' and 'slow' have different times (5 and 3 samples); bring all channels to one step",
        outputs="slow",
    )
    refused(mdf((T**2, {"force": FORCE, "x2": X2})), "is not uniform")
    damaged = tmp_path / "damaged.mf4"
    damaged.write_bytes(b"MDF and no more")
    refused(damaged, "cannot be read as an MDF file")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.98])
def test_a_file_that_was_cut_short_is_refused_without_a_traceback(mdf, tmp_path, capfd, share):
    whole = mdf((T, {"force": FORCE, "x2": X2})).read_bytes()
    damaged = tmp_path / "damaged.mf4"
    damaged.write_bytes(whole[: int(share * len(whole))])
    refused(damaged, "cannot be read as an MDF file")
    gc.collect()
    assert capfd.readouterr().err == ""


def test_durations_in_a_parquet_file_are_times(parquet):
    same(read(parquet(t=(1e6 * T).astype("timedelta64[us]"), force=FORCE, x2=X2), "force", "x2"))


@pytest.mark.parametrize(
    ("name", "package", "extra"), [("a.parquet", "pyarrow", "parquet"), ("a.mf4", "asammdf", "mdf")]
)
def test_a_missing_package_is_named(monkeypatch, tmp_path, name, package, extra):
    monkeypatch.setitem(sys.modules, package, None)
    (tmp_path / name).write_bytes(b"x")
    refused(tmp_path / name, f"install pilfr-casadi[{extra}]")


@pytest.mark.parametrize("name", ["none.parquet", "none.mf4"])
def test_a_missing_file_is_named(tmp_path, name):
    refused(tmp_path / name, "")


@pytest.mark.parametrize("suffix", [".mdf", ".mf4", ".parquet"])
def test_a_binary_file_given_as_csv_names_its_reader(tmp_path, suffix):
    path = tmp_path / f"rig{suffix}"
    path.write_bytes(b"\x00\x01" * 50)
    with pytest.raises(InputError, match=r"binary data\); read it with pilfr\.read"):
        read_csv(path, "u", "y")
