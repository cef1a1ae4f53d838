"""Simulators from MuJoCo models of arms and mechanisms: trees of rigid bodies on hinges and slides.

MuJoCo reads the file. The equations of motion

    M(q) dv/dt + c(q, v) = τ_actuators - D v - K (q - q_spring) - f(v) + w

(Featherstone 2008, Rigid Body Dynamics Algorithms, ch. 2) are then written for CasADi. So they can be compiled, have
exact derivatives by states and by all numbers of the model, and accept a force w at every joint. The dry friction f is
the joint's `frictionloss` while it slides, and `s v` while it sticks, where s is the slope of MuJoCo's own friction at
rest. They are compared with MuJoCo's own accelerations at several points. Contacts and joint limits are left out, with
a note. A model with any other feature that the equations lack is refused.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, check_known
from ..models import Named, Parameter, parameter_within, within_a_factor
from .mujoco_model import AXES, MujocoTree
from .ports import Port
from .simulator import Simulator
from .user_arguments import as_names, choose_parameters

COMPARED_POINTS = 8  # at which the equations are compared with MuJoCo
AGREE = 1e-8  # relative difference of accelerations that rounding may cause


def from_mujoco(
    model: str | os.PathLike[str] | Any,
    *,
    parameters: Sequence[str] | Mapping[str, Parameter] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    hold: str | None = None,
) -> Simulator:
    """Make a simulator from a MuJoCo model (extra `pilfr-casadi[mujoco]`).

    Every joint is a port, with its torque or force, position and speed. The states are the joints' positions, with the
    names of the joints, and their speeds, such as `elbow.speed`. The absolute force of the actuators on a joint is the
    signal `load` of its port, with which friction may grow.

    Parameters
    ----------
    model : path, mujoco.MjModel or mujoco.MjSpec
        An MJCF or URDF file, or a model in memory, which is copied.
    parameters : one name or several, or mapping from names to Parameter, optional
        Numbers of the model that a fit may change: `<body>.mass`, with which the inertia scales; `<body>.inertia`, a
        factor on the inertia alone; `<body>.inertia_x`, `inertia_y`, `inertia_z`, the moments of inertia about the
        principal axes in the order of MuJoCo; `<body>.com_x`, `com_y`, `com_z`; `<joint>.damping`, `armature`,
        `stiffness`, `spring`, `frictionloss`; `<actuator>.gain`, `gear`; `gravity`. By default all masses and dampings,
        friction losses that are not zero, and those with `bounds`. The others keep the model's values.
    bounds : mapping, optional
        `(lower, upper)` by parameter; by default a factor of ten either way; dampings, armatures, stiffnesses,
        friction losses and values of zero are bounded by zero below.
    inputs : str or sequence of str, optional
        Recorded actuators; by default all. The others are at zero.
    outputs : str or sequence of str, optional
        Recorded sensors, or joints; by default all sensors of joint positions and speeds, or all joints if there is
        none. Sensors of an actuator's force and of the actuators' force on a joint may be given too.
    hold : {"zero", "linear", "band-limited", "next"}, optional
        As of `Simulator`.

    Raises
    ------
    InputError
        If MuJoCo is not installed or cannot read the file, a name is unknown, or the model has features that the
        equations lack, such as free bodies, tendons, equality constraints or muscles.
    """
    tree, bounds = MujocoTree.load(model), bounds or {}
    inputs, outputs, parameters = map(as_names, (inputs, outputs, parameters))
    given = tree.default_parameters if parameters is None else parameters
    tree.check_parameters((*given, *bounds))
    check_known(inputs or (), tree.actuators, "actuators", tree.label)
    check_known(outputs or (), tuple(tree.sensors), "joints, and sensors of joints and actuators", tree.label)
    numbers = tree.numbers
    made = choose_parameters(
        given, bounds, lambda n, ends: parameter_within(n, numbers[n], ends or _default_bounds(n, numbers[n]))
    )
    drives = tuple(tree.actuators if inputs is None else inputs)
    measured = tuple(tree.default_outputs if outputs is None else outputs)
    equations = _Equations(tree, tuple(made), drives, measured)
    equations.check()
    return Simulator(
        equations,
        equations.outputs,
        (*tree.joints, *(f"{n}.speed" for n in tree.joints)),
        drives,
        made,
        tuple(equations.port(i) for i in range(len(tree.joints))),
        hold,
        units=tree.units(measured),
    )


class _Equations:
    """The equations of motion of a tree with some of its numbers, actuators and sensors as symbols."""

    def __init__(
        self, tree: MujocoTree, free: tuple[str, ...], inputs: tuple[str, ...], measured: tuple[str, ...]
    ) -> None:
        self.tree, self.free, self.inputs, self.measured = tree, free, inputs, measured
        n = len(tree.joints)
        q, v, u, p = (ca.SX.sym(name, size) for name, size in zip("qvup", (n, n, len(inputs), len(free)), strict=True))
        controls = {name: u[i] for i, name in enumerate(inputs)}
        numbers = {**tree.numbers, **{name: p[i] for i, name in enumerate(free)}}
        forces, driven = self._actuator_forces(q, v, controls, numbers)
        sizes = ca.vertcat(*(numbers[f"{name}.frictionloss"] for name in tree.joints))
        friction = _clip(ca.DM(tree.friction_slopes) * v, -sizes, sizes)
        mass, rest = self._motion_terms(q, v, driven - friction, numbers)
        # M, the rest of the equations M dv/dt = rest, the actuators' forces on the joints and their own, the friction
        self.motion = ca.Function("motion", [q, v, u, p], [mass, rest, driven, forces, friction])

    def __reduce__(self) -> tuple[Any, ...]:
        """Write the equations again in another process."""
        return _Equations, (self.tree, self.free, self.inputs, self.measured)

    def check(self) -> None:
        """Compare with MuJoCo's accelerations at several points, without dry friction, which depends on its solver."""
        tree, rng, n = self.tree, np.random.default_rng(0), len(self.tree.joints)
        drives = [tree.actuators.index(name) for name in self.inputs]
        values = [tree.numbers[name] for name in self.free]
        for _ in range(COMPARED_POINTS):
            q, v, u = rng.uniform(-0.7, 0.7, n), rng.normal(0, 1, n), np.zeros(len(tree.actuators))
            u[drives] = rng.uniform(-0.5, 0.5, len(drives))
            mass, rest, _, _, friction = self.motion(q, v, u[drives], values)
            wanted, found = tree.acceleration(q, v, u), np.linalg.solve(mass.full(), (rest + friction).full().ravel())
            if not np.max(np.abs(found - wanted)) <= AGREE * max(np.max(np.abs(wanted)), 1.0):
                raise InputError(
                    f"{tree.label} moves otherwise than a tree of rigid bodies with linear springs, dampers and "
                    "actuators; remove its other features, such as a fluid, curved damping, or gravity compensation."
                )

    def _pose_bodies(self, q: Any, numbers: Mapping[str, Any]) -> tuple[list[tuple[Any, Any, int]], list[Any]]:
        """Return centre of mass, axes of the inertia (3, 3) and index of each moving body, and the joints' axes.

        All are in the world's frame. A slide has the axis zero, because it turns nothing.
        """
        m, out = self.tree.model, []
        poses: list[tuple[Any, Any]] = [(ca.SX.zeros(3), ca.SX.eye(3))]
        turning = [ca.SX.zeros(3) for _ in self.tree.joints]
        for i in range(1, m.nbody):
            p, r = poses[m.body_parentid[i]]
            p, r = p + r @ ca.SX(ca.DM(m.body_pos[i])), r @ _rotate_by(m.body_quat[i])
            for j in range(m.body_jntadr[i], m.body_jntadr[i] + m.body_jntnum[i]):
                moved, axis = q[j] - m.qpos0[m.jnt_qposadr[j]], ca.DM(m.jnt_axis[j])
                along = r @ ca.SX(axis)
                if self.tree.hinge(j):
                    turning[j] = along
                    anchor = ca.SX(ca.DM(m.jnt_pos[j]))
                    turned = r @ _rotate_about(axis, moved)
                    p, r = p + r @ anchor - turned @ anchor, turned
                else:
                    p = p + along * moved
            poses.append((p, r))
        for i in self.tree.list_moving_bodies():
            p, r = poses[i]
            centre = ca.vertcat(*(numbers[f"{self.tree.bodies[i]}.com_{axis}"] for axis in AXES))
            out.append((p + r @ centre, r @ _rotate_by(m.body_iquat[i]), i))
        return out, turning

    def _joints_above(self, body: int) -> set[int]:
        """List the joints that move a body."""
        m, out = self.tree.model, set[int]()
        while body:
            out |= set(range(m.body_jntadr[body], m.body_jntadr[body] + m.body_jntnum[body]))
            body = int(m.body_parentid[body])
        return out

    def _motion_terms(self, q: Any, v: Any, driven: Any, numbers: Mapping[str, Any]) -> tuple[Any, Any]:
        """Return M(q), (n, n), and the rest of the equations M dv/dt = rest, (n,), with the forces `driven`."""
        m, n, tree = self.tree.model, len(self.tree.joints), self.tree
        down = m.opt.gravity / (np.linalg.norm(m.opt.gravity) or 1.0)
        fall = numbers["gravity"] * ca.SX(ca.DM(down))
        mass, rest = ca.SX.zeros(n, n), 1 * driven
        bodies, hinges = self._pose_bodies(q, numbers)
        for centre, axes, i in bodies:
            above, name = self._joints_above(i), tree.bodies[i]
            turning = ca.horzcat(*(axis if j in above else ca.SX.zeros(3) for j, axis in enumerate(hinges)))
            moving, weight = ca.jacobian(centre, q), numbers[f"{name}.mass"]
            share = numbers[f"{name}.inertia"] * weight / float(m.body_mass[i])
            principal = ca.vertcat(*(numbers[f"{name}.inertia_{axis}"] for axis in AXES))
            inertia = axes @ ca.diag(principal * share) @ axes.T
            omega = turning @ v
            bias, turned = (ca.jtimes(part @ v, q, v) for part in (moving, turning))
            mass += weight * moving.T @ moving + turning.T @ inertia @ turning
            torque = inertia @ turned + ca.cross(omega, inertia @ omega)
            rest -= moving.T @ (weight * (bias - fall)) + turning.T @ torque
        for j, name in enumerate(tree.joints):
            mass[j, j] += numbers[f"{name}.armature"]
            rest[j] -= numbers[f"{name}.damping"] * v[j]
            rest[j] -= numbers[f"{name}.stiffness"] * (q[j] - numbers[f"{name}.spring"])
        return mass, rest

    def _actuator_forces(
        self, q: Any, v: Any, controls: Mapping[str, Any], numbers: Mapping[str, Any]
    ) -> tuple[Any, Any]:
        """Return the force of every actuator, (n_u,), and of all actuators on every joint, (n,)."""
        m, driven = self.tree.model, ca.SX.zeros(len(self.tree.joints))
        forces = ca.SX.zeros(len(self.tree.actuators))
        for i, name in enumerate(self.tree.actuators):
            j, gear = int(m.actuator_trnid[i, 0]), numbers[f"{name}.gear"]
            control = controls.get(name, 0.0)
            if m.actuator_ctrllimited[i]:
                control = _clip(control, *m.actuator_ctrlrange[i])
            b0, b1, b2 = m.actuator_biasprm[i, :3]
            gain = m.actuator_gainprm[i, 0] * numbers[f"{name}.gain"]
            force = gain * control + b0 + b1 * gear * q[j] + b2 * gear * v[j]
            forces[i] = _clip(force, *m.actuator_forcerange[i]) if m.actuator_forcelimited[i] else force
            driven[j] += gear * forces[i]
        for j in np.flatnonzero(m.jnt_actfrclimited).tolist():
            driven[j] = _clip(driven[j], *m.jnt_actfrcrange[j])
        return forces, driven

    def _evaluate(self, x: Named, u: Named, p: Named) -> Any:
        """Evaluate `motion` for the simulator's symbols."""
        names, none = self.tree.joints, ca.SX(0, 1)
        return self.motion(
            ca.vertcat(*(x[n] for n in names)),
            ca.vertcat(*(x[f"{n}.speed"] for n in names)),
            ca.vertcat(none, *(u[n] for n in self.inputs)),
            ca.vertcat(none, *(p[n] for n in self.free)),
        )

    @property
    def note(self) -> str:
        """The features of the model that the equations leave out; a `Simulator` prints it."""
        return self.tree.omissions

    def __call__(self, x: Named, u: Named, p: Named) -> dict[str, Any]:
        """Evaluate the derivatives by state: the dynamics of a `Simulator`."""
        names, speeds = self.tree.joints, [f"{n}.speed" for n in self.tree.joints]
        mass, rest = self._evaluate(x, u, p)[:2]
        accelerations = dict(zip(speeds, ca.vertsplit(ca.solve(mass, rest)), strict=True))
        return {n: x[speed] for n, speed in zip(names, speeds, strict=True)} | accelerations

    def outputs(self, x: Named, u: Named, p: Named) -> dict[str, Any]:
        """Evaluate the outputs by name."""
        joints, out = self.tree.joints, {}
        for name in self.measured:
            what, i = self.tree.sensors[name]
            if what in ("force", "joint force"):
                out[name] = self._evaluate(x, u, p)[3 if what == "force" else 2][i]
            else:
                out[name] = x[joints[i] + (".speed" if what == "speed" else "")]
        return out

    def port(self, joint: int) -> Port:
        """Make the port of a joint; a positive force opposes motion."""
        names, name = self.tree.joints, self.tree.joints[joint]

        def into(x: Named, u: Named, p: Named) -> dict[str, Any]:
            mass = self._evaluate(x, u, p)[0]
            unit = ca.SX.zeros(len(names))
            unit[joint] = -1.0
            return {f"{n}.speed": a for n, a in zip(names, ca.vertsplit(ca.solve(mass, unit)), strict=True)}

        def load(x: Named, u: Named, p: Named) -> Any:
            return ca.fabs(self._evaluate(x, u, p)[2][joint])

        def motor(dz: Any, x: Named, u: Named, p: Named) -> Any:
            # the motor causes most of the damping of a geared joint
            loss = f"{name}.damping"
            damping = p[loss] if loss in self.free else self.tree.numbers[loss]
            return damping * dz - self._evaluate(x, u, p)[2][joint]

        unit = ("N m", "rad") if self.tree.hinge(joint) else ("N", "m")
        driven = any(int(j) == joint for j in self.tree.model.actuator_trnid[:, 0])
        across, rate = (lambda x: x[name]), (lambda x: x[f"{name}.speed"])
        own: dict[str, Any] = {"signals": {"load": load}, "term": motor} if driven else {}
        return Port(name, into, across, rate, *unit, **own)


def _rotate_about(axis: ca.DM, angle: Any) -> Any:
    """Make the rotation (3, 3) about a unit axis (Rodrigues)."""
    k = ca.SX(ca.skew(axis))
    return ca.SX.eye(3) + ca.sin(angle) * k + (1 - ca.cos(angle)) * (k @ k)


def _rotate_by(quaternion: np.ndarray) -> Any:
    """Make the rotation (3, 3) of a unit quaternion w, x, y, z."""
    w, v = float(quaternion[0]), ca.DM(quaternion[1:])
    k = ca.skew(v)
    return ca.SX(ca.DM.eye(3) + 2 * w * k + 2 * k @ k)


def _clip(value: Any, low: Any, high: Any) -> Any:
    return ca.fmin(ca.fmax(value, low), high)


def _default_bounds(name: str, value: float) -> tuple[float, float]:
    if ".com_" in name or name.endswith(".spring"):
        return -np.inf, np.inf
    if name.endswith((".damping", ".armature", ".stiffness", ".frictionloss")):  # a joint need not have any
        return 0.0, within_a_factor(value)[1] or np.inf
    return within_a_factor(value) if value else (0.0, np.inf)
