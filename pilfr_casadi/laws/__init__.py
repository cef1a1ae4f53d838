"""The catalogue of laws that may be missing from a simulator."""

from __future__ import annotations

from .base import Law, Local, readable_unit
from .friction import (
    AsymmetricFriction,
    CoulombFriction,
    CubicDamping,
    PreslidingFriction,
    QuadraticDrag,
    StribeckFriction,
)
from .limits import AsymmetricDeadZone, AsymmetricSaturation, DeadZone, Saturation, SoftSaturation
from .memory import (
    Attached,
    Backlash,
    BoucWen,
    Creep,
    Delay,
    Drift,
    Lag,
    Mode,
    PlayHysteresis,
    Relaxation,
    Resonance,
    StopHysteresis,
)
from .stiffness import (
    Clearance,
    Cubic,
    CubicStiffness,
    HertzContact,
    Magnitude,
    OffCentreClearance,
    PeriodicForce,
    PiecewiseStiffness,
    PiecewiseStiffnessBelow,
    Polynomial,
    Power,
    Quadratic,
    QuadraticStiffness,
)

CATALOGUE: tuple[type[Law], ...] = (
    CubicStiffness,
    QuadraticStiffness,
    PiecewiseStiffness,
    PiecewiseStiffnessBelow,
    HertzContact,
    Clearance,
    OffCentreClearance,
    CoulombFriction,
    AsymmetricFriction,
    PreslidingFriction,
    StribeckFriction,
    QuadraticDrag,
    CubicDamping,
    StopHysteresis,
    PlayHysteresis,
    BoucWen,
    Backlash,
    Saturation,
    AsymmetricSaturation,
    SoftSaturation,
    DeadZone,
    AsymmetricDeadZone,
    Quadratic,
    Cubic,
    Polynomial,
    Magnitude,
    Power,
    Delay,
    Relaxation,
    Creep,
    Drift,
    PeriodicForce,
    Lag,
    Resonance,
    Mode,
    Attached,
)

__all__ = ["CATALOGUE", "Law", "Local", "readable_unit"]
