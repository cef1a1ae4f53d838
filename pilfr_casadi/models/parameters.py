"""Named parameters with shapes and bounds, and their layout as a vector.

A model carries a `ParameterSet`: an ordered, immutable mapping from names to `Parameter`. Arrays are stacked column by
column (CasADi's `vec`) in the order of the names, so numbers and symbols share one layout. Bounds go to the solver as
they are; a parameter is never transformed to satisfy them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np

from .._base import InputError, filled, listed

Array = np.ndarray
NEAR_BOUND = 1e-3  # of a bound, or of the range if that is smaller: a value that is nearer counts as at the bound
LARGEST_MODEL = 20_000  # parameters, whose Gauss-Newton Hessian takes 3.2 GB, and its factorisation a minute per step


def parameter_within(name: str, value: float, bounds: tuple[float, float], unit: str = "") -> Parameter:
    """Make a parameter of an imported model; an error about its bounds contains its name."""
    _check_within(name, value, bounds)
    return Parameter(value, unit, bounds)


def _check_within(name: str, value: Any, bounds: Any) -> None:
    ends = np.ravel(np.asarray(bounds, dtype=object))
    if len(ends) != 2 or not all(isinstance(end, int | float | np.number) and not np.isnan(end) for end in ends):
        raise InputError(f"The bounds of {name!r} are {bounds!r}; give a pair of numbers (lower, upper).")
    low, high = ends
    if not low <= high:
        raise InputError(
            f"The bounds {low:g} to {high:g} of {name!r} are infeasible: the lower one exceeds the upper one; swap "
            "them."
        )
    for entry in np.ravel(value):
        if not low <= entry <= high:
            raise InputError(
                f"The parameter {name!r} is {entry:g}, outside of its bounds {low:g} to {high:g}; widen them."
            )


def is_at_bound(value: Any, lower: Any, upper: Any) -> Array:
    """Mark values at one of their bounds; a solver ends a little inside of it.

    Zero has no size, so that only zero itself is at the bound zero.
    """
    value, lower, upper = np.broadcast_arrays(*(np.asarray(v, dtype=float) for v in (value, lower, upper)))
    found = (value <= lower) | (value >= upper)
    for bound in (lower, upper):
        with np.errstate(invalid="ignore"):
            found |= np.abs(value - bound) < NEAR_BOUND * np.minimum(np.abs(bound), upper - lower)
    return np.asarray(found)


def check_size(owner: str, count: int) -> None:
    """Refuse a model with too many parameters for a fit, before arrays of that size are allocated."""
    if count > LARGEST_MODEL:
        raise InputError(
            f"{owner} of this size has at least {float(count):.3g} parameters, and the matrix that a fit solves for "
            f"takes {8e-9 * float(count) ** 2:.3g} GB of memory; give at most {LARGEST_MODEL} parameters."
        )


def within_a_factor(value: float) -> tuple[float, float]:
    """Return default bounds of a parameter known only by its size: a factor of ten either way."""
    low, high = sorted((value / 10, value * 10))
    return low, high


@dataclass(frozen=True, eq=False)
class Parameter:
    """A parameter of a model: a start value with its unit, its bounds, and whether it is estimated.

    Parameters
    ----------
    value : float or array
        Start value (the value itself where `fixed`). Scalars, vectors (n,) and matrices (n, m) are allowed.
    unit : str
        Unit in plain text.
    bounds : (lower, upper)
        Scalars or arrays of the value's shape; infinite where there is no bound.
    fixed : bool or bool array
        Entries that are not estimated.
    prior : (mean, std), optional
        A quadratic prior: `((value - mean) / std)²` is added to the sum of squared errors, each error in units of the
        noise.

    Raises
    ------
    InputError
        If a number is not finite, a lower bound exceeds its upper bound, the value lies outside its bounds, or an
        argument has the wrong type.

    Examples
    --------
    >>> stiffness = Parameter(1100.0, unit="N/m", bounds=(500, 3000))
    >>> stiffness.shape, stiffness.size
    ((1, 1), 1)
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
        if not isinstance(self.unit, str):
            raise InputError(f"A parameter's unit is {self.unit!r}; give plain text, such as 'N/m'.")
        lower, upper = (_fill(bound, value.shape, "A bound") for bound in _pair(self.bounds, "bounds (lower, upper)"))
        fixed = _fill(self.fixed, value.shape, "A fixed flag").astype(bool)
        between = f"({self.bounds[0]}, {self.bounds[1]})"
        if not np.all(lower <= upper):
            raise InputError(f"The bounds {between} are infeasible: the lower one must not exceed the upper one.")
        if np.any((value < lower) | (value > upper)):
            raise InputError(f"The value {self.value} lies outside its bounds {between}; move it inside or widen them.")
        if self.prior is not None:
            mean, std = (_fill(part, value.shape, "The prior") for part in _pair(self.prior, "prior (mean, std)"))
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

    @classmethod
    def trusted(cls, value: Any, unit: str, lower: Any, upper: Any) -> Parameter:
        """Make a free scalar without checks; the numbers must be finite, with `lower <= value <= upper`."""
        made = object.__new__(cls)
        value, lower, upper, fixed = np.array(value), np.array(lower), np.array(upper), np.array(False)
        for array in (value, lower, upper, fixed):
            array.setflags(write=False)
        made.__dict__.update(value=value, unit=unit, bounds=(lower, upper), fixed=fixed, prior=None)
        return made

    def _with_value(self, value: Array) -> Parameter:
        """Copy with another value, which must be finite, in bounds, of the same shape and not shared; not checked."""
        copy = object.__new__(type(self))
        copy.__dict__.update(self.__dict__)
        value.setflags(write=False)
        copy.__dict__["value"] = value
        return copy


