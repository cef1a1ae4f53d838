"""The base class of all laws: one small class for each physical hypothesis.

A law is a force `w = Σ_i c_i φ_i(z, ż, q, t; shape)`, linear in its *strengths* c and nonlinear in its *shape*
parameters (threshold, gap, knee, delay). Here z is the local coordinate at the port, ż its rate, and w the force. A law
may have states q of its own, with `q̇ = flow(...)`, or a discrete memory s, with `step(z, s, p)` in place of `force`. In
series, at an actuator or a sensor, w is the deviation of the signal: `w = law(u) - u`.

To add a law, state its equation, its sentence and the units of its parameters, and write `force`. Parameters whose unit
begins with w are strengths; all others are shape parameters. For each shape parameter, `starts` gives the start values
and `ranges` the bounds, as multiples of an attribute of `Local` or as a function of it:

>>> class RubberBlock(Law):
...     id, equation = "rubber_block", "w = k L tan(z / L)"
...     sentence = "a rubber block: its stiffness grows without limit as the deflection comes near L"
...     units = {"k": "w/z", "L": "z"}
...     starts = {"L": ("reach", 0.7, 1.0, 2.0)}  # 0.7, 1 and 2 times the largest |z|
...     ranges = {"L": ("reach", 0.65, 10.0)}
...
...     def force(self, z, p):
...         return p.k * p.L * ca.tan(z / p.L)
>>> signals = Local(z=np.linspace(-2.0, 2.0, 5), dz=np.ones(5), dt=0.1, lengths=(5,))
>>> [round(shape["L"], 2) for shape in RubberBlock().shapes(signals)]
[1.4, 2.0, 3.99]

`diagnose(simulator, recordings, laws=(*CATALOGUE, RubberBlock))` tries it beside the others. A class written into one
of the files that `catalogue` lists (`stiffness`, `friction`, ...) is in the catalogue without further steps.
"""

from __future__ import annotations

import inspect
import itertools
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import casadi as ca
import numpy as np

from .._base import InputError
from ..data import insert_units
from ..models import Parameter

ONSET_WIDTH = 0.05  # of a contact, as a share of its gap

# share of the reach that a signal must visit on either side, to tell the sides apart; and of half the range that it
# must go back, so that its turning points show
MIN_SIDE = 0.05

