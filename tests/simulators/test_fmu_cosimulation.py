"""Units for co-simulation: equations found from their steps, else their steps; failures and error messages."""

import sys
import textwrap

import casadi as ca
import cloudpickle
import numpy as np
import pytest
from command_line import run
from exported_fits import one_sentence

from pilfr_casadi import InputError, Recording, exported, from_fmu
from pilfr_casadi.laws import CoulombFriction
from pilfr_casadi.simulators import CoSimulation
from problems.fmu_rig import GUIDE, load, python_rig, recording, rig

pytest.importorskip("fmpy", reason="FMPy steps units for co-simulation; pip install 'pilfr-casadi[fmu]'")
pytest.importorskip("pythonfmu", reason="PythonFMU builds the units of these tests")
DT = 0.01
SLAVE = """
import math, os, time
from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real

class Unit(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.g, self.pos, self.vel, self.torque, self.push = 9.0, 0.0, 0.0, 0.0, 0.0
        self.hidden, self.steps = 0.0, 0
        self.register_variable(Real("g", causality=Fmi2Causality.parameter, variability=Fmi2Variability.tunable))
        for name in ("torque", "push"):
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        {register}

    def do_step(self, now, h):
        self.steps += 1
        {body}
        return True
"""
STATES = 'for name in ("pos", "vel"):\n            self.register_variable(Real(name, causality=Fmi2Causality.output))'


@pytest.fixture
def built(tmp_path):
    def build(body, register=STATES):
        from pythonfmu.builder import FmuBuilder

        lines = textwrap.dedent(body).strip().splitlines()
        text = SLAVE.format(register=register, body="\n        ".join(lines))
        folder = tmp_path / f"unit{len(list(tmp_path.iterdir()))}"
        folder.mkdir()
        (folder / "unit.py").write_text(text)
        return FmuBuilder.build_FMU(folder / "unit.py", dest=folder)

    return build


@pytest.fixture(scope="module")
def rig_unit(tmp_path_factory):
    return python_rig(tmp_path_factory.mktemp("units") / "rig.fmu")


SWING = """
rate = self.torque + self.push - self.g * math.sin(self.pos)
self.vel += h * rate
self.pos += h * self.vel
"""
PORT = {"pivot": {"into": "push", "across": "pos", "rate": "vel"}}


def swing(u, g=9.0, friction=0.0, pos=0.0):
    vel, found = 0.0, []
    for torque in u:
        found.append(pos)
        vel += DT * (torque - g * np.sin(pos) - friction * np.tanh(vel / 0.5))
        pos += DT * vel
    return np.array(found)[:, None]


def pulled(samples=40):
    u = 4 * np.sin(0.07 * np.arange(samples))
    return Recording(u[:, None], swing(u), DT, ("torque",), ("pos",), initial="zero", hold="zero")


def test_the_equations_of_a_unit_are_found_from_its_steps(rig_unit):
    found, given = load("pythonfmu", rig_unit), recording(0, samples=300)
    assert not found.discrete and "it is not called any more" in str(found)
    assert found.states == ("pos1", "vel1", "pos2", "vel2") and found.inputs == ("force",)
    friction = CoulombFriction({"F_c": 1.0, "v_0": 0.01})
    for own, other in ((found, rig()), (found.with_element("guide", friction), rig().with_element("guide", friction))):
        assert np.abs(own.simulate(given) - other.simulate(given)).max() <= 1e-6 * np.ptp(given.y)
    x, u, p, _ = found.symbols()
    assert {k: float(v) for k, v in found.port("guide").into(x, u, p).items()} == pytest.approx({"vel1": -1 / 1.2})
    power = from_fmu(rig_unit, ports=GUIDE, cosimulation=CoSimulation(dt=2e-3))
    assert power.output_names == ("pos1", "vel1", "pos2", "vel2", "power")
    assert np.allclose(power.simulate(given)[:, 4], given.u[:, 0] ** 2, rtol=1e-6)
    assert not np.any(exported(found, dt=2e-3).step(np.zeros(4), [1.0])[1].full())  # it can become a file
    again = cloudpickle.loads(cloudpickle.dumps(found))
    assert np.array_equal(again.simulate(given), found.simulate(given))


STIFF = """
rate = self.torque + self.push - 2e3 * self.g * self.pos - 30 * self.vel
self.vel += h * rate
self.pos += h * self.vel
"""


def test_the_equations_of_a_stiff_unit_are_found_from_shorter_steps(built):
    """Its modes at 300 rad/s and more are too fast for steps of 10 ms."""
    unit = from_fmu(built(STIFF), ports=PORT, bounds={"g": (1, 90)}, cosimulation=CoSimulation(dt=DT))
    assert not unit.discrete
    x, u, p, _ = unit.symbols()
    slope = unit.dynamics(x, u, p)["vel"]
    values = {"pos": 0.3, "vel": -2.0, "torque": 5.0, "g": 40.0}
    found = ca.Function("slope", [x["pos"], x["vel"], u["torque"], p["g"]], [slope])(*values.values())
    assert float(found) == pytest.approx(5 - 2e3 * 40 * 0.3 + 60, rel=1e-6)


