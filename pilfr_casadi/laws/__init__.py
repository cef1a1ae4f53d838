"""The catalogue of physical laws that may be missing from a simulator, one small class for each hypothesis.

`base` holds the class `Law` and shows how to add a law in ten lines. Laws are grouped by kind: `stiffness` (springs,
contacts, gaps, periodic forces), `friction` (forces of speed), `hysteresis` (loops), `curves` (saturation and other
curves of actuators and sensors), `dynamic` (delays, creep, modes, trends), `in_line` (in line with a term of the
equations), `thermal` and `electrical` (laws of one domain), `transport` (delays by a flow). `composed` makes laws of
laws (scaled, behind a gap, seen by one output), `scheduling` those whose strength varies with a signal, and
`varying_parameters` the changes of a parameter. `catalogue` lists the laws that a diagnosis tries. `forces` evaluates
laws along given signals.
"""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .base import (
        Law as Law,
        Local as Local,
        display_name as display_name,
        readable_unit as readable_unit,
        short_name as short_name,
    )
    from .catalogue import (
        CATALOGUE as CATALOGUE,
        DRAGS as DRAGS,
        DRY as DRY,
        FINER as FINER,
        LINEAR as LINEAR,
        POSITION_GAINS as POSITION_GAINS,
        SCALABLE as SCALABLE,
        SMALL_AND_LARGE as SMALL_AND_LARGE,
        related_forms as related_forms,
    )
    from .composed import (
        Feedthrough as Feedthrough,
        UnreadInput as UnreadInput,
        behind_gap as behind_gap,
        scaled as scaled,
        seen_by as seen_by,
    )
    from .curves import (
        AsymmetricDeadZone as AsymmetricDeadZone,
        AsymmetricSaturation as AsymmetricSaturation,
        Cubic as Cubic,
        DeadZone as DeadZone,
        Exponential as Exponential,
        FreeCurve as FreeCurve,
        Gain as Gain,
        GradualSaturation as GradualSaturation,
        Magnitude as Magnitude,
        Orifice as Orifice,
        Polynomial as Polynomial,
        Power as Power,
        PowerWithGain as PowerWithGain,
        Quadratic as Quadratic,
        Rectified as Rectified,
        Root as Root,
        Saturation as Saturation,
        SkewSaturation as SkewSaturation,
        SoftSaturation as SoftSaturation,
        SteepCurve as SteepCurve,
        chebyshev as chebyshev,
    )
    from .dynamic import (
        Attached as Attached,
        Creep as Creep,
        Delay as Delay,
        Drift as Drift,
        ElasticJoint as ElasticJoint,
        Lag as Lag,
        Mode as Mode,
        Relaxation as Relaxation,
        Resonance as Resonance,
        Settling as Settling,
        SprungMass as SprungMass,
        Swing as Swing,
        TwoStageCreep as TwoStageCreep,
        TwoStageRelaxation as TwoStageRelaxation,
    )
    from .electrical import (
        Clamp as Clamp,
        Diode as Diode,
        Overpotential as Overpotential,
        ReversedDiode as ReversedDiode,
        SaturatingInductance as SaturatingInductance,
        VoltageDrop as VoltageDrop,
    )
    from .forces import count_columns as count_columns, unit_forces as unit_forces
    from .friction import (
        AsymmetricFriction as AsymmetricFriction,
        CoulombFriction as CoulombFriction,
        CubicDamping as CubicDamping,
        DirectionalDamping as DirectionalDamping,
        DirectionalDrag as DirectionalDrag,
        DirectionalFriction as DirectionalFriction,
        PowerDrag as PowerDrag,
        PreslidingFriction as PreslidingFriction,
        PreslidingStribeckFriction as PreslidingStribeckFriction,
        QuadraticDrag as QuadraticDrag,
        StribeckFriction as StribeckFriction,
        ViscousDamping as ViscousDamping,
    )
    from .hysteresis import (
        OPERATORS as OPERATORS,
        Backlash as Backlash,
        BoucWen as BoucWen,
        BoucWenActuator as BoucWenActuator,
        FineGeneralized as FineGeneralized,
        FinePlays as FinePlays,
        GeneralizedHysteresis as GeneralizedHysteresis,
        PlayHysteresis as PlayHysteresis,
        SmoothHysteresis as SmoothHysteresis,
        StiffeningBoucWen as StiffeningBoucWen,
        StopHysteresis as StopHysteresis,
        hysteresis_layer as hysteresis_layer,
    )
    from .in_line import (
        Compliance as Compliance,
        ElasticDrive as ElasticDrive,
        ElasticDriveSeenAtLoad as ElasticDriveSeenAtLoad,
        LimitedTerm as LimitedTerm,
        LineGap as LineGap,
        SoftlyLimitedTerm as SoftlyLimitedTerm,
        TermLimit as TermLimit,
    )
    from .scheduling import (
        PROFILES as PROFILES,
        SCHEDULES as SCHEDULES,
        constant as constant,
        likely_profiles as likely_profiles,
        scheduled as scheduled,
        strengths_over as strengths_over,
    )
    from .stiffness import (
        AsymmetricCubicStiffness as AsymmetricCubicStiffness,
        Clearance as Clearance,
        CubicStiffness as CubicStiffness,
        DampedContact as DampedContact,
        DampedContactBelow as DampedContactBelow,
        GeometricStiffness as GeometricStiffness,
        Gravity as Gravity,
        HarmonicForce as HarmonicForce,
        HertzContact as HertzContact,
        LinearStiffness as LinearStiffness,
        LossyContact as LossyContact,
        LossyContactBelow as LossyContactBelow,
        OffCentreClearance as OffCentreClearance,
        PeriodicForce as PeriodicForce,
        PiecewiseStiffness as PiecewiseStiffness,
        PiecewiseStiffnessBelow as PiecewiseStiffnessBelow,
        PowerStiffness as PowerStiffness,
        ProgressiveStiffness as ProgressiveStiffness,
        QuadraticStiffness as QuadraticStiffness,
        QuinticStiffness as QuinticStiffness,
        Ripple as Ripple,
        SaturatingSpring as SaturatingSpring,
        SlackCoupling as SlackCoupling,
        SlackSpring as SlackSpring,
        SoftClearance as SoftClearance,
        Unbalance as Unbalance,
        WholeGravity as WholeGravity,
    )
    from .thermal import (
        AbsoluteRadiation as AbsoluteRadiation,
        Convection as Convection,
        Radiation as Radiation,
    )
    from .transport import carried as carried
    from .varying_parameters import (
        VARIATIONS as VARIATIONS,
        VaryingParameter as VaryingParameter,
        heated as heated,
        varying as varying,
    )

else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
