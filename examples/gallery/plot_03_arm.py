"""
An arm that swings far
======================

The simulator of a hanging arm linearises gravity for small angles and neglects the dry friction of the bearing.

.. image:: /pictures/sketch_arm.svg
   :alt: An arm that hangs in a bearing; the missing physics is red
   :width: 400
"""

# sphinx_gallery_thumbnail_path = "pictures/sketch_arm.svg"
import casadi as ca
import numpy as np

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Simulator
from pilfr_casadi.laws import CoulombFriction


def arm(gravity, damper, torque_of=lambda angle: angle):
    """Make the simulator with an inertia of 0.06 kg m²."""
    return Simulator(
        lambda x, u, p: dict(
            angle=x.speed, speed=(u.torque - p.gravity * torque_of(x.angle) - p.damper * x.speed) / 0.06
        ),
        lambda x: dict(angle=x.angle),
        states=("angle", "speed"),
        inputs=("torque",),
        parameters=dict(
            gravity=Parameter(gravity, unit="N m", bounds=(0.2, 5)),
            damper=Parameter(damper, unit="N m s", bounds=(0, 1)),
        ),
        ports=Port("joint", dict(speed=-1 / 0.06), lambda x: x.angle, lambda x: x.speed, unit="N m", across_unit="rad"),
        units=dict(torque="N m", angle="rad"),
    )


def record(machine, seed, samples=700, dt=0.01):
    """Record a multisine of torque, and the angle with noise of 2 mrad."""
    rng = np.random.default_rng(seed)
    torque = 0.35 * pilfr.multisine(samples, f_max=1.2, fs=1 / dt, rng=rng)
    blank = pilfr.Recording(torque, np.zeros(samples), dt, "torque", "angle", initial="zero", hold="zero")
    return blank.with_(y=machine.simulate(blank) + 2e-3 * rng.normal(size=(samples, 1)), name=f"run {seed}")


# %%
# The torque of gravity is proportional to the sine of the angle, and the bearing has 0.05 N m of dry friction.

machine = arm(1.0, 0.03, ca.sin).with_element("joint", CoulombFriction().at({"F_c": 0.05, "v_0": 0.02}))
simulator, train, test = arm(1.0, 0.05), record(machine, 1), record(machine, 2)
beside = simulator.plot(test)

# %%
# The unit of the angle is known, so that the torque of gravity is tried with its sine.

diagnosis = pilfr.diagnose(simulator, train, test=test)
print(diagnosis)
proof = diagnosis.plot(test)
assert {effect.law for effect in diagnosis.effects} == {"gravity", "coulomb_friction"} and diagnosis.outcome == "better"
