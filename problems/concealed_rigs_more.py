"""Electrical, thermal, hydraulic and static base rigs of the concealed cases; see `concealed_rigs`."""

from __future__ import annotations

from .concealed_rig import ACTUATOR, FLOW, SENSOR, SHAFT, Rig, port
from .concealed_rigs import MECHANICAL

MOTOR = """

def dynamics(x, u, p):
    torque = p.kt * (u.voltage - p.kt * x.w1) / p.r
    shaft = p.c * (x.a1 - x.a2) + p.dc * (x.w1 - x.w2)
    return dict(a1=x.w1, w1=(torque - shaft - p.b1 * x.w1) / p.j1, a2=x.w2, w2=(shaft - p.b2 * x.w2) / p.j2)


def outputs(x, u, p):
    return dict(motor=x.a1, load=x.a2)

"""
THERMAL = """

def dynamics(x, u, p):
    through = (x.junction - x.case) / p.r1
    return dict(junction=(u.heat - through) / p.c1, case=(through - x.case / p.r2) / p.c2)


def outputs(x, u, p):
    return dict(t_junction=x.junction, t_case=x.case)

"""
TANKS = """

def dynamics(x, u, p):
    return dict(upper=(p.pump * u.pump - p.c1 * x.upper) / p.area, lower=(p.c1 * x.upper - p.c2 * x.lower) / p.area)


def outputs(x, u, p):
    return dict(level=x.lower)

"""
CYLINDER = """

def dynamics(x, u, p):
    return dict(
        pos=x.vel,
        vel=(p.area * x.pressure - p.d * x.vel - p.k * x.pos) / p.m,
        pressure=p.beta * (p.valve * u.spool - p.area * x.vel - p.leak * x.pressure),
    )


def outputs(x, u, p):
    return dict(position=x.pos, pressure=x.pressure)

"""
PIEZO = """

def dynamics(x, u, p):
    w = 6.28318530718 * p.f0
    return dict(pos=x.vel, vel=w**2 * (p.gain * u.voltage - x.pos) - 2 * p.zeta * w * x.vel)


def outputs(x, u, p):
    return dict(displacement=x.pos)

"""
CIRCUIT = """

def dynamics(x, u, p):
    return dict(charge=x.current, current=(u.voltage - x.charge / p.c - p.r * x.current) / p.l)


def outputs(x, u, p):
    return dict(capacitor=x.charge / p.c)

"""
STATIC = """

def dynamics(x, u, p):
    return {}


def outputs(x, u, p):
    return dict(reading=p.gain * u.drive + p.offset)

"""

