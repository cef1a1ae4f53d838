"""Open files of named columns by their suffix: CSV, MATLAB, NumPy, Parquet and MDF; errors name file and column.

Code in a ``.mat`` or ``.npz`` file is never run. A CSV file may have a byte-order mark and Windows line ends.
"""

import contextlib
import gc
import re
import sys
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from .._base import REPAIR, InputError, existing_file, quote_error, read_bytes, usable, without_mask
from .columns import ONE_STEP, TIME_NAMES, present_samples, refuse_slow_channels, unit_in_brackets
from .csv_table import CsvTable, parse_csv

Array = np.ndarray

CONTROL_CHARACTER = re.compile(rb"[\x00-\x08\x0b\x0e-\x1f]")
NO_UNIT = ("", "1", "-")  # units that files state for numbers without one
KINDS = {
    "c": "complex numbers",
    "V": "a struct",
    "O": "a cell array or objects",
    "U": "text",
    "S": "text",
    "M": "dates",
}


@dataclass(frozen=True)
class ArrayTable:
    """The variables of a file other than CSV.

    An entry of `arrays` is an array, a function that reads one, or the error of reading it, which is raised when the
    variable is used. `clocks` holds the times of each channel, s, in a file of several clocks; `units` holds the units
    that the file states.
    """

    path: Path
    names: tuple[str, ...]
    arrays: Mapping[str, Any]
    clocks: Mapping[str, Array] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)

    def columns(self, names: Sequence[str], time: str | None = None) -> list[Array]:
        """Return each named variable, and last the times, as finite numbers, (M, channels).

        A row vector becomes a column.
        """
        first = next(iter(self.clocks), "")
        for name, t in self.clocks.items():
            if not np.array_equal(t, self.clocks[first]):
                raise InputError(
                    f"{self.path}: the channels {first!r} and {name!r} have different times ({len(self.clocks[first])} "
                    f"and {len(t)} samples); {ONE_STEP}."
                )
        parts = self._columns(names, time)
        if any(np.isnan(part).any() for part in parts):
            refuse_slow_channels(self.path, names, parts)
            for name in names:
                self._samples(name)
        return parts

    def series(self, names: Sequence[str], time: str) -> list[tuple[Array, Array]]:
        """Return each named variable without its missing samples: their times (K,), s, and values (K, channels)."""
        if self.clocks:
            pairs = [(self.clocks[name], self._samples(name, may_miss=True)) for name in names]
        else:
            *parts, t = self._columns(names, time)
            pairs = [(t[:, 0], part) for part in parts]
        return [present_samples(self.path, name, *pair) for name, pair in zip(names, pairs, strict=True)]

    def unit(self, name: str) -> str:
        """Return the unit of a variable; empty if there is none."""
        return self.units.get(name, "") or unit_in_brackets(name)

    def _columns(self, names: Sequence[str], time: str | None) -> list[Array]:
        """Return each named variable, (M, channels), nan where a sample is missing; last the times, none missing."""
        parts = [self._samples(name, may_miss=True) for name in names]
        if time is not None:
            names, parts = [*names, time], [*parts, self._samples(time)]
        if len({len(part) for part in parts}) > 1:
            counts = ", ".join(f"{name} {len(part)}" for name, part in zip(names, parts, strict=True))
            raise InputError(f"{self.path} has vectors of different lengths ({counts} samples); give all the same.")
        return parts

    def texts(self, name: str) -> list[str]:
        """Return the numbers of a vector with all their digits."""
        return [repr(t) for t in self._samples(name)[:, 0].tolist()]

    def place(self, row: int) -> str:
        """Return the sample `row`, counted from 0, in words."""
        return f"sample {row}"

    def array(self, name: str) -> Array:
        """Return a variable as it is in the file."""
        values = self.arrays[name]
        if callable(values):
            try:
                values = values()
            except Exception as error:  # damaged files and odd types raise many kinds
                values = error
        if isinstance(values, Exception):
            raise InputError(f"{self.path}: variable {name!r} cannot be read ({_reason(values)}); write it again.")
        if hasattr(values, "toarray"):
            raise InputError(f"{self.path}: variable {name!r} is a sparse matrix; write it as a full one.")
        if not isinstance(values, np.ndarray):
            raise InputError(f"{self.path}: variable {name!r} is not an array; give a vector of real numbers.")
        return values

    def _samples(self, name: str, may_miss: bool = False) -> Array:
        """Return a variable as finite numbers, (M, channels); samples that `may_miss` are nan."""
        values = self.array(name)
        if values.dtype.kind not in "biuf" or values.ndim > 2 or values.size == 0:
            kind = KINDS.get(values.dtype.kind, f"{values.dtype} numbers")
            raise InputError(
                f"{self.path}: variable {name!r} holds {kind} of shape {values.shape}; give a vector of real numbers, "
                "or a matrix with a row for each sample."
            )
        column = values.reshape(-1, 1) if values.ndim < 2 or 1 in values.shape else values
        column = column.astype(float)
        bad = np.argwhere(~usable(column) & ~(may_miss & np.isnan(column)))
        if bad.size:
            k, i = bad[0]
            raise InputError(f"{self.path}: variable {name!r}, sample {k} is {column[k, i]}; {REPAIR}.")
        return column


