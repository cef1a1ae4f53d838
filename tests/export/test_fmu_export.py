"""Exported FMUs pass FMPy's validator and give the numbers of `simulate` when FMPy runs them."""

import ctypes
import shutil
import subprocess
import zipfile

import numpy as np
import pytest
from command_line import refused, run
from exported_fits import CASES, mass_on_spring, one_sentence, recording_for, some_fit

from pilfr_casadi import InputError, Parameter, Port, Recording, Simulator, exported
from pilfr_casadi.engine import compiler
from pilfr_casadi.laws import CoulombFriction, CubicStiffness, Delay, Drift, Relaxation, StopHysteresis, heated

pytest.importorskip("fmpy")
pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler")
VERSIONS = ("2.0", "3.0")
EXACT = 1e-9  # of the range of a signal


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def validate(path):
    from fmpy import read_model_description
    from fmpy.validation import validate_fmu

    assert validate_fmu(str(path)) == []
    return read_model_description(str(path), validate=True)


def drive(path, u, dt, start=None, slopes=None, every=1):
    """Drive an FMU by FMPy's instances: set inputs, read outputs, step; (M, n_y)."""
    from fmpy import extract, read_model_description
    from fmpy.fmi2 import FMU2Slave
    from fmpy.fmi3 import FMU3Slave

    description = read_model_description(str(path))
    at = {v.name: v.valueReference for v in description.modelVariables}
    inputs = [v.valueReference for v in description.modelVariables if v.causality == "input" and v.name[:4] != "der("]
    outputs = [v.valueReference for v in description.modelVariables if v.causality == "output"]
    folder, two = extract(str(path)), description.fmiVersion == "2.0"
    model = (FMU2Slave if two else FMU3Slave)(
        guid=description.guid,
        unzipDirectory=folder,
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="plant",
    )
    model.instantiate()
    read, write = (model.getReal, model.setReal) if two else (model.getFloat64, model.setFloat64)
    for name, value in (start or {}).items():
        write([at[name]], [value])
    if two:
        model.setupExperiment(startTime=0.0)
    model.enterInitializationMode()
    model.exitInitializationMode()
    y = []
    for k in range(0, len(u), every):
        if inputs:
            write(inputs, u[k].tolist())
        if slopes is not None:
            names = [v.name for v in description.modelVariables if v.name[:4] == "der("]
            write([at[name] for name in names], slopes[k].tolist())
        y.append(read(outputs))
        model.doStep(currentCommunicationPoint=k * dt, communicationStepSize=every * dt)
    model.terminate()
    model.freeInstance()
    shutil.rmtree(folder)
    return np.array(y)


def close(found, wanted):
    return np.abs(found - wanted).max() <= EXACT * max(np.ptp(wanted), 1.0)


def with_laws():
    """A simulator with memory, an own state, a delay, heat and time, each from a law of its own."""
    held = StopHysteresis({"w": 5.0, "r": np.linspace(0.1, 0.6, 6)})
    simulator = mass_on_spring().with_element("ground", held)
    simulator = simulator.with_element("ground", Relaxation({"k_v": 2.0, "T": 0.3}))
    simulator = simulator.with_element("actuator:force", Delay({"T": 0.05}))
    simulator = simulator.with_element("parameter:d", heated("vel")().at({"c": 0.5, "T": 0.5, "s_2": 0.01}))
    return simulator.with_element("sensor:y", Drift({"a": 0.1, "b": 0.0}))


@pytest.mark.parametrize("fmi", VERSIONS)
@pytest.mark.parametrize("case", CASES)
def test_a_fit_gives_the_numbers_of_simulate(fmi, case):
    fitted = some_fit(case)
    recording = recording_for(fitted)
    path = fitted.export().to_fmu("plant.fmu", fmi=fmi)
    described = validate(path)
    units = {v.name: v.unit for v in described.modelVariables if v.causality in ("input", "output")}
    assert units["a"] == "V" and units["x"] == "µm"
    assert close(drive(path, recording.u, fitted.dt), fitted.simulate(recording))


