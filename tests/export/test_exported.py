"""Exported steps: names, start state, files that need no package, continuous time, error messages."""

import ast
import ctypes
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from command_line import refused, run
from exported_fits import CASES, lfr, mass_on_spring, one_sentence, own_model, recording_for, signed, some_fit, wave
from scipy.integrate import solve_ivp

from pilfr_casadi import InputError, Parameter, Play, PrandtlIshlinskii, Recording, Simulator, exported, to_casadi
from pilfr_casadi.data import nrmse, read_csv
from pilfr_casadi.diagnose import Diagnosis, diagnose
from pilfr_casadi.engine import compiler
from pilfr_casadi.identify import load
from pilfr_casadi.laws import Backlash, Delay, Drift, PreslidingFriction, Relaxation, StopHysteresis
from pilfr_casadi.models import PILFR
from pilfr_casadi.simulators import load_simulator

needs_compiler = pytest.mark.skipif(compiler() is None, reason="no C compiler")


def laws_in_ports():
    """A simulator with memory, an own state and time, each from a law of its own."""
    held = StopHysteresis({"w": 5.0, "r": np.linspace(0.1, 0.6, 6)})
    simulator = mass_on_spring().with_element("ground", held)
    simulator = simulator.with_element("ground", Relaxation({"k_v": 2.0, "T": 0.3}))
    return simulator.with_element("sensor:y", Drift({"a": 0.1, "b": 0.0}))


def test_every_state_of_a_fit_has_a_name():
    fitted = some_fit("stops, two channels")
    found = exported(fitted)
    assert list(found.states) == [*fitted.model.states, *(f"memory[{i},{j}]" for i in range(2) for j in range(3))]
    assert found.states["memory[1,2]"] == 7
    r = fitted.parameters["r"]
    assert found.thresholds == {f"memory[{i},{j}]": r[i, j] for i in range(2) for j in range(3)}
    assert (found.inputs, found.outputs, found.dt) == (("a", "b"), ("x", "y", "z"), fitted.dt)
    assert found.units == {"a": "V", "x": "µm"} and found.rhs is None
    assert "memory[1,2]" in str(found) and "a [V]" in str(found)
    # a memory goes where its name says: only what belongs to the second channel moves its play
    x = np.zeros(len(found.states))
    x[found.states["memory[1,2]"]] = 100.0
    moved = np.asarray(found.step(x, np.zeros(2))[0]).ravel() - np.asarray(found.step(0 * x, np.zeros(2))[0]).ravel()
    memory = {name: moved[i] for name, i in found.states.items() if name.startswith("memory")}
    assert [name for name, value in memory.items() if value] == ["memory[1,2]"]


def test_every_state_of_a_simulator_has_a_name():
    found = exported(laws_in_ports(), dt=0.02)
    memory = [f"ground.memory{k}" for k in range(1, 7)]
    assert list(found.states) == ["pos", "vel", "ground#2.q1", *memory, "time"]
    assert list(found.thresholds.values()) == pytest.approx(np.linspace(0.1, 0.6, 6))
    x = found.x0()
    for _ in range(3):
        x = found.step(x, 1.0)[0]
    x = np.asarray(x).ravel()
    assert x[found.states["time"]] == pytest.approx(0.06) and x[found.states["pos"]] > 0
    inside = x[found.states["ground.memory1"]]
    assert abs(inside - x[found.states["pos"]]) <= 0.1 + 1e-12


def test_names_that_are_there_already_get_an_underscore():
    dynamics, outputs = (lambda x, u, t: dict(time=u.f - x.time + t)), (lambda x: dict(y=x.time))
    simulator = Simulator(dynamics, outputs, states=("time",), inputs=("f", "f_next"))
    found = exported(simulator, dt=0.1, hold="linear")
    assert exported(simulator, dt=0.1, hold="band-limited").step.serialize() == found.step.serialize()
    assert list(found.states) == ["time", "time_"]
    assert found.inputs == ("f", "f_next", "f_next_", "f_next_next")


