"""Simulators from MuJoCo models: the same motion as in MuJoCo, numbers as parameters, error messages."""

import importlib
import json
import pickle

import casadi as ca
import numpy as np
import pytest
from command_line import refused, run

from pilfr_casadi import InputError, Parameter, Recording, from_mujoco
from pilfr_casadi.laws import CoulombFriction
from pilfr_casadi.simulators import load_simulator

mujoco = pytest.importorskip("mujoco")
STEP, SAMPLES = 0.002, 400
ARM = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="RK4"/>
  <worldbody>
    <body name="upper" pos="0 0 1" quat="1 0.1 0 0.2">
      <joint name="shoulder" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0.1 -.4" size=".03" mass="1.2"/>
      <body name="lower" pos="0 0 -.4" quat="1 0 0.3 0">
        <joint name="elbow" axis="1 1 0" pos="0 0 .02" damping=".05" armature=".01" stiffness="1" springref=".2"/>
        <geom type="capsule" fromto="0 0 0 0 0.05 -.3" size=".02" mass=".8"/>
        <body name="tip" pos="0 0 -.3">
          <joint name="slide" type="slide" axis="0 1 1" pos="0.1 0 0" damping="4" stiffness="300"/>
          <geom type="sphere" size=".05" pos=".01 .02 .03" mass=".3"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="m1" joint="shoulder" gear="3"/><position name="m2" joint="elbow" kp="5" kv=".3"/></actuator>
  <sensor><jointpos name="q1" joint="shoulder"/><jointvel name="w2" joint="elbow"/></sensor>
</mujoco>"""

PENDULUM = """
<mujoco>
  <worldbody>
    <body>
      <joint name="joint" axis="0 1 0" damping="0.1" range="-90 90"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="m" joint="joint"/></actuator>