PEOPLE = ("coulomb", "stribeck", "hertz")  # persons in the names of laws and forms
PROPER_NAMES = {
    "bouc_wen": "Bouc-Wen",
    "bouc_wen_stiffening": "stiffening Bouc-Wen",
    "prandtl_ishlinskii": "Prandtl-Ishlinskii",
}


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
    max_stiffness : float
        Largest stiffness (w/z) at the port that the simulation's steps resolve; a harder contact is a wall.
    max_damping : float
        Largest damping (w*s/z) at the port that the simulation's steps resolve.
    inputs : mapping of str to array, shape (M,)
        The simulator's inputs, for laws whose strength is scaled by one of them.
    from_zero : tuple of bool
        Whether each recording begins with everything at zero; else a law begins as if z had stood still before.
    readers : tuple of str
        Outputs that read z or its rate, if these are states.
    revolution : float
        One revolution in the unit of z, if that is the unit of an angle; else nan.
    term : callable, optional
        Force (M,) that the equations have at the port already, from another z and dz (M,); see `Port`.
    """

    z: np.ndarray
    dz: np.ndarray
    dt: float
    lengths: tuple[int, ...]
    max_stiffness: float = np.inf
    max_damping: float = np.inf
    inputs: Mapping[str, np.ndarray] = field(default_factory=dict)
    from_zero: tuple[bool, ...] = ()
    readers: tuple[str, ...] = ()
    revolution: float = np.nan
    term: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None

    # old spellings, which laws of users may name in `starts` and `ranges`
    stiffest = property(lambda self: self.max_stiffness)
    firmest = property(lambda self: self.max_damping)

    @cached_property
    def given(self) -> np.ndarray:
        """Force (M,) of the term along the signals; zero if there is none."""
        return np.zeros(len(self.z)) if self.term is None else self.term(self.z, self.dz)

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
    def middle(self) -> float:
        """Middle of the range of z."""
        return (self.low + self.high) / 2

    @property
    def half(self) -> float:
        """Half the range of z."""
        return max((self.high - self.low) / 2, 1e-300)

    @cached_property
    def speed(self) -> float:
        """Largest |ż|, without the outermost 1 %."""
        return max(float(np.quantile(np.abs(self.dz), 0.99)), 1e-300)

    @cached_property
    def is_speed(self) -> bool:
        """Whether z is itself the speed, at a port without a position."""
        return np.array_equal(self.z, self.dz)

    @cached_property
    def one_way(self) -> bool:
        """Whether z hardly turns round, so that any force with a memory of turning points is a curve of z."""
        steps = np.diff(self.z)
        return bool(min(steps[steps > 0].sum(), -steps[steps < 0].sum()) <= MIN_SIDE * self.half)

    @property
    def duration(self) -> float:
        """Length of the longest recording, s."""
        return max(self.lengths) * self.dt


def size_to_power(z: Any, n: Any, least: float = 1e-12) -> Any:
    """Compute (|z| + least)^n as exp(n log(|z| + least)), whose derivatives need no further power."""
    return ca.exp(n * ca.log(ca.fabs(z) + least))


def signed_power(z: Any, n: Any) -> Any:
    """Compute sign(z) |z|^n."""
    return ca.sign(z) * size_to_power(z, n)


# an attribute of `Local` ("" for none) and its multiples, or the values as a function of it
Grid = tuple[Any, ...] | Callable[[Local], Any]


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
        Parameters in which the force is linear; left out, those whose unit begins with w.
    starts, ranges : mapping
        Start values and (lower, upper) bounds of parameters: an attribute of `Local` ("reach", "half", "low", "high",
        "speed", "dt", "duration", "max_stiffness", or "" for plain numbers) and its multiples, or a function of
        `Local`. Every combination of start values is tried.
    defaults : mapping
        Values of parameters before any are given; otherwise strengths are zero and shapes one.
    as_base : mapping
        Values, or functions of the base class' values by name, at which the law equals its base class; parameters of
        the same name have the same value. Fits start there once the base class is named. Left out if the law is its
        base class where its own strengths are zero.
    constants : tuple of str
        Shape parameters that no fit changes, such as the revolution of an angle.
    places : tuple of {"parallel", "series", "sensor", "parameter"}
        Allowed places: inside the dynamics, at an actuator or a sensor, at a sensor only, or at a parameter.
    domains : tuple of {"mechanical", "thermal", "electrical", "fluid"}
        Physical domains in which it occurs; left out, all of them.
    rare : tuple of domain or "sensor"
        Physical domains in which it hardly occurs, or that it hardly occurs at sensors; there it is less likely before
        the data are seen.
    absent : tuple of domain
        Physical domains in which it cannot occur; there it is not tried.
    sentences : mapping
        Description of the law in a physical domain, if `sentence` does not say it there.
    special : bool
        It is tried only at ports of its domains, and not where the domain is unknown.
    across : str
        Unit that the local coordinate of a special law can be converted to, such as "V"; left out, any.
    angular : bool
        It is tried only where the local coordinate has the unit of an angle.
    dissipative, restoring : bool
        The force always opposes the motion, or always pushes back towards z = 0. This fixes the sign of all strengths
        except those in `signed`.
    flexible : bool
        The law can imitate many others, and is less likely before the data are seen.
    signed : tuple of str
        Strengths of a dissipative or restoring law that may have either sign.
    two_sided : bool
        The data carries information on the law only if z is both above and below zero.
    order, follows : int
        `order` is the number of its own states. If the signal stands still, the first `follows` of its states or its
        memory are at the signal's value, the others at zero, as for plays after the signal has moved there from zero.
    memory, shifts : int, bool
        `memory` is the length of its discrete memory. `shifts` says that the memory is a shift register, which reads
        the signal at the beginning of a step.
    turns : bool
        The force depends on where the motion last turned round; a motion that never does leaves a curve of z.
    in_line : bool
        The law stands in line with the port's `term`, which `force` and `flow` may call: `term(z, dz)`. That value has
        the name `given`.
    implied : {"", "drive", "balance"}
        Kind of term that the law may stand in line with if the user names none and the simulator finds one in its
        equations: the force of a drive, or all that changes a state. Empty if the user has to name the term.
    sensed : bool
        Outputs that read the port's coordinate or its rate read `far_side(q, p)` instead. The law is tried only where
        the coordinate is a state that outputs read.
    seen_by : str
        The one output that reads the far side; empty for all outputs that read the coordinate. See `seen_by`.
    substeps : int
        Smallest number of integration steps per sample.
    knee : str
        Name of the speed within which the force changes its sign; integration steps have to be fine there.
    scaled_by, scheduled_by : str
        Input that multiplies the force, or signal with which the strengths vary, if any; see `scaled`, `scheduled`.
    profile : str
        How they vary.
    carried_by : str
        Input whose flow carries the signal along, if any; see `carried`.
    of_input : bool
        It is the effect of an input alone, whose name `scaled` and `scheduled` put into its texts in place of "{by}".
    listed : bool
        An answer lists it by its name with its values; offsets and learned forces are described apart.
    signal : str
        State or input that is the local coordinate of a law at a parameter, if any.

    Parameters
    ----------
    values : mapping, optional
        Start values by parameter name.
    limits : mapping, optional
        `(lower, upper)` by parameter name.

    Raises
    ------
    InputError
        If a value or limit is not a number, or names a parameter that the law does not have; if a value is outside of
        its limits, or `low` is above `high`.
    """

    id: ClassVar[str]
    equation: ClassVar[str]
    source: ClassVar[str] = ""
    sentence: ClassVar[str] = ""
    form: ClassVar[str] = ""
    units: ClassVar[Mapping[str, str]] = {}
    strength: ClassVar[tuple[str, ...]] = ()
    starts: ClassVar[Mapping[str, Grid]] = {}
    ranges: ClassVar[Mapping[str, Grid]] = {}
    defaults: ClassVar[Mapping[str, Any]] = {}
    as_base: ClassVar[Mapping[str, Any]] = {}
    constants: ClassVar[tuple[str, ...]] = ()
    places: ClassVar[tuple[str, ...]] = ("parallel",)
    domains: ClassVar[tuple[str, ...]] = ()
    rare: ClassVar[tuple[str, ...]] = ()
    absent: ClassVar[tuple[str, ...]] = ()
    sentences: ClassVar[Mapping[str, str]] = {}
    special: ClassVar[bool] = False
    across: ClassVar[str] = ""
    angular: ClassVar[bool] = False
    dissipative: ClassVar[bool] = False
    restoring: ClassVar[bool] = False
    two_sided: ClassVar[bool] = False
    flexible: ClassVar[bool] = False
    signed: ClassVar[tuple[str, ...]] = ()
    order: ClassVar[int] = 0
    follows: ClassVar[int] = 0
    memory: ClassVar[Any] = 0
    shifts: ClassVar[bool] = False
    turns: ClassVar[bool] = False
    in_line: ClassVar[bool] = False
    implied: ClassVar[str] = ""
    sensed: ClassVar[bool] = False
    seen_by: ClassVar[str] = ""
    substeps: ClassVar[int] = 1
    knee: ClassVar[str] = ""
    scaled_by: ClassVar[str] = ""
    scheduled_by: ClassVar[str] = ""
    profile: ClassVar[str] = ""
    carried_by: ClassVar[str] = ""
    of_input: ClassVar[bool] = False
    listed: ClassVar[bool] = True
    signal: ClassVar[str] = ""

    values: Mapping[str, Any] = field(default_factory=dict)
    limits: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)

    def __init_subclass__(cls) -> None:
        own = vars(cls)
        if "applies" in own and "why_not" not in own:  # the old name of the method
            cls.why_not = own["applies"]  # type: ignore[method-assign]
        if own.get("driven") and "implied" not in own:  # an old spelling
            cls.implied = "drive"
        if "units" in own and "strength" not in own:
            cls.strength = tuple(name for name, unit in cls.units.items() if re.match(r"w\b", unit))

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
        for name, (low, high) in self.limits.items():
            value = np.asarray(self.values.get(name, low), dtype=float)
            if np.any(value < low) or np.any(value > high):
                raise InputError(
                    f"The law {self.id!r} has {name} = {value}, outside of its limits {low} to {high}; widen them."
                )
        if {"low", "high"} <= self.values.keys() and np.any(self.values["low"] > self.values["high"]):
            low, high = self.values["low"], self.values["high"]
            raise InputError(f"The law {self.id!r} has low = {low} above high = {high}; give them in order.")

    def force(self, *args: Any, **kwargs: Any) -> Any:
        """Force w from any of z, dz, q, t, x, u, p by name."""
        raise NotImplementedError(f"{type(self).__name__} needs a force")

    def shapes(self, local: Local) -> Iterator[dict[str, Any]]:
        """Generate the values of the shape parameters to try: every combination of `starts`."""
        for values in itertools.product(*(_evaluate(entry, local) for entry in self.starts.values())):
            yield {name: float(value) for name, value in zip(self.starts, values, strict=True)}

    def bounds(self, local: Local) -> dict[str, tuple[Any, Any]]:
        """Bounds of the parameters on which the data carries information: `ranges`."""
        found = {name: _evaluate(entry, local) for name, entry in self.ranges.items()}
        return {name: (low, high) for name, (low, high) in found.items()}

    def why_not(self, local: Local) -> str:
        """Say why the data carries no information on this law; empty if it does."""
        if self.sensed and not local.readers:
            return "no output reads the coordinate"
        if self.turns and local.one_way:
            return "the signal hardly turns round"
        if self.seen_by and (self.seen_by not in local.readers or len(local.readers) == 1):
            return f"{self.seen_by} does not read the coordinate, or does so alone"
        hidden = self.two_sided and min(-local.low, local.high) <= MIN_SIDE * local.reach
        return "one side of zero is hardly visited" if hidden else ""

    @property
    def lacks(self) -> str:
        """Say which value is missing before the law can stand in a port; empty if none is."""
        return ""

    def remark(self, values: Mapping[str, Any]) -> str:
        """Say how the law at its fitted values differs from its sentence; empty if it does not."""
        return ""

    def doubtful(self, values: Mapping[str, Any]) -> bool:
        """Tell whether the law degenerates at its fitted values, so that its sentence is hardly true."""
        return False

    @classmethod
    def finer_starts(cls, found: Law, local: Local) -> Iterator[dict[str, Any]]:
        """Start values of this form, by name and unit, for a law found in another form; strengths that vary have means.

        A form that contains the found law, or its base class, begins where it equals that.
        """
        own = {name: value for name, value in found.values.items() if cls.units.get(name) == found.units[name]}
        for name in own:
            ends = [found.values[f"{name}{end}"] for end in ("", "_mid", "_high") if f"{name}{end}" in found.values]
            own[name] = np.mean(ends, axis=0)
        based = cls.as_base if cls.extends(type(found)) else {}
        yield own | {name: value(found.values) if callable(value) else value for name, value in based.items()}
        shape = next(cls().shapes(local)) if based else {}
        if shape.keys() - own.keys():  # its further shape may be far from that of the base
            yield shape | own

    @classmethod
    def extends(cls, found: type[Law]) -> bool:
        """Tell whether this form contains another one, or the base class that both contain; see `as_base`."""
        if "as_base" not in vars(cls) or cls is found:
            return False
        base: Any = found.__base__
        both = "as_base" in vars(found) and base.units.items() <= found.units.items()
        return cls.__base__ is found or (both and cls.__base__ is base)

    @property
    def free(self) -> set[str]:
        """Names of the parameters that a fit may change."""
        return {name for name, p in self.parameters().items() if not np.all(p.fixed)}

    def size(self, values: Mapping[str, Any]) -> int:
        """Number of free numbers of the law at fitted values."""
        return sum(int(np.sum(~p.fixed)) for p in self.parameters().values())

    def first_unknowns(self, values: Mapping[str, Any], dt: float) -> int:
        """Number of unknowns with which the law begins in a recording of unknown beginning, sampled every dt s."""
        return self.order + int(self.memory)

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
        out = np.zeros(self.memory or self.order)
        out[: len(out) if self.shifts else self.follows] = z
        return out

    def schedule(self, local: Local) -> np.ndarray:
        """Signal (M,) with which the strengths vary."""
        return local.inputs[self.scheduled_by]

    def on_grid(self, h: float) -> Law:
        """Copy for steps of length h, s; only a delay depends on them."""
        return self

    def at(self, values: Mapping[str, Any], limits: Mapping[str, tuple[Any, Any]] | None = None) -> Self:
        """Copy that starts at `values`, clipped to `limits`."""
        own, ends = {**self.values, **values}, {**self.limits, **(limits or {})}
        try:
            clipped = {name: np.clip(value, *ends[name]) if name in ends else value for name, value in own.items()}
        except (TypeError, ValueError):  # they are no numbers, which the check of a law says
            clipped = own
        return replace(self, values=clipped, limits=ends)

    def parameters(self) -> dict[str, Parameter]:
        """Parameters with start values, limits and units (in w, z, s)."""
        return dict(self._parameters)

    @cached_property
    def _parameters(self) -> dict[str, Parameter]:
        start = {**dict.fromkeys(self.units, 1.0), **dict.fromkeys(self.strength, 0.0), **self.defaults, **self.values}
        out = {}
        for name, unit in self.units.items():
            low, high = (np.asarray(end, dtype=float) for end in self.limits.get(name, (-np.inf, np.inf)))
            value = np.clip(np.asarray(start[name], dtype=float), low, high)
            fixed = name in self.constants
            if value.ndim == low.ndim == high.ndim == 0 and not fixed:  # numbers that `__post_init__` has checked
                out[name] = Parameter.trusted(value, unit, low, high)
            else:
                out[name] = Parameter(value, unit=unit, bounds=(low, high), fixed=fixed)
        return out


