"""Hidden effects: each law id in its textbook formula and in formulas that differ from it.

A maker takes (rng, scale) and gives `(variant, strength -> Effect fields)`; `scale` holds the size of the local signals
without the effect. Sources: Armstrong-Hélouvry et al. (1994), Canudas de Wit et al. (1995) and Dahl (1968) for
friction, Iwan (1966) and Wen (1976) for hysteresis, Krejčí and Kuhnen (2001) for plays, Johnson (1985) for contact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

NONE = ca.SX(0, 1)
Law = Callable[[Any], tuple[Any, Any, Any]]


@dataclass(frozen=True)
class Scale:
    """Local signals without the effect: std and largest |.| of z, std of dz, a force; frequency, step, duration."""

    z: float
    z_max: float
    dz: float
    force: float
    frequency: float
    dt: float
    duration: float
    fine: int


@dataclass(frozen=True)
class Draft:
    """An effect before its strength is known; `make(strength)` gives the fields of `Effect`."""

    variant: str
    make: Callable[[float], dict[str, Any]]
    start: float = 0.3
    most: float = 1e9


def memoryless(fn: Callable[[Any, float], Any]) -> Callable[[float], dict[str, Any]]:
    """A law of z, dz, t alone."""
    return lambda a: {"fn": lambda s: (fn(s, a), NONE, NONE)}


def flowing(n: int, fn: Callable[[Any, float], tuple[Any, Any]]) -> Callable[[float], dict[str, Any]]:
    """A law with n differential equations of its own."""
    return lambda a: {"fn": lambda s: (*fn(s, a), NONE), "n_q": n}


def stored(n: int, fn: Callable[[Any, float], tuple[Any, list[Any]]]) -> Callable[[float], dict[str, Any]]:
    """A law with memory: n numbers, the last of which is z at the last step."""

    def make(a: float) -> dict[str, Any]:
        def law(s: Any) -> tuple[Any, Any, Any]:
            w, following = fn(s, a)
            return w, NONE, ca.vertcat(*following, s.z)

        return {"fn": law, "n_m": n + 1}

    return make


def clip(v: Any, r: Any) -> Any:
    """To [-r, r]."""
    return ca.fmax(ca.fmin(v, r), -r)


def choose(rng: np.random.Generator, options: dict[str, Any]) -> tuple[str, Any]:
    """One of the options, evenly."""
    key = list(options)[int(rng.integers(len(options)))]
    return key, options[key]


def _plain(options: Callable[[np.random.Generator, Scale], dict[str, Callable[[Any, float], Any]]]) -> Any:
    def maker(rng: np.random.Generator, c: Scale) -> Draft:
        found = options(rng, c)
        numbers: Any = found.pop("numbers", {})
        variant, fn = choose(rng, found)
        return Draft(variant, lambda a: {**memoryless(fn)(a), "numbers": numbers})

    return maker


@_plain
def cubic_stiffness(rng: np.random.Generator, c: Scale) -> dict[str, Any]:
    """Hardening: cube, taut string, sinh."""
    r = c.z * rng.uniform(0.8, 1.5)
    return {
        "cube": lambda s, a: a * c.force * (s.z / c.z) ** 3,
        "taut-string": lambda s, a: 5 * a * c.force * s.z / r * (1 - 1 / ca.sqrt(1 + (s.z / r) ** 2)),
        "sinh": lambda s, a: 3 * a * c.force * (ca.sinh(s.z / r) - s.z / r),
    }


@_plain
def quadratic_stiffness(rng: np.random.Generator, c: Scale) -> dict[str, Any]:
    """Asymmetric: square, and an exponential whose square dominates."""
    b = rng.uniform(0.15, 0.3) / c.z
    return {
        "square": lambda s, a: a * c.force * (s.z / c.z) ** 2,
        "exponential": lambda s, a: 2 * a * c.force / (b * c.z) ** 2 * (ca.exp(b * s.z) - 1 - b * s.z),
    }


@_plain
def piecewise_stiffness(rng: np.random.Generator, c: Scale) -> dict[str, Any]:
    """One-sided contact: linear, Hertz's power 3/2, rounded corner."""
    g, side = c.z_max * rng.uniform(0.2, 0.55), rng.choice([-1.0, 1.0])
    e = 0.03 * c.z

    def over(s: Any) -> Any:
        return side * s.z - g

    return {
        "numbers": {"gap": g, "side": side},
        "linear": lambda s, a: 4 * a * c.force * side * ca.fmax(over(s), 0) / c.z,
        "hertz": lambda s, a: 4 * a * c.force * side * (ca.fmax(over(s), 0) + 1e-12 * c.z) ** 1.5 / c.z**1.5,
        "rounded": lambda s, a: 4 * a * c.force * side * (over(s) + ca.sqrt(over(s) ** 2 + e**2)) / (2 * c.z),
    }