</mujoco>"""


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(ARM, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def recording():
    t = STEP * np.arange(SAMPLES)
    u = np.column_stack([np.sin(5 * t), 0.5 * np.cos(9 * t)])
    return Recording(u, np.zeros((SAMPLES, 2)), STEP, ("m1", "m2"), ("q1", "w2"), initial="zero", hold="zero")


def by_mujoco(path, recording, push=None):
    model = path if isinstance(path, mujoco.MjModel) else mujoco.MjModel.from_xml_path(str(path))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data, out = mujoco.MjData(model), np.zeros((len(recording), 2))
    for k, control in enumerate(recording.u):
        out[k] = data.qpos[0], data.qvel[1]
        data.ctrl[:] = control
        if push is not None:
            data.qfrc_applied[:] = push(data)
        mujoco.mj_step(model, data)
    return out


def test_it_moves_as_mujoco_does(arm, recording):
    simulator = from_mujoco(arm)
    assert simulator.states == ("shoulder", "elbow", "slide", "shoulder.speed", "elbow.speed", "slide.speed")
    wanted = by_mujoco(arm, recording)
    # MuJoCo holds a servo's force during a step, the equations do not
    assert np.max(np.abs(simulator.simulate(recording) - wanted)) < 2e-5 * np.max(np.abs(wanted))


def test_a_law_in_a_joint_is_an_applied_torque(arm, recording):
    law = CoulombFriction({"F_c": 0.4, "v_0": 0.3})
    simulator = from_mujoco(arm).with_element("shoulder", law)
    wanted = by_mujoco(arm, recording, lambda data: [-0.4 * np.tanh(data.qvel[0] / 0.3), 0, 0])
    free = from_mujoco(arm).simulate(recording)
    found = simulator.simulate(recording)
    assert np.max(np.abs(found - wanted)) < 2e-2 * np.max(np.abs(free - wanted))  # a torque that is held for a step


def test_numbers_of_the_model_are_parameters(arm, recording, tmp_path):
    chosen = ("lower.mass", "lower.com_z", "elbow.stiffness", "m1.gain", "gravity")
    simulator = from_mujoco(arm, parameters=chosen, bounds={"gravity": (9, 10)})
    values = {name: p.value for name, p in simulator.parameters.items()}
    assert values["lower.mass"] == pytest.approx(0.8) and values["gravity"] == pytest.approx(9.81)
    assert simulator.parameters["gravity"].bounds == (9, 10)
    other = {"lower.mass": Parameter(1.6), "elbow.stiffness": Parameter(2.0)}
    changed = simulator.with_parameters({**simulator.parameters, **other})
    path = tmp_path / "changed.xml"
    path.write_text(ARM.replace('mass=".8"', 'mass="1.6"').replace('stiffness="1"', 'stiffness="2"'), encoding="utf-8")
    wanted = by_mujoco(path, recording)
    assert np.max(np.abs(changed.simulate(recording) - wanted)) < 2e-5 * np.max(np.abs(wanted))


def test_gears_and_moments_of_inertia_are_parameters(arm, recording):
    simulator = from_mujoco(arm, parameters=("m1.gear", "lower.inertia_x"))
    start = {name: float(p.value) for name, p in simulator.parameters.items()}
    model = mujoco.MjModel.from_xml_path(str(arm))
    model.actuator_gear[0, 0], model.body_inertia[2, 0] = 2.0, 3 * model.body_inertia[2, 0]
    changed = simulator.with_parameters({"m1.gear": 2.0, "lower.inertia_x": 3 * start["lower.inertia_x"]})
    wanted = by_mujoco(model, recording)
    assert start["m1.gear"] == 3.0
    assert np.max(np.abs(changed.simulate(recording) - wanted)) < 2e-5 * np.max(np.abs(wanted))


def test_bounds_free_a_parameter(arm):
    usual = from_mujoco(arm)
    assert "lower.inertia" not in usual.parameters
    simulator = from_mujoco(arm, bounds={"lower.inertia": (0.3, 3), "lower.mass": (0.5, 2)})
    assert [*simulator.parameters] == [*usual.parameters, "lower.inertia"]
    assert simulator.parameters["lower.inertia"].bounds == (0.3, 3)
    assert simulator.parameters["lower.mass"].bounds == (0.5, 2)
    own = {"gravity": Parameter(9.8, fixed=True), "lower.mass": Parameter(0.7, "kg", fixed=True)}
    given = from_mujoco(arm, parameters=own, bounds={"lower.mass": (0.5, 2), "tip.mass": (0.1, 1)}).parameters
    assert [*given] == ["gravity", "lower.mass", "tip.mass"] and given["gravity"].fixed
    changed = given["lower.mass"]
    assert (changed.value, changed.unit, changed.bounds, changed.fixed) == (0.7, "kg", (0.5, 2), False)


def test_a_model_in_memory_is_read(arm, recording):
    import cloudpickle

    model, spec = mujoco.MjModel.from_xml_path(str(arm)), mujoco.MjSpec.from_file(str(arm))
    wanted = from_mujoco(arm).simulate(recording)
    simulator = from_mujoco(model)
    model.dof_damping[:] = 100.0  # the simulator has a copy
    for one in (simulator, from_mujoco(spec), pickle.loads(cloudpickle.dumps(simulator))):
        np.testing.assert_array_equal(one.simulate(recording), wanted)
    with pytest.raises(InputError, match="A dict was given; give an MJCF or URDF file, an MjModel or an MjSpec"):
        from_mujoco({})
    spec.body("upper").add_geom()  # without a size
    with pytest.raises(InputError, match=r"MuJoCo cannot read the MjSpec \(.*size"):
        from_mujoco(spec)


def test_dry_friction_is_that_of_mujoco(tmp_path):
    names, losses = ("m1", "q1"), ('name="shoulder"', 'name="shoulder" frictionloss=".3"')
    path = tmp_path / "arm.xml"
    path.write_text(ARM.replace(*losses).replace("<sensor>", '<sensor><jointpos name="q2" joint="elbow"/>'))
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.timestep, data, rows = 2e-4, mujoco.MjData(model), []
    for k in range(1500):
        data.ctrl[0] = 0.5 * np.sin(4 * k * STEP)
        rows.append([data.ctrl[0], data.qpos[0]])
        mujoco.mj_step(model, data, nstep=10)
    u, y = np.array(rows).T[..., None]
    recording = Recording(u, y, STEP, *((name,) for name in names), initial="zero", hold="zero")
    simulator = from_mujoco(path, inputs=("m1",), outputs=("q1",))
    assert simulator.parameters["shoulder.frictionloss"].value == 0.3
    without = simulator.with_parameters({"shoulder.frictionloss": 0.0}).simulate(recording)
    assert np.std(simulator.simulate(recording) - y) < 0.02 * np.std(y) < 0.1 * np.std(without - y)


def test_forces_of_actuators_are_outputs(arm, recording, tmp_path):
    more = '<actuatorfrc name="f1" actuator="m1"/><jointactuatorfrc name="t1" joint="shoulder"/></sensor>'
    text = ARM.replace("</sensor>", more).replace('damping="0.1"', 'damping="0.1" actuatorfrcrange="-2 2"')
    path = tmp_path / "arm.xml"
    path.write_text(text, encoding="utf-8")
    assert from_mujoco(path).output_names == ("q1", "w2")
    simulator = from_mujoco(path, outputs=("f1", "t1"))
    assert simulator.units == {"t1": "N m"}
    found = simulator.simulate(recording)
    np.testing.assert_allclose(found[:, 0], recording.u[:, 0], atol=1e-12)
    np.testing.assert_allclose(found[:, 1], np.clip(3 * recording.u[:, 0], -2, 2), atol=1e-12)


def test_what_is_left_out_is_noted(tmp_path):
    path = tmp_path / "arm.xml"

    def note(text):
        path.write_text(text, encoding="utf-8")
        return str(from_mujoco(path)).splitlines()[1].partition("leave out ")[2]

    text = ARM.replace("<worldbody>", '<worldbody><geom type="plane" size="1 1 .1"/>')
    text = text.replace('name="elbow" axis', 'name="elbow" range="-1 1" axis')
    text = text.replace("<sensor>", '<sensor><framepos name="place" objtype="body" objname="tip"/>')
    assert note(text) == "the limits of elbow; contacts, as of world with upper; the sensors place"
    off = '"RK4"><flag contact="disable" limit="disable"/></option>'
    assert note(text.replace('"RK4"/>', off)) == "the sensors place"
    assert note(ARM) == "contacts, as of upper with tip"  # neighbours do not collide
    assert not note(ARM.replace("<actuator>", '<contact><exclude body1="tip" body2="upper"/></contact><actuator>'))


def test_ports_load_and_units(arm):
    simulator = from_mujoco(arm, outputs=("q1", "slide"), inputs=("m1",))
    ports = {port.name: port for port in simulator.ports}
    assert (ports["shoulder"].unit, ports["slide"].unit, ports["shoulder"].domain) == ("N m", "N", "mechanical")
    assert list(ports["shoulder"].signals) == ["load"] and not ports["slide"].signals
    assert simulator.units == {"q1": "rad", "slide": "m"}
    x, u, p, t = simulator.symbols()
    load = simulator.port_signals(ports["shoulder"], x, u, p, t)["load"]
    assert float(ca.Function("load", [u["m1"]], [load])(-2.0)) == pytest.approx(6.0)


ROD = """
<mujoco>
  <worldbody>
    <body name="rod">
      <joint name="pivot" axis="0 1 0" damping="0.02"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="0.5"/>
    </body>
  </worldbody>
  <actuator><motor name="torque" joint="pivot"/></actuator>
