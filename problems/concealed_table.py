"""Near-equivalent answers of the concealed cases, fixed before any result was seen, each with its physical argument.

- commute: In a linear plant of one input and one output, linear time-invariant laws (delay, creep, extra_mode)
  commute with it: at the actuator or at the sensor they give the same output. A delay commutes with any plant whose
  equations do not hold the time, linear or not, for it shifts the time itself.
- static: In a device without states any law at the actuator is the same law at the sensor, scaled by the gain.
- quasi-static: A stage driven well below its resonance is a gain: a law of rate-independent kind at the actuator and
  at the sensor differ by a scale; in its equation it stands as a force of the displacement.
- slow: A drift slower than the plant passes it as a gain; with one output, drift at actuator, sensor or as a force is
  one and the same shape.
- one-sided: A gap spring whose other side is never reached is a contact, and the contact is such a gap spring.
- presliding: Friction with presliding (Dahl, LuGre, Maxwell slip) is a rate-independent hysteresis of small yield
  displacement (Dahl 1968; Iwan 1966); both names state the same force.
- short: A lag or resonance much faster than the excitation, and a short delay, are all 1 - jωτ; where the next term
  (`bend`, at 2.5 times the characteristic frequency) lies below 3 times the noise, the data cannot tell them.
- collocated: In a single-mass rig the force and the port's force enter the same equation, so a slow drift of the one
  is a slow drift of the other.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .concealed_rig import Rig
from .concealed_truth import Effect

Pair = tuple[str, str]
LINEAR_LAWS = ("delay", "creep", "extra_mode")


def equivalents(
    rig: Rig, effect: Effect, z: np.ndarray | None, names: Mapping[str, str], noise: float = 0.0
) -> frozenset[Pair]:
    """Pairs counted right for an effect; `z` is its local coordinate on the data, `names` maps ports as handed out."""
    port = names.get(effect.port, effect.port)
    pairs = {(port, effect.law)}
    siso = len(rig.inputs) == len(rig.outputs) == 1
    series = ":" in effect.port
    ends = {f"actuator:{n}" for n in rig.inputs} | {f"sensor:{n}" for n in rig.outputs}
    if siso and series and ((rig.linear_plant and effect.law in LINEAR_LAWS) or effect.law == "delay"):  # commute
        pairs |= {(end, effect.law) for end in ends}
    if siso and series and not rig.states:  # static
        pairs |= {(end, effect.law) for end in ends}
    if siso and series and rig.quasi_static:  # quasi-static
        pairs |= {(end, effect.law) for end in ends}
        if effect.law in ("hysteresis", "creep"):
            pairs |= {(names.get(n, n), effect.law) for n in rig.ports}
    if effect.law == "drift" and len(rig.outputs) == 1 and not rig.integrator:  # slow, collocated
        pairs |= {(end, "drift") for end in ends} | {(names.get(n, n), "drift") for n in rig.ports}
    if effect.law == "piecewise_stiffness" and z is not None and "gap" in effect.numbers:  # one-sided
        gap, side = effect.numbers["gap"], effect.numbers["side"]
        if np.min(side * z) > -gap:
            pairs.add((port, "clearance"))
    if effect.law == "coulomb_friction" and effect.variant in ("dahl", "lugre", "maxwell-slip"):  # presliding
        pairs.add((port, "hysteresis"))
    if series and effect.law in ("delay", "extra_mode") and effect.numbers.get("bend", 1.0) < 3 * noise:  # short
        pairs |= {(p, law) for p, _ in pairs for law in ("delay", "extra_mode")}
    return frozenset(pairs)