OTHERS = (
    Rig(
        "motor",
        "Motor, elastic shaft and load; both angles measured",
        MOTOR,
        ("a1", "w1", "a2", "w2"),
        ("voltage",),
        ("motor", "load"),
        {
            "j1": (1e-3, 2e-3, "kg m2", False),
            "j2": (1.5e-3, 4e-3, "kg m2", False),
            "kt": (0.1, 0.2, "N m/A", True),
            "r": (0.8, 1.5, "Ohm", True),
            "c": (3.0, 8.0, "N m/rad", False),
            "dc": (2e-3, 6e-3, "N m s", False),
            "b1": (1e-3, 4e-3, "N m s", False),
            "b2": (1e-3, 4e-3, "N m s", False),
        },
        {
            "shaft": port(
                "shaft",
                "lambda p: dict(w1=-1 / p.j1, w2=1 / p.j2)",
                "lambda x: x.a1 - x.a2",
                "lambda x: x.w1 - x.w2",
                "N m",
                "rad",
            ),
            "motor-bearing": port(
                "motor-bearing", "lambda p: dict(w1=-1 / p.j1)", "lambda x: x.a1", "lambda x: x.w1", "N m", "rad"
            ),
            "load-bearing": port(
                "load-bearing", "lambda p: dict(w2=-1 / p.j2)", "lambda x: x.a2", "lambda x: x.w2", "N m", "rad"
            ),
        },
        {
            "shaft": SHAFT,
            "motor-bearing": ("coulomb_friction", "stribeck_friction", "periodic_force", "quadratic_drag"),
            "load-bearing": ("coulomb_friction", "stribeck_friction", "quadratic_drag", "periodic_force"),
        },
        (4.0,),
        integrator=True,
    ),
    Rig(
        "thermal",
        "Power module: junction and case above ambient",
        THERMAL,
        ("junction", "case"),
        ("heat",),
        ("t_junction", "t_case"),
        {
            "c1": (0.02, 0.05, "J/K", False),
            "c2": (0.2, 0.5, "J/K", False),
            "r1": (0.8, 2.0, "K/W", False),
            "r2": (1.0, 3.0, "K/W", False),
        },
        {
            "junction-case": port(
                "junction-case",
                "lambda p: dict(junction=-1 / p.c1, case=1 / p.c2)",
                "lambda x: x.junction - x.case",
                None,
                "W",
                "K",
            ),
            "case-ambient": port("case-ambient", "lambda p: dict(case=-1 / p.c2)", "lambda x: x.case", None, "W", "K"),
        },
        {"junction-case": FLOW, "case-ambient": FLOW},
        (10.0,),
        slow=True,
        band=(2.0, 5.0),
    ),
    Rig(
        "tanks",
        "Two tanks about their operating point",
        TANKS,
        ("upper", "lower"),
        ("pump",),
        ("level",),
        {
            "area": (2.0, 4.0, "dm2", True),
            "c1": (1.5, 4.0, "dm2/s", False),
            "c2": (1.5, 4.0, "dm2/s", False),
            "pump": (0.5, 1.5, "l/s/V", False),
        },
        {
            "upper-lower": port(
                "upper-lower",
                "lambda p: dict(upper=-1 / p.area, lower=1 / p.area)",
                "lambda x: x.upper",
                None,
                "l/s",
                "dm",
            ),
            "overflow": port("overflow", "lambda p: dict(upper=-1 / p.area)", "lambda x: x.upper", None, "l/s", "dm"),
            "outlet": port("outlet", "lambda p: dict(lower=-1 / p.area)", "lambda x: x.lower", None, "l/s", "dm"),
        },
        {
            "upper-lower": ("cubic_stiffness", "quadratic_stiffness"),
            "overflow": ("piecewise_stiffness",),
            "outlet": ("cubic_stiffness", "quadratic_stiffness"),
        },
        (3.0,),
        slow=True,
        band=(2.0, 5.0),
    ),
    Rig(
        "cylinder",
        "Hydraulic cylinder against a spring",
        CYLINDER,
        ("pos", "vel", "pressure"),
        ("spool",),
        ("position", "pressure"),
        {
            "m": (10.0, 30.0, "kg", True),
            "area": (0.8, 1.5, "dm2", True),
            "d": (60.0, 200.0, "N s/m", False),
            "k": (2e4, 6e4, "N/m", False),
            "beta": (2e4, 5e4, "", False),
            "valve": (0.5, 1.5, "", False),
            "leak": (2e-3, 6e-3, "", False),
        },
        {
            "piston": port("piston", "lambda p: dict(vel=-1 / p.m)", *("lambda x: x.pos", "lambda x: x.vel")),
            "leakage": port("leakage", "lambda p: dict(pressure=-p.beta)", "lambda x: x.pressure", None, "l/s", "bar"),
        },
        {
            "piston": (
                "coulomb_friction",
                "stribeck_friction",
                "quadratic_drag",
                "cubic_stiffness",
                "piecewise_stiffness",
            ),
            "leakage": ("cubic_stiffness", "piecewise_stiffness"),
        },
        (0.5,),
    ),
    Rig(
        "piezo",
        "Piezo stage: gain and one resonance",
        PIEZO,
        ("pos", "vel"),
        ("voltage",),
        ("displacement",),
        {"gain": (0.05, 0.2, "um/V", False), "f0": (20.0, 60.0, "Hz", False), "zeta": (0.02, 0.1, "", False)},
        {"stage": port("stage", "dict(vel=-1.0)", "lambda x: x.pos", "lambda x: x.vel", "um/s2", "um")},
        {
            "stage": (),
            "actuator:voltage": ("hysteresis", "creep", "saturation"),
            "sensor:displacement": ("delay", "drift"),
        },
        (20.0,),
        {"stage": "equation:vel"},
        quasi_static=True,
        band=(0.15, 0.5),
    ),
    Rig(
        "circuit",
        "Series resonant circuit",
        CIRCUIT,
        ("charge", "current"),
        ("voltage",),
        ("capacitor",),
        {"l": (0.05, 0.2, "H", True), "c": (1e-3, 4e-3, "F", False), "r": (0.5, 2.0, "Ohm", False)},
        {
            "loop": port(
                "loop", "lambda p: dict(current=-1 / p.l)", "lambda x: x.charge", "lambda x: x.current", "V", "C"
            )
        },
        {"loop": ("cubic_stiffness", "quadratic_stiffness", "coulomb_friction", "hysteresis", "quadratic_drag")},
        (3.0,),
        {"loop": "equation:current"},
    ),
    Rig(
        "static",
        "Static transducer",
        STATIC,
        (),
        ("drive",),
        ("reading",),
        {"gain": (0.5, 3.0, "", False), "offset": (0.1, 0.4, "", False)},
        {},
        {
            "actuator:drive": ("saturation", "dead_zone", "backlash", "hysteresis", "static_curve", "creep", "delay"),
            "sensor:reading": ("saturation", "drift", "extra_mode"),
        },
        (1.0,),
    ),
)
RIGS = {rig.name: rig for rig in (*MECHANICAL, *OTHERS)}


def places(rig: Rig) -> list[tuple[str, str]]:
    """Every (port, law) a rig can hide; actuators and sensors are added to the internal ports."""
    found = [(name, law) for name, laws in rig.laws.items() for law in laws]
    if not any(":" in name for name in rig.laws):
        found += [(f"actuator:{n}", law) for n in rig.inputs for law in ACTUATOR]
        found += [(f"sensor:{n}", law) for n in rig.outputs for law in SENSOR]
    if rig.integrator:  # a mean force or a creeping input makes a free axis run away
        bad = {"creep", "static_curve", "hysteresis"}
        found = [(n, law) for n, law in found if not (n.startswith("actuator") and law in bad)]
    return found