@pytest.mark.parametrize("fmi", VERSIONS)
def test_a_simulator_with_laws_gives_the_numbers_of_simulate(fmi):
    simulator, rng = with_laws(), np.random.default_rng(0)
    u = rng.normal(size=(300, 1))
    wanted = simulator.simulate(Recording(u, np.zeros((300, 1)), 0.02, ("force",), ("y",)))
    path = exported(simulator, dt=0.02).to_fmu("plant.fmu", fmi=fmi)
    names = [v.name for v in validate(path).modelVariables if v.causality == "local"]
    assert {"state.pos", "state.ground.memory1", "state.time"} <= set(names)
    assert close(drive(path, u, 0.02), wanted)


@pytest.mark.parametrize("fmi", VERSIONS)
def test_fmpy_simulates_a_recording_by_itself(fmi):
    from fmpy import simulate_fmu

    simulator = mass_on_spring().with_element("ground", CoulombFriction({"F_c": 0.5, "v_0": 0.01}))
    t = np.arange(200) * 0.02
    u = np.sin(3 * t)
    wanted = simulator.simulate(Recording(u[:, None], np.zeros((200, 1)), 0.02, ("force",), ("y",)))
    path = exported(simulator, dt=0.02).to_fmu("plant.fmu", fmi=fmi)
    signals = np.array([*zip(t, u, strict=True)], dtype=[("time", float), ("force", float)])
    found = simulate_fmu(str(path), input=signals, stop_time=t[-1], output_interval=0.02, output=["y"])
    assert np.allclose(found["time"], t) and close(found["y"], wanted[:, 0])


@pytest.mark.parametrize("fmi", [pytest.param("2.0", marks=pytest.mark.slow), "3.0"])
def test_interpolated_inputs_are_given_by_their_slopes(fmi):
    simulator, rng = with_laws(), np.random.default_rng(1)
    u = rng.normal(size=(200, 1))
    wanted = simulator.simulate(Recording(u, np.zeros((200, 1)), 0.02, ("force",), ("y",), hold="linear"))
    path = exported(simulator, dt=0.02, hold="linear").to_fmu("plant.fmu", fmi=fmi)
    slopes = np.vstack([np.diff(u, axis=0), np.zeros((1, 1))]) / 0.02
    assert validate(path) and close(drive(path, u, 0.02, slopes=slopes), wanted)


def test_the_slopes_of_fmi_2_are_its_input_derivatives():
    from fmpy import extract, read_model_description
    from fmpy.fmi2 import FMU2Slave

    u, simulator = np.random.default_rng(3).normal(size=(100, 1)), mass_on_spring()
    wanted = simulator.simulate(Recording(u, np.zeros((100, 1)), 0.02, ("force",), ("y",), hold="linear"))
    path = exported(simulator, dt=0.02, hold="linear").to_fmu("plant.fmu")
    described = read_model_description(str(path))
    assert described.coSimulation.canInterpolateInputs
    force, y = (next(v.valueReference for v in described.modelVariables if v.name == n) for n in ("force", "y"))
    model = FMU2Slave(guid=described.guid, unzipDirectory=extract(str(path)), modelIdentifier="model")
    model.instantiate()
    model.setupExperiment()
    model.enterInitializationMode()
    model.exitInitializationMode()
    model.setReal([force], [u[0, 0]])
    found = [model.getReal([y])]
    for k, slope in enumerate(np.diff(u[:, 0]) / 0.02):
        model.setRealInputDerivatives([force], [1], [slope])
        model.doStep(currentCommunicationPoint=0.02 * k, communicationStepSize=0.02)
        found.append(model.getReal([y]))
    assert close(np.array(found), wanted)
    model.freeInstance()


