"""The base class of all laws: one small class for each physical hypothesis.

A law is a force `w = Σ_i c_i φ_i(z, ż, q, t; shape)`, linear in its *strengths* c and nonlinear in its *shape*
(threshold, gap, knee, delay). `q̇ = flow(...)` are states of its own; a law with `step(z, s, p)` has a discrete memory
instead. In series at an actuator or a sensor the force is the deviation of the signal: `w = law(u) - u`.

How to add a law: state its equation, its sentence, its units and strengths, and write `force`. `starts` and `ranges`
give the values of the shape parameters that are tried, and their bounds, as multiples of an attribute of `Local`:

>>> class RubberBlock(Law):
...     id, equation = "rubber_block", "w = k L tan(z / L)"
...     sentence = "a rubber block: its stiffness grows without limit as the deflection comes near L"
...     units, strength = {"k": "w/z", "L": "z"}, ("k",)
...     starts = {"L": ("reach", 0.7, 1.0, 2.0)}  # 0.7, 1 and 2 times the largest |z|
...     ranges = {"L": ("reach", 0.65, 10.0)}
...
...     def force(self, z, p):
...         return p.k * p.L * ca.tan(z / p.L)
>>> signals = Local(z=np.linspace(-2.0, 2.0, 5), dz=np.ones(5), dt=0.1, lengths=(5,))
>>> [round(shape["L"], 2) for shape in RubberBlock().shapes(signals)]
[1.4, 2.0, 3.99]

`diagnose(simulator, recordings, laws=(*CATALOGUE, RubberBlock))` tries it beside the others. To put it into the
catalogue, add the class to the file of its kind and one line to `catalogue.py`.
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

from .._base import InputError
from ..models import Parameter

EDGE = 0.05  # width of the onset of a contact, as a share of its gap

# an attribute of `Local` ("" for none) and its multiples, for each shape parameter
Multiples = Mapping[str, tuple[Any, ...]]


@dataclass(frozen=True, eq=False)
class Local:
    """The signals at a port along recordings, which set the start values and bounds of shape parameters.

    Attributes
    ----------
    z, dz : array, shape (M,)
        Local coordinate and its rate over all recordings, one after the other.
    dt : float
        Sampling interval, s.
    lengths : tuple of int
        Samples of each recording.
    stiffest : float
        Largest stiffness (w/z) at the port that the simulation's steps resolve; a harder contact is a wall.
    firmest : float
        Largest damping (w*s/z) at the port that the steps resolve.
    inputs : mapping of str to array, shape (M,)
        The simulator's inputs, for laws whose strength is scaled by one of them.
    from_zero : tuple of bool
        Whether each recording begins with everything at zero; else a law begins as if z had stood still before.
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
    """A law; subclasses set the class variables and `force`, and `starts` and `ranges` where there is a shape.

    Attributes
    ----------
    id, form : str
        Name in results, and the variant of the law.
    equation, source, sentence : str
        In plain text.
    units : mapping
        Parameter -> unit, in terms of w, z and s: "w/z^3".
    strength : tuple of str
        Parameters in which the force is linear.
    starts, ranges : mapping
        Start values and (lower, upper) bounds of parameters, as multiples of an attribute of `Local`: "reach", "half",
        "low", "high", "speed", "dt", "duration", "stiffest", or "" for plain numbers. Every combination of start values
        is tried.
    places : tuple of {"parallel", "series", "sensor"}
        Allowed places: inside the dynamics, at an actuator or a sensor, or at a sensor alone.
    dissipative : bool
        Strengths must oppose motion, except those in `signed`.
    restoring : bool
        Strengths must push back.
    order : int
        Number of its own states.
    follows : int
        Number of these, from the first, that settle at the signal where it stands still; the others settle at zero.
    shifts : bool
        Its memory is a shift register, which takes in the signal at the beginning of a step.
    substeps : int
        Smallest number of integration steps per sample.
    knee : str
        Name of the speed over which the force reverses about rest; steps have to be fine there.
    scaled_by : str
        Input that multiplies the force, if any; see `scaled`.

    Parameters
    ----------
    values : mapping, optional
        Start values by parameter name; strengths start at zero and shapes at one where not given.
    limits : mapping, optional
        `(lower, upper)` by parameter name.

    Raises
    ------
    InputError
        If a value or limit is not a number, or names a parameter that the law does not have.
    """

    id: ClassVar[str]
    equation: ClassVar[str]
    source: ClassVar[str] = ""
    sentence: ClassVar[str] = ""
    form: ClassVar[str] = ""
    units: ClassVar[Mapping[str, str]] = {}
    strength: ClassVar[tuple[str, ...]] = ()
    starts: ClassVar[Multiples] = {}
    ranges: ClassVar[Multiples] = {}
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

    def __post_init__(self) -> None:
        for option, count in (("values", 1), ("limits", 2)):
            given = getattr(self, option)
            if not isinstance(given, Mapping):
                raise InputError(f"The {option} of the law {self.id!r} are {given!r}; give a dict by parameter name.")
            for name, entry in given.items():
                if name not in self.units:
                    raise InputError(
                        f"The law {self.id!r} has no parameter {name!r}; its parameters are {', '.join(self.units)}."
                    )
                if not _are_numbers([entry] if count == 1 else entry, count):
                    wanted = "finite numbers" if count == 1 else "a pair (lower, upper) of increasing numbers"
                    raise InputError(f"The {option} of the law {self.id!r} hold {name} = {entry!r}; give {wanted}.")

    def force(self, *args: Any, **kwargs: Any) -> Any:
        """Force w from any of z, dz, q, t, x, u, p by name."""
        raise NotImplementedError(f"{type(self).__name__} needs a force")

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        """Generate the values of the shape parameters to try: every combination of `starts`."""
        yield from grid(**{name: _multiply(local, scale, np.array(of)) for name, (scale, *of) in self.starts.items()})

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        """Bounds of the parameters on which the data carries information: `ranges`."""
        return {
            name: (_multiply(local, scale, low), _multiply(local, scale, high))
            for name, (scale, low, high) in self.ranges.items()
        }

    def applies(self, local: Local) -> str:
        """Reason why the data carries no information on this law; empty if it does."""
        return ""

    @property
    def lacks(self) -> str:
        """Input that is still needed before the law can stand in a port; empty if none."""
        return ""

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Tell whether the fitted values hardly agree with the law's sentence."""
        return False

    def starts_as(self, plain: Law, own: Mapping[str, Any]) -> dict[str, Any]:
        """Start values at which it equals a plainer law fitted to `own`; empty where it does not refine that law."""
        more = [name for name in self.units if name not in plain.units]
        refines = plain.strength and plain.units.items() <= self.units.items() and set(more) <= set(self.strength)
        return {**dict.fromkeys(more, 0.0), **own} if more and refines else {}

    def size(self, values: Mapping[str, Any]) -> int:
        """Number of free numbers of the law at fitted values."""
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
        """States or memory after the signal has stood still at z."""
        out = np.zeros(int(getattr(self, "memory", 0)) if hasattr(self, "step") else self.order)
        out[: len(out) if self.shifts else self.follows] = z
        return out

    def on_grid(self, h: float) -> Law:
        """Copy for steps of length h, s; only a delay depends on them."""
        return self

    def at(self, values: Mapping[str, Any], limits: Mapping[str, tuple[Any, Any]] | None = None) -> Law:
        """Copy that starts at `values` inside `limits`."""
        return replace(self, values={**self.values, **values}, limits={**self.limits, **(limits or {})})

    def parameters(self) -> dict[str, Parameter]:
        """Parameters with start values, limits and units (in w, z, s)."""
        return dict(self._parameters)

    @cached_property
    def _parameters(self) -> dict[str, Parameter]:
        out = {}
        for name, unit in self.units.items():
            value = np.asarray(self.values.get(name, 0.0 if name in self.strength else 1.0), dtype=float)
            low, high = (np.asarray(end, dtype=float) for end in self.limits.get(name, (-np.inf, np.inf)))
            value = np.clip(value, low, high)
            scalar = value.ndim == low.ndim == high.ndim == 0  # with limits that `__post_init__` has checked
            make = Parameter.trusted if scalar else _checked_parameter
            out[name] = make(value, unit, low, high)
        return out


