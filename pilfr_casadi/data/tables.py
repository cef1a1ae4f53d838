"""Read named columns of numbers from CSV, MATLAB, NumPy, Parquet and MDF files; errors name the file, column and line.

NumPy reads a CSV file at once; only if that fails, the file is read cell by cell to find the bad cell. Commas,
semicolons and tabs separate cells; a byte-order mark, Windows line ends, quoted cells, blank lines, lines of a title
above the header and a row of units below it are accepted. Lines are counted as in an editor. Code in a ``.mat`` or
``.npz`` file is never run.
"""

import contextlib
import csv
import gc
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from .._base import REPAIR, InputError, existing_file, read_bytes, usable
from .units import dimension

Array = np.ndarray

CONTROL_CHARACTER = re.compile(rb"[\x00-\x08\x0b\x0e-\x1f]")
DELIMITERS = {",": "comma", ";": "semicolon", "\t": "tab"}
TIME_NAMES = ("t", "t_s", "time")
WITH_UNIT = re.compile(r"(.*\S)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\))\s*")  # such as "force [N]" or "speed (rad/s)"
_IN_SECONDS = re.compile(r"(?:t|time)\s*[\[(]\s*(?:s|sec|secs|seconds?)\s*[\])]", re.IGNORECASE)
NO_UNIT = ("", "1", "-")  # units that files state for numbers without one
ONE_STEP = "bring all channels to one step with resample=STEP"
LONGEST_TITLE = 100  # lines above the header of a CSV file, at most
KINDS = {
    "c": "complex numbers",
    "V": "a struct",
    "O": "a cell array or objects",
    "U": "text",
    "S": "text",
    "M": "dates",
}


