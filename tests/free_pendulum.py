"""A pendulum that swings out without an input; the simulator lacks the dry friction of the machine."""

import casadi as ca
import numpy as np

from pilfr_casadi import Parameter, Port, Recording, Simulator
from pilfr_casadi.laws import CoulombFriction

simulator = Simulator(
    lambda x, p: {"angle": x.speed, "speed": -(p.w**2) * ca.sin(x.angle) - p.d * x.speed},
    lambda x: {"angle": x.angle},
    states=("angle", "speed"),
    parameters={"w": Parameter(5.0, "rad/s", bounds=(3, 9)), "d": Parameter(0.1, "1/s", bounds=(0, 1))},
    ports=Port("bearing", {"speed": -1.0}, lambda x: x.angle, lambda x: x.speed, unit="rad/s^2", across_unit="rad"),
    units={"angle": "rad"},
)
rubbing = CoulombFriction().at({"F_c": 0.6, "v_0": 0.02})
machine = simulator.with_parameters({"w": 5.3, "d": 0.05}).with_element("bearing", rubbing)


def decay(start, true=machine, m=400, dt=0.02):
    """A recording of the machine from a start, which it does not state."""
    r = Recording(np.empty((m, 0)), np.empty((m, 0)), dt, initial=start, name="decay")
    y = true.simulate(r) + 2e-3 * np.random.default_rng(0).standard_normal((m, 1))
    return r.with_(y=y, outputs=("angle",), units={"angle": "rad"}, initial="estimate")
