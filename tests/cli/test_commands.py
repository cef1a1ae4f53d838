"""The command line: whole runs on small recordings; bad input gets one plain sentence and exit status 2."""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from command_line import fit_arguments, refused, run, sentence, write_csv

import pilfr_casadi as pilfr
from pilfr_casadi._base import ordered_digest
from pilfr_casadi.cli import main, models, name_options
from pilfr_casadi.identify import multistart
from pilfr_casadi.optimise import GaussNewton


@pytest.fixture
def train(tmp_path):
    return write_csv(tmp_path / "train.csv")


@pytest.fixture(scope="module")
def fitted(tmp_path_factory, without_drawing):
    """A folder with recordings, the model of `pilfr fit` in out/, and its words in said.txt."""
    folder = tmp_path_factory.mktemp("fitted")
    train, test = write_csv(folder / "train.csv"), write_csv(folder / "test.csv", seed=1)
    with (folder / "said.txt").open("w") as said, contextlib.redirect_stdout(said), without_drawing():
        assert main([str(a) for a in fit_arguments(train, folder, "--test", test)]) == 0
    return folder


@pytest.fixture
def model(fitted, tmp_path):
    """A copy of the model that a test may change."""
    return Path(shutil.copy(fitted / "out" / "model.json", tmp_path / "model.json"))


def test_fit_simulate_and_export_run_end_to_end(capsys, tmp_path, fitted):
    out, test = (fitted / "said.txt").read_text(), fitted / "test.csv"
    assert "Converged" in out and "NRMSE on test" in out
    assert f"training data: {fitted / 'train.csv'}, 600 samples, step 0.01 s, inputs u, outputs y\n" in out
    assert "order: 1, as given" in out
    model = fitted / "out" / "model.json"
    assert json.loads(model.read_text())["format"]
    assert "<html" in (fitted / "out" / "report.html").read_text().lower()
    simulated = tmp_path / "sim.csv"
    status, out, _ = run(capsys, "simulate", model, test, "--initial", "zero", "--out", simulated)
    assert status == 0
    nrmse = float(out.split("NRMSE on test: ")[1].split()[0])
    table = np.genfromtxt(simulated, delimiter=",", names=True)
    truth = np.genfromtxt(test, delimiter=",", names=True)
    assert table.dtype.names == ("t", "u", "y")
    assert np.sqrt(np.mean((table["y"] - truth["y"]) ** 2)) / np.std(truth["y"]) == pytest.approx(nrmse, abs=1e-4)
    assert nrmse < 0.05
    near = tmp_path / "near.csv"
    rows = np.column_stack([table["t"], table["u"], table["y"] * (1 + 2e-5)])
    np.savetxt(near, rows, delimiter=",", header="t,u,y", comments="", fmt="%.12g")
    _, out, _ = run(capsys, "simulate", model, near, "--initial", "zero", "--out", tmp_path / "again.csv")
    assert re.search(r"NRMSE on near: 2(\.\d\d?)?e-05\n", out)
    status, _, _ = run(capsys, "export", model, "--out", tmp_path / "model.casadi")
    assert status == 0
    f = ca.Function.load(str(tmp_path / "model.casadi"))
    assert f.name_in() == ["x", "u"] and f.name_out() == ["x_next", "y"]


