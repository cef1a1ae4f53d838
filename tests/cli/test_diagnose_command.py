"""`pilfr diagnose`: a whole run from files, and one plain sentence with exit status 2 for what cannot be used."""

import importlib
import json
import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from command_line import refused, run

from pilfr_casadi import multisine
from pilfr_casadi.cli.demo import diagnose_rig
from pilfr_casadi.laws import (
    Backlash,
    CoulombFriction,
    CubicStiffness,
    Power,
    PreslidingFriction,
    Saturation,
    display_name,
)
from pilfr_casadi.simulators import load_simulator

RIG = """
from pilfr_casadi import Parameter, Port, Simulator


def dynamics(x, u, p):
    return dict(pos=x.vel, vel=(u.force - p.k * x.pos - p.d * x.vel) / p.m)


def outputs(x, u, p):
    return dict(position=x.pos)


simulator = Simulator(
    dynamics, outputs, states=("pos", "vel"), inputs=("force",),
    parameters=dict(
        m=Parameter(1.0, unit="kg", fixed=True), k=Parameter(90.0, unit="N/m", bounds=(20, 400)),
        d=Parameter(1.5, unit="N s/m", bounds=(0.1, 20)),
    ),
    ports=(Port("ground-mass", into=lambda p: dict(vel=-1 / p.m), across=lambda x: x.pos, unit="N", across_unit="m"),),
)
"""
DT = 0.02


def rig(seed, m=800, k=100.0, cubic=4000.0):
    """Force and position of a mass on a stiffening spring, as the world makes them."""
    rng = np.random.default_rng(seed)
    force = 12 * multisine(m, f_max=4.0, fs=1 / DT, rng=rng)

    def speed_change(pos, vel, push):
        return push - k * pos - cubic * pos**3 - 2.0 * vel

    pos, vel, out, h = 0.0, 0.0, [], DT / 200
    for push in force.tolist():
        out.append(pos)
        for _ in range(200):  # Heun's rule
            a = speed_change(pos, vel, push)
            ahead = speed_change(pos + h * vel, vel + h * a, push)
            pos, vel = pos + h * (vel + h / 2 * a), vel + h / 2 * (a + ahead)
    return force, np.array(out) + 1e-4 * rng.standard_normal(m)


def write_csv(path, force, position, names=("t", "force", "position"), t=None):
    t = np.arange(len(force)) * DT if t is None else t
    rows = zip(t, force, position, strict=True)
    path.write_text(",".join(names) + "\n" + "\n".join(",".join(map(str, r)) for r in rows) + "\n")
    return path


@pytest.fixture(scope="module")
def truth():
    return {"train": rig(0), "test": rig(1)}


@pytest.fixture
def catalogue(monkeypatch):
    """Shorten the catalogue to some laws; many slow tests search the whole one."""

    def shorten(*laws):
        monkeypatch.setattr(importlib.import_module("pilfr_casadi.diagnose.arguments"), "CATALOGUE", laws)

    return shorten


@pytest.fixture
def files(tmp_path, truth):
    (tmp_path / "rig.py").write_text(RIG)
    for name, data in truth.items():
        write_csv(tmp_path / f"{name}.csv", *data)
    return tmp_path


def arguments(folder, *more, simulator="rig.py", train="train.csv", test="test.csv"):
    source = ("--simulated", folder / "simulated.csv") if simulator is None else (folder / simulator,)
    return (
        "diagnose",
        *source,
        folder / train,
        "--test",
        folder / test,
        "--out",
        folder / "out",
        "--workers",
        1,
        *more,
    )


