"""Simulators from functional mock-up units: the numbers of their equations, ports, parameters, error messages."""

import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from dataclasses import replace

import casadi as ca
import cloudpickle
import numpy as np
import pytest
from command_line import refused, run
from diagnosis_example import example
from exported_fits import one_sentence

from pilfr_casadi import InputError, Parameter, exported, fit, from_fmu
from pilfr_casadi._base import c_compiler
from pilfr_casadi.engine import VirtualMachine, compiler, make_engine
from pilfr_casadi.laws import CoulombFriction
from pilfr_casadi.report import corrected_file
from pilfr_casadi.simulators import (
    CoSimulation,
    discretise,
    fastest_rates,
    load_simulator,
    parse_port,
    stack,
    states_along,
)
from pilfr_casadi.simulators.fmu_function import FmuFunction
from problems.fmu_rig import FOLDER, GUIDE, PARAMETERS, c_rig, casadi_rig, description, recording, rig

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler")
DRY = {"F_c": 1.0, "v_0": 0.01}


@pytest.fixture(scope="module")
def units(tmp_path_factory):
    """Files of the rig: in C by FMI 2.0, and as CasADi exports it by FMI 3.0."""
    pytest.importorskip("fmpy")
    folder = tmp_path_factory.mktemp("units")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        return {"c": c_rig(folder / "c.fmu"), "casadi": casadi_rig(folder / "casadi.fmu")}


@pytest.fixture(params=["c", "casadi"])
def unit(request, units):
    return units[request.param]


def guided(path, **more):
    return from_fmu(path, ports=GUIDE, outputs=("pos1", "pos2"), **more)


def test_it_has_the_names_units_and_bounds_of_the_file(unit):
    simulator = from_fmu(unit)
    assert simulator.states == ("x1", "v1", "x2", "v2")
    assert simulator.inputs == ("force", "guide_force")
    assert simulator.output_names == ("pos1", "pos2", "vel1", "power")
    for name, (value, low, high) in PARAMETERS.items():
        p = simulator.parameters[name]
        assert (float(p.value), *map(float, p.bounds), bool(p.fixed)) == (value, low, high, False)
    assert simulator.parameters["k1"].unit == "N/m"
    assert {p.suffix for p in unit.parent.iterdir()} <= {".fmu", ".c", ".o", ".so", ".xml", ".h"}  # CasADi's export
    assert not [p for p in unit.parent.iterdir() if p.is_dir()]  # nothing is unpacked beside the file


def test_it_simulates_as_the_equations_do(unit):
    given = recording(0, samples=300)
    friction = CoulombFriction(DRY)
    for own, other in (
        (guided(unit), rig()),
        (guided(unit).with_element("guide", friction), rig().with_element("guide", friction)),
    ):
        assert np.abs(own.simulate(given) - other.simulate(given)).max() <= 1e-12 * np.ptp(given.y)


@pytest.mark.parametrize("engine", ["vm", "c"])
def test_sensitivities_are_those_of_the_equations(unit, engine):
    given = recording(1, samples=60)
    found = []
    for simulator in (guided(unit), rig()):
        model = discretise(simulator.with_element("guide", CoulombFriction(DRY)), given.dt, "zero", 1)
        own = make_engine(model, engine)
        assert isinstance(own, VirtualMachine) == (engine == "vm")
        p, n = model.parameters.start, model.n_state
        seed = np.zeros((n, len(p) + n))
        seed[:, len(p) :] = np.eye(n)
        found.append(own.sensitivity(model.drive(given), p, np.zeros(n), seed, np.arange(len(p)))[:2])
    (y, jac), (y_equations, jac_equations) = found
    assert np.abs(y - y_equations).max() <= 1e-12 * np.ptp(y)
    size = np.abs(jac_equations).max(axis=(0, 1))
    assert np.all(np.abs(jac - jac_equations).max(axis=(0, 1)) <= 1e-5 * size)


ELSEWHERE = """
import pickle, sys
import numpy as np
from pilfr_casadi.engine import make_engine
from pilfr_casadi.simulators import parse_port, CoSimulation, discretise
simulator, given = pickle.load(sys.stdin.buffer)
model = discretise(simulator, given.dt, "zero", 1)
y = make_engine(model).simulate(model.drive(given), model.parameters.start, np.zeros(model.n_state))[0]
sys.stdout.buffer.write(pickle.dumps(y))
"""