def test_where_it_starts():
    fitted, rng = lfr(Play, 2, 3), np.random.default_rng(0)
    data = recording_for(fitted, 200, initial="zero")
    assert np.array_equal(exported(fitted).x0(), np.zeros(5))
    state = rng.normal(size=5)
    assert np.array_equal(exported(fitted, start=state).x0(), state)
    assert np.array_equal(exported(fitted, start=state[:2]).x0(), [*state[:2], 0, 0, 0])
    y = fitted.simulate(data.with_(initial=state))
    measured = data.with_(y=y, initial="estimate")
    assert np.array_equal(exported(fitted, start=measured).x0(), fitted.initial_state(measured))
    found = exported(fitted, start=state)
    found.x0()[:] = 7.0  # a copy
    assert np.array_equal(found.x0(), state)
    simulator = mass_on_spring()
    release = wave(simulator, 0.02).with_(initial=np.array([0.3, -0.1]))
    assert np.array_equal(exported(simulator, dt=0.02, start=release).x0(), [0.3, -0.1])
    with pytest.raises(InputError, match=r"has 3 numbers; give 2\."):
        exported(simulator, dt=0.02, start=np.zeros(3))


def test_a_diagnosis_exports_what_it_fitted():
    simulator, data = laws_in_ports(), wave(mass_on_spring(), 0.02)
    empty = dict.fromkeys(("sentence", "effects", "candidates", "mismatch", "parameters", "errors", "floor"))
    diagnosis = Diagnosis(
        verdict="complete",
        gates=(),
        **empty,
        corrected=simulator,
        refitted=simulator,
        hold="linear",
        train=(data,),
        substeps=3,
    )
    step, wanted = diagnosis.to_casadi("rig"), exported(simulator, dt=0.02, hold="linear", substeps=3).step
    x, u = np.random.default_rng(0).normal(size=10), np.array([1.0, 2.0])
    assert step.name() == "rig"
    for of in (step, to_casadi(diagnosis), diagnosis.export().step):
        assert all(np.array_equal(*map(np.asarray, pair)) for pair in zip(of(x, u), wanted(x, u), strict=True))
    assert diagnosis.to_casadi(smooth=0.1)(x, u)[0][1] != wanted(x, u)[0][1]
    with pytest.raises(InputError, match="leave dt, hold and substeps out") as error:
        exported(diagnosis, dt=0.02)
    one_sentence(error)


@pytest.mark.slow
def test_a_real_diagnosis_exports_what_it_judged():
    simulator = load_simulator("pilfr_casadi/cli/demo_data/rig.py")
    known = {"inputs": "force", "outputs": "x2", "initial": "zero", "hold": "zero"}
    train, test = (read_csv(f"pilfr_casadi/cli/demo_data/rig_{name}.csv", **known) for name in ("train", "test"))
    diagnosis = diagnose(simulator, train, test=test, laws=(PreslidingFriction,))
    found = diagnosis.export(name="rig")
    assert found.substeps == diagnosis.substeps > 1 and "ground-m2.memory1" in found.states
    assert found.units["x2"] == "m"
    for kind, recording in (("train", train), ("test", test)):
        x, rows = found.x0(), []
        for u in recording.u:
            x, y = found.step(x, u)
            rows.append(np.asarray(y).ravel())
        error = nrmse(recording.y, np.array(rows))
        assert error == pytest.approx(diagnosis.errors[kind]["after"], rel=1e-6)


READER = """
import sys
sys.modules["pilfr_casadi"] = None  # an import of the package fails
import json
import casadi as ca
step = ca.Function.load("rig.casadi")
names = json.load(open("rig.casadi.names.json", encoding="utf-8"))
x, out = names["x0"], []
for k in range(5):
    result = step(x=x, u=[k / 3])
    x = result["x_next"]
    out.append(float(result["y"]))
print(json.dumps([out, names["states"], names["units"], names["dt"]]))
"""


