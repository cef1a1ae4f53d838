"""The catalogue of laws that may be missing from a simulator."""

from __future__ import annotations

from typing import Any

from .base import Law, Local, readable_unit
from .composed import behind_gap, scaled
from .curves import Cubic, Magnitude, Orifice, Polynomial, Power, PowerWithGain, Quadratic, Root
from .density import SmoothHysteresis
from .dynamic import (
    Attached,
    Creep,
    Delay,
    Drift,
    Lag,
    Mode,
    Relaxation,
    Resonance,
    Settling,
    Swing,
    TwoStageCreep,
    TwoStageRelaxation,
)
from .friction import (
    AsymmetricFriction,
    CoulombFriction,
    CubicDamping,
    DirectionalDamping,
    DirectionalDrag,
    DirectionalFriction,
    PreslidingFriction,
    PreslidingStribeckFriction,
    QuadraticDrag,
    StribeckFriction,
    ViscousDamping,
)
from .hysteresis import (
    Backlash,
    BoucWen,
    BoucWenActuator,
    FineGeneralized,
    FinePlays,
    GeneralizedHysteresis,
    PlayHysteresis,
    StopHysteresis,
)
from .limits import (
    AsymmetricDeadZone,
    AsymmetricSaturation,
    DeadZone,
    GradualSaturation,
    Saturation,
    SkewSaturation,
    SoftSaturation,
)
from .periodic import HarmonicForce, PeriodicForce, Ripple
from .stiffness import (
    Clearance,
    CubicStiffness,
    GeometricStiffness,
    HertzContact,
    LinearStiffness,
    OffCentreClearance,
    PiecewiseStiffness,
    PiecewiseStiffnessBelow,
    PowerStiffness,
    ProgressiveStiffness,
    QuadraticStiffness,
    QuinticStiffness,
    SlackCoupling,
    SlackSpring,
    SoftClearance,
)

CATALOGUE: tuple[type[Law], ...] = (
    LinearStiffness,
    CubicStiffness,
    PowerStiffness,
    GeometricStiffness,
    QuinticStiffness,
    QuadraticStiffness,
    ProgressiveStiffness,
    PiecewiseStiffness,
    PiecewiseStiffnessBelow,
    HertzContact,
    Clearance,
    SlackSpring,
    SlackCoupling,
    SoftClearance,
    OffCentreClearance,
    CoulombFriction,
    AsymmetricFriction,
    DirectionalFriction,
    behind_gap(CoulombFriction),
    PreslidingFriction,
    StribeckFriction,
    PreslidingStribeckFriction,
    ViscousDamping,
    DirectionalDamping,
    QuadraticDrag,
    DirectionalDrag,
    CubicDamping,
    StopHysteresis,
    PlayHysteresis,
    GeneralizedHysteresis,
    BoucWen,
    BoucWenActuator,
    Backlash,
    Saturation,
    AsymmetricSaturation,
    SoftSaturation,
    SkewSaturation,
    GradualSaturation,
    DeadZone,
    AsymmetricDeadZone,
    Quadratic,
    Cubic,
    Polynomial,
    Magnitude,
    Power,
    PowerWithGain,
    Root,
    Orifice,
    Delay,
    Relaxation,
    TwoStageRelaxation,
    Creep,
    TwoStageCreep,
    Drift,
    Settling,
    Swing,
    PeriodicForce,
    HarmonicForce,
    Ripple,
    Lag,
    Resonance,
    Mode,
    Attached,
)

# what a named law is put more finely by, once it is named: it costs more to fit
FINER: dict[type[Law], tuple[Any, ...]] = {
    StopHysteresis: (SmoothHysteresis,),
    PlayHysteresis: (FinePlays,),
    GeneralizedHysteresis: (FineGeneralized,),
}

# what an input that the simulator's equations do not read may scale
SCALABLE: tuple[type[Law], ...] = (
    LinearStiffness,
    ViscousDamping,
    CoulombFriction,
    PreslidingFriction,
    StopHysteresis,
)

__all__ = ["CATALOGUE", "FINER", "SCALABLE", "Law", "Local", "behind_gap", "readable_unit", "scaled"]