def test_it_survives_another_process(unit):
    given, simulator = recording(5, samples=40), guided(unit)
    job = cloudpickle.dumps((simulator, given))
    done = subprocess.run([sys.executable, "-c", ELSEWHERE], input=job, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    model = discretise(simulator, given.dt, "zero", 1)
    y = make_engine(model).simulate(model.drive(given), model.parameters.start, np.zeros(model.n_state))[0]
    assert np.array_equal(pickle.loads(done.stdout), y)


def test_a_port_enters_an_input_and_reads_outputs(unit):
    port = guided(unit).port("guide")
    assert port.into == pytest.approx({"v1": -1 / 1.2})
    x, *_ = guided(unit).symbols()
    assert str(port.across(x)) == "x1" and str(port.rate(x)) == "v1"
    assert guided(unit).inputs == ("force",)
    pair = {"both": {"into": {"force": -1.0, "guide_force": 0.5}, "across": "x2"}}
    assert from_fmu(unit, ports=pair, outputs=("pos1",)).port("both").into == pytest.approx({"v1": -0.5 / 1.2})
    assert [q.name for q in from_fmu(unit).all_ports()][:2] == ["equation:v1", "equation:v2"]


def test_parameters_and_bounds_can_be_chosen(unit):
    chosen = guided(unit, parameters=("k1",), bounds={"k1": (300, 500)})
    assert list(chosen.parameters) == ["k1"] and tuple(map(float, chosen.parameters["k1"].bounds)) == (300, 500)
    both = guided(unit, parameters=("k1",), bounds={"d1": (1, 3)}).parameters
    assert list(both) == ["k1", "d1"] and both["d1"].bounds == (1, 3)
    own = {"d1": Parameter(2.0, fixed=True), "k1": Parameter(380.0, fixed=True)}
    both = guided(unit, parameters=own, bounds={"d1": (1, 3), "k2": (900, 1100)}).parameters
    assert list(both) == ["d1", "k1", "k2"] and [bool(p.fixed) for p in both.values()] == [False, True, False]
    own = guided(unit, parameters={"d2": Parameter(2.0, fixed=True)})
    assert list(own.parameters) == ["d2"] and float(own.parameters["d2"].value) == 2.0
    given = recording(2, samples=100)
    equations = rig()
    changed = equations.with_parameters(equations.parameter_set.change(d2={"value": 2.0}))
    assert np.abs(own.simulate(given) - changed.simulate(given)).max() <= 1e-12 * np.ptp(given.y)


@pytest.mark.parametrize(
    "more, says",
    [
        ({"parameters": ("m3",)}, "has no 'm3' among its parameters; they are k1"),
        ({"cosimulation": CoSimulation(dt=0.01)}, "is for model exchange alone; leave it out"),
        ({"parameters": "m3"}, "has no 'm3' among its parameters; they are k1"),
        ({"inputs": ("moment",)}, "has no 'moment' among its inputs; they are force"),
        ({"outputs": ("acc",)}, "has no 'acc' among its outputs"),
        ({"bounds": {"k1": (1, 2)}}, "'k1' is 380, outside of its bounds 1 to 2"),
        ({"ports": {"guide": {"into": "guide", "across": "pos1"}}}, "has no 'guide' among its inputs"),
        ({"ports": {"guide": {"into": "guide_force", "across": "pos"}}}, "`across` of port 'guide' is 'pos'"),
        ({"ports": {"guide": {"into": "guide_force"}}}, "give dict"),
        ({"ports": {"guide": "guide_force"}}, "write NAME=INTO:ACROSS"),
        ({"ports": {"guide": 1}}, "give dict"),
        ({"ports": {"guide": {"into": "force", "across": "pos1", "speed": "v1"}}}, "the unknown key 'speed'"),
    ],
)
def test_wrong_names_are_refused_in_one_sentence(units, more, says):
    with pytest.raises(InputError) as error:
        from_fmu(units["c"], **more)
    assert says in one_sentence(error)


def test_an_input_that_is_no_force_is_refused(units):
    port = {"odd": {"into": "force", "across": "pos1"}}
    with pytest.raises(InputError, match="does not add up") as error:  # an output holds its square
        from_fmu(units["c"], ports=port)
    one_sentence(error)


NUMBER = (
    '<fmiModelDescription fmiVersion="2.0"><ModelVariables><ScalarVariable name="x" valueReference="one"><Real/>'
    "</ScalarVariable></ModelVariables></fmiModelDescription>"
)

EVENTS = description().replace('numberOfEventIndicators="0"', 'numberOfEventIndicators="two"')


def test_files_that_are_no_units_are_refused(tmp_path, units):
    def zipped(name, **files):
        with zipfile.ZipFile(tmp_path / name, "w") as archive:
            for path, text in files.items():
                archive.writestr(path, text)
        return tmp_path / name

    (tmp_path / "text.fmu").write_text("no archive")
    (tmp_path / "half.fmu").write_bytes(units["c"].read_bytes()[:2000])
    both = {"modelDescription.xml": description(), f"binaries/{FOLDER}/rig.so": "no program"}
    cases = {
        tmp_path / "text.fmu": "is not a functional mock-up unit",
        tmp_path / "half.fmu": "is not a functional mock-up unit",
        tmp_path / "none.fmu": "none.fmu",
        zipped("empty.fmu"): "is not a functional mock-up unit",
        zipped("broken.fmu", **{"modelDescription.xml": "<fmi"}): "is not a functional mock-up unit",
        zipped("number.fmu", **{"modelDescription.xml": NUMBER}): "is not a functional mock-up unit",
        zipped("events.fmu", **{"modelDescription.xml": EVENTS}): "is not a functional mock-up unit",
        zipped("bare.fmu", **{"modelDescription.xml": description()}): f"no platform; export it for {FOLDER}",
        zipped("program.fmu", **both): "cannot be evaluated",
        zipped(
            "events.fmu", **{"modelDescription.xml": description("ScheduledExecution")}
        ): "neither for model exchange",
        zipped("old.fmu", **{"modelDescription.xml": description(version="1.0")}): "FMI 1; give one of FMI 2.0",
        c_rig(tmp_path / "other.fmu", folder="win32"): f"has programs for win32; export it for {FOLDER}",
        c_rig(tmp_path / "crash.fmu", "CRASHES"): "ends the process that runs it",
    }
    for path, says in cases.items():
        with pytest.raises(InputError) as error:
            from_fmu(path)
        assert says in one_sentence(error), path


def test_what_calls_a_unit_cannot_become_a_file(tmp_path, units):
    step = exported(guided(units["c"]), dt=2e-3)
    given = recording(3, samples=50)
    x, found = step.x0(), []
    for u in given.u:
        x, y = step.step(x, u)
        found.append(np.asarray(y).ravel())
    assert np.abs(found - rig().simulate(given)).max() <= 1e-12 * np.ptp(given.y)
    for write in (lambda: step.to_c(tmp_path / "c"), lambda: step.to_fmu(tmp_path / "a.fmu")):
        with pytest.raises(InputError, match="call another program") as error:
            write()
        one_sentence(error)
    with pytest.raises(InputError, match="call another program"):
        step.serialize(tmp_path / "a.casadi")
    assert not list(tmp_path.iterdir())


def changed(path, *changes):
    """Change texts of a unit's description."""
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    text = files["modelDescription.xml"].decode()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in {**files, "modelDescription.xml": text}.items():
            archive.writestr(name, content)
    return path


def runs(simulator, given, **values):
    """Outputs by both engines at values of parameters."""
    own = simulator.parameter_set.change(**{name: {"value": value} for name, value in values.items()})
    model = discretise(simulator.with_parameters(own), given.dt, "zero", 1)
    job = model.drive(given), model.parameters.start, np.zeros(model.n_state)
    return [make_engine(model, engine).simulate(*job)[0] for engine in ("c", "vm")]


@pytest.mark.parametrize("failure", ["abort()", "exit(3)", pytest.param("for (;;)", marks=pytest.mark.slow)])
def test_a_parameter_at_which_the_unit_crashes_or_hangs_is_a_failed_trial(tmp_path, failure):
    given, unit = recording(6, samples=40), guided(c_rig(tmp_path / "a.fmu", f"FAILURE={failure}"))
    for y in runs(unit, given, k1=700.0):
        assert np.all(np.isnan(y[2:]))
    for y in runs(unit, given, k1=500.0):  # a new process
        assert np.all(np.isfinite(y))


FINITE_SAMPLES = """
import pickle, sys
import numpy as np
simulator, recordings = pickle.load(sys.stdin.buffer)
print([int(np.sum(np.isfinite(simulator.simulate(r)[:, 0]))) for r in recordings])
"""


def test_a_unit_that_refuses_a_second_instance_does_not_end_the_process_of_its_user(tmp_path):
    given = recording(6, samples=40)
    pushed = given.with_(u=given.u + 1e5)
    job = cloudpickle.dumps((guided(c_rig(tmp_path / "a.fmu", "SINGLE")), (given, pushed, given)))
    done = subprocess.run([sys.executable, "-c", FINITE_SAMPLES], input=job, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    whole, part, again = map(int, done.stdout.decode().strip("[]\n").split(","))
    assert whole == again == len(given) and 0 < part < len(given)


@pytest.mark.parametrize("compiler_name", ["", "none"])
def test_a_unit_that_crashes_at_a_state_does_not_end_the_process_of_its_user(tmp_path, compiler_name):
    """Without a compiler, single points are evaluated."""
    given = recording(6, samples=40)
    unit = guided(c_rig(tmp_path / "a.fmu", "FAILURE=abort()", "WHERE=(v[X1]>1)"))
    job = cloudpickle.dumps((unit, (given, given.with_(u=given.u + 1e5), given)))
    options = {**os.environ, "PILFR_COMPILER": compiler_name}
    command = [sys.executable, "-c", FINITE_SAMPLES]
    done = subprocess.run(command, input=job, capture_output=True, check=False, env=options)
    assert done.returncode == 0, done.stderr.decode()
    whole, part, again = map(int, done.stdout.decode().strip("[]\n").split(","))
    assert whole == again == len(given) and part < len(given)
    assert part > 0 or not compiler_name


def states_of(simulator, given):
    """States along a run, and the rates at some of them: points and steps of functions that call the unit."""
    model = discretise(simulator, given.dt, "zero", 1)
    x = states_along(model, model.drive(given), model.parameters.start, np.zeros(model.n_state))
    return x, fastest_rates(simulator, x, given.u, model.parameters.start)


def test_many_points_are_one_job_for_the_process_of_a_unit(units, monkeypatch):
    own, given = guided(units["c"]), recording(8, samples=300)
    monkeypatch.setattr(FmuFunction, "evaluate", lambda *_: pytest.fail("a single point was evaluated"))
    for found, expected in zip(states_of(own, given), states_of(rig(), given), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-12)


def test_libraries_that_the_cache_has_dropped_are_built_again(units, tmp_path, monkeypatch):
    """A process of the unit loads them at its first run, which may come long after."""
    cache = tmp_path / "cache"
    cache.mkdir()
    monkeypatch.setattr(c_compiler, "cache_directory", lambda: cache)
    given, found = recording(8, samples=60), []
    for simulator in (guided(units["c"]), rig()):
        model = discretise(simulator, given.dt, "zero", 1)
        engine = make_engine(model, "c")
        shutil.rmtree(cache, ignore_errors=True)
        y = engine.simulate(model.drive(given), model.parameters.start, np.zeros(model.n_state))[0]
        shutil.rmtree(cache, ignore_errors=True)
        found.append((y, *states_of(simulator, given)))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-12)


def test_a_point_at_which_a_unit_crashes_is_a_failed_trial(tmp_path):
    own, given = guided(c_rig(tmp_path / "a.fmu", "FAILURE=abort()", "WHERE=(v[X1]>1)")), recording(8, samples=20)
    x = np.zeros((20, 4))
    x[19, 0] = 2.0
    rates = fastest_rates(own, x, given.u, own.parameter_set.start)
    assert np.flatnonzero(~np.isfinite(rates)).tolist() == [19]


def test_a_unit_that_crashes_after_many_calls_is_called_in_a_new_process(tmp_path):
    counted = "{ static long calls; if (++calls > 2000) abort(); }"
    own, given = guided(c_rig(tmp_path / "a.fmu", f"FAILURE={counted}", "WHERE=1")), recording(6, samples=40)
    for _ in range(10):
        assert np.all(np.isfinite(own.simulate(given)))


def test_a_change_of_a_fixed_parameter_costs_little_more_than_one_of_a_tunable_one(units):
    given, seconds = recording(8, samples=1000), {}
    for name in ("k1", "m1"):
        model = discretise(guided(units["c"], parameters=(name,)), given.dt, "zero", 1)
        engine, seed = make_engine(model), np.zeros((4, 1))
        job = model.drive(given), model.parameters.start, np.zeros(4), seed, np.zeros(1, dtype=int)
        for _ in range(3):
            began = time.perf_counter()
            engine.sensitivity(*job)
            seconds[name] = min(time.perf_counter() - began, seconds.get(name, np.inf))
    assert seconds["m1"] < 5 * seconds["k1"] + 0.02


BEGUN = """
import pickle, sys
simulator, given = pickle.load(sys.stdin.buffer)
simulator.simulate(given)
print("begun", flush=True)
{body}
"""


def begun(unit, given, folder, body, **variables):
    """A process that has simulated a recording, in a temporary folder of its own, and goes on with some lines."""
    options = {**os.environ, "TMPDIR": str(folder), **variables}
    command = [sys.executable, "-c", BEGUN.format(body=body)]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=options
    )
    process.stdin.write(cloudpickle.dumps((unit, given)))
    process.stdin.close()
    assert process.stdout.readline() == b"begun\n", process.stderr.read().decode()
    return process


