"""How laws are related: which can imitate others, which contain others, and which stand beside another at one port."""

from __future__ import annotations

from ..laws import Law
from .candidate import Candidate

# a law that can imitate others -> factor by which its error must be smaller
FLEXIBLE: dict[str, float] = {
    "hysteresis": 1.25,
    "static_curve": 1.1,
    "extra_mode": 1.15,
    "stribeck_friction": 1.05,
    "periodic_force": 1.25,
    "drift": 1.25,
}
# a law -> what it has as special cases: it always does as well, and is no rival of theirs
CONTAINS = {
    "hysteresis": ("backlash", "coulomb_friction", "linear_stiffness"),
    "stribeck_friction": ("coulomb_friction",),
    "clearance": ("piecewise_stiffness", "linear_stiffness"),  # one side of which is never touched; no gap
    "piecewise_stiffness": ("linear_stiffness",),
    "creep": ("linear_stiffness", "viscous_damping"),  # that takes longer than the record, or no time
    "extra_mode": ("linear_stiffness", "viscous_damping"),  # above every frequency that is seen
}
# a law and one that it can imitate by its freedom alone -> how much nearer it has to come above the floor
IMITATES = {
    ("hysteresis", "coulomb_friction"): 1.4,
    ("hysteresis", "stribeck_friction"): 1.4,
    ("hysteresis", "backlash"): 1.4,
    ("clearance", "piecewise_stiffness"): 1.4,
    ("extra_mode", "delay"): 1.25,
}
FORMS = {
    "mode": 1.15,
    "off-centre": 1.05,
    "asymmetric": 1.05,
    "directional": 1.05,
    "soft asymmetric": 1.05,
    "power": 1.1,
    "power with gain": 1.15,
    "quintic": 1.05,
    "geometric": 1.05,
    "two-stage": 1.05,
    "hertz": 1.05,
    "progressive": 1.05,
    "harmonics": 1.05,
    "gradual": 1.05,
    "root": 1.1,
    "orifice": 1.1,
    "polynomial": 1.05,
    "attached mass": 1.1,
    "generalized_play": 1.1,
}


def handicap(law: Law) -> float:
    """Factor on the error of a law that can imitate others."""
    return FLEXIBLE.get(law.id, 1.0) * FORMS.get(law.form, 1.0)


def complements(one: Law, other: Law) -> bool:
    """Whether two laws of a port are different physics: one opposes motion, the other is a curve of position."""
    rubs, springs = sorted((one, other), key=lambda law: not law.dissipative)
    apart = rubs.dissipative and not springs.dissipative and springs.reads() == {"z"} and not hasattr(springs, "step")
    return apart and springs.order == 0 and rubs.id not in ("creep", "extra_mode")


def imitates(candidate: Candidate, rival: Candidate, floor: float) -> bool:
    """Whether a law comes so little nearer than another at its port, above the floor, that it may just imitate it.

    It does so by its freedom: one of no more parameters cannot.
    """
    free = candidate.port == rival.port and candidate.size > rival.size
    needed = IMITATES.get((candidate.law.id, rival.law.id), 0.0) if free else 0.0
    own, other = (max(c.error**2 - floor, 0.05 * floor) for c in (candidate, rival))
    return other < needed**2 * own