@dataclass(frozen=True)
class CsvTable:
    """The text of a CSV file: the lines below its header, and the number of the first of these lines in the file."""

    path: Path
    names: tuple[str, ...]
    delimiter: str
    lines: list[str]
    first_line: int

    def columns(self, names: Sequence[str], time: str | None = None) -> list[Array]:
        """Return each named column as finite numbers, (M, 1); last the times, s, where dates count from the first."""
        parts = self._columns(names, time)
        if any(np.isnan(part).any() for part in parts):
            _refuse_slow_channels(self.path, names, parts)
            self._read_cells([self.names.index(name) for name in names], np.zeros(len(names), dtype=bool))
        return parts

    def series(self, names: Sequence[str], time: str) -> list[tuple[Array, Array]]:
        """Return each named column without its missing samples: their times (K,), s, and values (K, 1)."""
        *parts, t = self._columns(names, time)
        return [_present(self.path, name, t[:, 0], part) for name, part in zip(names, parts, strict=True)]

    def unit(self, name: str) -> str:
        """Return the unit of a column; empty if there is none."""
        return unit_in_brackets(name)

    def _columns(self, names: Sequence[str], time: str | None) -> list[Array]:
        """Return each named column as numbers, (M, 1), nan where one is missing; last the times, none missing."""
        if time is not None and self._has_dates(time):
            return [*self._columns(names, None), self._count_seconds(time)]
        names = [*names, time] if time is not None else names
        where = [self.names.index(name) for name in names]
        may_miss = np.array([name != time for name in names])
        numbers = self._read_at_once(where, self.lines)
        if numbers is None:
            empty = rf"^(?={self.delimiter})|(?<={self.delimiter})(?={self.delimiter}|$)"
            numbers = self._read_at_once(where, [re.sub(empty, "nan", line) for line in self.lines])
        if numbers is None or not (usable(numbers) | (may_miss & np.isnan(numbers))).all():
            numbers = self._read_cells(where, may_miss)
        return [numbers[:, i : i + 1] for i in range(len(names))]

    def texts(self, name: str) -> list[str]:
        """Return the cells of a column as they are written."""
        where = self.names.index(name)
        return [_cells(text, self.delimiter, str(self.path))[where] for text in self.lines if text.strip()]

    def _has_dates(self, name: str) -> bool:
        """Tell whether a column begins with a date."""
        cells = _cells(next(text for text in self.lines if text.strip()), self.delimiter, str(self.path))
        return len(cells) == len(self.names) and _date(cells[self.names.index(name)]) is not None

    def _count_seconds(self, name: str) -> Array:
        """Return a column of dates as seconds after the first one, (M, 1)."""
        cells = self.texts(name)
        dates = [_date(cell) for cell in cells]
        first = dates[0]
        assert first is not None
        for row, date in enumerate(dates):
            if date is None or (date.tzinfo is None) != (first.tzinfo is None):
                raise InputError(
                    f"{self.path}: column {name!r}, {self.place(row)} reads {cells[row][:40]!r}, but the column begins "
                    f"with {cells[0]!r}; write all times in one way."
                )
        return np.array([[(date - first).total_seconds()] for date in dates if date is not None])

    def place(self, row: int) -> str:
        """Return the line of the data row `row`, counted from 0, in words."""
        rows = [i for i, line in enumerate(self.lines) if line.strip()]
        return f"line {self.first_line + rows[row]}"

    def _read_at_once(self, where: Sequence[int], lines: Sequence[str]) -> Array | None:
        width = len(self.names) - 1
        if any('"' in line or line.count(self.delimiter) != width for line in lines if line.strip()):
            return None
        try:
            return np.loadtxt(lines, delimiter=self.delimiter, usecols=where, ndmin=2, comments=None)
        except ValueError:
            return None

    def _read_cells(self, where: Sequence[int], may_miss: Array) -> Array:
        """Read columns cell by cell; empty cells of columns that may miss samples become nan."""
        rows = []
        for line, text in enumerate(self.lines, self.first_line):
            if not text.strip():
                continue
            cells = _cells(text, self.delimiter, f"{self.path}: line {line}")
            if len(cells) != len(self.names):
                raise InputError(
                    f"{self.path}: line {line} has {len(cells)} cell(s) but the header names {len(self.names)}; "
                    f"{self._wrong_count(cells)}."
                )
            rows.append(
                [
                    np.nan if may and cells[i].lower() in ("", "nan") else self._value(cells[i], self.names[i], line)
                    for i, may in zip(where, may_miss, strict=True)
                ]
            )
        return np.array(rows)

    def _wrong_count(self, cells: Sequence[str]) -> str:
        """Advise what to do about a line with another number of cells than the header."""
        advice = f"give every line one cell for each column, separated by {DELIMITERS[self.delimiter]}s"
        if self.delimiter == "," and len(cells) > len(self.names) and all(map(str.isdigit, cells[1::2])):
            advice += "; if its decimals are written with commas, write them with points"
        return advice

    def _value(self, cell: str, column: str, line: int) -> float:
        place = f"{self.path}: column {column!r}, line {line}"
        value = _number(cell)
        if value is None:
            if not cell.strip():
                raise InputError(f"{place} is empty; fill in a number or cut out that piece.")
            hint = "write a number there"
            if cell.count(",") == 1 and cell.replace(",", "").strip(" +-").isdigit():
                hint = "write all decimals with a point"
            raise InputError(f"{place} reads {cell.strip()[:40]!r}, which is not a number; {hint}.")
        if not usable(np.array(value)):
            raise InputError(f"{place} is {cell.strip()}; {REPAIR}.")
        return value


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
            _refuse_slow_channels(self.path, names, parts)
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
        return [_present(self.path, name, *pair) for name, pair in zip(names, pairs, strict=True)]

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


def _present(path: Path, name: str, t: Array, values: Array) -> tuple[Array, Array]:
    """Leave out the samples of a channel at which a value is missing."""
    there = ~np.isnan(values).any(axis=1)
    if np.count_nonzero(there) < 2:
        raise InputError(f"{path}: column {name!r} has {np.count_nonzero(there)} number(s); at least 2 are needed.")
    return t[there], values[there]


def _refuse_slow_channels(path: Path, names: Sequence[str], parts: Sequence[Array]) -> None:
    """Refuse channels that usually miss samples between two others, rather than here and there."""
    for name, part in zip(names, parts, strict=False):
        there = np.flatnonzero(~np.isnan(part).any(axis=1))
        if len(there) > 1 and np.median(np.diff(there)) >= 2:
            raise InputError(
                f"{path}: column {name!r} has numbers in {len(there)} of {len(part)} rows, as a channel of a slower "
                f"rate; {ONE_STEP}."
            )


