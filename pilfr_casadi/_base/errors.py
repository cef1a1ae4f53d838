"""What is wrong with the fields of a recording, in one plain sentence each; layer 0, knows nothing of the rest."""

from collections.abc import Sequence
from typing import Any, TypeGuard

import numpy as np

LARGEST = 1e100  # samples above cannot be squared and summed


class InputError(ValueError):
    """Something given by the user cannot be used; the message is one plain sentence for that user."""


def listed(names: Sequence[str], most: int = 20) -> str:
    """Join names for a message; of many, the first ones."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def usable(values: np.ndarray) -> np.ndarray:
    """Where the values are finite and small enough for their squares to be summed; a boolean array of their shape."""
    return np.abs(values) <= LARGEST  # False for nan


def whole(value: Any, what: str, least: int) -> int:
    """Return a whole number of `least` or more.

    Raises
    ------
    InputError
        If something else is given.
    """
    good = isinstance(value, int | np.integer) and not isinstance(value, bool) and value >= least
    if not good:
        raise InputError(f"{what} is {value!r}; give a whole number, {least} or more.")
    return int(value)


def is_number(value: Any) -> TypeGuard[float]:
    """Whether a value is one real number."""
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def numbers(values: Any, what: str, shape: tuple[int, ...] | None = None, infinite: bool = False) -> np.ndarray:
    """Return finite real numbers as an array; of a shape, to which it is broadcast, where one is given.

    Raises
    ------
    InputError
        If something else is given, or one of them is not finite (nan, where `infinite`).
    """
    try:
        given = np.asarray(values)
        if given.dtype.kind not in "biufO":
            raise TypeError
        found = given.astype(float)
        found = found if shape is None else np.broadcast_to(found, shape)
    except (TypeError, ValueError, OverflowError):
        fit = "" if shape is None else f" that fit the shape {shape}"
        raise InputError(f"{what} cannot be {str(values)[:60]!r}; give numbers{fit}.") from None
    if np.any(np.isnan(found)) or not (infinite or np.all(np.isfinite(found))):
        raise InputError(f"{what} holds a value that is not finite (nan or infinite); give finite numbers.")
    return found


def filled(
    values: Any, what: str, shape: tuple[int | str, ...], nan: bool = False, infinite: bool = False
) -> np.ndarray:
    """Return an array of a shape from one number for all of it, or from an array of just this shape.

    Nothing else is stretched: a row given for a matrix is more likely a mistake than every row of it.

    Parameters
    ----------
    values : float or array
    what : str
        Begins the sentence.
    shape : tuple
        A name in place of a length stands for one that is not known yet; a single number stays as it is then.
    nan, infinite : bool
        Whether such entries have a meaning.

    Raises
    ------
    InputError
        If something else is given.
    """
    wanted = f"a number or an array of shape ({', '.join(map(str, shape))}{',' * (len(shape) == 1)})"
    try:
        given = np.asarray(values)
        if given.dtype.kind not in "biuf":
            raise TypeError
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{what} is {str(values)[:60]}; give {wanted if shape else 'a number'}.") from None
    found = given.astype(float)
    known = tuple(k if isinstance(n, str) else n for n, k in zip(shape, found.shape, strict=False))
    if found.ndim and (len(shape), known) != (found.ndim, found.shape):
        raise InputError(f"{what} has the shape {found.shape}; give {wanted if shape else 'a number'}.")
    if (np.any(np.isnan(found)) and not nan) or (np.any(np.isinf(found)) and not infinite):
        raise InputError(f"{what} holds a value that is not finite; give {wanted if shape else 'a number'}, finite.")
    lengths = [n for n in shape if not isinstance(n, str)]
    return np.broadcast_to(found, lengths) if len(lengths) == len(shape) else found


def signal(
    values: Any, names: Sequence[str], letter: str, role: str, label: str, none: bool = False
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the signal as a read-only (M, n) copy, and its names; (M, 0) only where `none` allows it."""
    try:
        given = np.asarray(values)
        real = given.dtype.kind in "biuf" or given.dtype == object
        array = np.array(given, dtype=float) if real else None
    except (TypeError, ValueError, OverflowError):
        array = None
    if array is None:
        raise InputError(f"{letter} of {label} is not an array of real numbers; give one of shape (samples, channels).")
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2 or (array.shape[1] == 0 and not none):
        raise InputError(
            f"{letter} of {label} has the shape {array.shape}; give an array of shape (samples, channels)."
        )
    n = array.shape[1]
    names = (names,) if isinstance(names, str) else tuple(names)
    if not names and n:
        names = (letter,) if n == 1 else tuple(f"{letter}{i + 1}" for i in range(n))
    if len(names) != n:
        raise InputError(f"{label} has {n} {role} column(s) but {len(names)} name(s) {listed(names)}; give one each.")
    if len(set(names)) != n or not all(isinstance(name, str) and name for name in names):
        raise InputError(f"the {role} names {names} of {label} must be distinct and not empty.")
    unusable = ~usable(array)
    if unusable.any():
        k, i = np.argwhere(unusable)[0]
        raise InputError(
            f"sample {k} of {role} {names[i]!r} in {label} is {array[k, i]}; only finite numbers up to {LARGEST:g} can "
            "be used, so repair or cut out that piece, or give it in another unit."
        )
    array.setflags(write=False)
    return array, names
