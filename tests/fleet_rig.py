"""A small fleet for tests: a mass on a spring, with friction in all machines and a second fault in one."""

import numpy as np
from simulated import outputs_of

from pilfr_casadi.data import Recording
from pilfr_casadi.laws import CoulombFriction, CubicStiffness

DT, SAMPLES, PORT = 5e-3, 240, "ground-mass"
LAWS = (CoulombFriction, CubicStiffness)
SIMULATOR = """
from pilfr_casadi import Parameter, Port, Simulator


def dynamics(x, u, p):
    return {"pos": x.vel, "vel": (u.force - p.k * x.pos - p.d * x.vel) / p.m}


simulator = Simulator(
    dynamics,
    lambda x: {"position": x.pos},
    states=("pos", "vel"),
    inputs=("force",),
    parameters={
        "m": Parameter(2.0, unit="kg", fixed=True),
        "k": Parameter(1100.0, unit="N/m", bounds=(300, 4000)),
        "d": Parameter(12.0, unit="N s/m", fixed=True),
    },
    ports=(Port("ground-mass", lambda p: {"vel": -1 / p.m}, lambda x: x.pos, lambda x: x.vel, "N", "m"),),
    hold="zero",
)
"""


def rig():
    """The simulator, which has neither friction nor a cubic spring."""
    names = {}
    exec(SIMULATOR, names)
    return names["simulator"]


def recording(k, seed, cubic=0.0, friction=5.0, name=""):
    """A recording of a machine: 0.3 % noise, from rest."""
    true = rig().with_element(PORT, CoulombFriction({"F_c": friction, "v_0": 5e-3}))
    true = true.with_element(PORT, CubicStiffness({"k_3": cubic})) if cubic else true
    rng, t, f = np.random.default_rng(seed), np.arange(SAMPLES) * DT, np.linspace(0.5, 8, 20)
    v = np.sum(np.cos(2 * np.pi * f[:, None] * t + rng.uniform(0, 2 * np.pi, (20, 1))), axis=0)
    u = (30 * v / np.std(v))[:, None]
    blank = Recording(u, u, DT, inputs=("force",), outputs=("position",), initial="zero", name=name)
    y = outputs_of(true.with_parameters({"k": k}), blank, substeps=20)
    return blank.with_(y=y + 3e-3 * np.std(y) * rng.standard_normal(y.shape))


STIFFNESS = {"a": 1250.0, "b": 1300.0, "c": 1340.0, "d": 1280.0, "e": 1310.0}  # on the first day
WEAR = 0.03  # share of its stiffness that `b` loses from the first to the second day


def machines():
    """Five machines of two days: the spring of `e` stiffens, that of `b` wears."""
    return {
        name: [
            recording(k * (1 - WEAR * (name == "b") * day), 10 * i + day, 4e4 * (name == "e"), name=f"{name}{day}")
            for day in (0, 1)
        ]
        for i, (name, k) in enumerate(STIFFNESS.items())
    }


def write_machines(folder, found):
    """Write the simulator file, and a folder for each machine with a CSV for each day."""
    (folder / "rig.py").write_text(SIMULATOR)
    for name, days in found.items():
        (folder / "data" / name).mkdir(parents=True)
        for day, r in enumerate(days):
            rows = (f"{t:.9g},{u!r},{y!r}" for t, u, y in zip(r.t, r.u[:, 0].tolist(), r.y[:, 0].tolist(), strict=True))
            (folder / "data" / name / f"{day}.csv").write_text("\n".join(["t,force,position", *rows]) + "\n")
    return folder