def frame_table(frame: Any, time_names: Sequence[str], wanted: Sequence[str]) -> ArrayTable:
    """Convert a data frame to named arrays; an index that holds times becomes a column.

    Dates and durations become seconds after the first one. Only `wanted` columns need distinct names.
    """
    if isinstance(frame, Mapping) or not hasattr(frame, "columns") or not hasattr(frame, "__getitem__"):
        raise InputError(f"a {type(frame).__name__} was given; give a data frame of pandas or polars.")
    names = [str(name) for name in frame.columns]
    arrays: dict[str, Any] = {}
    for key, name in zip(frame.columns, names, strict=True):
        if names.count(name) > 1 and name in wanted:
            raise InputError(f"the frame has {names.count(name)} columns named {name!r}; rename all but one.")
        arrays[name] = _seconds(np.asarray(frame[key]))
    index = getattr(frame, "index", None)
    if index is not None and not {*time_names} & {*names}:
        values, named = np.asarray(index), str(getattr(index, "name", None))
        if values.dtype.kind in "mM" or named in time_names:
            arrays[named if named in time_names else time_names[0]] = _seconds(values)
    return ArrayTable(Path("the frame"), tuple(arrays), arrays)


def _seconds(values: Array) -> Array:
    """Convert dates and durations to seconds after the first one; return anything else unchanged."""
    return (values - values[0]) / np.timedelta64(1, "s") if values.dtype.kind in "mM" and len(values) else values


def open_table(path: Path, wanted: Sequence[str] = (), suffix: str = "") -> CsvTable | ArrayTable:
    """Open a file by its suffix, or by another `suffix`; the `wanted` columns help to find a CSV file's delimiter."""
    suffix = suffix or path.suffix.lower()
    if suffix in OPENERS:
        return OPENERS[suffix](path, wanted)
    existing_file(path)
    raise InputError(f"{path} has the suffix {suffix!r}; give a file with one of {', '.join(OPENERS)}.")


def _open_csv(path: Path, wanted: Sequence[str]) -> CsvTable:
    """Find the header: the line that names most of the `wanted` columns, or the first; read the names and units."""
    lines = _text(path).split("\n")
    written = [i for i, line in enumerate(lines) if line.strip()]
    if not written:
        raise InputError(f"{path} is empty; give a CSV file with a header row and one row for each sample.")
    top, delimiter, names = _find_header(path, lines, written[:LONGEST_TITLE], wanted)
    if all(_number(name) is not None for name in names):
        raise InputError(
            f"{path} has no header row: line {top + 1} reads {lines[top].strip()[:60]!r}; name the columns there."
        )
    rows = [i for i in written if i > top]
    if rows and (units := _read_units(_cells(lines[rows[0]], delimiter, f"{path}: line {rows[0] + 1}"), names)):
        names = tuple(f"{name} [{unit}]" if unit else name for name, unit in zip(names, units, strict=True))
        top = rows.pop(0)
    if not rows:
        raise InputError(f"{path} has a header but no data below it; give one row for each sample.")
    return CsvTable(path, names, delimiter, _with_decimal_points(lines[top + 1 :], delimiter), top + 2)


def _with_decimal_points(lines: list[str], delimiter: str) -> list[str]:
    """Replace decimal commas by points, unless they may separate cells or thousands, or a number has a point."""
    if delimiter == "," or not any("," in line for line in lines):
        return lines
    text = "\n".join(lines)
    decimal = r"(?<![\d,])(\d*),(\d*)(?![\d,])"
    if all(len(end) == 3 and 0 < len(begin) <= 3 and begin[0] != "0" for begin, end in set(re.findall(decimal, text))):
        return lines
    with_point = rf'(?:^|{delimiter})[ "]*[+-]?\d*\.\d*(?:[eE][+-]?\d+)?[ "]*(?:$|{delimiter})'
    return lines if re.search(with_point, text, re.MULTILINE) else re.sub(decimal, r"\1.\2", text).split("\n")


def _find_header(
    path: Path, lines: Sequence[str], written: Sequence[int], wanted: Sequence[str]
) -> tuple[int, str, tuple[str, ...]]:
    """Return the number of the header's line, its delimiter, and the names."""
    best, rank = None, (0, 0)
    for i in written:
        try:
            delimiter, names = _split_header(lines[i], wanted, f"{path}: line {i + 1}")
        except InputError:
            if best is None:
                raise
            break  # among the data
        known = _count_known(names, wanted)
        if best is None or (known and (known, len(names)) > rank):
            best, rank = (i, delimiter, names), (known, len(names))
        complete = wanted and rank[0] > len({*wanted})
        if complete or (rank[0] and all(_number(name) is not None for name in names)):
            break
    assert best is not None
    return best


