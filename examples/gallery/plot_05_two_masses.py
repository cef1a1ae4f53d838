"""
Two masses and a joint that loses energy
========================================

A motor mass moves a load through a bolted joint, and only the load is measured. The simulator has two masses, springs
and dampers. Microslip in the joint makes its spring hysteretic: the force depends on the past motion.

.. image:: /pictures/sketch_two_masses.svg
   :alt: Two masses on a mount, with a joint between them; the missing physics is red
   :width: 400
"""

# sphinx_gallery_thumbnail_path = "pictures/sketch_two_masses.svg"
import numpy as np

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Simulator
from pilfr_casadi.laws import BoucWen


def drive(k1, k2, d2):
    """Make the simulator: masses of 2 kg and 1 kg, the first on a mount."""

    def dynamics(x, u, p):
        joint = p.k2 * (x.p1 - x.p2) + p.d2 * (x.v1 - x.v2)
        return dict(p1=x.v1, v1=(u.force - p.k1 * x.p1 - 8 * x.v1 - joint) / 2, p2=x.v2, v2=joint)

    mount = Port("mount", dict(v1=-0.5), lambda x: x.p1, lambda x: x.v1, "N", "m")
    joint = Port("joint", dict(v1=-0.5, v2=1.0), lambda x: x.p1 - x.p2, lambda x: x.v1 - x.v2, "N", "m")
    return Simulator(
        dynamics,
        lambda x: dict(load=x.p2),
        states=("p1", "v1", "p2", "v2"),
        inputs=("force",),
        parameters=dict(
            k1=Parameter(k1, unit="N/m", bounds=(200, 5000)),
            k2=Parameter(k2, unit="N/m", bounds=(200, 20000)),
            d2=Parameter(d2, unit="N s/m", bounds=(0, 50)),
        ),
        ports=(mount, joint),
        units=dict(force="N", load="m"),
    )


def record(machine, seed, samples=1000, dt=5e-3):
    """Record a multisine of force, and the load's position with noise of 10 µm."""
    rng = np.random.default_rng(seed)
    force = 30 * pilfr.multisine(samples, f_max=10.0, fs=1 / dt, rng=rng)
    blank = pilfr.Recording(force, np.zeros(samples), dt, "force", "load", initial="zero", hold="zero")
    return blank.with_(y=machine.simulate(blank) + 1e-5 * rng.normal(size=(samples, 1)), name=f"run {seed}")


machine = drive(1100.0, 2000.0, 3.0).with_element(
    "joint", BoucWen().at({"k_h": 2500.0, "q_0": 0.004, "s": 0.5, "n": 1.0})
)
train, test = record(machine, 1), record(machine, 2)
diagnosis = pilfr.diagnose(drive(1000.0, 3000.0, 5.0), train, test=test)
print(diagnosis)
proof = diagnosis.plot(test)
assert diagnosis.effects[0].port == "joint" and diagnosis.outcome == "better"
