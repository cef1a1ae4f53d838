"""Tables from the text of a CSV file; errors name the line and the column.

NumPy reads the numbers at once; only if that fails, they are read cell by cell to find the bad cell. Commas, semicolons
and tabs separate cells; quoted cells, blank lines, lines of a title above the header and a row of units below it are
accepted. Lines are counted as in an editor.
"""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from .._base import REPAIR, InputError, usable
from .columns import (
    by_name_without_unit,
    is_time,
    name_with_unit,
    present_samples,
    refuse_slow_channels,
    unit_in_brackets,
)
from .units import dimension

Array = np.ndarray

DELIMITERS = {",": "comma", ";": "semicolon", "\t": "tab"}
LONGEST_TITLE = 100  # lines above the header of a CSV file, at most


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
            refuse_slow_channels(self.path, names, parts)
            self._read_cells([self.names.index(name) for name in names], np.zeros(len(names), dtype=bool))
        return parts

    def series(self, names: Sequence[str], time: str) -> list[tuple[Array, Array]]:
        """Return each named column without its missing samples: their times (K,), s, and values (K, 1)."""
        *parts, t = self._columns(names, time)
        return [present_samples(self.path, name, t[:, 0], part) for name, part in zip(names, parts, strict=True)]

    def unit(self, name: str) -> str:
        """Return the unit of a column; empty if there is none."""
        return unit_in_brackets(name)

    def _columns(self, names: Sequence[str], time: str | None) -> list[Array]:
        """Return each named column as numbers, (M, 1), nan where one is missing; last the times, none missing."""
        if time is not None and self._has_dates(time):
            return [*(self._columns(names, None) if names else ()), self._count_seconds(time)]
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
                hint = "write all decimals with a point, and no comma between thousands"
            raise InputError(f"{place} reads {cell.strip()[:40]!r}, which is not a number; {hint}.")
        if not usable(np.array(value)):
            raise InputError(f"{place} is {cell.strip()}; {REPAIR}.")
        return value


def parse_csv(path: Path, text: str, wanted: Sequence[str]) -> CsvTable:
    """Find the header: the line that names most of the `wanted` columns, or the first; read the names and units."""
    lines = text.split("\n")
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
        names = tuple(map(name_with_unit, names, units))
        top = rows.pop(0)
    if not rows:
        raise InputError(f"{path} has a header but no data below it; give one row for each sample.")
    return CsvTable(path, names, delimiter, _with_decimal_points(lines[top + 1 :], delimiter), top + 2)


def _with_decimal_points(lines: list[str], delimiter: str) -> list[str]:
    """Replace decimal commas by points, unless they may separate cells or thousands, or a number has a point.

    Only cells that are numbers count; a text may hold commas of any kind.
    """
    if delimiter == "," or not any("," in line for line in lines):
        return lines
    text = "\n".join(lines)
    number = rf'((?:^|(?<={delimiter}))[ "]*[+-]?)(\d*){{mark}}(\d*)((?:[eE][+-]?\d+)?[ "]*(?=$|{delimiter}))'
    with_comma, with_point = (re.compile(number.replace("{mark}", mark), re.MULTILINE) for mark in (",", r"\."))
    parts = {(match[2], match[3]) for match in with_comma.finditer(text)}
    if all(len(end) == 3 and 0 < len(begin) <= 3 and begin[0] != "0" for begin, end in parts):
        return lines
    return lines if with_point.search(text) else with_comma.sub(r"\1\2.\3\4", text).split("\n")


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
    return len({*wanted} & {*by_name_without_unit(names)}) + any(map(is_time, names))


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