def _split_header(line: str, wanted: Sequence[str], place: str) -> tuple[str, tuple[str, ...]]:
    """Return the delimiter that yields most of the `wanted` columns, and the names; a comment's mark is left out."""
    names = {d: _without_mark(_cells(line, d, place), wanted) for d in DELIMITERS}
    delimiter = max(DELIMITERS, key=lambda d: (_count_known(names[d], wanted), len(names[d]), d == ","))
    return delimiter, names[delimiter]


def _without_mark(names: tuple[str, ...], wanted: Sequence[str]) -> tuple[str, ...]:
    """Leave out the mark of a comment before a known name, as in ``# t,force``."""
    bare = names[0].lstrip("#%").lstrip()
    return (bare, *names[1:]) if names[0] not in wanted and _count_known((bare,), wanted) else names


def _count_known(names: Sequence[str], wanted: Sequence[str]) -> int:
    """Count the `wanted` columns among the names, and a time column."""
    return len({*wanted} & {*_by_bare_name(names)}) + any(map(is_time, names))


def find_column(column: str, names: Sequence[str]) -> str:
    """Return a file's name of a column, which may have a unit in brackets; `column` itself if there is none."""
    return _by_bare_name(names).get(column, column)


def _by_bare_name(names: Sequence[str]) -> dict[str, str]:
    """Return each name by itself and, if that is one alone, by what stands before its brackets."""
    bare = [parts.group(1) for name in names if (parts := WITH_UNIT.fullmatch(name))]
    counts, short = Counter(bare), dict(zip(bare, filter(WITH_UNIT.fullmatch, names), strict=True))
    return {name: full for name, full in short.items() if counts[name] == 1} | {name: name for name in names}


def unit_in_brackets(column: str) -> str:
    """Return the unit in brackets behind the name of a column; empty if there is none."""
    parts = WITH_UNIT.fullmatch(column)
    return (parts.group(2) or parts.group(3) or "").strip() if parts else ""


def is_time(column: str) -> bool:
    """Tell whether a column holds the time in seconds by its name, which may have the unit in brackets.

    >>> is_time("t"), is_time("Time [s]"), is_time("time (ms)"), is_time("T")
    (True, True, False, False)
    """
    return column in TIME_NAMES or bool(_IN_SECONDS.fullmatch(column.strip()))


def _read_units(cells: Sequence[str], names: Sequence[str]) -> list[str] | None:
    """Return the units of a row of units below the names, empty for a column without; None if it is no such row.

    Most of its words are known units, and none is a number or a date.
    """
    first, *others = cells
    units = [cell.strip("[]() ") for cell in (re.sub(r"^[#%]\s*(?=\S)", "", first), *others)]
    words = [unit for unit in units if unit not in ("", "-")]
    if len(units) != len(names) or any(_number(word) is not None or _date(word) for word in words):
        return None
    if 2 * sum(dimension(word) is not None for word in words) <= len(words):
        return None
    return ["" if unit == "-" or _states_unit(name) else unit for unit, name in zip(units, names, strict=True)]


def _states_unit(name: str) -> bool:
    """Tell whether a name ends with a known unit in brackets, rather than with a number or a word."""
    unit = unit_in_brackets(name)
    return _number(unit) is None and dimension(unit) is not None


def _open_mat(path: Path, _wanted: Sequence[str] = ()) -> ArrayTable:
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


def _open_parquet(path: Path, _wanted: Sequence[str] = ()) -> ArrayTable:
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


def _open_mdf(path: Path, wanted: Sequence[str] = ()) -> ArrayTable:
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
    text = str(error).partition("\n")[0].rstrip(".") or type(error).__name__
    return "it holds Python objects, which are not read because they can run code" if "pickle" in text else text


def _text(path: Path) -> str:
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


def _cells(line: str, delimiter: str, place: str) -> tuple[str, ...]:
    if delimiter not in line and '"' not in line:
        return (line.strip(),)
    try:
        return tuple(cell.strip() for cell in next(csv.reader([line], delimiter=delimiter)))
    except csv.Error as error:
        raise InputError(f"{place} is not a row of a CSV file ({error}); give one row for each sample.") from None


def _date(cell: str) -> datetime | None:
    """Return a date and time in the form of ISO 8601, such as 2024-05-01T10:00:00.25; None if it is none."""
    try:
        return datetime.fromisoformat(cell) if "-" in cell else None
    except ValueError:
        return None


def _number(cell: str) -> float | None:
    try:
        return None if "_" in cell else float(cell)
    except ValueError:
        return None