@pytest.mark.usefixtures("blank_figures")
def test_a_whole_diagnosis(capsys, files, catalogue):
    catalogue(Backlash, CoulombFriction, CubicStiffness, Power)
    given = arguments(files, "--hold", "zero", "--initial", "zero", "--bound", "k=50:1000")
    status, out, err = run(capsys, *given)
    assert status == 0 and "pilfr: " not in err
    found = json.loads((files / "out" / "diagnosis.json").read_text(), parse_constant=lambda c: pytest.fail(c))
    assert found["verdict"] == "missing-physics"
    (effect,) = found["effects"]
    assert (effect["port"], effect["law"]) == ("ground-mass", "cubic_stiffness")
    assert re.search(r"the simulator's own values, refitted:\n(  [kd] = .* given as [\d.]+\n){2}NRMSE", out)
    value = {name: p["value"] for name, p in effect["parameters"].items()}
    at_0_2 = value["k_3"] * 0.2**3 if "k_3" in value else value["k_n"] * 0.2 ** value["n"]
    assert at_0_2 == pytest.approx(32.0, rel=0.05)  # 4000 N/m^3 at 0.2 m
    assert all("N/m" in p["unit"] for name, p in effect["parameters"].items() if name != "n")
    errors = found["fit"]["test"]
    assert errors["after"] < 0.2 * errors["before"]
    assert "cubic stiffness at ground-mass" in out and "noise floor" in out
    three = r"( +\d\.\d{4,5}){3}"
    assert re.search(rf"NRMSE +as given +refitted +corrected\n  train{three}\n  test{three}\n", out)
    assert re.search(r"computed in [\d.]+ s\n", out)
    assert f"report: {files / 'out' / 'report.html'}" in out
    assert "<html" in (files / "out" / "report.html").read_text().lower()
    assert not list(files.rglob("__pycache__"))
    tried = [c for c in found["candidates"] if c["nrmse_train"] is not None]
    page = (files / "out" / "report.html").read_text()
    assert len(tried) > 5 and all(display_name(c["law"]) in page and c["port"] in page for c in tried)
    corrected = files / "out" / "corrected.py"
    assert f"corrected simulator: {corrected}" in out
    assert load_simulator(corrected).parameters["k"].bounds == (50, 1000)
    simulated = ("simulate", corrected, files / "test.csv", "--initial", "zero", "--out", files / "y.csv")
    status, out, err = run(capsys, *simulated)
    assert status == 0, err
    assert float(re.search(r"NRMSE on test: ([\d.]+)", out)[1]) == pytest.approx(errors["after"], abs=1e-4)
    assert run(capsys, "export", corrected, "--dt", 0.02, "--c", "--out", files / "c")[0] == 0
    before = (files / "out" / "diagnosis.json").read_text()
    refused(capsys, *given, says=("diagnosis.json exists", "--overwrite"))
    assert (files / "out" / "diagnosis.json").read_text() == before


BAD_SIMULATORS = {
    "syntax error": (("def outputs(x, u, p):", "def outputs(x, u, p)"), ("rig.py, line 9",)),
    "exception": (("p.k * x.pos", "p.k * x.position"), ("rig.py, line 6", "'position'")),
    "no simulator": (("simulator = ", "rig = "), ("'simulator'",)),
    "state without derivative": (("pos=x.vel, ", ""), ("derivative", "'pos'")),
    "port into an unknown state": (("dict(vel=-1", "dict(speed=-1"), ("'ground-mass'", "'speed'")),
    "recording lacks an input": (('("force",)', '("force", "heat")'), ("'heat'", "--column heat=COLUMN")),
    "recording lacks an output": (
        ("dict(position=x.pos)", "dict(place=x.pos)"),
        ("'place'", "--column place=COLUMN; without such a sensor"),
    ),
    "diverging simulator": (
        ("- p.d * x.vel", "+ 1e3 * x.vel"),
        ("diverges", "position is out", "s into", "it is unstable", "put the controller into the simulator"),
    ),
    "decides by a symbol": (("p.k * x.pos", "p.k * max(x.pos, 0)"), ("casadi.if_else", "casadi.fmax")),
    "math's functions": (("p.k * x.pos", "p.k * __import__('math').sin(x.pos)"), ("equation of 'vel'", "ca.sin")),
    "diverging at once": (("- p.d * x.vel", "+ 1e6 * x.vel**3"), ("diverges",)),
    "far too fast": (("p.k * x.pos", "1e16 * x.pos"), ("fast",)),
    "no mass": (
        ("m=Parameter(1.0", "m=Parameter(0.0"),
        ("derivative of the state 'vel' is not finite", "m = 0;", "by the argument `initial` of Recording"),
    ),
}