@pytest.mark.usefixtures("blank_figures")
def test_fit_prints_its_stages_in_plain_lines(capsys, tmp_path, train, monkeypatch):
    """Piped, each line has the stage, what is done of it, the best error so far, which never rises, and the time."""
    for pause in ("NEW_STAGE_LINE", "LINE"):
        monkeypatch.setattr(f"pilfr_casadi._base.progress.{pause}", 0.0)
    status, _, err = run(capsys, *fit_arguments(train, tmp_path))
    assert status == 0 and "\r" not in err and "\x1b" not in err
    count, best = r"( (?P<done>\d+)/(?P<total>\d+))?", r"(, best NRMSE (?P<best>[\d.]+))?"
    line = re.compile(rf"(?P<stage>\D+?){count}{best}, ((?P<minutes>\d+) min )?(?P<seconds>\d+) s")
    told = [line.fullmatch(text) for text in err.splitlines()]
    assert len(told) > 5 and all(told), err
    stages = list(dict.fromkeys(match["stage"] for match in told))
    assert stages[0] == "building the engine" and stages[-1] == "writing the report" and len(stages) >= 4, stages
    assert any(match["total"] and int(match["done"]) == int(match["total"]) for match in told)
    best = [float(match["best"]) for match in told if match["best"]]
    assert best and best == sorted(best, reverse=True)
    spent = [60 * int(m["minutes"] or 0) + int(m["seconds"]) for m in told if m["stage"] != "writing the report"]
    assert spent == sorted(spent)


@pytest.mark.usefixtures("blank_figures")
def test_a_saved_model_can_be_fitted_further(capsys, tmp_path, train, model):
    names = ("--inputs", "u", "--outputs", "y", "--initial", "zero")
    further = ("fit", train, *names, "--from", model, "--out", tmp_path / "further")
    status, out, _ = run(capsys, *further)
    assert status == 0 and "Converged" in out
    for option, value in (("--nx", 2), ("--operators", 20), ("--fix", "D_yu=0"), ("--bound", "w=0:1"), ("--seed", 0)):
        refused(capsys, *further, option, value, says=(option, "--from"))
    swapped = [{"u": "y", "y": "u"}.get(a, a) for a in (*further, "--overwrite")]
    refused(capsys, *swapped, says=("--inputs y", "the model's inputs are u"))


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
    assert "engine" not in run(capsys, *fit_arguments(path, tmp_path, "--nx", 8))[1]  # refused before compiling


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--bound", "w=2:1"), "infeasible"),
        (("--bound", "w=2"), "LOW:HIGH"),
        (("--bound", "w="), "LOW:HIGH"),
        (("--bound", "w=:"), "LOW:HIGH, of which one may be left out"),
        (("--bound", "nothing=0:1"), "nothing"),
        (("--fix", "D_yu=a"), "not a number"),
        (("--fix", "D_yu=nan"), "--fix D_yu=nan was given, and 'nan' is not a number"),
        (("--fix", "D_yu=-inf"), "--fix D_yu=-inf was given; give a finite number"),
        (("--bound", "w=nan:1"), "--bound w=nan:1 was given, and 'nan' is not a number"),
        (("--fix", "Q=0"), "'Q'"),
        (("--nx", "-1"), "--nx -1 was given; give a whole number from 0 to 1000"),
        (("--operators", "-2"), "--operators"),
        (("--starts", "0"), "starts"),
        (("--seed", "-1"), "--seed"),
        (("--channels", "0"), "--channels"),
        (("--operators", "999999999"), "--operators 999999999 was given; give a whole number from 0 to 10000"),
        (("--channels", "99999999"), "--channels 99999999 was given; give a whole number from 1 to 100"),
        (("--starts", "9" * 40), "--starts"),
        (("--seed", "9" * 40), "--seed"),
        (("--workers", "9" * 9), "--workers"),
        (("--skip", "9" * 40), "--skip"),
        (("--period", "9" * 5000), "--period"),
        (("--outputs", "t"), "t"),
        (("--time-tolerance", "nan"), "--time-tolerance nan"),
        (("--fix", "D_yu=0", "--fix", "D_yu=1"), "twice"),
        (("--time-limit", "0"), "--time-limit"),
        (("--period", "1"), "--period 1"),
        (("--skip", "600"), "--skip 600"),
        (("--dt", "0"), "--dt 0"),
        (("--dt", "0.02"), "--dt 0.02"),
        (("--column", "u=force"), "--column u=COLUMN"),
        (("--column", "u=y"), "both for an input and for an output"),
    ],
)
def test_bad_options_are_refused(capsys, tmp_path, train, options, says):
    refused(capsys, *fit_arguments(train, tmp_path, *options), says=says)


