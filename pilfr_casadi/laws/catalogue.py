"""The catalogue of laws that may be missing from a simulator: each law that a file of this folder defines."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from . import curves, dynamic, electrical, friction, hysteresis, in_line, stiffness, thermal
from .base import Law
from .composed import behind_gap

# laws that refine a named law, once it is named: they cost more to fit
FINER: dict[type[Law], tuple[Any, ...]] = {
    hysteresis.StopHysteresis: (hysteresis.SmoothHysteresis,),
    hysteresis.PlayHysteresis: (hysteresis.FinePlays,),
    hysteresis.GeneralizedHysteresis: (hysteresis.FineGeneralized,),
    curves.FreeCurve: (curves.SteepCurve,),
}


def related_forms(found: type[Law], laws: Iterable[type[Law]]) -> dict[type[Law], str]:
    """Return the forms that are fitted from the values of a law that was found, and how they are related to it.

    "finer": the form contains the law. "plainer": the law contains the form, and its values are values of the form as
    they are. "other": neither.
    """

    def relation(kind: Any) -> str:
        if kind in finest or kind.extends(found):
            return "finer" if issubclass(kind, found) else "other"
        keeps_values = kind.finer_starts.__func__ is Law.finer_starts.__func__  # type: ignore[attr-defined]
        return "plainer" if kind is base and base.units.items() <= found.units.items() and keeps_values else ""

    base: Any = found.__base__
    finest = FINER.get(found, ())
    related = {kind: relation(kind) for kind in (*finest, *laws)}
    return {kind: name for kind, name in related.items() if name}


# laws in the order in which they are tried: file by file, in the order of their definitions
CATALOGUE: tuple[type[Law], ...] = (
    *(
        law
        for file in (stiffness, friction, hysteresis, curves, dynamic, in_line, thermal, electrical)
        for law in vars(file).values()
        if isinstance(law, type) and issubclass(law, Law) and hasattr(law, "equation") and (law,) not in FINER.values()
    ),
    behind_gap(friction.CoulombFriction),
)

# ids of laws that are equivalent to other values of the simulator's own parameters, if it has a spring or damper there,
# or a gain of the signal
LINEAR = (stiffness.LinearStiffness.id, friction.ViscousDamping.id, curves.Gain.id)

# ids of dry friction, and of drags that grow with speed; a bearing or a seal may have one of each
DRY = (friction.CoulombFriction.id, friction.StribeckFriction.id)
DRAGS = (friction.ViscousDamping.id, friction.QuadraticDrag.id, friction.CubicDamping.id)

# ids of what becomes of small and of large signals; a drive or a valve may have one of each
SMALL_AND_LARGE = (curves.DeadZone.id, curves.Saturation.id)

# laws of the position that an input may scale: a force constant or a valve's gain that varies with the position, or
# repeats with it
POSITION_GAINS: tuple[type[Law], ...] = (
    stiffness.LinearStiffness,
    stiffness.QuadraticStiffness,
    stiffness.PeriodicForce,
)

# laws whose strength may vary with a signal
SCALABLE: tuple[type[Law], ...] = (
    stiffness.LinearStiffness,
    friction.ViscousDamping,
    friction.CoulombFriction,
    friction.PreslidingFriction,
    hysteresis.StopHysteresis,
    hysteresis.BoucWen,
)
