"""Mechanical base rigs of the concealed cases; the others stand in `concealed_rigs_more`."""

from __future__ import annotations

from .concealed_rig import FORCE, GUIDE, SPRING, Rig, port

MSD = """

def dynamics(x, u, p):
    return dict(pos=x.vel, vel=(u.force - p.k * x.pos - p.d * x.vel) / p.m)


def outputs(x, u, p):
    return dict(position=x.pos)

"""
CHAIN2 = """

def dynamics(x, u, p):
    coupling = p.k2 * (x.x2 - x.x1) + p.d2 * (x.v2 - x.v1)
    return dict(
        x1=x.v1, v1=(u.force - p.k1 * x.x1 - p.d1 * x.v1 + coupling) / p.m1, x2=x.v2, v2=-coupling / p.m2
    )


def outputs(x, u, p):
    return dict(x2=x.x2)

"""
MASING = """

def dynamics(x, u, p):
    coupling = p.k2 * (x.x2 - x.x1) + p.d2 * (x.v2 - x.v1)
    return dict(
        x1=x.v1, v1=(coupling - p.k1 * x.x1 - p.d1 * x.v1) / p.m1, x2=x.v2, v2=(u.force - coupling) / p.m2
    )


def outputs(x, u, p):
    return dict(x2=x.x2)

"""
CHAIN3 = """

def dynamics(x, u, p):
    upper = p.k2 * (x.x2 - x.x1) + p.d2 * (x.v2 - x.v1)
    top = p.k3 * (x.x3 - x.x2) + p.d3 * (x.v3 - x.v2)
    return dict(
        x1=x.v1, v1=(u.force - p.k1 * x.x1 - p.d1 * x.v1 + upper) / p.m1,
        x2=x.v2, v2=(top - upper) / p.m2,
        x3=x.v3, v3=-top / p.m3,
    )


def outputs(x, u, p):
    return dict(x1=x.x1, x3=x.x3)

"""
AXIS = """

def dynamics(x, u, p):
    return dict(pos=x.vel, vel=(u.force - p.d * x.vel) / p.m)


def outputs(x, u, p):
    return dict(position=x.pos)

"""
BASE = """

def dynamics(x, u, p):
    return dict(pos=x.vel, vel=(-p.k * (x.pos - u.base) - p.d * x.vel) / p.m)


def outputs(x, u, p):
    return dict(position=x.pos)

"""
PENDULUM = """

def dynamics(x, u, p):
    return dict(angle=x.speed, speed=(u.torque - p.g * ca.sin(x.angle) - p.d * x.speed) / p.j)


def outputs(x, u, p):
    return dict(angle=x.angle)

"""
STAGE = """

def dynamics(x, u, p):
    return dict(
        x=x.vx, vx=(u.fx - p.kx * x.x - p.dx * x.vx - p.kc * (x.x - x.y)) / p.mx,
        y=x.vy, vy=(u.fy - p.ky * x.y - p.dy * x.vy - p.kc * (x.y - x.x)) / p.my,
    )


def outputs(x, u, p):
    return dict(px=x.x, py=x.y)

"""
BEAM = """

def dynamics(x, u, p):
    return dict(
        q1=x.s1, s1=(0.8 * u.force - p.k1 * x.q1 - p.d1 * x.s1) / p.m,
        q2=x.s2, s2=(-0.6 * u.force - p.k2 * x.q2 - p.d2 * x.s2) / p.m,
    )


def outputs(x, u, p):
    return dict(deflection=x.q1 + x.q2)

"""
kg, n_m, ns_m = "kg", "N/m", "N s/m"
ABS = ("x1", "lambda x: x.x1", "lambda x: x.v1")
GROUND1 = port("ground-m1", "lambda p: dict(v1=-1 / p.m1)", *ABS[1:])
M1M2 = port("m1-m2", "lambda p: dict(v1=1 / p.m1, v2=-1 / p.m2)", "lambda x: x.x2 - x.x1", "lambda x: x.v2 - x.v1")
M2M3 = port("m2-m3", "lambda p: dict(v2=1 / p.m2, v3=-1 / p.m3)", "lambda x: x.x3 - x.x2", "lambda x: x.v3 - x.v2")
POS = ("lambda x: x.pos", "lambda x: x.vel")
CHAIN = {"m1": (1.0, 2.0, kg, True), "m2": (0.5, 1.0, kg, True), "k1": (4e3, 8e3, n_m, False)}
CHAIN |= {"k2": (4e3, 9e3, n_m, False), "d1": (2.0, 6.0, ns_m, False), "d2": (2.0, 6.0, ns_m, False)}