@pytest.mark.parametrize(
    "bound, says",
    [
        ("k=100:200", ("'k' is 90, outside of its bounds 100 to 200", "widen")),
        ("q=1:2", ("no parameter 'q'", "m, k, d")),
        ("k=200:100", ("infeasible",)),
        ("k=100", ("LOW:HIGH",)),
    ],
)
def test_bad_bounds_are_refused(capsys, files, bound, says):
    refused(capsys, *arguments(files, "--bound", bound), says=says)
    assert not (files / "out").exists()


def test_bounds_are_for_parameters_with_names(capsys, files):
    system = "import control\nsimulator = control.ss([[-1.0]], [[2.0]], [[1.0]], [[0.0]])\n"
    (files / "system.py").write_text(system)
    given = arguments(files, "--bound", "A11=-2:0", simulator="system.py")
    refused(capsys, *given, says=("a StateSpace, whose numbers have no names", "give a Simulator"))
    given = arguments(files, "--bound", "k=50:1000", simulator=None)
    refused(capsys, *given, says=("--bound was given", "not for --simulated"))


def test_a_pipe_is_no_simulator_file(capsys, files):
    os.mkfifo(files / "pipe.py")  # reading it would wait forever
    refused(capsys, *arguments(files, simulator="pipe.py"), says=("pipe.py", "a pipe or a device"))


@pytest.mark.parametrize("case", BAD_SIMULATORS)
def test_bad_simulators_are_refused(capsys, files, case):
    (old, new), says = BAD_SIMULATORS[case]
    assert old in RIG
    (files / "rig.py").write_text(RIG.replace(old, new))
    refused(capsys, *arguments(files, "--initial", "zero"), says=says)
    assert not (files / "out" / "diagnosis.json").exists()


BAD_RECORDINGS = {
    "NaN in the middle": (lambda f, y: (f, np.r_[y[:400], np.nan, y[401:]]), ("nan", "402")),
    "infinite": (lambda f, y: (np.r_[f[:9], np.inf, f[10:]], y), ("inf", "11")),
    "text": (lambda f, y: ([*map(str, f[:5]), "off", *map(str, f[6:])], y), ("off", "7")),
    "output never moves": (lambda f, y: (f, 0 * y), ("position", "never changes")),
    "too short": (lambda f, y: (f[:10], y[:10]), ("samples",)),
}


@pytest.mark.parametrize("case", BAD_RECORDINGS)
def test_bad_recordings_are_refused(capsys, files, truth, case):
    change, says = BAD_RECORDINGS[case]
    write_csv(files / "train.csv", *change(*truth["train"]))
    refused(capsys, *arguments(files), says=says)


def test_a_test_that_equals_the_training_is_refused(capsys, files, truth):
    refused(capsys, *arguments(files, test="train.csv"), says="twice")
    write_csv(files / "copy.csv", *truth["train"])
    refused(capsys, *arguments(files, test="copy.csv"), says=("copy.csv", "train.csv", "needs other data"))


def test_files_that_are_missing_or_in_the_wrong_place(capsys, files):
    refused(capsys, *arguments(files, simulator="nowhere.py"), says="nowhere.py")
    refused(capsys, *arguments(files, train="nowhere.csv"), says="nowhere.csv")
    refused(capsys, *arguments(files, simulator="train.csv", train="test.csv"), says=("--simulated", "train.csv"))
    refused(capsys, "diagnose", files / "train.csv", files / "rig.py", "--out", files / "out", says="--simulated")
    refused(capsys, "diagnose", files / "rig.py", "--out", files / "out", says="No training recording")
    refused(capsys, *arguments(files, "--inputs", "force"), says=("--inputs", "--simulated"))
    refused(capsys, *arguments(files, "--workers", 0), says="--workers 0")
    refused(capsys, *arguments(files, "--search-samples", 5), says="--search-samples 5")
    (files / "file").write_text("kept")
    refused(capsys, *arguments(files)[:-4], "--out", files / "file" / "below", says="--out")


