"""The command line: whole runs on small recordings; bad input gets one plain sentence and exit status 2."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pilfr_casadi.cli import main


def write_csv(path, seed=0, m=600, **columns):
    """A recording of a play behind a first-order lag, with columns replaced or added."""
    rng = np.random.default_rng(seed)
    u = np.cumsum(rng.standard_normal(m))
    u -= np.linspace(u[0], u[-1], m)
    q, x, y = 0.0, 0.0, []
    for value in u:
        q = max(value - 1.0, min(value + 1.0, q))
        y.append(x + 0.3 * q)
        x = 0.8 * x + 0.2 * q
    data = {"t": np.arange(m) * 0.01, "u": u, "y": np.array(y) + 1e-3 * rng.standard_normal(m), **columns}
    rows = zip(*data.values(), strict=True)
    path.write_text(",".join(data) + "\n" + "\n".join(",".join(map(str, row)) for row in rows) + "\n")
    return path


@pytest.fixture
def train(tmp_path):
    return write_csv(tmp_path / "train.csv")


def run(capsys, *arguments):
    """Exit status, stdout and stderr of a command run in this process."""
    try:
        status = main([str(a) for a in arguments])
    except SystemExit as stop:
        status = stop.code
    out = capsys.readouterr()
    return status, out.out, out.err


def fit_arguments(train, tmp_path, *more):
    names = ("--inputs", "u", "--outputs", "y", "--initial", "zero")
    return ("fit", train, *names, "--nx", 1, "--operators", 3, "--starts", 2, "--out", tmp_path / "out", *more)


def refused(capsys, *arguments, says):
    """Assert the contract on bad input: status 2, one sentence on stderr that says it, no traceback."""
    status, _, err = run(capsys, *arguments)
    assert status == 2
    assert err.startswith("pilfr: ") and err.count("\n") == 1 and "Traceback" not in err
    for word in says if isinstance(says, tuple) else (says,):
        assert word in err, err


def test_fit_simulate_and_export_run_end_to_end(capsys, tmp_path, train):
    test = write_csv(tmp_path / "test.csv", seed=1)
    status, out, _ = run(capsys, *fit_arguments(train, tmp_path, "--test", test))
    assert status == 0
    assert "Converged" in out and "NRMSE on test" in out
    model = tmp_path / "out" / "model.json"
    assert json.loads(model.read_text())["format"]
    assert "<html" in (tmp_path / "out" / "report.html").read_text().lower()
    simulated = tmp_path / "sim.csv"
    status, out, _ = run(capsys, "simulate", model, test, "--initial", "zero", "--out", simulated)
    assert status == 0
    nrmse = float(out.split("NRMSE on test: ")[1].split()[0])
    table = np.genfromtxt(simulated, delimiter=",", names=True)
    truth = np.genfromtxt(test, delimiter=",", names=True)
    assert table.dtype.names == ("t", "u", "y")
    assert np.sqrt(np.mean((table["y"] - truth["y"]) ** 2)) / np.std(truth["y"]) == pytest.approx(nrmse, abs=1e-4)
    assert nrmse < 0.05
    status, _, _ = run(capsys, "export", model, "--out", tmp_path / "model.casadi")
    assert status == 0
    import casadi as ca

    f = ca.Function.load(str(tmp_path / "model.casadi"))
    assert f.name_in() == ["x", "u"] and f.name_out() == ["x_next", "y"]


def test_a_saved_model_can_be_fitted_further(capsys, tmp_path, train):
    assert run(capsys, *fit_arguments(train, tmp_path))[0] == 0
    model = tmp_path / "out" / "model.json"
    status, out, _ = run(capsys, *fit_arguments(train, tmp_path, "--from", model))
    assert status == 0 and "Converged" in out


BAD_FILES = {
    "missing file": (None, ("nowhere.csv",)),
    "missing column": ({}, ("'force'", "u, y")),
    "not a number": ({"u": np.array(["1.0"] * 299 + ["abc"] + ["2.0"] * 300)}, ("abc", "301")),
    "nan": ({"y": np.r_[np.ones(100), np.nan, np.ones(499)]}, ("nan", "102")),
    "non-uniform time": ({"t": np.r_[np.arange(300), np.arange(300) + 300.4] * 0.01}, ("t", "uniform")),
    "constant input": ({"u": np.ones(600)}, ("never changes",)),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_recordings_are_refused(capsys, tmp_path, case):
    columns, says = BAD_FILES[case]
    path = tmp_path / "nowhere.csv" if columns is None else write_csv(tmp_path / "train.csv", **columns)
    arguments = list(fit_arguments(path, tmp_path))
    if case == "missing column":
        arguments[arguments.index("u")] = "force"
    refused(capsys, *arguments, says=says)
    assert not (tmp_path / "out" / "model.json").exists()


def test_time_in_milliseconds_is_refused(capsys, tmp_path):
    path = tmp_path / "train.csv"
    write_csv(path)
    path.write_text(path.read_text().replace("t,u,y", "t_ms,u,y", 1))
    refused(capsys, *fit_arguments(path, tmp_path), says=("t_ms", "seconds"))
    write_csv(path, t=np.arange(600) * 10.0)
    refused(capsys, *fit_arguments(path, tmp_path, "--dt", 0.01), says="step")


def test_mismatched_recordings_are_refused(capsys, tmp_path, train):
    other = write_csv(tmp_path / "other.csv", seed=2, t=np.arange(600) * 0.02)
    refused(capsys, *fit_arguments(train, tmp_path)[:2], other, *fit_arguments(train, tmp_path)[2:], says="0.02")


def test_too_few_samples_for_the_order(capsys, tmp_path):
    path = write_csv(tmp_path / "train.csv", m=40)
    refused(capsys, *fit_arguments(path, tmp_path, "--nx", 8), says=("samples", "smaller model"))


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--bound", "w=2:1"), "infeasible"),
        (("--bound", "w=2"), "LOW:HIGH"),
        (("--bound", "nothing=0:1"), "nothing"),
        (("--fix", "D_yu=a"), "not a number"),
        (("--fix", "Q=0"), "'Q'"),
        (("--nx", "-1"), "states"),
        (("--operators", "-2"), "--operators"),
        (("--starts", "0"), "starts"),
    ],
)
def test_bad_options_are_refused(capsys, tmp_path, train, options, says):
    refused(capsys, *fit_arguments(train, tmp_path, *options), says=says)


def test_a_test_on_training_data_is_refused(capsys, tmp_path, train):
    refused(capsys, *fit_arguments(train, tmp_path, "--test", train), says="twice")


def test_a_recording_is_never_overwritten(capsys, tmp_path, train):
    assert run(capsys, *fit_arguments(train, tmp_path))[0] == 0
    before = train.read_text()
    refused(capsys, "simulate", tmp_path / "out" / "model.json", train, "--out", train, says="overwrite")
    assert train.read_text() == before


def test_a_folder_that_cannot_be_written(capsys, tmp_path, train):
    (tmp_path / "file").write_text("kept")
    refused(capsys, *fit_arguments(train, tmp_path, "--out", tmp_path / "file" / "below"), says="--out")
    assert (tmp_path / "file").read_text() == "kept"


def test_unusable_model_files_are_refused_and_left_alone(capsys, tmp_path, train):
    assert run(capsys, *fit_arguments(train, tmp_path))[0] == 0
    good = (tmp_path / "out" / "model.json").read_text()
    for name, text in {
        "half": good[: len(good) // 2],
        "empty": "",
        "other": '{"format": "something"}',
        "list": "[1, 2]",
    }.items():
        path = tmp_path / f"{name}.json"
        path.write_text(text)
        refused(capsys, "simulate", path, train, "--out", tmp_path / "sim.csv", says=f"{name}.json")
        assert path.read_text() == text and not (tmp_path / "sim.csv").exists()
    refused(capsys, "simulate", tmp_path / "nowhere.json", train, "--out", tmp_path / "sim.csv", says="nowhere.json")


def test_an_unstable_start_is_refused(capsys, tmp_path, train):
    assert run(capsys, *fit_arguments(train, tmp_path))[0] == 0
    path = tmp_path / "out" / "model.json"
    document = json.loads(path.read_text())
    document["parameters"]["A"]["value"] = [[1e6]]
    wild = tmp_path / "wild.json"
    wild.write_text(json.dumps(document))
    refused(capsys, *fit_arguments(train, tmp_path, "--from", wild), says="diverges")


def test_an_interrupted_run_writes_the_best_so_far(tmp_path):
    path = write_csv(tmp_path / "train.csv", m=20000)
    command = [sys.executable, "-c", "import sys; from pilfr_casadi.cli import main; sys.exit(main(sys.argv[1:]))"]
    command += [
        "fit",
        str(path),
        "--inputs",
        "u",
        "--outputs",
        "y",
        "--nx",
        "4",
        "--operators",
        "20",
        "--starts",
        "500",
    ]
    process = subprocess.Popen(
        [*command, "--out", str(tmp_path / "out")],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(timeout=12)
        process.send_signal(2)
        out, _ = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130
    assert "interrupted" in out
    assert json.loads(Path(tmp_path / "out" / "model.json").read_text())["parameters"]["A"]