def _are_numbers(given: Any, count: int) -> bool:
    """Tell whether `count` numbers or arrays are given: one finite, or two that increase."""
    try:
        found = [np.asarray(part, dtype=float) for part in given]
        return len(found) == count and bool(np.all(found[0] <= found[1]) if count == 2 else np.all(np.isfinite(found)))
    except (TypeError, ValueError):
        return False


def _evaluate(entry: Grid, local: Local) -> Any:
    """Values of an entry of `starts` or `ranges`."""
    if callable(entry):
        return entry(local)
    attribute, *multiples = entry
    return [getattr(local, attribute) * multiple if attribute else multiple for multiple in multiples]


GENERAL = ("static_curve", "extra_mode", "viscous_damping")  # ids of laws that are named by their form


def display_name(law: str, form: str = "") -> str:
    """Write the id of a law, and its form, as words: "coulomb_friction" -> "Coulomb friction".

    A form that says no more than the id is left out.
    """
    if law == "extra_mode" and form:  # its forms say what it is: a lag, a resonance, an elastic joint
        law, _, form = form.partition(", ")
    form = "" if form in law.split("_") else form
    text = PROPER_NAMES.get(law, law.replace("_", " "))
    text = text.capitalize() if text.split(" ")[0] in PEOPLE else text
    return f"{text} ({', '.join(map(display_name, form.split(', ')))})" if form else text


