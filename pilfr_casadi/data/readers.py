"""Readers: CSV, ``.mat`` and ``.npz`` files into recordings.

A file holds one recording: a time column (``t``, ``t_s`` or ``time``, in seconds, uniform) and one column for each
input and output by name; other columns are ignored. Any fault of a file is reported in one sentence that names the
file, the column and the line.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, overload

import numpy as np

from .._base import InputError, existing_file, listed, positive
from .recording import Recording
from .tables import ArrayTable, CsvTable, read_csv_table, read_mat_table, read_npz_table
from .timebase import TIME_NAMES, refuse_other_unit, step_of, time_column

PathLike = str | Path
Names = Sequence[str] | str
Table = CsvTable | ArrayTable
CSV_SUFFIXES = (".csv", ".tsv", ".txt", ".dat")


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
        Names of the inputs and outputs, and of their columns unless `columns` maps them. Without outputs (`()`) the
        recording can be simulated but not fitted.
    columns : mapping, optional
        Column by name, e.g. ``{"force": "u_vir_V"}``; the key ``"t"`` chooses the time column.
    dt : float, optional
        Step in seconds. Needed if there is no time column; otherwise the times must agree with it within 0.1 %, which
        finds times that are not in seconds.
    time_tolerance : float, optional
        Allowed deviation of the times from a uniform grid, in steps, beyond the rounding of the written times; 1e-4 by
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
        If a file, a column or a cell cannot be used.
    """
    request = Request(inputs, outputs, columns, dt, time_tolerance, recording_options)
    return _read_each(path, request, lambda p: read_csv_table(p, request.wanted))


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
    return _read_each(path, Request.from_options(inputs, outputs, options), read_mat_table)


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
    return _read_each(path, Request.from_options(inputs, outputs, options), read_npz_table)


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
    request = Request.from_options(inputs, outputs, options)
    return _read_each(path, request, lambda p: _open_table(p, request.wanted))


