"""Readers: CSV, ``.mat`` and ``.npz`` files into recordings, checked at this door.

A file holds one recording: a time column (``t``, ``t_s`` or ``time``, in seconds, uniform) and one column for each
input and output by name; other columns are ignored. Whatever is wrong with it is said in one sentence that names the
file, the column and the line.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np

from .._base import InputError
from .array_files import mat_arrays, npz_arrays, samples
from .csv_table import CsvTable, existing_file, read_table
from .recording import Recording
from .request import Names, Request, request_of
from .timebase import TIME_NAMES, time_column

PathLike = str | Path


@overload
def read_csv(path: PathLike, inputs: Names, outputs: Names, **options: Any) -> Recording: ...
@overload
def read_csv(path: Iterable[PathLike], inputs: Names, outputs: Names, **options: Any) -> tuple[Recording, ...]: ...
def read_csv(
    path: PathLike | Iterable[PathLike],
    inputs: Names,
    outputs: Names,
    *,
    columns: Mapping[str, str] | None = None,
    dt: float | None = None,
    time_tolerance: float | None = None,
    **recording_options: Any,
) -> Recording | tuple[Recording, ...]:
    """Read recordings from CSV files with a header row.

    Parameters
    ----------
    path : str or Path, or several
        One file, or a list of files with the same columns.
    inputs, outputs : str or sequence of str
        Names of the inputs and outputs, which are also their columns where `columns` does not say otherwise. No outputs
        (`()`) give a recording to simulate, not to fit.
    columns : mapping, optional
        Column by name, e.g. ``{"force": "u_vir_V"}``; the key ``"t"`` chooses the time column.
    dt : float, optional
        Step in seconds. Needed where there is no time column; where there is one, its step must agree within 0.1 %,
        which finds times that are not in seconds.
    time_tolerance : float, optional
        How far samples may lie off the uniform grid, in steps, beyond the rounding of the written times; 1e-4 by
        default.
    **recording_options
        Further fields of :class:`Recording`: `hold`, `initial`, `period`, `skip`, `units`, `name` (by default the
        file's).

    Returns
    -------
    recording : Recording, or tuple of Recording when several paths were given

    Raises
    ------
    InputError
        When a file, a column or a cell cannot be used.
    """
    request = request_of(inputs, outputs, columns=columns, dt=dt, time_tolerance=time_tolerance, **recording_options)
    return _each(path, request, _from_csv)


@overload
def read_mat(path: PathLike, inputs: Names, outputs: Names, **options: Any) -> Recording: ...
@overload
def read_mat(path: Iterable[PathLike], inputs: Names, outputs: Names, **options: Any) -> tuple[Recording, ...]: ...
def read_mat(
    path: PathLike | Iterable[PathLike], inputs: Names, outputs: Names, **options: Any
) -> Recording | tuple[Recording, ...]:
    """Read recordings from MATLAB files (up to version 7.2): one vector for time and for each input and output.

    Parameters, returned values and errors are those of :func:`read_csv`. A matrix with a row for each sample gives the
    channels ``name1, name2, ...``.
    """
    request = request_of(inputs, outputs, **options)
    return _each(path, request, lambda p, r: _from_arrays(p, mat_arrays(p), r))


@overload
def read_npz(path: PathLike, inputs: Names, outputs: Names, **options: Any) -> Recording: ...
@overload
def read_npz(path: Iterable[PathLike], inputs: Names, outputs: Names, **options: Any) -> tuple[Recording, ...]: ...
def read_npz(
    path: PathLike | Iterable[PathLike], inputs: Names, outputs: Names, **options: Any
) -> Recording | tuple[Recording, ...]:
    """Read recordings from NumPy archives (``numpy.savez``): one vector for time and for each input and output.

    Parameters, returned values and errors are those of :func:`read_csv`. A matrix with a row for each sample gives the
    channels ``name1, name2, ...``.
    """
    request = request_of(inputs, outputs, **options)
    return _each(path, request, lambda p, r: _from_arrays(p, npz_arrays(p), r))


@overload
def read(path: PathLike, inputs: Names, outputs: Names, **options: Any) -> Recording: ...
@overload
def read(path: Iterable[PathLike], inputs: Names, outputs: Names, **options: Any) -> tuple[Recording, ...]: ...
def read(
    path: PathLike | Iterable[PathLike], inputs: Names, outputs: Names, **options: Any
) -> Recording | tuple[Recording, ...]:
    """Read recordings with the reader for the file's suffix: .csv, .tsv, .txt or .dat, .mat, .npz.

    Parameters, returned values and errors are those of :func:`read_csv`; files of different kinds may be mixed.
    """
    if isinstance(path, (str, Path)):
        return _READERS[_suffix(Path(path))](path, inputs, outputs, **options)
    return tuple(read(p, inputs, outputs, **options) for p in path)


def column_names(path: PathLike, wanted: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the names of a file's columns or variables; `wanted` helps to find what separates those of a CSV file.

    Raises
    ------
    InputError
        When the file cannot be read.
    """
    content = _open(Path(path), wanted)
    return content.names if isinstance(content, CsvTable) else tuple(content)


def written_times(path: PathLike, columns: Mapping[str, str] | None = None) -> list[str] | None:
    """Return the times of a file as they are written there (an array's to the last digit); None without a time column.

    Raises
    ------
    InputError
        When the file cannot be read.
    """
    columns = columns or {}
    chosen = next((columns[name] for name in TIME_NAMES if name in columns), None)
    content = _open(Path(path), [chosen or "t"])
    if isinstance(content, CsvTable):
        time = time_column(content.names, chosen, str(path))
        return content.texts(time) if time else None
    time = time_column(list(content), chosen, str(path))
    if time is None:
        return None
    return [repr(t) for t in samples(content[time], time, Path(path))[:, 0].tolist()]


def _open(path: Path, wanted: Sequence[str]) -> CsvTable | dict[str, np.ndarray]:
    if (suffix := _suffix(path)) in (".mat", ".npz"):
        return mat_arrays(path) if suffix == ".mat" else npz_arrays(path)
    return read_table(path, lambda names: sum(name in names for name in wanted))


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in _READERS:
        existing_file(path)
        raise InputError(f"{path} has the suffix {suffix!r}; files named {', '.join(_READERS)} can be read.")
    return suffix


_READERS: dict[str, Callable[..., Recording]] = {
    **dict.fromkeys((".csv", ".tsv", ".txt", ".dat"), read_csv),
    ".mat": read_mat,
    ".npz": read_npz,
}


def _each(
    path: PathLike | Iterable[PathLike], request: Request, reader: Callable[[Path, Request], Recording]
) -> Recording | tuple[Recording, ...]:
    if isinstance(path, (str, Path)):
        return reader(Path(path), request)
    return tuple(reader(Path(p), request) for p in path)


def _from_csv(path: Path, request: Request) -> Recording:
    table = read_table(path, request.found_in)
    time, wanted = request.locate(table.names, str(path))
    numbers = table.columns([*wanted, time] if time else wanted)
    t = numbers[:, -1] if time else None
    dt = request.step(t, time, str(path), lambda k: f"line {table.line_of_row(k)}")
    n_u, n = len(request.inputs), len(wanted)
    return _recording(path, request, numbers[:, :n_u], numbers[:, n_u:n], dt, request.inputs, request.outputs)


def _from_arrays(path: Path, arrays: Mapping[str, np.ndarray], request: Request) -> Recording:
    time, wanted = request.locate(list(arrays), str(path))
    parts = [samples(arrays[name], name, path) for name in wanted]
    lengths = {name: len(part) for name, part in zip(wanted, parts, strict=True)}
    t = None
    if time is not None:
        t = samples(arrays[time], time, path)[:, 0]
        lengths[time] = len(t)
    if len(set(lengths.values())) > 1:
        counts = ", ".join(f"{name} {n}" for name, n in lengths.items())
        raise InputError(f"{path} has vectors of different lengths ({counts} samples); give all the same.")
    dt = request.step(t, time, str(path), lambda k: f"sample {k}")
    n_u = len(request.inputs)
    u, y = np.hstack(parts[:n_u]), np.hstack([np.empty((len(parts[0]), 0)), *parts[n_u:]])
    inputs = _channel_names(request.inputs, parts[:n_u])
    outputs = _channel_names(request.outputs, parts[n_u:])
    return _recording(path, request, u, y, dt, inputs, outputs)


def _channel_names(names: Sequence[str], parts: Sequence[np.ndarray]) -> tuple[str, ...]:
    pairs = zip(names, parts, strict=True)
    return tuple(f"{n}{i + 1}" if p.shape[1] > 1 else n for n, p in pairs for i in range(p.shape[1]))


def _recording(
    path: Path,
    request: Request,
    u: np.ndarray,
    y: np.ndarray,
    dt: float,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
) -> Recording:
    options = {"name": path.stem, **request.options}
    try:
        return Recording(u, y, dt, inputs, outputs, **options)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
