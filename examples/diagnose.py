"""Find the missing physics of a simulator: a stage whose spring hits a stop on one side."""

import numpy as np

import pilfr_casadi as pilfr
from pilfr_casadi import Parameter, Port, Simulator


def dynamics(x, u, p):
    """Return the derivatives of the simulator: linear spring and damper only."""
    return dict(pos=x.vel, vel=(u.force - p.k * x.pos - p.d * x.vel) / p.m)


def outputs(x):
    """Return the measured output."""
    return dict(position=x.pos)


simulator = Simulator(
    dynamics,
    outputs,
    states=("pos", "vel"),
    inputs=("force",),
    parameters=dict(
        m=Parameter(2.0, unit="kg", fixed=True),
        k=Parameter(1100.0, unit="N/m", bounds=(500, 3000)),
        d=Parameter(15.0, unit="N s/m", bounds=(0, 100)),
    ),
    ports=(Port("ground-mass", lambda p: dict(vel=-1 / p.m), lambda x: x.pos, unit="N", across_unit="m"),),
)


def machine(seed, samples=1000, dt=0.01, fine=100):
    """Simulate the machine: its spring is 10 % softer, and a stop of 6000 N/m is at 12 mm."""
    rng = np.random.default_rng(seed)
    force = 15 * pilfr.multisine(samples, f_max=8.0, fs=1 / dt, rng=rng)
    pos, vel, measured = 0.0, 0.0, np.zeros(samples)
    for k in range(samples):
        measured[k] = pos
        for _ in range(fine):
            stop = 6000 * max(pos - 0.012, 0.0)
            vel += dt / fine * (force[k] - 1000 * pos - 16 * vel - stop) / 2.0
            pos += dt / fine * vel
    measured += 5e-5 * rng.standard_normal(samples)
    return pilfr.Recording(force, measured, dt, ("force",), ("position",), initial="zero", hold="zero")


train, test = machine(0), machine(1)
diagnosis = pilfr.diagnose(simulator, train, test=test)  # test is never used to fit or to choose
print(diagnosis)  # where, what, how sure, before -> after -> noise floor
diagnosis.report("report")  # report.html, diagnosis.json, figures
corrected = diagnosis.corrected  # the fitted simulator with the stop in its port
print(corrected.elements[0].port, float(corrected.parameters["k"].value))
errors = diagnosis.errors["test"]
assert diagnosis.effects[0].law == "piecewise_stiffness" and errors["after"] < 0.2 * errors["before"]
