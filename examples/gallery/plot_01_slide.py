"""
A slide with dry friction
=========================

A carriage is pushed along a guide against a spring. Its simulator has mass, spring and a viscous damper. The dry
friction of the guide is missing.

.. image:: /pictures/sketch_slide.svg
   :alt: A carriage on a guide, held by a spring and a damper; the missing physics is red
   :width: 400
"""

# sphinx_gallery_thumbnail_path = "pictures/sketch_slide.svg"
import numpy as np

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Simulator
from pilfr_casadi.laws import CoulombFriction


def slide(spring, damper):
    """Make the simulator of the design office."""
    return Simulator(
        lambda x, u, p: dict(pos=x.vel, vel=(u.force - p.spring * x.pos - p.damper * x.vel) / 2.0),
        lambda x: dict(position=x.pos),
        states=("pos", "vel"),
        inputs=("force",),
        parameters=dict(
            spring=Parameter(spring, unit="N/m", bounds=(100, 4000)),
            damper=Parameter(damper, unit="N s/m", bounds=(0, 100)),
        ),
        ports=Port("guide", dict(vel=-0.5), lambda x: x.pos, lambda x: x.vel, unit="N", across_unit="m"),
        units=dict(force="N", position="m"),
    )


def record(machine, seed, samples=800, dt=0.01):
    """Record a multisine of force, and the position with noise of 20 µm."""
    rng = np.random.default_rng(seed)
    force = 15 * pilfr.multisine(samples, f_max=6.0, fs=1 / dt, rng=rng)
    blank = pilfr.Recording(force, np.zeros(samples), dt, "force", "position", initial="zero", hold="zero")
    return blank.with_(y=machine.simulate(blank) + 2e-5 * rng.normal(size=(samples, 1)), name=f"run {seed}")


# %%
# The machine has 3 N of friction, and its spring is 5 % softer than in the drawing.

machine = slide(950.0, 6.0).with_element("guide", CoulombFriction().at({"F_c": 3.0, "v_0": 0.002}))
simulator, train, test = slide(1000.0, 10.0), record(machine, 1), record(machine, 2)
beside = simulator.plot(test)

# %%
diagnosis = pilfr.diagnose(simulator, train, test=test)
print(diagnosis)
proof = diagnosis.plot(test)
assert diagnosis.effects[0].law == "coulomb_friction" and diagnosis.outcome == "better"