def _pair(given: Any, name: str) -> tuple[Any, Any]:
    try:
        first, second = given
    except (TypeError, ValueError):
        raise InputError(f"A parameter's {name} were given as {given!r}; give a pair.") from None
    return first, second


def _fill(given: Any, shape: tuple[int, ...], name: str) -> Array:
    """Copy numbers into a parameter's shape."""
    return np.array(filled(given, f"{name} of a parameter", shape, nan=True, infinite=True))


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
        """Join both sets, names of `other` last; a name in both is an error."""
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
        """Mask of the entries that are estimated, shape (size,), bool."""
        return self._stack({n: ~p.fixed for n, p in self.items()}).astype(bool)

    @property
    def labels(self) -> tuple[str, ...]:
        """One readable name for each entry: `m`, `w[3]`, `A[0,1]` (indices from 0)."""
        out: list[str] = []
        for name, p in self.items():
            if p.value.ndim == 0:
                out.append(name)
            elif p.value.ndim == 1:
                out += [f"{name}[{i}]" for i in range(p.size)]
            else:
                out += [f"{name}[{i},{j}]" for j in range(p.shape[1]) for i in range(p.shape[0])]
        return tuple(out)

    def _slices(self) -> Iterator[tuple[str, Parameter, slice]]:
        begin = 0
        for name, p in self.items():
            yield name, p, slice(begin, begin + p.size)
            begin += p.size

    def position(self, name: str) -> slice:
        """Find the entries of a parameter in the vector."""
        self._require([name])
        return next(entries for n, _, entries in self._slices() if n == name)

    def _require(self, names: Any) -> None:
        for name in names:
            if name not in self.entries:
                raise InputError(f"There is no parameter {name!r}; there are {listed(list(self))}.")

    def pack(self, values: Mapping[str, Any]) -> Array:
        """Make a vector from values by name; all other parameters keep their start value."""
        self._require(values)
        full = {}
        for n, p in self.items():
            value = np.asarray(values.get(n, p.value), dtype=float)
            if np.squeeze(value).shape != np.squeeze(p.value).shape:
                raise InputError(f"Parameter {n!r} was given with shape {value.shape}; expected {p.value.shape}.")
            full[n] = value
        return self._stack(full)

    def unpack(self, vector: Array) -> dict[str, Array]:
        """Make values by name from a vector of shape (size,)."""
        vector = np.asarray(vector, dtype=float).ravel()
        if vector.size != self.size:
            raise InputError(f"A parameter vector of length {vector.size} was given; expected {self.size}.")
        return {n: vector[entries].reshape(p.value.shape, order="F") for n, p, entries in self._slices()}

    def symbols(self, vector: Any) -> dict[str, Any]:
        """Make CasADi expressions by name (as matrices) from a symbolic vector of shape (size, 1)."""
        return {n: ca.reshape(vector[entries], *p.shape) for n, p, entries in self._slices()}

    def at(self, vector: Array) -> ParameterSet:
        """Copy with the start values of a finite vector, clipped to the bounds."""
        values = self.unpack(np.clip(vector, self.lower, self.upper))
        if not all(np.all(np.isfinite(value)) for value in values.values()):
            raise InputError("A parameter's value is not finite; give a number.")
        return ParameterSet({n: p._with_value(values[n]) for n, p in self.items()})

    def free_within(self, bounds: Mapping[str, tuple[float, float]]) -> ParameterSet:
        """Copy with other bounds of some parameters, which are then free; their values must lie inside."""
        self._require(bounds)
        for name, ends in bounds.items():
            _check_within(name, self[name].value, ends)
        return self.change(**{name: {"bounds": ends, "fixed": False} for name, ends in bounds.items()})

    def change(self, **changes: Mapping[str, Any]) -> ParameterSet:
        """Copy with fields of some parameters replaced: `change(A={"fixed": True}, w={"bounds": (0, 1)})`."""
        self._require(changes)
        return ParameterSet({n: replace(p, **changes[n]) if n in changes else p for n, p in self.items()})