@_plain
def clearance(rng: np.random.Generator, c: Scale) -> dict[str, Any]:
    """Gap on both sides: linear, rounded, Hertzian."""
    g, e = c.z_max * rng.uniform(0.15, 0.45), 0.03 * c.z

    def soft(v: Any) -> Any:
        return (v + ca.sqrt(v**2 + e**2)) / 2

    return {
        "linear": lambda s, a: 4 * a * c.force * (s.z - clip(s.z, g)) / c.z,
        "rounded": lambda s, a: 4 * a * c.force * (soft(s.z - g) - soft(-s.z - g)) / c.z,
        "hertz": lambda s, a: 4 * a * c.force * ca.sign(s.z) * (ca.fabs(s.z - clip(s.z, g)) / c.z + 1e-12) ** 1.5,
    }


def _bristle(s: Any, zs: Any, level: Any) -> tuple[Any, list[Any]]:
    """Dahl's bristle, exact along a step: relaxes towards ±level over the distance zs."""
    dz = s.z - s.m[1]
    target = level * ca.sign(dz)
    h = target + (s.m[0] - target) * ca.exp(-ca.fabs(dz) / zs)
    return h, [h]


def coulomb_friction(rng: np.random.Generator, c: Scale) -> Draft:
    """Dry friction: steep tanh, Dahl, LuGre without Stribeck, Maxwell slip of a few stops."""
    soft, zs = c.dz * rng.uniform(0.01, 0.03), c.z * rng.uniform(0.02, 0.05)

    def lugre(s: Any, a: float) -> tuple[Any, list[Any]]:
        h, m = _bristle(s, zs, 1.0)
        return a * c.force * (h + 0.02 * s.dz / c.dz), m

    def slip(s: Any, a: float) -> tuple[Any, list[Any]]:
        r = zs * np.array([0.4, 0.8, 1.4])
        stops = [clip(s.m[i] + s.z - s.m[3], r[i]) for i in range(3)]
        return a * c.force / r.sum() * sum(stops), stops

    variant, make = choose(
        rng,
        {
            "tanh": memoryless(lambda s, a: a * c.force * ca.tanh(s.dz / soft)),
            "dahl": stored(1, lambda s, a: (a * c.force * _bristle(s, zs, 1.0)[0], _bristle(s, zs, 1.0)[1])),
            "lugre": stored(1, lugre),
            "maxwell-slip": stored(3, slip),
        },
    )
    return Draft(variant, make)


def stribeck_friction(rng: np.random.Generator, c: Scale) -> Draft:
    """Friction that falls with speed: Gauss, exponential, Tustin's fraction, LuGre."""
    soft, vs, r = c.dz * rng.uniform(0.01, 0.03), c.dz * rng.uniform(0.2, 0.5), rng.uniform(0.5, 1.2)
    zs = c.z * rng.uniform(0.02, 0.04)

    def curve(drop: Callable[[Any], Any]) -> Any:
        return memoryless(lambda s, a: a * c.force * ca.tanh(s.dz / soft) * (1 + r * drop(ca.fabs(s.dz) / vs)))

    def lugre(s: Any, a: float) -> tuple[Any, list[Any]]:
        h, m = _bristle(s, zs, 1 + r * ca.exp(-((s.dz / vs) ** 2)))
        return a * c.force * h, m

    variant, make = choose(
        rng,
        {
            "gauss": curve(lambda v: ca.exp(-(v**2))),
            "exponential": curve(lambda v: ca.exp(-v)),
            "tustin": curve(lambda v: 1 / (1 + v**2)),
            "lugre": stored(1, lugre),
        },
    )
    return Draft(variant, make)


@_plain
def quadratic_drag(rng: np.random.Generator, c: Scale) -> dict[str, Any]:
    """Drag: v|v|, a turbulent power near 2, and one that starts laminar."""
    power, v0 = rng.uniform(1.75, 2.2), c.dz * rng.uniform(0.05, 0.2)
    return {
        "square": lambda s, a: a * c.force * s.dz * ca.fabs(s.dz) / c.dz**2,
        "power": lambda s, a: a * c.force * ca.sign(s.dz) * (ca.fabs(s.dz) / c.dz + 1e-12) ** power,
        "laminar-start": lambda s, a: a * c.force * s.dz * ca.sqrt(s.dz**2 + v0**2) / c.dz**2,
    }