@pytest.mark.parametrize("compiler_name", ["", "none"])
def test_ctrl_c_ends_a_run_in_which_the_unit_hangs(tmp_path, compiler_name):
    given, unit = recording(6, samples=40), guided(c_rig(tmp_path / "a.fmu", "FAILURE=for(;;)", "WHERE=(v[X1]>1)"))
    body = "simulator.simulate(given.with_(u=given.u + 1e5))"
    with begun(unit, given, tmp_path, body, PILFR_COMPILER=compiler_name) as process:
        time.sleep(1.0)
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        began = time.perf_counter()
        process.wait(30)
        assert b"KeyboardInterrupt" in process.stderr.read()
        assert time.perf_counter() - began < 4.0


@pytest.mark.parametrize("end", ["", "import os; os.kill(os.getpid(), 9)"])
def test_nothing_is_left_in_the_temporary_folder(tmp_path, units, end):
    folder = tmp_path / "temporary"
    folder.mkdir()
    with begun(guided(units["c"]), recording(6, samples=40), folder, end) as process:
        process.wait(30)
    for _ in range(50):
        if not list(folder.glob("pilfr-fmu-*")):
            return
        time.sleep(0.1)
    pytest.fail(f"{list(folder.iterdir())} is left")


def test_folders_of_killed_processes_are_removed(tmp_path, units):
    """Of running ones, never."""
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    dead, alive = (tmp_path / f"pilfr-fmu-{number}-x" for number in (gone.pid, os.getppid()))
    for folder in (dead, alive):
        folder.mkdir()
    with begun(guided(units["c"]), recording(6, samples=40), tmp_path, "") as process:
        process.wait(30)
    assert alive.exists() and not dead.exists()


