"""MuJoCo models as MuJoCo has compiled them: names and numbers, sensors, and the features that equations lack."""

from __future__ import annotations

import copy
import itertools
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from .._base import InputError, existing_file, in_words, quote_error

AXES = ("x", "y", "z")
OF_BODIES = ("mass", "inertia", *(f"inertia_{axis}" for axis in AXES), *(f"com_{axis}" for axis in AXES))
OF_JOINTS = ("damping", "armature", "stiffness", "spring", "frictionloss")
OF_ACTUATORS = ("gain", "gear")


@dataclass(frozen=True, eq=False)
class MujocoTree:
    """A model as MuJoCo has compiled it, with its names; `source` is its file, or itself."""

    source: Any
    mujoco: Any
    model: Any

    @classmethod
    def load(cls, source: Any) -> MujocoTree:
        """Read a file, or copy a model in memory; refuse a model with features that the equations lack."""
        try:
            import mujoco
        except ImportError:
            raise InputError("mujoco is not installed; install it with `pip install pilfr-casadi[mujoco]`.") from None
        in_memory = isinstance(source, mujoco.MjModel | mujoco.MjSpec)
        path = None if in_memory else existing_file(_as_path(source))
        try:
            if path is not None:
                model = mujoco.MjModel.from_xml_path(str(path))
            else:
                model = copy.copy(source) if isinstance(source, mujoco.MjModel) else source.copy().compile()
        except Exception as error:
            raise InputError(f"MuJoCo cannot read {path or 'the MjSpec'} ({quote_error(error)}); correct it.") from None
        tree = cls(path or model, mujoco, model)
        if not model.njnt:
            raise InputError(f"{tree.label} has no joint, so nothing in it can move; give a model with joints.")
        if lacks := tree._unsupported_feature():
            raise InputError(
                f"{tree.label} has {lacks}, which the equations of a tree of rigid bodies do not hold; remove it."
            )
        return tree

    def __reduce__(self) -> tuple[Any, ...]:
        """Read the file again in another process, or send the model there."""
        return MujocoTree.load, (self.source,)

    @property
    def label(self) -> str:
        """Name of the model in messages."""
        if isinstance(self.source, Path):
            return str(self.source)
        return f"The MuJoCo model {bytes(self.model.names).split(bytes(1))[0].decode()}".strip()

    def _unsupported_feature(self) -> str:
        """Name a feature of the model that the equations lack; empty if there is none."""
        m, mj = self.model, self.mujoco
        one_axis = (int(mj.mjtJoint.mjJNT_HINGE), int(mj.mjtJoint.mjJNT_SLIDE))
        cases = {
            "a free or a ball joint": any(kind not in one_axis for kind in m.jnt_type),
            "an equality constraint": m.neq > 0,
            "a tendon": m.ntendon > 0,
            "an actuator that acts on something else than a joint": any(
                kind != int(mj.mjtTrn.mjTRN_JOINT) for kind in m.actuator_trntype
            ),
            "an actuator with a state of its own": any(
                kind != int(mj.mjtDyn.mjDYN_NONE) for kind in m.actuator_dyntype
            ),
            "a muscle, or another curved actuator": any(
                kind > int(mj.mjtBias.mjBIAS_AFFINE) for kind in m.actuator_biastype
            )
            or any(kind != int(mj.mjtGain.mjGAIN_FIXED) for kind in m.actuator_gaintype),
        }
        return next((what for what, found in cases.items() if found), "")

    def _names(self, kind: str, count: int) -> tuple[str, ...]:
        number = getattr(self.mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
        found = [self.mujoco.mj_id2name(self.model, number, i) or f"{kind}{i}" for i in range(count)]
        return tuple(name.replace(" ", "_") for name in found)

    @cached_property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints."""
        return self._names("joint", self.model.njnt)

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        """Names of the bodies, the world first."""
        return self._names("body", self.model.nbody)

    @cached_property
    def actuators(self) -> tuple[str, ...]:
        """Names of the actuators."""
        return self._names("actuator", self.model.nu)

    @cached_property
    def sensors(self) -> dict[str, tuple[str, int]]:
        """(measured quantity, joint or actuator) by name of a sensor that the equations have, or of a joint."""
        names = {"JOINTPOS": "position", "JOINTVEL": "speed", "ACTUATORFRC": "force", "JOINTACTFRC": "joint force"}
        kinds = {int(getattr(self.mujoco.mjtSensor, f"mjSENS_{kind}")): what for kind, what in names.items()}
        found = {
            name: (kinds[int(self.model.sensor_type[i])], int(self.model.sensor_objid[i]))
            for i, name in enumerate(self._names("sensor", self.model.nsensor))
            if int(self.model.sensor_type[i]) in kinds
        }
        return {**{name: ("position", i) for i, name in enumerate(self.joints)}, **found}

    @property
    def default_outputs(self) -> tuple[str, ...]:
        """The sensors of joint positions and speeds, or the joints if there is none."""
        motions = tuple(n for n, (what, _) in self.sensors.items() if what in ("position", "speed"))
        return tuple(n for n in motions if n not in self.joints) or self.joints

    @property
    def omissions(self) -> str:
        """The features that the equations leave out, in words; empty if there is none."""
        limited = [name for name, has in zip(self.joints, self.model.jnt_limited, strict=True) if has]
        touching = self._find_contact()
        unknown = [n for n in self._names("sensor", self.model.nsensor) if n not in self.sensors]
        off, bits = self.model.opt.disableflags, self.mujoco.mjtDisableBit
        parts = []
        if limited and not off & (bits.mjDSBL_LIMIT | bits.mjDSBL_CONSTRAINT):
            parts.append(f"the limits of {in_words(limited)}")
        if touching and not off & (bits.mjDSBL_CONTACT | bits.mjDSBL_CONSTRAINT):
            parts.append(f"contacts, as of {' with '.join(touching)}")
        if unknown:
            parts.append(f"the sensors {in_words(unknown)}")
        return f"{self.label}: the equations leave out {'; '.join(parts)}" if parts else ""

    def _find_contact(self) -> tuple[str, ...]:
        """Name two bodies that can collide, by the rules of MuJoCo; empty if there are none."""
        m = self.model
        if m.npair:
            return tuple(self.bodies[m.geom_bodyid[geom[0]]] for geom in (m.pair_geom1, m.pair_geom2))
        excluded = {frozenset(divmod(int(pair), 1 << 16)) for pair in m.exclude_signature}
        for i, j in itertools.combinations(range(m.nbody), 2):
            welds = {int(m.body_weldid[i]), int(m.body_weldid[j])}
            parents = {int(m.body_weldid[m.body_parentid[weld]]) for weld in welds}
            related = len(welds) == 1 or (0 not in welds and welds & parents)
            meets = m.body_contype[i] & m.body_conaffinity[j] or m.body_contype[j] & m.body_conaffinity[i]
            if meets and not related and frozenset((i, j)) not in excluded:
                return self.bodies[i], self.bodies[j]
        return ()

    def list_moving_bodies(self) -> list[int]:
        """List the bodies with a mass that a joint moves."""
        m, moves = self.model, [False] * self.model.nbody
        for i in range(1, m.nbody):
            moves[i] = bool(m.body_jntnum[i]) or moves[m.body_parentid[i]]
        return [i for i in range(1, m.nbody) if moves[i] and m.body_mass[i] > 0]

    @property
    def frictionless(self) -> bool:
        """Whether a flag of the model disables the dry friction of its joints."""
        bits = self.mujoco.mjtDisableBit
        return bool(self.model.opt.disableflags & (bits.mjDSBL_FRICTIONLOSS | bits.mjDSBL_CONSTRAINT))

    @cached_property
    def numbers(self) -> dict[str, float]:
        """Every number that may be a parameter, by name."""
        m, found = self.model, {"gravity": float(np.linalg.norm(self.model.opt.gravity))}
        for i in self.list_moving_bodies():
            values = (m.body_mass[i], 1.0, *m.body_inertia[i], *m.body_ipos[i])
            found |= _name_numbers(self.bodies[i], OF_BODIES, values)
        for i, name in enumerate(self.joints):
            values = m.dof_damping[i], m.dof_armature[i], m.jnt_stiffness[i], m.qpos_spring[m.jnt_qposadr[i]]
            found |= _name_numbers(name, OF_JOINTS, (*values, 0.0 if self.frictionless else m.dof_frictionloss[i]))
        for i, name in enumerate(self.actuators):
            found |= _name_numbers(name, OF_ACTUATORS, (1.0, m.actuator_gear[i, 0]))
        return found

    def check_parameters(self, names: Sequence[str]) -> None:
        """Refuse names of numbers that the model does not have; the message lists all that it has."""
        unknown = next((name for name in names if name not in self.numbers), None)
        if unknown is None:
            return
        moving = [self.bodies[i] for i in self.list_moving_bodies()]
        known = [
            f"{in_words(numbers)} of the {kind} {in_words(of)}"
            for numbers, kind, of in (
                (OF_BODIES, "bodies", moving),
                (OF_JOINTS, "joints", self.joints),
                (OF_ACTUATORS, "actuators", self.actuators),
            )
            if of
        ]
        raise InputError(
            f"{self.label} has no {unknown!r} among its parameters; they are {'; '.join(known)}; and gravity. Write "
            f"them as in {self.joints[0]}.damping."
        )

    @property
    def default_parameters(self) -> tuple[str, ...]:
        """Masses and dampings, and friction losses that are not zero."""
        kinds = (".mass", ".damping")
        return tuple(n for n, v in self.numbers.items() if n.endswith(kinds) or (n.endswith(".frictionloss") and v))

    @property
    def friction_slopes(self) -> np.ndarray:
        """Dry friction by speed of each joint that sticks, (n,): b / R in the terms of MuJoCo's soft constraints.

        A friction at rest has R = (1 - d) / d times the joint's inverse inertia, and the reference acceleration -b v.
        """
        m = self.model
        d, most = np.clip(m.dof_solimp[:, :2], 1e-4, 1 - 1e-4).T  # as MuJoCo limits them
        time = np.maximum(m.dof_solref[:, 0], 2 * m.opt.timestep)
        b = np.where(m.dof_solref[:, 0] > 0, 2 / (most * time), -m.dof_solref[:, 1] / most)
        return np.asarray(b * d / ((1 - d) * m.dof_invweight0))

    def hinge(self, joint: int) -> bool:
        """Tell whether a joint is a hinge."""
        return bool(self.model.jnt_type[joint] == int(self.mujoco.mjtJoint.mjJNT_HINGE))

    def units(self, measured: Sequence[str]) -> dict[str, str]:
        """Units of outputs."""
        out = {}
        for name in measured:
            what, i = self.sensors[name]
            if what == "force":  # before the gear, whose unit is unknown
                continue
            turns = self.hinge(i)
            units = {"position": ("m", "rad"), "speed": ("m/s", "rad/s"), "joint force": ("N", "N m")}
            out[name] = units[what][turns]
        return out

    def acceleration(self, q: np.ndarray, v: np.ndarray, control: np.ndarray) -> np.ndarray:
        """Compute MuJoCo's own accelerations (n,), without contacts and joint limits."""
        m, mj = self.model, self.mujoco
        data, flags = mj.MjData(m), m.opt.disableflags
        m.opt.disableflags = flags | mj.mjtDisableBit.mjDSBL_CONSTRAINT
        try:
            data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, control
            mj.mj_forward(m, data)
            return np.array(data.qacc)
        finally:
            m.opt.disableflags = flags


def _name_numbers(owner: str, names: Sequence[str], values: Sequence[float]) -> dict[str, float]:
    return {f"{owner}.{name}": float(value) for name, value in zip(names, values, strict=True)}


def _as_path(given: Any) -> Path:
    if not isinstance(given, str | os.PathLike):
        raise InputError(f"A {type(given).__name__} was given; give an MJCF or URDF file, an MjModel or an MjSpec.")
    return Path(given)