@pytest.mark.parametrize("fmi", VERSIONS)
def test_parameters_and_start_values_can_be_set(fmi):
    simulator = mass_on_spring()
    (name, given), *_ = [(n, p) for n, p in simulator.parameters.items() if not p.fixed]
    changed = simulator.with_parameters(simulator.parameter_set.change(**{name: {"value": 1.1 * given.value}}))
    path = exported(simulator, dt=0.02).to_fmu("plant.fmu", fmi=fmi)
    variables = {v.name: v for v in validate(path).modelVariables}
    described = variables[name]
    assert (described.causality, described.variability) == ("parameter", "tunable")
    assert float(described.start) == given.value and (described.unit or "") == given.unit
    u = np.sin(np.arange(100) * 0.1)[:, None]
    first = np.array([0.3, -0.2])
    record = Recording(u, np.zeros((100, 1)), 0.02, ("force",), ("y",), initial=first)
    start = {name: 1.1 * float(given.value), "state.pos": 0.3, "state.vel": -0.2}
    assert close(drive(path, u, 0.02, start=start), changed.simulate(record))


def test_bounds_and_held_parameters_are_described():
    parameters = {
        "m": Parameter(2.0, unit="kg", fixed=True),
        "k": Parameter(100.0, unit="N/m", bounds=(50, np.inf)),
        "force": Parameter([1.0, 2.0]),
    }
    simulator = Simulator(
        lambda x, u, p: dict(pos=u.force * p["force"][0] - p.k * x.pos / p.m),
        lambda x: {"pos": x.pos},
        states=("pos",),
        inputs=("force",),
        parameters=parameters,
        units={"force": "N"},
        ports=Port('a <&> "b"', into=dict(pos=1.0), across=lambda x: x.pos, unit="N", across_unit="m"),
    ).with_element('a <&> "b"', CubicStiffness({"k_3": 2.0}))
    for fmi in VERSIONS:
        described = {v.name: v for v in validate(exported(simulator, dt=0.1).to_fmu("p.fmu", fmi=fmi)).modelVariables}
        assert described["m"].variability == "fixed" and described["k"].variability == "tunable"
        assert float(described["k"].min) == 50 and described["k"].max is None and described["k"].unit == "N/m"
        assert described["force"].causality == "input" and described["force[1]"].start is not None
        assert described['a <&> "b".k_3'].unit == "N/m^3"


@pytest.mark.parametrize("fmi", [pytest.param("2.0", marks=pytest.mark.slow), "3.0"])
def test_the_memory_of_hysteresis_is_in_the_state_of_the_fmu(fmi):
    """A restored FMU continues as before, from its state or its serialized state."""
    from fmpy import extract, read_model_description
    from fmpy.fmi2 import FMU2Slave
    from fmpy.fmi3 import FMU3Slave

    path = exported(with_laws(), dt=0.02).to_fmu("plant.fmu", fmi=fmi)
    described, two = read_model_description(str(path)), fmi == "2.0"
    force, y = (next(v.valueReference for v in described.modelVariables if v.name == n) for n in ("force", "y"))
    made = dict(guid=described.guid, unzipDirectory=extract(str(path)), modelIdentifier="model")
    model = (FMU2Slave if two else FMU3Slave)(**made)
    model.instantiate()
    read, write = (model.getReal, model.setReal) if two else (model.getFloat64, model.setFloat64)
    if two:
        model.setupExperiment()
    model.enterInitializationMode()
    model.exitInitializationMode()

    def advance(begin, count):
        for k in range(begin, begin + count):
            write([force], [3.0 * np.sin(0.1 * k)])
            model.doStep(currentCommunicationPoint=0.02 * k, communicationStepSize=0.02)
        return read([y])

    advance(0, 60)
    state = model.getFMUState()
    stored = model.serializeFMUState(state)
    first = advance(60, 40)
    advance(100, 30)
    model.setFMUState(state)
    model.freeFMUState(state)
    assert advance(60, 40) == first
    model.setFMUState(model.deserializeFMUState(stored))
    assert advance(60, 40) == first
    model.freeInstance()