</mujoco>"""


@pytest.mark.usefixtures("blank_figures")
def test_the_command_writes_a_corrected_simulator_that_other_commands_take(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(importlib.import_module("pilfr_casadi.diagnose.arguments"), "CATALOGUE", (CoulombFriction,))
    model, rng = tmp_path / "pendulum.xml", np.random.default_rng(0)
    model.write_text(ROD, encoding="utf-8")
    t, dt = 0.01 * np.arange(300), 0.01
    torque = 0.4 * np.sin(4 * t + 2 * np.sin(t))[:, None]
    blank = Recording(torque, torque, dt, ("torque",), ("pivot",), initial="zero", hold="zero")
    true = from_mujoco(model).with_element("pivot", CoulombFriction({"F_c": 0.1, "v_0": 0.05}))
    rows = np.column_stack([t, torque, true.simulate(blank) + 1e-4 * rng.standard_normal((300, 1))])
    np.savetxt(tmp_path / "train.csv", rows, delimiter=",", header="t,torque,pivot", comments="")
    known, out = ("--initial", "zero", "--hold", "zero", "--workers", 1), tmp_path / "out"
    monkeypatch.chdir(tmp_path)
    given = ("diagnose", model, "train.csv", *known, "--bound", "rod.mass=0.4:0.7", "--out", out)
    status, said, err = run(capsys, *given)
    assert status == 0 and f"corrected simulator: {out / 'corrected.py'}" in said, err
    error = json.loads((out / "diagnosis.json").read_text())["fit"]["train"]["after"]
    status, said, err = run(capsys, "simulate", "out/corrected.py", "train.csv", "--initial", "zero", "--out", "y.csv")
    assert status == 0 and float(said.split("NRMSE on train: ")[1].split()[0]) == pytest.approx(error, rel=1e-2), err
    assert run(capsys, "export", "out/corrected.py", "--dt", dt, "--c", "--out", "c")[0] == 0
    assert load_simulator(out / "corrected.py").parameters["rod.mass"].bounds == (0.4, 0.7)


def test_it_may_be_sent_to_another_process(arm, recording):
    import cloudpickle

    again = pickle.loads(cloudpickle.dumps(from_mujoco(arm)))
    np.testing.assert_array_equal(again.simulate(recording), from_mujoco(arm).simulate(recording))


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ('<joint name="shoulder" axis="0 1 0" damping="0.1"/>', "<freejoint/>", "a free or a ball joint"),
        ("<motor ", '<intvelocity name="m0" joint="elbow" kp="1" actrange="0 1"/><motor ', "a state of its own"),
        ("<worldbody>", "<worldbody", "MuJoCo cannot read"),
        (ARM, '<robot name="box"><link name="box"/></robot>', "has no joint, so nothing in it can move"),
        ('integrator="RK4"', 'integrator="RK4" density="100"', "moves otherwise than a tree of rigid bodies"),
    ],
)  # fmt: skip
def test_what_the_equations_do_not_hold_is_refused(tmp_path, before, after, said):
    path = tmp_path / "arm.xml"
    assert before in ARM
    text = ARM.replace(before, after)
    if "freejoint" in after:
        text = text.replace('<motor name="m1" joint="shoulder" gear="3"/>', "").replace(
            '<jointpos name="q1" joint="shoulder"/>', ""
        )
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=said):
        from_mujoco(path)


def test_unknown_names_are_refused(arm):
    known = "'wrist.mass' among its parameters; they are mass, inertia, .* of the bodies upper, lower and tip; damping"
    with pytest.raises(InputError, match=known):
        from_mujoco(arm, parameters=["wrist.mass"])
    with pytest.raises(InputError, match=r"has no 'm9' among its actuators; they are m1, m2"):
        from_mujoco(arm, inputs=["m9"])
    assert from_mujoco(arm, inputs="m1", parameters="gravity").inputs == ("m1",)
    with pytest.raises(InputError, match="outside of its bounds 2 to 3; widen them"):
        from_mujoco(arm, bounds={"upper.mass": (2, 3)})


def test_the_command_takes_a_model(arm, tmp_path, capsys, recording):
    table = np.column_stack([recording.t, recording.u, recording.y])
    np.savetxt(tmp_path / "train.csv", table, delimiter=",", header="t,m1,m2,q1,w2", comments="")
    train, out = str(tmp_path / "train.csv"), ["--out", str(tmp_path / "out")]
    refused(capsys, "diagnose", str(tmp_path / "none.xml"), train, *out, says="none.xml")
    refused(capsys, "diagnose", str(arm), train, "--bound", "wrist.mass=1:2", *out, says="'wrist.mass'")
    refused(capsys, "diagnose", str(arm), train, "--port", "a=b:c", *out, says="--port was given")
    assert not (tmp_path / "out").exists()


def test_the_command_frees_a_bounded_parameter_and_prints_the_note(tmp_path, capsys):
    t, rng = 0.02 * np.arange(200), np.random.default_rng(0)
    u = np.sin(5 * t) + np.sin(11 * t)
    recording = Recording(u[:, None], np.zeros((200, 1)), 0.02, ("m",), ("joint",), initial="zero", hold="zero")
    arm, train = tmp_path / "arm.xml", tmp_path / "train.csv"
    arm.write_text(PENDULUM, encoding="utf-8")
    y = from_mujoco(arm).simulate(recording)[:, 0] + 1e-3 * rng.standard_normal(200)
    np.savetxt(train, np.column_stack([t, u, y]), delimiter=",", header="t,m,joint", comments="")
    given = ("check", arm, train, "--bound", "joint.armature=0:1", "--initial", "zero", "--hold", "zero")
    status, said, _ = run(capsys, *given, "--out", tmp_path)
    found = (tmp_path / "check.json").read_text(encoding="utf-8")
    assert status == 0 and "joint.armature" in found and "the equations leave out the limits of joint" in said


def test_dry_friction_that_a_flag_disables_is_none(tmp_path):
    path = tmp_path / "arm.xml"
    rubbing = PENDULUM.replace("<joint ", '<joint frictionloss="0.3" ', 1)
    for flags in (
        "",
        '<option><flag frictionloss="disable"/></option>',
        '<option><flag constraint="disable"/></option>',
    ):
        path.write_text(rubbing.replace("<mujoco>", f"<mujoco>{flags}"), encoding="utf-8")
        assert ("joint.frictionloss" in from_mujoco(path).parameters) == (not flags)


def test_laws_have_parameters_of_their_own_beside_the_joints(arm):
    simulator = from_mujoco(arm).with_element("shoulder", CoulombFriction()).with_element("shoulder", CoulombFriction())
    added = [name for name in simulator.parameters if name not in from_mujoco(arm).parameters]
    assert added == ["shoulder#2.F_c", "shoulder#2.v_0", "shoulder#3.F_c", "shoulder#3.v_0"]
    assert "shoulder.damping" in simulator.without_element().parameters