def test_a_test_on_training_data_is_refused(capsys, tmp_path, train):
    refused(capsys, *fit_arguments(train, tmp_path, "--test", train), says="twice")


def test_a_recording_is_never_overwritten(capsys, train, model):
    before = train.read_text()
    refused(capsys, "simulate", model, train, "--out", train, says="overwrite")
    assert train.read_text() == before


def test_a_folder_that_cannot_be_written(capsys, tmp_path, train):
    (tmp_path / "file").write_text("kept")
    refused(capsys, *fit_arguments(train, tmp_path, "--out", tmp_path / "file" / "below"), says="--out")
    assert (tmp_path / "file").read_text() == "kept"


def test_unusable_model_files_are_refused_and_left_alone(capsys, tmp_path, train, model):
    good = model.read_text()
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
    os.mkfifo(tmp_path / "pipe.json")  # reading it would wait forever
    refused(capsys, "simulate", tmp_path / "pipe.json", train, "--out", tmp_path / "sim.csv", says="a pipe or a device")


def test_an_unstable_start_is_refused(capsys, tmp_path, train, model):
    document = json.loads(model.read_text())
    del document["sha256"]
    document["parameters"]["A"]["value"] = [[1e6]]
    wild = tmp_path / "wild.json"
    wild.write_text(json.dumps({**document, "sha256": ordered_digest(document)}))
    names = ("--inputs", "u", "--outputs", "y", "--initial", "zero")
    refused(capsys, "fit", train, *names, "--from", wild, "--out", tmp_path / "wild", says="diverges")


@pytest.mark.usefixtures("blank_figures")
def test_messages_name_options_of_the_command_line(capsys, tmp_path, train, monkeypatch):
    path = tmp_path / "odd.csv"
    path.write_text(train.read_text().replace("t,u,y", "clock,u,y", 1))
    refused(capsys, *fit_arguments(path, tmp_path), says="--dt STEP")
    write_csv(path, time=np.arange(600) * 0.01)
    refused(capsys, *fit_arguments(path, tmp_path), says="--column t=t")
    t = np.arange(600) * 0.01
    t[300] += 3e-4
    write_csv(path, t=t)
    refused(capsys, *fit_arguments(path, tmp_path), says="--time-tolerance STEPS")
    assert run(capsys, *fit_arguments(path, tmp_path, "--operators", 0, "--time-tolerance", 0.1))[0] == 0
    periodic = [a if a != "zero" else "periodic" for a in fit_arguments(train, tmp_path, "--overwrite")]
    refused(capsys, *periodic, says="--period SAMPLES")
    monkeypatch.setattr("pilfr_casadi._base.c_compiler.compiler", lambda: None)
    refused(capsys, *fit_arguments(train, tmp_path, "--overwrite", "--engine", "c"), says="--engine vm")


@pytest.mark.parametrize(
    ("python", "options"),
    [
        ("or use engine='vm'.", "or use --engine vm."),
        ("run in a script, or use workers=1.", "run in a script, or use --workers 1."),
        ("give `period=`.", "give --period PERIOD."),
        ("as in columns={'force': 'u_vir_V'}.", "as in --column force=u_vir_V."),
        ("as in columns={'t': 'Zeit [s]'}.", 'as in --column "t=Zeit [s]".'),
        ("allow more with time_tolerance=STEPS.", "allow more with --time-tolerance STEPS."),
        ("resample with resample=STEP, or", "resample with --resample STEP, or"),
        ("the file /data/run_dt=0.1.csv is empty", "the file /data/run_dt=0.1.csv is empty"),
        ("but dt=0.01 was stated, a ratio", "but --dt 0.01 was stated, a ratio"),
        ("give the model as `model=`", "use it in Python with load(FILE, model=MODEL)"),
    ],
)
def test_keywords_become_options(python, options):
    assert name_options(python) == options


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (("fitt",), "No such command 'fitt'; did you mean 'fit'?"),
        (("campain", "rig.toml"), "did you mean 'campaign'?"),
        (("nonsense",), "No such command 'nonsense'; see pilfr --help."),
        ((), "Missing command; see pilfr --help."),
        (("fit",), "Missing argument 'TRAIN'; see pilfr fit --help."),
        (("fit", "a.csv", "--inputs", "u", "--outputs", "y", "--strats", "3"), "--starts"),
        (("fit", "a.csv", "--inputs", "u", "--outputs", "y", "--hold", "often"), "'zero', 'linear'"),
        (("export", "model.json", "--out", "c", "--c", "--casadi"), "--casadi and --c were given"),
    ],
)
def test_misspelt_commands_and_options_get_a_suggestion(capsys, given, says):
    refused(capsys, *given, says=says)