def test_a_unit_that_crashes_at_some_parameters_can_be_fitted(tmp_path):
    given, unit = recording(7, samples=200), guided(c_rig(tmp_path / "a.fmu", "FAILURE=abort()"))
    start = unit.with_parameters(unit.parameter_set.change(k1={"value": 590.0}))
    assert fit(start, given).parameters["k1"] == pytest.approx(380.0, rel=0.01)


def test_errors_of_all_getters_are_no_numbers(tmp_path):
    given = recording(6, samples=40)
    unit = guided(c_rig(tmp_path / "a.fmu", "FAILED=3"))
    for y in runs(unit, given, k1=700.0):
        assert np.all(np.isnan(y[2:]))
    for y in runs(unit, given, k1=500.0):
        assert np.all(np.isfinite(y))


def test_parameters_change_in_event_mode_and_fixed_ones_by_a_restart(tmp_path):
    given, unit = recording(2, samples=60), c_rig(tmp_path / "a.fmu", "STRICT")
    for y in runs(guided(unit), given, k1=450.0):
        changed_rig = rig().with_parameters(rig().parameter_set.change(k1={"value": 450.0}))
        assert np.abs(y - changed_rig.simulate(given)).max() <= 1e-12 * np.ptp(given.y)
    light = guided(unit, parameters=("m1", "k1"))
    for y in runs(light, given, m1=1.0):
        assert np.abs(y - given.y).max() > 0.01 * np.ptp(given.y)
    for y in runs(light, given, m1=1.2):
        assert np.abs(y - rig().simulate(given)).max() <= 1e-12 * np.ptp(given.y)


