"""The catalogue of laws that may be missing from a simulator, and laws made of laws.

Each law that a file of this folder defines is in the catalogue. Two laws in parallel in one port need no class of their
own: call `Simulator.with_element` twice.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from .._base import InputError
from ..models import Named, Parameter
from . import curves, dynamic, electrical, friction, hysteresis, in_line, stiffness, thermal
from .base import Law, Local, beyond_gap

GAPS = (0.1, 0.3, 0.6)  # tried gaps over the largest |z|


def scaled(law: type[Law], by: str) -> type[Law]:
    """Make a law whose strength a signal scales: `w = by law(z, dz/dt)`, such as a yield force set by a voltage.

    Parameters
    ----------
    law : class of Law
        Any law that may act in parallel, as a force.
    by : str
        An input of the simulator, which multiplies the strength.

    Raises
    ------
    InputError
        If it is not a law, or acts in series with a signal.
    """
    return _scaled(_parallel(law), by)


def scheduled(law: type[Law], by: str) -> type[Law]:
    """Make a law whose strength varies linearly with a signal, such as friction that grows with a pressure.

    Each strength, such as `F_c`, becomes two: `F_c` where the signal is lowest in the recordings (`low`), and
    `F_c_high` where it is highest (`high`). A force that opposes motion does so in the whole range.

    Parameters
    ----------
    law : class of Law
        Any law that may act in parallel, as a force.
    by : str
        An input of the simulator, one of the port's own `signals`, "z", the local coordinate, or "t", the time.

    Raises
    ------
    InputError
        If it is not a law, or acts in series with a signal.
    """
    return _scheduled(_parallel(law), by)


def unscheduled(law: type[Law]) -> type[Law]:
    """Return the law whose strength does not vary, if it does; see `scheduled`."""
    return law.__base__ if law.scheduled_by else law  # type: ignore[return-value]


def behind_gap(law: type[Law]) -> type[Law]:
    """Make a law that acts beyond a gap only: on `z' = z - clip(z, -g, g)` and its rate, such as a stop that rubs.

    A force of the rate sets in over a twentieth of the gap, as a contact does.

    Parameters
    ----------
    law : class of Law
        Any law that may act in parallel, as a force of `z` and `dz` alone.

    Raises
    ------
    InputError
        If it is not a law, acts in series with a signal, has states or a gap of its own, or reads other signals.
    """
    base = _parallel(law)
    if base.order or "g" in base.units:
        raise InputError(f"The law {base.id!r} has {'states' if base.order else 'a gap'} of its own; take another.")
    if base.reads() - {"z", "dz"}:
        raise InputError(f"The law {base.id!r} reads more than z and dz; take another.")
    return _behind_gap(base)


def _parallel(law: Any) -> Any:
    """Check that a law is a force."""
    if not (isinstance(law, type) and issubclass(law, Law)):
        raise InputError(f"A composed law is made of a class of laws, such as CoulombFriction; got {law!r}.")
    if "parallel" not in law.places:
        raise InputError(f"The law {law.id!r} stands in series with a signal; only a force can be composed.")
    return law


def _not_there(by: str, local: Local) -> str:
    """Say why a signal cannot vary a strength at a port; empty if it can."""
    if by not in local.inputs:
        return f"the port has no signal {by}"
    return "" if np.ptp(local.inputs[by]) > 0 else f"{by} is constant"


@functools.cache  # the same class for the same arguments
def _scaled(base: Any, by: str) -> Any:
    strengths = {name: f"{unit}/[{by}]" if name in base.strength else unit for name, unit in base.units.items()}

    class Scaled(base):
        form = f"{base.form}, scaled by {by}".removeprefix(", ")
        equation = f"w = {by} f,  {base.equation.replace('w =', 'f =', 1)}"
        sentence = f"{base.sentence}; {by} scales its strength"
        units, strength = strengths, base.strength
        places = ("parallel",)
        dissipative = restoring = False  # the signal may have either sign
        scaled_by = by

        def why_not(self, local: Local) -> str:
            """Say why the data carries no information on this law; empty if it does."""
            return super().why_not(local) or _not_there(by, local)

    return _name(Scaled, f"{base.__name__}ScaledBy_{by}", f"{base.__doc__}\n\n    Its strength is scaled by {by}.")


@functools.cache
def _scheduled(base: Any, by: str) -> Any:
    high = {name: f"{name}_high" for name in base.strength}
    unit = {"z": "z", "t": "s"}.get(by, f"[{by}]")
    words = {"z": "the local coordinate", "t": "time"}.get(by, by)
    read = [*inspect.signature(base.step if base.memory else base.force).parameters]

    def strengths(p: Any, u: Any, z: Any) -> dict[str, Any]:
        """Parameters of the law at a value of the signal."""
        signal = z if by == "z" else u[by]
        share = (signal - p["low"]) / (p["high"] - p["low"])
        own = {name: p[name] for name in base.units}
        return own | {name: p[name] + share * (p[end] - p[name]) for name, end in high.items()}

    class Scheduled(base):
        form = f"{base.form}, scheduled by {by}".removeprefix(", ")
        equation = f"{base.equation}  with {', '.join(base.strength)} linear in {by}"
        sentence = f"{base.sentence}; its strength varies with {words}"
        units = {**base.units, **{end: base.units[name] for name, end in high.items()}, "low": unit, "high": unit}
        strength = (*base.strength, *high.values())
        places = ("parallel",)
        scheduled_by = by

        def why_not(self, local: Local) -> str:
            """Say why the data carries no information on this law; empty if it does."""
            unknown = not (local.shown or (local.from_zero and all(local.from_zero)))
            if by == "z" and unknown:  # a level of each recording's own would pass for a variation with z
                return "no output reads the coordinate, and its start is unknown"
            return super().why_not(local) or ("" if by == "z" else _not_there(by, local))

        def parameters(self) -> dict[str, Parameter]:
            """Parameters, of which the ends of the signal's range are fixed."""
            ends = {k: Parameter(float(self.values.get(k, k == "high")), unit, fixed=True) for k in ("low", "high")}
            return {**super().parameters(), **ends}

        def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
            """Shapes of the law, with the range of the signal."""
            signal = self.schedule(local)
            for own in super().shapes(local):
                yield {**own, "low": float(signal.min()), "high": float(signal.max())}

        @classmethod
        def finer_starts(cls, values: Mapping[str, Any], local: Local) -> Iterator[dict[str, Any]]:
            """Start as the law of these values, stronger at one end of the range of the signal than at the other."""
            signal = cls().schedule(local)
            mean = {name: (values[name] + values.get(end, values[name])) / 2 for name, end in high.items()}
            ends = {"low": float(signal.min()), "high": float(signal.max())}
            for low, top in ((0.5, 1.5), (1.5, 0.5)):
                own = {name: low * v for name, v in mean.items()}
                yield {**values, **own, **{end: top * mean[name] for name, end in high.items()}, **ends}

        if base.memory:

            def step(self, z: Any, s: Any, p: Any, dz: Any = 0.0, u: Any = None) -> Any:
                at = p if u is None and by != "z" else strengths(p, u, z)
                have = {"z": z, "s": s, "p": at, "dz": dz}
                return super().step(**{k: have[k] for k in read if k in have})

        else:

            def force(self, z: Any, dz: Any, u: Any, p: Any) -> Any:
                have = {"z": z, "dz": dz, "p": Named("parameter", strengths(p, u, z))}
                return super().force(**{k: have[k] for k in read if k in have})

    return _name(
        Scheduled, f"{base.__name__}ScheduledBy_{by}", f"{base.__doc__}\n\n    Its strength varies with {words}."
    )


