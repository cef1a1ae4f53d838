"""A slow tank, for the tests of slow noise."""

import pilfr_casadi as pilfr


def tank(curved=0.0, outflow=2e-4):
    """A tank of 0.05 m²; `curved` bends its outflow."""
    return pilfr.Simulator(
        lambda x, u, p: {"level": (p.k * u.pump - p.a * x.level - curved * (x.level**2 - 0.9 * x.level)) / 0.05},
        lambda x: {"level": x.level},
        states=("level",),
        inputs=("pump",),
        parameters={
            "k": pilfr.Parameter(2.4e-5, bounds=(5e-6, 1e-4)),
            "a": pilfr.Parameter(outflow, bounds=(0, 1e-3)),
        },
    )
