"""A 2-DOF rig with one law hidden in a port, for the tests of the diagnosis."""

import numpy as np
from simulated import outputs_of

from pilfr_casadi.data import Recording
from pilfr_casadi.diagnose.preparation import first_refit, with_observer
from pilfr_casadi.models import Parameter
from pilfr_casadi.simulators import Port, Simulator, choose_substeps

DT, SAMPLES = 2e-3, 2500


def _dynamics(x, u, p):
    spring, damper = p.k2 * (x.p1 - x.p2), p.d2 * (x.v1 - x.v2)
    return {
        "p1": x.v1,
        "v1": (u.force - p.k1 * x.p1 - p.d1 * x.v1 - spring - damper) / p.m1,
        "p2": x.v2,
        "v2": (spring + damper) / p.m2,
    }


def refitted(bench):
    """The simulator of a workbench, refitted as a diagnosis begins."""
    return with_observer(first_refit(bench))


def rig(factors=(1.0, 1.0, 1.0, 1.0)):
    """The rig with k1, d1, k2, d2 off by factors."""
    k1, d1, k2, d2 = factors
    return Simulator(
        _dynamics,
        lambda x: {"x2": x.p2},
        states=("p1", "v1", "p2", "v2"),
        inputs=("force",),
        parameters={
            "m1": Parameter(2.0, unit="kg", fixed=True),
            "m2": Parameter(1.0, unit="kg", fixed=True),
            "k1": Parameter(1100.0 * k1, unit="N/m", bounds=(100, 9000)),
            "d1": Parameter(8.0 * d1, unit="N s/m", bounds=(0, 100)),
            "k2": Parameter(3000.0 * k2, unit="N/m", bounds=(100, 30000)),
            "d2": Parameter(4.0 * d2, unit="N s/m", bounds=(0, 100)),
        },
        ports=(
            Port("ground-m1", lambda p: {"v1": -1 / p.m1}, lambda x: x.p1, lambda x: x.v1, "N", "m"),
            Port(
                "m1-m2",
                lambda p: {"v1": -1 / p.m1, "v2": 1 / p.m2},
                lambda x: x.p1 - x.p2,
                lambda x: x.v1 - x.v2,
                "N",
                "m",
            ),
        ),
    )


OFF = (1.1, 0.8, 0.9, 1.2)


def recordings(*laws, port="ground-m1", seed=0, count=2, noise=1e-3, hold="zero", of=None):
    """Recordings of the rig, or of another, with laws in a port, from rest."""
    rng, true = np.random.default_rng(seed), of or rig()
    for law in filter(None, laws):
        true = true.with_element(port, law)
    t = np.arange(SAMPLES) * DT
    out = []
    for _ in range(count):
        f, phase = np.linspace(0.3, 12, 60), rng.uniform(0, 2 * np.pi, 60)
        v = np.sum(np.cos(2 * np.pi * f[:, None] * t + phase[:, None]), axis=0)
        u = (40 * v / np.std(v) * (0.3 + 0.7 * np.sin(np.pi * t / t[-1])))[:, None]
        blank = Recording(u, u, DT, inputs=("force",), outputs=("x2",), initial="zero", hold=hold)
        y = outputs_of(true, blank, hold, max(4, choose_substeps(true, [blank])))
        out.append(blank.with_(y=y + noise * np.std(y) * rng.standard_normal(y.shape)))
    return out