def test_a_period_without_an_initial_state_is_refused(capsys, tmp_path, train, model):
    names = ("--inputs", "u", "--outputs", "y", "--period", 20)
    refused(capsys, "fit", train, *names, "--out", tmp_path / "out", says="--period 20 was given without --initial")
    refused(capsys, "simulate", model, train, "--period", 20, "--out", tmp_path / "s.csv", says="--period 20")


def test_the_package_runs_as_a_module():
    done = subprocess.run([sys.executable, "-m", "pilfr_casadi", "--version"], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"pilfr {pilfr.__version__}\n", "")


def test_version_and_help(capsys):
    assert run(capsys, "--version") == (0, f"pilfr {pilfr.__version__}\n", "")
    status, out, err = run(capsys, "--help")
    assert status == 0 and "pilfr: " not in err
    for name in ("fit", "check", "diagnose", "simulate", "export", "run", "campaign", "fleet", "demo"):
        assert f"\n  {name} " in out
        status, text, _ = run(capsys, name, "--help")
        assert status == 0
        assert not re.search(r"<(list|str|int|float)|TEXT|INTEGER|FLOAT|[{}]", text), text  # types are Python's


def test_options_are_not_abbreviated(capsys, tmp_path, train):
    status, _, err = run(capsys, *fit_arguments(train, tmp_path)[:-2], "--start", "3")
    assert status == 2 and "No such option: --start" in err


@pytest.mark.usefixtures("blank_figures")
def test_a_model_is_overwritten_only_with_overwrite(capsys, tmp_path, train):
    model = tmp_path / "out" / "model.json"
    model.parent.mkdir()
    model.write_text("mine")
    linear = fit_arguments(train, tmp_path, "--operators", 0)
    refused(capsys, *linear, says=("model.json exists", "--overwrite"))
    assert model.read_text() == "mine"
    assert run(capsys, *linear, "--overwrite")[0] == 0
    assert json.loads(model.read_text())["format"]


@pytest.mark.usefixtures("blank_figures")
def test_fit_prints_its_data_order_and_engine(capsys, tmp_path, train, monkeypatch):
    arguments = list(fit_arguments(train, tmp_path, "--operators", 0))
    del arguments[arguments.index("--nx") : arguments.index("--nx") + 2]
    monkeypatch.setattr("pilfr_casadi.engine.compiled.compiler", lambda: None)
    monkeypatch.setattr("pilfr_casadi.cli.models.compiler", lambda: None)
    status, out, err = run(capsys, *arguments)
    assert status == 0 and "warning" not in err
    assert ", chosen on the training data\n" in out
    assert "engine: CasADi's virtual machine, which is slower: no C compiler was found\n" in out


@pytest.mark.usefixtures("blank_figures")
def test_a_compiler_that_fails_is_named(capsys, tmp_path, train, monkeypatch):
    monkeypatch.setattr("pilfr_casadi._base.c_compiler.compiler", lambda: "/bin/false")
    status, out, err = run(capsys, *fit_arguments(train, tmp_path, "--operators", 0))
    assert status == 0 and "warning" not in err
    assert out.count("virtual machine") == 1 and "/bin/false could not build the model" in out


