"""Read recordings from CSV, ``.mat``, ``.npz``, Parquet and MDF files, and from frames of pandas or polars.

A file holds one recording: a time column (``t``, ``t_s``, ``time`` or ``time [s]``, uniform, in seconds; in a CSV file
or a frame also dates) and one column for each input and output by name, with or without its unit in brackets; other
columns are ignored. One sentence reports a fault of a file; it names the file, the column and the line.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any, overload

import numpy as np

from .._base import InputError, listed, positive
from .columns import TIME_NAMES, find_column, find_time_column, refuse_other_unit
from .csv_table import CsvTable
from .holds import hold_at, levels_last
from .preprocessing import check_times, common_times, interpolate_at
from .recording import Recording, as_tuple
from .tables import ArrayTable, frame_table, open_table
from .time_grid import step_of

PathLike = str | Path
Paths = PathLike | Iterable[PathLike]
Names = Sequence[str] | str
Recordings = Recording | tuple[Recording, ...]  # a tuple if several paths were given

TIME_WORDS = ("time", "zeit", "temps", "tiempo", "tempo", "clock", "seconds")  # parts of the names of time columns
MOST_TRIED = 5  # columns that are read to find an unnamed time, at most


@overload
def read_csv(path: PathLike, inputs: Names, outputs: Names, **options: Any) -> Recording: ...
@overload
def read_csv(path: Iterable[PathLike], inputs: Names, outputs: Names, **options: Any) -> tuple[Recording, ...]: ...
def read_csv(
    path: Paths,
    inputs: Names,
    outputs: Names,
    *,
    columns: Mapping[str, str] | None = None,
    dt: float | None = None,
    time_tolerance: float | None = None,
    resample: float | None = None,
    **recording_options: Any,
) -> Recordings:
    """Read recordings from CSV files with a header row.

    Lines of a title may stand above the header, and a row of units below it. Times may be dates such as
    ``2024-05-01T10:00:00.25``; they become seconds after the first one.

    Parameters
    ----------
    path : str or Path, or several
        One file, or a list of files with the same columns.
    inputs, outputs : str or sequence of str
        Names of the inputs and outputs, and of their columns unless `columns` maps them. A unit behind a column's name,
        as in ``force [N]`` or ``force (N)``, becomes the unit of the channel. Without inputs (`()`) the recording is a
        free motion, such as a decay. Without outputs it can be simulated but not fitted.
    columns : mapping, optional
        Column by name, e.g. ``{"force": "u_vir_V"}``; the key ``"t"`` chooses the time column.
    dt : float, optional
        Step in seconds. Required without a time column; otherwise the times must agree with it within 0.1 %, which
        reveals times that are not in seconds.
    time_tolerance : float, optional
        Allowed deviation of the times from a uniform grid, in steps, beyond the rounding of the written times; 1e-4 by
        default.
    resample : float, optional
        New step in seconds, for times that are not uniform, and for channels of different rates, whose cells are empty
        or nan between their samples. Each channel is interpolated from its own samples, over the time that all cover;
        an anti-alias filter precedes a longer step. With ``hold="zero"`` an input becomes its mean over each step, and
        is held; with ``hold="next"`` it becomes its mean over the step that ends at each sample. A gap longer than ten
        median steps is refused.
    **recording_options
        Further fields of :class:`Recording`: `hold`, `initial`, `period`, `skip`, `units`, and `name` (by default the
        file's name).

    Returns
    -------
    recording : Recording, or tuple of Recording when several paths were given

    Raises
    ------
    InputError
        If a file, a column or a cell cannot be used.
    """
    options = dict(columns=columns, dt=dt, time_tolerance=time_tolerance, resample=resample, **recording_options)
    return _read_each(path, _Request(inputs, outputs, **options), ".csv")


@overload
def read_mat(path: PathLike, inputs: Names, outputs: Names, **options: Any) -> Recording: ...
@overload
def read_mat(path: Iterable[PathLike], inputs: Names, outputs: Names, **options: Any) -> tuple[Recording, ...]: ...
def read_mat(path: Paths, inputs: Names, outputs: Names, **options: Any) -> Recordings:
    """Read recordings from MATLAB files (up to version 7.2): one vector for time and for each input and output.

    Parameters, returned values and errors are the same as for :func:`read_csv`. A matrix with one row per sample holds
    the channels ``name1, name2, ...``.
    """
    return _read_each(path, _Request(inputs, outputs, **options), ".mat")


@overload
def read_npz(path: PathLike, inputs: Names, outputs: Names, **options: Any) -> Recording: ...
@overload
def read_npz(path: Iterable[PathLike], inputs: Names, outputs: Names, **options: Any) -> tuple[Recording, ...]: ...
def read_npz(path: Paths, inputs: Names, outputs: Names, **options: Any) -> Recordings:
    """Read recordings from NumPy archives (``numpy.savez``); otherwise as :func:`read_mat`."""
    return _read_each(path, _Request(inputs, outputs, **options), ".npz")


@overload
def read(path: PathLike, inputs: Names, outputs: Names, **options: Any) -> Recording: ...
@overload
def read(path: Iterable[PathLike], inputs: Names, outputs: Names, **options: Any) -> tuple[Recording, ...]: ...
def read(path: Paths, inputs: Names, outputs: Names, **options: Any) -> Recordings:
    """Read recordings with the reader for the file's suffix.

    The suffixes are .csv, .tsv, .txt or .dat, .mat, .npz, .parquet, .mf4 and .mdf. Parquet files need
    ``pilfr-casadi[parquet]``, MDF files ``pilfr-casadi[mdf]``. The column ``t`` of an MDF file holds the times of its
    channels; channels of different times need `resample`. Parameters, returned values and errors are the same as for
    :func:`read_csv`; a list may mix kinds of files.
    """
    return _read_each(path, _Request(inputs, outputs, **options))


def read_frame(
    frame: Any, inputs: Names, outputs: Names, *, columns: Mapping[str, str] | None = None, **options: Any
) -> Recording:
    """Make a recording from a data frame of pandas or polars, or from any table whose `columns` are named arrays.

    Parameters
    ----------
    frame : DataFrame
        A column for each input and output, and a time column: seconds, or dates or durations, which become seconds
        after the first one. Without a time column, the index of a pandas frame is the time if it has the name of a
        time column, or holds dates or durations.
    inputs, outputs, columns, **options
        As for :func:`read_csv`.

    Raises
    ------
    InputError
        If `frame` is not a data frame, or a column or a value cannot be used.
    """
    request = _Request(inputs, outputs, columns=columns, **{"name": "", **options})
    return request.recording(frame_table(frame, request.wanted))


def column_names(path: PathLike, wanted: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the names of a file's columns or variables; `wanted` helps to find the delimiter of a CSV file.

    A column with a unit behind a wanted name, such as ``force [N]``, is returned by the wanted name.
    """
    names = open_table(Path(path), wanted).names
    short = {find_column(name, names): name for name in wanted}
    return tuple(short.get(name, name) for name in names)


def written_times(
    path: PathLike, columns: Mapping[str, str] | None = None, wanted: Sequence[str] = ()
) -> list[str] | None:
    """Return the times of a file as text, all digits included; None if it has no time column.

    The other `wanted` columns help to find the header of a CSV file.
    """
    columns = columns or {}
    chosen = next((columns[name] for name in TIME_NAMES if name in columns), None)
    table = open_table(Path(path), [*wanted, chosen] if chosen else wanted)
    time = find_time_column(table.names, chosen, str(path))
    return table.texts(time) if time else None


class _Request:
    """The columns and options of a call to a reader; checks them, also against the columns of a file."""

    def __init__(
        self,
        inputs: Names,
        outputs: Names,
        columns: Mapping[str, str] | None = None,
        dt: float | None = None,
        time_tolerance: float | None = None,
        resample: float | None = None,
        **options: Any,
    ) -> None:
        self.inputs, self.outputs = _check_names(inputs, "inputs"), _check_names(outputs, "outputs")
        self.dt, self.time_tolerance, self.new_step, self.options = dt, time_tolerance, resample, options
        known = [f.name for f in fields(Recording) if f.name not in ("u", "y", "dt", "inputs", "outputs")]
        for name in options:
            if name not in known:
                raise InputError(f"{name!r} is not an option of a reader; the options are {listed(known)}.")
        if not isinstance(columns or {}, Mapping):
            raise InputError(f"columns={columns!r} was given; give columns={{'NAME': 'COLUMN'}}.")
        if not isinstance(options.get("units") or {}, Mapping):
            raise InputError(f"units={options['units']!r} was given; give units={{'NAME': 'UNIT'}}.")
        self.columns = {name: str(column) for name, column in (columns or {}).items()}  # pandas has numbers as names
        for name in self.columns:
            if name not in {*self.inputs, *self.outputs, *TIME_NAMES}:
                raise InputError(
                    f"a column is given for {name!r}, which is none of the inputs {listed(self.inputs)}, the "
                    f"outputs {listed(self.outputs)}, or t; correct the name."
                )
        if dt is not None:
            positive(dt, "dt", "the seconds from one sample to the next")
        if resample is not None:
            positive(resample, "resample", "the new step in seconds")
            if dt is not None or time_tolerance is not None:
                raise InputError(
                    "resample was given with dt or time_tolerance, but it makes times uniform; leave the others out."
                )
        if time_tolerance is not None:
            positive(
                time_tolerance, "time_tolerance", "the allowed deviation of samples from the grid, in steps", zero=True
            )

    def column(self, name: str) -> str:
        """Return the column of an input or an output."""
        return self.columns.get(name, name)

    @property
    def wanted(self) -> list[str]:
        """The columns of the inputs and outputs."""
        return [self.column(name) for name in (*self.inputs, *self.outputs)]

    @property
    def wanted_and_time(self) -> list[str]:
        """These columns, and that of the time if it has another name."""
        return [*self.wanted, *(column for name, column in self.columns.items() if name in TIME_NAMES)]

    def locate(self, table: CsvTable | ArrayTable) -> tuple[str | None, list[str]]:
        """Return the time column, or None, and the columns of the inputs and outputs."""
        names, source = table.names, str(table.path)
        mapped = [column for name, column in self.columns.items() if name in TIME_NAMES]
        time = find_time_column(names, mapped[0] if mapped else None, source)
        wanted = [find_column(column, names) for column in self.wanted]
        both = sorted({*map(self.column, self.inputs)} & {*map(self.column, self.outputs)})
        if both:
            raise InputError(
                f"{source}: column {both[0]!r} is given both for an input and for an output; correct one of them."
            )
        if time in wanted:
            raise InputError(
                f"{source}: column {time!r} holds the time and cannot be an input or an output too; name another "
                "column, or map the time column, as in columns={'t': 'COLUMN'}."
            )
        for role, column in zip((*self.inputs, *self.outputs), wanted, strict=True):
            if column not in names:
                like = next((name for name in names if name.lower().startswith(column.lower())), "COLUMN")
                hint = (
                    f"map it, as in columns={{'{role}': '{like}'}}" if len(names) > 1 else "separate columns by commas"
                )
                if role in self.outputs and len(names) > 1:
                    hint += "; without such a sensor, remove it from the outputs, also from the simulator's"
                raise InputError(f"{source} has no column {column!r}; it has {listed(names) or 'none'}: {hint}.")
        for name in [*wanted, time] if time else wanted:
            if list(names).count(name) > 1:
                raise InputError(f"{source} has {list(names).count(name)} columns named {name!r}; rename all but one.")
        if not wanted and (time is None or self.new_step is not None):
            raise InputError(f"{source} is read without inputs and outputs, for its times alone; name a time column.")
        if time is None and self.dt is None:
            refuse_other_unit(names, source)
            raise InputError(
                f"{source} has no time column; it has {listed(names)}: name one {' or '.join(TIME_NAMES)}, in seconds, "
                f"map one, as in columns={{'t': {_guess_time(table, wanted)!r}}}, or state the step with dt=STEP."
            )
        return time, wanted

    def recording(self, table: CsvTable | ArrayTable) -> Recording:
        """Make the recording from the columns of a file."""
        time, wanted = self.locate(table)
        hold = self.options.get("hold")
        if self.new_step is not None:
            assert time is not None
            dt = float(self.new_step)
            parts, hold = self._resample(table, wanted, time, dt)
        elif time is None:
            assert self.dt is not None
            dt, parts = float(self.dt), table.columns(wanted)
        else:
            *parts, t = table.columns(wanted, time)
            label = f"{table.path}: column {time!r}"
            dt = step_of(t[:, 0], label, table.place, dt=self.dt, tolerance=self.time_tolerance)
        n_u = len(self.inputs)
        none = np.empty((len(parts[0] if parts else t), 0))  # times alone, or no input, or no output
        u, y = np.hstack([none, *parts[:n_u]]), np.hstack([none, *parts[n_u:]])
        names = _channel_names(self.inputs, parts[:n_u]), _channel_names(self.outputs, parts[n_u:])
        found = zip((*self.inputs, *self.outputs), map(table.unit, wanted), strict=True)
        units = {name: unit for name, unit in found if unit and name in names[0] + names[1]}
        units |= self.options.get("units") or {}
        try:
            name = table.path.stem.encode(errors="replace").decode()  # a name on disk need not be text
            options = {"name": name, **self.options, "hold": hold, "units": units}
            return Recording(u, y, dt, *names, **options)
        except InputError as error:
            raise InputError(f"{table.path}: {error}") from None

    def _resample(
        self, table: CsvTable | ArrayTable, wanted: list[str], time: str, step: float
    ) -> tuple[list[np.ndarray], str | None]:
        """Bring each channel from its own samples to a common step, s; return them and the inputs' hold.

        Inputs stay held if they are, and their levels usually last at least a step. Next values become means.
        """
        hold, n_u = self.options.get("hold"), len(self.inputs)
        series = table.series(wanted, time)
        inputs = [(t, column) for t, values in series[:n_u] for column in values.T]
        held = hold == "zero" and all(levels_last(t, column, step) for t, column in inputs)
        for i, (column, (t, _)) in enumerate(zip(wanted, series, strict=True)):
            check_times(t, step, f"{table.path}: column {column!r}", held and i < n_u)
        first, last = min(t[0] for t, _ in series), max(t[-1] for t, _ in series)
        spans = [(t[0], last if held and i < n_u else t[-1]) for i, (t, _) in enumerate(series)]
        try:
            times = common_times(spans, step)
        except InputError as error:
            raise InputError(f"{table.path}: {error}") from None
        stated = self.options.get("initial", "estimate")
        if times[0] > first and not (isinstance(stated, str) and stated == "estimate"):
            raise InputError(
                f"{table.path}: the channels have values together from {times[0]:.6g} s on, but initial was stated for "
                f"{first:.6g} s; leave initial out, or give each channel a value there."
            )
        parts = []
        for i, (t, values) in enumerate(series):
            means = i < n_u and (held or hold == "next")
            bring = partial(hold_at, hold=hold) if means else partial(interpolate_at, smooth=i >= n_u)
            parts.append(np.column_stack([bring(t, column, times, step) for column in values.T]))
        return parts, "linear" if hold == "zero" and not held else hold


def _check_names(given: Any, role: str) -> tuple[str, ...]:
    names = as_tuple(given)
    if not all(isinstance(name, str) for name in names):
        raise InputError(f"{role}={given!r} was given; give the names of the columns.")
    return names


def _read_each(path: Paths, request: _Request, suffix: str = "") -> Recordings:
    """Read one file, or several into a tuple; a `suffix` overrides that of the files."""
    if isinstance(path, PathLike):
        return request.recording(open_table(Path(path), request.wanted_and_time, suffix))
    paths = tuple(path) if isinstance(path, Iterable) else (path,)
    if not all(isinstance(p, PathLike) for p in paths):
        raise InputError(f"the file {path!r} was given; give its path as text, or a list of paths.")
    return tuple(request.recording(open_table(Path(p), request.wanted_and_time, suffix)) for p in paths)


def _channel_names(names: Sequence[str], parts: Sequence[np.ndarray]) -> tuple[str, ...]:
    """Number the channels of a matrix: `u1, u2` for `u`."""
    pairs = zip(names, parts, strict=True)
    return tuple(f"{n}{i + 1}" if p.shape[1] > 1 else n for n, p in pairs for i in range(p.shape[1]))


def _guess_time(table: CsvTable | ArrayTable, wanted: Sequence[str]) -> str:
    """Return the column that most likely holds the time: by its name, else the first one that rises evenly."""
    others = [name for name in table.names if name not in wanted]
    named = [name for name in others if {*re.findall(r"[a-z]+", name.lower())} & {*TIME_WORDS}]
    if named:
        return named[0]
    for name in others[:MOST_TRIED]:
        try:
            step_of(table.columns([name])[0][:, 0], name, str)
        except InputError:
            continue
        return name
    return "COLUMN"
