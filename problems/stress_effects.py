"""Effects of the stress sets that the concealed cases lack: in place of a term, one-sided friction, constant loads.

A law in place of a term is `law(z) - k z` at the port of the spring `k z`: with the simulator's own spring nothing is
left but the law. Friction that acts in one direction alone is symmetric friction beside a constant load.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from .concealed_draw import Draw
from .concealed_effects import Draft, Scale, clip, memoryless, stored
from .concealed_rigs_more import places
from .concealed_series import SERIES

LOAD = "constant_load"
# rig -> port -> the stiffness and the damping that act there as a port's force does; "" where there is none
TERMS: dict[str, dict[str, tuple[str, str]]] = {
    "msd": {"ground-mass": ("k", "d")},
    "chain2": {"ground-m1": ("k1", "d1"), "m1-m2": ("k2", "d2")},
    "masing": {"ground-m1": ("k1", "d1"), "m1-m2": ("k2", "d2")},
    "chain3": {"ground-m1": ("k1", "d1"), "m1-m2": ("k2", "d2"), "m2-m3": ("k3", "d3")},
    "axis": {"guide": ("", "d")},
    "base": {"base-mass": ("k", ""), "ground-mass": ("", "d")},
    "pendulum": {"pivot": ("", "d")},
    "stage": {"x-guide": ("kx", "dx"), "y-guide": ("ky", "dy"), "x-y": ("kc", "")},
    "motor": {"shaft": ("c", "dc"), "motor-bearing": ("", "b1"), "load-bearing": ("", "b2")},
    "cylinder": {"piston": ("k", "d")},
}


def spring(draw: Draw, port: str) -> float:
    """The stiffness that a law replaces; the user leaves its bounds open down to zero."""
    name = TERMS[draw.rig.name][port][0]
    k = draw.values[name]
    draw.told[name] = float(f"{k * (1 + draw.rng.uniform(-0.3, 0.3)):.4g}"), 0.0, float(f"{5 * k:.2g}")
    return k


def hysteretic_spring(draw: Draw, port: str, c: Scale) -> Draft:
    """Stops in parallel (Iwan 1966) whose initial stiffness is the spring's; they yield sooner with more strength."""
    k = spring(draw, port)
    reach = c.z * np.geomspace(0.3, 6.0, 10)
    share = np.exp(-reach / (c.z * draw.rng.uniform(1.0, 3.0)))
    share = share / share.sum()

    def law(s: Any, a: float) -> tuple[Any, list[Any]]:
        stops = [clip(s.m[i] + s.z - s.m[10], reach[i] / a) for i in range(10)]
        return k * (sum(share[i] * stops[i] for i in range(10)) - s.z), stops

    return Draft("in-place-of-spring", stored(10, law), 0.5, 3.0)


def gap_spring(draw: Draw, port: str, c: Scale) -> Draft:
    """A spring that is fixed with play: no force within the gap."""
    k = spring(draw, port)
    return Draft("in-place-of-spring", memoryless(lambda s, a: -k * clip(s.z, 0.3 * a * c.z)), 0.5, 2.0)


def power_spring(draw: Draw, port: str, c: Scale) -> Draft:
    """A power of the deflection above 1, without a linear part."""
    k = spring(draw, port)

    def law(s: Any, a: float) -> Any:
        return k * c.z * ca.sign(s.z) * (ca.fabs(s.z) / c.z + 1e-9) ** (1 + a) - k * s.z

    return Draft("in-place-of-spring", memoryless(law), 0.5, 2.0)


def two_slopes(draw: Draw, port: str, c: Scale) -> Draft:
    """A spring that is stiffer on one side of a corner near zero."""
    k = spring(draw, port)
    side, corner = draw.rng.choice([-1.0, 1.0]), c.z * draw.rng.uniform(0.1, 0.3)

    def make(a: float) -> dict[str, Any]:
        def law(s: Any, a: float) -> Any:
            return k * a * (side * ca.fmax(side * s.z - corner, 0) - 0.5 * s.z)

        return {**memoryless(law)(a), "numbers": {"gap": corner, "side": side}}

    return Draft("in-place-of-spring", make, 0.3, 1.6)