@pytest.mark.parametrize("limit", ["force=much", "force", "torque=3", "force=-1", "force=nan", "force=inf"])
def test_bad_limits_are_refused(capsys, files, limit):
    refused(capsys, *arguments(files, "--limit", limit), says=("limit", limit.partition("=")[0]))


def test_recordings_that_do_not_fit_each_other(capsys, files, truth):
    write_csv(files / "test.csv", *truth["test"], t=np.arange(800) * 0.01)
    refused(capsys, *arguments(files), says=("test.csv", "0.01 s", "0.02 s"))


@pytest.mark.usefixtures("blank_figures")
def test_a_recorded_simulation_replaces_the_simulator(capsys, files, catalogue):
    catalogue(CubicStiffness, Saturation)
    write_csv(files / "simulated.csv", *rig(5, m=1200, k=95.0, cubic=0.0))
    status, out, err = run(capsys, *arguments(files, "--hold", "zero", "--initial", "zero", simulator=None))
    assert status == 0 and "pilfr: " not in err
    assert "inputs force, outputs position, as found in the files" in out
    assert "simulated.csv (NRMSE 0.00" in out and "ports mode:1.5" in out
    found = json.loads((files / "out" / "diagnosis.json").read_text())
    assert found["gates"][0]["finding"] == "surrogate"
    assert "A linear model stands for the simulation" in found["gates"][0]["sentence"]
    assert "A linear model stands for the simulation" in (files / "out" / "report.html").read_text()
    assert found["verdict"] == "missing-physics"
    effect = found["effects"][0]
    assert effect["port"].startswith("mode:1.5") and effect["law"] == "cubic_stiffness"
    assert found["fit"]["test"]["after"] < 0.1 * found["fit"]["test"]["before"]


@pytest.mark.slow
def test_a_simulation_that_stiffens_like_the_machine_lacks_nothing(capsys, files):
    """Its linear surrogate cannot show the stiffening."""
    write_csv(files / "simulated.csv", *rig(5, m=1200, k=95.0))
    names = ("--inputs", "force", "--outputs", "position")
    status, out, err = run(capsys, *arguments(files, "--hold", "zero", "--initial", "zero", *names, simulator=None))
    assert status == 0, err
    assert "pilfr: " not in err and "Nothing is seen that the simulation lacks" in out
    found = json.loads((files / "out" / "diagnosis.json").read_text())
    assert (found["verdict"], found["effects"]) == ("complete", [])


def test_inputs_of_a_simulation_are_the_columns_that_agree(capsys, files, truth, monkeypatch):
    seen = {}

    def stop(simulator, recordings, **options):
        seen.update(simulator=simulator, names=(recordings[0].inputs, recordings[0].outputs))
        raise KeyboardInterrupt

    monkeypatch.setattr(importlib.import_module("pilfr_casadi.diagnose"), "diagnose", stop)
    force, position = truth["train"]
    linear = np.convolve(force, 0.01 * 0.9 ** np.arange(200))[: len(force)]
    write_csv(files / "simulated.csv", linear, force, names=("t", "here", "drive"))
    write_csv(files / "train.csv", position, force, names=("t", "here", "drive"))
    status, out, err = run(capsys, *arguments(files, simulator=None)[:4], "--out", files / "out")
    assert status == 130 and "nothing was written" in err
    assert "inputs drive, outputs here, as found in the files" in out and seen["names"] == (("drive",), ("here",))
    assert not (files / "out").exists()
    write_csv(files / "named.csv", force, position, names=("t", "u_vir_V", "position"))
    column = ("--column", "force=u_vir_V", "--out", files / "out")
    status, out, _ = run(capsys, "diagnose", files / "rig.py", files / "named.csv", *column)
    assert status == 130 and seen["names"] == (("force",), ("position",))
    given = arguments(files, simulator=None, test="test.csv")
    refused(capsys, *given, says=("--inputs", "The columns (none) that"))
    refused(capsys, *given, "--inputs", "drive", says=("--inputs and --outputs",))
    refused(capsys, *given, "--inputs", "drive", "--outputs", "here", says=("test.csv", "'drive'"))


