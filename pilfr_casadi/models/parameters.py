"""Named, bounded, shaped parameters and the one way they become a vector.

A model carries a `ParameterSet`: an ordered, immutable mapping from names to `Parameter`. Arrays are stacked column by
column (CasADi's `vec`), in the order of the names, so numbers and symbols share one layout. Bounds are bounds: they go
to the solver as they are, a parameter is never re-expressed to satisfy them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, filled

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Parameter:
    """A parameter of a model: a start value with its unit, bounds and whether it is estimated.

    Parameters
    ----------
    value : float or array
        Start value (or the value, where `fixed`). Scalars, vectors (n,) and matrices (n, m) are legal.
    unit : str
        Unit in plain text.
    bounds : (lower, upper)
        Scalars or arrays of the value's shape; infinite where there is none.
    fixed : bool or bool array
        Entries that are not estimated.
    prior : (mean, std), optional
        A quadratic prior: `((value - mean) / std)²` is added to the sum of squared errors, each error in units of the
        noise.

    Raises
    ------
    InputError
        If a number is not finite, a lower bound exceeds its upper bound, or the value lies outside its bounds.
    """

    value: Any
    unit: str = ""
    bounds: tuple[Any, Any] = (-np.inf, np.inf)
    fixed: Any = False
    prior: tuple[Any, Any] | None = None

    def __post_init__(self) -> None:
        try:
            value = np.array(self.value, dtype=float)
        except (TypeError, ValueError):
            raise InputError(f"A parameter's value is {self.value!r}; give a number or an array of numbers.") from None
        if value.ndim > 2:
            raise InputError(f"A parameter has {value.ndim} dimensions; give a scalar, a vector or a matrix.")
        if not np.all(np.isfinite(value)):
            raise InputError("A parameter's value is not finite; give a number.")
        lower, upper = (_filled(bound, value.shape, "A bound") for bound in _pair(self.bounds, "bounds (lower, upper)"))
        fixed = _filled(self.fixed, value.shape, "A fixed flag").astype(bool)
        between = f"({self.bounds[0]}, {self.bounds[1]})"
        if not np.all(lower <= upper):
            raise InputError(f"The bounds {between} are infeasible: the lower one must not exceed the upper one.")
        if np.any((value < lower) | (value > upper)):
            raise InputError(f"The value {self.value} lies outside its bounds {between}; move it inside or widen them.")
        if self.prior is not None:
            mean, std = (_filled(part, value.shape, "The prior") for part in _pair(self.prior, "prior (mean, std)"))
            if not (np.all(np.isfinite(mean)) and np.all(std > 0)):
                raise InputError(f"The prior {self.prior} needs a finite mean and a positive standard deviation.")
        for array in (value, lower, upper, fixed):
            array.setflags(write=False)
        object.__setattr__(self, "value", value)
        object.__setattr__(self, "bounds", (lower, upper))
        object.__setattr__(self, "fixed", fixed)

    @property
    def shape(self) -> tuple[int, int]:
        """Shape as a matrix: a scalar is (1, 1), a vector (n, 1)."""
        value = self.value
        return value.shape if value.ndim == 2 else (value.size, 1)

    @property
    def size(self) -> int:
        """Number of entries."""
        return int(self.value.size)


def _pair(given: Any, what: str) -> tuple[Any, Any]:
    try:
        first, second = given
    except (TypeError, ValueError):
        raise InputError(f"A parameter's {what} were given as {given!r}; give a pair.") from None
    return first, second


def _filled(given: Any, shape: tuple[int, ...], what: str) -> Array:
    """Numbers of a parameter's shape, a copy."""
    return np.array(filled(given, f"{what} of a parameter", shape, nan=True, infinite=True))


