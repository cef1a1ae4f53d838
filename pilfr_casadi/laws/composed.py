"""Laws made of laws: behind a gap, and with a strength that another signal scales.

Two laws in parallel in one port need no class of their own: call `Simulator.with_element` twice.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Iterator
from typing import Any

import casadi as ca

from .._base import InputError
from .base import Law, Local, beyond

GAPS = (0.1, 0.3, 0.6)  # tried gaps over the largest |z|


def _parallel_law(law: Any) -> type[Law]:
    if not (isinstance(law, type) and issubclass(law, Law)):
        raise InputError(f"A composed law is made of a class of laws, such as CoulombFriction; got {law!r}.")
    if "parallel" not in law.places:
        raise InputError(f"The law {law.id!r} stands in series with a signal; only a force can be composed.")
    return law


def _form(kind: type[Law], more: str) -> str:
    return f"{kind.form}, {more}" if kind.form else more


def _named(name: str) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD)


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
    base: Any = _parallel_law(law)
    kind: type[Law] = _scaled(base, by)
    return kind


@functools.cache  # the same class for the same arguments
def _scaled(base: Any, by: str) -> Any:
    strengths = {name: f"{unit}/[{by}]" if name in base.strength else unit for name, unit in base.units.items()}

    class Scaled(base):
        form = _form(base, f"scaled by {by}")
        equation = f"w = {by} v,  {base.equation.replace('w =', 'v =', 1)}"
        sentence = f"{base.sentence}; {by} scales its strength"
        units = strengths
        places = ("parallel",)
        dissipative = restoring = False  # the signal may have either sign
        scaled_by = by

    Scaled.__doc__ = f"{base.__doc__}\n\n    Its strength is scaled by {by}."
    Scaled.__name__ = Scaled.__qualname__ = f"{base.__name__}ScaledBy_{by}"
    return Scaled


def behind_gap(law: type[Law]) -> type[Law]:
    """Make a law that acts beyond a gap only: on `z' = z - clip(z, -g, g)` and its rate, such as a stop that rubs.

    A force of the rate sets in over a twentieth of the gap, as a contact does.

    Parameters
    ----------
    law : class of Law
        Any law that may act in parallel, as a force.

    Raises
    ------
    InputError
        If it is not a law, acts in series with a signal, or has states or a gap of its own.
    """
    base: Any = _parallel_law(law)
    if base.order or "g" in base.units:
        raise InputError(f"The law {base.id!r} has {'states' if base.order else 'a gap'} of its own; take another.")
    kind: type[Law] = _behind(base)
    return kind


@functools.cache
def _behind(base: Any) -> Any:
    def reached(z: Any, dz: Any, p: Any) -> tuple[Any, Any]:
        return z - ca.fmin(ca.fmax(z, -p["g"]), p["g"]), beyond(z, p["g"]) * dz

    class Behind(base):
        form = _form(base, "behind a gap")
        equation = f"{base.equation}  with z - clip(z, -g, g) in place of z"
        sentence = f"{base.sentence}, beyond a gap"
        units = {**base.units, "g": "z"}
        places = ("parallel",)

        def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
            """Shapes of the law, each with every gap."""
            for own in super().shapes(local):
                for share in GAPS:
                    yield {**own, "g": share * local.reach}

        def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
            """Bounds of the law, and a gap that the signal passes."""
            return {**super().bounds(local), "g": (0.01 * local.reach, 0.95 * local.reach)}

        if hasattr(base, "step"):

            def step(self, z: Any, s: Any, p: Any, dz: Any = 0.0) -> Any:
                """Step of the law, beyond the gap."""
                past, rate = reached(z, dz, p)
                more = {"dz": rate} if "dz" in inspect.signature(base.step).parameters else {}
                return base.step(self, past, s, p, **more)

        else:

            def force(self, **have: Any) -> Any:
                """Force of the law, beyond the gap."""
                past, rate = reached(have["z"], have["dz"], have["p"])
                have |= {"z": past, "dz": rate}
                return base.force(
                    self, **{k: v for k, v in have.items() if k in inspect.signature(base.force).parameters}
                )

            named = tuple(inspect.signature(base.force).parameters)
            force.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
                [_named(name) for name in dict.fromkeys(("self", "z", "dz", *named))]
            )

    Behind.__doc__ = f"{base.__doc__}\n\n    It acts beyond a gap."
    Behind.__name__ = Behind.__qualname__ = f"{base.__name__}BehindGap"
    return Behind