@pytest.mark.usefixtures("blank_figures")
def test_a_time_limit_keeps_the_best_so_far(capsys, tmp_path):
    path = write_csv(tmp_path / "train.csv", m=2000)
    names = ("--inputs", "u", "--outputs", "y", "--nx", 3, "--operators", 20, "--starts", 2000)
    began = time.monotonic()
    status, out, _ = run(capsys, "fit", path, *names, "--time-limit", 3, "--out", tmp_path / "out")
    assert time.monotonic() - began < 40
    assert status == 0 and "the time limit was reached" in out
    assert json.loads((tmp_path / "out" / "model.json").read_text())["parameters"]["A"]
    status, _, err = run(capsys, "fit", path, *names, "--time-limit", 1e-3, "--out", tmp_path / "none")
    assert status == 1 and "--time-limit 0.001" in err and not (tmp_path / "none" / "model.json").exists()


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize("iterations", [1, 200])
def test_a_fit_that_ends_at_the_iteration_limit_says_how_to_go_on(capsys, tmp_path, train, monkeypatch, iterations):
    monkeypatch.setattr("pilfr_casadi.cli.models.GaussNewton", partial(GaussNewton, max_iterations=iterations))
    names = ("--inputs", "u", "--outputs", "y", "--nx", 1, "--starts", 1, "--operators", 1)
    status, said, _ = run(capsys, "fit", train, *names, "--out", tmp_path / "out")
    assert status == 0 and ("Not converged" in said) == (iterations == 1)
    assert (f"To go on from here: --from {tmp_path / 'out' / 'model.json'}" in said) == (iterations == 1)


def test_simulated_outputs_are_written_with_the_units_of_the_model(capsys, tmp_path, train, model):
    known, first, again = tmp_path / "known.json", tmp_path / "first.csv", tmp_path / "again.csv"
    replace(pilfr.load(model), units={"u": "V", "y": "mm"}).save(known)
    assert run(capsys, "simulate", known, train, "--initial", "zero", "--out", first)[0] == 0
    assert first.read_text().startswith("t,u [V],y [mm]\n")
    status, said, _ = run(capsys, "simulate", known, first, "--initial", "zero", "--out", again)
    assert status == 0 and "NRMSE on first: 0\n" in said and again.read_text() == first.read_text()


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".mat"])
def test_inputs_alone_are_enough_to_simulate(capsys, tmp_path, train, model, suffix):
    from scipy.io import savemat

    out, both = tmp_path / "sim.csv", tmp_path / "both.csv"
    t, u = np.loadtxt(train, delimiter=",", skiprows=1).T[:2]
    path = tmp_path / f"drive{suffix}"
    if suffix == ".csv":
        cells = [line.split(",") for line in train.read_text().splitlines()]
        path.write_text("\n".join(f"{a},{b}" for a, b, _ in cells) + "\n")
    else:
        {".npz": lambda: np.savez(path, t=t, u=u), ".mat": lambda: savemat(path, {"t": t, "u": u})}[suffix]()
    status, said, _ = run(capsys, "simulate", model, path, "--out", out)
    assert status == 0 and "NRMSE" not in said and "initial state: zero" in said and "with --initial" in said
    assert run(capsys, "simulate", model, train, "--initial", "zero", "--out", both)[0] == 0
    assert out.read_text() == both.read_text()
    again = ("simulate", model, path, "--out", out, "--overwrite")
    status, said, _ = run(capsys, *again, "--initial", "periodic", "--period", 300)
    assert status == 0 and "initial state: periodic steady state" in said and "with --initial" not in said
    refused(capsys, *again, "--initial", "estimate", says="needs measured outputs")
    refused(capsys, *again, "--outputs", "y", says="no column 'y'")
    refused(capsys, "fit", path, "--inputs", "u", "--outputs", "y", "--out", tmp_path / "no", says="no column 'y'")