def column_names(path: PathLike, wanted: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the names of a file's columns or variables; `wanted` helps to find the delimiter of a CSV file.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    return _open_table(Path(path), wanted).names


def written_times(path: PathLike, columns: Mapping[str, str] | None = None) -> list[str] | None:
    """Return the times of a file as they are written there (an array's to the last digit); None without a time column.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    columns = columns or {}
    chosen = next((columns[name] for name in TIME_NAMES if name in columns), None)
    table = _open_table(Path(path), [chosen or "t"])
    time = time_column(table.names, chosen, str(path))
    return table.texts(time) if time else None


@dataclass(frozen=True)
class Request:
    """The columns and options that a reader was called with, checked by themselves and against a file's columns."""

    inputs: Names
    outputs: Names
    columns: Mapping[str, str] | None = None
    dt: float | None = None
    time_tolerance: float | None = None
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for role in ("inputs", "outputs"):
            given = getattr(self, role)
            names = (given,) if isinstance(given, str) or not isinstance(given, Iterable) else tuple(given)
            if not all(isinstance(name, str) for name in names):
                raise InputError(f"{role}={given!r} was given; give the names of the columns.")
            object.__setattr__(self, role, names)
        if not self.inputs:
            raise InputError("a recording needs at least one input; name its column.")
        if not isinstance(self.columns or {}, Mapping):
            raise InputError(f"columns={self.columns!r} was given; give columns={{'NAME': 'COLUMN'}}.")
        for name in self.columns or {}:
            if name not in {*self.inputs, *self.outputs, *TIME_NAMES}:
                raise InputError(
                    f"a column is given for {name!r}, which is none of the inputs {listed(self.inputs)}, the "
                    f"outputs {listed(self.outputs)}, or t; correct the name."
                )
        if self.dt is not None:
            positive(self.dt, "dt", "the seconds from one sample to the next")
        if self.time_tolerance is not None:
            positive(self.time_tolerance, "time_tolerance", "the steps that samples may lie off the grid", zero=True)

    @classmethod
    def from_options(cls, inputs: Names, outputs: Names, options: Mapping[str, Any]) -> "Request":
        """Make a request from a reader's keyword arguments."""
        own = ("columns", "dt", "time_tolerance")
        rest = {key: value for key, value in options.items() if key not in own}
        return cls(inputs, outputs, options=rest, **{key: options[key] for key in own if key in options})

    def column(self, name: str) -> str:
        """Return the column of an input, an output or the time."""
        return (self.columns or {}).get(name, name)

    @property
    def wanted(self) -> list[str]:
        """The columns of the inputs and outputs."""
        return [self.column(name) for name in (*self.inputs, *self.outputs)]

    def locate(self, names: Sequence[str], source: str) -> tuple[str | None, list[str]]:
        """Return the time column, if any, and those of the inputs and outputs."""
        mapped = [column for name, column in (self.columns or {}).items() if name in TIME_NAMES]
        time = time_column(names, mapped[0] if mapped else None, source)
        wanted = self.wanted
        both = sorted({*map(self.column, self.inputs)} & {*map(self.column, self.outputs)})
        if both:
            raise InputError(f"{source}: column {both[0]!r} is taken both for an input and for an output; correct one.")
        if time in wanted:
            raise InputError(
                f"{source}: column {time!r} holds the time and cannot be an input or an output too; name another "
                "column, or say which one holds the time, as in columns={'t': 'COLUMN'}."
            )
        for role, column in zip((*self.inputs, *self.outputs), wanted, strict=True):
            if column not in names:
                hint = (
                    f"map it, as in columns={{'{role}': 'COLUMN'}}" if len(names) > 1 else "separate columns by commas"
                )
                raise InputError(f"{source} has no column {column!r}; it has {listed(names) or 'none'}: {hint}.")
        for name in [*wanted, time] if time else wanted:
            if list(names).count(name) > 1:
                raise InputError(f"{source} has {list(names).count(name)} columns named {name!r}; rename all but one.")
        if time is None and self.dt is None:
            refuse_other_unit(names, source)
            raise InputError(
                f"{source} has no time column; it has {listed(names)}: name one {' or '.join(TIME_NAMES)}, in "
                "seconds, or state the step with dt=STEP."
            )
        return time, wanted

    def recording(self, table: Table) -> Recording:
        """Make the recording from the columns of a file."""
        time, wanted = self.locate(table.names, str(table.path))
        parts = table.columns([*wanted, time] if time else wanted)
        if time is None:
            assert self.dt is not None
            dt = float(self.dt)
        else:
            label = f"{table.path}: column {time!r}"
            dt = step_of(parts.pop()[:, 0], label, table.place, dt=self.dt, tolerance=self.time_tolerance)
        n_u = len(self.inputs)
        u, y = np.hstack(parts[:n_u]), np.hstack([np.empty((len(parts[0]), 0)), *parts[n_u:]])
        names = _channel_names(self.inputs, parts[:n_u]), _channel_names(self.outputs, parts[n_u:])
        try:
            return Recording(u, y, dt, *names, **{"name": table.path.stem, **self.options})
        except InputError as error:
            raise InputError(f"{table.path}: {error}") from None


def _read_each(
    path: PathLike | Iterable[PathLike], request: Request, open_table: Callable[[Path], Table]
) -> Recording | tuple[Recording, ...]:
    if isinstance(path, PathLike):
        return request.recording(open_table(Path(path)))
    paths = tuple(path) if isinstance(path, Iterable) else (path,)
    if not all(isinstance(p, PathLike) for p in paths):
        raise InputError(f"the file {path!r} was given; give its path as text, or a list of paths.")
    return tuple(request.recording(open_table(Path(p))) for p in paths)


def _open_table(path: Path, wanted: Sequence[str]) -> Table:
    """Open a file by its suffix."""
    suffix = path.suffix.lower()
    if suffix in CSV_SUFFIXES:
        return read_csv_table(path, wanted)
    if suffix == ".mat":
        return read_mat_table(path)
    if suffix == ".npz":
        return read_npz_table(path)
    existing_file(path)
    suffixes = ", ".join((*CSV_SUFFIXES, ".mat", ".npz"))
    raise InputError(f"{path} has the suffix {suffix!r}; files named {suffixes} can be read.")


def _channel_names(names: Sequence[str], parts: Sequence[np.ndarray]) -> tuple[str, ...]:
    """Number the channels of a matrix: `u1, u2` for `u`."""
    pairs = zip(names, parts, strict=True)
    return tuple(f"{n}{i + 1}" if p.shape[1] > 1 else n for n, p in pairs for i in range(p.shape[1]))
