"""Laws made of laws: scaled by an input, acting beyond a gap, or with a far side that one output reads.

Two laws in parallel in one port need no class of their own: call `Simulator.with_element` twice. Strengths that vary
with a signal are in `scheduling`.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np

from .._base import InputError
from .base import Law, Local, beyond_gap, check_signal, rename_class

GAPS = (0.1, 0.3, 0.6)  # tried gaps over the largest |z|


def check_force(law: Any) -> Any:
    """Return a class of laws that may act as a force; refuse anything else."""
    if not (isinstance(law, type) and issubclass(law, Law)):
        raise InputError(f"A composed law is made of a class of laws, such as CoulombFriction; got {law!r}.")
    if "parallel" not in law.places and not law.of_input:
        raise InputError(f"The law {law.id!r} stands in series with a signal; only a force can be composed.")
    return law


def missing_signal(by: str, local: Local) -> str:
    """Say why a signal cannot vary a strength at a port; empty if it can."""
    if by not in local.inputs:
        return f"the port has no signal {by}"
    return "" if np.ptp(local.inputs[by]) > 0 else f"{by} is constant"


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
        If it is not a law, or acts in series with a signal; if `by` is no name.
    """
    check_signal(by)
    return _scaled(check_force(law), by)


@functools.cache  # the same class for the same arguments
def _scaled(base: Any, by: str) -> Any:
    strengths = {name: f"{unit}/[{by}]" if name in base.strength else unit for name, unit in base.units.items()}

    if base.of_input:
        words = [text.format(by=by) for text in (base.form, base.equation, base.sentence)]
    else:
        form, equation = f"{base.form}, scaled by {by}".removeprefix(", "), base.equation.replace("w =", "f =", 1)
        words = [form, f"w = {by} f,  {equation}", f"{base.sentence}; {by} scales its strength"]

    class Scaled(base):
        form, equation, sentence = words
        sentences = {domain: f"{text}; {by} scales its strength" for domain, text in base.sentences.items()}
        units, strength = strengths, base.strength
        places = base.places
        dissipative = restoring = False  # the signal may have either sign
        scaled_by, of_input = by, False

        def why_not(self, local: Local) -> str:
            return super().why_not(local) or missing_signal(by, local)

    return rename_class(
        Scaled, f"{base.__name__}ScaledBy_{by}", f"{base.__doc__}\n\n    Its strength is scaled by {by}."
    )


class UnreadInput(Law):
    """The effect of a recorded input that the equations do not read, such as a load or the sun; `scaled` names it.

    At a sensor it is cross-sensitivity, as of a strain gauge to temperature.
    """

    id = "unread_input"
    form = "{by}"
    equation = "w = a {by}"
    sentence = "{by} acts here; it is recorded, and the equations do not read it"
    of_input = True
    units = {"a": "w"}
    places: ClassVar[tuple[str, ...]] = ("parallel", "series")

    def force(self, p: Any) -> Any:
        return p.a


class Feedthrough(UnreadInput):
    """An input that reaches a sensor, or the channel of another input, directly; `scaled` names it."""

    id = "feedthrough"
    source = "Franklin, Powell & Emami-Naeini (2015), Feedback Control of Dynamic Systems, sec. 7.3"
    sentence = "{by} passes straight through to here, as by a resistance in series, or by cross-talk of channels"
    places = ("series",)


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
    base = check_force(law)
    if base.order or "g" in base.units:
        raise InputError(f"The law {base.id!r} has {'states' if base.order else 'a gap'} of its own; take another.")
    if base.reads() - {"z", "dz"}:
        raise InputError(f"The law {base.id!r} reads more than z and dz; take another.")
    return _behind_gap(base)


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

    return rename_class(Behind, f"{base.__name__}BehindGap", f"{base.__doc__}\n\n    It acts beyond a gap.")


def seen_by(law: type[Law], output: str) -> type[Law]:
    """Make a law with a far side that one output alone reads, such as a drive with a sensor at either end.

    Parameters
    ----------
    law : class of Law
        A law that changes what outputs read, such as `ElasticDrive`.
    output : str
        The output that reads the far side; others that read the port's coordinate still do so.

    Raises
    ------
    InputError
        If the law has no far side.
    """
    base: Any = law
    if not getattr(base, "sensed", False):
        raise InputError(f"{law!r} was given; give a class of laws that outputs see, such as ElasticDrive.")
    return _seen_by(base, output)


@functools.cache
def _seen_by(base: Any, output: str) -> Any:
    class Seen(base):
        form = f"{base.form}, seen by {output}"
        equation = base.equation.replace("outputs read", f"{output} reads")
        sentence = f"{base.sentence}; {output} alone is on the far side"
        units, strength = base.units, base.strength
        seen_by = output

    return rename_class(
        Seen, f"{base.__name__}SeenBy_{output}", f"{base.__doc__}\n\n    {output} alone reads its far side."
    )