def test_names_that_are_not_the_models_are_refused(capsys, tmp_path, train, model):
    out = tmp_path / "sim.csv"
    simulate = ("simulate", model, train, "--out", out)
    refused(capsys, *simulate, "--inputs", "y", "--outputs", "u", says=("--inputs y", "--column u=COLUMN"))
    refused(capsys, *simulate, "--outputs", "x2", says=("--outputs x2", "the model's outputs are y"))
    assert not out.exists()
    other = tmp_path / "other.csv"
    other.write_text(train.read_text().replace("t,u,y", "t,force,disp", 1))
    columns = ("--column", "u=force", "--column", "y=disp")
    status, said, _ = run(capsys, "simulate", model, other, *columns, "--out", out)
    assert status == 0 and "NRMSE" in said
    assert out.read_text().startswith("t,u,y\n")
    refused(capsys, "simulate", model, train, "--out", tmp_path / "sim.npz", says="written as CSV")
    refused(capsys, "simulate", model, train, "--out", model, says="overwrite the model")


def test_times_are_written_as_read(capsys, tmp_path, train, model):
    times = [f"{100 + k * 0.01:.4f}" for k in range(600)]
    path, out = write_csv(tmp_path / "drive.csv", t=times), tmp_path / "sim.csv"
    assert run(capsys, "simulate", model, path, "--out", out)[0] == 0
    assert [line.split(",")[0] for line in out.read_text().splitlines()[1:]] == times
    text = train.read_text().replace("t,u,y", "clock,u,y", 1)
    path.write_text(text)
    assert run(capsys, "simulate", model, path, "--dt", 0.01, "--out", out, "--overwrite")[0] == 0
    written = [line.split(",")[0] for line in out.read_text().splitlines()[1:]]
    assert written[35] == "0.35" and max(map(len, written)) == 4


def test_samples_too_large_to_square_get_one_sentence(capsys, tmp_path):
    path = write_csv(tmp_path / "train.csv", y=np.r_[np.ones(99), 1e308, np.zeros(500)])
    refused(capsys, *fit_arguments(path, tmp_path), says=("'y', line 101", "1e+308", "1e+100"))


def test_the_piezo_problem_names_its_remedy(capsys, tmp_path, monkeypatch):
    from problems.piezo_stack import main as piezo

    monkeypatch.setenv("PILFR_DATA", str(tmp_path))
    assert piezo(["--out", str(tmp_path)]) == 1
    assert "PILFR_DATA" in capsys.readouterr().out