@pytest.mark.parametrize("fmi", VERSIONS)
def test_a_communication_step_is_a_multiple_of_the_sample_time(fmi, capfd):
    path = exported(mass_on_spring(), dt=0.02).to_fmu("plant.fmu", fmi=fmi)
    u = np.repeat(np.random.default_rng(2).normal(size=(20, 1)), 3, axis=0)
    wanted = mass_on_spring().simulate(Recording(u, np.zeros((60, 1)), 0.02, ("force",), ("y",)))
    assert close(drive(path, u, 0.02, every=3), wanted[::3])
    with pytest.raises(Exception, match=r"doStep|DoStep"):
        drive(path, u, 0.03)
    said = "".join(capfd.readouterr())
    assert "The communication step of 0.03 s is not a multiple of the sample time 0.02 s; use a multiple." in said


def test_the_source_inside_compiles_without_a_header_of_the_standard():
    for fmi in VERSIONS:
        exported(with_laws(), dt=0.02, name="rig").to_fmu("rig.fmu", fmi=fmi)
        with zipfile.ZipFile("rig.fmu") as archive:
            names = set(archive.namelist())
            archive.extractall("inside")
        assert {"modelDescription.xml", "sources/rig.c"} <= names and any(n.startswith("binaries/") for n in names)
        command = [compiler(), "-std=c99", "-fPIC", "-shared", "-Wall", "-Werror", "-Wno-unused-function"]
        subprocess.run([*command, "inside/sources/rig.c", "-o", f"rig{fmi}.so", "-lm"], check=True)
        version = getattr(ctypes.CDLL(f"./rig{fmi}.so"), f"fmi{fmi[0]}GetVersion")
        version.restype = ctypes.c_char_p
        assert version().decode() == fmi


def test_the_same_model_gives_the_same_bytes():
    found = [exported(mass_on_spring(), dt=0.02).to_fmu(f"{k}.fmu").read_bytes() for k in range(2)]
    assert found[0] == found[1]


def test_without_a_compiler_nothing_is_written(tmp_path, monkeypatch):
    step = exported(mass_on_spring(), dt=0.02)
    for given, fmi, says in (("plant.zip", "2.0", "ends in .fmu"), ("plant.fmu", "1.0", "give one of 2.0, 3.0")):
        with pytest.raises(InputError, match=says) as error:
            step.to_fmu(given, fmi=fmi)
        one_sentence(error)
    monkeypatch.setenv("PILFR_COMPILER", "none")
    compiler.cache_clear()
    try:
        with pytest.raises(InputError, match="no C compiler was found") as error:
            step.to_fmu("plant.fmu")
        one_sentence(error)
    finally:
        monkeypatch.undo()
        compiler.cache_clear()
    assert not list(tmp_path.iterdir())


def test_the_command_writes_an_fmu(tmp_path, capsys):
    some_fit().save(tmp_path / "model.json")
    for more in ((), ("--fmi", "3.0")):
        given = ("export", tmp_path / "model.json", "--fmu", *more, "--out", tmp_path / "a.fmu", "--overwrite")
        status, text, _ = run(capsys, *given)
        assert status == 0 and "FMU: " in text
        assert validate(tmp_path / "a.fmu").fmiVersion == (more or ("", "2.0"))[1]
    model = tmp_path / "model.json"
    refused(capsys, "export", model, "--fmu", "--c", "--out", tmp_path / "b.fmu", says="--c and --fmu were given")
    refused(capsys, "export", model, "--fmi", "3.0", "--out", tmp_path / "b.fmu", says="give --fmu too")
    refused(capsys, "export", model, "--fmu", "--out", tmp_path / "b.zip", says="ends in .fmu")
    refused(capsys, "export", model, "--fmu", "--out", tmp_path / "no" / "b.fmu", says="folder that exists")
    assert not (tmp_path / "b.fmu").exists()
