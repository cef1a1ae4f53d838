"""Hidden effects in series at an actuator or a sensor, w = law(u) - u, and effects outside the catalogue."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from .concealed_effects import NONE, Draft, Scale, choose, clip, flowing, memoryless, stored


def saturation(rng: np.random.Generator, c: Scale) -> Draft:
    """Saturation: tanh, algebraic, one that differs by side; a sharp one at a sensor is a fault, clipping."""
    skew = rng.uniform(1.05, 1.3)

    def level(a: float) -> float:
        return c.z_max * (1.35 - 0.9 * a)

    variant, make = choose(
        rng,
        {
            "tanh": memoryless(lambda s, a: level(a) * ca.tanh(s.z / level(a)) - s.z),
            "algebraic": memoryless(lambda s, a: s.z / (1 + (s.z / level(a)) ** 4) ** 0.25 - s.z),
            "skew": memoryless(
                lambda s, a: (
                    ca.if_else(
                        s.z > 0, level(a) * ca.tanh(s.z / level(a)), skew * level(a) * ca.tanh(s.z / (skew * level(a)))
                    )
                    - s.z
                )
            ),
        },
    )
    return Draft(variant, make, float(rng.uniform(0.4, 0.8)), 1.0)


def dead_zone(rng: np.random.Generator, c: Scale) -> Draft:
    """Dead zone: sharp, rounded."""
    e = 0.02 * c.z

    def soft(v: Any) -> Any:
        return (v + ca.sqrt(v**2 + e**2)) / 2

    variant, make = choose(
        rng,
        {
            "sharp": memoryless(lambda s, a: -clip(s.z, 0.4 * a * c.z)),
            "rounded": memoryless(lambda s, a: soft(s.z - 0.4 * a * c.z) - soft(-s.z - 0.4 * a * c.z) - s.z),
        },
    )
    return Draft(variant, make, float(rng.uniform(0.3, 1.0)), 1.5)


def backlash(rng: np.random.Generator, c: Scale) -> Draft:
    """Play, and a play whose flanks give a little."""
    give = rng.uniform(0.03, 0.08)

    def play(s: Any, a: float) -> tuple[Any, list[Any]]:
        r = 0.3 * a * c.z
        p = ca.fmax(s.z - r, ca.fmin(s.z + r, s.m[0]))
        return p - s.z, [p]

    def soft(s: Any, a: float) -> tuple[Any, list[Any]]:
        r = 0.3 * a * c.z * np.array([1 - give, 1.0, 1 + give])
        p = [ca.fmax(s.z - r[i], ca.fmin(s.z + r[i], s.m[i])) for i in range(3)]
        return sum(p) / 3 - s.z, p

    variant, make = choose(rng, {"play": stored(1, play), "soft-flanks": stored(3, soft)})
    return Draft(variant, make, float(rng.uniform(0.2, 0.8)), 1.5)


def hysteresis(rng: np.random.Generator, c: Scale) -> Draft:
    """Actuator hysteresis: plays (Prandtl-Ishlinskii), Bouc-Wen, generalized play with unlike flanks, Masing."""
    zy, skew = c.z * rng.uniform(0.4, 1.0), rng.uniform(0.1, 0.2)
    r = c.z_max * np.linspace(0.08, 0.8, 8)
    g = np.exp(-r / (c.z * rng.uniform(0.5, 1.5)))
    g = g / g.sum()

    def plays(s: Any, a: float) -> tuple[Any, list[Any]]:
        p = [ca.fmax(s.z - r[i], ca.fmin(s.z + r[i], s.m[i])) for i in range(8)]
        return a * (sum(g[i] * p[i] for i in range(8)) - 0.5 * s.z), p

    def stops(s: Any, a: float) -> tuple[Any, list[Any]]:
        p = [clip(s.m[i] + s.z - s.m[8], r[i]) for i in range(8)]
        return -a * sum(g[i] * p[i] for i in range(8)), p

    def bouc_wen(s: Any, a: float) -> tuple[Any, list[Any]]:
        dz = (s.z - s.m[1]) / zy
        h = s.m[0] + dz * (1 - (0.5 * ca.sign((s.m[0] + dz / 2) * dz) + 0.5) * ca.fabs(s.m[0]))
        return -a * zy * h, [h]

    def generalized(s: Any, a: float) -> tuple[Any, list[Any]]:
        v = s.z + skew * s.z**2 / c.z_max
        p = [ca.fmax(v - 0.7 * r[i], ca.fmin(v + r[i], s.m[i])) for i in range(8)]
        return a * (sum(g[i] * p[i] for i in range(8)) - 0.5 * s.z), p

    variant, make = choose(
        rng,
        {
            "prandtl-ishlinskii": stored(8, plays),
            "masing": stored(8, stops),
            "bouc-wen": stored(1, bouc_wen),
            "generalized-play": stored(8, generalized),
        },
    )
    return Draft(variant, make, float(rng.uniform(0.1, 0.5)), 0.8)


def static_curve(rng: np.random.Generator, c: Scale) -> Draft:
    """A bent characteristic: square added, signed power, one side weaker."""
    power, sign = rng.uniform(1.3, 1.6), rng.choice([-1.0, 1.0])

    variant, make = choose(
        rng,
        {
            "square": memoryless(lambda s, a: sign * a * 0.5 * s.z**2 / c.z_max),
            "power": memoryless(
                lambda s, a: a * c.z * (ca.sign(s.z) * (ca.fabs(s.z) / c.z + 1e-9) ** power - s.z / c.z)
            ),
            "one-sided": memoryless(lambda s, a: sign * a * 0.6 * ca.fabs(s.z)),
        },
    )
    return Draft(variant, make, float(rng.uniform(0.1, 0.5)), 0.9)


def delay(rng: np.random.Generator, c: Scale) -> Draft:
    """A transport delay of 0.4 to 3 samples (longer whole shifts of a channel are recording faults)."""
    start = float(rng.uniform(0.2, 1))

    def make(a: float) -> dict[str, Any]:
        tau = float(np.clip(2.9 * a, 0.4, 2.9)) * c.dt
        return {"delay": tau, "numbers": {"bend": (2 * np.pi * 2.5 * c.frequency * tau) ** 2 / 2}}

    return Draft("transport", make, start, 1.0)


def creep(rng: np.random.Generator, c: Scale) -> Draft:
    """Kelvin elements that follow slowly: one, or three over a decade (nearly logarithmic in time)."""
    n = int(rng.choice([1, 3]))
    tau = np.geomspace(1, 10, n) * c.duration * rng.uniform(0.01, 0.04)

    def law(s: Any, a: float) -> tuple[Any, Any]:
        return a / n * sum(s.q[i] for i in range(n)), ca.vertcat(*[(s.z - s.q[i]) / tau[i] for i in range(n)])

    return Draft(f"kelvin-{n}", flowing(n, law), float(rng.uniform(0.2, 0.6)), 1.5)


def extra_mode(rng: np.random.Generator, c: Scale) -> Draft:
    """A first-order lag or a resonance that the simulator lacks."""
    w, zeta = 2 * np.pi * c.frequency, rng.uniform(0.1, 0.4)

    def lag(s: Any, a: float) -> tuple[Any, Any]:
        return s.q[0] - s.z, (s.z - s.q[0]) * w / a

    def resonance(s: Any, a: float) -> tuple[Any, Any]:
        wr = w * 1.5 / a
        return s.q[0] - s.z, ca.vertcat(s.q[1], wr**2 * (s.z - s.q[0]) - 2 * zeta * wr * s.q[1])

    variant, make = choose(rng, {"lag": flowing(1, lag), "resonance": flowing(2, resonance)})
    share = 2.5**2 / 2 if variant == "lag" else (2.5 / 1.5) ** 2
    start = float(rng.uniform(0.4, 0.9))
    return Draft(variant, lambda a: {**make(a), "numbers": {"bend": share * a**2}}, start, 1.2)


def drift(rng: np.random.Generator, c: Scale) -> Draft:
    """A slow trend: ramp, warm-up, slow swell."""
    t, sign = c.duration, rng.choice([-1.0, 1.0])
    variant, make = choose(
        rng,
        {
            "ramp": memoryless(lambda s, a: sign * a * c.z * s.t / t),
            "warm-up": memoryless(lambda s, a: sign * a * c.z * (1 - ca.exp(-3 * s.t / t))),
            "swell": memoryless(lambda s, a: sign * a * c.z * ca.sin(1.3 * np.pi * s.t / t) ** 2),
        },
    )
    return Draft(variant, make, float(rng.uniform(0.02, 0.4)))


SERIES: dict[str, Callable[[np.random.Generator, Scale], Draft]] = {
    f.__name__: f for f in (saturation, dead_zone, backlash, hysteresis, static_curve, delay, creep, extra_mode, drift)
}


# of the effects below, those that a law of the catalogue states by now, to the letter: a strength that varies with z
STATED = {"position-damping": "viscous_damping"}


def outside(rng: np.random.Generator, c: Scale, series: bool, other: str | None) -> Draft:
    """An effect that no law stated when these were drawn; `other` is a state that is not the port's own."""
    w = 2 * np.pi * c.frequency * rng.uniform(0.15, 0.6)
    b, t0 = rng.uniform(0.05, 0.25) * c.duration, c.duration * np.sort(rng.uniform(0.1, 0.9, 4))

    def heating(s: Any, a: float) -> tuple[Any, Any]:
        return -a * s.z * s.q[0], ((s.z / c.z) ** 2 - s.q[0]) / b

    def on(s: Any) -> Any:
        return ca.logic_or(ca.logic_and(s.t > t0[0], s.t < t0[1]), ca.logic_and(s.t > t0[2], s.t < t0[3]))

    if series:
        variant, make = choose(
            rng,
            {
                "self-heating-gain": flowing(1, heating),
                "gain-modulation": memoryless(lambda s, a: a * s.z * ca.sin(w * s.t)),
                "gain-switches": memoryless(lambda s, a: -a * s.z * on(s)),
            },
        )
        return Draft(variant, make, 0.2, 0.9)
    options = {
        "position-damping": memoryless(lambda s, a: a * c.force * (s.z / c.z) ** 2 * s.dz / c.dz),
        "parametric-stiffness": memoryless(lambda s, a: a * c.force * ca.cos(w * s.t) * s.z / c.z),
        "disturbance": lambda a: {"fn": lambda s: (a * c.force * s.noise, NONE, NONE)},
        "switching-friction": memoryless(lambda s, a: a * c.force * on(s) * ca.tanh(s.dz / (0.02 * c.dz))),
    }
    if other is not None:
        options["state-product"] = memoryless(lambda s, a: a * c.force * s.z / c.z * getattr(s.x, other) / c.dz)
    variant, make = choose(rng, options)
    return Draft(variant, make)