def frame_table(frame: Any, wanted: Sequence[str]) -> ArrayTable:
    """Convert a data frame to named arrays; an index that holds times becomes a column.

    Dates and durations become seconds after the first one. Only `wanted` columns need distinct names.
    """
    columns = getattr(frame, "columns", None)
    by_name = columns is not None and all(isinstance(key, Hashable) for key in columns)  # Arrow lists the data there
    if isinstance(frame, Mapping) or not by_name or not hasattr(frame, "__getitem__"):
        raise InputError(f"a {type(frame).__name__} was given; give a data frame of pandas or polars.")
    names = [str(name) for name in frame.columns]
    arrays: dict[str, Any] = {}
    for key, name in zip(frame.columns, names, strict=True):
        if names.count(name) > 1 and name in wanted:
            raise InputError(f"the frame has {names.count(name)} columns named {name!r}; rename all but one.")
        arrays[name] = _seconds(without_mask(frame[key]))
    index = getattr(frame, "index", None)
    if index is not None and not {*TIME_NAMES} & {*names}:
        values, named = np.asarray(index), str(getattr(index, "name", None))
        times = _seconds(values)
        if times is not values or named in TIME_NAMES:
            arrays[named if named in TIME_NAMES else TIME_NAMES[0]] = times
    return ArrayTable(Path("the frame"), tuple(arrays), arrays)


def _seconds(values: Array) -> Array:
    """Convert dates and durations to seconds after the first one; return anything else unchanged.

    Dates in a time zone are objects.
    """
    if not values.size:
        return values
    if values.dtype.kind in "mM":
        return (values - values[0]) / np.timedelta64(1, "s")
    if values.dtype.kind != "O" or not all(isinstance(date, datetime) for date in values.flat):
        return values
    dates = [date.astimezone(UTC) if date.tzinfo else date for date in values.flat]  # some days have 23 hours
    try:
        return np.array([(date - dates[0]).total_seconds() for date in dates])
    except TypeError:  # some are in a time zone, and some in none
        return values


def open_table(path: Path, wanted: Sequence[str], suffix: str = "") -> CsvTable | ArrayTable:
    """Open a file by its suffix, or by another `suffix`; the `wanted` columns help to find a CSV file's delimiter."""
    suffix = suffix or path.suffix.lower()
    if suffix in OPENERS:
        return OPENERS[suffix](path, wanted)
    existing_file(path)
    raise InputError(f"{path} has the suffix {suffix!r}; give a file with one of {', '.join(OPENERS)}.")


