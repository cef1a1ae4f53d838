"""A two-joint arm in MuJoCo whose gears have friction that grows with the load, and a joint that is elastic.

The simulator is the rigid arm without friction, as MuJoCo reads it. MuJoCo itself simulates the truth: the shoulder's
gear has Coulomb friction that grows with the torque it transmits; with `--elastic`, a spring stands between the elbow's
motor and the forearm. A controller that the simulator does not know follows random references; torques and motor angles
are recorded. Needs the package mujoco.

    python -m problems.mujoco_arm
    python -m problems.mujoco_arm --elastic --cases 3
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pilfr_casadi import Recording, from_mujoco

from .simulated_cases import case_parser, diagnose_case, numbered

DT, SAMPLES, FINE = 0.005, 2400, 10  # s, samples, steps of MuJoCo in a sample
NOISE = 2e-4  # rad
KNEE = 0.01  # rad/s
FOREARM = """
      <body name="forearm" pos="0 0 -.35">
        {joint}
        <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".025" mass="{forearm}"/>
      </body>"""
ARM = """
<mujoco model="arm">
  <compiler angle="radian"/>
  <option timestep="{step}" integrator="RK4"><flag contact="disable"/></option>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping="{d1}"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.35" size=".03" mass="{upper}"/>
      {forearm}
    </body>
  </worldbody>
  <actuator><motor name="torque1" joint="shoulder"/><motor name="torque2" joint="elbow"/></actuator>
  <sensor><jointpos name="angle1" joint="shoulder"/><jointpos name="angle2" joint="elbow"/></sensor>
</mujoco>"""
RIGID = '<joint name="elbow" axis="0 1 0" damping="{d2}" armature="{armature}"/>'
ELASTIC = """<joint name="elbow" axis="0 1 0" damping="{d2}" armature="{armature}"/>
        <joint name="spring" axis="0 1 0" stiffness="{stiffness}" damping="{loss}"/>"""


def arm(values: dict[str, float], elastic: bool = False) -> str:
    """Write the arm as MJCF."""
    joint = (ELASTIC if elastic else RIGID).format(**values)
    return ARM.format(step=DT / FINE, **{**values, "forearm": FOREARM.format(joint=joint, **values)})


def truth(seed: int, elastic: bool) -> tuple[dict[str, float], tuple[Recording, Recording]]:
    """Draw an arm and record it twice; return its values too."""
    rng = np.random.default_rng(seed)
    values = {
        "upper": rng.uniform(1.5, 2.5),
        "forearm": rng.uniform(0.8, 1.4),
        "d1": rng.uniform(0.1, 0.3),
        "d2": rng.uniform(0.05, 0.15),
        "armature": rng.uniform(0.02, 0.05),
        "stiffness": rng.uniform(30, 80),
        "loss": rng.uniform(0.02, 0.08),
    }
    friction = rng.uniform(0.1, 0.3), rng.uniform(0.1, 0.25)
    train, test = (_run(values, friction, elastic, rng) for _ in range(2))
    return values, (train, test)


def _run(values: dict[str, float], friction: tuple[float, float], elastic: bool, rng: np.random.Generator) -> Recording:
    import mujoco

    model = mujoco.MjModel.from_xml_string(arm(values, elastic))
    data = mujoco.MjData(model)
    t = DT * np.arange(SAMPLES)
    lines, phases = np.exp(rng.uniform(np.log(0.1), np.log(2.0), (10, 2))), rng.uniform(0, 2 * np.pi, (10, 2))
    wanted = np.sum(np.sin(2 * np.pi * t[:, None, None] * lines + phases) / np.sqrt(lines), axis=1)
    wanted *= np.array([1.0, 1.2]) / np.max(np.abs(wanted), axis=0)
    data.qpos[:2] = wanted[0]
    u, y = np.zeros((SAMPLES, 2)), np.zeros((SAMPLES, 2))
    for k in range(SAMPLES):
        y[k] = data.qpos[:2] + NOISE * rng.standard_normal(2)
        u[k] = np.array([80.0, 20.0]) * (wanted[k] - y[k]) - np.array([6.0, 1.0]) * data.qvel[:2]
        data.ctrl[:] = u[k]
        for _ in range(FINE):
            size = friction[0] + friction[1] * abs(u[k, 0])
            data.qfrc_applied[0] = -size * np.tanh(data.qvel[0] / KNEE)
            mujoco.mj_step(model, data)
    names = ("torque1", "torque2"), ("angle1", "angle2")
    return Recording(u, y, DT, *names, initial="estimate", hold="zero")


def main(arguments: Sequence[str] | None = None) -> int:
    """Diagnose every arm; print what was named and the errors."""
    parser = case_parser(__doc__, 5)
    parser.add_argument("--elastic", action="store_true", help="with a spring in the elbow")
    options = parser.parse_args(arguments)
    for seed in numbered(options):
        values, (train, test) = truth(seed, options.elastic)
        rng = np.random.default_rng(seed)
        given = {name: value * rng.uniform(0.85, 1.18) for name, value in values.items()}
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "arm.xml"
            path.write_text(arm(given), encoding="utf-8")
            free = ("upper.mass", "forearm.mass", "shoulder.damping", "elbow.damping", "elbow.armature")
            rigid = from_mujoco(path, parameters=free)
            diagnose_case((rigid, train, test), options.workers).show(f"{seed:3}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