def test_fixed_parameters_of_fmi_3_change_by_a_restart(tmp_path, units):
    copy, given = tmp_path / "a.fmu", recording(2, samples=60)
    copy.write_bytes(units["casadi"].read_bytes())
    fixed = guided(changed(copy, ('variability="tunable"', 'variability="fixed"')), parameters=("k1", "d2"))
    for y in runs(fixed, given, k1=450.0):
        changed_rig = rig().with_parameters(rig().parameter_set.change(k1={"value": 450.0}))
        assert np.abs(y - changed_rig.simulate(given)).max() <= 1e-12 * np.ptp(given.y)


def test_a_declared_type_gives_unit_and_bounds(tmp_path):
    declared = '<TypeDefinitions><SimpleType name="K"><Real unit="N/m" min="100" max="2000"/></SimpleType>'
    unit = changed(
        c_rig(tmp_path / "a.fmu"),
        ("<ModelVariables>", f"{declared}</TypeDefinitions><ModelVariables>"),
        ('<Real unit="N/m" start="380.0" min="100" max="2000"/>', '<Real declaredType="K" start="380.0"/>'),
    )
    p = guided(unit).parameters["k1"]
    assert p.unit == "N/m" and tuple(map(float, p.bounds)) == (100, 2000)


def test_events_are_told(tmp_path, capfd):
    unit = changed(c_rig(tmp_path / "a.fmu"), ('numberOfEventIndicators="0"', 'numberOfEventIndicators="2"'))
    assert "a.fmu has 2 event indicators; the integration steps over events" in str(guided(unit))
    assert capfd.readouterr().err == ""


