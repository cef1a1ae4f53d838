"""The PI-LFR model class, its special cases with fixed blocks, and the place of the element in it.

    x⁺ = A x + B_u u + B_w w,   y = C_y x + D_yu u + D_yw w + y_0,   z = C_z x + D_zu u,   w = element(z)

Krikelis et al. (2024), Eq. 15-17, with `n_z = n_w` channels, and a constant `y_0` for sensors that do not read zero
at rest. Without an element this is a linear state-space model. A Hammerstein model (`hammerstein`) fixes `B_u = 0` and
`D_zu = I`, a Wiener model (`wiener`) fixes `C_y = 0` and `D_yw = I`. The functions at the end of this file recognise
such structures, because their start values need no direction of z.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .._base import InputError, filled, whole
from ..data import Recording
from .elements import Element, is_element
from .model import Model, close_loop, open_model
from .parameters import Parameter, ParameterSet, check_size

BLOCKS = ("A", "B_u", "B_w", "C_y", "D_yu", "D_yw", "C_z", "D_zu", "y_0")


def block_shapes(nx: int, n_u: Any, n_y: Any, n_w: int) -> dict[str, tuple[Any, ...]]:
    """Return the shapes of the linear blocks; unknown n_u and n_y may be strings, which appear in the shapes."""
    return {
        "A": (nx, nx),
        "B_u": (nx, n_u),
        "B_w": (nx, n_w),
        "C_y": (n_y, nx),
        "D_yu": (n_y, n_u),
        "D_yw": (n_y, n_w),
        "C_z": (n_w, nx),
        "D_zu": (n_w, n_u),
        "y_0": (n_y,),
    }


@dataclass(frozen=True)
class PILFR:
    """A PI-LFR model structure, whose numbers of inputs and outputs come from data.

    Parameters
    ----------
    nx : int
        States of the linear part.
    element : Element or None
        The element in the loop, usually `PrandtlIshlinskii`; None for a linear model.
    fixed : mapping
        Blocks fixed at a value, for example `{"D_yu": 0.0}`. A number fills the block; an array has its shape, and its
        nan entries stay free: `{"A": [[0.9, nan], [0.0, nan]]}`. For `B_w` and `D_yw` a row of zeros and nan, one for
        each channel of the element, selects the channels that enter.
    bounds : mapping
        `(lower, upper)` by parameter name, for example `{"w": (0, 2)}`, in addition to the element's own, such as
        `w ≥ 0` and `r ≥ 0`.
    priors : mapping
        `(mean, std)` by parameter name: a quadratic prior, see `Parameter`.
    offset : bool
        Estimate the constant `y_0`.

    Raises
    ------
    InputError
        If nx is not a whole number of 0 or more, the element is not an element, a fixed, bounded or prior parameter is
        unknown, a bound or prior is not a pair, a value is neither a number nor an array of the parameter's shape, or
        it lies outside the element's own bounds.

    Examples
    --------
    >>> from pilfr_casadi import Play, PrandtlIshlinskii
    >>> structure = PILFR(nx=5, element=PrandtlIshlinskii(Play, 20), fixed={"D_yu": 0.0})
    >>> structure.count(n_u=1, n_y=1)
    88
    """

    nx: int
    element: Element | None = None
    fixed: Mapping[str, Any] = field(default_factory=dict)
    bounds: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)
    priors: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)
    offset: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "nx", whole(self.nx, "The number of states", 0))
        check_size(f"A model with nx = {self.nx}", self.nx**2)
        _check_element(self.element)
        for option in ("fixed", "bounds", "priors"):
            given = getattr(self, option)
            if not isinstance(given, Mapping):
                raise InputError(f"{option} = {given!r} was given; give values by parameter name, a mapping.")
        elements = self.element.parameters() if self.element else {}
        known = (*BLOCKS, *elements)
        for name in (*self.fixed, *self.bounds, *self.priors):
            if name not in known:
                raise InputError(f"There is no parameter {name!r} to fix or bound; there are {', '.join(known)}.")
        for name, pair in self.bounds.items():
            _check_pair(f"bounds of {name!r}", pair, "(lower, upper), with -numpy.inf or numpy.inf for none")
        for name, pair in self.priors.items():
            _check_pair(f"prior of {name!r}", pair, "(mean, std)")
        shapes = {**block_shapes(self.nx, "n_u", "n_y", self.n_w), **{k: p.value.shape for k, p in elements.items()}}
        for name, shape in shapes.items():
            given = self._given(name, shape)
            if name in elements:
                _check_within(name, elements[name], given)

    @property
    def n_w(self) -> int:
        """Channels of the element."""
        return 0 if self.element is None else self.element.channels

    def _given(self, name: str, shape: tuple[Any, ...]) -> dict[str, Any]:
        """Collect the options `fixed`, `bounds` and `prior` of a parameter, filled to its shape."""
        out: dict[str, Any] = {}
        if name in self.fixed:
            value = self.fixed[name]
            if name in ("B_w", "D_yw") and _selects_channels(value, self.n_w):
                value = np.tile(value, (shape[0], 1)) if isinstance(shape[0], int) else np.nan
            out["fixed"] = filled(value, f"The fixed value of {name!r}", shape, nan=True)
        if name in self.bounds:
            low, high = self.bounds[name]
            ends = ((low, "lower"), (high, "upper"))
            out["bounds"] = tuple(filled(v, f"The {end} bound of {name!r}", shape, infinite=True) for v, end in ends)
        if name in self.priors:
            mean, std = self.priors[name]
            filled(mean, f"The mean of the prior of {name!r}", shape)
            filled(std, f"The standard deviation of the prior of {name!r}", shape, infinite=True)
            out["prior"] = self.priors[name]
        return out

    def model(
        self,
        n_u: int,
        n_y: int,
        values: Mapping[str, Any] | None = None,
        *,
        inputs: tuple[str, ...] = (),
        outputs: tuple[str, ...] = (),
    ) -> Model:
        """Build the closed model for n_u inputs and n_y outputs; blocks start at `values`, or at zero."""
        values = dict(values or {})
        self._check_channels(n_u, n_y)
        shapes = block_shapes(self.nx, n_u, n_y, self.n_w)
        blocks = ParameterSet({name: Parameter(np.zeros(shape)) for name, shape in shapes.items()})
        model = open_model(_step, _port, blocks, n_x=self.nx, n_u=n_u, n_w=self.n_w, inputs=inputs, outputs=outputs)
        if self.element is not None:
            model = close_loop(model, self.element)
        changes = {name: self._fields(name, p, values) for name, p in model.parameters.items()}
        return model.with_parameters(model.parameters.change(**changes))

    def model_for(self, signals: Recording | Model, values: Mapping[str, Any] | None = None) -> Model:
        """Build the closed model for the inputs and outputs of a recording or of another model, with their names."""
        return self.model(signals.n_u, signals.n_y, values, inputs=signals.inputs, outputs=signals.outputs)

    def _fields(self, name: str, p: Parameter, values: Mapping[str, Any]) -> dict[str, Any]:
        """Make the fields of a parameter from the structure's options and the start values."""
        shape = p.value.shape
        options = self._given(name, shape)
        lower, upper = options.get("bounds", p.bounds)
        low, high = np.maximum(lower, p.bounds[0]), np.minimum(upper, p.bounds[1])
        given = values.get(name, p.value) if p.value.size else p.value  # a larger structure has more blocks
        start = np.clip(filled(given, f"The value of {name!r}", shape), low, high)
        fields: dict[str, Any] = {"value": start, "bounds": (low, high)}
        if name == "y_0" and not self.offset:
            options.setdefault("fixed", np.zeros(shape))
        if "fixed" in options:
            free = np.isnan(options["fixed"])
            fields |= {"value": np.where(free, start, options["fixed"]), "fixed": ~free}
        if "prior" in options:
            fields["prior"] = options["prior"]
        return fields

    def _check_channels(self, n_u: int, n_y: int) -> None:
        for name, count, signal in (("D_zu", n_u, "input"), ("D_yw", n_y, "output")):
            square = np.shape(self.fixed.get(name, 0.0)) == (self.n_w, self.n_w)
            if self.n_w and square and _is_identity(self, name) and count != self.n_w:
                raise InputError(
                    f"{name} is fixed to the identity (as in a Hammerstein or Wiener model) with {self.n_w} channel(s) "
                    f"of the element, but there are {count} {signal}(s); give channels={count} to the element."
                )

    def count(self, n_u: int, n_y: int) -> int:
        """Count the free parameters of the model for n_u inputs and n_y outputs."""
        return int(self.model(n_u, n_y).parameters.free.sum())

    def linear(self) -> PILFR:
        """Make the linear structure of the same order, everything free."""
        return PILFR(self.nx, offset=self.offset)