@dataclass(frozen=True, eq=False)
class ParameterSet(Mapping[str, Parameter]):
    """Ordered, immutable mapping from names to parameters, with the layout of their vector."""

    entries: Mapping[str, Parameter] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "entries", dict(self.entries))

    def __getitem__(self, name: str) -> Parameter:
        return self.entries[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.entries)

    def __len__(self) -> int:
        return len(self.entries)

    def __or__(self, other: Mapping[str, Parameter]) -> ParameterSet:
        """Both sets, names of `other` appended; a name in both is an error."""
        twice = set(self) & set(other)
        if twice:
            raise InputError(
                f"The parameter name {sorted(twice)[0]!r} is used twice; give each parameter a name of its own."
            )
        return ParameterSet({**self.entries, **dict(other)})

    @property
    def size(self) -> int:
        """Length of the parameter vector."""
        return sum(p.size for p in self.values())

    def _stack(self, arrays: Mapping[str, Array]) -> Array:
        parts = [np.asarray(arrays[name]).ravel(order="F") for name in self]
        return np.concatenate(parts) if parts else np.zeros(0)

    @property
    def start(self) -> Array:
        """Start values as one vector, shape (size,)."""
        return self._stack({n: p.value for n, p in self.items()})

    @property
    def lower(self) -> Array:
        """Lower bounds, shape (size,)."""
        return self._stack({n: p.bounds[0] for n, p in self.items()})

    @property
    def upper(self) -> Array:
        """Upper bounds, shape (size,)."""
        return self._stack({n: p.bounds[1] for n, p in self.items()})

    @property
    def free(self) -> Array:
        """Which entries are estimated, shape (size,), bool."""
        return self._stack({n: ~p.fixed for n, p in self.items()}).astype(bool)

    @property
    def labels(self) -> tuple[str, ...]:
        """One readable name an entry: `m`, `w[3]`, `A[0,1]` (indices from 0)."""
        out: list[str] = []
        for name, p in self.items():
            if p.value.ndim == 0:
                out.append(name)
            elif p.value.ndim == 1:
                out += [f"{name}[{i}]" for i in range(p.size)]
            else:
                out += [f"{name}[{i},{j}]" for j in range(p.shape[1]) for i in range(p.shape[0])]
        return tuple(out)

    def position(self, name: str) -> slice:
        """Where a parameter sits in the vector."""
        at = 0
        for n, p in self.items():
            if n == name:
                return slice(at, at + p.size)
            at += p.size
        raise InputError(f"There is no parameter {name!r}; there are {', '.join(self)}.")

    def pack(self, values: Mapping[str, Any]) -> Array:
        """Vector from values by name; names left out keep their start value."""
        for name in values:
            if name not in self.entries:
                raise InputError(f"There is no parameter {name!r}; there are {', '.join(self)}.")
        full = {}
        for n, p in self.items():
            value = np.asarray(values.get(n, p.value), dtype=float)
            if np.squeeze(value).shape != np.squeeze(p.value).shape:
                raise InputError(f"Parameter {n!r} was given with shape {value.shape}; expected {p.value.shape}.")
            full[n] = value
        return self._stack(full)

    def unpack(self, vector: Array) -> dict[str, Array]:
        """Values by name from a vector of shape (size,)."""
        vector = np.asarray(vector, dtype=float).ravel()
        if vector.size != self.size:
            raise InputError(f"A parameter vector of length {vector.size} was given; expected {self.size}.")
        return {n: vector[self.position(n)].reshape(p.value.shape, order="F") for n, p in self.items()}

    def symbols(self, vector: Any) -> dict[str, Any]:
        """CasADi expressions by name (as matrices) from a symbolic vector of shape (size, 1)."""
        return {n: ca.reshape(vector[self.position(n)], *p.shape) for n, p in self.items()}

    def at(self, vector: Array) -> ParameterSet:
        """The same set with start values from a vector, moved onto the bounds where rounding left them outside."""
        values = self.unpack(np.clip(vector, self.lower, self.upper))
        return ParameterSet({n: replace(p, value=values[n]) for n, p in self.items()})

    def change(self, **changes: Mapping[str, Any]) -> ParameterSet:
        """A copy with fields of some parameters replaced: `change(A={"fixed": True}, w={"bounds": (0, 1)})`."""
        for name in changes:
            if name not in self.entries:
                raise InputError(f"There is no parameter {name!r}; there are {', '.join(self)}.")
        return ParameterSet({n: replace(p, **changes[n]) if n in changes else p for n, p in self.items()})