def test_an_interrupted_run_writes_the_best_so_far(tmp_path):
    path = write_csv(tmp_path / "train.csv", m=600)
    program = "import sys; from pilfr_casadi.cli import main; sys.exit(main(sys.argv[1:]))"
    names = ("--inputs", "u", "--outputs", "y", "--nx", "1", "--operators", "5", "--starts", "2000")
    process = subprocess.Popen(
        [sys.executable, "-c", program, "fit", str(path), *names, "--out", str(tmp_path / "out")],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert any(line.startswith("engine:") for line in process.stdout)
        time.sleep(2)
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130
    assert "interrupted" in out
    assert json.loads((tmp_path / "out" / "model.json").read_text())["parameters"]["A"]


def wrapped_interrupt(*_, **__):
    """As from `DM.__array__`, which goes on with the KeyboardInterrupt of Ctrl-C pending."""
    try:
        raise KeyboardInterrupt
    except KeyboardInterrupt as cause:
        raise SystemError("<method 'full'> returned a result with an exception set") from cause


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize("done", [0, 1])
def test_an_interrupt_that_casadi_wraps_is_recognised(capsys, tmp_path, train, monkeypatch, done):
    """In the first start there is only the linear model to write, in the second one that of the first."""
    starts = [multistart.explore] * done
    monkeypatch.setattr(multistart, "explore", lambda *task: (starts.pop() if starts else wrapped_interrupt)(*task))
    status, out, _ = run(capsys, *fit_arguments(train, tmp_path, "--operators", 2, "--starts", 3))
    assert status == 130 and "interrupted" in out
    model = json.loads((tmp_path / "out" / "model.json").read_text())
    assert ("r" in model["parameters"]) == bool(done)


def test_a_wrapped_interrupt_before_any_work_is_recognised(capsys, tmp_path, train, monkeypatch):
    monkeypatch.setattr("pilfr_casadi.cli.models.check_out_folder", wrapped_interrupt)
    status, _, err = run(capsys, *fit_arguments(train, tmp_path))
    assert status == 130 and "Interrupted" in err


@pytest.mark.usefixtures("blank_figures")
def test_a_model_that_misses_its_constraints_is_no_usable_result(capsys, tmp_path):
    """What contradicts itself is bad input (2), what no solver could meet no usable result (1), as in a run."""
    write_csv(tmp_path / "train.csv", seed=0, m=200)
    data = fit_arguments(tmp_path / "train.csv", tmp_path, "--operators", 2, "--starts", 1)
    says = ("'spectral radius <= 1' is infeasible", "give 2, with limits 0 and 1")
    refused(capsys, *data, "--fix", "A=2", says=says)
    refused(capsys, *data, "--bound", "A=1.01:2", says=("bounds of A, 1.01 to 2, allow no", "widen the bounds of A"))
    loop = [option for name in ("B_w", "C_z", "w") for option in ("--bound", f"{name}=0.4:2")]
    status, _, err = run(capsys, *data, "--bound", "A=0.9:0.95", *loop)
    assert status == 1
    assert sentence(err).startswith("pilfr: The model does not meet its constraints: spectral radius with the")
    assert "off by" in err


def test_an_existing_file_is_replaced_only_if_that_is_said(capsys, tmp_path, train, model):
    out, before = write_csv(tmp_path / "measured.csv", seed=5), train.read_text()
    kept = out.read_text()
    simulate = ("simulate", model, train, "--initial", "zero", "--out")
    refused(capsys, *simulate, out, says="measured.csv exists already; give another --out, or --overwrite")
    refused(capsys, "export", model, "--out", out, says="measured.csv exists already")
    assert out.read_text() == kept
    refused(capsys, *simulate, train, "--overwrite", says="overwrite the recording")
    refused(capsys, "export", model, "--out", model, "--overwrite", says="overwrite the model")
    assert train.read_text() == before
    assert run(capsys, *simulate, out, "--overwrite")[0] == 0
    assert out.read_text() != kept
    for kind, name in (((), "model"), (("--c",), "c"), (("--fmu",), "model.fmu")):
        export = ("export", model, *kind, "--out", tmp_path / name)
        assert run(capsys, *export)[0] == 0
        refused(capsys, *export, says="exists already")
        assert run(capsys, *export, "--overwrite")[0] == 0


@pytest.mark.usefixtures("blank_figures")
def test_no_more_workers_than_starts_are_begun(capsys, tmp_path, train, monkeypatch):
    begun = []
    monkeypatch.setattr(
        "pilfr_casadi.cli.models.worker_pool", lambda count: begun.append(count) or contextlib.nullcontext()
    )
    assert run(capsys, *fit_arguments(train, tmp_path, "--workers", 900))[0] == 0
    assert begun == [2]


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are bytes there")
@pytest.mark.usefixtures("blank_figures")
def test_a_recording_whose_name_is_no_text_is_fitted(tmp_path, train, monkeypatch):
    path = os.fsdecode(os.fsencode(tmp_path / "f") + b"\xff.csv")
    shutil.copy(train, path)
    with (tmp_path / "said.txt").open("w", encoding="utf-8") as strict:
        monkeypatch.setattr(sys, "stdout", strict)
        assert main([str(a) for a in fit_arguments(path, tmp_path)]) == 0
    assert "f?.csv" in (tmp_path / "said.txt").read_text() and (tmp_path / "out" / "report.html").exists()


@pytest.mark.usefixtures("blank_figures")
def test_a_result_that_came_in_between_is_kept(capsys, tmp_path, train, monkeypatch):
    out = tmp_path / "out"

    def fit_beside_another_run(*given, **options):
        out.mkdir(exist_ok=True)
        (out / "model.json").write_text("of another run")
        return pilfr.fit(*given, **options)

    monkeypatch.setattr("pilfr_casadi.cli.models.fit", fit_beside_another_run)
    status, said, _ = run(capsys, *fit_arguments(train, tmp_path))
    assert status == 0 and "another run has written" in said and f"this result is in {out / 'run-2'}" in said
    assert (out / "model.json").read_text() == "of another run" and not (out / "report.html").exists()
    assert json.loads((out / "run-2" / "model.json").read_text())["format"]


@pytest.mark.parametrize(
    ("command", "step", "name", "beside"),
    [
        (("simulate",), "load", "sim.csv", ()),
        (("export",), "exported", "step", ("step.names.json",)),
        (("export", "--c"), "exported", "model.c", ("model.h",)),
    ],
)
def test_a_file_that_came_in_between_is_kept(capsys, tmp_path, train, model, monkeypatch, command, step, name, beside):
    """Of two commands that write the same file at once, the later one writes to another folder."""
    out, original = tmp_path / "out", getattr(models, step)
    out.mkdir()

    def run_beside_another_command(*given, **options):
        (out / name).write_text("of another command")
        return original(*given, **options)

    monkeypatch.setattr(models, step, run_beside_another_command)
    data = (train, "--initial", "zero") if command == ("simulate",) else ()
    status, said, err = run(capsys, *command, model, *data, "--out", out if "--c" in command else out / name)
    assert status == 0, err
    assert "another run has written" in said and str(out / "run-2" / name) in said
    assert {p.name for p in out.iterdir()} == {name, "run-2"} and (out / name).read_text() == "of another command"
    assert {p.name for p in (out / "run-2").iterdir()} == {name, *beside} and (out / "run-2" / name).stat().st_size


def test_a_file_that_cannot_be_written_is_refused_before_the_work(capsys, tmp_path, train, model, monkeypatch):
    monkeypatch.setattr(models, "load", None)  # nothing is loaded
    given = ("simulate", model, train, "--out")
    refused(capsys, *given, tmp_path / "none" / "sim.csv", says="give a file in a folder that exists")
    refused(capsys, *given, tmp_path, "--overwrite", says="give a file in a folder that exists")
    assert not (tmp_path / "none").exists() and tmp_path.is_dir()


@pytest.mark.usefixtures("blank_figures")
def test_a_model_that_cannot_be_written_leaves_no_file(capsys, tmp_path, train, monkeypatch):
    def full(fit, path):
        raise pilfr.InputError(f"{path} cannot be written (No space left on device); give another path.")

    monkeypatch.setattr("pilfr_casadi.identify.Fit.save", full)
    refused(capsys, *fit_arguments(train, tmp_path), says="No space left")
    assert not (tmp_path / "out" / "model.json").exists()


def test_a_python_file_is_no_start_of_a_fit(capsys, tmp_path, train):
    rig = tmp_path / "rig.py"
    rig.write_text("simulator = None\n")
    given = ("fit", train, "--inputs", "u", "--outputs", "y", "--from", rig)
    refused(capsys, *given, says="a simulator in Python; give a model.json")


def test_an_empty_name_of_a_folder_is_refused(capsys, train):
    names = ("--inputs", "u", "--outputs", "y", "--nx", 1, "--operators", 0)
    refused(capsys, "fit", train, *names, "--out", "", says="--out '' was given; give the name of a folder")