def _check_element(element: Any) -> None:
    if element is None or is_element(element):
        return
    given = f"{element.__name__}, a class" if isinstance(element, type) else repr(element)
    raise InputError(
        f"The element is {given}; give an element, such as PrandtlIshlinskii(Play, 20), or None for a linear model."
    )


def _check_pair(name: str, given: Any, wanted: str) -> None:
    try:
        first, second = (np.asarray(part, dtype=float) for part in given)
    except (TypeError, ValueError):
        first = second = np.asarray(np.nan)
    if np.any(np.isnan(first)) or np.any(np.isnan(second)):
        raise InputError(f"{given!r} was given as {name}; give a pair of numbers {wanted}.")


def _check_within(name: str, own: Parameter, options: dict[str, Any]) -> None:
    """Refuse bounds and fixed values outside the bounds of the element, such as weights below zero."""
    low, high = own.bounds
    bounds = [(f"A bound of {name!r}", value) for value in options.get("bounds", ())]
    for option, value in (*bounds, (f"The fixed value of {name!r}", options.get("fixed", np.nan))):
        beyond = np.isfinite(value) & ((value < low) | (value > high))
        if np.any(beyond):
            most = f" and at most {np.max(high):g}" if np.all(np.isfinite(high)) else ""
            raise InputError(
                f"{option} is {float(np.broadcast_to(value, beyond.shape)[beyond][0]):g}, but the element's {name} is "
                f"at least {np.min(low):g}{most}; give a number within, or as a bound numpy.inf for none of your own."
            )