@functools.cache
def _behind_gap(base: Any) -> Any:
    read = inspect.signature(base.step if base.memory else base.force).parameters

    def past(z: Any, dz: Any, p: Any) -> dict[str, Any]:
        """Arguments of the law's force or step beyond the gap."""
        signals = zip(("z", "dz"), beyond_gap(z, dz, p["g"]), strict=True)
        return {"p": p, **{name: value for name, value in signals if name in read}}

    class Behind(base):
        form = f"{base.form}, behind a gap".removeprefix(", ")
        equation = f"{base.equation}  with z - clip(z, -g, g) in place of z"
        sentence = f"{base.sentence}, beyond a gap"
        units, strength = {**base.units, "g": "z"}, base.strength
        places = ("parallel",)

        def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
            """Shapes of the law, each with every gap."""
            for own in super().shapes(local):
                for share in GAPS:
                    yield {**own, "g": share * local.reach}

        def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
            """Bounds of the law, and a gap that the signal passes."""
            return {**super().bounds(local), "g": (0.01 * local.reach, 0.95 * local.reach)}

        if base.memory:

            def step(self, z: Any, s: Any, p: Any, dz: Any = 0.0) -> Any:
                return super().step(s=s, **past(z, dz, p))

        else:

            def force(self, z: Any, dz: Any, p: Any) -> Any:
                return super().force(**past(z, dz, p))

    return _name(Behind, f"{base.__name__}BehindGap", f"{base.__doc__}\n\n    It acts beyond a gap.")


def _name(law: Any, name: str, doc: str) -> Any:
    law.__name__ = law.__qualname__ = name
    law.__doc__ = doc
    return law


# laws that refine a named law, once it is named: they cost more to fit
FINER: dict[type[Law], tuple[Any, ...]] = {
    hysteresis.StopHysteresis: (hysteresis.SmoothHysteresis,),
    hysteresis.PlayHysteresis: (hysteresis.FinePlays,),
    hysteresis.GeneralizedHysteresis: (hysteresis.FineGeneralized,),
}

# laws in the order in which they are tried: those of the files, in the order in which they are defined
CATALOGUE: tuple[type[Law], ...] = (
    *(
        law
        for file in (stiffness, friction, hysteresis, curves, dynamic, in_line, thermal, electrical)
        for law in vars(file).values()
        if isinstance(law, type) and issubclass(law, Law) and hasattr(law, "id") and (law,) not in FINER.values()
    ),
    behind_gap(friction.CoulombFriction),
)

# ids of laws that are equivalent to other values of the simulator's own parameters, if it has a spring or damper there
LINEAR = (stiffness.LinearStiffness.id, friction.ViscousDamping.id)

# laws of the position that an input may scale: a force constant or a valve's gain that varies with the position
POSITION_GAINS: tuple[type[Law], ...] = (stiffness.LinearStiffness, stiffness.QuadraticStiffness)

# laws whose strength may vary with a signal
SCALABLE: tuple[type[Law], ...] = (
    stiffness.LinearStiffness,
    friction.ViscousDamping,
    friction.CoulombFriction,
    friction.PreslidingFriction,
    hysteresis.StopHysteresis,
)