MECHANICAL = (
    Rig(
        "msd",
        "Mass on a spring and a damper",
        MSD,
        ("pos", "vel"),
        ("force",),
        ("position",),
        {"m": (0.5, 3.0, kg, True), "k": (1e3, 6e3, n_m, False), "d": (2.0, 8.0, ns_m, False)},
        {"ground-mass": port("ground-mass", "lambda p: dict(vel=-1 / p.m)", *POS)},
        {"ground-mass": FORCE},
        (20.0,),
        {"ground-mass": "equation:vel"},
    ),
    Rig(
        "chain2",
        "Two masses in a row, force on the first, second measured",
        CHAIN2,
        ("x1", "v1", "x2", "v2"),
        ("force",),
        ("x2",),
        CHAIN,
        {"ground-m1": GROUND1, "m1-m2": M1M2},
        {"ground-m1": FORCE, "m1-m2": SPRING},
        (30.0,),
    ),
    Rig(
        "masing",
        "Two masses, force on the outer one, on a spring to ground",
        MASING,
        ("x1", "v1", "x2", "v2"),
        ("force",),
        ("x2",),
        CHAIN,
        {"ground-m1": GROUND1, "m1-m2": M1M2},
        {"ground-m1": FORCE, "m1-m2": SPRING},
        (30.0,),
    ),
    Rig(
        "chain3",
        "Three masses in a row, first and last measured",
        CHAIN3,
        ("x1", "v1", "x2", "v2", "x3", "v3"),
        ("force",),
        ("x1", "x3"),
        CHAIN | {"m3": (0.4, 0.8, kg, True), "k3": (4e3, 9e3, n_m, False), "d3": (2.0, 6.0, ns_m, False)},
        {"ground-m1": GROUND1, "m1-m2": M1M2, "m2-m3": M2M3},
        {"ground-m1": FORCE, "m1-m2": SPRING, "m2-m3": SPRING},
        (30.0,),
    ),
    Rig(
        "axis",
        "Free axis with viscous friction",
        AXIS,
        ("pos", "vel"),
        ("force",),
        ("position",),
        {"m": (5.0, 20.0, kg, False), "d": (100.0, 300.0, ns_m, False)},
        {"guide": port("guide", "lambda p: dict(vel=-1 / p.m)", *POS)},
        {"guide": GUIDE},
        (60.0,),
        {"guide": "equation:vel"},
        integrator=True,
    ),
    Rig(
        "base",
        "Structure on an imposed base motion",
        BASE,
        ("pos", "vel"),
        ("base",),
        ("position",),
        {"m": (0.5, 3.0, kg, True), "k": (1e3, 6e3, n_m, False), "d": (2.0, 8.0, ns_m, False)},
        {
            "base-mass": port("base-mass", "lambda p: dict(vel=-1 / p.m)", "lambda x, u: x.pos - u.base", None),
            "ground-mass": port("ground-mass", "lambda p: dict(vel=-1 / p.m)", *POS),
        },
        {"base-mass": FORCE[:4] + FORCE[8:9], "ground-mass": FORCE[4:8]},
        (5e-3,),
        hold="linear",
    ),
    Rig(
        "pendulum",
        "Pendulum with a torque motor",
        PENDULUM,
        ("angle", "speed"),
        ("torque",),
        ("angle",),
        {"j": (0.01, 0.03, "kg m2", True), "g": (5.0, 15.0, "N m", False), "d": (0.02, 0.06, "N m s", False)},
        {
            "pivot": port(
                "pivot", "lambda p: dict(speed=-1 / p.j)", "lambda x: x.angle", "lambda x: x.speed", "N m", "rad"
            )
        },
        {"pivot": ("coulomb_friction", "stribeck_friction", "quadratic_drag", "piecewise_stiffness", "hysteresis")},
        (0.8,),
        {"pivot": "equation:speed"},
        linear_plant=False,
    ),
    Rig(
        "stage",
        "Coupled two-axis stage",
        STAGE,
        ("x", "vx", "y", "vy"),
        ("fx", "fy"),
        ("px", "py"),
        {
            "mx": (1.0, 2.0, kg, True),
            "my": (0.8, 1.5, kg, True),
            "kx": (4e3, 8e3, n_m, False),
            "ky": (4e3, 8e3, n_m, False),
            "kc": (1e3, 3e3, n_m, False),
            "dx": (3.0, 9.0, ns_m, False),
            "dy": (3.0, 9.0, ns_m, False),
        },
        {
            "x-guide": port("x-guide", "lambda p: dict(vx=-1 / p.mx)", "lambda x: x.x", "lambda x: x.vx"),
            "y-guide": port("y-guide", "lambda p: dict(vy=-1 / p.my)", "lambda x: x.y", "lambda x: x.vy"),
            "x-y": port(
                "x-y", "lambda p: dict(vx=-1 / p.mx, vy=1 / p.my)", "lambda x: x.x - x.y", "lambda x: x.vx - x.vy"
            ),
        },
        {"x-guide": FORCE, "y-guide": FORCE, "x-y": SPRING},
        (25.0, 25.0),
    ),
    Rig(
        "beam",
        "Beam of two modes",
        BEAM,
        ("q1", "s1", "q2", "s2"),
        ("force",),
        ("deflection",),
        {
            "m": (0.5, 1.0, kg, True),
            "k1": (1e3, 3e3, n_m, False),
            "k2": (1e4, 2e4, n_m, False),
            "d1": (1.0, 3.0, ns_m, False),
            "d2": (2.0, 6.0, ns_m, False),
        },
        {
            "tip": port(
                "tip", "lambda p: dict(s1=-1 / p.m, s2=-1 / p.m)", "lambda x: x.q1 + x.q2", "lambda x: x.s1 + x.s2"
            ),
            "middle": port(
                "middle",
                "lambda p: dict(s1=-0.4 / p.m, s2=0.7 / p.m)",
                "lambda x: 0.4 * x.q1 - 0.7 * x.q2",
                "lambda x: 0.4 * x.s1 - 0.7 * x.s2",
            ),
        },
        {"tip": FORCE, "middle": SPRING},
        (10.0,),
        band=(1.6, 4.0),
    ),
)