def _open_csv(path: Path, wanted: Sequence[str]) -> CsvTable:
    return parse_csv(path, _read_text(path), wanted)


def _open_mat(path: Path, _wanted: Sequence[str]) -> ArrayTable:
    """Read the variables of a MATLAB file (up to version 7.2)."""
    from scipy.io import loadmat

    with _report_parser_errors(path, "a MATLAB file", "save it again with the option -v7"):
        try:
            content = loadmat(path)
        except NotImplementedError:
            raise InputError(f"{path} is a MATLAB file of version 7.3; save it with the option -v7.") from None
    arrays = {name: value for name, value in content.items() if not name.startswith("__")}
    return ArrayTable(path, tuple(arrays), arrays)


def _open_npz(path: Path, _wanted: Sequence[str] = ()) -> ArrayTable:
    arrays: dict[str, Any] = {}
    with _report_parser_errors(path, "a NumPy archive", "write it with numpy.savez"), path.open("rb") as file:
        content = np.load(file, allow_pickle=False)
        if isinstance(content, np.ndarray):
            raise ValueError("it holds a single array")
        for name in content.files:
            try:
                arrays[name] = content[name]
            except Exception as error:  # damaged, encrypted or odd members raise many kinds
                arrays[name] = error
    return ArrayTable(path, tuple(arrays), arrays)


def _open_parquet(path: Path, _wanted: Sequence[str]) -> ArrayTable:
    """Read the names of a Parquet file's columns; a column is read when it is needed."""
    with _report_parser_errors(path, "a Parquet file", "write it again"):
        try:
            from pyarrow import parquet
        except ImportError:
            raise InputError(f"{path} is a Parquet file; install pilfr-casadi[parquet] to read it.") from None
        names = tuple(parquet.read_schema(path).names)
    return ArrayTable(path, names, {name: partial(_parquet_column, path, names.index(name)) for name in names})


def _parquet_column(path: Path, index: int) -> Array:
    from pyarrow import parquet

    with parquet.ParquetFile(path) as file:
        name = file.schema_arrow.names[index]
        return _seconds(np.asarray(file.read([name]).column(0).to_numpy()))


def _open_mdf(path: Path, wanted: Sequence[str]) -> ArrayTable:
    """Read the `wanted` channels of an MDF file, in physical units, and the times of the first as ``t``."""
    with _report_parser_errors(path, "an MDF file", "save it again as MDF 4"):
        try:
            from asammdf import MDF
        except ImportError:
            raise InputError(f"{path} is an MDF file; install pilfr-casadi[mdf] to read it.") from None
        with _silent_destructors():
            mdf, failed = None, ""
            try:
                mdf = MDF(path)
            except Exception as error:  # damaged files raise many kinds
                failed = _reason(error)
            if failed:
                gc.collect()  # destroys it here
        if mdf is None:
            raise ValueError(failed)
        with mdf:
            masters = {mdf.groups[i].channels[k].name for i, k in mdf.masters_db.items()}
            names = [name for name in mdf.channels_db if name not in masters]
            signals = {name: mdf.get(name) for name in dict.fromkeys(wanted) if name in names}
            clocks = {name: signal.timestamps for name, signal in signals.items()}
            times = next(iter(clocks.values())) if clocks else mdf.get_master(0)
    arrays = {"t": times, **{name: signal.samples for name, signal in signals.items()}}
    units = {name: signal.unit.strip() for name, signal in signals.items() if signal.unit.strip() not in NO_UNIT}
    return ArrayTable(path, tuple(dict.fromkeys(["t", *names])), arrays, clocks, units)


@contextlib.contextmanager
def _silent_destructors() -> Iterator[None]:
    """Print no tracebacks of objects that fail when they are destroyed, as half-opened MDF files do."""
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        yield
    finally:
        sys.unraisablehook = hook


