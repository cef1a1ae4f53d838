"""A simulator as a design office writes it: two masses, linear springs and dampers, parameters from the drawings."""

from typing import Any

from pilfr_casadi import Parameter, Port, Simulator


def dynamics(x: Any, u: Any, p: Any) -> dict[str, Any]:
    """Derivatives of the states."""
    inner = p.k2 * (x.x1 - x.x2) + p.d2 * (x.v1 - x.v2)
    return {
        "x1": x.v1,
        "v1": (u.force - p.k1 * x.x1 - p.d1 * x.v1 - inner) / p.m1,
        "x2": x.v2,
        "v2": inner / p.m2,
    }


def outputs(x: Any) -> dict[str, Any]:
    """Return the measured output."""
    return {"x2": x.x2}


simulator = Simulator(
    dynamics,
    outputs,
    states=("x1", "v1", "x2", "v2"),
    inputs=("force",),
    parameters={
        "m1": Parameter(1.2, unit="kg", fixed=True),
        "m2": Parameter(0.8, unit="kg", fixed=True),
        "k1": Parameter(380.0, unit="N/m", bounds=(100, 2000)),
        "k2": Parameter(1000.0, unit="N/m", bounds=(200, 5000)),
        "d1": Parameter(2.3, unit="N s/m", bounds=(0, 50)),
        "d2": Parameter(1.3, unit="N s/m", bounds=(0, 50)),
    },
    ports=(
        Port(
            "ground-m1",
            into=lambda p: {"v1": -1 / p.m1},
            across=lambda x: x.x1,
            rate=lambda x: x.v1,
            unit="N",
            across_unit="m",
        ),
        Port(
            "m1-m2",
            into=lambda p: {"v1": -1 / p.m1, "v2": 1 / p.m2},
            across=lambda x: x.x1 - x.x2,
            unit="N",
            across_unit="m",
        ),
        Port(
            "ground-m2",
            into=lambda p: {"v2": -1 / p.m2},
            across=lambda x: x.x2,
            rate=lambda x: x.v2,
            unit="N",
            across_unit="m",
        ),
    ),
    units={"force": "N", "x2": "m"},
)
