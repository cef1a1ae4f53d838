"""
A tank whose pump does not start at once
========================================

A pump fills a tank, which empties through an orifice. In the simulator the pump's flow is proportional to its voltage.

.. image:: /pictures/sketch_tank.svg
   :alt: A tank that a pump fills and an orifice empties; the missing physics is red
   :width: 400
"""

# sphinx_gallery_thumbnail_path = "pictures/sketch_tank.svg"
import casadi as ca
import numpy as np

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Simulator
from pilfr_casadi.laws import DeadZone


def tank(pump, outflow):
    """Make the simulator: a volume balance over an area of 0.02 m²."""
    return Simulator(
        lambda x, u, p: dict(level=(p.pump * u.voltage - p.outflow * ca.sqrt(ca.fmax(x.level, 1e-6))) / 0.02),
        lambda x: dict(level=x.level),
        states=("level",),
        inputs=("voltage",),
        parameters=dict(
            pump=Parameter(pump, unit="m3/(s V)", bounds=(5e-6, 5e-5)),
            outflow=Parameter(outflow, unit="m2.5/s", bounds=(2e-5, 5e-4)),
        ),
        units=dict(voltage="V", level="m"),
    )


def record(machine, seed, samples=700, dt=2.0):
    """Record a new voltage every 40 s, and the level with noise of 0.5 mm."""
    rng = np.random.default_rng(seed)
    voltage = np.repeat(rng.uniform(0, 8, samples // 20), 20)
    blank = pilfr.Recording(voltage, np.zeros(samples), dt, "voltage", "level", initial=[0.25], hold="zero")
    level = machine.simulate(blank) + 5e-4 * rng.normal(size=(samples, 1))
    return blank.with_(y=level, initial="estimate", name=f"run {seed}")


# %%
# Below 2 V nothing flows. The initial level is not known exactly, so it is estimated.

machine = tank(2e-5, 1e-4).with_element("actuator:voltage", DeadZone().at({"g": 2.0}))
simulator, train, test = tank(1.5e-5, 1.2e-4), record(machine, 1), record(machine, 2)
beside = simulator.plot(test)

# %%
diagnosis = pilfr.diagnose(simulator, train, test=test)
print(diagnosis)
proof = diagnosis.plot(test)
assert diagnosis.effects[0].law == "dead_zone" and diagnosis.outcome == "better"