IN_PLACE = {
    "hysteresis": hysteretic_spring,
    "clearance": gap_spring,
    "cubic_stiffness": power_spring,
    "piecewise_stiffness": two_slopes,
}


def one_sided_friction(draw: Draw, port: str, c: Scale) -> Draft:
    """Dry friction that acts in one direction alone, or less in the other."""
    side, ratio = draw.rng.choice([-1.0, 1.0]), float(draw.rng.choice([0.0, 0.3]))
    soft = c.dz * draw.rng.uniform(0.01, 0.03)

    def law(s: Any, a: float) -> Any:
        return a * c.force * ca.tanh(s.dz / soft) * ca.if_else(side * s.dz > 0, 1.0, ratio)

    return Draft("one-sided", memoryless(law))


def constant_load(draw: Draw, port: str, c: Scale) -> Draft:
    """A constant force, as a weight."""
    side = draw.rng.choice([-1.0, 1.0])
    return Draft("constant", memoryless(lambda s, a: ca.SX(side * a * c.force)))


def in_place(draw: Draw) -> list[tuple[str, str]]:
    """One law in place of a spring of the rig."""
    ports = [port for port, (k, _) in TERMS[draw.rig.name].items() if k]
    return [(str(draw.rng.choice(ports)), str(draw.rng.choice(list(IN_PLACE))))]


def in_series(draw: Draw) -> list[tuple[str, str]]:
    """Two laws one behind the other: with memory or a threshold, and a curve, a limit or a lag."""
    rng, rig = draw.rng, draw.rig
    ends = [f"actuator:{n}" for n in rig.inputs] + [f"sensor:{n}" for n in rig.outputs]
    port = str(rng.choice(ends))
    first = ["backlash", "dead_zone"] + (["hysteresis"] if port.startswith("actuator") else [])
    second = ["saturation", "static_curve"] + (["extra_mode"] if port.startswith("actuator") else [])
    pairs = [(port, str(rng.choice(first))), (port, str(rng.choice(second)))]
    assert all(law in SERIES for _, law in pairs)
    return pairs if rng.random() < 0.5 else pairs[::-1]


def inside(draw: Draw) -> list[tuple[str, str]]:
    """One law at a port inside the rig."""
    found = [(port, law) for port, laws in draw.rig.laws.items() if ":" not in port for law in laws]
    port = str(draw.rng.choice(sorted({port for port, _ in found})))
    return [(port, str(draw.rng.choice([law for p, law in found if p == port])))]


def one_way(draw: Draw) -> list[tuple[str, str]]:
    """One-sided friction at a port that may have friction."""
    ports = [port for port, laws in draw.rig.laws.items() if "coulomb_friction" in laws]
    return [(str(draw.rng.choice(ports)), "coulomb_friction")]


def loaded(draw: Draw) -> list[tuple[str, str]]:
    """A constant load at a port inside the rig."""
    return [(str(draw.rng.choice([port for port in draw.rig.laws if ":" not in port])), LOAD)]


def law_and_load(draw: Draw) -> list[tuple[str, str]]:
    """A law and a constant load, each at a port inside the rig."""
    return [*inside(draw), *loaded(draw)]


def three(draw: Draw) -> list[tuple[str, str]]:
    """Three laws at three places, one inside the rig at least, one actuator and one sensor at most; no delay."""
    rng, found = draw.rng, [(p, law) for p, law in places(draw.rig) if law != "delay"]
    ports = sorted({p for p, _ in found})
    inner = [p for p in ports if ":" not in p]
    chosen = [str(rng.choice(inner))]
    while len(chosen) < 3:
        taken = {p.split(":")[0] for p in chosen if ":" in p}
        open_ = [p for p in ports if p not in chosen and p.split(":")[0] not in taken]
        chosen.append(str(rng.choice(open_)))
    return [(port, str(rng.choice([law for p, law in found if p == port]))) for port in chosen]