def short_name(law: str, form: str = "") -> str:
    """Write the id of a law as words, with its form if the id says little, or the signal that varies its strength."""
    shown = [part for part in form.split(", ") if law in GENERAL or part.startswith(("scheduled", "scaled"))]
    return display_name(law, ", ".join(shown))


def readable_unit(unit: str, w: str, z: str, signals: Mapping[str, str] | None = None) -> str:
    """Insert the port's units into a unit in w, z and s: ("w/z^3", "N", "m") -> "N/m^3".

    `signals` has the units of signals by name, for units such as "[temperature]".
    """
    named = {f"[{name}]": own for name, own in (signals or {}).items() if own}
    return insert_units(unit, {"w": w or "[w]", "z": z or "[z]", **named})


def contact_onset(z: Any, g: Any) -> Any:
    """Rise from 0 to 1 as |z| passes a gap g; smooth, because a jump would have no derivative by g."""
    return (1 + ca.tanh((ca.fabs(z) - g) / (ONSET_WIDTH * g))) / 2


def beyond_gap(z: Any, dz: Any, g: Any) -> tuple[Any, Any]:
    """Travel beyond a gap g on both sides, and its rate."""
    return z - ca.fmin(ca.fmax(z, -g), g), contact_onset(z, g) * dz


def continue_along_tangents(
    x: Any, low: float, high: float, values_and_slopes: Callable[[Any], tuple[list[Any], list[Any]]]
) -> list[Any]:
    """Evaluate functions at x; below `low` and above `high` they go on along their tangents at these ends.

    `values_and_slopes` evaluates them inside the range; the slopes matter at its ends alone.
    """
    number = isinstance(x, (float, np.ndarray))
    inside = np.clip(x, low, high) if number else ca.fmin(ca.fmax(x, low), high)
    values, slopes = values_and_slopes(inside)
    return [value + (x - inside) * slope for value, slope in zip(values, slopes, strict=True)]


def check_signal(by: Any) -> None:
    """Raise an `InputError` unless the name of a signal is given."""
    if not (isinstance(by, str) and by):
        raise InputError(f"by = {by!r} was given; give the name of a signal.")


def rename_class(law: Any, name: str, doc: str) -> Any:
    """Give a class that was made at run time its own name and docstring."""
    law.__name__ = law.__qualname__ = name
    law.__doc__ = doc
    return law