def test_an_array_is_named_as_such(tmp_path, units):
    array = (
        '<Float64 name="tbl" valueReference="999" causality="parameter" start="1 2"><Dimension start="2"/></Float64>'
    )
    copy = tmp_path / "a.fmu"
    copy.write_bytes(units["casadi"].read_bytes())
    unit = changed(copy, ("</ModelVariables>", f"{array}</ModelVariables>"))
    assert "tbl" not in from_fmu(unit).parameters
    with pytest.raises(InputError, match=r"'tbl' of .* is an array of Float64") as error:
        from_fmu(unit, parameters=("tbl",))
    one_sentence(error)


def test_a_port_reads_a_unit_that_depends_on_the_time(tmp_path):
    path = c_rig(tmp_path / "a.fmu", "TIMED")
    unit = from_fmu(path, ports={"odd": {"into": "guide_force", "across": "power"}}, inputs="force", outputs="pos1")
    x, u, p, t = unit.symbols()
    z = unit.across(unit.port("odd"), x, u, p, t)
    evaluate = ca.Function("z", [stack(x), stack(u), stack(p), t], [z])
    start = unit.parameter_set.start
    assert [float(evaluate(np.zeros(4), 2.0, start, time)) for time in (0.0, 3.0)] == [4.0, 7.0]


def test_a_port_has_units(units):
    given = {"guide": {**GUIDE["guide"], "unit": "kN", "across_unit": "mm"}}
    port = from_fmu(units["c"], ports=given).port("guide")
    assert (port.unit, port.position_unit) == ("kN", "mm")
    assert guided(units["c"]).port("guide").unit == "N"


