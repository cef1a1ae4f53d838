"""The PI-LFR model class and what is the same with some blocks fixed.

    x⁺ = A x + B_u u + B_w w,   y = C_y x + D_yu u + D_yw w + y_0,   z = C_z x + D_zu u,   w = element(z)

Krikelis et al. (2024), Eq. 15-17, with `n_z = n_w` channels, and a constant `y_0` for sensors that do not read zero
at rest. Without an element this is a linear state-space model; `hammerstein` and `wiener` fix blocks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .._base import InputError, filled
from .elements import Element
from .model import Model, close_loop, open_model
from .parameters import Parameter, ParameterSet

BLOCKS = ("A", "B_u", "B_w", "C_y", "D_yu", "D_yw", "C_z", "D_zu", "y_0")


def block_shapes(nx: int, n_u: Any, n_y: Any, n_w: int) -> dict[str, tuple[Any, ...]]:
    """Shapes of the linear blocks; names in place of n_u and n_y, where these are not known, stay names."""
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
    """A PI-LFR model structure: what to identify, before data says how many inputs and outputs there are.

    Parameters
    ----------
    nx : int
        States of the linear part.
    element : Element or None
        The element in the loop, usually `PrandtlIshlinskii`; None for a linear model.
    fixed : mapping
        Blocks held at a value, for example `{"D_yu": 0.0}`; a number fills the block, an array has its shape, entries
        that are nan stay free: `{"A": [[0.9, nan], [0.0, nan]]}` says what is known of the physics. Of `B_w` and `D_yw`
        a row of zeros and nan, one for each channel of the element, says which channels enter.
    bounds : mapping
        `(lower, upper)` by parameter name, for example `{"w": (0, 2)}`; those of the element, such as `w ≥ 0` and
        `r ≥ 0`, hold beside them.
    priors : mapping
        `(mean, std)` by parameter name: a quadratic prior, see `Parameter`.
    offset : bool
        Estimate the constant `y_0`.

    Raises
    ------
    InputError
        If nx is no whole number of 0 or more, the element is none, a fixed, bounded or prior parameter is unknown, a
        bound or prior is no pair, what is given is neither a number nor an array of the parameter's shape, or it is
        beyond the element's own bounds.
    """

    nx: int
    element: Element | None = None
    fixed: Mapping[str, Any] = field(default_factory=dict)
    bounds: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)
    priors: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)
    offset: bool = True

    def __post_init__(self) -> None:
        if isinstance(self.nx, bool) or not isinstance(self.nx, int | float | np.number) or not 0 <= self.nx < np.inf:
            raise InputError(f"The number of states is {self.nx!r}; give a whole number, 0 or more.")
        if int(self.nx) != self.nx:
            raise InputError(f"The number of states is {self.nx}; give a whole number, 0 or more.")
        object.__setattr__(self, "nx", int(self.nx))
        _check_element(self.element)
        for what in ("fixed", "bounds", "priors"):
            given = getattr(self, what)
            if not isinstance(given, Mapping):
                raise InputError(f"{what} = {given!r} was given; give values by parameter name, a mapping.")
        known = (*BLOCKS, *(self.element.parameters() if self.element else ()))
        for name in (*self.fixed, *self.bounds, *self.priors):
            if name not in known:
                raise InputError(f"There is no parameter {name!r} to fix or bound; there are {', '.join(known)}.")
        for name, pair in self.bounds.items():
            _check_pair(f"bounds of {name!r}", pair, "(lower, upper), with -numpy.inf or numpy.inf for none")
        for name, pair in self.priors.items():
            _check_pair(f"prior of {name!r}", pair, "(mean, std)")
        elements = self.element.parameters() if self.element else {}
        shapes = {**block_shapes(self.nx, "n_u", "n_y", self.n_w), **{k: p.value.shape for k, p in elements.items()}}
        for name, shape in shapes.items():
            told = self._given(name, shape)
            if name in elements:
                _check_within(name, elements[name], told)

    @property
    def n_w(self) -> int:
        """Channels of the element."""
        return 0 if self.element is None else self.element.channels

    def _given(self, name: str, shape: tuple[Any, ...]) -> dict[str, Any]:
        """What is said of a parameter, filled to its shape: `fixed`, `bounds`, `prior`, as far as they are given.

        Raises
        ------
        InputError
            If something is neither a number nor an array of this shape.
        """
        out: dict[str, Any] = {}
        if name in self.fixed:
            value = self.fixed[name]
            if name in ("B_w", "D_yw") and _says_which(value, self.n_w):
                value = np.tile(value, (shape[0], 1)) if isinstance(shape[0], int) else np.nan
            out["fixed"] = filled(value, f"What {name!r} is fixed at", shape, nan=True)
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
        """The closed model for n_u inputs and n_y outputs, blocks starting at `values` (zero where not given)."""
        values = dict(values or {})
        self._check_channels(n_u, n_y)
        shapes = block_shapes(self.nx, n_u, n_y, self.n_w)
        blocks = ParameterSet({name: Parameter(np.zeros(shape)) for name, shape in shapes.items()})
        model = open_model(_step, _port, blocks, n_x=self.nx, n_u=n_u, n_w=self.n_w, inputs=inputs, outputs=outputs)
        if self.element is not None:
            model = close_loop(model, self.element)
        changes: dict[str, dict[str, Any]] = {}
        for name, p in model.parameters.items():
            told, shape = self._given(name, p.value.shape), p.value.shape
            lower, upper = told.get("bounds", p.bounds)
            low, high = np.maximum(lower, p.bounds[0]), np.minimum(upper, p.bounds[1])
            given = values.get(name, p.value) if p.value.size else p.value  # a larger structure has more blocks
            begin = np.clip(filled(given, f"The value of {name!r}", shape), low, high)
            changes[name] = {"value": begin, "bounds": (low, high)}
            if name == "y_0" and not self.offset:
                told.setdefault("fixed", np.zeros(shape))
            if "fixed" in told:
                free = np.isnan(told["fixed"])
                changes[name] |= {"value": np.where(free, begin, told["fixed"]), "fixed": ~free}
            if "prior" in told:
                changes[name]["prior"] = told["prior"]
        return model.with_parameters(model.parameters.change(**changes))

    def _check_channels(self, n_u: int, n_y: int) -> None:
        for name, count, what in (("D_zu", n_u, "input"), ("D_yw", n_y, "output")):
            if _is_identity(self.fixed.get(name), self.n_w) and count != self.n_w:
                raise InputError(
                    f"{name} is fixed to the identity (as in a Hammerstein or Wiener model) with {self.n_w} channel(s) "
                    f"of the element, but there are {count} {what}(s); give channels={count} to the element."
                )

    def count(self, n_u: int, n_y: int) -> int:
        """How many parameters are free, without building the model, which takes long where there are millions."""
        self._check_channels(n_u, n_y)
        own = {name: ~p.fixed for name, p in (self.element.parameters() if self.element else {}).items()}
        total = 0
        for name, shape in block_shapes(self.nx, n_u, n_y, self.n_w).items():
            whole = "fixed" not in self._given(name, shape) and (name != "y_0" or self.offset)
            total += int(np.prod(shape)) if whole else self._free(name, shape)
        return total + sum(
            self._free(name, free.shape) if name in self.fixed else int(free.sum()) for name, free in own.items()
        )

    def _free(self, name: str, shape: tuple[int, ...]) -> int:
        fixed = self._given(name, shape).get("fixed")
        return 0 if fixed is None else int(np.isnan(fixed).sum())

    def linear(self) -> PILFR:
        """The linear model of the same order, everything free."""
        return PILFR(self.nx, offset=self.offset)


def _check_element(element: Any) -> None:
    wanted = "give an element, such as PrandtlIshlinskii(Play, 20), or None for a linear model"
    if element is None:
        return
    if isinstance(element, type):
        raise InputError(f"The element is {element.__name__}, a class; {wanted}.")
    if not all(hasattr(element, name) for name in ("channels", "memory", "parameters", "step")):
        raise InputError(f"The element is {element!r}; {wanted}.")


def _check_pair(what: str, given: Any, wanted: str) -> None:
    try:
        first, second = (np.asarray(part, dtype=float) for part in given)
    except (TypeError, ValueError):
        first = second = np.asarray(np.nan)
    if np.any(np.isnan(first)) or np.any(np.isnan(second)):
        raise InputError(f"{given!r} was given as {what}; give a pair of numbers {wanted}.")


def _check_within(name: str, own: Parameter, told: dict[str, Any]) -> None:
    """Refuse bounds and fixed values beyond those of the element, such as thresholds and weights below zero."""
    low, high = own.bounds
    bounds = [(f"A bound of {name!r}", value) for value in told.get("bounds", ())]
    for what, value in (*bounds, (f"What {name!r} is fixed at", told.get("fixed", np.nan))):
        beyond = np.isfinite(value) & ((value < low) | (value > high))
        if np.any(beyond):
            most = f" and at most {np.max(high):g}" if np.all(np.isfinite(high)) else ""
            raise InputError(
                f"{what} is {float(np.broadcast_to(value, beyond.shape)[beyond][0]):g}, but the element's {name} is at "
                f"least {np.min(low):g}{most}; give a number within, or as a bound numpy.inf for none of your own."
            )


def _says_which(value: Any, n: int) -> bool:
    """Whether a value is a row of n zeros and nan."""
    return isinstance(value, np.ndarray) and value.shape == (n,) and bool(np.all(np.isnan(value) | (value == 0)))


def _is_identity(value: Any, n: int) -> bool:
    return n > 0 and np.shape(value) == (n, n) and bool(np.all(np.asarray(value) == np.eye(n)))


def _step(x: Any, u: Any, w: Any, p: dict[str, Any]) -> tuple[Any, Any]:
    x_next = p["A"] @ x + p["B_u"] @ u + p["B_w"] @ w
    return x_next, p["C_y"] @ x + p["D_yu"] @ u + p["D_yw"] @ w + p["y_0"]


def _port(x: Any, u: Any, p: dict[str, Any]) -> Any:
    return p["C_z"] @ x + p["D_zu"] @ u


def hammerstein(nx: int, element: Element, offset: bool = True) -> PILFR:
    """PI-Hammerstein: the input passes the element first; `z = u`, and u reaches the dynamics only through w.

    The element has one channel for each input.
    """
    _check_element(element)
    eye = np.eye(element.channels)
    return PILFR(nx, element, {"C_z": 0.0, "D_zu": eye, "B_u": 0.0, "D_yu": 0.0}, offset=offset)


def wiener(nx: int, element: Element, offset: bool = True) -> PILFR:
    """PI-Wiener: the linear dynamics come first, the output is read through the element; `y = w`.

    The element has one channel for each output.
    """
    _check_element(element)
    eye = np.eye(element.channels)
    return PILFR(nx, element, {"B_w": 0.0, "C_y": 0.0, "D_yu": 0.0, "D_yw": eye}, offset=offset)