class Named:
    """Symbols by name: `x.pos`, `p.k` or `p["k"]`."""

    def __init__(self, kind: str, values: Mapping[str, Any]) -> None:
        self.__dict__.update(_kind=kind, _values=dict(values))

    def __getattr__(self, name: str) -> Any:
        try:
            return self._values[name]
        except KeyError:
            if name.startswith("__"):
                raise AttributeError(name) from None
            known = ", ".join(self._values) or "none"
            raise InputError(f"There is no {self._kind} {name!r}; there are {known}.") from None

    __getitem__ = __getattr__

    def __setattr__(self, name: str, value: Any) -> None:
        raise InputError(f"The {self._kind} {name!r} cannot be assigned; return the equations in a dict instead.")

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)


class Neighbours:
    """Judge the size of an entry by the other entries of its row, its column and its matrix.

    An entry of zero has no size of its own. `sqrt(largest of its row × largest of its column)` is never less than the
    entry itself, and has its unit wherever the entries of a row or of a column share a unit.

    Parameters
    ----------
    labels : tuple of str
        Names of the entries, such as `A[0,1]`; see `ParameterSet.labels`.
    """

    def __init__(self, labels: tuple[str, ...]) -> None:
        keys = [_row_column_matrix(label) for label in labels]
        self._row, self._column, self._matrix = (
            np.unique([key[k] for key in keys], return_inverse=True)[1] if keys else np.zeros(0, dtype=int)
            for k in range(3)
        )

    def sizes(self, values: Array) -> Array:
        """Compute the size of each entry from its row and column, shape (n,)."""
        values = np.abs(values)
        return np.sqrt(_largest(values, self._row)) * np.sqrt(_largest(values, self._column))

    def largest(self, values: Array) -> Array:
        """Find the largest value of the matrix that each entry belongs to, shape (n,)."""
        return _largest(values, self._matrix)


def _row_column_matrix(label: str) -> tuple[str, str, str]:
    name, _, inside = label.partition("[")
    indices, _, rest = inside.partition("]")
    row, _, column = indices.partition(",")
    return f"{name}{rest} {row}", f"{name}{rest} ,{column}", name + rest


def _largest(values: Array, group: Array) -> Array:
    out = np.zeros(int(group.max(initial=-1)) + 1)
    np.maximum.at(out, group, values)
    return np.asarray(out[group])


def or_one(scale: Array) -> Array:
    """Replace scales of zero by one, so that a constant signal can be divided by its scale."""
    return np.where(scale > 0, scale, 1.0)
