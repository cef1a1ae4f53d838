"""The catalogue of laws that may be missing from a simulator, in the order in which they are tried."""

from __future__ import annotations

from typing import Any

from . import curves, dynamic, friction, hysteresis, periodic, saturation, stiffness
from .base import Law
from .composed import behind_gap

CATALOGUE: tuple[type[Law], ...] = (
    stiffness.LinearStiffness,
    stiffness.CubicStiffness,
    stiffness.PowerStiffness,
    stiffness.GeometricStiffness,
    stiffness.QuinticStiffness,
    stiffness.QuadraticStiffness,
    stiffness.ProgressiveStiffness,
    stiffness.PiecewiseStiffness,
    stiffness.PiecewiseStiffnessBelow,
    stiffness.HertzContact,
    stiffness.Clearance,
    stiffness.SlackSpring,
    stiffness.SlackCoupling,
    stiffness.SoftClearance,
    stiffness.OffCentreClearance,
    friction.CoulombFriction,
    friction.AsymmetricFriction,
    friction.DirectionalFriction,
    behind_gap(friction.CoulombFriction),
    friction.PreslidingFriction,
    friction.StribeckFriction,
    friction.PreslidingStribeckFriction,
    friction.ViscousDamping,
    friction.DirectionalDamping,
    friction.QuadraticDrag,
    friction.DirectionalDrag,
    friction.CubicDamping,
    hysteresis.StopHysteresis,
    hysteresis.PlayHysteresis,
    hysteresis.GeneralizedHysteresis,
    hysteresis.BoucWen,
    hysteresis.BoucWenActuator,
    hysteresis.Backlash,
    saturation.Saturation,
    saturation.AsymmetricSaturation,
    saturation.SoftSaturation,
    saturation.SkewSaturation,
    saturation.GradualSaturation,
    saturation.DeadZone,
    saturation.AsymmetricDeadZone,
    curves.Quadratic,
    curves.Cubic,
    curves.Polynomial,
    curves.Magnitude,
    curves.Power,
    curves.PowerWithGain,
    curves.Root,
    curves.Orifice,
    dynamic.Delay,
    dynamic.Relaxation,
    dynamic.TwoStageRelaxation,
    dynamic.Creep,
    dynamic.TwoStageCreep,
    dynamic.Drift,
    dynamic.Settling,
    dynamic.Swing,
    periodic.PeriodicForce,
    periodic.HarmonicForce,
    periodic.Ripple,
    dynamic.Lag,
    dynamic.Resonance,
    dynamic.Mode,
    dynamic.Attached,
)

# laws that refine a named law, once it is named: they cost more to fit
FINER: dict[type[Law], tuple[Any, ...]] = {
    hysteresis.StopHysteresis: (hysteresis.SmoothHysteresis,),
    hysteresis.PlayHysteresis: (hysteresis.FinePlays,),
    hysteresis.GeneralizedHysteresis: (hysteresis.FineGeneralized,),
}

# laws that may be scaled by an input which the simulator's equations do not read
SCALABLE: tuple[type[Law], ...] = (
    stiffness.LinearStiffness,
    friction.ViscousDamping,
    friction.CoulombFriction,
    friction.PreslidingFriction,
    hysteresis.StopHysteresis,
)