@pytest.mark.slow
def test_a_column_missing_in_the_recordings_is_reported(capsys, files, truth, monkeypatch):
    seen = {}

    def stop(simulator, recordings, **options):
        seen["outputs"] = recordings[0].outputs
        raise KeyboardInterrupt

    monkeypatch.setattr(importlib.import_module("pilfr_casadi.diagnose"), "diagnose", stop)
    force, position = truth["train"]
    time, given = np.arange(len(force)) * DT, arguments(files, simulator=None)[:4]
    linear = np.convolve(force, 0.01 * 0.9 ** np.arange(200))[: len(force)]

    def table(name, columns):
        rows = np.column_stack([time, *columns.values()])
        np.savetxt(files / name, rows, delimiter=",", header=",".join(["t", *columns]), comments="")

    table("simulated.csv", {"force": force, "position": linear, "speed": np.gradient(linear, DT)})
    status, out, _ = run(capsys, *given, "--out", files / "out")
    assert status == 130 and "note: speed of" in out and "train.csv has no such column" in out
    table("train.csv", {"force": force, "position": position, "v": np.gradient(position, DT)})
    refused(capsys, *given, "--out", files / "out", says=("speed", "of its own", "--column speed=v"))
    status, _, err = run(capsys, *given, "--out", files / "out", "--column", "speed=v")
    assert status == 130 and seen["outputs"] == ("position", "speed"), err


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_a_saved_model_is_diagnosed_to_the_end(capsys, files, truth, catalogue):
    """A fitted PI-LFR in place of a simulator file: its matrices are parameters of the simulator."""
    names = ("--inputs", "force", "--outputs", "position", "--nx", 2, "--operators", 0)
    assert run(capsys, "fit", files / "train.csv", *names, "--out", files / "fit")[0] == 0
    for name in ("train", "test"):
        force, position = truth[name]
        write_csv(files / f"{name}.csv", force[:300], position[:300])
    catalogue(CubicStiffness, Saturation)
    given = arguments(files, "--hold", "zero", "--initial", "zero", simulator="fit/model.json")
    status, out, err = run(capsys, *given)
    assert status == 0 and "the simulator's own values, refitted" in out, out + err
    found = json.loads((files / "out" / "diagnosis.json").read_text())
    assert np.shape(found["parameters"]["A"]["refit_with"]) == (2, 2) and found["candidates"]
    corrected, y = files / "out" / "corrected.py", files / "y.csv"
    status, out, err = run(capsys, "simulate", corrected, files / "test.csv", "--initial", "zero", "--out", y)
    assert status == 0, err
    error = float(re.search(r"NRMSE on test: ([\d.]+)", out)[1])
    assert error == pytest.approx(found["fit"]["test"]["after"], rel=1e-2)
    assert (files / "out" / "report.html").exists()


@pytest.mark.usefixtures("blank_figures")
def test_a_saved_model_is_diagnosed_like_a_simulator(capsys, files, monkeypatch):
    seen = {}

    def stop(simulator, recordings, **options):
        seen["simulator"] = simulator
        raise KeyboardInterrupt

    monkeypatch.setattr(importlib.import_module("pilfr_casadi.diagnose"), "diagnose", stop)
    names = ("--inputs", "force", "--outputs", "position", "--nx", 2, "--operators", 0)
    assert run(capsys, "fit", files / "train.csv", *names, "--out", files / "fit")[0] == 0
    given = ("diagnose", files / "fit" / "model.json", files / "test.csv", "--out", files / "out")
    assert run(capsys, *given)[0] == 130
    assert seen["simulator"].discrete and seen["simulator"].inputs == ("force",)
    (files / "rig.py").write_text("import control\nsimulator = control.tf([1.0], [1.0, 1.5, 90.0])\n")
    given = ("diagnose", files / "rig.py", files / "test.csv", "--out", files / "out")
    refused(capsys, *given, says="--column u=COLUMN")
    assert run(capsys, *given, "--column", "u=force", "--column", "y=position")[0] == 130
    assert seen["simulator"].inputs == ("u",) and len(seen["simulator"].states) == 2
    (files / "rig.py").write_text("import control\nsimulator = control.tf([1.0], [1.0, 0.5], 0.05)\n")
    refused(capsys, *given, "--column", "u=force", "--column", "y=position", says=("0.05 s", "0.02 s"))


