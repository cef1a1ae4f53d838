"""Arrays by name out of ``.mat`` and ``.npz`` files; no code in them is run."""

import zipfile
from pathlib import Path

import numpy as np

from .._base import LARGEST, InputError, usable
from .csv_table import existing_file


def samples(values: np.ndarray, name: str, path: Path) -> np.ndarray:
    """Return the array as (M, channels) of finite numbers; a row vector is taken as a column.

    Raises
    ------
    InputError
        When it is no array of real numbers, or one of them cannot be used.
    """
    if values.dtype.kind not in "biuf" or values.ndim > 2 or values.size == 0:
        raise InputError(
            f"{path}: variable {name!r} holds {values.dtype} of shape {values.shape}; give a vector of real numbers."
        )
    column = values.reshape(-1, 1) if values.ndim < 2 or 1 in values.shape else values
    column = column.astype(float)
    bad = np.argwhere(~usable(column))
    if bad.size:
        k, i = bad[0]
        raise InputError(
            f"{path}: variable {name!r}, sample {k} is {column[k, i]}; only finite numbers up to {LARGEST:g} can "
            "be used: repair or cut out that piece, or give it in another unit."
        )
    return column


def mat_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read the variables of a MATLAB file (up to version 7.2) by name.

    Raises
    ------
    InputError
        When the file cannot be read as one.
    """
    from scipy.io import loadmat

    existing_file(path)
    try:
        content = loadmat(path)
    except NotImplementedError:
        raise InputError(f"{path} is a MATLAB file of version 7.3; save it with the option -v7.") from None
    except Exception as error:  # the parser raises many kinds on damaged files
        raise InputError(
            f"{path} cannot be read as a MATLAB file ({error}); save it again with the option -v7."
        ) from None
    return {name: value for name, value in content.items() if not name.startswith("__")}


def npz_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read the variables of a NumPy archive by name.

    Raises
    ------
    InputError
        When the file cannot be read as one.
    """
    existing_file(path)
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as content:
            return {name: content[name] for name in content.files}
    except (OSError, ValueError, EOFError, AttributeError, TypeError, zipfile.BadZipFile) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path} cannot be read as a NumPy archive ({reason}); write it with numpy.savez.") from None
