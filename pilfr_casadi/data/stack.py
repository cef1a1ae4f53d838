"""Several records in one array: samples, channels, and further axes such as realizations and periods."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .._base import InputError, usable
from .array_files import npz_arrays
from .csv_table import existing_file

Array = np.ndarray


def read_stack(path: Path, inputs: Sequence[str], outputs: Sequence[str]) -> tuple[Array, Array | None] | None:
    """Inputs (M, n_u, ...) and outputs (M, n_y, ...), or None where the file holds one record.

    In an .npz file the arrays are found by one name for all channels, `u` for `u1, u2, u3`; outputs may be missing. An
    .npy file is the inputs alone.

    Parameters
    ----------
    path : Path
        The .npz or .npy file.
    inputs, outputs : sequence of str
        Names of the channels, or the one name of the array.

    Raises
    ------
    InputError
        If the file cannot be read, the arrays do not fit each other, or hold something else than finite numbers.
    """
    y: Array | None = None
    if path.suffix.lower() == ".npy":
        u = _npy(path)
        u = u if u.ndim > 2 else u.reshape(*u.shape, *(1,) * (3 - u.ndim))
    else:
        arrays = npz_arrays(path)
        found, y = (arrays.get(_stem(names)) for names in (inputs, outputs))
        if found is None or found.ndim < 3:
            return None
        u = found
    for x, names, what in ((u, inputs, "inputs"), (y, outputs, "outputs")):
        if x is None:
            continue
        if x.dtype.kind not in "biuf" or x.size == 0 or not np.all(usable(x)):
            raise InputError(f"{path}: the array of the {what} holds something else than finite numbers; repair it.")
        if x.shape != (u.shape[0], x.shape[1], *u.shape[2:]) or len(names) not in (1, x.shape[1]):
            raise InputError(
                f"{path}: the array of the {what} has the shape {x.shape}; expected (samples, {len(names)} channels, "
                f"...) with the axes of the inputs, {u.shape}."
            )
    return u.astype(float), None if y is None else y.astype(float)


def _npy(path: Path) -> Array:
    existing_file(path)
    try:
        with path.open("rb") as file:
            return np.asarray(np.load(file, allow_pickle=False))
    except (OSError, ValueError, EOFError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path} cannot be read as a NumPy array ({reason}); write it with numpy.save.") from None


def _stem(names: Sequence[str]) -> str:
    """The one name of several channels: `u` of `u1, u2, u3`."""
    if len(names) > 1 and all(name == f"{names[0][:-1]}{i + 1}" for i, name in enumerate(names)):
        return names[0][:-1]
    return names[0]
