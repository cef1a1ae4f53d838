"""Define the error for bad input, and the checks that raise it with a plain sentence."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

LARGEST = 1e100  # samples above cannot be squared and summed in double precision
REPAIR = (
    f"only finite numbers up to {LARGEST:g} can be used, so repair or cut out that piece, or give it in another unit"
)
LONGEST_MESSAGE = 240  # characters shown of another program's message


class InputError(ValueError):
    """The user gave something that cannot be used; the message is one plain sentence."""


def listed(names: Sequence[Any], most: int = 20) -> str:
    """Join names by commas for a message; abbreviate more than `most` names."""
    return ", ".join(map(str, names[:most])) + (f" and {len(names) - most} more" if len(names) > most else "")


def quote_error(error: BaseException, line: int | None = None) -> str:
    """Quote an error of another program within a sentence, without a stop; one without words by its type.

    `line` chooses one of its lines, such as the last of CasADi's.
    """
    lines = [row for row in str(error).splitlines() if row.strip()] or [type(error).__name__]
    return one_line((" ".join(lines) if line is None else lines[line]).rstrip(" ."))


def one_line(text: str) -> str:
    """Write another program's message in one line of at most `LONGEST_MESSAGE` characters."""
    text = " ".join(text.split())
    return text if len(text) <= LONGEST_MESSAGE else text[:LONGEST_MESSAGE].rsplit(" ", 1)[0] + " ..."


def check_known(names: Sequence[str], known: Sequence[str], kind: str, owner: Any) -> None:
    """Refuse names that are not among the `known` names of a `kind` that `owner` has."""
    for name in names:
        if name not in known:
            raise InputError(f"{owner} has no {name!r} among its {kind}; they are {listed(known) or 'none'}.")


def in_words(names: Sequence[str]) -> str:
    """Join names as in a sentence, "a, b and c"; abbreviate more than eight names."""
    if len(names) > 8:
        return listed(names, 8)
    return " and ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else "".join(names)


def capitalise(text: str) -> str:
    """Write the first letter of a text as a capital; the others, as of names and units, stay."""
    return text[:1].upper() + text[1:]


def percent(share: float) -> str:
    """Write a share or a relative error, "12.3 %"; a large one without an exponent, an infinite one in words."""
    if not np.isfinite(share):
        return "infinite (the simulation diverges)"
    return f"{100 * share:.0f} %" if 10 <= share < 1e4 else f"{100 * share:.3g} %"


def multiple(ratio: float) -> str:
    """Write how many times one value is another, to two digits: "1.4", "18", "230", without an exponent below 1e6."""
    return f"{float(f'{ratio:.2g}'):g}"


def usable(values: np.ndarray) -> np.ndarray:
    """Tell which values are finite and small enough that their squares can be summed; a boolean array."""
    return np.abs(values) <= LARGEST  # False for nan


def is_whole(value: Any, least: float, most: float = np.inf) -> bool:
    """Tell whether a value is a whole number from `least` to `most`."""
    whole_number = isinstance(value, int | np.integer) and not isinstance(value, bool | np.timedelta64)
    return whole_number and bool(least <= value <= most)


def whole(value: Any, what: str, least: int) -> int:
    """Return a whole number of `least` or more, or raise InputError."""
    if not is_whole(value, least):
        raise InputError(f"{what} is {value!r}; give a whole number, {least} or more.")
    return int(value)


def is_number(value: Any) -> TypeGuard[float]:
    """Tell whether a value is one real number."""
    real = isinstance(value, int | float | np.integer | np.floating)
    return real and not isinstance(value, bool | np.timedelta64)  # which NumPy counts among the integers


def positive(value: Any, what: str, meaning: str = "a number", zero: bool = False) -> float:
    """Return a finite number above zero, or raise InputError; `zero` allows zero too.

    The message names the argument `what` and asks for `meaning`.
    """
    if not is_number(value) or not np.isfinite(value) or value < 0 or (value == 0 and not zero):
        raise InputError(
            f"{what}={repr(value)[:60]} was given; give {meaning}, {'zero or more' if zero else 'above zero'}."
        )
    return float(value)


def without_mask(values: Any) -> np.ndarray:
    """Return an array in which masked values are missing: nan, or not a time."""
    array = np.asarray(values)
    if np.ma.is_masked(values):
        array = array.astype(float) if array.dtype.kind in "biu" else array.copy()
        array[np.ma.getmaskarray(values)] = None
    return array


def real_array(values: Any) -> np.ndarray | None:
    """Return real numbers as a new array of floats, masked ones as nan, or None if something else is given."""
    try:
        given = without_mask(values)
        return np.array(given, dtype=float) if given.dtype.kind in "biufO" else None
    except (TypeError, ValueError, OverflowError):
        return None


def numbers(values: Any, what: str, shape: tuple[int, ...] | None = None, infinite: bool = False) -> np.ndarray:
    """Return finite real numbers as an array, or raise InputError; `infinite` allows infinity.

    A given `shape` is the shape of the result, to which the numbers are broadcast.
    """
    found = real_array(values)
    if found is not None and shape is not None:
        try:
            found = np.broadcast_to(found, shape)
        except ValueError:
            found = None
    if found is None:
        fit = "" if shape is None else f" that fit the shape {shape}"
        raise InputError(f"{what} cannot be {str(values)[:60]!r}; give numbers{fit}.")
    if np.any(np.isnan(found)) or not (infinite or np.all(np.isfinite(found))):
        raise InputError(f"{what} holds a value that is not finite (nan or infinite); give finite numbers.")
    return found


def filled(
    values: Any, what: str, shape: tuple[int | str, ...], nan: bool = False, infinite: bool = False
) -> np.ndarray:
    """Return an array of a shape from a single number or an array of exactly this shape, or raise InputError.

    Nothing else is broadcast: a row given for a matrix is more likely a mistake than meant for every row. A name in
    place of a length stands for an unknown length; a single number then stays a single number. `what` begins the
    message.
    """
    wanted = f"a number or an array of shape ({', '.join(map(str, shape))}{',' * (len(shape) == 1)})"
    wanted = wanted if shape else "a number"
    found = real_array(values)
    if found is None or np.asarray(values).dtype.kind == "O":  # None would become nan
        raise InputError(f"{what} is {str(values)[:60]}; give {wanted}.")
    known = tuple(k if isinstance(n, str) else n for n, k in zip(shape, found.shape, strict=False))
    if found.ndim and (len(shape), known) != (found.ndim, found.shape):
        raise InputError(f"{what} has the shape {found.shape}; give {wanted}.")
    if (np.any(np.isnan(found)) and not nan) or (np.any(np.isinf(found)) and not infinite):
        raise InputError(f"{what} holds a value that is not finite; give {wanted}, finite.")
    lengths = [n for n in shape if not isinstance(n, str)]
    return np.broadcast_to(found, lengths) if len(lengths) == len(shape) else found


def existing_file(path: str | Path) -> Path:
    """Return the path of a regular file, or raise InputError: reading a pipe or a device might block forever."""
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path} is a directory; give the file inside it.")
    if not path.exists():
        link = ", only a link that leads nowhere" if path.is_symlink() else ""
        raise InputError(f"there is no file {path}{link}; check the name and the folder.")
    if not path.is_file():
        raise InputError(f"{path} is a pipe or a device, not a regular file; write its content to a file first.")
    return path


def read_bytes(path: str | Path) -> bytes:
    """Return the content of a regular file, or raise InputError."""
    try:
        return existing_file(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); check its permissions.") from None