def test_the_command_steps_by_the_sampling_interval(rig_unit, tmp_path, capsys):
    given, train = recording(4, samples=200), tmp_path / "train.csv"
    rows = np.column_stack([np.arange(200) * given.dt, given.u, given.y])
    np.savetxt(train, rows, delimiter=",", header="t,force,pos1,pos2", comments="")
    more = ("--port", "guide=guide_force:pos1:vel1", "--bound", "k1=300:500", "--initial", "zero", "--hold", "zero")
    status, out, _ = run(capsys, "check", rig_unit, train, *more)
    assert status == 0 and "guide" in out


def test_a_unit_without_such_equations_is_stepped(built):
    unit = from_fmu(built(SWING), ports=PORT, outputs=("pos",), cosimulation=CoSimulation(dt=DT))
    assert unit.discrete and unit.states == ("pos", "vel")
    assert "steps of 0.01 s, because no equations were found" in str(unit)
    given = pulled()
    assert np.abs(unit.simulate(given) - given.y).max() <= 1e-12
    law = CoulombFriction({"F_c": 1.0, "v_0": 0.5})
    rubbed = unit.with_element("pivot", law).simulate(given)
    assert np.abs(rubbed - swing(given.u[:, 0], friction=1.0)).max() <= 1e-9
    again = cloudpickle.loads(cloudpickle.dumps(unit))
    assert np.array_equal(again.simulate(given), unit.simulate(given))
    with pytest.raises(InputError, match=r"steps of 0\.01 s, the recordings of 0\.02 s"):
        unit.simulate(given.with_(dt=2 * DT))


def test_a_state_far_larger_than_one_is_found(built):
    """A pressure in Pa: a change by 1 Pa is not seen."""
    body = """
    self.pos += h * (1e9 * self.torque - 10 * self.pos)
    self.vel += h * (1e-6 * self.pos - self.vel)
    """
    unit = from_fmu(built(body), cosimulation=CoSimulation(dt=DT))
    assert unit.states == ("pos", "vel")


def test_outputs_count_from_zero_where_states_begin_elsewhere(built):
    unit = from_fmu(
        built(SWING, STATES + "\n        self.pos = 0.3"), ports=PORT, outputs=("pos",), cosimulation=CoSimulation(DT)
    )
    given = pulled()
    assert np.abs(unit.simulate(given) - swing(given.u[:, 0], pos=0.3)).max() <= 1e-12


@pytest.mark.parametrize("end", [pytest.param("os.abort()", marks=pytest.mark.slow), "raise ValueError"])
def test_a_step_that_fails_is_a_failed_trial(built, end):
    path = built(f"if self.pos > 0.4:\n    {end}\n" + SWING)
    unit = from_fmu(path, ports=PORT, outputs=("pos",), cosimulation=CoSimulation(dt=DT))
    given = Recording(np.full((40, 1), 20.0), np.zeros((40, 1)), DT, ("torque",), ("pos",), initial="zero")
    y = unit.simulate(given)
    assert np.isfinite(y[5, 0]) and np.isnan(y[-1, 0])


@pytest.mark.parametrize(
    "body, register, says",
    [
        ("self.hidden += h * self.torque\nself.pos += h * self.hidden + h * self.vel", STATES, "memory that cannot"),
        ("self.pos += h * self.steps", STATES, "memory that cannot be set"),
        (
            "self.hidden += h * (self.torque - self.hidden)",
            'self.register_variable(Real("reading", causality=Fmi2Causality.output, getter=lambda: self.hidden))',
            "none of its variables can be set as a state",
        ),
        ("os.abort()", STATES, "ends its process"),
        ("raise ValueError('no solver')", STATES, "does not step"),
    ],
)
def test_what_cannot_be_stepped_is_refused_in_one_sentence(built, body, register, says):
    with pytest.raises(InputError, match=says) as error:
        from_fmu(built(body, register), cosimulation=CoSimulation(dt=DT))
    one_sentence(error)


def test_it_needs_fmpy(rig_unit, monkeypatch):
    monkeypatch.setitem(sys.modules, "fmpy", None)
    with pytest.raises(InputError, match="needs FMPy; pip install") as error:
        load("pythonfmu", rig_unit)
    one_sentence(error)


def test_options_are_checked(built):
    path = built(SWING)
    with pytest.raises(InputError, match=r"no step size.*pilfr_casadi\.simulators\.CoSimulation") as error:
        from_fmu(path)
    one_sentence(error)
    with pytest.raises(InputError, match="has no 'speed' among its outputs and local variables") as error:
        from_fmu(path, cosimulation=CoSimulation(dt=DT, states="speed"))
    one_sentence(error)
    with pytest.raises(InputError, match=r"cosimulation=0\.01 was given; give CoSimulation"):
        from_fmu(path, cosimulation=0.01)
    with pytest.raises(InputError, match="memory that cannot be set"):
        from_fmu(path, cosimulation=CoSimulation(dt=DT, states=("pos",)))
    with pytest.raises(InputError, match="does not add up"):
        squared = {"odd": {"into": "push", "across": "pos"}}
        body = "self.vel += h * self.push ** 2\nself.pos += h * self.vel"
        from_fmu(built(body), ports=squared, cosimulation=CoSimulation(dt=DT))


@pytest.mark.slow
def test_a_unit_that_fails_at_most_parameters_names_them(built):
    path = built("if self.g > 9.5:\n    raise ValueError\n" + SWING)
    with pytest.raises(InputError, match="fails at all values of its parameters") as error:
        from_fmu(path, ports=PORT, outputs=("pos",), bounds={"g": (9.0, 900.0)}, cosimulation=CoSimulation(dt=DT))
    one_sentence(error)
