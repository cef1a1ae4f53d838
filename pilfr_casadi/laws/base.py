"""What a law is: a small class a physical hypothesis, with its equation, source, sentence, parameters and start values.

A law is a force `w = Σ_i c_i φ_i(z, ż, q, t; shape)`, linear in its *strengths* c, nonlinear in its *shape*
(threshold, gap, knee, delay). `q̇ = flow(...)` are states of its own; a law with `step(z, s, p)` has a discrete memory
instead. A law without strengths is the deviation of a signal from itself: `w = law(u) - u`.
"""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from ..models import Parameter

EDGE = 0.05  # share of a gap over which contact sets in


@dataclass(frozen=True, eq=False)
class Local:
    """Signals at a port along recordings, from which grids and limits of shapes follow.

    Attributes
    ----------
    z, dz : array, shape (M,)
        Local coordinate and its rate over all recordings, one after the other.
    dt : float
        Sampling interval, s.
    lengths : tuple of int
        Samples of each recording.
    stiffest : float
        Largest stiffness (w/z) that the simulation's steps can follow at the port: a harder contact is a wall.
    firmest : float
        Largest damping (w*s/z) that the steps can follow at the port.
    inputs : mapping of str to array, shape (M,)
        The simulator's inputs, for laws that one of them scales.
    from_zero : tuple of bool
        Which recordings begin with everything at zero; in the others laws begin as if z had stood still before.
    """

    z: np.ndarray
    dz: np.ndarray
    dt: float
    lengths: tuple[int, ...]
    stiffest: float = np.inf
    firmest: float = np.inf
    inputs: Mapping[str, np.ndarray] = field(default_factory=dict)
    from_zero: tuple[bool, ...] = ()

    @cached_property
    def low(self) -> float:
        """Smallest z, without the outermost 0.1 %."""
        return float(np.quantile(self.z, 0.001))

    @cached_property
    def high(self) -> float:
        """Largest z, without the outermost 0.1 %."""
        return float(np.quantile(self.z, 0.999))

    @property
    def reach(self) -> float:
        """Largest |z|."""
        return max(abs(self.low), abs(self.high), 1e-300)

    @property
    def half(self) -> float:
        """Half the range of z."""
        return max((self.high - self.low) / 2, 1e-300)

    @cached_property
    def speed(self) -> float:
        """Largest |ż|, without the outermost 1 %."""
        return max(float(np.quantile(np.abs(self.dz), 0.99)), 1e-300)

    @property
    def duration(self) -> float:
        """Length of the longest recording, s."""
        return max(self.lengths) * self.dt