@_plain
def cubic_damping(rng: np.random.Generator, c: Scale) -> dict[str, Any]:
    """Damping that hardens: cube, sinh."""
    v = c.dz * rng.uniform(0.8, 1.3)
    return {
        "cube": lambda s, a: a * c.force * (s.dz / c.dz) ** 3,
        "sinh": lambda s, a: 3 * a * c.force * (ca.sinh(s.dz / v) - s.dz / v),
    }


@_plain
def periodic_force(rng: np.random.Generator, c: Scale) -> dict[str, Any]:
    """Cogging: a sine of the position, with a second harmonic, or peaked; at least two periods are seen."""
    k = 2 * np.pi / (c.z_max * rng.uniform(0.25, 0.8))
    f = rng.uniform(-np.pi, np.pi)
    return {
        "sine": lambda s, a: a * c.force * ca.sin(k * s.z + f),
        "harmonics": lambda s, a: a * c.force * (ca.sin(k * s.z + f) + 0.25 * ca.sin(2 * k * s.z)),
        "peaked": lambda s, a: a * c.force * ca.sin(k * s.z + f) / (1 + 0.4 * ca.cos(k * s.z + f)),
    }


def hysteresis(rng: np.random.Generator, c: Scale) -> Draft:
    """A yielding path in parallel: Bouc-Wen, Masing (Iwan's stops), Ramberg-Osgood-like spread of stops."""
    zy, n = c.z * rng.uniform(0.3, 0.9), rng.uniform(1.0, 2.0)
    beta = rng.uniform(0.4, 0.7)

    def bouc_wen(s: Any, a: float) -> tuple[Any, list[Any]]:
        dz = (s.z - s.m[1]) / zy

        def slope(h: Any) -> Any:
            return 1 - (beta * ca.sign(h * dz) + 1 - beta) * (ca.fabs(h) + 1e-12) ** n

        h = s.m[0] + slope(s.m[0] + slope(s.m[0]) * dz / 2) * dz
        return a * c.force * h, [h]

    def iwan(power: float) -> Any:
        r = zy * np.linspace(0.15, 2.2, 10)
        g = np.exp(-r / zy) if power == 0 else (r / zy) ** -power
        g = g / (g @ r)

        def law(s: Any, a: float) -> tuple[Any, list[Any]]:
            stops = [clip(s.m[i] + s.z - s.m[10], r[i]) for i in range(10)]
            return a * c.force * sum(g[i] * stops[i] for i in range(10)), stops

        return stored(10, law)

    variant, make = choose(rng, {"bouc-wen": stored(1, bouc_wen), "iwan": iwan(0), "ramberg-osgood": iwan(1.5)})
    return Draft(variant, make)


def creep(rng: np.random.Generator, c: Scale) -> Draft:
    """Slow relaxation in parallel: one or three Maxwell elements, or six as a spring-pot (fractional damping)."""
    n = int(rng.choice([1, 3, 6]))
    tau = np.geomspace(1, 8, n) * c.duration * rng.uniform(0.01, 0.04)
    share = np.ones(n) / n
    if n == 6:
        tau = np.geomspace(0.02, 3.0, n) / c.frequency
        share = (tau[0] / tau) ** 0.5

    def law(s: Any, a: float) -> tuple[Any, Any]:
        pull = [s.z - s.q[i] for i in range(n)]
        force = sum(w * e for w, e in zip(share, pull, strict=True))
        return a * c.force / c.z * force, ca.vertcat(*[pull[i] / tau[i] for i in range(n)])

    return Draft(f"maxwell-{n}", flowing(n, law))


def extra_mode(rng: np.random.Generator, c: Scale) -> Draft:
    """A hidden oscillator hung onto the port."""
    w = 2 * np.pi * c.frequency * rng.uniform(0.6, 1.6)
    zeta = rng.uniform(0.02, 0.08)

    def law(s: Any, a: float) -> tuple[Any, Any]:
        pull = w**2 * (s.z - s.q[0]) + 2 * zeta * w * (s.dz - s.q[1])
        return a * c.force / (c.z * w**2) * pull, ca.vertcat(s.q[1], pull)

    return Draft("oscillator", flowing(2, law))


PARALLEL: dict[str, Callable[[np.random.Generator, Scale], Draft]] = {
    f.__name__: f for f in (coulomb_friction, stribeck_friction, hysteresis, creep, extra_mode)
} | {
    "cubic_stiffness": cubic_stiffness,
    "quadratic_stiffness": quadratic_stiffness,
    "piecewise_stiffness": piecewise_stiffness,
    "clearance": clearance,
    "quadratic_drag": quadratic_drag,
    "cubic_damping": cubic_damping,
    "periodic_force": periodic_force,
}