def _selects_channels(value: Any, n: int) -> bool:
    """Tell whether a value is a row of n zeros and nan."""
    return isinstance(value, np.ndarray) and value.shape == (n,) and bool(np.all(np.isnan(value) | (value == 0)))


def _step(x: Any, u: Any, w: Any, p: dict[str, Any]) -> tuple[Any, Any]:
    x_next = p["A"] @ x + p["B_u"] @ u + p["B_w"] @ w
    return x_next, p["C_y"] @ x + p["D_yu"] @ u + p["D_yw"] @ w + p["y_0"]


def _port(x: Any, u: Any, p: dict[str, Any]) -> Any:
    return p["C_z"] @ x + p["D_zu"] @ u


def with_port_gain(p: Mapping[str, Any], gain: Any) -> tuple[Any, Any, Any, Any]:
    """Close a gain `w = gain z`, (n_w, n_w), into the port of a PI-LFR: A, B, C, D of arrays or CasADi matrices."""
    return (
        p["A"] + p["B_w"] @ gain @ p["C_z"],
        p["B_u"] + p["B_w"] @ gain @ p["D_zu"],
        p["C_y"] + p["D_yw"] @ gain @ p["C_z"],
        p["D_yu"] + p["D_yw"] @ gain @ p["D_zu"],
    )


def hammerstein(nx: int, element: Element, offset: bool = True) -> PILFR:
    """Make a PI-Hammerstein structure: the input passes the element first, so `z = u`.

    The input reaches the dynamics only through w. The element has one channel for each input.
    """
    _check_element(element)
    eye = np.eye(element.channels)
    return PILFR(nx, element, {"C_z": 0.0, "D_zu": eye, "B_u": 0.0, "D_yu": 0.0}, offset=offset)


def wiener(nx: int, element: Element, offset: bool = True) -> PILFR:
    """Make a PI-Wiener structure: the output is the signal of the linear dynamics after the element, `y = w`.

    The element has one channel for each output.
    """
    _check_element(element)
    eye = np.eye(element.channels)
    return PILFR(nx, element, {"B_w": 0.0, "C_y": 0.0, "D_yu": 0.0, "D_yw": eye}, offset=offset)


def is_zero(structure: PILFR, name: str) -> bool:
    """Tell whether a block is fixed at zero."""
    return name in structure.fixed and not np.any(structure.fixed[name])


def _is_identity(structure: PILFR, name: str) -> bool:
    """Tell whether a block between channels is fixed at the identity."""
    given, eye = structure.fixed.get(name, np.nan), np.eye(structure.n_w)
    return np.shape(given) in ((), eye.shape) and np.array_equal(np.broadcast_to(given, eye.shape), eye)


def fixed_blocks(structure: PILFR) -> list[str]:
    """List the blocks that are fixed entirely."""
    return [k for k, v in structure.fixed.items() if not np.any(np.isnan(np.asarray(v, dtype=float)))]


def is_wiener(structure: PILFR) -> bool:
    """Tell whether the output is read through the element alone (Wiener)."""
    return is_zero(structure, "C_y") and _is_identity(structure, "D_yw")


def is_hammerstein(structure: PILFR) -> bool:
    """Tell whether the input reaches the dynamics through the element alone (Hammerstein)."""
    return is_zero(structure, "B_u") and _is_identity(structure, "D_zu")


def direction_fixed(structure: PILFR) -> bool:
    """Tell whether z has no free direction: `C_z` and `D_zu` are fixed, or z is the linear output (Wiener)."""
    return {"C_z", "D_zu"} <= set(fixed_blocks(structure)) or is_wiener(structure)


def places(structure: PILFR) -> tuple[str, ...]:
    """Name the element's places in the first starts: output, then input; output alone if z's direction is fixed."""
    return ("output",) if direction_fixed(structure) else ("output", "input")