# file suffix: the function that opens such a file
OPENERS: dict[str, Callable[[Path, Sequence[str]], CsvTable | ArrayTable]] = {
    **dict.fromkeys((".csv", ".tsv", ".txt", ".dat"), _open_csv),
    ".mat": _open_mat,
    ".npz": _open_npz,
    ".parquet": _open_parquet,
    **dict.fromkeys((".mf4", ".mdf"), _open_mdf),
}
STACK_SUFFIXES = (".npz", ".npy")  # files that may hold several records in one array; see `read_stack`
TABLE_SUFFIXES = (*OPENERS, ".npy")  # recordings, not simulators


@contextlib.contextmanager
def _report_parser_errors(path: Path, kind: str, remedy: str) -> Iterator[None]:
    """Turn any error of a parser into a sentence; damaged files raise many kinds."""
    existing_file(path)
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{path} cannot be read as {kind} ({_reason(error)}); {remedy}.") from None


def read_stack(path: Path, inputs: Sequence[str], outputs: Sequence[str]) -> tuple[Array, Array | None] | None:
    """Read several records in one array: samples, channels, and further axes such as realizations and periods.

    An .npz file holds one array for all inputs, named `u` for `u1, u2, u3`, and optionally one for all outputs; an .npy
    file holds the inputs alone. Return the inputs (M, n_u, ...) and the outputs (M, n_y, ...) or None. If the file
    holds a single record, return None.
    """
    y: Array | None = None
    if path.suffix.lower() == ".npy":
        with _report_parser_errors(path, "a NumPy array", "write it with numpy.save"), path.open("rb") as file:
            u = np.asarray(np.load(file, allow_pickle=False))
        u = u if u.ndim > 2 else u.reshape(*u.shape, *(1,) * (3 - u.ndim))
    else:
        table = _open_npz(path)
        found = [table.array(name) if name in table.arrays else None for name in map(_array_name, (inputs, outputs))]
        if found[0] is None or found[0].ndim < 3:
            return None
        u, y = found[0], found[1]
    for x, names, what in ((u, inputs, "inputs"), (y, outputs, "outputs")):
        if x is None:
            continue
        if x.dtype.kind not in "biuf" or x.size == 0 or not np.all(usable(x)):
            raise InputError(f"{path}: the array of the {what} has values that are not finite numbers; repair it.")
        if x.ndim != u.ndim or x.shape != (len(u), x.shape[1], *u.shape[2:]) or len(names) not in (1, x.shape[1]):
            raise InputError(
                f"{path}: the array of the {what} has the shape {x.shape}; expected (samples, {len(names)} channels, "
                f"...) with the axes of the inputs, {u.shape}."
            )
    return u.astype(float), None if y is None else y.astype(float)


def _array_name(names: Sequence[str]) -> str:
    """Return the name of the array that holds all these channels: `u` for `u1, u2, u3`."""
    if len(names) > 1 and all(name == f"{names[0][:-1]}{i + 1}" for i, name in enumerate(names)):
        return names[0][:-1]
    return names[0]


def _reason(error: Exception) -> str:
    """Return the first line of a parser's error as part of a sentence."""
    text = quote_error(error, 0)
    return "it holds Python objects, which are not read because they can run code" if "pickle" in text else text


def _read_text(path: Path) -> str:
    raw = read_bytes(path)
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InputError(f"{path} is UTF-16 text; save it as UTF-8.")
    if CONTROL_CHARACTER.search(raw, 0, 65536):
        is_csv = OPENERS.get(path.suffix.lower(), _open_csv) is _open_csv
        remedy = "give a CSV file, or name it .mat or .npz if it is one" if is_csv else "read it with pilfr.read"
        raise InputError(f"{path} is not text (it holds binary data); {remedy}.")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("latin-1")  # an older instrument's degree or micro sign
    return text.replace("\r\n", "\n").replace("\r", "\n")