@dataclass(frozen=True)
class Law:
    """A law; subclasses state the class variables and `force`, and `shapes` where there is a shape.

    Attributes
    ----------
    id, form : str
        Name in results, and which variant.
    equation, source, sentence : str
        In plain text.
    units : mapping
        Parameter -> unit, in terms of w, z and s: "w/z^3".
    strength : tuple of str
        Parameters in which the force is linear.
    places : tuple of {"parallel", "series", "sensor"}
        Inside the dynamics, at an actuator or a sensor, or at a sensor alone.
    dissipative : bool
        Strengths must oppose motion, but for those in `signed`.
    restoring : bool
        Strengths must push back.
    order : int
        States of its own.
    follows : int
        How many of these, the first, come to rest at the signal where it stands still; the others at zero.
    shifts : bool
        Its memory is a shift register, which takes in the signal at the begin of a step.
    substeps : int
        Integration steps a sample that it needs at least.
    knee : str
        Parameter over whose width, of speed about rest, the force turns round; steps have to be fine there.
    scaled_by : str
        Input that the force is multiplied by, where there is one; see `composed.scaled`.
    """

    id: ClassVar[str]
    equation: ClassVar[str]
    source: ClassVar[str] = ""
    sentence: ClassVar[str] = ""
    form: ClassVar[str] = ""
    units: ClassVar[Mapping[str, str]] = {}
    strength: ClassVar[tuple[str, ...]] = ()
    places: ClassVar[tuple[str, ...]] = ("parallel",)
    dissipative: ClassVar[bool] = False
    restoring: ClassVar[bool] = False
    signed: ClassVar[tuple[str, ...]] = ()
    order: ClassVar[int] = 0
    follows: ClassVar[int] = 0
    shifts: ClassVar[bool] = False
    substeps: ClassVar[int] = 1
    knee: ClassVar[str] = ""
    scaled_by: ClassVar[str] = ""

    values: Mapping[str, Any] = field(default_factory=dict)
    limits: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)

    def force(self, *args: Any, **kwargs: Any) -> Any:
        """Force w from any of z, dz, q, t, x, u, p by name."""
        raise NotImplementedError(f"{type(self).__name__} needs a force")

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        """Values of the shape parameters worth trying."""
        yield {}

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        """Limits of the shape parameters that the data can speak to."""
        return {}

    def applies(self, local: Local) -> str:
        """Why the data cannot speak to this law, or nothing."""
        return ""

    @property
    def lacks(self) -> str:
        """What has to be said of the law before it can stand in a port, or nothing."""
        return ""

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Whether at fitted values the law is hardly what its sentence says."""
        return False

    def starts_as(self, plain: Law, own: Mapping[str, Any]) -> dict[str, Any]:
        """Start values that make it a law which it refines, fitted to `own`; none where it refines another."""
        more = set(self.units) - set(plain.units)
        refines = plain.strength and plain.units.items() <= self.units.items() and more <= set(self.strength)
        return {**dict.fromkeys(more, 0.0), **own} if more and refines else {}

    def size(self, values: Mapping[str, Any]) -> int:
        """Free numbers of the law at fitted values."""
        return sum(int(np.sum(~p.fixed)) for p in self.parameters().values())

    @classmethod
    def reads(cls) -> set[str]:
        """Names of the signals that the force (and the flow) use."""
        if hasattr(cls, "step"):
            return set(inspect.signature(cls.step).parameters) & {"z", "dz"}
        named = set(inspect.signature(cls.force).parameters)
        if cls.order:
            named |= set(inspect.signature(cls.flow).parameters)  # type: ignore[attr-defined]
        return named & {"z", "dz", "t", "x", "u"}

    def standing(self, z: float) -> np.ndarray:
        """States of its own, or its memory, where the signal has stood still at z."""
        out = np.zeros(int(getattr(self, "memory", 0)) if hasattr(self, "step") else self.order)
        out[: len(out) if self.shifts else self.follows] = z
        return out

    def on_grid(self, h: float) -> Law:
        """The law for steps of length h, s; most do not care."""
        return self

    def at(self, values: Mapping[str, Any], limits: Mapping[str, tuple[Any, Any]] | None = None) -> Law:
        """The law starting at `values` inside `limits`."""
        return replace(self, values={**self.values, **values}, limits={**self.limits, **(limits or {})})

    def parameters(self) -> dict[str, Parameter]:
        """Parameters with start values, limits and units (in w, z, s)."""
        out = {}
        for name, unit in self.units.items():
            value = np.asarray(self.values.get(name, 0.0 if name in self.strength else 1.0), dtype=float)
            low, high = self.limits.get(name, (-np.inf, np.inf))
            out[name] = Parameter(np.clip(value, low, high), unit=unit, bounds=(low, high))
        return out


def readable_unit(unit: str, w: str, z: str) -> str:
    """A unit in w, z and s with the port's own units put in: ("w/z^3", "N", "m") -> "N/m^3"."""
    if unit == "w/z" and w == z:
        return ""
    parts = []
    for token in unit.replace("*", " * ").replace("/", " / ").split():
        base, _, power = token.partition("^")
        known = {"w": w or "[w]", "z": z or "[z]"}.get(base, base)
        parts.append(f"({known})^{power}" if power and " " in known else known + (f"^{power}" if power else ""))
    return "".join(f" {p} " if p == "*" else p for p in parts).strip()


def beyond(z: Any, g: Any) -> Any:
    """From 0 to 1 where z passes a gap of g on either side: over a part of it, for a jump would have no slope in g."""
    return (1 + ca.tanh((ca.fabs(z) - g) / (EDGE * g))) / 2


def grid(**axes: Any) -> Iterator[dict[str, Any]]:
    """Every combination of the axes' values."""
    for values in itertools.product(*axes.values()):
        yield {k: float(v) for k, v in zip(axes, values, strict=True)}