@pytest.mark.parametrize("many", [False, True])
def test_files_are_read_without_the_package(tmp_path, many):
    if many:
        found = exported(laws_in_ports(), dt=0.02, substeps=9, name="rig")
    else:
        found = exported(some_fit(), start=np.arange(7) / 9, name="rig")
    found.serialize(tmp_path / "rig.casadi")
    done = subprocess.run([sys.executable, "-c", READER], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    y, states, units, dt = json.loads(done.stdout)
    x, expected = found.x0(), []
    for k in range(5):
        x, output = found.step(x, k / 3)
        expected.append(float(output))
    assert y == expected and states == found.states and units == found.units and dt == found.dt


def test_files_that_cannot_be_written(tmp_path):
    found = exported(some_fit())
    for write in (found.serialize, found.to_c):
        (tmp_path / "file").write_text("")
        with pytest.raises(InputError) as error:
            write(tmp_path / "file" / "rig")
        one_sentence(error)


@needs_compiler
@pytest.mark.parametrize("flags", [("-O2", "-Wextra", "-pedantic"), ("-O0",)])
def test_hostile_names_stay_names(tmp_path, flags):
    """Names come from files, and nothing in them may reach the compiler as code."""
    names = ('a" */ #error\n"', "b\\", "*/ int evil(void) { return 1; } /*", "a b", "a-b", "??/", "µ*//*", "\u202e", "")
    structure = PILFR(1, PrandtlIshlinskii(Play, 2))
    values = {"A": 0.5, "B_u": np.ones((1, len(names) - 1)), "C_z": 1.0, "D_yw": 1.0}
    model = structure.model(len(names) - 1, 1, values, inputs=names[:-1], outputs=("*/\nint evil;",))
    units = {names[0]: "*/ #error \\\n", names[1]: "?\\\n"}
    fitted = replace(some_fit(), model=model, structure=structure, initial={}, units=units)
    found = exported(fitted, name="main")
    source, header = found.to_c(tmp_path)
    command = [compiler(), "-std=c99", "-Wall", "-Werror", *flags, "-fPIC", "-shared", "-o", tmp_path / "main.so"]
    done = subprocess.run([*command, source, "-lm"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    library = ctypes.CDLL(str(tmp_path / "main.so"))
    assert not hasattr(library, "evil") and hasattr(library, "main_step")
    text = header.read_text(encoding="utf-8")
    constants = [line.split()[1] for line in text.splitlines() if line.startswith("#define MAIN_U_")]
    assert len(set(constants)) == len(names) - 1
    assert "#error" not in [word for line in text.splitlines() for word in line.split()[:1]]


@needs_compiler
def test_c_for_a_program(tmp_path):
    """Use the header as a C programmer would: constants by name, and the state stepped in place."""
    found = exported(lfr(Play, 2, 3), name="rig", start=np.arange(5) / 7)
    found.to_c(tmp_path)
    (tmp_path / "main.c").write_text(
        '#include <stdio.h>\n#include "rig.h"\nint main(void) {\n  double x[RIG_NX], u[RIG_NU] = {0}, y[RIG_NY];\n'
        '  int k;\n  rig_x0(x);\n  printf("%.17g\\n", x[RIG_X_MEMORY_0_2]);\n'
        "  for (k = 0; k < 50; k++) {\n    u[RIG_U_U] = k * RIG_DT;\n    rig_step(x, u, x, y);\n"
        '    printf("%.17g\\n", y[RIG_Y_Y]);\n  }\n  return 0;\n}\n'
    )
    command = [compiler(), "-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "main.c", "rig.c", "-lm"]
    subprocess.run([*command, "-o", "rig"], cwd=tmp_path, check=True, capture_output=True)
    done = subprocess.run(["./rig"], cwd=tmp_path, capture_output=True, text=True, check=True)
    memory, *y = map(float, done.stdout.split())
    x, expected = found.x0(), []
    for k in range(50):
        x, output = found.step(x, k * 0.01)
        expected.append(float(output))
    assert memory == found.x0()[found.states["memory[0,2]"]]
    np.testing.assert_allclose(y, expected, rtol=1e-12)


def test_continuous_time_where_there_is_one():
    simulator = mass_on_spring().with_element("ground", Relaxation({"k_v": 2.0, "T": 0.3}))
    found = exported(simulator, dt=0.02, substeps=4)
    assert (found.rhs.name_in(), found.rhs.name_out()) == (["x", "u"], ["xdot", "y"])
    x = np.array([0.2, -0.1, 0.05])
    path = solve_ivp(lambda t, x: np.asarray(found.rhs(x, 3.0)[0]).ravel(), (0, 0.02), x, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(np.asarray(found.step(x, 3.0)[0]).ravel(), path.y[:, -1], rtol=1e-6, atol=1e-9)
    assert found.rhs(x, 3.0)[1] == found.step(x, 3.0)[1]
    timed = exported(mass_on_spring().with_element("sensor:y", Drift({"a": 0.1, "b": 0.0})), dt=0.02).rhs
    assert timed.name_in() == ["x", "u", "t"] and float(timed([0.0, 0.0], 0.0, 3.0)[1]) == pytest.approx(0.3)
    backlash = mass_on_spring().with_element("actuator:force", Backlash({"r": 0.1}))
    assert exported(backlash, dt=0.02).rhs is None
    discrete = Simulator(lambda x, u: dict(a=0.5 * x.a + u.f), lambda x: dict(y=x.a), ("a",), ("f",), discrete=True)
    assert exported(discrete, dt=1.0).rhs is None


def test_a_simulator_without_inputs_and_one_without_states(tmp_path):
    ringing = Simulator(lambda x: dict(a=x.b, b=-800 * x.a), lambda x: dict(y=x.a), ("a", "b"))
    found = exported(ringing, dt=0.1)
    assert (found.inputs, found.substeps) == ((), 12)
    assert float(found.step([1.0, 0.0], [])[0][0]) == pytest.approx(np.cos(np.sqrt(8.0)), abs=1e-4)
    device = exported(Simulator({}.get, lambda u: dict(y=2 * u.v), (), ("v",)), dt=0.1, name="device")
    assert (device.states, device.x0().size, float(device.step([], 3.0)[1])) == ({}, 0, 6.0)
    assert "#define DEVICE_NX 0" in device.to_c(tmp_path)[1].read_text()


REFUSED = {
    "what": (lambda: exported(3), "a int was given; give a Fit"),
    "class": (lambda: exported(Simulator, dt=0.1), "a class was given"),
    "name": (lambda: exported(some_fit(), name="a b"), "cannot be used"),
    "quotes": (lambda: exported(some_fit(), name='a";'), "cannot be used"),
    "smooth": (lambda: exported(some_fit(), smooth=-1.0), "smooth = -1.0 was given"),
    "smooth nan": (lambda: exported(some_fit(), smooth=float("nan")), "smooth = nan was given"),
    "dt": (lambda: exported(mass_on_spring()), "dt=None was given"),
    "dt zero": (lambda: exported(mass_on_spring(), dt=0.0), "dt=0.0 was given"),
    "other dt": (lambda: exported(some_fit(), dt=0.1), "the fit's step is"),
    "hold": (lambda: exported(mass_on_spring(), dt=0.1, hold="cubic"), "hold is 'cubic'"),
    "hold of a fit": (lambda: exported(some_fit(), hold="zero"), "are for simulators"),
    "substeps": (
        lambda: exported(mass_on_spring(), dt=0.1, substeps=0),
        "substeps is 0; give a whole number, 1 or more",
    ),
    "start": (lambda: exported(some_fit(), start=np.zeros(4)), "has 4 numbers; give 3 .* or 7"),
    "start nan": (lambda: exported(some_fit(), start=[np.nan] * 3), "finite numbers"),
    "start text": (lambda: exported(some_fit(), start="zero"), "give numbers"),
    "recording": (lambda: exported(mass_on_spring(), dt=0.1, start=recording_for(some_fit())), "has no input"),
    "step": (lambda: exported(mass_on_spring(), dt=0.1, start=wave(mass_on_spring(), 0.2)), "step is 0.2 s"),
    "bound": (lambda: exported(some_fit()).bound(np.zeros(3), [0.0]), "3 numbers were given for the state; expected 7"),
    "fast": (
        lambda: exported(
            Simulator(lambda x, u: dict(a=u.f - 1e9 * x.a), lambda x: dict(y=x.a), ("a",), ("f",)), dt=1.0
        ),
        "too fast",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_in_one_sentence(case):
    action, words = REFUSED[case]
    with pytest.raises(InputError, match=words) as error:
        action()
    one_sentence(error)


HOSTILE = (
    "__import__('os').system('touch evil')",
    "{0.__class__}",
    "%s%n",
    '"); system("touch evil"); //',
    "$(touch evil)",
)


@pytest.mark.parametrize("text", HOSTILE)
def test_no_code_is_run_from_a_model_file(tmp_path, monkeypatch, text):
    monkeypatch.chdir(tmp_path)
    some_fit().save("model.json")
    content = json.loads((tmp_path / "model.json").read_text())
    signals, training = content["model"], content["training"]
    signals["inputs"][0] |= {"name": text, "unit": text}
    signals["outputs"][0]["unit"] = training["message"] = content["written_by"]["casadi"] = text
    signals["states"] = [text] * len(signals["states"])
    training["active"] = [text]
    (tmp_path / "model.json").write_text(json.dumps(signed(content)))
    fitted = load("model.json")
    found = exported(fitted, name="rig")
    assert text in str(fitted) and text in str(found)
    found.serialize("rig.casadi")
    source, header = found.to_c("c")
    found.to_control()
    code = [re.sub(r"/\*.*?\*/", "", p.read_text(encoding="utf-8"), flags=re.S) for p in (source, header)]
    assert not any(word in part for part in code for word in ("evil", "system", text))  # but as RIG_U_SYSTEM_TOUCH_EVIL
    for key in ("operator", "kind"):
        content["structure"]["element"][key] = text
        (tmp_path / "model.json").write_text(json.dumps(signed(content)))
        with pytest.raises(InputError) as error:
            load("model.json")
        one_sentence(error)
    assert not list(tmp_path.rglob("evil"))


RUNS_PROGRAMS = ("user_file.py",)  # simulators/user_file runs the user's simulator file
TALKS_TO_ITS_CHILD = (
    "workers.py",
    "fmu_process.py",
    "fmu_function.py",
)  # the last loads a library that it has compiled


def test_the_package_runs_no_text_but_the_users_own_program():
    """`eval`, `exec` and unpickling occur only where a simulator's file, a program of the user, is run."""
    package = Path(exported.__code__.co_filename).parents[1]
    for path in package.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id not in ("eval", "exec", "compile", "__import__") or path.name in RUNS_PROGRAMS
            if isinstance(node, ast.Attribute):
                assert (
                    node.attr not in ("loads", "Unpickler", "external")
                    or ast.unparse(node)
                    in (
                        "json.loads",
                        "tomllib.loads",
                    )
                    or path.name in TALKS_TO_ITS_CHILD
                ), path  # between a process and its own child
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "np.load":
                assert any(k.arg == "allow_pickle" and k.value.value is False for k in node.keywords), path


def test_an_open_port_is_refused():
    from pilfr_casadi.models import ParameterSet, open_model

    p = ParameterSet({"k": Parameter(1.0)})
    model = open_model(lambda x, u, w, p: (x + w, x), lambda x, u, p: x, p, n_x=1, n_u=1, n_w=1)
    with pytest.raises(InputError, match="open port"):
        exported(model, dt=0.1)
    assert list(exported(own_model(2), dt=0.1).states) == ["x", "memory[0,0]", "memory[0,1]"]


def test_the_command(tmp_path, capsys):
    some_fit().save(tmp_path / "model.json")
    model, out = tmp_path / "model.json", tmp_path / "rig"
    assert run(capsys, "export", model, "--casadi", "--out", out, "--name", "rig", "--smooth", "0.01")[0] == 0
    names = json.loads((tmp_path / "rig.names.json").read_text())
    assert (ca.Function.load(str(out)).name(), names["smooth"]) == ("rig", 0.01)
    status, text, _ = run(capsys, "export", model, "--c", "--out", tmp_path / "c", "--name", "rig")
    assert status == 0 and (tmp_path / "c" / "rig.h").exists() and str(tmp_path / "c" / "rig.c") in text
    rig = "pilfr_casadi/cli/demo_data/rig.py"
    assert run(capsys, "export", rig, "--dt", "0.01", "--hold", "zero", "--out", tmp_path / "simulator")[0] == 0
    assert list(json.loads((tmp_path / "simulator.names.json").read_text())["states"]) == ["x1", "v1", "x2", "v2"]
    refused(capsys, "export", rig, "--out", out, says="--dt")
    refused(capsys, "export", model, "--dt", "1", "--out", out, says="--dt")
    refused(capsys, "export", model, "--out", model, says="overwrite")
    refused(capsys, "export", model, "--out", tmp_path / "no" / "rig", says="folder that exists")
    refused(capsys, "export", model, "--c", "--out", model, says="cannot be written")
    refused(capsys, "export", model, "--out", tmp_path / "new", "--name", "a b", says="cannot be used")
    refused(capsys, "export", model, "--out", tmp_path / "new", "--smooth", "-1", says="smooth")
    content = json.loads(model.read_text())
    for text, says in ((json.dumps(content | {"version": 3}), "version 3"), (model.read_text()[:900], "incomplete")):
        (tmp_path / "other.json").write_text(text)
        refused(capsys, "export", tmp_path / "other.json", "--out", out, says=says)
    (tmp_path / "model.json.names.json").write_text(model.read_text())
    refused(capsys, "export", tmp_path / "model.json.names.json", "--out", model, says="overwrite")


def test_a_recording_only_of_inputs_starts_a_fit_at_zero():
    fitted = lfr(Play, 2, 3)
    data = Recording(np.ones((10, 1)), np.zeros((10, 0)), 0.01, initial="zero")
    assert np.array_equal(exported(fitted, start=data).x0(), np.zeros(5))


@pytest.mark.parametrize(
    "engine", ["vm", pytest.param("c", marks=pytest.mark.skipif(compiler() is None, reason="no C compiler"))]
)
@pytest.mark.parametrize("case", CASES)
def test_the_exported_function_steps_like_the_fit(case, engine):
    fitted = some_fit(case, engine=engine)
    x0 = np.random.default_rng(5).normal(size=fitted.model.n_x + fitted.model.n_s)
    data = recording_for(fitted, 1000, initial=x0 if len(x0) else "zero")
    data = data.with_(u=data.u / 20)
    step = to_casadi(fitted)
    assert (step.name(), step.name_in(), step.name_out()) == ("model", ["x", "u"], ["x_next", "y"])
    x, rows = fitted.initial_state(data), []
    for u in data.u:
        out = step(x=x, u=u)
        x = out["x_next"]
        rows.append(np.asarray(out["y"]).ravel())
    expected = fitted.simulate(data)
    assert np.max(np.abs(rows - expected)) <= 1e-12 * max(1.0, np.max(np.abs(expected)))


def test_states_come_before_memory_channel_by_channel():
    structure = PILFR(1, PrandtlIshlinskii(Play, 2, 2), fixed={"B_w": 0.0})
    values = {"A": 0.5, "C_z": 0.0, "D_zu": np.array([[1.0], [-2.0]]), "r": np.array([[0.1, 0.2], [0.3, 0.4]])}
    fitted = replace(some_fit(), model=structure.model(1, 1, values), structure=structure)
    x_next, _ = fitted.to_casadi("rig")(np.array([8.0, 0, 0, 0, 0]), 1.0)
    assert np.asarray(x_next).ravel() == pytest.approx([4.0, 0.9, 0.8, -1.7, -1.6], abs=1e-15)
    assert fitted.to_casadi("rig").name() == "rig"


@pytest.mark.parametrize("name", ["", "two words", "1st", "a__b", "null"])
def test_a_name_that_casadi_does_not_take(name):
    with pytest.raises(InputError, match="cannot be used") as error:
        to_casadi(some_fit(), name)
    one_sentence(error)


NOT_PATHS = [None, 3, b"x", "", "a\0b", ["a"], "x" * 5000]


def refused_with(call, words=None):
    with pytest.raises(InputError, match=words) as error:
        call()
    text = one_sentence(error)
    assert len(text) < 500, text
    return text


@pytest.mark.parametrize("eps", [1e200, np.inf, -1.0, "a", None, True])
def test_rounding_that_cannot_be_used(eps):
    refused_with(lambda: some_fit().export(smooth=eps), "give a number, from zero to 1e\\+100")


def test_what_cannot_be_bounded_has_no_bound():
    found = some_fit().export(smooth=1e100)
    states, outputs = found.bound(np.full(len(found.states), 1e200), [1e200])
    assert not np.any(np.isnan(states)) and not np.any(np.isnan(outputs))


@pytest.mark.parametrize("path", NOT_PATHS, ids=[str(k) for k in range(len(NOT_PATHS))])
def test_paths_that_are_none(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fitted = some_fit()
    found = fitted.export(name="rig")
    for call in (found.to_c, found.serialize, fitted.save, load):
        refused_with(lambda call=call: call(path))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (None, "letters, digits"),
        (3, "letters, digits"),
        ("Ä", "letters, digits"),
        ("a-b", "letters, digits"),
        ("_a", "letters, digits"),
        ("x" * 51, "has 51 characters; give at most 50"),
        ("x" * 5000, "has 5000 characters"),
        ("double", "a C keyword"),
        ("Register", "a C keyword"),
        ("class", "a C keyword"),
        ("math", "one of C's headers"),
        ("stdio", "one of C's headers"),
    ],
)
def test_names_that_cannot_be_used(name, words):
    refused_with(lambda: some_fit().export(name=name), words)


@needs_compiler
@pytest.mark.parametrize("name", ["x", "exp", "main", "arg", "now", "i", "casadi_real", "NULL", "rig_", "a" * 50])
def test_odd_names_compile_beside_each_other_and_step(name, tmp_path):
    found = some_fit().export(name=name)
    source, _ = found.to_c(tmp_path)
    user = f'#include "{name}.h"\nint used(void) {{ double x[{name.upper()}_NX]; {name}_x0(x); return x[0] == 0.0; }}\n'
    (tmp_path / "user.c").write_text(user)
    library = tmp_path / "both.so"
    strict = ["-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-pedantic", "-shared", "-fPIC", f"-I{tmp_path}"]
    subprocess.run([compiler(), *strict, source, tmp_path / "user.c", "-o", library, "-lm"], check=True)
    code = ctypes.CDLL(str(library))
    assert code.used() == 1
    x, u, following, y = (np.zeros(n) for n in (7, 1, 7, 1))
    u[0] = 0.3
    pointers = [v.ctypes.data_as(ctypes.c_void_p) for v in (x, u, following, y)]
    getattr(code, f"{name}_step")(*pointers)
    expected = found.step(np.zeros(7), 0.3)
    assert np.array_equal(following, np.asarray(expected[0]).ravel()) and y[0] == float(expected[1])


@needs_compiler
def test_signals_that_differ_only_in_what_c_does_not_allow_keep_their_own_index(tmp_path):
    structure = some_fit("stops, two channels").structure
    names = {"inputs": ("a-b", "a b"), "outputs": ("µ", "?", "A_B")}
    model = structure.model(2, 3, **names)
    found = replace(some_fit("stops, two channels"), model=model, units={"a-b": "*/ int evil; /*"}).export(name="rig")
    _, header = found.to_c(tmp_path)
    for kind, count in (("U", 2), ("Y", 3), ("X", len(found.states))):
        lines = [line.split() for line in header.read_text().splitlines() if line.startswith(f"#define RIG_{kind}_")]
        assert [int(line[2]) for line in lines] == list(range(count))
        assert len({line[1] for line in lines}) == count
    subprocess.run([compiler(), "-std=c99", "-Werror", "-fsyntax-only", "-xc", header], check=True)


@pytest.mark.parametrize(
    ("start", "words"),
    [
        ("a", "numbers"),
        ({}, "numbers"),
        ([[1], [2, 3]], "numbers"),
        (np.zeros(7) * 1j, "numbers"),
        (["1"] * 7, "numbers"),
        ([np.nan] * 7, "not finite"),
        ([1.0], "has 1 numbers; give 3"),
        (np.zeros(8), "has 8 numbers"),
    ],
)
def test_start_states_that_are_none(start, words):
    assert "start state" in refused_with(lambda: some_fit().export(start=start), words)


@pytest.mark.parametrize(
    "options",
    [
        {"smooth": True},
        {"smooth": None},
        {"smooth": np.nan},
        {"smooth": [1.0]},
        {"substeps": "a"},
        {"substeps": [2]},
        {"substeps": True},
        {"substeps": 1.5},
        {"dt": True},
        {"dt": "a"},
        {"hold": 3},
    ],
    ids=str,
)
def test_options_that_are_none(options):
    refused_with(lambda: exported(mass_on_spring(), **({"dt": 0.02} | options)), next(iter(options)))


@pytest.mark.parametrize(
    ("x", "u", "words"),
    [
        ("a", 0.0, "The state"),
        ([np.nan] * 7, 0.0, "The state"),
        (np.zeros(7), None, "The input"),
        (np.zeros(7), [0.0, 1.0], "2 numbers were given for the input; expected 1"),
    ],
)
def test_bounds_where_there_are_no_numbers(x, u, words):
    refused_with(lambda: some_fit().export(smooth=0.1).bound(x, u), words)


@pytest.mark.parametrize(
    "given, words",
    [
        (([0, 0], [1]), "The state x of a step of model has 7 entries; the shape (2,) was given."),
        ((0.0, [1]), "has 7 entries; one number was given."),
        ((np.zeros((2, 7)), [1]), "the shape (2, 7)"),
        ((np.zeros(7), [1, 2]), "The input u of a step of model has 1 entry; the shape (2,)"),
        ((np.zeros(7), None), "The input u"),
        ((np.zeros(7),), "needs x and u"),
        ((np.zeros(7), 1, 2), "needs x and u"),
        ((ca.SX.sym("x", 2), 1.0), "the shape (2, 1)"),
    ],
)
def test_a_step_refuses_what_does_not_fit(given, words):
    refused_with(lambda: some_fit().export().step(*given), re.escape(words))


def test_a_step_takes_what_fits():
    step, x = some_fit().export().step, np.linspace(0.1, 0.7, 7)
    refused_with(lambda: step(x=x), "needs x and u")
    following, y = (np.asarray(v) for v in step(x, 0.3))
    for other in (step(x[None], [0.3]), step(ca.DM(x), ca.DM(0.3)), tuple(step(x=x, u=0.3).values())):
        assert np.array_equal(np.asarray(other[0]).ravel(), following.ravel()) and float(other[1]) == y.item()
    assert step(np.tile(x[:, None], 3), np.full((1, 3), 0.3))[0].shape == (7, 3)
    assert step(ca.MX.sym("x", 7), ca.MX.sym("u"))[1].shape == (1, 1)


def test_a_long_memory_is_one_entry_of_the_print():
    delayed = mass_on_spring().with_element("sensor:y", Delay().at({"T": 0.5}))
    text = str(exported(delayed, dt=0.05))
    assert re.search(r"sensor:y\.memory1\.\.\d+ \(\d+ states\)", text) and "memory2" not in text
