"""Add your own law to the catalogue: a magnet that pulls a mass on a spring, more strongly the closer it is."""

import numpy as np

import pilfr_casadi as pilfr
from pilfr_casadi import Law, Parameter, Port, Simulator
from pilfr_casadi.laws import CubicStiffness, PiecewiseStiffness, QuadraticStiffness, StopHysteresis


class Magnet(Law):
    """w = -c (1 / (g - z)² - 1 / g²): force of a magnet at the distance g, minus its force at rest."""

    id, equation = "magnet", "w = -c (1 / (g - z)^2 - 1 / g^2)"
    sentence = "a magnet: a pull that grows steeply as the gap closes"
    units = {"c": "w*z^2", "g": "z"}  # w is linear in c, whose unit begins with w; the gap g is a shape
    starts, ranges = {"g": ("high", 1.2, 1.5, 2.0, 3.0)}, {"g": ("high", 1.05, 10.0)}  # multiples of the largest z

    def force(self, z, p):
        """Force w."""
        return -p.c * (1 / (p.g - z) ** 2 - 1 / p.g**2)


simulator = Simulator(
    lambda x, u, p: dict(pos=x.vel, vel=u.force - p.k * x.pos - p.d * x.vel),
    lambda x: dict(position=x.pos),
    states=("pos", "vel"),
    inputs=("force",),
    parameters=dict(k=Parameter(110.0, bounds=(20, 500)), d=Parameter(2.0, bounds=(0, 20))),
    ports=(Port("magnet side", {"vel": -1.0}, lambda x: x.pos, lambda x: x.vel, unit="N", across_unit="m"),),
)


def machine(seed, samples=1000, dt=0.02, fine=40):
    """Simulate the machine."""
    rng = np.random.default_rng(seed)
    force, pos, vel, y = 1.2 * pilfr.multisine(samples, f_max=4.0, fs=1 / dt, rng=rng), 0.0, 0.0, np.zeros(samples)
    for k in range(samples):
        y[k] = pos
        for _ in range(fine):
            pull = 0.5 * (1 / (0.3 - pos) ** 2 - 1 / 0.3**2)
            vel += dt / fine * (force[k] - 120 * pos - 2.2 * vel + pull)
            pos += dt / fine * vel
    return pilfr.Recording(force, y + 1e-4 * rng.standard_normal(samples), dt, ("force",), ("position",), hold="zero")


laws = (Magnet, CubicStiffness, QuadraticStiffness, PiecewiseStiffness, StopHysteresis)  # or (*CATALOGUE, Magnet)
diagnosis = pilfr.diagnose(simulator, machine(0), test=machine(1), laws=laws)
print(diagnosis)
effect = diagnosis.effects[0]
assert effect.law == "magnet" and abs(effect.parameters["g"]["value"] / 0.3 - 1) < 0.05