@pytest.mark.usefixtures("blank_figures")
def test_the_demonstration_finds_what_its_rig_hides(capsys, tmp_path, catalogue):
    catalogue(CubicStiffness, PreslidingFriction)
    assert diagnose_rig(tmp_path / "diagnosis", 1) == 0
    assert "Coulomb friction at ground-m2" in capsys.readouterr().out
    found = json.loads((tmp_path / "diagnosis" / "diagnosis.json").read_text())
    assert [(e["port"], e["law"]) for e in found["effects"]] == [("ground-m2", "coulomb_friction")]
    test = found["fit"]["test"]
    assert test["after"] < 0.05 * test["before"] and test["after"] < 2 * found["fit"]["noise_floor"]["nrmse"]
    assert (tmp_path / "diagnosis" / "report.html").exists()


def test_an_interrupted_diagnosis_says_so(files):
    code = "import sys; from pilfr_casadi.cli import main; sys.exit(main(sys.argv[1:]))"
    process = subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments(files, "--hold", "zero", "--initial", "zero"))],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert "simulator:" in process.stdout.readline()
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130 and "Traceback" not in err
    assert "nterrupted" in err + out


def test_each_recording_uses_its_own_column(capsys, files):
    """Two columns are given for a name, and each file has one of them."""
    (files / "other.csv").write_text((files / "test.csv").read_text().replace("force", "Force (N)", 1))
    both = ("--column", "force=force", "--column", "force=Force (N)")
    status, _, err = run(capsys, "check", files / "rig.py", files / "train.csv", files / "other.csv", *both)
    assert status == 0, err
    header = "t,force,Force (N),position"
    rows = (files / "test.csv").read_text().splitlines()[1:]
    doubled = [",".join([*row.split(",")[:2], *row.split(",")[1:]]) for row in rows]
    (files / "other.csv").write_text("\n".join([header, *doubled]) + "\n")
    refused(capsys, "check", files / "rig.py", files / "other.csv", *both, says="which --column gives for force")


def test_refused_recordings_leave_no_folder(capsys, files, truth):
    force, position = truth["train"]
    write_csv(files / "constant.csv", force, np.full_like(position, 0.25))
    write_csv(files / "short.csv", force[:5], position[:5])
    out = files / "new" / "out"
    for command in ("diagnose", "check"):
        for name in ("constant", "short"):
            status, _, err = run(capsys, command, files / "rig.py", files / f"{name}.csv", "--out", out)
            assert status == 2 and err.count("pilfr: ") == 1
            assert not out.parent.exists()


def test_an_export_begins_at_the_given_state(capsys, files):
    command = ("export", files / "rig.py", "--c", "--dt", 0.02, "--out", files / "c")
    status, out, _ = run(capsys, *command)
    assert status == 0 and "begins with every state at zero; give other values with --initial" in out
    command = (*command, "--overwrite")
    status, out, _ = run(capsys, *command, "--initial", "0.125,0.5")
    assert status == 0 and "note" not in out
    status, out, _ = run(capsys, *command, "--initial", "0.125,0.5", "--hold", "next")
    assert status == 0 and "the input of a step acts until the next one" in out
    assert "0.125" in (files / "c" / "model.c").read_text()
    status, _, err = run(capsys, *command, "--initial", "estimate")
    assert status == 2 and "--initial estimate needs a recording" in err


def test_a_missing_unit_is_a_missing_file(capsys, files):
    status, _, err = run(capsys, "diagnose", files / "none.fmu", files / "train.csv", "--out", files / "out")
    assert status == 2 and "there is no file" in err and "mock-up" not in err