def _checked_parameter(value: Any, unit: str, lower: Any, upper: Any) -> Parameter:
    return Parameter(value, unit=unit, bounds=(lower, upper))


def _are_numbers(given: Any, count: int) -> bool:
    """Tell whether `count` numbers or arrays are given: one finite, or two that increase."""
    try:
        found = [np.asarray(part, dtype=float) for part in given]
        return len(found) == count and bool(np.all(found[0] <= found[1]) if count == 2 else np.all(np.isfinite(found)))
    except (TypeError, ValueError):
        return False


def _multiply(local: Local, scale: str, factor: Any) -> Any:
    return getattr(local, scale) * factor if scale else factor


def readable_unit(unit: str, w: str, z: str) -> str:
    """Put the port's own units into a unit in w, z and s: ("w/z^3", "N", "m") -> "N/m^3"."""
    if unit == "w/z" and w == z:
        return ""
    parts = []
    for token in unit.replace("*", " * ").replace("/", " / ").split():
        base, _, power = token.partition("^")
        known = {"w": w or "[w]", "z": z or "[z]"}.get(base, base)
        parts.append(f"({known})^{power}" if power and " " in known else known + (f"^{power}" if power else ""))
    return "".join(f" {p} " if p == "*" else p for p in parts).strip()


def beyond(z: Any, g: Any) -> Any:
    """Rise from 0 to 1 where |z| passes a gap g, over a share of the gap, because a jump would have no slope in g."""
    return (1 + ca.tanh((ca.fabs(z) - g) / (EDGE * g))) / 2


def grid(**axes: Any) -> Iterator[dict[str, Any]]:
    """Generate every combination of the axes' values."""
    for values in itertools.product(*axes.values()):
        yield {k: float(v) for k, v in zip(axes, values, strict=True)}
