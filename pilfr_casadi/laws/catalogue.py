"""The catalogue of laws that may be missing from a simulator: each law that a file of this folder defines."""

from __future__ import annotations

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
