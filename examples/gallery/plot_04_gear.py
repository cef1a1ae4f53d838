"""
A worn gear
===========

A servo turns a table through a gear. The simulator is a mode at 1.6 Hz; the play between the teeth is missing.

.. image:: /pictures/sketch_gear.svg
   :alt: Two toothed wheels with play between their teeth; the missing physics is red
   :width: 400
"""

# sphinx_gallery_thumbnail_path = "pictures/sketch_gear.svg"
import numpy as np

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Simulator
from pilfr_casadi.laws import Backlash


def table(stiffness, damper):
    """Make the simulator: inertia one, driven through the gear's stiffness."""
    return Simulator(
        lambda x, u, p: dict(angle=x.speed, speed=p.stiffness * (u.servo - x.angle) - p.damper * x.speed),
        lambda x: dict(angle=x.angle),
        states=("angle", "speed"),
        inputs=("servo",),
        parameters=dict(
            stiffness=Parameter(stiffness, unit="1/s2", bounds=(20, 500)),
            damper=Parameter(damper, unit="1/s", bounds=(0.1, 50)),
        ),
        units=dict(servo="deg", angle="deg"),
    )


def record(machine, seed, samples=900, dt=0.02):
    """Record a slow multisine of the servo, and the angle with noise of 0.01 degrees."""
    rng = np.random.default_rng(seed)
    servo = 5 * pilfr.multisine(samples, f_max=1.5, fs=1 / dt, rng=rng)
    blank = pilfr.Recording(servo, np.zeros(samples), dt, "servo", "angle", initial="zero", hold="linear")
    return blank.with_(y=machine.simulate(blank) + 0.01 * rng.normal(size=(samples, 1)), name=f"run {seed}")


# %%
# The teeth have a play of 1 degree to each side.

machine = table(100.0, 8.0).with_element("actuator:servo", Backlash().at({"r": 1.0}))
simulator, train, test = table(120.0, 6.0), record(machine, 1), record(machine, 2)
beside = simulator.plot(test)

# %%
diagnosis = pilfr.diagnose(simulator, train, test=test)
print(diagnosis)
proof = diagnosis.plot(test)
assert diagnosis.effects[0].law in ("backlash", "hysteresis") and diagnosis.outcome == "better"
