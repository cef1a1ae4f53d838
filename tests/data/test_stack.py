"""`pilfr simulate` on several records in one array."""

import re

import numpy as np
import pytest

from pilfr_casadi.cli import app as cli
from pilfr_casadi.data import Recording
from pilfr_casadi.identify import fit
from pilfr_casadi.models import PILFR
from pilfr_casadi.optimise import GaussNewton

N = 60


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    rng = np.random.default_rng(0)
    u = rng.normal(size=(200, 2))
    structure = PILFR(1, offset=False)
    start = {"A": 0.9, "B_u": [[1.0, 0.5]], "C_y": [[1.0], [2.0]]}
    y = np.column_stack([u[:, 0], u[:, 1]])
    found = fit(structure, Recording(u, y, 0.5, initial="zero"), start=start, solver=GaussNewton(max_iterations=2))
    path = tmp_path_factory.mktemp("stack") / "model.json"
    found.save(path)
    return path, found


def arrays(seed=1):
    u = np.random.default_rng(seed).normal(size=(N, 2, 3, 2))
    u[..., 1] = u[..., 0]  # two periods of each realization
    return u


PERIODIC = ["--initial", "periodic", "--period", str(N), "--dt", "0.5"]


@pytest.mark.parametrize("kind", [".npz", ".npy"])
def test_every_record_is_simulated_in_its_own_steady_state(model, tmp_path, kind, capsys):
    path, found = model
    u, data, out = arrays(), tmp_path / f"data{kind}", tmp_path / f"out{kind}"
    np.save(data, u) if kind == ".npy" else np.savez(data, u=u)
    assert cli.main(["simulate", str(path), str(data), "--out", str(out), *PERIODIC]) == 0
    y = np.load(out) if kind == ".npy" else np.load(out)["y"]
    assert y.shape == (N, 2, 3, 2)
    for r in range(3):
        alone = Recording(u[:, :, r, 0], np.empty((N, 0)), 0.5, period=N, initial="periodic")
        np.testing.assert_array_equal(y[:, :, r, 0], found.simulate(alone))
        np.testing.assert_array_equal(y[:, :, r, 0], y[:, :, r, 1])
    assert "simulated outputs" in capsys.readouterr().out


def test_measured_records_are_judged_and_a_table_is_written(model, tmp_path, capsys):
    path, _ = model
    u, data, out = arrays(), tmp_path / "data.npz", tmp_path / "out.csv"
    np.savez(data, u=u, y=u)
    assert cli.main(["simulate", str(path), str(data), "--out", str(out), *PERIODIC]) == 0
    assert "mean over 6 records" in capsys.readouterr().out
    table = np.genfromtxt(out, delimiter=",", names=True)
    assert table.dtype.names == ("record", "t", "u1", "u2", "y1", "y2")
    assert len(table) == 6 * N and table["record"][-1] == 6 and table["t"][N - 1] == 0.5 * (N - 1)


def test_a_record_with_a_constant_output_does_not_stop_the_others(model, tmp_path, capsys):
    path, _ = model
    u, data, out = arrays(), tmp_path / "data.npz", tmp_path / "out.npz"
    y = u.copy()
    y[..., 0, 0] = 1.0
    np.savez(data, u=u, y=y)
    assert cli.main(["simulate", str(path), str(data), "--out", str(out), *PERIODIC]) == 0
    said = capsys.readouterr().out
    assert "no NRMSE on data [0, 0]" in said and "mean over 5 records" in said and out.exists()


@pytest.mark.parametrize(
    "arguments, content, words",
    [
        (PERIODIC[:4], {"u": arrays()}, "no time column; state the step"),
        (["--initial", "estimate", "--dt", "0.5"], {"u": arrays()}, "needs measured outputs"),
        (PERIODIC, {"u": arrays()[:, :1]}, r"expected \(samples, 2 channels"),
        (PERIODIC, {"u": arrays(), "y": arrays()[:50]}, "array of the outputs has the shape"),
        (PERIODIC, {"u": arrays() * np.nan}, "not finite numbers"),
    ],
)
def test_one_sentence_where_a_stack_cannot_be_used(model, tmp_path, capsys, arguments, content, words):
    data = tmp_path / "data.npz"
    np.savez(data, **content)
    code = cli.main(["simulate", str(model[0]), str(data), "--out", str(tmp_path / "out.npz"), *arguments])
    assert code == 2
    error = capsys.readouterr().err
    assert re.search(words, error) and "Traceback" not in error


def test_an_archive_is_no_table_of_a_simulator(tmp_path, capsys):
    u, data, simulator = np.zeros(N), tmp_path / "data.npz", tmp_path / "rig.py"
    np.savez(data, u=u, y=u)
    simulator.write_text(
        "from pilfr_casadi import Simulator\n"
        "simulator = Simulator(lambda x, u: {'x': u.u - x.x}, lambda x: {'y': x.x}, states='x', inputs='u')\n"
    )
    for suffix, code in ((".npz", 2), (".npy", 2), (".csv", 0)):
        out = tmp_path / f"out{suffix}"
        assert cli.main(["simulate", str(simulator), str(data), "--out", str(out), "--dt", "0.5"]) == code
        assert out.exists() == (code == 0)
    assert capsys.readouterr().err.count("give a name that ends in .csv") == 2


def test_a_damaged_array(model, tmp_path, capsys):
    data = tmp_path / "data.npy"
    data.write_bytes(b"nothing")
    assert cli.main(["simulate", str(model[0]), str(data), "--out", str(tmp_path / "out.csv"), *PERIODIC]) == 2
    assert "cannot be read as a NumPy array" in capsys.readouterr().err