def test_a_port_is_given_as_a_text_with_units(units):
    port = from_fmu(units["c"], ports={"guide": "guide_force[kN]:pos1 [mm]:vel1"}).port("guide")
    assert (port.unit, port.position_unit, port.domain) == ("kN", "mm", "mechanical")
    plain = from_fmu(units["c"], ports={"guide": "guide_force:pos1"}).port("guide")
    assert (plain.unit, plain.rate) == ("N", None)
    with pytest.raises(InputError, match="write NAME=INTO:ACROSS"):
        from_fmu(units["c"], ports={"guide": "guide_force"})


def test_brackets_of_a_variable_are_not_taken_for_a_unit():
    found = parse_port("axis", "f[1]:r[1][mm]:v[1]", ("f[1]", "r[1]", "v[1]"))
    assert found == {"into": "f[1]", "across": "r[1]", "across_unit": "mm", "rate": "v[1]"}
    assert parse_port("axis", "f:r[3]", ("f", "r[1]"))["across"] == "r[3]"  # a mistyped index is no unit


def test_the_message_about_inputs_names_the_cure(units):
    with pytest.raises(InputError, match=r"name the recorded ones, as in from_fmu\(\.\.\., inputs=\.\.\.\)"):
        from_fmu(units["c"]).simulate(recording(0, samples=20))


def write_table(path, given):
    columns = np.column_stack([np.arange(len(given)) * given.dt, given.u, given.y])
    rows = "\n".join(",".join(map(repr, row)) for row in columns.tolist())
    path.write_text(f"t,force [N],pos1 [m],pos2\n{rows}\n")
    return path


def test_the_corrected_simulator_of_a_unit_is_a_file(tmp_path, units):
    ports = {"guide": {"into": "guide_force", "across": "pos1", "rate": "vel1"}}
    options = {"ports": ports, "bounds": {"k1": (300.0, 500.0)}, "inputs": ("force",), "outputs": ("pos1", "pos2")}
    unit = from_fmu(units["c"], **options).with_parameters({"k1": 390.0})
    law = CoulombFriction({"F_c": 3.0, "v_0": 0.002})
    found = replace(example(), corrected=unit.with_element("guide", law), refitted=unit)
    shutil.copy(units["c"], tmp_path / "unit.fmu")
    (tmp_path / "out").mkdir()
    file = tmp_path / "out" / "corrected.py"
    file.write_text(corrected_file(found, "../unit.fmu", "from_fmu", options))
    again, given = load_simulator(file), recording(4, samples=200)
    assert np.array_equal(again.simulate(given), found.corrected.simulate(given))
    assert again.parameters["k1"].bounds == (300.0, 500.0) and again.hold == found.hold


def test_the_command_checks_a_unit(tmp_path, capsys, units):
    train = write_table(tmp_path / "train.csv", recording(4, CoulombFriction({"F_c": 3.0, "v_0": 0.002}), samples=600))
    port = ("--port", "guide=guide_force:pos1:vel1", "--initial", "zero", "--hold", "zero")
    status, out, _ = run(capsys, "check", units["c"], train, *port, "--bound", "k1=300:500")
    assert "physical domain unknown" not in out
    unclear = ("--port", "guide=guide_force[level]:pos1[level]:vel1", *port[2:])
    assert "physical domain unknown at guide" in run(capsys, "check", units["c"], train, *unclear)[1]
    assert status == 0 and "guide" in out and "has no column for the outputs vel1, power" in out
    bad = tmp_path / "bad.fmu"
    bad.write_text("x")
    refused(capsys, "check", bad, train, says="is not a functional mock-up unit")
    refused(capsys, "diagnose", bad, train, "--out", tmp_path / "d", says="is not a functional mock-up unit")
    assert not (tmp_path / "d").exists()
    refused(capsys, "check", units["c"], train, "--port", "guide=x", says="write NAME=INTO:ACROSS")
    refused(capsys, "check", units["c"], train, "--port", "guide=no:pos1", says="has no 'no' among its inputs")
    refused(capsys, "check", units["c"], train, "--bound", "k1=2:1", says="infeasible")
    model = tmp_path / "model.py"
    model.write_text("simulator = 1\n")
    refused(capsys, "check", model, train, "--port", "a=b:c", says="--port was given, which is for an FMU")
    table = tmp_path / "other.csv"
    table.write_text("t,a,b\n0,1,2\n1,2,3\n")
    refused(capsys, "check", units["c"], table, says="has no column for any input")
